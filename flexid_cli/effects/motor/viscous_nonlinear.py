"""Friction at the motor that does not grow in proportion to speed.

What it is
    Lubricant that is churned or that shears thinner makes friction a curve over the speed: steeper at high
    speed (quadratic part) or flatter (a power below one).

In the data
    The motor equation's residual is an odd, smooth curve over the velocity, largest at the highest speed. It
    is the same at every position, load and time.

How to confirm
    Constant speeds over the whole range, at one temperature. The points do not lie on a line; the deviation
    is the same in both directions with the sign turned.

What to do
    Give the controller the curve instead of a slope. Which formula fits is no statement about the cause:
    report and use the curve.

Literature
    A. C. Bittencourt, S. Gunnarsson, "Static friction in a robot joint - modeling and identification of load
    and temperature effects", ASME J. Dyn. Sys. Meas. Control 134(5), 2012.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexid_cli.effects import slots
from flexid_cli.effects.base import Array, Effect, EffectParameter, Law, Stage
from flexid_cli.effects.forms import column
from flexid_cli.effects.motion import Base, Motion, Shape, Terms
from flexid_cli.effects.signature import Scale, Signature


def _torque(w: Array, p: Array, _x: Array, _dx: Array, _g: Array) -> None:
    velocity = w[slots.MOTOR_VELOCITY]
    w[slots.MOTOR_TORQUE] += p[0] * velocity * abs(velocity)
    if p[1] != 0.0:
        w[slots.MOTOR_COULOMB] += p[1] * abs(velocity) ** p[2]


VISCOUS = (0.8, 1.25)  # exponents that cannot be told from viscous friction


def _quadratic(m: Motion, _: Sequence[float]) -> Terms:
    return Terms(motor=column(m.motor_velocity * np.abs(m.motor_velocity)))


def _power(m: Motion, shape: Sequence[float]) -> Terms:
    return Terms(motor=column(m.motor_sign * np.abs(m.motor_velocity) ** shape[0]))


def _quadratic_values(a: Array, _: Sequence[float], __: Base) -> dict[str, float]:
    return {"quadratic_friction": float(a[0])}


def _power_values(a: Array, shape: Sequence[float], _: Base) -> dict[str, float]:
    return {"power_friction": float(a[0]), "power_exponent": shape[0]}


def _power_tied(_: Array, shape: Sequence[float], __: Base) -> str:
    low, high = VISCOUS
    return "its exponent is that of viscous friction" if low < shape[0] < high else ""


def _exponents(_: Scale) -> Sequence[Shape]:
    return (Shape("power_exponent", 0.25, 3.0, 12, "linear"),)


EFFECT = Effect(
    code="FX104",
    name="viscous_nonlinear",
    family="motor",
    equation="motor",
    term="FQ qm' |qm'| + FP |qm'|^a sgn(qm'), qm' in units of 1 rad/s (m/s) in the power",
    parameters=(
        EffectParameter("quadratic_friction", "FQ", "quadratic_viscous", -1e12, 1e12, 60.0, 0.0),
        EffectParameter("power_friction", "FP", "torque", -1e12, 1e12, 0.0, 0.0),
        EffectParameter("power_exponent", "a", "ratio", 0.1, 3.0, 0.5),
    ),
    needs=("torque", "motor_position"),
    best_recording="Constant speeds from the lowest to the highest in both directions, at one temperature.",
    text=__doc__,
    laws=(Law(Stage.MOTOR, _torque),),
    signatures=(
        Signature(_quadratic, _quadratic_values),
        Signature(_power, _power_values, _exponents, tied=_power_tied, curved=True),
    ),
)
