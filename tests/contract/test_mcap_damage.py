"""Damaged MCAP files: every kind that was seen in the wild, and flips and cuts at random places.

A message counts as right only where its log time, publish time and payload are exactly those of one message
that was written. What ``mcap recover`` 0.3.0 keeps is the least that must be kept: it goes on over wrong
checksums, and stops at the first record that it cannot walk over or unpack.
"""

from __future__ import annotations

import io
import random
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from flexid_cli.errors import InputError
from flexid_cli.readers.base import ReadOptions, Window
from flexid_cli.readers.loss import Loss
from flexid_cli.readers.mcap import McapFile
from flexid_cli.readers.registry import list_channels, open_reader, read_log

MAGIC = b"\x89MCAP0\r\n"
START_NS, STEP_NS = 1_700_000_000_000_000_000, 1_000_000
SCHEMA = b"float64[6] position\nfloat64 effort\nint64 row\n"
CODECS = {
    "zstd": CompressionType.ZSTD,
    "lz4": CompressionType.LZ4,
    "none": CompressionType.NONE,
}
SOURCES = ["/drive.position[0]", "/drive.row"]
ROWS = 2000
CHUNK_BYTES = 8_000


def payload_of(row: int) -> bytes:
    position = [np.sin(row * 1e-3 * (joint + 1)) for joint in range(6)]
    return b"\x00\x01\x00\x00" + struct.pack("<7dq", *position, 0.1 * row, row)


@dataclass(frozen=True)
class Piece:
    """One chunk of a sample file: its bytes, and the rows in it."""

    position: int
    end: int
    data: int
    first: int
    rows: int


@dataclass(frozen=True)
class Sample:
    """A sound file, and what is in it."""

    content: bytes
    rows: int
    pieces: tuple[Piece, ...] = ()
    summary_start: int = 0

    @property
    def middle(self) -> Piece:
        return self.pieces[len(self.pieces) // 2]


@cache
def sample(
    codec: str = "zstd", rows: int = ROWS, chunk_bytes: int = CHUNK_BYTES, *, crc: bool = True, **more: object
) -> Sample:
    """Write a file with the mcap package, and find its chunks with the same."""
    stream = io.BytesIO()
    writer = Writer(
        stream,
        chunk_size=chunk_bytes,
        compression=CODECS.get(codec, CompressionType.NONE),
        use_chunking=codec != "unchunked",
        enable_crcs=crc,
        **more,  # type: ignore[arg-type]
    )
    writer.start("ros2")
    schema = writer.register_schema("test/msg/Drive", "ros2msg", SCHEMA)
    channel = writer.register_channel("/drive", "cdr", schema)
    for row in range(rows):
        stamp = START_NS + row * STEP_NS
        writer.add_message(channel, stamp, payload_of(row), stamp + 500, row)
    writer.finish()
    content = stream.getvalue()
    start = struct.unpack_from("<Q", content, len(content) - 28)[0]
    return Sample(content, rows, pieces_of(content), start)


def pieces_of(content: bytes) -> tuple[Piece, ...]:
    summary = make_reader(io.BytesIO(content)).get_summary()
    assert summary is not None
    pieces = []
    for index in summary.chunk_indexes:
        position = index.chunk_start_offset
        first = (index.message_start_time - START_NS) // STEP_NS
        last = (index.message_end_time - START_NS) // STEP_NS
        end = position + index.chunk_length
        pieces.append(Piece(position, end, end - index.compressed_size, first, last - first + 1))
    return tuple(pieces)


@dataclass
class Result:
    """What the reader gave: rows by how far it trusts them, and messages that were never written."""

    trusted: set[int] = field(default_factory=set)
    suspect: set[int] = field(default_factory=set)
    wrong_trusted: int = 0
    wrong_suspect: int = 0
    checked: bool = True
    loss: Loss = field(default_factory=Loss)

    @property
    def kept(self) -> int:
        return len(self.trusted | self.suspect)


def salvage(path: Path, content: bytes, threads: int = 1, window: Window | None = None) -> Result:
    path.write_bytes(content)
    file = McapFile(path, options=ReadOptions(threads=threads))
    result = Result()
    for batch in file.batches(lambda topic: topic == "/drive", window or Window()):
        assert batch.publish_time is not None
        result.checked &= batch.checked
        for row in range(batch.starts.size):
            begin = int(batch.starts[row])
            payload = batch.buffer[begin : begin + int(batch.lengths[row])].tobytes()
            count = struct.unpack_from("<q", payload, 60)[0] if len(payload) == 68 else -1
            times = int(batch.log_time[row]), int(batch.publish_time[row])
            stamp = START_NS + count * STEP_NS
            if 0 <= count < 1 << 40 and payload == payload_of(count) and times == (stamp, stamp + 500):
                (result.trusted if batch.trusted else result.suspect).add(count)
            elif batch.trusted:
                result.wrong_trusted += 1
            else:
                result.wrong_suspect += 1
    result.loss = file.loss
    return result


def all_but(given: Sample, *pieces: Piece) -> set[int]:
    lost = {row for piece in pieces for row in range(piece.first, piece.first + piece.rows)}
    return set(range(given.rows)) - lost


def replaced(content: bytes, place: int, new: bytes) -> bytes:
    return content[:place] + new + content[place + len(new) :]


def flipped(content: bytes, place: int, bit: int = 3) -> bytes:
    return replaced(content, place, bytes([content[place] ^ 1 << bit]))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "log.mcap"


def test_the_sample_has_27_chunks_or_so() -> None:
    given = sample()
    assert 15 < len(given.pieces) < 40
    assert sum(piece.rows for piece in given.pieces) == given.rows


@pytest.mark.parametrize("codec", [*CODECS, "unchunked"])
@pytest.mark.parametrize("threads", [1, 3])
def test_a_sound_file_is_whole(codec: str, threads: int, path: Path) -> None:
    given = sample(codec)
    found = salvage(path, given.content, threads)
    assert found.trusted == all_but(given)
    assert found.checked == (codec != "unchunked")
    assert found.wrong_trusted == found.wrong_suspect == len(found.suspect) == 0
    assert found.loss == Loss()


# --- the end of the file ---------------------------------------------------------------------------------


@pytest.mark.parametrize("codec", [*CODECS, "unchunked"])
def test_no_footer(codec: str, path: Path) -> None:
    given = sample(codec)
    found = salvage(path, given.content[: given.summary_start - 13])
    assert found.trusted == all_but(given)
    assert found.loss.reasons


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
def test_cut_in_a_chunk(codec: str, share: float, path: Path) -> None:
    """What was unpacked before the cut is right, yet no checksum says so."""
    given = sample(codec, 20_000, 1 << 19)
    piece = given.middle
    cut = piece.data + int(share * (piece.end - piece.data))
    found = salvage(path, given.content[:cut])
    assert found.trusted == set(range(piece.first))
    assert found.wrong_trusted == found.wrong_suspect == 0
    assert len(found.suspect) >= (share - 0.3) * piece.rows
    assert found.loss.messages is None or found.loss.messages > 0
    assert any(str(piece.position) in reason for reason in found.loss.reasons)
    log = read_log([path], SOURCES)
    assert log.channels[SOURCES[1]].values.tolist() == list(range(piece.first))
    log = read_log([path], SOURCES, options=ReadOptions(keep_suspect=True))
    channel = log.channels[SOURCES[1]]
    assert channel.values.tolist() == list(range(piece.first + len(found.suspect)))
    if found.suspect:
        assert channel.suspect is not None
        assert np.flatnonzero(channel.suspect).tolist() == sorted(found.suspect)


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("place", range(0, 49, 3))
def test_cut_in_the_head_of_a_chunk(codec: str, place: int, path: Path) -> None:
    given = sample(codec)
    found = salvage(path, given.content[: given.middle.position + place])
    assert found.trusted == set(range(given.middle.first))


@pytest.mark.parametrize("codec", [*CODECS, "unchunked"])
def test_zeros_from_the_middle_on(codec: str, path: Path) -> None:
    given = sample(codec)
    cut = given.middle.data + 100 if given.pieces else len(given.content) // 2
    found = salvage(path, given.content[:cut] + bytes(len(given.content) - cut))
    least = given.middle.first if given.pieces else given.rows // 2 - 20
    assert found.trusted >= set(range(least))
    assert found.wrong_trusted == 0
    assert any("zeros" in reason or "chunk" in reason for reason in found.loss.reasons)


@pytest.mark.parametrize("codec", [*CODECS, "unchunked"])
def test_garbage_appended(codec: str, path: Path) -> None:
    given = sample(codec)
    found = salvage(path, given.content + random.Random(1).randbytes(5_000))
    assert found.trusted == all_but(given)
    assert any("5000 bytes follow" in reason for reason in found.loss.reasons)


@pytest.mark.parametrize("value", [1, 10, 1 << 20, 1 << 40, (1 << 64) - 1])
def test_summary_offset_garbage(value: int, path: Path) -> None:
    given = sample()
    found = salvage(path, replaced(given.content, len(given.content) - 28, struct.pack("<Q", value)))
    assert found.trusted == all_but(given)
    assert found.loss.reasons
    log = read_log([path], SOURCES)
    assert log.channels[SOURCES[1]].values.size == given.rows
    assert log.damage[0].lost == 0


def test_every_byte_of_the_summary_may_be_wrong(path: Path) -> None:
    given = sample()
    for place in range(given.summary_start - 13, len(given.content), 37):
        assert salvage(path, flipped(given.content, place)).trusted == all_but(given)


# --- one chunk -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("with_summary", [True, False])
def test_wrong_checksum_field(codec: str, with_summary: bool, path: Path) -> None:
    given = sample(codec)
    content = flipped(given.content, given.middle.position + 9 + 24)
    found = salvage(path, content if with_summary else content[: given.summary_start])
    assert found.trusted == all_but(given, given.middle)
    assert found.suspect == set(range(given.rows)) - found.trusted
    if with_summary:
        assert found.loss.messages == 0


@pytest.mark.parametrize("codec", CODECS)
def test_flip_in_the_packed_records(codec: str, path: Path) -> None:
    given = sample(codec)
    piece = given.middle
    for place in range(piece.data, piece.end, (piece.end - piece.data) // 25):
        found = salvage(path, flipped(given.content, place, place % 8))
        assert found.trusted == all_but(given, piece)
        assert found.wrong_trusted == 0
        assert found.loss.reasons
        if codec == "none":
            assert len(found.suspect) >= piece.rows - 2


def test_wrong_checksum_is_told_with_its_time(path: Path) -> None:
    given = sample()
    piece = given.middle
    path.write_bytes(flipped(given.content, piece.position + 9 + 24))
    damage = read_log([path], SOURCES).damage[0]
    assert (damage.trusted, damage.suspect, damage.lost) == (given.rows - piece.rows, piece.rows, 0)
    (span,) = damage.spans_s
    assert span == pytest.approx(((piece.first - 1) * 1e-3, (piece.first + piece.rows) * 1e-3), abs=1e-9)
    assert str(piece.position) in damage.reasons[0]
    with pytest.raises(InputError, match="checksum"):
        read_log([path], SOURCES, options=ReadOptions(strict=True))


def test_a_lost_chunk_leaves_a_gap(path: Path) -> None:
    given = sample()
    piece = given.middle
    path.write_bytes(replaced(given.content, piece.data, bytes(piece.end - piece.data)))
    log = read_log([path], SOURCES)
    rows = log.channels[SOURCES[1]].values.astype(int).tolist()
    assert rows == sorted(all_but(given, piece))
    assert log.channels[SOURCES[1]].stamps["log_time"].tolist() == [START_NS + r * STEP_NS for r in rows]
    assert log.damage[0].lost == piece.rows
    assert log.damage[0].lost_chunks == 1
    assert log.damage[0].lost_bytes >= piece.end - piece.data


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("with_summary", [True, False])
def test_every_byte_of_a_chunk_head_may_be_wrong(codec: str, with_summary: bool, path: Path) -> None:
    given = sample(codec)
    piece = given.middle
    content = given.content if with_summary else given.content[: given.summary_start]
    for place in range(piece.position, piece.data):
        found = salvage(path, flipped(content, place, place % 8))
        assert found.trusted >= all_but(given, piece), place - piece.position
        assert found.wrong_trusted == 0


@pytest.mark.parametrize("codec", CODECS)
def test_lengths_of_8_gib_are_not_believed(codec: str, path: Path) -> None:
    given = sample(codec)
    piece = given.middle
    huge = struct.pack("<Q", 8 << 30)
    name = piece.data - piece.position - 49
    places = {1: "record", 9 + 16: "unpacked size", 41 + name: "packed size"}
    for place, what in places.items():
        tracemalloc.start()
        found = salvage(path, replaced(given.content, piece.position + place, huge))
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 60e6
        assert found.trusted == all_but(given), what  # the checksum proves the records
        assert found.loss.reasons


@pytest.mark.parametrize("place", [1, 9 + 16])
@pytest.mark.parametrize("codec", CODECS)
def test_lengths_without_a_checksum_are_not_believed(codec: str, place: int, path: Path) -> None:
    given = sample(codec, crc=False)
    content = replaced(given.content, given.middle.position + place, struct.pack("<Q", 8 << 30))
    found = salvage(path, content)
    assert found.trusted >= all_but(given, given.middle)
    assert found.wrong_trusted == 0


def test_a_message_of_8_gib(path: Path) -> None:
    given = sample("none")
    piece = given.middle
    place = given.content.index(payload_of(piece.first + 20)) - 31
    assert given.content[place] == 5
    found = salvage(path, replaced(given.content, place + 1, struct.pack("<Q", 8 << 30)))
    assert found.trusted == all_but(given, piece)
    assert found.wrong_trusted == 0
    assert len(found.suspect) >= piece.rows - 1


@pytest.mark.parametrize("codec", CODECS)
def test_unknown_codec(codec: str, path: Path) -> None:
    given = sample(codec)
    piece = given.middle
    name = piece.data - piece.position - 49
    if name:
        renamed = replaced(given.content, piece.position + 41, b"lzma"[:name])
        assert salvage(path, renamed).trusted == all_but(given)  # found by its magic, proved by its checksum
        content = replaced(renamed, piece.data, b"none of it")
        found = salvage(path, content)
        assert found.trusted == all_but(given, piece)
        assert found.loss.messages == piece.rows
        assert any("compressed with" in reason for reason in found.loss.reasons)


@pytest.mark.parametrize("codec", CODECS)
def test_bytes_taken_out_or_put_in(codec: str, path: Path) -> None:
    given = sample(codec)
    piece = given.middle
    for place in (piece.position + 3, piece.data + 50, piece.end + 20):
        shorter = given.content[:place] + given.content[place + 100 :]
        longer = given.content[:place] + random.Random(2).randbytes(777) + given.content[place:]
        for content in (shorter, longer):
            for end in (None, given.summary_start - 200):
                found = salvage(path, content[:end])
                last = given.pieces[-1] if end else piece
                assert found.trusted >= all_but(given, piece, last)
                assert found.wrong_trusted == 0


def test_several_damaged_places(path: Path) -> None:
    given = sample()
    content = given.content
    hit = given.pieces[1::4]
    for piece in hit:
        content = replaced(content, piece.position, bytes(piece.end - piece.position))
    found = salvage(path, content)
    assert found.trusted == all_but(given, *hit)
    assert found.loss.messages == sum(piece.rows for piece in hit)
    assert len(found.loss.spans_ns) == len(hit)


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("with_summary", [True, False])
def test_the_chunk_with_the_schema_is_damaged(codec: str, with_summary: bool, path: Path) -> None:
    given = sample(codec)
    place = given.pieces[0].data + 200
    content = flipped(given.content, place)
    found = salvage(path, content if with_summary else content[: given.summary_start - 13])
    if with_summary:
        assert found.trusted == all_but(given, given.pieces[0])
    else:
        assert found.wrong_trusted == 0
        if found.suspect:  # where the description survived, it may be wrong itself
            assert found.suspect >= all_but(given, given.pieces[0])


# --- what has no checksum, or another one ----------------------------------------------------------------


@pytest.mark.parametrize("codec", [*CODECS, "unchunked"])
def test_checksum_over_all_data(codec: str, path: Path) -> None:
    """Without one over each chunk, a wrong one over everything leaves nothing that can be trusted."""
    given = sample(codec, crc=codec == "unchunked", enable_data_crcs=True)
    found = salvage(path, given.content)
    assert found.trusted == all_but(given)
    assert found.checked or codec != "unchunked"
    wrong = flipped(given.content, len(given.content) // 3)
    end = given.summary_start - 4
    if zlib.crc32(given.content[: end - 9]) == struct.unpack_from("<I", given.content, end)[0]:
        found = salvage(path, wrong)
        assert not found.trusted
        assert found.kept > 0.9 * given.rows or codec in {"zstd", "lz4"}
        with pytest.raises(InputError):
            read_log([path], SOURCES)


def test_a_field_without_a_checksum_among_others(path: Path) -> None:
    given = sample()
    found = salvage(path, replaced(given.content, given.middle.position + 33, bytes(4)))
    assert found.trusted == all_but(given, given.middle)
    assert len(found.suspect) == given.middle.rows


def test_no_chunk_index_and_a_wrong_checksum(path: Path) -> None:
    given = sample(index_types=IndexType.NONE)
    codec = given.content.index(b"\4\0\0\0zstd", len(given.content) // 2)
    found = salvage(path, flipped(given.content, codec - 4))
    assert found.wrong_trusted == found.wrong_suspect == 0
    assert found.kept == given.rows
    assert found.suspect


@pytest.mark.parametrize("types", [IndexType.CHUNK, IndexType.MESSAGE, IndexType.NONE])
def test_without_some_index(types: IndexType, path: Path) -> None:
    given = sample(index_types=types)
    found = salvage(path, given.content)
    assert found.trusted == all_but(given)
    assert not found.loss.reasons
    assert read_log([path], SOURCES).channels[SOURCES[1]].values.size == given.rows


def test_unchunked_message_with_a_wrong_length(path: Path) -> None:
    given = sample("unchunked", crc=False)
    place = given.content.index(payload_of(1000)) - 31
    for value in (60, 69, 89, 91, 100, 99, 500, 8 << 30, 0):
        found = salvage(path, replaced(given.content, place + 1, struct.pack("<Q", value)))
        assert found.trusted >= all_but(given) - set(range(999, 1006)), value
        assert found.loss.reasons
        assert found.kept >= given.rows - 6


# --- odd but whole ---------------------------------------------------------------------------------------


def write(path: Path, messages: list[tuple[int, bytes]], **more: object) -> None:
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=CHUNK_BYTES)
        writer.start(str(more.get("profile", "ros2")))
        schema = more.get("schema", SCHEMA)
        number = 0
        if schema is not None:
            number = writer.register_schema("test/msg/Drive", "ros2msg", bytes(schema))  # type: ignore[call-overload]
        channel = writer.register_channel("/drive", str(more.get("encoding", "cdr")), number)
        for stamp, payload in messages:
            writer.add_message(channel, stamp, payload, stamp + 500)
        writer.finish()


def test_one_short_payload(path: Path) -> None:
    messages = [(START_NS + row * STEP_NS, payload_of(row)) for row in range(ROWS)]
    messages[1000] = (messages[1000][0], messages[1000][1][:30])
    write(path, messages)
    log = read_log([path], SOURCES)
    assert log.channels[SOURCES[1]].values.tolist() == [r for r in range(ROWS) if r != 1000]
    assert log.damage[0].lost == 1
    assert log.damage[0].trusted == ROWS - 1
    with pytest.raises(InputError):
        read_log([path], SOURCES, options=ReadOptions(strict=True))


def test_shuffled_and_equal_times(path: Path) -> None:
    rows = list(range(ROWS))
    random.Random(3).shuffle(rows)
    messages = [(START_NS + (row // 2) * STEP_NS, payload_of(row)) for row in rows]
    write(path, messages)
    channel = read_log([path], SOURCES).channels[SOURCES[1]]
    assert channel.values.tolist() == rows
    assert channel.stamps["log_time"].tolist() == [stamp for stamp, _ in messages]
    half = read_log([path], SOURCES, options=ReadOptions(start_s=0.5)).channels[SOURCES[1]]
    assert half.values.tolist() == [row for row in rows if row >= ROWS // 2]


def test_no_schema_unknown_encoding_and_no_profile(path: Path) -> None:
    messages = [(START_NS + row * STEP_NS, payload_of(row)) for row in range(50)]
    write(path, messages, profile="")
    assert read_log([path], SOURCES).channels[SOURCES[1]].values.size == 50
    for more in ({"schema": None}, {"encoding": "flatbuffer"}):
        write(path, messages, **more)
        with pytest.raises(InputError, match="/drive"):
            read_log([path], SOURCES)


@pytest.mark.parametrize("content", [b"\0", b"PAR1" + bytes(100), b"time,q\n0,1\n", MAGIC, MAGIC[:5]])
def test_no_mcap_at_all(content: bytes, path: Path) -> None:
    path.write_bytes(content)
    with pytest.raises(InputError):
        read_log([path], SOURCES)


@pytest.mark.parametrize("place", range(8))
def test_a_flip_in_the_magic(place: int, path: Path) -> None:
    given = sample()
    path.write_bytes(flipped(given.content, place))
    assert open_reader([path]).name == "mcap"
    log = read_log([path], SOURCES)
    assert log.channels[SOURCES[1]].values.size == given.rows
    assert log.damage[0].reasons


# --- windows of time -------------------------------------------------------------------------------------


class CountingSource:
    """Counts the bytes that are read of a file."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        from flexid_cli.readers.byte_source import ByteSource

        self.bytes = 0
        plain = ByteSource.read

        def read(source: ByteSource, position: int, count: int) -> bytes:
            part = plain(source, position, count)
            self.bytes += len(part)
            return part

        monkeypatch.setattr(ByteSource, "read", read)


@pytest.mark.parametrize("codec", [*CODECS, "unchunked"])
@pytest.mark.parametrize("with_summary", [True, False])
@pytest.mark.parametrize(
    ("start", "end"), [(0.5, 0.6), (None, 0.1), (1.9, None), (0.0, None), (0.7, 0.7005), (0.5, 99.0)]
)
def test_windows(codec: str, with_summary: bool, start: float | None, end: float | None, path: Path) -> None:
    given = sample(codec)
    path.write_bytes(given.content if with_summary else given.content[: given.summary_start - 13])
    log = read_log([path], SOURCES, options=ReadOptions(start_s=start, end_s=end))
    rows = log.channels[SOURCES[1]].values.tolist()
    low = 0 if start is None else round(start * 1000)
    high = given.rows if end is None else min(given.rows, int(np.ceil(end * 1000 - 1e-9)))
    assert rows == list(range(low, high))


def test_a_window_reads_only_its_chunks(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given = sample("none", 20_000, 1 << 17)
    path.write_bytes(given.content)
    counter = CountingSource(monkeypatch)
    file = McapFile(path, options=ReadOptions(threads=1))
    piece = given.middle
    stamp = START_NS + (piece.first + 5) * STEP_NS
    found = sum(
        batch.starts.size for batch in file.batches(lambda _: True, Window(stamp, stamp + 3 * STEP_NS))
    )
    assert found == piece.rows
    assert counter.bytes < 0.2 * len(given.content)


def test_an_empty_window_is_an_input_error(path: Path) -> None:
    path.write_bytes(sample().content)
    with pytest.raises(InputError):
        read_log([path], SOURCES, options=ReadOptions(start_s=1e6))


@pytest.mark.parametrize("codec", CODECS)
def test_a_damaged_time_in_a_head_hides_no_chunk(codec: str, path: Path) -> None:
    given = sample(codec)
    piece = given.middle
    start = piece.first * 1e-3
    for place in (9, 14, 17, 22):
        content = flipped(given.content, piece.position + place, 6)
        for end in (None, given.summary_start - 13):
            path.write_bytes(content[:end])
            log = read_log([path], SOURCES, options=ReadOptions(start_s=start, end_s=start + 0.01))
            assert log.channels[SOURCES[1]].values.size == 10


def test_messages_of_two_topics_and_progress(path: Path) -> None:
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=CHUNK_BYTES)
        writer.start("ros2")
        schema = writer.register_schema("test/msg/Drive", "ros2msg", SCHEMA)
        numbers = [writer.register_channel(topic, "cdr", schema) for topic in ("/drive", "/other", "/drive")]
        for row in range(ROWS):
            writer.add_message(numbers[row % 3], START_NS + row * STEP_NS, payload_of(row), 0)
        writer.finish()
    seen: list[tuple[int, int]] = []
    options = ReadOptions(threads=2, progress=lambda done, total: seen.append((done, total)))
    log = read_log([path], SOURCES, options=options)
    assert log.channels[SOURCES[1]].values.tolist() == [row for row in range(ROWS) if row % 3 != 1]
    size = path.stat().st_size
    assert seen[-1] == (size, size)
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)
    counts = {info.source: info.count for info in list_channels([path])}
    assert counts["/drive.row"] == 1333
    assert counts["/other.row"] == 667


# --- at random places ------------------------------------------------------------------------------------


def least_after_cut(given: Sample, cut: int) -> int:
    return sum(piece.rows for piece in given.pieces if piece.end <= cut)


def check_flips(given: Sample, path: Path, count: int, seed: int) -> None:
    rng = random.Random(seed)
    largest = max(piece.rows for piece in given.pieces)
    for _ in range(count):
        place, bit = rng.randrange(len(given.content)), rng.randrange(8)
        found = salvage(path, flipped(given.content, place, bit))
        assert found.wrong_trusted == 0, (place, bit)
        assert len(found.trusted) >= given.rows - largest, (place, bit)
        if len(found.trusted) < given.rows:
            assert found.loss.reasons, (place, bit)


def check_cuts(given: Sample, path: Path, count: int, seed: int) -> None:
    rng = random.Random(seed)
    for _ in range(count):
        cut = rng.randrange(9, len(given.content))
        found = salvage(path, given.content[:cut])
        assert found.wrong_trusted == found.wrong_suspect == 0, cut
        assert len(found.trusted) == least_after_cut(given, cut), cut
        assert found.loss.reasons


@pytest.mark.parametrize("codec", CODECS)
def test_flips(codec: str, path: Path) -> None:
    check_flips(sample(codec, 600, 3_000), path, 300, 1)


@pytest.mark.parametrize("codec", CODECS)
def test_cuts(codec: str, path: Path) -> None:
    check_cuts(sample(codec, 600, 3_000), path, 100, 2)


@pytest.mark.slow
@pytest.mark.usefixtures("little_memory")
@pytest.mark.parametrize("codec", CODECS)
def test_many_flips(codec: str, path: Path) -> None:
    check_flips(sample(codec, 4_000, 16_000), path, 2_000, 3)


@pytest.mark.slow
@pytest.mark.usefixtures("little_memory")
@pytest.mark.parametrize("codec", CODECS)
def test_many_cuts(codec: str, path: Path) -> None:
    check_cuts(sample(codec, 4_000, 16_000), path, 500, 4)


Recorder = Callable[[str, object], None]


@pytest.mark.parametrize("codec", [*CODECS, "unchunked"])
def test_flips_without_checksums(codec: str, path: Path, record_property: Recorder) -> None:
    """No reader can notice every one; the file is read on, and the rate of wrong samples is told."""
    given = sample(codec, 600, 3_000, crc=False)
    rng = random.Random(5)
    wrong = 0
    for _ in range(60):
        found = salvage(path, flipped(given.content, rng.randrange(len(given.content)), rng.randrange(8)))
        wrong += found.wrong_trusted > 0
        largest = max((piece.rows for piece in given.pieces), default=20)
        assert found.kept >= given.rows - largest - 1
    record_property("flips that gave a wrong sample", wrong)


def test_random_bytes_in_the_file(path: Path) -> None:
    rng = random.Random(6)
    for codec in CODECS:
        given = sample(codec, 600, 3_000)
        for _ in range(40):
            start = rng.randrange(len(given.content))
            burst = rng.randbytes(rng.choice([2, 8, 200, 4_000]))
            content = replaced(given.content, start, burst)[: len(given.content)]
            found = salvage(path, content, threads=rng.choice([1, 2]))
            assert found.wrong_trusted == 0
            hit = [p for p in given.pieces if p.position < start + len(burst) and start < p.end + 1000]
            assert len(found.trusted) >= given.rows - sum(piece.rows for piece in hit)
