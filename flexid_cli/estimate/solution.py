"""One model solved: what the report's numbers are made from."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from flexid_cli.estimate.band import Tuning
from flexid_cli.estimate.band_choice import BandChoice
from flexid_cli.estimate.fit import FitResult
from flexid_cli.models.base import Model
from flexid_cli.pipeline.columns import Columns

if TYPE_CHECKING:
    from flexid_cli.estimate.essential import Reduction

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Correction:
    """Noise in the columns, taken out of the solution.

    Attributes
    ----------
    shift : ndarray, shape (p,)
        By how much the estimates moved from those of plain least squares.
    doubt : ndarray, shape (p,)
        Standard error that the doubt about the noise levels leaves.
    share : float
        Largest share of noise in what a direction of the parameters rests on.
    moments : tuple of ndarray
        Expected cross products of the noise, of each block.
    """

    shift: Array
    doubt: Array
    share: float
    moments: tuple[Array, ...] = ()


@dataclass(frozen=True)
class Solution:
    """A model, its columns, and the fit.

    Attributes
    ----------
    matrices : tuple of ndarray
        The blocks' columns, as `fit.block_matrices` gives them.
    method, method_reason : str
        Estimator, and why it was taken.
    correction : Correction or None
        None where the noise in the columns is left in.
    instruments : tuple of ndarray or None
        The blocks' instruments, shaped like ``matrices``; None in least squares.
    outputs : FitResult or None
        The output-error fit, where it is the one to report; ``result`` is then what it started from.
    notes : tuple of str
        What a person should know of the estimator: a fallback and its reason.
    reduction : Reduction or None
        Which parameters were tested and set to zero; None where all were fitted without a test.
    bands : BandChoice or None
        Bands that were tried, where the choice was left to the data.
    """

    model: Model
    columns: Columns
    matrices: tuple[Array, ...]
    result: FitResult
    tuning: Tuning
    method: str
    method_reason: str
    correction: Correction | None = None
    instruments: tuple[Array, ...] | None = None
    outputs: FitResult | None = None
    notes: tuple[str, ...] = field(default_factory=tuple)
    reduction: Reduction | None = None
    bands: BandChoice | None = None

    @property
    def reported(self) -> FitResult:
        """The fit whose parameters are reported."""
        return self.outputs or self.result
