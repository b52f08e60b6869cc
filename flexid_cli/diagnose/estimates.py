"""Parameters of the baseline and of the effects with intervals, from the whitened fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flexid_cli.diagnose.fitter import REVERSALS, Fitted
from flexid_cli.diagnose.problem import MODEL_FLOOR, RIGID_NAMES, SCALED, Problem
from flexid_cli.diagnose.stretch import Stretch
from flexid_cli.effects.base import unit_of
from flexid_cli.estimate.covariance import RobustCovariance, robust_covariance
from flexid_cli.estimate.result import Estimate
from flexid_cli.estimate.verdict import judge
from flexid_cli.models.base import Parameter
from flexid_cli.models.rigid import Rigid
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
    Parameter("torque_offset", "offset", "torque"),
)
RIGID = dict(zip(RIGID_NAMES, Rigid("none").parameters, strict=True))
NOISE_SEEDS = (20010521, 20010522)
DOUBT_OF_CORRECTION = 0.5  # share of the noise's bias that its correction may be wrong by
# A torque that no model predicts better than MODEL_FLOOR gives no parameter better than this share of it.
FLOOR_SHARE = 0.5
# Without a joint encoder the joint's motion is rebuilt from the model, which the covariance does not know of: over 21
# calibration records of the benchmark 95 % of the errors of K are within 3.0 standard errors.
ALONE_SPREAD = 1.5
WIDTH_STEP = 0.05
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
    problem, X, plain = fitted.problem, fitted.basis.columns, fitted.basis.coefficients
    shapes = [_shape_tangents(fitted, k) for k in range(len(fitted.chosen))]
    tangents = np.hstack([t for t, _ in shapes]) if shapes else np.empty((X.shape[0], 0))
    stiffened = np.concatenate([s for _, s in shapes]) if shapes else np.empty(0)
    # What the uncertainty of shapes and of the reversals' widths does to the coefficients.
    X = np.hstack([X, tangents, _width_tangents(fitted)])
    bread = _bread(X)
    shift = _noise_shift(fitted) if problem.both else np.zeros_like(plain)
    robust = _robust(fitted, X, bread)
    doubt = DOUBT_OF_CORRECTION * shift
    whole = plain + shift
    size = np.abs(whole)
    size[: len(problem.names)] += [abs(problem.linearised(name)) for name in problem.names]
    floor = np.diag((FLOOR_SHARE * MODEL_FLOOR * size) ** 2)
    covariance, p = robust.covariance, plain.size
    covariance[:p, :p] += np.outer(doubt, doubt) + floor
    if not problem.both and not problem.rigid:
        covariance = ALONE_SPREAD**2 * covariance
        k = problem.names.index("K")
        covariance[k, k] += _form_doubt(fitted)
    if problem.both:
        whole, covariance = _unscaled(fitted, whole, covariance, stiffened)
    return Solved(whole, covariance[:p, :p], robust.degrees_of_freedom[:p])


def _width_tangents(fitted: Fitted) -> Array:
    """Derivatives of the rows by the logarithms of the widths of the friction's reversals, shape (r, k)."""
    problem, found = fitted.problem, [np.empty((fitted.y.size, 0))]
    for field, symbol in REVERSALS.items():
        if symbol in problem.names:
            width = float(getattr(problem.base, field))
            change = problem.sign_rows(field, (1.0 + WIDTH_STEP) * width) - problem.sign_rows(field, width)
            found.append((fitted.at_reversal(symbol, width) / WIDTH_STEP * change)[:, None])
    return np.hstack(found)


def _unscaled(
    fitted: Fitted, coefficients: Array, covariance: Array, stiffened: Array
) -> tuple[Array, Array]:
    """The load's parameters without the factor K0 / K of `Problem`, and K without the effects' stiffness.

    ``covariance`` holds the shapes behind the coefficients; by them the effects' stiffness changes by ``stiffened``.
    """
    problem = fitted.problem
    k, whole = problem.names.index("K"), problem.stiffness
    G, out = np.eye(covariance.shape[0]), coefficients.copy()
    G[k, coefficients.size : coefficients.size + stiffened.size] = -stiffened
    for name in SCALED:
        i = problem.names.index(name)
        G[i, i], G[i, k] = coefficients[k] / whole, coefficients[i] / whole
        out[i] *= G[i, i]
    for n, chosen in enumerate(fitted.chosen):
        if chosen.form.signature.fixed is None:
            G[k, fitted.columns(n)] = -fitted.slopes(n)
    out[k] -= fitted.stiffening
    covariance = G @ covariance @ G.T
    covariance[k, k] += _form_doubt(fitted)
    return out, covariance


def _form_doubt(fitted: Fitted) -> float:
    """Variance of K from forms of effects that another member of the same family could have in their place."""
    doubt = 0.0
    for n, c in enumerate(fitted.chosen):
        if share := c.form.signature.form_doubt:
            slopes = fitted.slopes(n) if fitted.problem.both else fitted.problem.slopes(c.terms)
            doubt += (share * float(fitted.amplitudes(n) @ slopes)) ** 2
    return doubt


def _bread(X: Array) -> Array:
    """Inverse of the normal matrix."""
    scale = np.linalg.norm(X, axis=0)
    scale[scale == 0.0] = 1.0
    return np.asarray(np.linalg.pinv((X / scale).T @ (X / scale)) / np.outer(scale, scale))


def _robust(fitted: Fitted, X: Array, bread: Array) -> RobustCovariance:
    """Covariance of the coefficients of columns, from the fit's residual; equations share their time."""
    scores = (
        (X * fitted.basis.residual[:, None]).reshape(fitted.problem.equations, -1, X.shape[1]).sum(axis=0)
    )
    return robust_covariance(scores, bread, [int(w.open.sum()) for w in fitted.problem.weights])


def _noise_shift(fitted: Fitted) -> Array:
    """What the noise in the columns has moved the coefficients by, taken back."""
    problem, size = fitted.problem, fitted.basis.coefficients.size
    p = len(problem.names)
    normal, right = np.zeros((size, size)), np.zeros(size)
    for seed in NOISE_SEEDS:
        target, columns = _noise_rows(problem, seed)
        normal[:p, :p] += columns.T @ columns / len(NOISE_SEEDS)
        right[:p] += columns.T @ (columns @ fitted.basis.coefficients[:p] - target) / len(NOISE_SEEDS)
    # (H - N) b = X'y - n with N, n the noise's part of X'X and X'y; with b = b0 + d: (H - N) d = N b0 - n.
    X = fitted.basis.columns
    scale = np.linalg.norm(X, axis=0)
    scale[scale == 0.0] = 1.0
    reduced = ((X / scale).T @ (X / scale)) - normal / np.outer(scale, scale)
    return np.asarray(np.linalg.lstsq(reduced, right / scale, rcond=1e-12)[0] / scale, dtype=np.float64)


def _noise_rows(problem: Problem, seed: int) -> tuple[Array, Array]:
    """Target and baseline columns of a record that holds nothing but the encoders' noise."""
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


def _values(fitted: Fitted) -> dict[str, float]:
    """The baseline's parameters as the fit gives them, by symbol."""
    problem, coefficients = fitted.problem, fitted.basis.coefficients
    values = {
        n: problem.linearised(n) + float(coefficients[k]) for k, n in enumerate(problem.names) if n != "c"
    }
    if problem.both:
        values |= {n: values[n] * values["K"] / problem.stiffness for n in SCALED}
        values["K"] -= fitted.stiffening
    return values


def base_estimates(
    fitted: Fitted,
    result: Solved,
    alternatives: Sequence[Fitted] = (),
    *,
    linear: bool,
    torque_unit: str,
    level: float,
) -> tuple[Estimate, ...]:
    """The baseline's parameters; their intervals hold those of the ``alternatives`` that explain as well."""
    problem = fitted.problem
    here, others = _values(fitted), [_values(f) for f in alternatives]
    out = []
    for parameter in BASE_PARAMETERS:
        if parameter.symbol not in problem.names:
            continue
        k = problem.names.index(parameter.symbol)
        value = float(result.coefficients[k])
        value += problem.linearised(parameter.symbol)
        away = max((abs(v[parameter.symbol] - here[parameter.symbol]) for v in others), default=0.0)
        stderr = float(np.hypot(np.sqrt(max(result.covariance[k, k], 0.0)), 0.5 * away))
        unit = unit_of(parameter.quantity, linear=linear, torque_unit=torque_unit)
        out.append(
            judge(
                _reported(parameter, problem),
                unit,
                value,
                stderr,
                float(result.degrees_of_freedom[k]),
                level=level,
                method=METHOD,
            )
        )
    return tuple(out)


def _reported(parameter: Parameter, problem: Problem) -> Parameter:
    """The parameter as the baseline knows it: one encoder shows hardly more than the sums of motor and load."""
    if problem.rigid:
        return RIGID.get(parameter.symbol, parameter)
    return replace(parameter, split=parameter.quantity in {"viscous", "torque"} and not problem.both)


def effect_estimates(
    fitted: Fitted, k: int, result: Solved, *, linear: bool, torque_unit: str, level: float
) -> tuple[Estimate, ...]:
    """Parameters of the k-th effect: amplitudes and shapes together, to first order about the solution."""
    chosen = fitted.chosen[k]
    form, base = chosen.form, fitted.problem.base
    amplitudes = fitted.amplitudes(k)
    values = form.signature.values(amplitudes, chosen.shape, base)
    spread = _value_spread(fitted, k)
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


def _value_spread(fitted: Fitted, k: int) -> dict[str, float]:
    """Standard errors of an effect's values: its tangent columns beside the whole model."""
    tangents, others = _tangents(fitted, k), fitted.basis.columns
    if fitted.chosen[k].form.signature.fixed is None:
        others = np.delete(others, fitted.columns(k), axis=1)
    X, count = np.hstack([others, tangents]), tangents.shape[1]
    covariance = _robust(fitted, X, _bread(X)).covariance[-count:, -count:]
    jacobian = _jacobian(fitted, k, np.sqrt(np.maximum(np.diag(covariance), 0.0)))
    return {name: float(np.sqrt(max(float(g @ covariance @ g), 0.0))) for name, g in jacobian.items()}


def _tangents(fitted: Fitted, k: int) -> Array:
    """Derivatives of an effect's rows by its free amplitudes and its shapes, shape (r, p)."""
    chosen = fitted.chosen[k]
    shapes, _ = _shape_tangents(fitted, k)
    if chosen.form.signature.fixed is not None:
        return shapes
    return np.hstack([fitted.search.rows(chosen.form, chosen.shape), shapes])


def _shape_tangents(fitted: Fitted, k: int) -> tuple[Array, Array]:
    """Derivatives of an effect's rows and of its stiffness by its shapes, shapes (r, j) and (j,)."""
    chosen, amplitudes, search = fitted.chosen[k], fitted.amplitudes(k), fitted.search
    rows, slopes = search.rows(chosen.form, chosen.shape), fitted.slopes(k)
    tangents, stiffened = [np.empty((rows.shape[0], 0))], []
    for j, value in enumerate(chosen.shape):
        step = SHAPE_STEP * (abs(value) or 1.0)
        moved = (*chosen.shape[:j], value + step, *chosen.shape[j + 1 :])
        tangents.append(((search.rows(chosen.form, moved) - rows) @ amplitudes / step)[:, None])
        stiffened.append(float((search.slopes(chosen.form, moved) - slopes) @ amplitudes / step))
    return np.hstack(tangents), np.array(stiffened)


def _jacobian(fitted: Fitted, k: int, errors: Array) -> dict[str, Array]:
    """Derivatives of each of an effect's values by its free amplitudes and its shapes, in steps of their errors."""
    chosen, amplitudes, base = fitted.chosen[k], fitted.amplitudes(k), fitted.problem.base
    signature = chosen.form.signature
    free = amplitudes.size if signature.fixed is None else 0

    def values(at: Array) -> dict[str, float]:
        return signature.values(at[:free] if free else amplitudes, tuple(at[free:].tolist()), base)

    here = np.concatenate([amplitudes[:free], chosen.shape])
    steps = np.maximum(np.maximum(1e-3 * errors, 1e-9 * np.abs(here)), 1e-300)
    centre, moved = values(here), [values(here + d) for d in np.diag(steps)]
    return {n: np.array([v[n] - c for v in moved]) / steps for n, c in centre.items()}
