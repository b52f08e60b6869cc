"""One model solved: what the report's numbers are made from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexid_cli.estimate.band import Tuning
from flexid_cli.estimate.fit import FitResult
from flexid_cli.models.base import Model
from flexid_cli.pipeline.columns import Columns

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Solution:
    """A model, its columns, and the fit.

    Attributes
    ----------
    matrices : tuple of ndarray
        The blocks' columns, as `fit.block_matrices` gives them.
    method, method_reason : str
        Estimator, and why it was taken.
    """

    model: Model
    columns: Columns
    matrices: tuple[Array, ...]
    result: FitResult
    tuning: Tuning
    method: str
    method_reason: str
