"""Where a residual lives: how much of it a free function of each variable would explain, in each equation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexid_cli.diagnose.bands import correlated_rows, spread
from flexid_cli.diagnose.basis import Basis
from flexid_cli.diagnose.problem import Problem
from flexid_cli.diagnose.result import Shape, Where
from flexid_cli.diagnose.search import gained
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


def _velocity(m: Motion, equation: str) -> Array:
    return m.motor_velocity if equation == "motor" else m.joint_velocity


def _position(m: Motion, equation: str) -> Array:
    return m.motor_position if equation != "load" else m.joint_position


def _sign(m: Motion, equation: str) -> Array:
    return m.motor_sign if equation == "motor" else m.joint_sign


def _acceleration(m: Motion, _: str) -> Array:
    return m.joint_acceleration


def _torsion(m: Motion, _: str) -> Array:
    return m.deflection


def _load_size(m: Motion, _: str) -> Array:
    return np.abs(m.deflection)


def _spring_torque(m: Motion, _: str) -> Array:
    return m.base.K * m.deflection


def _torque(m: Motion, _: str) -> Array:
    return m.torque


def _time(m: Motion, _: str) -> Array:
    return m.time_s


def _one(m: Motion, _: str) -> Array:
    return np.ones(m.time_s.size)


Quantity = Callable[[Motion, str], Array]
# variable -> (its value, what the function of it multiplies)
VARIABLES: dict[str, tuple[Quantity, Quantity]] = {
    "velocity": (_velocity, _one),
    "position": (_position, _one),
    "position_times_sign": (_position, _sign),
    "position_times_acceleration": (_position, _acceleration),
    "position_times_torsion": (_position, _spring_torque),
    "torsion": (_torsion, _spring_torque),
    "load_times_sign": (_load_size, _sign),
    "torque": (_torque, _torque),
    "time": (_time, _one),
    "time_times_sign": (_time, _sign),
    "time_times_velocity": (_time, _velocity),
    "time_times_acceleration": (_time, _acceleration),
    "time_times_torsion": (_time, _spring_torque),
    "time_times_torque": (_time, _torque),
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
    C = _columns(problem, equation, variable, knots)
    gain, values, errors = _explained(C, now)
    return Map(equation, variable, gain, knots, values, errors, plain=factor is _one)


def _columns(problem: Problem, equation: str, variable: str, knots: Array) -> Array:
    """Rows of the free function's columns, shape (r, knots)."""
    value, factor = VARIABLES[variable]

    def terms(m: Motion) -> Terms:
        return Terms(**{equation: hats(value(m, equation), knots) * factor(m, equation)[:, None]})

    C, _ = problem.effect_rows(terms)
    if factor is _torque:
        # The torque is what is explained: only how its factor varies is free, not the factor itself.
        x = np.concatenate([value(m, equation) for m in problem.motions])
        C = C - np.outer(C.sum(axis=1), hats(x, knots).mean(axis=0))
    return C


def _knots(x: Array, variable: str) -> Array:
    if variable == "velocity":
        # Dense about zero, where friction changes.
        top = np.quantile(np.abs(x), 0.995)
        half = top * np.array([0.01, 0.04, 0.1, 0.25, 0.5, 1.0])
        return np.concatenate([-half[::-1], half])
    low, high = np.quantile(x, [0.002, 0.998])
    return np.linspace(low, high, KNOTS)


def _explained(C: Array, now: Basis) -> tuple[float, Array, Array]:
    U, heights = _solved(C, now)
    z = U.T @ now.residual
    errors = now.rms * np.linalg.norm(heights, axis=1)
    return gained(now.cost, now.cost - float(z @ z), now.residual.size), heights @ z, errors


def _solved(C: Array, now: Basis) -> tuple[Array, Array]:
    """Orthonormal basis U of columns outside the model's, and what turns U' e into their coefficients."""
    P = C - now.Q @ (now.Q.T @ C)
    size = np.linalg.norm(C, axis=0)
    size[size == 0.0] = 1.0
    U, s, Vt = np.linalg.svd(P / size, full_matrices=False)
    keep = s > 1e-4 * max(s[0], 1e-300)
    return U[:, keep], Vt[keep].T / s[keep] / size[:, None]


def _half_width(problem: Problem, now: Basis, found: Map) -> Array:
    """Half width of the 95 % band of a map's function, by the block bootstrap."""
    U, heights = _solved(_columns(problem, found.equation, found.variable, found.knots), now)
    left = now.residual - U @ (U.T @ now.residual)
    rows, lengths = problem.row_times.size, [w.seconds.size for w in problem.weights]
    # What each instant adds to each height, equations added.
    parts = (left[:, None] * (U @ heights.T)).reshape(-1, rows, found.knots.size).sum(axis=0)
    block = max(correlated_rows(e, lengths) for e in left.reshape(-1, rows))
    return spread(parts, lengths, block).half_width()


def _lines(problem: Problem, now: Basis) -> Iterator[Map]:
    """The strongest line of fixed frequency in each equation."""
    for equation in ("motor", "load") if problem.both else ("motor",):
        yield _line(problem, now, equation)


def _line(problem: Problem, now: Basis, equation: str) -> Map:
    k = 0 if equation == "motor" or not problem.both else 1
    rows = problem.row_times.size
    e = now.residual.reshape(-1, rows)[k]
    span = float(np.ptp(problem.row_times))
    grid = np.arange(0.2, 0.95 * problem.band_hz, 0.4 / max(span, 1.0))
    best = float(grid[int(np.argmax(np.abs(_transform(problem, e, grid))))])

    def terms(m: Motion) -> Terms:
        w = 2.0 * np.pi * best * m.time_s
        return Terms(**{equation: np.column_stack([np.cos(w), np.sin(w)])})

    gain, values, errors = _explained(problem.effect_rows(terms)[0], now)
    size = np.array([float(np.hypot(*values))])
    return Map(equation, "frequency", gain, np.array([best]), size, errors[:1], True)


def _transform(problem: Problem, e: Array, grid: Array) -> NDArray[np.complex128]:
    """Fourier sums of the rows ``e`` of one equation at a uniform grid of frequencies."""
    out, first = np.zeros(grid.size, dtype=np.complex128), 0
    for s, w in zip(problem.stretches, problem.weights, strict=True):
        # Rows are uniform within a stretch.
        count, step = w.seconds.size, float(w.seconds[1] - w.seconds[0])
        sums = chirp_transform(
            e[first : first + count], step * grid[0], step * (grid[1] - grid[0]), grid.size
        )
        out += sums * np.exp(-2j * np.pi * grid * (s.start_s + w.seconds[0]))
        first += count
    return out


def chirp_transform(x: Array, first: float, step: float, count: int) -> NDArray[np.complex128]:
    """Fourier sums of ``x`` at ``count`` frequencies from ``first`` on, in cycles a sample.

    Bluestein's chirp z-transform: 2 n k = n^2 + k^2 - (k - n)^2 makes a convolution of it.
    """
    from scipy.fft import fft, ifft, next_fast_len

    n, k = np.arange(x.size), np.arange(count)
    size = next_fast_len(x.size + count - 1)

    def chirp(at: NDArray[np.int64]) -> NDArray[np.complex128]:
        return np.asarray(np.exp(-1j * np.pi * step * at.astype(np.float64) ** 2))

    kernel = np.conj(chirp(np.arange(1 - x.size, count)))
    sums = ifft(fft(x * np.exp(-2j * np.pi * first * n) * chirp(n), size) * fft(kernel, size))
    return np.asarray(chirp(k) * sums[x.size - 1 : x.size - 1 + count])


def located(found: Map, problem: Problem, now: Basis, recording: Recording) -> Where:
    """Place of a mismatch: equation, variable, and its shape there with 95 % bands of the block bootstrap."""
    shape = None
    if found.knots.size > 1:
        half = _half_width(problem, now, found)
        unit = recording.torque_unit if found.plain else "1"
        shape = Shape(
            found.knots,
            found.values,
            found.values - half,
            found.values + half,
            unit_of_variable(found.variable, recording),
            unit,
        )
    frequency = (float(found.knots[0]), float(found.knots[0])) if found.variable == "frequency" else None
    return Where(found.equation, found.variable, None, frequency, shape)


def unit_of_variable(variable: str, recording: Recording) -> str:
    """Unit of the variable of a map."""
    length = "m" if recording.linear else "rad"
    first = variable.split("_times_", maxsplit=1)[0]
    return {"velocity": f"{length}/s", "time": "s", "torque": recording.torque_unit}.get(first, length)
