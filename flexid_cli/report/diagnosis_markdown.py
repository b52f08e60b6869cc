"""The diagnosis in the Markdown report: the sentence, what was found, how sure, and what to do."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from flexid_cli.report import diagnosis_words as say
from flexid_cli.report import locality_words, words
from flexid_cli.report.markdown_text import bullets, escape, estimates, table
from flexid_cli.report.numbers import MISSING

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

# The text of an effect is part of the library, not of the finding: it stands after all numbers.
_TEXT_TITLE = "What {name} is, and what to do about it"


def diagnosis_blocks(document: Mapping[str, Any], figures: Mapping[str, str]) -> list[str]:
    """Blocks of the report from the sentence to the effects' texts.

    Parameters
    ----------
    document : mapping
        From `build_document`, with a diagnosis.
    figures : mapping of str to str
        Link of each figure by its key of `diagnosis_words.captions`.
    """
    diagnosis = document["diagnosis"]
    meaning = say.MEANINGS[diagnosis["verdict"]]
    side = words.side_sentence(document)
    return [
        f"**{escape(diagnosis['sentence'])}**",
        f"Verdict: *{say.phrase(diagnosis['verdict'])}*: {meaning}. Model: {escape(diagnosis['model'])}.",
        *_found(diagnosis),
        *_left(diagnosis),
        *_locality(diagnosis),
        *_parameters(diagnosis),
        *([escape(side)] if side else []),
        *_fit(diagnosis),
        *_figures(diagnosis, figures),
        *_tested(diagnosis),
        *_next(diagnosis),
        *_texts(diagnosis),
        *_notes(diagnosis),
    ]


def _found(diagnosis: Mapping[str, Any]) -> Iterator[str]:
    yield "## What was found"
    if not diagnosis["effects"]:
        yield "No effect is named."
    for effect in diagnosis["effects"]:
        yield f"### {escape(effect['name'])} ({effect['code']})"
        yield escape(effect["text"]["summary"])
        facts = [
            f"Where: {escape(say.place(effect['where']))}",
            f"Term: `{effect['term']}`",
            f"How sure: {escape(say.evidence_sentence(effect['evidence']))}",
        ]
        if effect["alternatives"]:
            facts.append(f"**{escape(say.alternatives_sentence(effect))}**")
        yield bullets(facts)
        if effect["parameters"]:
            yield estimates(effect["parameters"])
            yield from _reasons(effect["parameters"])


def _reasons(parameters: list[Mapping[str, Any]]) -> Iterator[str]:
    found = words.reasons(parameters)
    if found:
        yield bullets(f"**{escape(name)}** ({verdict}): {escape(reason)}" for name, verdict, reason in found)


def _left(diagnosis: Mapping[str, Any]) -> Iterator[str]:
    location = diagnosis["location"]
    if location is None:
        return
    yield "## What stays unexplained"
    yield escape(say.left_sentence(diagnosis))
    shape = location["shape"]
    if shape is not None and shape["x"]:
        titles = (
            escape(say.labelled(say.phrase(location["variable"]), shape["x_unit"])),
            escape(say.labelled("Residual", shape["unit"])),
            "95 % band",
        )
        curves = zip(shape["x"], shape["y"], shape["low"], shape["high"], strict=True)
        rows = [(say.rounded(x), say.rounded(y), _band(low, high)) for x, y, low, high in curves]
        yield table(titles, "rrr", rows)


def _locality(diagnosis: Mapping[str, Any]) -> Iterator[str]:
    found = locality_words.shown(diagnosis)
    if found is None:
        return
    yield "## Where and when it shows"
    told = locality_words.sentences(diagnosis)
    yield escape(locality_words.introduction(diagnosis)) + (
        "" if told else " It is the same all over the record."
    )
    if told:
        yield bullets(escape(text) for text in told)
    loop = found["loop"]
    stiffness, width = ("", "") if loop is None else (loop["unit"], loop["torque_unit"])
    tables = (
        (
            ("Changes", "From (s)", "95 % interval (s)", "By", "Unit", "Explains %", "Nearly as well"),
            "lrrrlrl",
            locality_words.change_rows(found),
        ),
        (
            ("Lines", "Per motor revolution", "Per joint revolution", "Amplitude", "Unit", "Explains %",
             "Phase (rad)", "Chance of noise"),
            "lrrrlrrr",
            locality_words.line_rows(found),
        ),
        (
            ("Loop at (Hz)", f"Loss stiffness ({stiffness})", "95 % band, ±", f"Width ({width})"),
            "rrrr",
            locality_words.loop_rows(found),
        ),
        (
            ("Drift", "A minute", "Standard error", "Unit", "% a minute", "Explains %", "p"),
            "lrrlrrr",
            locality_words.drift_rows(found),
        ),
    )  # fmt: skip
    yield from (
        table([escape(t) for t in titles], align, [tuple(escape(c) for c in row) for row in rows])
        for titles, align, rows in tables
        if rows
    )


def _band(low: float | None, high: float | None) -> str:
    return MISSING if low is None or high is None else f"{say.rounded(low)} to {say.rounded(high)}"


def _parameters(diagnosis: Mapping[str, Any]) -> Iterator[str]:
    pairs = say.parameter_pairs(diagnosis)
    if not pairs:
        return
    if diagnosis["parameters_before"] == diagnosis["parameters_after"]:
        yield "## Parameters"
        yield estimates(diagnosis["parameters_after"])
        yield from _reasons(diagnosis["parameters_after"])
        return
    yield "## Parameters before and after"
    yield _pairs(pairs, words.interval_header(diagnosis["parameters_after"]))
    yield from _reasons(diagnosis["parameters_after"])


def _pairs(pairs: list[say.Pair], header: str) -> str:
    titles = (
        "Symbol",
        "Name",
        "Before",
        "After",
        header[0].upper() + header[1:],
        "Unit",
        "Change %",
        "Verdict",
    )
    rows = []
    for before, after in pairs:
        one = after or before
        if one is None:
            continue
        interval = MISSING if after is None else words.estimate_cells(after)[1]
        rows.append(
            (
                escape(one["symbol"]),
                escape(one["name"]),
                MISSING if before is None else words.estimate_cells(before)[0],
                MISSING if after is None else words.estimate_cells(after)[0],
                interval,
                escape(words.unit_cell(one)),
                say.change_percent(before, after),
                MISSING if after is None else words.VERDICTS[after["verdict"]],
            )
        )
    return table(titles, "llrrrlrl", rows)


def _fit(diagnosis: Mapping[str, Any]) -> Iterator[str]:
    yield "## Fit before and after"
    yield escape(say.held_out_sentence(diagnosis))
    rows = say.held_out_rows(diagnosis)
    if rows:
        titles = ("Equation", "Before", "After", "Noise floor", "Unit")
        yield table(titles, "lrrrl", [tuple(escape(cell) for cell in row) for row in rows])
    yield escape(say.simulation_sentence(diagnosis))


def _figures(diagnosis: Mapping[str, Any], figures: Mapping[str, str]) -> Iterator[str]:
    for key, caption in say.captions(diagnosis).items():
        if key in figures:
            yield f"![{escape(caption)}]({figures[key]})"


def _tested(diagnosis: Mapping[str, Any]) -> Iterator[str]:
    others = say.not_chosen(diagnosis)
    if not others:
        return
    yield "## What else was tested"
    rows = [
        (escape(one["name"]), one["code"], say.gain_cell(one["statistic"]), escape(one["reason"]))
        for one in others
    ]
    yield table(("Effect", "Code", "Gain", "Why it was not chosen"), "llrl", rows)


def _next(diagnosis: Mapping[str, Any]) -> Iterator[str]:
    if diagnosis["next_recording"]:
        yield "## What to record next"
        yield bullets(escape(advice) for advice in diagnosis["next_recording"])


def _texts(diagnosis: Mapping[str, Any]) -> Iterator[str]:
    for effect in diagnosis["effects"]:
        yield f"## {_TEXT_TITLE.format(name=escape(effect['name']))}"
        for section in effect["text"]["sections"]:
            yield f"### {escape(section['title'])}"
            yield from (escape(paragraph) for paragraph in section["paragraphs"])


def _notes(diagnosis: Mapping[str, Any]) -> Iterator[str]:
    if diagnosis["notes"]:
        yield "## Notes"
        yield bullets(escape(note) for note in diagnosis["notes"])
