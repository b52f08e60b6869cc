"""CSV and other tables of text, plain or packed with gzip or zstd."""

from __future__ import annotations

import codecs
import io
import os
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexid_cli.errors import InputError
from flexid_cli.readers.base import (
    DEFAULT_OPTIONS,
    ChannelInfo,
    Damage,
    Progress,
    RawChannel,
    RawLog,
    ReadOptions,
)
from flexid_cli.readers.damage import CURE
from flexid_cli.readers.dialect import (
    Detect,
    Dialect,
    Options,
    detect,
    detect_encoding,
    is_missing,
    is_number,
    split_line,
)
from flexid_cli.readers.lines import Block, Cutter, in_order, is_like_ascii, unified
from flexid_cli.readers.memory import keep_freed_memory
from flexid_cli.readers.messages import needs_integers
from flexid_cli.readers.packed import Fault, has_checksum, pieces
from flexid_cli.readers.path import missing_channel
from flexid_cli.readers.rows import RowReader, Rows
from flexid_cli.readers.table_gaps import TablePart, lost_rows, suspect_samples, without

_HEAD = 1 << 18
# Bytes of a file that are worth threads, and the start of compiled code.
_THREADED = 1 << 24
_COMPILED = 1 << 27
# Bytes that pandas parses at once, for it takes a millisecond or two to begin; compiled code takes half of them.
_BLOCK = 1 << 20
_SPLICE = 1 << 16  # samples converted in place at once
# Damage leaves most lines whole. Where more than this share of them does not fit, the table is not written
# as it seems to be, and what does fit may be read wrong.
_MOST_BAD = 0.1
_TOLD = 5  # bad lines of a file that are told one by one
_SOON = 100_000  # bad lines after which their share is looked at before the end


class CsvReader:
    """Reader of text tables.

    Parameters
    ----------
    options : Options, optional
        What the configuration fixes (``CsvOptions``); the rest is detected.
    """

    name = "csv"
    suffixes: tuple[str, ...] = (".csv", ".tsv", ".txt", ".dat", ".csv.gz", ".csv.zst")

    def __init__(self, options: Options | None = None) -> None:
        self.options: Options = options or Detect()
        self._sniffed: dict[Path, _Table] = {}

    def sniff(self, path: Path, head: bytes) -> bool:
        """Whether ``path`` is a text with rows of numbers."""
        if not head or path.is_dir():
            return False
        try:
            table = _Table(path, self.options)
        except InputError:
            return False
        self._sniffed[path] = table
        return _is_table(table.lines, table.dialect)

    def columns(self, paths: Sequence[Path]) -> list[str]:
        """List the names of the columns that hold numbers, by the first lines only.

        Raises
        ------
        InputError
            The table cannot be read without guessing.
        """
        dialect = self._open(paths)[0].dialect
        return [one.name for one, numeric in zip(dialect.fields, dialect.numeric, strict=True) if numeric]

    def channels(self, paths: Sequence[Path]) -> list[ChannelInfo]:
        """List the columns that hold numbers, with the unit that the header declares.

        Raises
        ------
        InputError
            The table cannot be read without guessing.
        """
        tables = self._open(paths)
        rows = sum(table.count() for table in tables)
        dialect = tables[0].dialect
        return [
            ChannelInfo(one.name, rows, one.unit, "column", _aliases(one.name, one.text, place))
            for place, one in enumerate(dialect.fields, start=1)
            if dialect.numeric[place - 1]
        ]

    def read(
        self, paths: Sequence[Path], sources: Sequence[str | int], options: ReadOptions = DEFAULT_OPTIONS
    ) -> RawLog:
        """Read columns by name or by number from 1; several files are appended in the given order.

        Lines that are damaged give no sample and are counted in ``RawLog.damage``. A table has no time of its
        own, so the window of ``options`` is left to who knows its time column.

        Raises
        ------
        InputError
            A column is missing, the table cannot be read without guessing, it holds no sample that can be
            trusted, or it is damaged and ``options`` are strict.
        """
        tables = self._open(paths)
        keep_freed_memory()
        places = {str(source): tables[0].place(source) for source in sources}
        progress = Progress(options, sum(_size(path) for path in paths))
        columns = {place: _Column() for place in sorted(set(places.values()))}
        accounts = [table.read(columns, options, progress) for table in tables]
        fields = tables[0].dialect.fields
        channels = {
            place: column.channel(fields[place].name, fields[place].unit) for place, column in columns.items()
        }
        parts = [account.part() for account in accounts]
        damage = [account.damage() for account in accounts]
        for number, (table, part) in enumerate(zip(tables, parts, strict=True)):
            if not table.has_checksum or damage[number].reasons:
                part.doubt(channels.values(), options.threads)
                damage[number] = part.count(damage[number])
        total = next(iter(columns.values())).size if columns else 0
        marks = suspect_samples(parts, total)
        if total == 0 or (marks is not None and marks.all() and not options.keep_suspect):
            raise _nothing(paths[0], damage, total)
        if options.strict and any(one.reasons for one in damage):
            raise _damaged(damage)
        if marks is not None and options.keep_suspect:
            channels = {place: replace(channel, suspect=marks) for place, channel in channels.items()}
        elif marks is not None:
            channels = without(channels, marks)
        lost = lost_rows(parts, None if options.keep_suspect else marks)
        read = {source: channels[place] for source, place in places.items()}
        return RawLog(self.name, tuple(paths), read, damage=tuple(damage), lost_rows=lost)

    def _open(self, paths: Sequence[Path]) -> list[_Table]:
        tables = [
            self._sniffed.pop(path) if path in self._sniffed else _Table(path, self.options) for path in paths
        ]
        first = tables[0]
        for table in tables[1:]:
            if [one.text for one in table.dialect.fields] != [one.text for one in first.dialect.fields]:
                raise InputError(
                    f"{table.path} and {first.path} have different columns, so they are not one recording",
                    "give the files of one run only",
                )
        return tables


def _nothing(path: Path, damage: Sequence[Damage], suspect: int) -> InputError:
    reasons = [reason for one in damage for reason in one.reasons]
    if suspect:
        return InputError(
            f"no sample of {path} can be trusted: {reasons[0]}",
            f"{CURE}; `--keep-suspect` gives the {suspect} samples that may be wrong",
        )
    if reasons:
        return InputError(f"{path} has no data rows that can be read: {reasons[0]}", CURE)
    return InputError(f"{path} has no data rows", "check that the log was written to its end")


def _damaged(damage: Sequence[Damage]) -> InputError:
    path, reason = next((one.path, reason) for one in damage for reason in one.reasons)
    return InputError(reason if str(path) in reason else f"{path} is damaged: {reason}", CURE)


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


class _Column:
    """The samples of one column of all files, in one buffer: integers until some block holds other numbers."""

    def __init__(self) -> None:
        self.size = 0
        self._integers = True
        self._buffer: NDArray[np.int64] = np.empty(0, dtype=np.int64)

    def reserve(self, size: int) -> None:
        """Make room for ``size`` samples in all; room that is never used takes no memory."""
        if size > self._buffer.size:
            grown = np.empty(size, dtype=np.int64)
            grown[: self.size] = self._buffer[: self.size]
            self._buffer = grown

    def extend(self, values: NDArray[Any]) -> None:
        """Append one block."""
        if self._integers and values.size and values.dtype.kind != "i":
            self._become_floats()
        stop = self.size + values.size
        if stop > self._buffer.size:
            self.reserve(max(stop, self._buffer.size + self._buffer.size // 2))
        target = self._buffer if self._integers else self._buffer.view(np.float64)
        target[self.size : stop] = values
        self.size = stop

    def _become_floats(self) -> None:
        floats = self._buffer.view(np.float64)
        for start in range(0, self.size, _SPLICE):
            part = slice(start, min(start + _SPLICE, self.size))
            floats[part] = self._buffer[part].astype(np.float64)
        self._integers = False

    def channel(self, name: str, unit: str | None) -> RawChannel:
        """Return all samples."""
        exact = None
        if self._integers:
            integers = self._buffer[: self.size]
            if needs_integers(integers):
                exact = integers.copy()
            self._become_floats()
        return RawChannel(name, self._buffer.view(np.float64)[: self.size], {}, unit, exact)


@dataclass
class _Account:
    """What was met in one file, while it is read."""

    path: Path
    line: int
    offset: int = 0  # samples of the files before
    rows: int = 0
    bad: int = 0
    lost: int | None = 0
    lost_bytes: int = 0
    suspect: list[tuple[int, int]] = field(default_factory=list)
    gaps: list[tuple[int, int | None]] = field(default_factory=list)  # samples before it, and rows if known
    reasons: list[str] = field(default_factory=list)
    first: InputError | None = None
    _stops: list[tuple[int, int, int]] = field(default_factory=list)
    _excused: int = 0  # bad lines where the packing is damaged: they say nothing about the rest

    def take(self, rows: Rows, stop: int) -> None:
        """Count a block that ends at byte ``stop`` of the text."""
        for one in rows.bad:
            self._tell(f"{self.path}:{self.line + one.place}: {one.words}", one.hint, bad=True)
        self.lose(len(rows.bad) if not rows.holes else None, rows.holes)
        self.gaps += [(self.rows + samples, count) for samples, count in rows.gaps]
        self.line += rows.lines
        self.rows += rows.count
        self._stops.append((stop, self.rows, self.bad))

    def fault(self, fault: Fault, stop: int) -> None:
        """Count what is lost at a fault at byte ``stop`` of the text, and doubt what comes before."""
        place = f":{self.line}" if fault.at_line else ""
        self._tell(f"{self.path}{place}: {fault.words}", CURE)
        self.lose(fault.lost, fault.lost_bytes)
        if fault.lost != 0:
            self.gaps.append((self.rows, None))
        if fault.doubt:
            before = [(rows, bad) for end, rows, bad in self._stops if end <= stop - fault.doubt]
            rows, bad = before[-1] if before else (0, 0)
            self.suspect.append((rows, self.rows))
            self._excused += self.bad - bad

    def lose(self, lines: int | None, count: int) -> None:
        self.lost = None if lines is None or self.lost is None else self.lost + lines
        self.lost_bytes += count

    def _tell(self, words: str, hint: str, *, bad: bool = False) -> None:
        self.bad += bad
        if not bad or self.bad <= _TOLD:
            self.reasons.append(words)
        self.first = self.first or InputError(words, hint)

    def refuse(self, *, strict: bool, end: bool = False) -> None:
        """Raise the first thing that was wrong where ``strict``, or where most likely the table is no such."""
        bad = self.bad - self._excused
        many = bad > _MOST_BAD * (bad + self.rows) and (end or bad > _SOON)
        if self.first is not None and (strict or many):
            raise self.first

    def damage(self) -> Damage:
        """Return the account."""
        reasons = list(self.reasons)
        if self.bad > _TOLD:
            reasons.append(f"{self.path}: {self.bad - _TOLD} more lines cannot be read")
        mask = np.zeros(self.rows, dtype=np.bool_)
        for first, stop in self.suspect:
            mask[first:stop] = True
        suspect = int(np.count_nonzero(mask))
        return Damage(
            self.path,
            trusted=self.rows - suspect,
            suspect=suspect,
            lost=self.lost,
            lost_bytes=self.lost_bytes,
            reasons=tuple(reasons),
        )

    def part(self) -> TablePart:
        """Return where its samples stand among those of all files, and what is missing there."""
        first = self.offset
        return TablePart(
            self.path,
            first,
            first + self.rows,
            [(first + place, count) for place, count in self.gaps],
            [(first + start, first + stop) for start, stop in self.suspect],
        )


class _Table:
    """One file and its dialect."""

    def __init__(self, path: Path, options: Options) -> None:
        self.path = path
        self.options = options
        head = _head(path)
        if not head:
            raise InputError(f"{path} is empty", "check that the log was written")
        self.lines, self._encoding = _first_lines(head, options, path)
        self.dialect: Dialect = detect(self.lines, options, name=str(path))
        self._line_bytes = len(head) / max(1, head.count(b"\n"))
        self._returns = b"\r" in head
        self._raw = is_like_ascii(self._encoding)
        self.has_checksum = has_checksum(path)

    def place(self, source: str | int) -> int:
        """Return the place of a column, from 0, by name, by the header's text, or by number from 1."""
        fields = self.dialect.fields
        text = str(source)
        if isinstance(source, str):
            for names in ([one.name for one in fields], [one.text for one in fields]):
                if text.strip() in names:
                    return names.index(text.strip())
        if text.strip().isdecimal() and 1 <= int(text) <= len(fields):
            return int(text) - 1
        if text.strip().isdecimal():
            raise InputError(
                f"{self.path}: there is no column {text}, for it has {len(fields)} columns",
                f"columns are counted from 1; `flexid inspect {self.path}` lists them",
            )
        known = [one.name for one in fields]
        detail = "" if self.dialect.header else ", for it has no header"
        raise missing_channel(text, list(dict.fromkeys(known)), log=str(self.path), detail=detail)

    def count(self) -> int:
        """Count the samples: the lines that have all fields."""
        account = _Account(self.path, self.dialect.first_line)
        with closing(self._rows((), account, None, _ignore)) as blocks:
            for _ in blocks:
                account.refuse(strict=False)
        account.refuse(strict=False, end=True)
        return account.rows

    def read(
        self,
        columns: dict[int, _Column],
        options: ReadOptions,
        progress: Progress,
    ) -> _Account:
        """Append the samples to ``columns``, and return what was met."""
        offset = next(iter(columns.values())).size if columns else 0
        account = _Account(self.path, self.dialect.first_line, offset)
        expected = offset + int(1.02 * _size(self.path) / self._line_bytes) + 64
        with closing(self._rows(tuple(columns), account, options.threads, progress.advance)) as blocks:
            for rows in blocks:
                account.refuse(strict=options.strict)
                for place, values in rows.columns.items():
                    columns[place].reserve(expected)
                    columns[place].extend(values)
        account.refuse(strict=options.strict, end=True)
        return account

    def _rows(
        self, wanted: tuple[int, ...], account: _Account, threads: int | None, advance: Callable[[int], None]
    ) -> Generator[Rows]:
        """Parse block by block in threads, in the order of the file, and keep account."""
        encoding = self._encoding.removesuffix("-sig") if self._raw else "utf-8"
        size = _size(self.path)
        parse = RowReader(self.dialect, encoding, wanted, compiled=size >= _COMPILED)
        if threads is None:
            threads = os.cpu_count() or 1 if size >= _THREADED else 1
        stop = 0
        with closing(in_order(parse, self._blocks(advance), threads)) as items:
            for item in items:
                if isinstance(item, Fault):
                    account.fault(item, stop)
                else:
                    rows, stop = item
                    account.take(rows, stop)
                    yield rows

    def _blocks(self, advance: Callable[[int], None]) -> Iterator[Block | Fault]:
        """Cut the text below the header into blocks of whole lines."""
        cutter = Cutter(self.dialect, _BLOCK // 2 if _size(self.path) >= _COMPILED else _BLOCK)
        for piece in unified(pieces(self.path, advance), self._encoding, returns=self._returns):
            yield from cutter.fault(piece) if isinstance(piece, Fault) else cutter.feed(piece)
        yield from cutter.end()


def _ignore(_count: int) -> None:
    """Take no notice of progress."""


def _head(path: Path) -> bytes:
    """Return the first bytes of the text, up to a place where something is lost."""
    head = b""
    with closing(pieces(path, _ignore)) as blocks:
        for block in blocks:
            if isinstance(block, Fault):
                if block.lost is None:
                    break
                continue
            head += block
            if len(head) >= _HEAD:
                break
    return head[:_HEAD]


def _first_lines(head: bytes, options: Options, path: Path) -> tuple[list[str], str]:
    """Decode the first bytes; return the whole lines among them, and the encoding."""
    encoding = options.encoding or detect_encoding(head, whole=len(head) < _HEAD)
    if encoding is None:
        raise InputError(f"{path} is no text", "flexid reads CSV, MCAP, rosbag2 and ROS 1 bags")
    try:
        decoder = codecs.getincrementaldecoder(encoding)(errors="strict" if options.encoding else "replace")
        text = io.IncrementalNewlineDecoder(decoder, translate=True).decode(head)
    except (LookupError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path} is not written in {encoding!r}: {error}", "correct `csv: {encoding: ...}`"
        ) from error
    lines = text.split("\n")
    return lines[:-1] if lines[-1] == "" or len(lines) > 3 else lines, encoding


def _is_table(lines: Sequence[str], dialect: Dialect) -> bool:
    """Whether most of the lines below the header are rows with a number, or rows of missing values."""
    start = dialect.first_line - 1
    rows = [split_line(line, dialect.delimiter) for line in lines[start : start + 200] if line.strip()]
    whole = [row for row in rows if len(row) == len(dialect.fields)]
    good = sum(
        any(is_number(cell, dialect.decimal) for cell in row) or all(map(is_missing, row)) for row in whole
    )
    return good > 0.7 * len(rows) and not lines[0].lstrip().startswith(("{", "[", "<"))


def _aliases(name: str, text: str, place: int) -> tuple[str, ...]:
    return tuple(dict.fromkeys(other for other in (text, str(place)) if other != name))
