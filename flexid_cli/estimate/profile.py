"""Profile interval of one parameter: where it may lie when all others follow it, curvature and all.

At each value of the parameter the other estimating equations are solved; what remains in its own equation, as a step
towards the estimate, is compared with the standard error there. For a linear model this is the usual symmetric
interval; where the model bends (a stiffness hardly determined from the motor alone) it is not symmetric.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from flexid_cli.estimate.corrected import equations
from flexid_cli.estimate.fit import scaled_inverse
from flexid_cli.models.base import Model

Array = NDArray[np.float64]
Matrices = Sequence[Array]

MAX_STEPS = 25
SETTLED = 1e-6
# A bound is looked for up to this many half widths from the estimate; beyond it the interval is open.
FARTHEST = 8.0
BISECTIONS = 30


def profile_interval(
    model: Model, products: Matrices, theta: Array, stderr: Array, index: int, half_width: float
) -> tuple[float | None, float | None]:
    """Bounds of a parameter where its profiled step towards the estimate is the interval's half width.

    Parameters
    ----------
    model : Model
        The model.
    products : sequence of ndarray, shapes (columns, columns)
        Weighted cross products Z'M - N of each block (`corrected.products`).
    theta, stderr : ndarray, shape (p,)
        Solution and standard errors.
    index : int
        The parameter.
    half_width : float
        Half width of its symmetric interval.

    Returns
    -------
    tuple of float or None
        Low and high bound; None where there is none within eight half widths.
    """

    def excess(distance: float, sign: float) -> float | None:
        step = _remaining_step(model, products, theta, stderr, index, sign * distance)
        return None if step is None else abs(step) - half_width

    bounds: list[float | None] = []
    for sign in (-1.0, 1.0):
        distance = _crossing(lambda d, sign=sign: excess(d, sign), half_width)
        bounds.append(None if distance is None else float(theta[index] + sign * distance))
    return bounds[0], bounds[1]


def _crossing(excess, half_width: float) -> float | None:  # type: ignore[no-untyped-def]
    low, high = 0.0, half_width
    while True:
        value = excess(high)
        if value is None or high > FARTHEST * half_width:
            return None
        if value >= 0.0:
            break
        low, high = high, 1.5 * high
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        value = excess(middle)
        if value is None:
            return None
        low, high = (middle, high) if value < 0.0 else (low, middle)
    return 0.5 * (low + high)


def _remaining_step(
    model: Model, products: Matrices, theta: Array, stderr: Array, index: int, distance: float
) -> float | None:
    """Step of the parameter towards the estimate when it is held ``distance`` away and the others have settled."""
    held = theta.copy()
    held[index] += distance
    others = np.flatnonzero(np.arange(theta.size) != index)
    scale = np.where(stderr > 0.0, stderr, 1.0)[others]
    for _ in range(MAX_STEPS):
        gradient, normal = equations(model, products, held)
        step = -scaled_inverse(normal[np.ix_(others, others)]) @ gradient[others]
        held[others] += step
        if not np.all(np.isfinite(held)):
            return None
        if float(np.max(np.abs(step) / scale, initial=0.0)) < SETTLED:
            gradient, normal = equations(model, products, held)
            inverse = scaled_inverse(normal)
            # A step is worth as much as the standard error where it is taken.
            there, here = inverse[index, index], _variance(model, products, theta, index)
            return float((inverse @ gradient)[index] * np.sqrt(abs(here / there))) if there else None
    return None


def _variance(model: Model, products: Matrices, theta: Array, index: int) -> float:
    """Variance of the parameter for residuals of unit size."""
    return float(scaled_inverse(equations(model, products, theta)[1])[index, index])
