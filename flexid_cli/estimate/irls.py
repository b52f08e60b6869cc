"""Iteratively reweighted least squares with Huber's weights: rows that fit badly lose their pull."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from flexid_cli.estimate.fit import FitResult, fit
from flexid_cli.models.base import Model

Array = NDArray[np.float64]

# 95 % of the efficiency of least squares on normal residuals (Huber, Annals of Mathematical Statistics 35 (1964) 73).
TUNING = 1.345
# Standard deviation of a normal variable over its median absolute deviation.
NORMAL = 1.4826
MAX_PASSES = 30
SETTLED = 1e-3


def fit_irls(
    model: Model,
    matrices: Sequence[Array],
    theta: Array,
    lengths: Sequence[int],
    *,
    weighted: bool,
    covariance: str = "hac",
) -> tuple[FitResult, float]:
    """Fit as `fit.fit` does, with Huber's weights on the rows of each equation.

    Returns
    -------
    FitResult, float
        Its ``residuals`` are those of the rows as they are; and the share of rows that lost weight.

    Raises
    ------
    DataError
        As `fit.fit`.
    """
    result = fit(model, matrices, theta, lengths, weighted=weighted, covariance=covariance)
    roots = [np.ones(M.shape[0]) for M in matrices]
    for _ in range(MAX_PASSES):
        roots = [
            _root_weights(M @ a) for M, a in zip(matrices, model.coefficients(result.theta), strict=True)
        ]
        rows = [M * r[:, None] for M, r in zip(matrices, roots, strict=True)]
        again = fit(model, rows, result.theta, lengths, weighted=weighted, covariance=covariance)
        moved = np.abs(again.theta - result.theta) / np.maximum(again.stderr, np.finfo(float).tiny)
        result = again
        if float(np.max(moved)) < SETTLED:
            break
    residuals = tuple(M @ a for M, a in zip(matrices, model.coefficients(result.theta), strict=True))
    light = float(np.mean(np.concatenate(roots) < 1.0))
    return replace(result, residuals=residuals, jacobian=_unweighted(model, matrices, result)), light


def _root_weights(residual: Array) -> Array:
    """Square roots of Huber's weights min(1, c s / abs(e)), s from the median absolute deviation."""
    scale = NORMAL * float(np.median(np.abs(residual - np.median(residual))))
    if scale == 0.0:
        return np.ones(residual.size)
    size = np.maximum(np.abs(residual), np.finfo(float).tiny)
    return np.asarray(np.sqrt(np.minimum(1.0, TUNING * scale / size)), dtype=np.float64)


def _unweighted(model: Model, matrices: Sequence[Array], result: FitResult) -> Array:
    derivatives = model.jacobian(result.theta)
    return np.vstack([w * (M @ D) for w, M, D in zip(result.weights, matrices, derivatives, strict=True)])
