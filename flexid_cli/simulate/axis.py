"""The simulation that the sample logs are made with, and the names of the machine's parts.

The sample logs' bytes follow from this integrator (fourth-order Runge-Kutta, fixed steps); `engine` is the one for
everything else: effects, set-valued friction, sensors, other inputs. The equations are the paper's (5) to (7),
joint side, with sgn v taken as tanh(v / v0):

    Gm = Jm qm'' + FVm qm' + FSm sgn qm' + K (qm - q)
    0  = JL q'' + FV q' + FS sgn q' + MX g cos q + MY g sin q - K (qm - q)
"""

from __future__ import annotations

import numpy as np
from numba import njit

from flexid_cli.errors import UsageError
from flexid_cli.simulate.machine import Array, Axis, Controller, Record, Sensors, Trajectory

__all__ = ["Axis", "Controller", "Record", "Sensors", "Trajectory", "chirp", "simulate"]


def simulate(
    axis: Axis,
    controller: Controller,
    reference: Array,
    sample_rate_hz: float,
    *,
    sensors: Sensors | None = None,
    seed: int = 0,
    substeps: int = 20,
) -> Record:
    """Simulate the axis following ``reference``.

    Parameters
    ----------
    axis, controller, sensors
        The machine.
    reference : ndarray, shape (n,)
        Position set point at each control period, rad.
    sample_rate_hz : float
        Control rate, also the rate of the record.
    seed : int
        Seed of the torque noise.
    substeps : int
        Runge-Kutta steps (fourth order) a control period.

    Returns
    -------
    Record

    Raises
    ------
    UsageError
        The closed loop is unstable, or something is asked for that only `engine` simulates.
    """
    sensors = sensors or Sensors()
    noise = np.random.default_rng(seed).normal(0.0, 1.0, reference.size) * sensors.torque_noise
    plain = Sensors(sensors.motor_resolution, sensors.joint_resolution, sensors.torque_noise)
    if (
        controller.period_s
        or axis.load_reversal_velocity
        or axis.reversal_velocity == 0.0
        or sensors != plain
    ):
        raise UsageError("this integrator knows only the plain axis", "use simulate_closed_loop")
    parameters = np.array(
        [
            axis.Jm, axis.K, axis.JL, axis.FVm, axis.FSm, axis.FV, axis.FS, axis.MX, axis.MY, axis.gravity,
            axis.torque_offset, axis.reversal_velocity,
        ]
    )  # fmt: skip
    gains = np.array([controller.kp, controller.kv, controller.ki, controller.velocity_feedforward])
    rest = np.array([float(reference[0]), _rest_position(axis, float(reference[0])), 0.0, 0.0])
    torque, motor, joint = _closed_loop(
        parameters,
        gains,
        np.ascontiguousarray(reference, dtype=np.float64),
        rest,
        1.0 / sample_rate_hz,
        substeps,
        sensors.motor_resolution,
        sensors.joint_resolution,
    )
    if not np.all(np.isfinite(motor)):
        raise UsageError(
            "the simulated loop is unstable", "lower the controller's gains or raise the sampling rate"
        )
    time = np.arange(reference.size) / sample_rate_hz
    return Record(time, torque + noise, motor, joint, np.asarray(reference, dtype=np.float64))


def chirp(start_hz: float, stop_hz: float, duration_s: float, sample_rate_hz: float) -> Array:
    """Linear chirp of unit amplitude, starting at zero.

    Returns
    -------
    ndarray, shape (round(duration_s * sample_rate_hz),)
    """
    time = np.arange(round(duration_s * sample_rate_hz)) / sample_rate_hz
    sweep = (stop_hz - start_hz) / duration_s
    return np.asarray(np.sin(2.0 * np.pi * (start_hz * time + 0.5 * sweep * time**2)), dtype=np.float64)


def _rest_position(axis: Axis, motor_position: float) -> float:
    """Joint position where the spring carries gravity, by fixed-point iteration (gravity is softer than K)."""
    position = motor_position
    for _ in range(50):
        load = axis.gravity * (axis.MX * np.cos(position) + axis.MY * np.sin(position))
        position = motor_position - load / axis.K
    return float(position)


@njit(cache=True)
def _derivative(p, torque, x, out):  # type: ignore[no-untyped-def] # pragma: no cover
    qm, q, vm, v = x
    spring = p[1] * (qm - q)
    out[0] = vm
    out[1] = v
    out[2] = (torque - p[10] - p[3] * vm - p[4] * np.tanh(vm / p[11]) - spring) / p[0]
    gravity = p[9] * (p[7] * np.cos(q) + p[8] * np.sin(q))
    out[3] = (spring - p[5] * v - p[6] * np.tanh(v / p[11]) - gravity) / p[2]


@njit(cache=True)
def _closed_loop(p, gains, reference, state, period, substeps, motor_lsb, joint_lsb):  # type: ignore[no-untyped-def] # pragma: no cover
    n = reference.size
    torque = np.empty(n)
    motor = np.empty(n)
    joint = np.empty(n)
    x = state.copy()
    k1, k2, k3, k4 = np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    step = period / substeps
    integral = 0.0
    previous = x[0] if motor_lsb == 0.0 else np.floor(x[0] / motor_lsb + 0.5) * motor_lsb
    previous_reference = reference[0]
    for i in range(n):
        motor[i] = x[0] if motor_lsb == 0.0 else np.floor(x[0] / motor_lsb + 0.5) * motor_lsb
        joint[i] = x[1] if joint_lsb == 0.0 else np.floor(x[1] / joint_lsb + 0.5) * joint_lsb
        reference_rate = (reference[i] - previous_reference) / period
        error = gains[0] * (reference[i] - motor[i]) + gains[3] * reference_rate
        error -= (motor[i] - previous) / period
        integral += error * period
        torque[i] = gains[1] * error + gains[2] * integral
        previous = motor[i]
        previous_reference = reference[i]
        for _ in range(substeps):
            _derivative(p, torque[i], x, k1)
            _derivative(p, torque[i], x + 0.5 * step * k1, k2)
            _derivative(p, torque[i], x + 0.5 * step * k2, k3)
            _derivative(p, torque[i], x + step * k3, k4)
            x = x + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return torque, motor, joint
