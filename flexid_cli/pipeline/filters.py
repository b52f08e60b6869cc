"""Zero-phase filters in second-order sections: Butterworth low pass, and the decimation filter of the paper."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from flexid_cli.errors import UsageError
from flexid_cli.pipeline.tuning import DECIMATION_EDGE

Array = NDArray[np.float64]

# MATLAB's decimate, which the paper uses: Chebyshev I of order 8, 0.05 dB ripple, at DECIMATION_EDGE of the new
# Nyquist rate.
DECIMATION_ORDER = 8
DECIMATION_RIPPLE_DB = 0.05
# A pole is real if its imaginary part is rounding.
REAL_POLE = 1e-12


def butterworth(order: int, cutoff_hz: float, sample_rate_hz: float) -> Array:
    """Second-order sections of a Butterworth low pass; ``order`` is that of one direction.

    Forward and backward its magnitude is 1 / (1 + (f / cutoff)^(2 order)), eq. (25): -6 dB at the cutoff.

    Raises
    ------
    UsageError
        The cutoff is not below half the sampling rate.
    """
    if not 0.0 < cutoff_hz < 0.5 * sample_rate_hz:
        raise UsageError(
            f"low-pass cutoff {cutoff_hz:g} Hz is not between 0 and half the sampling rate"
            f" ({0.5 * sample_rate_hz:g} Hz)",
            "lower pipeline.lowpass.cutoff_hz or leave it out",
        )
    return _butterworth(order, cutoff_hz, sample_rate_hz).copy()


@lru_cache(maxsize=64)
def _butterworth(order: int, cutoff_hz: float, sample_rate_hz: float) -> Array:
    angle = 0.5 * np.pi * (np.arange(1, 2 * order, 2) / order + 1.0)
    return _sections(np.exp(1j * angle), cutoff_hz / sample_rate_hz)


def decimation_filter(factor: int) -> Array:
    """Second-order sections of the low pass before keeping one sample in ``factor`` (1: all-pass)."""
    return _decimation_filter(factor).copy()


@lru_cache(maxsize=64)
def _decimation_filter(factor: int) -> Array:
    if factor == 1:
        return np.array([[1.0, 0.0, 0.0, 1.0, 0.0, 0.0]])
    ripple = 10.0 ** (DECIMATION_RIPPLE_DB / 10.0)
    width = np.arcsinh(1.0 / np.sqrt(ripple - 1.0)) / DECIMATION_ORDER
    angle = 0.5 * np.pi * np.arange(1 - DECIMATION_ORDER, DECIMATION_ORDER, 2) / DECIMATION_ORDER
    sos = _sections(-np.sinh(width + 1j * angle), 0.5 * DECIMATION_EDGE / factor)
    # An even order ripples down from one, and its gain at rest is the lowest.
    sos[0, :3] /= np.sqrt(ripple)
    return sos


def _sections(prototype: NDArray[np.complex128], cutoff: float) -> Array:
    """Sections of a low pass, each with gain one at rest, by the bilinear transform of an analog prototype.

    Parameters
    ----------
    prototype : ndarray, shape (order,)
        Poles of the analog low pass with cutoff 1 rad/s; it has no zeros.
    cutoff : float
        Cutoff over the sampling rate; there the digital filter is as the prototype at 1 rad/s.
    """
    analog = np.tan(np.pi * cutoff) * prototype
    poles = (1.0 + analog) / (1.0 - analog)
    pairs = [np.array([1.0, -2.0 * p.real, abs(p) ** 2]) for p in poles if p.imag > REAL_POLE]
    single = [np.array([1.0, -p.real, 0.0]) for p in poles if abs(p.imag) <= REAL_POLE]
    # Sections that ring most come last, behind those that damp.
    ordered = sorted(single + pairs, key=lambda a: a[2])
    zeros = [np.array([1.0, 1.0, 0.0]) if a[2] == 0.0 else np.array([1.0, 2.0, 1.0]) for a in ordered]
    return np.array(
        [np.concatenate([b * (a.sum() / b.sum()), a]) for b, a in zip(zeros, ordered, strict=True)]
    )


def zero_phase(x: Array, sos: Array, *, settled_edges: bool = True) -> Array:
    """Filter forward and backward.

    Parameters
    ----------
    x : ndarray, shape (n,)
        Samples.
    sos : ndarray, shape (sections, 6)
        Second-order sections.
    settled_edges : bool
        Extend the signal by odd reflection, as MATLAB's filtfilt does. Without it the filter starts at rest:
        then it is the same linear operator for every column whatever its noise at the first sample, which is
        what parallel decimation needs.
    """
    if settled_edges:
        return _settled_both_ways(x, sos)
    result = np.array(x, dtype=np.float64)
    return _both_ways(result, sos, np.zeros((sos.shape[0], 2)))


def _settled_both_ways(x: Array, sos: Array) -> Array:
    """Forward and backward over the odd extension, each pass from the rest state of its first value."""
    padding = min(settling_samples(sos), x.size - 1)
    before = 2.0 * x[0] - x[padding:0:-1]
    after = 2.0 * x[-1] - x[-2 : -padding - 2 : -1]
    extended = np.concatenate([before, x, after])
    rest = _rest_state(sos.tobytes(), sos.shape[0])
    return _both_ways(extended, sos, rest)[padding : padding + x.size].copy()


def settled(x: Array, sos: Array) -> Array:
    """Filter forward only, from the rest state of the first value."""
    from flexid_cli.pipeline.cascade import filter_in_place

    result = np.array(x, dtype=np.float64)
    filter_in_place(result, sos, _rest_state(sos.tobytes(), sos.shape[0]), False)
    return result


def _both_ways(x: Array, sos: Array, rest: Array) -> Array:
    """The samples filtered in place, forward and then backward."""
    from flexid_cli.pipeline.cascade import filter_in_place

    filter_in_place(x, sos, rest, False)
    filter_in_place(x, sos, rest, True)
    return x


@lru_cache(maxsize=64)
def _rest_state(sections: bytes, count: int) -> Array:
    """State of each section after a long constant input of one, shape (sections, 2)."""
    states, level = [], 1.0
    for b0, b1, b2, _, a1, a2 in np.frombuffer(sections).reshape(count, 6):
        out = level * (b0 + b1 + b2) / (1.0 + a1 + a2)
        last = b2 * level - a2 * out
        states.append([b1 * level - a1 * out + last, last])
        level = out
    return np.array(states)


def magnitude(sos: Array, frequency_hz: Array, sample_rate_hz: float) -> Array:
    """Forward-backward magnitude of ``sos`` at the given frequencies."""
    delay = np.exp(-2j * np.pi * frequency_hz / sample_rate_hz)
    powers = np.stack([np.ones_like(delay), delay, delay**2])
    response = np.prod((sos[:, :3] @ powers) / (sos[:, 3:] @ powers), axis=0)
    return np.asarray(np.abs(response) ** 2, dtype=np.float64)


def settling_samples(sos: Array, remaining: float = 1e-3) -> int:
    """Samples until the slowest pole has decayed to ``remaining``."""
    a1, a2 = sos[:, 4], sos[:, 5]
    spread = a1**2 - 4.0 * a2
    real = 0.5 * (np.abs(a1) + np.sqrt(np.maximum(spread, 0.0)))
    radius = float(np.max(np.where(spread < 0.0, np.sqrt(np.abs(a2)), real)))
    if radius < 1e-6:
        return 1
    return int(np.ceil(np.log(remaining) / np.log(min(radius, 1.0 - 1e-9)))) + 1
