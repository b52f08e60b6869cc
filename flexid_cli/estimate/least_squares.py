"""Linear least squares by QR with column scaling, and the textbook covariance of the paper's tables."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexid_cli.errors import DataError

Array = NDArray[np.float64]

MAX_REFINEMENTS = 10


@dataclass(frozen=True)
class LeastSquares:
    """Solution of Y = W X + rho.

    Attributes
    ----------
    estimate, stderr : ndarray, shape (p,)
        X and the square roots of the diagonal of sigma^2 (W'W)^-1, errors independent and equal.
    residuals : ndarray, shape (r,)
        Y - W X.
    sigma : float
        norm(residuals) / sqrt(r - p).
    covariance : ndarray, shape (p, p)
        sigma^2 (W'W)^-1.
    bread : ndarray, shape (p, p)
        (W'W)^-1.
    condition_number : float
        Of W with columns scaled to unit norm.
    rank : int
        Columns that are independent to working precision.
    """

    estimate: Array
    stderr: Array
    residuals: Array
    sigma: float
    covariance: Array
    bread: Array
    condition_number: float
    rank: int


def solve(W: Array, Y: Array) -> LeastSquares:
    """Ordinary least squares by Householder QR of the column-scaled observation matrix.

    The solution is refined with residuals in extended precision (Bjorck, BIT 7 (1967) 257: refinement of the
    augmented system), so that it is right to the conditioning of the data, not of the arithmetic.

    Parameters
    ----------
    W : ndarray, shape (r, p)
        Observation matrix, r > p.
    Y : ndarray, shape (r,)
        Measurement vector.

    Raises
    ------
    DataError
        Fewer rows than columns, a column of zeros, or dependent columns.
    """
    rows, columns = W.shape
    if rows <= columns:
        raise DataError(
            f"{rows} rows cannot determine {columns} parameters",
            "record longer, or lower pipeline.decimation",
        )
    scale = np.linalg.norm(W, axis=0)
    if not np.all(scale > 0.0):
        raise DataError(
            "a column of the observation matrix is zero", "a signal does not move; check the signals"
        )
    # Powers of two: the scaled matrix is the given one to the last bit.
    scale = np.exp2(np.round(np.log2(scale)))
    scaled = W / scale
    Q, R = np.linalg.qr(scaled)
    singular = np.linalg.svd(R, compute_uv=False)
    rank = numerical_rank(singular, rows)
    if rank < columns:
        raise DataError(
            f"the observation matrix has rank {rank} of {columns}: some columns depend on others",
            "excite the axis over a wider band or range",
        )
    x, residuals = _refine(scaled, Y, Q, R)
    inverse = np.linalg.solve(R, np.eye(columns))
    bread = (inverse @ inverse.T) / np.outer(scale, scale)
    sigma = float(np.linalg.norm(residuals) / np.sqrt(rows - columns))
    covariance = sigma**2 * bread
    return LeastSquares(
        estimate=x / scale,
        stderr=np.sqrt(np.diag(covariance)),
        residuals=residuals,
        sigma=sigma,
        covariance=covariance,
        bread=bread,
        condition_number=float(singular[0] / singular[-1]),
        rank=rank,
    )


def solve_instrumented(W: Array, Y: Array, Z: Array) -> LeastSquares:
    """Instrumental variables, X = (Z'W)^-1 Z'Y, as many instruments as parameters.

    Parameters
    ----------
    W : ndarray, shape (r, p)
        Observation matrix.
    Y : ndarray, shape (r,)
        Measurement vector.
    Z : ndarray, shape (r, p)
        Instruments: correlated with W, not with the residual.

    Returns
    -------
    LeastSquares
        ``bread`` is (Z'W)^-1, ``covariance`` sigma^2 (Z'W)^-1 Z'Z (W'Z)^-1.

    Raises
    ------
    DataError
        As `solve`, on W.
    """
    plain = solve(W, Y)
    left, right = np.linalg.norm(Z, axis=0), np.linalg.norm(W, axis=0)
    left = np.where(left > 0.0, left, 1.0)
    inverse = np.linalg.pinv((Z / left).T @ (W / right), rcond=1e-13) / np.outer(right, left)
    # From the least squares solution, so that only the difference suffers from the squared condition.
    estimate = plain.estimate + inverse @ (Z.T @ plain.residuals)
    residuals = Y - W @ estimate
    sigma = float(np.linalg.norm(residuals) / np.sqrt(W.shape[0] - W.shape[1]))
    covariance = sigma**2 * inverse @ (Z.T @ Z) @ inverse.T
    return LeastSquares(
        estimate=estimate,
        stderr=np.sqrt(np.diag(covariance)),
        residuals=residuals,
        sigma=sigma,
        covariance=covariance,
        bread=inverse,
        condition_number=plain.condition_number,
        rank=plain.rank,
    )


def triangle(W: Array) -> Array:
    """Triangular factor R of W = QR, shape (min(r, p), p)."""
    R = np.linalg.qr(W, mode="r")
    return np.asarray(R, dtype=np.float64)


def numerical_rank(singular_values: Array, rows: int) -> int:
    """Singular values above rows times machine precision times the largest one."""
    tolerance = max(rows, singular_values.size) * np.finfo(np.float64).eps * singular_values[0]
    return int(np.sum(singular_values > tolerance))


def _refine(W: Array, Y: Array, Q: Array, R: Array) -> tuple[Array, Array]:
    """Solution and residuals of the scaled system, refined until the correction stops shrinking."""
    W_long, Y_long = W.astype(np.longdouble), Y.astype(np.longdouble)
    x = np.linalg.solve(R, Q.T @ Y).astype(np.longdouble)
    r = Y_long - W_long @ x
    last = np.inf
    for _ in range(MAX_REFINEMENTS):
        # Augmented system: r + W x = Y, W' r = 0. Both equations' errors are corrected at once.
        f = np.asarray(Y_long - r - W_long @ x, dtype=np.float64)
        g = np.asarray(-(W_long.T @ r), dtype=np.float64)
        h = np.linalg.solve(R.T, g)
        dx = np.linalg.solve(R, Q.T @ f - h)
        dr = f - Q @ (Q.T @ f) + Q @ h
        size = float(np.linalg.norm(dx))
        if not size < 0.5 * last:
            break
        x, r, last = x + dx, r + dr, size
    return np.asarray(x, dtype=np.float64), np.asarray(r, dtype=np.float64)
