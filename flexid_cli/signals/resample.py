"""Values between the samples: interpolation without aliasing and without delay. Arrays in, arrays out.

Samples whose stamps are those wanted are handed on as they are. Everything else goes through a spline;
uniform samples are first brought to a finer grid by a linear-phase FIR filter, for a quintic spline alone is
exact to 1e-4 only below a third of the Nyquist frequency (error 2 (w / (2 pi - w))^6 at w radians a sample;
Unser, "Splines: a perfect fit for signal and image processing", IEEE Signal Processing Magazine 16(6), 1999).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flexid_cli.signals.recording import Array
from flexid_cli.signals.timebase import UNIFORM_JITTER, Track, fill_missing

PASS_BAND = 0.8
STOP_DB = 80.0
LOWPASS_FROM = 1.1
SPLINE_BAND = 0.15
NEAREST_STEP = 0.1
SHORTEST_BLOCK = 1024


@dataclass(frozen=True)
class Resampled:
    """Values of one signal on the common grid.

    Attributes
    ----------
    values : ndarray, shape (m,)
        At the instants asked for.
    copied : int
        How many of them are samples of the log, unchanged.
    taps : int
        Length of the low-pass filter, 0 where none was needed.
    """

    values: Array
    copied: int
    taps: int = 0


def resample(track: Track, instants: Array, period_ns: float, *, may_lowpass: bool = True) -> Resampled:
    """Values of a signal at ``instants``.

    Parameters
    ----------
    track : Track
        The signal.
    instants : ndarray, shape (m,)
        Times in ns inside one of its segments, ascending.
    period_ns : float
        Period of the common grid. A signal sampled more than 1.1 times as fast is low-passed first (what a
        smaller ratio folds stays above 0.9 of the Nyquist frequency).
    may_lowpass : bool
        False for a signal that shall only be interpolated.

    Returns
    -------
    Resampled
    """
    stamps, values = _segment_of(track, instants)
    ratio = period_ns / track.period_ns
    if may_lowpass and ratio > LOWPASS_FROM:
        position, uniform = _uniform_samples(track, stamps, values)
        fine, up, taps = _refine(uniform, PASS_BAND / (2.0 * ratio), 1.0 / (2.0 * ratio))
        return Resampled(_spline_at(fine, up * position(instants)), 0, taps)
    nearest = _nearest(stamps, instants)
    slack = UNIFORM_JITTER * track.period_ns if track.is_uniform else 1.0
    same = np.abs(stamps[nearest] - instants) <= slack
    copied = int(np.count_nonzero(same))
    if copied == instants.size:
        return Resampled(values[nearest], copied)
    if track.is_uniform and 2 * copied < instants.size:
        position, uniform = _uniform_samples(track, stamps, values)
        fine, up, _ = _refine(uniform, PASS_BAND / 2.0, 1.0 - PASS_BAND / 2.0)
        between = _spline_at(fine, up * position(instants))
    else:
        between = _irregular_spline(stamps, values, instants, track.period_ns)
    return Resampled(np.where(same, values[nearest], between), copied)


def _segment_of(track: Track, instants: Array) -> tuple[Array, Array]:
    middle = 0.5 * (instants[0] + instants[-1])
    starts = track.stamps[[first for first, _ in track.segments]]
    first, stop = track.segments[max(int(np.searchsorted(starts, middle, side="right")) - 1, 0)]
    return track.stamps[first:stop].astype(np.float64), track.values[first:stop]


def _nearest(stamps: Array, instants: Array) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    after = np.clip(np.searchsorted(stamps, instants), 1, max(stamps.size - 1, 1))
    if stamps.size == 1:
        return np.zeros(instants.size, dtype=np.intp)
    return np.where(instants - stamps[after - 1] <= stamps[after] - instants, after - 1, after)


class _Position:
    """Index on a uniform grid as a function of time."""

    def __init__(self, grid: Array) -> None:
        self._grid = grid

    def __call__(self, instants: Array) -> Array:
        inner = np.interp(instants, self._grid, np.arange(self._grid.size, dtype=np.float64))
        step = (self._grid[-1] - self._grid[0]) / max(self._grid.size - 1, 1)
        beyond = np.minimum(instants - self._grid[0], 0.0) + np.maximum(instants - self._grid[-1], 0.0)
        return np.asarray(inner + beyond / step if step else inner)


def _uniform_samples(track: Track, stamps: Array, values: Array) -> tuple[_Position, Array]:
    """Bring one segment to the signal's own uniform grid."""
    if track.is_uniform:
        grid = fill_missing(stamps, track.period_ns)
        if grid.size == stamps.size:
            return _Position(grid), values
    else:
        count = int((stamps[-1] - stamps[0]) / track.period_ns + UNIFORM_JITTER) + 1
        grid = stamps[0] + np.arange(count) * track.period_ns
    return _Position(grid), _irregular_spline(stamps, values, grid, track.period_ns)


def _irregular_spline(stamps: Array, values: Array, instants: Array, period_ns: float) -> Array:
    """Interpolate between samples at any distances: quintic where these are nearly equal, else cubic.

    A sample that follows another by less than a tenth of a period is left out: noise between the two would be
    a slope.
    """
    from scipy.interpolate import make_interp_spline

    time = (stamps - stamps[0]) / period_ns
    keep = np.concatenate(([True], np.diff(time) >= NEAREST_STEP))
    time, values = time[keep], values[keep]
    steps = np.diff(time)
    degree = 5 if steps.size and steps.min() > 0.5 and steps.max() < 1.5 else 3
    spline = make_interp_spline(time, values, k=_possible_degree(degree, time.size))
    return np.asarray(spline((instants - stamps[0]) / period_ns))


def _spline_at(values: Array, position: Array) -> Array:
    from scipy.interpolate import make_interp_spline

    index = np.arange(values.size, dtype=np.float64)
    return np.asarray(make_interp_spline(index, values, k=_possible_degree(5, values.size))(position))


def _possible_degree(degree: int, samples: int) -> int:
    """Return the degree, or the highest odd one that so few samples allow."""
    highest = max(samples - 1, 0)
    return min(degree, highest if highest % 2 or not highest else highest - 1)


def _refine(values: Array, pass_edge: float, stop_edge: float) -> tuple[Array, int, int]:
    """Refine the grid ``up`` times, and remove what lies above ``stop_edge`` (cycles per sample).

    The filter is symmetric, so it delays nothing; beyond its ends the signal is continued by odd reflection.

    Returns
    -------
    fine : ndarray, shape ((n - 1) * up + 1,)
    up, taps : int
    """
    up = max(1, math.ceil(pass_edge / SPLINE_BAND))
    window = up * _kaiser_lowpass((pass_edge + stop_edge) / up, 2.0 * (stop_edge - pass_edge) / up)
    half = window.size // 2
    reach = -(-half // up)
    padded = np.pad(values, reach, mode="reflect", reflect_type="odd")
    fine = np.empty((padded.size - 1) * up + window.size)
    for phase in range(up):
        part = _convolve(padded, window[phase::up])
        fine[phase::up] = part[: fine[phase::up].size]
    first = reach * up + half
    return fine[first : first + (values.size - 1) * up + 1], up, window.size


def _kaiser_lowpass(cutoff: float, width: float) -> Array:
    """Impulse response of gain one at rest; cutoff and width of the transition over the Nyquist frequency.

    Kaiser's formulae for length and window: Oppenheim and Schafer, "Discrete-Time Signal Processing", 7.5.
    """
    attenuation = STOP_DB + 2.0
    taps = math.ceil((attenuation - 7.95) / (2.285 * math.pi * width) + 1.0)
    taps += 1 - taps % 2
    index = np.arange(taps) - taps // 2
    window = np.sinc(cutoff * index) * np.kaiser(taps, 0.1102 * (attenuation - 8.7))
    return np.asarray(window / window.sum())


def _convolve(x: Array, window: Array) -> Array:
    """Full convolution with a short window, block by block (overlap and add)."""
    from scipy.fft import irfft, next_fast_len, rfft

    size = next_fast_len(max(8 * window.size, SHORTEST_BLOCK), real=True)
    step = size - window.size + 1
    spectrum = rfft(window, size)
    out = np.zeros(x.size + window.size - 1)
    for start in range(0, x.size, step):
        part = irfft(spectrum * rfft(x[start : start + step], size), size)
        out[start : start + size] += part[: out.size - start]
    return out
