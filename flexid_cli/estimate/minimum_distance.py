"""Optimal minimum distance: the physical parameters nearest to free coefficients, in their full covariance.

The free regression gives X1..X7 and the coefficients of the other columns; physics allows fewer parameters than
that. They are fitted to the coefficients, weighted by the inverse of the coefficients' robust covariance
(Chamberlain, Handbook of Econometrics 2 (1984) 1247); what remains is the J test of the restrictions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flexid_cli.estimate.covariance import RobustCovariance, combined_covariance
from flexid_cli.estimate.fit import FitResult
from flexid_cli.estimate.least_squares import LeastSquares, solve, solve_instrumented
from flexid_cli.models.base import Model

Array = NDArray[np.float64]

MAX_STEPS = 50
SETTLED = 1e-6


@dataclass(frozen=True)
class FreeCoefficients:
    """Coefficients of the columns after the first, each free: first column + others @ b = residual.

    Attributes
    ----------
    regression : LeastSquares
        Of the first column on the others: its ``estimate`` is -b.
    robust : RobustCovariance
        Of the estimate.
    instruments : ndarray, shape (r, q)
        What the residual is orthogonal to.
    """

    regression: LeastSquares
    robust: RobustCovariance
    instruments: Array


def free_coefficients(
    matrix: Array, lengths: tuple[int, ...], instruments: Array | None = None
) -> FreeCoefficients:
    """Regress the first column of a block on the others.

    Parameters
    ----------
    matrix : ndarray, shape (r, 1 + q)
        Columns of a block.
    lengths : tuple of int
        Rows of each gap-free segment.
    instruments : ndarray, shape (r, 1 + q), or None
        Instruments of the same columns.

    Raises
    ------
    DataError
        Dependent columns, or too few rows.
    """
    W, Y = matrix[:, 1:], matrix[:, 0]
    Z = W if instruments is None else instruments[:, 1:]
    free = solve(W, Y) if instruments is None else solve_instrumented(W, Y, Z)
    robust = combined_covariance(Z, W, free.bread, free.residuals, 1, lengths)
    return FreeCoefficients(free, robust, Z)


def fit_minimum_distance(
    model: Model,
    matrix: Array,
    lengths: tuple[int, ...],
    start: FitResult,
    instruments: Array | None = None,
) -> FitResult | None:
    """Physical parameters of a model of one equation from its free coefficients.

    Parameters
    ----------
    model : Model
        One block.
    matrix, lengths, instruments
        As `free_coefficients`.
    start : FitResult
        A fit of the model to start from.

    Returns
    -------
    FitResult or None
        None where the steps do not settle.

    Raises
    ------
    DataError
        As `free_coefficients`.
    """
    free = free_coefficients(matrix, lengths, instruments)
    scale = np.sqrt(np.diag(free.robust.covariance))
    weight = np.linalg.pinv(free.robust.covariance / np.outer(scale, scale), rcond=1e-12, hermitian=True)
    theta, gain = start.theta.copy(), np.zeros((start.theta.size, scale.size))
    for _ in range(MAX_STEPS):
        F = -model.jacobian(theta)[0][1:] / scale[:, None]
        gap = (free.regression.estimate + model.coefficients(theta)[0][1:]) / scale
        size = np.linalg.norm(F, axis=0)
        size[size == 0.0] = 1.0
        scaled = F / size
        gain = np.linalg.pinv(scaled.T @ weight @ scaled, rcond=1e-14) @ scaled.T @ weight / size[:, None]
        step = gain @ gap
        theta = theta + step
        if not np.all(np.isfinite(theta)):
            return None
        gain = gain / scale
        covariance = gain @ free.robust.covariance @ gain.T
        if np.max(np.abs(step) / np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))) < SETTLED:
            return _finish(model, matrix, start, free, theta, gain, covariance)
    return None


def _finish(
    model: Model,
    matrix: Array,
    start: FitResult,
    free: FreeCoefficients,
    theta: Array,
    gain: Array,
    covariance: Array,
) -> FitResult:
    residual = matrix @ model.coefficients(theta)[0]
    dof = float(np.min(free.robust.degrees_of_freedom))
    rows = max(residual.size - theta.size, 1)
    return replace(
        start,
        theta=theta,
        covariance=covariance,
        degrees_of_freedom=np.full(theta.size, dof),
        residuals=(residual,),
        sigmas=(float(np.sqrt(residual @ residual / rows)),),
        jacobian=matrix @ model.jacobian(theta)[0],
        weights=(1.0,),
        # A change of the residual moves the free coefficients against it, and the parameters with these.
        bread=-gain @ free.regression.bread,
        instruments=free.instruments,
    )
