"""Noise of the recorded torque: what no linear relation with the recorded motion explains of it.

In a narrow band of frequencies any linear relation is a gain that bends little, so that a least-squares fit there
needs no model of controller or mechanism (local polynomial method: Pintelon, Schoukens, Vandersteen and Barbe, Mech.
Syst. Signal Process. 24 (2010) 573). A drive's controller makes its torque of reference and measured position, noise
of the encoder and all: with both as inputs the rest is noise at every frequency, whatever the axis is. Without the
reference it is so only above the band of the motion.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from flexid_cli.signals.recording import Segment

Array = NDArray[np.float64]

# Lines on either side of a frequency, and of the polynomials there.
HALF_WINDOW, ORDER = 12, 1
FREQUENCIES = 60
# Range over the band: from its foot where the reference is known, else from above it.
LOWEST, ABOVE, HIGHEST = 0.05, 1.1, 2.2
HIGHEST_OVER_RATE = 0.35  # above it resampling has cut the torque
LEAST_FREQUENCIES = 8
# The level at rest is at most so many times what is seen just above the band: what lies below may be no noise.
MOST_FALL = 5.0
CORNERS = 40


def torque_noise(segment: Segment, rate_hz: float, band_hz: float) -> tuple[float, float] | None:
    """Variance a sample that white noise of the level at rest would have, and the corner of its fall.

    Parameters
    ----------
    segment : Segment
        Joint side, SI.
    rate_hz, band_hz : float
        Sampling rate, and highest frequency at which the motion stands out of its noise.

    Returns
    -------
    level, corner_hz : float
        (N m)^2, Hz; the density is that of a first-order low pass, infinite corner: white. None where the record is
        too short, or its band reaches too far, to tell.
    """
    inputs = [segment.motor_position]
    if segment.joint_position is not None:
        inputs.append(segment.joint_position)
    lowest = ABOVE * band_hz
    if segment.reference_position is not None:
        inputs.append(segment.reference_position)
        lowest = LOWEST * band_hz
    highest = min(HIGHEST * band_hz, HIGHEST_OVER_RATE * rate_hz)
    line = rate_hz / segment.samples
    frequency = np.linspace(max(lowest, HALF_WINDOW * line), highest, FREQUENCIES)
    if highest - frequency[0] < LEAST_FREQUENCIES * HALF_WINDOW * line:
        return None
    variance = local_variance(segment.torque, inputs, np.rint(frequency / line).astype(int))
    return first_order(frequency, variance, band_hz)


def local_variance(output: Array, inputs: Sequence[Array], lines: NDArray[np.intp]) -> Array:
    """Variance a sample of white noise with the density of what the inputs leave of the output at each line.

    Parameters
    ----------
    output, inputs : ndarray, shape (n,)
        Signals of one segment.
    lines : ndarray of int, shape (m,)
        Lines of their transforms about which to fit.

    Returns
    -------
    ndarray, shape (m,)
        Above zero.
    """
    Y, *U = (np.fft.rfft(x - x.mean()) for x in (output, *inputs))
    out = np.empty(lines.size)
    for i, line in enumerate(lines):
        k = np.arange(max(line - HALF_WINDOW, 1), min(line + HALF_WINDOW + 1, Y.size))
        powers = [((k - line) / HALF_WINDOW) ** p for p in range(ORDER + 1)]
        # The polynomial alone is what start and end of the record leak into the window.
        W = np.column_stack([*powers, *(u[k] * p for u in U for p in powers)])
        size = np.linalg.norm(W, axis=0)
        W = W / np.where(size > 0.0, size, 1.0)
        solution, _, rank, _ = np.linalg.lstsq(W, Y[k], rcond=1e-10)
        left = np.abs(Y[k] - W @ solution) ** 2
        out[i] = left.sum() / max(k.size - int(rank), 1) / output.size
    return np.maximum(out, np.finfo(np.float64).tiny)


def first_order(frequency_hz: Array, variance: Array, band_hz: float) -> tuple[float, float]:
    """Level and corner of L / (1 + (f / corner)^2) that come nearest in the mean of the logarithm's modulus."""
    best = (np.inf, 0.0, np.inf)
    edge = ABOVE * band_hz
    # The fall from rest to just above the band is MOST_FALL at the lowest corner.
    corners = edge / np.sqrt(MOST_FALL - 1.0) * np.geomspace(1.0, 10.0, CORNERS)
    for corner in (np.inf, *corners):
        logs = np.log(variance) + np.log1p((frequency_hz / corner) ** 2)
        level = float(np.median(logs))
        loss = float(np.mean(np.abs(logs - level)))
        if loss < best[0]:
            best = loss, level, corner
    return float(np.exp(best[1])), float(best[2])
