"""Which writer writes a log, by the name of the file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from flexid_cli.errors import OutputError
from flexid_cli.writers.table import LogTable

FORMATS = ("csv", "mcap", "rosbag1", "rosbag2", "db3")
_SUFFIXES = {
    ".csv": "csv",
    ".csv.gz": "csv",
    ".csv.zst": "csv",
    ".mcap": "mcap",
    ".bag": "rosbag1",
    ".db3": "db3",
}


def format_of(path: Path) -> str:
    """Return the format that a file's name asks for; a name without suffix is a rosbag2 folder.

    Raises
    ------
    OutputError
        The suffix is not known.
    """
    for suffix, name in sorted(_SUFFIXES.items(), key=lambda item: -len(item[0])):
        if path.name.lower().endswith(suffix):
            return name
    if not path.suffix:
        return "rosbag2"
    raise OutputError(
        f"{path}: the suffix names no format of logs",
        f"use one of {', '.join(_SUFFIXES)}, or a name without suffix for a rosbag2 folder",
    )


def write_log(path: Path, table: LogTable, format_name: str | None = None, **options: Any) -> None:
    """Write a table in the format that ``format_name`` or else the suffix of ``path`` says.

    Parameters
    ----------
    path : Path
        The file, or folder for rosbag2.
    table : LogTable
        The channels.
    format_name : {"csv", "mcap", "rosbag1", "rosbag2", "db3"}, optional
        The format.
    **options
        Of the format's own function: ``overwrite`` for all, ``compression``, ``encoding`` and so on.

    Raises
    ------
    OutputError
        The format is not known, the output exists, or cannot be written.
    """
    from flexid_cli.writers.csv import write_csv
    from flexid_cli.writers.mcap import write_mcap
    from flexid_cli.writers.rosbag1 import write_rosbag1
    from flexid_cli.writers.rosbag2 import write_db3, write_rosbag2

    functions: tuple[Callable[..., None], ...] = (
        write_csv,
        write_mcap,
        write_rosbag1,
        write_rosbag2,
        write_db3,
    )
    by_name = dict(zip(FORMATS, functions, strict=True))
    name = format_name or format_of(path)
    if name not in by_name:
        raise OutputError(f"format {name!r} is not known", "choose one of " + ", ".join(FORMATS))
    by_name[name](path, table, **options)
