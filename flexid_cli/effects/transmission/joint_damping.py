"""Damping in the joint, parallel to its spring.

What it is
    Material, grease and bolted joints of the transmission take energy in proportion to how fast the torsion
    changes: T = K d + D d'.

In the data
    Torque over torsion is an ellipse whose width grows with frequency. Motor and load equation have the same
    residual with opposite signs; the resonance is lower and wider than friction alone explains.

How to confirm
    Compare the loop's width at two frequencies: in proportion for damping, equal for hysteresis. The skew of
    one encoder's clock does the same with another sign on the two equations' inertia terms: measure the delay
    first.

What to do
    Add D to the model; it matters for the controller's gains near the resonance. It is no fault.

Literature
    M. W. Spong, "Modeling and control of elastic joint robots", ASME J. Dyn. Sys. Meas. Control 109, 1987. T.
    D. Tuttle, W. P. Seering, "A nonlinear model of a harmonic drive gear transmission", IEEE Trans. Robotics
    and Automation 12(3), 1996.
"""

from __future__ import annotations

from collections.abc import Sequence

from flexid_cli.effects import slots
from flexid_cli.effects.base import Array, Effect, EffectParameter, Law, Stage
from flexid_cli.effects.forms import column
from flexid_cli.effects.motion import Base, Motion, Terms
from flexid_cli.effects.signature import Signature


def _torque(w: Array, p: Array, _x: Array, _dx: Array, _g: Array) -> None:
    w[slots.JOINT_TORQUE] += p[0] * w[slots.TORSION_RATE]


def _columns(m: Motion, _: Sequence[float]) -> Terms:
    return Terms(transmission=column(m.torsion_rate))


def _values(a: Array, _: Sequence[float], __: Base) -> dict[str, float]:
    return {"joint_damping": float(a[0])}


EFFECT = Effect(
    code="FX201",
    name="joint_damping",
    family="transmission",
    equation="transmission",
    term="D d' in T",
    parameters=(EffectParameter("joint_damping", "D", "viscous", 0.0, 1e12, 60.0, 0.0),),
    needs=("torque", "motor_position"),
    best_recording="A multisine around the first resonance, with both encoders.",
    text=__doc__,
    laws=(Law(Stage.TRANSMISSION, _torque),),
    signatures=(Signature(_columns, _values, sign=1),),
)
