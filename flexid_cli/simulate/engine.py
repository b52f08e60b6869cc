"""Simulation in closed loop, driven by a torque, or driven by the measured motor position.

    simulate_closed_loop(axis, controller, reference, rate_hz, effects=(EffectValues("backlash", {"gap": 1e-3}),))
    simulate_torque_driven(axis, torque, rate_hz)
    simulate_motor_driven(axis, motor_position, rate_hz)

Each returns a `Trajectory`. The kernels run without the interpreter's lock, so that threads use all cores. The same
arguments give the same bytes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from flexid_cli.effects import slots
from flexid_cli.effects.base import Effect, EffectValues, Stage
from flexid_cli.effects.registry import effect as effect_named
from flexid_cli.errors import UsageError
from flexid_cli.simulate import kernel
from flexid_cli.simulate.compiled import law_table
from flexid_cli.simulate.machine import Array, Axis, Controller, InitialState, Sensors, Solver, Trajectory
from flexid_cli.simulate.noise import coloured

Index = NDArray[np.int64]

_STARTS = {"torque": -1, "motor_position": 0, "joint_position": 1, "joint_velocity": 3}
_KINDS = {
    "torque": kernel.BY_ITSELF,
    "motor_position": kernel.BY_TORSION,
    "joint_position": kernel.BY_TORSION,
    "joint_velocity": kernel.BY_VELOCITY,
}
_SAME_INSTANT = 1e-6  # of the shorter period


def simulate_closed_loop(
    axis: Axis,
    controller: Controller,
    reference: Array,
    rate_hz: float,
    *,
    effects: Sequence[EffectValues] = (),
    sensors: Sensors | None = None,
    seed: int = 0,
    initial: InitialState | None = None,
    solver: Solver | None = None,
) -> Trajectory:
    """Simulate the axis following a reference under its controller.

    Parameters
    ----------
    axis, controller, effects, sensors
        The machine; torques, positions and gains joint side.
    reference : ndarray, shape (n,)
        Position set point at the record's instants, rad.
    rate_hz : float
        Rate of the record, and of the controller unless it has a period of its own (the reference is then
        interpolated linearly).
    seed : int
        Seed of all noise.
    initial : InitialState, optional
        Else at rest at the first reference.
    solver : Solver, optional

    Returns
    -------
    Trajectory
        Arrays of shape (n,).

    Raises
    ------
    UsageError
        Impossible values, an unstable loop, steps too coarse, an axis too stiff to integrate.
    """
    reference = _series(reference, "reference")
    period = controller.period_s or 1.0 / _rate(rate_hz)
    times, controls, rows = _breakpoints(reference.size, 1.0 / rate_hz, period)
    at = np.arange(controls.max() + 1) * period
    grid = np.arange(reference.size) / rate_hz
    wanted = reference if controller.period_s is None else np.interp(at, grid, reference)
    history = (0.0, 0.0) if initial is None else (initial.integral, initial.reference_velocity)
    gains = np.array(
        [controller.kp, controller.kv, controller.ki, controller.velocity_feedforward, period, *history]
    )
    plan = _Plan(times, controls, rows, np.empty((0, 6)), gains, wanted)
    start = initial or InitialState(float(reference[0]), rest_position(axis, float(reference[0])))
    return _simulate(
        axis, plan, rate_hz, effects, sensors or Sensors(), seed, start, initial is None, solver, reference
    )


def simulate_torque_driven(
    axis: Axis,
    torque: Array,
    rate_hz: float,
    *,
    hold: Literal["sample", "linear"] = "sample",
    effects: Sequence[EffectValues] = (),
    sensors: Sensors | None = None,
    seed: int = 0,
    initial: InitialState | None = None,
    solver: Solver | None = None,
) -> Trajectory:
    """Simulate the axis under a given torque.

    Parameters
    ----------
    torque : ndarray, shape (n,)
        Motor torque, joint side, N m, held from its instant for a period (``sample``) or joined by straight
        lines (``linear``).
    initial : InitialState, optional
        Else at rest at zero.

    Returns
    -------
    Trajectory
        ``reference_position`` is the motor position.

    Raises
    ------
    UsageError
        As `simulate_closed_loop`.
    """
    torque = _series(torque, "torque")
    inputs = np.zeros((torque.size, 6))
    inputs[:, 0] = torque
    if hold == "linear":
        inputs[:-1, 1] = np.diff(torque) * _rate(rate_hz)
    plan = _record_plan(inputs, rate_hz)
    start = initial or InitialState(0.0, rest_position(axis, 0.0))
    return _simulate(
        axis, plan, rate_hz, effects, sensors or Sensors(), seed, start, initial is None, solver, None
    )


def simulate_motor_driven(
    axis: Axis,
    motor_position: Array,
    rate_hz: float,
    *,
    effects: Sequence[EffectValues] = (),
    sensors: Sensors | None = None,
    seed: int = 0,
    initial: InitialState | None = None,
    solver: Solver | None = None,
) -> Trajectory:
    """Simulate the load behind a prescribed motor motion; the torque follows by the motor equation.

    Parameters
    ----------
    motor_position : ndarray, shape (n,)
        Joint side, rad; joined by a spline of degree five, whose second derivative is the motor's acceleration.
        Noise in it is amplified accordingly: filter before.
    initial : InitialState, optional
        Only the joint's part is used; else the joint follows the motor with the torsion that weight and
        acceleration need.

    Returns
    -------
    Trajectory
        ``torque`` is the command: what the actuator's effects turn into the torque that the motion needs.

    Raises
    ------
    UsageError
        As `simulate_closed_loop`.
    """
    motor_position = _series(motor_position, "motor_position")
    inputs = _spline(motor_position, _rate(rate_hz))
    plan = _record_plan(inputs, rate_hz)
    first, speed = float(inputs[0, 0]), float(inputs[0, 1])
    start = initial or InitialState(first, rest_position(axis, first), speed, speed)
    return _simulate(
        axis,
        plan,
        rate_hz,
        effects,
        sensors or Sensors(),
        seed,
        start,
        initial is None,
        solver,
        None,
        driven=True,
    )


@dataclass(frozen=True)
class _Plan:
    """Breakpoints and what happens there, for the kernel."""

    times: Array
    controls: Index
    rows: Index
    inputs: Array
    gains: Array
    reference: Array


def _series(values: Array, name: str) -> Array:
    values = np.ascontiguousarray(values, dtype=np.float64)
    if values.ndim != 1 or values.size < 2:
        raise UsageError(f"{name} must be one row of two or more values, not {values.shape}")
    if not np.all(np.isfinite(values)):
        raise UsageError(f"{name} holds values that are no numbers", "fill or cut the gaps first")
    return values


def _rate(rate_hz: float) -> float:
    if not (math.isfinite(rate_hz) and rate_hz > 0.0):
        raise UsageError(f"a rate of {rate_hz:g} Hz is not possible")
    return rate_hz


def _record_plan(inputs: Array, rate_hz: float) -> _Plan:
    n = inputs.shape[0]
    index = np.arange(n, dtype=np.int64)
    return _Plan(index / _rate(rate_hz), np.full(n, -1), index, inputs, np.zeros(7), np.zeros(1))


def _breakpoints(n: int, record_s: float, control_s: float) -> tuple[Array, Index, Index]:
    """Instants of record and controller, merged; index of each at every instant (-1: none)."""
    rows: Index = np.arange(n, dtype=np.int64)
    record: Array = rows.astype(np.float64) * record_s
    if abs(control_s - record_s) <= 1e-12 * record_s:
        return record, rows, rows
    control = np.arange(int(record[-1] / control_s * (1.0 + 1e-12)) + 1) * control_s
    near = np.rint(control / record_s).astype(np.int64)
    same = (np.abs(control - near * record_s) <= _SAME_INSTANT * min(record_s, control_s)) & (near < n)
    control[same] = record[near[same]]
    times = np.union1d(record, control).astype(np.float64)
    controls: Index = np.full(times.size, -1)
    recorded: Index = np.full(times.size, -1)
    controls[np.searchsorted(times, control)] = np.arange(control.size)
    recorded[np.searchsorted(times, record)] = rows
    return times, controls, recorded


def _spline(values: Array, rate_hz: float) -> Array:
    """Coefficients of each interval's polynomial in the time since its start, shape (n, 6)."""
    from scipy.interpolate import make_interp_spline

    degree = min(5, values.size - 1)
    index = np.arange(values.size, dtype=np.float64)
    spline = make_interp_spline(index, values, k=degree)
    out = np.zeros((values.size, 6))
    for order in range(degree + 1):
        out[:, order] = spline(index, nu=order) * rate_hz**order / math.factorial(order)
    return out


def rest_position(axis: Axis, motor_position: float) -> float:
    """Joint position where the spring carries the weight (the kernel adds what effects change)."""
    position = motor_position
    for _ in range(50):
        load = axis.gravity * (axis.MX * math.cos(position) + axis.MY * math.sin(position))
        position = motor_position - load / axis.K
    return position


def _workspace(axis: Axis) -> Array:
    w = np.zeros(slots.SIZE)
    load_width = axis.load_reversal_velocity
    w[slots.JM : slots.LOAD_WIDTH + 1] = [
        axis.Jm, axis.K, axis.JL, axis.FVm, axis.FSm, axis.FV, axis.FS, axis.MX, axis.MY, axis.gravity,
        axis.torque_offset, axis.reversal_velocity, axis.reversal_velocity if load_width is None else load_width,
    ]  # fmt: skip
    if not np.all(np.isfinite(w)):
        raise UsageError("the axis has parameters that are no numbers")
    if min(axis.Jm, axis.JL, axis.K) <= 0.0 or w[slots.MOTOR_WIDTH : slots.LOAD_WIDTH + 1].min() < 0.0:
        raise UsageError("an axis needs positive inertias and stiffness, and no negative reversal velocity")
    return w


def _chosen(effects: Sequence[EffectValues], driven: bool) -> tuple[list[Effect], Array]:
    """Effects in the order of their codes, with the vector of their parameters."""
    known = sorted(((effect_named(e.name), e.values) for e in effects), key=lambda pair: pair[0].code)
    names = [effect.name for effect, _ in known]
    if len(set(names)) < len(names):
        raise UsageError(
            "an effect is given twice: " + ", ".join(sorted({n for n in names if names.count(n) > 1}))
        )
    vectors = [effect.vector(values) for effect, values in known]
    if driven:
        keep = [all(law.stage > Stage.LAG for law in effect.laws) for effect, _ in known]
        known = [pair for pair, kept in zip(known, keep, strict=True) if kept]
        vectors = [vector for vector, kept in zip(vectors, keep, strict=True) if kept]
    return [effect for effect, _ in known], np.concatenate([*vectors, np.empty(0)])


def _simulate(
    axis: Axis,
    plan: _Plan,
    rate_hz: float,
    effects: Sequence[EffectValues],
    sensors: Sensors,
    seed: int,
    start: InitialState,
    rest: bool,
    solver: Solver | None,
    reference: Array | None,
    *,
    driven: bool = False,
) -> Trajectory:
    solver = solver or Solver()
    w = _workspace(axis)
    w[slots.DRIVEN] = float(driven)
    chosen, p = _chosen(effects, driven)
    laws, stages, guards = law_table(chosen)
    states = [(f"{e.name}.{s.name}", s) for e in chosen for s in e.states]
    sizes = np.array([4 + len(states), guards], dtype=np.int64)
    work = np.zeros(kernel.work_size(4 + len(states), guards))
    work[:4] = start.motor_position, start.joint_position, start.motor_velocity, start.joint_velocity
    kinds = np.array([0, 0, 1, 1, *(_KINDS[s.kind] for _, s in states)], dtype=np.int64)
    starts = np.array([_STARTS[s.kind] for _, s in states], dtype=np.int64)
    n = int(plan.rows.max()) + 1
    random = np.random.default_rng(seed)
    torque_noise = coloured(
        random, n, sensors.torque_noise, sensors.torque_noise_time_s, np.arange(n) / rate_hz
    )
    motor_noise = coloured(
        random, plan.times.size, sensors.motor_noise, sensors.motor_noise_time_s, plan.times
    )
    joint_noise = coloured(random, n, sensors.joint_noise, sensors.joint_noise_time_s, np.arange(n) / rate_hz)
    out = np.empty((kernel.COLUMNS + len(states), n))
    control = _control(axis, solver, driven)
    status, time = kernel.run(
        w, p, laws, stages, work, sizes, kinds, starts, int(rest),
        plan.times, plan.controls, plan.rows, plan.inputs, plan.gains, plan.reference,
        np.array([sensors.motor_resolution, sensors.motor_delay_s]), motor_noise, control, out,
    )  # fmt: skip
    _check(status, time, control, solver, plan.inputs.shape[0] == 0, out)
    torque = _commands(out[kernel.COMMAND], rate_hz, effects) if driven else out[kernel.COMMAND]
    torque = _held_late(torque, sensors.torque_delay_s * rate_hz) + torque_noise
    joint = _joint_measured(out, rate_hz, sensors, joint_noise)
    return _trajectory(
        out, rate_hz, torque, joint, reference, states=[name for name, _ in states], control=control
    )


def _control(axis: Axis, solver: Solver, driven: bool) -> Array:
    inverse = 1.0 / axis.JL + (0.0 if driven else 1.0 / axis.Jm)
    frequency = math.sqrt(axis.K * inverse)
    tolerance = solver.tolerance if solver.substeps is None else 0.0
    return np.array([tolerance, solver.substeps or 1, math.inf, 0.0, 1e-12, frequency, 0.0])


def _check(status: int, time: float, control: Array, solver: Solver, closed: bool, out: Array) -> None:
    if status == kernel.UNSTABLE or (status == kernel.DONE and not np.all(np.isfinite(out))):
        cure = (
            "lower the controller's gains or raise the sampling rate" if closed else "look at the parameters"
        )
        raise UsageError(f"the simulated {'loop' if closed else 'axis'} is unstable", cure)
    if status == kernel.TOO_MANY_STEPS:
        raise UsageError(
            f"the axis is too stiff to integrate at {time:g} s",
            "look for a time constant far below the sampling period, such as a lag, a small mass, or a reversal"
            " velocity (0 makes friction set-valued)",
        )
    if status == kernel.TOO_MANY_EVENTS:
        raise UsageError(
            f"contact or friction switches without end at {time:g} s",
            "look for a gap without damping or a friction whose level is negative",
        )
    if solver.substeps is not None and control[3] > solver.error_limit:
        raise UsageError(
            f"steps are too coarse: the torsion's error is estimated to {control[3]:.1g} of its largest value",
            f"raise substeps ({solver.substeps}), or leave them out for adaptive steps",
        )


def _commands(torque: Array, rate_hz: float, effects: Sequence[EffectValues]) -> Array:
    """Command from acting torque, through the actuator's effects, the last one first."""
    known = sorted(((effect_named(e.name), e.values) for e in effects), key=lambda pair: pair[0].code)
    for effect, values in reversed(known):
        if effect.command is not None:
            torque = effect.command(torque, rate_hz, {**effect.neutral, **values})
    return torque


def _held_late(torque: Array, delay_samples: float) -> Array:
    """Torque that was held this many samples before each instant."""
    if delay_samples == 0.0:
        return torque.copy()
    index = np.floor(np.arange(torque.size) - delay_samples + 1e-9).astype(np.int64)
    return np.asarray(torque[np.clip(index, 0, torque.size - 1)])


def _joint_measured(out: Array, rate_hz: float, sensors: Sensors, noise: Array) -> Array:
    """Joint position as it is recorded: late, off its zero, noisy, in counts."""
    delay = (out[kernel.JOINT_DELAY] + sensors.joint_delay_s) * rate_hz
    position: Array = out[kernel.MEASURED_JOINT].copy()
    if np.any(delay != 0.0):
        position = _shifted(position, out[kernel.MEASURED_JOINT_RATE] / rate_hz, delay)
    if sensors.joint_zero != 0.0:
        position += sensors.joint_zero
    position += noise
    if sensors.joint_resolution > 0.0:
        position = np.floor(position / sensors.joint_resolution + 0.5) * sensors.joint_resolution
    return position


def _shifted(values: Array, rates: Array, delay: Array) -> Array:
    """Values ``delay`` samples earlier by Hermite's cubic; before the start at rest, beyond the end straight on."""
    last = values.size - 1
    at = np.arange(values.size) - delay
    j = np.clip(np.floor(at).astype(np.int64), 0, last - 1)
    s = at - j
    a = (1.0 + 2.0 * s) * values[j] + s * rates[j]
    b = (3.0 - 2.0 * s) * values[j + 1] - (1.0 - s) * rates[j + 1]
    inside = (1.0 - s) ** 2 * a + s * s * b
    beyond = values[last] + (at - last) * rates[last]
    return np.where(at <= 0.0, values[0], np.where(at >= last, beyond, inside))


def _trajectory(
    out: Array,
    rate_hz: float,
    torque: Array,
    joint: Array,
    reference: Array | None,
    *,
    states: list[str],
    control: Array,
) -> Trajectory:
    columns = list(out)
    motor = columns[kernel.MEASURED_MOTOR]
    return Trajectory(
        time_s=np.arange(out.shape[1]) / rate_hz,
        torque=torque,
        motor_position=motor,
        joint_position=joint,
        reference_position=motor if reference is None else reference,
        acting_torque=columns[kernel.TORQUE],
        true_motor_position=columns[kernel.MOTOR_POSITION],
        motor_velocity=columns[kernel.MOTOR_VELOCITY],
        motor_acceleration=columns[kernel.MOTOR_ACCELERATION],
        true_joint_position=columns[kernel.JOINT_POSITION],
        joint_velocity=columns[kernel.JOINT_VELOCITY],
        joint_acceleration=columns[kernel.JOINT_ACCELERATION],
        torsion=columns[kernel.TORSION],
        joint_torque=columns[kernel.JOINT_TORQUE],
        states=dict(zip(states, columns[kernel.COLUMNS :], strict=True)),
        error=float(control[3]),
        steps=int(control[6]),
    )
