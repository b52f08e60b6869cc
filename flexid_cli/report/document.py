"""The one report document ("flexid-report/1"): plain data that every renderer reads.

Everything that depends on the container (path, format, clock, what the reader met) stands under ``inputs``
and nowhere else, so that the rest of the report is the same whatever the log was stored in.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from flexid_cli import __version__
from flexid_cli.report.diagnosis_section import diagnosis_section, model_effect_section
from flexid_cli.report.parameter import finite, parameter_section

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from flexid_cli.diagnose.result import Diagnosis
    from flexid_cli.estimate.result import Fit, Identification, ModelResult, PipelineSummary
    from flexid_cli.signals.recording import ClockStatistics, Recording

SCHEMA = "flexid-report/1"
_PAPER = (
    "M. T. Pham, M. Gautier, P. Poignet: Identification of joint stiffness with bandpass filtering. "
    "IEEE International Conference on Robotics and Automation (ICRA), Seoul, 2001, pp. 2867-2872. "
    "doi:10.1109/ROBOT.2001.933056"
)
CITATIONS = (_PAPER,)
# Step of the recording's history that names the clock.
_CLOCK_STEP = "clock: "
_DAMAGE_UNKNOWN = "damaged samples were not counted; what the reader met stands under notes"
_NO_LOG = "a report, not a log"
_PART_OF_A_RUN = "one of several files of one run: samples and duration of the run stand under recording"


@dataclass(frozen=True)
class Damage:
    """Samples of one file by how far they can be trusted.

    Attributes
    ----------
    trusted, suspect : int
        Samples that are right as far as the file can tell, and those of damaged places.
    lost : int or None
        Samples that could not be read; None where their number cannot be known.
    lost_bytes, lost_chunks : int
        What of the file gave nothing.
    spans_s : tuple of (float, float)
        Stretches without trusted samples, in seconds from the first message of the run.
    reasons : tuple of str
        What is damaged, with positions in the file.
    """

    trusted: int
    suspect: int = 0
    lost: int | None = 0
    lost_bytes: int = 0
    lost_chunks: int = 0
    spans_s: tuple[tuple[float, float], ...] = ()
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True)
class InputFile:
    """One file of the run, and all that depends on how the log was stored.

    Attributes
    ----------
    path, sha256, format : str
        Path as the user gave it, SHA-256 of the content in hex, the reader's name.
    samples : int or None
        Samples of the motor position in this file; None takes the recording's where the run is one file.
    duration_s : float or None
        From first to last sample of this file, treated like ``samples``.
    damage : Damage or None
        None where the reader does not count damaged samples.
    notes : tuple of str
        What the reader met in this file. The same sentences among the recording's notes are not repeated
        among the report's warnings.
    role : {"recording", "validation", "parameters"}
        What the file was used for: the run itself, the other run on which a diagnosis is checked, or the report
        whose parameters were taken as known.
    record : str
        Name of the record that it belongs to, where several are fitted together.
    """

    path: str
    sha256: str
    format: str
    samples: int | None = None
    duration_s: float | None = None
    damage: Damage | None = None
    notes: tuple[str, ...] = ()
    role: str = "recording"
    record: str = ""


def build_document(
    *,
    recording: Recording,
    inputs: Sequence[InputFile],
    config_digest: str,
    config_resolved: Mapping[str, Any],
    identification: Identification | None = None,
    diagnosis: Diagnosis | None = None,
    validation: Recording | None = None,
    records: Mapping[str, Recording] | None = None,
    citations: Sequence[str] = CITATIONS,
) -> dict[str, Any]:
    """Build the report of an identification or of a diagnosis.

    Parameters
    ----------
    recording : Recording
        What it was estimated from.
    inputs : sequence of InputFile
        The files of the run, in their order; after them those of other roles.
    config_digest : str
        SHA-256 of the configuration file.
    config_resolved : mapping
        The configuration with all defaults filled in.
    identification : Identification, optional
        What was estimated.
    diagnosis : Diagnosis, optional
        Where simulation and recording differ, and why.
    validation : Recording, optional
        The other run, whose files are the inputs of that role.
    records : mapping of str to Recording, optional
        Records that were fitted together, by name; ``recording`` is then the account of all of them.
    citations : sequence of str
        References for the methods that were used.

    Returns
    -------
    dict
        Plain dicts, lists, strings, numbers, bools and None, in a fixed order. Numbers are finite: NaN and
        infinity become None. An estimate without a number is never anything but ``not_identifiable``, one
        without an interval never ``identified``.

    Raises
    ------
    TypeError
        A result holds something that is not plain data.
    """
    models = () if identification is None else identification.models
    skipped = () if identification is None else identification.skipped
    document = {
        "schema": SCHEMA,
        "tool": {"name": "flexid", "version": __version__},
        "inputs": _inputs(inputs, recording, validation, records or {}),
        "config": {"sha256": config_digest, "resolved": config_resolved},
        "recording": _recording(recording),
        "models": [{**_model(model), **_records(model, inputs, records or {})} for model in models],
        "skipped": [{"id": model.id, "reason": model.reason} for model in skipped],
        "diagnosis": None if diagnosis is None else diagnosis_section(diagnosis),
        "warnings": _warnings(identification, (recording, validation), inputs),
        "citations": list(citations),
    }
    plain = _plain(document)
    if not isinstance(plain, dict):
        raise TypeError("the report is not a mapping")
    return plain


def _warnings(
    identification: Identification | None,
    recordings: Sequence[Recording | None],
    inputs: Sequence[InputFile],
) -> list[str]:
    """Return every warning once; what a reader said of its file stands under that input alone."""
    told = {note for file in inputs for note in file.notes}
    notes = [note for recording in recordings if recording is not None for note in recording.notes]
    warnings = dict.fromkeys([*(() if identification is None else identification.warnings), *notes])
    return [warning for warning in warnings if warning not in told]


def _inputs(
    inputs: Sequence[InputFile],
    recording: Recording,
    validation: Recording | None,
    records: Mapping[str, Recording],
) -> list[dict[str, Any]]:
    """Return the files of every role, each with the totals of the recording that it belongs to."""
    owners = [(file.role, file.record) for file in inputs]
    recordings = {"recording": recording, "validation": validation}
    return [
        _input(
            file,
            records[file.record] if file.record in records else recordings.get(file.role),
            single=owners.count((file.role, file.record)) == 1,
        )
        for file in inputs
    ]


def _input(file: InputFile, recording: Recording | None, *, single: bool) -> dict[str, Any]:
    clock = None if recording is None else _leading_clock(recording.clocks)
    samples, duration_s, notes = file.samples, file.duration_s, file.notes
    if single and recording is not None:
        samples = clock.samples if samples is None and clock is not None else samples
        duration_s = recording.duration_s if duration_s is None else duration_s
    elif recording is not None and (samples is None or duration_s is None):
        notes = (*notes, _PART_OF_A_RUN)
    reason = "" if recording is None else _clock_reason(recording, "" if clock is None else clock.clock)
    unknown = _NO_LOG if recording is None else _DAMAGE_UNKNOWN
    return {
        "path": file.path,
        "role": file.role,
        "sha256": file.sha256,
        "format": file.format,
        "clock": None if clock is None else clock.clock,
        "clock_reason": reason,
        "samples": samples,
        "duration": duration_s,
        "damage": None if file.damage is None else _damage(file.damage),
        "damage_reason": unknown if file.damage is None else "",
        "notes": notes,
        **({"record": file.record} if file.record else {}),
    }


def _damage(damage: Damage) -> dict[str, Any]:
    return {
        "trusted": damage.trusted,
        "suspect": damage.suspect,
        "lost": damage.lost,
        "lost_bytes": damage.lost_bytes,
        "lost_chunks": damage.lost_chunks,
        "spans_s": damage.spans_s,
        "reasons": damage.reasons,
    }


def _leading_clock(clocks: Sequence[ClockStatistics]) -> ClockStatistics | None:
    """Statistics of the motor position, the one signal that every recording has."""
    by_signal = {clock.signal: clock for clock in clocks}
    return by_signal.get("motor_position", clocks[0] if clocks else None)


def _clock_reason(recording: Recording, clock: str) -> str:
    """Why the clock was chosen: the step of the history that names it, ``clock: NAME (reason)``."""
    steps = [step.removeprefix(_CLOCK_STEP) for step in recording.history if step.startswith(_CLOCK_STEP)]
    if not steps:
        return ""
    named = f"{clock} ("
    return steps[0][len(named) : -1] if steps[0].startswith(named) and steps[0].endswith(")") else steps[0]


def _recording(recording: Recording) -> dict[str, Any]:
    return {
        "sample_rate_hz": recording.sample_rate_hz,
        "segments": len(recording.segments),
        "samples": recording.samples,
        "duration_s": recording.duration_s,
        "linear": recording.linear,
        "torque_unit": recording.torque_unit,
        "clocks": [_clock(clock) for clock in recording.clocks],
        "history": [step for step in recording.history if not step.startswith(_CLOCK_STEP)],
    }


def _clock(clock: ClockStatistics) -> dict[str, Any]:
    """Statistics of one signal's stamps; the clock's name, which the container sets, stands under inputs."""
    return {
        "signal": clock.signal,
        "samples": clock.samples,
        "period_s": clock.period_s,
        "jitter_s": clock.jitter_s,
        "gaps": clock.gaps,
        "lost_s": clock.lost_s,
        "bridged": clock.bridged,
        "duplicates": clock.duplicates,
        "reordered": clock.reordered,
        "resets": clock.resets,
        "invalid": clock.invalid,
    }


def _model(model: ModelResult) -> dict[str, Any]:
    return {
        "id": model.id,
        "method": model.method,
        "method_reason": model.method_reason,
        "equation": model.equation,
        "added_terms": model.added_terms,
        "parameters": [parameter_section(estimate) for estimate in model.parameters],
        "regression": [parameter_section(estimate) for estimate in model.regression],
        "derived": [parameter_section(estimate) for estimate in model.derived],
        "correlation": {"names": model.correlation_names, "matrix": _matrix(model.correlation)},
        "condition_number": model.condition_number,
        "rank": model.rank,
        "columns": model.columns,
        "fit": _fit(model.fit),
        "pipeline": _pipeline(model.pipeline),
        "tests": model.tests,
        "warnings": model.warnings,
        **_joined(model),
    }


def _joined(model: ModelResult) -> dict[str, Any]:
    """Effects that the user named, and the parameters without them; nothing where none were."""
    if not model.effects:
        return {}
    return {
        "effects": [model_effect_section(effect) for effect in model.effects],
        "parameters_before": [parameter_section(estimate) for estimate in model.parameters_before],
    }


def _records(
    model: ModelResult, inputs: Sequence[InputFile], records: Mapping[str, Recording]
) -> dict[str, Any]:
    """Records of a joint estimate, each by itself; nothing where there is one recording."""
    if not model.records:
        return {}
    found = [
        {
            "name": one.name,
            "inputs": [k for k, file in enumerate(inputs) if file.record == one.name],
            "samples": records[one.name].samples,
            "duration_s": records[one.name].duration_s,
            "used": not one.reason,
            "reason": one.reason,
            "parameters": [parameter_section(estimate) for estimate in one.parameters],
            "fit": None if one.fit is None else _fit(one.fit),
            "tests": one.tests,
        }
        for one in model.records
    ]
    return {"records": found}


def _matrix(matrix: NDArray[np.float64]) -> list[list[float | None]]:
    return [[finite(float(cell)) for cell in row] for row in np.atleast_2d(matrix)] if matrix.size else []


def _fit(fit: Fit) -> dict[str, Any]:
    return {
        "torque_rms": fit.torque_rms,
        "residual_rms": fit.residual_rms,
        "fit_percent": fit.fit_percent,
        "unit": fit.unit,
        "held_out": None,
    }


def _pipeline(pipeline: PipelineSummary) -> dict[str, Any]:
    low_hz, high_hz = pipeline.effective_band_hz
    return {
        "sample_rate_hz": pipeline.sample_rate_hz,
        "steps": pipeline.steps,
        "lowpass": {"order": pipeline.lowpass_order, "cutoff_hz": pipeline.lowpass_cutoff_hz},
        "derivative": pipeline.derivative,
        "decimation": pipeline.decimation,
        "effective_band_hz": {"low": low_hz, "high": high_hz},
        "limited_by": pipeline.limited_by,
        "sign_cutoff_hz": pipeline.sign_cutoff_hz,
        "reversal_velocity": pipeline.reversal_velocity,
        "rows": pipeline.rows,
        "trimmed_s": pipeline.trimmed_s,
        "f1_hz": pipeline.f1_hz,
        "f1_source": pipeline.f1_source,
    }


def _plain(value: Any) -> Any:
    """Turn what results hold into data that JSON can hold."""
    match value:
        case None | bool() | int():
            return value
        case float():
            return finite(value)
        case str():
            return _writable(value)
        case Mapping():
            return {_writable(str(key)): _plain(item) for key, item in value.items()}
        case np.generic() | np.ndarray():
            return _plain(value.tolist())
        case Sequence():
            return [_plain(item) for item in value]
        case _:
            message = f"{type(value).__name__} has no place in a report"
            raise TypeError(message)


def _writable(text: str) -> str:
    """Return ``text`` as UTF-8 can hold it: a file name that is not UTF-8 has half characters."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")
