"""Noise in the columns: the expected cross products, and the fit that is freed of them."""

from __future__ import annotations

import numpy as np
import pytest

from flexid_cli.estimate import corrected, driven, iv, noise
from flexid_cli.estimate.fit import block_matrices, fit
from flexid_cli.estimate.least_squares import solve, solve_instrumented
from flexid_cli.estimate.minimum_distance import fit_minimum_distance
from flexid_cli.models.base import Block, Parameter
from flexid_cli.models.two_encoders import TwoEncodersStructured
from flexid_cli.pipeline.chain import Chain, ChainSettings
from flexid_cli.pipeline.columns import Columns
from flexid_cli.signals.recording import Recording, Segment

RATE = 200.0
SAMPLES = 60_000
SIGMA = (3.0, 2e-4, 1e-4)
TERMS = (("torque", 0), ("torque", 2), ("motor", 1), ("motor", 2), ("joint", 2), ("torsion", 0), ("one", 0))


@pytest.fixture(scope="module")
def chain() -> Chain:
    return Chain(ChainSettings(RATE, 4, 20.0, decimation=8))


@pytest.fixture(scope="module")
def pure_noise() -> Recording:
    rng = np.random.default_rng(1)
    torque, motor, joint = (s * rng.standard_normal(SAMPLES) for s in SIGMA)
    return Recording(RATE, (Segment(0.0, torque, motor, joint),))


def test_the_floor_of_white_noise_is_its_standard_deviation(pure_noise: Recording):
    floors = noise.floors(pure_noise)
    assert floors.sigma == pytest.approx(SIGMA, rel=0.03)
    assert max(floors.doubt) < 0.15


def test_noise_that_is_not_white_raises_the_doubt():
    rng = np.random.default_rng(2)
    white = rng.standard_normal(SAMPLES)
    coloured = np.convolve(white, [0.5, 0.5], mode="same")
    record = Recording(RATE, (Segment(0.0, coloured, white, None),))
    floors = noise.floors(record)
    assert floors.doubt[0] > 1.0
    assert floors.doubt[1] < 0.2


def test_cross_products_of_noise_are_those_that_are_measured(chain: Chain, pure_noise: Recording):
    columns = Columns(pure_noise, chain, 40.0)
    rows = sum(columns.lengths)
    expected = noise.moments(chain, rows, SIGMA, TERMS, TERMS)
    M = np.column_stack([columns(*t) if t[0] != "one" else np.zeros(rows) for t in TERMS])
    found = M.T @ M
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))[:-1, :-1]
    # Cross products of some 5000 nearly independent rows err by 1.4 %, their differences from nothing by 2 %.
    np.testing.assert_allclose(found[:-1, :-1] / size, expected[:-1, :-1] / size, atol=0.06)
    assert not expected[-1].any()


def test_central_differences_are_counted_as_they_are(pure_noise: Recording):
    chain = Chain(ChainSettings(RATE, 4, 60.0, derivative="central", decimation=2))
    columns = Columns(pure_noise, chain, 40.0)
    term = (("motor", 2),)
    expected = noise.moments(chain, sum(columns.lengths), SIGMA, term, term)[0, 0]
    column = columns("motor", 2)
    assert column @ column == pytest.approx(expected, rel=0.06)


class Line:
    """y = b x: one parameter, one equation, x the motor's position and y the torque."""

    id = "line"
    equation = "y = b x"
    parameters = (Parameter("b", "b", "stiffness"),)
    blocks = (Block("motor", (("torque", 0), ("motor", 0))),)

    def coefficients(self, theta):
        return (np.array([1.0, -theta[0]]),)

    def jacobian(self, theta):
        return (np.array([[0.0], [-1.0]]),)


def line_with_noise(seed: int, slope: float = 5.0, sigma: float = 0.5, rows: int = 400):
    rng = np.random.default_rng(seed)
    x = rng.standard_normal(rows)
    seen = x + sigma * rng.standard_normal(rows)
    y = slope * x + 0.3 * rng.standard_normal(rows)
    return x, np.column_stack([y, seen]), np.diag([0.0, rows * sigma**2])


def z_scores(solver) -> np.ndarray:
    scores = []
    for seed in range(300):
        result = solver(*line_with_noise(seed))
        scores.append((result.theta[0] - 5.0) / result.stderr[0])
    return np.array(scores)


def plain_line(matrix):
    return fit(Line(), (matrix,), np.ones(1), (matrix.shape[0],), weighted=False)


def test_subtraction_takes_the_bias_out_and_its_interval_holds():
    def solver(_, matrix, moments):
        found = corrected.correct(Line(), (matrix,), plain_line(matrix), (400,), moments=(moments,))
        assert found is not None
        return found

    assert abs(plain_line(line_with_noise(0)[1]).theta[0] - 4.0) < 0.3  # drawn down by 1 / (1 + 0.25)
    scores = z_scores(solver)
    assert abs(scores.mean()) < 4.0 / np.sqrt(300)
    assert 0.85 < scores.std() < 1.15


def test_instruments_take_the_bias_out_and_their_interval_holds():
    def solver(x, matrix, _):
        Z = np.column_stack([matrix[:, 0], x])
        none = np.zeros((2, 2))
        found = corrected.correct(
            Line(), (matrix,), plain_line(matrix), (400,), moments=(none,), instruments=(Z,)
        )
        assert found is not None
        return found

    scores = z_scores(solver)
    assert abs(scores.mean()) < 4.0 / np.sqrt(300)
    assert 0.85 < scores.std() < 1.15


def test_the_noise_share_is_that_of_the_column():
    _, matrix, moments = line_with_noise(3)
    share = corrected.noise_share(Line(), plain_line(matrix), (moments,))
    assert share == pytest.approx(0.25 / 1.25, rel=0.2)


def test_doubt_is_the_shift_that_a_wrong_level_makes():
    _, matrix, moments = line_with_noise(4)
    first = corrected.correct(Line(), (matrix,), plain_line(matrix), (400,), moments=(moments,))
    other = corrected.correct(Line(), (matrix,), plain_line(matrix), (400,), moments=(1.02 * moments,))
    doubt = corrected.doubt(Line(), first, {0: (moments,)}, (0.02,))
    assert doubt[0] == pytest.approx(abs(other.theta[0] - first.theta[0]), rel=0.1)


def test_instrumental_variables_are_the_textbook_ones():
    rng = np.random.default_rng(5)
    Z = rng.standard_normal((200, 3))
    W = Z + 0.3 * rng.standard_normal((200, 3))
    Y = W @ np.array([1.0, -2.0, 3.0]) + rng.standard_normal(200)
    found = solve_instrumented(W, Y, Z)
    np.testing.assert_allclose(found.estimate, np.linalg.solve(Z.T @ W, Z.T @ Y), rtol=1e-9)
    np.testing.assert_allclose(found.bread, np.linalg.inv(Z.T @ W), rtol=1e-9)
    same = solve_instrumented(W, Y, W)
    np.testing.assert_allclose(same.estimate, solve(W, Y).estimate, rtol=1e-9)


def test_minimum_distance_of_as_many_coefficients_as_parameters_is_least_squares():
    _, matrix, _ = line_with_noise(6)
    plain = plain_line(matrix)
    found = fit_minimum_distance(Line(), matrix, (400,), plain)
    assert found is not None
    np.testing.assert_allclose(found.theta, plain.theta, rtol=1e-9)
    np.testing.assert_allclose(found.covariance, plain.covariance, rtol=1e-6)
    change = np.ones(400)
    np.testing.assert_allclose(
        found.bread @ (found.instruments.T @ change), plain.bread @ (plain.instruments.T @ change), rtol=1e-9
    )


# --- the driven load ------------------------------------------------------


def test_a_driven_load_follows_a_sine_as_its_transfer_function_says():
    period, omega = 1e-3, 2.0 * np.pi * 3.0
    t = np.arange(20_000) * period
    J, D, K = 2.0, 6.0, 3000.0
    q = driven.follow(K * np.sin(omega * t), J, D, K, 0.0, 0.0, period)
    gain = K / (K - J * omega**2 + 1j * D * omega)
    expected = np.imag(gain * np.exp(1j * omega * t))
    late = t > 8.0
    np.testing.assert_allclose(q[late], expected[late], atol=1e-5 * abs(gain))


def test_a_driven_load_sticks_where_friction_holds_it():
    """A torque below the Coulomb friction leaves the load at rest but for the creep of the reversal's width."""
    t = np.arange(4000) * 1e-3
    drive = 0.8 * np.sin(2.0 * np.pi * t)
    q = driven.follow(drive, 1.0, 0.1, 1e-3, 1.0, 1e-6, 1e-3)
    assert np.max(np.abs(q)) < 1e-5


def test_a_driven_load_agrees_with_small_steps_of_runge_kutta():
    from scipy.integrate import solve_ivp

    period, J, D, K, F, w = 2e-3, 0.5, 0.4, 400.0, 1.5, 0.02
    t = np.arange(1500) * period

    def torque_at(time):
        return 30.0 * np.sin(2.0 * np.pi * 1.3 * time) + 10.0 * np.sin(2.0 * np.pi * 3.7 * time)

    drive = torque_at(t)

    def rate(time, x):
        torque = torque_at(time)
        return [x[1], (torque - D * x[1] - K * x[0] - F * np.tanh(x[1] / w)) / J]

    exact = solve_ivp(
        rate, (0.0, t[-1]), [drive[0] / K, 0.0], t_eval=t, rtol=1e-8, atol=1e-10, max_step=period
    )
    q = driven.follow(drive, J, D, K, F, w, period)
    # Friction is first order: late by an eighth of a sample, and here 5 % of the torque.
    assert np.max(np.abs(q - exact.y[0])) < 2e-3 * np.max(np.abs(q))


def test_instruments_respond_to_the_motor_encoder_as_announced(chain: Chain):
    """Noise alone drives the simulation: its columns' cross products with the measured ones are the expected ones."""
    axis = iv.Mechanism(Jm=2.0, K=800.0, JL=1.0, FVm=3.0, FV=4.0, FSm=0.0, FS=0.0, load={})
    rng = np.random.default_rng(7)
    motor = 1e-4 * rng.standard_normal(SAMPLES)
    columns = Columns(Recording(RATE, (Segment(0.0, 0.0 * motor, motor, motor),)), chain, 90.0)
    columns.set_reversal_velocity(1.0)
    simulated = iv.motor_driven(columns, axis)
    left, right = (("torque", 0), ("torque", 1), ("torsion", 0)), (("motor", 2), ("motor", 1), ("motor", 0))
    expected = noise.moments(
        chain, sum(columns.lengths), (0.0, 1e-4, 0.0), left, right, left_response=iv.response(axis)
    )
    for i, a in enumerate(left):
        for j, b in enumerate(right):
            x, y = simulated(*a), columns(*b)
            size = np.linalg.norm(x) * np.linalg.norm(y)
            assert x @ y / size == pytest.approx(expected[i, j] / size, abs=0.05), (a, b)


def test_an_axis_that_is_not_passive_is_not_simulated():
    model = TwoEncodersStructured()
    theta = np.array([1.0, 0.1, 0.1, -5.0, 1.0, 0.0, 0.0, 0.1, 0.1, 0.0])
    assert iv.mechanism(model, theta) is None


def test_blocks_of_the_instruments_are_shaped_like_those_of_the_model(chain: Chain, pure_noise: Recording):
    model = TwoEncodersStructured()
    columns = Columns(pure_noise, chain, 40.0)
    columns.set_reversal_velocity(0.01)
    axis = iv.mechanism(model, np.array([2.0, 1.0, 0.1, 800.0, 1.0, 0.0, 0.1, 1.0, 0.1, 0.0]))
    assert axis is not None
    shapes = [Z.shape for Z in iv.instruments(model, columns, axis)]
    assert shapes == [M.shape for M in block_matrices(model, columns)]


def test_slow_noise_in_a_short_informative_stretch_does_not_narrow_the_interval():
    """A sixth of the record informs; noise slower than that is taken up there, and seen in the rest."""
    from flexid_cli.estimate.covariance import combined_covariance, robust_covariance

    rng = np.random.default_rng(12)
    rows, part, scores, plain = 600, 100, [], []
    t = np.arange(part)
    W = np.zeros((rows, 5))
    for k in range(5):
        W[:part, k] = np.cos(np.pi * k * (t + 0.5) / part)
    bread = np.linalg.inv(W.T @ W)
    for _ in range(200):
        e = rng.standard_normal(rows + 100)
        for k in range(1, e.size):
            e[k] = 0.9 * e[k - 1] + np.sqrt(0.19) * e[k]
        e = e[100:]
        estimate = bread @ W.T @ e
        rest = e - W @ estimate
        both = combined_covariance(W, W, bread, rest, 1, (rows,))
        alone = robust_covariance(W * rest[:, None], bread, (rows,))
        scores.append(estimate[2] / np.sqrt(both.covariance[2, 2]))
        plain.append(estimate[2] / np.sqrt(alone.covariance[2, 2]))
    assert np.std(plain) > 1.5
    assert 0.8 < np.std(scores) < 1.25
