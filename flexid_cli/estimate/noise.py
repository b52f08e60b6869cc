"""Noise in the columns: what white noise of the encoders and the torque adds to their cross products.

Every column is a signal through the same chain and a derivative, so the expected cross products of the columns'
noise follow from the noise's level alone, by an integral over frequency. Subtracted from the cross products of the
measured columns, they leave those of the motion (errors in variables; bias-compensated least squares, Stoica and
Soderstrom, Signal Processing 26 (1982); here with known levels and any derivative).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from flexid_cli.pipeline.chain import Chain
from flexid_cli.pipeline.spectrum import welch
from flexid_cli.signals.recording import Recording

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Term = tuple[str, int]
# Column, angular frequency, the chain's first derivative there (1j w where it is exact) -> response to noise of the
# torque, the motor encoder, the joint encoder; shape (3, f)
Response = Callable[[Term, Array, Complex], Complex]

# The floor is read where a drive's motion has died out, in two parts of the spectrum: noise that is white shows the
# same level in both, and where it is not, the difference is the doubt about the level inside the band.
LOW_PART = (0.3, 0.6)
HIGH_PART = (0.6, 0.95)
GRID = 600
# Beyond this multiple of its band the chain lets nothing through.
REACH = 4.0


@dataclass(frozen=True)
class Floors:
    """White noise of each signal (one sigma a sample, SI), and the relative doubt about its variance.

    Attributes
    ----------
    sigma, doubt : tuple of float
        Of torque, motor position, joint position.
    """

    sigma: tuple[float, float, float]
    doubt: tuple[float, float, float]


def floors(recording: Recording) -> Floors:
    """Noise of the signals from the upper part of their spectra, in the longest segment."""
    segment = max(recording.segments, key=lambda s: s.samples)
    found = [_floor(segment.torque), _floor(segment.motor_position)]
    found.append((0.0, 0.0) if segment.joint_position is None else _floor(segment.joint_position))
    levels, doubts = zip(*found, strict=True)
    return Floors(tuple(levels), tuple(doubts))


def _floor(x: Array) -> tuple[float, float]:
    """Standard deviation a sample of white noise with the median density, and the doubt about its square."""
    length = min(1024, x.size - 2)
    # The second difference flattens the steep spectrum of a motion, whose leakage would hide the floor.
    frequency, density = welch(np.diff(x, 2), 1.0, length)
    gain = (2.0 * np.sin(np.pi * frequency)) ** 4
    levels = []
    for low, high in (LOW_PART, HIGH_PART):
        use = (frequency > 0.5 * low) & (frequency < 0.5 * high)
        levels.append(float(np.median(density[use] / gain[use])))
    level = min(levels)
    if level <= 0.0:
        return 0.0, 0.0
    # The median of a density that a few windows average errs by itself.
    windows = max(1.0, 2.0 * x.size / length - 1.0)
    own = 1.25 / np.sqrt(windows * 0.15 * length)
    return float(np.sqrt(0.5 * level)), float(np.hypot(own, max(levels) / level - 1.0))


def measured(term: Term, omega: Array, s: Complex) -> Complex:
    """Response of a measured column: its derivative, of the signals that it holds."""
    signal, order = term
    response = np.zeros((3, omega.size), dtype=np.complex128)
    derivative = s**order
    if signal == "torque":
        response[0] = derivative
    elif signal == "motor":
        response[1] = derivative
    elif signal == "joint":
        response[2] = derivative
    elif signal == "torsion":
        response[1], response[2] = derivative, -derivative
    return response


@lru_cache(maxsize=16)
def _weight(chain: Chain) -> tuple[Array, Array]:
    """Angular frequencies, and what white noise of unit variance a sample puts into each step of the integral."""
    rate = chain.settings.sample_rate_hz
    frequency = np.linspace(0.0, min(0.5 * rate, REACH * chain.band_hz), GRID)
    # Two-sided density of white noise is sigma^2 / rate; twice its half range, by the trapezoidal rule.
    weight = chain.magnitude(np.maximum(frequency, 1e-9)) ** 2 * (2.0 / rate) * (frequency[1] - frequency[0])
    weight[[0, -1]] *= 0.5
    return 2.0 * np.pi * frequency, weight


def moments(
    chain: Chain,
    rows: int,
    sigma: Sequence[float],
    left: Sequence[Term],
    right: Sequence[Term],
    *,
    left_response: Response = measured,
) -> Array:
    """Expected cross products of the columns' noise, shape (left, right).

    Parameters
    ----------
    chain : Chain
        What every column passes.
    rows : int
        Rows that are summed.
    sigma : sequence of 3 floats
        Noise a sample of torque, motor position, joint position.
    left, right : sequence of (signal, derivative)
        The columns; those of ``left`` respond to noise as ``left_response`` says.
    """
    omega, weight = _weight(chain)
    s: Complex = np.asarray(1j * omega, dtype=np.complex128)
    if chain.settings.derivative == "central":
        period = 1.0 / chain.settings.sample_rate_hz
        s = np.asarray(1j * np.sin(omega * period) / period, dtype=np.complex128)
    size = np.asarray(sigma, dtype=np.float64)[:, None] ** 2 * weight
    L = np.array([left_response(term, omega, s) for term in left])
    R = np.array([measured(term, omega, s) for term in right])
    total = np.einsum("isf,sf,jsf->ij", L.real, size, R.real) + np.einsum(
        "isf,sf,jsf->ij", L.imag, size, R.imag
    )
    return np.asarray(rows * total, dtype=np.float64)
