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

from flexid_cli.effects import slots
from flexid_cli.effects.base import Array, Effect, EffectParameter, Law, Stage


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
)
