"""Forms that several effects share: sines of free phase over an angle, a lag, a resonance."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from flexid_cli.effects.motion import Shape
from flexid_cli.effects.signature import CYCLES_PER_SPEED, POINTS_PER_CYCLE, Scale
from flexid_cli.pipeline import filters

Array = NDArray[np.float64]

MOST_POINTS = 500
# Periods in the range of motion: a wave that hardly repeats is any function of the position. See docs/diagnosis.md.
LEAST_PERIODS = 2.5


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
    """Cycles per radian of motor motion that this record can show; None where there are none."""
    once = 2.0 * math.pi / max(scale.motor_range, 1e-12)
    low, high = LEAST_PERIODS * once, 2.0 * math.pi * scale.band_hz / (CYCLES_PER_SPEED * scale.motor_speed)
    if high <= low:
        return None
    points = int(np.clip(POINTS_PER_CYCLE * (high - low) / once, 12, MOST_POINTS))
    return (Shape(name, low, high, points, "linear"),)


def lagged(x: Array, lag_s: float, period_s: float) -> Array:
    """First-order lag of a signal that is linear between its samples, started at rest on its first value."""
    decay = math.exp(-period_s / lag_s)
    share = lag_s / period_s * (1.0 - decay)
    return filters.settled(x, np.array([[1.0 - share, share - decay, 0.0, 1.0, -decay, 0.0]]))


def resonant(x: Array, frequency_hz: float, damping_ratio: float, period_s: float) -> Array:
    """(2 z w s + w^2) / (s^2 + 2 z w s + w^2) of a signal, by the bilinear transform that keeps w in its place."""
    w = 2.0 * math.pi * frequency_hz
    c = w / math.tan(0.5 * w * period_s)  # s = c (z - 1) / (z + 1)
    damping = 2.0 * damping_ratio * w * c
    b = np.array([damping + w * w, 2.0 * w * w, w * w - damping])
    a = np.array([c * c + damping + w * w, 2.0 * (w * w - c * c), c * c - damping + w * w])
    return filters.settled(x, (np.concatenate([b, a]) / a[0])[None, :])
