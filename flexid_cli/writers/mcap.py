"""MCAP."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple

from flexid_cli.errors import OutputError
from flexid_cli.writers.table import (
    FLOAT64,
    JOINT_STATE,
    LogTable,
    Topic,
    check_stamps,
    finished_later,
    one_of,
    ros_message,
    ros_store,
    topics_of,
)

Encoding = Literal["ros2msg", "ros2idl", "ros1", "json"]
Compression = Literal["zstd", "lz4", "none"]
_NANO = 1_000_000_000
_PROFILES = {"ros2msg": "ros2", "ros2idl": "ros2", "ros1": "ros1", "json": ""}
_LIBRARY = "flexid"  # without a version, so that the same table gives the same bytes
_STAMP = {"type": "object", "properties": {"sec": {"type": "integer"}, "nanosec": {"type": "integer"}}}
_NUMBERS = {"type": "array", "items": {"type": ["number", "null"]}}
_JSON_SCHEMAS: dict[str, dict[str, Any]] = {
    FLOAT64: {"type": "object", "properties": {"data": {"type": ["number", "null"]}}},
    JOINT_STATE: {
        "type": "object",
        "properties": {
            "header": {"type": "object", "properties": {"stamp": _STAMP, "frame_id": {"type": "string"}}},
            "name": {"type": "array", "items": {"type": "string"}},
            "position": _NUMBERS,
            "velocity": _NUMBERS,
            "effort": _NUMBERS,
        },
    },
}


class _Format(NamedTuple):
    """Names of an encoding, a schema's text by message type, a message's bytes by row and stamp."""

    message_encoding: str
    schema_encoding: str
    schema_name: Callable[[str], str]
    schema: Callable[[str], str]
    message: Callable[[Topic, int, int], bytes]


def write_mcap(
    path: Path,
    table: LogTable,
    *,
    topic: str = "/axis",
    encoding: Encoding = "ros2msg",
    compression: Compression = "zstd",
    chunked: bool = True,
    overwrite: bool = False,
) -> None:
    """Write a table as MCAP.

    Channels ``/topic/joint/position`` (velocity, effort) become JointState messages, others Float64. The
    stamps are log time, publish time and, in a JointState, the header's. The same table gives the same bytes
    (the packed chunks with the same release of the compressor).

    Parameters
    ----------
    path : Path
        The file.
    table : LogTable
        The channels.
    topic : str
        Under which channels without a topic of their own are written.
    encoding : {"ros2msg", "ros2idl", "ros1", "json"}
        Message encoding and schema language; both ROS 2 ones are little-endian CDR. JSON has null for NaN.
    compression : {"zstd", "lz4", "none"}
        Of the chunks.
    chunked : bool
        Whether messages stand in chunks with an index.
    overwrite : bool
        Whether an existing file is replaced.

    Raises
    ------
    OutputError
        The file exists, cannot be written, or cannot hold the stamps.
    """
    from mcap.writer import CompressionType, Writer

    one_of(encoding, tuple(_PROFILES), "encoding")
    one_of(compression, ("zstd", "lz4", "none"), "compression")
    check_stamps(table.stamps_ns, largest_s=2**31 - 1, kind="a message's stamp")
    form = _FORMATS[encoding]()
    topics = topics_of(table, topic)
    with finished_later(path, overwrite=overwrite) as draft, draft.open("wb") as stream:
        packing = CompressionType[compression.upper()]
        writer = Writer(stream, compression=packing, use_chunking=chunked, enable_data_crcs=not chunked)
        writer.start(profile=_PROFILES[encoding], library=_LIBRARY)
        schemas = {
            msgtype: writer.register_schema(
                form.schema_name(msgtype), form.schema_encoding, form.schema(msgtype).encode()
            )
            for msgtype in dict.fromkeys(one.msgtype for one in topics)
        }
        channels = [
            writer.register_channel(one.name, form.message_encoding, schemas[one.msgtype]) for one in topics
        ]
        for row, stamp in enumerate(table.stamps_ns.tolist()):
            for one, channel in zip(topics, channels, strict=True):
                writer.add_message(channel, stamp, form.message(one, row, stamp), stamp, row)
        writer.finish()  # type: ignore[no-untyped-call]


def _ros2(schema_encoding: str) -> _Format:
    store = ros_store(2)

    def message(topic: Topic, row: int, stamp: int) -> bytes:
        content = ros_message(store, topic, row, stamp)
        return bytes(store.serialize_cdr(content, topic.msgtype, little_endian=True))

    def schema(msgtype: str) -> str:
        return store.generate_msgdef(msgtype, ros_version=2)[0]

    return _Format(
        "cdr", schema_encoding, str, schema if schema_encoding == "ros2msg" else _IDL.__getitem__, message
    )


def _ros1() -> _Format:
    store = ros_store(1)

    def message(topic: Topic, row: int, stamp: int) -> bytes:
        return bytes(store.serialize_ros1(ros_message(store, topic, row, stamp), topic.msgtype))

    def schema(msgtype: str) -> str:
        return store.generate_msgdef(msgtype)[0]

    return _Format("ros1", "ros1msg", lambda msgtype: msgtype.replace("/msg/", "/"), schema, message)


def _json() -> _Format:
    def schema(msgtype: str) -> str:
        return json.dumps(_JSON_SCHEMAS[msgtype], sort_keys=True)

    return _Format("json", "jsonschema", str, schema, _json_message)


def _json_message(topic: Topic, row: int, stamp: int) -> bytes:
    values = {name: [_json_number(x) for x in array[row].tolist()] for name, array in topic.arrays.items()}
    if topic.msgtype == FLOAT64:
        return json.dumps({"data": values["data"][0]}, allow_nan=False).encode()
    seconds, nanoseconds = divmod(stamp, _NANO)
    header = {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": ""}
    return json.dumps({"header": header, "name": topic.joints, **values}, allow_nan=False).encode()


def _json_number(value: float) -> float | None:
    if math.isinf(value):
        raise OutputError("JSON cannot hold infinite numbers", "choose another encoding")
    return None if math.isnan(value) else value


_FORMATS: dict[str, Callable[[], _Format]] = {
    "ros2msg": lambda: _ros2("ros2msg"),
    "ros2idl": lambda: _ros2("ros2idl"),
    "ros1": _ros1,
    "json": _json,
}


def _idl_file(name: str, modules: str, struct: str, fields: str) -> str:
    opening = "".join(f"module {module} {{ " for module in modules.split("/"))
    closing = "}; " * len(modules.split("/"))
    return f"{'=' * 80}\nIDL: {name}\n{opening}struct {struct} {{ {fields} }}; {closing.strip()}\n"


_IDL_TIME = _idl_file(
    "builtin_interfaces/msg/Time", "builtin_interfaces/msg", "Time", "long sec; unsigned long nanosec;"
)
_IDL_HEADER = _idl_file(
    "std_msgs/msg/Header",
    "std_msgs/msg",
    "Header",
    "builtin_interfaces::msg::Time stamp; string frame_id;",
)
_IDL_JOINT_STATE = _idl_file(
    JOINT_STATE,
    "sensor_msgs/msg",
    "JointState",
    "std_msgs::msg::Header header; sequence<string> name; sequence<double> position; "
    "sequence<double> velocity; sequence<double> effort;",
)
_IDL = {
    FLOAT64: _idl_file(FLOAT64, "std_msgs/msg", "Float64", "double data;"),
    JOINT_STATE: _IDL_JOINT_STATE + _IDL_HEADER + _IDL_TIME,
}
