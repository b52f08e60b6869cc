"""How a text table is written: found from its first lines, by rules that refuse rather than guess wrong."""

from __future__ import annotations

import codecs
import csv
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from flexid_cli.errors import InputError, UsageError
from flexid_cli.units import parse_unit

MISSING = (
    "", "NaN", "nan", "NAN", "N/A", "n/a", "NA", "#N/A", "-", "--", "null", "NULL", "None", "none",
    "-nan", "+nan", "-NaN", "+NaN", "-nan(ind)", "nan(ind)", "1.#QNAN", "-1.#IND", "1.#IND",
)  # fmt: skip
WHITESPACE = " "
_COMMENTS = ("#", "%", "//")
_DELIMITERS = (",", ";", "\t", "|", WHITESPACE)
_NUMBER = {
    ".": re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?inf(inity)?|true|false", re.IGNORECASE),
    ",": re.compile(r"[+-]?\d+(,\d+)?([eE][+-]?\d+)?|[+-]?inf(inity)?|true|false", re.IGNORECASE),
}
_UNIT_IN_NAME = re.compile(r"^(?P<name>.*\S)\s*(?:\[(?P<square>[^\[\]]*)\]|\((?P<round>[^()]*)\))$")
_LOOKED_AT = 400  # lines
_ODD_SHARE = 1e-3  # of characters that no text has: more of them is no damage, but no text


class Options(Protocol):
    """What a configuration can fix; None is detected."""

    @property
    def delimiter(self) -> str | None: ...  # noqa: D102
    @property
    def decimal(self) -> str | None: ...  # noqa: D102
    @property
    def header(self) -> bool | None: ...  # noqa: D102
    @property
    def comment(self) -> str | None: ...  # noqa: D102
    @property
    def encoding(self) -> str | None: ...  # noqa: D102
    @property
    def skip_rows(self) -> int | None: ...  # noqa: D102


@dataclass(frozen=True)
class Detect:
    """Options that leave everything to detection."""

    delimiter: str | None = None
    decimal: str | None = None
    header: bool | None = None
    comment: str | None = None
    encoding: str | None = None
    skip_rows: int | None = None


@dataclass(frozen=True)
class Field:
    """One column: its name without unit, the unit, and the header's own text."""

    name: str
    unit: str | None
    text: str


@dataclass(frozen=True)
class Dialect:
    """How the lines of a table are to be read.

    Attributes
    ----------
    delimiter, decimal : str
        Between fields (a space stands for any run of spaces and tabs), and inside numbers.
    comments : tuple of str
        What a line begins with that is no data.
    fields : tuple of Field
        The columns; named by number from 1 where there is no header.
    first_line : int
        Line of the first sample, from 1.
    header : bool
        Whether the names stand in the file.
    numeric : tuple of bool
        Which columns have a number in the lines that were looked at.
    """

    delimiter: str
    decimal: str
    comments: tuple[str, ...]
    fields: tuple[Field, ...]
    first_line: int
    header: bool = False
    numeric: tuple[bool, ...] = ()


@dataclass(frozen=True)
class _Line:
    number: int
    text: str
    comment: bool


def detect_encoding(head: bytes, *, whole: bool) -> str | None:
    """Return the encoding of a text that begins with ``head``, or None where it is no text.

    Parameters
    ----------
    head : bytes
        The first bytes.
    whole : bool
        Whether ``head`` is the whole text (else it may end inside a character).
    """
    for mark, name in (
        (codecs.BOM_UTF8, "utf-8-sig"),
        (codecs.BOM_UTF16_LE, "utf-16"),
        (codecs.BOM_UTF16_BE, "utf-16"),
    ):
        if head.startswith(mark):
            return name
    if b"\0" in head:
        return _unmarked_utf16(head) or _around_holes(head, whole=whole)
    odd = sum(byte < 9 or (13 < byte < 32 and byte != 26) for byte in head[:4096])
    if odd > _ODD_SHARE * min(len(head), 4096):
        return None
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head, final=whole)
    except UnicodeDecodeError:
        return "cp1252" if _decodes(head, "cp1252") else "latin-1"
    return "utf-8"


def _decodes(head: bytes, encoding: str) -> bool:
    try:
        head.decode(encoding)
    except UnicodeDecodeError:
        return False
    return True


def _around_holes(head: bytes, *, whole: bool) -> str | None:
    """Return the encoding of a text with stretches of zero bytes, which a loss of power leaves in files."""
    holes = len(re.findall(rb"\0+", head))
    text = head.replace(b"\0", b"")
    first, end, _ = head.partition(b"\n")
    if not end or b"\0" in first or holes > 1 + _ODD_SHARE * len(text):
        return None
    return detect_encoding(text, whole=whole)


def _unmarked_utf16(head: bytes) -> str | None:
    even = head[: len(head) // 2 * 2]
    for encoding, zeros, others in (
        ("utf-16-le", even[1::2], even[::2]),
        ("utf-16-be", even[::2], even[1::2]),
    ):
        if zeros.count(0) > 0.9 * len(zeros) and b"\0" not in others:
            return encoding
    return None


def is_missing(field: str) -> bool:
    """Whether ``field`` says that there is no value."""
    return field.strip() in MISSING


def is_number(field: str, decimal: str) -> bool:
    """Whether ``field`` is a number with this decimal mark."""
    return _NUMBER[decimal].fullmatch(field.strip()) is not None


def split_line(line: str, delimiter: str) -> list[str]:
    """Split one line into fields; quotes protect delimiters."""
    if delimiter == WHITESPACE:
        line = re.sub(r"[ \t]+", " ", line.strip())
    if '"' not in line:
        return [field.strip() for field in line.split(delimiter)]
    row = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [""])
    return [field.strip() for field in row]


def split_unit(text: str) -> tuple[str, str | None]:
    """Split a header's text into name and unit: ``position [rad]``, ``current (A)``.

    Square brackets hold a unit unless there is a number in them, round ones only where the unit is known.
    """
    match = _UNIT_IN_NAME.match(text.strip())
    if match is None:
        return text.strip(), None
    square, inside = match["square"], (match["square"] or match["round"] or "").strip()
    if not inside or re.fullmatch(r"-?\d+", inside):
        return text.strip(), None
    if square is None and not _is_unit(inside):
        return text.strip(), None
    return match["name"].strip(), inside


def _is_unit(text: str) -> bool:
    try:
        parse_unit(text)
    except UsageError:
        return bool(re.fullmatch(r"[A-Za-zµμ°%][\w.·*^µμ°%-]*/[\w.·*^-]+|°?C|K|%|Hz|kHz|bar|kg", text))
    return True


def detect(lines: Sequence[str], options: Options, *, name: str = "the file") -> Dialect:
    """Find how a table is written.

    Parameters
    ----------
    lines : sequence of str
        Its first lines, without line ends.
    options : Options
        What the configuration fixes.
    name : str
        The file, for messages.

    Raises
    ------
    InputError
        It is no table of numbers, its header does not fit, or column names appear twice.
    """
    comments = (options.comment,) if options.comment else _COMMENTS
    kept = list(_numbered(lines, comments, options.skip_rows or 0))
    data = [line for line in kept if not line.comment]
    if not data:
        raise InputError(f"{name} has no data rows", "check that the log was written to its end")
    delimiter, decimal = _delimiter_and_decimal([line.text for line in data], options)
    return _with_columns(Dialect(delimiter, decimal, comments, (), 0), kept, options, name)


def _numbered(lines: Sequence[str], comments: tuple[str, ...], skip: int) -> Iterator[_Line]:
    for number, text in enumerate(lines[: skip + _LOOKED_AT], start=1):
        if number > skip and text.strip():
            yield _Line(number, text, text.lstrip().startswith(comments))


def _delimiter_and_decimal(lines: Sequence[str], options: Options) -> tuple[str, str]:
    """Choose the pair under which most lines have the same number of fields and most fields are numbers."""
    best, chosen = (-1.0, 0), (",", ".")
    body = lines[1:] or lines
    delimiters = (_chosen_delimiter(options.delimiter),) if options.delimiter else _DELIMITERS
    absent_before = False
    for delimiter in delimiters:
        # of those that stand in no line all tell the same, but the comma, which is no decimal mark beside itself
        absent = delimiter != "," and not any(_is_in(delimiter, line) for line in body)
        if absent and absent_before:
            continue
        absent_before |= absent
        rows = [split_line(line, delimiter) for line in body]
        width, often = Counter(map(len, rows)).most_common(1)[0]
        fitting = [row for row in rows if len(row) == width]
        for decimal in (options.decimal,) if options.decimal else (".", ","):
            if decimal == delimiter:
                continue
            numbers = sum(is_number(field, decimal) or is_missing(field) for row in fitting for field in row)
            # several columns outrank one; the order of the candidates decides between equals
            share = often / len(rows) * numbers / (width * len(fitting))
            score = (round(share, 3), int(width > 1))
            if score > best and (numbers or delimiter == delimiters[0]):
                best, chosen = score, (delimiter, decimal)
    return chosen


def _is_in(delimiter: str, line: str) -> bool:
    return delimiter in line or (delimiter == WHITESPACE and "\t" in line)


def _chosen_delimiter(text: str) -> str:
    if text in {"\\t", "tab"}:
        return "\t"
    return WHITESPACE if text in {"space", "whitespace", "\\s+"} or not text.strip(" ") else text


class _Table:
    """The first lines as rows of fields."""

    def __init__(self, dialect: Dialect, kept: Sequence[_Line]) -> None:
        self.dialect = dialect
        self.kept = kept
        self.data = [line for line in kept if not line.comment]
        self.rows = [self.cells(line) for line in self.data]
        self.width = Counter(map(len, self.rows)).most_common(1)[0][0]
        body = [row for row in self.rows[1:] or self.rows if len(row) == self.width]
        self.ends_empty = self.width > 1 and not any(row[-1] for row in body)
        self.numeric = tuple(
            any(is_number(row[place], dialect.decimal) for row in body) for place in range(self.width)
        )

    def cells(self, line: _Line) -> list[str]:
        """Split a line; a comment without its mark, a unit after a space as part of the name before it."""
        text = line.text.strip()
        if line.comment:
            mark = next(mark for mark in self.dialect.comments if text.startswith(mark))
            text = text[len(mark) :].lstrip(mark[0])
        if self.dialect.delimiter == WHITESPACE and "[" in text:
            text = re.sub(r"\s+(\[[^\]]*\])", r"\1", text)
        return split_line(
            text if self.dialect.delimiter != "\t" or line.comment else line.text, self.dialect.delimiter
        )

    def first_sample(self) -> int | None:
        """Index of the first line of samples among the lines that are no comments.

        It has all fields, and numbers where other lines have numbers. A text among its numbers makes it a
        header (of columns named by numbers) where no header was met, else a sample that cannot be read.
        """
        header_met = False
        for index, row in enumerate(self.rows):
            if len(row) != self.width:
                continue
            numbers = [is_number(cell, self.dialect.decimal) for cell in row]
            texts = [
                numeric and not number and not is_missing(cell)
                for cell, number, numeric in zip(row, numbers, self.numeric, strict=True)
            ]
            if any(numbers) and (header_met or not any(texts)):
                return index
            if not any(numbers) and all(map(is_missing, row)) and (header_met or any(row)):
                return index
            header_met = header_met or any(texts)
        return None

    def names(self, row: Sequence[str]) -> list[str] | None:
        """Return the header's names, one per column, or None where they are too few or too many."""
        if len(row) == self.width:
            return list(row)
        return [*row, ""] if self.ends_empty and len(row) == self.width - 1 else None


def _with_columns(dialect: Dialect, kept: Sequence[_Line], options: Options, name: str) -> Dialect:
    table = _Table(dialect, kept)
    dialect = replace(dialect, numeric=table.numeric)
    table.dialect = dialect
    start = 0 if options.header is True and len(table.data) > 1 else table.first_sample()
    if start is None or not any(table.numeric):
        raise InputError(
            f"{name} has no rows of numbers", "it is no table of signals, or `csv:` needs options"
        )
    if options.header is True:
        start = max(start, (table.first_sample() or 0), 1)
    above, first = table.data[:start], table.data[start] if start < len(table.data) else None
    if first is None:
        raise InputError(f"{name} has no data rows", "check that the log was written to its end")
    if options.header is False:
        return _nameless(table, above, first, name)
    return _named_above(table, above, first, name) if above else _named_in_comment(table, first, name)


def _nameless(table: _Table, above: Sequence[_Line], first: _Line, name: str) -> Dialect:
    if above:
        raise InputError(
            f"{name}:{above[0].number}: {above[0].text.strip()[:60]!r} is no row of numbers, and the "
            "configuration says that there is no header",
            f"`csv: {{header: true}}`, or skip the lines with `csv: {{skip_rows: {first.number - 1}}}`",
        )
    fields = tuple(Field(str(place), None, str(place)) for place in range(1, table.width + 1))
    return replace(table.dialect, fields=fields, first_line=first.number, header=False)


def _named_above(table: _Table, above: Sequence[_Line], first: _Line, name: str) -> Dialect:
    """Take the names, and perhaps units, from the lines above the samples; further lines are a preamble."""
    cells = [table.cells(line) for line in above]
    if table.names(cells[-1]) is None and len(cells[-1]) > 1:
        raise InputError(
            f"{name}:{above[-1].number}: the header has {len(cells[-1])} names, but the rows have "
            f"{table.width} fields",
            "correct the header, or skip it with `csv: {skip_rows: "
            f"{first.number - 1}, header: false}}` and give columns by number",
        )
    heads = [names for row in cells if (names := table.names(row))]
    if not heads:
        return _nameless(table, (), first, name)
    return _named(table, heads, first, name)


def _named_in_comment(table: _Table, first: _Line, name: str) -> Dialect:
    """Take names from the comment lines above the samples, where they have as many words as columns."""
    rows = [table.cells(line) for line in table.kept if line.comment and line.number < first.number]
    heads: list[list[str]] = []
    while rows and _can_be_names(table, rows[-1]):
        heads.insert(0, rows.pop())
    return _named(table, heads, first, name) if heads else _nameless(table, (), first, name)


def _can_be_names(table: _Table, row: Sequence[str]) -> bool:
    numbers = any(is_number(cell, table.dialect.decimal) for cell in row)
    return table.width > 1 and len(row) == table.width and all(row) and not numbers


def _named(table: _Table, heads: Sequence[Sequence[str]], first: _Line, name: str) -> Dialect:
    """Name the columns by the last of ``heads``, or by the one before where the last holds units."""
    names, units = heads[-1], None
    if len(heads) > 1 and _are_units(heads[-1]):
        names, units = heads[-2], heads[-1]
    return replace(table.dialect, fields=_fields(names, units, name), first_line=first.number, header=True)


def _are_units(row: Sequence[str]) -> bool:
    texts = [cell.strip("[]() ") for cell in row if not is_missing(cell)]
    return bool(texts) and all(_is_unit(text) for text in texts)


def _fields(row: Sequence[str], units: Sequence[str] | None, name: str) -> tuple[Field, ...]:
    texts = [text.strip() for text in row]
    twice = [text for text, count in Counter(filter(None, texts)).items() if count > 1]
    if twice:
        raise InputError(
            f"{name}: the header has {', '.join(map(repr, twice))} more than once",
            "rename the columns, or skip the header and give columns by number",
        )
    split = [split_unit(text) for text in texts]
    short = Counter(stem for stem, _ in split)
    fields = []
    for place, (text, (stem, unit)) in enumerate(zip(texts, split, strict=True)):
        below = units[place].strip("[]() ") if units and place < len(units) else ""
        declared = unit or (None if is_missing(below) else below)
        fields.append(Field((stem if short[stem] == 1 else text) or str(place + 1), declared, text))
    return tuple(fields)


def is_whole(field: str, before: Sequence[str], decimal: str) -> bool:
    """Whether the last field of a line without line end is surely not cut, judged by that field ``before``.

    It is where all of them have the same length, or the same number of decimals (one at least).
    """
    if not before:
        return False
    if {len(other) for other in before} == {len(field)}:
        return True
    decimals = {len(other.partition(decimal)[2]) for other in before}
    return decimals == {len(field.partition(decimal)[2])} and decimals != {0}
