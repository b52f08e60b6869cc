"""Friction at the motor falls while the axis warms up.

What it is
    Lubricant thins as it warms. Viscous friction falls by the share c of its cold value, with a time constant
    from minutes to an hour.

In the data
    The motor equation's residual is the velocity times a curve of time. Blocks of the record, fitted one by
    one, give a viscous friction that falls steadily while everything else stays.

How to confirm
    Repeat the same motion at the end of the record, or start a second record warm. In a single chirp time and
    frequency are one and the same, so drift looks like a lag.

What to do
    Warm the axis up before identifying, or use a friction that depends on temperature. Compare only records
    at equal temperature.

Literature
    A. C. Bittencourt, S. Gunnarsson, "Static friction in a robot joint - modeling and identification of load
    and temperature effects", ASME J. Dyn. Sys. Meas. Control 134(5), 2012.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from flexid_cli.effects import slots
from flexid_cli.effects.base import Array, Effect, EffectParameter, Law, Stage
from flexid_cli.effects.forms import column
from flexid_cli.effects.motion import Base, Motion, Shape, Terms
from flexid_cli.effects.signature import Scale, Signature


def _torque(w: Array, p: Array, _x: Array, _dx: Array, _g: Array) -> None:
    change = p[0] * (math.exp(-w[slots.TIME] / p[1]) - 1.0)
    w[slots.MOTOR_TORQUE] += w[slots.FVM] * change * w[slots.MOTOR_VELOCITY]


def _columns(m: Motion, shape: Sequence[float]) -> Terms:
    return Terms(motor=column(m.motor_velocity * np.expm1(-m.time_s / shape[0])))


def _shapes(scale: Scale) -> Sequence[Shape]:
    return (Shape("warming_time", 0.05 * scale.duration_s, 5.0 * scale.duration_s, 8),)


def _values(a: Array, shape: Sequence[float], base: Base) -> dict[str, float]:
    return {"friction_change": float(a[0]) / base.FVm, "warming_time": shape[0]}


EFFECT = Effect(
    code="FX109",
    name="thermal_drift",
    family="motor",
    equation="motor",
    term="FVm c (exp(-t/tau) - 1) qm'",
    parameters=(
        EffectParameter("friction_change", "c", "ratio", -10.0, 1.0, 0.3, 0.0),
        EffectParameter("warming_time", "tau", "time", 1e-3, 1e6, 20.0),
    ),
    needs=("torque", "motor_position"),
    best_recording="The same motion at the start and at the end of a long record.",
    text=__doc__,
    laws=(Law(Stage.MOTOR, _torque),),
    energy="exchanges",
    signatures=(Signature(_columns, _values, _shapes),),
)
