"""The gear's ratio is not constant within a turn.

What it is
    Teeth and the wave generator are not perfect: the load's position differs from the motor's by a wave that
    repeats with the motor's angle. d = qm + A sin(n qm + phi) - q.

In the data
    The difference of the encoders repeats at the same motor angles, at every speed, also without torque. Near
    the resonance it drives the spring: motor and load equation have the same residual with opposite signs.

How to confirm
    Move slowly over several motor revolutions without load: the difference of the encoders is the wave. Two
    cycles per turn of the wave generator are usual for strain wave gears. One cycle per turn of the joint
    encoder is that encoder's eccentricity instead.

What to do
    Correct with a table over the motor's angle. A wave that grows points at a wrongly mounted or worn gear.

Literature
    F. H. Ghorbel, P. S. Gandhi, F. Alpeter, "On the kinematic error in harmonic drive gears", ASME J.
    Mechanical Design 123(1), 2001.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from flexid_cli.effects import slots
from flexid_cli.effects.base import Array, Effect, EffectParameter, Law, Stage
from flexid_cli.effects.forms import amplitude_and_phase, cycles_range, sines
from flexid_cli.effects.motion import Base, Motion, Shape, Terms
from flexid_cli.effects.signature import Scale, Signature


def _kinematics(w: Array, p: Array, _x: Array, _dx: Array, _g: Array) -> None:
    angle = p[1] * w[slots.MOTOR_POSITION] + p[2]
    ratio = p[0] * p[1] * math.cos(angle)
    w[slots.TORSION] += p[0] * math.sin(angle)
    w[slots.TORSION_RATE] += ratio * w[slots.MOTOR_VELOCITY]
    w[slots.GEAR] += ratio  # power conserving: the motor feels T times the derivative of d


def _columns(m: Motion, shape: Sequence[float]) -> Terms:
    error = sines(m.motor_position, shape[0])
    return Terms(transmission=m.base.K * error, torsion=error)


def _shapes(scale: Scale) -> Sequence[Shape] | None:
    return cycles_range(scale, "error_cycles")


def _values(a: Array, shape: Sequence[float], _: Base) -> dict[str, float]:
    size, phase = amplitude_and_phase(a)
    return {"error_amplitude": size, "error_cycles": shape[0], "error_phase": phase}


EFFECT = Effect(
    code="FX205",
    name="transmission_error",
    family="transmission",
    equation="transmission",
    term="d = qm + A sin(n qm + phi) - q; the motor feels T (1 + A n cos(n qm + phi))",
    parameters=(
        EffectParameter("error_amplitude", "A", "position", 0.0, 1.0, 3e-4, 0.0),
        EffectParameter("error_cycles", "n", "cycles", 1e-6, 1e7, 100.0),
        EffectParameter("error_phase", "phi", "phase", -6.3, 6.3, 0.4),
    ),
    needs=("torque", "motor_position"),
    best_recording="Slow motion at constant speed over several motor revolutions in both directions, both encoders.",
    text=__doc__,
    laws=(Law(Stage.KINEMATICS, _kinematics),),
    energy="conserves",
    signatures=(Signature(_columns, _values, _shapes, ripple="transmission", lawless=True),),
)
