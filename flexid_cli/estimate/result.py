"""Results of an identification, as frozen data; renderers read them, nothing here formats."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Verdict = Literal["identified", "weak", "not_identifiable"]


@dataclass(frozen=True)
class Interval:
    """A confidence interval, always with its level and method."""

    low: float
    high: float
    level: float
    method: str


@dataclass(frozen=True)
class Estimate:
    """One parameter with what the data say of it.

    Attributes
    ----------
    name, symbol, unit : str
        ``joint_stiffness``, ``K``, ``N.m/rad``.
    value, stderr : float or None
        None where the data do not determine the parameter (then ``reason`` says why).
    interval : Interval or None
        Confidence interval.
    relative_stderr_percent : float or None
        The paper's relative standard deviation, 100 stderr / abs(value).
    verdict : {"identified", "weak", "not_identifiable"}
        Whether the estimate can be relied on.
    reason : str
        Why, where the verdict is not ``identified``.
    advice : str
        What to record to determine it, where the verdict is not ``identified`` and a recording would help.
    """

    name: str
    symbol: str
    unit: str
    value: float | None
    stderr: float | None
    interval: Interval | None
    relative_stderr_percent: float | None
    verdict: Verdict
    reason: str = ""
    advice: str = ""


@dataclass(frozen=True)
class Fit:
    """How well the model predicts the filtered motor torque.

    ``fit_percent`` is 100 (1 - norm(residual) / norm(torque - mean)).
    """

    torque_rms: float
    residual_rms: float
    fit_percent: float
    unit: str


@dataclass(frozen=True)
class Trace:
    """Measured and predicted torque after the pipeline, for the figures. Times in s from the record's start."""

    time_s: Array
    measured: Array
    predicted: Array
    unit: str


@dataclass(frozen=True)
class Spectrum:
    """Amplitude spectrum of the unfiltered torque (square root of the power density), for the figures."""

    frequency_hz: Array
    density: Array
    unit: str


@dataclass(frozen=True)
class PipelineSummary:
    """What was done to the data before the solve.

    Attributes
    ----------
    sample_rate_hz : float
        Rate of the recording.
    steps : tuple of str
        Every step in words, with its numbers, in order.
    lowpass_order : int
        Order of the Butterworth filter in one direction.
    lowpass_cutoff_hz : float or None
        Cutoff of the Butterworth filter.
    derivative : str
        ``exact`` or ``central``.
    decimation : int
        Nd; 1 where not decimated.
    effective_band_hz : tuple of float
        Lowest and highest frequency that enter the estimate.
    limited_by : str
        Which step sets the upper edge (``decimation``, ``lowpass``).
    sign_cutoff_hz : float
        Cutoff of the velocity whose sign is taken.
    reversal_velocity : float or None
        Fitted v0 of tanh(v/v0), rad/s or m/s.
    rows : int
        Rows of one equation after decimation and trimming.
    trimmed_s : float
        Cut off at each edge of each segment.
    f1_hz : float or None
        First (free-free) resonance used for the tuning, and in ``f1_source`` where it came from.
    f1_source : str
        ``configuration``, ``data`` or empty.
    magnitude_hz, magnitude : ndarray
        Magnitude of the whole filter chain common to all columns, for the figure.
    """

    sample_rate_hz: float
    steps: tuple[str, ...]
    lowpass_order: int
    lowpass_cutoff_hz: float | None
    derivative: str
    decimation: int
    effective_band_hz: tuple[float, float]
    limited_by: str
    sign_cutoff_hz: float
    reversal_velocity: float | None
    rows: int
    trimmed_s: float
    f1_hz: float | None
    f1_source: str
    magnitude_hz: Array
    magnitude: Array


@dataclass(frozen=True)
class ModelEffect:
    """An effect that was named and joined to a model.

    Attributes
    ----------
    name, code, family : str
    parameters : tuple of Estimate
    statistic, threshold, p_value, held_out_gain, stability : float
        Evidence for it as a diagnosis has it; NaN where it could not join the model.
    """

    name: str
    code: str
    family: str
    parameters: tuple[Estimate, ...]
    statistic: float
    threshold: float
    p_value: float
    held_out_gain: float
    stability: float


@dataclass(frozen=True)
class RecordResult:
    """One of several records of the axis, as it speaks for itself.

    Attributes
    ----------
    name : str
        Of the record.
    parameters : tuple of Estimate
        From this record alone; empty where it could not be solved.
    fit : Fit or None
        Of these estimates.
    tests : mapping
        As `ModelResult`.
    reason : str
        Why it does not count in the joint estimate, or empty.
    """

    name: str
    parameters: tuple[Estimate, ...] = ()
    fit: Fit | None = None
    tests: dict[str, dict[str, Any]] = field(default_factory=dict)
    reason: str = ""


@dataclass(frozen=True)
class ModelResult:
    """One model solved on one recording.

    Attributes
    ----------
    id : str
        ``two_encoders``, ``motor_only`` or ``rigid``.
    method : str
        ``ols``, ``wls``, ``structured`` or ``paper``, and ``method_reason``: why it was taken.
    equation : str
        The model's equation in the report's symbols, plain text.
    parameters : tuple of Estimate
        The physical parameters.
    regression : tuple of Estimate
        X1..X7 of the motor-only model; empty else.
    derived : tuple of Estimate
        Quantities that follow (resonance, antiresonance, inertia ratio), by the delta method.
    correlation_names, correlation : tuple of str, ndarray (p, p)
        Correlation of the estimates of ``parameters`` that were estimated.
    condition_number : float
        Of the observation matrix after column scaling; ``rank`` and ``columns`` beside it.
    added_terms : tuple of str
        Effects that were added beyond the declared baseline (``gravity``, ``torque_offset``).
    tests : mapping
        Named test results, each a mapping of plain numbers and words (statistic, p_value, verdict).
    effects, parameters_before : tuple of ModelEffect, tuple of Estimate
        Effects that the user named, and the physical parameters without them; empty where none were.
    records : tuple of RecordResult
        The records of a joint estimate, each alone; empty where there is one recording.
    """

    id: str
    method: str
    method_reason: str
    equation: str
    parameters: tuple[Estimate, ...]
    regression: tuple[Estimate, ...]
    derived: tuple[Estimate, ...]
    correlation_names: tuple[str, ...]
    correlation: Array
    condition_number: float
    rank: int
    columns: int
    fit: Fit
    pipeline: PipelineSummary
    trace: Trace
    spectrum: Spectrum
    added_terms: tuple[str, ...]
    tests: dict[str, dict[str, Any]]
    warnings: tuple[str, ...]
    effects: tuple[ModelEffect, ...] = ()
    parameters_before: tuple[Estimate, ...] = ()
    records: tuple[RecordResult, ...] = ()


@dataclass(frozen=True)
class Skipped:
    """A model that could not be solved on this recording, and why."""

    id: str
    reason: str


@dataclass(frozen=True)
class Identification:
    """All that ``flexid identify`` found."""

    models: tuple[ModelResult, ...]
    skipped: tuple[Skipped, ...]
    warnings: tuple[str, ...]
