"""Interpolation and anti-aliasing against signals known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from flexid_cli.signals import resample as resample_module
from flexid_cli.signals.resample import resample
from flexid_cli.signals.timebase import Track, build_timelines, make_track

NS = 1e9


def track_of(stamps: np.ndarray, values: np.ndarray) -> Track:
    return make_track("motor_torque", "i", "column", build_timelines([("i", stamps, None)])[0], values)


def uniform(rate_hz: float, seconds: float, start_ns: int = 0) -> np.ndarray:
    return start_ns + np.rint(np.arange(int(seconds * rate_hz)) * NS / rate_hz).astype(np.int64)


def sines(stamps: np.ndarray, frequencies: list[float]) -> np.ndarray:
    return sum(np.sin(2 * np.pi * f * stamps / NS + f) for f in frequencies)


def inner(grid: np.ndarray, margin: int = 40) -> slice:
    return slice(margin, grid.size - margin)


def test_equal_stamps_are_copied_bit_for_bit():
    stamps = uniform(350.87, 5)
    values = np.random.default_rng(0).normal(size=stamps.size)
    result = resample(track_of(stamps, values), stamps.astype(float), NS / 350.87)
    assert np.array_equal(result.values, values)
    assert result.copied == stamps.size


@pytest.mark.parametrize("share", [0.02, 0.2, 0.5, 0.78])
def test_half_a_sample_later_is_exact_up_to_the_pass_band(share):
    stamps = uniform(1000, 4)
    frequency = share * 500.0
    grid = stamps[1:-1] + 500_000.0
    result = resample(track_of(stamps, sines(stamps, [frequency])), grid, 1e6)
    assert result.copied == 0
    error = np.abs(result.values - sines(grid, [frequency]))
    assert error[inner(grid)].max() < 1.5e-4
    assert error.max() < 0.5  # the last samples know only one side


@pytest.mark.parametrize(
    ("fast", "slow"), [(1000, 800), (1000, 500), (1000, 350.87), (8000, 500), (20000, 100)]
)
def test_faster_signal_is_flat_in_band_and_free_of_aliases(fast, slow):
    stamps, grid = uniform(fast, 4), uniform(slow, 4, 1_300_000)[:-2].astype(float)
    nyquist = slow / 2
    kept = [0.03 * nyquist, 0.4 * nyquist, 0.78 * nyquist]
    result = resample(track_of(stamps, sines(stamps, kept)), grid, NS / slow)
    assert result.taps > 0
    assert np.abs(result.values - sines(grid, kept))[inner(grid)].max() < 4e-4
    folding = [1.02 * nyquist] + [f for f in (1.5 * nyquist, 3.3 * nyquist) if f < 0.95 * fast / 2]
    alias = resample(track_of(stamps, sines(stamps, folding)), grid, NS / slow)
    assert np.abs(alias.values)[inner(grid)].max() < 4e-4


def test_without_the_filter_the_same_signal_would_alias():
    stamps, grid = uniform(1000, 4), uniform(500, 4)[:-2].astype(float)
    result = resample(track_of(stamps, sines(stamps, [400.0])), grid, 2e6, may_lowpass=False)
    assert np.abs(result.values).max() > 0.5


def test_constant_and_line_are_kept_up_to_the_ends():
    stamps, grid = uniform(2000, 2), uniform(500, 2)[:-1].astype(float)
    for values in (np.full(stamps.size, 3.0), 2.0 + 5.0 * stamps / NS):
        expected = np.interp(grid, stamps, values)
        assert np.abs(resample(track_of(stamps, values), grid, 2e6).values - expected).max() < 2e-4


@pytest.mark.parametrize(("jitter", "tolerance"), [(0.02, 1e-4), (0.1, 2e-4), (0.3, 2e-3)])
def test_jittered_stamps_give_the_analytic_signal(jitter, tolerance):
    rng = np.random.default_rng(1)
    stamps = uniform(1000, 5) + np.rint(rng.uniform(-1, 1, 5000) * jitter * 1e6).astype(np.int64)
    frequencies = [3.0, 20.0, 60.0]
    track = track_of(stamps, sines(stamps, frequencies))
    assert not track.is_uniform
    grid = np.arange(stamps[0], stamps[-1], 1e6)
    error = np.abs(resample(track, grid, 1e6).values - sines(grid, frequencies))
    assert error[inner(grid)].max() < tolerance


def test_jittered_fast_signal_is_lowpassed_too():
    rng = np.random.default_rng(2)
    stamps = uniform(2000, 4) + rng.integers(-25_000, 25_000, 8000)
    grid = uniform(500, 4)[5:-5].astype(float)
    kept, folding = [5.0, 80.0], [300.0]
    values = sines(stamps, kept) + sines(stamps, folding)
    result = resample(track_of(stamps, values), grid, 2e6)
    assert np.abs(result.values - sines(grid, kept))[inner(grid)].max() < 2e-3


def test_noise_in_samples_at_almost_the_same_time_is_not_a_slope():
    rng = np.random.default_rng(3)
    stamps = np.sort(np.concatenate([uniform(1000, 3) + rng.integers(-1, 1, 3000), uniform(100, 3) + 2000]))
    values = sines(stamps, [5.0]) + rng.normal(0, 0.01, stamps.size)
    track = track_of(stamps, values)
    grid = np.arange(stamps[0], stamps[-1], 1e6) + 300_000.0
    error = resample(track, grid[:-1], 1e6).values - sines(grid[:-1], [5.0])
    assert np.abs(error).max() < 0.06


def test_missing_samples_of_a_uniform_signal_leave_the_others_alone():
    stamps = uniform(1000, 3)
    values = sines(stamps, [10.0, 40.0])
    keep = np.ones(stamps.size, dtype=bool)
    keep[[100, 700, 701, 1500]] = False
    result = resample(track_of(stamps[keep], values[keep]), stamps.astype(float), 1e6)
    assert np.array_equal(result.values[keep], values[keep])
    assert np.abs(result.values - values).max() < 2e-3


@pytest.mark.parametrize("samples", [2, 3, 4, 5, 8])
def test_few_samples(samples):
    stamps = uniform(1000, samples / 1000)
    grid = stamps[:-1] + 250_000.0
    result = resample(track_of(stamps, stamps / NS), grid, 1e6)
    assert result.values == pytest.approx(grid / NS, abs=1e-6)


@pytest.mark.parametrize(("cutoff", "width"), [(0.33, 0.13), (0.9, 0.05), (0.02, 0.004)])
def test_the_low_pass_is_kaisers_of_scipy(cutoff, width):
    taps, beta = signal.kaiserord(resample_module.STOP_DB + 2.0, width)
    expected = signal.firwin(taps + 1 - taps % 2, cutoff, window=("kaiser", beta))
    np.testing.assert_allclose(resample_module._kaiser_lowpass(cutoff, width), expected, atol=1e-14)


@pytest.mark.parametrize(("samples", "taps"), [(5, 3), (1, 9), (1100, 33), (5000, 1033), (3000, 1)])
def test_convolution_by_blocks_is_the_whole_one(samples, taps):
    rng = np.random.default_rng(samples)
    x, window = rng.standard_normal(samples), rng.standard_normal(taps)
    np.testing.assert_allclose(resample_module._convolve(x, window), np.convolve(x, window), atol=1e-11)
