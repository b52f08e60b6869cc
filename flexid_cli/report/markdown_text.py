"""Blocks of Markdown that GitHub, GitLab and pandoc show alike; shared by the parts of the report."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from flexid_cli.report import words
from flexid_cli.report.numbers import MISSING

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

_SPECIAL = re.compile(r"[\\`*\[\]<>|~^$&#]|(?<![^\W_])_|_(?![^\W_])|^[-+=]")
_LIST_NUMBER = re.compile(r"^(\d+)([.)])(?=\s|$)")


def escape(text: str) -> str:
    """Escape what Markdown, GitHub's tables and mathematics, or pandoc's extensions would interpret."""
    one_line = " ".join(str(text).split())
    escaped = _SPECIAL.sub(lambda match: "\\" + match.group(0), one_line)
    return _LIST_NUMBER.sub(r"\1\\\2", escaped)


def estimates(parameters: Sequence[Mapping[str, Any]]) -> str:
    """Table of estimates with intervals and verdicts."""
    header = words.interval_header(parameters)
    interval_title = header[0].upper() + header[1:]
    titles = ("Symbol", "Name", "Estimate", interval_title, "Unit", "Rel. std. dev. %", "Verdict")
    rows = []
    for parameter in parameters:
        estimate, interval, relative = words.estimate_cells(parameter, with_level=header == "interval")
        verdict = words.VERDICTS[parameter["verdict"]]
        symbol, unit = escape(parameter["symbol"]), escape(words.unit_cell(parameter))
        rows.append((symbol, escape(parameter["name"]), estimate, interval, unit, relative, verdict))
    return table(titles, "llrrlrl", rows)


def table(titles: Sequence[str], alignment: str, rows: Sequence[Sequence[str]]) -> str:
    """Pipe table; ``alignment`` has l or r for each column. Cells are escaped by the caller."""
    rules = ["---:" if side == "r" else ":---" for side in alignment]
    lines = [titles, rules, *([cell or MISSING for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def bullets(lines: Iterable[str]) -> str:
    """Bulleted list, one line each."""
    return "\n".join(f"- {line}" for line in lines)


def numbered(lines: Iterable[str]) -> str:
    """Numbered list, one line each."""
    return "\n".join(f"{number}. {line}" for number, line in enumerate(lines, start=1))


def code(text: str) -> str:
    """Fenced block whose fence is longer than any run of backticks in the text."""
    longest = max((len(run) for run in re.findall(r"`+", text)), default=0)
    fence = "`" * max(3, longest + 1)
    return f"{fence}text\n{text}\n{fence}"
