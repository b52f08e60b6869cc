"""Damaged rosbag2 sqlite3 files and ROS 1 bags: nothing is lost beyond the damage, and nothing wrong is trusted."""

from __future__ import annotations

import random
import shutil
import sqlite3
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard

from flexid_cli.errors import FlexidError, InputError
from flexid_cli.readers.base import RawLog, ReadOptions, Window
from flexid_cli.readers.registry import list_channels, read_log
from flexid_cli.readers.rosbag1 import Rosbag1Reader
from flexid_cli.readers.sqlite_storage import SqliteFile
from flexid_cli.writers.registry import write_log
from flexid_cli.writers.table import LogTable

SOURCES = ("/joint_states/motor/position", "/joint_states/motor/effort", "/joint_states/joint/position")
ROWS = 3000
FLIPS, CUTS = (12, 6)
MANY_FLIPS, MANY_CUTS = (2000, 500)
CONTAINERS = ("sqlite3", "bag none", "bag lz4", "bag lz4 checksum", "bag bz2")


def make_table(rows: int = ROWS) -> LogTable:
    """A drive that swings and rests, with encoder steps and noise: what a plausibility check has to live with."""
    time = np.arange(rows) * 1e-3
    rng = np.random.default_rng(5)
    motor = np.round(40 * np.sin(2.1 * time) * (time > 0.2) / 1e-3) * 1e-3
    effort = 0.3 * np.sign(np.cos(2.1 * time)) + 0.05 * rng.normal(size=rows)
    joint = motor / 50 + 1e-5 * rng.normal(size=rows)
    stamps = (np.arange(rows) * 1_000_000 + 1_700_000_000_000_000_123).astype(np.int64)
    return LogTable(stamps, dict(zip(SOURCES, (motor, effort, joint), strict=True)))


TABLE = make_table()


def write_bag(path: Path, codec: str) -> None:
    """A ROS 1 bag of small chunks, by the rosbags package."""
    from lz4.frame import compress
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    types = store.types
    writer = Writer(path)
    writer.chunk_threshold = 16_000
    if codec != "none":
        writer.set_compression(Writer.CompressionFormat[codec[:3].upper()])
    if "checksum" in codec:  # as the recorder of ROS writes them
        writer.compressor = lambda content: bytes(compress(content, content_checksum=True))
    motor, effort, joint = (TABLE.channels[source] for source in SOURCES)
    nothing = np.array([], dtype=np.float64)
    with writer:
        connection = writer.add_connection("/joint_states", "sensor_msgs/msg/JointState", typestore=store)
        for row, stamp in enumerate(TABLE.stamps_ns.tolist()):
            clock = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
            message = types["sensor_msgs/msg/JointState"](
                header=types["std_msgs/msg/Header"](seq=row, stamp=clock, frame_id="base"),
                name=["motor", "joint"],
                position=np.array([motor[row], joint[row]]),
                velocity=nothing,
                effort=np.array([effort[row], 0.0]),
            )
            data = store.serialize_ros1(message, "sensor_msgs/msg/JointState")
            writer.write(connection, stamp, bytes(data))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The undamaged files by container."""
    folder = tmp_path_factory.mktemp("whole")
    write_log(folder / "log.db3", TABLE)
    contents = {"sqlite3": (folder / "log.db3").read_bytes()}
    for name in CONTAINERS[1:]:
        write_bag(folder / f"{name}.bag", name[4:])
        contents[name] = (folder / f"{name}.bag").read_bytes()
    return contents


def file_of(folder: Path, container: str, content: bytes) -> Path:
    path = folder / ("log.db3" if container == "sqlite3" else "log.bag")
    path.write_bytes(content)
    return path


def read(path: Path, **options: Any) -> RawLog:
    return read_log([path], SOURCES, options=ReadOptions(**options))


def wrong_and_kept(log: RawLog) -> tuple[int, int]:
    """Count the samples that are not those of the table, and the messages that are there."""
    wrong = 0
    for source, channel in log.channels.items():
        times = channel.stamps["log_time"]
        place = np.searchsorted(TABLE.stamps_ns, times).clip(0, ROWS - 1)
        same = (TABLE.stamps_ns[place] == times) & (
            TABLE.channels[source][place].view(np.int64) == channel.values.view(np.int64)
        )
        wrong += int(np.count_nonzero(~same))
    return wrong, min(channel.values.size for channel in log.channels.values())


def account(log: RawLog) -> tuple[int, int, int | None]:
    (damage,) = log.damage
    return damage.trusted, damage.suspect, damage.lost


@pytest.mark.parametrize("container", CONTAINERS)
def test_whole_files_are_read_whole_and_without_a_word(
    container: str, whole: dict[str, bytes], tmp_path: Path
) -> None:
    log = read(file_of(tmp_path, container, whole[container]), strict=True)
    assert wrong_and_kept(log) == (0, ROWS)
    assert account(log) == (ROWS, 0, 0)
    assert log.damage[0].is_harmless
    assert not log.damage[0].reasons
    assert not log.notes


# -- sqlite3: logs.md 3.4 and 3.5

PAGE = 4096


def message_pages(content: bytes) -> list[int]:
    """Numbers from 0 of the pages that hold messages, by SQLite's own walk."""
    root = sqlite_one(content, "SELECT rootpage FROM sqlite_master WHERE name = 'messages'")
    interior = content[(root - 1) * PAGE : root * PAGE]
    assert interior[0] == 5
    count = int.from_bytes(interior[3:5], "big")
    cells = [int.from_bytes(interior[12 + 2 * k : 14 + 2 * k], "big") for k in range(count)]
    pages = [int.from_bytes(interior[cell : cell + 4], "big") for cell in cells]
    return [page - 1 for page in (*pages, int.from_bytes(interior[8:12], "big"))]


def sqlite_one(content: bytes, query: str) -> Any:
    database = sqlite3.connect(":memory:")
    database.deserialize(content)
    try:
        return database.execute(query).fetchone()[0]
    finally:
        database.close()


def cells_of(content: bytes, page: int) -> int:
    return int.from_bytes(content[page * PAGE + 3 : page * PAGE + 5], "big")


def with_page(content: bytes, page: int, new: bytes) -> bytes:
    return content[: page * PAGE] + new.ljust(PAGE, b"\x00") + content[(page + 1) * PAGE :]


def test_zeroed_pages_lose_their_own_rows_only(whole: dict[str, bytes], tmp_path: Path) -> None:
    content = whole["sqlite3"]
    pages = random.Random(2).sample(message_pages(content)[1:-1], 10)
    lost = sum(cells_of(content, page) for page in pages)
    for page in pages:
        content = with_page(content, page, b"")
    path = file_of(tmp_path, "sqlite3", content)
    log = read(path)
    assert wrong_and_kept(log) == (0, ROWS - lost)
    assert account(log) == (ROWS - lost, 0, lost)
    with pytest.raises(InputError):
        read(path, strict=True)
    assert list_channels([path])[0].count == ROWS - lost


@pytest.mark.parametrize("what", ["zeros", "noise", "head only"])
def test_first_page_destroyed_loses_nothing(what: str, whole: dict[str, bytes], tmp_path: Path) -> None:
    content = whole["sqlite3"]
    noise = random.Random(3).randbytes(PAGE)
    if what == "head only":
        content = noise[:100] + content[100:]
    else:
        content = with_page(content, 0, b"" if what == "zeros" else noise)
    folder = tmp_path / "bag"
    folder.mkdir()
    file_of(folder, "sqlite3", content)
    log = read(folder)
    assert wrong_and_kept(log) == (0, ROWS)
    assert log.damage[0].reasons


def test_root_of_the_messages_destroyed_loses_nothing(whole: dict[str, bytes], tmp_path: Path) -> None:
    content = whole["sqlite3"]
    root = sqlite_one(content, "SELECT rootpage FROM sqlite_master WHERE name = 'messages'")
    log = read(file_of(tmp_path, "sqlite3", with_page(content, root - 1, b"")))
    assert wrong_and_kept(log) == (0, ROWS)


@pytest.mark.parametrize("fraction", [0.2, 0.5, 0.51, 0.9])
def test_truncated_database_gives_what_is_there(
    fraction: float, whole: dict[str, bytes], tmp_path: Path
) -> None:
    content = whole["sqlite3"]
    size = round(len(content) * fraction)
    there = sum(cells_of(content, page) for page in message_pages(content) if (page + 1) * PAGE <= size)
    log = read(file_of(tmp_path, "sqlite3", content[:size]))
    assert wrong_and_kept(log) == (0, there)
    assert log.damage[0].lost is None
    assert log.damage[0].lost_bytes


def test_topics_destroyed_is_one_error(whole: dict[str, bytes], tmp_path: Path) -> None:
    content = whole["sqlite3"]
    root = sqlite_one(content, "SELECT rootpage FROM sqlite_master WHERE name = 'topics'")
    with pytest.raises(InputError, match="topics"):
        read(file_of(tmp_path, "sqlite3", with_page(content, root - 1, b"")))


def wal_recording(folder: Path, content: bytes, merged: int) -> tuple[bytes, bytes]:
    """The files of a recorder that was killed: ``merged`` rows in the database, the others in its -wal."""
    path = folder / "live.db3"
    path.write_bytes(content)
    database = sqlite3.connect(path, isolation_level=None)
    rows = database.execute("SELECT * FROM messages WHERE id > ?", (merged,)).fetchall()
    database.execute("DELETE FROM messages WHERE id > ?", (merged,))
    database.execute("VACUUM")
    database.execute("PRAGMA journal_mode = WAL")
    database.execute("PRAGMA wal_autocheckpoint = 0")
    for start in range(0, len(rows), 100):
        database.execute("BEGIN")
        database.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows[start : start + 100])
        database.execute("COMMIT")
    files = path.read_bytes(), Path(f"{path}-wal").read_bytes()
    database.close()
    return files


def test_wal_is_read_whole_and_nothing_is_written(whole: dict[str, bytes], tmp_path: Path) -> None:
    main, wal = wal_recording(tmp_path, whole["sqlite3"], 1000)
    folder = tmp_path / "killed"
    folder.mkdir()
    (folder / "log.db3").write_bytes(main)
    (folder / "log.db3-wal").write_bytes(wal)
    log = read(folder / "log.db3")
    assert wrong_and_kept(log) == (0, ROWS)
    assert log.damage[0].is_harmless
    assert "log.db3-wal" in log.notes[0].message
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == {
        "log.db3": main,
        "log.db3-wal": wal,
    }
    (folder / "log.db3-wal").unlink()
    assert wrong_and_kept(read(folder / "log.db3")) == (0, 1000)


def test_damaged_wal_gives_its_first_part_and_says_so(whole: dict[str, bytes], tmp_path: Path) -> None:
    main, wal = wal_recording(tmp_path, whole["sqlite3"], 1000)
    changed = bytearray(wal)
    changed[len(wal) // 2] ^= 4
    (tmp_path / "log.db3").write_bytes(main)
    (tmp_path / "log.db3-wal").write_bytes(changed)
    log = read(tmp_path / "log.db3")
    wrong, kept = wrong_and_kept(log)
    assert wrong == 0
    assert 1000 < kept < ROWS
    assert log.damage[0].lost is None
    assert "log.db3-wal" in log.damage[0].reasons[0]
    # a database whose first page is gone too: SQLite refuses both
    (tmp_path / "log.db3").write_bytes(with_page(main, 0, b""))
    changed_kept = kept
    wrong, kept = wrong_and_kept(read(tmp_path / "log.db3"))
    assert wrong == 0
    assert kept == changed_kept
    (tmp_path / "log.db3-wal").write_bytes(wal)
    assert wrong_and_kept(read(tmp_path / "log.db3")) == (0, ROWS)


def test_truncated_file_compression_gives_the_rows_before_the_cut(tmp_path: Path) -> None:
    write_log(tmp_path / "bag", TABLE)
    (storage,) = (tmp_path / "bag").glob("*.db3")
    packed = zstandard.compress(storage.read_bytes())
    storage.with_suffix(".db3.zstd").write_bytes(packed[: len(packed) * 2 // 3])
    storage.unlink()
    (tmp_path / "bag" / "metadata.yaml").unlink()
    log = read(tmp_path / "bag")
    wrong, kept = wrong_and_kept(log)
    assert wrong == 0
    assert ROWS // 4 < kept < ROWS
    assert any("zstd" in reason for reason in log.damage[0].reasons)


def batches_of(path: Path, window: Window | None = None) -> list[tuple[str, int, bytes]]:
    with ExitStack() as stack:
        file = SqliteFile(path, path, stack)
        found = []
        for batch in file.batches(lambda _: True, window or Window()):
            for start, length, time in zip(
                batch.starts.tolist(), batch.lengths.tolist(), batch.log_time.tolist(), strict=True
            ):
                found.append((batch.kind.topic, time, batch.buffer[start : start + length].tobytes()))
        assert not file.loss.any
    return found


@pytest.mark.parametrize("page_size", [512, 1024, 4096, 65536])
@pytest.mark.parametrize("seed", range(3))
def test_pages_give_what_sqlite_gives(page_size: int, seed: int, tmp_path: Path) -> None:
    """Rows of all sizes, chains of pages, gaps in the numbers, deleted rows, integers of all widths."""
    rng = random.Random(seed)
    path = tmp_path / "any.db3"
    database = sqlite3.connect(path, isolation_level=None)
    database.execute(f"PRAGMA page_size = {page_size}")
    database.execute(f"PRAGMA auto_vacuum = {seed % 2}")
    database.execute(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)"
    )
    extra = ", note TEXT" if seed == 1 else ""
    database.execute(
        f"CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB{extra})"
    )
    if seed != 2:
        database.execute("CREATE INDEX timestamp_idx ON messages (timestamp ASC)")
    database.executemany(
        "INSERT INTO topics VALUES (?, ?, 'a/msg/B', 'cdr')", [(1, "/a"), (2, "/b"), (300, "/c")]
    )
    database.execute("BEGIN")
    number = 0
    for row in range(1500):
        number += rng.choice([1, 1, 1, 1, 3, 200])
        size = rng.choice([0, 8, 44, 44, 44, 300, 300, rng.randrange(2000), rng.randrange(20_000)])
        time = rng.choice([row, row * 1_000_000, 1_700_000_000_000_000_000 + row * 1000, -row])
        values = (number, rng.choice([1, 1, 2, 300]), time, rng.randbytes(size), "x" * (row % 40))
        marks = ", ".join("?" * (5 if seed == 1 else 4))
        database.execute(f"INSERT INTO messages VALUES ({marks})", values[: 5 if seed == 1 else 4])
    database.execute("COMMIT")
    database.execute("DELETE FROM messages WHERE id % 7 = 0 OR (id > 4000 AND id < 9000)")
    names = {1: "/a", 2: "/b", 300: "/c"}

    def by_sqlite(where: str = "1") -> dict[str, list[tuple[int, bytes]]]:
        rows = database.execute(f"SELECT topic_id, timestamp, data FROM messages WHERE {where} ORDER BY id")
        return by_topic((names[topic], time, data) for topic, time, data in rows)

    assert by_topic(batches_of(path)) == by_sqlite()
    low, high = 500_000_000, 1_700_000_000_000_700_000
    inside = f"timestamp >= {low} AND timestamp < {high}"
    assert by_topic(batches_of(path, Window(low, high))) == by_sqlite(inside)
    database.close()


def by_topic(rows: Any) -> dict[str, list[tuple[int, bytes]]]:
    found: dict[str, list[tuple[int, bytes]]] = {}
    for topic, time, data in rows:
        found.setdefault(topic, []).append((time, data))
    return found


# -- ROS 1: logs.md 3.3

BAGS = CONTAINERS[1:]


def chunk_positions(content: bytes) -> list[int]:
    """Positions of the chunks' records, found without the project's reader."""
    positions, at = [], 13
    while at < len(content):
        length = int.from_bytes(content[at : at + 4], "little")
        data = int.from_bytes(content[at + 4 + length : at + 8 + length], "little")
        if b"op=\x05" in content[at : at + 4 + length]:
            positions.append(at)
        at += 8 + length + data
    return positions


def never_closed(content: bytes) -> bytes:
    """As a recorder leaves the file that is killed: no index position, and nothing after the last chunk's index."""
    start = content.index(b"index_pos=") + 10
    index = int.from_bytes(content[start : start + 8], "little")
    return content[:start] + bytes(8) + content[start + 8 : index]


@pytest.mark.parametrize("container", BAGS)
def test_bag_never_closed_is_read_whole(container: str, whole: dict[str, bytes], tmp_path: Path) -> None:
    path = file_of(tmp_path, container, never_closed(whole[container]))
    log = read(path)
    assert wrong_and_kept(log) == (0, ROWS)
    assert "not closed" in log.notes[0].message
    assert {info.source: info.count for info in list_channels([path])}[SOURCES[0]] == ROWS


@pytest.mark.parametrize("container", BAGS)
@pytest.mark.parametrize("fraction", [0.1, 0.5, 0.97])
def test_truncated_bag_gives_all_before_the_cut(
    container: str, fraction: float, whole: dict[str, bytes], tmp_path: Path
) -> None:
    content = whole[container]
    size = round(len(content) * fraction)
    positions = chunk_positions(content)
    chunk = ROWS / len(positions)
    before = sum(position < size for position in positions[1:])  # whole chunks before the one that is cut
    log = read(file_of(tmp_path, container, content[:size]))
    wrong, kept = wrong_and_kept(log)
    assert wrong == 0
    assert kept >= before * chunk * 0.98 - 1
    if size < content.index(b"op=\x06"):
        assert log.damage[0].lost is None


@pytest.mark.parametrize("codec", ["none", "lz4", "bz2"])
@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("threads", [1, 2])
def test_mixed_topics_give_what_rosbags_gives(codec: str, closed: bool, threads: int, tmp_path: Path) -> None:
    """Several connections by turns, of any size down to none at the very end of a chunk."""
    from rosbags.rosbag1 import Reader, Writer

    rng = random.Random(8)
    path = tmp_path / "mixed.bag"
    writer = Writer(path)
    writer.chunk_threshold = 5000
    if codec != "none":
        writer.set_compression(Writer.CompressionFormat[codec.upper()])
    with writer:
        connections = [
            writer.add_connection(f"/topic{k}", "a/msg/B", msgdef="uint8[] data", md5sum="0" * 32)
            for k in range(4)
        ]
        for row in range(2000):
            k = rng.choice([0, 0, 0, 1, 2, 3])
            size = (44, rng.randrange(300), 0, rng.choice([1, 2, 2000]))[k]
            writer.write(connections[k], 10**18 + row * 1000 + rng.randrange(900), rng.randbytes(size))
    with Reader(path) as reader:
        expected = by_topic((one.topic, time, bytes(data)) for one, time, data in reader.messages())
    if not closed:
        path.write_bytes(never_closed(path.read_bytes()))
    with Rosbag1Reader().open_files([path], ReadOptions(threads=threads)) as ((file,), _):
        found = []
        for batch in file.batches(lambda topic: topic != "/topic1", Window()):
            for start, length, time in zip(batch.starts, batch.lengths, batch.log_time.tolist(), strict=True):
                content = batch.buffer[start : start + length].tobytes()
                found.append((batch.kind.topic, time, content))
        assert not file.loss.any
    del expected["/topic1"]
    assert by_topic(found) == expected


def test_cut_plain_chunk_gives_its_first_messages(whole: dict[str, bytes], tmp_path: Path) -> None:
    content = whole["bag none"]
    start, stop = chunk_positions(content)[2:4]
    half = read(file_of(tmp_path, "bag none", content[: (start + stop) // 2]))
    _, kept = wrong_and_kept(half)
    chunk = ROWS / len(chunk_positions(content))
    assert kept == pytest.approx(2.5 * chunk, rel=0.1)


Change = Callable[[bytearray, int], None]


def wrong_length(content: bytearray, at: int) -> None:
    place = at + 4 + int.from_bytes(content[at : at + 4], "little")
    content[place : place + 4] = (0x7FFFFFFF).to_bytes(4, "little")


def longer_by_one(content: bytearray, at: int) -> None:
    place = at + 4 + int.from_bytes(content[at : at + 4], "little")
    content[place] ^= 1


def wrong_size(content: bytearray, at: int) -> None:
    place = content.index(b"size=", at) + 5
    content[place : place + 4] = (0xFFFFFFFF).to_bytes(4, "little")


def unknown_codec(content: bytearray, at: int) -> None:
    place = content.index(b"compression=", at) + 12
    content[place : place + 3] = b"xyz"


def wrong_op(content: bytearray, at: int) -> None:
    content[content.index(b"op=", at) + 3] = 0x45


def wrong_header_length(content: bytearray, at: int) -> None:
    content[at + 1] = 0xEE


def zeroed(content: bytearray, at: int) -> None:
    content[at : at + 300] = bytes(300)


def wrong_index(content: bytearray, at: int) -> None:
    place = content.index(b"op=\x04", at) + 60
    content[place : place + 40] = bytes(40)


@pytest.mark.parametrize("container", BAGS)
@pytest.mark.parametrize(
    "change",
    [
        wrong_length,
        longer_by_one,
        wrong_size,
        unknown_codec,
        wrong_op,
        wrong_header_length,
        zeroed,
        wrong_index,
    ],
)
def test_damaged_framing_costs_one_chunk_at_most(
    container: str, change: Change, whole: dict[str, bytes], tmp_path: Path
) -> None:
    content = bytearray(whole[container])
    positions = chunk_positions(whole[container])
    change(content, positions[3])
    tracemalloc.start()
    log = read(file_of(tmp_path, container, bytes(content)))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    wrong, kept = wrong_and_kept(log)
    assert wrong == 0
    assert kept >= ROWS - 1.1 * ROWS / len(positions) - 2
    assert log.damage[0].reasons
    assert peak < 100e6


@pytest.mark.parametrize("container", BAGS)
def test_garbage_and_zeros_at_the_end(container: str, whole: dict[str, bytes], tmp_path: Path) -> None:
    for tail in (random.Random(4).randbytes(5000), bytes(100_000)):
        log = read(file_of(tmp_path, container, whole[container] + tail))
        assert wrong_and_kept(log) == (0, ROWS)
        assert log.damage[0].reasons


def test_time_window_reads_only_its_chunks(whole: dict[str, bytes], tmp_path: Path) -> None:
    for container in CONTAINERS:
        log = read(file_of(tmp_path, container, whole[container]), start_s=1.0, end_s=1.25)
        times = log.channels[SOURCES[0]].stamps["log_time"]
        first = TABLE.stamps_ns[0]
        assert times.size == 250
        assert first + 10**9 <= times.min()
        assert times.max() < first + 1_250_000_000
        assert wrong_and_kept(log)[0] == 0


# -- flips and cuts at random places


def flips(content: bytes, count: int, seed: int) -> Iterator[bytes]:
    rng = random.Random(seed)
    for _ in range(count):
        changed = bytearray(content)
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
        yield bytes(changed)


def outcome(path: Path) -> tuple[int, int] | None:
    """Wrong trusted samples and kept messages, or None for one of the project's own errors."""
    try:
        list_channels([path])
        return wrong_and_kept(read(path))
    except FlexidError:
        return None


def try_flips(container: str, content: bytes, folder: Path, count: int) -> dict[str, float]:
    """Flip bits; return the share of flips that pass wrong samples, those refused, and the fewest messages."""
    found = [outcome(file_of(folder, container, changed)) for changed in flips(content, count, 17)]
    read_ = [one for one in found if one is not None]
    return {
        "wrong": sum(wrong > 0 for wrong, _ in read_) / count,
        "refused": found.count(None) / count,
        "least": min(kept for _, kept in read_),
    }


def try_cuts(container: str, content: bytes, folder: Path, count: int) -> None:
    rng = random.Random(19)
    for _ in range(count):
        size = rng.randrange(len(content))
        found = outcome(file_of(folder, container, content[:size]))
        if found is None:
            assert size < 0.06 * len(content) + 40_000
        else:
            assert found[0] == 0


def most_wrong(container: str, content: bytes, flip_count: int) -> float:
    """The largest share of flips that may pass a wrong sample, with four standard deviations of chance.

    None may where a checksum is stored. Where none is, a flip in the log time or in one of the three numbers of a
    message may pass, and no other: what is left of the file is structure, or nothing that was asked for. In
    packed bytes without a checksum any flip may be one in a number.
    """
    if container in {"bag lz4 checksum", "bag bz2"}:
        return 0.0
    share = 1.0 if container == "bag lz4" else min(1.0, ROWS * 8 * (1 + len(SOURCES)) / len(content))
    return share + 4 * float(np.sqrt(share * (1 - share) / flip_count))


def check_random_damage(
    container: str, content: bytes, folder: Path, flip_count: int, cut_count: int
) -> dict[str, float]:
    found = try_flips(container, content, folder, flip_count)
    assert found["wrong"] <= most_wrong(container, content, flip_count)
    assert found["refused"] <= 0.05
    assert found["least"] >= ROWS * 0.85
    try_cuts(container, content, folder, cut_count)
    return found


@pytest.mark.usefixtures("little_memory")
@pytest.mark.parametrize("container", CONTAINERS)
def test_flips_and_cuts(container: str, whole: dict[str, bytes], tmp_path: Path) -> None:
    check_random_damage(container, whole[container], tmp_path, FLIPS, CUTS)


@pytest.mark.slow
@pytest.mark.usefixtures("little_memory")
@pytest.mark.parametrize("container", CONTAINERS)
def test_many_flips_and_cuts(container: str, whole: dict[str, bytes], tmp_path: Path) -> None:
    found = check_random_damage(container, whole[container], tmp_path, MANY_FLIPS, MANY_CUTS)
    print(f"\n{container}: {found}, at most {most_wrong(container, whole[container], MANY_FLIPS):.3f} wrong")


def test_copies_of_a_folder_are_left_alone(whole: dict[str, bytes], tmp_path: Path) -> None:
    """Reading a damaged folder changes nothing in it."""
    folder = tmp_path / "bag"
    write_log(folder, TABLE)
    (storage,) = folder.glob("*.db3")
    storage.write_bytes(storage.read_bytes()[: len(whole["sqlite3"]) // 2])
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    read(folder)
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == {
        file.name: file.read_bytes() for file in copy.iterdir()
    }


# -- what is lost becomes a gap, however short


def spans_of(log: RawLog) -> list[tuple[int, int]]:
    """Rows before and after each stretch that the account gives, as numbers of the table."""
    (damage,) = log.damage
    return [(round(first * 1e3), round(end * 1e3)) for first, end in damage.spans_s]


def missing_of(log: RawLog) -> list[tuple[int, int]]:
    times = log.channels[SOURCES[0]].stamps["log_time"]
    rows = np.searchsorted(TABLE.stamps_ns, times)
    places = np.flatnonzero(np.diff(rows) > 1)
    return [(int(rows[place]), int(rows[place + 1])) for place in places]


def test_lost_rows_of_a_database_are_told_with_their_times(whole: dict[str, bytes], tmp_path: Path) -> None:
    content = whole["sqlite3"]
    for page in message_pages(content)[5::9]:
        content = with_page(content, page, b"")
    log = read(file_of(tmp_path, "sqlite3", content))
    assert len(missing_of(log)) > 3
    assert spans_of(log) == missing_of(log)


@pytest.mark.parametrize("container", BAGS)
@pytest.mark.parametrize("change", [wrong_length, unknown_codec, wrong_op, zeroed])
def test_lost_messages_of_a_bag_are_told_with_their_times(
    container: str, change: Change, whole: dict[str, bytes], tmp_path: Path
) -> None:
    content = bytearray(whole[container])
    for position in chunk_positions(whole[container])[3:12:4]:
        change(content, position)
    log = read(file_of(tmp_path, container, bytes(content)))
    if log.damage[0].lost != 0 or log.damage[0].suspect:
        assert missing_of(log)
    assert set(missing_of(log)) <= set(spans_of(log))


def test_one_message_lost_in_a_plain_chunk_is_told_with_its_time(
    whole: dict[str, bytes], tmp_path: Path
) -> None:
    content = bytearray(whole["bag none"])
    place = content.index(TABLE.channels[SOURCES[0]][700].tobytes()) - 70
    content[place : place + 30] = bytes(30)
    log = read(file_of(tmp_path, "bag none", bytes(content)))
    assert 0 < ROWS - log.channels[SOURCES[0]].values.size < 5
    assert spans_of(log) == missing_of(log)
    assert len(spans_of(log)) == 1


@pytest.mark.parametrize("container", ["sqlite3", "bag none"])
def test_a_sample_in_doubt_is_told_with_its_time(
    container: str, whole: dict[str, bytes], tmp_path: Path
) -> None:
    content = bytearray(whole[container])
    value = TABLE.channels[SOURCES[1]][700].tobytes()
    place = content.index(value)
    content[place + 7] ^= 0x40  # the highest bit of the exponent
    log = read(file_of(tmp_path, container, bytes(content)))
    assert account(log) == (ROWS - 1, 1, 0)
    assert spans_of(log) == [(699, 701)]
    kept = read(file_of(tmp_path, container, bytes(content)), keep_suspect=True)
    assert spans_of(kept) == [(699, 701)]
    assert kept.channels[SOURCES[1]].values.size == ROWS


@pytest.mark.parametrize("container", BAGS)
@pytest.mark.parametrize("bit", [7, 13, 17, 20, 31])
def test_a_wrong_length_of_an_index_hides_no_chunk(
    container: str, bit: int, whole: dict[str, bytes], tmp_path: Path
) -> None:
    """It is told, and the chunks that it leads over are read."""
    content = bytearray(whole[container])
    head = content.index(b"op=\x04", chunk_positions(whole[container])[3])
    place = content.index(b"count=", head) + 10
    assert int.from_bytes(content[place : place + 4], "little") % 12 == 0
    content[place + bit // 8] ^= 1 << bit % 8
    log = read(file_of(tmp_path, container, bytes(content)))
    assert wrong_and_kept(log) == (0, ROWS)
    assert log.damage[0].reasons
