"""Generalised least squares over records: against dense algebra, laws, and coverage on synthetic estimates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom, t

from flexid_cli.estimate.joint import Evidence, Joint, combine, paule_mandel

Array = np.ndarray
LONG = 1e9  # so long a record that its covariance is as good as known
TRUTH = np.array([3.0, 2000.0, -0.02])
SYMBOLS = ("Jm", "K", "MX")
SCALE = np.array([0.01, 5.0, 1e-4])


def covariance(rng: np.random.Generator, scale: Array = SCALE) -> Array:
    root = rng.normal(size=(scale.size, scale.size)) + np.eye(scale.size)
    return np.outer(scale, scale) * (root @ root.T) / scale.size


def evidence(
    rng: np.random.Generator,
    symbols: Sequence[str] = SYMBOLS,
    truth: Array = TRUTH,
    scale: Array = SCALE,
    dof: float = LONG,
) -> Evidence:
    """One record: estimates with errors of a covariance, which is estimated itself where dof is finite."""
    C = covariance(rng, scale)
    root = np.linalg.cholesky(C)
    seen = C
    if dof < LONG:
        draws = rng.normal(size=(int(dof), scale.size)) @ root.T
        seen = draws.T @ draws / dof
    theta = truth + root @ rng.normal(size=scale.size)
    return Evidence(tuple(symbols), theta, seen, np.full(scale.size, dof))


def stderr(joint: Joint, symbol: str) -> float:
    k = joint.symbols.index(symbol)
    return float(np.sqrt(joint.covariance[k, k]))


def value(joint: Joint, symbol: str) -> float:
    return float(joint.theta[joint.symbols.index(symbol)])


def held(joint: Joint, truth: Array, level: float = 0.95) -> Array:
    half = t.ppf(0.5 + 0.5 * level, joint.degrees_of_freedom) * np.sqrt(np.diag(joint.covariance))
    return np.abs(joint.theta - truth) < half


# --- algebra ---


def test_one_record_is_itself() -> None:
    one = evidence(np.random.default_rng(1))
    joint = combine([one])
    np.testing.assert_allclose(joint.theta, one.theta, rtol=1e-12)
    np.testing.assert_allclose(joint.covariance, one.covariance, rtol=1e-6)
    assert joint.consistency.p_value is None


def test_shared_and_own_parameters_against_dense_least_squares() -> None:
    rng = np.random.default_rng(2)
    a = evidence(rng, ("Jm", "K", "MX[a]"))
    b = evidence(rng, ("Jm", "K", "MX[b]"))
    joint = combine([a, b])
    assert joint.symbols == ("Jm", "K", "MX[a]", "MX[b]")
    X = np.zeros((6, 4))
    X[[0, 1, 2], [0, 1, 2]] = X[[3, 4, 5], [0, 1, 3]] = 1.0
    V = np.zeros((6, 6))
    V[:3, :3], V[3:, 3:] = a.covariance, b.covariance
    scale = np.sqrt(np.diag(V))
    whitened = np.linalg.solve(np.linalg.cholesky(V / np.outer(scale, scale)), np.diag(1.0 / scale))
    wanted, left, *_ = np.linalg.lstsq(whitened @ X, whitened @ np.r_[a.theta, b.theta], rcond=None)
    if joint.between.any() or joint.widened > 1.0:
        pytest.fail("these two records agree")
    np.testing.assert_allclose(joint.theta, wanted, rtol=1e-9)
    np.testing.assert_allclose(
        joint.covariance, np.linalg.inv((whitened @ X).T @ whitened @ X), rtol=1e-5, atol=1e-12
    )
    assert joint.consistency.statistic == pytest.approx(float(left[0]), rel=1e-6)
    assert joint.consistency.restrictions == 2


def test_a_record_counts_with_the_sum_that_it_determines() -> None:
    """The first record tells FVm from FV, the second only their sum, much better."""
    first = Evidence(("FVm", "FV"), np.array([3.0, 2.0]), np.diag([0.04, 0.04]), np.full(2, LONG))
    # The shortest solution of a regression that determines the sum 5.2 alone; its covariance has no other direction.
    second = Evidence(
        ("FVm", "FV"),
        np.array([2.6, 2.6]),
        1e-6 * np.full((2, 2), 0.25),
        np.full(2, LONG),
        directions=np.array([[1.0, 1.0]]),
        dependent=frozenset({"FVm", "FV"}),
    )
    joint = combine([first, second])
    assert joint.theta.sum() == pytest.approx(5.2, abs=1e-4)
    assert joint.theta[0] - joint.theta[1] == pytest.approx(1.0, abs=1e-6)
    assert float(np.sqrt(joint.covariance.sum())) == pytest.approx(1e-3, rel=1e-3)
    assert joint.dependent == ()
    alone = combine([second])
    assert alone.dependent == (0, 1)
    assert alone.theta.sum() == pytest.approx(5.2)


def test_what_no_record_determines_stays_open() -> None:
    rng = np.random.default_rng(4)
    blind = [
        replace(
            evidence(rng),
            directions=np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
            dependent=frozenset({"MX"}),
        )
        for _ in range(2)
    ]
    joint = combine(blind)
    assert [joint.symbols[k] for k in joint.dependent] == ["MX"]
    assert "MX" not in joint.differences
    assert np.isfinite(joint.theta).all()


# --- systematic parts ---


def records_with_a_shift(sizes: Sequence[float]) -> list[Evidence]:
    made = Evidence(("K",), np.array([2000.0]), np.array([[1.0]]), np.array([LONG]))
    return [replace(made, shifts={"timing": np.array([size])}) for size in sizes]


def test_a_common_source_does_not_average_out() -> None:
    few, many = combine(records_with_a_shift([2.0] * 2)), combine(records_with_a_shift([2.0] * 40))
    assert stderr(few, "K") == pytest.approx(np.sqrt(1.0 / 2.0 + 4.0), rel=1e-6)
    assert stderr(many, "K") == pytest.approx(np.sqrt(1.0 / 40.0 + 4.0), rel=1e-6)
    assert many.shifts["timing"] == pytest.approx([2.0])


def test_sources_of_opposite_sign_do_not_cancel() -> None:
    joint = combine(records_with_a_shift([2.0, -2.0]))
    assert joint.systematic[0, 0] == pytest.approx(2.0)


def test_a_record_with_a_large_doubt_weighs_little() -> None:
    good, bad = records_with_a_shift([0.0, 30.0])
    joint = combine([good, replace(bad, theta=np.array([2020.0]))])
    assert value(joint, "K") == pytest.approx(2000.0, abs=0.1)


# --- laws ---


def unequal(rng: np.random.Generator, records: int = 4) -> list[Evidence]:
    made = [evidence(rng, dof=40.0) for _ in range(records)]
    made = [
        replace(one, theta=one.theta * np.array([1.0, 1.0 + 0.03 * k, 1.0])) for k, one in enumerate(made)
    ]
    return [
        replace(one, shifts={"timing": one.theta * 1e-4, "width": one.theta * np.array([1e-4, -1e-4, 0.0])})
        for one in made
    ]


def test_the_order_of_the_records_does_not_matter() -> None:
    made = unequal(np.random.default_rng(5))
    forth, back = combine(made), combine(made[::-1])
    np.testing.assert_allclose(forth.theta, back.theta, rtol=1e-9)
    np.testing.assert_allclose(forth.covariance, back.covariance, rtol=1e-6)
    np.testing.assert_allclose(forth.degrees_of_freedom, back.degrees_of_freedom, rtol=1e-6)
    assert forth.consistency.p_value == pytest.approx(back.consistency.p_value, rel=1e-6)


@pytest.mark.parametrize("factors", [(1e6, 1e-3, 1.0), (1.0, 1.0, -1.0), (2.0**-20, 2.0**20, -8.0)])
def test_units_and_directions_are_only_names(factors: tuple[float, ...]) -> None:
    f = np.array(factors)
    made = unequal(np.random.default_rng(6))
    other = [
        replace(
            one,
            theta=f * one.theta,
            covariance=np.outer(f, f) * one.covariance,
            shifts={name: f * shift for name, shift in one.shifts.items()},
        )
        for one in made
    ]
    plain, changed = combine(made), combine(other)
    np.testing.assert_allclose(changed.theta, f * plain.theta, rtol=1e-8)
    np.testing.assert_allclose(np.diag(changed.covariance), f**2 * np.diag(plain.covariance), rtol=1e-6)
    assert changed.consistency.statistic == pytest.approx(plain.consistency.statistic, rel=1e-6)


# --- differences between records ---


def test_two_records_that_agree_are_not_widened() -> None:
    one = Evidence(("K",), np.array([2000.0]), np.array([[1.0]]), np.array([LONG]))
    joint = combine([one, replace(one, theta=np.array([2001.0]))])
    assert stderr(joint, "K") == pytest.approx(np.sqrt(0.5), rel=1e-6)
    assert joint.consistency.statistic == pytest.approx(0.5)


def test_two_records_that_contradict_each_other_get_birges_factor() -> None:
    one = Evidence(("K",), np.array([2000.0]), np.array([[1.0]]), np.array([LONG]))
    joint = combine([one, replace(one, theta=np.array([2060.0]))])
    assert stderr(joint, "K") == pytest.approx(30.0, rel=1e-3)  # half the difference
    assert joint.consistency.p_value < 1e-6
    assert joint.differences["K"].p_value < 1e-6


def test_what_differs_does_not_drag_what_is_correlated_with_it() -> None:
    """K differs by sixty of its standard errors; Jm, correlated with it in each record, agrees."""
    C = np.array([[1e-4, 0.9 * 1e-2], [0.9 * 1e-2, 1.0]])
    truth = [np.array([3.0, K]) for K in (2000.0, 2060.0, 1940.0)]
    joint = combine([Evidence(("Jm", "K"), x, C, np.full(2, LONG)) for x in truth])
    assert value(joint, "Jm") == pytest.approx(3.0, abs=1e-3)
    assert stderr(joint, "Jm") < 0.02


def test_paule_mandel_against_its_definition() -> None:
    rng = np.random.default_rng(8)
    values, variances = 5.0 + 3.0 * rng.normal(size=6), rng.uniform(0.1, 2.0, 6)
    between = paule_mandel(values, variances, 5.0)
    weights = 1.0 / (variances + between)
    mean = weights @ values / weights.sum()
    assert weights @ (values - mean) ** 2 == pytest.approx(5.0, rel=1e-9)
    assert paule_mandel(np.array([1.0, 1.001, 0.999]), np.ones(3), 2.0) == 0.0


DRAWS = 120


def not_below(count: int, of: int, share: float) -> bool:
    """Whether a count is not significantly (one in a thousand) below a share."""
    return bool(binom.cdf(count, of, share) > 1e-3)


@pytest.mark.parametrize(("records", "dof"), [(2, 40.0), (3, 40.0), (5, 20.0)])
def test_coverage_where_all_records_have_the_same_truth(records: int, dof: float) -> None:
    rng = np.random.default_rng(100 + records)
    joints = [combine([evidence(rng, dof=dof) for _ in range(records)]) for _ in range(DRAWS)]
    inside = np.array([held(joint, TRUTH) for joint in joints])
    for k in range(TRUTH.size):
        assert not_below(int(inside[:, k].sum()), DRAWS, 0.93)
    small = sum(joint.consistency.p_value < 0.05 for joint in joints)
    assert binom.sf(small - 1, DRAWS, 0.07) > 1e-3
    assert binom.cdf(small, DRAWS, 0.025) > 1e-3


@pytest.mark.parametrize("records", [3, 6])
@pytest.mark.parametrize("percent", [0.5, 3.0])
def test_coverage_where_the_stiffness_differs_between_records(records: int, percent: float) -> None:
    """Its standard error in each record is about 0.25 %."""
    rng = np.random.default_rng(1000 * records + int(percent))
    spread = np.array([0.0, 0.01 * percent * TRUTH[1], 0.0])
    joints = []
    for _ in range(DRAWS):
        truths = TRUTH + spread * rng.normal(size=(records, 1))
        joints.append(combine([evidence(rng, truth=truth, dof=40.0) for truth in truths]))
    inside = np.array([held(joint, TRUTH) for joint in joints])
    for k in range(TRUTH.size):
        assert not_below(int(inside[:, k].sum()), DRAWS, 0.92)
    width = np.median([t.ppf(0.975, j.degrees_of_freedom[1]) * stderr(j, "K") for j in joints])
    ideal = t.ppf(0.975, records - 1) * np.hypot(spread[1], 6.0) / np.sqrt(records)
    assert width < 2.0 * ideal


def test_short_records_count_less_than_their_covariance_says() -> None:
    """Six contrasts for three parameters: the inverse of such a covariance is three times too large on average."""
    rng = np.random.default_rng(9)
    short, long_ = evidence(rng, dof=6.0), evidence(rng, dof=600.0)
    assert short.inflation == pytest.approx(3.0)
    assert long_.inflation == pytest.approx(600.0 / 596.0)
    assert not replace(short, degrees_of_freedom=np.full(3, 5.0)).is_long_enough
