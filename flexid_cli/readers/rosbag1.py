"""ROS 1 bags, version 2.0: plain, lz4 and bz2, closed or not, whole or damaged."""

from __future__ import annotations

import bz2
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flexid_cli.errors import InputError
from flexid_cli.readers.base import DEFAULT_OPTIONS, Note, Progress, ReadOptions, Window
from flexid_cli.readers.batch import Batch
from flexid_cli.readers.byte_source import ByteSource
from flexid_cli.readers.container import Container, MessageReader, Probe
from flexid_cli.readers.damage import explain
from flexid_cli.readers.decoders import TopicType
from flexid_cli.readers.loss import Loss, TimeGaps
from flexid_cli.readers.memory import keep_freed_memory
from flexid_cli.readers.rosbag1_records import (
    CODECS,
    LARGEST_CHUNK,
    VERSION,
    Chunk,
    Connection,
    Messages,
    Walk,
    entries,
    holes,
    split,
)

MAGIC = b"#ROSBAG V"
_LZ4_MAGIC = b"\x04\x22\x4d\x18"
_CONTENT_CHECKSUM = 4  # bit of an lz4 frame's descriptor
_MOST_LZ4 = 256  # bytes that one byte of lz4 can stand for
_STEP = 1 << 16  # bytes that a damaged chunk is unpacked by
_LOOKED_AT = 101  # messages per connection; what `Probe` keeps and one more


class Rosbag1Reader(MessageReader):
    """Reader of ROS 1 bags; messages come in the order of the file."""

    name = "rosbag1"
    suffixes: tuple[str, ...] = (".bag",)

    def sniff(self, path: Path, head: bytes) -> bool:
        """Whether ``path`` begins as a ROS 1 bag, or is named like one and has a bag's first record."""
        return head.startswith(MAGIC) or (path.suffix == ".bag" and b"op=\x03" in head[: 4 * len(VERSION)])

    @contextmanager
    def open_files(
        self, paths: Sequence[Path], options: ReadOptions = DEFAULT_OPTIONS
    ) -> Iterator[tuple[list[Container], list[Note]]]:
        """Open all files of one run."""
        with ExitStack() as stack:
            sources = [stack.enter_context(ByteSource(path, path)) for path in paths]
            progress = Progress(options, sum(source.size for source in sources))
            threads = options.threads or os.cpu_count() or 1
            yield [BagFile(*pair, threads, progress) for pair in zip(paths, sources, strict=True)], []


@dataclass(frozen=True)
class _Unpacked:
    """A chunk's records.

    ``checked``: a checksum over them was verified; ``sound``: nothing contradicts them; ``fault``: why not all
    are there, or empty.
    """

    chunk: Chunk
    content: bytes
    checked: bool
    sound: bool
    fault: str


class BagFile:
    """One ROS 1 bag.

    Parameters
    ----------
    path : Path
        The file.
    source : ByteSource
        Its bytes.
    threads : int
        Chunks that are unpacked at the same time where that helps.
    progress : Progress
        Is told what has been read.

    Raises
    ------
    InputError
        It is of another version.
    """

    def __init__(self, path: Path, source: ByteSource, threads: int, progress: Progress) -> None:
        self.path = path
        self.notes: list[Note] = []
        self.loss = Loss()
        self._source = source
        self._threads = threads
        self._progress = progress
        start = source.read(0, len(VERSION))
        if (
            start != VERSION
            and start.startswith(MAGIC)
            and start[len(MAGIC) : -1] in {b"1.0", b"1.1", b"1.2"}
        ):
            raise InputError(
                f"{path} is a ROS 1 bag of version {start[len(MAGIC) : -1].decode()}, not 2.0",
                "convert it with `rosbag fix`",
            )
        self._walk = Walk(source)
        self._connections = dict(self._walk.connections)
        if not self._walk.closed:
            self.notes.append(Note(f"{path} was not closed by its recorder; its chunks were read one by one"))
        self._begin()

    def _begin(self) -> None:
        """Count anew; forget what an earlier pass over the file counted."""
        self.loss = Loss()
        for reason, size in self._walk.reasons:
            cut = reason.startswith("it is cut short")
            self.loss.add(f"{self.path}: {reason}", None if cut else 0, size)

    # -- reading

    def probe(self) -> Probe:
        """Take the first messages of every connection, and the counts from the chunks' indexes."""
        probe = Probe()
        self._begin()
        wanted: dict[int, int] = {}
        counts: dict[int, int] = {}
        for chunk in self._walk.chunks:
            news = [conn for conn in chunk.index if wanted.get(conn, 0) < _LOOKED_AT]
            if chunk.index and not news:
                for conn, (count, _) in chunk.index.items():
                    counts[conn] = counts.get(conn, 0) + count
                continue
            unpacked = self._unpack(chunk)
            messages = self._split(unpacked)
            for conn in messages.conns():
                mine = np.flatnonzero(messages.conn == conn)
                counts[conn] = counts.get(conn, 0) + mine.size
                self._keep(probe, conn, unpacked.content, messages, mine[: _LOOKED_AT - wanted.get(conn, 0)])
                wanted[conn] = wanted.get(conn, 0) + mine.size
        probe.counts = {}
        for conn, count in counts.items():
            kind = self._kind(conn)
            if kind is not None and count:
                probe.counts[kind] = probe.counts.get(kind, 0) + count
        self._begin()
        return probe

    def _keep(
        self, probe: Probe, conn: int, content: bytes, messages: Messages, places: NDArray[np.int64]
    ) -> None:
        kind = self._kind(conn)
        if kind is None or not places.size:
            return
        earliest = int(messages.time[places].min())
        before = probe.first_log_time
        for place in places.tolist():
            start = int(messages.starts[place])
            data = content[start : start + int(messages.lengths[place])]
            probe.add(kind, int(messages.time[place]), data)
        probe.first_log_time = earliest if before is None else min(before, earliest)

    def _kind(self, conn: int) -> TopicType | None:
        found: Connection | None = self._connections.get(conn)
        if found is None:
            return None
        return TopicType(found.topic, found.msgtype, "ros1", "ros1msg", found.definition.encode())

    def batches(self, wanted: Callable[[str], bool], window: Window) -> Iterator[Batch]:
        """Yield the messages of the wanted topics in the order of the file, chunk by chunk."""
        self._begin()
        keep_freed_memory()
        chunks = [chunk for chunk in self._walk.chunks if self._matters(chunk, wanted, window)]
        gaps = TimeGaps(self.loss)
        for unpacked in self._unpacked(chunks):
            messages = self._split(unpacked)
            self._account(unpacked, messages)
            gaps.take(*_around_holes(unpacked, messages))
            yield from self._batches(unpacked, messages, wanted, window)
            self._progress.advance(unpacked.chunk.end - unpacked.chunk.position)

    def _matters(self, chunk: Chunk, wanted: Callable[[str], bool], window: Window) -> bool:
        """Whether a chunk may hold what is asked for; one without an index always may."""
        if not chunk.index:
            return True
        kinds = {conn: self._kind(conn) for conn in chunk.index}
        mine = [conn for conn, kind in kinds.items() if kind is None or wanted(kind.topic)]
        if window.is_open:
            return bool(mine)
        times = [entries(raw)[0] for conn, raw in self._index(chunk).items() if conn in mine]
        return any(one.size and window.overlaps(int(one.min()), int(one.max())) for one in times)

    def _index(self, chunk: Chunk) -> dict[int, bytes]:
        return {conn: self._source.read(at, 12 * count) for conn, (count, at) in chunk.index.items()}

    def _split(self, unpacked: _Unpacked) -> Messages:
        index = {} if unpacked.fault else self._index(unpacked.chunk)
        return split(unpacked.content, index, self._connections)

    def _account(self, unpacked: _Unpacked, messages: Messages) -> None:
        """Count what a chunk does not give."""
        chunk = unpacked.chunk
        told = chunk.count
        here = f"{self.path}: the chunk at byte {chunk.position}"
        if unpacked.fault:
            lost = None if told is None else max(told - messages.conn.size, 0)
            gone = not messages.conn.size
            self.loss.add(f"{here} {unpacked.fault}", lost, chunk.end - chunk.data if gone else 0, int(gone))
        elif messages.lost and chunk.cut:
            self.loss.add(f"{here} ends within a message", None, messages.lost)
        elif messages.lost:
            lost = None if told is None else max(told - messages.conn.size, 0)
            self.loss.add(f"{here} has {messages.lost} bytes that are no message", lost, messages.lost)
        elif told is not None and not messages.indexed:
            lost = max(told - messages.conn.size, 0)
            self.loss.add(f"{here} is not as its index says; its records were read one by one", lost)
        wrong = int(np.count_nonzero(~messages.sure))
        if wrong:
            self.loss.add(f"{here} has {wrong} messages whose log time is not that of its index")
        strange = [conn for conn in messages.conns() if conn not in self._connections]
        unknown = int(np.isin(messages.conn, strange).sum()) if strange else 0
        if unknown:
            self.loss.add(f"{here} has {unknown} messages of connections that are not described", unknown)

    def _batches(
        self, unpacked: _Unpacked, messages: Messages, wanted: Callable[[str], bool], window: Window
    ) -> Iterator[Batch]:
        buffer = np.frombuffer(unpacked.content, dtype=np.uint8)
        inside = None if window.is_open else window.holds(messages.time)
        for conn in messages.conns():
            kind = self._kind(conn)
            if kind is None or not wanted(kind.topic):
                continue
            mine = messages.conn == conn
            if inside is not None:
                mine &= inside
            groups = [(mine, True)]
            # a verified checksum covers the times in the chunk, so that it is the index that is wrong
            if not (unpacked.checked or messages.sure.all()):
                groups = [(mine & messages.sure, True), (mine & ~messages.sure, False)]
            for chosen, sure in groups:
                if not chosen.any():
                    continue
                mine_ = (messages.starts, messages.lengths, messages.time)
                starts, lengths, times = mine_ if chosen.all() else (part[chosen] for part in mine_)
                trusted = sure and unpacked.sound
                yield Batch(kind, buffer, starts, lengths, times, None, trusted, unpacked.checked)

    # -- unpacking

    def _unpacked(self, chunks: Sequence[Chunk]) -> Iterator[_Unpacked]:
        """Unpack in threads where the codec is slow enough to gain by it, a few chunks ahead."""
        if self._threads < 2 or not any(chunk.codec in {"bz2", "lz4"} for chunk in chunks):
            yield from map(self._unpack, chunks)
            return
        with ThreadPoolExecutor(self._threads) as pool:
            waiting: deque[Future[_Unpacked]] = deque()
            try:
                for chunk in chunks:
                    waiting.append(pool.submit(self._unpack, chunk))
                    if len(waiting) > self._threads + 1:
                        yield waiting.popleft().result()
                while waiting:
                    yield waiting.popleft().result()
            finally:
                for future in waiting:
                    future.cancel()

    def _unpack(self, chunk: Chunk) -> _Unpacked:
        length = chunk.end - chunk.data
        if length > LARGEST_CHUNK:
            return _Unpacked(chunk, b"", checked=False, sound=False, fault=f"is too long ({length} bytes)")
        packed = self._source.read(chunk.data, length)
        codec = chunk.codec
        if codec in {"", "none"}:
            return _Unpacked(chunk, packed, checked=False, sound=True, fault="")
        if codec not in CODECS:
            return _Unpacked(chunk, b"", checked=False, sound=False, fault=f"is packed with {codec[:20]!r}")
        # the size is not covered by any checksum; it only bounds what is unpacked
        limit = min(max(chunk.size, 1), LARGEST_CHUNK)
        if codec == "bz2":
            return _bz2(chunk, packed, limit)
        return _lz4(chunk, packed, min(limit, _MOST_LZ4 * len(packed)))


def _around_holes(unpacked: _Unpacked, messages: Messages) -> tuple[NDArray[np.int64], list[int]]:
    """Return the times of the messages that can be trusted, and before which of them some are missing."""
    sure = np.ones_like(messages.sure) if unpacked.checked else messages.sure
    if not unpacked.sound:
        return messages.time[:0], [0]
    is_whole = messages.indexed or not (unpacked.fault or messages.lost or unpacked.chunk.index)
    if is_whole and unpacked.chunk.codec and sure.all():
        return messages.time, []
    places = [] if messages.indexed else holes(messages, len(unpacked.content), is_cut=bool(unpacked.fault))
    missing = np.zeros(sure.size + 1, dtype=np.bool_)
    missing[places] = True
    missing[1:] |= ~sure
    before = np.concatenate(([0], np.cumsum(sure)))
    return messages.time[sure], np.unique(before[missing]).tolist()


def _bz2(chunk: Chunk, packed: bytes, limit: int) -> _Unpacked:
    """Unpack a chunk whose blocks have checksums: what comes out is right."""
    unpacker = bz2.BZ2Decompressor()
    try:
        content = unpacker.decompress(packed, limit + 1)
        if unpacker.eof and len(content) == chunk.size:
            return _Unpacked(chunk, content, checked=True, sound=True, fault="")
    except OSError:
        pass
    parts, fault = _by_steps(bz2.BZ2Decompressor(), packed, limit)
    return _Unpacked(chunk, b"".join(parts), checked=True, sound=True, fault=fault)


def _lz4(chunk: Chunk, packed: bytes, limit: int) -> _Unpacked:
    from lz4.frame import LZ4FrameDecompressor

    checked = len(packed) > 4 and packed.startswith(_LZ4_MAGIC) and bool(packed[4] & _CONTENT_CHECKSUM)
    unpacker = LZ4FrameDecompressor()
    try:
        content = unpacker.decompress(packed, max_length=limit)
        if unpacker.eof and len(content) == chunk.size:
            return _Unpacked(chunk, content, checked=checked, sound=True, fault="")
    except RuntimeError:
        pass
    parts, fault = _by_steps(LZ4FrameDecompressor(), packed, limit)
    # where the file was cut, what is there is as good as in any other chunk; elsewhere something is wrong
    return _Unpacked(chunk, b"".join(parts), checked=False, sound=chunk.cut, fault=fault)


def _by_steps(unpacker: object, packed: bytes, limit: int) -> tuple[list[bytes], str]:
    """Unpack as far as it goes; return the parts, and what is wrong."""
    parts: list[bytes] = []
    done = 0
    try:
        for at in range(0, len(packed), _STEP):
            parts.append(unpacker.decompress(packed[at : at + _STEP]))  # type: ignore[attr-defined]
            done += len(parts[-1])
            if unpacker.eof or done > limit:  # type: ignore[attr-defined]
                break
    except (OSError, RuntimeError, EOFError) as error:
        return parts, f"cannot be unpacked beyond {done} bytes ({explain(error)})"
    if not unpacker.eof:  # type: ignore[attr-defined]
        return parts, f"ends after {done} bytes"
    return parts, f"holds {done} bytes, not as many as it says"
