"""One effect against the residual of what is in the model already: its shape is searched, not gridded."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexid_cli.diagnose.basis import Basis
from flexid_cli.diagnose.problem import Problem
from flexid_cli.effects.base import Effect
from flexid_cli.effects.motion import Shape
from flexid_cli.effects.signature import Scale, Signature

Array = NDArray[np.float64]

GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)
# How near a shape is found, in steps of its grid, and how many points are tried for it.
TRIED, REFINED = 0.01, 0.002  # for a candidate, and for an effect of the model
MOST_TRIED = 12
CLOSE = 20.0  # times the nearness: spread of the points of a parabola whose vertex is believed
PEAKS = 5  # of a search over cycles that are looked at exactly
NORMS = 16  # cycles at which a ripple's size in the rows is worked out
DEPENDENT = 1e-7  # a column with less than this share outside the model's is the model's
CACHED = 4000
# Range of K beside an effect, as a share of the stiffness of both together.
LEAST_SPRING, MOST_SPRING = 0.1, 10.0


@dataclass(frozen=True)
class Form:
    """One form of an effect, by which it enters the model."""

    effect: Effect
    index: int

    @property
    def signature(self) -> Signature:
        """Its columns and shapes."""
        return self.effect.signatures[self.index]

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.effect.name


@dataclass(frozen=True)
class Candidate:
    """A form of an effect with its best shape, against the residual of a model.

    Attributes
    ----------
    amplitudes : ndarray, shape (k,)
    before, cost : float
        Sum of squares of the residual without it and with it.
    rows : int
        Number of rows: the sum of squares of their noise.
    refused : str
        Why it cannot be the effect although it may fit.
    """

    form: Form
    shape: tuple[float, ...]
    amplitudes: Array
    before: float
    cost: float
    rows: int
    refused: str = ""

    @property
    def gain(self) -> float:
        """See `gained`."""
        return gained(self.before, self.cost, self.rows)

    @property
    def rank(self) -> tuple[bool, float]:
        """Order of candidates: possible ones first, then by what they leave."""
        return bool(self.refused), self.cost


class Search:
    """Searches in one linearisation; columns that were made once are kept.

    Parameters
    ----------
    problem : Problem
    forms : sequence of Form
        That this record could show.
    held : mapping of Form to ndarray, optional
        Stiffness of effects that another record's K holds, in place of this record's own.
    """

    def __init__(
        self, problem: Problem, forms: Sequence[Form], held: Mapping[Form, Array] | None = None
    ) -> None:
        self.problem, self.forms, self._held = problem, forms, held or {}
        self.scale: Scale = problem.scale()
        self.target = problem.target()
        self.base = problem.base_rows()
        self._rows: dict[tuple[Form, tuple[float, ...]], tuple[Array, Array]] = {}
        self._norms: dict[str, tuple[Array, Array]] = {}

    def rows(self, form: Form, shape: tuple[float, ...]) -> Array:
        """Whitened columns of a form for unit amplitudes."""
        return self._made(form, shape)[0]

    def slopes(self, form: Form, shape: tuple[float, ...]) -> Array:
        """Stiffness that a form has for unit amplitudes, shape (k,)."""
        return self._made(form, shape)[1]

    def _made(self, form: Form, shape: tuple[float, ...]) -> tuple[Array, Array]:
        key = (form, shape)
        found = self._rows.get(key)
        if found is None:
            found = self.problem.effect_rows(lambda m: form.signature.columns(m, shape), self._held.get(form))
            if len(self._rows) > CACHED:
                self._rows.clear()
            self._rows[key] = found
        return found

    def shapes(self, form: Form) -> Sequence[Shape] | None:
        """Shape parameters with their ranges; None where the record cannot show the form."""
        shapes = form.signature.shapes(self.scale)
        if shapes is None or any(not 0.0 < s.high - s.low < np.inf for s in shapes):
            return None
        return shapes

    def spread(self, form: Form, parts: Sequence[float]) -> list[tuple[float, ...]]:
        """Values of a form's only shape at these parts of its grid."""
        shapes = self.shapes(form)
        if not shapes or len(shapes) > 1:
            return []
        grid = shapes[0].grid()
        return [(float(grid[round(part * (grid.size - 1))]),) for part in parts]

    def evaluate(self, form: Form, shape: tuple[float, ...], now: Basis) -> Candidate:
        """Fit a form's amplitudes, or take the fixed one, at one shape."""
        C = self.rows(form, shape)
        before, signature, count = now.cost, form.signature, now.residual.size
        if signature.fixed is not None:
            e = now.residual - now.outside(C[:, 0] * signature.fixed)
            return Candidate(form, shape, np.array([signature.fixed]), before, float(e @ e), count)
        P = now.outside(C)
        norm = np.linalg.norm(P, axis=0)
        if not np.all(norm > DEPENDENT * np.maximum(np.linalg.norm(C, axis=0), 1e-300)):
            nothing, why = np.zeros(C.shape[1]), "its columns depend on the model's"
            return Candidate(form, shape, nothing, before, before, count, why)
        z, amplitudes = _explained(P / norm, now.residual)
        amplitudes = amplitudes / norm
        refused = self._refused(form, shape, amplitudes)
        cost = before if refused else max(before - float(z @ z), 0.0)
        if not refused and signature.tied is not None:
            refused = signature.tied(amplitudes, shape, self.problem.base)
        return Candidate(form, shape, amplitudes, before, cost, count, refused)

    def _refused(self, form: Form, shape: tuple[float, ...], amplitudes: Array) -> str:
        """Why amplitudes are out of the question, or nothing."""
        if np.any(form.signature.sign * amplitudes < 0.0):
            return "physics forbids the sign that the fit gives it"
        stiffening = float(amplitudes @ self.slopes(form, shape))
        if not LEAST_SPRING < 1.0 - stiffening / self.problem.stiffness < MOST_SPRING:
            return "it would take the spring's place"
        return ""

    def best(self, form: Form, now: Basis) -> Candidate | None:
        """Search a form's shape; None where the record cannot show it."""
        shapes = self.shapes(form)
        if shapes is None:
            return None
        points = self._ripples(form, shapes[0], now) if form.signature.ripple else _grid(shapes)
        best = min((self.evaluate(form, p, now) for p in points), key=lambda c: c.rank)
        return best if not shapes or best.refused else self.refine(best, now, TRIED)

    def extended(self, form: Form, plain: Candidate, now: Basis) -> Candidate:
        """A form that extends another one, searched about that one's best cycles and half of them.

        The overtone may be the stronger one of two waves.
        """
        points = [plain.shape, tuple(0.5 * n for n in plain.shape)]
        best = min((self.evaluate(form, p, now) for p in points), key=lambda c: c.rank)
        return best if best.refused else self.refine(best, now, TRIED)

    def _ripples(self, form: Form, shape: Shape, now: Basis) -> list[tuple[float, ...]]:
        """Cycles at which a ripple over the motor's angle would explain most, by one transform over all of them."""
        cycles = shape.grid()
        step = cycles[1] - cycles[0]
        score = np.zeros(cycles.size, dtype=np.complex128)
        weights = self.problem.back(now.residual, form.signature.ripple)
        for g, m in zip(weights, self.problem.motions, strict=True):
            turning = g * np.exp(1j * cycles[0] * m.motor_position)
            advance = np.exp(1j * step * m.motor_position)
            for k in range(cycles.size):
                score[k] += turning.sum()
                turning *= advance
        explained = np.abs(score) ** 2 / self._ripple_norm(form, cycles)
        peak = np.r_[True, explained[1:] > explained[:-1]] & np.r_[explained[:-1] >= explained[1:], True]
        order = np.argsort(np.where(peak, explained, -1.0))[::-1][:PEAKS]
        return [(float(cycles[k]),) for k in order]

    def _ripple_norm(self, form: Form, cycles: Array) -> Array:
        """Mean square of a ripple's rows, worked out at a few cycles: it changes slowly with them."""
        if form.name not in self._norms:
            some = np.linspace(cycles[0], cycles[-1], NORMS)
            norms = [float(np.mean(np.sum(self.rows(form, (float(n),)) ** 2, axis=0))) for n in some]
            self._norms[form.name] = some, np.asarray(norms)
        return np.maximum(np.interp(cycles, *self._norms[form.name]), 1e-300)

    def refine(self, best: Candidate, now: Basis, near: float = REFINED, reach: float = 1.0) -> Candidate:
        """Search along each shape parameter in turn, between the neighbours of the best point.

        ``reach`` is how far to look, in distances of the neighbours.
        """
        shapes = self.shapes(best.form)
        if not shapes:
            return best
        steps = [reach * _step(s) for s in shapes]
        for _ in range(2 if len(shapes) > 1 else 1):
            for k, s in enumerate(shapes):
                best = self._along(best, k, s, steps[k], now, near)
                steps[k] *= 0.3
        return best

    def _along(self, best: Candidate, k: int, s: Shape, step: float, now: Basis, near: float) -> Candidate:
        to, back = (np.log, np.exp) if s.spacing == "log" else (float, float)
        centre = float(to(best.shape[k]))
        low, high = max(centre - step, float(to(s.low))), min(centre + step, float(to(s.high)))
        found = [best]

        def cost(u: float) -> float:
            if u == centre:
                return best.cost
            value = _as_in_the_grid(float(back(u)), s)
            found.append(self.evaluate(best.form, (*best.shape[:k], value, *best.shape[k + 1 :]), now))
            return found[-1].cost

        minimum(cost, low, high, (low, centre, high), near * step, MOST_TRIED)
        return min(found, key=lambda c: c.rank)


def _explained(P: Array, residual: Array) -> tuple[Array, Array]:
    """Of a residual the part in the span of columns of norm one, in an orthonormal basis, and its coefficients."""
    if P.shape[1] == 1:
        z = P.T @ residual
        return z, z
    q, r = np.linalg.qr(P)
    z = q.T @ residual
    return z, np.linalg.lstsq(r, z, rcond=None)[0]


def gained(before: float, after: float, rows: int) -> float:
    """Logarithm of the sums of squares before over after, each with that of the noise.

    Whitened noise has one a row. What stays below the noise that the signals themselves show is no finding, however
    large its share of the residual.
    """
    return float(np.log((before + rows) / (after + rows)))


def minimum(
    cost: Callable[[float], float], low: float, high: float, first: Sequence[float], near: float, most: int
) -> tuple[float, float]:
    """Minimum of a function of one variable, and its place, by Brent's method.

    Parabolas through the three best points, and golden sections where these do not help: R. P. Brent, "Algorithms
    for minimization without derivatives", Prentice-Hall, 1973, chapter 5.

    Parameters
    ----------
    cost : callable
    low, high : float
        Bounds of the place.
    first : sequence of float
        Places within the bounds to begin with.
    near : float
        Step that is too short to be made.
    most : int
        Points that are tried after the first ones.

    Returns
    -------
    place, cost : float
        Of the best point that was tried.
    """
    points = sorted((cost(u), u) for u in sorted(set(first)))
    x = points[0][1]
    a, b = (
        max((u for _, u in points if u < x), default=low),
        min((u for _, u in points if u > x), default=high),
    )
    last = before = b - a
    for _ in range(most):
        fx, x = points[0]
        step = _to_vertex(points)
        if not a < x + step < b or abs(step) > 0.5 * before:
            step = (1.0 - GOLDEN) * (b - x if b - x > x - a else a - x)
        spread = max(u for _, u in points[:3]) - min(u for _, u in points[:3])
        if abs(step) < near:
            if spread < CLOSE * near:
                break
            # A parabola through points far apart may be wrong about it.
            step = np.copysign(min(0.2 * spread, 0.5 * (b - x if step > 0.0 else x - a)), step)
        u = x + step
        fu = cost(u)
        better, worse = (u, x) if fu < fx else (x, u)
        a, b = (worse, b) if worse < better else (a, worse)
        points = sorted([*points, (fu, u)])
        before, last = last, abs(step)
    return points[0][1], points[0][0]


def _to_vertex(points: Sequence[tuple[float, float]]) -> float:
    """From the best of the points to the vertex of the parabola through the best three; infinite where none is."""
    if len(points) < 3:
        return np.inf
    (f0, x0), (f1, x1), (f2, x2) = points[:3]
    slope, other = (f1 - f0) / (x1 - x0), (f2 - f0) / (x2 - x0)
    curvature = (slope - other) / (x1 - x2)
    return 0.5 * (x1 - x0 - slope / curvature) if curvature > 0.0 else np.inf


def _as_in_the_grid(value: float, s: Shape) -> float:
    """The grid's own number for a value that rounding sets apart from it: its columns are there already."""
    grid = s.grid()
    nearest = float(grid[np.argmin(np.abs(grid - value))])
    return nearest if abs(nearest - value) < 1e-9 * abs(value) else value


def _grid(shapes: Sequence[Shape]) -> list[tuple[float, ...]]:
    points: list[tuple[float, ...]] = [()]
    for s in shapes:
        values = s.grid() if s.points > 1 else np.array([0.5 * (s.low + s.high)])
        points = [(*p, float(v)) for p in points for v in values]
    return points


def _step(s: Shape) -> float:
    span = float(np.log(s.high / s.low)) if s.spacing == "log" else s.high - s.low
    return 0.5 * span if s.points < 2 else span / (s.points - 1)
