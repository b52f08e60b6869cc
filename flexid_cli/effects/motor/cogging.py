"""A torque that repeats with the motor's angle.

What it is
    Magnets prefer certain positions against the stator's teeth (cogging), and currents that are not
    sinusoidal to the magnets' field add a ripple. Both repeat a whole number of times per motor revolution,
    often with an overtone of twice as many.

In the data
    The motor equation's residual is a line in the spectrum over the motor's angle, at the same cycles per
    revolution at every speed. In the time domain its frequency moves with the speed.

How to confirm
    Turn slowly at constant speed in both directions: the torque repeats at the same angles, with the same
    sign. Counts per revolution that are multiples of pole pairs or slots name the cause.

What to do
    Add a table of torque over the motor's angle to the feed-forward (drives often have one), or change to a
    motor with skewed slots. A ripple that grows with the current comes from commutation: calibrate the
    encoder's phase.

Literature
    P. Krause, O. Wasynczuk, S. Sudhoff, S. Pekarek, "Analysis of electric machinery and drive systems",
    Wiley. B. Grcar, P. Cafuta, G. Stumberger, A. M. Stankovic, "Control-based reduction of pulsating torque
    for PMAC machines", IEEE Trans. Energy Conversion 17(2), 2002.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from flexid_cli.effects import slots
from flexid_cli.effects.base import Array, Effect, EffectParameter, Law, Stage
from flexid_cli.effects.forms import amplitude_and_phase, cycles_range, sines
from flexid_cli.effects.motion import Base, Motion, Shape, Terms
from flexid_cli.effects.signature import Scale, Signature


def _torque(w: Array, p: Array, _x: Array, _dx: Array, _g: Array) -> None:
    angle = p[1] * w[slots.MOTOR_POSITION]
    w[slots.MOTOR_TORQUE] += p[0] * math.sin(angle + p[2]) + p[3] * math.sin(2.0 * angle + p[4])


def _columns(m: Motion, shape: Sequence[float]) -> Terms:
    return Terms(motor=sines(m.motor_position, shape[0]))


def _two_columns(m: Motion, shape: Sequence[float]) -> Terms:
    waves = [sines(m.motor_position, k * shape[0]) for k in (1.0, 2.0)]
    return Terms(motor=np.hstack(waves))


def _shapes(scale: Scale) -> Sequence[Shape] | None:
    return cycles_range(scale, "cogging_cycles")


def _values(a: Array, shape: Sequence[float], _: Base) -> dict[str, float]:
    size, phase = amplitude_and_phase(a)
    return {"cogging_torque": size, "cogging_cycles": shape[0], "cogging_phase": phase}


def _two_values(a: Array, shape: Sequence[float], base: Base) -> dict[str, float]:
    size, phase = amplitude_and_phase(a[2:])
    return _values(a, shape, base) | {"second_torque": size, "second_phase": phase}


EFFECT = Effect(
    code="FX106",
    name="cogging",
    family="motor",
    equation="motor",
    term="A sin(n qm + phi) + A2 sin(2 n qm + phi2)",
    parameters=(
        EffectParameter("cogging_torque", "A", "torque", 0.0, 1e12, 12.0, 0.0),
        EffectParameter("cogging_cycles", "n", "cycles", 1e-6, 1e7, 300.0),
        EffectParameter("cogging_phase", "phi", "phase", -6.3, 6.3, 0.7),
        EffectParameter("second_torque", "A2", "torque", 0.0, 1e12, 0.0, 0.0),
        EffectParameter("second_phase", "phi2", "phase", -6.3, 6.3, 0.0),
    ),
    needs=("torque", "motor_position"),
    best_recording="Slow motion at constant speed over several motor revolutions in both directions.",
    text=__doc__,
    laws=(Law(Stage.MOTOR, _torque),),
    energy="conserves",
    signatures=(
        Signature(_columns, _values, _shapes, ripple="motor"),
        Signature(_two_columns, _two_values, _shapes, ripple="motor", extends=True),
    ),
)
