"""Every estimator on one record: near the truth, says what it did, falls back and says why; and the tests' sizes."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from flexid_cli.config.load import parse_config
from flexid_cli.estimate import checks, methods
from flexid_cli.estimate.fit import fit
from flexid_cli.estimate.identify import identify
from flexid_cli.estimate.irls import fit_irls
from flexid_cli.estimate.profile import profile_interval
from flexid_cli.models.base import Block, Parameter
from flexid_cli.signals.recording import Recording, Segment
from flexid_cli.simulate.axis import Axis, Controller, Sensors, chirp, simulate

RATE, DURATION = 250.0, 24.0
AXIS = Axis(reversal_velocity=0.01, MX=0.0, MY=0.0)
METHODS = ("auto", "ols", "wls", "irls", "iv", "structured", "minimum_distance", "output_error")
TEXT = """
version: 1
axis: {{name: axis, gear_ratio: 1, f1_hz: 4.0}}
signals:
  joint_torque: {{source: u, unit: N.m, hold: instant}}
  motor_position: {{source: qm, unit: rad}}
  joint_position: {{source: q, unit: rad}}
  reference_position: {{source: ref, unit: rad}}
controller: {{kp: 8.0, kv: 6000.0, ki: 8000.0}}
models: [{model}]
estimate: {{method: {method}}}
"""


def make_recording(seed: int = 0, noise: float = 20.0) -> Recording:
    t = np.arange(round(DURATION * RATE)) / RATE
    reference = 0.06 * chirp(0.1, 8.0, DURATION, RATE) + 0.05 * np.sin(2.0 * np.pi * 0.31 * t)
    sensors = Sensors(motor_resolution=1e-6, joint_resolution=1e-6)
    run = simulate(AXIS, Controller(8.0, 6000.0, 8000.0), reference, RATE, sensors=sensors)
    # Steps of the held torque, as they act at the instant of each sample.
    torque = np.concatenate([run.torque[:1], 0.5 * (run.torque[1:] + run.torque[:-1])])
    torque[1:-1] -= np.diff(torque, 2) / 12.0
    torque += noise * np.random.default_rng(seed).standard_normal(t.size)
    segment = Segment(0.0, torque, run.motor_position, run.joint_position, run.reference_position)
    return Recording(RATE, (segment,), duration_s=DURATION)


@pytest.fixture(scope="module")
def recording() -> Recording:
    return make_recording()


def solve(recording: Recording, model: str, method: str):
    return identify(recording, parse_config(TEXT.format(model=model, method=method))).models[0]


@pytest.mark.parametrize("model", ["two_encoders", "motor_only"])
@pytest.mark.parametrize("method", METHODS)
def test_every_method_comes_near_the_truth(recording: Recording, model: str, method: str):
    found = solve(recording, model, method)
    assert found.method in METHODS
    assert found.method_reason
    values = {e.symbol: e for e in found.parameters}
    for symbol in ("Jm", "K", "JL"):
        estimate, truth = values[symbol], getattr(AXIS, symbol)
        assert estimate.verdict == "identified", symbol
        assert abs(estimate.value / truth - 1.0) < (0.005 if model == "two_encoders" else 0.03), symbol
        assert abs(estimate.value - truth) < 6.0 * estimate.stderr, symbol


def test_auto_says_which_and_why(recording: Recording):
    assert solve(recording, "motor_only", "auto").method == "iv"
    both = solve(recording, "two_encoders", "auto")
    assert (both.method, "subtracted" in both.method_reason) == ("structured", True)


def test_a_known_loop_gives_instruments_without_noise(recording: Recording):
    assert "closed loop" in solve(recording, "motor_only", "iv").method_reason


def test_weak_instruments_are_not_used(recording: Recording, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("flexid_cli.estimate.iv.strength", lambda *_: 0.1)
    found = solve(recording, "motor_only", "auto")
    assert found.method == "structured"
    assert any("weak" in w for w in found.warnings)


def test_equations_that_diverge_leave_the_plain_fit(recording: Recording, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("flexid_cli.estimate.corrected.correct", lambda *_, **__: None)
    found = solve(recording, "two_encoders", "auto")
    assert any("did not settle" in w for w in found.warnings)
    assert found.tests["bias_budget"]["noise_share"] is None
    sources = found.tests["bias_budget"]["parameters"]["K"]["systematic_percent"]
    assert "encoder and torque noise in the columns" in sources


def test_minimum_distance_is_refused_for_both_encoders_in_words(recording: Recording):
    assert any("minimum_distance" in w for w in solve(recording, "two_encoders", "minimum_distance").warnings)


def test_the_report_holds_every_test(recording: Recording):
    tests = solve(recording, "motor_only", "auto").tests
    wanted = {"over_determination", "whiteness", "input_correlation", "stability", "endogeneity"}
    assert wanted | {"stiffness_profile", "bias_budget", "torque_delay"} <= tests.keys()
    assert all("meaning" in t or "reason" in t for t in tests.values())
    profile = tests["stiffness_profile"]
    assert profile["low"] == pytest.approx(profile["symmetric_low"], rel=0.01)
    assert profile["high"] == pytest.approx(profile["symmetric_high"], rel=0.01)


def test_instruments_for_both_paths_are_known_to_the_configuration():
    for method in METHODS:
        config = parse_config(TEXT.format(model="motor_only", method=method))
        assert methods.takes_noise_out(config) == (
            method in {"auto", "iv", "minimum_distance", "output_error"}
        )


# --- robust weights and profiles on one line -------------------------------


class Ratio:
    """y = x / b: bends in its parameter."""

    id = "ratio"
    equation = "y = x / b"
    parameters = (Parameter("b", "b", "stiffness"),)
    blocks = (Block("motor", (("torque", 0), ("motor", 0))),)

    def coefficients(self, theta):
        return (np.array([1.0, -1.0 / theta[0]]),)

    def jacobian(self, theta):
        return (np.array([[0.0], [1.0 / theta[0] ** 2]]),)


def ratio_data(outliers: int = 0) -> np.ndarray:
    rng = np.random.default_rng(8)
    x = rng.standard_normal(400)
    y = x / 4.0 + 0.1 * rng.standard_normal(400)
    y[:outliers] += 5.0 * x[:outliers]
    return np.column_stack([y, x])


def test_hubers_weights_withstand_what_least_squares_does_not():
    M = ratio_data(outliers=12)
    plain = fit(Ratio(), (M,), np.array([3.0]), (400,), weighted=False)
    robust, light = fit_irls(Ratio(), (M,), np.array([3.0]), (400,), weighted=False)
    assert abs(plain.theta[0] - 4.0) > 4.0 * abs(robust.theta[0] - 4.0)
    assert 0.05 < light < 0.35
    np.testing.assert_allclose(robust.residuals[0], M @ Ratio().coefficients(robust.theta)[0])


def test_a_profile_bends_with_the_model():
    """1/b is estimated linearly: its symmetric interval, turned over, is b's profile to second order."""
    M = ratio_data()
    result = fit(Ratio(), (M,), np.array([3.0]), (400,), weighted=False)
    half = 3.0 * result.stderr[0]
    low, high = profile_interval(Ratio(), [M.T @ M], result.theta, result.stderr, 0, half)
    assert low is not None
    assert high is not None
    assert high - result.theta[0] > 1.02 * (result.theta[0] - low)


# --- sizes of the tests ---------------------------------------------------


def coloured(rng: np.random.Generator, n: int, phi: float) -> np.ndarray:
    x = rng.standard_normal(n)
    for k in range(1, n):
        x[k] = phi * x[k - 1] + np.sqrt(1.0 - phi**2) * x[k]
    return x


def test_whiteness_rejects_colour_and_counts_the_rows_it_is_worth():
    rng = np.random.default_rng(9)
    white = checks.whiteness(rng.standard_normal(800), (800,))
    red = checks.whiteness(coloured(rng, 800, 0.8), (800,))
    assert white["p_value"] > 1e-3
    assert red["p_value"] < 1e-6
    # (1 - 0.8) / (1 + 0.8) of the rows.
    assert 0.5 < red["effective_rows"] / (800 / 9.0) < 2.0
    assert 500 < white["effective_rows"] < 1300


def test_input_correlation_has_at_most_its_nominal_size_and_finds_a_late_input():
    rng = np.random.default_rng(10)
    p = []
    for _ in range(150):
        e, u = coloured(rng, 400, 0.6), coloured(rng, 400, 0.6)
        p.append(checks.input_correlation(e, u, (250, 150))["p_value"])
    # 99.9 % of binomial(150, 0.05) lie below 17.
    assert sum(x < 0.05 for x in p) <= 17
    late = np.concatenate([np.zeros(3), u[:-3]])
    found = checks.input_correlation(e + 0.6 * late, u, (400,))
    assert found["p_value"] < 1e-3
    assert found["lag_rows"] == 3


def stability_of(rng: np.random.Generator, change: float) -> float:
    n = 500
    x = rng.standard_normal(n)
    slope = np.where(np.arange(n) < n // 2, 1.0, 1.0 + change)
    y = slope * x + coloured(rng, n, 0.5)
    M = np.column_stack([y, x])

    class Line(Ratio):
        def coefficients(self, theta):
            return (np.array([1.0, -theta[0]]),)

        def jacobian(self, theta):
            return (np.array([[0.0], [-1.0]]),)

    result = fit(Line(), (M,), np.array([1.0]), (n,), weighted=False)
    return checks.stability(result, [0], ["b"], (n,))["p_value"]


def test_stability_has_at_most_its_nominal_size_and_finds_a_jump():
    rng = np.random.default_rng(11)
    p = [stability_of(rng, 0.0) for _ in range(120)]
    # 99.9 % of binomial(120, 0.05) lie below 15.
    assert sum(x < 0.05 for x in p) <= 15
    assert stability_of(rng, 0.8) < 0.01


def test_endogeneity_asks_whether_the_two_estimates_differ_by_more_than_chance():
    """The same columns as instruments: nothing to compare."""
    M = ratio_data()
    result = fit(Ratio(), (M,), np.array([3.0]), (400,), weighted=False)
    solution = SimpleNamespace(
        model=Ratio(), matrices=(M,), result=result, columns=SimpleNamespace(lengths=(400,))
    )
    assert (
        checks.endogeneity(solution, [0])["p_value"] is None
        or checks.endogeneity(solution, [0])["p_value"] > 0.01
    )
