"""A recording simulated once more, and laid over itself: measured, simulated, residual."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from flexid_cli.effects.base import EffectValues
from flexid_cli.errors import DataError, UsageError
from flexid_cli.pipeline.filters import butterworth, settling_samples, zero_phase
from flexid_cli.simulate import logged
from flexid_cli.simulate.engine import rest_position, simulate_closed_loop, simulate_motor_driven
from flexid_cli.simulate.machine import Axis, Controller, InitialState, Sensors, Trajectory
from flexid_cli.simulate.parameters import Given, axis_of
from flexid_cli.simulate.setup import merged, sensors_of
from flexid_cli.writers.table import LogTable

if TYPE_CHECKING:
    from flexid_cli.config.schema import Config
    from flexid_cli.signals.recording import Recording, Segment

Array = NDArray[np.float64]
Drive = Literal["controller", "motor"]

SIGNALS = ("torque", "motor_position", "joint_position")
MEASURED, SIMULATED, RESIDUAL = "/measured", "/simulated", "/residual"
BAND = 4.0  # of the low pass over the first resonance, where no report says it
ORDER = 6
WIDER = (
    2.0  # the band of the motion that drives, over the one that is compared: there it damps by 2e-4 at most
)
HIGHEST_SHARE = 0.2  # of the sampling rate
START_PERIOD = 0.1  # of the resonance: over which the motion at a segment's start is taken
FEWEST = 8
_NS = 1e9


@dataclass(frozen=True)
class Overlay:
    """Measured and simulated signals of one recording; joint side, SI.

    Attributes
    ----------
    drive : {"controller", "motor"}
        What moved the simulation: the reference through the controller, or the measured motor position.
    table : LogTable
        Channels ``/measured/torque``, ``/simulated/torque``, ``/residual/torque``, and so on.
    residual_rms, measured_rms : mapping of str to float
        By signal; of the residual, and of the measured signal about its mean.
    notes : tuple of str
        What a person should know.
    """

    drive: Drive
    table: LogTable
    residual_rms: Mapping[str, float]
    measured_rms: Mapping[str, float]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Machine:
    """What is simulated in every segment."""

    axis: Axis
    effects: tuple[EffectValues, ...]
    sensors: Sensors
    config: Config
    rate_hz: float
    cutoff_hz: float


def as_recorded(config: Config) -> Config:
    """The configuration under which a recording's torque is what stands in the log at each stamp.

    `identify` moves a held torque to where it acts; an overlay compares what was recorded.
    """
    signals = config.signals
    torque = signals.torque.model_copy(update={"hold": "instant"})
    return config.model_copy(update={"signals": signals.model_copy(update={signals.torque_role: torque})})


def overlay(
    recording: Recording,
    config: Config,
    given: Given,
    *,
    parameters: Mapping[str, float] | None = None,
    effects: Sequence[EffectValues] = (),
    drive: Drive | None = None,
) -> Overlay:
    """Simulate a recording, segment by segment, and compare.

    Parameters
    ----------
    recording : Recording
        Read with `as_recorded`.
    config : Config
        As the log was made.
    given, parameters, effects
        The machine; the later ones win.
    drive : {"controller", "motor"}, optional
        Else the controller where it and the reference are known.

    Returns
    -------
    Overlay

    Raises
    ------
    UsageError
        Parameters are missing, or the closed loop is asked for and not known.
    DataError
        No segment is long enough.
    """
    chosen, note = _drive(recording, config, drive)
    values = {**given.values, **(parameters or {})}
    axis = axis_of(values, config.axis.gravity_m_per_s2, _centre(recording))
    machine = _Machine(
        axis=axis,
        effects=merged(given.effects, effects),
        sensors=_zero_only(sensors_of(config, given)),
        config=config,
        rate_hz=recording.sample_rate_hz,
        cutoff_hz=_cutoff(axis, given, recording.sample_rate_hz),
    )
    simulate = _closed_loop if chosen == "controller" else _motor_driven
    parts = [simulate(segment, machine) for segment in recording.segments if segment.samples >= FEWEST]
    if not parts:
        raise DataError("no segment of the recording is long enough to simulate", "record longer")
    stamps = np.concatenate([_stamps(recording, s) for s in recording.segments if s.samples >= FEWEST])
    channels = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    present = [name for name in SIGNALS if f"{MEASURED}/{name}" in channels]
    return Overlay(
        drive=chosen,
        table=LogTable(stamps, channels),
        residual_rms={s: _rms(channels[f"{RESIDUAL}/{s}"]) for s in present if f"{RESIDUAL}/{s}" in channels},
        measured_rms={s: float(np.std(channels[f"{MEASURED}/{s}"])) for s in present},
        notes=(note,) if note else (),
    )


def _drive(recording: Recording, config: Config, wanted: Drive | None) -> tuple[Drive, str]:
    """What moves the simulation, and why where it was not asked for."""
    missing = []
    if config.controller is None or config.controller.law == "external":
        missing.append("the controller is not known")
    if any(s.reference_position is None for s in recording.segments):
        missing.append("reference_position was not recorded")
    if wanted == "controller" and missing:
        raise UsageError(
            f"the closed loop cannot be simulated: {' and '.join(missing)}",
            "leave --drive out: the measured motor position then drives the simulation",
        )
    if wanted is not None:
        return wanted, ""
    return ("motor", f"{' and '.join(missing)}: driven by the motor") if missing else ("controller", "")


def _centre(recording: Recording) -> float:
    """Middle of the motor's motion, as `identify` takes it."""
    positions = [s.motor_position for s in recording.segments]
    return 0.5 * float(min(p.min() for p in positions) + max(p.max() for p in positions))


def _zero_only(sensors: Sensors) -> Sensors:
    """Delays and zeros are part of what is compared, noise and counts would only add noise."""
    return replace(
        sensors,
        motor_resolution=0.0,
        joint_resolution=0.0,
        torque_noise=0.0,
        motor_noise=0.0,
        joint_noise=0.0,
    )


def _cutoff(axis: Axis, given: Given, rate_hz: float) -> float:
    cutoff = given.cutoff_hz or BAND * axis.resonance_hz
    return min(cutoff, HIGHEST_SHARE * rate_hz)


def _stamps(recording: Recording, segment: Segment) -> NDArray[np.int64]:
    offsets = (segment.start_s + np.arange(segment.samples) / recording.sample_rate_hz) * _NS
    return recording.start_ns + np.rint(offsets).astype(np.int64)


def _closed_loop(segment: Segment, m: _Machine) -> dict[str, Array]:
    """The reference moves the simulation; it starts from the measured motion and torque."""
    controller = Controller.from_config(m.config.controller)
    reference = segment.reference_position
    if reference is None:
        raise UsageError("reference_position was not recorded")
    run = simulate_closed_loop(
        m.axis,
        controller,
        reference,
        m.rate_hz,
        effects=m.effects,
        sensors=m.sensors,
        initial=_start(segment, reference, controller, m),
    )
    torque = logged.at_stamp(run.torque, m.rate_hz, m.config)
    channels = _pair("torque", segment.torque, torque)
    channels |= _pair("motor_position", segment.motor_position, run.motor_position)
    return channels | _joint(segment, run) | {"/measured/reference_position": reference}


def _start(segment: Segment, reference: Array, controller: Controller, m: _Machine) -> InitialState:
    """The measured motion, and the integral that the first torque needs.

    Without a joint encoder the torsion is that of rest.
    """
    position, speed = _first_motion(segment.motor_position, m)
    joint, joint_speed = rest_position(m.axis, position), speed
    if segment.joint_position is not None:
        joint, joint_speed = _first_motion(segment.joint_position - m.sensors.joint_zero, m)
    wanted_speed = float(reference[1] - reference[0]) * m.rate_hz
    integral = 0.0
    if controller.ki > 0.0:
        error = controller.kp * (float(reference[0]) - position) - speed
        error += controller.velocity_feedforward * wanted_speed
        period = controller.period_s or 1.0 / m.rate_hz
        integral = (float(segment.torque[0]) - controller.kv * error) / controller.ki - error * period
    return InitialState(position, joint, speed, joint_speed, integral, wanted_speed)


def _first_motion(positions: Array, m: _Machine) -> tuple[float, float]:
    """Position and speed at the start, by a cubic through the first part of a resonance's period."""
    count = min(max(FEWEST, round(START_PERIOD / m.axis.resonance_hz * m.rate_hz)), positions.size)
    cubic = np.polyfit(np.arange(count) / m.rate_hz, positions[:count], 3)
    return float(cubic[3]), float(cubic[2])


def _motor_driven(segment: Segment, m: _Machine) -> dict[str, Array]:
    """The measured motor position moves the simulation, without the noise above twice the band that is compared."""
    moved = zero_phase(segment.motor_position, butterworth(ORDER, WIDER * m.cutoff_hz, m.rate_hz))
    run = simulate_motor_driven(m.axis, moved, m.rate_hz, effects=m.effects, sensors=m.sensors)
    torque = logged.at_stamp(run.torque, m.rate_hz, m.config, stepwise=False)
    band = butterworth(ORDER, m.cutoff_hz, m.rate_hz)
    channels = _pair("torque", segment.torque, torque, band)
    channels |= {f"{MEASURED}/motor_position": segment.motor_position, f"{SIMULATED}/motor_position": moved}
    return channels | _joint(segment, run, band)


def _joint(segment: Segment, run: Trajectory, band: Array | None = None) -> dict[str, Array]:
    if segment.joint_position is None:
        return {f"{SIMULATED}/joint_position": run.joint_position}
    return _pair("joint_position", segment.joint_position, run.joint_position, band)


def _pair(name: str, measured: Array, simulated: Array, band: Array | None = None) -> dict[str, Array]:
    """The two and their difference; where there is a band, low-passed, and no number where the filter settles."""
    residual = measured - simulated
    if band is not None:
        residual = zero_phase(residual, band)
        edge = min(settling_samples(band), residual.size // 2 - 1)
        residual[:edge] = residual[residual.size - edge :] = np.nan
    return {f"{MEASURED}/{name}": measured, f"{SIMULATED}/{name}": simulated, f"{RESIDUAL}/{name}": residual}


def _rms(values: Array) -> float:
    return float(np.sqrt(np.nanmean(values**2)))
