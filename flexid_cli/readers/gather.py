"""The samples of a topic's channels, gathered batch by batch into arrays that grow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from flexid_cli.readers.base import Note, RawChannel
from flexid_cli.readers.batch import Batch
from flexid_cli.readers.damage import damaged
from flexid_cli.readers.messages import needs_integers
from flexid_cli.readers.parts import Decoded
from flexid_cli.readers.path import Leaf, canonical
from flexid_cli.readers.plausibility import lone_jumps_in_parts, misplaced_stamps

_LARGEST_START = 1 << 25  # elements; a log that says it holds more may be damaged, and growing costs little
_SMALLEST = 1024
_T = TypeVar("_T", bound=np.generic)


class Growing(Generic[_T]):
    """A one-dimensional array that grows at its end.

    Parameters
    ----------
    dtype : data type
        Of its elements.
    expected : int
        Elements that it will probably get.
    """

    def __init__(self, dtype: DTypeLike, expected: int = 0) -> None:
        # memory that is never written to is not taken from the system
        self._array: NDArray[_T] = np.empty(max(_SMALLEST, min(expected, _LARGEST_START)), dtype=dtype)
        self.size = 0

    def extend(self, values: NDArray[np.generic]) -> None:
        """Append ``values``."""
        end = self._grown(values.size)
        self._array[self.size : end] = values
        self.size = end

    def fill(self, value: float | bool, count: int) -> None:
        """Append ``value`` ``count`` times."""
        end = self._grown(count)
        self._array[self.size : end] = value
        self.size = end

    def _grown(self, count: int) -> int:
        end = self.size + count
        if end > self._array.size:
            # in place: the system moves the pages of large arrays instead of copying them
            self._array.resize(max(end, self._array.size + self._array.size // 4), refcheck=False)
        return end

    def view(self) -> NDArray[_T]:
        """Return what there is so far; not to be kept while the array grows."""
        return self._array[: self.size]

    def finish(self) -> NDArray[_T]:
        """Return the array without its spare room; nothing can be appended any more."""
        self._array.resize(self.size, refcheck=False)
        return self._array


class _Column:
    """The samples of one channel; rows are kept only where some messages lack it."""

    def __init__(self, leaf: Leaf, expected: int) -> None:
        self.leaf = leaf
        self.values: Growing[np.float64] = Growing(np.float64, expected)
        self.rows: Growing[np.int64] | None = None
        self._integral = True
        self._exact: Growing[np.int64] | None = None

    def add(self, decoded: Decoded, numbers: NDArray[np.int64] | None, before: int, count: int) -> None:
        """Append what one batch holds.

        Parameters
        ----------
        decoded : Decoded
            The batch.
        numbers : ndarray of int64 or None
            Place of each of its messages among the good ones; None: all are good.
        before, count : int
            Messages of the topic before this batch, and good messages in it.
        """
        leaf = self.leaf
        values = decoded.values.get(leaf)
        found = 0 if values is None else values.size
        if found < count and self.rows is None:
            self.rows = Growing(np.int64, before)
            self.rows.extend(np.arange(before))
        if values is None or found == 0:
            return
        self._add_integers(decoded, values)
        self.values.extend(values)
        if self.rows is not None:
            rows = decoded.rows[leaf]
            self.rows.extend((rows if numbers is None else numbers[rows]) + before)

    def _add_integers(self, decoded: Decoded, values: NDArray[np.float64]) -> None:
        """Keep integers as such from the first batch on that float64 cannot hold."""
        exact = decoded.exact.get(self.leaf)
        self._integral = self._integral and decoded.integral.get(self.leaf, False)
        if not self._integral:
            self._exact = None
        elif exact is not None or self._exact is not None:
            if self._exact is None:
                self._exact = Growing(np.int64, self.values.size)
                self._exact.extend(self.values.view().astype(np.int64))
            self._exact.extend(values.astype(np.int64) if exact is None else exact)

    def exact(self) -> NDArray[np.int64] | None:
        """The samples as integers, where float64 cannot hold every one of them."""
        integers = None if self._exact is None else self._exact.finish()
        return integers if integers is not None and needs_integers(integers) else None


class Doubt(NamedTuple):
    """Samples that physics does not allow: messages they are in (ascending), and a sentence about them."""

    rows: NDArray[np.int64]
    reason: str


class TopicOutput:
    """The messages of one topic: stamps by clock, and the channels asked for.

    Samples that no checksum covers are suspect where they jump farther than the record's own statistics
    allow, or where their stamp does.

    Parameters
    ----------
    topic : str
        The topic.
    leaves : sequence of Leaf
        The channels.
    expected : int
        Messages that the topic probably has.
    """

    def __init__(self, topic: str, leaves: Sequence[Leaf], expected: int = 0) -> None:
        self.topic = topic
        self.leaves = tuple(leaves)
        self._columns = [_Column(leaf, expected) for leaf in leaves]
        self._log: Growing[np.int64] = Growing(np.int64, expected)
        self._publish: Growing[np.int64] | None = Growing(np.int64, expected)
        self._header: Growing[np.int64] | None = Growing(np.int64, expected)
        self._suspect: Growing[np.bool_] | None = None
        self._unchecked: list[list[int]] = []  # first and end of the messages that no checksum covers
        self.doubts: list[Doubt] = []

    @property
    def log_time(self) -> NDArray[np.int64]:
        """Log times of the messages so far, shape (n,), in ns; not to be kept while there are more to come."""
        return self._log.view()

    @property
    def size(self) -> int:
        """Number of messages so far."""
        return self._log.size

    def add(self, batch: Batch, decoded: Decoded) -> None:
        """Append the good messages of one batch."""
        before = self._log.size
        good = None if not decoded.bad.any() else ~decoded.bad
        count = batch.log_time.size if good is None else int(np.count_nonzero(good))
        if count == 0:
            return
        self._log.extend(_chosen(batch.log_time, good))
        self._publish = _extended(self._publish, batch.publish_time, good)
        self._header = _extended(self._header, decoded.header_stamp, good)
        self._mark(not batch.trusted, before, count)
        if batch.trusted and not batch.checked:
            if self._unchecked and self._unchecked[-1][1] == before:
                self._unchecked[-1][1] = before + count
            else:
                self._unchecked.append([before, before + count])
        numbers = None if good is None else np.cumsum(good) - 1
        for column in self._columns:
            column.add(decoded, numbers, before, count)

    def spans_without(self, rows: NDArray[np.int64], times: NDArray[np.int64]) -> list[tuple[int, int]]:
        """Return the times between which lie messages that gave no sample that can be trusted.

        Parameters
        ----------
        rows : ndarray of int64, shape (m,)
            Messages that are not plausible.
        times : ndarray of int64, shape (k,)
            Log times of messages that could not be decoded.

        Returns
        -------
        list of (int, int)
            Log times of the trusted messages before and after each of them; without those that have none on
            one side.
        """
        places = np.delete(np.arange(self.size), rows)
        kept = self.log_time[places]
        spans = _around(
            kept, np.searchsorted(places, rows), np.searchsorted(places, rows)
        )  # times may be wrong
        kept.sort(kind="stable")
        spans |= _around(kept, np.searchsorted(kept, times), np.searchsorted(kept, times, side="right"))
        return sorted(spans)

    def _mark(self, suspect: bool, before: int, count: int) -> None:
        if self._suspect is None and suspect:
            self._suspect = Growing(np.bool_, before)
            self._suspect.fill(value=False, count=before)
        if self._suspect is not None:
            self._suspect.fill(suspect, count)

    def finish(self, log: str, notes: list[Note], *, keep_suspect: bool = False) -> dict[str, RawChannel]:
        """Return the channels by their canonical paths, and add to ``notes`` what a person should know.

        Suspect samples are left out, or marked where they are to be kept; `doubts` has them afterwards.

        Raises
        ------
        InputError
            No message has one of the channels.
        """
        stamps = {"log_time": self._log.finish()}
        if self._publish is not None:
            stamps["publish_time"] = self._publish.finish()
        if self._header is not None:
            header = self._header.finish()
            if header.any():
                stamps["header_stamp"] = header
            elif header.size:
                notes.append(
                    Note(f"{log}: the header stamps of topic {self.topic!r} are all zero, so not used")
                )
        suspect = None if self._suspect is None else self._suspect.finish()
        misplaced = self._misplaced(stamps)
        finished = {}
        for column in self._columns:
            channel, rows = self._channel(column, stamps, suspect, log, notes)
            doubtful = self._implausible(channel, rows, misplaced)
            if doubtful is not None:
                channel = _marked(channel, doubtful) if keep_suspect else _kept(channel, ~doubtful)
            finished[channel.source] = channel
        return finished

    def _channel(
        self,
        column: _Column,
        stamps: Mapping[str, NDArray[np.int64]],
        suspect: NDArray[np.bool_] | None,
        log: str,
        notes: list[Note],
    ) -> tuple[RawChannel, NDArray[np.int64] | None]:
        """Return a channel, and the messages of its samples where some messages lack it."""
        name = canonical(column.leaf)
        values = column.values.finish()
        if values.size == 0:
            raise damaged(Path(log), f"no message of topic {self.topic!r} has channel {name!r}")
        rows = None
        if column.rows is not None:
            rows, count = column.rows.finish(), self.size
            notes.append(Note(f"{log}: {count - rows.size} of {count} messages lack channel {name!r}"))
            stamps = {clock: times[rows] for clock, times in stamps.items()}
            suspect = None if suspect is None else suspect[rows]
        exact = column.exact()
        if exact is not None:
            notes.append(
                Note(f"{log}: channel {name!r} holds integers beyond 2^53; as numbers they are rounded")
            )
        return RawChannel(name, values, dict(stamps), exact=exact, suspect=suspect), rows

    def _misplaced(self, stamps: Mapping[str, NDArray[np.int64]]) -> NDArray[np.int64]:
        """Return the messages whose stamps lie where they cannot, ascending; doubts them."""
        rows = []
        for first, end in self._unchecked:
            for clock, times in stamps.items():
                found = np.flatnonzero(misplaced_stamps(times[first:end])) + first
                if found.size:
                    rows.append(found)
                    self._doubt(
                        found, found, f"{{count}} messages have a {clock} far from their neighbours'", stamps
                    )
        return np.unique(np.concatenate(rows)) if rows else np.empty(0, dtype=np.int64)

    def _implausible(
        self, channel: RawChannel, rows: NDArray[np.int64] | None, misplaced: NDArray[np.int64]
    ) -> NDArray[np.bool_] | None:
        """Return which samples are not plausible, or None where all are; doubts those that jump."""
        doubtful = np.zeros(channel.values.size, dtype=np.bool_)
        for span in self._unchecked:
            first, end = span if rows is None else np.searchsorted(rows, span).tolist()
            doubtful[lone_jumps_in_parts(channel.values[first:end]) + first] = True
        places = np.flatnonzero(doubtful)
        if places.size:
            reason = f"{{count}} samples of {channel.source!r} jump farther than the rest allows"
            self._doubt(places if rows is None else rows[places], places, reason, channel.stamps)
        if misplaced.size:
            if rows is None:
                doubtful[misplaced] = True
            else:
                doubtful |= np.isin(rows, misplaced)
        return doubtful if doubtful.any() else None

    def _doubt(
        self,
        rows: NDArray[np.int64],
        places: NDArray[np.int64],
        reason: str,
        stamps: Mapping[str, NDArray[np.int64]],
    ) -> None:
        at = int(stamps["log_time"][places[0]])
        reason = reason.format(count=rows.size)
        self.doubts.append(Doubt(rows, f"{reason}, the first at {at} ns; no checksum covers them"))


def _marked(channel: RawChannel, doubtful: NDArray[np.bool_]) -> RawChannel:
    return replace(channel, suspect=doubtful if channel.suspect is None else channel.suspect | doubtful)


def _kept(channel: RawChannel, which: NDArray[np.bool_]) -> RawChannel:
    return replace(
        channel,
        values=channel.values[which],
        stamps={clock: times[which] for clock, times in channel.stamps.items()},
        exact=None if channel.exact is None else channel.exact[which],
        suspect=None if channel.suspect is None else channel.suspect[which],
    )


def _around(
    kept: NDArray[np.int64], before: NDArray[np.intp], after: NDArray[np.intp]
) -> set[tuple[int, int]]:
    """The last time of those before, and the first of those from ``after`` on, where both are."""
    inside = (before > 0) & (after < kept.size)
    return set(zip(kept[before[inside] - 1].tolist(), kept[after[inside]].tolist(), strict=True))


def _chosen(times: NDArray[np.int64], good: NDArray[np.bool_] | None) -> NDArray[np.int64]:
    return times if good is None else times[good]


def _extended(
    clock: Growing[np.int64] | None, times: NDArray[np.int64] | None, good: NDArray[np.bool_] | None
) -> Growing[np.int64] | None:
    """Append ``times``, or give the clock up where some messages lack it."""
    if clock is None or times is None:
        return None
    clock.extend(_chosen(times, good))
    return clock
