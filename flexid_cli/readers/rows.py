"""Lines of a text table to arrays, one block at a time; lines that do not fit are named, not guessed at."""

from __future__ import annotations

import csv
import io
import re
import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from flexid_cli.readers.dialect import MISSING, WHITESPACE, Dialect, is_missing, is_number, split_line

if TYPE_CHECKING:
    import pandas as pd

_LONGEST_SPLIT = 1 << 17  # characters; the csv module takes no longer field
_SLICE = 1 << 18  # bytes whose masks stay in the processor's cache
_PLUS = ord("+")  # the compiled reader refuses every character below it but a separator
_one_at_a_time = threading.Lock()  # for the import of pandas
_NOT_TEXT = re.compile(r"[\x00-\x08\x0e-\x19\x1b-\x1f\ufffd\ud800-\udfff]")
_NEGATIVE_ZERO = re.compile(rb"-0+(?![0-9.])")


class BadLine(NamedTuple):
    """A line that gives no sample.

    Its place in the block from 0, what is wrong, how to cure it, and how many rows it is for sure: 1 where it
    has all its fields; a line with others may be two rows, or a part of one, and is None.
    """

    place: int
    words: str
    hint: str
    rows: int | None = None


@dataclass(frozen=True)
class Rows:
    """The samples of one block of lines.

    Attributes
    ----------
    columns : mapping of int to ndarray of int64 or float64, shape (count,)
        By place of the column from 0; int64 where all fields are integers.
    count : int
        Number of samples.
    lines : int
        Number of lines, with comments and blank ones.
    bad : sequence of BadLine
        Lines that gave no sample.
    holes : int
        Zero bytes in the bad lines: as many bytes were lost.
    gaps : sequence of (int, int or None)
        Per bad line the samples of the block before it, and `BadLine.rows`.
    """

    columns: Mapping[int, NDArray[Any]]
    count: int
    lines: int
    bad: Sequence[BadLine] = field(default_factory=tuple)
    holes: int = 0
    gaps: Sequence[tuple[int, int | None]] = ()


class RowReader:
    """Reads the blocks of one table; may be called in several threads at once.

    Parameters
    ----------
    dialect : Dialect
        How the lines are written.
    encoding : str
        Of text that is no number; a superset of ASCII.
    wanted : sequence of int
        Places of columns from 0. Where there are none, lines are only checked and counted.
    compiled : bool
        Whether there is so much that compiled code is worth its start (45 MB of memory and, the first time ever,
        seconds); what it reads is the same.
    """

    def __init__(self, dialect: Dialect, encoding: str, wanted: Sequence[int], *, compiled: bool) -> None:
        self._dialect = dialect
        self._encoding = encoding
        self._wanted = wanted
        self._compiled = compiled and bool(wanted)

    def __call__(self, text: bytes) -> Rows:
        """Read a block of whole lines, each with a line feed at its end, below the header."""
        dialect, wanted = self._dialect, self._wanted
        simple = _simplified(text, dialect)
        if not any(mark[:1] in simple and mark in simple for mark in _high_marks(dialect)):
            rows = _read_bare(simple, dialect, wanted) if self._compiled else None
            if rows is None:
                rows = _read_plain(simple, dialect, wanted)
            if rows is not None:
                return rows
        return _read_any(text, dialect, self._encoding, wanted)


# --- lines of plain numbers ------------------------------------------------------------


def _read_bare(text: bytes, dialect: Dialect, wanted: Sequence[int]) -> Rows | None:
    """Read a block that has nothing but numbers, delimiters and line feeds; else return None."""
    from flexid_cli.readers.digits import read_numbers

    found = read_numbers(text, dialect.delimiter, dialect.decimal, len(dialect.fields), tuple(wanted))
    return None if found is None else Rows(found[1], found[0], found[0])


def _read_plain(text: bytes, dialect: Dialect, wanted: Sequence[int]) -> Rows | None:
    """Read a block in which every line has all fields and nothing is quoted or a comment; else None."""
    lines = _count(text, dialect)
    if lines is None:
        return None
    if not wanted or not lines:
        return Rows({}, lines, lines) if _even_lines(text, dialect) == lines else None
    frame = _parse(text, dialect, {*wanted, len(dialect.fields) - 1})
    return None if frame is None or len(frame) != lines else _checked(frame, text, dialect, wanted)


def _checked(frame: pd.DataFrame, text: bytes, dialect: Dialect, wanted: Sequence[int]) -> Rows | None:
    """Return the columns of a parsed block, or None where some line may lack a field or a field is a text."""
    last = len(dialect.fields) - 1
    if _lacks(frame[last]) and (last == 0 or _even_lines(text, dialect) != len(frame)):
        return None
    columns: dict[int, NDArray[Any]] = {}
    for place in wanted:
        values = _numbers(frame[place])
        if values is None:
            return None
        columns[place] = values
    return Rows(_with_signed_zeros(columns, text, dialect), len(frame), len(frame))


def _lacks(series: pd.Series[Any]) -> bool:
    """Whether some field of a parsed column is missing."""
    if series.dtype.kind in "iub":
        return False
    return bool(np.isnan(series.to_numpy()).any() if series.dtype.kind == "f" else series.isna().any())


def _simplified(text: bytes, dialect: Dialect) -> bytes:
    """Take quotes off fields that need none, and leave one space between fields that spaces separate."""
    if dialect.delimiter == WHITESPACE:
        if b"  " in text or b"\t" in text or b" \n" in text or b"\n " in text or text.startswith(b" "):
            text = re.sub(rb" ?\n ?", b"\n", re.sub(rb"[ \t]+", b" ", text)).lstrip(b" ")
    elif b'"' in text:
        mark = re.escape(dialect.delimiter.encode())
        around = rb"(?:(?<=%b)|(?<=\n)|\A)" % mark
        text = re.sub(around + rb'"([^"\n%b]*)"(?=%b|\n)' % (mark, mark), rb"\1", text)
    return text


def _count(text: bytes, dialect: Dialect) -> int | None:
    """Count lines where as many delimiters belong to them, and nothing is quoted or a comment; else None."""
    delimiter, width = ord(dialect.delimiter), len(dialect.fields)
    if any(mark in text for mark in _low_marks(dialect)):
        return None
    lines = _count_if(text, np.equal, ord("\n"))
    delimiters = _count_if(text, np.equal, delimiter)
    controls = _count_if(text, np.less, ord(" "))
    if controls != lines + (delimiters if dialect.delimiter == "\t" else 0):
        return None
    return lines if delimiters == lines * (width - 1) else None


def _count_if(text: bytes, compare: np.ufunc, value: int) -> int:
    """Count the bytes for which ``compare`` with ``value`` holds."""
    marks = np.frombuffer(text, dtype=np.uint8)
    return sum(
        int(np.count_nonzero(compare(marks[start : start + _SLICE], np.uint8(value))))
        for start in range(0, marks.size, _SLICE)
    )


@cache
def _high_marks(dialect: Dialect) -> tuple[bytes, ...]:
    """Return the beginnings of comments that do not count as a character too many."""
    marks = (mark.encode() for mark in dialect.comments)
    return tuple(mark for mark in marks if mark[0] >= _PLUS or mark[:1] == dialect.delimiter.encode())


@cache
def _low_marks(dialect: Dialect) -> tuple[bytes, ...]:
    return (b'"', *(mark.encode() for mark in dialect.comments))


def _even_lines(text: bytes, dialect: Dialect) -> int | None:
    """Count the lines, where each has exactly its fields; else None."""
    width, lines = len(dialect.fields), 0
    for part in _slices(text):
        marks = np.frombuffer(part, dtype=np.uint8)
        marks = marks[(marks == ord("\n")) | (marks == ord(dialect.delimiter))]
        if marks.size % width:
            return None
        ends = marks.reshape(-1, width) == ord("\n")
        if not ends[:, -1].all() or ends[:, :-1].any():
            return None
        lines += len(ends)
    return lines


def _slices(text: bytes) -> list[memoryview]:
    """Cut a block into slices of whole lines."""
    view, slices, start = memoryview(text), [], 0
    while start < len(text):
        stop = text.rfind(b"\n", start, start + _SLICE) + 1
        stop = stop or text.find(b"\n", start + _SLICE) + 1 or len(text)
        slices.append(view[start:stop])
        start = stop
    return slices


# --- the parser ------------------------------------------------------------


def _parse(
    text: bytes, dialect: Dialect, places: Iterable[int], dtype: str | None = None
) -> pd.DataFrame | None:
    """Parse columns with pandas; None where it refuses."""
    pandas = _pandas()
    how = _how(dialect, places)
    if dtype is not None:
        how["dtype"] = dtype
    if not text.isascii():
        how["encoding_errors"] = "surrogateescape"
    try:
        return cast("pd.DataFrame", pandas.read_csv(io.BytesIO(text), **how))
    except (pandas.errors.ParserError, ValueError, OverflowError):
        return None


def _pandas() -> ModuleType:
    """Import pandas, which two threads must not do at the same time."""
    with _one_at_a_time:
        import pandas as pd
    return pd


def _how(dialect: Dialect, places: Iterable[int]) -> dict[str, Any]:
    """Return what tells pandas how a table is written."""
    return {
        "sep": dialect.delimiter,
        "decimal": dialect.decimal,
        "header": None,
        "names": list(range(len(dialect.fields))),
        "index_col": False,
        "usecols": sorted(places),
        "na_values": list(MISSING),
        "keep_default_na": False,
        "skipinitialspace": True,
        "skip_blank_lines": False,
        "low_memory": False,
        **_exact_floats(),
    }


@cache
def _exact_floats() -> Mapping[str, Any]:
    """Ask for correctly rounded numbers where that is not the parser's only way."""
    pandas = _pandas()
    major, minor = (int(part) for part in pandas.__version__.split(".")[:2])
    return {} if (major, minor) >= (3, 1) else {"float_precision": "round_trip"}


def _numbers(series: pd.Series[Any]) -> NDArray[Any] | None:
    """Return the numbers of a parsed column, or None where it holds a text."""
    if series.dtype.kind == "i":
        return series.to_numpy()
    return series.to_numpy(dtype=np.float64) if series.dtype.kind in "fbu" else None


def _with_signed_zeros(
    columns: dict[int, NDArray[Any]], text: bytes, dialect: Dialect
) -> dict[int, NDArray[Any]]:
    """Read integer columns again as float64 where one of their zeros may be negative."""
    zeros = [place for place, values in columns.items() if values.dtype.kind == "i" and not values.all()]
    if zeros and b"-0" in text and _NEGATIVE_ZERO.search(text):
        again = _parse(text, dialect, zeros, "float64")
        if again is not None:
            columns.update({place: again[place].to_numpy() for place in zeros})
    return columns


# --- lines of any kind ------------------------------------------------------------


def _read_any(text: bytes, dialect: Dialect, encoding: str, wanted: Sequence[int]) -> Rows:
    """Read a block line by line, and set aside those that do not fit."""
    lines = text.decode(encoding, "surrogateescape").split("\n")[:-1]
    kept: list[list[str]] = []
    places: list[int] = []
    bad: list[BadLine] = []
    holes = 0
    for place, line in enumerate(lines):
        if not line.strip():
            continue
        if line.lstrip().startswith(dialect.comments):
            if _was_a_row(line, dialect):
                bad.append(BadLine(place, f"the comment was a row: {line.strip()[:60]!r}", _COMMENT_HINT))
            continue
        row = _split(line, dialect)
        if isinstance(row, list):
            kept.append(row)
            places.append(place)
        else:
            bad.append(BadLine(place, row, _WIDTH_HINT))
            holes += line.count("\0")
    columns = {column: _column(kept, column, dialect, places, bad) for column in wanted}
    spoilt = {one.place for one in bad}
    if wanted and spoilt.intersection(places):
        good = np.array([place not in spoilt for place in places], dtype=np.bool_)
        columns = {column: values[good] for column, values in columns.items()}
        places = [place for place in places if place not in spoilt]
    bad = _one_each(bad)
    before = np.searchsorted(places, [one.place for one in bad]).tolist()
    gaps = [(samples, one.rows) for samples, one in zip(before, bad, strict=True)]
    return Rows(columns, len(places), len(lines), bad, holes, gaps)


def _one_each(bad: Iterable[BadLine]) -> list[BadLine]:
    """Leave one entry per line, in the order of the lines: a line with two texts for numbers is one line."""
    first: dict[int, BadLine] = {}
    for one in bad:
        first.setdefault(one.place, one)
    return [first[place] for place in sorted(first)]


def _was_a_row(line: str, dialect: Dialect) -> bool:
    """Whether a comment is a row but for its mark: one flipped bit makes 3 a # and 5 a %."""
    text = line.strip()
    mark = next(mark for mark in dialect.comments if text.startswith(mark))
    row = _fields(f"3{text[len(mark) :]}", dialect.delimiter)
    return len(row) == len(dialect.fields) and all(
        is_number(cell, dialect.decimal) or is_missing(cell) for cell in row
    )


_COMMENT_HINT = "remove the mark where the row is right; rows that are missing on purpose leave a gap too"
_WIDTH_HINT = "correct or remove the line; the file may be two recordings in one, or damaged"


def _split(line: str, dialect: Dialect) -> list[str] | str:
    """Return the fields of a line, or what is wrong with it."""
    found = _NOT_TEXT.search(line)
    if found is not None:
        what = "zero bytes" if "\0" in line else "bytes that are no text"
        return f"the line holds {what}: {line[: found.start()].strip()[:60]!r}"
    if len(line) > _LONGEST_SPLIT:
        return f"the line has {len(line)} characters"
    row = _fields(line, dialect.delimiter)
    width = len(dialect.fields)
    if len(row) != width:
        return f"the line has {len(row)} fields, not {width}: {line.strip()[:60]!r}"
    return row


def _fields(line: str, delimiter: str) -> list[str]:
    try:
        return split_line(line, delimiter)
    except csv.Error:
        return [field.strip() for field in line.split(delimiter)]


def _column(
    rows: Sequence[Sequence[str]],
    column: int,
    dialect: Dialect,
    places: Sequence[int],
    bad: list[BadLine],
) -> NDArray[Any]:
    """Turn one column of fields into numbers; lines whose field is none are added to ``bad``."""
    fields = [row[column] for row in rows]
    if fields and all(map(_INTEGER.fullmatch, fields)):
        integers = [int(text) for text in fields]
        if all(-(2**63) <= value < 2**63 for value in integers) and not any(map(_ZERO.fullmatch, fields)):
            return np.array(integers, dtype=np.int64)
    values = np.empty(len(fields))
    for index, text in enumerate(fields):
        number = _number(text, dialect.decimal)
        if number is None:
            name = dialect.fields[column].name
            words = f"column {name!r} has the text {text[:40]!r}, not a number"
            whole = 1 if len(dialect.fields) > 1 else None  # two rows of one field each may be one line
            bad.append(BadLine(places[index], words, _text_hint(dialect.decimal), whole))
            number = float("nan")
        values[index] = number
    return values


_INTEGER = re.compile(r"[+-]?[0-9]{1,20}")
_ZERO = re.compile(r"-0+")


def _number(text: str, decimal: str) -> float | None:
    if is_missing(text):
        return float("nan")
    if decimal == ",":
        text = text.replace(".", "?").replace(",", ".")
    if not is_number(text, "."):
        return None
    truth = {"true": 1.0, "false": 0.0}.get(text.lower())
    return float(text) if truth is None else truth


def _text_hint(decimal: str) -> str:
    mark = "decimal comma" if decimal == "," else "decimal point"
    return (
        f"correct the line, or leave the field empty; numbers are read with a {mark}, which "
        "`csv: {decimal: ...}` sets"
    )
