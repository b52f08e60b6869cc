"""What a log holds: its channels, their clocks and ranges, and which of them look like which signal."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from flexid_cli.errors import InputError, UsageError
from flexid_cli.readers.base import DEFAULT_OPTIONS, ChannelInfo, Damage, RawChannel, RawLog, ReadOptions
from flexid_cli.signals.build import broken, cut_table, find_time_column, time_unit_of
from flexid_cli.signals.recording import ClockStatistics
from flexid_cli.signals.timebase import (
    CLOCKS,
    NS,
    BoolArray,
    IntArray,
    Track,
    build_timelines,
    is_usable,
    make_track,
    to_nanoseconds,
)
from flexid_cli.units import parse_unit

if TYPE_CHECKING:
    from flexid_cli.config.schema import CsvOptions


@dataclass(frozen=True)
class ChannelSummary:
    """One channel.

    Attributes
    ----------
    info : ChannelInfo
        Its name, kind, declared unit and other spellings; ``count`` is that of the samples read.
    minimum, maximum : float or None
        Range of the finite samples; None where there are none.
    invalid : int
        Samples that are NaN or infinite.
    clock : ClockStatistics or None
        None where there is no clock, or where less than two samples have a time.
    clocks : tuple of str
        Clocks that the log holds for the channel and that run.
    rate_hz : float or None
        Mean sampling rate, gaps left out.
    """

    info: ChannelInfo
    minimum: float | None
    maximum: float | None
    invalid: int
    clock: ClockStatistics | None
    clocks: tuple[str, ...] = ()
    rate_hz: float | None = None


@dataclass(frozen=True)
class Inspection:
    """What a log holds.

    Attributes
    ----------
    format : str
        Of the log.
    paths : tuple of Path
        Its files.
    duration_s : float or None
        From the first to the last stamp of all channels; None without a clock.
    time_column : str or None
        The column that looks like time, for formats without clocks of their own.
    time_unit : str or None
        Its unit: declared, else guessed from its name, else s.
    channels : tuple of ChannelSummary
        In the order of the log.
    notes : tuple of str
        What the reader met.
    damage : tuple of Damage
        One entry per file.
    """

    format: str
    paths: tuple[Path, ...]
    duration_s: float | None
    time_column: str | None
    time_unit: str | None
    channels: tuple[ChannelSummary, ...]
    notes: tuple[str, ...] = ()
    damage: tuple[Damage, ...] = ()


_Stamps = tuple[str, IntArray, BoolArray | None]


def inspect_log(
    paths: Sequence[Path], csv: CsvOptions | None = None, options: ReadOptions = DEFAULT_OPTIONS
) -> Inspection:
    """Read a log, or the window of it that ``options`` names, and describe every channel.

    Raises
    ------
    InputError
        The log cannot be read, or holds no numeric channel.
    """
    from flexid_cli.readers.registry import list_channels, read_log

    infos = list_channels(paths, csv=csv)
    if not infos:
        hint = "record joint states, currents or encoder positions"
        raise InputError(f"{paths[0]} holds no numeric channel", hint)
    raw = read_log(paths, [info.source for info in infos], csv=csv, options=options)
    column = None
    if not any(channel.stamps for channel in raw.channels.values()):
        column = find_time_column([info.source for info in infos])
    unit = _time_unit(raw.channels[column]) if column is not None else None
    time = _column_stamps(raw.channels[column], unit or "s") if column is not None else None
    if time is not None and column is not None:
        valid = np.ones(time[1].size, dtype=np.bool_) if time[2] is None else time[2]
        raw = cut_table(raw, (time[1], valid), options)
        time = _column_stamps(raw.channels[column], unit or "s")
    clocks = {info.source: _clock_of(raw.channels[info.source], time) for info in infos}
    return Inspection(
        format=raw.format,
        paths=tuple(raw.paths),
        duration_s=_duration(clocks.values()),
        time_column=column,
        time_unit=unit,
        channels=tuple(_summary(info, raw, clocks[info.source]) for info in infos),
        notes=tuple(note.message for note in raw.notes),
        damage=raw.damage,
    )


def _time_unit(channel: RawChannel) -> str:
    try:
        unit = parse_unit(time_unit_of(channel))
    except UsageError:
        return "s"
    return unit.name if unit.dimension == "time" else "s"


def _column_stamps(time: RawChannel, unit: str) -> _Stamps:
    factor = parse_unit(unit).factor
    if time.exact is not None and np.abs(time.exact).max(initial=0) < 2**63 // round(factor * NS):
        return "column", np.asarray(time.exact * np.int64(round(factor * NS))), None
    return ("column", *to_nanoseconds(time.values, factor))


def _clock_of(channel: RawChannel, time: _Stamps | None) -> _Stamps | None:
    for name in CLOCKS:
        if name in channel.stamps and is_usable(channel.stamps[name]):
            return name, channel.stamps[name], None
    if time is not None and time[1].size == channel.values.size:
        return time
    return None


def _duration(clocks: Iterable[_Stamps | None]) -> float | None:
    """Longest span of one clock; clocks of different names may have different zeros."""
    spans: dict[str, tuple[int, int]] = {}
    for stamps in {id(clock[1]): clock for clock in clocks if clock is not None}.values():
        line = build_timelines([stamps])[0].stamps
        if line.size:
            low, high = spans.get(stamps[0], (int(line[0]), int(line[-1])))
            spans[stamps[0]] = min(low, int(line[0])), max(high, int(line[-1]))
    return max((high - low) / NS for low, high in spans.values()) if spans else None


def _summary(info: ChannelInfo, raw: RawLog, clock: _Stamps | None) -> ChannelSummary:
    channel = raw.channels[info.source]
    finite = channel.values[np.isfinite(channel.values)]
    running = tuple(name for name in CLOCKS if name in channel.stamps and is_usable(channel.stamps[name]))
    track = _track(info.source, raw, clock)
    return ChannelSummary(
        info=replace(info, count=int(channel.values.size), unit=channel.unit or info.unit),
        minimum=float(finite.min()) if finite.size else None,
        maximum=float(finite.max()) if finite.size else None,
        invalid=int(channel.values.size - finite.size),
        clock=track.statistics if track is not None else None,
        clocks=running,
        rate_hz=NS / track.period_ns if track is not None and track.period_ns else None,
    )


def _track(source: str, raw: RawLog, clock: _Stamps | None) -> Track | None:
    if clock is None:
        return None
    channel = raw.channels[source]
    try:
        timeline = broken(build_timelines([clock])[0], channel, raw)
        return make_track(source, source, clock[0], timeline, channel.values)
    except InputError:  # too few samples, or a clock that never stops jumping: nothing to say about it
        return None


def as_document(inspection: Inspection, proposal: str) -> dict[str, object]:
    """Return plain data for JSON (``flexid-inspect/1``); None where something is not known."""
    return {
        "schema": "flexid-inspect/1",
        "format": inspection.format,
        "paths": [str(path) for path in inspection.paths],
        "duration_s": inspection.duration_s,
        "time_column": inspection.time_column,
        "time_unit": inspection.time_unit,
        "channels": [_channel_document(channel) for channel in inspection.channels],
        "notes": list(inspection.notes),
        "damage": [_damage_document(damage) for damage in inspection.damage],
        "proposed_config": proposal,
    }


def _damage_document(damage: Damage) -> dict[str, object]:
    return {
        "path": str(damage.path),
        "trusted": damage.trusted,
        "suspect": damage.suspect,
        "lost": damage.lost,
        "lost_bytes": damage.lost_bytes,
        "lost_chunks": damage.lost_chunks,
        "spans_s": [list(span) for span in damage.spans_s],
        "reasons": list(damage.reasons),
    }


def _channel_document(channel: ChannelSummary) -> dict[str, object]:
    clock = channel.clock
    document: dict[str, object] = {
        "source": channel.info.source,
        "aliases": list(channel.info.aliases),
        "kind": channel.info.kind,
        "unit": channel.info.unit,
        "samples": channel.info.count,
        "minimum": channel.minimum,
        "maximum": channel.maximum,
        "invalid": channel.invalid,
        "rate_hz": channel.rate_hz,
        "clocks": list(channel.clocks),
        "clock": None,
    }
    if clock is not None:
        document["clock"] = {
            "name": clock.clock,
            "period_s": clock.period_s,
            "jitter_s": clock.jitter_s,
            "gaps": clock.gaps,
            "lost_s": clock.lost_s,
            "bridged": clock.bridged,
            "duplicates": clock.duplicates,
            "reordered": clock.reordered,
            "resets": clock.resets,
        }
    return document
