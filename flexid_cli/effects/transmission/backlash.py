"""Play between motor and load.

What it is
    Between two flanks there is a gap: over its whole width the spring transmits nothing. Wear, a lost preload
    or a loose key or coupling open it.

In the data
    Torque over torsion is flat at zero torque, over the width of the gap. Motor and load equation have the
    same residual with opposite signs, in short intervals where the torque changes sign. The resonance seems
    to fall at small amplitude.

How to confirm
    Hold the motor and push the load by hand in both directions: the load encoder moves without torque. Or
    repeat with a constant load (weight) that keeps the flanks together: the residual disappears.

What to do
    Restore the preload, replace worn gears, tighten couplings. Until then avoid torque reversals in precise
    motion, and identify K from intervals in which the torque keeps its sign.

Literature
    M. Nordin, P.-O. Gutman, "Controlling mechanical systems with backlash - a survey", Automatica 38(10),
    2002.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexid_cli.effects import slots
from flexid_cli.effects.base import Array, Effect, EffectParameter, Law, Stage
from flexid_cli.effects.forms import column
from flexid_cli.effects.motion import Base, Motion, Shape, Terms
from flexid_cli.effects.signature import Scale, Signature


def _contact(w: Array, p: Array, _x: Array, _dx: Array, g: Array) -> None:
    g[0] = 1.0
    g[1] = 1.0
    if p[0] > 0.0:
        torsion = w[slots.SPRING_TORSION]
        half = 0.5 * p[0]
        g[0] = torsion - half
        g[1] = torsion + half
        if torsion > half:
            w[slots.SPRING_TORSION] = torsion - half
        elif torsion < -half:
            w[slots.SPRING_TORSION] = torsion + half
        else:
            w[slots.SPRING_TORSION] = 0.0


INNER_STIFFNESS = 0.35  # over the outer one: stiffer than that inside the gap, and it is no gap


def _columns(m: Motion, shape: Sequence[float]) -> Terms:
    half = 0.5 * shape[0]
    return Terms(transmission=column(-np.clip(m.torsion - shape[1], -half, half)))


def _shapes(scale: Scale) -> Sequence[Shape]:
    low = max(scale.deflection_noise, 0.004 * scale.deflection)
    centre = 0.3 * scale.deflection
    return (
        Shape("gap", low, 1.2 * scale.deflection, 12),
        Shape("centre", -centre, centre, 1, "linear"),
    )


def _values(_: Array, shape: Sequence[float], __: Base) -> dict[str, float]:
    return {"gap": shape[0]}


def _tied(a: Array, _: Sequence[float], base: Base) -> str:
    inner = 1.0 - float(a[0]) / base.K
    if abs(inner) < INNER_STIFFNESS:
        return ""
    return f"inside the gap the stiffness would be {inner:.2g} of the outer one"


EFFECT = Effect(
    code="FX202",
    name="backlash",
    family="transmission",
    equation="transmission",
    term="K dz(d) in place of K d, dz zero over the width of the gap",
    parameters=(EffectParameter("gap", "gap", "position", 0.0, 10.0, 1e-3, 0.0),),
    needs=("torque", "motor_position"),
    best_recording="Small motions with many changes of the torque's sign, without a constant load, both encoders.",
    text=__doc__,
    laws=(Law(Stage.CONTACT, _contact),),
    guards=2,
    energy="conserves",
    signatures=(Signature(_columns, _values, _shapes, sign=1, tied=_tied, centred=True),),
)
