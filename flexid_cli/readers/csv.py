"""CSV and other tables of text, plain or packed with gzip or zstd."""

from __future__ import annotations

import codecs
import io
import zlib
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flexid_cli.errors import InputError
from flexid_cli.readers.base import ChannelInfo, Note, RawChannel, RawLog
from flexid_cli.readers.damage import decoding, unreadable
from flexid_cli.readers.dialect import (
    MISSING,
    WHITESPACE,
    Detect,
    Dialect,
    Options,
    detect,
    detect_encoding,
    is_missing,
    is_number,
    is_whole,
    split_line,
)
from flexid_cli.readers.messages import needs_integers
from flexid_cli.readers.path import missing_channel

if TYPE_CHECKING:
    import pandas as pd

GZIP_MAGIC = b"\x1f\x8b"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_BLOCK = 1 << 22  # characters parsed at once
_HEAD = 1 << 18
_READ = 1 << 20


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

    def sniff(self, path: Path, head: bytes) -> bool:
        """Whether ``path`` is a text with rows of numbers."""
        if not head or path.is_dir():
            return False
        try:
            start = _Bytes(path).head()
            lines, _ = _first_lines(start, self.options, path)
            dialect = detect(lines, self.options, name=str(path))
        except InputError:
            return False
        return _is_table(lines, dialect)

    def channels(self, paths: Sequence[Path]) -> list[ChannelInfo]:
        """List the columns that hold numbers, with the unit that the header declares.

        Raises
        ------
        InputError
            The table cannot be read without guessing.
        """
        tables = self._open(paths)
        rows = sum(block.rows for table in tables for block in table.blocks())
        dialect = tables[0].dialect
        return [
            ChannelInfo(one.name, rows, one.unit, "column", _aliases(one.name, one.text, place))
            for place, one in enumerate(dialect.fields, start=1)
            if dialect.numeric[place - 1]
        ]

    def read(self, paths: Sequence[Path], sources: Sequence[str | int]) -> RawLog:
        """Read columns by name or by number from 1; several files are appended in the given order.

        Raises
        ------
        InputError
            A column is missing, holds a text, or the table cannot be read without guessing.
        """
        tables = self._open(paths)
        places = {str(source): tables[0].place(source) for source in sources}
        wanted = sorted(set(places.values()))
        gathered: dict[int, list[NDArray[Any]]] = {place: [] for place in wanted}
        for table in tables:
            for block in table.blocks():
                for place, values in table.numbers(block, wanted).items():
                    gathered[place].append(values)
        notes = [note for table in tables for note in table.notes]
        fields = tables[0].dialect.fields
        channels = {
            place: _channel(fields[place].name, fields[place].unit, gathered[place]) for place in wanted
        }
        if not channels or not next(iter(channels.values())).values.size:
            raise InputError(f"{paths[0]} has no data rows", "check that the log was written to its end")
        read = {source: channels[place] for source, place in places.items()}
        return RawLog(self.name, tuple(paths), read, tuple(notes))

    def _open(self, paths: Sequence[Path]) -> list[_Table]:
        tables = [_Table(path, self.options) for path in paths]
        first = tables[0]
        for table in tables[1:]:
            if [one.text for one in table.dialect.fields] != [one.text for one in first.dialect.fields]:
                raise InputError(
                    f"{table.path} and {first.path} have different columns, so they are not one recording",
                    "give the files of one run only",
                )
        return tables


@dataclass(frozen=True)
class _Block:
    """Whole lines of samples, without comments and blank lines.

    Attributes
    ----------
    text : str
        The lines.
    rows : int
        Their number.
    lines : sequence of int
        Number of each line in the file, from 1.
    """

    text: str
    rows: int
    lines: Sequence[int]


class _Bytes:
    """The unpacked bytes of a file; ``cut`` tells afterwards whether a packed file is cut short."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.cut = False

    def head(self) -> bytes:
        """Return the first bytes."""
        start = b""
        for block in self:
            start += block
            if len(start) >= _HEAD:
                break
        return start[:_HEAD]

    def __iter__(self) -> Iterator[bytes]:
        try:
            with self.path.open("rb") as stream:
                start = stream.read(4)
                stream.seek(0)
                blocks = iter(lambda: stream.read(_READ), b"")
                packed = start.startswith(GZIP_MAGIC) or start == ZSTD_MAGIC
                yield from self._unpacked(blocks, zstd=start == ZSTD_MAGIC) if packed else blocks
        except OSError as error:
            raise unreadable(self.path, error) from error

    def _unpacked(self, blocks: Iterable[bytes], *, zstd: bool) -> Iterator[bytes]:
        member = _member(zstd=zstd)
        for block in blocks:
            rest = block
            while rest:
                if member.eof:
                    if not rest.strip(b"\0"):
                        break
                    member = _member(zstd=zstd)
                with decoding(self.path, "its packed content"):
                    plain = member.decompress(rest)
                rest = member.unused_data if member.eof else b""
                yield plain
        self.cut = not member.eof


def _member(*, zstd: bool) -> Any:
    if zstd:
        import zstandard

        return zstandard.ZstdDecompressor().decompressobj()
    return zlib.decompressobj(wbits=31)


@dataclass
class _Table:
    """One file, its dialect, and what was noticed while reading it."""

    path: Path
    options: Options
    notes: list[Note] = field(default_factory=list)

    def __post_init__(self) -> None:
        head = _Bytes(self.path).head()
        if not head:
            raise InputError(f"{self.path} is empty", "check that the log was written")
        lines, self._encoding = _first_lines(head, self.options, self.path)
        self.dialect: Dialect = detect(lines, self.options, name=str(self.path))
        self._recent: deque[str] = deque(maxlen=20)

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

    def blocks(self) -> Iterator[_Block]:
        """Yield the samples as blocks of lines whose number of fields is checked.

        Raises
        ------
        InputError
            A line has too few or too many fields, or the text cannot be decoded.
        """
        self.notes.clear()
        source = _Bytes(self.path)
        rest, number = "", 1
        for text in self._texts(source):
            rest += text
            end = rest.rfind("\n") + 1
            if end >= _BLOCK:
                block = self._block(rest[:end], number)
                number, rest = number + rest.count("\n", 0, end), rest[end:]
                if block.rows:
                    yield block
        end = rest.rfind("\n") + 1
        block = self._block(rest[:end], number)
        last = self._last(rest[end:], number + rest.count("\n", 0, end), cut=source.cut)
        if block.rows or last:
            lines = [*block.lines, last[0]] if last else block.lines
            yield _Block(block.text + (last[1] if last else ""), block.rows + bool(last), lines)

    def _texts(self, source: _Bytes) -> Iterator[str]:
        decoder = io.IncrementalNewlineDecoder(codecs.getincrementaldecoder(self._encoding)(), translate=True)
        for block in source:
            yield self._decode(decoder, block, final=False)
        if not source.cut:
            yield self._decode(decoder, b"", final=True)

    def _decode(self, decoder: io.IncrementalNewlineDecoder, block: bytes, *, final: bool) -> str:
        try:
            return decoder.decode(block, final=final)
        except UnicodeDecodeError as error:
            raise InputError(
                f"{self.path} is not written in {self._encoding}: {error.reason}",
                "name its encoding: `csv: {encoding: latin-1}`",
            ) from error

    def _block(self, text: str, number: int) -> _Block:
        """Keep the samples of whole lines, the first of which is line ``number`` of the file."""
        width, delimiter = len(self.dialect.fields), self.dialect.delimiter
        count = text.count("\n")
        plain = number >= self.dialect.first_line and delimiter != WHITESPACE
        odd = ('"', *self.dialect.comments)
        if plain and not any(mark in text for mark in odd) and _is_even(text, delimiter, width):
            self._remember(text)
            return _Block(text, count, range(number, number + count))
        kept, lines = [], []
        for place, line in enumerate(text.split("\n")[:-1], start=number):
            if place < self.dialect.first_line or not line.strip():
                continue
            if line.lstrip().startswith(self.dialect.comments):
                continue
            self._check_width(line, place)
            kept.append(line)
            lines.append(place)
        joined = "\n".join(kept) + "\n" if kept else ""
        self._remember(joined)
        return _Block(joined, len(kept), lines)

    def _check_width(self, line: str, number: int) -> None:
        width = len(self.dialect.fields)
        found = len(split_line(line, self.dialect.delimiter))
        if found != width:
            raise InputError(
                f"{self.path}:{number}: the line has {found} fields, not {width}: {line.strip()[:60]!r}",
                "correct or remove the line; the file may be two recordings in one, or damaged",
            )

    def _remember(self, text: str) -> None:
        tail = text[-4096:].split("\n")[-21:-1]
        self._recent.extend(split_line(line, self.dialect.delimiter)[-1] for line in tail)

    def _last(self, line: str, number: int, *, cut: bool) -> tuple[int, str] | None:
        """Return the last line, which has no line end, if it is surely whole; else note its loss."""
        if not line.strip() or line.lstrip().startswith(self.dialect.comments):
            if cut:
                self.notes.append(Note(f"{self.path} is cut short; what comes before was read"))
            return None
        cells = split_line(line, self.dialect.delimiter)
        whole = len(cells) == len(self.dialect.fields)
        sure = whole and is_whole(cells[-1], list(self._recent), self.dialect.decimal)
        if sure and not cut and number >= self.dialect.first_line:
            return number, f"{line}\n"
        why = "the file is cut short" if cut else "it has no line end"
        self.notes.append(
            Note(f"{self.path}:{number}: the last line was dropped, for {why} and it may be cut")
        )
        return None

    def numbers(self, block: _Block, wanted: Sequence[int]) -> dict[int, NDArray[Any]]:
        """Parse columns of a block: int64 arrays where all are integers, else float64."""
        frame = self._frame(block, wanted)
        columns = {place: self._column(frame[place], place, block) for place in wanted}
        signed = "-0" in block.text
        zeros = [
            place
            for place, values in columns.items()
            if signed and values.dtype.kind == "i" and not values.all()
        ]
        if zeros:  # an integer has no negative zero
            again = self._frame(block, zeros, dtype="float64")
            columns.update({place: again[place].to_numpy() for place in zeros})
        return columns

    def _frame(self, block: _Block, wanted: Sequence[int], **how: Any) -> pd.DataFrame:
        import pandas as pd

        delimiter = self.dialect.delimiter
        try:
            frame: pd.DataFrame = pd.read_csv(
                io.StringIO(block.text),
                sep=r"\s+" if delimiter == WHITESPACE else delimiter,
                decimal=self.dialect.decimal,
                header=None,
                names=list(range(len(self.dialect.fields))),
                index_col=False,
                usecols=list(wanted),
                na_values=list(MISSING),
                keep_default_na=False,
                skipinitialspace=True,
                low_memory=False,
                **_exact_floats(),
                **how,
            )
        except (pd.errors.ParserError, ValueError) as error:
            for line, number in zip(block.text.split("\n"), block.lines, strict=False):
                self._check_width(line, number)
            raise InputError(f"{self.path} cannot be read as a table ({error})") from error
        return frame

    def _column(self, series: pd.Series[Any], place: int, block: _Block) -> NDArray[Any]:
        if series.dtype.kind in "if":
            return series.to_numpy()
        if series.dtype.kind in "bu":
            return series.to_numpy().astype(np.float64)
        values = np.empty(len(series))
        for row, value in enumerate(series.tolist()):
            values[row] = self._number(value, place, row, block)
        return values

    def _number(self, value: Any, place: int, row: int, block: _Block) -> float:
        if not isinstance(value, str):
            return float("nan") if value is None else float(value)
        if is_missing(value):
            return float("nan")
        if is_number(value, self.dialect.decimal):
            truth = {"true": 1.0, "false": 0.0}.get(value.strip().lower())
            return float(value.replace(self.dialect.decimal, ".")) if truth is None else truth
        name = self.dialect.fields[place].name
        mark = "decimal comma" if self.dialect.decimal == "," else "decimal point"
        raise InputError(
            f"{self.path}:{block.lines[row]}: column {name!r} has the text {value[:40]!r}, not a number",
            f"correct the line, or leave the field empty; numbers are read with a {mark}, which "
            "`csv: {decimal: ...}` sets",
        )


def _is_even(text: str, delimiter: str, width: int) -> bool:
    """Whether each line has exactly ``width`` fields, and none is blank."""
    marks = np.frombuffer(text.encode(), dtype=np.uint8)
    ends = marks == ord("\n")
    if width == 1 or ord(delimiter) > 127:
        return False
    marks = marks[ends | (marks == ord(delimiter))]
    if marks.size % width:
        return False
    lines = marks.reshape(-1, width) == ord("\n")
    return bool(lines[:, -1].all()) and not lines[:, :-1].any()


def _exact_floats() -> Mapping[str, Any]:
    """Ask for correctly rounded numbers where that is not the parser's only way."""
    import pandas as pd

    major, minor = (int(part) for part in pd.__version__.split(".")[:2])
    return {} if (major, minor) >= (3, 1) else {"float_precision": "round_trip"}


def _first_lines(head: bytes, options: Options, path: Path) -> tuple[list[str], str]:
    """Decode the first bytes; return the whole lines among them, and the encoding."""
    encoding = options.encoding or detect_encoding(head, whole=len(head) < _HEAD)
    if encoding is None:
        raise InputError(f"{path} is no text", "flexid reads CSV, MCAP, rosbag2 and ROS 1 bags")
    try:
        decoder = codecs.getincrementaldecoder(encoding)()
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


def _channel(name: str, unit: str | None, parts: Sequence[NDArray[Any]]) -> RawChannel:
    values = np.concatenate([part.astype(np.float64) for part in parts]) if parts else np.empty(0)
    exact = None
    if parts and all(part.dtype.kind == "i" for part in parts):
        integers = np.concatenate([part.astype(np.int64) for part in parts])
        exact = integers if needs_integers(integers) else None
    return RawChannel(name, values, {}, unit, exact)
