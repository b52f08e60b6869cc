"""Noise of the torque by local fits, on loops whose noise is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from flexid_cli.diagnose.torque_noise import MOST_FALL, first_order, torque_noise
from flexid_cli.signals.recording import Segment

RATE, BAND = 500.0, 40.0


def loop(corner_hz: float, *, sigma: float = 0.2, seed: int = 1, samples: int = 20_000) -> Segment:
    """A drive: torque of a PD controller on a quantised position of a load with Coulomb friction, and its noise."""
    rng = np.random.default_rng(seed)
    low = signal.butter(4, 0.2 * BAND, fs=RATE, output="sos")
    reference = signal.sosfiltfilt(low, 10.0 * rng.standard_normal(samples))
    lag = signal.butter(2, 0.7 * BAND, fs=RATE, output="sos")
    moved = signal.sosfilt(lag, reference)
    stuck = signal.sosfilt(lag, np.sign(np.gradient(moved)))
    position = 0.01 * np.round((moved - 0.1 * stuck) / 0.01)
    error = reference - position
    torque = 30.0 * error + 0.5 * np.diff(error, prepend=error[0]) * RATE
    noise = sigma * rng.standard_normal(samples)
    if np.isfinite(corner_hz):
        pole = np.exp(-2.0 * np.pi * corner_hz / RATE)
        noise = signal.lfilter([1.0 - pole], [1.0, -pole], noise)
    return Segment(0.0, torque + noise, position, reference_position=reference)


def without_reference(segment: Segment) -> Segment:
    return Segment(0.0, segment.torque, segment.motor_position)


@pytest.mark.parametrize("seed", range(4))
def test_white_noise_is_found_at_its_level(seed: int):
    segment = loop(np.inf, seed=seed)
    for record in (segment, without_reference(segment)):
        found = torque_noise(record, RATE, BAND)
        assert found is not None
        level, corner = found
        assert np.sqrt(level / (1.0 + (0.5 * BAND / corner) ** 2)) == pytest.approx(0.2, rel=0.15)


@pytest.mark.parametrize("seed", range(4))
def test_with_the_reference_coloured_noise_is_found_inside_the_band(seed: int):
    found = torque_noise(loop(30.0, seed=seed), RATE, BAND)
    assert found is not None
    level, corner = found
    assert np.sqrt(level) == pytest.approx(0.2, rel=0.12)
    assert corner == pytest.approx(30.0, rel=0.25)


def test_the_unit_of_the_torque_does_not_matter():
    segment = loop(30.0)
    found = torque_noise(segment, RATE, BAND)
    scaled = torque_noise(
        Segment(
            0.0, 1e3 * segment.torque, segment.motor_position, reference_position=segment.reference_position
        ),
        RATE,
        BAND,
    )
    assert found is not None
    assert scaled == pytest.approx((1e6 * found[0], found[1]))


@pytest.mark.parametrize("sigma", [0.0, 1e-9])
def test_a_torque_without_noise_has_next_to_none(sigma: float):
    found = torque_noise(loop(np.inf, sigma=sigma), RATE, BAND)
    assert found is not None
    # What bends in a window: far below the floor of 1e-3 of the torque that the rows have.
    assert 0.0 < np.sqrt(found[0]) < 1e-5 * np.std(loop(np.inf).torque)


def test_a_torque_that_is_always_the_same_has_none():
    segment = loop(np.inf)
    found = torque_noise(Segment(0.0, np.ones(segment.samples), segment.motor_position), RATE, BAND)
    assert found is not None
    assert 0.0 < found[0] < 1e-20


def test_a_record_too_short_to_tell_gives_nothing():
    assert torque_noise(loop(np.inf, samples=300), RATE, BAND) is None
    # Without a reference nothing is left between the band and what resampling keeps.
    assert torque_noise(without_reference(loop(np.inf)), RATE, 0.34 * RATE) is None


def test_the_level_at_rest_stays_within_what_the_range_can_tell():
    frequency = np.linspace(44.0, 88.0, 60)
    level, _ = first_order(frequency, 1.0 / frequency**4, 40.0)
    assert level <= 1.05 * MOST_FALL / 44.0**4
