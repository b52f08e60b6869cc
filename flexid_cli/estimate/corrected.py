"""The fit's equations with the noise of the columns taken out, and with instruments for noisy columns.

Least squares solves sum w^2 (M D)'(M a) = 0, where M holds measured columns: noise in M moves the solution. Here

    sum w^2 [(Z D)'(M a) - D'N a] = 0,

with Z the instruments (M itself where there are none) and N the expected cross products of the noise of Z and M.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from flexid_cli.estimate.covariance import combined_covariance
from flexid_cli.estimate.fit import FitResult, scaled_inverse
from flexid_cli.models.base import Model

Array = NDArray[np.float64]
Matrices = Sequence[Array]

MAX_STEPS = 12
SETTLED = 1e-4
# Where the noise makes up this much of what a direction of the parameters rests on, nothing would be left of it.
MAX_NOISE_SHARE = 0.8


def noise_share(model: Model, result: FitResult, moments: Matrices) -> float:
    """Largest share of noise in the normal matrix, over all directions of the parameters."""
    D = model.jacobian(result.theta)
    N = sum(w**2 * Dk.T @ Nk @ Dk for w, Dk, Nk in zip(result.weights, D, moments, strict=True))
    scale = np.linalg.norm(result.jacobian, axis=0)
    scale[scale == 0.0] = 1.0
    _, s, Vt = np.linalg.svd(result.jacobian / scale, full_matrices=False)
    root = Vt[: result.rank].T / s[: result.rank]
    inside = root.T @ (np.asarray(N) / np.outer(scale, scale)) @ root
    return float(np.linalg.eigvalsh(0.5 * (inside + inside.T))[-1])


def correct(
    model: Model,
    matrices: Matrices,
    result: FitResult,
    lengths: Sequence[int],
    *,
    moments: Matrices,
    instruments: Matrices | None = None,
) -> FitResult | None:
    """Solve the corrected equations from the solution of the plain ones.

    Parameters
    ----------
    model, matrices, result
        The plain fit.
    lengths : sequence of int
        Rows of each gap-free segment.
    moments : sequence of ndarray, shapes (columns, columns)
        N of each block: expected cross products of the noise of ``instruments`` (or ``matrices``) and ``matrices``.
    instruments : sequence of ndarray or None
        Z of each block.

    Returns
    -------
    FitResult or None
        With ``covariance`` robust to correlated residuals; None where the iteration does not settle.
    """
    Z = matrices if instruments is None else instruments
    theta = result.theta.copy()
    scale = np.where(result.stderr > 0.0, result.stderr, 1.0)
    last = np.inf
    cross = products(matrices, Z, moments, result.weights)
    for _ in range(MAX_STEPS):
        gradient, normal = equations(model, cross, theta)
        step = -scaled_inverse(normal) @ gradient
        size = float(np.max(np.abs(step) / scale))
        if not np.isfinite(size) or size > 2.0 * last:
            return None
        theta, last = theta + step, size
        if size < SETTLED:
            return _finish(model, matrices, Z, cross, result, theta, lengths)
    return None


def products(matrices: Matrices, Z: Matrices, moments: Matrices, weights: Sequence[float]) -> list[Array]:
    """Weighted cross products w^2 (Z'M - N) of each block: all that the estimating equations need of the record."""
    return [w**2 * (z.T @ M - N) for w, M, z, N in zip(weights, matrices, Z, moments, strict=True)]


def equations(model: Model, cross: Matrices, theta: Array) -> tuple[Array, Array]:
    """Left side of the estimating equations, shape (p,), and their normal matrix, shape (p, p)."""
    gradient, normal = np.zeros(theta.size), np.zeros((theta.size, theta.size))
    for C, a, D in zip(cross, model.coefficients(theta), model.jacobian(theta), strict=True):
        gradient += D.T @ (C @ a)
        normal += D.T @ C @ D
    return gradient, normal


def _finish(
    model: Model,
    matrices: Matrices,
    Z: Matrices,
    cross: Matrices,
    result: FitResult,
    theta: Array,
    lengths: Sequence[int],
) -> FitResult:
    _, normal = equations(model, cross, theta)
    bread = scaled_inverse(normal)
    derivatives = model.jacobian(theta)
    residuals = tuple(M @ a for M, a in zip(matrices, model.coefficients(theta), strict=True))
    jacobian = np.vstack([w * (M @ D) for w, M, D in zip(result.weights, matrices, derivatives, strict=True)])
    instrumented = [w * (z @ D) for w, z, D in zip(result.weights, Z, derivatives, strict=True)]
    stacked = np.concatenate([w * e for w, e in zip(result.weights, residuals, strict=True)])
    robust = combined_covariance(np.vstack(instrumented), jacobian, bread, stacked, len(residuals), lengths)
    rows = matrices[0].shape[0]
    share = theta.size / len(residuals)
    return replace(
        result,
        theta=theta,
        covariance=robust.covariance,
        degrees_of_freedom=robust.degrees_of_freedom,
        residuals=residuals,
        sigmas=tuple(float(np.sqrt(e @ e / max(rows - share, 1.0))) for e in residuals),
        jacobian=jacobian,
        instruments=np.vstack(instrumented),
        bread=bread,
    )


def doubt(model: Model, result: FitResult, moments: Mapping[int, Matrices], doubts: Sequence[float]) -> Array:
    """Standard error that the doubt about each noise level leaves after the correction, shape (p,).

    ``moments[k]`` is N of noise source k alone, ``doubts[k]`` the relative doubt about its variance.
    """
    total = np.zeros(result.theta.size)
    coefficients, derivatives = model.coefficients(result.theta), model.jacobian(result.theta)
    for source, single in moments.items():
        gradient = np.zeros(result.theta.size)
        for w, N, a, D in zip(result.weights, single, coefficients, derivatives, strict=True):
            gradient += w**2 * (D.T @ (N @ a))
        total += (doubts[source] * (result.bread @ gradient)) ** 2
    return np.asarray(np.sqrt(total), dtype=np.float64)
