"""Parameters of the baseline and of the effects with intervals, from the whitened fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexid_cli.diagnose.fitter import Fitted
from flexid_cli.diagnose.problem import Problem, Stretch
from flexid_cli.effects.base import unit_of
from flexid_cli.estimate.covariance import robust_covariance
from flexid_cli.estimate.result import Estimate
from flexid_cli.estimate.verdict import judge
from flexid_cli.models.base import Parameter
from flexid_cli.signals.recording import Segment

Array = NDArray[np.float64]

METHOD = "whitened least squares, HAC"
BASE_PARAMETERS = (
    Parameter("motor_inertia", "Jm", "inertia", positive=True),
    Parameter("joint_stiffness", "K", "stiffness", positive=True),
    Parameter("load_inertia", "JL", "inertia", positive=True),
    Parameter("motor_viscous_friction", "FVm", "viscous", positive=True),
    Parameter("motor_coulomb_friction", "FSm", "torque", positive=True),
    Parameter("load_viscous_friction", "FV", "viscous", positive=True),
    Parameter("load_coulomb_friction", "FS", "torque", positive=True),
    Parameter("gravity_moment_x", "MX", "first_moment"),
    Parameter("gravity_moment_y", "MY", "first_moment"),
)
NOISE_SEEDS = (20010521, 20010522)
DOUBT_OF_CORRECTION = 0.5  # share of the noise's bias that its correction may be wrong by
SHAPE_STEP = 0.01  # relative step of a shape parameter for its derivative


@dataclass(frozen=True)
class Solved:
    """Coefficients of the columns, freed of the encoders' noise, and their covariance."""

    coefficients: Array
    covariance: Array
    degrees_of_freedom: Array


def solved(fitted: Fitted) -> Solved:
    """Coefficients with a covariance that is robust to correlated residuals.

    The encoders' noise stands in the columns too; its part of the normal matrix is that of a record of noise alone
    that passes the same chain, and is taken off.
    """
    problem, X = fitted.problem, fitted.basis.columns
    scale = np.linalg.norm(X, axis=0)
    scale[scale == 0.0] = 1.0
    bread = np.linalg.pinv((X / scale).T @ (X / scale)) / np.outer(scale, scale)
    plain = fitted.basis.coefficients
    shift = _noise_shift(fitted, bread) if problem.both else np.zeros_like(plain)
    rows = fitted.y.size // problem.equations
    scores = (X * fitted.basis.residual[:, None]).reshape(problem.equations, rows, -1).sum(axis=0)
    robust = robust_covariance(scores, bread, [int(w.open.sum()) for w in problem.weights])
    doubt = DOUBT_OF_CORRECTION * shift
    return Solved(plain + shift, robust.covariance + np.outer(doubt, doubt), robust.degrees_of_freedom)


def _noise_shift(fitted: Fitted, bread: Array) -> Array:
    """What the noise in the columns has moved the coefficients by, taken back."""
    problem, size = fitted.problem, fitted.basis.coefficients.size
    p = len(problem.names)
    normal, right = np.zeros((size, size)), np.zeros(size)
    for seed in NOISE_SEEDS:
        columns, y = _noise_rows(problem, seed)
        normal[:p, :p] += columns.T @ columns / len(NOISE_SEEDS)
        right[:p] += columns.T @ (y - columns @ fitted.basis.coefficients[:p]) / len(NOISE_SEEDS)
    # (H - N) b = X'y - V'v; with b = b0 + d: (H - N) d = N b0 - V'v = -V'(v - V b0).
    reduced = np.linalg.pinv(bread) - normal
    return np.asarray(-np.linalg.lstsq(reduced, right, rcond=1e-12)[0], dtype=np.float64)


def _noise_rows(problem: Problem, seed: int) -> tuple[Array, Array]:
    """Baseline columns and target of a record that holds nothing but the encoders' noise."""
    rng = np.random.default_rng(seed)
    noisy = []
    for s in problem.stretches:
        n = s.torque.size
        segment = Segment(
            s.start_s,
            np.zeros(n),
            problem.noise.motor_position * rng.standard_normal(n),
            problem.noise.joint_position * rng.standard_normal(n) if problem.both else None,
        )
        noisy.append(Stretch(segment, s.rate_hz, problem.band_hz))
    return problem.noise_rows(noisy)


def base_estimates(
    fitted: Fitted, result: Solved, *, linear: bool, torque_unit: str, level: float
) -> tuple[Estimate, ...]:
    """The baseline's parameters."""
    problem = fitted.problem
    out = []
    for parameter in BASE_PARAMETERS:
        if parameter.symbol not in problem.names:
            continue
        k = problem.names.index(parameter.symbol)
        value = float(result.coefficients[k])
        if not problem.both:
            value += float(getattr(problem.base, parameter.symbol))
        stderr = float(np.sqrt(max(result.covariance[k, k], 0.0)))
        unit = unit_of(parameter.quantity, linear=linear, torque_unit=torque_unit)
        out.append(
            judge(
                parameter,
                unit,
                value,
                stderr,
                float(result.degrees_of_freedom[k]),
                level=level,
                method=METHOD,
            )
        )
    return tuple(out)


def effect_estimates(
    fitted: Fitted, k: int, result: Solved, *, linear: bool, torque_unit: str, level: float
) -> tuple[Estimate, ...]:
    """Parameters of the k-th effect: amplitudes and shapes together, to first order about the solution."""
    chosen = fitted.chosen[k]
    form, base = chosen.form, fitted.problem.base
    amplitudes = fitted.amplitudes(k)
    values = form.signature.values(amplitudes, chosen.shape, base)
    spread = _value_spread(fitted, k, result)
    dof = float(np.min(result.degrees_of_freedom))
    out = []
    for p in form.effect.parameters:
        if p.name not in values:
            continue
        unit = unit_of(p.quantity, linear=linear, torque_unit=torque_unit)
        parameter = Parameter(p.name, p.symbol, p.quantity, positive=p.low >= 0.0)
        out.append(
            judge(parameter, unit, float(values[p.name]), spread[p.name], dof, level=level, method=METHOD)
        )
    return tuple(out)


def _value_spread(fitted: Fitted, k: int, result: Solved) -> dict[str, float]:
    """Standard errors of an effect's values: its tangent columns beside the whole model."""
    chosen = fitted.chosen[k]
    signature, base = chosen.form.signature, fitted.problem.base
    amplitudes = np.atleast_1d(fitted.amplitudes(k))
    rows = fitted.search.rows(chosen.form, chosen.shape)
    free = signature.fixed is None
    tangents = [rows[:, j] for j in range(rows.shape[1])] if free else []
    names = [("amplitude", j) for j in range(len(tangents))]
    for j, value in enumerate(chosen.shape):
        step = SHAPE_STEP * (abs(value) or 1.0)
        moved = (*chosen.shape[:j], value + step, *chosen.shape[j + 1 :])
        tangents.append((fitted.search.rows(chosen.form, moved) - rows) @ amplitudes[: rows.shape[1]] / step)
        names.append(("shape", j))
    own = fitted._columns(k) if free else slice(0, 0)
    others = np.delete(fitted.basis.columns, np.arange(fitted.basis.columns.shape[1])[own], axis=1)
    X = np.column_stack([others, *tangents])
    scale = np.linalg.norm(X, axis=0)
    scale[scale == 0.0] = 1.0
    bread = np.linalg.pinv((X / scale).T @ (X / scale)) / np.outer(scale, scale)
    equations = fitted.problem.equations
    scores = (X * fitted.basis.residual[:, None]).reshape(equations, -1, X.shape[1]).sum(axis=0)
    lengths = [int(w.open.sum()) for w in fitted.problem.weights]
    covariance = robust_covariance(scores, bread, lengths).covariance[-len(tangents) :, -len(tangents) :]
    centre = signature.values(amplitudes, chosen.shape, base)
    jacobian: dict[str, list[float]] = {name: [] for name in centre}
    for i, (kind, j) in enumerate(names):
        step = max(
            1e-3 * float(np.sqrt(max(covariance[i, i], 0.0))),
            1e-9 * abs(amplitudes[j] if kind == "amplitude" else chosen.shape[j]),
            1e-300,
        )
        a, shape = amplitudes.copy(), list(chosen.shape)
        if kind == "amplitude":
            a[j] += step
        else:
            shape[j] += step
        there = signature.values(a, tuple(shape), base)
        for name, value in centre.items():
            jacobian[name].append((there[name] - value) / step)
    return {
        name: float(np.sqrt(max(np.array(g) @ covariance @ np.array(g), 0.0))) for name, g in jacobian.items()
    }
