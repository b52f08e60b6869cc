"""The joint remembers which way it was twisted.

What it is
    Surfaces that slip a little inside gear, bearings and clamped joints take energy at every turn of the
    torsion, however slowly it turns. Dahl's element beside the spring: z' = (Fh/dh) d' - |d'| z/dh, T = K d +
    z.

In the data
    Torque over torsion is a loop whose width does not depend on frequency. Motor and load equation have the
    same residual with opposite signs; it changes its sign within the length dh after the torsion turns round.

How to confirm
    Twist the joint slowly against a locked load, or compare the loop's width at two frequencies: equal for
    hysteresis, in proportion to frequency for damping.

What to do
    Add the loop to a simulation or to a torque estimate from torsion. A wider loop than a year ago points at
    bearings, clamping or lubricant. Which member of the family (Dahl, Maxwell slip, Bouc-Wen) it is, a log
    seldom tells.

Literature
    P. R. Dahl, "A solid friction model", The Aerospace Corporation, TOR-0158(3107-18)-1, 1968. M. Ruderman,
    F. Hoffmann, T. Bertram, "Modeling and identification of elastic robot joints with hysteresis and
    backlash", IEEE Trans. Industrial Electronics 56(10), 2009.
"""

from __future__ import annotations

from flexid_cli.effects import slots
from flexid_cli.effects.base import Array, Effect, EffectParameter, EffectState, Law, Stage


def _torque(w: Array, p: Array, x: Array, dx: Array, g: Array) -> None:
    rate = w[slots.TORSION_RATE]
    dx[0] = (p[0] * rate - abs(rate) * x[0]) / p[1]
    w[slots.JOINT_TORQUE] += x[0]
    g[0] = 1.0 if p[0] == 0.0 else rate


EFFECT = Effect(
    code="FX204",
    name="hysteresis",
    family="transmission",
    equation="transmission",
    term="z in T, z' = (Fh/dh) d' - |d'| z/dh",
    parameters=(
        EffectParameter("hysteresis_torque", "Fh", "torque", 0.0, 1e12, 15.0, 0.0),
        EffectParameter("hysteresis_length", "dh", "position", 1e-12, 10.0, 1e-3),
    ),
    needs=("torque", "motor_position"),
    best_recording="Slow and fast motions of equal torque with many turns of the torsion, both encoders.",
    text=__doc__,
    laws=(Law(Stage.TRANSMISSION, _torque),),
    states=(EffectState("z"),),
    guards=1,
)
