"""How an effect is looked for in a record: its columns, and the shape parameters that these depend on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from flexid_cli.effects.motion import Base, Motion, Shape, Terms

Array = NDArray[np.float64]

CYCLES_PER_SPEED = (
    0.3  # a ripple is looked for up to the cycles that meet the band's edge at this share of full speed
)
POINTS_PER_CYCLE = (
    1.6  # of the search over cycles: ripples that differ by one over the whole travel are told apart
)


@dataclass(frozen=True)
class Scale:
    """Sizes of a record, from which the ranges of shapes follow.

    Attributes
    ----------
    duration_s, period_s : float
        Of the record.
    band_hz : float
        Highest frequency that the encoders resolve.
    motor_speed, joint_speed : float
        98 % quantile of the absolute velocity.
    motor_range, joint_range : float
        Largest minus smallest position.
    motor_reversal_step, joint_reversal_step : float
        Velocity that passes within the reach of the filters where it reverses: nothing narrower is resolved.
    deflection : float
        99 % quantile of the absolute torsion about its zero.
    deflection_noise : float
        Noise of the torsion in the band, one sigma.
    torque : float
        Largest absolute torque.
    resonance_hz : float
        Free-free resonance of the baseline.
    gear_ratio : float
        Motor angle over joint angle.
    joint_encoder : bool
        Whether the joint's motion was measured.
    base : Base
        The baseline's parameters.
    """

    duration_s: float
    period_s: float
    band_hz: float
    motor_speed: float
    joint_speed: float
    motor_range: float
    joint_range: float
    motor_reversal_step: float
    joint_reversal_step: float
    deflection: float
    deflection_noise: float
    torque: float
    resonance_hz: float
    gear_ratio: float
    joint_encoder: bool
    base: Base


@dataclass(frozen=True)
class Signature:
    """What an effect, or one form of it, looks like in the equations.

    Attributes
    ----------
    columns : callable
        (Motion, shape values) -> Terms for unit amplitudes.
    values : callable
        (amplitudes, shape values, Base) -> values of the effect's parameters by name.
    shapes : callable
        Scale -> shape parameters with their ranges: empty where the columns have none, None where the record
        cannot hold the effect.
    fixed : float or None
        The amplitude where it is not free (a lag, a limit: all of it is in the shape).
    sign : {1, -1, 0}
        Sign that physics demands of all amplitudes; 0: either.
    tied : callable or None
        (amplitudes, shape values, Base) -> why these values cannot be the effect, or an empty string.
    corrected : callable or None
        (position as recorded, amplitudes, derivative, gear ratio) -> the position that the effect leaves when it is
        taken out; with it the equations are linearised about the true motion. ``derivative(x, order)``.
    corrects : {"joint", "motor"}
        Whose position that is.
    ripple : {"motor", "transmission", ""}
        Equation in which the (first two) columns are `forms.sines` of the motor's position with the shape as cycles
        per radian: such a search can be made at once for all cycles.
    extends : bool
        Whether it is a ripple's form before it with an overtone: taken where it explains clearly more.
    needs_joint : bool
        Whether it is looked for with both encoders only.
    motor_alone : bool
        Whether it is looked for without a joint encoder only, for the baseline of both encoders holds it.
    form_doubt : float
        Share of its stiffness that its form leaves open: K is no surer than that.
    rotary : bool
        Whether a linear axis has none.
    curved : bool
        Whether it is a friction whose curve over the velocity the width of the reversal can stand in for.
    event : bool
        Whether its shape is an instant of the record: another record of the axis has its own.
    centred : bool
        Whether one of its shapes is the place of its zero beside the spring's.
    lawless : bool
        Whether the effect's torque law cannot do what this form does, so that no simulation can speak against it.
    """

    columns: Callable[[Motion, Sequence[float]], Terms]
    values: Callable[[Array, Sequence[float], Base], dict[str, float]]
    shapes: Callable[[Scale], Sequence[Shape] | None] = lambda _: ()
    fixed: float | None = None
    sign: int = 0
    tied: Callable[[Array, Sequence[float], Base], str] | None = None
    corrected: Callable[[Array, Array, Callable[[Array, int], Array], float], Array] | None = None
    corrects: str = "joint"
    ripple: str = ""
    extends: bool = False
    needs_joint: bool = False
    motor_alone: bool = False
    form_doubt: float = 0.0
    rotary: bool = False
    curved: bool = False
    event: bool = False
    centred: bool = False
    lawless: bool = False
