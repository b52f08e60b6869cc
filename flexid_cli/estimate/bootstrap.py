"""Block bootstrap as a check of the random standard errors, by another way to allow for correlation.

The error of an estimate is a sum over the rows of their influence. Blocks of consecutive rows of it, drawn with
replacement, keep the correlation within a block, and their sums show the spread of the error without any kernel or
cosine (Kunsch, Annals of Statistics 17 (1989) 1217; blocks that wrap around within a gap-free segment: Politis and
Romano 1992). The length of the blocks follows from the influences' own correlation (Politis and White, Econometric
Reviews 23 (2004) 53, with the correction of Patton, Politis and White, ibid. 28 (2009) 372).

That spread is of the linearised estimate. A few true fits, each with whole blocks weighted at random by exponential
variables (Rubin, Annals of Statistics 9 (1981) 130), show what the curvature of the model adds: the equations need
the cross products of each block only, so that a fit costs no pass over the rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexid_cli.estimate.corrected import equations
from flexid_cli.estimate.covariance import row_scores
from flexid_cli.estimate.fit import FitResult, scaled_inverse
from flexid_cli.estimate.solution import Solution

Array = NDArray[np.float64]
Matrices = Sequence[Array]

SEED = 20010521
DRAWS = 999
REFITS = 80
# Fewer blocks than this cannot stand for the record.
FEWEST_BLOCKS = 20
MOST_BLOCKS = 200
MAX_STEPS = 12
SETTLED = 1e-3
JUDGED = ("Jm", "K", "JL", "Jm+JL")
# Estimators whose solution is not that of the estimating equations.
OTHER_EQUATIONS = frozenset({"irls", "minimum_distance", "output_error"})


def interval_check(solution: Solution) -> dict[str, Any]:
    """Compare the bootstrap's standard errors of inertias and stiffness with the robust ones.

    Returns
    -------
    dict
        For the report's tests: ``ratios`` (bootstrap over robust, by symbol) and their extremes, the block's length,
        ``monte_carlo_error`` (one standard error of a ratio, relative); with ``refit_ratios`` from true fits where
        the record has blocks enough and the estimator allows it. The same record gives the same numbers.
    """
    result, lengths = solution.reported, solution.columns.lengths
    index = [
        k
        for k, p in enumerate(solution.model.parameters)
        if p.symbol in JUDGED and k not in solution.result.dependent and result.stderr[k] > 0.0
    ]
    if not index:
        return {"statistic": None, "reason": "no inertia and no stiffness was determined"}
    symbols = [solution.model.parameters[k].symbol for k in index]
    parts = influence(result)[:, index]
    block = block_length(parts, lengths)
    if sum(lengths) < FEWEST_BLOCKS * block:
        return {
            "block_rows": block,
            "statistic": None,
            "reason": f"fewer than {FEWEST_BLOCKS} blocks of correlated rows: the record is too short for the check",
        }
    rows, size = parts.shape[0], result.theta.size
    spread = block_spread(parts, lengths, block) * np.sqrt(rows / max(rows - size, 1))
    ratios = spread / result.stderr[index]
    found: dict[str, Any] = {
        "smallest_ratio": float(np.min(ratios)),
        "largest_ratio": float(np.max(ratios)),
        "monte_carlo_error": float(1.0 / np.sqrt(2.0 * (DRAWS - 1))),
        "draws": DRAWS,
        "block_rows": block,
        "ratios": dict(zip(symbols, map(float, ratios), strict=True)),
    }
    refitted = _refit_spread(solution, block)
    if refitted is not None:
        again = refitted[index] / result.stderr[index]
        found |= {
            "largest_refit_ratio": float(np.max(again)),
            "refit_monte_carlo_error": float(1.0 / np.sqrt(2.0 * (REFITS - 1))),
            "refits": REFITS,
            "refit_ratios": dict(zip(symbols, map(float, again), strict=True)),
        }
    meaning = (
        "block bootstrap over robust standard error, random part; well above one: the intervals may be short"
    )
    return {**found, "meaning": meaning}


def influence(result: FitResult) -> Array:
    """Part of each row in the error of the estimates, leverage allowed for as in the robust covariance; (r, p)."""
    stacked = np.concatenate([w * e for w, e in zip(result.weights, result.residuals, strict=True)])
    scores = row_scores(result.instruments, result.jacobian, result.bread, stacked, len(result.residuals))
    return np.asarray(-scores @ result.bread.T, dtype=np.float64)


def block_length(parts: Array, lengths: Sequence[int]) -> int:
    """Rows of a block: the longest of the series' optimal lengths for circular blocks.

    Parameters
    ----------
    parts : ndarray, shape (r, k)
        Series side by side.
    lengths : sequence of int
        Rows of each gap-free segment.
    """
    longest = int(np.ceil(min(3.0 * np.sqrt(parts.shape[0]), parts.shape[0] / 3.0)))
    return int(np.clip(np.ceil(max(_optimal(x, lengths) for x in parts.T)), 1, max(longest, 1)))


def _optimal(x: Array, lengths: Sequence[int]) -> float:
    """(2 G^2 / (4/3 g^2))^(1/3) n^(1/3): g the long-run variance, G the sum of abs(k) R(k), flat-top window."""
    n = x.size
    reach = max(5, int(np.ceil(np.sqrt(np.log10(n)))))
    most = min(int(np.ceil(np.sqrt(n))) + reach, max(lengths) - 1)
    if most < 1:
        return 1.0
    R = _autocovariances(x, lengths, 2 * most)
    if R[0] <= 0.0:
        return 1.0
    small = np.abs(R[1 : most + 1] / R[0]) < 2.0 * np.sqrt(np.log10(n) / n)
    quiet = [m for m in range(most) if np.all(small[m : m + reach])]
    M = 2 * max(quiet[0] if quiet else most, 1)
    k = np.arange(min(M, R.size - 1) + 1)
    window = np.clip(2.0 * (1.0 - k / M), 0.0, 1.0)
    twice = np.where(k == 0, 1.0, 2.0) * window * R[: k.size]
    g, G = float(np.sum(twice)), float(np.sum(twice * k))
    return float((1.5 * (G / g) ** 2 * n) ** (1.0 / 3.0)) if g > 0.0 else 1.0


def _autocovariances(x: Array, lengths: Sequence[int], most: int) -> Array:
    """R(0) to R(most), products across gaps left out."""
    from scipy.fft import irfft, next_fast_len, rfft

    centred = x - x.mean()
    spans = [slice(a, b) for a, b in pairwise(accumulate(lengths, initial=0))]
    most = min(most, max(lengths) - 1)
    total = np.zeros(most + 1)
    for span in spans:
        part = centred[span]
        size = next_fast_len(2 * part.size, real=True)
        products = irfft(np.abs(rfft(part, size)) ** 2, size)[: min(most + 1, part.size)]
        total[: products.size] += products
    return np.asarray(total / x.size, dtype=np.float64)


def block_spread(parts: Array, lengths: Sequence[int], block: int, draws: int = DRAWS) -> Array:
    """Standard deviation of the sum of each series over bootstrap records, shape (k,).

    Parameters
    ----------
    parts : ndarray, shape (r, k)
        Series, their mean taken off here.
    lengths : sequence of int
        Rows of each gap-free segment; a block wraps around within its own.
    block, draws : int
        Rows of a block, and number of bootstrap records.
    """
    blocks, mean_length = block_sums(parts, lengths, block)
    count = max(1, round(blocks.shape[0] / mean_length))
    rng = np.random.default_rng(SEED)
    drawn = np.empty((draws, parts.shape[1]))
    for i in range(draws):
        drawn[i] = blocks[rng.integers(blocks.shape[0], size=count)].sum(axis=0)
    drawn *= np.sqrt(blocks.shape[0] / (count * mean_length))
    return np.asarray(np.std(drawn, axis=0, ddof=1), dtype=np.float64)


def block_sums(parts: Array, lengths: Sequence[int], block: int) -> tuple[Array, float]:
    """Sums of each series over every block, and the blocks' mean length; parameters as in `block_spread`."""
    centred = parts - parts.mean(axis=0)
    sums, size = [], 0
    for a, b in pairwise(accumulate(lengths, initial=0)):
        length = min(block, b - a)
        wrapped = np.concatenate([centred[a:b], centred[a : a + length]])
        total = np.concatenate([np.zeros((1, parts.shape[1])), np.cumsum(wrapped, axis=0)])
        sums.append((total[length:] - total[:-length])[: b - a])
        size += length * (b - a)
    blocks = np.concatenate(sums)
    return blocks, size / blocks.shape[0]


def _refit_spread(solution: Solution, block: int) -> Array | None:
    """Standard deviation of true fits with randomly weighted blocks, shape (p,); None where there are none."""
    lengths = solution.columns.lengths
    block = max(block, -(-sum(lengths) // MOST_BLOCKS))
    spans = [
        slice(start, min(start + block, b))
        for a, b in pairwise(accumulate(lengths, initial=0))
        for start in range(a, b, block)
    ]
    if solution.method in OTHER_EQUATIONS or len(spans) < FEWEST_BLOCKS:
        return None
    products = _block_products(solution, spans)
    rng = np.random.default_rng(SEED)
    fits = []
    for _ in range(REFITS):
        weights = rng.exponential(size=len(spans))
        cross = [np.tensordot(weights / weights.mean(), P, axes=1) for P in products]
        theta = _solve(solution, cross)
        if theta is None:
            return None
        fits.append(theta)
    return np.asarray(np.std(fits, axis=0, ddof=1), dtype=np.float64)


def _block_products(solution: Solution, spans: Sequence[slice]) -> list[Array]:
    """Weighted cross products w^2 (Z'M - N) of each block of rows, shapes (spans, columns, columns)."""
    Z = solution.instruments or solution.matrices
    moments = () if solution.correction is None else solution.correction.moments
    none = tuple(np.zeros((M.shape[1], M.shape[1])) for M in solution.matrices)
    rows = solution.matrices[0].shape[0]
    return [
        w**2 * np.stack([z[s].T @ M[s] - N * ((s.stop - s.start) / rows) for s in spans])
        for w, M, z, N in zip(solution.result.weights, solution.matrices, Z, moments or none, strict=True)
    ]


def _solve(solution: Solution, cross: Matrices) -> Array | None:
    """Parameters that solve the estimating equations with these cross products."""
    theta = solution.result.theta.copy()
    scale = np.where(solution.result.stderr > 0.0, solution.result.stderr, 1.0)
    for _ in range(MAX_STEPS):
        gradient, normal = equations(solution.model, cross, theta)
        step = -scaled_inverse(normal) @ gradient
        theta = theta + step
        if not np.all(np.isfinite(theta)):
            return None
        if float(np.max(np.abs(step) / scale)) < SETTLED:
            return theta
    return None
