"""ROS 1 bags."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from flexid_cli.writers.table import (
    LogTable,
    check_stamps,
    finished_later,
    one_of,
    ros_message,
    ros_store,
    topics_of,
)


def write_rosbag1(
    path: Path,
    table: LogTable,
    *,
    topic: str = "/axis",
    compression: Literal["none", "lz4", "bz2"] = "none",
    overwrite: bool = False,
) -> None:
    """Write a table as a ROS 1 bag; topics and messages as `write_mcap`.

    The same table gives the same bytes (the packed chunks with the same release of the compressor).

    Raises
    ------
    OutputError
        The file exists, cannot be written, or cannot hold the stamps.
    """
    from rosbags.rosbag1 import Writer

    one_of(compression, ("none", "lz4", "bz2"), "compression")
    check_stamps(table.stamps_ns, largest_s=2**32 - 1, kind="a ROS 1 bag")
    store = ros_store(1)
    topics = topics_of(table, topic)
    with finished_later(path, overwrite=overwrite) as draft:
        writer = Writer(draft)
        if compression != "none":
            writer.set_compression(Writer.CompressionFormat[compression.upper()])
        with writer:
            connections = [writer.add_connection(one.name, one.msgtype, typestore=store) for one in topics]
            for row, stamp in enumerate(table.stamps_ns.tolist()):
                for one, connection in zip(topics, connections, strict=True):
                    message = ros_message(store, one, row, stamp)
                    writer.write(connection, stamp, store.serialize_ros1(message, one.msgtype))
