"""What every reader gives: channels of a log, as arrays with their stamps."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

HEAD_BYTES = 65536
_NS = 1_000_000_000
_SPANS_SHOWN = 3


@dataclass(frozen=True)
class ReadOptions:
    """How a log is read.

    Attributes
    ----------
    start_s, end_s : float or None
        Window in seconds after the run's first log time: ``start_s <= t < end_s``. For a table, after the
        first stamp of its time column.
    strict : bool
        Any damage is an InputError.
    keep_suspect : bool
        Give the samples too that may be wrong; `RawChannel.suspect` marks them.
    threads : int or None
        Number of threads that unpack chunks; None takes one per core.
    progress : callable or None
        Called now and then with the bytes read so far and the bytes of all files of the run.
    """

    start_s: float | None = None
    end_s: float | None = None
    strict: bool = False
    keep_suspect: bool = False
    threads: int | None = None
    progress: Callable[[int, int], None] | None = None

    def window(self, first_ns: int) -> Window:
        """Return the window as log times, for a run whose first log time is ``first_ns``."""
        start = None if self.start_s is None else first_ns + round(self.start_s * _NS)
        end = None if self.end_s is None else first_ns + round(self.end_s * _NS)
        return Window(start, end)


@dataclass(frozen=True)
class Window:
    """A stretch of log time, ``start_ns <= t < end_ns`` in nanoseconds; None is without bound."""

    start_ns: int | None = None
    end_ns: int | None = None

    @property
    def is_open(self) -> bool:
        """Whether nothing lies outside."""
        return self.start_ns is None and self.end_ns is None

    def overlaps(self, first_ns: int, last_ns: int) -> bool:
        """Whether some time from ``first_ns`` to ``last_ns``, both included, lies inside."""
        begins = self.end_ns is None or first_ns < self.end_ns
        return begins and (self.start_ns is None or last_ns >= self.start_ns)

    def holds(self, times: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which of ``times``, shape (n,), lie inside."""
        inside = np.ones(times.shape, dtype=np.bool_)
        if self.start_ns is not None:
            inside &= times >= self.start_ns
        if self.end_ns is not None:
            inside &= times < self.end_ns
        return inside


class Progress:
    """Adds up the bytes that all files of one run have read, and tells ``ReadOptions.progress``.

    Parameters
    ----------
    options : ReadOptions
        Whose ``progress`` is called.
    total : int
        Bytes of all files of the run.
    """

    def __init__(self, options: ReadOptions, total: int) -> None:
        self._call = options.progress
        self._done = 0
        self._total = total

    def advance(self, count: int) -> None:
        """Count ``count`` more bytes."""
        self._done = min(self._done + count, self._total)
        if self._call is not None:
            self._call(self._done, self._total)


@dataclass(frozen=True)
class Damage:
    """What could be read of one file, and what was lost.

    Attributes
    ----------
    path : Path
        The file.
    trusted, suspect : int
        Messages of the topics that were read (samples of a table) that are right as far as the file's own
        checksums and layout can tell, and those that may be wrong.
    lost : int or None
        Messages that are lost; None where their number cannot be known.
    lost_bytes, lost_chunks : int
        Bytes of the file and number of chunks (pages) that gave nothing.
    spans_s : tuple of (float, float)
        Stretches of time without trusted samples, in seconds after the run's first log time.
    reasons : tuple of str
        One sentence each, with positions in the file.
    """

    path: Path
    trusted: int = 0
    suspect: int = 0
    lost: int | None = 0
    lost_bytes: int = 0
    lost_chunks: int = 0
    spans_s: tuple[tuple[float, float], ...] = ()
    reasons: tuple[str, ...] = ()

    @property
    def is_harmless(self) -> bool:
        """Whether every sample is there and can be trusted."""
        return not (self.suspect or self.lost or self.lost is None or self.lost_bytes or self.lost_chunks)

    def cause(self) -> str:
        """Return the first reason, without the path: what follows it is a line number, or a word."""
        if not self.reasons:
            return ""
        reason = self.reasons[0].removeprefix(f"{self.path}:").strip()
        line, mark, words = reason.partition(": ")
        if reason != self.reasons[0] and mark and line.isdecimal():
            reason = f"line {line}: {words}"
        return reason

    def sentence(self, *, suspect_kept: bool = False) -> str:
        """Say in one sentence what was lost, and where the first damaged place is."""
        parts = []
        if self.suspect:
            were = "was" if self.suspect == 1 else "were"
            fate = "used nevertheless" if suspect_kept else "left out"
            parts.append(f"{self.suspect} may be wrong and {were} {fate}")
        if self.lost is None:
            parts.append("an unknown number is lost")
        elif self.lost:
            parts.append(f"{self.lost} {'is' if self.lost == 1 else 'are'} lost")
        elif self.lost_bytes:
            parts.append("none is lost")
        total = f"{self.trusted} {_noun(self.trusted, 'sample')} can be trusted"
        text = f"{self.path} is damaged: {', '.join([total, *parts])}"
        if self.spans_s:
            shown = ", ".join(_span(*span) for span in self.spans_s[:_SPANS_SHOWN])
            more = len(self.spans_s) - _SPANS_SHOWN
            text += f"; no trusted sample from {shown}"
            text += f" and in {more} more {_noun(more, 'gap')}" if more > 0 else ""
        if not self.reasons:
            return text
        return f"{text}. {'Cause' if len(self.reasons) == 1 else 'First cause'}: {self.cause()}"


def _noun(count: int, singular: str) -> str:
    return singular if count == 1 else f"{singular}s"


def _span(first: float, last: float) -> str:
    """Spell a stretch of time with as many decimals as its length needs."""
    decimals = max(0, min(9, 2 - math.floor(math.log10(last - first) + 1e-6))) if last > first else 3
    return f"{first:.{decimals}f} to {last:.{decimals}f} s"


@dataclass(frozen=True)
class ChannelInfo:
    """One number that a log holds over time.

    Attributes
    ----------
    source : str
        Canonical signal path: a CSV column, or ``/topic/joint/field``, ``/topic.field[2]``.
    count : int
        Number of samples; -1 where it is not known without reading the file.
    unit : str or None
        Unit that the log itself declares (a CSV header), else None.
    kind : str
        Message type or ``column``.
    aliases : tuple of str
        Other spellings of the same channel.
    """

    source: str
    count: int = -1
    unit: str | None = None
    kind: str = "column"
    aliases: tuple[str, ...] = ()


@dataclass(frozen=True)
class RawChannel:
    """Samples of one channel as they stand in the log: no unit conversion, no resampling.

    Attributes
    ----------
    source : str
        Canonical signal path.
    values : ndarray of float64, shape (n,)
        NaN where the log has an empty or non-numeric value.
    stamps : mapping of str to ndarray of int64, shape (n,)
        Nanoseconds by clock: ``header_stamp``, ``log_time``, ``publish_time``. Empty for CSV, whose time is
        a channel of its own.
    unit : str or None
        Unit that the log itself declares.
    exact : ndarray of int64, shape (n,), or None
        The same samples as integers, where all of them are integers and float64 cannot hold every one
        (epoch nanoseconds in a column); else None.
    suspect : ndarray of bool, shape (n,), or None
        Which samples may be wrong and were kept because `ReadOptions.keep_suspect` asks for it; else None.
    """

    source: str
    values: NDArray[np.float64]
    stamps: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)
    unit: str | None = None
    exact: NDArray[np.int64] | None = None
    suspect: NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class Note:
    """Something the reader met that a person should know, as one sentence with file and place."""

    message: str


@dataclass(frozen=True)
class LostRows:
    """A place of a table where rows are missing among its samples.

    Attributes
    ----------
    path : Path
        The file.
    before : int
        Number of the sample that follows, from 0; the number of samples where none does.
    count : int or None
        Rows that are missing; None where that is not known for sure; 0 where none is, but the samples from
        here on may be wrong and were kept.
    """

    path: Path
    before: int
    count: int | None


@dataclass(frozen=True)
class RawLog:
    """All channels that were asked for, from all files of one run, in the order they were recorded.

    ``damage`` has one entry per file, in the order of ``paths``. ``first_ns`` is the log time of the run's
    first message, from which spans and windows count; None for tables. ``lost_rows`` are the places of a table
    where rows are missing, ascending and each once; a message log has the stamps to see them by.
    """

    format: str
    paths: tuple[Path, ...]
    channels: Mapping[str, RawChannel]
    notes: tuple[Note, ...] = ()
    damage: tuple[Damage, ...] = ()
    first_ns: int | None = None
    lost_rows: tuple[LostRows, ...] = ()


DEFAULT_OPTIONS = ReadOptions()


class Reader(Protocol):
    """One log format.

    ``sniff`` must recognise its own files by content and reject every other reader's.
    ``read`` raises InputError naming the nearest channels where a requested source does not exist, and where
    a request is ambiguous.
    """

    name: str
    suffixes: tuple[str, ...]

    def sniff(self, path: Path, head: bytes) -> bool:
        """Whether this reader reads ``path`` (a file or a folder; ``head`` is empty for a folder)."""
        ...

    def channels(self, paths: Sequence[Path]) -> list[ChannelInfo]:
        """List the numeric channels of the log."""
        ...

    def read(
        self, paths: Sequence[Path], sources: Sequence[str], options: ReadOptions = DEFAULT_OPTIONS
    ) -> RawLog:
        """Read the channels ``sources``; the result's keys are the requested spellings."""
        ...
