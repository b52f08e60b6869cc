"""Message logs beyond the common recording: types, encodings, order of names, stamps, odd containers."""

from __future__ import annotations

import json
import sqlite3
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer

from flexid_cli.errors import InputError
from flexid_cli.readers.damage import damaged, decoding
from flexid_cli.readers.decoders import TopicType, full_name, make_decoder
from flexid_cli.readers.registry import list_channels, read_log

DRIVE_MSG = """uint32 status
bool enabled
int64 counts
float32 temperature
Axis[2] axes
Axis[] spare
uint8[] image
string from
================================================================================
MSG: my_drives/Axis
float64 current
float64[3] vector
int16[<=4] raw
"""
DRIVE_IDL = """module my_drives { module msg {
  struct Axis { double current; double vector[3]; sequence<short, 4> raw; };
  struct Drive {
    unsigned long status; boolean enabled; long long counts; float temperature;
    my_drives::msg::Axis axes[2]; sequence<my_drives::msg::Axis> spare; sequence<octet> image; string from;
  };
}; };
"""


def write_messages(
    path: Path,
    messages: Iterable[tuple[int, bytes]],
    *,
    topic: str = "/drive",
    encoding: str = "json",
    schema: tuple[str, str, bytes] | None = None,
    publish_ns: int = 0,
) -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema_id = writer.register_schema(*schema) if schema else 0
        channel = writer.register_channel(topic, encoding, schema_id)
        for time, data in messages:
            writer.add_message(channel, time, data, time + publish_ns)
        writer.finish()
    return path


def write_json(path: Path, messages: Iterable[Any], topic: str = "/drive") -> Path:
    return write_messages(
        path, [(k * 1000, json.dumps(one).encode()) for k, one in enumerate(messages)], topic=topic
    )


def drive_messages(count: int, *, little: bool) -> list[tuple[int, bytes]]:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(DRIVE_MSG, "my_drives/msg/Drive"))
    axis, drive = store.types["my_drives/msg/Axis"], store.types["my_drives/msg/Drive"]

    def one(k: int, place: int) -> Any:
        return axis(k + place / 10, np.array([k, -k, 0.5]), np.array([k, -k][: 1 + k % 2], dtype=np.int16))

    messages = []
    for k in range(count):
        spare = [one(k, 7)] if k % 2 else []
        message = drive(
            k, k % 2 == 0, 2**60 + k, 0.1 * k, [one(k, 0), one(k, 1)], spare, np.zeros(5000, np.uint8), "x"
        )
        messages.append(
            (k * 1000, bytes(store.serialize_cdr(message, "my_drives/msg/Drive", little_endian=little)))
        )
    return messages


@pytest.mark.parametrize("little", [True, False])
@pytest.mark.parametrize("language", ["ros2msg", "ros2idl"])
def test_a_type_of_ones_own(little: bool, language: str, tmp_path: Path) -> None:
    text = DRIVE_MSG if language == "ros2msg" else DRIVE_IDL
    path = write_messages(
        tmp_path / "log.mcap",
        drive_messages(9, little=little),
        encoding="cdr",
        schema=("my_drives/msg/Drive", language, text.encode()),
        publish_ns=7,
    )
    sources = [info.source for info in list_channels([path])]
    assert "/drive.axes[1].vector[2]" in sources
    assert not any("image" in source or "from" in source for source in sources)
    log = read_log(
        [path],
        [
            "/drive/status",
            "/drive.enabled",
            "/drive.axes[1].current",
            "/drive/axes[0]/vector[-2]",
            "/drive.counts",
        ],
    )
    values = [channel.values.tolist() for channel in log.channels.values()]
    assert values[0] == list(range(9))
    assert values[1] == [1.0, 0.0] * 4 + [1.0]
    assert values[2] == [k + 0.1 for k in range(9)]
    assert values[3] == [-k for k in range(9)]
    counts = log.channels["/drive.counts"]
    assert counts.exact is not None
    assert counts.exact.tolist() == [2**60 + k for k in range(9)]
    assert any("2^53" in note.message for note in log.notes)
    assert set(counts.stamps) == {"log_time", "publish_time"}
    assert counts.stamps["publish_time"].tolist() == [k * 1000 + 7 for k in range(9)]


def test_an_element_that_some_messages_lack(tmp_path: Path) -> None:
    path = write_messages(
        tmp_path / "log.mcap",
        drive_messages(9, little=True),
        encoding="cdr",
        schema=("my_drives/msg/Drive", "ros2msg", DRIVE_MSG.encode()),
    )
    channel = read_log([path], ["/drive.spare[0].current"]).channels["/drive.spare[0].current"]
    assert channel.values.tolist() == [k + 0.7 for k in (1, 3, 5, 7)]
    assert channel.stamps["log_time"].tolist() == [1000, 3000, 5000, 7000]
    last = read_log([path], ["/drive.axes[0].raw[-1]"]).channels["/drive.axes[0].raw[-1]"]
    assert last.values.tolist() == [-k if k % 2 else k for k in range(9)]
    info = {one.source: one.count for one in list_channels([path])}
    assert info["/drive.spare[0].current"] == -1
    assert info["/drive.status"] == 9


def joints(names: list[str], position: list[float], **more: Any) -> dict[str, Any]:
    return {"name": names, "position": position, **more}


def test_names_that_change_their_order_or_are_missing(tmp_path: Path) -> None:
    path = write_json(
        tmp_path / "log.mcap",
        [
            joints(["a", "b"], [1.0, 2.0]),
            joints(["b", "a"], [2.5, 1.5]),
            joints(["b"], [2.75]),
            joints(["a"], []),
        ],
        "/js",
    )
    log = read_log([path], ["/js/a/position", "/js/b/position"])
    assert log.channels["/js/a/position"].values.tolist() == [1.0, 1.5]
    assert log.channels["/js/b/position"].values.tolist() == [2.0, 2.5, 2.75]
    assert log.channels["/js/b/position"].stamps["log_time"].tolist() == [0, 1000, 2000]
    assert any("2 of 4 messages lack channel '/js/a/position'" in note.message for note in log.notes)
    with pytest.raises(InputError, match=r"is 'a' in some messages and 'b' in others") as caught:
        read_log([path], ["/js.position[0]"])
    assert "/js/a/position" in caught.value.hint


def test_a_joint_that_appears_late(tmp_path: Path) -> None:
    messages = [joints(["a"], [1.0])] * 300 + [joints(["a", "late"], [1.0, 5.0])] * 3
    path = write_json(tmp_path / "log.mcap", messages, "/js")
    assert read_log([path], ["/js/late/position"]).channels["/js/late/position"].values.tolist() == [5.0] * 3
    with pytest.raises(InputError, match="no channel") as caught:
        read_log([path], ["/js/lata/position"])
    assert "/js/late/position" in caught.value.hint


@pytest.mark.parametrize(
    ("message", "word"),
    [
        (joints(["a", "b"], [1.0]), "2 names but 1 numbers"),
        (joints(["a", "a"], [1.0, 2.0]), "'a' twice"),
        (joints(["a", "b"], ["x", 1.0]), "has 'x' where a number is expected"),
    ],
)
def test_messages_that_contradict_themselves(message: dict[str, Any], word: str, tmp_path: Path) -> None:
    path = write_json(tmp_path / "log.mcap", [joints(["a", "b"], [1.0, 2.0]), message], "/js")
    with pytest.raises(InputError, match=word):
        read_log([path], ["/js/a/position"])


def test_json_of_any_shape(tmp_path: Path) -> None:
    messages = [
        {"t": 1_700_000_000_000_000_000 + k, "axes": [{"q": k / 3}, {"q": None}], "on": True, "mode": "run"}
        for k in range(3)
    ]
    path = write_json(tmp_path / "log.mcap", messages)
    infos = {info.source: info for info in list_channels([path])}
    assert sorted(infos) == ["/drive.axes[0].q", "/drive.on", "/drive.t"]
    log = read_log([path], ["/drive/axes[0]/q", "/drive.on"], time_source="/drive.t")
    assert log.channels["/drive/axes[0]/q"].values.tolist() == [0.0, 1 / 3, 2 / 3]
    time = log.channels["/drive.t"]
    assert time.exact is not None
    assert time.exact.tolist() == [message["t"] for message in messages]


def test_plain_numbers_and_arrays_as_json(tmp_path: Path) -> None:
    path = write_json(tmp_path / "a.mcap", [1, 2.5, None], "/current")
    assert np.array_equal(
        read_log([path], ["/current"]).channels["/current"].values, [1.0, 2.5, np.nan], equal_nan=True
    )
    path = write_json(tmp_path / "b.mcap", [[1, 2], [3, 4]], "/pair")
    assert read_log([path], ["/pair[1]"]).channels["/pair[1]"].values.tolist() == [2.0, 4.0]


@pytest.mark.parametrize(
    "header", [{"header": {"stamp": {"sec": 5, "nanosec": 6}}}, {"timestamp": {"sec": 5, "nsec": 6}}]
)
def test_the_messages_own_stamp(header: dict[str, Any], tmp_path: Path) -> None:
    path = write_json(tmp_path / "log.mcap", [{**header, "q": 1.0}])
    assert read_log([path], ["/drive.q"], time_source="header_stamp").channels["/drive.q"].stamps[
        "header_stamp"
    ].tolist() == [5_000_000_006]


def test_header_stamps_that_are_all_zero_are_not_used(tmp_path: Path) -> None:
    path = write_json(tmp_path / "log.mcap", [{"header": {"stamp": {"sec": 0, "nanosec": 0}}, "q": 1.0}])
    log = read_log([path], ["/drive.q"])
    assert "header_stamp" not in log.channels["/drive.q"].stamps
    assert any("all zero" in note.message for note in log.notes)
    with pytest.raises(InputError, match="has no header_stamp") as caught:
        read_log([path], ["/drive.q"], time_source="header_stamp")
    assert "log_time" in caught.value.hint


def test_protobuf(tmp_path: Path) -> None:
    pytest.importorskip("mcap_protobuf")
    from google.protobuf.timestamp_pb2 import Timestamp
    from google.protobuf.wrappers_pb2 import DoubleValue
    from mcap_protobuf.schema import build_file_descriptor_set

    schema = (
        "google.protobuf.DoubleValue",
        "protobuf",
        build_file_descriptor_set(DoubleValue).SerializeToString(),
    )
    messages = [(k, DoubleValue(value=k / 7).SerializeToString()) for k in range(5)]
    path = write_messages(tmp_path / "a.mcap", messages, topic="/current", encoding="protobuf", schema=schema)
    assert read_log([path], ["/current.value"]).channels["/current.value"].values.tolist() == [
        k / 7 for k in range(5)
    ]
    schema = (
        "google.protobuf.Timestamp",
        "protobuf",
        build_file_descriptor_set(Timestamp).SerializeToString(),
    )
    path = write_messages(tmp_path / "b.mcap", [(1, b"")], topic="/t", encoding="protobuf", schema=schema)
    assert list_channels([path]) == []


def test_protobuf_without_its_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mcap_protobuf", None)
    monkeypatch.setitem(sys.modules, "mcap_protobuf.decoder", None)
    schema = ("x.Y", "protobuf", b"not looked at")
    path = write_messages(tmp_path / "a.mcap", [(1, b"")], encoding="protobuf", schema=schema)
    with pytest.raises(InputError, match="not installed") as caught:
        read_log([path], ["/drive.q"])
    assert caught.value.hint == "pip install 'flexid[protobuf]'"
    assert list_channels([path]) == []


@pytest.mark.parametrize(
    ("encoding", "schema", "word"),
    [
        ("flatbuffer", ("X", "flatbuffer", b"x"), "flexid does not read"),
        ("cdr", ("my/msg/Unknown", "", b""), "does not describe message type 'my/msg/Unknown'"),
        (
            "cdr",
            ("my/msg/X", "ros2msg", b"my/Missing m\n"),
            "does not describe message type 'my/msg/Missing'",
        ),
        (
            "cdr",
            ("my/msg/X", "ros2msg", b"?? !!\n"),
            "is damaged: the description of message type 'my/msg/X'",
        ),
        (
            "cdr",
            ("std_msgs/msg/Float64", "ros2msg", b"float64 data\n"),
            "is damaged: a message of topic '/drive'",
        ),
        ("json", None, "no channel"),
    ],
)
def test_topics_that_cannot_be_decoded(
    encoding: str, schema: tuple[str, str, bytes] | None, word: str, tmp_path: Path
) -> None:
    data = b'"text"' if encoding == "json" else b"\0\1\0\0\1"
    path = write_messages(tmp_path / "a.mcap", [(1, data)], encoding=encoding, schema=schema)
    with pytest.raises(InputError, match=word):
        read_log([path], ["/drive.data"])


def test_standard_types_that_a_schema_leaves_out(tmp_path: Path) -> None:
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types: Any = store.types
    vector = types["geometry_msgs/msg/Vector3"](1.0, 2.0, 3.0)
    data = bytes(store.serialize_cdr(vector, "geometry_msgs/msg/Vector3"))
    path = write_messages(
        tmp_path / "a.mcap",
        [(1, data)],
        encoding="cdr",
        schema=("my/msg/Wrapped", "ros2msg", b"geometry_msgs/Vector3 v\n"),
    )
    assert read_log([path], ["/drive.v.z"]).channels["/drive.v.z"].values.tolist() == [3.0]


def test_a_recorder_that_was_killed_leaves_a_wal(tmp_path: Path) -> None:
    """Messages that stand only in the -wal file count; the folder is not written to."""
    live = tmp_path / "live.db3"
    database = sqlite3.connect(live, isolation_level=None)
    database.execute("PRAGMA journal_mode=WAL")
    database.execute("PRAGMA wal_autocheckpoint=0")
    database.execute(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)"
    )
    database.execute(
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)"
    )
    database.execute("INSERT INTO topics VALUES (1, '/current', 'std_msgs/msg/Float64', 'cdr')")
    for k in range(20):
        data = b"\0\1\0\0" + np.float64(k).tobytes()
        database.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (1, ?, ?)", (k, data))
    folder = tmp_path / "killed"
    folder.mkdir()
    for end in ("", "-wal"):
        (folder / f"log.db3{end}").write_bytes(Path(f"{live}{end}").read_bytes())
    database.close()
    before = sorted((path.name, path.read_bytes()) for path in folder.iterdir())
    for path in (folder, folder / "log.db3"):
        log = read_log([path], ["/current"])
        assert log.channels["/current"].values.tolist() == list(range(20))
        assert any("was not closed by its recorder" in note.message for note in log.notes)
        assert any("current ROS 2 release" in note.message for note in log.notes)
    assert sorted((path.name, path.read_bytes()) for path in folder.iterdir()) == before


@pytest.mark.parametrize(
    "metadata",
    [
        "",
        "a: [",
        "[]",
        "rosbag2_bagfile_information: 3",
        "rosbag2_bagfile_information: {relative_file_paths: []}",
    ],
)
def test_broken_metadata(metadata: str, tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").write_text(metadata)
    with pytest.raises(InputError, match=r"metadata\.yaml"):
        list_channels([tmp_path])


def test_an_sqlite_file_that_is_no_bag(tmp_path: Path) -> None:
    with sqlite3.connect(tmp_path / "a.db3") as database:
        database.execute("CREATE TABLE people(name TEXT)")
    database.close()
    with pytest.raises(InputError, match="no rosbag2 recording"):
        list_channels([tmp_path / "a.db3"])


def test_an_old_ros1_bag(tmp_path: Path) -> None:
    path = tmp_path / "a.bag"
    path.write_bytes(b"#ROSBAG V1.2\n" + b"\0" * 100)
    with pytest.raises(InputError, match=r"version 1\.2, not 2\.0"):
        list_channels([path])


def test_no_messages_at_all(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no messages"):
        list_channels([write_messages(tmp_path / "a.mcap", [])])


def test_names_of_types() -> None:
    assert full_name("sensor_msgs/JointState") == "sensor_msgs/msg/JointState"
    assert full_name("sensor_msgs::msg::JointState") == "sensor_msgs/msg/JointState"
    with pytest.raises(InputError):
        make_decoder(TopicType("/a", "b", "unknown"))


def test_only_failures_of_libraries_are_called_damage(tmp_path: Path) -> None:
    with (
        pytest.raises(InputError, match="is damaged: its head cannot be read"),
        decoding(tmp_path, "its head"),
    ):
        raise EOFError
    with pytest.raises(InputError, match=r"cannot read .*no such file"), decoding(tmp_path, "its head"):
        (tmp_path / "nothing").read_bytes()
    with pytest.raises(KeyboardInterrupt), decoding(tmp_path, "its head"):
        raise KeyboardInterrupt
    assert "copy the log again" in damaged(tmp_path, "x").hint
