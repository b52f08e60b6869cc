"""The torque acts later than the record says.

What it is
    The current loop needs time to follow its command: a first-order lag between the recorded and the acting
    torque. A fieldbus cycle between torque and position looks nearly the same.

In the data
    The motor equation's residual follows the torque's rate of change: its phase against the torque grows in
    proportion to frequency, its size with it.

How to confirm
    Compare the command with the measured current, or the recorded current with a current probe. A second
    recording at another sampling rate shows whether the time is a lag (stays) or a cycle (changes with the
    rate).

What to do
    Record the measured current instead of the command, or give the signal's delay in the configuration.
    Without a joint encoder a lag cannot be told from damping in the joint.

Literature
    W. Leonhard, "Control of electrical drives", Springer (current loop as a first-order lag).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from flexid_cli.effects import slots
from flexid_cli.effects.base import Array, Effect, EffectParameter, EffectState, Law, Stage
from flexid_cli.effects.forms import column, lagged
from flexid_cli.effects.motion import Base, Motion, Shape, Terms
from flexid_cli.effects.signature import Scale, Signature


def _torque(w: Array, p: Array, x: Array, dx: Array, _g: Array) -> None:
    if p[0] > 0.0:
        dx[0] = (w[slots.TORQUE] - x[0]) / p[0]
        w[slots.TORQUE] = x[0]
    else:
        dx[0] = 0.0


def _command(torque: Array, rate_hz: float, values: Mapping[str, float]) -> Array:
    """Command that a first-order lag turns into this torque."""
    return torque + values["lag"] * np.gradient(torque) * rate_hz


def _columns(m: Motion, shape: Sequence[float]) -> Terms:
    return Terms(motor=column(m.limited_torque - lagged(m.limited_torque, shape[0], m.period_s)))


def _shapes(scale: Scale) -> Sequence[Shape]:
    return (Shape("lag", 0.15 * scale.period_s, 1.0 / scale.resonance_hz, 15),)


def _values(_: Array, shape: Sequence[float], __: Base) -> dict[str, float]:
    return {"lag": shape[0]}


EFFECT = Effect(
    code="FX108",
    name="actuator_lag",
    family="motor",
    equation="motor",
    term="Gm - tau Ga' in place of Gm, Ga the acting torque",
    parameters=(EffectParameter("lag", "tau", "time", 0.0, 1.0, 2e-3, 0.0),),
    needs=("torque", "motor_position"),
    best_recording="A multisine or chirp well above the first resonance, sampled fast.",
    text=__doc__,
    laws=(Law(Stage.LAG, _torque),),
    states=(EffectState("acting_torque"),),
    energy="exchanges",
    command=_command,
    signatures=(Signature(_columns, _values, _shapes, fixed=1.0),),
)
