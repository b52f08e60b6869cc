"""Finding the next record of an MCAP file behind a damaged place.

A record has no mark of its own, so one is believed only where its length is possible, its inner lengths
agree with it, and the records that follow it are possible, too.
"""

from __future__ import annotations

from collections.abc import Set as AbstractSet

import numpy as np
from numpy.typing import NDArray

from flexid_cli.readers.byte_source import ByteSource
from flexid_cli.readers.mcap_records import (
    CHANNEL,
    CHUNK,
    CHUNK_HEAD_BYTES,
    CODECS,
    DATA_END,
    FOOTER,
    MAGIC,
    MESSAGE,
    MESSAGE_INDEX,
    RECORD,
    SCHEMA,
    Bytes,
    is_possible,
    parse_channel,
    parse_chunk,
    parse_schema,
)

_BLOCK, _SMALL_BLOCK = 1 << 20, 1 << 14
_CHAIN = 3  # records that must follow one another
_LONGEST_DESCRIPTION = 1 << 24  # bytes of a schema that is still looked into
_LEAST_LENGTH = np.array([2**32 - 1, 8, 20, 12, 12, 22, 40, 6, 64, 28, 42, 42, 8, 20, 17, 4], dtype=np.uint32)


def heads(view: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Places in ``view`` where the head of a record may stand: known opcode, possible length below 4 GiB."""
    count = view.size - RECORD.size + 1
    if count <= 0:
        return np.empty(0, dtype=np.int64)
    upper = np.ndarray((count,), "<u4", view, 5, (1,))
    lower = np.ndarray((count,), "<u4", view, 1, (1,))
    places = np.flatnonzero((upper == 0) & (view[:count] - np.uint8(1) < 15))
    return places[lower[places] >= _LEAST_LENGTH[view[places]]]


def next_message(buffer: Bytes, begin: int, channels: AbstractSet[int]) -> int | None:
    """Return the first place from ``begin`` on where a message of the records of one chunk may begin.

    Parameters
    ----------
    buffer : bytes
        Records of a chunk.
    begin : int
        Where the search begins.
    channels : set of int
        Channels that the chunk holds; empty where that is not known.
    """
    view = np.frombuffer(buffer, dtype=np.uint8)
    for start in range(begin, view.size, _SMALL_BLOCK):
        places = heads(view[start : start + _SMALL_BLOCK + RECORD.size - 1]) + start
        for place in places[view[places] == MESSAGE].tolist():
            channel = int.from_bytes(buffer[place + 9 : place + 11], "little")
            if (not channels or channel in channels) and _is_chain_in(buffer, place, view.size):
                return int(place)
    return None


def _is_chain_in(buffer: Bytes, place: int, end: int) -> bool:
    for _ in range(_CHAIN):
        if place == end:
            return True
        if end - place < RECORD.size:
            return False
        opcode, length = RECORD.unpack_from(buffer, place)
        place += RECORD.size + length
        if opcode not in {SCHEMA, CHANNEL, MESSAGE} or not is_possible(opcode, length) or place > end:
            return False
    return True


class Seeker:
    """Finds records in a damaged file.

    Parameters
    ----------
    source : ByteSource
        The file.
    channels : set of int
        Channels met so far; a message outside a chunk must belong to one, where any is known. May grow.
    """

    def __init__(self, source: ByteSource, channels: AbstractSet[int]) -> None:
        self._source = source
        self._channels = channels

    def next_record(self, begin: int, *, chunks_only: bool = False) -> int | None:
        """Return the first place from ``begin`` on where a record begins, or None."""
        overlap = RECORD.size - 1
        for start in range(begin, self._source.size, _BLOCK):
            view = np.frombuffer(self._source.read(start, _BLOCK + overlap), dtype=np.uint8)
            places = heads(view)
            if chunks_only:
                places = places[view[places] == CHUNK]
            for place in (places + start).tolist():
                if self.is_record(place):
                    return int(place)
        return None

    def is_record(self, place: int) -> bool:
        """Whether a whole and possible record, followed by possible ones, begins at ``place``."""
        head = self._source.peek(place, CHUNK_HEAD_BYTES)
        opcode, length = RECORD.unpack_from(head)
        end = place + RECORD.size + length
        if opcode == CHUNK:
            chunk = parse_chunk(head, place, self._source.size)
            return chunk is not None and chunk.codec in CODECS and chunk.first_ns <= chunk.last_ns
        if end > self._source.size:
            return False
        if opcode == MESSAGE:
            channel = int.from_bytes(head[9:11], "little")
            return (not self._channels or channel in self._channels) and self.leads_on(end)
        if opcode == MESSAGE_INDEX:
            inner = int.from_bytes(head[11:15], "little")
            return inner == length - 6 and inner % 16 == 0 and self.leads_on(end)
        if opcode in {SCHEMA, CHANNEL}:
            return self._is_description(opcode, place, length)
        return self.leads_on(end)

    def _is_description(self, opcode: int, place: int, length: int) -> bool:
        if length > _LONGEST_DESCRIPTION:
            return False
        body = self._source.read(place + RECORD.size, length)
        try:
            if opcode == SCHEMA:
                parse_schema(body)
            else:
                parse_channel(body)
        except ValueError:
            return False
        return True

    def leads_on(self, place: int, depth: int = _CHAIN) -> bool:
        """Whether ``depth`` possible records follow one another from ``place`` on, or the file ends well."""
        for _ in range(depth):
            head = self._source.peek(place, CHUNK_HEAD_BYTES)
            if not head or head.startswith(MAGIC):
                return True
            if len(head) < RECORD.size:
                return self._is_begun(head)
            opcode, length = RECORD.unpack_from(head)
            place += RECORD.size + length
            if not is_possible(opcode, length):
                return False
            if opcode == CHUNK:
                return parse_chunk(head, place - RECORD.size - length, self._source.size) is not None
            if place > self._source.size:
                return self._is_begun(head)
            if opcode in {DATA_END, FOOTER}:
                return True
        return True

    def _is_begun(self, head: bytes) -> bool:
        """Whether the last bytes of a file can be the beginning of a record that was not written to its end."""
        if head[0] != MESSAGE or any(head[5:9]):
            return head[0] in {SCHEMA, CHANNEL, CHUNK, MESSAGE_INDEX, DATA_END, FOOTER} and not any(head[5:9])
        return len(head) < 11 or not self._channels or int.from_bytes(head[9:11], "little") in self._channels
