"""rosbag2 recordings."""

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

Storage = Literal["sqlite3", "mcap"]
Compression = Literal["none", "file", "message"]


def write_rosbag2(
    path: Path,
    table: LogTable,
    *,
    topic: str = "/axis",
    storage: Storage = "sqlite3",
    compression: Compression = "none",
    overwrite: bool = False,
) -> None:
    """Write a table as a rosbag2 folder; topics and messages as `write_mcap`.

    The same table gives the same bytes with the same releases of rosbags, SQLite and zstd: an sqlite3 file
    names the release of SQLite that wrote it.

    Parameters
    ----------
    path : Path
        The folder; the storage file in it has the folder's name.
    table : LogTable
        The channels.
    topic : str
        Under which channels without a topic of their own are written.
    storage : {"sqlite3", "mcap"}
        Format of the file in the folder.
    compression : {"none", "file", "message"}
        What zstd packs.
    overwrite : bool
        Whether an existing folder is replaced.

    Raises
    ------
    OutputError
        The folder exists, cannot be written, or the messages cannot hold the stamps.
    """
    one_of(storage, ("sqlite3", "mcap"), "storage")
    one_of(compression, ("none", "file", "message"), "compression")
    check_stamps(table.stamps_ns, largest_s=2**31 - 1, kind="a message's stamp")
    with finished_later(path, overwrite=overwrite) as draft:
        _write_folder(draft, table, topic, storage, compression)


def write_db3(path: Path, table: LogTable, *, topic: str = "/axis", overwrite: bool = False) -> None:
    """Write a table as a bare sqlite3 storage file, as it stands in a rosbag2 folder; see `write_rosbag2`."""
    check_stamps(table.stamps_ns, largest_s=2**31 - 1, kind="a message's stamp")
    with finished_later(path, overwrite=overwrite) as draft:
        folder = draft.parent / draft.stem / draft.stem
        _write_folder(folder, table, topic, "sqlite3", "none")
        (folder / f"{folder.name}.db3").rename(draft)


def _write_folder(
    folder: Path, table: LogTable, topic: str, storage: Storage, compression: Compression
) -> None:
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    store = ros_store(2)
    topics = topics_of(table, topic)
    writer = Writer(folder, version=8, storage_plugin=StoragePlugin[storage.upper()])
    writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    with writer:
        connections = [writer.add_connection(one.name, one.msgtype, typestore=store) for one in topics]
        for row, stamp in enumerate(table.stamps_ns.tolist()):
            for one, connection in zip(topics, connections, strict=True):
                message = ros_message(store, one, row, stamp)
                data = store.serialize_cdr(message, one.msgtype, little_endian=True)
                writer.write(connection, stamp, bytes(data))
