"""The joint gets stiffer (or softer) the more it is twisted.

What it is
    More of the teeth, balls or belts carry the load as the torque grows, so that the stiffness is no
    constant: a cubic term, or a second stiffness beyond a knee. Data sheets of strain wave gears give three
    stiffnesses.

In the data
    Torque over torsion is one curve, odd and without a loop, steeper at large torque. Motor and load equation
    have the same residual with opposite signs. The resonance rises with the amplitude.

How to confirm
    Repeat at amplitudes that differ by three or more. A linear fit's K rises with the amplitude, at every
    frequency. In a gap or a soft zone instead, the deviation sits at small torque.

What to do
    Use the curve in simulation and control; compare with the data sheet. A knee that moves towards lower
    torque over time points at wear.

Literature
    T. D. Tuttle, W. P. Seering, IEEE Trans. Robotics and Automation 12(3), 1996. H. D. Taghirad, P. R.
    Belanger, "Modeling and parameter identification of harmonic drive systems", ASME J. Dyn. Sys. Meas.
    Control 120(4), 1998.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexid_cli.effects import slots
from flexid_cli.effects.base import Array, Effect, EffectParameter, Law, Stage
from flexid_cli.effects.forms import column
from flexid_cli.effects.motion import Base, Motion, Shape, Terms
from flexid_cli.effects.signature import Scale, Signature


def _torque(w: Array, p: Array, _x: Array, _dx: Array, g: Array) -> None:
    torsion = w[slots.SPRING_TORSION]
    w[slots.JOINT_TORQUE] += p[0] * torsion * torsion * torsion
    g[0] = 1.0
    g[1] = 1.0
    if p[1] != 0.0:
        g[0] = torsion - p[2]
        g[1] = torsion + p[2]
        if torsion > p[2]:
            w[slots.JOINT_TORQUE] += p[1] * (torsion - p[2])
        elif torsion < -p[2]:
            w[slots.JOINT_TORQUE] += p[1] * (torsion + p[2])


def _cubic(m: Motion, _: Sequence[float]) -> Terms:
    return Terms(transmission=column(m.torsion**3))


def _cubic_values(a: Array, _: Sequence[float], __: Base) -> dict[str, float]:
    return {"cubic_stiffness": float(a[0])}


def _knee(m: Motion, shape: Sequence[float]) -> Terms:
    return Terms(transmission=column(m.torsion - np.clip(m.torsion, -shape[0], shape[0])))


def _knees(scale: Scale) -> Sequence[Shape]:
    return (Shape("knee_torsion", 0.1 * scale.deflection, 0.9 * scale.deflection, 8),)


def _knee_values(a: Array, shape: Sequence[float], _: Base) -> dict[str, float]:
    return {"knee_stiffness": float(a[0]), "knee_torsion": shape[0]}


def _knee_tied(a: Array, _: Sequence[float], base: Base) -> str:
    return (
        ""
        if 0.35 * (base.K + float(a[0])) < base.K
        else "the spring below its knee would be nearly free, a gap"
    )


EFFECT = Effect(
    code="FX203",
    name="hardening_stiffness",
    family="transmission",
    equation="transmission",
    term="K3 d^3 + K2 (d beyond the knee) in T",
    parameters=(
        EffectParameter("cubic_stiffness", "K3", "cubic_stiffness", -1e20, 1e20, 2e7, 0.0),
        EffectParameter("knee_stiffness", "K2", "stiffness", -1e12, 1e12, 0.0, 0.0),
        EffectParameter("knee_torsion", "d1", "position", 0.0, 10.0, 0.01),
    ),
    needs=("torque", "motor_position"),
    best_recording="The same motion at amplitudes that differ by three or more, up to the largest permitted torque.",
    text=__doc__,
    laws=(Law(Stage.TRANSMISSION, _torque),),
    guards=2,
    energy="conserves",
    signatures=(
        Signature(_cubic, _cubic_values, sign=1),
        Signature(_knee, _knee_values, _knees, sign=1, tied=_knee_tied),
    ),
)
