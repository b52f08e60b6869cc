"""The joint encoder's stamps are late (or early) against the motor's.

What it is
    The two encoders are read at different instants, often by one cycle of the bus, but stamped as one. A
    value of the joint encoder stamped t was taken at t - skew.

In the data
    Both equations have a residual in proportion to K q': the torsion shows a part that follows the velocity.
    The torsion is not zero at constant speed without torque.

How to confirm
    Move at constant speed in both directions: the difference of the encoders jumps by twice speed times skew.
    Friction's torsion does not grow with the speed, a skew's does.

What to do
    Give the signal's delay_s in the configuration, or read both encoders in one cycle. Damping in the joint
    looks similar: exclude the skew first.

Literature
    L. Ljung, "System identification: theory for the user", Prentice Hall, 1999, chapter on preprocessing of
    data.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import factorial

from flexid_cli.effects import slots
from flexid_cli.effects.base import Array, Effect, EffectParameter, Law, Stage
from flexid_cli.effects.forms import column
from flexid_cli.effects.motion import Base, Motion, Terms
from flexid_cli.effects.signature import Signature


def _measurement(w: Array, p: Array, _x: Array, _dx: Array, _g: Array) -> None:
    w[slots.JOINT_DELAY] += p[0]


def _columns(m: Motion, _: Sequence[float]) -> Terms:
    return Terms(joint_error=column(-m.joint_velocity))


def _corrected(joint: Array, a: Array, derivative: Callable[[Array, int], Array], _: float) -> Array:
    """The position at the stamp: Taylor's series, which three terms end for skews of a few samples."""
    skew = float(a[0])
    terms = [skew**k / factorial(k) * derivative(joint, k) for k in (1, 2, 3)]
    return joint + sum(terms)


def _values(a: Array, _: Sequence[float], __: Base) -> dict[str, float]:
    return {"skew": float(a[0])}


EFFECT = Effect(
    code="FX401",
    name="clock_skew",
    family="measurement",
    equation="measurement",
    term="q(t - skew) in place of q(t)",
    parameters=(EffectParameter("skew", "skew", "time", -1.0, 1.0, 1e-3, 0.0),),
    needs=("torque", "motor_position", "joint_position"),
    best_recording="Constant speeds in both directions, several of them, with both encoders.",
    text=__doc__,
    laws=(Law(Stage.MEASUREMENT, _measurement),),
    energy="conserves",
    signatures=(Signature(_columns, _values, needs_joint=True, corrected=_corrected),),
)
