"""Fit of a model whose residuals are linear in filtered columns: weighted, iterated, with robust covariance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexid_cli.errors import DataError
from flexid_cli.estimate.covariance import combined_covariance
from flexid_cli.estimate.least_squares import numerical_rank, triangle
from flexid_cli.models.base import Block, Model

Array = NDArray[np.float64]

MAX_ITERATIONS = 60
CONVERGED = 1e-10


@dataclass(frozen=True)
class FitResult:
    """Solution of one model on one set of columns.

    Attributes
    ----------
    theta : ndarray, shape (p,)
        Parameters.
    covariance, degrees_of_freedom : ndarray, shape (p, p), (p,)
        Robust to correlated residuals ("hac"), or the textbook's ("iid": normal, degrees of freedom r - p).
    residuals : tuple of ndarray, shape (r,)
        Residual of each block.
    sigmas : tuple of float
        Size of each block's residual; its inverse is the weight where blocks are weighted.
    condition_number, rank : float, int
        Of the weighted Jacobian after column scaling.
    dependent : tuple of int
        Parameters that take part in a dependence of the columns: not determined.
    converged : bool
        Whether the iteration settled.
    jacobian : ndarray, shape (blocks * r, p)
        Weighted derivative of the stacked residuals, for sensitivities.
    weights : tuple of float
        Weights of the blocks.
    bread : ndarray, shape (p, p)
        Inverse of the normal matrix that the parameters were solved with.
    instruments : ndarray, shape (blocks * r, p)
        What the residuals are made orthogonal to: the Jacobian itself in least squares.
    """

    theta: Array
    covariance: Array
    degrees_of_freedom: Array
    residuals: tuple[Array, ...]
    sigmas: tuple[float, ...]
    condition_number: float
    rank: int
    dependent: tuple[int, ...]
    converged: bool
    jacobian: Array
    weights: tuple[float, ...]
    bread: Array
    instruments: Array

    @property
    def stderr(self) -> Array:
        """Standard errors, shape (p,)."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))


def block_matrices(model: Model, column: Callable[[str, int], Array]) -> tuple[Array, ...]:
    """Columns of each block of a model, shapes (rows, columns of the block)."""
    return tuple(block_matrix(block, column) for block in model.blocks)


def block_matrix(block: Block, column: Callable[[str, int], Array]) -> Array:
    """Columns of one block, shape (rows, columns)."""
    return np.column_stack([column(*c) for c in block.columns])


def fit(
    model: Model,
    matrices: Sequence[Array],
    theta: Array,
    lengths: Sequence[int],
    *,
    weighted: bool,
    covariance: str = "hac",
) -> FitResult:
    """Minimise sum over blocks of weight^2 norm(M_k a_k(theta))^2 by Gauss-Newton.

    Parameters
    ----------
    model : Model
        Gives a_k(theta) and its derivatives.
    matrices : sequence of ndarray, shapes (r, columns)
        M_k, from `block_matrices`.
    theta : ndarray, shape (p,)
        Starting point; any for a linear model.
    lengths : sequence of int
        Rows of each gap-free segment.
    weighted : bool
        Weight each block by the inverse size of its residual (the paper's groups: per-equation weighted least
        squares), iterated; else all blocks count alike.
    covariance : {"hac", "iid"}
        Robust, or the textbook's for independent residuals.

    Raises
    ------
    DataError
        Fewer rows than parameters.
    """
    rows = matrices[0].shape[0]
    if rows <= theta.size + 2:
        raise DataError(
            f"{rows} rows remain after filtering and decimation, too few for {theta.size} parameters",
            "record longer, or lower pipeline.decimation (raise pipeline.band_hz)",
        )
    # The cost depends on the columns through their triangular factor only: iterate on that.
    triangles = [triangle(M) for M in matrices]
    weights = _initial_weights(triangles, weighted=weighted)
    theta, weights, converged = _iterate(model, triangles, theta, weights, rows, weighted=weighted)
    return _finish(model, matrices, theta, weights, lengths, converged, covariance)


def _initial_weights(triangles: Sequence[Array], *, weighted: bool) -> Array:
    if not weighted:
        return np.ones(len(triangles))
    return np.array([1.0 / np.linalg.norm(R[:, 0]) for R in triangles])


def _iterate(
    model: Model, triangles: Sequence[Array], theta: Array, weights: Array, rows: int, *, weighted: bool
) -> tuple[Array, Array, bool]:
    def residual(t: Array, w: Array) -> Array:
        return np.concatenate(
            [wk * (R @ a) for wk, R, a in zip(w, triangles, model.coefficients(t), strict=True)]
        )

    damping = 0.0
    for _ in range(MAX_ITERATIONS):
        e = residual(theta, weights)
        J = np.vstack(
            [w * (R @ D) for w, R, D in zip(weights, triangles, model.jacobian(theta), strict=True)]
        )
        step = _scaled_step(J, e, damping)
        trial = theta + step
        if np.linalg.norm(residual(trial, weights)) > np.linalg.norm(e) * (1.0 + 1e-9):
            damping = max(4.0 * damping, 1e-3)
            if damping > 1e6:
                return theta, weights, False
            continue
        damping = 0.0 if damping < 1e-6 else damping / 10.0
        scale = np.linalg.norm(J, axis=0)
        moved = np.linalg.norm(scale * step) / max(float(np.linalg.norm(scale * trial)), 1e-300)
        theta = trial
        change = 0.0
        if weighted:
            new = _residual_weights(model, triangles, theta, rows)
            change = float(np.max(np.abs(np.log(new / weights))))
            weights = new
        if moved < CONVERGED and change < 1e-8:
            return theta, weights, True
    return theta, weights, False


def _residual_weights(model: Model, triangles: Sequence[Array], theta: Array, rows: int) -> Array:
    # The triangles' own residual is sqrt(rows) times the size of a row's.
    sizes = [np.linalg.norm(R @ a) for R, a in zip(triangles, model.coefficients(theta), strict=True)]
    floors = [1e-12 * np.linalg.norm(R[:, 0]) for R in triangles]
    return np.array([np.sqrt(rows) / max(s, f, 1e-300) for s, f in zip(sizes, floors, strict=True)])


def _scaled_step(J: Array, e: Array, damping: float) -> Array:
    """Gauss-Newton step by QR (SVD where columns are dependent: the shortest step in scaled units)."""
    scale = np.linalg.norm(J, axis=0)
    scale[scale == 0.0] = 1.0
    U, s, Vt = np.linalg.svd(J / scale, full_matrices=False)
    keep = s > J.shape[0] * np.finfo(np.float64).eps * s[0]
    inverse = np.where(keep, s / (s**2 + damping * s[0] ** 2 + np.finfo(float).tiny), 0.0)
    return np.asarray(-(Vt.T @ (inverse * (U.T @ e))) / scale, dtype=np.float64)


def _finish(
    model: Model,
    matrices: Sequence[Array],
    theta: Array,
    weights: Array,
    lengths: Sequence[int],
    converged: bool,
    covariance: str,
) -> FitResult:
    residuals = tuple(M @ a for M, a in zip(matrices, model.coefficients(theta), strict=True))
    jacobians = [w * (M @ D) for w, M, D in zip(weights, matrices, model.jacobian(theta), strict=True)]
    J = np.vstack(jacobians)
    rows, size = matrices[0].shape[0], theta.size
    scale = np.linalg.norm(J, axis=0)
    scale[scale == 0.0] = 1.0
    _, s, Vt = np.linalg.svd(J / scale, full_matrices=False)
    rank = numerical_rank(s, J.shape[0])
    null = Vt[rank:]
    dependent = tuple(int(k) for k in np.flatnonzero(np.any(np.abs(null) > 1e-6, axis=0)))
    inverse = (Vt[:rank].T / s[:rank] ** 2) @ Vt[:rank]
    bread = inverse / np.outer(scale, scale)
    weighted_residuals = [w * e for w, e in zip(weights, residuals, strict=True)]
    if covariance == "hac":
        robust = combined_covariance(J, J, bread, np.concatenate(weighted_residuals), len(residuals), lengths)
        matrix, dof = robust.covariance, robust.degrees_of_freedom
    else:
        count = J.shape[0] - rank
        variance = float(sum(e @ e for e in weighted_residuals)) / count
        matrix, dof = variance * bread, np.full(size, float(count))
    return FitResult(
        theta=theta,
        covariance=matrix,
        degrees_of_freedom=dof,
        residuals=residuals,
        sigmas=tuple(float(np.sqrt(e @ e / max(rows - size / len(residuals), 1.0))) for e in residuals),
        condition_number=float(s[0] / s[-1]) if s[-1] > 0.0 else float("inf"),
        rank=rank,
        dependent=dependent,
        converged=converged,
        jacobian=J,
        weights=tuple(float(w) for w in weights),
        bread=bread,
        instruments=J,
    )


def scaled_inverse(normal: Array) -> Array:
    """Pseudo-inverse of a normal matrix after scaling it by its diagonal, shape (p, p)."""
    scale = np.sqrt(np.abs(np.diag(normal)))
    scale[scale == 0.0] = 1.0
    inverse = np.linalg.pinv(normal / np.outer(scale, scale), rcond=1e-13)
    return np.asarray(inverse / np.outer(scale, scale), dtype=np.float64)
