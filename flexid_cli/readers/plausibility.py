"""Which samples of a record without checksums physics does not allow: lone jumps that the rest rules out.

A drive's signals go on from sample to sample; steps and impacts change them and leave them changed, or shake the
samples beside them too. A flipped bit changes one sample, and the next ones are as if nothing had been. What is
measured is therefore the *excursion* of a sample: how far it lies outside of the range of its two neighbours
on either side. It is zero on every ramp and at every step, and never larger than the smaller one of the two
steps that lead to the sample and away from it.

How large an excursion may be is read from the record itself, in two ways, and the larger bound holds:

1. ``STEPS`` times the largest regular step from one sample to the next. Regular are the steps in all but the few
   stretches with the largest ones; a record that hardly moves (a flag with a pulse) has none, and is not judged.
2. The tail of the excursions e, continued. Leaving out the ``c`` largest, which may be damage, the next ``k`` of
   y = s + e, where s is ``SHARE`` of the regular step, give Hill's estimate of the tail's index,
   xi = mean(log(y_(c+j) / y_(c+k)), j < k), plus twice its standard error xi / sqrt(k). The level that one record
   in ``1 / ALPHA`` would exceed by chance is then y_(c+k) * (k / ALPHA)**xi - s. Without s, the tail of a smooth
   signal would be that of its rounding errors.

Signals with many spikes of their own have a heavy tail and so a high bound; those of a smooth one are sharp.
Between the samples that are called suspect and the largest excursion that is not must be a gap of a factor of
``GAP``, so that a tail is never cut where it merely gets thin. At last a suspect sample (or two side by side) must
stand alone: the three samples on either side must not jump by more than ``STEPS`` regular steps among themselves.

Where the constants come from. ``ALPHA`` is the rate of false alarms that is wanted, one record in a thousand; the
other constants make it hold where tails are not as Hill's estimate has them:

- ``STEPS``: in 409 columns of the project's recordings (10.8 million samples) the largest excursion is 2.83 regular
  steps, in 99 % of them less than 0.82. 1.4 times the largest, for a wilder record than these, is 4.0.
- ``GAP``: the largest of n excursions with a tail of index xi exceeds the next one by a factor g with the
  probability g**(-1 / xi). Normal noise has xi near 0.1 to 0.2 at these n, so that a factor of 3 occurs in less than
  3**-5 = 0.4 % of the records that are beyond both bounds; Student's t with 3 degrees of freedom has xi = 1/3, 4 %.
- ``SHARE``: excursions below a tenth of a regular step are a smooth motion's; they count in no tail.
- an end of the record is judged by its range alone: a step of a hundred ranges (``_ONE_SIDED``) is none of a drive.

The rates of false alarms on records that were not used for this, and of the flips that are found, are those of
``tests/unit/test_readers_plausibility.py``; docs/reading.md tells them.

B. M. Hill, "A simple general approach to inference about the tail of a distribution", Ann. Statist. 3 (1975).
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

ALPHA = 1e-3  # share of sound records with a suspect sample, were all tails as Hill's estimate has them
GAP = 3.0
STEPS = 4.0
SHARE = 0.1
_LOOKED_THROUGH = 1 << 20  # samples at once: the statistics need several arrays of that size
_OVERLAP = 16  # samples beside a part, so that its first and last are judged by their neighbours
_CACHED = 1 << 15
_FEWEST = 256  # samples; fewer do not show what is usual
_STRETCHES = 512
_DAMAGED = 1000  # one sample in so many may be damaged, and at least a few
_AT_LEAST = 5
_ONE_SIDED = 100.0
_BESIDE = 3  # samples on either side that must be as if nothing had been
_LONGEST_RUN = 2
_PASSES = 4  # damaged neighbours hide each other: those found are left out, and the rest is looked at again

Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]


def lone_jumps(values: Floats) -> Mask:
    """Mark the samples that jump away from their neighbours farther than the record allows.

    Parameters
    ----------
    values : ndarray of float64, shape (n,)
        Samples in the order of recording; NaN where there is none.

    Returns
    -------
    ndarray of bool, shape (n,)
        True where a sample is not plausible. All False for fewer than 256 samples.
    """
    suspect = np.zeros(values.size, dtype=np.bool_)
    if values.size < _FEWEST:
        return suspect
    largest = _regular_step(values)
    if not largest:
        return suspect
    for _ in range(_PASSES):
        places = (
            np.flatnonzero(~suspect & ~np.isnan(values)) if suspect.any() or np.isnan(values).any() else None
        )
        rest = values if places is None else values[places]
        found = _beyond(rest, largest)
        if not found.size:
            break
        suspect[found if places is None else places[found]] = True
    return _lone(values, suspect, largest) if suspect.any() else suspect


def _lone(values: Floats, suspect: Mask, step: float) -> Mask:
    """Keep of the ``suspect`` samples those that stand alone, in a record that goes on as if they were not there.

    An impact or a switched set point shakes the samples beside it too.
    """
    places = np.flatnonzero(suspect | ~np.isnan(values))
    marks, rest = suspect[places], values[places]
    edges = np.flatnonzero(np.diff(np.concatenate(([False], marks, [False])).astype(np.int8)))
    lone = np.zeros_like(suspect)
    for first, end in edges.reshape(-1, 2).tolist():
        if end - first > _LONGEST_RUN:
            continue
        run = places[first:end]
        around = np.concatenate((rest[max(first - _BESIDE, 0) : first], rest[end : end + _BESIDE]))
        if around.size < 2 * _BESIDE:  # at an end it cannot be seen whether the record goes on
            lone[run] = _is_out_of_reach(rest[first:end], rest[~marks])
        elif not np.isnan(values[[run[0] - 1, run[-1] + 1]]).any():  # nor beside a missing value
            lone[run] = bool(np.abs(np.diff(around)).max() <= STEPS * step)
    return lone


def _is_out_of_reach(values: Floats, others: Floats) -> bool:
    """Whether all of ``values`` are farther from ``others`` than any step of the record can lead."""
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(np.abs(values - np.median(others)).min() > _ONE_SIDED * np.ptp(others))


def lone_jumps_in_parts(values: Floats) -> NDArray[np.int64]:
    """Return the places of the `lone_jumps` of a long record, looked through in parts of equal length.

    Parameters
    ----------
    values : ndarray of float64, shape (n,)
        As for `lone_jumps`.

    Returns
    -------
    ndarray of int64
        Ascending. The memory that is needed beside ``values`` is that of a part.
    """
    parts = -(-values.size // _LOOKED_THROUGH) or 1
    edges = [values.size * part // parts for part in range(parts + 1)]
    found = []
    for first, end in itertools.pairwise(edges):
        begin = max(first - _OVERLAP, 0)
        places = np.flatnonzero(lone_jumps(values[begin : end + _OVERLAP])) + begin
        found.append(places[(places >= first) & (places < end)])
    return np.concatenate(found)


def misplaced_stamps(stamps: NDArray[np.int64]) -> Mask:
    """Mark the stamps that lie before or after all their neighbours farther than the record allows.

    Parameters
    ----------
    stamps : ndarray of int64, shape (n,)
        Nanoseconds in the order of recording. Jitter, pauses, a clock that was set, and messages of several
        writers that overtake each other are no damage.

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    if stamps.size < _FEWEST or bool((stamps[1:] >= stamps[:-1]).all()):
        return np.zeros(stamps.size, dtype=np.bool_)
    return lone_jumps((stamps - np.sort(stamps)[stamps.size // 2]).astype(np.float64))


def _regular_step(values: Floats) -> float | None:
    """The largest step of all stretches but the few with the largest ones; None where no step is larger."""
    peaks = np.sort(np.nan_to_num(_largest_steps(values), nan=0.0, posinf=np.inf))[::-1]
    regular = float(peaks[max(1, min(_allowed(values.size - 1), peaks.size // 16))])
    return regular if peaks[0] > STEPS * regular else None


def _largest_steps(values: Floats) -> Floats:
    """Largest step of each stretch, NaN where it has none; a few stretches at a time stay in the cache."""
    count = values.size - 1
    length = max(count // _STRETCHES, 16)
    block = length * max(1, _CACHED // length)
    buffer, peaks = np.empty(min(block, count)), []
    with np.errstate(invalid="ignore", over="ignore"):
        for start in range(0, count, block):
            steps = buffer[: min(block, count - start)]
            np.subtract(
                values[start + 1 : start + steps.size + 1], values[start : start + steps.size], out=steps
            )
            np.abs(steps, out=steps)
            whole = steps.size // length * length
            peaks.append(np.fmax.reduce(steps[:whole].reshape(-1, length), axis=1))
            if whole < steps.size:
                peaks.append(np.fmax.reduce(steps[whole:], keepdims=True))
    return np.concatenate(peaks)


def _allowed(count: int) -> int:
    """How many of ``count`` samples may be damaged."""
    return max(_AT_LEAST, count // _DAMAGED)


def _beyond(values: Floats, step: float) -> NDArray[np.int64]:
    """Places of the samples whose excursion is beyond the bounds; ``step`` is the regular step."""
    if values.size < _FEWEST:
        return np.empty(0, dtype=np.int64)
    excursion = _excursions(values)
    allowed = _allowed(values.size)
    bound = max(STEPS * step, _tail(excursion, allowed, step))
    found = np.flatnonzero(excursion > bound)
    if not found.size or found.size > allowed:
        return found[:0]
    usual = float(np.delete(excursion, found).max())
    return found[excursion[found] > GAP * usual]


def _excursions(values: Floats) -> Floats:
    """How far each sample lies outside of the range of its two neighbours on either side, shape (n,)."""
    padded = np.concatenate((values[[2, 2]], values, values[[-3, -3]]))
    parts = [padded[shift : shift + values.size] for shift in (0, 1, 3, 4)]
    above = np.maximum(np.maximum(parts[0], parts[1]), np.maximum(parts[2], parts[3]))
    below = np.minimum(np.minimum(parts[0], parts[1]), np.minimum(parts[2], parts[3]))
    with np.errstate(invalid="ignore", over="ignore"):
        found: Floats = np.nan_to_num(np.maximum(values - above, below - values), nan=0.0, posinf=np.inf)
    found = np.maximum(found, 0.0)
    # the first and last samples have neighbours on one side only, which a steady motion leaves behind
    found[[0, 1, -2, -1]] /= _ONE_SIDED
    return found


def _tail(excursion: Floats, left_out: int, step: float) -> float:
    """The excursion that one record in ``1 / ALPHA`` would exceed by chance; see the module's text."""
    count = max(20, int(np.sqrt(excursion.size)))
    top = np.sort(np.partition(excursion, -(left_out + count))[-(left_out + count) :])[:count]
    scale = SHARE * step if step > 0 else float(min(top[top > 0], default=0.0))
    top = top + scale
    if not top[0] > 0 or not np.isfinite(top[-1]):
        return float(np.nan_to_num(top[-1]))
    index = float(np.mean(np.log(top[1:] / top[0]))) * (1 + 2 / np.sqrt(count))
    with np.errstate(over="ignore"):
        return float(top[0] * np.power(count / ALPHA, index)) - scale
