"""Fits of the motor alone by simulation: the load is led by the measured motor motion, effects and all.

Eq. (18) is linear in the parameters only nearby, and the joint's motion that its columns need is rebuilt from the
torque, noise and all. A simulation that the measured motor leads needs neither: the torque that it asks for is
compared with the recorded one, in the rows of the problem (weighted, 1 + X2 s + X1 s^2, so that free oscillations of
the load leave nothing). Levenberg-Marquardt steps from where the linear fit ended, derivatives by differences.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flexid_cli.diagnose.basis import Basis
from flexid_cli.diagnose.fitter import Chosen, Fitted, Fitter
from flexid_cli.diagnose.instants import own_instant
from flexid_cli.diagnose.problem import ALONE_NAMES, Problem
from flexid_cli.diagnose.reversals import motor_sharpened
from flexid_cli.diagnose.rows import Complex
from flexid_cli.diagnose.stretch import MOTOR_SIGN_BAND, Stretch, later
from flexid_cli.diagnose.trust import trusted
from flexid_cli.effects.base import EffectValues, Stage
from flexid_cli.effects.motion import Base, Motion
from flexid_cli.errors import FlexidError
from flexid_cli.pipeline.columns import reversal
from flexid_cli.simulate.machine import Trajectory
from flexid_cli.threads import side_by_side

Array = NDArray[np.float64]

STEPS, TRIALS, START_STEPS = 8, 4, 2
LINEAR = 3  # Jm, FVm, FSm come first: the torque is linear in them
SETTLED = 2e-4  # change of the cost's logarithm
DAMPING, CALMER, BOLDER = 1e-3, 10.0, 0.1  # of the first step; its factors after a bad and after a good one
DIFFERENCE = 0.3  # standard errors
FIRST_DIFFERENCE, WIDTH_DIFFERENCE = 1e-3, 0.05  # of the parameter; of a width's logarithm
LEAST_DIFFERENCE, MOST_DIFFERENCE = 1e-5, 1e-2  # of the parameter
# A jump of a shape (share of it; of a width's logarithm five times that), where more than noise is left.
JUMPS = (-0.15, -0.08, -0.04, 0.04, 0.08, 0.15)
MOST_JUMPS, ABOVE_NOISE, WORTH_A_JUMP = 2, 1.15, 0.97
MOST_CHANGE = 0.3  # of a parameter in one step; of a width's logarithm twice that
SMALL_SHAPE = 0.05  # of a shape's range: what counts as its size where it is smaller
WIDTHS = ("motor_reversal", "load_reversal")
FRICTION = ("FVm", "FSm", "FV", "FS")
TOLERANCE = 1e-8  # of the simulation's steps


@dataclass(frozen=True)
class Point:
    """Baseline and effects at which to simulate; the load's torsion and velocity at the start, by stretch."""

    base: Base
    amplitudes: tuple[Array, ...]
    chosen: tuple[Chosen, ...]
    starts: Array

    @classmethod
    def of(cls, fitted: Fitted) -> Point:
        """Where a fit ended."""
        if isinstance(fitted, LedFit):
            return fitted.point
        names, problem = fitted.problem.names, fitted.problem
        coefficients = fitted.basis.coefficients[: len(names)]
        values = {n: problem.linearised(n) + float(c) for n, c in zip(names, coefficients, strict=True)}
        values |= {n: max(values[n], 0.0) for n in FRICTION}
        amplitudes = tuple(fitted.amplitudes(k) for k in range(len(fitted.chosen)))
        return cls(replace(problem.base, **values), amplitudes, fitted.chosen, starts(problem))

    def vector(self) -> Array:
        """Names, then free amplitudes and shapes effect by effect, the starts, and the logarithms of the widths."""
        parts = [np.array([getattr(self.base, n) for n in ALONE_NAMES])]
        for c, a in zip(self.chosen, self.amplitudes, strict=True):
            parts += [a if c.form.signature.fixed is None else np.empty(0), np.array(c.shape)]
        parts.append(self.starts)
        parts.append(np.log([getattr(self.base, n) for n in WIDTHS]))
        return np.concatenate(parts)

    def at(self, x: Array) -> Point:
        """The same model at another vector."""
        base = replace(
            self.base,
            **dict(zip(ALONE_NAMES, (float(v) for v in x), strict=False)),
            **dict(zip(WIDTHS, (float(np.exp(v)) for v in x[-2:]), strict=True)),
        )
        i, amplitudes, chosen = len(ALONE_NAMES), [], []
        for c, a in zip(self.chosen, self.amplitudes, strict=True):
            free = a.size if c.form.signature.fixed is None else 0
            amplitudes.append(x[i : i + free] if free else a)
            i += free
            chosen.append(Chosen(c.form, tuple(float(v) for v in x[i : i + len(c.shape)])))
            i += len(c.shape)
        return Point(base, tuple(amplitudes), tuple(chosen), x[i:-2])

    def with_chosen(self, k: int, other: Chosen) -> Point:
        """The same model with another shape of the k-th effect."""
        return replace(self, chosen=(*self.chosen[:k], other, *self.chosen[k + 1 :]))

    def shapes(self) -> list[int]:
        """Places of the effects' shapes in the vector."""
        i = len(ALONE_NAMES)
        places: list[int] = []
        for c, a in zip(self.chosen, self.amplitudes, strict=True):
            i += a.size if c.form.signature.fixed is None else 0
            places += range(i, i + len(c.shape))
            i += len(c.shape)
        return places

    def effects(self) -> list[EffectValues]:
        """Effects of the mechanics, for the simulation."""
        return [
            EffectValues(c.name, c.form.signature.values(a, c.shape, self.base))
            for c, a in zip(self.chosen, self.amplitudes, strict=True)
            if not _is_signal(c)
        ]


def starts(problem: Problem) -> Array:
    """Torsion and velocity of the load at the start of each stretch, as far as they can be told before a fit."""
    found = [
        (m.deflection[0], s.motor_velocity[0])
        for s, m in zip(problem.stretches, problem.motions, strict=True)
    ]
    return np.array(found, dtype=np.float64).ravel()


def _is_signal(c: Chosen) -> bool:
    """Whether an effect changes the recorded signals rather than the mechanics."""
    stages = {law.stage for law in c.form.effect.laws}
    return max(stages) <= Stage.LAG or stages == {Stage.MEASUREMENT}


def residual(problem: Problem, point: Point) -> Array | None:
    """Rows of what the recorded torque is beyond the simulated one; None where nothing can be simulated."""
    found = _simulated(problem, point)
    return None if found is None else _rows(problem, point, found)


def _simulated(problem: Problem, point: Point) -> list[Trajectory] | None:
    """What the axis does behind the measured motor, and the torque that this takes, by stretch."""
    runs = _led(problem, point)
    if runs is None:
        return None
    each = zip(problem.stretches, problem.motions, runs, strict=True)
    return [_reversed(s, m, point, run) for s, m, run in each]


def _led(problem: Problem, point: Point) -> list[Trajectory] | None:
    """The same with the motor's velocity as its position shows it."""
    from flexid_cli.simulate.engine import simulate_motor_driven
    from flexid_cli.simulate.machine import Axis, InitialState, Solver

    b = point.base
    try:
        axis = Axis(
            Jm=b.Jm, K=b.K, JL=b.JL, FVm=b.FVm, FSm=b.FSm, FV=b.FV, FS=b.FS, MX=0.0, MY=0.0, gravity=problem.gravity,
            reversal_velocity=b.motor_reversal, load_reversal_velocity=b.load_reversal,
        )  # fmt: skip
        effects, solver = point.effects(), Solver(tolerance=TOLERANCE)
        return [
            simulate_motor_driven(
                axis,
                path,
                problem.stretches[0].rate_hz,
                effects=effects,
                initial=InitialState(float(path[0]), float(path[0]) - torsion, 0.0, velocity),
                solver=solver,
            )
            for path, (torsion, velocity) in zip(
                _paths(problem, point), point.starts.reshape(-1, 2).tolist(), strict=True
            )
        ]
    except (FlexidError, ZeroDivisionError):
        return None


def _reversed(s: Stretch, m: Motion, point: Point, run: Trajectory) -> Trajectory:
    """The simulation with the motor's friction by the sharper velocity, about its reversals."""
    if s.sharpener is None:
        return run
    b = point.base
    sharp = replace(m, base=b, motor_velocity=s.motor_sharp, motor_sign=s.motor_sign(b.motor_reversal))
    plain = replace(
        m,
        base=b,
        motor_velocity=run.motor_velocity,
        motor_sign=reversal(run.motor_velocity, b.motor_reversal),
    )
    torque = run.torque + b.FSm * (sharp.motor_sign - plain.motor_sign)
    for c, a in zip(point.chosen, point.amplitudes, strict=True):
        if _is_signal(c):
            continue
        there, here = (c.terms(x).motor for x in (sharp, plain))
        if there is not None and here is not None:
            torque = torque + (there - here) @ a
    return replace(run, torque=torque)


def _informed(problem: Problem, fitted: Fitted, point: Point) -> Problem:
    """The record with reversals and weights of rows that know of a model and of where it leads the load."""
    runs = _led(problem, point)
    if runs is None:
        return problem
    b = point.base
    friction = fitted.at_reversal("FSm", b.motor_reversal)
    held = []
    for s, m, run in zip(problem.stretches, problem.motions, runs, strict=True):
        v = run.motor_velocity
        own = b.Jm * run.motor_acceleration + b.FVm * v + friction * reversal(v, b.motor_reversal)
        held.append(own + b.K * run.true_motor_position - run.torque - _lost(s, m, point))
    return trusted(motor_sharpened(problem.at(b), held, friction))


def _paths(problem: Problem, point: Point) -> list[Array]:
    """The motor's motion, without what effects of measurement make of it."""
    return [
        s.lowpass(_true_motor(problem, s, m, point), MOTOR_SIGN_BAND)
        for s, m in zip(problem.stretches, problem.motions, strict=True)
    ]


def _true_motor(problem: Problem, s: Stretch, m: Motion, point: Point) -> Array:
    motor = s.motor
    for c, a in zip(point.chosen, point.amplitudes, strict=True):
        signature = c.form.signature
        if signature.corrected is not None and signature.corrects == "motor":
            motor = signature.corrected(motor, a, s.derivative, problem.gear_ratio)
        elif _is_signal(c) and (error := c.terms(m).motor_error) is not None:
            motor = motor - error @ a
    return motor


def _rows(problem: Problem, point: Point, runs: Sequence[Trajectory]) -> Array | None:
    """Rows of recorded less simulated torque."""
    parts = []
    for s, m, run in zip(problem.stretches, problem.motions, runs, strict=True):
        torque = s.torque - _lost(s, m, point)
        recorded = later(s, s.spectrum(problem.through(s, torque)), problem.shift)
        parts.append(recorded - s.spectrum(problem.through(s, run.torque)))
    e = _weighted(problem, parts)[:, 0]
    return e if np.all(np.isfinite(e)) else None


def _lost(s: Stretch, m: Motion, point: Point) -> Array:
    """Torque that effects of measurement add to the recorded one."""
    lost = np.zeros(s.torque.size)
    for c, a in zip(point.chosen, point.amplitudes, strict=True):
        added = c.terms(m).motor if _is_signal(c) else None
        lost = lost if added is None else lost + added @ a
    return lost


def _weighted(problem: Problem, parts: Sequence[Complex]) -> Array:
    rows = [w.apply([part])[0] for part, w in zip(parts, problem.weights, strict=True)]
    return np.concatenate(rows)


def _motor_columns(problem: Problem, point: Point, runs: Sequence[Trajectory]) -> Array:
    """Derivatives of the rows by Jm, FVm and FSm, in which the torque is linear: shape (r, 3)."""
    width, parts = point.base.motor_reversal, []
    for s, run in zip(problem.stretches, runs, strict=True):
        v = run.motor_velocity
        sign = reversal(v, width) if s.sharpener is None else s.motor_sign(width)
        columns = (run.motor_acceleration, v, sign)
        parts.append(s.spectrum(np.column_stack([problem.through(s, x) for x in columns])))
    return _weighted(problem, parts)


@dataclass(frozen=True)
class LedFit(Fitted):
    """A fit by simulation: ``basis`` is linear about its ``point``."""

    point: Point

    @property
    def is_noise(self) -> bool:
        """Whether what it leaves is about the noise."""
        return self.cost < ABOVE_NOISE * self.y.size


@dataclass(frozen=True)
class _Limits:
    """Range of each element of the vector, and the longest step."""

    low: Array
    high: Array
    most: Array

    @classmethod
    def of(cls, fitted: Fitted, x: Array) -> _Limits:
        low, high, most = np.full(x.size, -np.inf), np.full(x.size, np.inf), np.full(x.size, np.inf)
        # The rows hardly feel how the load starts: noise would throw it anywhere.
        own = _start_steps(fitted.problem) / FIRST_DIFFERENCE
        most[-2 - own.size : -2] = MOST_CHANGE * own
        for k, n in enumerate(ALONE_NAMES):
            low[k] = 0.0 if n in FRICTION else 0.05 * x[k]
        i = len(ALONE_NAMES)
        for k, c in enumerate(fitted.chosen):
            if c.form.signature.fixed is None:
                size = fitted.amplitudes(k).size
                if c.form.signature.sign > 0:
                    low[i : i + size] = 0.0
                i += size
            for shape in fitted.search.shapes(c.form) or ():
                low[i], high[i] = shape.low, shape.high
                most[i] = MOST_CHANGE * max(abs(x[i]), SMALL_SHAPE * (shape.high - shape.low))
                i += 1
        low[-2:] = np.log(1e-6)
        return cls(np.minimum(low, x), np.maximum(high, x), most)


def predicted(problem: Problem, fitted: LedFit) -> Array | None:
    """Rows of another record that its parameters do not predict; None where they cannot be simulated there.

    A load that sticks and slips soon goes its own way in a simulation, however right the parameters are. The joint's
    motion that the torque shows does not: of the two the one that leaves less.
    """
    here = problem.at(fitted.problem.base, shift=fitted.problem.shift)
    point = _with_own_instants(here, replace(fitted.point, starts=starts(here)))
    here = _informed(here, fitted, point)
    simulated = _started(here, point)
    if simulated is None:
        return None
    shown = (_unexplained(here.at(point.base, led=led), point) for led in (False, True))
    return min((simulated, *shown), key=lambda e: float(e @ e))


def _with_own_instants(problem: Problem, point: Point) -> Point:
    """The model with the events where the joint's motion that another record shows has them."""
    for k, c in enumerate(point.chosen):
        if c.form.signature.event:
            moved = []
            for led in (False, True):
                here = problem.at(point.base, led=led)
                left = _unexplained(here, point) + here.effect_rows(c.terms)[0] @ point.amplitudes[k]
                other = point.with_chosen(k, own_instant(here, c, point.amplitudes[k], left))
                moved.append((float(np.sum(_unexplained(here, other) ** 2)), other))
            _, point = min(moved, key=lambda m: m[0])
    return point


def _started(problem: Problem, point: Point) -> Array | None:
    """Simulated rows of a record; how the load starts there is no parameter of the axis, and fitted."""
    steps, e = _start_steps(problem), residual(problem, point)
    for _ in range(START_STEPS):
        if e is None:
            return None
        J = np.zeros((e.size, steps.size))
        for k, step in enumerate(np.diag(steps)):
            there = residual(problem, replace(point, starts=point.starts + step))
            if there is not None:
                J[:, k] = (e - there) / steps[k]
        moved = replace(point, starts=point.starts + np.linalg.lstsq(J, e, rcond=1e-9)[0])
        there = residual(problem, moved)
        if there is None or there @ there > e @ e:
            break
        point, e = moved, there
    return e


def _unexplained(problem: Problem, point: Point) -> Array:
    """Rows that a point leaves of eq. (18) with the joint's motion that the record shows."""
    e = problem.target()
    for c, a in zip(point.chosen, point.amplitudes, strict=True):
        rows, _ = problem.effect_rows(c.terms)
        e = e - rows @ a
    return e


def refined(fitter: Fitter, fitted: Fitted, most: int = STEPS) -> LedFit | None:
    """The model of a linear fit, fitted by simulation; None where that explains no more than the linear fit.

    Its columns are the simulation's derivatives.
    """
    start = Point.of(fitted)
    problem, x = _informed(fitted.problem, fitted, start), start.vector()
    limits = _Limits.of(fitted, x)
    damping, widths = DAMPING, _first_steps(problem, x)
    jumps = MOST_JUMPS if most == STEPS else 0
    kept, least = x, np.inf  # a jump may lead astray
    for _ in range(most + jumps):
        found = _derivatives(problem, start, x, widths)
        if found is None:
            return None
        e, J = found
        widths = _differences(J, e, x, widths, x.size - 2 - start.starts.size)
        moved = _moved(problem, start, x, e, J, damping, limits)
        change = 0.0
        if moved is not None:
            x, e_new, damping = moved
            change, e = float(np.log((e @ e) / (e_new @ e_new))), e_new
        if e @ e < least:
            kept, least = x, float(e @ e)
        if change < SETTLED:
            jumped = (
                _jumped(problem, start, x, e, J, limits) if jumps and e @ e > ABOVE_NOISE * e.size else None
            )
            if jumped is None:
                break
            x, damping, jumps = jumped, DAMPING, jumps - 1
    return _as_fitted(fitter, problem, start, kept, widths, J if most < STEPS else None)


def _first_steps(problem: Problem, x: Array) -> Array:
    """Differences before anything is known of standard errors."""
    speed = max(float(np.sqrt(np.mean(s.motor_velocity**2))) for s in problem.stretches)
    zero = np.full(x.size, LEAST_DIFFERENCE)
    zero[: len(ALONE_NAMES)] = problem.torque_rms
    for k, n in enumerate(ALONE_NAMES):
        zero[k] /= speed if n in ("FVm", "FV") else 1.0
    steps = FIRST_DIFFERENCE * np.where(x == 0.0, zero, np.abs(x))
    own = _start_steps(problem)
    steps[-2 - own.size : -2] = own
    steps[-2:] = WIDTH_DIFFERENCE
    return np.asarray(steps)


def _start_steps(problem: Problem) -> Array:
    """Differences of the load's torsion and velocity at the start."""
    torsion = FIRST_DIFFERENCE * problem.torque_rms / problem.base.K
    return np.tile([torsion, torsion * np.sqrt(problem.base.K / problem.base.JL)], len(problem.stretches))


def _differences(J: Array, e: Array, x: Array, before: Array, first: int) -> Array:
    """Steps of a part of the standard error each; as before where it is zero, and for starts (from ``first`` on)."""
    norm = np.linalg.norm(J, axis=0)
    seen = norm > 0.0
    scaled = J[:, seen] / norm[seen]
    stderr = np.zeros(x.size)
    spread = np.diag(np.linalg.pinv(scaled.T @ scaled, rcond=1e-12))
    stderr[seen] = np.sqrt(np.maximum(spread, 0.0) * float(e @ e) / e.size) / norm[seen]
    steps = DIFFERENCE * stderr
    known = x != 0.0
    size = np.abs(x[known])
    steps[known] = np.clip(steps[known], LEAST_DIFFERENCE * size, MOST_DIFFERENCE * size)
    steps = np.where(steps > 0.0, steps, before)
    steps[first:-2] = before[first:-2]
    steps[-2:] = WIDTH_DIFFERENCE
    return np.asarray(steps)


def _derivatives(problem: Problem, start: Point, x: Array, steps: Array) -> tuple[Array, Array] | None:
    """Residual, and the derivatives of the simulated torque's rows, shapes (r,) and (r, p)."""
    here = start.at(x)
    runs = _simulated(problem, here)
    e = None if runs is None else _rows(problem, here, runs)
    if runs is None or e is None:
        return None
    J = np.empty((e.size, x.size))
    J[:, :LINEAR] = _motor_columns(problem, here, runs)

    def one(k: int) -> bool:
        for step in (steps[k], -steps[k]):
            moved = x.copy()
            moved[k] += step
            there = residual(problem, start.at(moved))
            if there is not None:
                J[:, k] = (e - there) / step
                return True
        return False

    return (e, J) if all(side_by_side(one, range(LINEAR, x.size))) else None


def _moved(
    problem: Problem, start: Point, x: Array, e: Array, J: Array, damping: float, limits: _Limits
) -> tuple[Array, Array, float] | None:
    """A step that makes the residual smaller, and the next one's damping."""
    for _ in range(TRIALS):
        moved = _step(x, e, J, damping, limits)
        e_new = residual(problem, start.at(moved))
        if e_new is not None and e_new @ e_new < e @ e:
            return moved, e_new, damping * BOLDER
        damping *= CALMER
    return None


def _jumped(problem: Problem, start: Point, x: Array, e: Array, J: Array, limits: _Limits) -> Array | None:
    """Another shape or width from where the rest, to first order, makes the residual smaller.

    Gaps that open and close and signs that turn make the residual rough in them: steps by derivatives get caught.
    """
    trials = []
    for k in (*start.shapes(), x.size - 2, x.size - 1):
        width = k >= x.size - 2
        for part in JUMPS:
            moved = x.copy()
            moved[k] = moved[k] + 5.0 * part if width else moved[k] * (1.0 + part)
            if limits.low[k] <= moved[k] <= limits.high[k] and moved[k] != x[k]:
                trials.append((k, moved))

    def left(trial: tuple[int, Array]) -> tuple[float, Array]:
        k, moved = trial
        there = residual(problem, start.at(moved))
        if there is None:
            return np.inf, moved
        others = J.copy()
        others[:, k] = 0.0
        new = _step(moved, there, others, DAMPING, limits)
        rest = there - others @ (new - moved)
        return float(rest @ rest), new

    cost, best = min(side_by_side(left, trials), key=lambda found: found[0], default=(np.inf, x))
    return best if cost < WORTH_A_JUMP * float(e @ e) else None


def _step(x: Array, e: Array, J: Array, damping: float, limits: _Limits) -> Array:
    """Levenberg-Marquardt step; what it would take beyond a limit is set there, and the rest solved again."""
    norm = np.linalg.norm(J, axis=0)
    free = norm > 0.0
    moved = x.copy()
    target = e.copy()
    for _ in range(x.size):
        A = np.vstack([J[:, free] / norm[free], np.sqrt(damping) * np.eye(int(free.sum()))])
        step = np.zeros(x.size)
        step[free] = np.linalg.lstsq(A, np.r_[target, np.zeros(int(free.sum()))], rcond=None)[0] / norm[free]
        moved[free] = (x + step)[free]
        beyond = free & ((moved < limits.low) | (moved > limits.high))
        if not np.any(beyond):
            break
        moved[beyond] = np.clip(moved, limits.low, limits.high)[beyond]
        target = target - J[:, beyond] @ (moved - x)[beyond]
        free = free & ~beyond
    most = limits.most.copy()
    for k, n in enumerate(ALONE_NAMES):
        if n not in FRICTION:
            most[k] = MOST_CHANGE * abs(x[k])
    most[-2:] = 2.0 * MOST_CHANGE
    return np.asarray(x + np.clip(moved - x, -most, most))


def _as_fitted(
    fitter: Fitter, problem: Problem, start: Point, x: Array, steps: Array, rough: Array | None
) -> LedFit | None:
    """The solution as a fit that is linear about it, its rows weighted by what it found.

    With ``rough`` derivatives those of another point stand for its own.
    """
    point = start.at(x)
    problem = problem.at(point.base)
    if rough is None:
        found = _derivatives(problem, start, x, steps)
    else:
        own = residual(problem, point)
        found = None if own is None else (own, rough)
    if found is None:
        return None
    e, J = found
    coefficients = [np.zeros(len(ALONE_NAMES))]
    keep = list(range(len(ALONE_NAMES)))
    i = len(ALONE_NAMES)
    for c, a in zip(point.chosen, point.amplitudes, strict=True):
        if c.form.signature.fixed is None:
            coefficients.append(a)
            keep += range(i, i + a.size)
            i += a.size
        i += len(c.shape)
    columns, b = J[:, keep], np.concatenate(coefficients)
    search = fitter.fit(problem, point.chosen).search
    Q, _ = np.linalg.qr(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300))
    return LedFit(problem, search, point.chosen, Basis(columns, Q, e, b), e + columns @ b, point)
