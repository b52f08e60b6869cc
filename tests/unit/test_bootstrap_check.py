"""Block bootstrap of the influences: lengths and spreads against their closed forms, and in a report."""

from __future__ import annotations

import time
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from flexid_cli.estimate import bootstrap
from flexid_cli.estimate.bootstrap import block_length, block_spread, interval_check
from flexid_cli.estimate.fit import fit
from flexid_cli.estimate.solution import Solution
from flexid_cli.models.base import Block, Parameter


def autoregressive(rng, n, rho):
    return lfilter([1.0], [1.0, -rho], rng.standard_normal(n + 500))[500:]


@pytest.mark.parametrize("rho", [0.3, 0.6, 0.9])
def test_block_length_is_near_the_optimum_of_a_first_order_process(rho):
    # g = 1/(1-rho)^2 and G = 2 rho / ((1-rho)^3 (1+rho)), so (G/g) = 2 rho / (1 - rho^2).
    n = 20_000
    optimum = (1.5 * (2.0 * rho / (1.0 - rho**2)) ** 2 * n) ** (1.0 / 3.0)
    rng = np.random.default_rng(1)
    found = [block_length(autoregressive(rng, n, rho)[:, None], (n,)) for _ in range(9)]
    assert np.median(found) == pytest.approx(optimum, rel=0.3)


def test_white_rows_need_no_blocks():
    rng = np.random.default_rng(2)
    assert np.median([block_length(rng.standard_normal((5000, 1)), (5000,)) for _ in range(9)]) <= 4
    assert block_length(np.zeros((100, 2)), (100,)) == 1
    assert block_length(rng.standard_normal((6, 1)), (1,) * 6) == 1


def test_the_longest_of_several_series_counts():
    rng = np.random.default_rng(3)
    white, slow = rng.standard_normal(4000), autoregressive(rng, 4000, 0.9)
    both = block_length(np.column_stack([white, slow]), (4000,))
    assert both == block_length(slow[:, None], (4000,)) > block_length(white[:, None], (4000,))


@pytest.mark.parametrize("rho", [0.0, 0.7])
def test_the_spread_is_the_long_run_variance(rho):
    rng = np.random.default_rng(4)
    n = 20_000
    found = []
    for _ in range(5):
        x = autoregressive(rng, n, rho)[:, None]
        found.append(block_spread(x, (n,), block_length(x, (n,)), draws=400)[0])
    assert np.mean(found) == pytest.approx(np.sqrt(n) / (1.0 - rho), rel=0.08)


def test_a_plain_bootstrap_of_single_rows_is_known_exactly():
    x = np.random.default_rng(5).standard_normal((300, 2)) * np.array([1.0, 7.0])
    exact = np.sqrt(300) * np.std(x, axis=0)
    np.testing.assert_allclose(block_spread(x, (300,), 1, draws=20_000), exact, rtol=0.02)


def test_blocks_stay_within_their_segment():
    # Two segments of opposite level that both are constant: within each, all blocks are the same number.
    x = np.repeat([1.0, -1.0], 50)[:, None]
    exact = 10 * np.sqrt(10)  # ten blocks of +-10
    assert block_spread(x, (50, 50), 10, draws=4000)[0] == pytest.approx(exact, rel=0.04)
    blended = block_spread(x, (100,), 10, draws=4000)[0]
    assert blended < 0.97 * exact


def test_the_same_record_gives_the_same_numbers():
    x = np.random.default_rng(6).standard_normal((500, 3))
    np.testing.assert_array_equal(block_spread(x, (500,), 5), block_spread(x, (500,), 5))


class Line:
    """y = Jm x + K w."""

    id = "line"
    equation = "y = Jm x + K w"
    parameters = (Parameter("motor_inertia", "Jm", "inertia"), Parameter("joint_stiffness", "K", "stiffness"))
    blocks = (Block("motor", (("torque", 0), ("x", 0), ("w", 0))),)

    def coefficients(self, theta):
        return (np.concatenate([[1.0], -theta]),)

    def jacobian(self, theta):
        return (np.vstack([np.zeros(2), -np.eye(2)]),)


def solution(n, rho=0.0, seed=0, method="structured"):
    rng = np.random.default_rng(seed)
    W = np.column_stack([autoregressive(rng, n, rho), rng.standard_normal(n)])
    y = W @ np.array([2.0, 3.0]) + autoregressive(rng, n, rho)
    matrices = (np.column_stack([y, W]),)
    result = fit(Line(), matrices, np.zeros(2), (n,), weighted=False)
    return Solution(Line(), SimpleNamespace(lengths=(n,)), matrices, result, None, method, "")  # type: ignore[arg-type]


@pytest.mark.parametrize("rho", [0.0, 0.7])
def test_bootstrap_refits_and_robust_errors_agree_on_a_linear_model(rho):
    ratios = {"ratios": [], "refit_ratios": []}
    for seed in range(12):
        found = interval_check(solution(2000, rho, seed))
        for name, values in ratios.items():
            values.extend(found[name].values())
    assert 0.8 < np.mean(ratios["ratios"]) < 1.05
    assert 0.8 < np.mean(ratios["refit_ratios"]) < 1.1


def test_numbers_are_reported_with_their_own_error():
    found = interval_check(solution(1500))
    assert found["monte_carlo_error"] == pytest.approx(1.0 / np.sqrt(2 * 998))
    assert found["refit_monte_carlo_error"] == pytest.approx(1.0 / np.sqrt(2 * (bootstrap.REFITS - 1)))
    assert set(found["ratios"]) == {"Jm", "K"}
    assert found["smallest_ratio"] == min(found["ratios"].values())
    assert found == interval_check(solution(1500))
    assert "refits" not in interval_check(solution(1500, method="irls"))


def test_a_short_record_is_not_judged():
    found = interval_check(solution(60, 0.95))
    assert found["statistic"] is None
    assert "too short" in found["reason"]


def test_it_is_fast():
    large = solution(6000, 0.5)
    start = time.process_time()
    interval_check(large)
    assert time.process_time() - start < 0.5
