"""Sentences and cells that the renderings for people share. Reads the document, computes nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from flexid_cli.report.numbers import (
    MISSING,
    format_level,
    format_percent,
    format_significant,
    round_estimate,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

VERDICTS = {"identified": "identified", "weak": "weak", "not_identifiable": "not identifiable"}
EXPLANATIONS = {
    "identified": "the record determines the value, and the interval can be relied on",
    "weak": "the record says something about the value, but not enough to rely on it alone",
    "not_identifiable": "the record does not determine the value",
}
STRONG_CORRELATION = 0.9
_ROUNDS_TO_ONE = 0.99995
_F1_SOURCES = {"configuration": "from the configuration", "data": "estimated from the data"}


def plain_name(parameter: Mapping[str, Any]) -> str:
    """Name in words: ``motor Coulomb friction``."""
    return str(parameter["name"]).replace("_", " ").replace("coulomb", "Coulomb")


def human_name(parameter: Mapping[str, Any]) -> str:
    """Name and symbol: ``joint stiffness K``; the name alone where it holds the symbol."""
    name = plain_name(parameter)
    return name if parameter["symbol"] in name.split() else f"{name} {parameter['symbol']}"


def verdict_sentence(model: Mapping[str, Any]) -> str:
    """One sentence: which of the model's parameters are identified, weak, not identifiable."""
    parameters = model["parameters"]
    groups = {verdict: [p for p in parameters if p["verdict"] == verdict] for verdict in VERDICTS}
    if not parameters:
        return "The model gave no parameters."
    if not groups["identified"]:
        parts = ["No parameter is identified"]
    elif len(groups["identified"]) == len(parameters) > 1:
        parts = [f"All {len(parameters)} parameters are identified: {_names(parameters)}"]
    else:
        parts = [_group(groups["identified"], "identified", f" of {len(parameters)} parameters")]
    parts += [_group(groups[key], VERDICTS[key]) for key in ("weak", "not_identifiable") if groups[key]]
    return "; ".join(parts) + "."


def _group(members: Sequence[Mapping[str, Any]], verdict: str, of: str = "") -> str:
    verb = "is" if len(members) == 1 else "are"
    return f"{len(members)}{of} {verb} {verdict}: {_names(members)}"


def _names(members: Sequence[Mapping[str, Any]]) -> str:
    return ", ".join(human_name(member) for member in members)


def unit_cell(parameter: Mapping[str, Any]) -> str:
    """Return the unit of a parameter; a dash for a plain number."""
    unit = str(parameter["unit"])
    return MISSING if unit in {"", "1"} else unit


def interval_header(parameters: Sequence[Mapping[str, Any]]) -> str:
    """Heading of the interval column, with the level where all intervals share it."""
    levels = {p["ci"]["level"] for p in parameters if p["ci"] is not None}
    return f"{format_level(levels.pop())} interval" if len(levels) == 1 else "interval"


def estimate_cells(parameter: Mapping[str, Any], *, with_level: bool = False) -> tuple[str, str, str]:
    """Estimate, interval and relative standard deviation as text, rounded to the uncertainty."""
    ci = parameter["ci"]
    low, high = (None, None) if ci is None else (ci["low"], ci["high"])
    rounded = round_estimate(parameter["estimate"], parameter["stderr"], low, high)
    if low is None and high is None:
        interval = MISSING
    elif high is None:
        interval = f"above {rounded.low}"
    elif low is None:
        interval = f"below {rounded.high}"
    else:
        interval = f"{rounded.low} to {rounded.high}"
    if with_level and ci is not None:
        interval += f" ({format_level(ci['level'])})"
    return rounded.estimate, interval, format_percent(parameter["relative_stderr_percent"])


WITHOUT_EFFECTS = "Parameters of the same model without these effects"


def reported(model: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Every estimate of a model that stands in its tables: parameters, those of named effects, derived ones."""
    joined = [p for effect in model.get("effects", ()) for p in effect["parameters"]]
    return [*model["parameters"], *joined, *model["derived"]]


ALONE = "Each record alone, and what they give together"


def records_table(model: Mapping[str, Any]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Titles and rows of the estimates of each record of a joint fit beside the joint ones; estimate ± stderr."""
    used = [record for record in model.get("records", ()) if record["used"]]
    joint = {p["symbol"]: p for p in model["parameters"]}
    alone = [{p["symbol"]: p for p in record["parameters"]} for record in used]
    symbols = dict.fromkeys(symbol for one in alone for symbol in one)
    rows = []
    for symbol in symbols:
        together = _with_stderr(joint[symbol]) if symbol in joint else "its own"
        rows.append((symbol, together, *(_with_stderr(one.get(symbol)) for one in alone)))
    return ("", "together", *(record["name"] for record in used)), rows


def _with_stderr(parameter: Mapping[str, Any] | None) -> str:
    if parameter is None or parameter["estimate"] is None:
        return MISSING
    rounded = round_estimate(parameter["estimate"], parameter["stderr"])
    return rounded.estimate if rounded.stderr == MISSING else f"{rounded.estimate} ± {rounded.stderr}"


def reasons(parameters: Iterable[Mapping[str, Any]]) -> list[tuple[str, str, str]]:
    """Names, verdict and reason of the parameters that have a reason; those with the same one stand together."""
    together: dict[tuple[str, str], list[str]] = {}
    for p in parameters:
        if p["reason"]:
            together.setdefault((VERDICTS[p["verdict"]], p["reason"]), []).append(human_name(p))
    return [(", ".join(names), verdict, reason) for (verdict, reason), names in together.items()]


def advices(parameters: Iterable[Mapping[str, Any]]) -> list[tuple[str, str]]:
    """Return what to record, and the parameters that it would determine; a report of old has no advice."""
    together: dict[str, list[str]] = {}
    for p in parameters:
        if p.get("advice"):
            together.setdefault(p["advice"], []).append(p["symbol"])
    return [(", ".join(names), advice) for advice, names in together.items()]


def side_sentence(document: Mapping[str, Any]) -> str:
    """Say at which side of the gear the values count; empty where there is no gear."""
    axis = document["config"]["resolved"].get("axis")
    ratio = axis.get("gear_ratio", 1.0) if isinstance(axis, dict) else 1.0
    if ratio == 1.0:
        return ""
    text = "Values are at the joint side"
    if document["recording"]["torque_unit"] == "A":
        return f"{text}, per ampere of motor current (gear ratio {format_significant(ratio)})."
    gear = format_significant(ratio)
    return f"{text}: torques {gear} times, inertias and stiffness {gear}² times those at the motor shaft."


def quantity(unit: str) -> str:
    """Name what a torque channel of this unit measures: torque, force or current."""
    return {"A": "current", "N": "force"}.get(unit, "torque")


def fit_sentence(model: Mapping[str, Any]) -> str:
    """How well the model predicts the torque."""
    fit = model["fit"]
    return (
        f"The model predicts the filtered motor {quantity(fit['unit'])} with a fit of "
        f"{format_significant(fit['fit_percent'])} %: "
        f"{format_significant(fit['torque_rms'])} {fit['unit']} RMS measured, "
        f"{format_significant(fit['residual_rms'])} {fit['unit']} RMS left over."
    )


def band_sentence(model: Mapping[str, Any]) -> str:
    """Which frequencies the estimate rests on, and why no higher ones."""
    pipeline = model["pipeline"]
    band = pipeline["effective_band_hz"]
    text = f"The estimate rests on {format_significant(band['low'])} to {format_significant(band['high'])} Hz"
    if pipeline["limited_by"]:
        text += f" (the upper edge is set by: {pipeline['limited_by']})"
    return text + "."


def resonance_sentence(model: Mapping[str, Any]) -> str:
    """First free-free resonance that the tuning used; empty where there was none."""
    pipeline = model["pipeline"]
    if pipeline["f1_hz"] is None:
        return ""
    source = _F1_SOURCES.get(pipeline["f1_source"], pipeline["f1_source"])
    text = f"The first free-free resonance f1 was taken as {format_significant(pipeline['f1_hz'])} Hz"
    return f"{text}, {source}." if source else f"{text}."


def strong_correlations(model: Mapping[str, Any]) -> list[tuple[str, str, float]]:
    """Pairs of estimates that the record hardly tells apart, strongest first."""
    names, matrix = model["correlation"]["names"], model["correlation"]["matrix"]
    pairs = [
        (names[i], names[j], matrix[i][j])
        for i in range(len(names))
        for j in range(i)
        if matrix[i][j] is not None and abs(matrix[i][j]) >= STRONG_CORRELATION
    ]
    return sorted(pairs, key=lambda pair: -abs(pair[2]))


def axis_name(document: Mapping[str, Any]) -> str:
    """Name of the axis in the configuration, or ``axis``."""
    axis = document["config"]["resolved"].get("axis")
    name = axis.get("name") if isinstance(axis, dict) else None
    return str(name) if name else "axis"


def duration(seconds: float | None) -> str:
    """Return a time in the unit that keeps it readable: s, ms or us."""
    if seconds is None:
        return MISSING
    if seconds == 0:
        return "0"
    for unit, factor in (("s", 1.0), ("ms", 1e3), ("us", 1e6)):
        if abs(seconds) * factor >= _ROUNDS_TO_ONE:
            return f"{format_significant(seconds * factor)} {unit}"
    return f"{format_significant(seconds * 1e9)} ns"


def input_notes(entry: Mapping[str, Any]) -> list[str]:
    """Return what the reader met in a file, each sentence naming the file."""
    path = entry["path"]
    return [note if path in note else f"{path}: {note}" for note in entry["notes"]]


def model_warnings(model: Mapping[str, Any]) -> list[str]:
    """Return the model's warnings, each one naming the model."""
    prefix = f"{model['id']}: "
    return [prefix + str(warning).removeprefix(prefix) for warning in model["warnings"]]


def finding(model: Mapping[str, Any], kind: str) -> str:
    """Say what the figure ``kind`` (torque, filter, spectrum) of the model shows."""
    pipeline, fit = model["pipeline"], model["fit"]
    band = pipeline["effective_band_hz"]
    edges = f"{format_significant(band['low'])} to {format_significant(band['high'])} Hz"
    f1 = pipeline["f1_hz"]
    resonance = "" if f1 is None else f"; the first resonance f1 is at {format_significant(f1)} Hz"
    drive = f"motor {quantity(fit['unit'])}"
    if kind == "torque":
        return (
            f"Measured and predicted {drive} over time: the model {model['id']} leaves "
            f"{format_significant(fit['residual_rms'])} {fit['unit']} RMS of "
            f"{format_significant(fit['torque_rms'])} {fit['unit']} RMS, a fit of "
            f"{format_significant(fit['fit_percent'])} %"
        )
    if kind == "filter":
        return f"Magnitude of the filter chain: it passes {edges} to the estimate{resonance}"
    return f"Amplitude spectrum of the {drive}: the estimate uses {edges}{resonance}"
