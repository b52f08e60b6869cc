"""The load changes during the record.

What it is
    A part is picked up or set down, a fluid moves, a clamp opens: inertia and weight jump at one instant. The
    velocity does not jump (the part is taken along at the speed of the load).

In the data
    The load equation's residual is zero before (or after) one instant, and from there follows acceleration
    and position. Fits of the two halves differ in JL and in the gravity moments, and in nothing else.

How to confirm
    Look into the process: what happened at that time? Cut the record there and identify both pieces.

What to do
    Use one set of load parameters per piece. If nothing was meant to change, look for a loose part.

Literature
    W. Khalil, E. Dombre, "Modeling, identification and control of robots", Butterworth-Heinemann, 2004,
    chapter on identification (payload parameters).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from flexid_cli.effects import slots
from flexid_cli.effects.base import Array, Effect, EffectParameter, Law, Stage
from flexid_cli.effects.forms import column
from flexid_cli.effects.motion import Base, Motion, Shape, Terms
from flexid_cli.effects.signature import Scale, Signature


def _torque(w: Array, p: Array, _x: Array, _dx: Array, g: Array) -> None:
    g[0] = 1.0
    if p[0] != 0.0 or p[1] != 0.0 or p[2] != 0.0:
        g[0] = w[slots.TIME] - p[3]
        if g[0] >= 0.0:
            q = w[slots.JOINT_POSITION]
            w[slots.LOAD_INERTIA] += p[0]
            w[slots.LOAD_TORQUE] += w[slots.GRAVITY] * (p[1] * math.cos(q) + p[2] * math.sin(q))


def _columns(m: Motion, shape: Sequence[float]) -> Terms:
    return Terms(load=column(m.joint_acceleration * (m.time_s > shape[0])))


def _shapes(scale: Scale) -> Sequence[Shape]:
    return (Shape("time_of_change", 0.05 * scale.duration_s, 0.95 * scale.duration_s, 40, "linear"),)


def _values(a: Array, shape: Sequence[float], _: Base) -> dict[str, float]:
    return {"inertia_change": float(a[0]), "time_of_change": shape[0]}


EFFECT = Effect(
    code="FX304",
    name="payload_change",
    family="load",
    equation="load",
    term="dJL q'' + dMX g cos q + dMY g sin q from the time of change on",
    parameters=(
        EffectParameter("inertia_change", "dJL", "inertia", -1e9, 1e9, 8.0, 0.0),
        EffectParameter("moment_change_x", "dMX", "first_moment", -1e9, 1e9, 0.0, 0.0),
        EffectParameter("moment_change_y", "dMY", "first_moment", -1e9, 1e9, 0.0, 0.0),
        EffectParameter("time_of_change", "tc", "time", -1e9, 1e9, 2.0),
    ),
    needs=("torque", "motor_position"),
    best_recording="The same motion before and after the change, with a note of its time.",
    text=__doc__,
    laws=(Law(Stage.LOAD, _torque),),
    guards=1,
    energy="exchanges",
    signatures=(Signature(_columns, _values, _shapes, event=True),),
)
