"""Covariance of estimates when residuals are correlated: heteroscedasticity- and autocorrelation-robust.

Orthonormal-series estimator with equal weights on B cosines (Lazarus, Lewis, Stock and Watson, J. Business and
Economic Statistics 36 (2018) 541): the long-run covariance of the scores is the mean square of their first B
cosine transforms, and the estimate over its standard error follows Student's t with B degrees of freedom.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# B = 0.41 T^(2/3): the authors' rule for the least size distortion at a tolerable loss of power.
SERIES_FACTOR = 0.41
SERIES_POWER = 2.0 / 3.0
# Autocovariances reach to this multiple of the square root of the rows.
LAG_FACTOR = 2.0
# A row that one parameter follows all by itself says nothing of its own noise.
MAX_LEVERAGE = 0.9


@dataclass(frozen=True)
class RobustCovariance:
    """Covariance of the estimates and the degrees of freedom of each one's t statistic.

    Attributes
    ----------
    covariance : ndarray, shape (p, p)
        bread' S bread.
    degrees_of_freedom : ndarray, shape (p,)
        For Student's t; below B where a parameter's score is concentrated in a part of the record.
    series : int
        B.
    """

    covariance: Array
    degrees_of_freedom: Array
    series: int


def series_length(rows: int, parameters: int) -> int:
    """Number of cosines B for a record of ``rows``."""
    wanted = int(SERIES_FACTOR * float(rows) ** SERIES_POWER + 0.5)
    return max(min(wanted, rows - 1), min(parameters + 2, rows - 1), 1)


def robust_covariance(scores: Array, bread: Array, lengths: Sequence[int]) -> RobustCovariance:
    """Covariance ``bread' S bread`` with S the long-run covariance of the scores.

    Parameters
    ----------
    scores : ndarray, shape (r, p)
        Derivative of each row's part of the cost: W_i e_i summed over the equations of one instant.
    bread : ndarray, shape (p, p)
        Inverse of the cost's Hessian, (W'W)^-1.
    lengths : sequence of int
        Rows of each gap-free segment, in order: a cosine runs through each segment of its own, so that a gap
        does not count as correlation. Their B share the rows in proportion.

    Returns
    -------
    RobustCovariance
    """
    rows, parameters = scores.shape
    influence = scores @ bread
    total = series_length(rows, parameters)
    covariance = np.zeros((parameters, parameters))
    series, start = 0, 0
    parts = []
    for length in lengths:
        part = influence[start : start + length]
        start += length
        count = min(max(1, round(total * length / rows)), max(length - 1, 1))
        transforms = np.sqrt(2.0 / length) * _cosine_sums(part, count)[1:]
        covariance += transforms.T @ transforms * (length / count)
        series += count
        parts.append((part, count))
    correction = rows / max(rows - parameters, 1)
    return RobustCovariance(
        covariance=covariance * correction,
        degrees_of_freedom=_degrees_of_freedom(parts),
        series=series,
    )


def row_scores(instruments: Array, jacobian: Array, bread: Array, residuals: Array, blocks: int) -> Array:
    """Score of each instant: instruments times residuals, summed over the equations, leverage allowed for.

    Where a short stretch determines several parameters, they take up the noise in it, and the residual shows too
    little of it: divided by one minus its leverage it is what leaving out the row would show (MacKinnon and White,
    J. Econometrics 29 (1985) 305).

    Parameters
    ----------
    instruments, jacobian : ndarray, shape (blocks * r, p)
        What the residuals are made orthogonal to, and their derivative.
    bread : ndarray, shape (p, p)
        Inverse of instruments' jacobian.
    residuals : ndarray, shape (blocks * r,)
        Weighted residuals, stacked by equation.

    Returns
    -------
    ndarray, shape (r, p)
    """
    share = np.clip(np.sum((jacobian @ bread) * instruments, axis=1), 0.0, MAX_LEVERAGE)
    scores = instruments * (residuals / (1.0 - share))[:, None]
    return np.asarray(scores.reshape(blocks, -1, instruments.shape[1]).sum(axis=0), dtype=np.float64)


def combined_covariance(
    instruments: Array, jacobian: Array, bread: Array, residuals: Array, blocks: int, lengths: Sequence[int]
) -> RobustCovariance:
    """Covariance of estimates: the robust one, widened to what stationary residuals would give where that is more.

    A sweep informs on a parameter in a short stretch only. There the parameters take up a good part of slow noise,
    and few cosines are left to see the rest; the remaining record shows the same noise undisturbed.

    Parameters
    ----------
    instruments, jacobian, bread, residuals, blocks
        As `row_scores`.
    lengths : sequence of int
        Rows of each gap-free segment.
    """
    scores = row_scores(instruments, jacobian, bread, residuals, blocks)
    robust = robust_covariance(scores, bread.T, lengths)
    stationary = _stationary(instruments, residuals, bread, blocks, lengths)
    ratio = np.diag(stationary) / np.maximum(np.diag(robust.covariance), np.finfo(float).tiny)
    wider = np.sqrt(np.maximum(ratio, 1.0))
    dof = np.where(
        ratio > 1.0, np.maximum(robust.degrees_of_freedom, robust.series), robust.degrees_of_freedom
    )
    return RobustCovariance(robust.covariance * np.outer(wider, wider), dof, robust.series)


def _stationary(
    instruments: Array, residuals: Array, bread: Array, blocks: int, lengths: Sequence[int]
) -> Array:
    """Covariance B Z' G Z B' with bread B and the residuals' autocovariances G.

    Parzen's lag window makes G a covariance. Its products are convolutions.
    """
    from scipy.fft import irfft, next_fast_len, rfft

    rows, parameters = residuals.size // blocks, instruments.shape[1]
    e = residuals.reshape(blocks, rows)
    Z = (instruments @ bread.T).reshape(blocks, rows, parameters)
    farthest = LAG_FACTOR * np.sqrt(rows)
    lags = np.arange(min(int(farthest), max(lengths) - 1) + 1)
    spans = [slice(a, b) for a, b in pairwise(accumulate(lengths, initial=0))]
    sizes = [next_fast_len(s.stop - s.start + lags.size, real=True) for s in spans]
    gamma = np.zeros((blocks, blocks, lags.size))
    for s, n in zip(spans, sizes, strict=True):
        E = rfft(e[:, s], n)
        gamma += irfft(E[:, None] * E.conj(), n)[..., : lags.size] / rows
    # Lags of either sign are each other's transpose: one half is enough, with half of lag zero.
    half = gamma * _parzen(lags / farthest)
    half[..., 0] *= 0.5
    total = np.zeros((parameters, parameters))
    for s, n in zip(spans, sizes, strict=True):
        spectrum = np.einsum("abf,bfp->afp", rfft(half, n), rfft(Z[:, s], n, axis=1))
        smoothed = irfft(spectrum, n, axis=1)[:, : s.stop - s.start]
        total += np.tensordot(Z[:, s], smoothed, ((0, 1), (0, 1)))
    return np.asarray((total + total.T) * rows / max(rows - parameters, 1), dtype=np.float64)


def _parzen(x: Array) -> Array:
    return np.where(x <= 0.5, 1.0 - 6.0 * x**2 * (1.0 - x), 2.0 * np.maximum(1.0 - x, 0.0) ** 3)


def _cosine_sums(x: Array, count: int) -> Array:
    """Sums of x cos(pi j (t - 1/2) / T) over the rows, for j of 0 to ``count``, shape (count + 1, columns)."""
    from scipy.fft import dct

    sums = 0.5 * dct(x, axis=0)
    # At T the cosine is zero, and beyond it that of 2 T - j with its sign turned.
    return np.concatenate([sums, np.zeros_like(sums[:1]), -sums[::-1]])[: count + 1]


def _degrees_of_freedom(parts: Sequence[tuple[Array, int]]) -> Array:
    """Satterthwaite's degrees of freedom of the mean square, tr(M)^2 / tr(M^2) summed over the segments.

    M is the covariance of the transforms if the scores were independent with the variances that they show:
    B for a stationary score, less where a short part of the record carries it.
    """
    parameters = parts[0][0].shape[1]
    trace, square = np.zeros(parameters), np.zeros(parameters)
    for part, count in parts:
        variance = np.column_stack([_smooth(x**2, count) for x in part.T])
        # cos j cos k = (cos (j-k) + cos (j+k)) / 2: M follows from 2 B + 1 sums.
        sums = _cosine_sums(variance, 2 * count) / count
        j = np.arange(1, count + 1)
        difference, total = np.abs(j[:, None] - j), j[:, None] + j
        for k in range(parameters):
            M = sums[difference, k] + sums[total, k]
            trace[k] += np.trace(M)
            square[k] += np.sum(M**2)
    return np.asarray(np.maximum(trace**2 / np.maximum(square, np.finfo(float).tiny), 1.0), dtype=np.float64)


def _smooth(x: Array, count: int) -> Array:
    """Moving average over the shortest half wave of the cosines: single squares are too noisy a variance."""
    width = max(1, min(x.size, round(x.size / count)))
    padded = np.pad(x, (width // 2, width - 1 - width // 2), mode="edge")
    return np.convolve(padded, np.full(width, 1.0 / width), mode="valid")
