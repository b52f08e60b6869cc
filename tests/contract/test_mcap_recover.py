"""Never fewer right messages than ``mcap recover`` 0.3.0 keeps.

Its way, from its source and from runs: over wrong checksums it goes on, at the first record that it cannot walk
over, or chunk that it cannot unpack, it stops; what it has got by then is kept. This is done again here, without
the project's reader, and counted as the other tests of damage count: a message is right where its times and its
payload are those of one that was written.
"""

from __future__ import annotations

import random
import struct
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import lz4.frame
import pytest
import zstandard

sys.path.insert(0, str(Path(__file__).resolve().parent))

from test_mcap_damage import (
    CODECS,
    MAGIC,
    START_NS,
    STEP_NS,
    Sample,
    flipped,
    payload_of,
    replaced,
    salvage,
    sample,
)

LARGEST = 1 << 28  # of an unpacked chunk
UNPACK: dict[bytes, Callable[[bytes], bytes]] = {
    b"zstd": lambda data: zstandard.ZstdDecompressor().decompress(data, max_output_size=LARGEST),
    b"lz4": lz4.frame.decompress,
    b"": bytes,
}


def records(content: bytes, start: int) -> Iterator[tuple[int, bytes]]:
    while start + 9 <= len(content):
        code, size = struct.unpack_from("<BQ", content, start)
        if not code or size > len(content) - start - 9:
            raise ValueError(f"no record at byte {start}")
        yield code, content[start + 9 : start + 9 + size]
        start += 9 + size


def recovered(content: bytes) -> set[int]:
    """Rows that ``mcap recover`` keeps, and has right."""
    rows: set[int] = set()
    if not content.startswith(MAGIC):
        return rows
    try:
        for code, body in records(content, len(MAGIC)):
            if code == 5:
                rows |= right(body)
            elif code == 6:
                length = struct.unpack_from("<I", body, 28)[0]
                size = struct.unpack_from("<Q", body, 32 + length)[0]
                packed = body[40 + length : 40 + length + size]
                for inner, message in records(UNPACK[body[32 : 32 + length]](packed), 0):
                    rows |= right(message) if inner == 5 else set()
            elif code == 2:
                break
    except (ValueError, KeyError, RuntimeError, EOFError, struct.error, zstandard.ZstdError):
        pass
    return rows


def right(message: bytes) -> set[int]:
    if len(message) != 22 + 68:
        return set()
    times = struct.unpack_from("<QQ", message, 6)
    row = struct.unpack_from("<q", message, 22 + 60)[0]
    stamp = START_NS + row * STEP_NS
    whole = 0 <= row < 1 << 40 and message[22:] == payload_of(row) and times == (stamp, stamp + 500)
    return {row} if whole else set()


def cases(given: Sample) -> Iterator[tuple[str, bytes]]:
    """The damages that were seen in the wild."""
    content, start = given.content, given.summary_start
    yield "whole", content
    yield "no footer", content[: start - 13]
    yield "summary offset garbage", replaced(content, len(content) - 28, struct.pack("<Q", 1 << 63))
    yield "garbage appended", content + random.Random(1).randbytes(5_000)
    if given.pieces:
        piece = given.middle
        half = (piece.data + piece.end) // 2
        yield "cut in a chunk", content[:half]
        yield "cut in a length", content[: piece.position + 5]
        yield "wrong checksum field", flipped(content, piece.position + 9 + 24)
        yield "flip in the packed records", flipped(content, half)
        yield "flip in the head of the chunk", flipped(content, piece.position + 3)
        yield (
            "unknown codec",
            replaced(content, piece.position + 41, b"lzma"[: piece.data - piece.position - 49]),
        )
        yield "length of 8 GiB", replaced(content, piece.position + 1, struct.pack("<Q", 8 << 30))
        yield "zeros from here on", content[:half] + bytes(len(content) - half)
    else:
        place = content.index(payload_of(given.rows // 2))
        yield "cut", content[:place]
        yield "flip in a payload", flipped(content, place + 20)
        yield "flip in the framing", flipped(content, place - 30)
        yield "zeros from here on", content[:place] + bytes(len(content) - place)


def sound(codec: str, *, crc: bool) -> Sample:
    return sample(codec, 600, 3_000, crc=crc)


@pytest.mark.parametrize("crc", [True, False])
@pytest.mark.parametrize("codec", [*CODECS, "unchunked"])
def test_no_fewer_in_every_case(codec: str, crc: bool, tmp_path: Path) -> None:
    given = sound(codec, crc=crc)
    if codec == "lz4":
        assert b"lz4" in given.content
    for what, content in cases(given):
        found = salvage(tmp_path / "log.mcap", content)
        least = recovered(content)
        assert (found.trusted | found.suspect) >= least, what
        if what == "whole":
            assert len(least) == given.rows


@pytest.mark.parametrize("codec", [*CODECS, "unchunked"])
def test_no_fewer_after_random_damage(codec: str, tmp_path: Path) -> None:
    given, rng = sound(codec, crc=codec != "unchunked"), random.Random(8)
    for number in range(30):
        place = rng.randrange(9, len(given.content))
        content = flipped(given.content, place, rng.randrange(8)) if number % 2 else given.content[:place]
        found = salvage(tmp_path / "log.mcap", content)
        assert (found.trusted | found.suspect) >= recovered(content), (number, place)
