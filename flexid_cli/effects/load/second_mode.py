"""The load itself bends.

What it is
    A part of the load (arm, tool, payload) hangs on a spring of its own: a second resonance above the first.
    JL is what is left of the inertia without that part.

In the data
    The load equation's residual is a peak in frequency, at the second mode, whatever the amplitude. Below it
    the part moves along and looks like inertia.

How to confirm
    Strike the arm and listen, or put an accelerometer at its end. Another payload or posture moves the peak,
    another amplitude does not.

What to do
    Keep the controller's bandwidth and the excitation below the peak, or use a notch filter; for simulation
    take the three-mass model. A peak that falls over time points at a loose or cracked part.

Literature
    E. Wernholt, S. Gunnarsson, "Nonlinear identification of a physically parameterized robot model", IFAC
    SYSID, 2006 (three masses).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexid_cli.effects import slots
from flexid_cli.effects.base import Array, Effect, EffectParameter, EffectState, Law, Stage
from flexid_cli.effects.forms import column, resonant
from flexid_cli.effects.motion import Base, Motion, Shape, Terms
from flexid_cli.effects.signature import Scale, Signature


def _torque(w: Array, p: Array, x: Array, dx: Array, _g: Array) -> None:
    if p[0] > 0.0:
        torque = p[1] * (x[0] - w[slots.JOINT_POSITION]) + p[2] * (x[1] - w[slots.JOINT_VELOCITY])
        w[slots.LOAD_TORQUE] -= torque
        dx[0] = x[1]
        dx[1] = -torque / p[0]
    else:
        dx[0] = 0.0
        dx[1] = 0.0


MOST_INERTIA = 1.1  # of the load's, which before the effect is found is that of both


def _columns(m: Motion, shape: Sequence[float]) -> Terms:
    return Terms(load=column(resonant(m.joint_acceleration, shape[0], shape[1], m.period_s)))


def _shapes(scale: Scale) -> Sequence[Shape]:
    return (
        # A lightly damped mode between two frequencies is met by none of them unless the damping's points overlap.
        Shape("frequency", 0.2 * scale.resonance_hz, _highest(scale), 25),
        Shape("damping_ratio", 0.01, 0.7, 4),
    )


def _shapes_alone(scale: Scale) -> Sequence[Shape]:
    """With the motor alone a mode that is damped strongly stands in for the transmission's damping."""
    return (
        Shape("frequency", 0.3 * scale.resonance_hz, _highest(scale), 22),
        Shape("damping_ratio", 0.01, 0.3, 3),
    )


def _highest(scale: Scale) -> float:
    return min(1.3 * scale.band_hz, 0.45 / scale.period_s)


def _values(a: Array, shape: Sequence[float], _: Base) -> dict[str, float]:
    inertia = float(a[0])
    w = 2.0 * np.pi * shape[0]
    stiffness = inertia * w**2
    return {
        "second_inertia": inertia,
        "second_stiffness": stiffness,
        "second_damping": 2.0 * shape[1] * w * inertia,
    }


def _tied(a: Array, _: Sequence[float], base: Base) -> str:
    """A resonance far above the band is a curve that a negative load inertia and a larger second one make, too."""
    return "the load would keep no inertia of its own" if float(a[0]) > MOST_INERTIA * base.JL else ""


EFFECT = Effect(
    code="FX303",
    name="second_mode",
    family="load",
    equation="load",
    term="-K2 (q2 - q) - D2 (q2' - q') with J2 q2'' = -K2 (q2 - q) - D2 (q2' - q')",
    parameters=(
        EffectParameter("second_inertia", "J2", "inertia", 0.0, 1e9, 8.0, 0.0),
        EffectParameter("second_stiffness", "K2", "stiffness", 0.0, 1e15, 40000.0),
        EffectParameter("second_damping", "D2", "viscous", 0.0, 1e12, 20.0),
    ),
    needs=("torque", "motor_position"),
    best_recording="A multisine or chirp that reaches beyond the second resonance, sampled fast.",
    text=__doc__,
    laws=(Law(Stage.LOAD, _torque),),
    states=(EffectState("position", "joint_position"), EffectState("velocity", "joint_velocity")),
    signatures=(
        Signature(_columns, _values, _shapes, sign=1, tied=_tied, needs_joint=True),
        Signature(_columns, _values, _shapes_alone, sign=1, tied=_tied, motor_alone=True),
    ),
)
