"""Weights of rows in which noise turns the sign of a velocity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flexid_cli.diagnose.problem import Problem
from flexid_cli.diagnose.stretch import Stretch
from flexid_cli.diagnose.trust import trusted
from flexid_cli.effects.motion import Base
from flexid_cli.estimate.budget import NoiseLevels
from flexid_cli.pipeline.columns import reversal
from flexid_cli.signals.recording import Segment

RATE, BAND, SAMPLES = 1000.0, 40.0, 20_000
WIDTH, ENCODER = 0.002, 2e-6
BASE = Base(
    Jm=2.0, K=3e8, JL=1.5, FVm=1.0, FSm=20.0, FV=0.4, FS=4.0, motor_reversal=WIDTH, load_reversal=WIDTH
)
TIME = np.arange(SAMPLES) / RATE
# Between reversals (at 1, 3, 5, 7 and 9 s), and in the standstill behind them.
MOVING = (TIME > 2.0) & (TIME < 8.0) & (np.abs((TIME + 1.0) % 2.0 - 1.0) < 0.5)
RESTING = TIME > 12.0


def position() -> np.ndarray:
    """Waves for ten seconds, then a standstill."""
    velocity = np.where(
        TIME < 10.0, np.sin(np.pi * TIME / 10.0) ** 2 * np.cos(2.0 * np.pi * 0.25 * TIME), 0.0
    )
    return np.asarray(np.cumsum(velocity) / RATE)


def problem(base: Base, noise: NoiseLevels, seed: int = 5) -> Problem:
    """A rigid motion with the baseline's friction, as the encoder and the current sensor of ``noise`` show it."""
    rng = np.random.default_rng(seed)
    q = position()
    velocity = np.gradient(q) * RATE
    friction = (base.FVm + base.FV) * velocity + (base.FSm + base.FS) * reversal(velocity, WIDTH)
    torque = (base.Jm + base.JL) * np.gradient(velocity) * RATE + friction
    segment = Segment(
        0.0,
        torque + noise.torque * rng.standard_normal(SAMPLES),
        q + noise.motor_position * rng.standard_normal(SAMPLES),
        None,
    )
    return Problem(
        [Stretch(segment, RATE, BAND)],
        base,
        noise,
        BAND,
        gravity=9.81,
        gear_ratio=1.0,
        duration_s=SAMPLES / RATE,
        both=False,
        shift=0.0,
        led=True,
    )


def rows_at(p: Problem, moving: np.ndarray) -> np.ndarray:
    return np.interp(p.row_times, TIME, moving.astype(float)) > 0.99


def test_rows_at_a_standstill_count_less_and_those_in_motion_in_full():
    p = trusted(problem(BASE, NoiseLevels(0.02, ENCODER, 0.0)))
    assert p.trust is not None
    [[trust]] = p.trust
    assert np.all((trust > 0.0) & (trust <= 1.0))
    assert np.median(trust[rows_at(p, MOVING)]) > 0.95
    assert np.median(trust[rows_at(p, RESTING)]) < 0.3


def test_weighted_rows_of_a_true_model_are_of_unit_size_everywhere():
    plain = problem(BASE, NoiseLevels(0.02, ENCODER, 0.0))
    weighted = trusted(plain)

    def rms(p: Problem, moving: np.ndarray) -> float:
        return float(np.sqrt(np.mean(p.target()[rows_at(p, moving)] ** 2)))

    assert rms(plain, RESTING) > 3.0
    assert rms(weighted, RESTING) == pytest.approx(1.0, abs=0.4)
    assert rms(weighted, MOVING) == pytest.approx(rms(plain, MOVING), rel=0.15)


def test_without_coulomb_friction_all_rows_count_in_full():
    base = replace(BASE, FSm=0.0, FS=0.0)
    p = trusted(problem(base, NoiseLevels(0.02, ENCODER, 0.0)))
    assert p.trust is not None
    np.testing.assert_array_equal(p.trust[0], 1.0)


COUNT = 2e-5


def counted(creep: float) -> Problem:
    """An axis without friction whose encoder counts: waves for ten seconds, then ``creep`` counts a second."""
    rng = np.random.default_rng(7)
    base = replace(BASE, FSm=0.0, FS=0.0, FVm=0.0, FV=0.0)
    q = position() + COUNT * creep * np.clip(TIME - 10.0, 0.0, None)
    noise = NoiseLevels(0.005, COUNT / np.sqrt(12.0), 0.0)
    torque = (base.Jm + base.JL) * np.gradient(np.gradient(q)) * RATE**2
    segment = Segment(
        0.0, torque + noise.torque * rng.standard_normal(SAMPLES), COUNT * np.round(q / COUNT), None
    )
    return trusted(
        Problem(
            [Stretch(segment, RATE, BAND)], base, noise, BAND, gravity=9.81, gear_ratio=1.0,
            duration_s=SAMPLES / RATE, both=False, shift=0.0,
        )
    )  # fmt: skip


@pytest.mark.parametrize("creep", [5.0, 30.0])
def test_rows_count_less_where_counts_follow_each_other_slowly(creep):
    """The error of a count that lasts as long as the band's periods lies within the band, not above it."""
    p = counted(creep)
    assert p.trust is not None
    [[trust]] = p.trust
    fast, slow, e = rows_at(p, MOVING), rows_at(p, RESTING), p.target()
    assert np.median(trust[fast]) > 0.9
    assert np.sqrt(np.mean((e[slow] / trust[slow]) ** 2)) > 2.0
    assert np.sqrt(np.mean(e[slow] ** 2)) == pytest.approx(1.0, abs=0.25)
