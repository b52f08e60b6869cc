"""The report on a terminal: short, 80 columns, never a broken number."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

from flexid_cli.report import diagnosis_words as say
from flexid_cli.report import words
from flexid_cli.report.diagnosis_console import diagnosis_lines
from flexid_cli.report.lines import Line, Table, estimates, fitting
from flexid_cli.report.numbers import format_significant

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from rich.console import Console

_STYLES = {"identified": "green", "weak": "yellow", "not_identifiable": "red"}
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


def _lines(document: Mapping[str, Any], width: int) -> Iterator[Line]:
    if document["diagnosis"] is not None:
        yield from diagnosis_lines(document, width)
    else:
        yield from _identification(document, width)
    yield from _warnings(document)


def _identification(document: Mapping[str, Any], width: int) -> Iterator[Line]:
    recording = document["recording"]
    yield Line(f"Drive parameters of {words.axis_name(document)}", style="bold")
    yield Line(
        f"{recording['samples']} samples at {format_significant(recording['sample_rate_hz'], 6)} Hz, "
        f"{words.duration(recording['duration_s'])}"
    )
    side = words.side_sentence(document)
    if side:
        yield Line(side)
    for model in document["models"]:
        yield Line("")
        yield from _model(model, width)
    for skipped in document["skipped"]:
        yield Line("")
        yield Line(f"Model {skipped['id']} was not solved: {skipped['reason']}")


def _model(model: Mapping[str, Any], width: int) -> Iterator[Line]:
    yield Line(f"Model {model['id']}", style="bold")
    yield Line(words.verdict_sentence(model))
    yield Line("")
    yield from estimates(model["parameters"], width)
    yield from _records(model, width)
    if model["derived"]:
        yield Line("")
        yield from estimates(model["derived"], width)
    yield from _joined(model, width)
    yield Line("")
    for name, verdict, reason in words.reasons(words.reported(model)):
        yield Line(f"{name} ({verdict}): {reason}")
    for names, advice in words.advices([*model["parameters"], *model["derived"]]):
        yield Line(f"To determine {names}, record {advice}.")
    yield Line(words.fit_sentence(model))
    yield Line(words.band_sentence(model))


def _joined(model: Mapping[str, Any], width: int) -> Iterator[Line]:
    """Effects that were named, and the parameters without them."""
    for effect in model.get("effects", ()):
        yield Line("")
        yield Line(f"With {say.joined_effect(effect)}")
        yield from estimates(effect["parameters"], width)
    if model.get("parameters_before"):
        yield Line("")
        yield Line(words.WITHOUT_EFFECTS)
        yield from estimates(model["parameters_before"], width)


def _records(model: Mapping[str, Any], width: int) -> Iterator[Line]:
    """Estimates of each record of a joint fit, beside the joint ones."""
    titles, rows = words.records_table(model)
    if rows:
        right = (False, *(True for _ in titles[1:]))
        yield Line("")
        yield Line(words.ALONE)
        yield from fitting(Table(titles, right, tuple(rows), tuple("" for _ in rows)), width)


def _warnings(document: Mapping[str, Any]) -> Iterator[Line]:
    lines = [note for entry in document["inputs"] for note in words.input_notes(entry)]
    lines += document["warnings"]
    for model in document["models"]:
        lines += words.model_warnings(model)
    if lines:
        yield Line("")
    for line in lines:
        yield Line(f"Warning: {line}", style="yellow")
