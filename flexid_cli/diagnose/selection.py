"""Which effects a record holds: added one at a time, dropped again if a later one makes them needless."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexid_cli.diagnose.fitter import Chosen, Fitted, Fitter, without
from flexid_cli.diagnose.problem import Problem
from flexid_cli.diagnose.search import Candidate
from flexid_cli.threads import side_by_side

MOST_EFFECTS = 4
RIVALS = 3
NEAR_RIVAL = 0.5  # of the best candidate's gain
# Least gain (logarithm of the cost) of an effect, and what an alternative may be worse by. Calibrated, see
# docs/diagnosis.md.
ENOUGH = 0.12
ENOUGH_ALONE = 0.4  # flexible, without a joint encoder
AS_GOOD = 0.05
LOOKED_AT = 0.6  # gain that a rival may be behind before its own refit


@dataclass(frozen=True)
class Selection:
    """Outcome of the search.

    Attributes
    ----------
    before, after : Fitted
        The baseline, and with the chosen effects.
    alternatives : tuple of tuple of Fitted
        For each chosen effect, fits of other effects in its place that the record cannot exclude.
    tested : tuple of Candidate
        Every effect against the baseline.
    rivals : tuple of tuple of (str, float)
        Names of the other effects tried in place of each chosen one, and what they are worse by.
    elsewhere : tuple of Fitted
        Fits from other starts that are worse by less than what would name an effect.
    """

    before: Fitted
    after: Fitted
    alternatives: tuple[tuple[Fitted, ...], ...]
    tested: tuple[Candidate, ...]
    rivals: tuple[tuple[tuple[str, float], ...], ...]
    elsewhere: tuple[Fitted, ...] = ()


def select(fitter: Fitter, problems: Sequence[Problem]) -> Selection:
    """Search the library for what the record holds beyond the baseline, from the likeliest of some linearisations."""
    problem, elsewhere = _start(fitter, problems)
    enough = threshold(problem)
    before = fitter.relax(problem)
    fitted, tested = before, fitter.candidates(before)
    found = tested
    while len(fitted.chosen) < MOST_EFFECTS:
        new = _added(fitter, fitted, found)
        if new is None or new.gain(fitted) < enough:
            break
        fitted = fitter.reweighted(_needed(fitter, new, enough))
        found = fitter.candidates(fitted)
    alternatives, rivals = _alternatives(fitter, fitted)
    if fitted.chosen:
        before = fitter.fit(before.problem.at(before.problem.base, trust=fitted.problem.trust))
    return Selection(before, fitted, alternatives, tuple(tested), rivals, elsewhere)


def _start(fitter: Fitter, problems: Sequence[Problem]) -> tuple[Problem, tuple[Fitted, ...]]:
    """Of several linearisations the most likely one, and the fits at others that the record cannot exclude.

    What the baseline lacks draws its stiffness to where it stands in for it: without an effect the likelihood says
    little about where to begin. So each is judged with the one effect that explains most there.
    """
    if len(problems) == 1:
        return problems[0], ()
    fits = side_by_side(lambda problem: _alone_or_with_one(fitter, problem), problems)
    found = [(problem, fit) for problem, fit in zip(problems, fits, strict=True) if fit is not None]
    if not found:
        return problems[0], ()
    best, fit = min(found, key=lambda start: start[1].loss)
    near = [f for p, f in found if p is not best and f.loss - fit.loss < threshold(best)]
    return best, tuple(near)


def _alone_or_with_one(fitter: Fitter, problem: Problem) -> Fitted | None:
    """The baseline from a start, or it with the effect that explains most there; None where neither is possible."""
    fitted = fitter.relax(problem, rounds=1)
    both = (fitted, _added(fitter, fitted, fitter.candidates(fitted)))
    possible = [f for f in both if f is not None and f.is_possible]
    return min(possible, key=lambda f: f.loss) if possible else None


def threshold(problem: Problem) -> float:
    """Least gain that names an effect in this record."""
    return ENOUGH if problem.both or problem.rigid else ENOUGH_ALONE


def _added(fitter: Fitter, fitted: Fitted, found: list[Candidate]) -> Fitted | None:
    """The model with one more effect: of those that promise most, the one that is best after its own refit."""
    possible = [c for c in found if not c.refused]
    if not possible or possible[0].gain <= 0.0:
        return None
    rivals = [c for c in possible if c.gain > NEAR_RIVAL * possible[0].gain][:RIVALS]
    if possible[0].gain < 0.5 * ENOUGH:
        return None
    trials = fitter.relaxed(fitted, [(*fitted.chosen, Chosen(c.form, c.shape)) for c in rivals])
    return min(trials, key=lambda f: f.loss)


def _needed(fitter: Fitter, fitted: Fitted, enough: float) -> Fitted:
    """Leave out effects that the others, with shapes of their own, make needless."""
    while len(fitted.chosen) > 1:
        smaller = fitter.relaxed(fitted, [without(fitted.chosen, k) for k in range(len(fitted.chosen))])
        weakest = min(smaller, key=lambda f: f.loss)
        if fitted.gain(weakest) > enough:
            break
        fitted = weakest
    return fitted


def _alternatives(
    fitter: Fitter, fitted: Fitted
) -> tuple[tuple[tuple[Fitted, ...], ...], tuple[tuple[tuple[str, float], ...], ...]]:
    """What explains the record as well in place of each chosen effect."""
    alternatives, rivals = [], []
    for k, chosen in enumerate(fitted.chosen):
        others = [c for c in fitter.candidates(fitted, instead_of=k) if c.form.name != chosen.name]
        worse = [(c.form.name, float(np.log(c.cost / fitted.cost))) for c in others]
        near = [c for c, (_, w) in zip(others, worse, strict=True) if w < LOOKED_AT and not c.refused]
        rest = without(fitted.chosen, k)
        refits = fitter.relaxed(fitted, [(*rest, Chosen(c.form, c.shape)) for c in near])
        alternatives.append(tuple(f for f in refits if f.loss - fitted.loss < AS_GOOD))
        rivals.append(tuple(sorted(worse, key=lambda w: w[1])))
    return tuple(alternatives), tuple(rivals)
