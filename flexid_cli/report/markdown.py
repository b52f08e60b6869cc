"""The report as Markdown that GitHub, GitLab and pandoc show alike: plain tables, no HTML."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from flexid_cli.report import diagnosis_words as say
from flexid_cli.report import words
from flexid_cli.report.diagnosis_markdown import diagnosis_blocks
from flexid_cli.report.markdown_text import bullets, code, escape, estimates, numbered, table
from flexid_cli.report.numbers import MISSING, format_significant

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

FIGURE_KINDS = ("torque", "filter", "spectrum")
_ROLES = {"recording": "Input", "validation": "Other run", "parameters": "Known parameters"}
_SMALLEST_P_VALUE = 0.001
_UNITS = {"s": "s", "hz": "Hz"}
_CLOCK_COUNTS = ("gaps", "bridged", "duplicates", "reordered", "resets", "invalid")


def render_markdown(document: Mapping[str, Any], figures: Mapping[str, str]) -> str:
    """Write the report for people, most important first.

    Parameters
    ----------
    document : mapping
        From `build_document`.
    figures : mapping of str to str
        Link of each figure by ``<model>_<kind>`` (``two_encoders_torque``) or by the keys of
        `diagnosis_words.captions`, relative to the Markdown file. A figure without a link is left out.
    """
    models, axis = document["models"], escape(words.axis_name(document))
    if document["diagnosis"] is None:
        blocks = [f"# Drive parameters of {axis}", *_verdict(document)]
    else:
        blocks = [f"# Diagnosis of {axis}", *diagnosis_blocks(document, figures)]
    for model in models:
        blocks += [f"## Model {model['id']}", *_results(model), *_figures(model, figures)]
    blocks += [*_warnings(document), *_data_quality(document)]
    blocks += [*_pipelines(models), *_methods(models), *_reproducibility(document)]
    return "\n\n".join(blocks) + "\n"


def _verdict(document: Mapping[str, Any]) -> list[str]:
    lines = [f"**{escape(m['id'])}**: {escape(words.verdict_sentence(m))}" for m in document["models"]]
    lines += [f"**{escape(s['id'])}** was not solved: {escape(s['reason'])}" for s in document["skipped"]]
    if not lines:
        lines = ["No model was solved."]
    legend = "; ".join(f"*{words.VERDICTS[key]}*: {text}" for key, text in words.EXPLANATIONS.items())
    side = words.side_sentence(document)
    return ["## Verdict", bullets(lines), f"Here {legend}.", *([escape(side)] if side else [])]


def _results(model: Mapping[str, Any]) -> list[str]:
    blocks = ["### Parameters", estimates(model["parameters"]), *_joined(model), *_records(model)]
    reasons = words.reasons([*words.reported(model), *model["regression"]])
    if reasons:
        lines = [f"**{escape(name)}** ({verdict}): {escape(reason)}" for name, verdict, reason in reasons]
        blocks += ["### Reasons", bullets(lines)]
    advices = words.advices([*model["parameters"], *model["derived"]])
    if advices:
        lines = [f"for {escape(names)}: {escape(advice)}" for names, advice in advices]
        blocks += ["What to record:", bullets(lines)]
    if model["regression"]:
        blocks += ["### Regression", estimates(model["regression"])]
    if model["derived"]:
        blocks += ["### Derived quantities", estimates(model["derived"])]
    return [*blocks, "### Fit", escape(words.fit_sentence(model)), *_tests(model), *_correlations(model)]


def _joined(model: Mapping[str, Any]) -> list[str]:
    """Effects that were named, and the parameters without them."""
    blocks = []
    for effect in model.get("effects", ()):
        blocks += [f"### Effect {escape(say.joined_effect(effect))}", code(effect["term"])]
        blocks.append(estimates(effect["parameters"]))
    if model.get("parameters_before"):
        blocks += [f"### {words.WITHOUT_EFFECTS}", estimates(model["parameters_before"])]
    return blocks


def _records(model: Mapping[str, Any]) -> list[str]:
    """Estimates of each record of a joint fit, beside the joint ones."""
    titles, rows = words.records_table(model)
    if not rows:
        return []
    shown = [tuple(escape(cell) if k == 0 else cell for k, cell in enumerate(row)) for row in rows]
    heads = ["Symbol", "Together", *(escape(title) for title in titles[2:])]
    return [f"### {words.ALONE}", table(heads, "l" + "r" * (len(heads) - 1), shown)]


def _tests(model: Mapping[str, Any]) -> list[str]:
    if not model["tests"]:
        return []
    lines = [f"{escape(_phrase(name))}: {escape(_facts(test))}" for name, test in model["tests"].items()]
    return ["Tests of the result:", bullets(lines)]


def _facts(test: Mapping[str, Any]) -> str:
    """Name and value of each entry of a test, what it means in brackets, nested ones left to the JSON."""
    simple = {key: value for key, value in test.items() if not isinstance(value, dict | list)}
    meaning = simple.pop("meaning", None)
    facts = ", ".join(_fact(key, value) for key, value in simple.items()) or MISSING
    return f"{facts} ({meaning})" if meaning else facts


def _fact(key: str, value: object) -> str:
    name, _, last = key.rpartition("_")
    if last not in _UNITS or value is None:
        return f"{_phrase(key)} {_value(key, value)}"
    return f"{_phrase(name)} {_value(key, value)} {_UNITS[last]}"


def _phrase(key: str) -> str:
    return key.replace("_", " ")


def _value(key: str, value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None:
        return MISSING
    if not isinstance(value, int | float):
        return _phrase(str(value))
    return "below 0.001" if key == "p_value" and value < _SMALLEST_P_VALUE else format_significant(value)


def _correlations(model: Mapping[str, Any]) -> list[str]:
    pairs = words.strong_correlations(model)
    if not pairs:
        return []
    lines = [f"{escape(a)} and {escape(b)}: {format_significant(value, 3)}" for a, b, value in pairs]
    return ["Estimates that this record hardly tells apart (correlation):", bullets(lines)]


def _figures(model: Mapping[str, Any], figures: Mapping[str, str]) -> list[str]:
    links = {kind: figures.get(f"{model['id']}_{kind}") for kind in FIGURE_KINDS}
    images = [f"![{escape(words.finding(model, kind))}]({link})" for kind, link in links.items() if link]
    return ["### Figures", *images] if images else []


def _warnings(document: Mapping[str, Any]) -> list[str]:
    lines = [escape(warning) for warning in document["warnings"]]
    for model in document["models"]:
        lines += [escape(warning) for warning in words.model_warnings(model)]
    return ["## Warnings", bullets(lines)] if lines else []


def _data_quality(document: Mapping[str, Any]) -> list[str]:
    recording = document["recording"]
    count, unit = recording["segments"], recording["torque_unit"]
    pieces = "one piece without a gap" if count == 1 else f"{count} pieces without gaps"
    summary = (
        f"{recording['samples']} samples at {format_significant(recording['sample_rate_hz'], 6)} Hz over "
        f"{words.duration(recording['duration_s'])}, in {pieces}; {words.quantity(unit)} in {unit}."
    )
    blocks = ["## Data quality", escape(summary)]
    if recording["clocks"]:
        counts = (key.capitalize() for key in _CLOCK_COUNTS)
        titles = ("Signal", "Samples", "Period", "Jitter", "Lost", *counts)
        rows = [_clock_row(clock) for clock in recording["clocks"]]
        blocks += [table(titles, "lrrrr" + "r" * len(_CLOCK_COUNTS), rows), _clock_legend()]
    notes = [line for entry in document["inputs"] for line in _input_notes(entry)]
    return [*blocks, bullets(notes)] if notes else blocks


def _input_notes(entry: Mapping[str, Any]) -> list[str]:
    notes, damage = words.input_notes(entry), entry["damage"]
    if damage is not None and (damage["suspect"] or damage["lost"] != 0):
        counts = ", ".join(f"{damage[kind]} {kind}" for kind in ("trusted", "suspect"))
        lost = "an unknown number" if damage["lost"] is None else damage["lost"]
        notes.insert(0, f"{entry['path']}: damaged file, samples: {counts}, {lost} lost")
    return [escape(note) for note in notes]


def _clock_row(clock: Mapping[str, Any]) -> tuple[str, ...]:
    times = (words.duration(clock[key]) for key in ("period_s", "jitter_s", "lost_s"))
    counts = (str(clock[key]) for key in _CLOCK_COUNTS)
    return (escape(clock["signal"]), str(clock["samples"]), *times, *counts)


def _clock_legend() -> str:
    return (
        "Period and jitter are median and standard deviation of the time between stamps. Gaps split the "
        "record (lost is their time); bridged samples were interpolated; duplicates were dropped; reordered "
        "samples were put back; resets are jumps back of the clock; invalid samples are no finite numbers."
    )


def _pipelines(models: Sequence[Mapping[str, Any]]) -> list[str]:
    blocks = ["## Pipeline"] if models else []
    for model in models:
        steps = [escape(step) for step in model["pipeline"]["steps"]]
        sentences = (words.band_sentence(model), words.resonance_sentence(model), _rows(model["pipeline"]))
        blocks += [f"### {escape(model['id'])}: pipeline", *([numbered(steps)] if steps else [])]
        blocks.append(escape(" ".join(sentence for sentence in sentences if sentence)))
    return blocks


def _rows(pipeline: Mapping[str, Any]) -> str:
    text = f"{pipeline['rows']} rows of each equation were solved"
    if pipeline["trimmed_s"]:
        text += f", after {words.duration(pipeline['trimmed_s'])} were cut off at each edge"
    return text + "."


def _methods(models: Sequence[Mapping[str, Any]]) -> list[str]:
    blocks = ["## Method"] if models else []
    for model in models:
        blocks += [f"### {escape(model['id'])}: method", code(model["equation"])]
        blocks.append(bullets(_method_lines(model)))
    return blocks


def _method_lines(model: Mapping[str, Any]) -> list[str]:
    estimator = f"Estimator: {escape(model['method'])}"
    lines = [f"{estimator}, {escape(model['method_reason'])}" if model["method_reason"] else estimator]
    methods = {p["ci"]["method"]: None for p in model["parameters"] if p["ci"] is not None}
    if methods:
        lines.append("Intervals: " + ", ".join(escape(method) for method in methods))
    condition = format_significant(model["condition_number"])
    lines.append(f"Condition number {condition} (columns scaled), rank {model['rank']} of {model['columns']}")
    if model["added_terms"]:
        terms = ", ".join(escape(_phrase(term)) for term in model["added_terms"])
        lines.append(f"Added beyond the declared baseline: {terms}")
    return lines


def _reproducibility(document: Mapping[str, Any]) -> list[str]:
    tool, config = document["tool"], document["config"]
    lines = [f"{tool['name']} {tool['version']}, report format {document['schema']}"]
    lines += [_input_line(entry) for entry in document["inputs"]]
    lines.append(f"Configuration: SHA-256 `{config['sha256']}`")
    blocks = ["## Reproducibility", bullets(lines)]
    if config["resolved"]:
        settings = "\n".join(_settings(config["resolved"]))
        blocks += ["The configuration with all defaults filled in:", code(settings)]
    if document["citations"]:
        blocks += ["## References", bullets(escape(citation) for citation in document["citations"])]
    return blocks


def _input_line(entry: Mapping[str, Any]) -> str:
    facts = [entry["format"]]
    if entry["clock"]:
        reason = f" ({entry['clock_reason']})" if entry["clock_reason"] else ""
        facts.append(f"clock {entry['clock']}{reason}")
    if entry["samples"] is not None:
        facts.append(f"{entry['samples']} samples")
    if entry["duration"] is not None:
        facts.append(words.duration(entry["duration"]))
    file = f"{_ROLES[entry['role']]} {escape(entry['path'])}"
    return f"{file} ({escape(', '.join(facts))}): SHA-256 `{entry['sha256']}`"


def _settings(value: object, path: str = "") -> Iterable[str]:
    """One line for each setting: ``axis.gear_ratio = 50``."""
    if isinstance(value, dict) and value:
        for key, item in value.items():
            yield from _settings(item, f"{path}.{key}" if path else str(key))
    else:
        yield f"{path} = {json.dumps(value, ensure_ascii=False)}"
