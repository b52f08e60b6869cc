"""The models' equations, coefficients and derivatives against a symbolic derivation from the paper's (3) to (7)."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import sympy as sp

from flexid_cli.estimate.paper_route import PaperRegression
from flexid_cli.models import motor_only
from flexid_cli.models.motor_only import MotorOnly
from flexid_cli.models.rigid import Rigid
from flexid_cli.models.two_encoders import TwoEncoders, TwoEncodersStructured
from flexid_cli.pipeline.chain import Chain, ChainSettings
from flexid_cli.pipeline.columns import Columns
from flexid_cli.pipeline.derivatives import differentiate
from flexid_cli.signals.recording import Recording, Segment

t, g = sp.symbols("t g", real=True)
SYMBOLS = {
    name: sp.Symbol(name) for name in ["Jm", "K", "JL", "FVm", "FV", "FSm", "FS", "MX", "MY", "c", "kg", "q0"]
}
SYMBOLS["offset"] = sp.Symbol("offset")
# Over a small motion the constant of the equation is the offset together with the gravity torque at q0.
SYMBOLS["Q0"] = SYMBOLS["offset"]
Jm, K, JL, FVm, FV, FSm, FS, MX, MY, c, kg, q0, offset = (
    SYMBOLS[n] for n in ["Jm", "K", "JL", "FVm", "FV", "FSm", "FS", "MX", "MY", "c", "kg", "q0", "offset"]
)
q, qm, torque = (sp.Function(n)(t) for n in ("q", "qm", "torque"))
# The friction signs and the gravity torque stay functions of time: all that the elimination needs is linear.
sign_motor, sign_joint, gravity_torque = (sp.Function(n)(t) for n in ("S", "SL", "Q"))

PAPER_TRUTH = {
    "Jm": 174.7996,
    "K": 20341.0458,
    "JL": 47.4458,
    "FVm": 235.91,
    "FSm": 41.4254,
    "FV": 83.1508,
    "FS": 8.4612,
    "MX": -0.7241,
    "MY": -53.4201,
}
GRAVITY = 9.81
REGRESSION_THETA = np.array([PAPER_TRUTH[n] for n in ("Jm", "K", "JL", "FVm", "FV", "FSm")])


def load_equation(gravity=gravity_torque):
    """Eq. (5) with friction (3); zero on a motion of the axis."""
    return JL * q.diff(t, 2) + gravity + FS * sign_joint + FV * q.diff(t) - K * (qm - q)


def motor_equation():
    """Eq. (6) with friction (4) and an offset of the torque signal; zero on a motion of the axis."""
    return torque - offset - (Jm * qm.diff(t, 2) + FSm * sign_motor + FVm * qm.diff(t) + K * (qm - q))


@cache
def motor_only_equation():
    """Eq. (5) with q eliminated by eq. (6), not scaled."""
    joint = sp.solve(motor_equation(), q)[0]
    return sp.expand(load_equation().subs(q, joint).doit())


def column_symbols() -> dict[tuple[str, int], sp.Expr]:
    """What each column of the observation matrix stands for."""
    signals = {
        "torque": torque, "motor": qm, "joint": q, "torsion": qm - q, "joint_centred": q - q0,
        "sign_motor": sign_motor, "sign_joint": sign_joint, "one": sp.Integer(1),
        "gravity_cos": g * sp.cos(q), "gravity_sin": g * sp.sin(q),
    }  # fmt: skip
    return {
        (name, d): signal.diff(t, d) if d else signal for name, signal in signals.items() for d in range(5)
    }


def block_residual(model, index: int, theta: dict[str, sp.Expr]) -> sp.Expr:
    """Residual of one block of ``model`` as an expression: the package's coefficients, symbolically."""
    coefficients = symbolic_coefficients(model, theta)[index]
    columns = column_symbols()
    return sum(a * columns[name] for a, name in zip(coefficients, model.blocks[index].columns, strict=True))


def symbolic_coefficients(model, theta: dict[str, sp.Expr]):
    """Run the package's own arithmetic on symbols (object arrays), so that every term and sign is seen."""
    values = np.array([theta[p.symbol] for p in model.parameters], dtype=object)
    return model.coefficients(values)


# --- the paper's elimination


def test_x1_to_x6_are_the_coefficients_of_the_eliminated_equation():
    equation = motor_only_equation()
    lead = equation.coeff(torque)
    scaled = {d: sp.simplify(equation.coeff(torque.diff(t, d)) / lead) for d in (1, 2)}
    motion = {d: sp.simplify(-equation.coeff(qm.diff(t, d)) / lead) for d in (1, 2, 3, 4)}
    theta = np.array([Jm, K, JL, FVm, FV, FSm], dtype=object)
    X = motor_only.regression_coefficients(theta)
    derived = [scaled[2], scaled[1], motion[4], motion[3], motion[2], motion[1]]
    for ours, theirs in zip(X, derived, strict=False):
        assert sp.simplify(ours - theirs) == 0
    assert sp.simplify(X[6] - (-equation.coeff(sign_motor) / lead)) == 0
    assert sp.simplify(equation.coeff(qm)) == 0


def test_motor_only_columns_and_signs_reproduce_the_eliminated_equation():
    model = MotorOnly("none")
    residual = block_residual(model, 0, SYMBOLS) - gravity_torque
    equation = motor_only_equation()
    assert sp.simplify(sp.expand(residual - equation / equation.coeff(torque))) == 0


@pytest.mark.parametrize(
    ("form", "gravity"),
    [("spring", kg * (q - q0)), ("moments", MX * g * sp.cos(q) + MY * g * sp.sin(q))],
)
def test_gravity_terms_enter_with_the_sign_of_the_load_equation(form: str, gravity: sp.Expr):
    residual = block_residual(MotorOnly(form), 0, SYMBOLS)
    without = block_residual(MotorOnly("none"), 0, SYMBOLS)
    assert sp.simplify(residual - without + gravity) == 0


def two_encoder_equations() -> dict[str, sp.Expr]:
    """The residual that each block's name stands for, from the equations of motion, with the spring's zero."""
    gravity = MX * g * sp.cos(q) + MY * g * sp.sin(q)
    motor = motor_equation().subs(offset, 0) + c
    load = load_equation(gravity) + c
    return {"motor": motor, "load": load, "total": motor - load, "torsion": -load / K}


@pytest.mark.parametrize("model", [TwoEncoders(), TwoEncodersStructured()])
def test_two_encoder_blocks_are_the_equations_of_motion(model):
    for index, block in enumerate(model.blocks):
        difference = block_residual(model, index, SYMBOLS) - two_encoder_equations()[block.name]
        assert sp.nsimplify(sp.expand(difference)) == 0
    # Two independent combinations of the two equations: the pair has the same parameters and solutions.
    assert len({block.name for block in model.blocks}) == 2


def test_rigid_is_the_sum_for_an_infinite_stiffness():
    gravity = MX * g * sp.cos(q) + MY * g * sp.sin(q)
    both = (motor_equation() - load_equation(gravity)).subs({sign_joint: sign_motor}).subs(qm, q).doit()
    model = Rigid("moments")
    theta = {"Jm+JL": Jm + JL, "FVm+FV": FVm + FV, "FSm+FS": FSm + FS, "offset": offset, "MX": MX, "MY": MY}
    assert sp.simplify(sp.expand(block_residual(model, 0, theta).subs(qm, q).doit() - both)) == 0


def test_paper_regression_is_equation_18():
    X = {f"X{k}": sp.Symbol(f"X{k}") for k in range(1, 8)}
    residual = block_residual(PaperRegression(), 0, X)
    regressor = [
        -torque.diff(t, 2), -torque.diff(t),
        qm.diff(t, 4), qm.diff(t, 3), qm.diff(t, 2), qm.diff(t), sign_motor,
    ]  # fmt: skip
    printed = torque - sum(X[f"X{k + 1}"] * column for k, column in enumerate(regressor))
    assert sp.simplify(residual - printed) == 0


# --- derivatives of the coefficients


def models():
    return {
        "motor_only none": MotorOnly("none"),
        "motor_only spring": MotorOnly("spring"),
        "motor_only moments": MotorOnly("moments"),
        "rigid none": Rigid("none"),
        "rigid spring": Rigid("spring"),
        "rigid moments": Rigid("moments"),
        "two_encoders": TwoEncoders(),
        "two_encoders structured": TwoEncodersStructured(),
        "paper": PaperRegression(),
    }


@pytest.mark.parametrize("name", models())
def test_jacobian_is_the_derivative_of_the_coefficients(name: str):
    model = models()[name]
    symbols = [sp.Symbol(f"p{k}") for k in range(len(model.parameters))]
    coefficients = model.coefficients(np.array(symbols, dtype=object))
    theta = np.random.default_rng(5).uniform(0.5, 2.0, len(symbols)) * np.geomspace(1.0, 30.0, len(symbols))
    at = dict(zip(symbols, theta, strict=True))
    for block, a, D in zip(model.blocks, coefficients, model.jacobian(theta), strict=True):
        assert len(a) == len(block.columns)
        exact = sp.Matrix(list(a)).jacobian(symbols).subs(at)
        np.testing.assert_allclose(D, np.array(exact.tolist(), dtype=float), rtol=1e-13, atol=1e-15)


def test_regression_jacobian_is_the_derivative_of_x():
    symbols = sp.symbols("a:6")
    X = sp.Matrix(list(motor_only.regression_coefficients(np.array(symbols, dtype=object))))
    exact = X.jacobian(symbols).subs(dict(zip(symbols, REGRESSION_THETA, strict=True)))
    ours = motor_only.regression_jacobian(REGRESSION_THETA)
    np.testing.assert_allclose(ours, np.array(exact.tolist(), dtype=float), rtol=1e-13, atol=1e-18)


def test_six_parameters_leave_seven_coefficients_one_restriction():
    symbols = sp.symbols("a:6", positive=True)
    X = sp.Matrix(list(motor_only.regression_coefficients(np.array(symbols, dtype=object))))
    rational = {s: sp.Rational(n) for s, n in zip(symbols, (175, 20341, 47, 236, 83, 41), strict=True)}
    J = X.jacobian(symbols).subs(rational)
    assert J.rank() == 6
    for dropped in range(6):
        rest = J.copy()
        rest.row_del(dropped)
        assert rest.rank() == 6


# --- inversions, and the paper's printed numbers


def test_the_paper_inversion_inverts_the_regression():
    X = motor_only.regression_coefficients(REGRESSION_THETA)
    np.testing.assert_allclose(motor_only.paper_inversion(X), REGRESSION_THETA, rtol=1e-11)


def test_the_starting_point_is_exact_without_friction_and_close_with_it():
    frictionless = REGRESSION_THETA * np.array([1.0, 1.0, 1.0, 0.0, 0.0, 1.0])
    X = motor_only.regression_coefficients(frictionless)
    np.testing.assert_allclose(motor_only.starting_point(X), frictionless, rtol=1e-13, atol=1e-13)
    start = motor_only.starting_point(motor_only.regression_coefficients(REGRESSION_THETA))
    # X5 exceeds Jm + JL by FV FVm / K, which passes to JL and, through K = JL / X1, to K.
    excess = PAPER_TRUTH["FV"] * PAPER_TRUTH["FVm"] / PAPER_TRUTH["K"] / PAPER_TRUTH["JL"]
    np.testing.assert_allclose(
        start[:3] / REGRESSION_THETA[:3], [1.0, 1.0 + excess, 1.0 + excess], rtol=1e-11
    )
    assert excess < 0.03
    assert start[3] + start[4] == pytest.approx(PAPER_TRUTH["FVm"] + PAPER_TRUTH["FV"])


def test_table_3_follows_from_table_2_with_its_hidden_digits():
    # X3 to X7 as printed; X1 and X2 carry the digits that Table 3 implies.
    X = np.array([2.06418e-3, 4.55680e-3, 0.3554, 3.1739, 205.4558, 1246.5690, 5.1624])
    Jm_, K_, JL_, FVm_, FV_, FSm_ = motor_only.paper_inversion(X)
    # X1 and X2 in six digits: FV is the difference X6 - FVm of numbers a dozen times larger.
    assert Jm_ == pytest.approx(172.1890, rel=2e-4)
    assert pytest.approx(19552.6214, rel=2e-3) == K_
    assert pytest.approx(40.3601, rel=2e-3) == JL_
    assert FVm_ == pytest.approx(1157.4716, rel=2e-4)
    assert pytest.approx(89.0974, rel=2e-3) == FV_
    assert FSm_ == pytest.approx(5.1624)


def test_rounding_of_the_printed_table_2_moves_table_3():
    X = np.array([0.0021, 0.0046, 0.3554, 3.1739, 205.4558, 1246.5690, 5.1624])
    Jm_, K_, JL_ = motor_only.paper_inversion(X)[:3]
    assert pytest.approx(169.2, abs=0.05) == Jm_
    assert pytest.approx(23022.0, abs=1.0) == K_
    assert pytest.approx(48.3, abs=0.06) == JL_


def test_table_3_contradicts_the_x5_of_table_2():
    table_3 = np.array([172.1890, 19552.6214, 40.3601, 1157.4716, 89.0974, 5.1624])
    X = motor_only.regression_coefficients(table_3)
    assert X[4] == pytest.approx(217.82, abs=0.005)
    assert (X[4] - 205.4558) / (7.9221 / 2.0) == pytest.approx(3.1, abs=0.05)


def test_table_1_implies_other_coefficients_than_table_2():
    X = motor_only.regression_coefficients(REGRESSION_THETA)
    assert X[3] == pytest.approx(1.26, abs=0.01)
    assert X[5] == pytest.approx(319.0, abs=0.1)
    printed = np.array([0.0021, 0.0046, 0.3554, 3.1739, 205.4558, 1246.5690, 5.1624])
    two_sigma = np.array([0.0001, 0.0022, 0.0176, 0.3569, 7.9221, 165.1359, 7.4232])
    # X1 is printed with one significant digit of its deviation; its relative one gives it exactly.
    two_sigma[0] = 2.0 * 0.025977 * 2.06418e-3
    printed[0] = 2.06418e-3
    z = (printed - X) / (two_sigma / 2.0)
    np.testing.assert_allclose(z[[1, 2, 3, 4, 5, 6]], [0.5, -5.9, 10.7, -4.5, 11.2, -9.8], atol=0.1)


# --- signs end to end: an analytic motion through the chain

RATE = 250.0
DURATION = 16.0
WIDTH = 0.05


@cache
def motion(gravity: sp.Expr, extra_offset: float) -> Recording:
    """A record that satisfies the equations of motion exactly: q(t) chosen, qm and the torque computed."""
    path = (
        sp.Float(0.06) * sp.sin(2.1 * t)
        + sp.Float(0.05) * sp.sin(5.7 * t + 0.4)
        + sp.Float(0.012) * sp.cos(11.9 * t + 1.0)
    )
    numbers = {SYMBOLS[k]: v for k, v in PAPER_TRUTH.items()} | {g: GRAVITY, q0: 0.0, kg: -480.0}

    def friction(velocity):
        return sp.tanh(velocity / WIDTH)

    load = JL * q.diff(t, 2) + gravity + FS * friction(q.diff(t)) + FV * q.diff(t)
    load_torque = load.subs(q, path).doit().subs(numbers)
    motor_path = path + load_torque / numbers[K]
    drive = Jm * qm.diff(t, 2) + FVm * qm.diff(t) + FSm * friction(qm.diff(t))
    total = drive.subs(qm, motor_path).doit().subs(numbers) + load_torque + extra_offset
    time = np.arange(round(DURATION * RATE)) / RATE
    arrays = [sp.lambdify(t, e, "numpy", cse=True)(time) for e in (total, motor_path, path)]
    return Recording(RATE, (Segment(0.0, *arrays),))


def columns_of(recording: Recording) -> Columns:
    """Columns whose low pass lies far above the motion, and whose signs take the true width."""
    chain = Chain(ChainSettings(RATE, lowpass_cutoff_hz=None, decimation=3))
    columns = Columns(recording, chain, sign_cutoff_hz=0.45 * RATE, gravity_m_per_s2=GRAVITY)
    columns.set_reversal_velocity(WIDTH)
    return columns


class Exact:
    """The columns, with the friction signs taken from exact velocities instead of filtered ones."""

    def __init__(self, recording: Recording) -> None:
        self.columns = columns_of(recording)
        segment = recording.segments[0]
        assert segment.joint_position is not None
        chain, period = self.columns.chain, 1.0 / RATE
        self.signs = {}
        for name, x in (("sign_motor", segment.motor_position), ("sign_joint", segment.joint_position)):
            velocity = differentiate(x, 1, period, half_width=chain.half_width)
            self.signs[name] = np.tanh(velocity / WIDTH)

    def __call__(self, name: str, derivative: int) -> np.ndarray:
        if name in self.signs:
            return self.columns.chain.apply(self.signs[name], derivative)
        return self.columns(name, derivative)


def relative_residual(model, theta: np.ndarray, source) -> list[float]:
    """Residual of each block over the size of its largest term, at the true parameters."""
    result = []
    for block, a in zip(model.blocks, model.coefficients(theta), strict=True):
        terms = np.column_stack(
            [coefficient * source(*name) for coefficient, name in zip(a, block.columns, strict=True)]
        )
        result.append(float(np.abs(terms.sum(axis=1)).max() / np.abs(terms).max()))
    return result


# The chain's promise: at the edge of its band the second derivative is right to 1e-6 and the fourth to 2e-6.
RESIDUAL = 2e-6


def theta_of(model, **extra: float) -> np.ndarray:
    values = PAPER_TRUTH | {"c": 0.0, "offset": 0.0} | extra
    return np.array([values[p.symbol] for p in model.parameters])


@pytest.mark.parametrize("model", [TwoEncoders(), TwoEncodersStructured()])
def test_two_encoder_equations_hold_on_an_analytic_motion(model):
    source = Exact(motion(MX * g * sp.cos(q) + MY * g * sp.sin(q), 0.0))
    assert max(relative_residual(model, theta_of(model), source)) < RESIDUAL


@pytest.mark.parametrize(
    ("form", "gravity", "extra"),
    [
        ("none", sp.Integer(0), {"offset": 12.0}),
        ("spring", kg * q, {"Q0": 12.0, "kg": -480.0}),
        ("moments", MX * g * sp.cos(q) + MY * g * sp.sin(q), {"offset": 12.0}),
    ],
)
def test_motor_only_equation_holds_on_an_analytic_motion(
    form: str, gravity: sp.Expr, extra: dict[str, float]
):
    recording = motion(gravity, 12.0)
    model = MotorOnly(form)
    source = Exact(recording)
    source.columns.centre = 0.0
    assert max(relative_residual(model, theta_of(model, **extra), source)) < RESIDUAL


@pytest.mark.parametrize("symbol", [p.symbol for p in MotorOnly("moments").parameters])
def test_the_analytic_motion_would_show_a_wrong_sign(symbol: str):
    """The residual test above has teeth for every parameter of the motor-only equation."""
    model = MotorOnly("moments")
    source = Exact(motion(MX * g * sp.cos(q) + MY * g * sp.sin(q), 12.0))
    theta = theta_of(model, offset=12.0)
    theta[[p.symbol for p in model.parameters].index(symbol)] *= -1.0
    assert max(relative_residual(model, theta, source)) > 500.0 * RESIDUAL


def test_the_joint_position_is_rebuilt_as_equation_14():
    recording = motion(MX * g * sp.cos(q) + MY * g * sp.sin(q), 0.0)
    segment = recording.segments[0]
    blind = Recording(RATE, (Segment(0.0, segment.torque, segment.motor_position),))
    columns = columns_of(blind)
    p = PAPER_TRUTH
    columns.rebuild_joint(p["Jm"], p["FVm"], p["FSm"], p["K"])
    inner = slice(200, -200)
    torsion = np.abs(segment.motor_position - segment.joint_position).max()
    error = np.abs(columns.joint[0] - segment.joint_position)[inner].max()
    # The band of the signs reaches to nine tenths of Nyquist; its derivative of half width 3 errs by
    # (w Ts)^6 / 140 on the fastest reversal, which Jm / K turns into a small part of the torsion. The sign is that of
    # a whole sample with the average's damping undone to second order: at a reversal a hundredth of FSm.
    assert error < 2e-3 * torsion + 0.01 * p["FSm"] / p["K"]
