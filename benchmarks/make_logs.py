"""The logs that ``reading.py`` reads: the same JointState messages in every container, and a table.

Usage: ``python benchmarks/make_logs.py FOLDER [--messages 1000000] [NAME ...]``

Six joints at 1 kHz, 316 bytes of CDR a message. Messages are written by the containers' own libraries, from
payloads that the libraries serialized once and whose numbers are then replaced; so what is written does not
depend on the reader that is measured.
"""

from __future__ import annotations

import argparse
import json
import sqlite3
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:  # else imported where used, for what is measured must not bear the writers' memory
    from mcap.writer import Writer as McapWriter
    from rosbags.typesys.store import Typestore

TOPIC = "/joint_states"
MSGTYPE = "sensor_msgs/msg/JointState"
JOINTS = tuple(f"joint_{number}" for number in range(1, 7))
JOINT = 2
SOURCES = (f"{TOPIC}/{JOINTS[JOINT]}/position", f"{TOPIC}/{JOINTS[JOINT]}/effort")
COLUMNS = ("time", "motor_current", "motor_position", "joint_position")
WANTED_COLUMNS = (COLUMNS[0], COLUMNS[1], COLUMNS[3])
ROWS_PER_MESSAGE = 10
BLOCK = 20_000
START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 1_000_000
CHUNK = 1 << 20
IMAGE = 100_000  # bytes


@dataclass(frozen=True)
class Block:
    """Some of the messages: stamps, shape (n,), and numbers, shape (n, 3, 6), of all joints."""

    stamps: NDArray[np.int64]
    numbers: NDArray[np.float64]


def blocks(count: int) -> Iterator[Block]:
    """Yield ``count`` messages; the same for every container."""
    rng = np.random.default_rng(1)
    for first in range(0, count, BLOCK):
        rows = np.arange(first, min(first + BLOCK, count))
        seconds = rows[:, None] * PERIOD_NS * 1e-9
        phase = np.arange(len(JOINTS)) * 0.7
        position = np.sin(2.0 * seconds + phase) + 1e-4 * rng.normal(size=(rows.size, len(JOINTS)))
        velocity = 2.0 * np.cos(2.0 * seconds + phase)
        effort = 5.0 * np.cos(7.0 * seconds + phase) + 0.1 * rng.normal(size=position.shape)
        yield Block(START_NS + rows * PERIOD_NS, np.stack([position, velocity, effort], axis=1))


def truth(count: int) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Return what a reader must find: stamps, position and effort of the third joint."""
    parts = list(blocks(count))
    stamps = np.concatenate([part.stamps for part in parts])
    numbers = np.concatenate([part.numbers[:, :, JOINT] for part in parts])
    return stamps, numbers[:, 0].copy(), numbers[:, 2].copy()


def table_rows(count: int) -> Iterator[NDArray[np.float64]]:
    """Yield the rows of the table in blocks, as they stand in its text."""
    rng = np.random.default_rng(2)
    for first in range(0, count, BLOCK):
        seconds = np.arange(first, min(first + BLOCK, count)) * 1e-3
        current = np.round(3.0 * rng.normal(size=seconds.size), 9)
        yield np.column_stack([seconds, current, np.sin(seconds) * 7.0, np.cos(seconds) / 3.0]).round(12)


class Payloads:
    """Serialized messages, made from one that a library serialized by putting other numbers in.

    Parameters
    ----------
    store : Typestore
        Knows the message type.
    ros1 : bool
        Serialize as ROS 1 does, else as CDR.
    """

    def __init__(self, store: Typestore, *, ros1: bool = False) -> None:
        self.store = store
        self._ros1 = ros1
        marks = np.arange(1.0, 19.0) * np.pi
        self._template = np.frombuffer(self._serialized(marks, 0x01234567, 0x12345678), dtype=np.uint8)
        text = self._template.tobytes()
        self._places = [text.index(mark.tobytes()) for mark in marks]
        self._seconds = text.index((0x01234567).to_bytes(4, "little"))
        self._nanoseconds = text.index((0x12345678).to_bytes(4, "little"))

    def _serialized(self, numbers: NDArray[np.float64], seconds: int, nanoseconds: int) -> bytes:
        types = self.store.types
        stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
        header = {"stamp": stamp, "frame_id": "base_link"} | ({"seq": 0} if self._ros1 else {})
        message = types[MSGTYPE](
            header=types["std_msgs/msg/Header"](**header),
            name=list(JOINTS),
            position=numbers[:6],
            velocity=numbers[6:12],
            effort=numbers[12:],
        )
        serialize = self.store.serialize_ros1 if self._ros1 else self.store.serialize_cdr
        return bytes(serialize(message, MSGTYPE))

    def of(self, block: Block) -> list[bytes]:
        """Serialize all messages of a block."""
        count, size = block.stamps.size, self._template.size
        data = np.tile(self._template, (count, 1))
        _put(data, self._seconds, (block.stamps // 10**9).astype("<u4"))
        _put(data, self._nanoseconds, (block.stamps % 10**9).astype("<u4"))
        for place, column in zip(self._places, block.numbers.reshape(count, -1).T, strict=True):
            _put(data, place, np.ascontiguousarray(column))
        text = data.tobytes()
        return [text[start : start + size] for start in range(0, count * size, size)]


def _put(data: NDArray[np.uint8], place: int, values: NDArray[np.generic]) -> None:
    data[:, place : place + values.itemsize] = values.view(np.uint8).reshape(-1, values.itemsize)


def ros2_payloads() -> Payloads:
    """Payloads in CDR."""
    from rosbags.typesys import Stores, get_typestore

    return Payloads(get_typestore(Stores.ROS2_HUMBLE))


def mcap(folder: Path, count: int, *, compression: str, chunked: bool = True) -> Path:
    """Write an MCAP file with ros2msg schemas, as rosbag2 does."""
    path = folder / f"{compression}{'' if chunked else '_unchunked'}.mcap"
    payloads = ros2_payloads()
    with path.open("wb") as stream:
        writer = _mcap_writer(stream, compression, chunked=chunked)
        channel = _channel(writer, payloads.store, TOPIC, MSGTYPE)
        for block in blocks(count):
            for stamp, data in zip(block.stamps.tolist(), payloads.of(block), strict=True):
                writer.add_message(channel, stamp, data, stamp)
        writer.finish()
    return path


def _mcap_writer(stream: IO[bytes], compression: str, *, chunked: bool = True) -> McapWriter:
    from mcap.writer import CompressionType, IndexType
    from mcap.writer import Writer as McapWriter

    index = IndexType.ALL if chunked else IndexType.NONE
    writer = McapWriter(
        stream,
        chunk_size=CHUNK,
        compression=CompressionType[compression.upper()],
        index_types=index,
        use_chunking=chunked,
    )
    writer.start(profile="ros2")
    return writer


def _channel(writer: McapWriter, store: Typestore, topic: str, msgtype: str) -> int:
    definition, _ = store.generate_msgdef(msgtype, ros_version=2)
    schema = writer.register_schema(msgtype, "ros2msg", definition.encode())
    return int(writer.register_channel(topic, "cdr", schema))


def mixed(folder: Path, count: int) -> Path:
    """Write an MCAP file in which a fifth of the messages is wanted, with other topics and images."""
    path = folder / "mixed.mcap"
    payloads = ros2_payloads()
    store = payloads.store
    text = store.types["std_msgs/msg/String"]
    texts = [bytes(store.serialize_cdr(text("a" * k), "std_msgs/msg/String")) for k in range(60, 160)]
    with path.open("wb") as stream:
        writer = _mcap_writer(stream, "zstd")
        wanted = _channel(writer, store, TOPIC, MSGTYPE)
        others = [_channel(writer, store, f"/other_{k}", "std_msgs/msg/String") for k in range(3)]
        camera = _channel(writer, store, "/camera", "sensor_msgs/msg/Image")
        image = _image(store)
        for block in blocks(count // 5):
            for row, (stamp, data) in enumerate(zip(block.stamps.tolist(), payloads.of(block), strict=True)):
                writer.add_message(wanted, stamp, data, stamp)
                for other in others:
                    writer.add_message(other, stamp + 1, texts[row % 100], stamp + 1)
                if row % 100 == 0:
                    writer.add_message(camera, stamp + 2, image, stamp + 2)
        writer.finish()
    return path


def _image(store: Typestore) -> bytes:
    types = store.types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](1, 2), "camera")
    pixels = np.frombuffer(np.random.default_rng(3).bytes(IMAGE), dtype=np.uint8)
    image = types["sensor_msgs/msg/Image"](header, 250, IMAGE // 250, "mono8", 0, IMAGE // 250, pixels)
    return bytes(store.serialize_cdr(image, "sensor_msgs/msg/Image"))


def json_mcap(folder: Path, count: int) -> Path:
    """Write an MCAP file of JSON messages."""
    path = folder / "json.mcap"
    with path.open("wb") as stream:
        writer = _mcap_writer(stream, "zstd")
        schema = writer.register_schema("JointState", "jsonschema", b'{"type": "object"}')
        channel = writer.register_channel(TOPIC, "json", schema)
        for block in blocks(count):
            for stamp, numbers in zip(block.stamps.tolist(), block.numbers.tolist(), strict=True):
                message = {
                    "header": {"stamp": {"sec": stamp // 10**9, "nsec": stamp % 10**9}, "frame_id": "base"},
                    "name": JOINTS,
                    **dict(zip(("position", "velocity", "effort"), numbers, strict=True)),
                }
                writer.add_message(channel, stamp, json.dumps(message).encode(), stamp)
        writer.finish()
    return path


def db3(folder: Path, count: int) -> Path:
    """Write a rosbag2 folder with sqlite3 storage."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    path, payloads = folder / "sqlite3", ros2_payloads()
    with Writer(path, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection(TOPIC, MSGTYPE, typestore=payloads.store)
        first = next(blocks(1))
        writer.write(connection, int(first.stamps[0]), payloads.of(first)[0])
    (storage,) = path.glob("*.db3")
    with sqlite3.connect(storage) as database:
        database.execute("DELETE FROM messages")
        topic = database.execute("SELECT id FROM topics").fetchone()[0]
        for block in blocks(count):
            rows = zip(block.stamps.tolist(), payloads.of(block), strict=True)
            database.executemany(
                "INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)",
                ((topic, stamp, data) for stamp, data in rows),
            )
    database.close()
    metadata = path / "metadata.yaml"
    text = metadata.read_text().replace("message_count: 1", f"message_count: {count}")
    text = text.replace("nanoseconds: 0", f"nanoseconds: {(count - 1) * PERIOD_NS}")
    metadata.write_text(text)
    return path


def bag(folder: Path, count: int, *, compression: str) -> Path:
    """Write a ROS 1 bag."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    path = folder / f"{compression}.bag"
    payloads = Payloads(get_typestore(Stores.ROS1_NOETIC), ros1=True)
    writer = Writer(path)
    if compression != "none":
        writer.set_compression(Writer.CompressionFormat[compression.upper()])
    with writer:
        connection = writer.add_connection(TOPIC, MSGTYPE, typestore=payloads.store)
        for block in blocks(count):
            for stamp, data in zip(block.stamps.tolist(), payloads.of(block), strict=True):
                writer.write(connection, stamp, data)
    return path


def table(folder: Path, count: int) -> Path:
    """Write a CSV file with ten rows for each message of the other logs."""
    path = folder / "table.csv"
    with path.open("w") as stream:
        stream.write(",".join(COLUMNS) + "\n")
        for rows in table_rows(ROWS_PER_MESSAGE * count):
            stream.writelines(f"{a:.6f},{b:.9f},{c:.12f},{d:.12f}\n" for a, b, c, d in rows.tolist())
    return path


Maker = Callable[[Path, int], Path]
MAKERS: dict[str, Maker] = {
    "mcap_zstd": partial(mcap, compression="zstd"),
    "mcap_lz4": partial(mcap, compression="lz4"),
    "mcap_none": partial(mcap, compression="none"),
    "mcap_unchunked": partial(mcap, compression="none", chunked=False),
    "mcap_mixed": mixed,
    "mcap_json": json_mcap,
    "sqlite3": db3,
    "bag_none": partial(bag, compression="none"),
    "bag_lz4": partial(bag, compression="lz4"),
    "csv": table,
}


def make(name: str, folder: Path, count: int) -> Path:
    """Write the log ``name`` with ``count`` messages into a folder of its own, unless it is there.

    Returns
    -------
    Path
        The log: a file, or a rosbag2 folder.
    """
    home = folder / f"{name}_{count}"
    done = home / "path"
    if not done.exists():
        home.mkdir(parents=True, exist_ok=True)
        done.write_text(MAKERS[name](home, count).name)
    return home / done.read_text()


def main() -> None:
    """Write logs by name."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", default=[], metavar="NAME", help=", ".join(MAKERS))
    parser.add_argument("--messages", type=int, default=1_000_000)
    options = parser.parse_args()
    for name in options.names or MAKERS:
        path = make(name, options.folder, options.messages)
        print(path)


if __name__ == "__main__":
    main()
