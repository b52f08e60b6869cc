"""Does a 95 % interval hold the truth in 95 % of the records? The robust covariance against simulated noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom, t

from flexid_cli.estimate import covariance as covariance_module
from flexid_cli.estimate.covariance import robust_covariance, series_length

Array = np.ndarray
LEVEL = 0.95
# Every acceptance region below holds the right answer with this probability.
SURE = 1.0 - 1e-4


def autoregressive(rng: np.random.Generator, rows: int, phi: float, columns: int = 1) -> Array:
    """Stationary AR(1) of unit variance."""
    noise = rng.standard_normal((rows + 100, columns))
    return lfilter([np.sqrt(1.0 - phi**2)], [1.0, -phi], noise, axis=0)[100:]


def moving_average(rng: np.random.Generator, rows: int, width: int, columns: int = 1) -> Array:
    """Noise after a smoothing filter, unit variance."""
    noise = rng.standard_normal((rows + width - 1, columns))
    return lfilter(np.full(width, width**-0.5), [1.0], noise, axis=0)[width - 1 :]


@dataclass(frozen=True)
class Case:
    """Two correlated regressors and a constant, with correlated residuals, in gap-free segments.

    ``shortfall`` is the part of the score's low-frequency power that the B cosines miss: for an AR(1) of the
    scores it is known; it lowers the coverage, and no estimator of finitely many rows is free of it.
    """

    lengths: tuple[int, ...]
    regressor: float
    residual: float
    average: int = 0
    burst: float = 0.0

    def draw(self, rng: np.random.Generator) -> tuple[Array, Array]:
        columns, residuals = [], []
        for rows in self.lengths:
            columns.append(np.hstack([autoregressive(rng, rows, self.regressor, 2), np.ones((rows, 1))]))
            e = (
                moving_average(rng, rows, self.average)
                if self.average
                else autoregressive(rng, rows, self.residual)
            )
            time = np.arange(rows) / rows
            residuals.append(e[:, 0] * (1.0 + self.burst * (np.abs(time - 0.5) < 0.05)))
        return np.vstack(columns), np.concatenate(residuals)

    @property
    def rows(self) -> int:
        return sum(self.lengths)


def shortfall(phi: float, rows: int, series: int) -> float:
    """Expected standard error over the true one for scores that follow an AR(1)."""
    w = np.pi * np.arange(1, series + 1) / rows
    density = (1.0 - phi) ** 2 / (1.0 - 2.0 * phi * np.cos(w) + phi**2)
    return float(np.sqrt(density.mean()))


@dataclass(frozen=True)
class Outcome:
    """Many records: estimates (truth zero), robust and textbook standard errors, degrees of freedom."""

    estimate: Array
    stderr: Array
    dof: Array
    textbook: Array

    @property
    def coverage(self) -> Array:
        return np.mean(np.abs(self.estimate) < t.ppf(0.5 + 0.5 * LEVEL, self.dof) * self.stderr, axis=0)

    @property
    def textbook_coverage(self) -> Array:
        return np.mean(np.abs(self.estimate) < 1.96 * self.textbook, axis=0)


def simulate(case: Case, trials: int, seed: int) -> Outcome:
    rng = np.random.default_rng(seed)
    result = []
    for _ in range(trials):
        W, e = case.draw(rng)
        bread = np.linalg.inv(W.T @ W)
        estimate = bread @ W.T @ e
        residual = e - W @ estimate
        robust = robust_covariance(W * residual[:, None], bread, case.lengths)
        sigma2 = residual @ residual / (len(e) - W.shape[1])
        result.append(
            (
                estimate,
                np.sqrt(np.diag(robust.covariance)),
                robust.degrees_of_freedom,
                np.sqrt(sigma2 * np.diag(bread)),
            )
        )
    return Outcome(*(np.array(part) for part in zip(*result, strict=True)))


def acceptance(probability: float, trials: int) -> tuple[float, float]:
    low, high = binom.interval(SURE, trials, probability)
    return low / trials, high / trials


CASES = {
    "white": Case((300,), 0.0, 0.0),
    "weak": Case((300,), 0.5, 0.5),
    "strong": Case((1000,), 0.7, 0.7),
    "smoothed": Case((600,), 0.6, 0.0, average=5),
    "segments": Case((500, 250, 120), 0.5, 0.5),
    "burst": Case((600,), 0.5, 0.5, burst=4.0),
}
SLOW_CASES = CASES | {
    "stronger": Case((1000,), 0.85, 0.85),
    "long": Case((5000,), 0.9, 0.9),
    "many segments": Case((90,) * 10, 0.4, 0.4),
    "burst in segments": Case((600, 300), 0.3, 0.3, burst=6.0),
}


def expected_coverage(case: Case, column: int, dof: float) -> float:
    """Coverage with the power that B cosines miss: scores of regressor and residual AR(1) are an AR(1) product."""
    phi = case.residual * (case.regressor if column < 2 else 1.0)
    if case.average:
        phi = (case.average - 1) / (case.average + 1) * (case.regressor if column < 2 else 1.0)
    series = series_length(case.rows, 3)
    ratio = shortfall(phi, case.rows, series)
    return float(2.0 * t.cdf(t.ppf(0.5 + 0.5 * LEVEL, dof) * ratio, dof) - 1.0)


def check_coverage(case: Case, trials: int, seed: int) -> None:
    outcome = simulate(case, trials, seed)
    for column in range(3):
        expected = expected_coverage(case, column, float(np.median(outcome.dof[:, column])))
        low, _ = acceptance(expected, trials)
        # Each estimated regression parameter takes a little of the low-frequency power of the residuals.
        assert outcome.coverage[column] > low - 0.01, (column, outcome.coverage[column], expected)
        # Never much too wide: bursts leave few degrees of freedom, whose estimate errs to the safe side.
        _, high = acceptance(0.99 if case.burst else 0.965, trials)
        assert outcome.coverage[column] < high, (column, outcome.coverage[column])


@pytest.mark.parametrize("name", CASES)
def test_intervals_hold_the_truth_as_often_as_they_say(name: str):
    check_coverage(CASES[name], trials=300, seed=20010521)


@pytest.mark.slow
@pytest.mark.parametrize("name", SLOW_CASES)
def test_intervals_hold_the_truth_in_many_records(name: str):
    check_coverage(SLOW_CASES[name], trials=4000, seed=7)


def test_textbook_intervals_do_not():
    """What the robust covariance is for: independent residuals assumed, correlated ones met."""
    outcome = simulate(CASES["strong"], 300, 3)
    assert np.all(outcome.textbook_coverage < 0.85)
    assert np.all(outcome.coverage > 0.88)
    white = simulate(CASES["white"], 300, 3)
    low, high = acceptance(LEVEL, 300)
    assert np.all((white.textbook_coverage > low) & (white.textbook_coverage < high))


def test_on_white_noise_the_covariance_is_the_textbook_one_on_average():
    """E[covariance] = sigma^2 (W'W)^-1 for a fixed W: the scaling, not only the coverage."""
    rng = np.random.default_rng(11)
    rows, sigma, trials = 400, 3.0, 800
    W = np.column_stack([autoregressive(rng, rows, 0.6, 2), np.ones(rows)])
    bread = np.linalg.inv(W.T @ W)
    hat = W @ bread @ W.T
    total = np.zeros((trials, 3, 3))
    for k in range(trials):
        e = sigma * rng.standard_normal(rows)
        total[k] = robust_covariance(W * (e - hat @ e)[:, None], bread, (rows,)).covariance
    exact = sigma**2 * bread
    scale = np.sqrt(np.outer(np.diag(exact), np.diag(exact)))
    error = (total.mean(axis=0) - exact) / scale
    spread = total.std(axis=0) / scale / np.sqrt(trials)
    # The residuals miss p of r degrees of freedom, which the factor r / (r - p) gives back evenly; what a slow
    # column takes from the first cosines it takes from B of them, so up to 1 / B remains on the diagonal.
    assert np.all(np.abs(error) < 4.0 * spread + 1.0 / series_length(rows, 3))


@pytest.mark.parametrize(("lengths", "phi"), [((800,), 0.6), ((500, 200, 100), 0.6), ((800,), -0.4)])
def test_the_variance_of_a_mean_is_the_spectrum_over_the_first_cosines(lengths: tuple[int, ...], phi: float):
    """Without regression the estimator's expectation is known exactly: the spectral density averaged over B."""
    rng = np.random.default_rng(12)
    rows, trials = sum(lengths), 800
    bread = np.array([[1.0 / rows]])
    values = []
    for _ in range(trials):
        e = np.concatenate([autoregressive(rng, n, phi) for n in lengths])
        values.append(robust_covariance(e, bread, lengths).covariance[0, 0] * (rows - 1) / rows)
    total = series_length(rows, 1)
    expected = 0.0
    for n in lengths:
        j = np.arange(1, max(1, round(total * n / rows)) + 1)
        lag = np.arange(n)
        covariance = phi ** np.abs(lag[:, None] - lag[None, :])
        cosines = np.sqrt(2.0 / n) * np.cos(np.pi * np.outer(lag + 0.5, j) / n)
        expected += n * np.mean(np.einsum("ij,ik,kj->j", cosines, covariance, cosines)) / rows**2
    assert abs(np.mean(values) - expected) < 4.0 * np.std(values) / np.sqrt(trials)


def test_segments_do_not_leak_into_each_other():
    """Order of segments, and a constant shift between them, change nothing; each has its own cosines."""
    rng = np.random.default_rng(13)
    a, b = autoregressive(rng, 200, 0.5, 2), autoregressive(rng, 120, 0.5, 2)
    bread = np.eye(2)
    one = robust_covariance(np.vstack([a, b]), bread, (200, 120))
    other = robust_covariance(np.vstack([b, a]), bread, (120, 200))
    shifted = robust_covariance(np.vstack([a + 5.0, b - 3.0]), bread, (200, 120))
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-12)
    np.testing.assert_allclose(one.covariance, shifted.covariance, rtol=1e-9)


def test_sign_direction_of_time_and_order_of_parameters_do_not_matter():
    scores = autoregressive(np.random.default_rng(14), 150, 0.4, 2)
    one = robust_covariance(scores, np.eye(2), (150,)).covariance
    for changed in (-scores, scores[::-1]):
        np.testing.assert_allclose(robust_covariance(changed, np.eye(2), (150,)).covariance, one, rtol=1e-10)
    swapped = robust_covariance(scores[:, ::-1], np.eye(2), (150,)).covariance
    np.testing.assert_allclose(swapped[::-1, ::-1], one, rtol=1e-10)


def test_units_of_the_parameters_do_not_matter():
    rng = np.random.default_rng(15)
    scores = autoregressive(rng, 200, 0.4, 3)
    units = np.array([1e-6, 1.0, 1e5])
    bread = np.linalg.inv(scores.T @ scores)
    plain = robust_covariance(scores, bread, (200,))
    scaled = robust_covariance(scores * units, bread / np.outer(units, units), (200,))
    np.testing.assert_allclose(scaled.covariance * np.outer(units, units), plain.covariance, rtol=1e-9)
    np.testing.assert_allclose(scaled.degrees_of_freedom, plain.degrees_of_freedom, rtol=1e-9)


def measured_dof(variance: Array) -> float:
    """Degrees of freedom that variances with this mean and spread have (two moments of chi-square)."""
    return float(2.0 * variance.mean() ** 2 / variance.var())


@pytest.mark.parametrize(
    ("burst", "lengths"), [(0.0, (700,)), (0.0, (400, 200, 100)), (6.0, (700,)), (6.0, (400, 300))]
)
def test_degrees_of_freedom_are_those_of_the_simulated_variances(burst: float, lengths: Sequence[int]):
    """White scores: Satterthwaite's value against the spread of the variances over many records."""
    rng = np.random.default_rng(16)
    trials, values, announced = 800, [], []
    bread = np.array([[1.0]])
    for _ in range(trials):
        parts = []
        for n in lengths:
            size = 1.0 + burst * (np.abs(np.arange(n) / n - 0.5) < 0.05)
            parts.append(size * rng.standard_normal(n))
        robust = robust_covariance(np.concatenate(parts)[:, None], bread, lengths)
        values.append(robust.covariance[0, 0])
        announced.append(robust.degrees_of_freedom[0])
    truth = measured_dof(np.array(values))
    # The relative error of a variance of chi-square-like values is about sqrt((2 + 12 / dof) / trials).
    error = np.sqrt((2.0 + 12.0 / truth) / trials)
    # The variance of a row is read from smoothed squares, whose own noise counts as unevenness: it lowers the
    # announced value by up to a fifth (a longer tail of t than needed), and must not raise it.
    assert np.median(announced) < truth * (1.0 + 4.0 * error) * 1.1
    assert np.median(announced) > truth * (1.0 - 4.0 * error) * 0.75
    if burst:
        # A tenth of the record carries the score: far fewer than the number of cosines.
        assert truth < 0.45 * series_length(sum(lengths), 1)


def test_stationary_scores_have_as_many_degrees_of_freedom_as_cosines():
    scores = np.sign(np.random.default_rng(17).standard_normal((2000, 1)))
    robust = robust_covariance(scores, np.array([[1.0]]), (2000,))
    assert robust.series == series_length(2000, 1)
    assert robust.degrees_of_freedom[0] == pytest.approx(robust.series, rel=1e-9)


def test_the_number_of_cosines_follows_the_rule_of_its_authors():
    """B = 0.41 T^(2/3), Lazarus, Lewis, Stock and Watson (2018), section 3."""
    for rows in (200, 1000, 10000):
        assert series_length(rows, 2) == round(0.41 * rows ** (2.0 / 3.0))
    # Few rows, many parameters: enough cosines for a covariance of full rank, never more than there are.
    assert series_length(30, 9) == 11
    assert series_length(5, 9) == 4
    assert series_length(2, 1) == 1
    scores = np.random.default_rng(18).standard_normal((40, 9))
    assert np.linalg.matrix_rank(robust_covariance(scores, np.eye(9), (40,)).covariance) == 9


@pytest.mark.parametrize("lengths", [(300,), (200, 80, 20), (1, 60), (25,)])
@pytest.mark.parametrize("blocks", [1, 2])
def test_stationary_covariance_is_the_sum_over_the_lags(lengths: tuple[int, ...], blocks: int):
    rows, rng = sum(lengths), np.random.default_rng(3)
    Z = rng.standard_normal((blocks * rows, 4))
    e = np.cumsum(rng.standard_normal(blocks * rows)) / 5.0
    found = covariance_module._stationary(Z, e, np.eye(4), blocks, lengths)
    # Every pair of rows of one segment, with the window and the autocovariance of its lag.
    segment = np.repeat(np.arange(len(lengths)), lengths)
    lag = np.arange(rows)[:, None] - np.arange(rows)
    same = segment[:, None] == segment
    width = covariance_module.LAG_FACTOR * np.sqrt(rows)
    reach = min(int(width), max(lengths) - 1)
    residuals = e.reshape(blocks, rows)
    total = np.zeros((4, 4))
    for a in range(blocks):
        for b in range(blocks):
            products = np.outer(residuals[a], residuals[b])
            gamma = {k: products[same & (lag == k)].sum() / rows for k in range(-reach, reach + 1)}
            window = {k: float(covariance_module._parzen(np.array(abs(k) / width))) for k in gamma}
            G = sum(window[k] * gamma[k] * (same & (lag == k)) for k in gamma)
            total += Z[a * rows : (a + 1) * rows].T @ G @ Z[b * rows : (b + 1) * rows]
    np.testing.assert_allclose(found, total * rows / (rows - 4), rtol=1e-9, atol=1e-9 * np.abs(total).max())


@pytest.mark.parametrize(("rows", "count"), [(50, 12), (50, 98), (3, 4), (1, 2)])
def test_cosine_sums_are_those_of_the_cosines(rows: int, count: int):
    x = np.random.default_rng(4).standard_normal((rows, 3))
    t = (np.arange(rows) + 0.5) / rows
    cosines = np.cos(np.pi * np.outer(np.arange(count + 1), t))
    np.testing.assert_allclose(covariance_module._cosine_sums(x, count), cosines @ x, atol=1e-12)
