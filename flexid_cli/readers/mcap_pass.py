"""One pass through an MCAP file: chunks are unpacked in threads, their messages come out in order."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from flexid_cli.readers.base import Progress, Window
from flexid_cli.readers.batch import Batch
from flexid_cli.readers.byte_source import ByteSource
from flexid_cli.readers.loss import Loss
from flexid_cli.readers.mcap_chunk import Picks, Trust, Unpacked, unpack
from flexid_cli.readers.mcap_records import MAGIC, Chunk, Located, index_times
from flexid_cli.readers.mcap_salvage import Seeker
from flexid_cli.readers.mcap_summary import Summary, data_checksum_holds, read_summary
from flexid_cli.readers.mcap_topics import Described, Level, Topics
from flexid_cli.readers.mcap_walk import ChunkPiece, HolePiece, LoosePiece, Piece, Walk
from flexid_cli.readers.memory import keep_freed_memory

_MOST_IN_FLIGHT = 48 << 20  # bytes of unpacked chunks that wait, beyond the one that is in use
_INDEX_BYTES = 1 << 20

Read = tuple[Piece, Unpacked | None]
_Choice = NDArray[np.bool_] | NDArray[np.int64] | None


@dataclass(frozen=True)
class _Found:
    """Messages in one buffer, before they are sorted by topic."""

    buffer: bytes
    messages: Located
    trusted: NDArray[np.bool_] | bool
    checked: bool


@dataclass
class _Ahead:
    """A piece that waits for its turn; its chunk is unpacked, or a thread will do that."""

    piece: Piece
    future: Future[Unpacked] | None
    unpacked: Unpacked | None = None


class McapPass:
    """One pass through a file.

    Parameters
    ----------
    source : ByteSource
        The open file.
    loss : Loss
        Takes up what is damaged.
    wanted : callable
        Whether a topic is wanted.
    window : Window
        Chunks outside of it are not read.
    threads : int or None
        That unpack chunks; None takes one per core.
    progress : Progress, optional
        Is told what has been read.
    summary : Summary, optional
        The end of the file, where it was read before.
    """

    def __init__(
        self,
        source: ByteSource,
        loss: Loss,
        wanted: Callable[[str], bool],
        window: Window,
        threads: int | None,
        progress: Progress | None = None,
        summary: Summary | None = None,
    ) -> None:
        self._source = source
        self._loss = loss
        self._window = window
        self._threads = threads or os.cpu_count() or 1
        self._progress = progress
        self._summary = summary or read_summary(source)
        self._topics = Topics(self._summary, wanted)
        self._seeker = Seeker(source, set(self._summary.channels))
        self._walk = Walk(source, self._summary, self._seeker, self._skips)
        self._skipped: list[Chunk] = []
        self._unknown: dict[int, int] = {}
        self._delivered = 0
        self._suspect = 0
        self._met_chunks = bool(self._summary.chunks)
        self._met_checksums = False
        self._gap = _Gap(loss)

    def batches(self) -> Iterator[Batch]:
        """Yield the messages of the wanted topics in the order of the file."""
        keep_freed_memory()
        done = 0
        if self._source.read(0, len(MAGIC)) != MAGIC:
            self._loss.add("its first bytes are not those of an MCAP file")
        for piece, unpacked in self._read():
            for batch in self._messages(piece, unpacked):
                self._note(batch)
                yield batch
                del batch
            del unpacked  # its memory, still in the processor's cache, is the next chunk's
            end = piece.end if isinstance(piece, HolePiece) else _end_of(piece)
            self._advance(end - done)
            done = max(done, end)
        self._advance(self._source.size - done)
        self._finish()

    def _advance(self, count: int) -> None:
        if self._progress is not None and count > 0:
            self._progress.advance(count)

    # --- pieces of the file, unpacked -----------------------------------------------------------------

    def _pieces(self) -> Iterator[Piece]:
        if not self._window.is_open and self._summary.lists_all:
            return self._walk.indexed()
        return self._walk.pieces()

    def _read(self) -> Iterator[Read]:
        """Yield the pieces in order, their chunks unpacked by some threads ahead of the one in use.

        This thread, which decodes the messages, is one of them: one more would stand in its way.
        """
        if self._threads == 1:
            for piece in self._pieces():
                yield piece, self._unpack(piece) if isinstance(piece, ChunkPiece) else None
            return
        waiting: deque[_Ahead] = deque()
        size = 0
        with ThreadPoolExecutor(self._threads - 1, "flexid-unpack") as pool:
            try:
                for piece in self._pieces():
                    chunk = piece if isinstance(piece, ChunkPiece) else None
                    waiting.append(_Ahead(piece, None if chunk is None else pool.submit(self._unpack, chunk)))
                    size += _size_of(piece)
                    while len(waiting) > self._threads + 1 or (size > _MOST_IN_FLIGHT and len(waiting) > 1):
                        size -= _size_of(waiting[0].piece)
                        yield self._next(waiting)
                while waiting:
                    yield self._next(waiting)
            finally:
                for ahead in waiting:
                    if ahead.future is not None:
                        ahead.future.cancel()

    def _next(self, waiting: deque[_Ahead]) -> Read:
        """Take the first of the pieces; until its chunk is unpacked, unpack those that no thread has begun."""
        first = waiting[0]
        for ahead in waiting:
            if first.future is None or first.future.done():
                break
            if ahead.future is not None and ahead.future.cancel() and isinstance(ahead.piece, ChunkPiece):
                ahead.future, ahead.unpacked = None, self._unpack(ahead.piece)
        waiting.popleft()
        return first.piece, first.unpacked if first.future is None else first.future.result()

    def _unpack(self, piece: ChunkPiece) -> Unpacked:
        return unpack(self._source, piece.chunk, piece.index_end, self._picks(piece.chunk))

    def _picks(self, chunk: Chunk) -> Picks | None:
        """Return where a checked summary places the index of all that is wanted of a chunk.

        None where all of the chunk is wanted, or where the summary does not describe all of its channels.
        """
        entry = self._summary.chunks.get(chunk.position) if self._summary.lists_all else None
        if entry is None or entry.channels <= self._wanted_by_summary:
            return None
        places = entry.indexes
        if places is None or not entry.channels <= self._summary.channels.keys():
            return None
        return [(channel, *places[channel]) for channel in entry.channels & self._wanted_by_summary] or None

    def _skips(self, chunk: Chunk) -> bool:
        """Whether a chunk holds nothing that is wanted; damaged times in its head must not hide it."""
        entry = self._summary.chunks.get(chunk.position) if self._summary.lists_all else None
        if entry is not None and not entry.channels & self._wanted_by_summary:
            return True
        if self._window.is_open:
            return False
        if entry is not None:
            return not self._window.overlaps(entry.first_ns, entry.last_ns)
        if self._window.overlaps(chunk.first_ns, chunk.last_ns):
            return False
        times = index_times(self._source.read(chunk.end, _INDEX_BYTES))
        outside = times is None or not self._window.overlaps(*times)
        if outside:
            self._skipped.append(chunk)
        return outside

    @cached_property
    def _wanted_by_summary(self) -> frozenset[int]:
        return self._topics.wanted_channels()

    # --- from pieces to messages ----------------------------------------------------------------------

    def _messages(self, piece: Piece, unpacked: Unpacked | None) -> Iterator[Batch]:
        plain = self._plain(piece, unpacked)
        if plain is not None:
            yield plain
            return
        for found in self._take(piece, unpacked):
            yield from self._sorted(found)

    def _plain(self, piece: Piece, unpacked: Unpacked | None) -> Batch | None:
        """Return the messages of a sound chunk where they are of one channel and all there is, else None."""
        if unpacked is None or unpacked.trust is not Trust.CHECKED or unpacked.reason:
            return None
        messages = unpacked.messages
        if messages.channel is None or messages.others or not isinstance(piece, ChunkPiece) or piece.reason:
            return None
        described = self._topics.get(messages.channel)
        if described is None or not described.wanted or not described.trusted:
            return None
        self._met_chunks = self._met_checksums = True
        return Batch(
            kind=described.kind,
            buffer=np.frombuffer(unpacked.buffer, dtype=np.uint8),
            starts=messages.starts,
            lengths=messages.lengths,
            log_time=messages.log_time,
            publish_time=messages.publish_time,
            checked=True,
            stride=messages.stride,
        )

    def _take(self, piece: Piece, unpacked: Unpacked | None) -> Iterator[_Found]:
        if isinstance(piece, HolePiece):
            self._gap.open()
            self._loss.add(piece.reason, None, piece.end - piece.begin, 0)
        elif isinstance(piece, LoosePiece):
            yield self._loose(piece)
        elif unpacked is not None:
            yield self._chunk(piece, unpacked)

    def _loose(self, piece: LoosePiece) -> _Found:
        holds = self._data_checksum_holds if self._needs_data_checksum(piece) else None
        in_broken_chunk = piece.follows_damage and self._is_chunked()
        is_suspect = holds is False or in_broken_chunk
        level = Level.SUSPECT if is_suspect else Level.CHECKED if holds else Level.UNCHECKED
        self._describe(piece.buffer, piece.messages, level)
        trusted: NDArray[np.bool_] | bool = not is_suspect
        if piece.last_is_doubtful and not is_suspect and piece.messages.count:
            trusted = np.ones(piece.messages.count, dtype=np.bool_)
            trusted[-1] = False
            self._loss.add(f"no record follows the one before byte {piece.position + piece.messages.stop}")
        if is_suspect and piece.messages.count:
            cause = (
                "a chunk that cannot be found" if in_broken_chunk else "a data section with a wrong checksum"
            )
            self._loss.add(f"the messages from byte {piece.position} on stand in {cause}; they may be wrong")
        return _Found(piece.buffer, piece.messages, trusted, holds is True)

    def _needs_data_checksum(self, piece: LoosePiece) -> bool:
        return piece.messages.count > 0 or not self._summary.is_checked

    @cached_property
    def _data_checksum_holds(self) -> bool | None:
        return data_checksum_holds(self._source, self._summary)

    def _is_chunked(self) -> bool:
        if not self._met_chunks:
            self._met_chunks = self._seeker.next_record(len(MAGIC), chunks_only=True) is not None
        return self._met_chunks

    def _chunk(self, piece: ChunkPiece, unpacked: Unpacked) -> _Found:
        self._met_chunks = True
        trust = self._trust(unpacked)
        level = {Trust.CHECKED: Level.CHECKED, Trust.UNCHECKED: Level.UNCHECKED}.get(trust, Level.SUSPECT)
        self._describe(unpacked.buffer, unpacked.messages, level)
        reason = unpacked.reason or piece.reason
        if trust is Trust.SUSPECT:
            self._blame(piece, unpacked, unpacked.reason or "it has no checksum that covers it")
        elif reason:
            self._blame(piece, unpacked, reason, harmless=trust is Trust.CHECKED)
        checked = trust is Trust.CHECKED or (trust is Trust.UNCHECKED and self._data_known is True)
        return _Found(unpacked.buffer, unpacked.messages, trust is not Trust.SUSPECT, checked)

    def _trust(self, unpacked: Unpacked) -> Trust:
        if unpacked.trust is Trust.CHECKED:
            self._met_checksums = True
        if unpacked.trust is not Trust.UNCHECKED:
            return unpacked.trust
        if self._data_checksum_holds is not None:
            return Trust.UNCHECKED if self._data_checksum_holds else Trust.SUSPECT
        # one chunk without a checksum among others with one: the field itself is damaged
        return Trust.SUSPECT if self._met_checksums and unpacked.messages.count else Trust.UNCHECKED

    @property
    def _data_known(self) -> bool | None:
        return self.__dict__.get("_data_checksum_holds")

    def _blame(self, piece: ChunkPiece, unpacked: Unpacked, reason: str, *, harmless: bool = False) -> None:
        """Note what is wrong with a chunk, and how many messages of it are lost."""
        where = f"the chunk at byte {piece.chunk.position}"
        found = unpacked.messages.count
        text = f"{where}: {reason}"
        if harmless:
            self._loss.add(f"{text}; its checksum holds, so nothing is lost")
            return
        self._gap.open()
        listed = sum(unpacked.counts.values())
        lost = max(0, listed - found) if unpacked.counts else None
        if found:
            noun = "message" if found == 1 else "messages"
            text += f"; {found} {noun} of it may be wrong"
        size = 0 if found else piece.chunk.end - piece.chunk.position
        self._loss.add(text, lost, size, 0 if found else 1)

    def _describe(self, buffer: bytes, messages: Located, level: Level) -> None:
        view = memoryview(buffer)
        for opcode, begin, end in messages.others:
            if not self._topics.add(opcode, view[begin:end], level) and level > Level.SUSPECT:
                self._loss.add("the description of a schema or channel is damaged")

    # --- from messages to batches ---------------------------------------------------------------------

    def _sorted(self, found: _Found) -> Iterator[Batch]:
        """Yield one batch per topic, in the order of its messages."""
        messages = found.messages
        if not messages.count:
            return
        numbers = _distinct(messages.channels) if messages.channel is None else [messages.channel]
        described = {number: self._described(number, messages) for number in numbers}
        by_topic: dict[str, list[int]] = {}
        for number, one in described.items():
            if one is not None and one.wanted:
                by_topic.setdefault(one.kind.topic, []).append(number)
        for channels in by_topic.values():
            known = [one for number in channels if (one := described[number]) is not None]
            rows = None if len(numbers) == len(channels) else np.isin(messages.channels, channels)
            if len(set(known)) == 1:
                yield from self._batch(found, known[0], rows)
            else:
                yield from self._changing(found, described, channels)

    def _changing(
        self, found: _Found, described: dict[int, Described | None], channels: list[int]
    ) -> Iterator[Batch]:
        """Yield the messages of one topic whose channels differ in type, run by run."""
        numbers = found.messages.channels
        mine = np.flatnonzero(np.isin(numbers, channels))
        breaks = np.flatnonzero(np.diff(numbers[mine])) + 1
        for begin, end in pairwise([0, *breaks.tolist(), mine.size]):
            one = described[int(numbers[mine[begin]])]
            if one is not None:
                yield from self._batch(found, one, mine[begin:end])

    def _described(self, channel: int, messages: Located) -> Described | None:
        one = self._topics.get(channel)
        if one is None and self._skipped:
            self._catch_up()
            one = self._topics.get(channel)
        if one is None:
            count = int(np.count_nonzero(messages.channels == channel))
            self._unknown[channel] = self._unknown.get(channel, 0) + count
        return one

    def _catch_up(self) -> None:
        """Look for descriptions in the chunks that were left out."""
        for chunk in self._skipped:
            unpacked = unpack(self._source, chunk, chunk.end)
            if unpacked.trust is not Trust.SUSPECT:
                checked = unpacked.trust is Trust.CHECKED
                self._describe(
                    unpacked.buffer, unpacked.messages, Level.CHECKED if checked else Level.UNCHECKED
                )
        self._skipped.clear()

    def _batch(self, found: _Found, described: Described, rows: _Choice) -> Iterator[Batch]:
        messages, trusted = found.messages, found.trusted
        parts: list[tuple[_Choice, bool]]
        if isinstance(trusted, np.ndarray):
            chosen = np.arange(messages.count)
            chosen = chosen if rows is None else chosen[rows]
            parts = [(chosen[trusted[chosen]], True), (chosen[~trusted[chosen]], False)]
        else:
            parts = [(rows, trusted)]
        for part, is_trusted in parts:
            batch = Batch(
                kind=described.kind,
                buffer=np.frombuffer(found.buffer, dtype=np.uint8),
                starts=_rows(messages.starts, part),
                lengths=_rows(messages.lengths, part),
                log_time=_rows(messages.log_time, part),
                publish_time=_rows(messages.publish_time, part),
                trusted=is_trusted and described.trusted,
                checked=found.checked,
                stride=messages.stride if part is None else 0,
            )
            if batch.starts.size:
                yield batch

    def _note(self, batch: Batch) -> None:
        count = batch.starts.size
        self._delivered += count
        if batch.trusted:
            self._gap.close(int(batch.log_time[0]), int(batch.log_time[-1]))
        else:
            self._suspect += count
            self._gap.open()
            self._gap.reach(int(batch.log_time[0]), int(batch.log_time[-1]))

    # --- the end --------------------------------------------------------------------------------------

    def _finish(self) -> None:
        """Say what was lost, exactly where the file knows how much it held."""
        for channel, count in self._unknown.items():
            self._loss.add(f"{count} messages belong to channel {channel}, which is not described", count)
        if self._walk.trailing > 0:
            self._loss.add(f"{self._walk.trailing} bytes follow its end")
        elif self._summary.problem:
            self._loss.add(self._summary.problem, 0 if self._walk.reached_end else None)
        known = self._summary.statistics
        if known is not None and self._summary.is_checked and self._window.is_open:
            held = sum(known.counts.get(number, 0) for number in self._wanted_by_summary)
            self._loss.messages = max(0, held - self._delivered)
            last = known.last_ns if self._loss.messages else None
            self._gap.end(last)
        else:
            self._gap.end(None)
        if self._loss.messages == 0 and not self._suspect:
            self._loss.size = self._loss.chunks = 0  # what is damaged held no message


class _Gap:
    """The stretches of log time without trusted messages."""

    def __init__(self, loss: Loss) -> None:
        self._loss = loss
        self._last: int | None = None
        self._reached: int | None = None
        self._first_suspect: int | None = None
        self._is_open = False

    def open(self) -> None:
        """Something is damaged here."""
        self._is_open = True

    def reach(self, first_ns: int, last_ns: int) -> None:
        """Messages that may be wrong have these times."""
        if self._first_suspect is None:
            self._first_suspect = first_ns
        self._reached = max(last_ns, self._reached or last_ns)

    def close(self, first_ns: int, last_ns: int) -> None:
        """Trusted messages have these times."""
        if self._is_open:
            self._add(first_ns)
        self._last = last_ns

    def end(self, last_ns: int | None) -> None:
        """The file ends; its last message was at ``last_ns``, where that is known."""
        if self._is_open:
            self._add(last_ns if last_ns is not None else self._reached)

    def _add(self, until_ns: int | None) -> None:
        begin = self._last if self._last is not None else self._first_suspect
        if begin is not None and until_ns is not None and until_ns > begin:
            self._loss.spans_ns.append((begin, until_ns))
        self._is_open, self._reached, self._first_suspect = False, None, None


def _distinct(values: NDArray[np.int64]) -> list[int]:
    """Return the values that occur; quick where only one does."""
    first = int(values[0])
    return [first] if bool((values == first).all()) else [int(value) for value in np.unique(values)]


def _size_of(piece: Piece) -> int:
    if isinstance(piece, ChunkPiece):
        return max(piece.chunk.packed, min(piece.chunk.size, 64 * piece.chunk.packed))
    return len(piece.buffer) if isinstance(piece, LoosePiece) else 0


def _end_of(piece: ChunkPiece | LoosePiece) -> int:
    return piece.index_end if isinstance(piece, ChunkPiece) else piece.position + piece.messages.stop


def _rows(values: NDArray[np.int64], rows: _Choice) -> NDArray[np.int64]:
    return values if rows is None else values[rows]
