"""Bands of what a residual is summed to, by the moving block bootstrap.

A mean in a bin, the slope of a trend and the height of a map are sums over the rows. Blocks of consecutive rows,
drawn with replacement, keep the residual's correlation (Kunsch, Annals of Statistics 17 (1989) 1217). The spread of
a sum over such draws is that of the blocks' own sums, so that no draw is needed: the bands are those of infinitely
many, and the same record gives the same ones. The length of the blocks follows from the residual's correlation
(Politis and White). Few blocks know little of their spread: the bands are Student's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexid_cli.estimate.bootstrap import block_length, block_sums

Array = NDArray[np.float64]

LEVEL = 0.95
# Overlapping blocks see a variance as 1.5 times as many separate ones do (Kunsch 1989, section 3).
OVERLAP = 1.5
FEWEST = 1.5  # blocks


@dataclass(frozen=True)
class Spread:
    """Standard errors of sums, and the degrees of freedom that they are known with; each shape (k,)."""

    stderr: Array
    degrees_of_freedom: Array

    def half_width(self, level: float = LEVEL) -> Array:
        """Half width of a band."""
        from scipy.special import stdtrit

        return np.asarray(stdtrit(self.degrees_of_freedom, 0.5 + 0.5 * level) * self.stderr)

    def p_value(self, sums: Array) -> Array:
        """Two-sided, of sums that are zero without an effect."""
        from scipy.special import stdtr

        t = np.abs(sums) / np.maximum(self.stderr, np.finfo(float).tiny)
        return np.asarray(2.0 * stdtr(self.degrees_of_freedom, -t))


def spread(parts: Array, lengths: Sequence[int], block: int) -> Spread:
    """Spread of the sum of each series.

    Parameters
    ----------
    parts : ndarray, shape (r, k)
        What each row adds to each sum, its expectation taken off; zero where a row adds nothing.
    lengths : sequence of int
        Rows of each gap-free segment.
    block : int
        Rows of a block.
    """
    blocks, mean_length = block_sums(parts, lengths, block)
    variance = np.mean(np.square(blocks), axis=0) * parts.shape[0] / mean_length
    count = _blocks_that_count(parts, block)
    # The expectation that was taken off is that of the same blocks.
    stderr = np.sqrt(variance / (1.0 - 1.0 / count))
    return Spread(np.asarray(stderr), np.maximum(OVERLAP * (count - 1.0), 1.0))


def _blocks_that_count(parts: Array, block: int) -> Array:
    """Number of equal blocks that would hold each sum as the record's do, at least `FEWEST`; shape (k,)."""
    edges = np.arange(0, parts.shape[0], block)
    power = np.add.reduceat(np.square(parts), edges, axis=0)
    total = np.square(power.sum(axis=0))
    count = total / np.maximum(np.square(power).sum(axis=0), np.finfo(float).tiny)
    return np.asarray(np.maximum(count, FEWEST))


def correlated_rows(e: Array, lengths: Sequence[int]) -> int:
    """Rows of a block for a residual, shape (r,)."""
    return block_length(e[:, None], lengths)


def binned(e: Array, which: Array, bins: Sequence[int], lengths: Sequence[int]) -> tuple[Array, Array]:
    """Mean of the residual in each bin and the half width of its band.

    Parameters
    ----------
    e, which : ndarray, shape (r,)
        Residual, and the bin of each row.
    bins : sequence of int
        Bins that are wanted; none is empty.
    lengths : sequence of int
        Rows of each gap-free segment.
    """
    inside = which[:, None] == np.asarray(bins)
    count = inside.sum(axis=0)
    means = (e @ inside) / count
    left = inside * (e[:, None] - means)
    block = correlated_rows(left.sum(axis=1), lengths)
    return means, spread(left / count, lengths, block).half_width()
