"""Compiled loops and what replaces scipy.signal, against numpy's and scipy's own."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import bilinear, czt, lfilter, lfilter_zi

from flexid_cli.diagnose.location import chirp_transform
from flexid_cli.effects.forms import lagged, resonant
from flexid_cli.pipeline import derivatives
from flexid_cli.pipeline.columns import reversal

PERIOD = 1e-3


@pytest.fixture
def signal() -> np.ndarray:
    return np.cumsum(np.random.default_rng(3).standard_normal(5000)) * 1e-3


@pytest.mark.parametrize("kind", ["exact", "central"])
@pytest.mark.parametrize("order", [1, 2, 3, 4])
@pytest.mark.parametrize("samples", [60, 1024, 5000])
def test_a_derivative_is_the_convolution_with_its_weights(signal, kind, order, samples):
    x = signal[:samples]
    weights = np.array(derivatives._stencil(kind, order, 12))
    expected = np.convolve(x, weights[::-1], mode="same") / PERIOD**order
    found = derivatives.differentiate(x, order, PERIOD, kind=kind, half_width=12)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-13 * np.abs(expected).max())


@pytest.mark.parametrize("width", [1e-4, 1e-2, 1.0, 100.0])
def test_the_averaged_sign_is_the_difference_quotient_of_ln_cosh(signal, width):
    middle = np.concatenate([signal[:1], 0.5 * (signal[1:] + signal[:-1]), signal[-1:]]) / width
    integral, change = np.logaddexp(middle, -middle), np.diff(middle)
    slow = np.abs(change) < 1e-3
    expected = np.where(slow, np.tanh(signal / width), np.diff(integral) / np.where(slow, 1.0, change))
    expected[1:-1] -= np.diff(expected, 2) / 24.0
    # The quotient's own rounding: the integral's last bit over the least change.
    np.testing.assert_allclose(reversal(signal, width), expected, rtol=0.0, atol=1e-12)


def test_a_sign_of_nothing_is_nothing():
    assert reversal(np.empty(0), 1.0).size == 0


@pytest.mark.parametrize("lag_s", [1e-4, 3e-3, 1.0])
def test_a_lag_is_scipys_filter(signal, lag_s):
    decay = np.exp(-PERIOD / lag_s)
    share = lag_s / PERIOD * (1.0 - decay)
    b, a = [1.0 - share, share - decay], [1.0, -decay]
    expected, _ = lfilter(b, a, signal, zi=[share * signal[0]])
    np.testing.assert_allclose(lagged(signal, lag_s, PERIOD), expected, rtol=0.0, atol=1e-13)


@pytest.mark.parametrize(("frequency_hz", "ratio"), [(2.0, 0.3), (40.0, 0.01), (440.0, 0.1)])
def test_a_resonance_is_scipys_bilinear_transform(signal, frequency_hz, ratio):
    x, w = signal + 1.0, 2.0 * np.pi * frequency_hz
    b, a = bilinear(
        [2.0 * ratio * w, w * w], [1.0, 2.0 * ratio * w, w * w], fs=0.5 * w / np.tan(0.5 * w * PERIOD)
    )
    expected, _ = lfilter(b, a, x, zi=lfilter_zi(b, a) * x[0])
    np.testing.assert_allclose(resonant(x, frequency_hz, ratio, PERIOD), expected, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("count", [7, 200, 3000])
def test_the_chirp_transform_is_scipys_and_the_sum_itself(signal, count):
    x, first, step = signal[:1500], 0.003, 1e-4
    turn = -2j * np.pi
    expected = czt(x, count, np.exp(turn * step), np.exp(-turn * first))
    found = chirp_transform(x, first, step, count)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-8 * np.abs(expected).max())
    k = count - 1
    direct = np.sum(x * np.exp(turn * (first + step * k) * np.arange(x.size)))
    assert abs(found[k] - direct) < 1e-11 * np.abs(expected).max()
