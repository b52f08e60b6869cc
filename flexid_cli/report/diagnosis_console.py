"""The diagnosis on a terminal: the sentence, the effects, the parameters before and after."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from flexid_cli.report import diagnosis_words as say
from flexid_cli.report import locality_words, words
from flexid_cli.report.lines import Line, Table, estimates, fitting
from flexid_cli.report.numbers import MISSING

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

_STYLES = {
    "adequate": "bold green",
    "explained": "bold green",
    "partly_explained": "bold yellow",
    "ambiguous": "bold yellow",
    "unexplained": "bold red",
    "inconclusive": "bold red",
}


def diagnosis_lines(document: Mapping[str, Any], width: int) -> Iterator[Line]:
    """Yield the lines of the report of a diagnosis, for a terminal of ``width`` columns."""
    diagnosis = document["diagnosis"]
    verdict = diagnosis["verdict"]
    yield Line(f"Diagnosis of {words.axis_name(document)}: {say.phrase(verdict)}", style=_STYLES[verdict])
    yield Line(diagnosis["sentence"])
    yield from _effects(diagnosis, width)
    left = say.left_sentence(diagnosis)
    if left:
        yield from (Line(""), Line(left))
    yield from _locality(diagnosis)
    yield from _parameters(diagnosis, width)
    side = words.side_sentence(document)
    if side and (diagnosis["parameters_before"] or diagnosis["parameters_after"]):
        yield Line(side)
    yield from _fit(diagnosis, width)
    yield from _next(diagnosis)


def _effects(diagnosis: Mapping[str, Any], width: int) -> Iterator[Line]:
    effects = diagnosis["effects"]
    if not effects:
        return
    yield Line("")
    yield from fitting(_effect_table(effects), width)
    for effect in effects:
        yield Line("")
        yield Line(f"{effect['name']} ({effect['code']})", style="bold")
        if effect["alternatives"]:
            yield Line(say.alternatives_sentence(effect), style="yellow")
        if effect["parameters"]:
            yield from estimates(effect["parameters"], width)
            yield from _reasons(effect["parameters"])
    yield Line("")
    name = effects[0]["name"] if len(effects) == 1 else "NAME"
    yield Line(f"`flexid explain {name}` says how to confirm it and what to do about it.")


def _effect_table(effects: Sequence[Mapping[str, Any]]) -> Table:
    rows = tuple(
        (
            effect["name"],
            effect["where"]["equation"],
            say.phrase(effect["where"]["variable"]),
            _percent(effect["evidence"]["statistic"]),
            _percent(effect["evidence"]["held_out_gain"]),
        )
        for effect in effects
    )
    titles = ("effect", "equation", "over", "explains", "held out")
    return Table(titles, (False, False, False, True, True), rows, ("",) * len(rows))


def _percent(gain: float | None) -> str:
    text = say.explained_percent(gain)
    return text if text == MISSING else f"{text} %"


def _reasons(parameters: Sequence[Mapping[str, Any]]) -> Iterator[Line]:
    for name, verdict, reason in words.reasons(parameters):
        yield Line(f"{name} ({verdict}): {reason}")


def _locality(diagnosis: Mapping[str, Any]) -> Iterator[Line]:
    found = locality_words.sentences(diagnosis)
    if found:
        yield Line("")
        yield Line(f"Where and when it shows. {locality_words.introduction(diagnosis)}")
        yield from (Line(f"- {text}") for text in found)


def _parameters(diagnosis: Mapping[str, Any], width: int) -> Iterator[Line]:
    pairs = say.parameter_pairs(diagnosis)
    if not pairs:
        return
    yield Line("")
    if diagnosis["parameters_before"] == diagnosis["parameters_after"]:
        yield from estimates(diagnosis["parameters_after"], width)
        yield from _reasons(diagnosis["parameters_after"])
        return
    rows, verdicts = [], []
    for before, after in pairs:
        one = after or before or {}
        value, interval, _ = (MISSING,) * 3 if after is None else words.estimate_cells(after)
        rows.append(
            (
                one["symbol"],
                MISSING if before is None else words.estimate_cells(before)[0],
                value,
                interval,
                words.unit_cell(one),
                MISSING if after is None else words.VERDICTS[after["verdict"]],
            )
        )
        verdicts.append("" if after is None else after["verdict"])
    header = words.interval_header(diagnosis["parameters_after"])
    titles = ("", "before", "after", header, "unit", "verdict")
    yield from fitting(
        Table(titles, (False, True, True, True, False, False), tuple(rows), tuple(verdicts)), width
    )
    yield from _reasons(diagnosis["parameters_after"])


def _fit(diagnosis: Mapping[str, Any], width: int) -> Iterator[Line]:
    yield Line("")
    yield Line(say.held_out_sentence(diagnosis))
    rows = tuple(say.held_out_rows(diagnosis))
    if rows:
        titles = ("equation", "before", "after", "noise floor", "unit")
        yield from fitting(Table(titles, (False, True, True, True, False), rows, ("",) * len(rows)), width)
    yield Line(say.simulation_sentence(diagnosis))


def _next(diagnosis: Mapping[str, Any]) -> Iterator[Line]:
    if diagnosis["next_recording"] or diagnosis["notes"]:
        yield Line("")
    for advice in diagnosis["next_recording"]:
        yield Line(f"Record next: {advice}")
    for note in diagnosis["notes"]:
        yield Line(f"Note: {note}")
