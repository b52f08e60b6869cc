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
    suggests : tuple of str
        What shape, time and lines suggest, in words; no name of an effect.
    """

    equation: str
    variable: str
    interval: tuple[float, float] | None = None
    frequency_hz: tuple[float, float] | None = None
    shape: Shape | None = None
    suggests: tuple[str, ...] = ()


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
class Change:
    """A time from which on another factor of one column of the model fits.

    Attributes
    ----------
    column : str
        Symbol of a parameter of the baseline, or ``motor_offset``, ``load_offset``, ``torque_scale``.
    time_s, earliest_s, latest_s : float
        When, with a 95 % interval, from the record's start.
    size, stderr : float
        Change of the factor, in ``unit``.
    share : float
        Of the residual's sum of squares, what the change explains.
    p_value : float
        Corrected for the number of columns.
    alternatives : tuple of str
        Columns whose change explains nearly as much.
    unit : str
    """

    column: str
    time_s: float
    earliest_s: float
    latest_s: float
    size: float
    stderr: float
    share: float
    p_value: float
    alternatives: tuple[str, ...] = ()
    unit: str = ""


@dataclass(frozen=True)
class Event:
    """A burst of residual energy far above what the rest of the record shows.

    Attributes
    ----------
    equation : str
    start_s, end_s : float
        From the record's start.
    times_usual : float
        Energy over the median's.
    share : float
        Of the equation's sum of squares.
    """

    equation: str
    start_s: float
    end_s: float
    times_usual: float
    share: float


@dataclass(frozen=True)
class Reversals:
    """The residual about an equation's velocity reversals.

    Attributes
    ----------
    equation : str
    count : int
        Reversals.
    time_share : float
        Share of the rows that lie within the window.
    energy_share, low, high : float
        Share of the residual's sum of squares there, with 95 % band.
    p_value : float
        Of an energy share that is no larger than the time's.
    lag_s, mean, band : ndarray
        Mean residual over the time from the reversal, folded by the direction after it, in ``unit``, and the half
        width of its 95 % band.
    unit : str
    """

    equation: str
    count: int
    time_share: float
    energy_share: float
    low: float
    high: float
    p_value: float
    lag_s: Array
    mean: Array
    band: Array
    unit: str


@dataclass(frozen=True)
class AngleLine:
    """A ripple of fixed period over the motor's angle.

    Attributes
    ----------
    cycles_per_motor_revolution, cycles_per_joint_revolution : float
    amplitude, stderr : float
        In torque units.
    share : float
        Of the equation's sum of squares, what the line explains.
    phase : float
        rad: amplitude cos(cycles x angle + phase), at the joint's angle zero.
    false_alarm : float
        Chance that noise of the spectrum's level shows such a line anywhere among those searched.
    """

    cycles_per_motor_revolution: float
    cycles_per_joint_revolution: float
    amplitude: float
    stderr: float
    share: float
    phase: float
    false_alarm: float


@dataclass(frozen=True)
class AngleSpectrum:
    """Spectrum of an equation's residual over the motor's angle.

    Attributes
    ----------
    equation : str
    cycles : ndarray
        Per joint revolution.
    amplitude, level : ndarray
        Of a line there, and the level that noise exceeds anywhere in one of a hundred records; in ``unit``.
    lines : tuple of AngleLine
        Strongest first.
    unit : str
    """

    equation: str
    cycles: Array
    amplitude: Array
    level: Array
    lines: tuple[AngleLine, ...]
    unit: str


@dataclass(frozen=True)
class LoopWidth:
    """Width of the loop of torque over torsion in bands of frequency.

    Attributes
    ----------
    frequency_hz : ndarray, shape (k,)
    stiffness, band : ndarray, shape (k,)
        Torque in quadrature to the torsion over the torsion (loss stiffness), and half width of its 95 % band.
    torsion, width : ndarray, shape (k,)
        Amplitude of the torsion in the band, and the loop's width in torque at zero torsion.
    slope, slope_stderr : float or None
        Of log stiffness over log frequency: zero where the loop does not depend on the rate, one where it is viscous.
        None where too few bands show a loop.
    share : float
        Of the residual's sum of squares, what the loops explain.
    unit, torque_unit : str
    """

    frequency_hz: Array
    stiffness: Array
    band: Array
    torsion: Array
    width: Array
    slope: float | None
    slope_stderr: float | None
    share: float
    unit: str
    torque_unit: str


@dataclass(frozen=True)
class Drift:
    """Trend of one parameter over the record.

    Attributes
    ----------
    column : str
        As `Change`.
    per_minute, stderr : float
        In ``unit`` a minute.
    percent_per_minute : float or None
        Of the parameter.
    share : float
        Of the residual's sum of squares, what the trend explains.
    p_value : float
        Corrected for the number of columns.
    unit : str
    """

    column: str
    per_minute: float
    stderr: float
    percent_per_minute: float | None
    share: float
    p_value: float
    unit: str = ""


@dataclass(frozen=True)
class Locality:
    """Where and when the mismatch of one model with the record shows, by every view of it.

    Attributes
    ----------
    model : {"baseline", "with the named effects"}
        Whose residual it is.
    """

    model: str
    changes: tuple[Change, ...] = ()
    events: tuple[Event, ...] = ()
    reversals: tuple[Reversals, ...] = ()
    angle: tuple[AngleSpectrum, ...] = ()
    loop: LoopWidth | None = None
    drift: tuple[Drift, ...] = ()


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
    locality : Locality or None
        Time, events, reversals, angle, loop and drift of the mismatch.
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
    locality: Locality | None = None
