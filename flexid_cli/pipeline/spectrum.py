"""Power spectral density by averaged periodograms (Welch, IEEE Trans. Audio Electroacoustics 15 (1967) 70)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def welch(x: Array, rate_hz: float, length: int) -> tuple[Array, Array]:
    """One-sided density of the mean periodogram of half-overlapping Hann windows, each about its own mean.

    Parameters
    ----------
    x : ndarray, shape (n,)
        Samples.
    rate_hz : float
        Sampling rate.
    length : int
        Samples in a window; n at most.

    Returns
    -------
    frequency, density : ndarray, shape (length // 2 + 1,)
        Hz, and the square of the unit of ``x`` over Hz.
    """
    length = min(length, x.size)
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(length) / length)
    parts = np.lib.stride_tricks.sliding_window_view(x, length)[:: length - length // 2]
    total = np.zeros(length // 2 + 1)
    for part in parts:
        total += np.abs(np.fft.rfft(window * (part - part.mean()))) ** 2
    density = total / (parts.shape[0] * rate_hz * np.sum(window**2))
    density[1 : (length + 1) // 2] *= 2.0
    return np.asarray(np.fft.rfftfreq(length, 1.0 / rate_hz), dtype=np.float64), density
