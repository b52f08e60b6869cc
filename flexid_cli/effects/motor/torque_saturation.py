"""The drive cannot give the torque that is asked for.

What it is
    The acting torque stops at a limit (current limit, voltage limit, thermal protection) while the recorded
    command goes on. Where the recorded value is the measured current, the limit shows in the record itself.

In the data
    The motor equation's residual is zero below the limit and grows with the command above it: large, short,
    of one sign with the command.

How to confirm
    Look at the largest commands: acceleration does not follow them. Repeat with half the amplitude: the
    residual is gone altogether.

What to do
    Identify from motions below the limit or leave these intervals out. If the limit should not be there,
    check the drive's parameters and supply voltage.

Literature
    K. J. Astrom, R. M. Murray, "Feedback systems", Princeton University Press, chapter on PID control (limits
    and windup).
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


def _torque(w: Array, p: Array, _x: Array, _dx: Array, g: Array) -> None:
    torque = w[slots.TORQUE]
    g[0] = 1.0 if p[0] == math.inf else p[0] - abs(torque)
    if torque > p[0]:
        w[slots.TORQUE] = p[0]
    elif torque < -p[0]:
        w[slots.TORQUE] = -p[0]


def _columns(m: Motion, shape: Sequence[float]) -> Terms:
    return Terms(motor=column(m.torque - np.clip(m.torque, -shape[0], shape[0])))


def _shapes(scale: Scale) -> Sequence[Shape]:
    return (Shape("torque_limit", 0.3 * scale.torque, 0.999 * scale.torque, 16, "linear"),)


def _values(_: Array, shape: Sequence[float], __: Base) -> dict[str, float]:
    return {"torque_limit": shape[0]}


EFFECT = Effect(
    code="FX107",
    name="torque_saturation",
    family="motor",
    equation="motor",
    term="min(max(Gm, -limit), limit) in place of Gm",
    parameters=(EffectParameter("torque_limit", "limit", "torque", 0.0, math.inf, 300.0, math.inf),),
    needs=("torque", "motor_position"),
    best_recording="One motion at full amplitude and the same at half of it.",
    text=__doc__,
    laws=(Law(Stage.LIMIT, _torque),),
    guards=1,
    energy="exchanges",
    signatures=(Signature(_columns, _values, _shapes, fixed=1.0),),
)
