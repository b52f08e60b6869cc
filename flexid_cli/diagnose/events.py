"""Isolated events: short bursts of residual energy that the rest of the record does not explain."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate, pairwise

import numpy as np
from numpy.typing import NDArray

from flexid_cli.diagnose.bands import correlated_rows, spread
from flexid_cli.diagnose.result import Event

Array = NDArray[np.float64]

WINDOW_S = 0.2
ALPHA = 0.01  # chance of any event in a record that has none
BODY, TAIL = 0.75, 0.95  # quantiles of the windows' energies that their tail is continued from
FEWEST = 40  # windows


def events(equation: str, e: Array, time_s: Array, lengths: Sequence[int]) -> tuple[Event, ...]:
    """Bursts of one equation's residual, in the order of time.

    Energies of windows of `WINDOW_S` have a chi-squared distribution in Gaussian noise, with the degrees of freedom
    that the residual's correlation leaves. A mismatch that comes and goes has a heavier tail: it is continued as a
    power law from what the record itself shows, so that what recurs is no event.

    Parameters
    ----------
    equation : str
    e, time_s : ndarray, shape (r,)
    lengths : sequence of int
        Rows of each gap-free segment.
    """
    width = max(2, round(WINDOW_S / max(float(np.median(np.diff(time_s))), 1e-9)))
    starts, energy = _windows(e, lengths, width)
    count = e.size // width
    if count < FEWEST or not np.all(energy >= 0.0) or float(np.median(energy)) <= 0.0:
        return ()
    loud = energy > max(_gaussian_limit(e, energy, lengths, width, count), _tail_limit(energy, count))
    total, usual = max(float(e @ e), 1e-300), float(np.median(energy))
    found = []
    for first, last in _runs(loud, starts):
        a, b = starts[first], starts[last] + width
        share = float(e[a:b] @ e[a:b]) / total
        peak = float(energy[first : last + 1].max()) / usual
        found.append(Event(equation, float(time_s[a]), float(time_s[b - 1]), peak, share))
    return tuple(found)


def _windows(e: Array, lengths: Sequence[int], width: int) -> tuple[NDArray[np.intp], Array]:
    """First row and mean square of every window within a segment."""
    starts, energy = [], []
    total = np.concatenate([[0.0], np.cumsum(np.square(e))])
    for a, b in pairwise(accumulate(lengths, initial=0)):
        first = np.arange(a, max(b - width + 1, a))
        starts.append(first)
        energy.append((total[first + width] - total[first]) / width)
    return np.concatenate(starts), np.concatenate(energy)


def _gaussian_limit(e: Array, energy: Array, lengths: Sequence[int], width: int, count: int) -> float:
    """What the largest of the windows' energies stays below in stationary Gaussian noise."""
    from scipy.special import gammaincinv

    quiet = np.clip(np.square(e), 0.0, np.quantile(np.square(e), TAIL))
    left = quiet - quiet.mean()
    # Correlated squares come in fewer degrees of freedom than rows.
    error = float(spread(left[:, None], lengths, correlated_rows(left, lengths)).stderr[0])
    inflation = max(error**2 / max(float(left @ left), 1e-300), 1.0)
    half = 0.5 * max(width / inflation, 1.0)
    level = float(np.median(energy)) / float(gammaincinv(half, 0.5))
    return level * float(gammaincinv(half, 1.0 - ALPHA / count))


def _tail_limit(energy: Array, count: int) -> float:
    """The same for a tail that falls as a power of the energy, as far out as the record shows it."""
    body, tail = np.log(np.maximum(np.quantile(energy, [BODY, TAIL]), 1e-300))
    power = (tail - body) / np.log((1.0 - BODY) / (1.0 - TAIL))
    return float(np.exp(tail + power * np.log((1.0 - TAIL) * count / ALPHA)))


def _runs(loud: NDArray[np.bool_], starts: NDArray[np.intp]) -> list[tuple[int, int]]:
    """First and last of each run of windows that are loud and follow each other."""
    at = np.flatnonzero(loud)
    if not at.size:
        return []
    apart = np.flatnonzero(np.diff(starts[at]) > 1)
    return list(zip(at[np.r_[0, apart + 1]].tolist(), at[np.r_[apart, at.size - 1]].tolist(), strict=True))
