"""Sentences and cells that the renderings of a diagnosis share. Reads the document, finds nothing out."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from flexid_cli.report import locality_words
from flexid_cli.report.numbers import MISSING, format_significant

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

MEANINGS = {
    "adequate": "the model explains the record down to its noise",
    "explained": "the named effects explain what the model had left out",
    "partly_explained": "the named effects explain a part, and a difference stays",
    "ambiguous": "several effects explain the difference equally well; this record cannot tell which",
    "unexplained": "there is a difference that no effect of the library explains",
    "inconclusive": "the data are too poor to judge",
}
RESIDUAL_FIGURE = "diagnosis_residual"
SHAPE_FIGURE = "diagnosis_shape"
_DIGITS = 3
_LARGEST_PERCENT = 999  # ten times worse: how much worse says nothing more
_SMALLEST_GAIN = 0.001
_SMALLEST_P_VALUE = 0.001


def captions(diagnosis: Mapping[str, Any]) -> dict[str, str]:
    """What each figure that a diagnosis can have shows, by its key, in the order of the report."""
    maps = {map_key(k): _map_finding(one) for k, one in enumerate(diagnosis["maps"])}
    return {
        RESIDUAL_FIGURE: _residual_finding(diagnosis),
        **maps,
        SHAPE_FIGURE: _shape_finding(diagnosis),
        **locality_words.captions(diagnosis),
    }


def map_key(index: int) -> str:
    """Key of the figure of a residual map, by its place among the maps."""
    return f"diagnosis_map_{index + 1}"


def phrase(name: str) -> str:
    """Name in words: ``partly explained``."""
    return name.replace("_", " ").replace("coulomb", "Coulomb")


def labelled(name: str, unit: str) -> str:
    """Name with its unit, where it has one."""
    return f"{name} ({unit})" if unit else name


def rounded(value: float | None) -> str:
    """Number without a standard error: an RMS, a gain, a time."""
    return format_significant(value, _DIGITS)


def place(where: Mapping[str, Any]) -> str:
    """Where it shows: equation, variable, time and frequency."""
    equation = where["equation"]
    text = "in the measurement" if equation == "measurement" else f"in the {equation} equation"
    if where["variable"]:
        text += f", over {phrase(where['variable'])}"
    if where["interval"] is not None:
        text += f", from {_range(where['interval'])} s"
    if where["frequency_hz"] is not None:
        text += f", mostly at {_range(where['frequency_hz'])} Hz"
    return text


def _range(pair: Sequence[float | None]) -> str:
    return f"{rounded(pair[0])} to {rounded(pair[1])}"


def gain_cell(gain: float | None) -> str:
    """Return a gain for a table, where how small it is says nothing more."""
    return "<0.001" if gain is not None and abs(gain) < _SMALLEST_GAIN else rounded(gain)


def explained_percent(gain: float | None) -> str:
    """Share of the residual's sum of squares that a gain stands for, in percent; below zero it adds to it."""
    if gain is None:
        return MISSING
    if gain < -math.log1p(_LARGEST_PERCENT / 100.0):
        return f"<-{_LARGEST_PERCENT}"
    return rounded(-100.0 * math.expm1(-gain))


def joined_effect(effect: Mapping[str, Any]) -> str:
    """Name of an effect that was joined to a model by name, and what it explains."""
    gain = effect["evidence"]["statistic"]
    share = "" if gain is None else f", explains {explained_percent(gain)} %"
    return f"{effect['name']} ({effect['code']}{share})"


def evidence_sentence(evidence: Mapping[str, Any]) -> str:
    """How sure the name is."""
    text = (
        f"It explains {explained_percent(evidence['statistic'])} % of the residual's sum of squares "
        f"(gain {rounded(evidence['statistic'])}; {rounded(evidence['threshold'])} is needed for a name)"
    )
    if evidence["held_out_gain"] is not None:
        text += f", on data that it was not fitted to {explained_percent(evidence['held_out_gain'])} %"
    if evidence["p_value"] is not None:
        text += f"; p {_p_value(evidence['p_value'])}, corrected for the size of the library"
    if evidence["stability"] is not None:
        text += f"; the same sign in {rounded(100.0 * evidence['stability'])} % of the record's blocks"
    return f"{text}. Not known: {evidence['reason']}." if evidence["reason"] else f"{text}."


def _p_value(value: float) -> str:
    return "below 0.001" if value < _SMALLEST_P_VALUE else format_significant(value, 2)


def alternatives_sentence(effect: Mapping[str, Any]) -> str:
    """What else it may be; empty where the data exclude all others."""
    names = effect["alternatives"]
    if not names:
        return ""
    return f"This record cannot tell {effect['name']} from {' or '.join(names)}."


def left_sentence(diagnosis: Mapping[str, Any]) -> str:
    """Where what is left unexplained stands; empty where nothing is."""
    location = diagnosis["location"]
    if location is None:
        return ""
    # The sentence on top may have the first of them already.
    further = [s for s in location["suggests"] if s[1:] not in diagnosis["sentence"]]
    suggests = f" What that suggests: {'; '.join(further)}." if further else ""
    return f"What stays unexplained shows {place(location)}.{suggests}"


def simulation_sentence(diagnosis: Mapping[str, Any]) -> str:
    """How far simulation and recording differ, before and after."""
    error = diagnosis["fit"]["simulation"]
    if error["before"] is None and error["after"] is None:
        return f"No error of simulation: {error['reason']}."
    unit = error["unit"]
    text = (
        f"Simulated and recorded {phrase(error['quantity'])} differ by {rounded(error['before'])} {unit} RMS"
    )
    if error["after"] != error["before"]:
        text += f" before, {rounded(error['after'])} {unit} after"
    return f"{text} ({error['reason']})." if error["reason"] else f"{text}."


def held_out_rows(diagnosis: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Equation, residual before and after, noise floor, unit; one row for each equation."""
    held_out = diagnosis["fit"]["held_out"]
    kinds = ("before", "after", "noise_floor")
    equations = dict.fromkeys(equation for kind in kinds for equation in held_out[kind])
    unit = held_out["unit"] or MISSING
    return [
        (equation, *(rounded(held_out[kind].get(equation)) for kind in kinds), unit) for equation in equations
    ]


def held_out_sentence(diagnosis: Mapping[str, Any]) -> str:
    """Which data were held out, or why none were."""
    held_out = diagnosis["fit"]["held_out"]
    if held_out["data"] is None:
        return f"No residual on held-out data: {held_out['reason']}."
    missing = f" Not known: {held_out['reason']}." if held_out["reason"] else ""
    return f"Residual RMS on data that was not fitted ({held_out['data']}).{missing}"


Pair = tuple["Mapping[str, Any] | None", "Mapping[str, Any] | None"]


def parameter_pairs(diagnosis: Mapping[str, Any]) -> list[Pair]:
    """Every parameter before and after, by name; one that exists on one side only has None on the other."""
    before = {one["name"]: one for one in diagnosis["parameters_before"]}
    after = {one["name"]: one for one in diagnosis["parameters_after"]}
    return [(before.get(name), after.get(name)) for name in dict.fromkeys([*before, *after])]


def change_percent(before: Mapping[str, Any] | None, after: Mapping[str, Any] | None) -> str:
    """Change of an estimate in percent of the one before, with its sign."""
    old = None if before is None else before["estimate"]
    new = None if after is None else after["estimate"]
    if old is None or new is None or old == 0.0:
        return MISSING
    change = 100.0 * (new - old) / abs(old)
    text = format_significant(change, 2)
    return f"+{text}" if change > 0.0 and text != "0" else text


def not_chosen(diagnosis: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Effects that were tried and not chosen, the one nearest to being chosen first."""
    others = [one for one in diagnosis["tested"] if not one["chosen"]]
    return sorted(
        others, key=lambda one: -math.inf if one["statistic"] is None else one["statistic"], reverse=True
    )


def _residual_finding(diagnosis: Mapping[str, Any]) -> str:
    """Say what the figure of the residuals over time shows."""
    text = "Residual of each equation over time"
    if diagnosis["effects"]:
        text += ", before and after the effects joined the model"
    rows = held_out_rows(diagnosis)
    sizes = "; ".join(
        f"{row[0]} {row[1]} before, {row[2]} after, noise {row[3]} {row[4]} RMS" for row in rows
    )
    return f"{text} (held-out data: {sizes})" if sizes else text


def _map_finding(one: Mapping[str, Any]) -> str:
    """Say what the figure of a residual map shows."""
    text = (
        f"Mean residual of the {one['equation']} equation over {phrase(one['variable'])}, before and after, with "
        "the 95 % band in which it does not differ from zero"
    )
    sizes = [max((abs(y) for y in one[kind] if y is not None), default=None) for kind in ("before", "after")]
    if None in sizes:
        return text
    outside = sum(
        abs(y) > band for y, band in zip(one["after"], one["band"], strict=True) if None not in (y, band)
    )
    places = "no place" if outside == 0 else f"{outside} of {len(one['x'])} places"
    return (
        f"{text}: at most {rounded(sizes[0])} {one['unit']} before and {rounded(sizes[1])} {one['unit']} after, which"
        f" leaves the band at {places}"
    )


def _shape_finding(diagnosis: Mapping[str, Any]) -> str:
    """Say what the figure of the unexplained residual shows."""
    location = diagnosis["location"]
    over = "" if location is None else f" {place(location)}"
    return f"What stays unexplained{over}: mean and 95 % band"
