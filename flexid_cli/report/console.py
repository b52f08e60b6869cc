"""The report on a terminal: short, 80 columns, never a broken number."""

from __future__ import annotations

import io
from dataclasses import dataclass
from itertools import starmap
from typing import TYPE_CHECKING, Any

from flexid_cli.report import words
from flexid_cli.report.numbers import MISSING, format_significant

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from rich.console import Console

_STYLES = {"identified": "green", "weak": "yellow", "not_identifiable": "red"}
_NAME_COLUMN = 1
_ASCII = str.maketrans(
    {
        "–": "-",
        "—": "-",
        "−": "-",
        "─": "-",
        "±": "+/-",
        "·": ".",
        "×": "x",
        "²": "^2",
        "³": "^3",
        "µ": "u",
        "μ": "u",
        "°": "deg",
        "→": "->",
        "≤": "<=",
        "≥": ">=",
        "√": "sqrt",
        "ω": "w",
        "σ": "sigma",
    }
)


@dataclass(frozen=True)
class _Line:
    """One line; ``wrap`` is off where it holds numbers that must stay whole."""

    text: str
    style: str = ""
    wrap: bool = True
    verdict: str = ""


@dataclass(frozen=True)
class _Table:
    """Cells of an estimates table, one verdict for each row; numeric columns stand to the right."""

    titles: tuple[str, ...]
    right: tuple[bool, ...]
    rows: tuple[tuple[str, ...], ...]
    verdicts: tuple[str, ...]


def render_console(
    document: Mapping[str, Any], *, width: int = 80, colour: bool = False, encoding: str = "utf-8"
) -> str:
    """Return the report as it looks on a terminal of ``width`` columns.

    Parameters
    ----------
    document : mapping
        From `build_document`.
    width : int
        Columns. Where the parameter table does not fit, each parameter gets lines of its own.
    colour : bool
        Colour the verdicts; NO_COLOR in the environment overrules it. They always stand there as words too.
    encoding : str
        Encoding of the terminal; other than UTF-8 gives plain ASCII.
    """
    from rich.console import Console

    buffer = io.StringIO()
    console = Console(
        file=buffer,
        width=width,
        force_terminal=colour,
        color_system="standard" if colour else None,
        no_color=None if colour else True,
        legacy_windows=False,
    )
    print_report(document, console, encoding=encoding)
    return buffer.getvalue()


def print_report(document: Mapping[str, Any], console: Console, *, encoding: str | None = None) -> None:
    """Print the report on a rich console, whose width, colour and encoding it follows."""
    from rich.text import Text

    unicode = (encoding or console.encoding).lower().replace("-", "").replace("_", "") == "utf8"
    for line in _lines(document, console.width):
        shown = line.text if unicode else _to_ascii(line.text)
        text = Text(shown, style=line.style)
        if line.verdict:
            word = words.VERDICTS[line.verdict]
            start = shown.rfind(word)
            text.stylize(_STYLES[line.verdict], start, start + len(word))
        for part in text.wrap(console, console.width) if line.wrap else [text]:
            part.rstrip()
            console.print(part, highlight=False, no_wrap=True, overflow="ignore", crop=False)


def _to_ascii(text: str) -> str:
    return text.translate(_ASCII).encode("ascii", "backslashreplace").decode("ascii")


def _lines(document: Mapping[str, Any], width: int) -> Iterator[_Line]:
    recording = document["recording"]
    yield _Line(f"Drive parameters of {words.axis_name(document)}", style="bold")
    yield _Line(
        f"{recording['samples']} samples at {format_significant(recording['sample_rate_hz'], 6)} Hz, "
        f"{words.duration(recording['duration_s'])}"
    )
    side = words.side_sentence(document)
    if side:
        yield _Line(side)
    for model in document["models"]:
        yield _Line("")
        yield from _model(model, width)
    for skipped in document["skipped"]:
        yield _Line("")
        yield _Line(f"Model {skipped['id']} was not solved: {skipped['reason']}")
    yield from _warnings(document)


def _model(model: Mapping[str, Any], width: int) -> Iterator[_Line]:
    yield _Line(f"Model {model['id']}", style="bold")
    yield _Line(words.verdict_sentence(model))
    yield _Line("")
    yield from _estimates(model["parameters"], width)
    if model["derived"]:
        yield _Line("")
        yield from _estimates(model["derived"], width)
    yield _Line("")
    for name, verdict, reason in words.reasons([*model["parameters"], *model["derived"]]):
        yield _Line(f"{name} ({verdict}): {reason}")
    yield _Line(words.fit_sentence(model))
    yield _Line(words.band_sentence(model))


def _warnings(document: Mapping[str, Any]) -> Iterator[_Line]:
    lines = [note for entry in document["inputs"] for note in words.input_notes(entry)]
    lines += document["warnings"]
    for model in document["models"]:
        lines += words.model_warnings(model)
    if lines:
        yield _Line("")
    for line in lines:
        yield _Line(f"Warning: {line}", style="yellow")


def _estimates(parameters: Sequence[Mapping[str, Any]], width: int) -> Iterator[_Line]:
    """Yield the widest layout that fits: with names, without names, or one parameter below the other."""
    table = _table(parameters)
    without_names = _drop(table, _NAME_COLUMN)
    for candidate in (table, without_names):
        lines = list(_aligned(candidate))
        if all(len(line.text) <= width for line in lines):
            yield from lines
            return
    yield from _stacked(parameters)


def _table(parameters: Sequence[Mapping[str, Any]]) -> _Table:
    header = words.interval_header(parameters)
    rows = []
    for parameter in parameters:
        estimate, interval, relative = words.estimate_cells(parameter, with_level=header == "interval")
        name, verdict = words.plain_name(parameter), words.VERDICTS[parameter["verdict"]]
        rows.append(
            (parameter["symbol"], name, estimate, interval, words.unit_cell(parameter), relative, verdict)
        )
    return _Table(
        titles=("", "", "estimate", header, "unit", "rel. %", "verdict"),
        right=(False, False, True, True, False, True, False),
        rows=tuple(rows),
        verdicts=tuple(parameter["verdict"] for parameter in parameters),
    )


def _drop(table: _Table, column: int) -> _Table:
    def without(cells: tuple[Any, ...]) -> tuple[Any, ...]:
        return cells[:column] + cells[column + 1 :]

    rows = tuple(without(row) for row in table.rows)
    return _Table(without(table.titles), without(table.right), rows, table.verdicts)


def _aligned(table: _Table) -> Iterator[_Line]:
    """Yield the header, a rule and the rows, each column as wide as its widest cell."""
    widths = [max(map(len, column)) for column in zip(table.titles, *table.rows, strict=True)]

    def line(cells: Sequence[str]) -> str:
        placed = starmap(_placed, zip(cells, widths, table.right, strict=True))
        return "  ".join(placed).rstrip()

    yield _Line(line(table.titles), style="bold", wrap=False)
    yield _Line("  ".join("─" * width for width in widths), wrap=False)
    for row, verdict in zip(table.rows, table.verdicts, strict=True):
        yield _Line(line([cell or MISSING for cell in row]), wrap=False, verdict=verdict)


def _placed(cell: str, width: int, right: bool) -> str:
    return cell.rjust(width) if right else cell.ljust(width)


def _stacked(parameters: Sequence[Mapping[str, Any]]) -> Iterator[_Line]:
    """Yield two or three short lines for each parameter, for terminals that are too narrow for the table."""
    for parameter in parameters:
        estimate, interval, _ = words.estimate_cells(parameter)
        word = words.VERDICTS[parameter["verdict"]]
        yield _Line(f"{parameter['symbol']}: {word}", wrap=False, verdict=parameter["verdict"])
        yield _Line(f"  {estimate} {parameter['unit']}".rstrip(), wrap=False)
        if interval != MISSING:
            yield _Line(f"  {words.interval_header([parameter])}:", wrap=False)
            yield _Line(f"  {interval}", wrap=False)
