"""How far each row can be trusted where noise turns a sign.

Coulomb friction follows the sign of a velocity. About a standstill the encoder's noise is of the size of the
velocity, and what it makes of the sign stands in the rows like noise that is there for a while: no stationary
spectrum holds it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from flexid_cli.diagnose.problem import Problem, Stretch

Array = NDArray[np.float64]

REPLICAS, SEED = 4, 20010526
WINDOW_S = 0.2  # over which the noise's power is averaged


def trusted(problem: Problem) -> Problem:
    """The problem with every row weighted by what noise in the signs adds to it."""
    rng = np.random.default_rng(SEED)
    draws = [_sign_noise(problem, rng) for _ in range(REPLICAS)]
    width = max(1, round(2.0 * problem.band_hz * WINDOW_S))
    power = [np.mean(np.square(rows), axis=0) for rows in zip(*draws, strict=True)]
    trust = [1.0 / np.sqrt(1.0 + _smoothed(p, width)) for p in power]
    return problem.at(problem.base, trust=trust)


def _sign_noise(problem: Problem, rng: np.random.Generator) -> list[Array]:
    """What one more draw of the signals' noise makes of the signs, shape (equations, rows), by stretch."""
    b, out = problem.base, []
    for s, m, w in zip(problem.stretches, problem.motions, problem.weights, strict=True):
        noisy = problem.motion(_with_noise(s, problem, rng))
        motor = b.FSm * (noisy.motor_sign - m.motor_sign)
        load = b.FS * (noisy.joint_sign - m.joint_sign)
        parts = [motor, load] if problem.both else [problem.through(s, motor) + load]
        out.append(w.apply([s.spectrum(x) for x in parts])[:, :, 0])
    return out


def _with_noise(s: Stretch, problem: Problem, rng: np.random.Generator) -> Stretch:
    def noise(sigma: float) -> Array:
        return np.asarray(sigma * rng.standard_normal(s.torque.size))

    segment = replace(
        s.segment,
        torque=s.torque + noise(problem.noise.torque),
        motor_position=s.motor + noise(problem.noise.motor_position),
        joint_position=s.joint + noise(problem.noise.joint_position) if problem.both else None,
    )
    return Stretch(segment, s.rate_hz, problem.band_hz)


def _smoothed(power: Array, width: int) -> Array:
    """Moving average along the rows; at the ends over what there is."""
    kernel = np.ones(min(width, power.shape[1]))
    there = np.convolve(np.ones(power.shape[1]), kernel, "same")
    return np.asarray([np.convolve(p, kernel, "same") / there for p in power], dtype=np.float64)
