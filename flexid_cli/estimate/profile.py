"""Profile interval of one parameter: where it may lie when all others follow it, curvature and all.

At each value of the parameter the other estimating equations are solved; what remains in its own equation, as a step
towards the estimate, is compared with the standard error there. For a linear model this is the usual symmetric
interval; where the model bends (a stiffness hardly determined from the motor alone) it is not symmetric.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

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
# Of the half width: far below what is printed.
TOLERANCE = 1e-6


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
    unit = _variance(model, products, theta, index)

    def bound(sign: float) -> float | None:
        def excess(distance: float) -> float:
            held = sign * distance
            return abs(_remaining_step(model, products, theta, stderr, index, held, unit)) - half_width

        try:
            distance = _crossing(excess, half_width)
        except ArithmeticError:
            return None
        return None if distance is None else float(theta[index] + sign * distance)

    return bound(-1.0), bound(1.0)


def _crossing(excess: Callable[[float], float], half_width: float) -> float | None:
    """Distance at which the excess turns positive, or None."""
    from scipy.optimize import brentq

    low, high = 0.0, half_width
    while excess(high) < 0.0:
        low, high = high, 1.5 * high
        if high > FARTHEST * half_width:
            return None
    return float(brentq(excess, low, high, xtol=TOLERANCE * half_width))


def _remaining_step(
    model: Model,
    products: Matrices,
    theta: Array,
    stderr: Array,
    index: int,
    distance: float,
    unit: float,
) -> float:
    """Step of the parameter towards the estimate when it is held ``distance`` away and the others have settled.

    ``unit`` is its variance at the estimate for residuals of unit size; ArithmeticError where they do not settle.
    """
    held = theta.copy()
    held[index] += distance
    others = np.flatnonzero(np.arange(theta.size) != index)
    scale = np.where(stderr > 0.0, stderr, 1.0)[others]
    for _ in range(MAX_STEPS):
        gradient, normal = equations(model, products, held)
        step = -scaled_inverse(normal[np.ix_(others, others)]) @ gradient[others]
        held[others] += step
        if not np.all(np.isfinite(held)):
            break
        if float(np.max(np.abs(step) / scale, initial=0.0)) < SETTLED:
            gradient, normal = equations(model, products, held)
            inverse = scaled_inverse(normal)
            # A step is worth as much as the standard error where it is taken.
            there = inverse[index, index]
            if there:
                return float((inverse @ gradient)[index] * np.sqrt(abs(unit / there)))
            break
    raise ArithmeticError("the other parameters do not settle")


def _variance(model: Model, products: Matrices, theta: Array, index: int) -> float:
    """Variance of the parameter for residuals of unit size."""
    return float(scaled_inverse(equations(model, products, theta)[1])[index, index])
