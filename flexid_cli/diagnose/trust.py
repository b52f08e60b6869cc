"""How far each row can be trusted where noise turns a sign, or where an effect amplifies it.

Coulomb friction follows the sign of a velocity. About a standstill the encoder's noise is of the size of the
velocity, and what it makes of the sign stands in the rows like noise that is there for a while: no stationary
spectrum holds it. Nor does it hold what an effect makes of the noise: a joint that stiffens with its torsion passes
more of the encoders' noise the more it is twisted, and a damper passes its rate.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from flexid_cli.diagnose.problem import Effects, Problem
from flexid_cli.diagnose.rows import Weights, motor_only_noise, two_encoder_noise
from flexid_cli.diagnose.stretch import SMOOTH_BAND, Stretch
from flexid_cli.effects.motion import Motion
from flexid_cli.estimate.budget import NoiseLevels

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

REPLICAS, SEED = 4, 20010526
REPLICAS_BOTH = 2  # both encoders: little is left that turns a sign
REPLICAS_SLOW, SLOW_SEED = 8, 20010527  # of errors of counting
WINDOW_S = 0.2  # over which the noise's power is averaged
# Counts show in the steps from sample to sample: nearly all are a whole number of the smallest.
MOST_COUNTS, LEAST_STEPS, WHOLE, MOSTLY = 100.0, 100, 0.02, 0.98
OVER_COUNTS = 0.4  # noise over a count, which is 0.29 of counts alone


def trusted(problem: Problem, effects: Effects = ()) -> Problem:
    """The problem with every row weighted by what noise adds to it through signs and ``effects``."""
    rng = np.random.default_rng(SEED)
    width = max(1, round(2.0 * problem.band_hz * WINDOW_S))
    added = [_added_noise(problem, effects, rng) for _ in range(REPLICAS_BOTH if problem.both else REPLICAS)]
    slow = [_slow_noise(problem, s, w) for s, w in zip(problem.stretches, problem.weights, strict=True)]
    power = [np.mean(p, axis=0) + more for *p, more in zip(*added, slow, strict=True)]
    trust = [1.0 / np.sqrt(1.0 + np.maximum(_smoothed(p, width), 0.0)) for p in power]
    return problem.at(problem.base, trust=trust)


def _added_noise(problem: Problem, effects: Effects, rng: np.random.Generator) -> list[Array]:
    """Power that one more draw of the signals' noise adds to each row, shape (equations, rows), by stretch."""
    out = []
    for s, m, w in zip(problem.stretches, problem.motions, problem.weights, strict=True):
        noisy = _with_noise(s, problem, rng)
        moved = problem.motion(noisy)
        power = w.plain(_sign_noise(problem, s, m, moved))[:, :, 0] ** 2
        if effects:
            joint = noisy.joint - s.joint if problem.both else None
            errors = noisy.torque - s.torque, noisy.motor - s.motor, joint
            known = w.plain(_known_noise(problem, s, *errors))[:, :, 0]
            through = [(columns(moved).since(columns(m)), amplitudes) for columns, amplitudes in effects]
            changed = sum((w.plain(problem.place(s, m, t)) @ amplitudes for t, amplitudes in through), known)
            power += changed**2 - known**2
        out.append(power)
    return out


def _sign_noise(problem: Problem, s: Stretch, m: Motion, moved: Motion) -> list[Complex | None]:
    """What noise makes of the signs, by equation."""
    b = problem.base
    motor = b.FSm * (moved.motor_sign - m.motor_sign)
    load = b.FS * (moved.joint_sign - m.joint_sign)
    return [s.spectrum(x) for x in ([motor, load] if problem.both else [problem.through(s, motor) + load])]


def _slow_noise(problem: Problem, s: Stretch, w: Weights) -> Array | float:
    """Power of the encoders' errors of counting in each row beyond white noise's; zero without counts."""
    noise, zero = problem.noise, np.zeros(s.torque.size)
    motor = noise.motor_position if count_of(s.motor, noise.motor_position) else 0.0
    joint = noise.joint_position if problem.both and count_of(s.joint, noise.joint_position) else 0.0
    if motor == joint == 0.0:
        return 0.0
    rng, power = np.random.default_rng(SLOW_SEED), np.zeros(1)
    for _ in range(REPLICAS_SLOW):
        errors = (
            _counting(s, s.motor, motor, rng),
            _counting(s, s.joint, joint, rng) if problem.both else None,
        )
        power = power + w.plain(_known_noise(problem, s, zero, *errors))[:, :, 0] ** 2
    make = two_encoder_noise if problem.both else motor_only_noise
    white = make(problem.base, NoiseLevels(0.0, motor, joint), 2.0 * np.pi * w.taper.frequency_hz)
    usual = np.mean(np.einsum("fij,fjk,fik->fi", w.inverse, white, np.conj(w.inverse)).real, axis=0)
    return np.asarray(power / REPLICAS_SLOW - usual[:, None])


def _counting(s: Stretch, position: Array, sigma: float, rng: np.random.Generator) -> Array:
    """One more draw of an error of counting, along the motion that the counts show; zero where ``sigma`` is."""
    if sigma == 0.0:
        return np.zeros(position.size)
    return _encoder_noise(position, s.lowpass(_between_counts(position), SMOOTH_BAND), sigma, rng)


def _known_noise(
    problem: Problem, s: Stretch, torque: Array, motor: Array, joint: Array | None
) -> list[Complex | None]:
    """What the baseline makes of errors of the signals, which the rows' weights know of; with the sign of effects."""
    b = problem.base
    carried = b.Jm * s.derivative(motor, 2) + b.FVm * s.derivative(motor, 1) - torque
    if joint is None:
        load = b.JL * s.derivative(motor, 2) + b.FV * s.derivative(motor, 1)
        return [s.spectrum(problem.through(s, carried) + load)]
    spring = b.K * (motor - joint)
    load = b.JL * s.derivative(joint, 2) + b.FV * s.derivative(joint, 1)
    return [s.spectrum(carried + spring), s.spectrum(load - spring)]


def _with_noise(s: Stretch, problem: Problem, rng: np.random.Generator) -> Stretch:
    joint = None
    torque = _facing(s.torque) * problem.noise.torque * rng.standard_normal(s.torque.size)
    # With the motor alone no force tells what goes on within a count: a motion that stays in one errs all the same.
    counted = problem.both
    motor = _encoder_noise(s.motor, s.motor_smooth, problem.noise.motor_position, rng, counted=counted)
    if problem.both:
        joint = s.joint + _encoder_noise(s.joint, s.joint_smooth, problem.noise.joint_position, rng)
    segment = replace(
        s.segment, torque=s.torque + torque, motor_position=s.motor + motor, joint_position=joint
    )
    return s.like(segment)


def _encoder_noise(
    position: Array, smooth: Array, sigma: float, rng: np.random.Generator, *, counted: bool = True
) -> Array:
    """One more draw of an encoder's noise; of counts, where they are all there is of it and ``counted``.

    About a standstill counts follow each other slowly, and their error is slow: white noise has too little of that.
    """
    count, facing = count_of(position, sigma) if counted else 0.0, _facing(position)
    if count == 0.0:
        return np.asarray(facing * sigma * rng.standard_normal(position.size), dtype=np.float64)
    passed = facing * smooth + count * rng.random()
    return np.asarray(facing * (count * np.round(passed / count) - passed), dtype=np.float64)


def _between_counts(position: Array) -> Array:
    """The motion that counts show: half way where they change, straight from there to the next change."""
    changes = np.flatnonzero(np.diff(position))
    half_way = 0.5 * (position[changes] + position[changes + 1])
    return np.asarray(np.interp(np.arange(position.size), changes + 0.5, half_way), dtype=np.float64)


def _facing(x: Array) -> float:
    """Side of its mean on which a signal goes farthest: an axis that counts the other way has the same physics."""
    away = x - x.mean()
    return float(np.sign(away[int(np.argmax(np.abs(away)))])) or 1.0


def count_of(position: Array, sigma: float) -> float:
    """One count of an encoder whose noise of ``sigma`` is that of its counts; zero where it is not."""
    steps = np.abs(np.diff(position))
    steps = steps[(steps > sigma) & (steps < MOST_COUNTS * sigma)]
    if steps.size < LEAST_STEPS:
        return 0.0
    count = float(steps.min())
    whole = np.abs(steps / count - np.round(steps / count)) < WHOLE
    return count if np.mean(whole) > MOSTLY and sigma < OVER_COUNTS * count else 0.0


def _smoothed(power: Array, width: int) -> Array:
    """Moving average along the rows; at the ends over what there is."""
    kernel = np.ones(min(width, power.shape[1]))
    there = np.convolve(np.ones(power.shape[1]), kernel, "same")
    return np.asarray([np.convolve(p, kernel, "same") / there for p in power], dtype=np.float64)
