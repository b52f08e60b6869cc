"""Coulomb friction that grows with the torque that the gear transmits.

What it is
    Teeth and bearings rub harder the harder they are pressed together: friction at the motor is FSm + mu |T|.
    A gear's efficiency below one is this effect.

In the data
    The motor equation's residual follows |T| sgn(qm'): larger in the half periods in which the spring is
    loaded, in both quadrants of driving and braking.

How to confirm
    Repeat one motion with a heavier payload or in a posture with more weight. The Coulomb friction grows with
    the mean torque; without load it falls back.

What to do
    Compensate friction in proportion to the transmitted torque. A large or growing mu points at wear, preload
    or lubricant of the gear.

Literature
    P. Hamon, M. Gautier, P. Garrec, "Dynamic identification of robots with a dry friction model depending on
    load and velocity", IEEE/RSJ IROS, 2010.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexid_cli.effects import slots
from flexid_cli.effects.base import Array, Effect, EffectParameter, Law, Stage
from flexid_cli.effects.forms import column
from flexid_cli.effects.motion import Base, Motion, Terms
from flexid_cli.effects.signature import Signature


def _torque(w: Array, p: Array, _x: Array, _dx: Array, g: Array) -> None:
    torque = w[slots.JOINT_TORQUE]
    w[slots.MOTOR_COULOMB] += p[0] * abs(torque)
    g[0] = 1.0 if p[0] == 0.0 else torque


def _columns(m: Motion, _: Sequence[float]) -> Terms:
    return Terms(motor=column(np.abs(m.joint_torque) * m.motor_sign))


def _values(a: Array, _: Sequence[float], __: Base) -> dict[str, float]:
    return {"load_friction_coefficient": float(a[0])}


EFFECT = Effect(
    code="FX105",
    name="load_dependent_friction",
    family="motor",
    equation="motor",
    term="mu |T| sgn(qm')",
    parameters=(EffectParameter("load_friction_coefficient", "mu", "ratio", 0.0, 1.0, 0.08, 0.0),),
    needs=("torque", "motor_position"),
    best_recording="A motion whose transmitted torque changes sign and size while the motor moves both ways.",
    text=__doc__,
    laws=(Law(Stage.MOTOR, _torque),),
    guards=1,
    signatures=(Signature(_columns, _values, sign=1),),
)
