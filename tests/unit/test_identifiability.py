"""Which sums of parameters are determined where these are not: against exact algebra, and in a record's report."""

from __future__ import annotations

import numpy as np
import pytest
import sympy

from flexid_cli.config.load import parse_config
from flexid_cli.estimate import identifiability
from flexid_cli.estimate.identifiability import Combination, determined, exact, of_columns
from flexid_cli.estimate.identify import identify
from flexid_cli.models.base import Parameter
from flexid_cli.signals.recording import Recording, Segment


def null_space(W):
    """Of a matrix of rationals, exactly."""
    exact_matrix = sympy.Matrix([[sympy.nsimplify(x, rational=True) for x in row] for row in W])
    return [np.array(v.T.tolist()[0], dtype=float) for v in exact_matrix.nullspace()]


def as_row(combination, size):
    row = np.zeros(size)
    row[list(combination.index)] = combination.coefficients
    return row


def rationals(rng, shape):
    return rng.integers(-8, 9, shape) / 4.0


@pytest.mark.parametrize("seed", range(5))
def test_combinations_are_those_that_no_null_vector_changes(seed):
    rng = np.random.default_rng(seed)
    B = rationals(rng, (12, 4))
    W = np.column_stack([B, 2.0 * B[:, 0] - 0.5 * B[:, 2], 0.25 * B[:, 1]])[:, rng.permutation(6)]
    null = null_space(W)
    assert len(null) == 2
    found = of_columns(W, np.inf)
    assert found.base
    for combination in found.base:
        for vector in null:
            assert as_row(combination, 6) @ vector == pytest.approx(0.0, abs=1e-9)
    touched = {k for v in null for k in np.flatnonzero(np.abs(v) > 1e-12)}
    assert touched == {k for c in found.base for k in c.index}
    for k in range(6):
        assert (exact(W, k) is None) == (k not in touched)


def test_friction_at_one_speed_is_one_number():
    # FV v + FS sgn v with |v| = 0.25: only FV + 4 FS, by hand.
    sign = np.tile([1.0, -1.0], 20)
    W = np.column_stack([np.linspace(-1.0, 1.0, 40), 0.25 * sign, sign])
    combination = exact(W, 1)
    ratio = dict(zip(combination.index, combination.coefficients, strict=True))
    assert ratio[1] / ratio[2] == pytest.approx(0.25)
    text = combination.text(("Jm+JL", "FV", "FS"))
    assert text in {"FS + 0.25 FV", "FV + 4 FS"}
    assert exact(W, 0) is None


def test_gravity_at_one_angle_is_a_torque():
    q0, g = sympy.Rational(3, 5), 9.81
    cos, sin = float(sympy.cos(q0)), float(sympy.sin(q0))
    W = np.column_stack([np.ones(30), np.full(30, g * cos), np.full(30, g * sin), np.linspace(0.0, 1.0, 30)])
    combination = exact(W, 2)
    row = as_row(combination, 4)
    np.testing.assert_allclose(row / row[0], [1.0, g * cos, g * sin, 0.0], rtol=1e-9)


def test_a_column_of_zeros_belongs_to_nothing():
    W = np.column_stack([np.arange(5.0), np.zeros(5), np.arange(5.0)])
    assert exact(W, 1) is None
    assert set(exact(W, 0).index) == {0, 2}
    assert of_columns(np.zeros((5, 2))).base == ()


def test_near_dependencies_count_from_a_condition_index_of_thirty():
    rng = np.random.default_rng(0)
    x, y, z = rng.standard_normal((3, 400))
    far, near = np.column_stack([x, y, x + 0.2 * z]), np.column_stack([x, y, x + 0.02 * z])
    assert of_columns(far).base == ()
    found = of_columns(near)
    assert found.near == (0, 2)
    assert [set(c.index) for c in found.base] == [{0, 2}]
    assert found.base[0].coefficients[1] == pytest.approx(1.0, abs=0.01)
    s = np.linalg.svd(near / np.linalg.norm(near, axis=0), compute_uv=False)
    np.testing.assert_allclose(found.condition_indices, s[0] / s)


def test_scaling_a_column_scales_its_coefficient():
    rng = np.random.default_rng(1)
    x, z = rng.standard_normal((2, 100))
    W = np.column_stack([x, x + 1e-3 * z])
    a = as_row(of_columns(W).base[0], 2)
    b = as_row(of_columns(W * np.array([1.0, 1000.0])).base[0], 2)
    assert (b[1] / b[0]) / (a[1] / a[0]) == pytest.approx(1000.0)


def test_the_determined_sum_is_the_one_with_the_least_variance():
    covariance = np.array([[100.0, -97.0, 0.0], [-97.0, 98.0, 0.0], [0.0, 0.0, 1e-4]])
    theta = np.array([40.0, 60.0, 5.0])
    found = determined(theta, covariance, 0)
    assert found.index == (0, 1)
    value, stderr = found.estimate(theta, covariance)
    for slope in np.linspace(0.8, 1.2, 81):
        other = Combination((0, 1), (1.0, float(slope)))
        assert other.estimate(theta, covariance)[1] >= stderr - 1e-12
    assert value == pytest.approx(40.0 + found.coefficients[1] * 60.0)
    assert determined(theta, covariance, 2) is None
    assert determined(theta, np.diag([100.0, 98.0, 1e-4]), 0) is None


def test_three_that_only_together_are_determined():
    # Each pair is correlated by about a half; the sum of all is known.
    a = np.array([1.0, 1.0, 1.0]) / np.sqrt(3.0)
    covariance = 25.0 * (np.eye(3) - np.outer(a, a)) + 1e-4 * np.outer(a, a)
    found = determined(np.array([5.0, 6.0, 7.0]), covariance, 1)
    assert sorted(found.index) == [0, 1, 2]
    np.testing.assert_allclose(found.coefficients, 1.0, rtol=1e-3)


def test_what_others_know_well_makes_no_sum():
    covariance = np.array([[25.0, 4.9], [4.9, 1.0]])
    assert determined(np.array([3.0, 1000.0]), covariance, 0) is None


def test_words():
    combination = Combination((0, 1, 2), (1.0, -0.98, 1.0))
    assert combination.text(("FVm", "FV", "FS")) == "FVm - 0.98 FV + FS"
    theta, covariance = np.array([300.0, 0.0, 19.0]), np.diag([16.0, 0.0, 0.0])
    text = identifiability.in_words(combination, ("FVm", "FV", "FS"), theta, covariance, "N.m.s/rad")
    assert text == "only FVm - 0.98 FV + FS is determined (319 ± 4 N.m.s/rad)"
    assert identifiability.in_words(None, (), theta, covariance, "") == ""


def test_every_parameter_of_every_model_has_advice():
    from flexid_cli.models.base import GRAVITY_FORMS
    from flexid_cli.models.motor_only import PHYSICAL
    from flexid_cli.models.rigid import Rigid
    from flexid_cli.models.two_encoders import PARAMETERS

    known = set().union(*(symbols for symbols, _ in identifiability._ADVICE))
    gravity: list[Parameter] = [p for form in GRAVITY_FORMS.values() for p in form[0]]
    symbols = {p.symbol for p in (*PHYSICAL, *gravity, *Rigid("moments").parameters, *PARAMETERS)}
    assert symbols - {"c"} | {"z"} <= known


TEXT = """
version: 1
axis: {name: axis, gear_ratio: 1}
signals:
  joint_torque: {source: u, unit: N.m, hold: instant}
  motor_position: {source: qm, unit: rad}
models: [rigid]
"""


def test_a_record_of_one_speed_names_the_sum_and_what_to_record():
    # Legs of one speed, back and forth, the reversals slow against the samples: FV and FS are one torque.
    rate, speed = 200.0, 0.5
    t = np.arange(round(20.0 * rate)) / rate
    velocity = speed * np.tanh(np.sin(2.0 * np.pi * 0.25 * t) / 0.02)
    position = np.concatenate([[0.0], np.cumsum(0.5 * (velocity[1:] + velocity[:-1]))]) / rate
    acceleration = np.gradient(velocity, 1.0 / rate)
    torque = 2.0 * acceleration + 3.0 * velocity + 1.0 * velocity / speed
    torque += 0.05 * np.random.default_rng(0).standard_normal(t.size)
    recording = Recording(rate, (Segment(0.0, torque, position, None),), duration_s=20.0)
    found = identify(recording, parse_config(TEXT)).models[0]
    friction = {e.symbol: e for e in found.parameters if e.symbol in {"FVm+FV", "FSm+FS"}}
    doubtful = [e for e in friction.values() if e.verdict != "identified"]
    assert doubtful
    assert any("is determined" in e.reason for e in doubtful)
    assert all("constant velocity" in e.advice for e in doubtful)
    assert all(not e.advice for e in found.parameters if e.verdict == "identified")
    test = found.tests["identifiability"]
    assert {"largest_condition_index", "near_dependent", "determined", "combinations"} <= test.keys()
