"""Random axes, their controllers, sensors and references: plausible, not alike, and reproducible from a seed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from .axis import Axis, Controller, Record, Sensors, simulate
from .trajectories import Limits, chirp, rich, triangles, updown

Array = NDArray[np.float64]

SIZES = {"small": 0.01, "medium": 3.0, "large": 175.0}  # joint-side motor inertia, kg m2
GEARS = (1.0, 50.0, 80.0, 100.0, 121.0, 160.0)
GEARED_COUNTS = (4096.0, 8192.0, 16384.0, 65536.0)  # a revolution of the motor shaft, behind a gear
DIRECT_COUNTS = (2.0**20, 2.0**21, 2.0**22, 2.0**23)
JOINT_COUNTS = (2.0**19, 2.0**20, 2.0**21, 2.0**22, 2.0**23)
FAST_LOOP = 6.0  # 1/s
SHAPES = ("chirp", "updown", "rich", "triangles")
FINE_ENOUGH = 0.02  # an encoder's count over the torsion that an ordinary acceleration makes


@dataclass(frozen=True)
class Plant:
    """Everything that stays the same from record to record of one axis."""

    axis: Axis
    controller: Controller
    sensors: Sensors
    limits: Limits
    rate_hz: float
    torque_constant_nm_per_a: float | None

    @property
    def gear_ratio(self) -> float:
        """Motor angle over joint angle."""
        return self.sensors.gear_ratio


def axis(rng: np.random.Generator, size: str | float | None = None, *, gravity: bool = True) -> Axis:
    """Draw an axis.

    Parameters
    ----------
    rng : Generator
    size : {"small", "medium", "large"}, float, or None
        Joint-side motor inertia of about 0.01, 3 or 175 kg m2 (up to 1.4 times more or less), or of this value; by
        default anything from 0.01 to 200.
    gravity : bool
        Whether the load has a moment that gravity acts on.
    """
    if size is None:
        Jm = _log_uniform(rng, 0.01, 200.0)
    else:
        Jm = (SIZES[size] if isinstance(size, str) else size) * _log_uniform(rng, 1.0 / 1.4, 1.4)
    JL = Jm * _log_uniform(rng, 0.3, 1.5)
    K = JL * (2.0 * np.pi * _log_uniform(rng, 3.0, 25.0)) ** 2
    moment = JL * rng.uniform(0.0, 0.5) if gravity else 0.0
    angle = rng.uniform(0.0, 2.0 * np.pi)
    return Axis(
        Jm=Jm,
        JL=JL,
        K=K,
        FVm=Jm * _log_uniform(rng, 0.3, 2.0),
        FSm=Jm * _log_uniform(rng, 0.3, 2.5),
        FV=JL * _log_uniform(rng, 0.1, 0.8),
        FS=JL * _log_uniform(rng, 0.1, 0.6),
        MX=moment * float(np.cos(angle)),
        MY=moment * float(np.sin(angle)),
        v0=_log_uniform(rng, 1e-3, 4e-3),
        v0l=_log_uniform(rng, 1e-3, 4e-3),
    )


def controller(rng: np.random.Generator, plant: Axis, rate_hz: float) -> Controller:
    """Draw gains that a commissioning engineer would leave: stable, and below the first resonance.

    Gains are lowered until the linear sampled loop is stable with twice the velocity gain too (6 dB of margin).
    """
    omega = 2.0 * np.pi * plant.locked_motor_hz
    kv = (plant.Jm + plant.JL) * omega * rng.uniform(0.15, 0.45)
    kp = omega * rng.uniform(0.05, 0.15)
    ki_share = rng.uniform(0.3, 0.7)
    # A slow loop without feedforward would hardly move.
    feedforward = 0.0 if kp > FAST_LOOP and rng.random() < 0.4 else 1.0
    for _ in range(40):
        gains = Controller(kp, kv, kv * kp * ki_share, feedforward)
        louder = Controller(kp, 2.0 * kv, 2.0 * gains.ki, feedforward)
        settled = float(np.exp(-0.2 * kp * ki_share / rate_hz))
        if max(_largest_pole(plant, g, rate_hz) for g in (gains, louder)) < settled:
            return gains
        kv, kp = 0.9 * kv, 0.93 * kp
    return gains


def sensors(rng: np.random.Generator, torsion: float) -> Sensors:
    """Draw encoders and a gear, without torque noise (which goes with the torque, see `plant`).

    Nobody measures a torsion with encoders that hardly see it: both have counts below `FINE_ENOUGH` of ``torsion``
    (rad), or as many as there are.
    """
    gear = GEARS[rng.integers(len(GEARS))]
    coarsest = 2.0 * np.pi / (FINE_ENOUGH * torsion)
    return Sensors(
        motor_counts=_counts(rng, DIRECT_COUNTS if gear == 1.0 else GEARED_COUNTS, coarsest / gear),
        joint_counts=_counts(rng, JOINT_COUNTS, coarsest),
        gear_ratio=gear,
    )


def _counts(rng: np.random.Generator, known: tuple[float, ...], least: float) -> float:
    """One of the three coarsest encoders that have at least so many counts."""
    enough = [c for c in known if c > least] or [known[-1]]
    return enough[rng.integers(len(enough[:3]))]


def limits(rng: np.random.Generator, plant: Axis) -> Limits:
    """Draw the range of motion; softer axes are accelerated less, for no joint is twisted by a tenth of a rad."""
    omega = 2.0 * np.pi * plant.locked_motor_hz
    gentle = 0.03 * omega**2  # the torsion stays below about 30 mrad before the resonance lifts it
    return Limits(
        travel=rng.uniform(0.4, 1.2),
        speed=rng.uniform(1.0, 2.5),
        acceleration=min(rng.uniform(12.0, 40.0), gentle),
        centre=rng.uniform(-np.pi, np.pi),
    )


def plant(rng: np.random.Generator, size: str | float | None = None, *, gravity: bool = True) -> Plant:
    """Draw an axis with its controller, sensors (torque noise of 0.3 to 1.5 % of a typical torque) and limits."""
    drawn = axis(rng, size, gravity=gravity)
    rate_hz = float(rng.choice([500.0, 800.0, 1000.0]))
    bounds = limits(rng, drawn)
    gains = controller(rng, drawn, rate_hz)
    typical = 0.2 * (drawn.Jm + drawn.JL) * bounds.acceleration + drawn.FSm + drawn.FS
    white = sensors(rng, 0.4 * drawn.JL * bounds.acceleration / drawn.K)
    noisy = Sensors(
        motor_counts=white.motor_counts,
        joint_counts=white.joint_counts,
        gear_ratio=white.gear_ratio,
        torque_noise=typical * _log_uniform(rng, 0.003, 0.015),
        torque_noise_corner_hz=0.0 if rng.random() < 0.5 else _log_uniform(rng, 20.0, 120.0),
    )
    constant = None if noisy.gear_ratio == 1.0 else float(np.round(rng.uniform(0.05, 0.4), 4))
    return Plant(drawn, gains, noisy, bounds, rate_hz, constant)


def reference(
    rng: np.random.Generator,
    shape: str,
    bounds: Limits,
    rate_hz: float,
    duration_s: float,
    low_hz: float = 0.1,
    high_hz: float = 10.0,
) -> Array:
    """Reference of one of the `SHAPES`."""
    if shape == "chirp":
        return chirp(bounds, duration_s, rate_hz, low_hz, high_hz)
    if shape == "updown":
        return updown(bounds, duration_s, rate_hz, low_hz, high_hz)
    if shape == "rich":
        return rich(bounds, duration_s, rate_hz, rng, low_hz, high_hz)
    if shape == "triangles":
        return triangles(bounds, duration_s, rate_hz, rng)
    raise ValueError(f"no such shape: {shape}; there are {', '.join(SHAPES)}")


def high_hz(plant_axis: Axis) -> float:
    """Upper end of a sweep that crosses the first resonance: 2.5 times it, but no less than 10 Hz."""
    return float(max(10.0, 2.5 * plant_axis.free_hz))


def baseline(
    rng: np.random.Generator, shape: str, size: str | float | None = None, duration_s: float = 40.0
) -> Record:
    """One record of a newly drawn axis with nothing hidden."""
    machine = plant(rng, size)
    path = reference(rng, shape, machine.limits, machine.rate_hz, duration_s, high_hz=high_hz(machine.axis))
    seed = int(rng.integers(2**31))
    return simulate(
        machine.axis, machine.controller, path, machine.rate_hz, sensors=machine.sensors, seed=seed
    )


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _largest_pole(plant_axis: Axis, gains: Controller, rate_hz: float) -> float:
    """Largest magnitude of the closed loop's poles, friction left out, one sample's delay in the difference.

    States: qm, qm', q, q', previous qm, integral of the error.
    """
    a, T = plant_axis, 1.0 / rate_hz
    A = np.zeros((5, 5))
    A[0, 1] = A[2, 3] = 1.0
    A[1, :4] = [-a.K / a.Jm, -a.FVm / a.Jm, a.K / a.Jm, 0.0]
    A[3, :4] = [a.K / a.JL, 0.0, -a.K / a.JL, -a.FV / a.JL]
    A[1, 4] = 1.0 / a.Jm
    step = expm(A * T)
    error = np.array([-gains.kp - 1.0 / T, 0.0, 0.0, 0.0, 1.0 / T, 0.0])
    integral = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0]) + T * error
    torque = gains.kv * error + gains.ki * integral
    loop = np.zeros((6, 6))
    loop[:4, :4] = step[:4, :4]
    loop[:4] += np.outer(step[:4, 4], torque)
    loop[4, 0] = 1.0
    loop[5] = integral
    return float(np.max(np.abs(np.linalg.eigvals(loop))))
