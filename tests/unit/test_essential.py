"""Essential parameters: the sequence of F tests in closed form, sizes and powers, and what a record gives."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner
from scipy import stats

from flexid_cli.cli.main import main
from flexid_cli.config.load import parse_config
from flexid_cli.errors import FlexidError
from flexid_cli.estimate.essential import Restricted, reduce_solution
from flexid_cli.estimate.fit import fit
from flexid_cli.estimate.identify import identify
from flexid_cli.estimate.solution import Solution
from flexid_cli.models.base import Block, Parameter
from flexid_cli.models.motor_only import MotorOnly
from flexid_cli.signals.recording import Recording, Segment
from flexid_cli.simulate.axis import Axis, Controller, Sensors, chirp, simulate

LEVEL = 0.05
TEXT = """
version: 1
axis: {{name: axis, gear_ratio: 1, f1_hz: 4.0}}
signals:
  joint_torque: {{source: u, unit: N.m, hold: instant}}
  motor_position: {{source: qm, unit: rad}}
  joint_position: {{source: q, unit: rad}}
models: [{model}]
estimate: {{method: {method}, essential: {essential}}}
"""


class Linear:
    """y = W theta: one equation, any number of columns."""

    id = "linear"
    equation = "y = W theta"

    def __init__(self, symbols: tuple[str, ...]) -> None:
        self.parameters = tuple(Parameter(s, s, "viscous") for s in symbols)
        self.blocks = (Block("motor", (("torque", 0), *((s, 0) for s in symbols))),)

    def coefficients(self, theta):
        return (np.concatenate([[1.0], -theta]),)

    def jacobian(self, theta):
        return (np.vstack([np.zeros(theta.size), -np.eye(theta.size)]),)


def solved(W, y, symbols, covariance):
    model, lengths = Linear(symbols), (y.size,)
    matrices = (np.column_stack([y, W]),)
    result = fit(model, matrices, np.zeros(W.shape[1]), lengths, weighted=False, covariance=covariance)
    columns = SimpleNamespace(lengths=lengths)
    return Solution(model, columns, matrices, result, None, "structured", "")  # type: ignore[arg-type]


def reduced(W, y, symbols, covariance="iid", shifts=None):
    solution = solved(W, y, symbols, covariance)
    return reduce_solution(
        solution, solution.result.covariance, shifts or {}, level=LEVEL, covariance=covariance
    )


def squares(W, y, kept):
    theta = np.linalg.lstsq(W[:, kept], y, rcond=None)[0]
    return float(np.sum((y - W[:, kept] @ theta) ** 2))


def closed_form(W, y, may_go):
    """Backward elimination by residual sums of squares alone."""
    kept, steps = list(range(W.shape[1])), []
    while True:
        here, dof = squares(W, y, kept), y.size - len(kept)
        ratios = {
            k: (squares(W, y, [j for j in kept if j != k]) - here) / (here / dof) for k in kept if k in may_go
        }
        if not ratios:
            return steps
        k = min(ratios, key=ratios.__getitem__)
        p = stats.f.sf(ratios[k], 1, dof)
        if p <= LEVEL:
            return steps
        steps.append((k, ratios[k], p))
        kept.remove(k)


@pytest.mark.parametrize("seed", range(6))
def test_the_sequence_is_that_of_the_residual_sums_of_squares(seed):
    rng = np.random.default_rng(seed)
    W = rng.standard_normal((80, 6)) @ (np.eye(6) + 0.4 * rng.standard_normal((6, 6)))
    y = W @ np.array([0.05, 2.0, 0.1, 0.0, -0.15, 0.0]) + rng.standard_normal(80)
    found = reduced(W, y, ("Jm", "a", "b", "c1", "d", "e"))
    expected = closed_form(W, y, {1, 2, 3, 4, 5})
    assert len(expected) >= 1
    assert [s.index for s in found.reduction.steps] == [k for k, _, _ in expected]
    for step, (_, statistic, p_value) in zip(found.reduction.steps, expected, strict=True):
        assert step.statistic == pytest.approx(statistic, rel=1e-9)
        assert step.p_value == pytest.approx(p_value, rel=1e-7)
    gone = list(found.reduction.fixed)
    kept = [k for k in range(6) if k not in gone]
    np.testing.assert_allclose(
        found.result.theta[kept], np.linalg.lstsq(W[:, kept], y, rcond=None)[0], rtol=1e-9
    )
    assert not np.any(found.result.theta[gone])
    assert (found.result.rank, found.result.dependent) == (len(kept), tuple(sorted(gone)))
    both = (
        (squares(W, y, kept) - squares(W, y, list(range(6))))
        / len(gone)
        / (squares(W, y, list(range(6))) / 74)
    )
    assert found.reduction.statistic == pytest.approx(both, rel=1e-9)
    assert found.reduction.p_value == pytest.approx(stats.f.sf(both, len(gone), 74), rel=1e-7)


def test_inertias_and_stiffness_are_never_dropped():
    rng = np.random.default_rng(3)
    W, y = rng.standard_normal((60, 4)), rng.standard_normal(60)
    found = reduced(W, y, ("Jm", "K", "JL", "Jm+JL"))
    assert (found.reduction.steps, found.reduction.test()["dropped"]) == ((), "none")
    assert reduced(W, y, ("Jm", "FS", "MX", "z")).reduction.steps


def test_of_two_columns_that_are_nearly_one_only_one_goes():
    rng = np.random.default_rng(5)
    x = rng.standard_normal(200)
    W = np.column_stack([x, x + 1e-3 * rng.standard_normal(200)])
    found = reduced(W, W.sum(axis=1) + rng.standard_normal(200), ("FVm", "FV"))
    assert len(found.reduction.steps) == 1
    assert found.result.theta.sum() == pytest.approx(2.0, abs=0.3)


def test_many_small_parameters_do_not_go_where_together_they_matter():
    rng = np.random.default_rng(1)
    W = np.linalg.qr(rng.standard_normal((400, 12)))[0]
    y = W @ np.full(12, 1.6) + rng.standard_normal(400)
    found = reduced(W, y, tuple(f"F{k}" for k in range(12)))
    assert found.reduction.p_value > LEVEL
    assert all("differs from zero" in reason for reason in found.reduction.kept)
    assert found.reduction.test()["kept"] == "; ".join(found.reduction.kept)
    assert len(found.reduction.steps) < 12


def test_a_systematic_doubt_counts_in_the_test():
    rng = np.random.default_rng(2)
    W = rng.standard_normal((100, 2))
    y = W @ np.array([1.0, 0.42]) + rng.standard_normal(100)
    assert not reduced(W, y, ("Jm", "FV")).reduction.steps
    assert reduced(W, y, ("Jm", "FV"), shifts={"timing": np.array([0.0, 2.0])}).reduction.fixed == (1,)


def test_what_the_torque_needs_stays_whatever_the_doubt():
    rng = np.random.default_rng(2)
    W = rng.standard_normal((100, 2))
    y = W @ np.array([1.0, 1.0]) + rng.standard_normal(100)
    found = reduced(W, y, ("Jm", "FV"), shifts={"timing": np.array([0.0, 2.0])})
    grown = np.sqrt(squares(W, y, [0]) / squares(W, y, [0, 1]))
    assert grown > 1.1
    assert found.reduction.fixed == ()
    assert found.reduction.kept == (f"FV: without it the residual grows by {100 * grown - 100:.0f} %",)


def coloured(rng, n, rho=0.6):
    from scipy.signal import lfilter

    return lfilter([np.sqrt(1.0 - rho**2)], [1.0, -rho], rng.standard_normal(n + 100))[100:]


def draws(count, slope, seed=11):
    """Kept or not, estimate, standard error of the first and its interval's: coloured noise, correlated columns."""
    rng = np.random.default_rng(seed)
    n, rows = 300, []
    x = coloured(rng, n, 0.8)
    W = np.column_stack([0.7 * x + 0.7 * coloured(rng, n, 0.8), x])
    for _ in range(count):
        y = W @ np.array([5.0, slope]) + coloured(rng, n)
        found = reduced(W, y, ("Jm", "FV"), "hac")
        variance = found.result.covariance[0, 0] + sum(s[0] ** 2 for s in found.reduction.shifts.values())
        dof = found.result.degrees_of_freedom[0]
        half = stats.t.ppf(0.975, dof)
        error = abs(found.result.theta[0] - 5.0)
        naive = error < half * np.sqrt(found.result.covariance[0, 0])
        rows.append((not found.reduction.steps, naive, error < half * np.sqrt(variance)))
    return np.array(rows, dtype=float)


def standard_error():
    """Of the second slope over many records, without any formula for correlated noise."""
    rng = np.random.default_rng(11)
    n = 300
    x = coloured(rng, n, 0.8)
    W = np.column_stack([0.7 * x + 0.7 * coloured(rng, n, 0.8), x])
    errors = [np.linalg.lstsq(W, coloured(rng, n), rcond=None)[0][1] for _ in range(3000)]
    return float(np.std(errors))


def test_sizes_and_powers_are_those_of_the_level():
    se = standard_error()
    zero, large = draws(300, 0.0), draws(60, 6.0 * se)
    # Four standard errors of the count about the level.
    assert 0.0 < np.mean(zero[:, 0]) < 0.05 + 4.0 * np.sqrt(0.05 * 0.95 / 300)
    assert np.mean(large[:, 0]) == 1.0
    half = draws(300, 2.0 * se)
    # A known standard error would keep every other one; the robust one allows for what the fit took up of the noise.
    assert 0.25 < np.mean(half[:, 0]) < stats.norm.sf(1.96 - 2.0) + 0.1


def test_intervals_hold_where_a_parameter_was_dropped_that_is_not_zero():
    found = draws(300, 1.5 * standard_error())
    naive, wide = np.mean(found[:, 1]), np.mean(found[:, 2])
    # As if the reduced model had been given the interval is too short; with what was left open it holds.
    assert naive < 0.9 < 0.93 < wide


def test_a_restricted_model_is_the_model_with_zeros():
    model = MotorOnly("spring")
    rng = np.random.default_rng(0)
    theta = rng.uniform(1.0, 2.0, len(model.parameters))
    zeroed = theta.copy()
    zeroed[[4, 7]] = 0.0
    held = Restricted(model, (4, 7))
    np.testing.assert_array_equal(held.coefficients(theta)[0], model.coefficients(zeroed)[0])
    D = held.jacobian(theta)[0]
    for k in range(theta.size):
        step = np.zeros(theta.size)
        step[k] = 1e-6
        slope = (held.coefficients(theta + step)[0] - held.coefficients(theta - step)[0]) / 2e-6
        np.testing.assert_allclose(D[:, k], slope, atol=1e-8)
    assert (held.id, held.parameters, held.blocks) == (model.id, model.parameters, model.blocks)


RATE, DURATION = 250.0, 24.0
# No gravity, no friction of the load: MX, MY and FS are truly zero.
AXIS = Axis(reversal_velocity=0.01, MX=0.0, MY=0.0, FS=0.0)


def make_recording() -> Recording:
    t = np.arange(round(DURATION * RATE)) / RATE
    reference = 0.06 * chirp(0.1, 8.0, DURATION, RATE) + 0.05 * np.sin(2.0 * np.pi * 0.31 * t)
    sensors = Sensors(motor_resolution=1e-6, joint_resolution=1e-6)
    run = simulate(AXIS, Controller(8.0, 6000.0, 8000.0), reference, RATE, sensors=sensors)
    torque = np.concatenate([run.torque[:1], 0.5 * (run.torque[1:] + run.torque[:-1])])
    torque[1:-1] -= np.diff(torque, 2) / 12.0
    torque += 20.0 * np.random.default_rng(0).standard_normal(t.size)
    return Recording(
        RATE, (Segment(0.0, torque, run.motor_position, run.joint_position),), duration_s=DURATION
    )


@pytest.fixture(scope="module")
def recording() -> Recording:
    return make_recording()


def solve(recording, model, method="auto", essential="true"):
    config = parse_config(TEXT.format(model=model, method=method, essential=essential))
    return identify(recording, config).models[0]


def test_a_record_keeps_what_matters_and_reports_what_went(recording):
    found = solve(recording, "two_encoders")
    values = {e.symbol: e for e in found.parameters}
    test = found.tests["essential"]
    gone = [step["symbol"] for step in test["steps"]]
    assert {"MX", "MY", "FS"} & set(gone)
    assert set(gone) <= {"MX", "MY", "FS", "z"}
    assert test["level"] == 0.05
    for order, symbol in enumerate(gone, 1):
        assert values[symbol].value is None
        assert values[symbol].verdict == "not_identifiable"
        assert f"dropped as number {order}" in values[symbol].reason
    for symbol in ("Jm", "K", "JL", "FVm", "FSm", "FV"):
        estimate = values[symbol]
        assert abs(estimate.value - getattr(AXIS, symbol)) < 4.0 * estimate.stderr, symbol
    assert (found.rank, found.columns) == (10 - len(gone),) * 2
    assert np.isfinite(found.condition_number)


def test_intervals_do_not_shrink_by_what_was_dropped(recording):
    full, small = solve(recording, "two_encoders", essential="false"), solve(recording, "two_encoders")
    assert "essential" not in full.tests
    before = {e.symbol: e for e in full.parameters}
    for after in small.parameters:
        if after.symbol in {"Jm", "K", "JL"}:
            assert after.stderr > 0.9 * before[after.symbol].stderr


@pytest.mark.parametrize("method", ["auto", "structured", "irls", "minimum_distance", "output_error"])
def test_every_estimator_can_be_reduced(recording, method):
    found = solve(recording, "motor_only", method)
    assert found.method == ("iv" if method == "auto" else method)
    assert found.tests["essential"]["steps"]
    for estimate in found.parameters:
        if estimate.symbol in {"Jm", "K", "JL"}:
            assert abs(estimate.value / getattr(AXIS, estimate.symbol) - 1.0) < 0.03


def test_the_sum_of_frictions_stands_where_one_of_them_went(recording):
    found = solve(recording, "motor_only")
    gone = {step["symbol"] for step in found.tests["essential"]["steps"]}
    sums = {e.symbol: e for e in found.derived}
    for pair in (("FVm", "FV"), ("FSm", "FS")):
        assert (" + ".join(pair) in sums) == (not set(pair) <= gone)


def test_the_papers_route_leaves_nothing_out():
    text = TEXT.format(model="two_encoders", method="auto", essential="true, route: paper")
    with pytest.raises(FlexidError, match="route paper"):
        parse_config(text)


def test_a_fit_that_does_not_settle_ends_the_elimination(monkeypatch):
    rng = np.random.default_rng(0)
    W, y = rng.standard_normal((60, 3)), rng.standard_normal(60)
    settled = solved(W, y, ("Jm", "FV", "FS"), "iid")
    lost = replace(settled.result, converged=False)
    monkeypatch.setattr("flexid_cli.estimate.essential.fit", lambda *_, **__: lost)
    found = reduce_solution(settled, settled.result.covariance, {}, level=LEVEL)
    assert found.result is settled.result
    assert "does not settle" in found.reduction.kept[0]


def test_the_option_is_the_setting_and_the_report_names_what_went(tmp_path, root):
    out = tmp_path / "report.json"
    arguments = ["identify", str(root / "sample_logs/axis3.mcap"), "-c", str(root / "configs/axis3.yaml")]
    outcome = CliRunner().invoke(
        main, [*arguments, "--set", "models=[two_encoders]", "--essential", "-o", str(out)]
    )
    assert outcome.exit_code == 0, outcome.output
    document = json.loads(out.read_text("utf-8"))
    assert document["config"]["resolved"]["estimate"]["essential"] is True
    both = document["models"][0]
    zero = {p["symbol"]: p for p in both["parameters"] if p["estimate"] is None}
    assert list(zero) == [step["symbol"] for step in both["tests"]["essential"]["steps"]] == ["z"]
    assert "not essential: F = " in zero["z"]["reason"]
    assert "To determine z, record" in " ".join(outcome.stdout.split())
