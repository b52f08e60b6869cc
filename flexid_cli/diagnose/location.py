"""Where a residual lives: how much of it a free function of each variable would explain, in each equation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexid_cli.diagnose.basis import Basis
from flexid_cli.diagnose.fitter import Fitted
from flexid_cli.diagnose.problem import Problem
from flexid_cli.diagnose.result import Shape, Where
from flexid_cli.effects.motion import Motion, Terms
from flexid_cli.signals.recording import Recording

Array = NDArray[np.float64]

KNOTS = 10


@dataclass(frozen=True)
class Map:
    """A free function of one variable in one equation, fitted to the residual.

    Attributes
    ----------
    equation, variable : str
    gain : float
        Logarithm of the residual's sum of squares before over after.
    knots, values, errors : ndarray, shape (knots,)
        The function at its knots (amplitude of a frequency) and its standard errors.
    plain : bool
        The function is a torque; else a factor of another quantity.
    """

    equation: str
    variable: str
    gain: float
    knots: Array
    values: Array
    errors: Array
    plain: bool


def hats(x: Array, knots: Array) -> Array:
    """Linear B-splines of ``x`` at the knots, shape (n, knots)."""
    clipped = np.clip(x, knots[0], knots[-1])
    k = np.clip(np.searchsorted(knots, clipped, side="right") - 1, 0, knots.size - 2)
    share = (clipped - knots[k]) / (knots[k + 1] - knots[k])
    out = np.zeros((x.size, knots.size))
    rows = np.arange(x.size)
    out[rows, k] = 1.0 - share
    out[rows, k + 1] += share
    return out


def _TORQUE(m: Motion, equation: str) -> Array:
    return m.torque


# variable -> (its value, what the function multiplies)
VARIABLES: dict[str, tuple[Callable[[Motion, str], Array], Callable[[Motion, str], Array | float]]] = {
    "velocity": (lambda m, e: _v(m, e), lambda m, e: 1.0),
    "position": (lambda m, e: _q(m, e), lambda m, e: 1.0),
    "position_times_sign": (
        lambda m, e: _q(m, e),
        lambda m, e: m.motor_sign if e == "motor" else m.joint_sign,
    ),
    "position_times_acceleration": (lambda m, e: _q(m, e), lambda m, e: m.joint_acceleration),
    "position_times_torsion": (lambda m, e: _q(m, e), lambda m, e: m.base.K * m.deflection),
    "torsion": (lambda m, e: m.deflection, lambda m, e: m.base.K * m.deflection),
    "load_times_sign": (
        lambda m, e: np.abs(m.deflection),
        lambda m, e: m.motor_sign if e == "motor" else m.joint_sign,
    ),
    "torque": (lambda m, e: m.torque, _TORQUE),
    "time": (lambda m, e: m.time_s, lambda m, e: 1.0),
    "time_times_sign": (lambda m, e: m.time_s, lambda m, e: m.motor_sign if e == "motor" else m.joint_sign),
    "time_times_velocity": (lambda m, e: m.time_s, lambda m, e: _v(m, e)),
    "time_times_acceleration": (lambda m, e: m.time_s, lambda m, e: m.joint_acceleration),
    "time_times_torsion": (lambda m, e: m.time_s, lambda m, e: m.base.K * m.deflection),
    "time_times_torque": (lambda m, e: m.time_s, _TORQUE),
}
EQUATIONS = {
    "motor": (
        "velocity",
        "position",
        "position_times_sign",
        "torque",
        "load_times_sign",
        "time",
        "time_times_sign",
        "time_times_velocity",
        "time_times_torque",
    ),
    "transmission": ("torsion", "position", "position_times_torsion", "time_times_torsion"),
    "load": (
        "velocity",
        "position",
        "position_times_sign",
        "position_times_acceleration",
        "load_times_sign",
        "time",
        "time_times_sign",
        "time_times_velocity",
        "time_times_acceleration",
    ),
}


def _v(m: Motion, equation: str) -> Array:
    return m.motor_velocity if equation == "motor" else m.joint_velocity


def _q(m: Motion, equation: str) -> Array:
    return m.motor_position if equation != "load" else m.joint_position


def residual_maps(problem: Problem, now: Basis) -> list[Map]:
    """Maps of the residual in every equation and variable, largest gain first."""
    found = [
        _map(problem, now, equation, variable) for equation, names in EQUATIONS.items() for variable in names
    ]
    found += list(_lines(problem, now))
    return sorted(found, key=lambda m: -m.gain)


def _map(problem: Problem, now: Basis, equation: str, variable: str) -> Map:
    value, factor = VARIABLES[variable]
    x = np.concatenate([value(m, equation) for m in problem.motions])
    knots = _knots(x, variable)

    def terms(m: Motion) -> Terms:
        columns = hats(value(m, equation), knots) * np.reshape(factor(m, equation), (-1, 1))
        return Terms(**{equation: columns})

    C = problem.effect_rows(terms)
    if factor is _TORQUE:
        # The torque is what is explained: only how its factor varies is free, not the factor itself.
        weight = hats(x, knots).mean(axis=0)
        C = C - np.outer(C.sum(axis=1), weight)
    gain, values, errors = _explained(C, now)
    return Map(
        equation,
        variable,
        gain,
        knots,
        values,
        errors,
        "_times_" not in variable and variable not in {"torsion", "torque"},
    )


def _knots(x: Array, variable: str) -> Array:
    if variable == "velocity":
        # Dense about zero, where friction changes.
        top = np.quantile(np.abs(x), 0.995)
        half = top * np.array([0.01, 0.04, 0.1, 0.25, 0.5, 1.0])
        return np.concatenate([-half[::-1], half])
    low, high = np.quantile(x, [0.002, 0.998])
    return np.linspace(low, high, KNOTS)


def _explained(C: Array, now: Basis) -> tuple[float, Array, Array]:
    P = C - now.Q @ (now.Q.T @ C)
    size = np.linalg.norm(C, axis=0)
    size[size == 0.0] = 1.0
    U, s, Vt = np.linalg.svd(P / size, full_matrices=False)
    keep = s > 1e-4 * max(s[0], 1e-300)
    z = U[:, keep].T @ now.residual
    values = (Vt[keep].T @ (z / s[keep])) / size
    errors = now.rms * np.linalg.norm(Vt[keep].T / s[keep], axis=1) / size
    return float(np.log(now.cost / max(now.cost - float(z @ z), 1e-300))), values, errors


def _lines(problem: Problem, now: Basis) -> Iterator[Map]:
    """The strongest line of fixed frequency in each equation."""
    for equation in ("motor", "load") if problem.both else ("motor",):
        yield _line(problem, now, equation)


def _line(problem: Problem, now: Basis, equation: str) -> Map:
    k = 0 if equation == "motor" or not problem.both else 1
    rows = problem.row_times.size
    e = now.residual.reshape(-1, rows)[k]
    t = problem.row_times
    grid = np.arange(0.2, 0.95 * problem.band_hz, 0.4 / max(t[-1] - t[0], 1.0))
    # Rows come at twice the band: uniform within a stretch.
    power = np.abs(_transform(e, t, grid)) ** 2
    best = float(grid[int(np.argmax(power))])

    def terms(m: Motion) -> Terms:
        w = 2.0 * np.pi * best * m.time_s
        return Terms(**{equation: np.column_stack([np.cos(w), np.sin(w)])})

    gain, values, errors = _explained(problem.effect_rows(terms), now)
    size = np.array([float(np.hypot(*values))])
    return Map(equation, "frequency", gain, np.array([best]), size, errors[:1], True)


def _transform(e: Array, t: Array, grid: Array) -> Array:
    out = np.zeros(grid.size, dtype=np.complex128)
    for k in range(0, grid.size, 64):
        out[k : k + 64] = np.exp(-2j * np.pi * np.outer(grid[k : k + 64], t)) @ e
    return out


def located(fitted: Fitted, found: Map, recording: Recording) -> Where:
    """Place of a mismatch: equation, variable, and its shape there with 95 % bands."""
    shape = None
    if found.knots.size > 1:
        half = 1.96 * found.errors
        unit = recording.torque_unit if found.plain else "1"
        shape = Shape(
            found.knots,
            found.values,
            found.values - half,
            found.values + half,
            _unit(found.variable, recording),
            unit,
        )
    frequency = (float(found.knots[0]), float(found.knots[0])) if found.variable == "frequency" else None
    return Where(found.equation, found.variable, None, frequency, shape)


def _unit(variable: str, recording: Recording) -> str:
    length = "m" if recording.linear else "rad"
    first = variable.split("_times_", maxsplit=1)[0]
    return {"velocity": f"{length}/s", "time": "s", "torque": recording.torque_unit}.get(first, length)
