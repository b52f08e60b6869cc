"""A constant torque at the motor.

What it is
    A torque that does not depend on motion: the offset of the current sensor, a preload, or Coulomb friction
    that is larger in one direction than in the other (the asymmetric part of friction is an offset, too).

In the data
    The motor equation's residual has a mean, the same at every speed, position and time. Only a motion that
    covers several positions tells it from weight, whose torque changes with the position.

How to confirm
    Record the current with the axis disengaged or the drive off: what remains is the sensor's. If the offset
    is gone, compare slow sweeps in both directions at several positions: friction's asymmetry stays, weight
    changes.

What to do
    Zero the current sensor. Otherwise keep the offset in the controller's feed-forward.

Literature
    A. Janot, M. Gautier, M. Brunot, "Data set and reference models of EMPS", Workshop on Nonlinear System
    Identification Benchmarks, 2019 (an offset of 16 % of the Coulomb friction on a real axis).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexid_cli.effects import slots
from flexid_cli.effects.base import Array, Effect, EffectParameter, Law, Stage
from flexid_cli.effects.motion import Base, Motion, Terms
from flexid_cli.effects.signature import Signature


def _torque(w: Array, p: Array, _x: Array, _dx: Array, _g: Array) -> None:
    w[slots.MOTOR_TORQUE] += p[0]


def _columns(m: Motion, _: Sequence[float]) -> Terms:
    return Terms(motor=np.ones((m.torque.size, 1)))


def _values(a: Array, _: Sequence[float], __: Base) -> dict[str, float]:
    return {"torque_offset": float(a[0])}


EFFECT = Effect(
    code="FX101",
    name="torque_offset",
    family="motor",
    equation="motor",
    term="offset",
    parameters=(EffectParameter("torque_offset", "offset", "torque", -1e12, 1e12, 8.0, 0.0),),
    needs=("torque", "motor_position"),
    best_recording="Slow sweeps in both directions over the whole range of positions.",
    text=__doc__,
    laws=(Law(Stage.MOTOR, _torque),),
    energy="conserves",
    signatures=(Signature(_columns, _values),),
)
