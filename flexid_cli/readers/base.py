"""What every reader gives: channels of a log, as arrays with their stamps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

HEAD_BYTES = 65536


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
    """

    source: str
    values: NDArray[np.float64]
    stamps: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)
    unit: str | None = None
    exact: NDArray[np.int64] | None = None


@dataclass(frozen=True)
class Note:
    """Something the reader met that a person should know, as one sentence with file and place."""

    message: str


@dataclass(frozen=True)
class RawLog:
    """All channels that were asked for, from all files of one run, in the order they were recorded."""

    format: str
    paths: tuple[Path, ...]
    channels: Mapping[str, RawChannel]
    notes: tuple[Note, ...] = ()


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

    def read(self, paths: Sequence[Path], sources: Sequence[str]) -> RawLog:
        """Read the channels ``sources``; the result's keys are the requested spellings."""
        ...
