"""What is simulated: axis, controller, sensors, accuracy, and the result."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexid_cli.config.schema import Controller as ControllerSection
from flexid_cli.errors import UsageError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Axis:
    """Parameters of a flexible axis, joint side, SI.

    The defaults are Table 1 of Pham, Gautier and Poignet (ICRA 2001). sgn v is tanh(v / reversal_velocity);
    with a reversal velocity of 0 Coulomb friction is set-valued: the axis sticks and breaks loose.
    ``load_reversal_velocity`` is that of the load where it differs.
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
    load_reversal_velocity: float | None = None

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
    difference of the measured position. Sampled at the rate of the record unless ``period_s`` says otherwise.
    """

    kp: float
    kv: float
    ki: float
    velocity_feedforward: float = 1.0
    period_s: float | None = None

    @classmethod
    def from_config(cls, section: ControllerSection | None) -> Controller:
        """The controller of a configuration.

        Raises
        ------
        UsageError
            None is given, or its law is not known.
        """
        if section is None or section.law == "external" or section.kp is None or section.kv is None:
            raise UsageError(
                "the controller is not known, so its loop cannot be simulated",
                "give `controller` in the configuration, or drive the simulation by the motor position",
            )
        return cls(section.kp, section.kv, section.ki, section.velocity_feedforward, section.period_s)


@dataclass(frozen=True)
class Sensors:
    """What measuring adds; joint side, SI; 0 is ideal.

    Attributes
    ----------
    motor_resolution, joint_resolution : float
        Radians per count.
    torque_noise, motor_noise, joint_noise : float
        One sigma. The motor's enters the controller.
    torque_noise_time_s, motor_noise_time_s, joint_noise_time_s : float
        Correlation time of the noise (first-order Markov); 0: white.
    torque_delay_s, motor_delay_s, joint_delay_s : float
        Age of the value at its stamp. The motor's enters the controller.
    joint_zero : float
        Added to the joint position: the encoders' zeros differ.
    """

    motor_resolution: float = 0.0
    joint_resolution: float = 0.0
    torque_noise: float = 0.0
    motor_noise: float = 0.0
    joint_noise: float = 0.0
    torque_noise_time_s: float = 0.0
    motor_noise_time_s: float = 0.0
    joint_noise_time_s: float = 0.0
    torque_delay_s: float = 0.0
    motor_delay_s: float = 0.0
    joint_delay_s: float = 0.0
    joint_zero: float = 0.0


@dataclass(frozen=True)
class Solver:
    """How accurately it is integrated.

    Attributes
    ----------
    tolerance : float
        Error of one step, relative to the largest torsion so far (velocities: times the resonance). The default
        keeps the torsion within about 1e-6; `ACCURATE` is for checks against it.
    substeps : int, optional
        Fixed steps in place of adaptive ones: this many per sampling period. The sum of the estimated errors is
        checked against ``error_limit``.
    error_limit : float
        Of fixed steps, relative to the largest torsion.
    """

    tolerance: float = 1e-9
    substeps: int | None = None
    error_limit: float = 1e-4

    def __post_init__(self) -> None:
        """Refuse what cannot be integrated."""
        if not 1e-14 <= self.tolerance <= 1e-2:
            raise UsageError(f"a tolerance of {self.tolerance:g} is not possible", "take 1e-14 to 1e-2")
        if self.substeps is not None and self.substeps < 1:
            raise UsageError(f"{self.substeps} steps a period are not possible", "take 1 or more")


ACCURATE = Solver(tolerance=1e-13)


@dataclass(frozen=True)
class InitialState:
    """Where the simulation starts; what is not given is at rest, the spring carrying the load.

    ``integral`` is that of the controller's velocity error, rad: a loop that was on before the record began holds
    weight and friction with it. Its differences begin with motor and reference moving at the given velocities.
    """

    motor_position: float
    joint_position: float
    motor_velocity: float = 0.0
    joint_velocity: float = 0.0
    integral: float = 0.0
    reference_velocity: float = 0.0


@dataclass(frozen=True)
class Record:
    """What was recorded, one row a sampling period; joint side, SI.

    As the sensors and the controller show it; ``torque`` is recorded at the instant from which it is held.
    """

    time_s: Array
    torque: Array
    motor_position: Array
    joint_position: Array
    reference_position: Array


@dataclass(frozen=True)
class Trajectory(Record):
    """What was recorded, and the truth behind it at the same instants.

    Attributes
    ----------
    acting_torque : ndarray
        What acts on the motor behind limits and lag.
    torsion, joint_torque : ndarray
        d (with the transmission error where there is one) and T.
    states : mapping
        ``effect.state`` to its values.
    error : float
        Sum of the estimated errors of all steps, relative to the largest torsion.
    steps : int
        Integration steps taken.
    """

    acting_torque: Array
    true_motor_position: Array
    motor_velocity: Array
    motor_acceleration: Array
    true_joint_position: Array
    joint_velocity: Array
    joint_acceleration: Array
    torsion: Array
    joint_torque: Array
    states: Mapping[str, Array]
    error: float
    steps: int
