"""CSV, plain or packed with gzip or zstd."""

from __future__ import annotations

import csv
import gzip
import io
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal

import numpy as np

from flexid_cli.errors import OutputError
from flexid_cli.writers.table import LogTable, finished_later

_NANO = 1_000_000_000
_LARGEST_EXACT_NS = 1 << 50  # below it, a float64 of seconds rounds back to the same nanosecond
_ROWS = 4096


def write_csv(
    path: Path,
    table: LogTable,
    *,
    time_name: str = "time",
    time_unit: Literal["s", "ns"] | None = None,
    units_in_header: bool = True,
    overwrite: bool = False,
) -> None:
    """Write a table as CSV; a name that ends in ``.gz`` or ``.zst`` is packed.

    Numbers are written so that reading them gives the same float64 to the last bit; NaN is an empty field.
    The same table gives the same bytes.

    Parameters
    ----------
    path : Path
        The file.
    table : LogTable
        The channels; names are column names.
    time_name : str
        Name of the first column, the stamps.
    time_unit : {"s", "ns"}, optional
        Unit of the stamps. By default seconds, and nanoseconds where float64 seconds would lose some.
    units_in_header : bool
        Whether the header has units: ``position [rad]``.
    overwrite : bool
        Whether an existing file is replaced.

    Raises
    ------
    OutputError
        The file exists, or cannot be written.
    """
    if time_name in table.channels:
        raise OutputError(f"the name {time_name!r} is both the time's and a channel's", "rename one of them")
    if time_unit is None:
        largest = int(np.abs(table.stamps_ns).max(initial=0))
        time_unit = "s" if largest < _LARGEST_EXACT_NS else "ns"
    units = {**table.units, time_name: time_unit} if units_in_header else {}
    header = [f"{name} [{units[name]}]" if name in units else name for name in (time_name, *table.channels)]
    with finished_later(path, overwrite=overwrite) as draft:
        pack = _packer(path)
        with draft.open("wb") as stream:
            for block in pack(_blocks(table, header, time_unit)):
                stream.write(block)


def _blocks(table: LogTable, header: list[str], time_unit: str) -> Iterator[bytes]:
    stamp = _seconds if time_unit == "s" else str
    for start in range(0, max(table.stamps_ns.size, 1), _ROWS):
        text = io.StringIO(newline="")
        writer = csv.writer(text, lineterminator="\n")
        if start == 0:
            writer.writerow(header)
        part = slice(start, start + _ROWS)
        columns = [[_number(value) for value in values[part].tolist()] for values in table.channels.values()]
        times = [stamp(time) for time in table.stamps_ns[part].tolist()]
        writer.writerows(zip(times, *columns, strict=True))
        yield text.getvalue().encode()


def _seconds(time_ns: int) -> str:
    whole, rest = divmod(abs(time_ns), _NANO)
    text = f"{'-' if time_ns < 0 else ''}{whole}.{rest:09d}".rstrip("0")
    return f"{text}0" if text.endswith(".") else text


def _number(value: float) -> str:
    return "" if math.isnan(value) else repr(value)


def _packer(path: Path) -> Callable[[Iterator[bytes]], Iterator[bytes]]:
    if path.name.endswith(".gz"):
        return _gzip
    return _zstd if path.name.endswith((".zst", ".zstd")) else iter


def _gzip(blocks: Iterator[bytes]) -> Iterator[bytes]:
    target = io.BytesIO()
    with gzip.GzipFile(filename="", fileobj=target, mode="wb", mtime=0) as packed:
        for block in blocks:
            packed.write(block)
    yield target.getvalue()


def _zstd(blocks: Iterator[bytes]) -> Iterator[bytes]:
    import zstandard

    packer = zstandard.ZstdCompressor(level=10, write_checksum=True).compressobj()
    for block in blocks:
        yield packer.compress(block)
    yield packer.flush()
