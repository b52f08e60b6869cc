"""Friction at the load that falls as the motion starts (Stribeck).

What it is
    Like friction at the motor, but behind the spring: bearings, seals and guides of the load rub harder at
    rest and at very low speed than in motion.

In the data
    The load equation's residual differs from zero only where the load moves slowly, with the sign of its
    velocity. The motor may already move while the load still sticks; then the torsion shows a saw tooth.

How to confirm
    Slow sweeps with both encoders: the torsion is largest just before the load starts. Without the joint
    encoder it can be told from friction at the motor only near the resonance.

What to do
    Lubricate or replace the load's bearings and guides. For control, compensate the friction and filter the
    reference.

Literature
    B. Armstrong-Helouvry, P. Dupont, C. Canudas de Wit, Automatica 30(7), 1994.
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
    ratio = w[slots.JOINT_VELOCITY] / p[1]
    w[slots.LOAD_COULOMB] += p[0] * math.exp(-ratio * ratio)


def _columns(m: Motion, shape: Sequence[float]) -> Terms:
    return Terms(load=column(m.joint_sign * np.exp(-((m.joint_velocity / shape[0]) ** 2))))


def _shapes(scale: Scale) -> Sequence[Shape]:
    low = max(2.0 * scale.base.load_reversal, 2.0 * scale.joint_reversal_step, 0.01 * scale.joint_speed)
    return (Shape("stribeck_velocity", low, 0.6 * scale.joint_speed, 12),)


def _values(a: Array, shape: Sequence[float], _: Base) -> dict[str, float]:
    return {"stribeck_torque": float(a[0]), "stribeck_velocity": shape[0]}


EFFECT = Effect(
    code="FX302",
    name="stribeck_load",
    family="load",
    equation="load",
    term="FStl exp(-(q'/vsl)^2) sgn(q')",
    parameters=(
        EffectParameter("stribeck_torque", "FStl", "torque", 0.0, 1e12, 10.0, 0.0),
        EffectParameter("stribeck_velocity", "vsl", "velocity", 1e-9, 1e6, 0.03),
    ),
    needs=("torque", "motor_position"),
    best_recording="Slow sweeps with many reversals, with both encoders.",
    text=__doc__,
    laws=(Law(Stage.LOAD, _torque),),
    signatures=(Signature(_columns, _values, _shapes, sign=1, curved=True),),
)
