"""Lines of text for terminals of any width, on which no number is broken."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import starmap
from typing import TYPE_CHECKING, Any

from flexid_cli.report import words
from flexid_cli.report.numbers import MISSING

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

_NAME_COLUMN = 1


@dataclass(frozen=True)
class Line:
    """One line; ``wrap`` is off where it holds numbers that must stay whole."""

    text: str
    style: str = ""
    wrap: bool = True
    verdict: str = ""


@dataclass(frozen=True)
class Table:
    """Cells of a table, one verdict (or none) for each row; numeric columns stand to the right."""

    titles: tuple[str, ...]
    right: tuple[bool, ...]
    rows: tuple[tuple[str, ...], ...]
    verdicts: tuple[str, ...]


def estimates(parameters: Sequence[Mapping[str, Any]], width: int) -> Iterator[Line]:
    """Yield the widest layout that fits: with names, without names, or one parameter below the other."""
    table = _table(parameters)
    without_names = _drop(table, _NAME_COLUMN)
    for candidate in (table, without_names):
        lines = list(aligned(candidate))
        if all(len(line.text) <= width for line in lines):
            yield from lines
            return
    yield from _stacked(parameters)


def fitting(table: Table, width: int) -> Iterator[Line]:
    """Yield the table, or where it is too wide, the cells of each row below one another."""
    lines = list(aligned(table))
    if all(len(line.text) <= width for line in lines):
        yield from lines
        return
    for row, verdict in zip(table.rows, table.verdicts, strict=True):
        yield Line(row[0], wrap=False)
        for title, cell in zip(table.titles[1:], row[1:], strict=True):
            text = f"  {title}: {cell}"
            parts = [text] if len(text) <= width else [f"  {title}:", f"    {cell}"]
            is_word = verdict and cell == words.VERDICTS[verdict]
            for part in parts:
                yield Line(part, wrap=False, verdict=verdict if is_word and part.endswith(cell) else "")


def _table(parameters: Sequence[Mapping[str, Any]]) -> Table:
    header = words.interval_header(parameters)
    rows = []
    for parameter in parameters:
        estimate, interval, relative = words.estimate_cells(parameter, with_level=header == "interval")
        name, verdict = words.plain_name(parameter), words.VERDICTS[parameter["verdict"]]
        rows.append(
            (parameter["symbol"], name, estimate, interval, words.unit_cell(parameter), relative, verdict)
        )
    return Table(
        titles=("", "", "estimate", header, "unit", "rel. %", "verdict"),
        right=(False, False, True, True, False, True, False),
        rows=tuple(rows),
        verdicts=tuple(parameter["verdict"] for parameter in parameters),
    )


def _drop(table: Table, column: int) -> Table:
    def without(cells: tuple[Any, ...]) -> tuple[Any, ...]:
        return cells[:column] + cells[column + 1 :]

    rows = tuple(without(row) for row in table.rows)
    return Table(without(table.titles), without(table.right), rows, table.verdicts)


def aligned(table: Table) -> Iterator[Line]:
    """Yield the header, a rule and the rows, each column as wide as its widest cell."""
    widths = [max(map(len, column)) for column in zip(table.titles, *table.rows, strict=True)]

    def line(cells: Sequence[str]) -> str:
        placed = starmap(_placed, zip(cells, widths, table.right, strict=True))
        return "  ".join(placed).rstrip()

    yield Line(line(table.titles), style="bold", wrap=False)
    yield Line("  ".join("─" * width for width in widths), wrap=False)
    for row, verdict in zip(table.rows, table.verdicts, strict=True):
        yield Line(line([cell or MISSING for cell in row]), wrap=False, verdict=verdict)


def _placed(cell: str, width: int, right: bool) -> str:
    return cell.rjust(width) if right else cell.ljust(width)


def _stacked(parameters: Sequence[Mapping[str, Any]]) -> Iterator[Line]:
    """Yield two or three short lines for each parameter, for terminals that are too narrow for the table."""
    for parameter in parameters:
        estimate, interval, _ = words.estimate_cells(parameter)
        word = words.VERDICTS[parameter["verdict"]]
        yield Line(f"{parameter['symbol']}: {word}", wrap=False, verdict=parameter["verdict"])
        yield Line(f"  {estimate} {parameter['unit']}".rstrip(), wrap=False)
        if interval != MISSING:
            yield Line(f"  {words.interval_header([parameter])}:", wrap=False)
            yield Line(f"  {interval}", wrap=False)
