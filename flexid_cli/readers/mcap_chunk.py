"""From one chunk of an MCAP file to its messages, with a verdict on how far they can be trusted.

Everything here is free of shared state, so that several chunks are unpacked at the same time: reading,
unpacking and the checksum let go of the interpreter.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any

import numpy as np

from flexid_cli.readers.byte_source import ByteSource
from flexid_cli.readers.checksum import crc32
from flexid_cli.readers.damage import explain, failures
from flexid_cli.readers.mcap_records import (
    CODECS,
    LARGEST_CHUNK,
    Chunk,
    Located,
    by_index,
    by_picks,
    even,
    index_offsets,
    locate,
    scan,
)
from flexid_cli.readers.mcap_salvage import next_message

if TYPE_CHECKING:
    import zstandard

_PIECE = 1 << 17
_ZSTD_MAGIC, _LZ4_MAGIC = b"\x28\xb5\x2f\xfd", b"\x04\x22\x4d\x18"
_LARGEST_WINDOW = 1 << 27  # bytes; what the reference decoder allows, too
_UNKNOWN_SIZE = (1 << 64) - 1
_own = threading.local()

Picks = Sequence[tuple[int, int, int]]


class Trust(Enum):
    """How far the messages of a chunk can be trusted."""

    CHECKED = "its checksum holds"
    UNCHECKED = "it has no checksum, and its layout is whole"
    SUSPECT = "they may be wrong"


@dataclass(frozen=True)
class Unpacked:
    """One chunk's records.

    Attributes
    ----------
    buffer : bytes
        The records.
    messages : Located
        Where they lie in ``buffer``.
    trust : Trust
        For all of them.
    reason : str
        What is wrong; empty where nothing is.
    counts : dict of int to int
        Number of messages by channel, as the message index records after a damaged chunk say.
    """

    buffer: bytes
    messages: Located
    trust: Trust
    reason: str
    counts: dict[int, int]


def unpack(source: ByteSource, chunk: Chunk, index_end: int, picks: Picks | None = None) -> Unpacked:
    """Read, unpack and verify a chunk.

    Parameters
    ----------
    source : ByteSource
        The file.
    chunk : Chunk
        Where it stands.
    index_end : int
        End of its message index records.
    picks : sequence of (int, int, int), optional
        Channels whose messages are all that is wanted, with the first byte and the end of their message index
        record in the file, by a summary whose checksum holds. Others are left out where that can be verified.
    """
    packed = source.read(chunk.start, chunk.packed)
    records, reason = _decompress(chunk, packed)
    sound = bool(records) and chunk.checksum != 0 and crc32(records) == chunk.checksum
    if sound and picks is not None and len(records) == chunk.size and chunk.codec in CODECS:
        messages = _picked(source, chunk, index_end, records, picks)
        if messages is not None:
            return Unpacked(records, messages, Trust.CHECKED, "", {})
    may_be_whole = sound or (not reason and chunk.checksum == 0 and len(records) == chunk.size)
    messages = even(records) if may_be_whole else None
    counts: dict[int, int] = {}
    if messages is None:
        offsets, counts = index_offsets(source.read(chunk.end, index_end - chunk.end))
    if may_be_whole:
        messages = messages or by_index(records, offsets) or scan(records, 0, len(records))
        if sound or messages.stop == len(records):
            trust = Trust.CHECKED if sound else Trust.UNCHECKED
            return Unpacked(records, messages, trust, _oddity(chunk, messages, records), counts)
        reason = f"no record begins at byte {messages.stop} of its {len(records)}"
    elif not reason:
        reason = _mismatch(chunk, records)
    if chunk.is_cut:
        reason = "the file ends inside it"
    messages = _salvage(records, frozenset(counts))
    if chunk.is_cut and not chunk.checksum and chunk.codec == "":
        return Unpacked(records, messages, Trust.UNCHECKED, reason, counts)
    return Unpacked(records, messages, Trust.SUSPECT, reason, counts)


def _picked(source: ByteSource, chunk: Chunk, index_end: int, records: bytes, picks: Picks) -> Located | None:
    index = source.read(chunk.end, index_end - chunk.end)
    return by_picks(
        records, index, [(channel, first - chunk.end, end - chunk.end) for channel, first, end in picks]
    )


def _oddity(chunk: Chunk, messages: Located, records: bytes) -> str:
    """Say what is wrong with a chunk whose checksum holds."""
    left = len(records) - messages.stop
    if left:
        return f"its last {left} bytes are no records"
    if len(records) != chunk.size or chunk.codec not in CODECS:
        return "its head is damaged"
    return ""


def _mismatch(chunk: Chunk, records: bytes) -> str:
    if len(records) != chunk.size:
        return f"it holds {len(records)} bytes instead of {chunk.size}"
    return "its checksum is wrong"


def _salvage(records: bytes, channels: frozenset[int]) -> Located:
    """Locate all messages that can be found in damaged ``records``."""
    parts = [scan(records, 0, len(records))]
    while parts[-1].stop < len(records):
        last = parts[-1]
        # the length of the last message may be what is wrong, so the search begins inside it
        inside = int(last.starts[-1]) if last.count else last.stop + 1
        begin = next_message(records, min(inside, last.stop + 1), channels)
        if begin is None:
            break
        parts.append(scan(records, begin, len(records)))
    offsets = np.concatenate([part.starts for part in parts]) - 31
    others = [other for part in parts for other in part.others]
    return locate(records, offsets, others, parts[-1].stop)


def _decompress(chunk: Chunk, packed: bytes) -> tuple[bytes, str]:
    """Return what could be unpacked, and why it is not all."""
    codec = chunk.codec
    if codec not in CODECS:
        codec = {_ZSTD_MAGIC: "zstd", _LZ4_MAGIC: "lz4"}.get(packed[:4], "")
        if not codec or not chunk.checksum:
            return b"", f"it is compressed with {chunk.codec!r}, which flexid does not read"
    if codec == "" or not packed:
        return packed, ""
    try:
        whole = _whole(codec, packed, chunk.size)
    except failures() as error:
        problem = explain(error)
    else:
        if whole is not None:
            return whole, ""
        problem = f"its {codec} frame does not hold {chunk.size} bytes"
    parts = []
    limit = LARGEST_CHUNK
    try:
        for piece in _pieces(codec, packed):
            parts.append(piece[:limit])
            limit -= len(parts[-1])
            if not limit:
                break
    except failures() as error:
        problem = explain(error)
    return b"".join(parts), f"it cannot be unpacked ({problem})"


def _whole(codec: str, packed: bytes, size: int) -> bytes | None:
    """Unpack everything at once; None where the frame has another size than the chunk claims."""
    if not 0 < size <= LARGEST_CHUNK:
        return None
    if codec == "lz4":
        import lz4.frame

        context = lz4.frame.create_decompression_context()
        records, _, ended = lz4.frame.decompress_chunk(context, packed, max_length=size)
        return bytes(records) if ended and len(records) == size else None
    import zstandard

    content = zstandard.get_frame_parameters(packed).content_size
    if content not in {size, _UNKNOWN_SIZE}:
        return None
    records = _zstd().decompress(packed, max_output_size=size)
    return bytes(records) if len(records) == size else None


def _pieces(codec: str, packed: bytes) -> Iterator[bytes]:
    """Unpack piece by piece, so that what stands before a damaged place is not lost."""
    decoder: Any
    if codec == "lz4":
        import lz4.frame

        decoder = lz4.frame.LZ4FrameDecompressor()
        for start in range(0, len(packed), _PIECE // 8):
            piece = decoder.decompress(packed[start : start + _PIECE // 8])
            yield bytes(piece)
            if decoder.eof:
                return
        return
    with _zstd().stream_reader(packed, read_across_frames=True) as reader:
        while piece := reader.read(_PIECE):
            yield piece


def _zstd() -> zstandard.ZstdDecompressor:
    """Return the decompressor of this thread."""
    if not hasattr(_own, "zstd"):
        import zstandard

        _own.zstd = zstandard.ZstdDecompressor(max_window_size=_LARGEST_WINDOW)
    decompressor: zstandard.ZstdDecompressor = _own.zstd
    return decompressor
