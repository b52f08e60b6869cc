"""CSV, plain or packed with gzip or zstd."""

from __future__ import annotations

import codecs
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

_DIGITS = {"s": 9, "ms": 6, "us": 3, "ns": 0}
_LARGEST_EXACT_NS = 1 << 50  # below it, a float64 of seconds rounds back to the same nanosecond
_ROWS = 4096


def write_csv(
    path: Path,
    table: LogTable,
    *,
    time_name: str | None = "time",
    time_unit: Literal["s", "ms", "us", "ns"] | None = None,
    time_place: int = 1,
    units_in_header: bool = True,
    header: bool = True,
    delimiter: str = ",",
    decimal: Literal[".", ","] = ".",
    encoding: str = "utf-8",
    rows_before: int = 0,
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
    time_name : str or None
        Name of the column of stamps; None writes none.
    time_unit : {"s", "ms", "us", "ns"}, optional
        Unit of the stamps. By default seconds, and nanoseconds where float64 seconds would lose some.
    time_place : int
        Which column holds the stamps, from 1.
    units_in_header : bool
        Whether the header has units: ``position [rad]``.
    header : bool
        Whether the first row holds the names.
    delimiter, decimal, encoding : str
        Column separator, decimal sign, text encoding.
    rows_before : int
        Rows that say nothing, before the header, for readers that skip as many.
    overwrite : bool
        Whether an existing file is replaced.

    Raises
    ------
    OutputError
        The file exists, cannot be written, or a name cannot be in this encoding.
    """
    if time_name in table.channels:
        raise OutputError(f"the name {time_name!r} is both the time's and a channel's", "rename one of them")
    if decimal == delimiter:
        raise OutputError(f"delimiter and decimal sign are both {decimal!r}", "separate columns by ;")
    if time_unit is None:
        largest = int(np.abs(table.stamps_ns).max(initial=0))
        time_unit = "s" if largest < _LARGEST_EXACT_NS else "ns"
    units = {**table.units, str(time_name): time_unit} if units_in_header else {}
    names: list[str | None] = list(table.channels)
    if time_name is not None:
        names.insert(min(max(time_place, 1) - 1, len(names)), time_name)
    titles = [f"{name} [{units[str(name)]}]" if name in units else str(name) for name in names]
    columns = [_texts(table, name, time_name, time_unit, decimal) for name in names]
    with finished_later(path, overwrite=overwrite) as draft:
        pack = _packer(path)
        with draft.open("wb") as stream:
            blocks = _blocks(
                table.stamps_ns.size, [["-"]] * rows_before + [titles] * header, columns, delimiter
            )
            for block in pack(_encoded(blocks, encoding)):
                stream.write(block)


def _texts(
    table: LogTable, name: str | None, time_name: str | None, time_unit: str, decimal: str
) -> Callable[[slice], list[str]]:
    """How the rows of one column are written."""
    if name == time_name:
        digits = _DIGITS[time_unit]
        return lambda rows: [_stamp(time, digits, decimal) for time in table.stamps_ns[rows].tolist()]
    values = table.channels[str(name)]
    if decimal == ".":
        return lambda rows: [_number(value) for value in values[rows].tolist()]
    return lambda rows: [_number(value).replace(".", decimal) for value in values[rows].tolist()]


def _blocks(
    count: int, first: list[list[str]], columns: list[Callable[[slice], list[str]]], delimiter: str
) -> Iterator[str]:
    for start in range(0, max(count, 1), _ROWS):
        text = io.StringIO(newline="")
        writer = csv.writer(text, delimiter=delimiter, lineterminator="\n")
        if start == 0:
            writer.writerows(first)
        rows = slice(start, start + _ROWS)
        writer.writerows(zip(*(column(rows) for column in columns), strict=True))
        yield text.getvalue()


def _encoded(blocks: Iterator[str], encoding: str) -> Iterator[bytes]:
    encoder = codecs.getincrementalencoder(encoding)()  # writes a byte order mark once, where there is one
    try:
        for block in blocks:
            yield encoder.encode(block)
    except UnicodeEncodeError as error:
        wrong = error.object[error.start : error.end]
        raise OutputError(f"{wrong!r} cannot be written in {encoding}", "use utf-8") from error


def _stamp(time_ns: int, digits: int, decimal: str) -> str:
    """Nanoseconds in a unit of ``10**digits`` of them, exactly."""
    if digits == 0:
        return str(time_ns)
    whole, rest = divmod(abs(time_ns), 10**digits)
    text = f"{'-' if time_ns < 0 else ''}{whole}{decimal}{rest:0{digits}d}".rstrip("0")
    return f"{text}0" if text.endswith(decimal) else text


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
