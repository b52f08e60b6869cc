"""Forms that several effects share: sines of free phase over an angle, a lag, a resonance."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from flexid_cli.effects.motion import Shape
from flexid_cli.effects.signature import CYCLES_PER_SPEED, POINTS_PER_CYCLE, Scale

Array = NDArray[np.float64]

MOST_POINTS = 500


def column(x: Array) -> Array:
    """One column, shape (n, 1)."""
    return x.reshape(-1, 1)


def sines(angle: Array, cycles: float) -> Array:
    """Cosine and sine of ``cycles`` times the angle, shape (n, 2)."""
    return np.column_stack([np.cos(cycles * angle), np.sin(cycles * angle)])


def amplitude_and_phase(amplitudes: Array) -> tuple[float, float]:
    """(A, phi) of A sin(x + phi) = a cos x + b sin x."""
    a, b = (float(x) for x in amplitudes[:2])
    return math.hypot(a, b), math.atan2(a, b)


def cycles_range(scale: Scale, name: str) -> Sequence[Shape] | None:
    """Cycles per radian of motor motion that this record can show; None where it moves less than two of them."""
    low = 2.0 * math.pi / max(scale.motor_range, 1e-12)
    high = 2.0 * math.pi * scale.band_hz / (CYCLES_PER_SPEED * scale.motor_speed)
    if high <= 2.0 * low:
        return None
    points = int(np.clip(POINTS_PER_CYCLE * (high - low) / low, 12, MOST_POINTS))
    return (Shape(name, low, high, points, "linear"),)


def lagged(x: Array, lag_s: float, period_s: float) -> Array:
    """First-order lag of a signal that is linear between its samples, started at rest on its first value."""
    from scipy.signal import lfilter

    decay = math.exp(-period_s / lag_s)
    share = lag_s / period_s * (1.0 - decay)
    y, _ = lfilter([1.0 - share, share - decay], [1.0, -decay], x, zi=[share * x[0]])
    return np.asarray(y, dtype=np.float64)


def resonant(x: Array, frequency_hz: float, damping_ratio: float, period_s: float) -> Array:
    """(2 z w s + w^2) / (s^2 + 2 z w s + w^2) of a signal, by the bilinear transform that keeps w in its place."""
    from scipy.signal import bilinear, lfilter, lfilter_zi

    w = 2.0 * math.pi * frequency_hz
    half_rate = 0.5 * w / math.tan(0.5 * w * period_s)
    b, a = bilinear([2.0 * damping_ratio * w, w * w], [1.0, 2.0 * damping_ratio * w, w * w], fs=half_rate)
    y, _ = lfilter(b, a, x, zi=lfilter_zi(b, a) * x[0])
    return np.asarray(y, dtype=np.float64)
