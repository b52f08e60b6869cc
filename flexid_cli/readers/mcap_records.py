"""The records of an MCAP file (https://mcap.dev/spec): their fields, and where messages lie in a buffer."""

from __future__ import annotations

import struct
from array import array
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(9, 16)
RECORD = struct.Struct("<BQ")
MESSAGE_HEAD = struct.Struct("<HIQQ")
INDEX_HEAD = struct.Struct("<BQHI")
LARGEST_CHUNK = 1 << 30  # bytes; writers use 1 to 8 MiB
CODECS = ("", "zstd", "lz4")

_CHUNK_HEAD = struct.Struct("<QQQI")
_PAIR = struct.Struct("<HQ")
_FOUR = struct.Struct("<QQQQ")
_LONGEST_CODEC = 32
CHUNK_HEAD_BYTES = RECORD.size + _CHUNK_HEAD.size + 4 + _LONGEST_CODEC + 8
_LEAST = (0, 8, 20, 12, 12, 22, 40, 6, 64, 28, 42, 42, 8, 20, 17, 4)  # bytes of a body, by opcode
_MESSAGE_BYTES = RECORD.size + MESSAGE_HEAD.size
_HEAD = np.dtype(
    {
        "names": ["opcode", "length", "channel", "log_time", "publish_time"],
        "formats": ["u1", "<i8", "<u2", "<i8", "<i8"],
        "offsets": [0, 1, 9, 15, 23],
        "itemsize": _MESSAGE_BYTES,
    }
)
_OPAQUE = np.dtype(f"V{_MESSAGE_BYTES}")  # numpy copies plain bytes several times as fast as fields
_WORDS_OF_A_HEAD = (0, 3)  # eight bytes each: together opcode, length and channel
_WORD, _TIME = np.dtype("<u8"), np.dtype("<i8")
_FIRST_LOOK, _LOOK_GROWTH, _LONGEST_LOOK = 16, 8, 1 << 14

Bytes = bytes | memoryview
Integers = NDArray[np.int64]


@dataclass(frozen=True)
class Schema:
    """A schema record."""

    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True)
class Channel:
    """A channel record."""

    schema: int
    topic: str
    encoding: str


@dataclass(frozen=True)
class Chunk:
    """A chunk record, as its head says; positions are those in the file.

    Attributes
    ----------
    position, end : int
        First byte of the record and of what follows it.
    first_ns, last_ns : int
        Log times of its messages.
    size : int
        Bytes of its records, unpacked.
    checksum : int
        CRC-32 of these, 0 where none is stored.
    codec : str
        ``zstd``, ``lz4`` or empty.
    start, packed : int
        First byte of the packed records, and their number of bytes that the file holds.
    is_cut : bool
        Whether the file ends inside it.
    """

    position: int
    end: int
    first_ns: int
    last_ns: int
    size: int
    checksum: int
    codec: str
    start: int
    packed: int
    is_cut: bool = False


@dataclass(frozen=True)
class ChunkIndex:
    """A chunk index record of the summary."""

    position: int
    length: int
    first_ns: int
    last_ns: int
    channels: frozenset[int]
    index_bytes: int
    places: dict[int, int] = field(default_factory=dict)

    @cached_property
    def indexes(self) -> dict[int, tuple[int, int]] | None:
        """First byte and end of each channel's message index record; None where they are no such records."""
        end = self.position + self.length + self.index_bytes
        found: dict[int, tuple[int, int]] = {}
        for channel, place in sorted(self.places.items(), key=lambda pair: -pair[1]):
            if end - place < RECORD.size + 6 or (end - place - RECORD.size - 6) % 16:
                return None
            found[channel] = place, end
            end = place
        return found if end == self.position + self.length else None

    @property
    def messages(self) -> int:
        """Number of messages that the message index records of the chunk list."""
        return (self.index_bytes - 15 * len(self.channels)) // 16


@dataclass
class Statistics:
    """The statistics record."""

    messages: int
    chunks: int
    first_ns: int
    last_ns: int
    counts: dict[int, int] = field(default_factory=dict)


def is_possible(opcode: int, length: int) -> bool:
    """Whether a record of ``opcode`` may have a body of ``length`` bytes."""
    if opcode == DATA_END:
        return length == 4
    if opcode == FOOTER:
        return length == 20
    if opcode < len(_LEAST):
        return opcode > 0 and length >= _LEAST[opcode]
    return opcode >= 0x80  # private records; those between are reserved


class _Fields:
    """Reads the fields of one body in turn; raises ValueError where it ends too early."""

    def __init__(self, body: Bytes) -> None:
        self._body = memoryview(body)
        self._place = 0

    def number(self, size: int) -> int:
        return int.from_bytes(self.bytes(size), "little")

    def bytes(self, size: int) -> bytes:
        end = self._place + size
        if end > len(self._body):
            raise ValueError("a field goes beyond its record")
        part = bytes(self._body[self._place : end])
        self._place = end
        return part

    def text(self) -> str:
        return self.bytes(self.number(4)).decode("utf-8")

    def pairs(self) -> dict[int, int]:
        """Numbers of channels, and what belongs to them."""
        content = self.bytes(self.number(4))
        if len(content) % _PAIR.size:
            raise ValueError("a pair goes beyond its record")
        return dict(_PAIR.iter_unpack(content))

    @property
    def is_done(self) -> bool:
        return self._place == len(self._body)


def parse_schema(body: Bytes) -> tuple[int, Schema]:
    """Return a schema's number and content; raises ValueError where the body cannot be one."""
    fields = _Fields(body)
    number = fields.number(2)
    schema = Schema(fields.text(), fields.text(), fields.bytes(fields.number(4)))
    if not number or not fields.is_done:
        raise ValueError("a schema's length or number is wrong")
    return number, schema


def parse_channel(body: Bytes) -> tuple[int, Channel]:
    """Return a channel's number and content; raises ValueError where the body cannot be one."""
    fields = _Fields(body)
    number, schema = fields.number(2), fields.number(2)
    channel = Channel(schema, fields.text(), fields.text())
    metadata = _Fields(fields.bytes(fields.number(4)))
    while not metadata.is_done:
        metadata.text()
        metadata.text()
    if not fields.is_done:
        raise ValueError("a channel's length is wrong")
    return number, channel


def parse_chunk_index(body: Bytes) -> ChunkIndex:
    """Return the content of a chunk index record; raises ValueError where the body cannot be one."""
    fields = _Fields(body)
    first, last, position, length = _FOUR.unpack(fields.bytes(_FOUR.size))
    places = fields.pairs()
    return ChunkIndex(position, length, first, last, frozenset(places), fields.number(8), places)


def parse_statistics(body: Bytes) -> Statistics:
    """Return the content of a statistics record; raises ValueError where the body cannot be one."""
    fields = _Fields(body)
    messages = fields.number(8)
    fields.bytes(2 + 4 + 4 + 4)  # numbers of schemas, channels, attachments, metadata
    statistics = Statistics(messages, fields.number(4), fields.number(8), fields.number(8))
    statistics.counts = fields.pairs()
    return statistics


def parse_chunk(head: Bytes, position: int, size: int) -> Chunk | None:
    """Return the chunk that begins at ``position`` of a file of ``size`` bytes, or None.

    The length of the record and that of the packed records must agree. The opcode is not looked at, so
    that a chunk whose opcode is damaged is found too.

    Parameters
    ----------
    head : bytes
        What stands in the file from ``position`` on, at least `CHUNK_HEAD_BYTES` where the file has them.
    position, size : int
        Of the record and of the file, bytes.
    """
    fixed = RECORD.size + _CHUNK_HEAD.size + 4
    if len(head) < fixed + 8:
        return None
    length = RECORD.unpack_from(head)[1]
    first, last, unpacked, checksum = _CHUNK_HEAD.unpack_from(head, RECORD.size)
    name = int.from_bytes(head[fixed - 4 : fixed], "little")
    if name > _LONGEST_CODEC or len(head) < fixed + name + 8:
        return None
    packed = int.from_bytes(head[fixed + name : fixed + name + 8], "little")
    if length != _CHUNK_HEAD.size + 4 + name + 8 + packed or packed > LARGEST_CHUNK:
        return None
    if first >= 1 << 63 or last >= 1 << 63:
        first, last = 0, (1 << 63) - 1
    start, end = position + fixed + name + 8, position + RECORD.size + length
    codec = bytes(head[fixed : fixed + name]).decode("ascii", "replace")
    available = max(0, min(packed, size - start))
    return Chunk(
        position, min(end, size), first, last, unpacked, checksum, codec, start, available, end > size
    )


@dataclass(frozen=True)
class Located:
    """Where messages lie in a buffer.

    Attributes
    ----------
    channels, starts, lengths, log_time, publish_time : ndarray of int64, shape (n,)
        Of each message; ``starts`` and ``lengths`` are those of the payloads.
    others : tuple of (int, int, int)
        Opcode, first byte and end of the body of each schema and channel record.
    stop : int
        Where the walk ended: the end of the buffer, or the first byte that begins no record.
    channel : int or None
        The channel of all messages, where it is known that they have only one.
    stride : int
        Bytes from one message to the next, where it is known that it is always the same, else 0.
    """

    channels: Integers
    starts: Integers
    lengths: Integers
    log_time: Integers
    publish_time: Integers
    others: tuple[tuple[int, int, int], ...]
    stop: int
    channel: int | None = None
    stride: int = 0

    @property
    def count(self) -> int:
        """Number of messages."""
        return self.starts.size


def locate(
    buffer: Bytes, offsets: Integers, others: Iterable[tuple[int, int, int]] = (), stop: int = 0
) -> Located:
    """Read the heads of the message records that begin at ``offsets``, shape (n,)."""
    return _located(_heads(buffer, offsets), offsets, tuple(others), stop)


def _heads(buffer: Bytes, offsets: Integers) -> NDArray[np.void]:
    """Heads of the message records at ``offsets``, shape (n,), copied: they are touched only once."""
    if not offsets.size:
        return np.empty(0, dtype=_HEAD)
    step = int(offsets[1] - offsets[0]) if offsets.size > 1 else 1
    even = step > 0 and int(offsets[-1] - offsets[0]) == step * (offsets.size - 1)
    if even and bool((offsets[1:] - offsets[:-1] == step).all()):
        return np.ndarray((offsets.size,), _OPAQUE, buffer, int(offsets[0]), (step,)).copy().view(_HEAD)
    every: NDArray[np.void] = np.ndarray((len(buffer) - _MESSAGE_BYTES + 1,), _OPAQUE, buffer, 0, (1,))
    return every[offsets].view(_HEAD)


def _located(
    heads: NDArray[np.void], offsets: Integers, others: tuple[tuple[int, int, int], ...], stop: int
) -> Located:
    return Located(
        channels=heads["channel"].astype(np.int64),
        starts=offsets + _MESSAGE_BYTES,
        lengths=heads["length"] - MESSAGE_HEAD.size,
        log_time=heads["log_time"].astype(np.int64),
        publish_time=heads["publish_time"].astype(np.int64),
        others=others,
        stop=stop,
    )


def scan(buffer: Bytes, begin: int, end: int, *, loose: bool = False) -> Located:
    """Walk from record to record, from ``begin`` to ``end`` of ``buffer``.

    Runs of messages of one length are walked at once. With ``loose``, for the records outside chunks, the
    walk ends at the first record that is no message, schema or channel; otherwise such records are skipped.
    """
    offsets: array[int] = array("q")
    others: list[tuple[int, int, int]] = []
    view = np.frombuffer(buffer, dtype=np.uint8)
    place, before = begin, -1
    while end - place >= RECORD.size:
        opcode, length = RECORD.unpack_from(buffer, place)
        following = place + RECORD.size + length
        if following > end or not is_possible(opcode, length):
            break
        if opcode == MESSAGE:
            offsets.append(place)
            if length == before:
                more = _run(view, place, RECORD.size + length, end)
                offsets.frombytes(_steps(following, RECORD.size + length, more))
                following += (RECORD.size + length) * more
            before = length
        elif opcode in {SCHEMA, CHANNEL}:
            others.append((opcode, place + RECORD.size, following))
        elif loose:
            break
        place = following
    return locate(buffer, np.frombuffer(offsets, dtype=np.int64), others, place)


def _steps(first: int, step: int, count: int) -> bytes:
    return (first + step * np.arange(count, dtype=np.int64)).tobytes()


def _run(view: NDArray[np.uint8], place: int, stride: int, end: int) -> int:
    """Number of records after the one at ``place`` that have its opcode and length, without a break."""
    head = view[place : place + RECORD.size]
    found, look = 0, _FIRST_LOOK
    place += stride
    while True:
        rows = min(look, (end - place) // stride)
        if rows <= 0:
            return found
        heads = view[place : place + rows * stride].reshape(rows, stride)[:, : RECORD.size]
        same = (heads == head).all(axis=1)
        if not same.all():
            return found + int(same.argmin())
        found, place = found + rows, place + rows * stride
        look = min(look * _LOOK_GROWTH, _LONGEST_LOOK)


def even(buffer: Bytes) -> Located | None:
    """Locate messages of one length that fill the buffer behind schemas and channels; None where they do not.

    The usual chunk of one topic; it is located several times as fast as by its index.
    """
    place, size = 0, len(buffer)
    others: list[tuple[int, int, int]] = []
    while size - place >= _MESSAGE_BYTES:
        opcode, length = RECORD.unpack_from(buffer, place)
        following = place + RECORD.size + length
        if opcode == MESSAGE:
            break
        if opcode not in {SCHEMA, CHANNEL} or following > size:
            return None
        others.append((opcode, place + RECORD.size, following))
        place = following
    else:
        return None
    stride = RECORD.size + length
    if length < MESSAGE_HEAD.size or (size - place) % stride:
        return None
    count = (size - place) // stride
    for offset in _WORDS_OF_A_HEAD:
        words = np.ndarray((count,), _WORD, buffer, place + offset, (stride,))
        if not (words == words[0]).all():
            return _even_mixed(buffer, place, stride, tuple(others))
    channel = int.from_bytes(buffer[place + 9 : place + 11], "little")
    return Located(
        channels=_constant(channel, count),
        starts=np.arange(place + _MESSAGE_BYTES, size + _MESSAGE_BYTES, stride, dtype=np.int64),
        lengths=_constant(length - MESSAGE_HEAD.size, count),
        log_time=np.ndarray((count,), _TIME, buffer, place + 15, (stride,)),
        publish_time=np.ndarray((count,), _TIME, buffer, place + 23, (stride,)),
        others=tuple(others),
        stop=size,
        channel=channel,
        stride=stride,
    )


def _even_mixed(
    buffer: Bytes, place: int, stride: int, others: tuple[tuple[int, int, int], ...]
) -> Located | None:
    """Locate messages of one length and several channels; None where they have several lengths."""
    offsets = np.arange(place, len(buffer), stride, dtype=np.int64)
    heads = _heads(buffer, offsets)
    if not ((heads["opcode"] == MESSAGE) & (heads["length"] == stride - RECORD.size)).all():
        return None
    return _located(heads, offsets, others, len(buffer))


def _constant(value: int, count: int) -> Integers:
    """Return an array that has the same element everywhere, and memory for one."""
    return np.ndarray((count,), np.int64, np.array([value], dtype=np.int64), 0, (0,))


def by_picks(buffer: Bytes, index: bytes, picks: Iterable[tuple[int, int, int]]) -> Located | None:
    """Locate the messages of some channels by their message index records; None where these are wrong.

    Right are offsets at which different messages of their channel begin that have the log times of the index
    and do not overlap. As the number of entries is that of a checked summary, no message is missing.

    Parameters
    ----------
    buffer : bytes
        The records of a chunk, whose checksum holds.
    index : bytes
        The message index records after it.
    picks : iterable of (int, int, int)
        Channel, and first byte and end of its record in ``index``.
    """
    size = len(buffer)
    channels = []
    pairs = []
    for channel, first, end in picks:
        head = (MESSAGE_INDEX, end - first - RECORD.size, channel, end - first - RECORD.size - 6)
        if end > len(index) or INDEX_HEAD.unpack_from(index, first) != head:
            return None
        pairs.append(np.frombuffer(index[first + INDEX_HEAD.size : end], dtype="<i8").reshape(-1, 2))
        channels.append(channel)
    numbers: Integers | int
    if len(pairs) == 1:
        entries, numbers = pairs[0], channels[0]
    else:
        entries = np.concatenate(pairs)
        numbers = np.repeat(channels, [len(part) for part in pairs])
        order = np.argsort(entries[:, 1], kind="stable")
        entries, numbers = entries[order], numbers[order]
    times, offsets = entries[:, 0], entries[:, 1].astype(np.int64)
    if not offsets.size or offsets.min() < 0 or offsets.max() > size - _MESSAGE_BYTES:
        return None
    heads = _heads(buffer, offsets)
    lengths = heads["length"]
    right = (heads["opcode"] == MESSAGE) & (heads["channel"] == numbers) & (heads["log_time"] == times)
    if not right.all() or lengths.min() < MESSAGE_HEAD.size or lengths.max() > size:
        return None
    ends = offsets + lengths + RECORD.size
    if int(ends[-1]) > size or not (offsets[1:] >= ends[:-1]).all():
        return None
    located = _located(heads, offsets, (), size)
    return replace(located, channel=channels[0]) if len(pairs) == 1 else located


def by_index(buffer: Bytes, offsets: Integers) -> Located | None:
    """Locate messages by the ``offsets`` of message index records, shape (n,); None where these are wrong.

    Right are offsets at which message records begin that, together with schemas and channels, fill the
    buffer without a gap: then no message is missing in the index.
    """
    size = len(buffer)
    if offsets.size > 1 and not bool((offsets[1:] > offsets[:-1]).all()):
        offsets = np.sort(offsets)
    if not offsets.size or offsets[0] < 0 or offsets[-1] > size - _MESSAGE_BYTES:
        return None
    heads = _heads(buffer, offsets)
    lengths = heads["length"]
    if not (heads["opcode"] == MESSAGE).all() or lengths.min() < MESSAGE_HEAD.size or lengths.max() > size:
        return None
    others = _between(buffer, offsets, offsets + (RECORD.size + lengths))
    return None if others is None else _located(heads, offsets, tuple(others), size)


def _between(buffer: Bytes, offsets: Integers, ends: Integers) -> list[tuple[int, int, int]] | None:
    """Return the schemas and channels between messages; None where something else stands there."""
    places = np.flatnonzero(offsets[1:] != ends[:-1])
    gaps = [(0, int(offsets[0]))]
    gaps += zip(ends[places].tolist(), offsets[places + 1].tolist(), strict=True)
    gaps.append((int(ends[-1]), len(buffer)))
    others: list[tuple[int, int, int]] = []
    for begin, end in gaps:
        if end < begin:
            return None
        if end > begin:
            between = scan(buffer, begin, end)
            if between.count or between.stop != end:
                return None
            others += between.others
    return others


def index_offsets(records: Bytes) -> tuple[Integers, dict[int, int]]:
    """Return the offsets in message index records, shape (n,), and the number of messages by channel.

    The walk ends at the first record that is no message index, or that cannot be one.
    """
    found: list[Integers] = []
    counts: dict[int, int] = {}
    for body in _indexes(records):
        pairs = np.frombuffer(body, dtype="<i8", offset=6)
        found.append(pairs[1::2].astype(np.int64))
        channel = int.from_bytes(body[:2], "little")
        counts[channel] = counts.get(channel, 0) + pairs.size // 2
    return (np.concatenate(found) if found else np.empty(0, dtype=np.int64)), counts


def index_times(records: Bytes) -> tuple[int, int] | None:
    """Return the first and last log time in message index records; None where there are none."""
    times = [np.frombuffer(body, dtype="<i8", offset=6)[::2] for body in _indexes(records)]
    times = [part for part in times if part.size]
    if not times:
        return None
    return min(int(part.min()) for part in times), max(int(part.max()) for part in times)


def _indexes(records: Bytes) -> Iterator[memoryview]:
    view, place = memoryview(records), 0
    while place + RECORD.size + 6 <= len(view):
        opcode, length = RECORD.unpack_from(view, place)
        end = place + RECORD.size + length
        if opcode != MESSAGE_INDEX or end > len(view):
            return
        body = view[place + RECORD.size : end]
        if length < 6 or int.from_bytes(body[2:6], "little") != length - 6 or (length - 6) % 16:
            return
        yield body
        place = end
