"""The joint remembers which way it was twisted.

What it is
    Surfaces that slip a little inside gear, bearings and clamped joints take energy at every turn of the
    torsion, however slowly it turns. An element beside the spring, T = K d + z, that yields as z nears Fh:
    z' = (Fh/dh) (d' - |d'| sgn z |z/Fh|^m). With m = 1 it is Dahl's; the larger m, the more it is a spring that
    slips at Fh.

In the data
    Torque over torsion is a loop whose width does not depend on frequency. Motor and load equation have the
    same residual with opposite signs; it changes its sign within the length dh after the torsion turns round.

How to confirm
    Twist the joint slowly against a locked load, or compare the loop's width at two frequencies: equal for
    hysteresis, in proportion to frequency for damping.

What to do
    Add the loop to a simulation or to a torque estimate from torsion. A wider loop than a year ago points at
    bearings, clamping or lubricant. Which member of the family (Dahl, Maxwell slip, Bouc-Wen) it is, a log
    seldom tells.

Literature
    P. R. Dahl, "A solid friction model", The Aerospace Corporation, TOR-0158(3107-18)-1, 1968. M. Ruderman,
    F. Hoffmann, T. Bertram, "Modeling and identification of elastic robot joints with hysteresis and
    backlash", IEEE Trans. Industrial Electronics 56(10), 2009. W. D. Iwan, "A distributed-element model for
    hysteresis and its steady-state dynamic response", ASME J. Applied Mechanics 33(4), 1966.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit

from flexid_cli.effects import slots
from flexid_cli.effects.base import Array, Effect, EffectParameter, EffectState, Law, Stage
from flexid_cli.effects.forms import column
from flexid_cli.effects.motion import Base, Motion, Shape, Terms
from flexid_cli.effects.signature import Scale, Signature

# By the calibration seeds of the benchmark: K comes out wrong by 1 to 7 % of the loop's own stiffness where the
# loop is of another member of the family than the one that is fitted.
FORM_DOUBT = 0.05
# Beyond the largest exponent the element is a slider to a few per cent; steps of the integration over its length.
MOST_EXPONENT, STEP = 20.0, 0.1
LENGTHS = (0.5, 1.0, 2.0)  # over dh, of sliders that yield one after the other: an octave each


def _torque(w: Array, p: Array, x: Array, dx: Array, g: Array) -> None:
    rate = w[slots.TORSION_RATE]
    yielding = x[0]
    if p[0] > 0.0 and p[2] != 1.0 and abs(x[0]) < p[0]:
        yielding = math.copysign(p[0] * (abs(x[0]) / p[0]) ** p[2], x[0])
    dx[0] = (p[0] * rate - abs(rate) * yielding) / p[1]
    w[slots.JOINT_TORQUE] += x[0]
    g[0] = 1.0 if p[0] == 0.0 else rate


@njit(cache=True)
def _dahl(torsion: Array, length: float, out: Array) -> None:  # pragma: no cover
    state = 0.0
    for i in range(1, torsion.size):
        step = torsion[i] - torsion[i - 1]
        end = 1.0 if step > 0.0 else -1.0
        # Exact while the direction stays the same.
        state = end + (state - end) * np.exp(-abs(step) / length)
        out[i] = state


@njit(cache=True)
def _slip(torsion: Array, length: float, out: Array) -> None:  # pragma: no cover
    state = 0.0
    for i in range(1, torsion.size):
        state = min(1.0, max(-1.0, state + (torsion[i] - torsion[i - 1]) / length))
        out[i] = state


@njit(cache=True)
def _yielding(torsion: Array, length: float, exponent: float, out: Array) -> None:  # pragma: no cover
    state = 0.0
    for i in range(1, torsion.size):
        step = (torsion[i] - torsion[i - 1]) / length
        parts = 1 + int(abs(step) * exponent / STEP)
        step /= parts
        for _ in range(parts):
            # Heun's rule: the state nears its bound as an exponential of rate ``exponent``.
            first = step - abs(step) * np.sign(state) * min(abs(state), 1.0) ** exponent
            ahead = state + first
            second = step - abs(step) * np.sign(ahead) * min(abs(ahead), 1.0) ** exponent
            state += 0.5 * (first + second)
        out[i] = state


def _dahl_columns(m: Motion, shape: Sequence[float]) -> Terms:
    state = np.zeros(m.torsion.size)
    _dahl(m.torsion, shape[0], state)
    return Terms(transmission=column(state))


def _slip_columns(m: Motion, shape: Sequence[float]) -> Terms:
    state = np.zeros(m.torsion.size)
    _slip(m.torsion, shape[0], state)
    return Terms(transmission=column(state))


def _sliders_columns(m: Motion, shape: Sequence[float]) -> Terms:
    states = np.zeros((len(LENGTHS), m.torsion.size))
    for length, state in zip(LENGTHS, states, strict=True):
        _slip(m.torsion, length * shape[0], state)
    return Terms(transmission=states.T)


def _yielding_columns(m: Motion, shape: Sequence[float]) -> Terms:
    state = np.zeros(m.torsion.size)
    _yielding(m.torsion, shape[0], shape[1], state)
    return Terms(transmission=column(state))


def _shapes(scale: Scale) -> Sequence[Shape]:
    low = max(2.0 * scale.deflection_noise, 0.01 * scale.deflection)
    return (Shape("hysteresis_length", low, 1.5 * scale.deflection, 10),)


def _yielding_shapes(scale: Scale) -> Sequence[Shape]:
    return (*_shapes(scale), Shape("hysteresis_exponent", 1.0, MOST_EXPONENT, 4))


def _values(a: Array, shape: Sequence[float], _: Base) -> dict[str, float]:
    exponent = {"hysteresis_exponent": shape[1]} if len(shape) > 1 else {}
    return {"hysteresis_torque": float(a[0]), "hysteresis_length": shape[0], **exponent}


def _sliders_values(a: Array, shape: Sequence[float], _: Base) -> dict[str, float]:
    """Torque of all sliders together, and the length of one slider of the same stiffness."""
    stiffness = float(a @ (1.0 / np.array(LENGTHS)))
    mean = float(a.sum()) / stiffness if stiffness > 0.0 else 1.0
    return {"hysteresis_torque": float(a.sum()), "hysteresis_length": mean * shape[0]}


EFFECT = Effect(
    code="FX204",
    name="hysteresis",
    family="transmission",
    equation="transmission",
    term="z in T, z' = (Fh/dh) (d' - |d'| sgn z |z/Fh|^m)",
    parameters=(
        EffectParameter("hysteresis_torque", "Fh", "torque", 0.0, 1e12, 15.0, 0.0),
        EffectParameter("hysteresis_length", "dh", "position", 1e-12, 10.0, 1e-3),
        EffectParameter("hysteresis_exponent", "m", "ratio", 1.0, 1000.0, 1.0),
    ),
    needs=("torque", "motor_position"),
    best_recording="Slow and fast motions of equal torque with many turns of the torsion, both encoders.",
    text=__doc__,
    laws=(Law(Stage.TRANSMISSION, _torque),),
    states=(EffectState("z"),),
    guards=1,
    signatures=(
        Signature(_dahl_columns, _values, _shapes, sign=1, form_doubt=FORM_DOUBT),
        Signature(_slip_columns, _values, _shapes, sign=1, needs_joint=True, form_doubt=FORM_DOUBT),
        Signature(
            _sliders_columns, _sliders_values, _shapes, sign=1, needs_joint=True, form_doubt=FORM_DOUBT
        ),
        Signature(
            _yielding_columns, _values, _yielding_shapes, sign=1, motor_alone=True, form_doubt=FORM_DOUBT
        ),
    ),
)
