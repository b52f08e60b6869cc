"""One suite that every reader passes: the same recording in every container gives the same numbers."""

from __future__ import annotations

import json
import random
import shutil
import sqlite3
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter

from flexid_cli.errors import InputError
from flexid_cli.readers.base import RawLog, Reader
from flexid_cli.readers.registry import list_channels, open_reader, read_log, readers
from flexid_cli.writers.registry import write_log
from flexid_cli.writers.table import LogTable

SOURCES = (
    "/joint_states/motor/position",
    "/joint_states/motor/effort",
    "/joint_states/joint/position",
    "/joint_states/reference/position",
)
ROWS = 160
JOINT_STATE = """std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


def make_table(first: int = 0, last: int = ROWS) -> LogTable:
    rng = np.random.default_rng(7)
    values = {source: rng.normal(size=ROWS) * 10.0 ** rng.integers(-9, 9, ROWS) for source in SOURCES}
    values[SOURCES[2]][[0, 11, ROWS - 1]] = np.nan
    values[SOURCES[0]][:3] = [0.1 + 0.2, 5e-324, -0.0]
    stamps = (np.arange(ROWS) * 2_850_059 + 1_700_000_000_123_456_789).astype(np.int64)
    return LogTable(stamps[first:last], {name: one[first:last] for name, one in values.items()})


TABLE = make_table()
Maker = Callable[[Path, LogTable], Path]


def by_writer(name: str, **options: Any) -> Maker:
    def make(folder: Path, table: LogTable) -> Path:
        write_log(folder / name, table, **options)
        return folder / name

    return make


def joint_state_bytes(store: Any, table: LogTable, row: int, *, order: int = 1, little: bool = True) -> bytes:
    """A JointState built without the project's writers; ``order`` -1 turns the names round."""
    types = store.types
    joints = ("motor", "joint", "reference")[::order]

    def array(field: str) -> np.ndarray:
        absent = np.full(table.stamps_ns.size, np.nan)
        return np.array(
            [table.channels.get(f"/joint_states/{joint}/{field}", absent)[row] for joint in joints]
        )

    stamp = int(table.stamps_ns[row])
    header_type = types["std_msgs/msg/Header"]
    counted = {"seq": row} if "seq" in header_type.__dataclass_fields__ else {}
    message = types["sensor_msgs/msg/JointState"](
        header=header_type(
            **counted,
            stamp=types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9),
            frame_id="base",
        ),
        name=list(joints),
        position=array("position"),
        velocity=np.array([], dtype=np.float64),
        effort=array("effort"),
    )
    if counted:
        return bytes(store.serialize_ros1(message, "sensor_msgs/msg/JointState"))
    return bytes(store.serialize_cdr(message, "sensor_msgs/msg/JointState", little_endian=little))


def ros2_store() -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def mcap_directly(
    *, profile: str = "", big_endian: bool = False, turning: bool = False, **options: Any
) -> Maker:
    """MCAP by the mcap package itself, with messages serialised by rosbags."""

    def make(folder: Path, table: LogTable) -> Path:
        store = ros2_store()
        path = folder / "direct.mcap"
        with path.open("wb") as stream:
            writer = McapWriter(stream, **{"chunk_size": 8_000, **options})
            writer.start(profile=profile)
            schema = writer.register_schema("sensor_msgs/msg/JointState", "ros2msg", JOINT_STATE.encode())
            channel = writer.register_channel("/joint_states", "cdr", schema)
            other = writer.register_channel("/rosout", "cdr", schema)
            for row, stamp in enumerate(table.stamps_ns.tolist()):
                order = -1 if turning and row % 3 == 1 else 1
                data = joint_state_bytes(store, table, row, order=order, little=not big_endian)
                writer.add_message(channel, stamp, data, stamp, row)
                if row % 50 == 0:
                    writer.add_message(other, stamp, data, stamp, row)
            writer.finish()
        return path

    return make


def without_summary(folder: Path, table: LogTable) -> Path:
    return mcap_directly(
        index_types=IndexType.NONE,
        repeat_channels=False,
        repeat_schemas=False,
        use_statistics=False,
        use_summary_offsets=False,
    )(folder, table)


def json_mcap(folder: Path, table: LogTable) -> Path:
    """JSON without a schema, as a logger in any language writes it."""
    path = folder / "json.mcap"
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start()
        channel = writer.register_channel("/joint_states", "json", 0)
        for row, stamp in enumerate(table.stamps_ns.tolist()):
            values = {source: float(values[row]) for source, values in table.channels.items()}
            position = [
                values[f"/joint_states/{joint}/position"] for joint in ("motor", "joint", "reference")
            ]
            message = {
                "header": {"stamp": {"sec": stamp // 10**9, "nsec": stamp % 10**9}},
                "name": ["motor", "joint", "reference"],
                "position": [None if np.isnan(x) else x for x in position],
                "effort": [values["/joint_states/motor/effort"], None, None],
            }
            writer.add_message(channel, stamp, json.dumps(message).encode(), stamp)
        writer.finish()
    return path


def bag_directly(folder: Path, table: LogTable) -> Path:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    path = folder / "direct.bag"
    writer = Writer(path)
    writer.chunk_threshold = 8_000
    with writer:
        connection = writer.add_connection("/joint_states", "sensor_msgs/msg/JointState", typestore=store)
        for row, stamp in enumerate(table.stamps_ns.tolist()):
            writer.write(connection, stamp, joint_state_bytes(store, table, row, order=(-1) ** row))
    return path


def old_db3(folder: Path, table: LogTable) -> Path:
    """A storage file of the first rosbag2 releases: no message definitions, no quality of service."""
    store, path = ros2_store(), folder / "old_0.db3"
    with sqlite3.connect(path) as database:
        database.execute(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)"
        )
        database.execute(
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)"
        )
        database.execute(
            "INSERT INTO topics VALUES (1, '/joint_states', 'sensor_msgs/msg/JointState', 'cdr')"
        )
        rows = [
            (stamp, joint_state_bytes(store, table, row))
            for row, stamp in enumerate(table.stamps_ns.tolist())
        ]
        database.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (1, ?, ?)", rows)
    database.close()
    return path


def without_metadata(maker: Maker) -> Maker:
    def make(folder: Path, table: LogTable) -> Path:
        path = maker(folder, table)
        (path / "metadata.yaml").unlink()
        return path

    return make


def semicolons(folder: Path, table: LogTable) -> Path:
    lines = ["# axis 3", "time [ns];" + ";".join(table.channels)]
    for row, stamp in enumerate(table.stamps_ns.tolist()):
        values = [repr(float(values[row])).replace(".", ",") for values in table.channels.values()]
        lines.append(";".join([str(stamp), *values]))
    path = folder / "german.csv"
    path.write_bytes(("\r\n".join(lines) + "\r\n").encode("utf-16"))
    return path


SAMPLES: dict[str, dict[str, Maker]] = {
    "csv": {
        "plain": by_writer("log.csv"),
        "gzip": by_writer("log.csv.gz"),
        "zstd": by_writer("log.csv.zst"),
        "semicolon, decimal comma, UTF-16, CRLF": semicolons,
    },
    "mcap": {
        "ros2msg": by_writer("log.mcap"),
        "ros2idl lz4": by_writer("log.mcap", encoding="ros2idl", compression="lz4"),
        "ros1 unchunked": by_writer("log.mcap", encoding="ros1", chunked=False),
        "json plain": by_writer("log.mcap", encoding="json", compression="none"),
        "json without schema": json_mcap,
        "mcap package": mcap_directly(profile="ros2"),
        "big-endian": mcap_directly(big_endian=True),
        "turning names": mcap_directly(turning=True, compression=CompressionType.LZ4),
        "no message index": mcap_directly(index_types=IndexType.CHUNK),
        "no summary": without_summary,
        "no checksums": mcap_directly(enable_crcs=False, compression=CompressionType.NONE),
    },
    "rosbag2": {
        "sqlite3": by_writer("folder"),
        "mcap": by_writer("folder", storage="mcap"),
        "sqlite3 file compression": by_writer("folder", compression="file"),
        "mcap file compression": by_writer("folder", storage="mcap", compression="file"),
        "message compression": by_writer("folder", compression="message"),
        "mcap message compression": by_writer("folder", storage="mcap", compression="message"),
        "no metadata": without_metadata(by_writer("folder")),
        "no metadata, file compression": without_metadata(by_writer("folder", compression="file")),
        "no metadata, message compression": without_metadata(by_writer("folder", compression="message")),
        "bare db3": by_writer("log.db3"),
        "old db3": old_db3,
    },
    "rosbag1": {
        "plain": by_writer("log.bag"),
        "lz4": by_writer("log.bag", compression="lz4"),
        "bz2": by_writer("log.bag", compression="bz2"),
        "rosbags package, names turning": bag_directly,
    },
}
CASES = [
    pytest.param(name, maker, id=f"{name}-{what}")
    for name, all_ in SAMPLES.items()
    for what, maker in all_.items()
]
ONE_EACH = {name: next(iter(all_.values())) for name, all_ in SAMPLES.items()}


def reader_named(name: str) -> Reader:
    return next(reader for reader in readers() if reader.name == name)


def head_of(path: Path) -> bytes:
    return b"" if path.is_dir() else path.read_bytes()[:65536]


def assert_same(log: RawLog, table: LogTable) -> None:
    assert list(log.channels) == list(table.channels)
    for source, values in table.channels.items():
        read = log.channels[source].values
        assert read.dtype == np.float64
        both_nan = np.isnan(read) & np.isnan(values)
        assert np.array_equal(
            np.where(both_nan, 0, read.view(np.int64)), np.where(both_nan, 0, values.view(np.int64))
        )
        for times in log.channels[source].stamps.values():
            assert times.dtype == np.int64
            assert np.array_equal(times, table.stamps_ns)


@pytest.mark.parametrize(("name", "maker"), CASES)
def test_identifies_its_own_and_no_other(name: str, maker: Maker, tmp_path: Path) -> None:
    path = maker(tmp_path, make_table(0, 20))
    claimed = [reader.name for reader in readers() if reader.sniff(path, head_of(path))]
    assert claimed == [name]
    assert open_reader([path]).name == name


@pytest.mark.parametrize("name", SAMPLES)
def test_rejects_noise_and_text(name: str, tmp_path: Path) -> None:
    rng = random.Random(3)
    reader = reader_named(name)
    contents = [rng.randbytes(size) for size in (1, 7, 100, 5000)]
    contents += [
        b"Lorem ipsum dolor sit amet,\nconsectetur\n",
        b'{"a": 1}\n',
        b"a: 1\nb:\n  - c\n",
        b"\x00" * 4096,
    ]
    for number, content in enumerate(contents):
        path = tmp_path / f"{number}.dat"
        path.write_bytes(content)
        assert not reader.sniff(path, content)
    (tmp_path / "folder").mkdir()
    assert not reader.sniff(tmp_path / "folder", b"")


@pytest.mark.parametrize(("name", "maker"), CASES)
def test_same_numbers_from_every_container(name: str, maker: Maker, tmp_path: Path) -> None:
    log = read_log([maker(tmp_path, TABLE)], SOURCES)
    assert log.format == name
    assert_same(log, TABLE)
    clocks = set(log.channels[SOURCES[0]].stamps)
    expected = {"csv": set(), "mcap": {"header_stamp", "log_time", "publish_time"}}.get(
        name, {"header_stamp", "log_time"}
    )
    assert clocks - {"publish_time"} == expected - {"publish_time"}


@pytest.mark.parametrize(("name", "maker"), CASES)
def test_channels_agree_with_read(name: str, maker: Maker, tmp_path: Path) -> None:
    path = maker(tmp_path, TABLE)
    infos = {info.source: info for info in list_channels([path])}
    assert set(SOURCES) <= set(infos)
    log = read_log([path], list(infos))
    for source, info in infos.items():
        assert log.channels[source].values.size == info.count, source
    for source in SOURCES:
        assert infos[source].count == ROWS
        for alias in infos[source].aliases[:1]:
            try:
                again = read_log([path], [alias]).channels[alias]
            except InputError as error:
                assert "in some messages" in error.message  # noqa: PT017
                continue
            assert np.array_equal(again.values, log.channels[source].values, equal_nan=True)


@pytest.mark.parametrize(("name", "maker"), CASES)
def test_split_files_equal_the_whole(name: str, maker: Maker, tmp_path: Path) -> None:
    parts = []
    for number, (first, last) in enumerate([(0, 70), (70, 71), (71, ROWS)]):
        folder = tmp_path / str(number)
        folder.mkdir()
        parts.append(maker(folder, make_table(first, last)))
    order = parts if name == "csv" else parts[::-1]
    assert_same(read_log(order, SOURCES), TABLE)


@pytest.mark.parametrize("name", SAMPLES)
def test_missing_channel_names_the_nearest(name: str, tmp_path: Path) -> None:
    path = ONE_EACH[name](tmp_path, make_table(0, 20))
    with pytest.raises(InputError) as caught:
        read_log([path], ["/joint_states/motr/position"])
    assert "/joint_states/motr/position" in caught.value.message
    assert "/joint_states/motor/position" in caught.value.hint
    assert "flexid inspect" in caught.value.hint


@pytest.mark.parametrize("name", SAMPLES)
def test_double_files_and_mixed_formats_are_refused(name: str, tmp_path: Path) -> None:
    path = ONE_EACH[name](tmp_path, make_table(0, 20))
    with pytest.raises(InputError, match="twice"):
        read_log([path, path], SOURCES)
    other = ONE_EACH["mcap" if name != "mcap" else "csv"](tmp_path, make_table(0, 20))
    with pytest.raises(InputError, match="different formats"):
        read_log([path, other], SOURCES)


def storage_of(path: Path) -> Path:
    if not path.is_dir():
        return path
    return next(file for file in path.iterdir() if file.name != "metadata.yaml")


def read_damaged(path: Path) -> RawLog | None:
    """Read a log that may be damaged: it gives numbers or one InputError, never anything else."""
    try:
        list_channels([path])
        return read_log([path], SOURCES)
    except InputError:
        return None


@pytest.mark.parametrize(("name", "maker"), CASES)
def test_truncated_files_give_one_error_or_whole_samples(name: str, maker: Maker, tmp_path: Path) -> None:
    path = maker(tmp_path, TABLE)
    storage = storage_of(path)
    content = storage.read_bytes()
    for cut in (0, 1, 9, len(content) // 2, len(content) - 30, len(content) - 1):
        storage.write_bytes(content[:cut])
        log = read_damaged(path)
        if log is None:
            continue
        for source, values in TABLE.channels.items():
            read = log.channels[source].values
            assert np.array_equal(read, values[: read.size], equal_nan=True)
        if log.channels[SOURCES[0]].values.size < ROWS:
            assert log.notes or not all(one.is_harmless for one in log.damage)


@pytest.mark.parametrize(("name", "maker"), CASES)
def test_random_damage_gives_input_errors_only(name: str, maker: Maker, tmp_path: Path) -> None:
    path = maker(tmp_path, make_table(0, 60))
    storage = storage_of(path)
    content = storage.read_bytes()
    rng = random.Random(11)
    for _ in range(6):
        changed = bytearray(content)
        start = rng.randrange(len(changed))
        for place in range(start, min(start + rng.choice([1, 8, 200]), len(changed))):
            changed[place] = rng.choice([0, 255, rng.randrange(256)])
        storage.write_bytes(changed)
        read_damaged(path)


@pytest.mark.parametrize("what", ["zstd", "none", "unchunked"])
def test_every_bit_flip_in_an_mcap_is_noticed(what: str, tmp_path: Path) -> None:
    """With checksums over every section, no flip goes through as a wrong number."""
    path = tmp_path / "log.mcap"
    table = make_table(0, 60)
    write_log(path, table, compression="none" if what != "zstd" else "zstd", chunked=what != "unchunked")
    content = path.read_bytes()
    rng = random.Random(5)
    for _ in range(60):
        changed = bytearray(content)
        changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
        path.write_bytes(changed)
        log = read_damaged(path)
        if log is not None:
            for source, values in table.channels.items():
                assert np.array_equal(log.channels[source].values, values, equal_nan=True)


@pytest.mark.parametrize("name", SAMPLES)
def test_missing_empty_and_unknown_files(name: str, tmp_path: Path) -> None:
    path = tmp_path / f"nothing{reader_named(name).suffixes[0]}"
    with pytest.raises(InputError, match="there is no file"):
        open_reader([path])
    path.touch()
    with pytest.raises(InputError, match="is empty"):
        open_reader([path])
    path.write_bytes(random.Random(1).randbytes(3000))
    with pytest.raises(InputError):
        list_channels([path])


def test_folder_without_a_bag(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="folder without"):
        open_reader([tmp_path])


def test_no_log_at_all() -> None:
    with pytest.raises(InputError, match="no log"):
        open_reader([])


@pytest.mark.skipif(sys.platform == "win32", reason="permissions")
def test_split_bag_folder(tmp_path: Path) -> None:
    """A split recording as rosbag2 writes it: files out of order in the folder, listed in the metadata."""
    whole = by_writer("bag")(tmp_path, TABLE)
    storage = storage_of(whole).name
    for number, (first, last) in enumerate([(0, 60), (60, ROWS)]):
        folder = tmp_path / f"part{number}"
        folder.mkdir()
        part = by_writer("bag")(folder, make_table(first, last))
        shutil.move(part / storage, whole / f"bag_{number}.db3")
    (whole / storage).unlink()
    text = (whole / "metadata.yaml").read_text()
    (whole / "metadata.yaml").write_text(
        text.replace(f"  - {storage}\n", "  - bag_1.db3\n  - bag_0.db3\n", 1)
    )
    assert_same(read_log([whole], SOURCES), TABLE)
    (whole / "bag_1.db3").unlink()
    with pytest.raises(InputError, match=r"lacks the file 'bag_1.db3'"):
        read_log([whole], SOURCES)
    (whole / "metadata.yaml").unlink()
    assert_same(read_log([whole], SOURCES), make_table(0, 60))
