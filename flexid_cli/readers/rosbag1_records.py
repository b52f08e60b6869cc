"""The records of ROS 1 bags, version 2.0 (https://wiki.ros.org/Bags/Format/2.0): in a file, and in a chunk.

Every record is a header of named fields and data, each with its length before it. The file is a chain of
chunks, each followed by an index of its messages; descriptions of the connections stand in the chunks and
once more at the end, after which only a bag that was closed has its own index. Nothing of that index is needed.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexid_cli.readers.byte_source import ByteSource
from flexid_cli.readers.payloads import Payloads

VERSION = b"#ROSBAG V2.0\n"
BAG_HEADER, MESSAGE, INDEX, CHUNK, CHUNK_INFO, CONNECTION = 3, 2, 4, 5, 6, 7
CODECS = ("none", "lz4", "bz2")
LARGEST_CHUNK = 1 << 30  # bytes; writers use 768 KiB to some MiB
_LONGEST_HEADER = 1 << 16
_HEAD = 256  # bytes that hold the header of every record but those of connections with long topics
_WINDOW = 1 << 20
_ALL_BITS = 2**64 - 1
_WIDEST = 128  # bytes of a message's header; the fields that every one has take 46
_OP = re.compile(rb"\x04\x00\x00\x00op=[\x02-\x07]")
_BEFORE_OP = 96  # bytes of other fields that may stand before the field ``op``
_FIELDS: dict[int, dict[bytes, int]] = {  # the fields that a record must have, and their lengths; 0: any
    BAG_HEADER: {b"index_pos": 8},
    MESSAGE: {b"conn": 4, b"time": 8},
    INDEX: {b"ver": 4, b"conn": 4, b"count": 4},
    CHUNK: {b"compression": 0, b"size": 4},
    CHUNK_INFO: {b"ver": 4, b"chunk_pos": 8, b"count": 4},
    CONNECTION: {b"conn": 4, b"topic": 0},
}
_TIMES = np.dtype([("sec", "<u4"), ("nsec", "<u4"), ("offset", "<u4")])

Ints = NDArray[np.int64]
Bytes = NDArray[np.uint8]
Buffer = bytes | memoryview


@dataclass(frozen=True)
class Record:
    """One record; positions count from where it was looked for.

    Attributes
    ----------
    position, data, end : int
        First byte, first byte of its data, and the byte after it.
    op : int
        What it is.
    fields : mapping of bytes to bytes
        Its header.
    """

    position: int
    data: int
    end: int
    op: int
    fields: Mapping[bytes, bytes]

    def number(self, name: bytes) -> int:
        """Return a field as an unsigned integer."""
        return int.from_bytes(self.fields[name], "little")


@dataclass
class Chunk:
    """A chunk of the file, or a stretch of it whose framing is damaged.

    Attributes
    ----------
    position, data, end : int
        First byte of the record and of its data in the file, and the byte after the data.
    codec : str
        How it is packed; empty: a stretch in which messages are searched for.
    size : int
        Bytes when unpacked, as it says.
    index : dict of int to tuple of (int, int)
        Count and position of the entries of its index, by connection.
    cut : bool
        Whether the file ends in it.
    """

    position: int
    data: int
    end: int
    codec: str
    size: int
    index: dict[int, tuple[int, int]] = field(default_factory=dict)
    cut: bool = False

    @property
    def count(self) -> int | None:
        """Number of its messages where its index tells it."""
        return sum(count for count, _ in self.index.values()) if self.index else None


@dataclass(frozen=True)
class Connection:
    """What the messages of one connection are."""

    topic: str
    msgtype: str
    definition: str


def parse(content: Buffer, position: int) -> Record | None:
    """Return the record at ``position`` if its header is whole and right; its data may end elsewhere."""
    if len(content) - position < 8:
        return None
    (length,) = struct.unpack_from("<I", content, position)
    stop = position + 4 + length
    if length > _LONGEST_HEADER or len(content) < stop + 4:
        return None
    fields: dict[bytes, bytes] = {}
    at = position + 4
    while at + 4 < stop:
        (size,) = struct.unpack_from("<I", content, at)
        at += 4 + size
        if at > stop:
            return None
        name, equals, value = bytes(content[at - size : at]).partition(b"=")
        if not equals:
            return None
        fields[name] = value
    op = fields.get(b"op", b"")
    if at != stop or len(op) != 1 or op[0] not in _FIELDS:
        return None
    wanted = _FIELDS[op[0]]
    if any(name not in fields or size not in {0, len(fields[name])} for name, size in wanted.items()):
        return None
    (length,) = struct.unpack_from("<I", content, stop)
    return Record(position, stop + 4, stop + 4 + length, op[0], fields)


def connection(record: Record, data: bytes) -> Connection | None:
    """Return what a connection's record describes, or None where it is damaged."""
    fields: dict[bytes, bytes] = {}
    at = 0
    while at + 4 <= len(data):
        (size,) = struct.unpack_from("<I", data, at)
        name, equals, value = data[at + 4 : at + 4 + size].partition(b"=")
        at += 4 + size
        if not equals or at > len(data):
            return None
        fields[name] = value
    if b"type" not in fields:
        return None
    try:
        texts = [fields.get(b"topic") or record.fields[b"topic"], fields[b"type"]]
        definition = fields.get(b"message_definition", b"")
        return Connection(texts[0].decode(), texts[1].decode(), definition.decode("utf-8", "replace"))
    except UnicodeDecodeError:
        return None


def search(content: bytes, start: int, ops: Sequence[int], size: int) -> Record | None:
    """Find the next record of ``ops`` from ``start`` on, in a file that goes on to ``size``.

    What looks like one must have a right header, end within ``size``, and be followed by another right
    header, by the end, or by what ``content`` does not show.
    """
    for hit in _OP.finditer(content, start):
        if content[hit.end() - 1] not in ops:
            continue
        for position in range(hit.start() - 4, max(hit.start() - 4 - _BEFORE_OP, start) - 1, -1):
            record = parse(content, position)
            if record is None or record.end > size:
                continue
            unseen = record.end + 8 > len(content) and record.end < size
            if record.end == size or unseen or parse(content, record.end) is not None:
                return record
    return None


class Walk:
    """One pass over the top level of a bag.

    Parameters
    ----------
    source : ByteSource
        The file.

    Attributes
    ----------
    chunks : list of Chunk
        What may hold messages.
    connections : dict of int to Connection
        Those described outside of chunks.
    reasons : list of (str, int)
        What is damaged, as the rest of a sentence, and how many bytes gave no record.
    closed : bool
        Whether the recorder finished the file.
    """

    def __init__(self, source: ByteSource) -> None:
        self._source = source
        self.chunks: list[Chunk] = []
        self.connections: dict[int, Connection] = {}
        self.reasons: list[tuple[str, int]] = []
        self.closed = False
        position = len(VERSION)
        while position < source.size:
            position = self._step(position)

    def _step(self, position: int) -> int:
        """Take the record at ``position``; return where the next one is."""
        size = self._source.size
        record = self._record(position)
        if record is None:
            return self._skip(position)
        if record.op == CHUNK:
            return self._chunk(record)
        if self._misses_the_next(record):
            following = self._next(record.data)
            if following is not None and following < record.end:
                self.reasons.append((f"the length of the record at byte {position} is wrong", 0))
                return following
        if record.end > size:
            self.reasons.append((f"it is cut short in the record at byte {position}", size - position))
            return size
        if record.op == INDEX:
            self._index(record)
        elif record.op == CONNECTION:
            found = connection(record, self._source.read(record.data, record.end - record.data))
            if found is not None:
                self.connections.setdefault(record.number(b"conn"), found)
        elif record.op == BAG_HEADER:
            self.closed = record.number(b"index_pos") != 0
        elif record.op == MESSAGE:
            return self._skip(position)
        return record.end

    def _misses_the_next(self, record: Record) -> bool:
        """Whether a record does not end where another one begins, so that its length may lead over others."""
        if record.op == INDEX and record.end - record.data != record.number(b"count") * _TIMES.itemsize:
            return True
        return record.end > self._source.size or (
            record.end < self._source.size and self._record(record.end) is None
        )

    def _record(self, position: int) -> Record | None:
        for count in (_HEAD, _LONGEST_HEADER):
            head = self._source.peek(position, count)
            found = parse(head, 0)
            if found is not None:
                return Record(position, position + found.data, position + found.end, found.op, found.fields)
            if len(head) < count or int.from_bytes(head[:4], "little") + 8 <= count:
                break
        return None

    def _chunk(self, record: Record) -> int:
        size = self._source.size
        codec = record.fields[b"compression"].decode("latin-1")
        chunk = Chunk(record.position, record.data, record.end, codec, record.number(b"size"))
        if record.end > size:
            following = self._next(record.data)
            if following is None:
                self.reasons.append((f"it is cut short in the chunk at byte {record.position}", 0))
                chunk.end, chunk.cut = size, True
            else:
                self.reasons.append((f"the length of the chunk at byte {record.position} is wrong", 0))
                chunk.end = following
        elif record.end < size and self._record(record.end) is None:
            following = self._next(record.data)
            if following is not None and following < record.end:
                self.reasons.append((f"the length of the chunk at byte {record.position} is wrong", 0))
                chunk.end = following
        if codec == "none" and not chunk.cut and chunk.size != chunk.end - chunk.data:
            self.reasons.append((f"the size of the chunk at byte {record.position} is wrong", 0))
        self.chunks.append(chunk)
        return chunk.end

    def _index(self, record: Record) -> None:
        count = record.number(b"count")
        if self.chunks and record.number(b"ver") == 1 and record.end - record.data == count * _TIMES.itemsize:
            self.chunks[-1].index[record.number(b"conn")] = (count, record.data)
        else:
            self.reasons.append((f"the index at byte {record.position} is wrong", 0))

    def _skip(self, position: int) -> int:
        """Go on at the next record that is right; what lies before it is searched for messages later."""
        following = self._next(position + 1)
        stop = self._source.size if following is None else following
        self.reasons.append((f"no record begins at byte {position}; {stop - position} bytes were skipped", 0))
        self.chunks.append(Chunk(position, position, stop, "", stop - position))
        return stop

    def _next(self, start: int) -> int | None:
        """Position of the next chunk or index from ``start`` on."""
        size = self._source.size
        while start < size:
            window = self._source.read(start, _WINDOW + _LONGEST_HEADER)
            found = search(window, 0, (INDEX, CHUNK, CHUNK_INFO), size - start)
            if found is not None:
                return start + found.position
            start += _WINDOW
        return None


@dataclass(frozen=True)
class Messages:
    """The messages of a chunk in their order; positions are those in the unpacked chunk.

    Attributes
    ----------
    conn, starts, lengths, time : ndarray of int64, shape (n,)
        Connection, first byte and length of the payload, and log time in nanoseconds.
    sure : ndarray of bool, shape (n,)
        Whether nothing in the file contradicts the message.
    lost : int
        Bytes that belong to no record.
    indexed : bool
        Whether the chunk's index was there and right.
    """

    conn: Ints
    starts: Ints
    lengths: Ints
    time: Ints
    sure: NDArray[np.bool_]
    lost: int = 0
    indexed: bool = False

    def conns(self) -> list[int]:
        """Return the connections that have messages."""
        if self.conn.size and int(self.conn.min()) == int(self.conn.max()):
            return [int(self.conn[0])]
        return [int(conn) for conn in np.unique(self.conn)]


def split(content: bytes, index: Mapping[int, bytes], connections: dict[int, Connection]) -> Messages:
    """Find the messages of an unpacked chunk.

    Parameters
    ----------
    content : bytes
        The chunk.
    index : mapping of int to bytes
        The entries of its index by connection; used only where every record bears it out.
    connections : dict of int to Connection
        Gets those that the chunk describes.
    """
    found = _by_index(content, index, connections) if index else None
    return _by_walk(content, connections) if found is None else found


def holes(messages: Messages, size: int, *, is_cut: bool) -> list[int]:
    """Return the numbers of the messages of a damaged chunk that do not follow the one before them directly.

    Parameters
    ----------
    messages : Messages
        Of the chunk.
    size : int
        Its bytes when unpacked.
    is_cut : bool
        Whether it may not end there.

    Returns
    -------
    list of int
        0 where something stands before the first one; the number of messages where after the last.
    """
    if not messages.starts.size:
        return [0]
    ends = messages.starts + messages.lengths
    heads = messages.starts - np.concatenate(([0], ends[:-1]))
    places = np.flatnonzero(heads != heads.min()).tolist()
    return [*places, heads.size] if is_cut or int(ends[-1]) != size else places


def entries(index: bytes) -> tuple[Ints, Ints]:
    """Log times in nanoseconds and offsets in an index, shape (n,) each."""
    table = np.frombuffer(index, dtype=_TIMES)
    return table["sec"] * np.int64(1_000_000_000) + table["nsec"], table["offset"].astype(np.int64)


def _by_index(
    content: bytes, index: Mapping[int, bytes], connections: dict[int, Connection]
) -> Messages | None:
    """Take the records at the index's offsets, if they and the connections between them fill the chunk."""
    parts: list[tuple[NDArray[Any], ...]] = []
    room = np.frombuffer(content, dtype=np.uint8)
    for conn, raw in index.items():
        time, offset = entries(raw)
        if not offset.size:
            continue
        if int(offset.max()) + _WIDEST > room.size:
            room = np.concatenate((room, np.zeros(_WIDEST, dtype=np.uint8)))
        part = _at_offsets(content, room, conn, time, offset)
        if part is None:
            return None
        parts.append(part)
    if not parts:
        return None
    columns = list(parts[0])
    if len(parts) > 1:
        columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
        order = np.argsort(columns[0], kind="stable")
        columns = [column[order] for column in columns]
    offset, conn_, start, length, time, sure = columns
    ends = start + length
    begins = np.append(offset, len(content))
    stops = np.concatenate(([0], ends))
    gaps = [(int(stops[place]), int(begins[place])) for place in np.flatnonzero(begins != stops)]
    if not all(_only_connections(content, *gap, connections) for gap in gaps):
        return None
    return Messages(conn_, start, length, time, sure, indexed=True)


def _at_offsets(
    content: bytes, room: Bytes, conn: int, time: Ints, offset: Ints
) -> tuple[NDArray[Any], ...] | None:
    """Check that a message of ``conn`` begins at every offset, with the header that the first one has.

    ``room`` is the content, with bytes after it that may be looked at.
    """
    first = parse(content, int(offset[0]))
    if first is None or first.op != MESSAGE or first.number(b"conn") != conn:
        return None
    width = first.data - first.position
    if width > _WIDEST or int(offset.max()) + width > len(content):
        return None
    stamp = content.index(b"time=", first.position) + 5 - first.position
    heads = Payloads(room, offset)
    template = content[first.position : first.position + _WIDEST].ljust(_WIDEST, b"\x00")
    for place, bits in _fixed(stamp, width):
        column = heads.column(place, "<u8")
        same = column if bits == _ALL_BITS else column & np.uint64(bits)
        if not (same == np.uint64(bits & int.from_bytes(template[place : place + 8], "little"))).all():
            return None
    length = heads.column(width - 4, "<u4").astype(np.int64)
    start = offset + width
    if int((start + length).max()) > len(content):
        return None
    written = heads.column(stamp, "<u4") * np.int64(1_000_000_000) + heads.column(stamp + 4, "<u4")
    return offset, np.full(offset.size, conn, dtype=np.int64), start, length, written, written == time


@lru_cache
def _fixed(stamp: int, width: int) -> list[tuple[int, int]]:
    """Words of 8 bytes that cover a header without its time and length: places, and the bits that count."""
    counts = [place < stamp or stamp + 8 <= place < width - 4 for place in range(width + 8)]
    places = (*range(0, stamp, 8), *range(stamp + 8, width - 4, 8))
    return [(at, sum(255 << 8 * byte for byte in range(8) if counts[at + byte])) for at in places]


def _time(stamps: Bytes) -> Ints:
    """Nanoseconds from seconds and nanoseconds, shape (n, 8) bytes."""
    parts = np.ascontiguousarray(stamps).view("<u4").astype(np.int64)
    return parts[:, 0] * 1_000_000_000 + parts[:, 1]


def _only_connections(content: bytes, start: int, stop: int, connections: dict[int, Connection]) -> bool:
    while start < stop:
        record = parse(content, start)
        if record is None or record.op != CONNECTION or record.end > stop:
            return False
        _learn(record, content, connections)
        start = record.end
    return start == stop


def _learn(record: Record, content: bytes, connections: dict[int, Connection]) -> None:
    found = connection(record, content[record.data : record.end])
    if found is not None:
        connections.setdefault(record.number(b"conn"), found)


def _by_walk(content: bytes, connections: dict[int, Connection]) -> Messages:
    """Go from record to record, over runs of alike ones at once; after a damaged one to the next right one."""
    parts: list[tuple[Ints, ...]] = []
    lost = 0
    for record, count in _runs(content):
        if record is None:
            lost += count
        elif record.op == CONNECTION:
            _learn(record, content, connections)
        elif record.op == MESSAGE:
            stamp = content.index(b"time=", record.position) + 5
            stride = record.end - record.position
            at = np.arange(count, dtype=np.int64) * stride
            stamps = np.ndarray((count, 8), np.uint8, content, stamp, (stride, 1))
            conn = np.full(count, record.number(b"conn"), dtype=np.int64)
            parts.append((conn, at + record.data, np.full_like(at, record.end - record.data), _time(stamps)))
    if not parts:
        nothing = np.empty(0, dtype=np.int64)
        return Messages(nothing, nothing, nothing, nothing, np.empty(0, dtype=np.bool_), lost)
    conn, start, length, time = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Messages(conn, start, length, time, np.ones(conn.size, dtype=np.bool_), lost)


def _runs(content: bytes) -> Iterator[tuple[Record | None, int]]:
    """Yield records with the number of alike ones from there on, or None with the bytes that are none."""
    position, size = 0, len(content)
    while position < size:
        record = parse(content, position)
        if record is None or record.end > size or record.op not in {MESSAGE, CONNECTION}:
            following = search(content, position + 1, (MESSAGE, CONNECTION), size)
            stop = size if following is None else following.position
            yield None, stop - position
            position = stop
            continue
        count = _alike(content, record) if record.op == MESSAGE else 1
        yield record, count
        position += count * (record.end - record.position)


def _alike(content: bytes, first: Record) -> int:
    """How many records from ``first`` on have its header but for the time, and its length."""
    stride, width = first.end - first.position, first.data - first.position
    stamp = content.index(b"time=", first.position) + 5 - first.position
    whole = np.ndarray(
        ((len(content) - first.position) // stride, width), np.uint8, content, first.position, (stride, 1)
    )
    count, look = 1, 1
    while count < len(whole):
        look = min(look * 8, len(whole) - count)
        rows = whole[count : count + look]
        same = (rows[:, :stamp] == whole[0, :stamp]).all(axis=1)
        same &= (rows[:, stamp + 8 :] == whole[0, stamp + 8 :]).all(axis=1)
        if not same.all():
            return count + int(np.argmin(same))
        count += look
    return count
