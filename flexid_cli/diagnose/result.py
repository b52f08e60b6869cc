"""What a diagnosis says, as frozen data; renderers read it, nothing here formats."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from flexid_cli.estimate.result import Estimate

Array = NDArray[np.float64]
Verdict = Literal["adequate", "explained", "partly_explained", "ambiguous", "unexplained", "inconclusive"]


@dataclass(frozen=True)
class Shape:
    """A residual as a function of the variable that it was located in, with 95 % bands."""

    x: Array
    y: Array
    low: Array
    high: Array
    x_unit: str
    unit: str


@dataclass(frozen=True)
class Where:
    """Place of a mismatch.

    Attributes
    ----------
    equation : {"motor", "transmission", "load", "measurement"}
    variable : str
        ``velocity``, ``position``, ``torsion``, ``load_times_sign``, ``time``, ``frequency``, ...
    interval : (float, float) or None
        Times between which it acts, s from the record's start; None: all the time.
    frequency_hz : (float, float) or None
        Band that holds most of it.
    shape : Shape or None
        As a function of the variable.
    """

    equation: str
    variable: str
    interval: tuple[float, float] | None = None
    frequency_hz: tuple[float, float] | None = None
    shape: Shape | None = None


@dataclass(frozen=True)
class Evidence:
    """Why an effect was named.

    Attributes
    ----------
    statistic : float
        Gain: logarithm of the whitened residual's sum of squares without the effect over with it.
    threshold : float
        Least gain that names an effect; calibrated, see docs/diagnosis.md.
    p_value : float
        Of the effect's score, robust to correlated residuals, after correction for the size of the library.
    held_out_gain : float or None
        The same gain on data that the effect was not fitted to: blocks of the record, or the other recording.
    stability : float
        Share of the record's blocks in which its amplitude has the same sign.
    """

    statistic: float
    threshold: float
    p_value: float
    held_out_gain: float | None
    stability: float


@dataclass(frozen=True)
class NamedEffect:
    """An effect that the record holds.

    Attributes
    ----------
    name, code, family : str
    alternatives : tuple of str
        Names that the data cannot exclude in its place.
    parameters : tuple of Estimate
    evidence : Evidence
    where : Where
    """

    name: str
    code: str
    family: str
    alternatives: tuple[str, ...]
    parameters: tuple[Estimate, ...]
    evidence: Evidence
    where: Where


@dataclass(frozen=True)
class Tested:
    """An effect that was tried, and why it was not chosen (empty where it was)."""

    name: str
    code: str
    statistic: float | None
    reason: str


@dataclass(frozen=True)
class HeldOut:
    """Residual RMS on data that was not fitted, by equation, in torque units."""

    before: Mapping[str, float]
    after: Mapping[str, float]
    noise_floor: Mapping[str, float]
    data: str  # "blocks of the record", or the other recording's name
    unit: str


@dataclass(frozen=True)
class SimulationError:
    """RMS difference of simulated and recorded joint position (or torque for the motor alone)."""

    before: float | None
    after: float | None
    quantity: str
    unit: str
    reason: str = ""


@dataclass(frozen=True)
class Traces:
    """Residual of each equation over time before and after, for figures; shapes (rows,)."""

    time_s: Array
    before: Mapping[str, Array]
    after: Mapping[str, Array]
    unit: str


@dataclass(frozen=True)
class ResidualMap:
    """Binned mean of a residual over a variable before and after, with 95 % bands, for figures."""

    equation: str
    variable: str
    x: Array
    before: Array
    after: Array
    band: Array
    x_unit: str
    unit: str


@dataclass(frozen=True)
class Diagnosis:
    """Outcome of a diagnosis.

    Attributes
    ----------
    verdict : Verdict
    sentence : str
        What a person should take from it.
    model : {"two_encoders", "motor_only"}
    effects : tuple of NamedEffect
        In the order of what they explain.
    location : Where or None
        Of what stays unexplained.
    held_out, simulation : HeldOut, SimulationError or None
    parameters_before, parameters_after : tuple of Estimate
        K, Jm, JL and friction of the baseline, and with the effects.
    tested : tuple of Tested
    next_recording : tuple of str
        What to record to decide what this record cannot.
    notes : tuple of str
    traces, maps : for figures
    """

    verdict: Verdict
    sentence: str
    model: str
    effects: tuple[NamedEffect, ...]
    location: Where | None
    held_out: HeldOut | None
    simulation: SimulationError | None
    parameters_before: tuple[Estimate, ...]
    parameters_after: tuple[Estimate, ...]
    tested: tuple[Tested, ...]
    next_recording: tuple[str, ...]
    notes: tuple[str, ...]
    traces: Traces | None = None
    maps: tuple[ResidualMap, ...] = field(default=())
