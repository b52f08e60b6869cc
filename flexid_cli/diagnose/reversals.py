"""Velocities about their reversals, from an encoder and the forces on its side together.

A reversal is sharper than any band in which an encoder's derivative is clean, and what is wrong about the sign of the
velocity there stands in the equation with all of the Coulomb friction. The forces know better: torque, spring and
friction give the acceleration, whose integral is good at high frequency, as the encoder is at low. An extended Kalman
smoother (Rauch, Tung and Striebel, AIAA J. 3 (1965) 1445) of one side's equation joins the two. How far the equation
can be trusted (what it lacks acts as noise) is chosen by the likelihood of the encoder's values.

Without a joint encoder the other end of the spring is where a load goes that the measured motor leads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from flexid_cli.diagnose.mean_sign import FINE, FULL, between
from flexid_cli.diagnose.problem import Effects, Problem
from flexid_cli.diagnose.stretch import Stretch
from flexid_cli.effects.motion import Motion
from flexid_cli.estimate.driven import friction_sign
from flexid_cli.signals.recording import Segment

Array = NDArray[np.float64]

DOUBTS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0)  # factors of the equation's noise


@dataclass(frozen=True)
class Side:
    """One side of the axis: J v' + D v + F tanh(v / w) + K q + known = force.

    Attributes
    ----------
    inertia, damping, stiffness, friction, width : float
        J, D, K, F, w.
    known : ndarray, shape (n,), or float
        What else the model holds.
    encoder, noise : float
        Noise of the position and of the equation, one sigma a sample.
    """

    inertia: float
    damping: float
    stiffness: float
    friction: float
    width: float
    known: Array | float
    encoder: float
    noise: float

    def smoothed(self, position: Array, force: Array, period_s: float) -> tuple[float, Array]:
        """Twice the negative logarithm of the positions' likelihood, and the velocity in `FINE` steps a period."""
        step = period_s / FINE
        axis = (self.inertia, self.damping, self.stiffness, max(self.friction, 0.0), self.width, step)
        given = between(force - self.known)
        loss, velocity = _smoothed(position, given, np.array(axis), self.encoder**2, FINE * self.noise**2)
        return float(loss), np.asarray(velocity, dtype=np.float64)

    def doubted(self, position: Array, force: Array, period_s: float) -> Side:
        """The same with as much noise of the equation as the encoder's values ask for."""
        best, least = self, np.inf
        for doubt in DOUBTS:
            trial = replace(self, noise=doubt * self.noise)
            loss, _ = trial.smoothed(position, force, period_s)
            if loss > least:
                break
            best, least = trial, loss
        return best


@dataclass(frozen=True)
class Reversals:
    """Smoother of the velocities of one stretch, and of the same stretch with other noise or less errors.

    Attributes
    ----------
    motor, load : Side
    zero, torsion : float
        Difference of the encoders where the spring carries nothing, and its mean in the stretch for which that holds:
        an error that is taken out of a position changes both.
    shift : float
        Periods by which the torque acts later than its stamp says.
    """

    motor: Side
    load: Side
    zero: float
    torsion: float
    shift: float

    def __call__(self, segment: Segment, rate_hz: float) -> tuple[Array, Array]:
        """Velocities of motor and joint, `FINE` steps a period."""
        sides = zip((self.motor, self.load), self._given(segment), strict=True)
        motor, load = (side.smoothed(*given, 1.0 / rate_hz)[1] for side, given in sides)
        return motor, load

    def doubted(self, segment: Segment, rate_hz: float) -> Reversals:
        """The same with as much noise of the equations as the encoders' values ask for."""
        sides = zip((self.motor, self.load), self._given(segment), strict=True)
        motor, load = (side.doubted(*given, 1.0 / rate_hz) for side, given in sides)
        return replace(self, motor=motor, load=load)

    def _given(self, segment: Segment) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """Position and force of either side; each encoder holds one end of the spring."""
        motor, joint = segment.motor_position, segment.joint_position
        if joint is None:
            raise ValueError("both encoders are needed")
        stiffness = self.motor.stiffness
        zero = self.zero + float(np.mean(motor - joint)) - self.torsion
        return (motor, delayed(segment.torque, self.shift) + stiffness * (joint + zero)), (
            joint,
            stiffness * (motor - zero),
        )


def delayed(torque: Array, periods: float) -> Array:
    """A torque that acts ``periods`` later than its stamps say, between them by straight lines."""
    if periods == 0.0:
        return torque
    at = np.arange(torque.size)
    return np.asarray(np.interp(at - periods, at, torque), dtype=np.float64)


@dataclass(frozen=True)
class MotorReversals:
    """Smoother of the motor's velocity in one stretch, where the motor has the only encoder.

    Attributes
    ----------
    motor : Side
    held : ndarray, shape (n,)
        Torque on the motor from what it does not carry itself: from the other end of the spring, and effects.
    shift : float
        Periods by which the torque acts later than its stamp says.
    """

    motor: Side
    held: Array
    shift: float

    def __call__(self, segment: Segment, rate_hz: float) -> tuple[Array]:
        """The motor's velocity, `FINE` steps a period."""
        force = delayed(segment.torque, self.shift) + self.held
        return (self.motor.smoothed(segment.motor_position, force, 1.0 / rate_hz)[1],)

    def doubted(self, segment: Segment, rate_hz: float) -> MotorReversals:
        """The same with as much noise of the equation as the encoder's values ask for."""
        force = delayed(segment.torque, self.shift) + self.held
        return replace(self, motor=self.motor.doubted(segment.motor_position, force, 1.0 / rate_hz))


def motor_sharpened(
    problem: Problem, held: Sequence[Array] | None = None, friction: float | None = None
) -> Problem:
    """The problem of the motor alone with reversals told by its encoder and the forces together.

    Parameters
    ----------
    problem : Problem
    held : sequence of ndarray, optional
        As in `MotorReversals`, by stretch; the baseline's unless given.
    friction : float, optional
        All friction that turns its sign at a reversal of the motor; the baseline's unless given.
    """
    b, noise = problem.base, problem.noise
    if problem.both or problem.rigid or noise.motor_position == 0.0:
        return problem
    if held is None:
        held = [b.K * problem.led_position(s) for s in problem.stretches]
    rate = problem.stretches[0].rate_hz
    size = float(np.sqrt(noise.torque**2 + problem.floor(rate)))
    total = b.FSm if friction is None else friction
    side = Side(b.Jm, b.FVm, b.K, total, b.motor_reversal, 0.0, noise.motor_position, size)
    stretches = [
        s.sharpened(MotorReversals(side, torque, problem.shift).doubted(s.segment, rate))
        for s, torque in zip(problem.recorded, held, strict=True)
    ]
    return problem.at(b, stretches=stretches)


def sharpened(problem: Problem, effects: Effects = (), friction: Sequence[float] | None = None) -> Problem:
    """The problem with reversals told by encoders and forces together.

    Parameters
    ----------
    problem : Problem
    effects : sequence of pairs
        What the model holds beside the baseline.
    friction : sequence of 2 floats, optional
        All friction that turns its sign at a reversal of the motor, of the load; the baseline's unless given.
    """
    b, noise = problem.base, problem.noise
    if not problem.both or noise.motor_position == 0.0 or noise.joint_position == 0.0:
        return problem
    rate = problem.stretches[0].rate_hz
    total = (b.FSm, b.FS) if friction is None else friction
    motor_noise = np.sqrt(noise.torque**2 + (b.K * noise.joint_position) ** 2 + problem.floor(rate))
    load_noise = np.sqrt((b.K * noise.motor_position) ** 2 + problem.floor(rate))
    stretches: list[Stretch] = []
    for s, recorded, m in zip(problem.stretches, problem.recorded, problem.motions, strict=True):
        motor, load = _held(m, effects)
        # Friction of effects that turns with the sign is the smoother's to tell.
        motor = motor - (total[0] - b.FSm) * m.motor_sign
        load = load - (total[1] - b.FS) * m.joint_sign
        sides = (
            Side(
                b.Jm, b.FVm, b.K, total[0], b.motor_reversal, motor, noise.motor_position, float(motor_noise)
            ),
            Side(b.JL, b.FV, b.K, total[1], b.load_reversal, load, noise.joint_position, float(load_noise)),
        )
        torsion = float(np.mean(s.motor - s.joint))
        smoother = Reversals(*sides, b.torsion_zero, torsion, problem.shift).doubted(s.segment, rate)
        stretches.append(recorded.sharpened(smoother))
    return problem.at(b, stretches=stretches, applied=problem.applied)


def _held(m: Motion, effects: Effects) -> tuple[Array, Array]:
    """Torque that effects take from the motor and from the load."""
    motor, load = np.zeros(m.time_s.size), np.zeros(m.time_s.size)
    for columns, amplitudes in effects:
        terms = columns(m)
        if terms.motor is not None:
            motor += terms.motor @ amplitudes
        if terms.load is not None:
            load += terms.load @ amplitudes
        if terms.transmission is not None:
            motor += terms.transmission @ amplitudes
            load -= terms.transmission @ amplitudes
    return motor, load


@njit(cache=True, nogil=True)
def _smoothed(position, force, axis, encoder, torque):  # type: ignore[no-untyped-def] # pragma: no cover
    """Loss of the encoder's values and the smoothed velocity; steps by the trapezoidal rule, friction implicit."""
    D, K, F, w, T = axis[1:]
    n, h = force.size, 0.5 * T / axis[0]
    x, P = np.empty((n, 2)), np.empty((n, 3))  # filtered, as P00, P01, P11
    ahead, spread, A = np.empty((n, 2)), np.empty((n, 3)), np.empty((n, 4))
    x[0, 0], x[0, 1] = position[0], 0.0
    P[0, 0], P[0, 1], P[0, 2] = encoder, 0.0, encoder / (FINE * T) ** 2
    loss = 0.0
    for i in range(1, n):
        q, v = x[i - 1]
        s = np.tanh(v / w) if abs(v) < FULL * w else np.sign(v)
        a = 1.0 + h * (D + 0.5 * K * T)
        free = v + h * (force[i - 1] + force[i] - 2.0 * K * q - (0.5 * K * T + D) * v - F * s)
        middle, reach = free / a, h * F / a
        if abs(middle) > reach + FULL * w:  # far from a reversal
            sign = 1.0 if middle > 0.0 else -1.0
        else:
            sign = friction_sign(middle, v, reach, w)
        later = (free - h * F * sign) / a
        b = a + h * F * (1.0 - sign * sign) / w
        vq = -2.0 * h * K / b
        vv = (1.0 - h * (0.5 * K * T + D + F * (1.0 - s * s) / w)) / b
        qq, qv = 1.0 + 0.5 * T * vq, 0.5 * T * (1.0 + vv)
        push = (2.0 * h / b) ** 2 * torque
        p0, p1, p2 = P[i - 1]
        r0, r1 = qq * p0 + qv * p1, qq * p1 + qv * p2
        s0, s1 = vq * p0 + vv * p1, vq * p1 + vv * p2
        c0 = r0 * qq + r1 * qv + 0.25 * T * T * push
        c1 = r0 * vq + r1 * vv + 0.5 * T * push
        c2 = s0 * vq + s1 * vv + push
        ahead[i, 0], ahead[i, 1] = q + 0.5 * T * (v + later), later
        spread[i, 0], spread[i, 1], spread[i, 2] = c0, c1, c2
        A[i, 0], A[i, 1], A[i, 2], A[i, 3] = qq, qv, vq, vv
        if i % FINE:
            x[i], P[i] = ahead[i], spread[i]
            continue
        error, S = position[i // FINE] - ahead[i, 0], c0 + encoder
        loss += np.log(S) + error * error / S
        x[i, 0], x[i, 1] = ahead[i, 0] + c0 / S * error, later + c1 / S * error
        P[i, 0], P[i, 1], P[i, 2] = c0 - c0 * c0 / S, c1 - c0 * c1 / S, c2 - c1 * c1 / S
    for i in range(n - 2, -1, -1):
        c0, c1, c2 = spread[i + 1]
        determinant = c0 * c2 - c1 * c1
        e0, e1 = x[i + 1, 0] - ahead[i + 1, 0], x[i + 1, 1] - ahead[i + 1, 1]
        g0, g1 = (c2 * e0 - c1 * e1) / determinant, (c0 * e1 - c1 * e0) / determinant
        qq, qv, vq, vv = A[i + 1]
        g0, g1 = qq * g0 + vq * g1, qv * g0 + vv * g1
        x[i, 0] += P[i, 0] * g0 + P[i, 1] * g1
        x[i, 1] += P[i, 1] * g0 + P[i, 2] * g1
    return loss, x[:, 1].copy()
