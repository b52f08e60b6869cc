"""Which of several files are pieces of one run, and which are records of their own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from flexid_cli.errors import DataError, InputError
from flexid_cli.readers.base import DEFAULT_OPTIONS, RawChannel, RawLog, ReadOptions
from flexid_cli.readers.registry import refuse_doubles
from flexid_cli.signals.build import build_recording, motor_stamps, read_raw, recording_from_raw
from flexid_cli.signals.timebase import NS

if TYPE_CHECKING:
    from flexid_cli.config.schema import Config
    from flexid_cli.signals.recording import Recording

Mode = Literal["auto", "each", "one"]

# Where a recorder goes on in the next file, hardly a sample is missing between the two.
SPLIT_PERIODS = 10.0
_PACKED = (".gz", ".zst")


@dataclass(frozen=True)
class Record:
    """One record of the axis.

    Attributes
    ----------
    name : str
        For the report: its first file without suffix where that is unique, else the file's path.
    paths : tuple of Path
        Its files.
    recording : Recording
        Joint side, SI.
    raw : RawLog
        What was read, for the report's inputs.
    """

    name: str
    paths: tuple[Path, ...]
    recording: Recording
    raw: RawLog


@dataclass(frozen=True)
class Records:
    """What several files are.

    Attributes
    ----------
    records : tuple of Record
        At least one.
    left_out : tuple of (str, str)
        Name of each record that could not be used, and why.
    decision : str
        What was decided about the files, one sentence; empty for one file.
    doubt : str
        What makes the decision doubtful, or empty.
    """

    records: tuple[Record, ...]
    left_out: tuple[tuple[str, str], ...] = ()
    decision: str = ""
    doubt: str = ""


@dataclass(frozen=True)
class _Span:
    """When a file's motor position was recorded."""

    first_ns: int
    last_ns: int
    period_ns: float


@dataclass(frozen=True)
class _Alone:
    """A file read by itself: its channels, or why it cannot be a record of its own."""

    raw: RawLog | None = None
    time: RawChannel | None = None
    span: _Span | None = None
    reason: str = ""


def read_records(
    paths: Sequence[Path], config: Config, options: ReadOptions = DEFAULT_OPTIONS, mode: Mode = "auto"
) -> Records:
    """Read files that are pieces of one run, or records of their own of the same axis.

    A file continues another one where its stamps begin as the other's end, within ``signals.time.max_gap_s`` or a
    few samples; the two are one run then. A file that lacks a signal belongs to the run of the file before it. All
    other files are records of their own.

    Parameters
    ----------
    paths : sequence of Path
        The files.
    config : Config
        The axis and its signals.
    options : ReadOptions
        The window counts from the start of every record.
    mode : {"auto", "each", "one"}
        ``each``: every file is a record; ``one``: all are files of one run.

    Raises
    ------
    InputError
        A file cannot be read or lacks a signal.
    DataError
        No record can be used.
    """
    if len(paths) == 1 or mode == "one":
        recording, raw = build_recording(paths, config, options)
        return Records((Record(_names([tuple(paths)])[0], tuple(paths), recording, raw),))
    refuse_doubles(paths)
    alone = [_read_alone(path, config, options, strict=mode == "each") for path in paths]
    runs = [[k] for k in range(len(paths))] if mode == "each" else _runs(alone, config)
    if len(runs) == 1:
        files = tuple(paths[k] for k in runs[0])
        recording, raw = build_recording(files, config, options)
        return Records((Record(_names([files])[0], files, recording, raw),), (), _one_run(paths, alone))
    return _several(paths, runs, alone, config, options)


def _read_alone(path: Path, config: Config, options: ReadOptions, *, strict: bool) -> _Alone:
    whole = replace(options, start_s=None, end_s=None)
    try:
        raw, time = read_raw((path,), config, whole)
        stamps = motor_stamps(raw, config, time)
    except InputError as error:
        if strict:
            raise
        return _Alone(reason=error.message)
    return _Alone(raw, time, None if stamps is None else _span(stamps))


def _span(stamps: np.ndarray) -> _Span | None:
    if stamps.size < 2:
        return None
    steps = np.diff(stamps)
    forward = steps[steps > 0]
    period = float(np.median(forward)) if forward.size else 0.0
    return _Span(int(stamps.min()), int(stamps.max()), period)


def _runs(alone: Sequence[_Alone], config: Config) -> list[list[int]]:
    """Numbers of the files of each run, in the order of their stamps; runs in the given order."""
    complete = [k for k, one in enumerate(alone) if one.raw is not None]
    if not complete or any(alone[k].span is None for k in complete):
        return [list(range(len(alone)))]
    run = {k: {k} for k in complete}
    for a, b in sorted(combinations(complete, 2), key=lambda pair: pair[1] - pair[0]):
        joined = run[a] | run[b]
        if run[a] is not run[b] and _continues(alone[a], alone[b], config) and _apart(joined, alone):
            for k in joined:
                run[k] = joined
    for k in range(len(alone)):
        if k not in run:
            neighbour = max((c for c in complete if c < k), default=complete[0])
            run[neighbour].add(k)
    distinct = {id(members): members for members in run.values()}
    return [_in_time(members, alone) for members in sorted(distinct.values(), key=min)]


def _in_time(members: set[int], alone: Sequence[_Alone]) -> list[int]:
    starts = {k: one.span.first_ns for k in members if (one := alone[k]).span is not None}
    return sorted(members, key=lambda k: starts[k] if len(starts) == len(members) else k)


def _slack_ns(one: _Span, other: _Span) -> float:
    return SPLIT_PERIODS * max(one.period_ns, other.period_ns)


def _continues(one: _Alone, other: _Alone, config: Config) -> bool:
    """Whether one file begins where the other one ends."""
    if one.span is None or other.span is None or one.raw is None or other.raw is None:
        return False
    if one.raw.format != other.raw.format:
        return False
    first, second = sorted((one.span, other.span), key=lambda span: span.first_ns)
    slack = _slack_ns(first, second)
    max_gap = config.signals.time.max_gap_s if config.signals.time else None
    longest = slack if max_gap is None else max(max_gap * NS, slack)
    return -slack <= second.first_ns - first.last_ns <= longest


def _apart(members: set[int], alone: Sequence[_Alone]) -> bool:
    """Whether no two of the files were recorded at the same time."""
    spans = sorted((s for k in members if (s := alone[k].span)), key=lambda span: span.first_ns)
    return all(b.first_ns >= a.last_ns - _slack_ns(a, b) for a, b in pairwise(spans))


def _several(
    paths: Sequence[Path],
    runs: Sequence[Sequence[int]],
    alone: Sequence[_Alone],
    config: Config,
    options: ReadOptions,
) -> Records:
    files = [tuple(paths[k] for k in run) for run in runs]
    names = _names(files)
    records: list[Record] = []
    failed: dict[str, DataError] = {}
    for name, run, own in zip(names, runs, files, strict=True):
        try:
            recording, raw = _build(own, [alone[k] for k in run], config, options)
        except DataError as error:
            failed[name] = error
            continue
        except InputError as error:
            told = any(str(path) in error.message for path in own)
            raise InputError(error.message if told else f"{name}: {error.message}", error.hint) from error
        records.append(Record(name, own, recording, raw))
    if not records:
        name, first = next(iter(failed.items()))
        raise DataError(f"no record can be used; {name}: {first.message}", first.hint)
    left_out = tuple((name, why.message) for name, why in failed.items())
    return Records(tuple(records), left_out, _decision(names, files), _doubt(paths, runs, alone))


def _build(
    paths: tuple[Path, ...], alone: Sequence[_Alone], config: Config, options: ReadOptions
) -> tuple[Recording, RawLog]:
    raw = alone[0].raw
    if len(paths) == 1 and raw is not None and options.start_s is None and options.end_s is None:
        return recording_from_raw(raw, config, alone[0].time), raw
    return build_recording(paths, config, options)


def _names(files: Sequence[tuple[Path, ...]]) -> list[str]:
    """Short names of records, each one different."""
    short = [_stem(own[0]) for own in files]
    return [s if short.count(s) == 1 else str(own[0]) for s, own in zip(short, files, strict=True)]


def _stem(path: Path) -> str:
    return Path(path.stem).stem if path.suffix.lower() in _PACKED else path.stem


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names)


def _one_run(paths: Sequence[Path], alone: Sequence[_Alone]) -> str:
    lacking = [path.name for path, one in zip(paths, alone, strict=True) if one.raw is None]
    why = "their stamps continue each other"
    if lacking:
        why = f"{_listed(lacking)} alone {'is' if len(lacking) == 1 else 'are'} no complete record"
    elif any(one.span is None for one in alone):
        why = "they have no stamps to tell them apart by"
    return f"{len(paths)} files taken as one run, for {why} (--records each: records of their own)"


def _decision(names: Sequence[str], files: Sequence[tuple[Path, ...]]) -> str:
    shown = [
        name if len(own) == 1 else f"{name} ({_listed([path.name for path in own])})"
        for name, own in zip(names, files, strict=True)
    ]
    return f"{len(files)} records of one axis, fitted together: {_listed(shown)} (--records one: files of one run)"


def _doubt(paths: Sequence[Path], runs: Sequence[Sequence[int]], alone: Sequence[_Alone]) -> str:
    """A file that lacks a signal, beside another one that lacks none: which of them belongs where is a guess."""
    told = []
    for run in runs:
        complete = [paths[k].name for k in run if alone[k].raw is not None]
        told += [
            f"{paths[k].name} was taken for a further file of the run of {complete[0]}: {alone[k].reason}"
            for k in run
            if alone[k].raw is None and complete
        ]
    return "; ".join(told)


def pooled(records: Sequence[Record]) -> Recording:
    """All records as one for the report's account of the data: counts are sums, and names tell them apart.

    Parameters
    ----------
    records : sequence of Record
        Two or more. The sample rate is that of the first.
    """
    first = records[0].recording
    named: Mapping[str, Recording] = {record.name: record.recording for record in records}
    return replace(
        first,
        segments=tuple(segment for one in named.values() for segment in one.segments),
        duration_s=sum(one.duration_s for one in named.values()),
        clocks=tuple(
            replace(clock, signal=f"{clock.signal} ({name})")
            for name, one in named.items()
            for clock in one.clocks
        ),
        history=tuple(
            f"{name}: {step}"
            for name, one in named.items()
            for step in one.history
            if not step.startswith("clock: ")  # differs by container, and stands with each input
        ),
        notes=notes_of(records),
    )


def notes_of(records: Sequence[Record]) -> tuple[str, ...]:
    """What a person should know of each record, its name first; what the reader met names the file itself."""
    return tuple(
        note if note in {told.message for told in record.raw.notes} else f"{record.name}: {note}"
        for record in records
        for note in record.recording.notes
    )
