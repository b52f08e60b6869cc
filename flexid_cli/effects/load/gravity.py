"""Weight of the load that the model does not hold.

What it is
    The load's centre of mass is not on the axis: its weight adds MX g cos q + MY g sin q.

In the data
    The load equation's residual (without a joint encoder: the motor equation's) follows the position, the
    same at every speed and in both directions. Over a small range it looks like a spring, or like an offset.

How to confirm
    Hold still at several positions and compare the torques in both directions of approach. A cable or hose
    does the same over a small range; weight follows a sine over a large one.

What to do
    Add the two moments to the model, or tell the tool the true gravity for this axis. A change against the
    data sheet is a payload.

Literature
    M. T. Pham, M. Gautier, P. Poignet, "Identification of joint stiffness with bandpass filtering", IEEE
    ICRA, 2001, equation (7).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from flexid_cli.effects import slots
from flexid_cli.effects.base import Array, Effect, EffectParameter, Law, Stage
from flexid_cli.effects.motion import Base, Motion, Terms
from flexid_cli.effects.signature import Signature


def _torque(w: Array, p: Array, _x: Array, _dx: Array, _g: Array) -> None:
    q = w[slots.JOINT_POSITION]
    w[slots.LOAD_TORQUE] += w[slots.GRAVITY] * (p[0] * math.cos(q) + p[1] * math.sin(q))


def _columns(m: Motion, _: Sequence[float]) -> Terms:
    return Terms(load=m.gravity * np.column_stack([np.cos(m.joint_position), np.sin(m.joint_position)]))


def _values(a: Array, _: Sequence[float], __: Base) -> dict[str, float]:
    return {"gravity_moment_x": float(a[0]), "gravity_moment_y": float(a[1])}


EFFECT = Effect(
    code="FX301",
    name="gravity",
    family="load",
    equation="load",
    term="MX g cos q + MY g sin q",
    parameters=(
        EffectParameter("gravity_moment_x", "MX", "first_moment", -1e9, 1e9, 3.0, 0.0),
        EffectParameter("gravity_moment_y", "MY", "first_moment", -1e9, 1e9, 12.0, 0.0),
    ),
    needs=("torque", "motor_position"),
    best_recording="Slow motion over the whole range of positions in both directions.",
    text=__doc__,
    laws=(Law(Stage.LOAD, _torque),),
    energy="conserves",
    signatures=(Signature(_columns, _values, motor_alone=True, rotary=True),),
)
