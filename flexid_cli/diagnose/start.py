"""Where the fits begin: band, noise, a first linearisation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from flexid_cli.diagnose.basis import solve
from flexid_cli.diagnose.fitter import Fitter
from flexid_cli.diagnose.problem import SHORTEST_S, SMOOTH_BAND, Problem, Stretch
from flexid_cli.effects.motion import Base
from flexid_cli.errors import DataError
from flexid_cli.estimate.band import usable_band
from flexid_cli.estimate.budget import NoiseLevels, noise_levels
from flexid_cli.pipeline.columns import reversal
from flexid_cli.signals.recording import Recording

Array = NDArray[np.float64]

HIGHEST_BAND = 0.2  # of the sampling rate
FIRST_WIDTH = 0.004  # of the highest speed
SCAN_POINTS, SCAN_STEPS = 14, 4
SCAN_LOW = 8.0  # lowest locked-motor frequency looked at, cycles in the record


def first_problem(recording: Recording, gravity: float, gear_ratio: float, fitter: Fitter) -> Problem:
    """The record in its band, linearised where a simple fit puts it.

    Raises
    ------
    DataError
        The record is too short, or shows no flexible axis.
    """
    both = recording.has_joint_position
    rate = recording.sample_rate_hz
    band = min(usable_band(recording, joint=both), HIGHEST_BAND * rate)
    segments = [s for s in recording.segments if s.samples > SHORTEST_S * rate]
    if not segments:
        raise DataError(
            f"no gap-free stretch of the recording is longer than {SHORTEST_S:g} s",
            "record longer, or permit longer gaps with signals.time.max_gap_s",
        )
    stretches = [Stretch(s, rate, band) for s in segments]
    speed = float(np.quantile(np.abs(np.concatenate([s.motor_velocity for s in stretches])), 0.98))
    width = FIRST_WIDTH * speed
    base = (_both_base if both else _rigid_base)(stretches, width)
    problem = Problem(
        stretches, base, noise_levels(recording), band, gravity=gravity, gear_ratio=gear_ratio,
        duration_s=recording.duration_s, both=both, hold=fitter.holds[0],
    )  # fmt: skip
    if not both:
        problem = _scanned(problem, fitter)
    return _with_torque_noise(fitter.relax(problem, rounds=1).problem)


def _both_base(stretches: list[Stretch], width: float) -> Base:
    """Motor equation and load equation, each by plain least squares in the smooth band."""
    motor, load = [], []
    for s in stretches:
        torsion, one = s.motor_smooth - s.joint_smooth, np.ones(s.torque.size)
        velocity = s.derivative(s.joint_smooth, 1)
        cut = slice(50, -50)
        motor.append(
            np.column_stack(
                [
                    s.lowpass(s.torque, SMOOTH_BAND),
                    s.derivative(s.motor_smooth, 2),
                    torsion,
                    s.motor_velocity,
                    np.tanh(s.motor_velocity / width),
                    one,
                ]
            )[cut]
        )
        # Torsion explained by the load's motion: the other way round noise would draw K to zero.
        load.append(
            np.column_stack(
                [
                    torsion,
                    s.derivative(s.joint_smooth, 2),
                    velocity,
                    np.tanh(velocity / width),
                    one,
                    np.cos(s.joint_smooth),
                    np.sin(s.joint_smooth),
                ]
            )[cut]
        )
    M, L = np.vstack(motor), np.vstack(load)
    Jm, K, FVm, FSm, _ = solve(M[:, 1:], M[:, 0]).coefficients
    inertia, viscous, coulomb, *_ = solve(L[:, 1:], L[:, 0]).coefficients
    if not (Jm > 0.0 and K > 0.0 and inertia > 0.0):
        raise DataError(
            "the motor and joint positions do not show a flexible axis: inertia or stiffness come out negative",
            "check the signs and units of torque and positions with `flexid identify`, and excite the axis around its"
            " first resonance",
        )
    return Base(
        Jm=float(Jm), K=float(K), JL=float(K * inertia), FVm=float(FVm), FSm=float(FSm), FV=float(K * viscous),
        FS=float(K * coulomb), motor_reversal=width, load_reversal=width,
    )  # fmt: skip


def _rigid_base(stretches: list[Stretch], width: float) -> Base:
    """Total inertia and friction, split evenly; the stiffness is scanned for."""
    rows = []
    for s in stretches:
        acceleration = s.derivative(s.motor_smooth, 2)
        friction = np.tanh(s.motor_velocity / width)
        columns = [
            s.lowpass(s.torque, SMOOTH_BAND),
            acceleration,
            s.motor_velocity,
            friction,
            np.ones(s.torque.size),
        ]
        rows.append(np.column_stack(columns)[50:-50])
    M = np.vstack(rows)
    J, FV, FS, _ = (float(x) for x in solve(M[:, 1:], M[:, 0]).coefficients)
    if J <= 0.0:
        raise DataError(
            "the motor's acceleration does not follow the torque: the inertia comes out negative",
            "check the sign and unit of the torque signal with `flexid identify`",
        )
    FV, FS = max(FV, 0.0), max(FS, 0.0)
    return Base(
        Jm=0.5 * J, K=1.0, JL=0.5 * J, FVm=0.5 * FV, FSm=0.7 * FS, FV=0.5 * FV, FS=0.3 * FS,
        motor_reversal=width, load_reversal=width,
    )  # fmt: skip


def _scanned(problem: Problem, fitter: Fitter) -> Problem:
    """The best of a series of locked-motor frequencies, each followed for a few Gauss-Newton steps."""
    base, trials = problem.base, []
    low = SCAN_LOW / problem.duration_s
    for frequency in np.geomspace(max(low, 0.02 * problem.band_hz), 0.8 * problem.band_hz, SCAN_POINTS):
        trial = problem.at(replace(base, K=base.JL * (2.0 * np.pi * float(frequency)) ** 2))
        for _ in range(SCAN_STEPS):
            trial = trial.at(fitter.moved(fitter.fit(trial)))
        trials.append((fitter.fit(trial).cost, trial))
    return min(trials, key=lambda t: t[0])[1]


def _with_torque_noise(problem: Problem) -> Problem:
    """Raise the torque's noise to what stands in the motor equation just above the band.

    A current's noise is seldom white; that of the encoders is taken off by its known shape.
    """
    from scipy.signal import welch

    s = max(problem.stretches, key=lambda s: s.torque.size)
    b, noise = problem.base, problem.noise
    rest = s.torque - b.Jm * s.derivative(s.motor, 2) - b.FVm * s.derivative(s.motor, 1)
    rest = rest - b.FSm * reversal(s.motor_sharp, b.motor_reversal)
    if problem.both:
        rest = rest - b.K * (s.motor - s.joint)
    cut = rest[100:-100]
    length = int(min(cut.size, 1024))
    f, density = welch(cut, fs=s.rate_hz, nperseg=length)
    use = (f > 1.1 * problem.band_hz) & (f < min(2.2 * problem.band_hz, 0.3 * s.rate_hz))
    if not use.any():
        return problem
    omega = 2.0 * np.pi * f[use]
    stiffness = b.K if problem.both else 0.0
    encoders = ((b.Jm * omega**2 - stiffness) * noise.motor_position) ** 2 + (
        stiffness * noise.joint_position
    ) ** 2
    left = np.median(density[use] * 0.5 * s.rate_hz - encoders)
    torque = float(np.sqrt(max(left, noise.torque**2)))
    problem.noise = NoiseLevels(torque, noise.motor_position, noise.joint_position)
    return problem.at(b)
