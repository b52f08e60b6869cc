"""Tests of a solution, for the report: endogeneity, whiteness, independence of the inputs, stability in time."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexid_cli.estimate import corrected
from flexid_cli.estimate.covariance import robust_covariance
from flexid_cli.estimate.fit import FitResult
from flexid_cli.estimate.profile import profile_interval
from flexid_cli.estimate.solution import Solution

Array = NDArray[np.float64]

LAGS = 20
# Parameters whose stability and endogeneity are asked for: those that every flexible model determines.
JUDGED = ("Jm", "K", "JL")
# Correlations of this much of their largest size are counted for the effective sample size (Bartlett's sum).
NEGLIGIBLE = 0.05


def solution_tests(solution: Solution) -> dict[str, dict[str, Any]]:
    """Every test that applies to the solution, by name."""
    residual = solution.result.residuals[0]
    lengths = solution.columns.lengths
    tests = {
        "whiteness": whiteness(residual, lengths),
        "input_correlation": input_correlation(residual, solution.columns("torque", 0) - residual, lengths),
    }
    indices = [k for k, p in enumerate(solution.model.parameters) if p.symbol in JUDGED]
    if indices and not set(indices) & set(solution.result.dependent):
        symbols = [solution.model.parameters[k].symbol for k in indices]
        tests["stability"] = stability(solution.result, indices, symbols, lengths)
        if solution.instruments is not None:
            tests["endogeneity"] = endogeneity(solution, indices)
    return tests


def stiffness_profile(solution: Solution, stderr: float, level: float) -> dict[str, Any]:
    """Profile interval of K with the total standard error, beside the symmetric one that is reported."""
    from scipy.special import ndtri

    result = solution.result
    symbols = [p.symbol for p in solution.model.parameters]
    index = symbols.index("K")
    Z = solution.instruments or solution.matrices
    moments = () if solution.correction is None else solution.correction.moments
    none = tuple(np.zeros((M.shape[1], M.shape[1])) for M in solution.matrices)
    cross = corrected.products(solution.matrices, Z, moments or none, result.weights)
    half = float(ndtri(0.5 + 0.5 * level)) * stderr
    low, high = profile_interval(solution.model, cross, result.theta, result.stderr, index, half)
    return {
        "low": low,
        "high": high,
        "level": level,
        "symmetric_low": float(result.theta[index]) - half,
        "symmetric_high": float(result.theta[index]) + half,
        "meaning": "normal quantile; bounds unlike the symmetric ones: the stiffness bends the model, trust these",
    }


def influence(result: FitResult) -> Array:
    """Part of each row in the error of the estimates, shape (r, p): what the robust covariance sums."""
    blocks = len(result.residuals)
    stacked = np.concatenate([w * e for w, e in zip(result.weights, result.residuals, strict=True)])
    scores = (
        (result.instruments * stacked[:, None]).reshape(blocks, -1, result.instruments.shape[1]).sum(axis=0)
    )
    return np.asarray(-scores @ result.bread.T, dtype=np.float64)


def endogeneity(solution: Solution, indices: Sequence[int]) -> dict[str, Any]:
    """Compare least squares with the instruments' solution (Durbin, Wu and Hausman).

    The difference of the two estimates of Jm, K and JL, in its own robust covariance (that of the difference of
    their influences, so that it holds for correlated residuals).
    """
    from scipy.special import fdtrc

    from flexid_cli.estimate.fit import fit

    result = solution.result
    plain = fit(solution.model, solution.matrices, result.theta, solution.columns.lengths, weighted=False)
    pick = np.asarray(indices)
    gap = (plain.theta - result.theta)[pick]
    difference = (influence(plain) - influence(result))[:, pick]
    scale = np.linalg.norm(difference, axis=0)
    if not np.all(scale > 0.0):
        return {"statistic": None, "p_value": None, "reason": "instruments and columns are the same"}
    robust = robust_covariance(difference / scale, np.eye(pick.size), solution.columns.lengths)
    statistic = float((gap / scale) @ np.linalg.pinv(robust.covariance, rcond=1e-10) @ (gap / scale))
    series = min(float(robust.series), float(np.min(robust.degrees_of_freedom)))
    remaining = series - pick.size + 1
    if remaining < 1.0:
        return {
            "statistic": statistic,
            "p_value": None,
            "reason": "too few independent stretches for the test",
        }
    scaled = statistic / pick.size * remaining / series
    return {
        "statistic": statistic,
        "restrictions": int(pick.size),
        "p_value": float(fdtrc(pick.size, remaining, max(scaled, 0.0))),
        "meaning": "a small p value: noise in the columns biases plain least squares, which is why it was not taken",
    }


def whiteness(residual: Array, lengths: Sequence[int]) -> dict[str, Any]:
    """Ljung and Box on the rows of the torque's residual, and the rows that are worth an independent one."""
    from scipy.special import chdtrc

    lags = min(LAGS, max(1, min(lengths) // 4))
    rho = autocorrelation(residual, lengths, lags)
    n = residual.size
    statistic = float(n * (n + 2) * np.sum(rho**2 / (n - np.arange(1, lags + 1))))
    first = np.flatnonzero(np.abs(rho) < NEGLIGIBLE)
    used = rho[: int(first[0])] if first.size else rho
    return {
        "statistic": statistic,
        "lags": lags,
        "p_value": float(chdtrc(lags, max(statistic, 0.0))),
        "first_autocorrelation": float(rho[0]),
        "rows": int(n),
        "effective_rows": float(n / max(1.0 + 2.0 * float(np.sum(used)), 1.0 / n)),
        "meaning": "a small p value: the residual is coloured, so that textbook standard errors would be wrong",
    }


def autocorrelation(x: Array, lengths: Sequence[int], lags: int) -> Array:
    """Correlation at lags 1 to ``lags``, products across gaps left out."""
    parts = np.split(x - x.mean(), np.cumsum(lengths)[:-1])
    power = sum(float(p @ p) for p in parts)
    if power == 0.0:
        return np.zeros(lags)
    return np.array([sum(float(p[k:] @ p[:-k]) for p in parts) / power for k in range(1, lags + 1)])


def input_correlation(residual: Array, predicted: Array, lengths: Sequence[int]) -> dict[str, Any]:
    """Largest correlation of the residual with the predicted torque at any lag, against chance.

    Two independent series correlate with the variance sum_k rho_e(k) rho_u(k) / n (Bartlett 1935); the p value is
    Bonferroni's over the lags.
    """
    from scipy.special import ndtr

    lags = min(LAGS, max(1, min(lengths) // 4))
    e, u = residual - residual.mean(), predicted - predicted.mean()
    size = float(np.linalg.norm(e) * np.linalg.norm(u))
    if size == 0.0:
        return {"statistic": None, "p_value": None, "reason": "no residual, or no torque"}
    both = autocorrelation(e, lengths, lags) * autocorrelation(u, lengths, lags)
    spread = float(np.sqrt(max(1.0 + 2.0 * float(np.sum(both)), 1.0 / e.size) / e.size))
    starts = np.concatenate([[0], np.cumsum(lengths)])
    found = []
    for lag in range(-lags, lags + 1):
        total = 0.0
        for a, b in pairwise(int(s) for s in starts):
            x, y = e[a:b], u[a:b]
            total += float(x[lag:] @ y[: y.size - lag]) if lag >= 0 else float(x[:lag] @ y[-lag:])
        found.append(total / size)
    worst = int(np.argmax(np.abs(found)))
    statistic = abs(found[worst]) / spread
    return {
        "statistic": statistic,
        "correlation": float(found[worst]),
        "lag_rows": worst - lags,
        "p_value": min(1.0, 2.0 * float(ndtr(-statistic)) * (2 * lags + 1)),
        "meaning": "a small p value: the torque explains a part of the residual that the model leaves out",
    }


def stability(
    result: FitResult, indices: Sequence[int], symbols: Sequence[str], lengths: Sequence[int]
) -> dict[str, Any]:
    """Find whether a part of the record pulls a parameter away from the rest.

    The cumulative sum of a parameter's influence over its long-run standard deviation is a Brownian bridge while the
    parameter stays the same (Ploberger and Kramer, Econometrica 60 (1992) 271); time counts by the share of the
    influence's own variance that has passed, for a sweep does not inform on a parameter evenly. Bonferroni over the
    parameters.
    """
    from scipy.special import kolmogorov

    parts = influence(result)[:, list(indices)]
    parts = parts - parts.mean(axis=0)
    robust = robust_covariance(parts, np.eye(len(indices)), lengths)
    sigma = np.sqrt(np.maximum(np.diag(robust.covariance), np.finfo(float).tiny))
    sums = np.cumsum(parts, axis=0)
    passed = np.cumsum(parts**2, axis=0)
    bridge = (sums - passed / passed[-1] * sums[-1]) / sigma
    peaks = np.max(np.abs(bridge), axis=0)
    worst = int(np.argmax(peaks))
    return {
        "statistic": float(peaks[worst]),
        "parameter": symbols[worst],
        "row": int(np.argmax(np.abs(bridge[:, worst]))),
        "p_value": min(1.0, float(kolmogorov(peaks[worst])) * len(indices)),
        "meaning": "a small p value: the parameter is not the same throughout the record",
    }
