"""What the record determines where it does not determine every parameter, and what to record instead.

Before the solve: the columns of the observation matrix. A condition index above 30 is a near dependency, and the
parameters that have more than half of their variance there take part in it (Belsley, Kuh and Welsch, Regression
Diagnostics, 1980, chapter 3). A QR factorisation with column pivoting sorts as many columns to the end as there are
such indices; each is a combination of the others, W2 = W1 beta, so that only X1 + beta X2 is determined: the base
parameters (Gautier, J. Robotic Systems 8 (1991) 485).

After the solve: the covariance of the estimates, which knows of the noise too. Where a parameter hardly differs from
a combination of others, the sum that leaves the least variance is the one that the record does determine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flexid_cli.estimate.fit import block_matrices
from flexid_cli.estimate.least_squares import numerical_rank, triangle
from flexid_cli.estimate.verdict import FORBIDDEN, IDENTIFIED_PERCENT, NAMED_CORRELATION
from flexid_cli.models.two_encoders import TwoEncoders

if TYPE_CHECKING:
    from flexid_cli.estimate.result import Estimate
    from flexid_cli.estimate.solution import Solution

Array = NDArray[np.float64]

NEAR_DEPENDENCY = 30.0
HALF_OF_VARIANCE = 0.5
# A combination of more is no help to anybody.
MOST_TERMS = 3
# Coefficients below this, in units of the columns' lengths, do not belong to a combination.
NEGLIGIBLE = 0.05
EXACTLY_ZERO = 1e-6
MOST_SHOWN = 3
FREE_NAMES = ("X1", "X2", "X3", "X4", "X5", "X6", "X7", "FSm X2", "FSm X1")


@dataclass(frozen=True)
class Combination:
    """A sum of parameters that is determined although they are not.

    Attributes
    ----------
    index : tuple of int
        The parameters, the one that it is named for first.
    coefficients : tuple of float
        Of each; that of the first is one.
    """

    index: tuple[int, ...]
    coefficients: tuple[float, ...]

    def text(self, symbols: Sequence[str]) -> str:
        """In symbols: ``FVm + 0.98 FV``."""
        parts = [symbols[self.index[0]]]
        for k, c in zip(self.index[1:], self.coefficients[1:], strict=True):
            size = "" if abs(abs(c) - 1.0) < 5e-4 else f"{abs(c):.3g} "
            parts.append(f"{'-' if c < 0.0 else '+'} {size}{symbols[k]}")
        return " ".join(parts)

    def estimate(self, theta: Array, covariance: Array) -> tuple[float, float]:
        """Value and standard error."""
        index, a = list(self.index), np.array(self.coefficients)
        return float(a @ theta[index]), float(np.sqrt(max(a @ covariance[np.ix_(index, index)] @ a, 0.0)))


@dataclass(frozen=True)
class Columns:
    """What the columns alone say.

    Attributes
    ----------
    condition_indices : ndarray, shape (p,)
        Largest singular value over each, columns scaled to unit length; ascending.
    near : tuple of int
        Columns that take part in a near dependency.
    base : tuple of Combination
        Combinations that are determined in their place.
    """

    condition_indices: Array
    near: tuple[int, ...]
    base: tuple[Combination, ...]


def of_columns(W: Array, largest_index: float = NEAR_DEPENDENCY) -> Columns:
    """Near dependencies of the columns of ``W`` and the base parameters that are left.

    Parameters
    ----------
    W : ndarray, shape (r, p)
        Observation matrix, or its triangular factor. Columns of zeros belong to no combination.
    largest_index : float
        Condition index above which columns count as dependent.
    """
    size = np.linalg.norm(W, axis=0)
    used = np.flatnonzero(size > 0.0)
    if not used.size:
        return Columns(np.zeros(0), (), ())
    R = triangle(W[:, used] / size[used])
    _, s, Vt = np.linalg.svd(R)
    s = np.concatenate([s, np.zeros(used.size - s.size)])
    floor = s[0] * np.finfo(float).eps
    indices = s[0] / np.maximum(s, floor)
    rank = min(int(np.sum(indices <= largest_index)), numerical_rank(s, W.shape[0]))
    if rank == used.size:
        return Columns(indices, (), ())
    shares = (Vt / np.maximum(s, floor)[:, None]) ** 2
    near = np.sum(shares[rank:], axis=0) / np.sum(shares, axis=0) > HALF_OF_VARIANCE
    base = base_parameters(R, rank, NEGLIGIBLE if np.isfinite(largest_index) else EXACTLY_ZERO)
    named = tuple(
        Combination(
            tuple(int(used[k]) for k in c.index),
            tuple(
                float(x * size[used[k]] / size[used[c.index[0]]])
                for k, x in zip(c.index, c.coefficients, strict=True)
            ),
        )
        for c in base
    )
    return Columns(indices, tuple(int(used[k]) for k in np.flatnonzero(near)), named)


def base_parameters(R: Array, rank: int, negligible: float = EXACTLY_ZERO) -> tuple[Combination, ...]:
    """Combinations that ``rank`` of the columns stand for when the others are expressed by them.

    Parameters
    ----------
    R : ndarray, shape (p, p)
        Columns of unit length, or their triangular factor.
    rank : int
        Number of columns that are kept, by pivoting.
    negligible : float
        Coefficients up to this are left out.

    Returns
    -------
    tuple of Combination
        One for each kept column that stands for others too, in units of the scaled columns.
    """
    from scipy.linalg import qr, solve_triangular

    _, T, pivots = qr(R, mode="economic", pivoting=True)
    beta = solve_triangular(T[:rank, :rank], T[:rank, rank:])
    found = []
    for i in np.argsort(pivots[:rank]):
        others = [j for j in np.argsort(-np.abs(beta[i])) if abs(beta[i, j]) > negligible]
        if others:
            index = (int(pivots[i]), *(int(pivots[rank + j]) for j in others))
            found.append(Combination(index, (1.0, *(float(beta[i, j]) for j in others))))
    return tuple(found)


def before_the_solve(solution: Solution) -> dict[str, Any]:
    """Near dependencies of the observation matrix, for the report's tests."""
    W, symbols = observation_matrix(solution)
    found = of_columns(W)
    sums = [c.text(symbols) for c in found.base]
    more = f" and {len(sums) - MOST_SHOWN} more" if len(sums) > MOST_SHOWN else ""
    largest = float(found.condition_indices[-1]) if found.condition_indices.size else None
    return {
        "largest_condition_index": largest,
        "near_dependent": ", ".join(symbols[k] for k in found.near) or "none",
        "determined": "; ".join(sums[:MOST_SHOWN]) + more or "each by itself",
        "combinations": sums,
        "limit": NEAR_DEPENDENCY,
        "meaning": "columns of the observation matrix before the solve, whatever the noise; above the limit only"
        " these combinations stand firm",
    }


def observation_matrix(solution: Solution) -> tuple[Array, list[str]]:
    """The linear equations' columns, before any parameter is known, and the names of their coefficients."""
    model = solution.model
    symbols = [p.symbol for p in model.parameters]
    if model.id == "two_encoders":
        linear = TwoEncoders()
        blocks = block_matrices(linear, solution.columns)
        theta = np.zeros(len(symbols))
        return np.vstack([M @ D for M, D in zip(blocks, linear.jacobian(theta), strict=True)]), symbols
    W = solution.matrices[0][:, 1:]
    if model.id == "motor_only":
        return W, [*FREE_NAMES, *symbols[6:]]
    return W, symbols


def exact(jacobian: Array, index: int) -> Combination | None:
    """The combination that a parameter of dependent columns belongs to, if there is one."""
    found = of_columns(jacobian, np.inf)
    return next((c for c in found.base if index in c.index), None)


def determined(theta: Array, covariance: Array, index: int, skip: Sequence[int] = ()) -> Combination | None:
    """The sum with up to two others that the record determines although it determines none of them.

    Parameters
    ----------
    theta : ndarray, shape (p,)
        Estimates.
    covariance : ndarray, shape (p, p)
        Their covariance.
    index : int
        The parameter.
    skip : sequence of int
        Parameters that cannot take part.

    Returns
    -------
    Combination or None
        With at most 10 % relative standard deviation; None where no such sum exists, or where the parameter's
        uncertainty is not shared with others.
    """
    unsure = np.sqrt(np.maximum(np.diag(covariance), 0.0)) * 100.0 > IDENTIFIED_PERCENT * np.abs(theta)
    if not unsure[index]:
        return None
    others = [int(k) for k in np.flatnonzero(unsure) if k != index and k not in skip]
    variance = float(covariance[index, index])
    chosen: list[int] = []
    while others and len(chosen) < MOST_TERMS - 1:
        left = {k: _remaining(covariance, index, [*chosen, k]) for k in others}
        best = min(left, key=left.__getitem__)
        others.remove(best)
        chosen.append(best)
        if left[best] > (1.0 - NAMED_CORRELATION**2) * variance:
            continue
        a = -np.linalg.lstsq(_scaled(covariance, chosen), _cross(covariance, index, chosen), rcond=1e-12)[0]
        slopes = a * np.sqrt(variance / np.diag(covariance)[chosen])
        found = Combination((index, *chosen), (1.0, *map(float, slopes)))
        value, stderr = found.estimate(theta, covariance)
        if abs(value) * IDENTIFIED_PERCENT >= 100.0 * stderr:
            return found
    return None


def _scaled(covariance: Array, chosen: Sequence[int]) -> Array:
    size = np.sqrt(np.diag(covariance)[list(chosen)])
    return np.asarray(covariance[np.ix_(chosen, chosen)] / np.outer(size, size))


def _cross(covariance: Array, index: int, chosen: Sequence[int]) -> Array:
    size = np.sqrt(np.diag(covariance)[list(chosen)] * covariance[index, index])
    return np.asarray(covariance[list(chosen), index] / size)


def _remaining(covariance: Array, index: int, chosen: Sequence[int]) -> float:
    """Variance of the parameter when the chosen ones are known."""
    r = _cross(covariance, index, chosen)
    explained = float(r @ np.linalg.lstsq(_scaled(covariance, chosen), r, rcond=1e-12)[0])
    return float(covariance[index, index]) * max(1.0 - explained, 0.0)


def others_of(symbols: Sequence[str], index: int) -> tuple[int, ...]:
    """Parameters of other kinds, whose sum with this one would say nothing to anybody."""
    kind = next((known for known, _ in _ADVICE if symbols[index] in known), set(symbols))
    return tuple(k for k, symbol in enumerate(symbols) if symbol not in kind)


def in_words(
    combination: Combination | None, symbols: Sequence[str], theta: Array, covariance: Array, unit: str
) -> str:
    """``only FVm + 0.98 FV is determined (319 +- 4 N.m.s/rad)``, or nothing."""
    if combination is None:
        return ""
    value, stderr = combination.estimate(theta, covariance)
    return f"only {combination.text(symbols)} is determined ({value:.4g} ± {stderr:.2g} {unit})"


# What to record, by the parameters' symbols; {f1} is the resonance where it is known.
_FRICTION = "legs of constant velocity in both directions, at several speeds from slow to fast"
_SPLIT = "the joint encoder too: it tells the motor's friction from the load's"
_SWEEP = "slow sweeps over the whole range of the joint, in both directions"
_RESONANCE = "a sweep through the resonance{f1}, with as much torque as the axis may take"
_INERTIA = "faster accelerations, in both directions"
_ADVICE = (
    ({"FVm", "FV", "FSm", "FS", "FVm+FV", "FSm+FS", "FVm + FV", "FSm + FS"}, _FRICTION),
    ({"MX", "MY", "kg", "Q0", "offset", "z"}, _SWEEP),
    ({"Jm", "K", "JL", "f1", "fa", "JL/Jm"}, _RESONANCE),
    ({"Jm+JL"}, _INERTIA),
)


def with_advice(estimates: Sequence[Estimate], solution: Solution, doubt: str) -> tuple[Estimate, ...]:
    """The estimates, those that are not identified with what to record instead.

    Where the model lacks something (``doubt``), no other recording would help, and there is none.
    """
    if doubt:
        return tuple(estimates)
    f1 = solution.tuning.f1_hz
    at = f" at {f1:.3g} Hz" if f1 else ""
    split = {p.symbol for p in solution.model.parameters if p.split}
    return tuple(_advised(e, at, split) for e in estimates)


def _advised(estimate: Estimate, at: str, split: set[str]) -> Estimate:
    if estimate.verdict == "identified" or estimate.reason.startswith(FORBIDDEN):
        return estimate
    if estimate.symbol in split:
        return replace(estimate, advice=_SPLIT)
    text = next((text for symbols, text in _ADVICE if estimate.symbol in symbols), "")
    return replace(estimate, advice=text.format(f1=at))
