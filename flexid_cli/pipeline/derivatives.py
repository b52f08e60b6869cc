"""Derivatives of sampled signals without phase shift: the paper's central difference, and an exact one."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from flexid_cli.errors import UsageError

Array = NDArray[np.float64]
MAX_ORDER = 4
MAX_HALF_WIDTH = 64


@lru_cache(maxsize=64)
def _stencil(kind: str, order: int, half_width: int) -> tuple[float, ...]:
    """Weights of one derivative for unit sampling period, from -h to +h."""
    if order == 0:
        return (1.0,)
    if kind == "central":
        weights = np.array([1.0])
        for _ in range(order):
            weights = np.convolve(weights, [-0.5, 0.0, 0.5])
        return tuple(weights)
    first, second = _maximally_flat(half_width)
    weights = np.array([1.0])
    for factor in [second] * (order // 2) + [first] * (order % 2):
        weights = np.convolve(weights, factor)
    return tuple(weights)


def _maximally_flat(half_width: int) -> tuple[Array, Array]:
    """Central difference weights of the highest order of accuracy, for the first and second derivative.

    Closed form of the Lagrange weights on 2p+1 points: Fornberg, Math. Comp. 51 (1988) 699, section 4.
    """
    p = half_width
    k = np.arange(1, p + 1)
    ratio = np.array([_factorial_ratio(p, int(j)) for j in k])
    alternating = np.where(k % 2 == 1, 1.0, -1.0)
    first_half = alternating * ratio / k
    second_half = 2.0 * alternating * ratio / k**2
    first = np.concatenate([-first_half[::-1], [0.0], first_half])
    second = np.concatenate([second_half[::-1], [-2.0 * second_half.sum()], second_half])
    return first, second


def _factorial_ratio(p: int, k: int) -> float:
    """Return p!^2 / ((p-k)! (p+k)!) without overflow."""
    return math.exp(2.0 * math.lgamma(p + 1) - math.lgamma(p - k + 1) - math.lgamma(p + k + 1))


def half_width_for(band: float, tolerance: float = 1e-6) -> int:
    """Half width of the exact derivative whose relative error stays below ``tolerance`` up to ``band``.

    Parameters
    ----------
    band : float
        Upper edge of the band as a fraction of the sampling rate, below 0.5.
    tolerance : float
        Largest relative error of the second derivative (the fourth has twice as much).

    Raises
    ------
    UsageError
        No stencil of up to 64 points on either side reaches the tolerance.
    """
    w = 2.0 * math.pi * band
    for p in range(2, MAX_HALF_WIDTH + 1):
        if abs(response("exact", 2, w, p) + w**2) < tolerance * w**2:
            return p
    raise UsageError(
        f"no derivative of this accuracy up to {band:.3g} of the sampling rate",
        "lower the band (pipeline.band_hz, pipeline.decimation) or record at a higher rate",
    )


def response(kind: str, order: int, w: float, half_width: int) -> float:
    """Real amplitude of the derivative at ``w`` rad a sample: the factor of j^(order mod 2).

    An ideal derivative has w, -w^2, -w^3, w^4.
    """
    weights = np.array(_stencil(kind, order, half_width))
    n = np.arange(weights.size) - weights.size // 2
    if order % 2:
        return float(np.sum(weights * np.sin(w * n)))
    return float(np.sum(weights * np.cos(w * n)))


def reach(kind: str, order: int, half_width: int) -> int:
    """Samples on either side that the derivative of ``order`` needs."""
    return order if kind == "central" else half_width * ((order + 1) // 2)


def differentiate(
    x: Array, order: int, period_s: float, *, kind: str = "exact", half_width: int = 8
) -> Array:
    """Derivative of ``order`` of a uniformly sampled signal, without phase shift.

    Parameters
    ----------
    x : ndarray, shape (n,)
        Samples.
    order : int
        0 to 4.
    period_s : float
        Sampling period, s.
    kind : {"exact", "central"}
        ``central`` is the paper's eq. (22), repeated ``order`` times: amplitude sin(w Ts)/(w Ts) each time.
        ``exact`` is the maximally flat difference of the given half width: exact to the tolerance of
        `half_width_for` over the band.
    half_width : int
        Points on either side of the exact first and second derivatives.

    Returns
    -------
    ndarray, shape (n,)
        The ``reach`` first and last samples are not valid (zero padding) and must be trimmed.
    """
    if not 0 <= order <= MAX_ORDER:
        raise UsageError(f"derivative of order {order}", f"orders 0 to {MAX_ORDER} are supported")
    if order == 0:
        return x
    from flexid_cli.pipeline.loops import stencil

    weights = np.array(_stencil(kind, order, half_width))
    middle = weights.size // 2
    padded = np.zeros(x.size + 2 * middle)
    padded[middle : middle + x.size] = x
    derivative = np.empty(x.size)
    stencil(padded, weights[middle:] / period_s**order, -1.0 if order % 2 else 1.0, derivative)
    return derivative
