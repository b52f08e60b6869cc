"""From the plain fit to one without the bias of noisy columns: instruments where they help, noise subtracted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexid_cli.estimate import corrected, iv, noise
from flexid_cli.estimate.fit import FitResult, block_matrices
from flexid_cli.estimate.solution import Correction
from flexid_cli.models.base import Model
from flexid_cli.pipeline.columns import Columns

Array = NDArray[np.float64]
Matrices = tuple[Array, ...]

# A column whose instrument has less than half of its square in common with it is hardly instrumented.
WEAK_INSTRUMENT = 0.7
# Numbers of the noise sources, as in `noise.Floors`.
SOURCES, MOTOR = 3, 1


@dataclass(frozen=True)
class Refined:
    """A corrected fit, or the reason why there is none.

    Attributes
    ----------
    result : FitResult or None
        None: the plain fit stands.
    correction : Correction or None
        What was taken out.
    reason : str
        Why there is no correction, where there is none.
    instruments : tuple of ndarray or None
        Of each block, where there are any.
    """

    result: FitResult | None
    correction: Correction | None
    reason: str = ""
    instruments: Matrices | None = None


def refine(
    model: Model,
    columns: Columns,
    matrices: Matrices,
    result: FitResult,
    levels: noise.Floors,
    *,
    driven: bool = False,
    loop: Columns | None = None,
) -> Refined:
    """Take the noise of the columns out of a fit.

    Parameters
    ----------
    model, columns, matrices, result
        The plain fit.
    levels : noise.Floors
        Noise of the signals.
    driven : bool
        With instruments from the motor-driven simulation.
    loop : Columns or None
        Columns of a simulation of the closed loop, to be used as instruments. With neither the noise is subtracted.
    """
    Z: Matrices | None = None
    response: noise.Response = noise.measured
    sources = list(range(SOURCES))
    if loop is not None:
        # A simulation along the set point knows nothing of the record's noise.
        Z, sources = block_matrices(model, loop), []
    elif driven:
        axis = iv.mechanism(model, result.theta)
        if axis is None:
            return Refined(None, None, "the fitted axis is not one that could be simulated")
        # Instruments from the motor's motion hold no other noise than the motor encoder's.
        Z, response, sources = iv.instruments(model, columns, axis), iv.response(axis), [MOTOR]
    if Z is not None and iv.strength(Z, matrices) < WEAK_INSTRUMENT:
        return Refined(
            None, None, "the instruments are weak: a simulated column hardly follows the measured one"
        )
    units = {k: _unit_moments(model, columns, k, response) for k in sources if levels.sigma[k] > 0.0}
    single = {k: tuple(levels.sigma[k] ** 2 * N for N in unit) for k, unit in units.items()}
    total = tuple(
        np.asarray(sum((s[b] for s in single.values()), np.zeros((len(block.columns),) * 2)))
        for b, block in enumerate(model.blocks)
    )
    share = corrected.noise_share(model, result, total)
    if share > corrected.MAX_NOISE_SHARE:
        return Refined(
            None, None, f"noise makes up {100.0 * share:.0f} % of what a direction of the parameters rests on"
        )
    found = corrected.correct(model, matrices, result, columns.lengths, moments=total, instruments=Z)
    if found is None:
        return Refined(None, None, "the corrected equations did not settle")
    doubt = corrected.doubt(model, found, single, levels.doubt)
    return Refined(found, Correction(found.theta - result.theta, doubt, share, total), instruments=Z)


def _unit_moments(model: Model, columns: Columns, source: int, response: noise.Response) -> Matrices:
    """Cross products of each block's columns for unit noise of one source."""
    sigma = [1.0 if k == source else 0.0 for k in range(SOURCES)]
    rows = sum(columns.lengths)
    return tuple(
        noise.moments(columns.chain, rows, sigma, b.columns, b.columns, left_response=response)
        for b in model.blocks
    )
