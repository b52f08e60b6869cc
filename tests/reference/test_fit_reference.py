"""The project's fit against independent solvers and textbook formulae, on synthetic columns."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import least_squares

from flexid_cli.errors import DataError
from flexid_cli.estimate import budget
from flexid_cli.estimate.fit import block_matrices, fit
from flexid_cli.estimate.overdetermination import regression
from flexid_cli.estimate.paper_route import PaperRegression
from flexid_cli.models.motor_only import MotorOnly
from flexid_cli.models.rigid import Rigid
from flexid_cli.models.two_encoders import TwoEncoders, TwoEncodersStructured

Array = np.ndarray
Source = Callable[[str, int], Array]
ROWS = 400
PERIOD = 0.074  # the paper's row period, Nd = 26 at 350.87 Hz
TRUTH = {
    "Jm": 174.8, "K": 20341.0, "JL": 47.4, "FVm": 235.9, "FSm": 41.4, "FV": 83.2, "FS": 8.5, "MX": -0.72,
    "MY": -53.4, "c": 3.0, "offset": -7.0, "Q0": -7.0, "kg": -480.0,
}  # fmt: skip


class Motion:
    """Columns of a motion that satisfies the equations exactly: sums of waves, differentiated analytically.

    The friction columns are waves of their own with analytic derivatives: linear algebra does not ask where a
    column comes from, and so every relation holds to rounding.
    """

    def __init__(self, gravity: str = "moments", rows: int = ROWS, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.time = np.arange(rows) * PERIOD
        self.frequency = 2.0 * np.pi * rng.uniform(0.1, 5.4, 24)
        self.phase = rng.uniform(0.0, 2.0 * np.pi, 24)
        self.size = 0.3 / self.frequency**1.5
        self.size_sign = rng.uniform(0.1, 0.4, (2, 24))
        self.gravity = gravity
        self.noise: dict[tuple[str, int], Array] = {}

    def waves(self, sizes: Array, order: int, shift: float = 0.0) -> Array:
        angle = np.outer(self.time, self.frequency) + self.phase + shift + 0.5 * np.pi * order
        return np.cos(angle) @ (sizes * self.frequency**order)

    def joint(self, order: int) -> Array:
        return self.waves(self.size, order)

    def sign(self, which: int, order: int) -> Array:
        return self.waves(self.size_sign[which], order, shift=1.0)

    def gravity_column(self, name: str) -> Array:
        """g cos q and g sin q: only their values enter."""
        return 9.81 * (np.cos if name == "gravity_cos" else np.sin)(self.joint(0))

    def load(self, order: int) -> Array:
        """Torque through the spring; with gravity only its value is needed, without it every derivative."""
        p = TRUTH
        load = (
            p["JL"] * self.joint(order + 2) + p["FV"] * self.joint(order + 1) + p["FS"] * self.sign(1, order)
        )
        if self.gravity == "moments" and order == 0:
            load += p["MX"] * self.gravity_column("gravity_cos") + p["MY"] * self.gravity_column(
                "gravity_sin"
            )
        return load

    def motor(self, order: int) -> Array:
        zero = TRUTH["c"] / TRUTH["K"] if self.gravity == "moments" and order == 0 else 0.0
        return self.joint(order) + self.load(order) / TRUTH["K"] + zero

    def torque(self, order: int) -> Array:
        p = TRUTH
        drive = (
            p["Jm"] * self.motor(order + 2)
            + p["FVm"] * self.motor(order + 1)
            + p["FSm"] * self.sign(0, order)
        )
        constant = p["offset"] if self.gravity == "none" and order == 0 else 0.0
        return drive + self.load(order) + constant

    def __call__(self, name: str, order: int) -> Array:
        make = {
            "torque": self.torque,
            "motor": self.motor,
            "joint": self.joint,
            "torsion": lambda k: self.motor(k) - self.joint(k),
            "sign_motor": lambda k: self.sign(0, k),
            "sign_joint": lambda k: self.sign(1, k),
            "gravity_cos": lambda _: self.gravity_column("gravity_cos"),
            "gravity_sin": lambda _: self.gravity_column("gravity_sin"),
            "one": lambda _: np.ones(self.time.size),
        }
        return make[name](order) + self.noise.get((name, order), 0.0)


def truth(model) -> Array:
    return np.array([TRUTH[p.symbol] for p in model.parameters])


def start(model) -> Array:
    """A tenth to a fifth beside the truth."""
    return truth(model) * np.linspace(0.8, 1.1, len(model.parameters))


def with_torque_noise(motion: Motion, sigma: float, seed: int) -> Motion:
    motion.noise[("torque", 0)] = sigma * np.random.default_rng(seed).standard_normal(motion.time.size)
    return motion


def stacked(model, matrices, theta: Array, weights: tuple[float, ...]) -> Array:
    parts = zip(weights, matrices, model.coefficients(theta), strict=True)
    return np.concatenate([w * (M @ a) for w, M, a in parts])


# --- exact data


@pytest.mark.parametrize(
    ("model", "gravity"),
    [(TwoEncoders(), "moments"), (TwoEncodersStructured(), "moments"), (MotorOnly("none"), "none")],
)
def test_exact_data_give_back_the_parameters(model, gravity: str):
    matrices = block_matrices(model, Motion(gravity))
    result = fit(model, matrices, start(model), (ROWS,), weighted=False)
    assert result.converged
    assert result.rank == truth(model).size
    assert result.dependent == ()
    # Rounding of the columns, enlarged by their conditioning.
    np.testing.assert_allclose(result.theta, truth(model), rtol=1e-13 * result.condition_number * 1e3)


# --- against scipy


@pytest.mark.parametrize(
    ("model", "gravity", "weighted"),
    [(TwoEncodersStructured(), "moments", True), (TwoEncodersStructured(), "moments", False),
     (TwoEncoders(), "moments", True), (MotorOnly("none"), "none", False)],
)  # fmt: skip
def test_noisy_data_give_the_minimum_that_scipy_finds(model, gravity: str, weighted: bool):
    motion = with_torque_noise(Motion(gravity), 4.0, 1)
    rng = np.random.default_rng(2)
    motion.noise[("torsion", 0)] = 2e-5 * rng.standard_normal(ROWS)
    motion.noise[("joint", 2)] = 5e-3 * rng.standard_normal(ROWS)
    matrices = block_matrices(model, motion)
    result = fit(model, matrices, start(model), (ROWS,), weighted=weighted)
    assert result.converged
    scale = np.abs(truth(model))

    def cost(x: Array) -> Array:
        return stacked(model, matrices, x * scale, result.weights)

    # Three-point differences and a trust region: no derivative and no step of the project's own.
    other = least_squares(
        cost, truth(model) / scale, jac="3-point", x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    ours, theirs = np.sum(cost(result.theta / scale) ** 2), 2.0 * other.cost
    assert ours <= theirs * (1.0 + 1e-12)
    # Costs that agree to 1e-12 leave the parameters apart by about 1e-6 of the noise's own spread.
    spread = np.sqrt(np.diag(np.linalg.inv(result.jacobian.T @ result.jacobian)) * ours / ROWS)
    assert np.max(np.abs(result.theta - other.x * scale) / spread) < 1e-3
    # First-order condition, in units of the residual's projection on each column.
    J, e = result.jacobian, stacked(model, matrices, result.theta, result.weights)
    assert np.max(np.abs(J.T @ e) / (np.linalg.norm(J, axis=0) * np.linalg.norm(e))) < 1e-8


def test_the_jacobian_of_the_result_is_the_derivative_of_the_weighted_residuals():
    model = TwoEncodersStructured()
    matrices = block_matrices(model, with_torque_noise(Motion(), 4.0, 1))
    result = fit(model, matrices, start(model), (ROWS,), weighted=True)
    for k, value in enumerate(result.theta):
        step = np.zeros(result.theta.size)
        step[k] = 1e-4 * abs(value)
        up, down = (stacked(model, matrices, result.theta + s * step, result.weights) for s in (1.0, -1.0))
        slope = (up - down) / (2.0 * step[k])
        column = result.jacobian[:, k]
        assert np.linalg.norm(column - slope) < 1e-6 * np.linalg.norm(column)


# --- textbook


def test_least_squares_of_a_linear_model_are_those_of_numpy():
    model = PaperRegression()
    motion = with_torque_noise(Motion("none"), 4.0, 5)
    M = block_matrices(model, motion)[0]
    result = fit(model, [M], np.ones(7), (ROWS,), weighted=False, covariance="iid")
    W = M[:, 1:] * np.array([-1, -1, 1, 1, 1, 1, 1])
    reference, rss, rank, singular = np.linalg.lstsq(W / np.linalg.norm(W, axis=0), M[:, 0], rcond=None)
    np.testing.assert_allclose(result.theta, reference / np.linalg.norm(W, axis=0), rtol=1e-9)
    sigma2 = rss[0] / (ROWS - 7)
    covariance = sigma2 * np.linalg.inv(W.T @ W)
    np.testing.assert_allclose(
        result.covariance, covariance, rtol=1e-7, atol=1e-12 * np.abs(covariance).max()
    )
    np.testing.assert_allclose(result.degrees_of_freedom, ROWS - 7)
    assert result.rank == rank
    assert result.condition_number == pytest.approx(singular[0] / singular[-1], rel=1e-6)
    assert result.sigmas[0] ** 2 == pytest.approx(sigma2)


def closed_form(matrices, known: list[Array], weights: tuple[float, ...]) -> Array:
    """(W'G2W)^-1 W'G2Y of Gautier's weighted least squares, stacked equations."""
    W = np.vstack([w * D for w, D in zip(weights, matrices, strict=True)])
    Y = np.concatenate([w * y for w, y in zip(weights, known, strict=True)])
    return np.linalg.lstsq(W, Y, rcond=None)[0]


def test_weighted_least_squares_have_the_closed_form_of_their_weights():
    model = TwoEncoders()
    motion = with_torque_noise(Motion(), 4.0, 6)
    motion.noise[("joint", 2)] = 5e-3 * np.random.default_rng(7).standard_normal(ROWS)
    matrices = block_matrices(model, motion)
    result = fit(model, matrices, np.ones(10), (ROWS,), weighted=True)
    D = [-M @ J for M, J in zip(matrices, model.jacobian(result.theta), strict=True)]
    known = [matrices[0][:, 0], np.zeros(ROWS)]
    np.testing.assert_allclose(closed_form(D, known, result.weights), result.theta, rtol=1e-7)
    # The weights are the inverse sizes of the residuals at the solution: a fixed point of the iteration.
    for weight, residual in zip(result.weights, result.residuals, strict=True):
        assert weight == pytest.approx(1.0 / np.sqrt(np.mean(residual**2)), rel=1e-6)


def test_unweighted_blocks_count_alike():
    model = TwoEncoders()
    matrices = block_matrices(model, with_torque_noise(Motion(), 4.0, 8))
    result = fit(model, matrices, np.ones(10), (ROWS,), weighted=False, covariance="iid")
    D = [-M @ J for M, J in zip(matrices, model.jacobian(result.theta), strict=True)]
    known = [matrices[0][:, 0], np.zeros(ROWS)]
    np.testing.assert_allclose(closed_form(D, known, (1.0, 1.0)), result.theta, rtol=1e-7)
    W = np.vstack(D)
    rss = sum(float(e @ e) for e in result.residuals)
    expected = rss / (2 * ROWS - 10) * np.linalg.inv(W.T @ W)
    # Normal equations square the condition number.
    np.testing.assert_allclose(np.diag(result.covariance), np.diag(expected), rtol=1e-5)


def test_robust_and_textbook_covariance_agree_for_independent_residuals():
    """Rows without correlation: the two differ by the spread of a variance on B degrees of freedom only.

    The robust one is never below that of stationary residuals, which here is the textbook's: of X, its ratio to it,
    the mean of max(X, 1) is 1 + sd(X) / sqrt(2 pi).
    """
    model = Rigid("none")
    ratios = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        W = rng.standard_normal((ROWS, 4))
        M = np.column_stack([W @ np.array([5.0, 2.0, 1.0, 0.3]) + rng.standard_normal(ROWS), W])
        robust, plain = (
            fit(model, [M], np.zeros(4), (ROWS,), weighted=False, covariance=kind) for kind in ("hac", "iid")
        )
        np.testing.assert_allclose(robust.theta, plain.theta)
        ratios.append(np.diag(robust.covariance) / np.diag(plain.covariance))
    mean = np.mean(ratios)
    dof = float(np.mean(robust.degrees_of_freedom))
    expected = 1.0 + np.sqrt(2.0 / dof / (2.0 * np.pi))
    assert abs(mean - expected) < 4.0 * np.sqrt(2.0 / dof / (4 * 40)) + 4.0 / ROWS


# --- dependent columns


def test_dependent_columns_are_named_and_the_others_keep_their_estimates():
    rng = np.random.default_rng(9)
    model = Rigid("spring")
    W = rng.standard_normal((ROWS, 5))
    Y = W @ np.array([5.0, 2.0, 1.0, 0.3, 7.0]) + 0.1 * rng.standard_normal(ROWS)
    whole = fit(model, [np.column_stack([Y, W])], np.zeros(5), (ROWS,), weighted=False)
    assert whole.dependent == ()
    broken = W.copy()
    broken[:, 3] = -2.5 * W[:, 1]
    result = fit(model, [np.column_stack([Y, broken])], np.zeros(5), (ROWS,), weighted=False)
    assert result.dependent == (1, 3)
    assert result.rank == 4
    assert not np.isfinite(result.condition_number) or result.condition_number > 1e12
    reference = np.linalg.lstsq(broken[:, [0, 1, 2, 4]], Y, rcond=None)[0]
    np.testing.assert_allclose(result.theta[[0, 2, 4]], reference[[0, 2, 3]], rtol=1e-9)
    sub = fit(
        Rigid("none"), [np.column_stack([Y, broken[:, [0, 1, 2, 4]]])], np.zeros(4), (ROWS,), weighted=False
    )
    np.testing.assert_allclose(result.stderr[[0, 2, 4]], sub.stderr[[0, 2, 3]], rtol=0.02)


def test_a_column_of_zeros_is_dependent_on_nothing_else():
    rng = np.random.default_rng(10)
    W = rng.standard_normal((ROWS, 4))
    Y = W @ np.ones(4) + 0.1 * rng.standard_normal(ROWS)
    W[:, 2] = 0.0
    result = fit(Rigid("none"), [np.column_stack([Y, W])], np.zeros(4), (ROWS,), weighted=False)
    assert result.dependent == (2,)
    assert np.all(np.isfinite(result.theta))
    assert np.all(np.isfinite(result.stderr))


def test_too_few_rows_are_refused_with_a_cure():
    with pytest.raises(DataError) as caught:
        fit(Rigid("none"), [np.ones((6, 5))], np.zeros(4), (6,), weighted=False)
    assert caught.value.hint


# --- the test of over-determination


def overdetermination(seed: int, phi: float = 0.0, extra: Array | None = None) -> dict[str, float]:
    """One record of the motor-only model with residuals of 3 N m in the filtered equation."""
    model = MotorOnly("none")
    M = block_matrices(model, MOTION)[0].copy()
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal(ROWS)
    for k in range(1, ROWS):
        noise[k] = phi * noise[k - 1] + np.sqrt(1.0 - phi**2) * noise[k]
    M[:, 0] += 3.0 * noise
    if extra is not None:
        M[:, 0] += extra
    result = fit(model, [M], truth(model), (ROWS,), weighted=False)
    solution = SimpleNamespace(
        matrices=(M,),
        model=model,
        result=result,
        columns=SimpleNamespace(lengths=(ROWS,)),
        method="structured",
        instruments=None,
    )
    config = SimpleNamespace(estimate=SimpleNamespace(covariance="hac"))
    free, test = regression(
        solution, config, make=lambda p, v, s, d: SimpleNamespace(symbol=p.symbol, value=v)
    )
    assert [f.symbol for f in free] == [f"X{k}" for k in range(1, 8)]
    return test


MOTION = Motion("none")


def test_the_wald_test_has_its_nominal_size_on_exact_data_with_noise():
    trials = 80
    p = np.array([overdetermination(seed)["p_value"] for seed in range(trials)])
    rejected = int(np.sum(p < 0.05))
    # 99.99 % of binomial(80, 0.05) lie below 13.
    assert rejected <= 13
    assert 0.5 - 4.5 / np.sqrt(12 * trials) < p.mean() < 0.5 + 4.5 / np.sqrt(12 * trials) + 0.05


@pytest.mark.slow
@pytest.mark.parametrize("phi", [0.0, 0.5])
def test_the_wald_test_has_its_nominal_size_in_many_records(phi: float):
    p = np.array([overdetermination(seed, phi)["p_value"] for seed in range(1500)])
    # Thirteen cosines' covariance of twelve coefficients: an approximate size of up to 8 % is the method's own.
    assert 0.03 < np.mean(p < 0.05) < 0.09


def test_the_wald_test_finds_coefficients_that_no_axis_has():
    """A tenth more of X5's column than the others allow."""
    column = MOTION("motor", 2)
    assert overdetermination(3, extra=0.1 * TRUTH["Jm"] * column)["p_value"] < 1e-3


def test_the_wald_test_counts_its_restrictions():
    """Coefficients 7 + S', S'', FS, offset; parameters 8: three restrictions."""
    assert overdetermination(1)["restrictions"] == 3


# --- sensitivities of the budget, on the same columns


def torque_of(motion: Motion, delay: float) -> Motion:
    """The record of a torque whose stamps are early: what is logged at t acts at t + delay."""

    class Late(Motion):
        def torque(self, order: int) -> Array:
            return Motion.torque(self, order) + delay * Motion.torque(self, order + 1)

    late = Late.__new__(Late)
    late.__dict__.update(motion.__dict__)
    return late


def recorded(source: Source) -> SimpleNamespace:
    """What `budget.torque_delay` asks of columns."""

    class Columns(SimpleNamespace):
        def __call__(self, name: str, order: int) -> Array:
            return source(name, order)

    return Columns(lengths=(ROWS,))


def test_the_torque_delay_is_found_with_its_sign_and_its_effect():
    model, delay = MotorOnly("none"), 1e-3
    source = torque_of(with_torque_noise(Motion("none"), 0.05, 4), delay)
    result = fit(model, block_matrices(model, source), start(model), (ROWS,), weighted=False)
    found = budget.torque_delay(model, result, recorded(source), (ROWS,))
    # The linearisation is right to the next order, (w delay)^2 / 2 with w = 34 rad/s, and to its own noise.
    assert found.value == pytest.approx(delay, abs=4.0 * found.stderr + 0.02 * delay)
    corrected = result.theta + found.per_unit * found.value
    error = np.abs(result.theta - truth(model))[:5]
    assert np.all(np.abs(corrected - truth(model))[:5] < 0.2 * error + 4.0 * result.stderr[:5])
    assert error[3] > 10.0 * result.stderr[3]


def test_noise_bias_is_the_shift_that_noise_in_the_columns_makes(monkeypatch: pytest.MonkeyPatch):
    """Estimate minus truth, averaged over many noises, for a regressor measured with noise."""
    model = Rigid("none")
    rng = np.random.default_rng(20)
    W = rng.standard_normal((ROWS, 4))
    theta = np.array([5.0, 2.0, 1.0, 0.3])
    sigma = 0.1
    shifts, predictions = [], []
    for _ in range(60):
        V = np.zeros((ROWS, 5))
        V[:, 1] = sigma * rng.standard_normal(ROWS)
        V[:, 2] = 0.5 * V[:, 1] + 0.05 * rng.standard_normal(ROWS)
        M = np.column_stack([W @ theta, W]) + V
        result = fit(model, [M], np.zeros(4), (ROWS,), weighted=False)
        other = np.zeros((ROWS, 5))
        other[:, 1] = sigma * rng.standard_normal(ROWS)
        other[:, 2] = 0.5 * other[:, 1] + 0.05 * rng.standard_normal(ROWS)
        monkeypatch.setattr(budget, "_block_noise", lambda *_, V=other: V)
        monkeypatch.setattr(budget, "_noise_columns", lambda *_: None)
        levels = budget.NoiseLevels(0.0, 0.0, 0.0)
        predictions.append(budget.noise_bias(model, result, SimpleNamespace(), levels))
        shifts.append(result.theta - theta)
    mean, error = np.mean(shifts, axis=0), np.std(shifts, axis=0) / np.sqrt(len(shifts))
    predicted = np.mean(predictions, axis=0)
    assert mean[0] < -0.02
    # First order in the noise-to-signal power of one in a hundred; the next order is a few of its squares.
    np.testing.assert_allclose(predicted, mean, atol=4.0 * error.max() + 0.05 * np.abs(mean).max())
