"""Zero-phase filters: the paper's magnitudes, no phase, and the design of `decimate`."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from flexid_cli.errors import UsageError
from flexid_cli.pipeline import filters

RATE = 350.87


@pytest.mark.parametrize("order", [1, 2, 4, 6])
def test_butterworth_has_the_analog_magnitude_of_equation_25_far_below_nyquist(order: int):
    rate = 1e5
    cutoff = 28.0
    frequency = cutoff * np.geomspace(0.05, 4.0, 60)
    ours = filters.magnitude(filters.butterworth(order, cutoff, rate), frequency, rate)
    paper = 1.0 / (1.0 + (frequency / cutoff) ** (2 * order))
    # The bilinear transform warps f by (pi f / rate)^2 / 3 relative to the cutoff; the magnitude falls with the
    # power 2 m of the frequency at most.
    warp = 2 * order * (np.pi * frequency.max() / rate) ** 2 / 3.0
    np.testing.assert_allclose(ours, paper, rtol=1.5 * warp + 1e-9)


@pytest.mark.parametrize("order", [2, 4, 6])
def test_butterworth_is_at_minus_six_decibel_at_its_cutoff_at_any_rate(order: int):
    sos = filters.butterworth(order, 60.0, RATE)
    assert filters.magnitude(sos, np.array([60.0]), RATE)[0] == pytest.approx(0.5, rel=1e-9)
    assert filters.magnitude(sos, np.array([1e-6]), RATE)[0] == pytest.approx(1.0, rel=1e-9)


def test_butterworth_as_the_paper_used_it():
    """176 rad/s at 350.87 Hz: physics of the paper's pipeline at wc = 147.03 rad/s, with the bilinear warp."""
    sos = filters.butterworth(4, 176.0 / (2.0 * np.pi), RATE)
    edge = np.array([147.03 / (2.0 * np.pi)])
    assert filters.magnitude(sos, edge, RATE)[0] == pytest.approx(0.816, abs=5e-4)
    assert pytest.approx(0.808, abs=5e-4) == 1.0 / (1.0 + (147.03 / 176.0) ** 8)


@pytest.mark.parametrize("order", range(1, 11))
@pytest.mark.parametrize("share", [0.001, 0.03, 0.3, 0.49])
def test_butterworth_is_the_design_of_scipy(order: int, share: float):
    ours = filters.butterworth(order, share * RATE, RATE)
    theirs = signal.butter(order, share * RATE, fs=RATE, output="sos")
    assert ours.shape == theirs.shape
    frequency = np.linspace(0.0, 0.499 * RATE, 300)
    _, response = signal.freqz_sos(theirs, 2.0 * np.pi * frequency / RATE)
    np.testing.assert_allclose(filters.magnitude(ours, frequency, RATE), np.abs(response) ** 2, atol=1e-10)


@pytest.mark.parametrize("order", range(1, 9))
@pytest.mark.parametrize("samples", [1, 2, 7, 999])
def test_the_compiled_sections_give_the_bits_of_sosfilt(order: int, samples: int):
    sos = filters.butterworth(order, 0.1 * RATE, RATE)
    x = 1e3 * np.random.default_rng(order).standard_normal(samples)
    forward = signal.sosfilt(sos, x)
    expected = signal.sosfilt(sos, forward[::-1])[::-1]
    np.testing.assert_array_equal(filters.zero_phase(x, sos, settled_edges=False), expected)


@pytest.mark.parametrize("order", range(1, 9))
def test_the_state_of_rest_is_that_of_scipy(order: int):
    sos = filters.butterworth(order, 0.05 * RATE, RATE)
    ours = filters._rest_state(sos.tobytes(), sos.shape[0])
    np.testing.assert_allclose(ours, signal.sosfilt_zi(sos), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("cutoff", [0.0, -1.0, 0.5 * RATE, 400.0])
def test_a_cutoff_outside_the_band_is_refused_with_a_cure(cutoff: float):
    with pytest.raises(UsageError) as caught:
        filters.butterworth(4, cutoff, RATE)
    assert caught.value.hint


@pytest.mark.parametrize("factor", [2, 4, 9, 13, 26])
def test_decimation_filter_is_the_design_of_decimate(factor: int):
    """Chebyshev I, order 8, 0.05 dB, edge 0.8 / q: scipy's and MATLAB's `decimate`."""
    poles = signal.cheby1(8, 0.05, 0.8 / factor, output="zpk")
    frequency = np.linspace(0.001, 0.49, 300)
    _, reference = signal.freqz_zpk(*poles, worN=2.0 * np.pi * frequency)
    ours = filters.magnitude(filters.decimation_filter(factor), frequency, 1.0)
    np.testing.assert_allclose(ours, np.abs(reference) ** 2, rtol=1e-7, atol=1e-30)
    edge = filters.magnitude(filters.decimation_filter(factor), np.array([0.4 / factor]), 1.0)[0]
    assert 20.0 * np.log10(edge) == pytest.approx(-0.1, abs=1e-6)


@pytest.mark.parametrize("factor", [3, 8])
def test_decimation_gives_the_samples_of_scipy_decimate_away_from_the_edges(factor: int):
    x = np.cumsum(np.random.default_rng(3).standard_normal(6000))
    ours = filters.zero_phase(x, filters.decimation_filter(factor), settled_edges=False)[::factor]
    theirs = signal.decimate(x, factor, ftype="iir", zero_phase=True)
    middle = slice(ours.size // 3, 2 * ours.size // 3)
    np.testing.assert_allclose(ours[middle], theirs[middle], rtol=1e-6, atol=1e-6 * np.abs(x).max())


def test_no_decimation_is_the_identity():
    x = np.random.default_rng(4).standard_normal(50)
    np.testing.assert_array_equal(filters.zero_phase(x, filters.decimation_filter(1), settled_edges=False), x)


def test_settled_edges_are_those_of_filtfilt():
    """Odd reflection and settled initial conditions, as MATLAB's filtfilt."""
    x = np.cumsum(np.random.default_rng(5).standard_normal(4000)) + 7.0
    b, a = signal.butter(4, 20.0, fs=RATE)
    reference = signal.filtfilt(b, a, x, padtype="odd", padlen=400)
    ours = filters.zero_phase(x, filters.butterworth(4, 20.0, RATE))
    # The padding is as long as the slowest pole needs to decay to 1e-3; each pass leaves that part of a step.
    np.testing.assert_allclose(ours, reference, atol=2e-3 * np.abs(np.diff(x)).max() + 1e-6)


@pytest.mark.parametrize("settled", [True, False])
@pytest.mark.parametrize("sos", [filters.butterworth(4, 20.0, RATE), filters.decimation_filter(8)])
def test_zero_phase_commutes_with_reversed_time(sos: np.ndarray, settled: bool):
    x = np.random.default_rng(6).standard_normal(3000)
    forward = filters.zero_phase(x, sos, settled_edges=settled)
    backward = filters.zero_phase(x[::-1], sos, settled_edges=settled)[::-1]
    # Away from the edges, where the order of the two passes matters.
    np.testing.assert_allclose(forward[1000:2000], backward[1000:2000], atol=1e-9)


def test_a_wave_keeps_its_phase_and_takes_the_magnitude():
    for sos in (filters.butterworth(6, 28.0, RATE), filters.decimation_filter(26)):
        for frequency in (1.0, 4.5, 6.5):
            n = np.arange(12000)
            wave = np.cos(2.0 * np.pi * frequency * n / RATE + 0.4)
            out = filters.zero_phase(wave, sos, settled_edges=False)[4000:8000]
            gain = filters.magnitude(sos, np.array([frequency]), RATE)[0]
            np.testing.assert_allclose(out, gain * wave[4000:8000], atol=1e-8)


@pytest.mark.parametrize("settled", [True, False])
def test_filters_are_linear(settled: bool):
    rng = np.random.default_rng(7)
    sos = filters.butterworth(4, 15.0, RATE)
    x, y = rng.standard_normal((2, 500))
    combined = filters.zero_phase(2.0 * x - 5.0 * y, sos, settled_edges=settled)
    separate = 2.0 * filters.zero_phase(x, sos, settled_edges=settled) - 5.0 * filters.zero_phase(
        y, sos, settled_edges=settled
    )
    np.testing.assert_allclose(combined, separate, atol=1e-11)


def test_a_short_signal_is_filtered_without_complaint():
    for size in (2, 5, 20):
        out = filters.zero_phase(np.ones(size), filters.butterworth(4, 5.0, RATE))
        np.testing.assert_allclose(out, 1.0, atol=1e-9)
