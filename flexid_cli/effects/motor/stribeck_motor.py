"""Friction at the motor that falls as the motion starts (Stribeck).

What it is
    At rest and at very low speed the surfaces touch; with speed the lubricant separates them and friction
    falls by FSt within a few times the velocity vs. Above that the usual Coulomb and viscous friction remain.

In the data
    The motor equation's residual differs from zero only at low speed, with the sign of the velocity.
    Reversals show a peak of torque on both sides; slow motion can stick and slip.

How to confirm
    Sweep slowly, several speeds below vs, or a triangle of small amplitude. The torque at constant speed
    falls as the speed grows, then rises again.

What to do
    Compensate with the full curve near reversals, or avoid positioning at these speeds. A peak that grows
    over months points at the lubricant.

Literature
    B. Armstrong-Helouvry, P. Dupont, C. Canudas de Wit, Automatica 30(7), 1994. C. Canudas de Wit, H. Olsson,
    K. J. Astrom, P. Lischinsky, "A new model for control of systems with friction", IEEE TAC 40(3), 1995.
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
    ratio = w[slots.MOTOR_VELOCITY] / p[1]
    w[slots.MOTOR_COULOMB] += p[0] * math.exp(-ratio * ratio)


def _columns(m: Motion, shape: Sequence[float]) -> Terms:
    return Terms(motor=column(m.motor_sign * np.exp(-((m.motor_velocity / shape[0]) ** 2))))


def _shapes(scale: Scale) -> Sequence[Shape]:
    # Narrower than the reversal, or than what the filters resolve of it, it would be part of it; as wide as the
    # speeds it would be Coulomb friction.
    low = max(2.0 * scale.base.motor_reversal, 2.0 * scale.motor_reversal_step, 0.01 * scale.motor_speed)
    return (Shape("stribeck_velocity", low, 0.6 * scale.motor_speed, 12),)


def _values(a: Array, shape: Sequence[float], _: Base) -> dict[str, float]:
    return {"stribeck_torque": float(a[0]), "stribeck_velocity": shape[0]}


EFFECT = Effect(
    code="FX103",
    name="stribeck_motor",
    family="motor",
    equation="motor",
    term="FSt exp(-(qm'/vs)^2) sgn(qm')",
    parameters=(
        EffectParameter("stribeck_torque", "FSt", "torque", 0.0, 1e12, 20.0, 0.0),
        EffectParameter("stribeck_velocity", "vs", "velocity", 1e-9, 1e6, 0.03),
    ),
    needs=("torque", "motor_position"),
    best_recording="Slow sweeps with many reversals, much of the time below the Stribeck velocity.",
    text=__doc__,
    laws=(Law(Stage.MOTOR, _torque),),
    signatures=(Signature(_columns, _values, _shapes, sign=1, curved=True),),
)
