"""Closed-loop simulation of one flexible axis: two masses, a spring, a sampled position controller.

The equations are the paper's (5) to (7), joint side, with sgn v taken as tanh(v / v0):

    Gm = Jm qm'' + FVm qm' + FSm sgn qm' + K (qm - q)
    0  = JL q'' + FV q' + FS sgn q' + MX g cos q + MY g sin q - K (qm - q)
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from flexid_cli.errors import UsageError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Axis:
    """Parameters of a flexible axis, joint side, SI.

    The defaults are Table 1 of Pham, Gautier and Poignet (ICRA 2001).
    """

    Jm: float = 174.7996
    K: float = 20341.0458
    JL: float = 47.4458
    FVm: float = 235.91
    FSm: float = 41.4254
    FV: float = 83.1508
    FS: float = 8.4612
    MX: float = -0.7241
    MY: float = -53.4201
    gravity: float = 9.81
    torque_offset: float = 0.0
    reversal_velocity: float = 1e-3

    @property
    def resonance_hz(self) -> float:
        """Free-free resonance, sqrt(K (1/Jm + 1/JL)) / 2 pi."""
        return float(np.sqrt(self.K * (1.0 / self.Jm + 1.0 / self.JL)) / (2.0 * np.pi))

    @property
    def antiresonance_hz(self) -> float:
        """Locked-motor resonance, sqrt(K / JL) / 2 pi."""
        return float(np.sqrt(self.K / self.JL) / (2.0 * np.pi))


@dataclass(frozen=True)
class Controller:
    """P position and PI velocity loop, sampled and held.

    u = kv e + ki integral(e dt), e = kp (ref - qm) + velocity_feedforward ref' - qm'; qm' by backward
    difference of the measured position.
    """

    kp: float
    kv: float
    ki: float
    velocity_feedforward: float = 1.0


@dataclass(frozen=True)
class Sensors:
    """Resolution of the encoders (joint-side rad per count; 0: ideal) and torque noise (N m, one sigma)."""

    motor_resolution: float = 0.0
    joint_resolution: float = 0.0
    torque_noise: float = 0.0


@dataclass(frozen=True)
class Trajectory:
    """What was simulated, one row a control period; joint side, SI.

    ``torque`` is recorded at the instant from which the controller holds it.
    """

    time_s: Array
    torque: Array
    motor_position: Array
    joint_position: Array
    reference_position: Array


def simulate(
    axis: Axis,
    controller: Controller,
    reference: Array,
    sample_rate_hz: float,
    *,
    sensors: Sensors | None = None,
    seed: int = 0,
    substeps: int = 20,
) -> Trajectory:
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
    Trajectory

    Raises
    ------
    UsageError
        The closed loop is unstable.
    """
    sensors = sensors or Sensors()
    noise = np.random.default_rng(seed).normal(0.0, 1.0, reference.size) * sensors.torque_noise
    parameters = np.array(list(asdict(axis).values()), dtype=np.float64)
    gains = np.array(list(asdict(controller).values()), dtype=np.float64)
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
    return Trajectory(time, torque + noise, motor, joint, np.asarray(reference, dtype=np.float64))


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
