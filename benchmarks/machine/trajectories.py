"""References of the motor position: what a person commissioning an axis would run.

All start at rest at ``centre`` and fade in. ``travel`` is the largest deviation from the centre, ``speed`` and
``acceleration`` what the drive may do; where a frequency asks for more, the amplitude shrinks with it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FADE_S = 1.0


@dataclass(frozen=True)
class Limits:
    """What the drive may do, joint side: rad, rad/s, rad/s2; and where it stands."""

    travel: float
    speed: float
    acceleration: float
    centre: float = 0.0

    def amplitude(self, frequency_hz: Array) -> Array:
        """Largest amplitude of a sine of this frequency."""
        omega = 2.0 * np.pi * np.maximum(frequency_hz, 1e-9)
        return np.asarray(1.0 / (1.0 / self.travel + omega / self.speed + omega**2 / self.acceleration))


def chirp(
    limits: Limits, duration_s: float, rate_hz: float, low_hz: float = 0.1, high_hz: float = 10.0
) -> Array:
    """Sine whose frequency rises exponentially from ``low_hz`` to ``high_hz``.

    Returns
    -------
    ndarray, shape (round(duration_s * rate_hz),)
    """
    time = _time(duration_s, rate_hz)
    growth = np.log(high_hz / low_hz) / duration_s
    frequency = low_hz * np.exp(growth * time)
    return _swept(limits, frequency, rate_hz, time)


def updown(
    limits: Limits, duration_s: float, rate_hz: float, low_hz: float = 0.1, high_hz: float = 10.0
) -> Array:
    """Up chirp and its way back, so that time and frequency are not one and the same."""
    time = _time(duration_s, rate_hz)
    place = 1.0 - np.abs(2.0 * time / duration_s - 1.0)
    frequency = low_hz * np.exp(np.log(high_hz / low_hz) * place)
    return _swept(limits, frequency, rate_hz, time)


def rich(
    limits: Limits,
    duration_s: float,
    rate_hz: float,
    rng: np.random.Generator,
    low_hz: float = 0.1,
    high_hz: float = 10.0,
    lines: int = 40,
) -> Array:
    """Multisine of random phases on a slow triangular sweep, half of the travel for each.

    The lines lie between ``low_hz`` and ``high_hz``, evenly on a logarithmic scale and off each other's harmonics.
    """
    time = _time(duration_s, rate_hz)
    frequency = np.exp(np.linspace(np.log(3.0 * low_hz), np.log(high_hz), lines))
    frequency *= 1.0 + 0.02 * rng.uniform(-1.0, 1.0, lines)
    amplitude = limits.amplitude(frequency)
    phase = rng.uniform(0.0, 2.0 * np.pi, lines)
    waves = np.zeros(time.size)
    for a, f, p in zip(amplitude, frequency, phase, strict=True):
        waves += a * np.sin(2.0 * np.pi * f * time + p)
    waves = _within(waves, 0.5, limits, rate_hz)
    slow = _triangles(0.5 * limits.travel, 0.3 * limits.speed, time, rng)
    return np.asarray(limits.centre + _fade(time) * (waves - waves[0] + slow))


def triangles(limits: Limits, duration_s: float, rate_hz: float, rng: np.random.Generator) -> Array:
    """Slow triangular sweeps of speeds from 3 to 100 % of ``limits.speed``, corners rounded."""
    time = _time(duration_s, rate_hz)
    return np.asarray(limits.centre + _fade(time) * _triangles(limits.travel, limits.speed, time, rng))


def _time(duration_s: float, rate_hz: float) -> Array:
    return np.arange(round(duration_s * rate_hz)) / rate_hz


def _fade(time: Array) -> Array:
    """From 0 to 1 without a jump in velocity or acceleration."""
    s = np.clip(time / FADE_S, 0.0, 1.0)
    return np.asarray(s**3 * (10.0 - 15.0 * s + 6.0 * s**2))


def _swept(limits: Limits, frequency: Array, rate_hz: float, time: Array) -> Array:
    phase = 2.0 * np.pi * np.cumsum(frequency) / rate_hz
    waves = limits.amplitude(frequency) * np.sin(phase - phase[0])
    return np.asarray(limits.centre + _fade(time) * waves)


def _within(waves: Array, share: float, limits: Limits, rate_hz: float) -> Array:
    """Scale to a share of the limits, whichever binds first."""
    speed = np.diff(waves) * rate_hz
    acceleration = np.diff(speed) * rate_hz
    worst = max(
        float(np.max(np.abs(waves - waves[0]))) / (share * limits.travel),
        float(np.max(np.abs(speed))) / limits.speed,
        float(np.max(np.abs(acceleration))) / (1.5 * limits.acceleration),
    )
    return np.asarray(waves / worst)


def _triangles(travel: float, speed: float, time: Array, rng: np.random.Generator) -> Array:
    """Back and forth at constant speeds, another speed for each way; corners rounded over 0.2 s."""
    period = float(time[1] - time[0])
    velocity = np.empty(time.size)
    place, i, direction = 0.0, 0, 1.0
    while i < time.size:
        target = direction * travel * rng.uniform(0.6, 1.0)
        v = speed * float(np.exp(rng.uniform(np.log(0.1), 0.0)))
        v = max(v, abs(target - place) / 8.0)  # no way longer than 8 s, or a record would hold one or two
        count = max(1, round(abs(target - place) / v / period))
        velocity[i : i + count] = direction * v
        i, place, direction = i + count, target, -direction
    width = max(1, round(0.2 / period))
    smooth = np.convolve(np.pad(velocity, (width, 0)), np.hanning(width + 2)[1:-1], mode="full")
    smooth = smooth[width : width + time.size] / np.hanning(width + 2)[1:-1].sum()
    return np.asarray(np.cumsum(smooth) * period)
