"""An encoder's value is filtered before it is recorded.

What it is
    Encoder electronics or the drive smooth the position: a first-order lag. On the motor's side the
    controller sees the lag, too, and the loop loses phase.

In the data
    Like a delay at low frequency, but with an amplitude that falls at high frequency. With both encoders, a
    lag of one gives a torsion that follows the velocity.

How to confirm
    Compare with a recording of the raw encoder, or with the filter switched off in the drive. At constant
    speed a lag looks like a delay; at the top of the band its amplitude is missing.

What to do
    Switch the filter off, or correct the record by it. Identify in a band far below the filter's.

Literature
    L. Ljung, "System identification: theory for the user", Prentice Hall, 1999, chapter on preprocessing of
    data.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from flexid_cli.effects import slots
from flexid_cli.effects.base import Array, Effect, EffectParameter, EffectState, Law, Stage
from flexid_cli.effects.forms import column
from flexid_cli.effects.motion import Base, Motion, Terms
from flexid_cli.effects.signature import Signature


def _measurement(w: Array, p: Array, x: Array, dx: Array, _g: Array) -> None:
    dx[0] = 0.0
    dx[1] = 0.0
    if p[0] > 0.0:
        dx[0] = (w[slots.MEASURED_JOINT] - x[0]) / p[0]
        w[slots.MEASURED_JOINT] = x[0]
        w[slots.MEASURED_JOINT_RATE] = dx[0]
    if p[1] > 0.0:
        dx[1] = (w[slots.MEASURED_MOTOR] - x[1]) / p[1]
        w[slots.MEASURED_MOTOR] = x[1]
        w[slots.MEASURED_MOTOR_RATE] = dx[1]


def _joint(m: Motion, _: Sequence[float]) -> Terms:
    return Terms(joint_error=column(-m.joint_velocity))


def _motor(m: Motion, _: Sequence[float]) -> Terms:
    return Terms(motor_error=column(-m.motor_velocity))


def _corrected(position: Array, a: Array, derivative: Callable[[Array, int], Array], _: float) -> Array:
    """The inverse of a first-order lag."""
    return np.asarray(position + float(a[0]) * derivative(position, 1))


def _joint_values(a: Array, _: Sequence[float], __: Base) -> dict[str, float]:
    return {"joint_lag": float(a[0])}


def _motor_values(a: Array, _: Sequence[float], __: Base) -> dict[str, float]:
    return {"motor_lag": float(a[0])}


EFFECT = Effect(
    code="FX402",
    name="sensor_lag",
    family="measurement",
    equation="measurement",
    term="tau s' + s = q in place of q",
    parameters=(
        EffectParameter("joint_lag", "taul", "time", 0.0, 1.0, 2e-3, 0.0),
        EffectParameter("motor_lag", "taum", "time", 0.0, 1.0, 0.0, 0.0),
    ),
    needs=("torque", "motor_position"),
    best_recording="A multisine or chirp up to the highest frequency of interest, with both encoders.",
    text=__doc__,
    laws=(Law(Stage.MEASUREMENT, _measurement),),
    states=(EffectState("joint", "joint_position"), EffectState("motor", "motor_position")),
    energy="exchanges",
    signatures=(
        Signature(_joint, _joint_values, sign=1, needs_joint=True, corrected=_corrected),
        Signature(_motor, _motor_values, sign=1, needs_joint=True, corrected=_corrected, corrects="motor"),
    ),
)
