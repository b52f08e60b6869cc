"""How sure a named effect is: score, stability over the record, and data that it was not fitted to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flexid_cli.diagnose.basis import solve
from flexid_cli.diagnose.fitter import Fitted, Fitter, informed, without
from flexid_cli.diagnose.instants import own_instant
from flexid_cli.diagnose.led import LedFit
from flexid_cli.diagnose.led import predicted as led_rows
from flexid_cli.diagnose.problem import Problem
from flexid_cli.diagnose.search import Search

Array = NDArray[np.float64]

BLOCKS = 24  # of the score test: long against the residual's correlation, many enough for Student's t
# Blocks of the record that are predicted from the others, every fifth of them at once: what a sweep passes in one
# block its neighbours pass too, or the prediction would be one of frequencies that were never seen.
FOLDS, FOLD_BLOCKS = 5, 20
STABILITY_BLOCKS = 6


@dataclass(frozen=True)
class Score:
    """Score test of one effect, and how steady its amplitude is."""

    p_value: float
    stability: float


def score(fitter: Fitter, fitted: Fitted, k: int, library: int) -> Score:
    """Score test of the k-th effect against the model without it.

    The score's sum over the record is compared with what the residual of the model with the effect makes of it in
    blocks of time, so that coloured residuals do not make it look sure; Bonferroni's correction over the
    ``library`` that was searched.
    """
    from scipy.special import stdtr

    chosen = fitted.chosen[k]
    rest = fitter.fit(fitted.problem, without(fitted.chosen, k), fitted.search)
    rows = fitted.search.rows(chosen.form, chosen.shape)
    column = rest.basis.outside(rows) @ fitted.amplitudes(k)
    parts = _blocks(column * rest.basis.residual, fitted.problem, BLOCKS)
    noise = _blocks(column * fitted.basis.residual, fitted.problem, BLOCKS)
    spread = float(np.sqrt(np.sum(noise**2)))
    statistic = float(parts.sum()) / max(spread, 1e-300)
    p = 2.0 * float(stdtr(parts.size - 1, -abs(statistic)))
    few = _blocks(column * rest.basis.residual, fitted.problem, STABILITY_BLOCKS)
    weight = _blocks(column**2, fitted.problem, STABILITY_BLOCKS)
    informed = weight > 0.02 * weight.max()
    return Score(min(1.0, p * library), float(np.mean(few[informed] > 0.0)))


def _blocks(values: Array, problem: Problem, count: int) -> Array:
    """Sums over blocks of time of row values, equations added."""
    by_time = values.reshape(problem.equations, -1).sum(axis=0)
    return np.array([part.sum() for part in np.array_split(by_time, count)])


def cross_validated(fitted: Fitted) -> Array:
    """Residual rows of a model, every fifth block of the record predicted from the rest (with gaps between)."""
    rows, columns = fitted.y.size // fitted.problem.equations, fitted.basis.columns
    time = np.arange(rows)
    fold = (time * FOLD_BLOCKS // rows) % FOLDS
    gap = max(2, rows // 200)
    residual = np.empty_like(fitted.y)
    for f in range(FOLDS):
        inside = fold == f
        away = np.convolve(inside, np.ones(2 * gap + 1), "same") < 0.5
        train, test = np.tile(away, fitted.problem.equations), np.tile(inside, fitted.problem.equations)
        coefficients = solve(columns[train], fitted.y[train]).coefficients
        residual[test] = fitted.y[test] - columns[test] @ coefficients
    return residual


def predicted(problem: Problem, fitter: Fitter, fitted: Fitted) -> Array:
    """Residual rows of another record with all parameters of ``fitted``; events have their own instants there."""
    if isinstance(fitted, LedFit) and (led := led_rows(problem, fitted)) is not None:
        return led
    here = fitted.problem
    other = problem.at(
        here.base, shift=here.shift, applied=here.applied, stiffening=here.stiffening, led=here.led
    )
    if fitted.chosen and other.both:
        fitted = _with_own_instants(other, fitter, fitted)
        other = informed(other, fitted)
    return _left(other, fitter, fitted)


def _left(other: Problem, fitter: Fitter, fitted: Fitted) -> Array:
    """What the parameters of a fit leave of another record, linearised as that is."""
    held = {c.form: fitted.slopes(k) for k, c in enumerate(fitted.chosen)}
    there = fitter.fit(other, fitted.chosen, Search(other, fitter.forms, held))
    return np.asarray(there.y - there.basis.columns @ fitted.basis.coefficients)


def _with_own_instants(other: Problem, fitter: Fitter, fitted: Fitted) -> Fitted:
    """The fit with the events where they happened in another record."""
    for k, c in enumerate(fitted.chosen):
        if c.form.signature.event:
            amplitudes = fitted.amplitudes(k)
            left = _left(other, fitter, fitted) + other.effect_rows(c.terms)[0] @ amplitudes
            there = own_instant(other, c, amplitudes, left)
            fitted = replace(fitted, chosen=(*fitted.chosen[:k], there, *fitted.chosen[k + 1 :]))
    return fitted


def held_out_gain(before: Array, after: Array) -> float:
    """Logarithm of the sums of squares, before over after."""
    return float(np.log(float(before @ before) / max(float(after @ after), 1e-300)))


def by_equation(problem: Problem, residual: Array) -> Mapping[str, Array]:
    """Rows of each equation."""
    names = ("motor", "load") if problem.both else ("motor",)
    return dict(zip(names, residual.reshape(problem.equations, -1), strict=True))


def gains(fitter: Fitter, fitted: Fitted) -> list[float]:
    """What leaving out each effect costs, at the present linearisation."""
    rest = [
        fitter.fit(fitted.problem, without(fitted.chosen, k), fitted.search)
        for k in range(len(fitted.chosen))
    ]
    return [fitted.gain(f) for f in rest]
