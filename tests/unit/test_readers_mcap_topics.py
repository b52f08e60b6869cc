"""One topic of a log of several: its messages by the index where that can be verified, by a walk where not."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer

from flexid_cli.readers import mcap_chunk
from flexid_cli.readers.base import RawLog, ReadOptions
from flexid_cli.readers.mcap_records import MESSAGE, MESSAGE_INDEX, RECORD, Located, by_picks
from flexid_cli.readers.registry import read_log

WANTED = "/drive.q"
ROWS = 900
START = 1_700_000_000_000_000_000
STEP = 1_000_000


def written(path: Path) -> Path:
    """Write a log of three topics; the second has messages of changing length between those of the first."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=1 << 13, compression=CompressionType.NONE)
        writer.start()
        schema = writer.register_schema("test_msgs/msg/Drive", "ros2msg", b"float64 q")
        text = writer.register_schema("test_msgs/msg/Text", "ros2msg", b"string text")
        drive = writer.register_channel("/drive", "cdr", schema)
        other = writer.register_channel("/text", "cdr", text)
        third = writer.register_channel("/drive_2", "cdr", schema)
        for row in range(ROWS):
            at = START + row * STEP
            writer.add_message(drive, at, b"\0\1\0\0" + struct.pack("<d", row), at)
            content = b"x" * (row % 17)
            size = struct.pack("<I", len(content) + 1)
            writer.add_message(other, at + 1, b"\0\1\0\0" + size + content + b"\0", at + 1)
            if row % 3 == 0:
                writer.add_message(third, at + 2, b"\0\1\0\0" + struct.pack("<d", -row), at + 2)
        writer.finish()
    return path


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return written(tmp_path / "run.mcap")


@pytest.fixture
def picked(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Whether the index was enough, chunk by chunk."""
    found: list[bool] = []

    def spy(buffer: bytes, index: bytes, picks: list[tuple[int, int, int]]) -> Located | None:
        located = by_picks(buffer, index, picks)
        found.append(located is not None)
        return located

    monkeypatch.setattr(mcap_chunk, "by_picks", spy)
    return found


def assert_whole(log: RawLog, source: str = WANTED) -> None:
    channel = log.channels[source]
    step = 1 if source == WANTED else 3
    rows = np.arange(0, ROWS, step)
    np.testing.assert_array_equal(channel.values, rows if step == 1 else -rows)
    np.testing.assert_array_equal(channel.stamps["log_time"], START + rows * STEP + (0 if step == 1 else 2))
    assert log.damage[0].suspect == log.damage[0].lost == 0


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_the_index_is_enough(path: Path, picked: list[bool], threads: int) -> None:
    log = read_log([path], [WANTED], options=ReadOptions(threads=threads))
    assert_whole(log)
    assert not log.damage[0].reasons
    assert len(picked) > 3
    assert all(picked)


def test_two_of_three_topics_come_out_whole_and_in_order(path: Path, picked: list[bool]) -> None:
    log = read_log([path], [WANTED, "/drive_2.q"])
    assert_whole(log)
    both = log.channels["/drive_2.q"]
    np.testing.assert_array_equal(both.values, -np.arange(0, ROWS, 3))
    assert all(picked)


def index_of(content: bytes, channel: int) -> int:
    """Return the place of the first entry of the first message index record of a channel."""
    place = content.find(struct.pack("<BQ", MESSAGE_INDEX, 0)[:1], 9)
    while True:
        opcode, length = RECORD.unpack_from(content, place)
        inner = int.from_bytes(content[place + 11 : place + 15], "little")
        number = int.from_bytes(content[place + 9 : place + 11], "little")
        if (opcode, number) == (MESSAGE_INDEX, channel) and inner == length - 6 and inner % 16 == 0:
            return place + 15
        place = content.find(bytes([MESSAGE_INDEX]), place + 1)


@pytest.mark.parametrize("channel", [1, 2, 3])
@pytest.mark.parametrize("byte", [*range(24), 33, 40])
def test_a_wrong_byte_in_the_index_loses_nothing(
    path: Path, picked: list[bool], channel: int, byte: int
) -> None:
    content = bytearray(path.read_bytes())
    content[index_of(bytes(content), channel) + byte] ^= 0x10
    path.write_bytes(content)
    assert_whole(read_log([path], [WANTED]))
    assert all(picked) == (channel != 1), "only the index of a topic that is wanted is needed"


def test_an_index_that_names_a_message_twice_is_refused() -> None:
    record = bytes([MESSAGE]) + struct.pack("<QHIQQ", 22, 7, 0, 5, 5)
    entries = struct.pack("<qqqq", 5, 0, 5, 0)
    index = struct.pack("<BQHI", MESSAGE_INDEX, 6 + len(entries), 7, len(entries)) + entries
    assert by_picks(record * 2, index, [(7, 0, len(index))]) is None
    entries = struct.pack("<qqqq", 5, 0, 5, len(record))
    index = struct.pack("<BQHI", MESSAGE_INDEX, 6 + len(entries), 7, len(entries)) + entries
    located = by_picks(record * 2, index, [(7, 0, len(index))])
    assert located is not None
    assert located.starts.tolist() == [31, 62]
    assert located.channel == 7


@pytest.mark.parametrize(
    ("field", "value"),
    [("", 0), ("opcode", 6), ("channel", 8), ("log_time", 6), ("length", 21), ("length", 23)],
)
def test_an_index_that_leads_elsewhere_is_refused(field: str, value: int) -> None:
    head = {"opcode": MESSAGE, "length": 22, "channel": 7, "log_time": 5} | ({field: value} if field else {})
    record = struct.pack("<BQHIQQ", head["opcode"], head["length"], head["channel"], 0, head["log_time"], 5)
    entries = struct.pack("<qq", 5, 0)
    index = struct.pack("<BQHI", MESSAGE_INDEX, 22, 7, 16) + entries
    assert (by_picks(record, index, [(7, 0, len(index))]) is None) == bool(field)


def test_a_message_that_is_damaged_in_its_chunk_is_not_trusted(path: Path) -> None:
    content = bytearray(path.read_bytes())
    place = bytes(content).find(struct.pack("<d", 123.0))
    content[place + 6] ^= 1
    path.write_bytes(content)
    log = read_log([path], [WANTED])
    values = log.channels[WANTED].values
    assert set(values.tolist()) <= set(range(ROWS))
    assert log.damage[0].suspect > 0
    assert log.damage[0].trusted == values.size == ROWS - log.damage[0].suspect
