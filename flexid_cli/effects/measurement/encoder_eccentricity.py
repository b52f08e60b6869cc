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
from collections.abc import Callable, Sequence

import numpy as np

from flexid_cli.effects import slots
from flexid_cli.effects.base import Array, Effect, EffectParameter, Law, Stage
from flexid_cli.effects.forms import amplitude_and_phase, sines
from flexid_cli.effects.motion import Base, Motion, Shape, Terms
from flexid_cli.effects.signature import Scale, Signature

MOST_WAVE, NEAR, ROUNDS = 0.5, 1e-12, 60  # slope of a wave that is taken out, and how near the angle is found


def _measurement(w: Array, p: Array, _x: Array, _dx: Array, _g: Array) -> None:
    joint = w[slots.MEASURED_JOINT] + p[1]
    w[slots.MEASURED_JOINT] += p[0] * math.sin(joint)
    w[slots.MEASURED_JOINT_RATE] *= 1.0 + p[0] * math.cos(joint)
    motor = p[4] * w[slots.MEASURED_MOTOR] + p[3]
    w[slots.MEASURED_MOTOR] += p[2] * math.sin(motor)
    w[slots.MEASURED_MOTOR_RATE] *= 1.0 + p[2] * p[4] * math.cos(motor)


def _centred(measured: Array, a: Array, cycles: float) -> Array:
    """The angle of which the wave makes the measured one: x + a sin(n x) = measured, which repetition solves."""
    if float(np.hypot(*a)) * cycles > MOST_WAVE:
        return measured  # no encoder's wave: the measured angle would all but stand still in places
    angle = measured
    for _ in range(ROUNDS):
        before, angle = angle, measured - sines(angle, cycles) @ a
        if np.max(np.abs(angle - before)) < NEAR:
            break
    return angle


def _joint_corrected(joint: Array, a: Array, _: Callable[[Array, int], Array], __: float) -> Array:
    return _centred(joint, a, 1.0)


def _motor_corrected(motor: Array, a: Array, _: Callable[[Array, int], Array], gear_ratio: float) -> Array:
    return _centred(motor, a, gear_ratio)


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
        Signature(_joint, _joint_values, needs_joint=True, rotary=True, corrected=_joint_corrected),
        Signature(
            _motor, _motor_values, _once_a_turn, rotary=True, corrected=_motor_corrected, corrects="motor"
        ),
    ),
)
