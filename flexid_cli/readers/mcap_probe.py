"""A quick look at an MCAP file: how many messages each topic has, and the first of them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from flexid_cli.readers.byte_source import ByteSource
from flexid_cli.readers.container import Probe
from flexid_cli.readers.loss import Loss
from flexid_cli.readers.mcap_chunk import Trust, unpack
from flexid_cli.readers.mcap_records import Chunk, Located, index_offsets, index_times
from flexid_cli.readers.mcap_salvage import Seeker
from flexid_cli.readers.mcap_summary import Summary, read_summary
from flexid_cli.readers.mcap_topics import Level, Topics
from flexid_cli.readers.mcap_walk import ChunkPiece, HolePiece, LoosePiece, Piece, Walk

_LOOKED_AT = 100  # messages of a topic that are kept
_LOOKED_AT_BYTES = 1 << 20
_LEVELS = {Trust.CHECKED: Level.CHECKED, Trust.UNCHECKED: Level.UNCHECKED, Trust.SUSPECT: Level.SUSPECT}


def probe(source: ByteSource, loss: Loss, summary: Summary | None = None) -> Probe:
    """Look at an open file.

    Where the summary is sound, only the chunks with the first messages of each topic are read; else the
    heads of all records and the message indexes, and all chunks that have none.

    Parameters
    ----------
    source : ByteSource
        The file.
    loss : Loss
        Takes up what is damaged.
    summary : Summary, optional
        The end of the file, where it was read before.
    """
    summary = summary or read_summary(source)
    look = _Look(source, summary, loss)
    if summary.knows_counts:
        look.take_samples()
    else:
        if summary.problem:
            loss.add(summary.problem, None)
        look.take_all()
    return look.result()


class _Messages:
    """Numbers and first messages by channel."""

    def __init__(self) -> None:
        self.counts: dict[int, int] = {}
        self.samples: dict[int, list[bytes]] = {}
        self.first_ns: int | None = None

    def reach(self, first_ns: int) -> None:
        self.first_ns = first_ns if self.first_ns is None else min(first_ns, self.first_ns)

    def count(self, counts: dict[int, int]) -> None:
        for channel, count in counts.items():
            self.counts[channel] = self.counts.get(channel, 0) + count

    def add(self, buffer: bytes, messages: Located) -> None:
        """Take messages that lie in ``buffer``."""
        if not messages.count:
            return
        self.reach(int(messages.log_time.min()))
        numbers, counts = np.unique(messages.channels, return_counts=True)
        self.count(dict(zip(numbers.tolist(), counts.tolist(), strict=True)))
        for number in numbers.tolist():
            kept = self.samples.setdefault(number, [])
            for row in np.flatnonzero(messages.channels == number)[: _LOOKED_AT - len(kept)].tolist():
                length = int(messages.lengths[row])
                if kept and (len(kept) + 1) * length > _LOOKED_AT_BYTES:
                    break
                begin = int(messages.starts[row])
                kept.append(buffer[begin : begin + length])


class _Look:
    def __init__(self, source: ByteSource, summary: Summary, loss: Loss) -> None:
        self._source = source
        self._summary = summary
        self._loss = loss
        self._topics = Topics(summary, lambda _: True)
        self._trusted, self._suspect = _Messages(), _Messages()
        self._missing: set[int] = set()
        seeker = Seeker(source, set(summary.channels))
        self._walk = Walk(source, summary, seeker, self._skips)

    def _skips(self, chunk: Chunk) -> bool:
        entry = self._summary.chunks.get(chunk.position) if self._summary.lists_all else None
        return entry is not None and bool(self._missing) and not entry.channels & self._missing

    def take_samples(self) -> None:
        """Take the counts from the summary, and look for the first messages of each channel."""
        known = self._summary.statistics
        counts = {} if known is None else {channel: count for channel, count in known.counts.items() if count}
        self._missing = set(counts)
        for piece in self._walk.indexed() if self._summary.lists_all else self._walk.pieces():
            if not self._missing:
                break
            self._take(piece)
            self._missing -= set(self._trusted.samples)
        for messages in (self._trusted, self._suspect):
            messages.counts = {channel: counts.get(channel, 0) for channel in messages.samples}
            if known is not None and messages.first_ns is not None:
                messages.reach(known.first_ns)
        self._trusted.counts |= {c: n for c, n in counts.items() if self._trusted.samples}

    def take_all(self) -> None:
        """Count the messages of the whole file; chunks whose topics are known need no unpacking for that."""
        for piece in self._walk.pieces():
            if isinstance(piece, ChunkPiece):
                index = self._source.read(piece.chunk.end, piece.index_end - piece.chunk.end)
                counts, times = index_offsets(index)[1], index_times(index)
                if counts and times is not None and set(counts) <= set(self._trusted.samples):
                    self._trusted.count(counts)
                    self._trusted.reach(times[0])
                    continue
            self._take(piece)

    def _take(self, piece: Piece) -> None:
        for buffer, messages, level in self._unpacked(piece):
            view = memoryview(buffer)
            for opcode, begin, end in messages.others:
                self._topics.add(opcode, view[begin:end], level)
            (self._suspect if level is Level.SUSPECT else self._trusted).add(buffer, messages)

    def _unpacked(self, piece: Piece) -> Iterator[tuple[bytes, Located, Level]]:
        if isinstance(piece, HolePiece):
            self._loss.add(piece.reason, None, piece.end - piece.begin)
        elif isinstance(piece, LoosePiece):
            yield piece.buffer, piece.messages, Level.UNCHECKED
        else:
            unpacked = unpack(self._source, piece.chunk, piece.index_end)
            if unpacked.reason:
                self._loss.add(f"the chunk at byte {piece.chunk.position}: {unpacked.reason}", None)
            yield unpacked.buffer, unpacked.messages, _LEVELS[unpacked.trust]

    def result(self) -> Probe:
        """Return what was found; messages that may be wrong count only where there are no others."""
        messages = self._trusted if self._trusted.samples else self._suspect
        found = Probe(first_log_time=messages.first_ns)
        for channel, count in messages.counts.items():
            described = self._topics.get(channel)
            if described is None or not count:
                continue
            found.counts[described.kind] = found.counts.get(described.kind, 0) + count
            samples = found.samples.setdefault(described.kind, [])
            samples += messages.samples.get(channel, [])[: _LOOKED_AT - len(samples)]
        if not found.counts:
            found.first_log_time = None
        return found
