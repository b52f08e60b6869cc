"""X1..X7 without their restrictions, and the test of the restrictions (physics leaves six of seven free)."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flexid_cli.estimate.covariance import robust_covariance
from flexid_cli.estimate.least_squares import solve, solve_instrumented
from flexid_cli.estimate.result import Estimate
from flexid_cli.estimate.solution import Solution
from flexid_cli.models.base import Parameter
from flexid_cli.models.motor_only import REGRESSION

if TYPE_CHECKING:
    from flexid_cli.config.schema import Config

Array = NDArray[np.float64]
Make = Callable[[Parameter, float, float, float], Estimate]

# Columns after the torque: sign with which each enters X1, X2, X3..X6, X7.
_SIGNS = np.array([-1.0, -1.0, 1.0, 1.0, 1.0, 1.0, 1.0])

# An F statistic with fewer degrees of freedom below has no mean.
FEWEST_LEFT = 3.0


def regression(
    solution: Solution, config: Config, *, make: Make
) -> tuple[tuple[Estimate, ...], dict[str, Any]]:
    """Linear least squares for X1..X7 beside the columns that the paper dropped, and the J test.

    With instruments (`iv`) the linear solve uses them too.

    Returns
    -------
    tuple of Estimate, dict
        X1..X7 with intervals, and the over-determination test: how far the free coefficients are from those
        that six physical parameters allow, in their robust covariance (Wald statistic, F distribution).
    """
    M = solution.matrices[0]
    signs = np.concatenate([_SIGNS, np.ones(M.shape[1] - 8)])
    W, Y = M[:, 1:] * signs, M[:, 0]
    if solution.instruments is None:
        free = solve(W, Y)
        scores = W * free.residuals[:, None]
    else:
        Z = solution.instruments[0][:, 1:] * signs
        free = solve_instrumented(W, Y, Z)
        scores = Z * free.residuals[:, None]
    robust = robust_covariance(scores, free.bread.T, solution.columns.lengths)
    covariance = robust.covariance if config.estimate.covariance == "hac" else free.covariance
    stderr = np.sqrt(np.diag(covariance))
    estimates = tuple(
        make(p, float(free.estimate[k]), float(stderr[k]), float(robust.degrees_of_freedom[k]))
        for k, p in enumerate(REGRESSION)
    )
    # Where a short part of the record carries a coefficient, fewer cosines than B are independent.
    series = min(float(robust.series), float(np.min(robust.degrees_of_freedom)))
    return estimates, _wald(solution, free.estimate, robust.covariance, series)


def _wald(solution: Solution, free: Array, covariance: Array, series: float) -> dict[str, Any]:
    """Distance of the free coefficients from the restricted ones, minimised over the parameters."""
    from scipy.special import fdtrc

    signs = np.concatenate([_SIGNS, np.ones(free.size - 7)])
    model, theta = solution.model, solution.result.theta
    restricted = -model.coefficients(theta)[0][1:] * signs
    F = -model.jacobian(theta)[0][1:] * signs[:, None]
    scale = np.sqrt(np.diag(covariance))
    C = covariance / np.outer(scale, scale)
    g, F = (free - restricted) / scale, F / scale[:, None]
    weight = np.linalg.pinv(C)
    step = np.linalg.lstsq(F.T @ weight @ F, F.T @ weight @ g, rcond=None)[0]
    rest = g - F @ step
    statistic = float(rest @ weight @ rest)
    restrictions = free.size - int(np.linalg.matrix_rank(F))
    remaining = series - restrictions + 1
    if restrictions < 1 or remaining < FEWEST_LEFT:
        return {"statistic": None, "p_value": None, "reason": "too few rows for the test"}
    scaled = statistic / restrictions * remaining / series
    return {
        "statistic": statistic,
        "scaled_statistic": scaled,
        "restrictions": restrictions,
        "p_value": float(fdtrc(restrictions, remaining, max(scaled, 0.0))),
        "meaning": "a small p value: distortion, noise in the columns or missing physics bias the coefficients",
    }
