"""Velocities about their reversals, and the sign's mean over a sampling period."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flexid_cli.diagnose.mean_sign import FINE, between, mean_sign
from flexid_cli.diagnose.reversals import Reversals, Side
from flexid_cli.signals.recording import Segment

RATE, SAMPLES, STEPS = 500.0, 5_000, 40
INERTIA, DAMPING, FRICTION, WIDTH = 2.0, 1.0, 5.0, 0.002
COUNT = 3e-5
TIME = np.arange(SAMPLES) / RATE


def force_at(t: np.ndarray) -> np.ndarray:
    return np.asarray(9.0 * np.sin(2.0 * np.pi * 1.3 * t) + 5.0 * np.sin(2.0 * np.pi * 3.1 * t + 0.4))


@pytest.fixture(scope="module")
def motion() -> tuple[np.ndarray, np.ndarray]:
    """Position and velocity of a mass with friction, by small implicit steps; the velocity in `FINE` steps."""
    h = 1.0 / (RATE * STEPS)
    position, velocity = np.empty(SAMPLES), np.empty(FINE * SAMPLES)
    q = v = 0.0
    for i in range(SAMPLES * STEPS):
        if i % STEPS == 0:
            position[i // STEPS] = q
        if i % (STEPS // FINE) == 0:
            velocity[i // (STEPS // FINE)] = v
        force = float(force_at(np.array((i + 0.5) * h)))
        slope = DAMPING + FRICTION / WIDTH * (1.0 - np.tanh(v / WIDTH) ** 2)
        pull = force - DAMPING * v - FRICTION * np.tanh(v / WIDTH)
        new = v + h / INERTIA * pull / (1.0 + h / INERTIA * slope)
        q, v = q + 0.5 * h * (v + new), new
    return position, velocity[: FINE * (SAMPLES - 1) + 1]


def side(noise: float) -> Side:
    return Side(INERTIA, DAMPING, 0.0, FRICTION, WIDTH, 0.0, COUNT / np.sqrt(12.0), noise)


def counted(position: np.ndarray) -> np.ndarray:
    return np.asarray(COUNT * np.round(position / COUNT))


def test_reversals_are_told_far_better_by_encoder_and_force_than_by_the_encoder(motion):
    position, velocity = motion
    _, found = (
        side(0.05)
        .doubted(counted(position), force_at(TIME), 1.0 / RATE)
        .smoothed(counted(position), force_at(TIME), 1.0 / RATE)
    )
    inside = slice(FINE * 100, -FINE * 100)
    kernel = np.ones(8) / 8.0  # the encoder's derivative over eight samples
    encoder = between(np.convolve(np.gradient(counted(position)) * RATE, kernel, "same"))
    error = np.std(np.tanh(found / WIDTH)[inside] - np.tanh(velocity / WIDTH)[inside])
    assert error < 0.08
    assert error < 0.3 * np.std(np.tanh(encoder / WIDTH)[inside] - np.tanh(velocity / WIDTH)[inside])


def test_a_force_that_the_model_lacks_raises_the_doubt_about_it(motion):
    position, _ = motion
    wrong = force_at(TIME) + 2.0 * np.sin(2.0 * np.pi * 20.0 * TIME)
    plain, doubted = side(0.05), side(0.05).doubted(counted(position), wrong, 1.0 / RATE)
    assert doubted.noise > 4.0 * plain.noise
    assert plain.doubted(counted(position), force_at(TIME), 1.0 / RATE).noise <= 4.0 * plain.noise


@pytest.mark.parametrize("share", [0.1, 0.35, 0.5, 0.8])
def test_the_mean_of_a_sign_holds_the_time_at_which_it_turns(share):
    """A jump between two samples leaves the sum of a sign that turns there, not at the next sample."""
    n, at = 40, 20.0 + share
    fine = np.arange(FINE * (n - 1) + 1) / FINE - at
    sign = mean_sign(fine, 1e-3)
    assert sign.shape == (n,)
    # Over the periods about the samples the sign is -1 until `at` and 1 from there to the last one's end.
    assert np.sum(sign[5:35]) == pytest.approx((34.5 - at) - (at - 4.5), abs=1e-3)
    assert np.sum(np.sign(np.arange(5, 35) - at)) != pytest.approx((34.5 - at) - (at - 4.5), abs=1e-3) or (
        share == 0.5
    )
    assert np.all(np.abs(sign) < 1.1)


def test_a_sign_that_does_not_turn_is_that_of_its_velocity():
    fine = np.full(FINE * 9 + 1, 0.003)
    np.testing.assert_allclose(mean_sign(fine, 0.002), np.tanh(1.5), rtol=1e-9)


def test_an_error_that_is_taken_out_of_a_position_takes_the_springs_zero_with_it(motion):
    """Else the spring would pull at the motor with a torque that is not there, and turn signs."""
    position, _ = motion
    motor, load = (replace(side(0.05), stiffness=500.0) for _ in range(2))
    joint = position - force_at(TIME) / 500.0
    both = Reversals(motor, load, 0.0, float(np.mean(position - joint)), 0.0)
    record, moved = (Segment(0.0, 2.0 * force_at(TIME), position, joint + e) for e in (0.0, 2e-3))
    for plain, other in zip(both(record, RATE), both(moved, RATE), strict=True):
        assert other == pytest.approx(plain, abs=1e-6 * np.ptp(plain))
