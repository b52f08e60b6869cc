"""What `flexid simulate` simulates: axis, controller, sensors, effects and reference out of all that is given."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flexid_cli import __version__
from flexid_cli.effects.base import EffectValues
from flexid_cli.effects.registry import effect as effect_named
from flexid_cli.errors import UsageError
from flexid_cli.signals.convert import TURN
from flexid_cli.simulate import logged
from flexid_cli.simulate.engine import simulate_closed_loop
from flexid_cli.simulate.machine import Axis, Controller, Sensors, Trajectory
from flexid_cli.simulate.noise import coloured
from flexid_cli.simulate.parameters import Given, axis_of
from flexid_cli.simulate.reference import KINDS, Motion, reference, reference_from_file
from flexid_cli.units import parse_unit

if TYPE_CHECKING:
    from flexid_cli.config.schema import Config, Simulation

Array = NDArray[np.float64]

DEFAULT_RATE_HZ = 1000.0
DEFAULT_DURATION_S = 60.0
AMPLITUDES = {False: 0.08, True: 0.01}  # rad and m (linear axis)
SLOW_TURNS = 2.0  # of the motor, to either side
LOWEST_HZ = 0.05
BAND = {"chirp": 4.0, "multisine": 2.5, "updown": 0.25}  # upper frequency over the first resonance
HIGHEST_SHARE = 0.2  # of the rate of the record
MOST_SAMPLES = 50_000_000
_TORQUE_STREAM = 1


@dataclass(frozen=True)
class Setup:
    """Everything that a simulated record follows from.

    Attributes
    ----------
    axis, controller, sensors, effects
        The machine.
    reference : ndarray, shape (n,)
        Joint side.
    rate_hz : float
    seed : int
    motion : mapping
        What the reference does, in words.
    """

    axis: Axis
    controller: Controller
    sensors: Sensors
    effects: tuple[EffectValues, ...]
    reference: Array
    rate_hz: float
    seed: int
    motion: Mapping[str, Any]


@dataclass(frozen=True)
class Wishes:
    """What the command line asks for; None leaves it to the configuration."""

    trajectory: str | None = None
    amplitude: float | None = None
    start_hz: float | None = None
    stop_hz: float | None = None
    duration_s: float | None = None
    rate_hz: float | None = None
    seed: int | None = None


def prepare(
    config: Config,
    given: Given,
    wishes: Wishes,
    *,
    parameters: Mapping[str, float] | None = None,
    effects: Sequence[EffectValues] = (),
) -> Setup:
    """Bring configuration, source of parameters and command line together; the later in this order wins.

    Raises
    ------
    UsageError
        A parameter or the controller is missing, or values contradict each other.
    InputError
        The trajectory's file cannot be used.
    """
    section = _section(config)
    controller = controller_of(config)
    rate = _rate(config, given, wishes)
    duration = _first(wishes.duration_s, section.duration_s, DEFAULT_DURATION_S)
    if duration * rate > MOST_SAMPLES:
        raise UsageError(
            f"{duration:g} s at {rate:g} Hz are too many samples for one record", "simulate a shorter one"
        )
    kind = wishes.trajectory or section.trajectory.kind or KINDS[0]
    centre = section.trajectory.centre or 0.0
    axis = axis_of({**given.values, **(parameters or {})}, config.axis.gravity_m_per_s2, centre)
    motion: Mapping[str, Any]
    if kind in KINDS:
        chosen = _motion(kind, axis, config, wishes, rate)
        motion, wanted = asdict(chosen), reference(chosen, duration, rate)
    else:
        wanted = _from_file(kind, config, rate, duration if wishes.duration_s else None)
        motion = {"file": kind}
    return Setup(
        axis=axis,
        controller=controller,
        sensors=sensors_of(config, given),
        effects=merged(given.effects, effects),
        reference=wanted,
        rate_hz=rate,
        seed=_first(wishes.seed, section.seed, 0),
        motion=motion,
    )


def run(setup: Setup) -> Trajectory:
    """Simulate; ``torque`` is without its noise, which `torque_noise` gives.

    Raises
    ------
    UsageError
        The loop is unstable, or cannot be integrated.
    """
    return simulate_closed_loop(
        setup.axis,
        setup.controller,
        setup.reference,
        setup.rate_hz,
        effects=setup.effects,
        sensors=replace(setup.sensors, torque_noise=0.0),
        seed=setup.seed,
    )


def torque_noise(setup: Setup) -> Array:
    """Noise of the recorded torque, joint side, shape (n,)."""
    random = np.random.default_rng((setup.seed, _TORQUE_STREAM))
    sensors, n = setup.sensors, setup.reference.size
    return coloured(
        random, n, sensors.torque_noise, sensors.torque_noise_time_s, np.arange(n) / setup.rate_hz
    )


def truth(setup: Setup, config: Config, source: str) -> dict[str, Any]:
    """What was simulated, as `from_truth` reads it again; joint side, SI."""
    return {
        "schema": "flexid-truth/1",
        "tool": {"name": "flexid", "version": __version__},
        "source": source,
        "axis": _given(asdict(setup.axis)),
        "resonance_hz": setup.axis.resonance_hz,
        "antiresonance_hz": setup.axis.antiresonance_hz,
        "controller": _given(asdict(setup.controller)),
        "effects": {e.name: {**effect_named(e.name).neutral, **e.values} for e in setup.effects},
        "sensors": {k: v for k, v in asdict(setup.sensors).items() if v != 0.0},
        "trajectory": dict(setup.motion),
        "gear_ratio": config.axis.gear_ratio,
        "torque_constant_nm_per_a": config.axis.torque_constant_nm_per_a,
        "sample_rate_hz": setup.rate_hz,
        "samples": int(setup.reference.size),
        "seed": setup.seed,
    }


def _given(values: Mapping[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in values.items() if v is not None}


def controller_of(config: Config) -> Controller:
    """The configuration's controller.

    Raises
    ------
    UsageError
        It is not known.
    """
    try:
        return Controller.from_config(config.controller)
    except UsageError as error:
        raise UsageError(
            error.message,
            "give `controller: {kp: ..., kv: ..., ki: ...}` in the configuration; --like LOG needs none, for there"
            " the measured motor position drives the simulation",
        ) from error


def sensors_of(config: Config, given: Given) -> Sensors:
    """Sensors of the source of parameters, with what the configuration says of them in their place.

    An encoder that is logged in counts has its counts unless told otherwise.

    Raises
    ------
    UsageError
        Counts per revolution on a linear axis.
    """
    section = _section(config).sensors.model_dump(exclude_none=True)
    values: dict[str, float] = {**_counts_of_log(config), **given.sensors}
    gear = {"motor": config.axis.gear_ratio, "joint": 1.0}
    for side, ratio in gear.items():
        counts = section.pop(f"{side}_counts_per_rev", None)
        if counts is not None and config.linear:
            raise UsageError(
                f"simulation.sensors.{side}_counts_per_rev: a linear axis has no revolution",
                f"give {side}_resolution in m",
            )
        if counts is not None:
            values[f"{side}_resolution"] = TURN / counts / ratio
    skew = section.pop("skew_s", 0.0)
    values.update(section)
    values["joint_delay_s"] = values.get("joint_delay_s", 0.0) + skew
    return Sensors(**values)


def _counts_of_log(config: Config) -> dict[str, float]:
    steps = {}
    for side in ("motor", "joint"):
        signal = getattr(config.signals, f"{side}_position")
        if signal is not None and parse_unit(signal.unit).dimension == "count":
            steps[f"{side}_resolution"] = abs(logged.unit_of_position(f"{side}_position", signal, config))
    return steps


def merged(first: Sequence[EffectValues], second: Sequence[EffectValues]) -> tuple[EffectValues, ...]:
    """Effects of both; where both have one, the second's values win."""
    values: dict[str, dict[str, float]] = {}
    for effect in (*first, *second):
        values.setdefault(effect.name, {}).update(effect.values)
    return tuple(EffectValues(name, given) for name, given in values.items())


def _section(config: Config) -> Simulation:
    from flexid_cli.config.schema import Simulation

    return config.simulation or Simulation()


def _first(*values: Any) -> Any:
    """The first that is given."""
    return next(value for value in values if value is not None)


def _rate(config: Config, given: Given, wishes: Wishes) -> float:
    """Rate of the record; that of a log without times is fixed by its configuration."""
    time, controller = config.signals.time, config.controller
    fixed = None if time is None else time.rate_hz
    wanted = wishes.rate_hz or _section(config).rate_hz
    if fixed is not None and wanted is not None and abs(wanted - fixed) > 1e-9 * fixed:
        raise UsageError(
            f"a record at {wanted:g} Hz would not be what the configuration says (signals.time.rate_hz {fixed:g})",
            "leave --rate out, or change signals.time.rate_hz",
        )
    period = None if controller is None else controller.period_s
    of_controller = None if period is None else 1.0 / period
    return float(_first(wanted, fixed, given.sample_rate_hz, of_controller, DEFAULT_RATE_HZ))


def _motion(kind: str, axis: Axis, config: Config, wishes: Wishes, rate: float) -> Motion:
    section = _section(config).trajectory
    amplitude = AMPLITUDES[config.linear]
    if kind == "slow" and not config.linear:
        amplitude = max(amplitude, SLOW_TURNS * TURN / config.axis.gear_ratio)
    stop = min(BAND.get(kind, 1.0) * axis.resonance_hz, HIGHEST_SHARE * rate)
    stop = _first(wishes.stop_hz, section.stop_hz, stop)
    return Motion(
        kind=kind,
        amplitude=_first(wishes.amplitude, section.amplitude, amplitude),
        start_hz=_first(wishes.start_hz, section.start_hz, min(LOWEST_HZ, 0.1 * stop)),
        stop_hz=stop,
        centre=section.centre or 0.0,
    )


def _from_file(name: str, config: Config, rate: float, duration: float | None) -> Array:
    path = Path(name)
    if not path.exists():
        import difflib

        near = difflib.get_close_matches(name, KINDS, n=1, cutoff=0.5)
        guess = f"did you mean {near[0]}? " if near else ""
        raise UsageError(
            f"--trajectory {name}: there is neither such a trajectory nor such a file",
            f"{guess}trajectories: {', '.join(KINDS)}; or a log that holds a reference",
        )
    wanted = reference_from_file(path, config, rate)
    return wanted if duration is None else wanted[: round(duration * rate)]
