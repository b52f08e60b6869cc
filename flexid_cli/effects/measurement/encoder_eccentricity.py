"""An encoder's disc or ring is not centred.

What it is
    The measured angle differs from the true one by a wave with one cycle per turn of that encoder: a sin(q +
    phi) at the joint, and with the gear ratio's number of cycles per turn of the joint at the motor.

In the data
    The difference of the encoders repeats once per turn of the encoder, at every speed and without torque.
    Over a small range it is a wrong zero and a wrong scale, no more.

How to confirm
    Turn through a whole revolution of the encoder, slowly, in both directions. The wave stays at the same
    angles; torsion from friction changes its sign with the direction.

What to do
    Centre the ring, use two reading heads, or correct by a table.

Literature
    A. H. Slocum, "Precision machine design", Prentice Hall, 1992, chapter on sensors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from flexid_cli.effects import slots
from flexid_cli.effects.base import Array, Effect, EffectParameter, Law, Stage
from flexid_cli.effects.forms import amplitude_and_phase, sines
from flexid_cli.effects.motion import Base, Motion, Shape, Terms
from flexid_cli.effects.signature import Scale, Signature


def _measurement(w: Array, p: Array, _x: Array, _dx: Array, _g: Array) -> None:
    joint = w[slots.MEASURED_JOINT] + p[1]
    w[slots.MEASURED_JOINT] += p[0] * math.sin(joint)
    w[slots.MEASURED_JOINT_RATE] *= 1.0 + p[0] * math.cos(joint)
    motor = p[4] * w[slots.MEASURED_MOTOR] + p[3]
    w[slots.MEASURED_MOTOR] += p[2] * math.sin(motor)
    w[slots.MEASURED_MOTOR_RATE] *= 1.0 + p[2] * p[4] * math.cos(motor)


def _joint(m: Motion, _: Sequence[float]) -> Terms:
    return Terms(joint_error=sines(m.joint_position, 1.0))


def _joint_values(a: Array, _: Sequence[float], __: Base) -> dict[str, float]:
    size, phase = amplitude_and_phase(a)
    return {"joint_amplitude": size, "joint_phase": phase}


def _motor(m: Motion, _: Sequence[float]) -> Terms:
    return Terms(motor_error=sines(m.motor_position, m.gear_ratio))


def _once_a_turn(scale: Scale) -> Sequence[Shape] | None:
    """Nothing to search; without a gear, or over less than two turns, it is no ripple."""
    turns = scale.gear_ratio * scale.motor_range / (2.0 * np.pi)
    return () if scale.gear_ratio > 1.0 and turns > 2.0 else None


def _motor_values(a: Array, _: Sequence[float], base: Base) -> dict[str, float]:
    size, phase = amplitude_and_phase(a)
    return {"motor_amplitude": size, "motor_phase": phase, "motor_cycles": base.gear_ratio}


EFFECT = Effect(
    code="FX403",
    name="encoder_eccentricity",
    family="measurement",
    equation="measurement",
    term="q + a sin(q + phi), qm + am sin(n qm + phim) in place of q, qm",
    parameters=(
        EffectParameter("joint_amplitude", "a", "position", 0.0, 1.0, 1e-3, 0.0),
        EffectParameter("joint_phase", "phi", "phase", -6.3, 6.3, 0.9),
        EffectParameter("motor_amplitude", "am", "position", 0.0, 1.0, 0.0, 0.0),
        EffectParameter("motor_phase", "phim", "phase", -6.3, 6.3, 0.0),
        EffectParameter("motor_cycles", "n", "cycles", 1e-6, 1e7, 50.0),
    ),
    needs=("torque", "motor_position"),
    best_recording="Slow motion through a whole turn of the encoder in both directions, with both encoders.",
    text=__doc__,
    laws=(Law(Stage.MEASUREMENT, _measurement),),
    energy="exchanges",
    signatures=(
        Signature(_joint, _joint_values, needs_joint=True, rotary=True),
        Signature(_motor, _motor_values, _once_a_turn, rotary=True),
    ),
)
