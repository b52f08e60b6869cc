"""What the effects see of a record: the smoothed motion of one gap-free stretch and the baseline's parameters."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Base:
    """Parameters of the baseline model, joint side, SI, as far as they were estimated.

    Attributes
    ----------
    Jm, K, JL, FVm, FSm, FV, FS : float
        Inertias, stiffness, viscous and Coulomb friction.
    motor_reversal, load_reversal : float
        Widths v0 of sgn v = tanh(v / v0).
    torsion_zero : float
        Difference of the encoders where the spring carries nothing.
    gear_ratio : float
        Motor angle over joint angle.
    """

    Jm: float
    K: float
    JL: float
    FVm: float
    FSm: float
    FV: float
    FS: float
    motor_reversal: float
    load_reversal: float
    torsion_zero: float = 0.0
    gear_ratio: float = 1.0


@dataclass(frozen=True)
class Motion:
    """One stretch of a record. All arrays have shape (n,), joint side, SI.

    Attributes
    ----------
    time_s : ndarray
        From the start of the record.
    torque : ndarray
        Recorded motor torque.
    limited_torque : ndarray
        What is left of it by a limit that the model has.
    motor_position, motor_velocity, joint_position, joint_velocity, joint_acceleration : ndarray
        Low-passed; without a joint encoder the joint's are rebuilt from eq. (14).
    motor_sign, joint_sign : ndarray
        sgn of the velocities with the baseline's reversal width.
    deflection : ndarray
        Difference of the positions, without the spring's zero.
    torsion, torsion_rate : ndarray
        The same with what the transmission's kinematics add, by the effects that the model has: what the spring sees;
        and its rate.
    joint_torque : ndarray
        Torque that the transmission passes on: its spring's, and that of the effects that the model has there.
    period_s : float
        Sampling period.
    base : Base
        The baseline's parameters.
    gravity : float
        m/s2.
    gear_ratio : float
        Motor angle over joint angle.
    joint_encoder : bool
        Whether the joint's motion was measured.
    duration_s : float
        Of the whole record.
    """

    time_s: Array
    torque: Array
    limited_torque: Array
    motor_position: Array
    motor_velocity: Array
    joint_position: Array
    joint_velocity: Array
    joint_acceleration: Array
    motor_sign: Array
    joint_sign: Array
    deflection: Array
    torsion: Array
    torsion_rate: Array
    joint_torque: Array
    period_s: float
    base: Base
    gravity: float
    gear_ratio: float
    joint_encoder: bool
    duration_s: float


@dataclass(frozen=True)
class Terms:
    """What one effect adds to the equations for unit amplitudes; each (n, k) or None.

    Attributes
    ----------
    motor, load : ndarray or None
        Torque that resists the motor, the load.
    transmission : ndarray or None
        Torque that the transmission passes on beside K (qm - q).
    torsion : ndarray or None
        What an error of the transmission's kinematics adds to the torsion; its spring's torque stands in
        ``transmission``.
    motor_error, joint_error : ndarray or None
        What a position's measurement is too large by.
    """

    motor: Array | None = None
    transmission: Array | None = None
    torsion: Array | None = None
    load: Array | None = None
    motor_error: Array | None = None
    joint_error: Array | None = None

    def since(self, before: Terms) -> Terms:
        """What has changed from other terms of the same effect."""
        pairs = {f.name: (getattr(before, f.name), getattr(self, f.name)) for f in fields(Terms)}
        return Terms(**{n: None if a is None else b - a for n, (a, b) in pairs.items()})


@dataclass(frozen=True)
class Shape:
    """A parameter that an effect is not linear in, and where it is searched for.

    Attributes
    ----------
    name : str
        Its name among the effect's parameters.
    low, high : float
        Range in this record.
    points : int
        Of the first, coarse search.
    spacing : {"log", "linear"}
    """

    name: str
    low: float
    high: float
    points: int
    spacing: str = "log"

    def grid(self) -> Array:
        """Points of the coarse search, shape (points,)."""
        if self.spacing == "log":
            return np.geomspace(self.low, self.high, self.points)
        return np.linspace(self.low, self.high, self.points)
