"""The ``diagnosis`` section of the document: everything that its renderers say, as plain data."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any

from flexid_cli.report.parameter import finite, parameter_section

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from flexid_cli.diagnose.result import (
        Array,
        Diagnosis,
        Evidence,
        HeldOut,
        Locality,
        NamedEffect,
        ResidualMap,
        Shape,
        SimulationError,
        Tested,
        Where,
    )
    from flexid_cli.estimate.result import ModelEffect

_NOT_JUDGED = "the record could not be judged"
_NO_NUMBER = "a number is missing where this record cannot give it: a slope without a loop, a share of zero"
_NOT_COMPUTED = "could not be computed from this record"


def diagnosis_section(diagnosis: Diagnosis) -> dict[str, Any]:
    """Build the section of a diagnosis.

    Parameters
    ----------
    diagnosis : Diagnosis
        What was found.

    Returns
    -------
    dict
        Numbers are finite: NaN and infinity are None, with a reason beside them. The text of every named effect
        is part of it, so that a renderer needs the document only; the residuals over time are not, for they are
        as long as the record.
    """
    return {
        "verdict": diagnosis.verdict,
        "sentence": diagnosis.sentence,
        "model": diagnosis.model,
        "effects": [_effect(effect) for effect in diagnosis.effects],
        "location": None if diagnosis.location is None else _where(diagnosis.location),
        "fit": {"held_out": _held_out(diagnosis.held_out), "simulation": _simulation(diagnosis.simulation)},
        "parameters_before": [parameter_section(one) for one in diagnosis.parameters_before],
        "parameters_after": [parameter_section(one) for one in diagnosis.parameters_after],
        "maps": [_map(one) for one in diagnosis.maps],
        "locality": None if diagnosis.locality is None else _locality(diagnosis.locality),
        "tested": [_tested(one, _chosen(diagnosis)) for one in diagnosis.tested],
        "next_recording": diagnosis.next_recording,
        "notes": diagnosis.notes,
    }


def _chosen(diagnosis: Diagnosis) -> frozenset[str]:
    return frozenset(effect.name for effect in diagnosis.effects)


def _effect(effect: NamedEffect) -> dict[str, Any]:
    return {
        "name": effect.name,
        "code": effect.code,
        "family": effect.family,
        "alternatives": effect.alternatives,
        "parameters": [parameter_section(one) for one in effect.parameters],
        "evidence": _evidence(effect.evidence),
        "where": _where(effect.where),
        **_library(effect.name),
    }


def model_effect_section(effect: ModelEffect) -> dict[str, Any]:
    """One entry of a model's ``effects[]``: an effect that the user named, with the evidence for it."""
    from flexid_cli.diagnose.result import Evidence

    found = Evidence(
        effect.statistic, effect.threshold, effect.p_value, effect.held_out_gain, effect.stability
    )
    return {
        "name": effect.name,
        "code": effect.code,
        "family": effect.family,
        "term": _library(effect.name)["term"],
        "parameters": [parameter_section(one) for one in effect.parameters],
        "evidence": _evidence(found),
    }


def _library(name: str) -> dict[str, Any]:
    """What the library says of the effect: the term that joins the model, and its text."""
    from flexid_cli.effects.registry import effect as find
    from flexid_cli.report.effect_text import effect_text

    effect = find(name)
    text = effect_text(effect)
    sections = [{"title": title, "paragraphs": paragraphs} for title, paragraphs in text.sections]
    return {"term": effect.term, "text": {"summary": text.summary, "sections": sections}}


def _evidence(evidence: Evidence) -> dict[str, Any]:
    numbers = {
        "statistic": evidence.statistic,
        "threshold": evidence.threshold,
        "p_value": evidence.p_value,
        "held_out_gain": evidence.held_out_gain,
        "stability": evidence.stability,
    }
    known = {name: finite(value) for name, value in numbers.items()}
    return {**known, "reason": _missing(known)}


def _missing(numbers: Mapping[str, float | None]) -> str:
    """Why numbers are None; empty where all are known."""
    names = [name.replace("_", " ") for name, value in numbers.items() if value is None]
    return f"{', '.join(names)}: {_NOT_COMPUTED}" if names else ""


def _where(where: Where) -> dict[str, Any]:
    return {
        "equation": where.equation,
        "variable": where.variable,
        "interval": _pair(where.interval),
        "frequency_hz": _pair(where.frequency_hz),
        "shape": None if where.shape is None else _shape(where.shape),
        "suggests": where.suggests,
    }


def _pair(pair: tuple[float, float] | None) -> list[float | None] | None:
    if pair is None:
        return None
    ends = [finite(end) for end in pair]
    return None if ends == [None, None] else ends


def _shape(shape: Shape) -> dict[str, Any]:
    curves = {"x": shape.x, "y": shape.y, "low": shape.low, "high": shape.high}
    return {
        **{name: _numbers(curve) for name, curve in curves.items()},
        "x_unit": shape.x_unit,
        "unit": shape.unit,
        "reason": _gaps(curves.values()),
    }


def _map(one: ResidualMap) -> dict[str, Any]:
    curves = {"x": one.x, "before": one.before, "after": one.after, "band": one.band}
    return {
        "equation": one.equation,
        "variable": one.variable,
        **{name: _numbers(curve) for name, curve in curves.items()},
        "x_unit": one.x_unit,
        "unit": one.unit,
        "reason": _gaps(curves.values()),
    }


def _locality(found: Locality) -> dict[str, Any]:
    section: dict[str, Any] = _plain(found)
    return {**section, "reason": _NO_NUMBER if _has_gaps(section) else ""}


def _plain(value: Any) -> Any:
    """Frozen data as mappings, lists and finite numbers, under the names of its fields."""
    if is_dataclass(value):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, tuple):
        return [_plain(one) for one in value]
    if hasattr(value, "tolist"):
        return _numbers(value)
    return finite(value) if isinstance(value, float) else value


def _has_gaps(value: Any) -> bool:
    if isinstance(value, dict):
        return any(_has_gaps(one) for key, one in value.items() if key != "loop" or one is not None)
    return any(_has_gaps(one) for one in value) if isinstance(value, list) else value is None


def _numbers(values: Array) -> list[float | None]:
    return [finite(float(value)) for value in values]


def _gaps(curves: Iterable[Array]) -> str:
    """Why a curve has no number at some places; empty where it has all."""
    whole = all(None not in _numbers(curve) for curve in curves)
    return "" if whole else "where a number is missing, too few samples fell there"


def _held_out(held_out: HeldOut | None) -> dict[str, Any]:
    if held_out is None:
        nothing: dict[str, Any] = {"before": {}, "after": {}, "noise_floor": {}}
        return {**nothing, "data": None, "unit": None, "reason": _NOT_JUDGED}
    sizes = {"before": held_out.before, "after": held_out.after, "noise_floor": held_out.noise_floor}
    found = {kind: {key: finite(value) for key, value in rms.items()} for kind, rms in sizes.items()}
    flat = {f"{key} {kind}": value for kind, rms in found.items() for key, value in rms.items()}
    return {**found, "data": held_out.data, "unit": held_out.unit, "reason": _missing(flat)}


def _simulation(error: SimulationError | None) -> dict[str, Any]:
    if error is None:
        nothing: dict[str, Any] = {"before": None, "after": None, "quantity": None, "unit": None}
        return {**nothing, "reason": _NOT_JUDGED}
    found = {"before": finite(error.before), "after": finite(error.after)}
    reason = error.reason or _missing(found)
    return {**found, "quantity": error.quantity, "unit": error.unit, "reason": reason}


def _tested(one: Tested, chosen: frozenset[str]) -> dict[str, Any]:
    statistic = finite(one.statistic)
    reason = one.reason
    if not reason and (statistic is None or one.name not in chosen):
        reason = _NOT_COMPUTED if statistic is None else "no reason was given"
    return {"name": one.name, "code": one.code, "statistic": statistic, "chosen": one.name in chosen,
            "reason": reason}  # fmt: skip
