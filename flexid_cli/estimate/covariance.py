"""Covariance of estimates when residuals are correlated: heteroscedasticity- and autocorrelation-robust.

Orthonormal-series estimator with equal weights on B cosines (Lazarus, Lewis, Stock and Watson, J. Business and
Economic Statistics 36 (2018) 541): the long-run covariance of the scores is the mean square of their first B
cosine transforms, and the estimate over its standard error follows Student's t with B degrees of freedom.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# B = 0.41 T^(2/3): the authors' rule for the least size distortion at a tolerable loss of power.
SERIES_FACTOR = 0.41
SERIES_POWER = 2.0 / 3.0


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
        cosines = _cosines(length, max(1, round(total * length / rows)))
        transforms = cosines.T @ part
        covariance += transforms.T @ transforms * (length / cosines.shape[1])
        series += cosines.shape[1]
        parts.append((cosines, part))
    correction = rows / max(rows - parameters, 1)
    return RobustCovariance(
        covariance=covariance * correction,
        degrees_of_freedom=_degrees_of_freedom(parts),
        series=series,
    )


def _cosines(rows: int, count: int) -> Array:
    """Orthonormal cosines sqrt(2/T) cos(pi j (t - 1/2) / T), shape (rows, count)."""
    t = (np.arange(rows) + 0.5) / rows
    j = np.arange(1, min(count, max(rows - 1, 1)) + 1)
    return np.asarray(np.sqrt(2.0 / rows) * np.cos(np.pi * np.outer(t, j)), dtype=np.float64)


def _degrees_of_freedom(parts: Sequence[tuple[Array, Array]]) -> Array:
    """Satterthwaite's degrees of freedom of the mean square, tr(M)^2 / tr(M^2) summed over the segments.

    M is the covariance of the transforms if the scores were independent with the variances that they show:
    B for a stationary score, less where a short part of the record carries it.
    """
    parameters = parts[0][1].shape[1]
    trace, square = np.zeros(parameters), np.zeros(parameters)
    for cosines, part in parts:
        rows, count = cosines.shape
        variance = np.column_stack([_smooth(x**2, count) for x in part.T])
        # cos j cos k = (cos (j-k) + cos (j+k)) / 2: M follows from 2 B + 1 sums.
        angle = np.pi * (np.arange(rows) + 0.5) / rows
        sums = np.cos(np.outer(np.arange(2 * count + 1), angle)) @ variance / count
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
