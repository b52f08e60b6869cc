"""Welch's density against scipy's, and in its own units."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from flexid_cli.pipeline.spectrum import welch


@pytest.mark.parametrize(("samples", "length"), [(1000, 256), (1001, 255), (300, 300), (20, 7), (90, 1000)])
def test_density_is_that_of_scipy(samples: int, length: int):
    x = 3.0 + np.cumsum(np.random.default_rng(0).standard_normal(samples))
    frequency, density = welch(x, 350.87, length)
    theirs = signal.welch(x, fs=350.87, nperseg=min(length, samples))
    np.testing.assert_allclose(frequency, theirs[0], rtol=1e-12)
    np.testing.assert_allclose(density[1:], theirs[1][1:], rtol=1e-9)


def test_white_noise_has_its_variance_spread_over_the_band():
    x = 0.3 * np.random.default_rng(1).standard_normal(200_000)
    frequency, density = welch(x, 1000.0, 512)
    assert np.mean(density[2:-2]) == pytest.approx(0.3**2 / 500.0, rel=0.02)
    assert frequency[-1] == 500.0
