"""From files and a configuration to a `Recording`: read, choose the clock, convert, align."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from flexid_cli.errors import DataError, InputError, UsageError
from flexid_cli.readers.base import DEFAULT_OPTIONS, Damage, RawChannel, RawLog, ReadOptions
from flexid_cli.signals.convert import Converted, convert_position, convert_torque
from flexid_cli.signals.recording import Array, Recording, Segment
from flexid_cli.signals.resample import PASS_BAND, STOP_DB, Resampled, resample
from flexid_cli.signals.timebase import (
    CLOCKS,
    NS,
    BoolArray,
    IntArray,
    Timeline,
    Track,
    build_timelines,
    choose_clock,
    common_intervals,
    fixed_rate_stamps,
    grid_instants,
    make_track,
    to_nanoseconds,
)
from flexid_cli.units import Unit, parse_unit

if TYPE_CHECKING:
    from flexid_cli.config.schema import Config, PositionSignal, TorqueSignal

DEFAULT_TORQUE_HOLD = "instant"
MIN_SEGMENT_SAMPLES = 32
POSITIONS = ("motor_position", "joint_position", "reference_position")
FASTEST_TURN = 1e4  # rad/s at the encoder; spindles end near it
FASTEST_SLIDE = 100.0  # m/s
MOTION_TOLERANCE = 0.08
MOTION_BLOCKS = (200, 60, 20)  # the longer the blocks, the less of a resonance is left in them
FLEXIBLE = (0.5, 2.0)  # near a resonance the two sides do move differently far
SPAN_ROUNDING_NS = 1000  # spans are told as seconds in floating point
NEARLY_ONE = (0.85, 1.15)  # in slow motion they do not
_TIME_NAME = re.compile(
    r"(?:\w*?[_. ])?(?:time|t|timestamp|time_?stamp|stamp|zeit|seconds?|secs?|epoch|clock)"
    r"(?:[_. ]?(?:s|sec|secs|seconds?|ms|msec|us|µs|usec|ns|nsec|nanos|millis|micros))?"
)
_UNIT_SUFFIX = re.compile(r"(?:[_. (\[]+)(s|sec|seconds?|ms|msec|us|µs|usec|ns|nsec)[)\] ]*$", re.IGNORECASE)


_RowTimes = tuple[IntArray, BoolArray]


@dataclass(frozen=True)
class _Clock:
    """One clock for all signals, before it is cleaned."""

    name: str
    reason: str
    stamps: Mapping[str, tuple[IntArray, BoolArray | None]]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Signal:
    """One signal in joint-side SI, on its own stamps."""

    track: Track
    converted: Converted
    source: str


def build_recording(
    paths: Sequence[Path], config: Config, options: ReadOptions = DEFAULT_OPTIONS
) -> tuple[Recording, RawLog]:
    """Read the signals that the configuration names, and bring them to one joint-side SI recording.

    Parameters
    ----------
    paths : sequence of Path
        All files of one run.
    config : Config
        The axis and its signals.
    options : ReadOptions
        The window, and what is done with damage.

    Returns
    -------
    recording : Recording
        Uniform samples in gap-free segments.
    raw : RawLog
        What was read, for the report's inputs.

    Raises
    ------
    InputError
        A channel or the clock is missing, has less than two samples, or its side, gear or sign contradicts
        another signal.
    DataError
        The signals never overlap in time, or one of them never changes.
    """
    raw, time = read_raw(paths, config, options)
    return recording_from_raw(raw, config, time), raw


def recording_from_raw(raw: RawLog, config: Config, time: RawChannel | None = None) -> Recording:
    """Bring channels that have been read to a recording; see `build_recording`.

    Parameters
    ----------
    raw : RawLog
        Channels by the sources of the configuration.
    config : Config
        The axis and its signals.
    time : RawChannel, optional
        Channel of times, where the log's own clocks are not used.
    """
    sources = _sources(config)
    channels = {role: raw.channels[source] for role, source in sources.items()}
    clock = _choose(raw, channels, config, time)
    timelines = _clean(clock, _max_gap(config))
    timelines = {role: broken(timeline, channels[role], raw) for role, timeline in timelines.items()}
    signals, origin_ns = _convert_all(channels, sources, timelines, clock.name, config)
    for signal in signals.values():
        _require_motion(signal)
    history = [f"clock: {clock.name} ({clock.reason})", *_describe_signals(signals)]
    signals = {role: _delayed(role, signal, config, history) for role, signal in signals.items()}
    segments, rate, notes, duration = _align(signals, config, history)
    start_ns = origin_ns + min(int(signal.track.stamps[0]) for signal in signals.values())
    notes += _check_motions(segments, config)
    return Recording(
        sample_rate_hz=rate,
        segments=segments,
        linear=config.linear,
        torque_unit=signals[config.signals.torque_role].converted.unit,
        duration_s=duration,
        start_ns=start_ns,
        clocks=tuple(signal.track.statistics for signal in signals.values()),
        history=tuple(history),
        notes=(
            *(note.message for note in raw.notes),
            *clock.notes,
            *_unit_notes(channels, config, time),
            *_signal_notes(signals, timelines, config),
            *notes,
        ),
    )


def _given_sources(config: Config) -> list[str | int]:
    return list(dict.fromkeys(getattr(config.signals, role).source for role in _roles(config)))


def _roles(config: Config) -> list[str]:
    roles = (config.signals.torque_role, *POSITIONS)
    return [role for role in roles if getattr(config.signals, role) is not None]


def _sources(config: Config) -> dict[str, str]:
    return {role: str(getattr(config.signals, role).source) for role in _roles(config)}


def _max_gap(config: Config) -> float | None:
    return config.signals.time.max_gap_s if config.signals.time else None


# --- reading ------------------------------------------------------------


def read_raw(paths: Sequence[Path], config: Config, options: ReadOptions) -> tuple[RawLog, RawChannel | None]:
    """Return the log, and the channel that holds its times where these are not the log's own stamps."""
    from flexid_cli.readers.registry import open_reader, read_log

    time = config.signals.time
    source = _time_source(paths, config, is_csv=open_reader(paths, csv=config.csv).name == "csv")
    raw = read_log(paths, _given_sources(config), csv=config.csv, time_source=source, options=options)
    rate = None if time is None else time.rate_hz
    column = None if source is None or rate is not None else raw.channels.get(str(source))
    if raw.format == "csv":
        times = (
            _column_stamps(column, config) if column is not None else _row_times(raw, rate or 1.0, options)
        )
        raw = cut_table(raw, times, options)
        column = None if column is None else raw.channels[str(source)]
    return raw, column


def _row_times(raw: RawLog, rate_hz: float, options: ReadOptions) -> _RowTimes:
    """Times of the rows by a fixed rate; where the window ends before they are lost, that is no fault."""
    rows = max((channel.values.size for channel in raw.channels.values()), default=0)
    known = next((lost.before for lost in raw.lost_rows if lost.count is None and lost.before), rows)
    if known < rows and options.end_s is not None:
        before = tuple(lost for lost in raw.lost_rows if lost.before < known)
        stamps = _fixed_stamps(replace(raw, lost_rows=before), rows, rate_hz)
        if options.end_s * NS <= stamps[known - 1]:
            return stamps, np.arange(rows) < known
    return _fixed_stamps(raw, rows, rate_hz), np.ones(rows, dtype=np.bool_)


def cut_table(raw: RawLog, times: _RowTimes, options: ReadOptions) -> RawLog:
    """Keep the rows of a table that lie in the window of ``options``, counted from its first valid time.

    Parameters
    ----------
    raw : RawLog
        Channels of one length, n rows.
    times : (stamps in ns, valid), each of shape (n,)
        Of the rows.
    options : ReadOptions
        Their window.

    Returns
    -------
    RawLog
        Its account of damage says at which times rows are missing.

    Raises
    ------
    InputError
        No row lies in it.
    """
    stamps, valid = times
    if not valid.any():
        return raw
    first = int(stamps[np.argmax(valid)])
    if options.window(0).is_open:
        return _with_spans(raw, stamps, valid, first)
    inside = valid & options.window(first).holds(stamps)
    if not inside.any():
        raise InputError(
            f"{raw.paths[0]}: nothing was recorded in the window from --start to --end",
            f"its times go up to {(int(stamps[valid].max()) - first) / NS:.6g} s",
        )
    before = np.concatenate(([0], np.cumsum(inside)))
    cut = replace(
        raw,
        channels={name: _rows(channel, inside) for name, channel in raw.channels.items()},
        lost_rows=tuple(replace(lost, before=int(before[lost.before])) for lost in raw.lost_rows),
    )
    return _with_spans(cut, stamps[inside], valid[inside], first)


def _with_spans(raw: RawLog, stamps: IntArray, valid: BoolArray, first_ns: int) -> RawLog:
    """Say between which times the rows are missing that were lost, and those that were kept but may be wrong."""
    usable = np.flatnonzero(valid & ~_suspect_rows(raw, stamps.size))
    spans: dict[Path, set[tuple[float, float]]] = {}
    for lost in raw.lost_rows:
        place = int(np.searchsorted(usable, lost.before))
        if 0 < place < usable.size:
            begin, end = stamps[usable[place - 1]], stamps[usable[place]]
            spans.setdefault(lost.path, set()).add((float(begin - first_ns) / NS, float(end - first_ns) / NS))
    damage = tuple(
        replace(one, spans_s=tuple(sorted({*one.spans_s, *spans.get(one.path, ())}))) for one in raw.damage
    )
    return replace(raw, damage=damage)


def _suspect_rows(raw: RawLog, rows: int) -> BoolArray:
    marks = next((channel.suspect for channel in raw.channels.values() if channel.suspect is not None), None)
    return np.zeros(rows, dtype=np.bool_) if marks is None else marks


def _rows(channel: RawChannel, rows: BoolArray) -> RawChannel:
    return replace(
        channel,
        values=channel.values[rows],
        stamps={clock: times[rows] for clock, times in channel.stamps.items()},
        exact=None if channel.exact is None else channel.exact[rows],
        suspect=None if channel.suspect is None else channel.suspect[rows],
    )


def _time_source(paths: Sequence[Path], config: Config, *, is_csv: bool) -> str | int | None:
    """Choose what to read as time: the configured source, for CSV else the column that looks like it."""
    from flexid_cli.readers.registry import list_channels

    time = config.signals.time
    if time is not None and (time.source is not None or time.rate_hz is not None):
        return time.source
    if not is_csv:
        return None
    names = [info.source for info in list_channels(paths, csv=config.csv)]
    source = find_time_column(names)
    if source is None:
        raise InputError(
            f"no column of {paths[0]} looks like time; columns: {', '.join(names)}",
            "name the time column in signals.time.source, or give signals.time.rate_hz",
        )
    return source


def find_time_column(names: Sequence[str]) -> str | None:
    """Find the column that looks like time: ``time``, ``t``, ``timestamp [ms]``, ``time_ns``."""
    plain = [re.sub(r"\s*[(\[{].*$", "", name).strip().lower() for name in names]
    for wanted in (r"(?:time|t)", _TIME_NAME):
        for name, text in zip(names, plain, strict=True):
            if re.fullmatch(wanted, text):
                return name
    return None


def time_unit_of(channel: RawChannel) -> str:
    """Return the unit of a time column: what the log declares, else what its name ends in, else s."""
    if channel.unit is not None:
        return channel.unit
    suffix = _UNIT_SUFFIX.search(channel.source)
    return suffix.group(1).lower() if suffix else "s"


# --- clock ------------------------------------------------------------


def _choose(
    raw: RawLog, channels: Mapping[str, RawChannel], config: Config, time: RawChannel | None
) -> _Clock:
    settings = config.signals.time
    if settings is not None and settings.rate_hz is not None:
        rate = settings.rate_hz
        rows = max(channel.values.size for channel in channels.values())
        _require_equal_length(channels, rows, f"the rate of {rate:g} Hz")
        stamps = _fixed_stamps(raw, rows, rate)
        return _Clock("fixed_rate", f"{rate:g} Hz, configured", dict.fromkeys(channels, (stamps, None)))
    if time is not None:
        _require_equal_length(channels, time.values.size, f"the time channel {time.source!r}")
        nanoseconds, valid = _column_stamps(time, config)
        chosen = (
            "configured"
            if settings is not None and settings.source is not None
            else "its name is that of a time"
        )
        return _Clock("column", f"{time.source}, {chosen}", dict.fromkeys(channels, (nanoseconds, valid)))
    wanted = None if settings is None or settings.source is None else str(settings.source)
    name, reason = choose_clock({role: channel.stamps for role, channel in channels.items()}, wanted)
    notes: tuple[str, ...] = ()
    if wanted is None and name != CLOCKS[0]:
        notes = (f"clock: {name}, for {reason}; its stamps hold the delays of the transport",)
    return _Clock(name, reason, {role: (c.stamps[name], None) for role, c in channels.items()}, notes)


def motor_stamps(raw: RawLog, config: Config, time: RawChannel | None = None) -> IntArray | None:
    """Stamps of the motor position in ns by the clock that a recording would have, shape (n,).

    None where the configuration gives a fixed rate instead of a clock. See `recording_from_raw` for the rest.
    """
    sources = _sources(config)
    clock = _choose(raw, {role: raw.channels[source] for role, source in sources.items()}, config, time)
    if clock.name == "fixed_rate":
        return None
    stamps, valid = clock.stamps["motor_position"]
    return stamps if valid is None else stamps[valid]


def _require_equal_length(channels: Mapping[str, RawChannel], samples: int, clock: str) -> None:
    for role, channel in channels.items():
        if channel.values.size != samples:
            raise InputError(
                f"{clock} cannot be that of {role}: {channel.values.size} samples instead of {samples}",
                "use a clock that was recorded with every signal: header_stamp or log_time",
            )


def _column_stamps(time: RawChannel, config: Config) -> tuple[IntArray, BoolArray]:
    unit = _time_unit(time, config)
    factor = round(unit.factor * NS)
    if time.exact is not None and np.abs(time.exact).max(initial=0) < 2**63 // factor:
        return time.exact * np.int64(factor), np.ones(time.exact.size, dtype=np.bool_)
    stamps, valid = to_nanoseconds(time.values, unit.factor)
    beyond = np.count_nonzero(np.isfinite(time.values) & ~valid)
    if beyond:
        raise InputError(
            f"{beyond} times of {time.source!r} in {unit.name} lie beyond the year 2262",
            "correct signals.time.unit",
        )
    return stamps, valid


def _time_unit(time: RawChannel, config: Config) -> Unit:
    settings = config.signals.time
    if settings is not None and "unit" in settings.model_fields_set:
        return parse_unit(settings.unit)
    try:
        unit = parse_unit(time_unit_of(time))
    except UsageError:
        unit = parse_unit("s")
    return unit if unit.dimension == "time" else parse_unit("s")


def _clean(clock: _Clock, max_gap_s: float | None) -> dict[str, Timeline]:
    """Timelines of all signals; signals that share stamps share the work."""
    distinct: list[tuple[str, IntArray, BoolArray | None]] = []
    place: dict[str, int] = {}
    for role, (stamps, valid) in clock.stamps.items():
        for number, (_, other, _) in enumerate(distinct):
            if other is stamps or np.array_equal(other, stamps):
                place[role] = number
                break
        else:
            place[role] = len(distinct)
            distinct.append((role, stamps, valid))
    timelines = build_timelines(distinct, max_gap_s)
    return {role: timelines[number] for role, number in place.items()}


def broken(timeline: Timeline, channel: RawChannel, raw: RawLog) -> Timeline:
    """Break a clock where samples were lost, however few: what damage took away is never interpolated.

    Parameters
    ----------
    timeline : Timeline
        Clock of the channel.
    channel : RawChannel
        As it was read.
    raw : RawLog
        Its log.
    """
    if raw.lost_rows:
        return timeline.broken_at([lost.before for lost in raw.lost_rows if lost.count != 0])
    log_time = channel.stamps.get("log_time")
    if log_time is None or raw.first_ns is None:
        return timeline
    reached = np.maximum.accumulate(log_time)
    samples = []
    for begin, end in (span for damage in raw.damage for span in damage.spans_s):
        sample = int(np.searchsorted(reached, raw.first_ns + round(end * NS) - SPAN_ROUNDING_NS))
        before = raw.first_ns + round(begin * NS) + SPAN_ROUNDING_NS
        if 0 < sample < reached.size and reached[sample - 1] <= before:  # else samples in doubt were kept
            samples.append(sample)
    return timeline.broken_at(samples) if samples else timeline


def _fixed_stamps(raw: RawLog, rows: int, rate_hz: float) -> IntArray:
    """Stamps by a fixed rate, shape (rows,), in ns; rows that are missing keep their time.

    Raises
    ------
    InputError
        Samples are missing inside the record, nobody knows how many: those that follow would have a wrong time.
    """
    stamps = fixed_rate_stamps(rows, rate_hz)
    if raw.format != "csv":
        for damage in raw.damage:
            if damage.suspect or damage.lost != 0:
                hint = "leave rate_hz out, so that the log's own stamps are used"
                raise _misplaced(damage, hint)
        return stamps
    accounts = {damage.path: damage for damage in raw.damage}
    missing = np.zeros(rows, dtype=np.int64)
    for lost in raw.lost_rows:
        if not 0 < lost.before < rows:
            continue
        if lost.count is None:
            hint = "name a column of times in signals.time.source, or stop before the damage with --end"
            raise _misplaced(accounts[lost.path], hint)
        missing[lost.before] += lost.count
    if not missing.any():
        return stamps
    return fixed_rate_stamps(rows + int(missing.sum()), rate_hz)[np.arange(rows) + np.cumsum(missing)]


def _misplaced(damage: Damage, hint: str) -> InputError:
    return InputError(
        f"{damage.path} is damaged ({damage.cause()}): samples are missing, and a fixed rate_hz cannot tell when "
        "those after them were recorded",
        hint,
    )


# --- signals ------------------------------------------------------------


def _convert_all(
    channels: Mapping[str, RawChannel],
    sources: Mapping[str, str],
    timelines: Mapping[str, Timeline],
    clock: str,
    config: Config,
) -> tuple[dict[str, _Signal], int]:
    """Signals on stamps that count from the earliest of them, which is returned too."""
    tracks = {
        role: make_track(role, sources[role], clock, timelines[role], channel.values, _max_gap(config))
        for role, channel in channels.items()
    }
    origin = min(int(track.stamps[0]) for track in tracks.values())
    signals = {}
    for role, track in tracks.items():
        converted = _convert(role, track, config)
        moved = replace(track, stamps=track.stamps - origin, values=converted.values)
        signals[role] = _Signal(moved, converted, sources[role])
    return signals, origin


def _convert(role: str, track: Track, config: Config) -> Converted:
    if role not in POSITIONS:
        return convert_torque(track.values, role, config.signals.torque, config.axis, linear=config.linear)
    signal: PositionSignal = getattr(config.signals, role)
    steps = np.diff(track.stamps)
    periods = np.maximum(np.rint(steps / track.period_ns), 1.0).astype(np.int64)
    periods[steps > track.limit_ns] = 0
    return convert_position(track.values, role, signal, config, periods)


def _require_motion(signal: _Signal) -> None:
    """Refuse a channel from which nothing can be learnt; a reference may rest."""
    track = signal.track
    if track.name == "reference_position" or np.ptp(track.values) > 0.0:
        return
    if track.values.size < MIN_SEGMENT_SAMPLES:
        raise DataError(
            f"{track.name}: the channel {signal.source!r} has only {track.values.size} samples",
            f"record longer: at least {MIN_SEGMENT_SAMPLES} samples, and several seconds of motion",
        )
    raise DataError(
        f"{track.name}: the channel {signal.source!r} never changes, it is {track.values[0]:g}"
        f" {signal.converted.unit} (joint side) in all {track.values.size} samples",
        "check signals." + track.name + ".source, or record while the axis moves",
    )


def _delayed(role: str, signal: _Signal, config: Config, history: list[str]) -> _Signal:
    """Move stamps to the time at which the value was true."""
    settings: TorqueSignal | PositionSignal = getattr(config.signals, role)
    shift = 0
    if settings.delay_s:
        shift -= round(settings.delay_s * NS)
        history.append(f"{role}: stamps moved by {-settings.delay_s:g} s, the configured delay")
    if role not in POSITIONS:
        held_ns = _hold_ns(signal.track, config)
        half = round(0.5 * held_ns)
        if (config.signals.torque.hold or DEFAULT_TORQUE_HOLD) == "sample":
            shift += half
            signal = replace(signal, track=_held(signal.track, held_ns))
            history.append(
                f"{role}: each value is held for {held_ns / NS:g} s: stamps moved {half / NS:g} s later, the hold's"
                " damping sinc(f T) applied"
            )
        else:
            history.append(f"{role}: taken as measured at its stamp")
    return (
        replace(signal, track=replace(signal.track, stamps=signal.track.stamps + shift)) if shift else signal
    )


def _hold_ns(track: Track, config: Config) -> float:
    """How long a value is held: the controller's period, else one sample of the log."""
    if config.controller is not None and config.controller.period_s is not None:
        return config.controller.period_s * NS
    return track.period_ns


def _held(track: Track, held_ns: float) -> Track:
    """Values as they act when each is held for a time T: damped by sinc(f T), to (w T)^4.

    sinc(f T) is 1 - (w T)^2 / 24 + ..., and -(w T)^2 the second difference.
    """
    if not track.is_uniform:
        return track
    values = track.values.copy()
    for first, stop in track.segments:
        values[first + 1 : stop - 1] += (
            np.diff(track.values[first:stop], 2) * (held_ns / track.period_ns) ** 2 / 24.0
        )
    return replace(track, values=values)


# --- alignment ------------------------------------------------------------


def _align(
    signals: Mapping[str, _Signal], config: Config, history: list[str]
) -> tuple[tuple[Segment, ...], float, list[str], float]:
    """Segments on the common grid, its rate in Hz, notes, and the duration in s."""
    tracks = [signal.track for signal in signals.values()]
    master = _slowest(signals)
    grids = [grid_instants(master, start, stop) for start, stop in common_intervals(tracks)]
    long = [grid for grid in grids if grid.size >= MIN_SEGMENT_SAMPLES]
    if not long:
        raise _no_common_time(tracks, max((grid.size for grid in grids), default=0))
    origin = min(int(track.stamps[0]) for track in tracks)
    kind = "its own stamps, which count as uniform" if master.is_uniform else "uniform, at its mean rate"
    history.append(f"common grid: {NS / master.period_ns:g} Hz of {master.name} ({kind})")
    resampled = {
        role: [
            resample(s.track, grid, master.period_ns, may_lowpass=role != "reference_position")
            for grid in long
        ]
        for role, s in signals.items()
    }
    history += [_describe_resampling(signals[role].track, parts, master) for role, parts in resampled.items()]
    segments = tuple(
        _segment(
            (grid[0] - origin) / NS, {role: parts[number].values for role, parts in resampled.items()}, config
        )
        for number, grid in enumerate(long)
    )
    lost = [grid for grid in grids if grid.size < MIN_SEGMENT_SAMPLES]
    notes = _coverage_notes(tracks, sum(float(grid[-1] - grid[0]) for grid in long))
    if lost:
        total = sum(grid.size for grid in lost)
        notes.append(
            f"{len(lost)} stretches shorter than {MIN_SEGMENT_SAMPLES} samples were left out, {total} samples"
        )
    return segments, NS / master.period_ns, notes, float(long[-1][-1] - long[0][0]) / NS


def _coverage_notes(tracks: Sequence[Track], used_ns: float) -> list[str]:
    """Say which signal limits the record, where it costs the others a tenth of their time."""
    covered = {
        t.name: float(sum(t.stamps[stop - 1] - t.stamps[first] for first, stop in t.segments)) for t in tracks
    }
    longest, shortest = max(covered, key=covered.__getitem__), min(covered, key=covered.__getitem__)
    if used_ns >= 0.9 * covered[longest]:
        return []
    used, most, least = (f"{time / NS:.4g} s" for time in (used_ns, covered[longest], covered[shortest]))
    return [f"only {used} of the {most} of {longest} are common to all signals; {shortest} has {least}"]


def _slowest(signals: Mapping[str, _Signal]) -> Track:
    """Return the signal whose rate is the common one. The reference never limits it."""
    torque = next(role for role in signals if role not in POSITIONS)
    tracks = [signals[role].track for role in ("motor_position", "joint_position", torque) if role in signals]
    slowest = max(track.period_ns for track in tracks)
    return next(track for track in tracks if track.period_ns >= slowest * (1.0 - 1e-3))


def _no_common_time(tracks: Sequence[Track], longest: int) -> DataError:
    spans = "; ".join(
        f"{track.name} {track.stamps[0] / NS:.3f} to {track.stamps[-1] / NS:.3f} s" for track in tracks
    )
    if max(track.stamps[0] for track in tracks) > min(track.stamps[-1] for track in tracks):
        return DataError(
            f"the signals do not overlap in time: {spans}",
            "check that they have the same clock (signals.time.source), and delay_s",
        )
    gaps = ", ".join(
        f"{track.name} {track.statistics.gaps} (longer than {track.limit_ns / NS:g} s)"
        for track in tracks
        if track.statistics.gaps
    )
    return DataError(
        f"no stretch of {MIN_SEGMENT_SAMPLES} samples without a gap is common to all signals; the longest has"
        f" {longest} ({spans}" + (f"; gaps: {gaps})" if gaps else ")"),
        "record longer, choose another clock, or raise signals.time.max_gap_s",
    )


def _segment(start_s: float, values: Mapping[str, Array], config: Config) -> Segment:
    return Segment(
        start_s=float(start_s),
        torque=values[config.signals.torque_role],
        motor_position=values["motor_position"],
        joint_position=values.get("joint_position"),
        reference_position=values.get("reference_position"),
    )


# --- words ------------------------------------------------------------


def _describe_signals(signals: Mapping[str, _Signal]) -> list[str]:
    lines = []
    for role, signal in signals.items():
        track, clock = signal.track, signal.track.statistics
        uniform = "stamps count as uniform" if track.is_uniform else "stamps are irregular"
        share = 100.0 * clock.jitter_s / clock.period_s
        lines.append(
            f"{role}: {clock.samples} samples of {signal.source!r}, {NS / track.period_ns:g} Hz,"
            f" jitter {share:.2g} % of the period: {uniform}"
        )
        lines += [f"{role}: {step}" for step in signal.converted.steps]
    return lines


def _describe_resampling(track: Track, parts: Sequence[Resampled], master: Track) -> str:
    total, copied = sum(part.values.size for part in parts), sum(part.copied for part in parts)
    if parts[0].taps:
        nyquist = 0.5 * NS / master.period_ns
        return (
            f"{track.name}: low-passed without delay (Kaiser FIR of {parts[0].taps} taps, flat to"
            f" {PASS_BAND * nyquist:g} Hz, {STOP_DB:g} dB from {nyquist:g} Hz), then interpolated"
        )
    if copied == total:
        return f"{track.name}: samples kept as they are"
    return f"{track.name}: {total - copied} of {total} values interpolated by splines, the others kept"


def _signal_notes(
    signals: Mapping[str, _Signal], timelines: Mapping[str, Timeline], config: Config
) -> list[str]:
    damage: dict[str, list[str]] = {}
    for role, signal in signals.items():
        for text in _damage_of(signal.track):
            damage.setdefault(text, []).append(role)
    notes = [f"{', '.join(roles)}: {text}" for text, roles in damage.items()]
    for role, signal in signals.items():
        notes += [*signal.converted.notes, *_speed_notes(role, signal.track, config)]
    quanta = {timeline.quantum_ns for timeline in timelines.values() if timeline.quantum_ns}
    notes += [
        f"stamps were rounded to {quantum / NS:g} s; the uniform clock behind them is used"
        for quantum in sorted(quanta)
    ]
    return notes


def _damage_of(track: Track) -> list[str]:
    clock = track.statistics
    texts = [
        (
            clock.gaps,
            f"{_count(clock.gaps, 'gap')} above {track.limit_ns / NS:.4g} s, in all {clock.lost_s:.4g} s",
        ),
        (clock.bridged, f"{_count(clock.bridged, 'missing sample')} interpolated in short gaps"),
        (
            clock.invalid,
            f"{clock.invalid} of {clock.samples} samples without a number or a stamp were dropped",
        ),
        (clock.duplicates, f"{_count(clock.duplicates, 'sample')} with the stamp of another dropped"),
        (
            clock.duplicates > 0.1 * clock.samples,
            "many stamps are equal, so the clock is too coarse: better give rate_hz",
        ),
        (clock.reordered, f"{_count(clock.reordered, 'sample')} out of order, now sorted"),
        (clock.resets, f"{_count(clock.resets, 'jump')} back of the clock; what follows stands behind a gap"),
        (
            not 1e-6 < clock.period_s < 0.5,
            f"a sampling period of {clock.period_s:g} s is unusual; is the unit of time right?",
        ),
    ]
    return [text for happened, text in texts if happened]


def _count(number: int, word: str) -> str:
    return f"{number} {word}" if number == 1 else f"{number} {word}s"


def _speed_notes(role: str, track: Track, config: Config) -> list[str]:
    if role not in POSITIONS:
        return []
    at_motor = getattr(config.signals, role).side == "motor"
    steps = np.maximum(np.diff(track.stamps), 0.5 * track.period_ns)  # close stamps make noise a speed
    speed = float(np.abs(np.diff(track.values) / steps).max()) * NS
    speed *= config.axis.gear_ratio if at_motor else 1.0
    limit, unit = (FASTEST_SLIDE, "m/s") if config.linear else (FASTEST_TURN, "rad/s")
    if speed <= limit:
        return []
    text = f"{role}: moves at up to {speed:.3g} {unit}, which is hardly possible"
    return [f"{text}; are unit, scale and unwrap right?"]


def _unit_notes(channels: Mapping[str, RawChannel], config: Config, time: RawChannel | None) -> list[str]:
    pairs = [(role, channel.unit, getattr(config.signals, role).unit) for role, channel in channels.items()]
    if time is not None:
        pairs.append(("time", time.unit, _time_unit(time, config).name))
    notes = []
    for role, declared, configured in pairs:
        if declared is None:
            continue
        try:
            same = parse_unit(declared) == parse_unit(configured)
        except UsageError:
            continue
        if not same:
            notes.append(
                f"{role}: the log declares {declared}, the configuration says {configured}, which is used"
            )
    return notes


# --- plausibility ------------------------------------------------------------


def _check_motions(segments: Sequence[Segment], config: Config) -> list[str]:
    """Compare the two encoders' slow motion: a wrong side, gear, unit or sign shows as its ratio."""
    if any(s.joint_position is None for s in segments):
        return []
    seen = [_compared(segments, blocks) for blocks in MOTION_BLOCKS]
    correlation, ratio = max((pair for pair in seen if pair is not None), key=_size, default=(0.0, 1.0))
    if correlation == 0.0:
        return []
    if abs(correlation) < 0.5:
        words = f"motor_position and joint_position hardly move together (correlation {correlation:.2f})"
        return [f"{words}; are they of one axis?"]
    low, high = NEARLY_ONE if correlation > 0.999 else FLEXIBLE
    if low <= ratio <= high or abs(correlation) < 0.9:
        return []
    possible = ratio < FLEXIBLE[0] or ratio > FLEXIBLE[1]
    cause = _cause_of(ratio, config) if possible and abs(correlation) > 0.99 else None
    text = f"at the joint side, joint_position moves {ratio:.3g} times as far as motor_position"
    if cause is not None:
        raise InputError(f"{text}; {cause[0]}", cause[1])
    return [f"{text}; are gear_ratio, side, unit and sign right?"]


def _size(pair: tuple[float, float]) -> float:
    """Size of the correlation, the first of the pair."""
    return abs(pair[0])


def _compared(segments: Sequence[Segment], blocks: int) -> tuple[float, float] | None:
    """Correlation and signed ratio of the encoders' motions; None where one of them rests."""
    motor = np.concatenate([_slow(s.motor_position, blocks) for s in segments])
    joint = np.concatenate([_slow(s.joint_position, blocks) for s in segments])
    power = float(np.sqrt((motor @ motor) * (joint @ joint)))
    if power == 0.0:
        return None
    correlation = float(motor @ joint) / power
    return correlation, float(np.copysign(np.sqrt((joint @ joint) / (motor @ motor)), correlation))


def _slow(position: Array | None, blocks: int) -> Array:
    """Means of ``blocks`` blocks, about their mean: what vibrates near a resonance averages out."""
    if position is None:
        return np.zeros(0)
    block = max(1, position.size // blocks)
    count = position.size // block
    means = position[: count * block].reshape(count, block).mean(axis=1)
    return np.asarray(means - means.mean())


def _cause_of(ratio: float, config: Config) -> tuple[str, str] | None:
    gear = config.axis.gear_ratio
    factors = [(1.0, "their directions differ", "")]
    if abs(gear - 1.0) > 0.05:
        factors.append((gear, f"that is gear_ratio ({gear:g})", "is `side` or gear_ratio wrong?"))
        factors.append((1.0 / gear, f"that is 1/gear_ratio (1/{gear:g})", "is `side` or gear_ratio wrong?"))
    turns = [
        (180.0 / np.pi, "deg per rad"),
        (2.0 * np.pi, "rad per rev"),
        (360.0, "deg per rev"),
        (1e3, "thousand"),
    ]
    for factor, words in turns:
        factors.append((factor, f"that is the factor {words}", "is one of the units wrong?"))
        factors.append((1.0 / factor, f"that is one over the factor {words}", "is one of the units wrong?"))
    off, cause, cure = min((abs(np.log(abs(ratio) / factor)), *words) for factor, *words in factors)
    if off > MOTION_TOLERANCE:
        return None
    turn = "set `sign: -1` on one of the two" if ratio < 0 else ""
    return cause, "; ".join(part for part in (cure, turn) if part)
