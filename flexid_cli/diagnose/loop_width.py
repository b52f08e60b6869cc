"""Width of the loop of torque over torsion against frequency: friction in the transmission, or damping.

In each band of frequency the transmission may pass a torque a quarter period ahead of the torsion: its size over
the torsion's is the loss stiffness, and twice that times the torsion's amplitude the width of the loop. Damping
grows with the frequency (slope one), a loop that does not depend on the rate has slope zero. The parameters of the
model stay free, or their errors would stand in it; noise of the torsion is in phase with itself and does not. Where
the torsion's amplitude differs much between the bands, what depends on the amplitude stands in the slope too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexid_cli.diagnose.bands import correlated_rows, spread
from flexid_cli.diagnose.basis import Basis
from flexid_cli.diagnose.location import hats
from flexid_cli.diagnose.problem import Problem
from flexid_cli.diagnose.result import LoopWidth
from flexid_cli.diagnose.stretch import Stretch
from flexid_cli.effects.motion import Motion, Terms

Array = NDArray[np.float64]

BANDS = 6
PERIODS = 10.0  # of the lowest frequency in the record
PRESENT = 0.02  # of the torsion's RMS: bands with less say nothing
FEWEST_BANDS = 3


@dataclass(frozen=True)
class _Bands:
    """Frequencies between which the loss stiffness is linear, and the torsion's amplitude about each."""

    frequency_hz: Array
    torsion: Array


def loop_width(problem: Problem, now: Basis, *, unit: str, torque_unit: str) -> LoopWidth | None:
    """Loss stiffness in bands of frequency; None where both encoders are not there, or too few bands are."""
    if not problem.both:
        return None
    bands = _bands(problem)
    if bands.frequency_hz.size < FEWEST_BANDS:
        return None
    stiffness, stderr, half, share = _fitted(problem, now, bands)
    slope, slope_stderr = log_slope(bands.frequency_hz, stiffness, stderr, half)
    width = 2.0 * np.abs(stiffness) * bands.torsion
    return LoopWidth(
        bands.frequency_hz,
        stiffness,
        half,
        bands.torsion,
        width,
        slope,
        slope_stderr,
        share,
        unit,
        torque_unit,
    )


def log_slope(
    frequency_hz: Array, stiffness: Array, stderr: Array, half: Array
) -> tuple[float | None, float | None]:
    """Slope of log stiffness over log frequency and its standard error, from bands that show a loop for sure."""
    sure = stiffness > half
    if np.count_nonzero(sure) < FEWEST_BANDS:
        return None, None
    x, y = np.log(frequency_hz[sure]), np.log(stiffness[sure])
    weight = np.square(stiffness[sure] / stderr[sure])
    x = x - np.average(x, weights=weight)
    size = float(weight @ np.square(x))
    slope = float((weight * x) @ y) / size
    left = y - np.average(y, weights=weight) - slope * x
    # A straight line may not hold: then the scatter about it counts.
    scatter = max(float(weight @ np.square(left)) / (x.size - 2), 1.0)
    return slope, float(np.sqrt(scatter / size))


def _bands(problem: Problem) -> _Bands:
    low = min(PERIODS / max(problem.duration_s, 1e-9), 0.5 * problem.band_hz)
    knots = np.geomspace(low, problem.band_hz, BANDS)
    k = int(np.argmax([m.deflection.size for m in problem.motions]))
    s, m = problem.stretches[k], problem.motions[k]
    power = np.square(np.abs(s.spectrum(m.deflection - m.deflection.mean())[:, 0]))
    share = power @ hats(s.taper.frequency_hz, knots) / power.sum()
    there = share > PRESENT**2
    return _Bands(knots[there], np.sqrt(2.0 * share[there]) * float(np.std(m.deflection)))


def _quadrature(m: Motion, s: Stretch, knots: Array) -> Array:
    """Torsion about each frequency a quarter period ahead, shape (n, knots)."""
    from scipy.fft import irfft, next_fast_len, rfft

    n = m.deflection.size
    size = next_fast_len(n, real=True)
    X = rfft(m.deflection - m.deflection.mean(), size)
    # Linear between the frequencies: a constant loss and one that grows with frequency are both met exactly.
    parts = hats(np.asarray(np.fft.rfftfreq(size, s.period_s), dtype=np.float64), knots)
    return np.column_stack([irfft(1j * X * part, size)[:n] for part in parts.T])


def _fitted(problem: Problem, now: Basis, bands: _Bands) -> tuple[Array, Array, Array, float]:
    """Loss stiffness of each band, its standard error, half width of its band, and what all explain."""
    stretches = {id(m): s for m, s in zip(problem.motions, problem.stretches, strict=True)}

    def terms(m: Motion) -> Terms:
        return Terms(transmission=_quadrature(m, stretches[id(m)], bands.frequency_hz))

    # A quarter period ahead, noise of the torsion is no stiffness.
    C, _ = problem.effect_rows(terms, np.zeros(bands.frequency_hz.size))
    P = now.outside(C)
    influence = np.linalg.pinv(P, rcond=1e-4)
    values = influence @ now.residual
    left = now.residual - P @ values
    rows = problem.row_times.size
    parts = (influence * left).reshape(bands.frequency_hz.size, -1, rows).sum(axis=1).T
    lengths = [int(w.open.sum()) for w in problem.weights]
    size = spread(parts, lengths, correlated_rows(left[:rows], lengths))
    return values, size.stderr, size.half_width(), 1.0 - float(left @ left) / max(now.cost, 1e-300)
