"""Sign of a velocity that may turn within a sampling period."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

FINE = 4  # steps a sampling period, of the velocities whose sign is taken
LEAST_CHANGE = 1e-4  # of a velocity over its reversal width, for which a mean is told from its ends
FULL = 20.0  # widths beyond which a sign is one, to the last digit


def between(velocity: Array) -> Array:
    """A velocity at `FINE` steps a period, straight between its samples."""
    at = np.arange(FINE * (velocity.size - 1) + 1) / FINE
    return np.asarray(np.interp(at, np.arange(velocity.size), velocity), dtype=np.float64)


def mean_sign(fine: Array, width: float) -> Array:
    """Mean of tanh(v / width) over the period about each sample, freed of the mean's damping, shape (n,).

    Samples of a sign that turns within a period hold its time no better than to the period. A mean over T damps by
    sinc(f T), that is by (w T)^2 / 24.

    Parameters
    ----------
    fine : ndarray, shape (FINE (n - 1) + 1,)
        The velocity, `FINE` steps a period.
    width : float
    """
    mean = _means(np.ascontiguousarray(fine), width)
    out = np.array(mean, dtype=np.float64)
    out[1:-1] -= np.diff(mean, 2) / 24.0
    return out


@njit(cache=True, nogil=True)
def _means(fine, width):  # type: ignore[no-untyped-def] # pragma: no cover
    """Means over the periods about the samples; at the ends the first and the last step stand for what is beyond."""
    steps = fine.size - 1
    out = np.zeros(steps // FINE + 1)
    for k in range(out.size):
        for i in range(k * FINE - FINE // 2, k * FINE + FINE // 2):
            j = min(max(i, 0), steps - 1)
            out[k] += _straight(fine[j] / width, fine[j + 1] / width)
        out[k] /= FINE
    return out


@njit(cache=True, nogil=True)
def _straight(x, y):  # type: ignore[no-untyped-def] # pragma: no cover
    """Mean of the tanh on the way from x to y: the difference of its integral, ln cosh."""
    if min(x, y) > FULL:
        return 1.0
    if max(x, y) < -FULL:
        return -1.0
    if abs(y - x) < LEAST_CHANGE:
        return np.tanh(0.5 * (x + y))
    a, b = abs(x), abs(y)
    return (b - a + np.log1p(np.exp(-2.0 * b)) - np.log1p(np.exp(-2.0 * a))) / (y - x)
