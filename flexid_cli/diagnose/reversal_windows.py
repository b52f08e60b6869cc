"""The residual about velocity reversals: whether a mismatch lives there, and what it looks like."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate, pairwise

import numpy as np
from numpy.typing import NDArray

from flexid_cli.diagnose.bands import correlated_rows, spread
from flexid_cli.diagnose.result import Reversals

Array = NDArray[np.float64]

WINDOW_S = 0.1  # to either side
LAGS = 21
FEWEST = 8  # reversals that make a mean
MOVING = 0.02  # of the usual speed: slower is standing, and noise turns its sign


def turns(time_s: Array, velocity: Array) -> tuple[Array, Array]:
    """Times at which the velocity changes its sign for good, and its sign after; shapes (k,)."""
    least = MOVING * float(np.quantile(np.abs(velocity), 0.98))
    moving = np.flatnonzero(np.abs(velocity) > least)
    way = np.sign(velocity[moving])
    last = np.flatnonzero(way[1:] != way[:-1])
    found = []
    for k in last:
        a, b = moving[k], moving[k + 1]
        part = np.arange(a, b + 1)
        found.append(float(time_s[part[np.argmin(np.abs(velocity[part]))]]))
    return np.array(found), np.asarray(way[last + 1], dtype=np.float64)


def reversals(
    equation: str,
    e: Array,
    time_s: Array,
    lengths: Sequence[int],
    at: tuple[Array, Array],
    *,
    scale: float,
    unit: str,
) -> Reversals | None:
    """Share of a residual's energy about reversals, and its mean there.

    Parameters
    ----------
    equation : str
    e, time_s : ndarray, shape (r,)
    lengths : sequence of int
        Rows of each gap-free segment.
    at : (ndarray, ndarray)
        Times and directions of the reversals.
    scale : float
        Torque that residual one stands for, in ``unit``.
    unit : str

    Returns
    -------
    Reversals or None
        None where there are fewer than `FEWEST`.
    """
    turned, way = at
    if turned.size < FEWEST:
        return None
    near = _distance(time_s, turned) <= WINDOW_S
    square = np.square(e)
    total = max(float(square.sum()), 1e-300)
    share = float(square[near].sum()) / total
    # A row moves the ratio of the sums by this.
    parts = square * (near - share) / total
    size = spread(parts[:, None], lengths, correlated_rows(parts, lengths))
    half, by_chance = float(size.half_width()[0]), float(near.mean())
    p = float(size.p_value(np.array([share - by_chance]))[0])
    lag, mean, band = _folded(e, time_s, lengths, turned, way)
    return Reversals(
        equation=equation,
        count=int(turned.size),
        time_share=by_chance,
        energy_share=share,
        low=max(share - half, 0.0),
        high=min(share + half, 1.0),
        p_value=0.5 * p if share > by_chance else 1.0 - 0.5 * p,
        lag_s=lag,
        mean=scale * mean,
        band=scale * band,
        unit=unit,
    )


def _distance(time_s: Array, turned: Array) -> Array:
    """Time of each row to the nearest reversal, shape (r,)."""
    after = np.clip(np.searchsorted(turned, time_s), 1, turned.size - 1)
    return np.minimum(np.abs(time_s - turned[after - 1]), np.abs(time_s - turned[after]))


def _folded(
    e: Array, time_s: Array, lengths: Sequence[int], turned: Array, way: Array
) -> tuple[Array, Array, Array]:
    """Mean over the reversals of the residual times the direction after, and its band.

    Each reversal counts as one draw: what lies between two of them is longer than the residual's correlation.
    """
    from scipy.special import stdtrit

    lag = np.linspace(-WINDOW_S, WINDOW_S, LAGS)
    whole = np.zeros(turned.size, dtype=bool)
    for a, b in pairwise(accumulate(lengths, initial=0)):
        whole |= (turned - WINDOW_S >= time_s[a]) & (turned + WINDOW_S <= time_s[b - 1])
    if np.count_nonzero(whole) < 2:
        return lag, np.full(LAGS, np.nan), np.full(LAGS, np.nan)
    each = way[whole, None] * np.interp(turned[whole, None] + lag, time_s, e)
    count = each.shape[0]
    half = float(stdtrit(count - 1, 0.975)) * each.std(axis=0, ddof=1) / np.sqrt(count)
    return lag, each.mean(axis=0), half
