"""The summary at the end of an MCAP file: what it claims, and whether its checksum holds."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

from flexid_cli.readers.byte_source import ByteSource
from flexid_cli.readers.checksum import crc32
from flexid_cli.readers.mcap_records import (
    CHANNEL,
    CHUNK_INDEX,
    DATA_END,
    FOOTER,
    LARGEST_CHUNK,
    MAGIC,
    RECORD,
    SCHEMA,
    STATISTICS,
    Channel,
    ChunkIndex,
    Schema,
    Statistics,
    parse_channel,
    parse_chunk_index,
    parse_schema,
    parse_statistics,
)

_FOOTER_BYTES = RECORD.size + 20


@dataclass
class Summary:
    """What the end of the file says about the whole.

    Attributes
    ----------
    data_end : int or None
        First byte of the data end record; None where it does not stand before the summary.
    data_checksum : int
        CRC-32 of the data section, 0 where none is stored.
    is_checked : bool
        Whether the summary has a checksum that holds.
    problem : str
        What is wrong with the end of the file; empty where nothing is.
    """

    data_end: int | None = None
    data_checksum: int = 0
    is_checked: bool = False
    problem: str = ""
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: dict[int, ChunkIndex] = field(default_factory=dict)
    statistics: Statistics | None = None

    @property
    def knows_counts(self) -> bool:
        """Whether the numbers of messages can be believed: checked, or at least in agreement."""
        known = self.statistics
        if known is None or known.messages != sum(known.counts.values()):
            return False
        return self.is_checked or (not self.problem and set(known.counts) <= set(self.channels))

    @cached_property
    def lists_all(self) -> bool:
        """Whether the chunk index is checked and leads to every message of the file."""
        known = self.statistics
        return (
            self.is_checked
            and known is not None
            and known.chunks == len(self.chunks)
            and known.messages == sum(chunk.messages for chunk in self.chunks.values())
        )


def read_summary(source: ByteSource) -> Summary:
    """Read the end of an MCAP file; where it is damaged or missing, ``problem`` says so."""
    tail = source.read(source.size - _FOOTER_BYTES - len(MAGIC), _FOOTER_BYTES + len(MAGIC))
    if not tail.endswith(MAGIC) or RECORD.unpack_from(tail) != (FOOTER, 20):
        return Summary(problem="its end is missing or damaged: the recorder did not close it, or it is cut")
    begin = int.from_bytes(tail[9:17], "little")
    stored = int.from_bytes(tail[25:29], "little")
    end = source.size - _FOOTER_BYTES - len(MAGIC)
    if begin and not (len(MAGIC) <= begin <= end and end - begin <= LARGEST_CHUNK):
        return Summary(problem=f"its footer places the summary at byte {begin}, which cannot be")
    content = source.read(begin, end - begin) if begin else b""
    summary = Summary()
    if stored:
        summary.is_checked = crc32(tail[:25], crc32(content)) == stored
        if not summary.is_checked:
            return Summary(problem="the checksum of its summary is wrong")
    try:
        _fill(summary, content)
    except ValueError as error:
        return Summary(problem=f"its summary cannot be read ({error})")
    _find_data_end(source, summary, (begin or end) - RECORD.size - 4)
    return summary


def _find_data_end(source: ByteSource, summary: Summary, place: int) -> None:
    record = source.read(place, RECORD.size + 4) if place > 0 else b""
    if len(record) == RECORD.size + 4 and RECORD.unpack_from(record) == (DATA_END, 4):
        summary.data_end = place
        summary.data_checksum = int.from_bytes(record[9:], "little")


def _fill(summary: Summary, content: bytes) -> None:
    place, view = 0, memoryview(content)
    while place < len(view):
        if len(view) - place < RECORD.size:
            raise ValueError("its last record is cut short")
        opcode, length = RECORD.unpack_from(view, place)
        body = view[place + RECORD.size : place + RECORD.size + length]
        if len(body) != length:
            raise ValueError("a record goes beyond its end")
        if opcode == SCHEMA:
            number, schema = parse_schema(body)
            summary.schemas[number] = schema
        elif opcode == CHANNEL:
            number, channel = parse_channel(body)
            summary.channels[number] = channel
        elif opcode == CHUNK_INDEX:
            chunk = parse_chunk_index(body)
            summary.chunks[chunk.position] = chunk
        elif opcode == STATISTICS:
            summary.statistics = parse_statistics(body)
        place += RECORD.size + length


def data_checksum_holds(source: ByteSource, summary: Summary) -> bool | None:
    """Whether the checksum over all bytes before the data end record holds; None where none is stored."""
    if not summary.data_checksum or summary.data_end is None:
        return None
    checksum, block = 0, 1 << 20
    for start in range(0, summary.data_end, block):
        checksum = crc32(source.read(start, min(block, summary.data_end - start)), checksum)
    return checksum == summary.data_checksum
