"""Time of a log: which clock, what its stamps are worth, where it stops. Arrays in, arrays out.

Stamps are int64 nanoseconds. A clock is cleaned in this order: stamps that are not set are dropped, jumps
back of the clock split the record into stretches, stamps out of order are sorted, equal stamps are dropped,
and stamps that were only rounded (0.0029, 0.0057, 0.0086 s) are put back on the uniform clock they come from.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flexid_cli.errors import InputError
from flexid_cli.signals.recording import Array, ClockStatistics

IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

NS = 1e9
GAP_PERIODS = 3.5
GAP_SIGMAS = 6.0
UNIFORM_JITTER = 1e-3
UNIFORM_WORST = 1e-2
EPOCH_NS = 10**17  # 1973: a clock beyond it counts from 1970, and a stamp of zero in it was never set
RESET_RUN = 4
MAX_RESETS = 1000
SHUFFLED_SHARE = 0.1
CLOCKS = ("header_stamp", "log_time", "publish_time")


def to_nanoseconds(values: Array, seconds_per_unit: float) -> tuple[IntArray, BoolArray]:
    """Return times as integer nanoseconds.

    Parameters
    ----------
    values : ndarray, shape (n,)
        Times in the log's unit; NaN where there is none.
    seconds_per_unit : float
        1 for s, 1e-3 for ms.

    Returns
    -------
    stamps : ndarray of int64, shape (n,)
        Rounded to nanoseconds; 0 where not valid.
    valid : ndarray of bool, shape (n,)
        False for NaN, infinite values, and times beyond the range of int64.
    """
    scaled = np.asarray(values, dtype=np.float64) * round(seconds_per_unit * NS)
    valid = np.abs(scaled) < 2.0**63  # False for NaN too
    stamps: IntArray = np.rint(np.where(valid, scaled, 0.0)).astype(np.int64)
    return stamps, valid


def fixed_rate_stamps(samples: int, rate_hz: float) -> IntArray:
    """Stamps of a record without a time column, shape (samples,), in ns."""
    stamps: IntArray = np.rint(np.arange(samples) * (NS / rate_hz)).astype(np.int64)
    return stamps


def is_usable(stamps: IntArray) -> bool:
    """Whether a clock runs: most of its stamps are set, and they are not all the same."""
    if stamps.size < 2:
        return True
    unset = int(np.count_nonzero(stamps == 0))
    return 2 * unset < stamps.size and bool(stamps.min() != stamps.max())


def choose_clock(clocks: Mapping[str, Mapping[str, IntArray]], wanted: str | None) -> tuple[str, str]:
    """Choose one clock for all signals, for two clocks cannot be compared.

    Parameters
    ----------
    clocks : mapping of signal to mapping of clock to stamps
        What the log offers.
    wanted : str or None
        The configured clock.

    Returns
    -------
    clock, reason : str
        Name of the clock and why it was chosen.

    Raises
    ------
    InputError
        A signal lacks the wanted clock, or no clock runs for every signal.
    """
    if wanted is not None:
        _require_clock(clocks, wanted)
        return wanted, "configured"
    reason = "default: recorded with every signal, and running"
    for clock in CLOCKS:
        lacking = [name for name, stamps in clocks.items() if clock not in stamps]
        stopped = [name for name in clocks if name not in lacking and not is_usable(clocks[name][clock])]
        if not lacking and not stopped:
            return clock, reason
        why = f"{lacking[0]} has none" if lacking else f"that of {stopped[0]} does not run (zero or constant)"
        reason = f"{clock} is not usable: {why}"
    names = ", ".join(clocks)
    raise InputError(
        f"no clock of the log runs for all of {names}; {reason}",
        "record with a running clock; for a CSV, name its time column in signals.time or give rate_hz",
    )


def _require_clock(clocks: Mapping[str, Mapping[str, IntArray]], wanted: str) -> None:
    for name, stamps in clocks.items():
        offered = [clock for clock in CLOCKS if clock in stamps and is_usable(stamps[clock])]
        hint = f"running clocks of {name}: {', '.join(offered) or 'none'}; change signals.time.source"
        if wanted not in stamps:
            raise InputError(f"signals.time.source is {wanted}, but {name} was recorded without it", hint)
        if not is_usable(stamps[wanted]):
            raise InputError(f"the clock {wanted} of {name} does not run: zero or constant stamps", hint)


@dataclass(frozen=True)
class Timeline:
    """A cleaned clock.

    Attributes
    ----------
    order : ndarray of int, shape (m,)
        Which samples of the log are kept, in time order.
    stamps : ndarray of int64, shape (m,)
        Their times in ns, never decreasing (equal stamps are still there).
    starts : tuple of int
        Times at which a new stretch begins after a jump back of the clock.
    reordered, invalid : int
        Samples put back in order; samples without a usable stamp.
    quantum_ns : int
        Step to which the stamps had been rounded, where that was undone, else 0.
    breaks : tuple of int
        Times of the first samples after lost ones; nothing is put between them and the samples before.
    """

    order: NDArray[np.intp]
    stamps: IntArray
    starts: tuple[int, ...] = ()
    reordered: int = 0
    invalid: int = 0
    quantum_ns: int = 0
    breaks: tuple[int, ...] = ()

    def broken_at(self, samples: Sequence[int]) -> Timeline:
        """Return the timeline with breaks before ``samples``, by their number in the log."""
        places = np.searchsorted(np.maximum.accumulate(self.order), np.asarray(samples, dtype=np.intp))
        found = {int(self.stamps[place]) for place in places.tolist() if 0 < place < self.stamps.size}
        return replace(self, breaks=tuple(sorted({*self.breaks, *found})))


def build_timelines(
    clocks: Sequence[tuple[str, IntArray, BoolArray | None]], max_gap_s: float | None = None
) -> list[Timeline]:
    """Clean the clocks of several signals together.

    Parameters
    ----------
    clocks : sequence of (name, stamps in ns, valid or None)
        One entry per signal, in the order of recording.
    max_gap_s : float, optional
        The permitted gap.

    Returns
    -------
    list of Timeline
        Stretches after a reset stand behind the ones before it, moved by the same time in every signal.

    Raises
    ------
    InputError
        The clock jumps back a different number of times in different signals, or all the time.
    """
    kept = [_usable_stamps(stamps, valid) for _, stamps, valid in clocks]
    limits = [
        _gap_limit(_forward_steps(stamps[index]), max_gap_s)
        for (_, stamps, _), index in zip(clocks, kept, strict=True)
    ]
    cuts = [
        find_resets(stamps[index], limit)
        for (_, stamps, _), index, limit in zip(clocks, kept, limits, strict=True)
    ]
    _require_same_resets([name for name, _, _ in clocks], cuts)
    stretches = [
        [_sorted_stretch(stamps, part) for part in np.split(index, cut)]
        for (_, stamps, _), index, cut in zip(clocks, kept, cuts, strict=True)
    ]
    shifts = _stretch_shifts(stretches, max(limits, default=0.0))
    return [
        _join(parts, shifts, stamps.size - index.size, limit)
        for parts, (_, stamps, _), index, limit in zip(stretches, clocks, kept, limits, strict=True)
    ]


def _usable_stamps(stamps: IntArray, valid: BoolArray | None) -> NDArray[np.intp]:
    usable = np.ones(stamps.size, dtype=np.bool_) if valid is None else valid.copy()
    if usable.any() and np.median(stamps[usable]) > EPOCH_NS:
        usable &= stamps > 0
    return np.flatnonzero(usable)


def _forward_steps(stamps: IntArray) -> IntArray:
    """Positive differences of successive stamps; of the sorted ones where the record is shuffled."""
    steps = np.diff(stamps)
    if np.count_nonzero(steps < 0) > SHUFFLED_SHARE * steps.size:
        steps = np.diff(np.sort(stamps))
    return steps[steps > 0]


def _gap_limit(steps: IntArray, max_gap_s: float | None) -> float:
    """Longest step in ns that is no gap. A step of less than 1.5 periods lacks no sample, so it never is."""
    if steps.size == 0:
        return 0.0
    median = float(np.median(steps))
    if max_gap_s is not None:
        return max(max_gap_s * NS, 1.5 * median)
    sigma = 1.4826 * float(
        np.median(np.abs(steps - median))
    )  # of a normal spread, blind to the gaps themselves
    return max(GAP_PERIODS * median, median + GAP_SIGMAS * sigma)


def find_resets(stamps: IntArray, limit_ns: float) -> list[int]:
    """Where the clock jumps back and goes on from there.

    Samples that come late, one by one or in blocks, fit into the hole that they left; samples after a reset
    of the clock lie over others or apart from them.

    Parameters
    ----------
    stamps : ndarray of int64, shape (n,)
        In the order of recording.
    limit_ns : float
        Longest step that is no gap.

    Returns
    -------
    list of int
        Index of the first sample of every new stretch.

    Raises
    ------
    InputError
        There are more than a thousand of them.
    """
    steps = np.diff(stamps)
    if not np.any(steps < 0) or np.count_nonzero(steps < 0) > SHUFFLED_SHARE * steps.size:
        return []
    period = float(np.median(steps[steps > 0])) if np.any(steps > 0) else 0.0
    resets: list[int] = []
    start = 0
    while (found := _first_reset(stamps[start:], period, limit_ns)) is not None:
        start += found
        resets.append(start)
        if len(resets) > MAX_RESETS:
            raise InputError(
                f"the clock jumps back more than {MAX_RESETS} times",
                "choose another clock with signals.time.source, or give a fixed rate_hz",
            )
    return resets


def _first_reset(stamps: IntArray, period: float, limit: float) -> int | None:
    high = np.maximum.accumulate(stamps)
    late = np.zeros(stamps.size + 2, dtype=np.int8)
    late[2:-1] = stamps[1:] < high[:-1]
    edges = np.flatnonzero(np.diff(late))
    for first, stop in zip(edges[::2], edges[1::2], strict=True):
        returns = stop < stamps.size
        if returns and stop - first < RESET_RUN:
            continue
        reach = int(np.searchsorted(high[:first], stamps[first:stop].min() - 2.0 * max(period, limit)))
        if _lies_over(stamps[reach:first], stamps[first:stop], period, limit):
            return int(first)
    return None


def _lies_over(before: IntArray, late: IntArray, period: float, limit: float) -> bool:
    """Whether late stamps lie over earlier ones, or apart from them, instead of in a hole between them."""
    low, high = int(late.min()), int(late.max())
    if int(before.max()) - low < GAP_PERIODS * period:
        return False
    near = before[(before > low - period / 2) & (before < high + period / 2)]
    if near.size >= min(RESET_RUN, late.size):
        first, last = int(near.min()), int(near.max())
        both = near.size + np.count_nonzero((late >= first) & (late <= last))
        if both * period > 1.5 * (last - first + period):
            return True
    older, newer = before[before < low], before[before > high]
    apart = [low - int(older.max())] if older.size else []
    apart += [int(newer.min()) - high] if newer.size else []
    return bool(apart) and max(apart) > limit


def _require_same_resets(names: Sequence[str], cuts: Sequence[Sequence[int]]) -> None:
    if len({len(cut) for cut in cuts}) <= 1:
        return
    counts = ", ".join(f"{name} {len(cut)}" for name, cut in zip(names, cuts, strict=True))
    raise InputError(
        f"the clock jumps back a different number of times in the signals ({counts}): they cannot be aligned",
        "choose another clock, for example signals.time: {source: log_time}, or cut the log at the jump",
    )


def _sorted_stretch(stamps: IntArray, index: NDArray[np.intp]) -> tuple[NDArray[np.intp], IntArray, int]:
    own = stamps[index]
    if not np.any(np.diff(own) < 0):
        return index, own, 0
    late = int(np.count_nonzero(own[1:] < np.maximum.accumulate(own)[:-1]))
    by_time = np.argsort(own, kind="stable")
    return index[by_time], own[by_time], late


def _stretch_shifts(
    stretches: Sequence[Sequence[tuple[NDArray[np.intp], IntArray, int]]], limit: float
) -> list[int]:
    """Time by which every stretch moves, the same for all signals, so that it follows the one before it."""
    count = min((len(parts) for parts in stretches), default=0)
    gap = int(max(NS, 2.0 * limit))
    shifts = [0] * count
    for number in range(1, count):
        ends = [
            int(parts[number - 1][1][-1]) + shifts[number - 1]
            for parts in stretches
            if parts[number - 1][1].size
        ]
        begins = [int(parts[number][1][0]) for parts in stretches if parts[number][1].size]
        shifts[number] = max(ends) + gap - min(begins)
    return shifts


def _join(
    parts: Sequence[tuple[NDArray[np.intp], IntArray, int]], shifts: Sequence[int], invalid: int, limit: float
) -> Timeline:
    order = np.concatenate([index for index, _, _ in parts])
    moved = [stamps + shift for (_, stamps, _), shift in zip(parts, shifts, strict=True)]
    stamps, quantum = _undo_rounding(np.concatenate(moved), limit)
    starts = tuple(int(part[0]) for part in moved[1:] if part.size)
    return Timeline(order, stamps, starts, sum(late for _, _, late in parts), invalid, quantum)


def _undo_rounding(stamps: IntArray, limit: float) -> tuple[IntArray, int]:
    """Put stamps that were rounded to a coarse step back on their uniform clock.

    Rounding of a uniform clock is the only cause for which all stamps are multiples of one step and yet less
    than one step away from a straight line; anything else is left as it is.
    """
    unique, inverse = np.unique(stamps, return_inverse=True)
    if unique.size < 32:
        return stamps, 0
    steps = np.diff(unique)
    quantum = int(np.gcd.reduce(steps))
    period = mean_period(steps, limit)
    if not 2.0 * UNIFORM_JITTER * period < quantum < 0.5 * period:
        return stamps, 0
    smooth = unique.copy()
    for first, stop in split_at_gaps(unique, limit):
        if stop - first < 32:
            continue
        count = np.concatenate(
            ([0], np.cumsum(np.maximum(np.rint(np.diff(unique[first:stop]) / period), 1.0)))
        )
        own = (unique[first:stop] - unique[first]).astype(np.float64)
        slope, offset = np.polyfit(count, own, 1)
        line = slope * count + offset
        if np.ptp(own - line) > 1.25 * quantum:
            return stamps, 0
        smooth[first:stop] = unique[first] + np.rint(line).astype(np.int64)
    return np.asarray(smooth[inverse]), quantum


def mean_period(steps: IntArray, limit_ns: float) -> float:
    """Return the sampling period in ns: the mean step, gaps left out, missing samples counted.

    The median step is that of the rounding where stamps are coarse; the mean has the precision of the record.
    """
    inside = steps[steps <= limit_ns]
    if inside.size == 0:
        return float(np.median(steps)) if steps.size else 0.0
    return float(inside.sum() / np.maximum(np.rint(inside / np.median(inside)), 1.0).sum())


def split_at_gaps(stamps: IntArray, limit_ns: float, breaks: Sequence[int] = ()) -> list[tuple[int, int]]:
    """Index ranges (first, stop) between steps longer than ``limit_ns``, and before ``breaks``."""
    is_gap = (np.diff(stamps) > limit_ns) | _broken(stamps, breaks)
    cuts = np.flatnonzero(is_gap) + 1
    edges = [0, *cuts.tolist(), int(stamps.size)]
    return [(first, stop) for first, stop in itertools.pairwise(edges) if stop > first]


def _broken(stamps: IntArray, breaks: Sequence[int]) -> BoolArray:
    """Which steps between ``stamps`` lead over a break, shape (n - 1,)."""
    broken = np.zeros(max(stamps.size - 1, 0), dtype=np.bool_)
    places = np.searchsorted(stamps, np.asarray(breaks, dtype=np.int64)) - 1
    broken[places[(places >= 0) & (places < broken.size)]] = True
    return broken


@dataclass(frozen=True)
class Track:
    """Samples of one signal in time order, with distinct stamps.

    Attributes
    ----------
    name : str
        Role of the signal.
    stamps : ndarray of int64, shape (n,)
        Strictly increasing, in ns.
    values : ndarray, shape (n,)
        Finite.
    period_ns, limit_ns : float
        Sampling period; longest step that is bridged.
    is_uniform : bool
        Whether the stamps count as uniform (missing samples apart).
    segments : tuple of (first, stop)
        Index ranges without a gap.
    statistics : ClockStatistics
        For the report.
    """

    name: str
    stamps: IntArray
    values: Array
    period_ns: float
    limit_ns: float
    is_uniform: bool
    segments: tuple[tuple[int, int], ...]
    statistics: ClockStatistics


def make_track(
    name: str, source: str, clock: str, timeline: Timeline, values: Array, max_gap_s: float | None = None
) -> Track:
    """Drop what has no value and what has no time of its own, and describe the clock of what is left.

    Parameters
    ----------
    name, source, clock : str
        Role, channel and clock, for messages and the report.
    timeline : Timeline
        Cleaned clock of the channel.
    values : ndarray, shape (n,)
        Samples as they stand in the log.
    max_gap_s : float, optional
        The permitted gap.

    Raises
    ------
    InputError
        Less than two samples are left.
    """
    timed = values[timeline.order]
    finite = np.isfinite(timed)
    stamps, ordered = timeline.stamps[finite], timed[finite]
    distinct = np.concatenate(([True], np.diff(stamps) > 0)) if stamps.size else np.zeros(0, dtype=np.bool_)
    stamps, kept = stamps[distinct], ordered[distinct]
    if stamps.size < 2:
        raise _too_few(name, source, values, timed=timed.size, usable=int(np.count_nonzero(finite)))
    steps = np.diff(stamps)
    limit = _gap_limit(steps, max_gap_s)
    period = mean_period(steps, limit)
    counts = {
        "samples": int(values.size),
        "duplicates": int(distinct.size - stamps.size),
        "reordered": timeline.reordered,
        "resets": len(timeline.starts),
        "invalid": timeline.invalid + int(finite.size - np.count_nonzero(finite)),
    }
    statistics = _statistics(name, clock, stamps, timeline, limit, counts)
    return Track(
        name, stamps, kept, period, limit, _is_uniform(steps, period, limit),
        tuple(split_at_gaps(stamps, limit, timeline.breaks)), statistics,
    )  # fmt: skip


def _too_few(name: str, source: str, values: Array, *, timed: int, usable: int) -> InputError:
    """Return the error for a channel of which less than two samples are left."""
    total, channel = values.size, f"{name}: the channel {source!r}"
    cure = "choose another clock in signals.time.source, or give signals.time.rate_hz"
    if total > 1 and usable > 1:
        text = f"{name}: all {usable} samples of the channel {source!r} have the same stamp"
        return InputError(text, cure)
    if total > 1 and timed < 2:
        return InputError(f"{channel} has a stamp at {timed or 'none'} of its {total} samples", cure)
    hint = f"check signals.{name}.source, or record again"
    if total < 2:
        return InputError(f"{channel} has {'only one' if total else 'no'} sample", hint)
    return InputError(
        f"{channel} has {'no number' if not usable else 'one number'} among its {total} samples", hint
    )


def _statistics(
    signal: str, clock: str, stamps: IntArray, timeline: Timeline, limit: float, counts: Mapping[str, int]
) -> ClockStatistics:
    steps = np.diff(stamps)
    is_gap = (steps > limit) | _broken(stamps, timeline.breaks)
    inside = steps[~is_gap] if not is_gap.all() else steps
    median = float(np.median(inside))
    missing = np.rint(inside / mean_period(steps, limit))
    single = inside[inside < 1.5 * median]
    gaps = steps[is_gap & ~_broken(stamps, timeline.starts)]
    return ClockStatistics(
        signal=signal,
        clock=clock,
        period_s=median / NS,
        jitter_s=float(np.sqrt(np.mean((single - median) ** 2))) / NS,
        gaps=int(gaps.size),
        lost_s=float(gaps.sum()) / NS,
        bridged=int(np.maximum(missing - 1.0, 0.0).sum()),
        **counts,
    )


def _is_uniform(steps: IntArray, period: float, limit: float) -> bool:
    inside = steps[steps <= limit]
    error = inside - np.maximum(np.rint(inside / period), 1.0) * period
    if error.size == 0:
        return False
    typical, worst = float(np.sqrt(np.mean(error**2))), float(np.abs(error).max())
    return typical <= UNIFORM_JITTER * period and worst <= UNIFORM_WORST * period


def common_intervals(tracks: Sequence[Track]) -> list[tuple[int, int]]:
    """Return the times (start, stop) in ns, both inclusive, at which every signal has a segment."""
    common = [
        (int(track.stamps[first]), int(track.stamps[stop - 1]))
        for track in tracks[:1]
        for first, stop in track.segments
    ]
    for track in tracks[1:]:
        slack = UNIFORM_JITTER * track.period_ns
        own = [
            (int(track.stamps[first] - slack), int(track.stamps[stop - 1] + slack))
            for first, stop in track.segments
        ]
        common = _intersect(common, own)
    return common


def _intersect(one: Sequence[tuple[int, int]], other: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    result = []
    i = j = 0
    while i < len(one) and j < len(other):
        start, stop = max(one[i][0], other[j][0]), min(one[i][1], other[j][1])
        if start <= stop:
            result.append((start, stop))
        if one[i][1] < other[j][1]:
            i += 1
        else:
            j += 1
    return result


def grid_instants(master: Track, start_ns: int, stop_ns: int) -> Array:
    """Instants of the common grid inside one interval.

    Where the master's stamps count as uniform they are the grid, with the missing ones put between them, so
    that its samples stay as they are; else the grid is uniform from the master's first stamp on.

    Returns
    -------
    ndarray, shape (m,)
        Nanoseconds.
    """
    slack = UNIFORM_JITTER * master.period_ns
    first = int(np.searchsorted(master.stamps, start_ns - slack, side="left"))
    stop = int(np.searchsorted(master.stamps, stop_ns + slack, side="right"))
    stamps = master.stamps[first:stop].astype(np.float64)
    if stamps.size < 2:
        return stamps
    if master.is_uniform:
        return fill_missing(stamps, master.period_ns)
    count = int((stamps[-1] - stamps[0]) / master.period_ns + UNIFORM_JITTER) + 1
    return np.asarray(stamps[0] + np.arange(count) * master.period_ns)


def fill_missing(stamps: Array, period_ns: float) -> Array:
    """Stamps with those of missing samples put between them at equal distances."""
    repeats = np.maximum(np.rint(np.diff(stamps) / period_ns), 1.0).astype(np.int64)
    if np.all(repeats == 1):
        return stamps
    index = np.concatenate(([0], np.cumsum(repeats)))
    return np.asarray(np.interp(np.arange(index[-1] + 1), index, stamps))
