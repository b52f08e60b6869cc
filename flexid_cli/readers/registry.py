"""Which reader reads a log, and the two functions that the rest of the program calls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from flexid_cli.errors import InputError
from flexid_cli.readers.base import DEFAULT_OPTIONS, HEAD_BYTES, ChannelInfo, RawLog, Reader, ReadOptions
from flexid_cli.readers.damage import unreadable

if TYPE_CHECKING:
    from flexid_cli.config.schema import CsvOptions

_FORMATS = "flexid reads CSV (.csv, .csv.gz, .csv.zst), MCAP, rosbag2 folders and .db3, and ROS 1 .bag"


def readers(csv: CsvOptions | None = None) -> tuple[Reader, ...]:
    """Return one reader per format, those with a magic number first."""
    from flexid_cli.readers.csv import CsvReader
    from flexid_cli.readers.mcap import McapReader
    from flexid_cli.readers.rosbag1 import Rosbag1Reader
    from flexid_cli.readers.rosbag2 import Rosbag2Reader

    return McapReader(), Rosbag2Reader(), Rosbag1Reader(), CsvReader(csv)


def open_reader(paths: Sequence[Path], csv: CsvOptions | None = None) -> Reader:
    """Return the reader that reads ``paths``, found by their content.

    Parameters
    ----------
    paths : sequence of Path
        The files (or folders) of one run, all of one format.
    csv : CsvOptions, optional
        What the configuration fixes about text tables.

    Raises
    ------
    InputError
        A file is missing, empty, given twice, or of no known format, or the formats are mixed.
    """
    if not paths:
        raise InputError("no log is given", _FORMATS)
    refuse_doubles(paths)
    found = [(path, _reader_of(path, csv)) for path in paths]
    names = {reader.name for _, reader in found}
    if len(names) > 1:
        listed = ", ".join(f"{path.name} is {reader.name}" for path, reader in found)
        raise InputError(f"the logs have different formats: {listed}", "give the files of one run only")
    return found[0][1]


def list_channels(paths: Sequence[Path], csv: CsvOptions | None = None) -> list[ChannelInfo]:
    """List the numeric channels of a log; raises InputError as `open_reader` and for a damaged log."""
    return open_reader(paths, csv).channels(paths)


def read_log(
    paths: Sequence[Path],
    sources: Sequence[str | int],
    csv: CsvOptions | None = None,
    time_source: str | int | None = None,
    options: ReadOptions = DEFAULT_OPTIONS,
) -> RawLog:
    """Read channels of a log.

    Parameters
    ----------
    paths : sequence of Path
        The files of one run; one recording.
    sources : sequence of str or int
        Signal paths as a person wrote them; for CSV a column's name or its number from 1.
    csv : CsvOptions, optional
        What the configuration fixes about text tables.
    time_source : str or int, optional
        ``header_stamp``, ``log_time`` or ``publish_time``: every channel must have that clock. Anything else
        is a channel that holds the time and is read with the others.
    options : ReadOptions
        The window, and what is done with damage.

    Returns
    -------
    RawLog
        Its channels' keys are the spellings of ``sources`` (numbers as text).

    Raises
    ------
    InputError
        The log cannot be read, a channel or clock is missing, nothing lies in the window, or the log is damaged
        and the options are strict.
    """
    reader = open_reader(paths, csv)
    is_clock = reader.name != "csv" and time_source in {"header_stamp", "log_time", "publish_time"}
    wanted = list(dict.fromkeys(sources))
    if time_source is not None and not is_clock and time_source not in wanted:
        wanted.append(time_source)
    log = reader.read(paths, wanted, options)  # type: ignore[arg-type]
    if is_clock:
        _check_clock(log, str(time_source))
    return replace(log, channels=dict(log.channels))


def _check_clock(log: RawLog, clock: str) -> None:
    for source, channel in log.channels.items():
        if clock not in channel.stamps:
            raise InputError(
                f"{log.paths[0]}: channel {source!r} has no {clock}",
                f"use one of its clocks: {', '.join(channel.stamps)}",
            )


def refuse_doubles(paths: Sequence[Path]) -> None:
    """Raise InputError where a file is given twice."""
    seen: set[Path] = set()
    for path in paths:
        real = path.resolve()
        if real in seen:
            raise InputError(f"{path} is given twice")
        seen.add(real)


def _reader_of(path: Path, csv: CsvOptions | None) -> Reader:
    head = _head(path)
    for reader in readers(csv):
        if reader.sniff(path, head):
            return reader
    if path.is_dir():
        raise InputError(f"{path} is a folder without a rosbag2 recording", f"name the files; {_FORMATS}")
    text = readers(csv)[-1]
    if path.name.lower().endswith(text.suffixes):
        text.channels([path])  # raises the reason why this table is none
        return text
    raise InputError(f"{path} is of no known format", _FORMATS)


def _head(path: Path) -> bytes:
    if path.is_dir():
        return b""
    try:
        with path.open("rb") as stream:
            head = stream.read(HEAD_BYTES)
    except FileNotFoundError as error:
        raise InputError(f"there is no file {path}", "check the name; a relative path starts here") from error
    except OSError as error:
        raise unreadable(path, error) from error
    if not head:
        raise InputError(f"{path} is empty", "its recorder was killed before it wrote anything")
    return head
