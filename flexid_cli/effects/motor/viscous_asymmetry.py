"""Viscous friction that differs between the two directions.

What it is
    The slope of friction over speed is FVm + FVa one way and FVm - FVa the other. Seals with a lip, bearings
    under an axial preload from a helical gear, and a current gain that differs with the sign all do this.

In the data
    The motor equation's residual follows |qm'|: the same sign in both directions, growing with speed. Plotted
    over the velocity it is a V.

How to confirm
    Record constant speeds, three or more in each direction, over the same positions. The torque over speed is
    a straight line on each side; the slopes differ.

What to do
    Use a friction compensation with one slope per direction. If the difference is new, look at seals, at the
    preload and at the current calibration.

Literature
    B. Armstrong-Helouvry, P. Dupont, C. Canudas de Wit, "A survey of models, analysis tools and compensation
    methods for the control of machines with friction", Automatica 30(7), 1994.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexid_cli.effects import slots
from flexid_cli.effects.base import Array, Effect, EffectParameter, Law, Stage
from flexid_cli.effects.forms import column
from flexid_cli.effects.motion import Base, Motion, Terms
from flexid_cli.effects.signature import Signature


def _torque(w: Array, p: Array, _x: Array, _dx: Array, g: Array) -> None:
    velocity = w[slots.MOTOR_VELOCITY]
    w[slots.MOTOR_TORQUE] += p[0] * abs(velocity)
    g[0] = 1.0 if p[0] == 0.0 else velocity


def _columns(m: Motion, _: Sequence[float]) -> Terms:
    return Terms(motor=column(np.abs(m.motor_velocity)))


def _values(a: Array, _: Sequence[float], __: Base) -> dict[str, float]:
    return {"viscous_asymmetry": float(a[0])}


EFFECT = Effect(
    code="FX102",
    name="viscous_asymmetry",
    family="motor",
    equation="motor",
    term="FVa |qm'|",
    parameters=(EffectParameter("viscous_asymmetry", "FVa", "viscous", -1e12, 1e12, 40.0, 0.0),),
    needs=("torque", "motor_position"),
    best_recording="Constant speeds in both directions, up to the highest that the axis reaches.",
    text=__doc__,
    laws=(Law(Stage.MOTOR, _torque),),
    guards=1,
    energy="exchanges",
    signatures=(Signature(_columns, _values),),
)
