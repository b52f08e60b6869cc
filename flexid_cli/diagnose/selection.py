"""Which effects a record holds: added one at a time, dropped again if a later one makes them needless."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from flexid_cli.diagnose.fitter import Chosen, Fitted, Fitter, without
from flexid_cli.diagnose.led import LedFit, refined
from flexid_cli.diagnose.problem import Problem
from flexid_cli.diagnose.search import Candidate
from flexid_cli.threads import side_by_side

MOST_EFFECTS = 4
RIVALS = 3
WIDE = 8  # rivals where none of the first gains enough, and more than noise stays
NEAR_RIVAL = 0.5  # of the best candidate's gain
# Least gain (logarithm of the cost) of an effect, and what an alternative may be worse by. Calibrated, see
# docs/diagnosis.md.
ENOUGH = 0.12
ENOUGH_ALONE = 0.15  # without a joint encoder: of the linear fit, which a simulation confirms where it can
ENOUGH_LED = 0.12  # of fits by simulation
AS_GOOD = 0.05
# Gain that the linear fit may have over its simulation, for noise in its columns makes it look better than it is.
NO_WORSE = 0.5
WORTH_A_SIMULATION = 0.3  # loss that an alternative may be behind before it is simulated
# Of several starts: those looked at with effects, how far behind they may be, and steps by simulation.
MOST_LIKELY, FAR_BEHIND, FEW_STEPS = 3, 1.5, 2
CURVES = (0.1, 0.35, 0.7)  # starts of a curved friction's shape, over its range
MOST_ROUNDS, STILL = 5, 0.01  # of moving all shapes again, and the change of loss that ends it
ABOUT_NOISE = 1.15  # RMS of rows in which no other form of an effect is looked for
NEEDLESS = 0.5  # of the least gain: what an effect explains that goes again in the end
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
    before = fitter.relax(problem)
    if problem.both:
        before = _settled(fitter, before)
    tested = fitter.candidates(before)
    if problem.both or problem.rigid:
        fitted = _grown(fitter, before, tested)
    else:
        fitted = _grown_led(fitter, _simulated(fitter, before) or before, tested)
        before = before if fitted.chosen else fitted
    fitted, alternatives, rivals = _alternatives(fitter, fitted)
    if not (problem.both or problem.rigid):
        # Where the baseline stands at a wrong stiffness, no simulation follows the record.
        settled = isinstance(fitted, LedFit) or (fitted.problem.settled and not _denied(fitted))
        fitted.problem.settled = before.problem.settled = settled
    elif fitted.chosen:
        before = fitter.fit(before.problem.at(before.problem.base, trust=fitted.problem.trust))
    return Selection(before, fitted, alternatives, tuple(tested), rivals, elsewhere)


def _grown(fitter: Fitter, fitted: Fitted, found: list[Candidate]) -> Fitted:
    """The model with the effects that the record holds."""
    enough, seen, before = threshold(fitted.problem), {_names(fitted)}, fitted
    while len(fitted.chosen) < MOST_EFFECTS:
        trials = _added(fitter, fitted, found)
        if not _gains(trials, fitted, enough) and fitted.basis.rms > ABOUT_NOISE:
            trials = _added(fitter, fitted, found, WIDE)
        if not _gains(trials, fitted, enough):
            break
        needed = _needed(fitter, trials[0], enough)
        if _names(needed) in seen and _names(trials[0]) not in seen:
            needed = trials[0]  # what takes the place of a wrong effect may need them both before
        grown = fitter.reweighted(needed)
        if _names(grown) in seen:  # rows are weighted anew by each set of effects: it could go round for ever
            fitted = _better(fitted, grown)
            break
        fitted = _reformed(fitter, grown)
        seen.add(_names(fitted))
        found = fitter.candidates(fitted)
    return fitted if fitted is before else _pruned(fitter, _settled(fitter, fitted))


def _pruned(fitter: Fitter, fitted: Fitted) -> Fitted:
    """Without effects that explain nothing any more once the others have settled: they stood in for their shapes."""
    for k in reversed(range(len(fitted.chosen))):
        rest = fitter.fit(fitted.problem, without(fitted.chosen, k), fitted.search)
        if len(fitted.chosen) > 1 and fitted.gain(rest) < NEEDLESS * ENOUGH:
            fitted = _settled(fitter, rest)
    return fitted


def _gains(trials: Sequence[Fitted], fitted: Fitted, enough: float) -> bool:
    return bool(trials) and trials[0].gain(fitted) >= enough


def _reformed(fitter: Fitter, fitted: Fitted) -> Fitted:
    """The same effects, in other forms where that leaves less: the form was chosen before the others were there."""
    before = fitted
    for k, c in enumerate(fitted.chosen[:-1]):
        if fitted.basis.rms < ABOUT_NOISE:
            break
        rest = fitter.fit(fitted.problem, without(fitted.chosen, k), fitted.search)
        forms = [
            f
            for f in fitter.forms
            if f.name == c.name and f != c.form and not (f.signature.extends or f.signature.curved)
        ]
        found = [fitted.search.best(f, rest.basis) for f in forms]
        models = [
            (*fitted.chosen[:k], Chosen(x.form, x.shape), *fitted.chosen[k + 1 :])
            for x in found
            if x is not None and not x.refused
        ]
        fitted = min([fitted, *fitter.relaxed(fitted, models)], key=lambda f: f.loss)
    return fitted if fitted is before else fitter.reweighted(fitted)


def _settled(fitter: Fitter, fitted: Fitted) -> Fitted:
    """The fit where shapes and reversals no longer move: one that was far off has drawn the others along."""
    return _until_still(fitted, lambda f: fitter.reweighted(fitter.relax(f.problem, f.chosen)))


def _settled_led(fitter: Fitter, fitted: Fitted) -> Fitted:
    """The fit by simulation where further steps, from reversals told anew, no longer help.

    Gaps that open and signs that turn make the residual rough: steps get caught.
    """
    return _until_still(
        fitted, lambda f: refined(fitter, f) if isinstance(f, LedFit) and not f.is_noise else None
    )


def _until_still(fitted: Fitted, again: Callable[[Fitted], Fitted | None]) -> Fitted:
    for _ in range(MOST_ROUNDS):
        moved = again(fitted)
        if moved is None or moved.loss > fitted.loss - STILL:
            break
        fitted = moved
    return fitted


def _better(fitted: Fitted, again: Fitted) -> Fitted:
    """Of two fits of the same effects the likelier one: the shapes of some have several minima."""
    return again if _names(again) == _names(fitted) and again.loss < fitted.loss else fitted


def _names(fitted: Fitted) -> frozenset[str]:
    return frozenset(c.name for c in fitted.chosen)


def _grown_led(fitter: Fitter, fitted: Fitted, found: list[Candidate]) -> Fitted:
    """The same with the motor alone: the linear fit proposes, with its noisy columns, and the simulation decides.

    A model at a wrong stiffness, and an effect that only stands in for another, are denied by it.
    """
    seen = {_names(fitted)}
    while len(fitted.chosen) < MOST_EFFECTS:
        trials = _added(fitter, fitted, found)
        trials = [
            f
            for f in trials
            if f.gain(fitted) > ENOUGH_ALONE and f.loss - trials[0].loss < WORTH_A_SIMULATION
        ]
        simulated = [s for f in trials if (s := _simulated(fitter, f))]
        if not simulated and trials and not fitted.chosen:
            simulated = trials[:1]
        new = min(simulated, key=lambda f: f.loss, default=None)
        if new is None or new.gain(fitted) < ENOUGH_LED:
            break
        other = _reshaped(fitter, fitted)
        if other is not fitted and new.gain(other) < ENOUGH_LED:
            fitted = other
            break
        grown = _confirmed(fitter, new) if len(new.chosen) > 1 else new
        if _names(grown) in seen:
            fitted = _better(fitted, grown)
            break
        fitted = grown
        seen.add(_names(fitted))
        found = fitter.candidates(fitted)
    return _settled_led(fitter, fitted)


def _reshaped(fitter: Fitter, fitted: Fitted) -> Fitted:
    """The same effects with curved frictions from other starts, if that is better: before a further one is named.

    The shape at which a linear fit proposed it stands in for what else it lacked.
    """
    best = fitted
    for k, c in enumerate(fitted.chosen):
        starts = _curves(fitter, fitted, c.form.name) if c.form.signature.curved else []
        models = [(*fitted.chosen[:k], s, *fitted.chosen[k + 1 :]) for s in starts]
        simulated = [s for f in fitter.relaxed(fitted, models) if (s := _simulated(fitter, f))]
        best = min([best, *simulated], key=lambda f: f.loss)
    return best


def _simulated(fitter: Fitter, fitted: Fitted) -> Fitted | None:
    """A fit by simulation, or itself where an effect has no law; None where the axis that it says does not do so."""
    if _lawless(fitted):
        return fitted
    new = refined(fitter, fitted)
    return None if new is None or fitted.gain(new) > NO_WORSE else new


def _lawless(fitted: Fitted) -> bool:
    return any(c.form.signature.lawless for c in fitted.chosen)


def _denied(fitted: Fitted) -> bool:
    """Whether no simulation does what a fit says."""
    return not isinstance(fitted, LedFit) and not _lawless(fitted)


def _confirmed(fitter: Fitter, fitted: Fitted) -> Fitted:
    """Without effects that the others, by simulation, make needless."""
    for k in reversed(range(len(fitted.chosen) - 1)):
        less = _simulated(fitter, fitter.relax(fitted.problem, without(fitted.chosen, k), rounds=1))
        if less is not None and fitted.gain(less) < ENOUGH_LED:
            fitted = less
    return fitted


def _start(fitter: Fitter, problems: Sequence[Problem]) -> tuple[Problem, tuple[Fitted, ...]]:
    """Of several linearisations the most likely one, and the fits at others that the record cannot exclude.

    What the baseline lacks draws its stiffness to where it stands in for it: without an effect the likelihood says
    little about where to begin. So each is judged with the one effect that explains most there, and by simulation:
    eq. (18) at a wrong stiffness explains noise, a simulation does not.
    """
    if len(problems) == 1:
        return problems[0], ()
    plain = side_by_side(lambda problem: fitter.relax(problem, rounds=1), problems)
    possible = [f for f in plain if f.is_possible]
    simulated = side_by_side(lambda f: _led(fitter, f), possible)
    likely = sorted(zip(possible, simulated, strict=True), key=lambda s: s[1].loss)
    found = []
    for fitted, led in likely[:MOST_LIKELY]:
        if led.loss - likely[0][1].loss > FAR_BEHIND:
            break
        more = [f for f in _added(fitter, fitted, fitter.candidates(fitted))[:1] if f.is_possible]
        found.append(min([led, *(_led(fitter, f) for f in more)], key=lambda f: f.loss))
    if not found:
        return problems[0], ()
    best = min(found, key=lambda f: f.loss)
    near = [f for f in found if f is not best and f.loss - best.loss < threshold(best.problem)]
    problem = best.problem.at(best.problem.base)
    problem.anchor = problem.base
    return problem, tuple(near)


def _led(fitter: Fitter, fitted: Fitted) -> Fitted:
    """A fit after a few steps by simulation, or itself where there is no such axis."""
    return refined(fitter, fitted, most=FEW_STEPS) or fitted


def threshold(problem: Problem) -> float:
    """Least gain that names an effect in this record."""
    return ENOUGH if problem.both or problem.rigid else ENOUGH_ALONE


def least_gain(fitted: Fitted) -> float:
    """Least gain that names an effect beyond this model, by simulation where that is one."""
    return ENOUGH_LED if isinstance(fitted, LedFit) else threshold(fitted.problem)


def _added(fitter: Fitter, fitted: Fitted, found: list[Candidate], wide: int = 0) -> list[Fitted]:
    """The model with one more effect: those that promise most, after a refit each, the best first.

    With ``wide`` so many, however little they promise: one may gain only once the others' shapes make room for it.
    """
    possible = [c for c in found if not c.refused]
    if not possible or (possible[0].gain < 0.5 * ENOUGH and not wide):
        return []
    near = [c for c in possible if c.gain > NEAR_RIVAL * possible[0].gain][:RIVALS]
    rivals = possible[:wide] if wide else near
    starts = [Chosen(c.form, c.shape) for c in rivals]
    if fitted.problem.both:
        starts += [s for c in rivals for s in _curves(fitter, fitted, c.form.name)]
    trials = fitter.relaxed(fitted, [(*fitted.chosen, s) for s in starts])
    return sorted(trials, key=lambda f: f.loss)


def _curves(fitter: Fitter, fitted: Fitted, name: str) -> list[Chosen]:
    """Other starts for a friction: the reversal's width, fitted without it, has taken the place of a part of it."""
    forms = [f for f in fitter.forms if f.name == name and f.signature.curved]
    return [Chosen(f, shape) for f in forms for shape in fitted.search.spread(f, CURVES)]


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
) -> tuple[Fitted, tuple[tuple[Fitted, ...], ...], tuple[tuple[tuple[str, float], ...], ...]]:
    """The model, and what explains the record as well in place of each chosen effect.

    With the motor alone, another effect can be the better one once it is simulated: then it is the model's. And
    where the best of them leaves more than noise, what is missing in it is as large as that: effects that are worse
    by no more are not excluded.
    """
    alone = not (fitted.problem.both or fitted.problem.rigid)
    alternatives, rivals = [], []
    for k in range(len(fitted.chosen)):
        far = max(WORTH_A_SIMULATION, _missing(fitted)) if alone else AS_GOOD
        refits, worse = _others(fitter, fitted, k, far)
        if alone:
            refits = [s for f in refits if (s := _simulated(fitter, f))]
        if alone and len(fitted.chosen) == 1 and refits:
            own = [] if _denied(fitted) else [fitted]
            fitted, *refits = sorted([*own, *refits], key=lambda f: f.loss)
        near = max(AS_GOOD, _missing(fitted))
        alternatives.append(tuple(f for f in refits if f.loss - fitted.loss < near))
        rivals.append(tuple(sorted(worse, key=lambda w: w[1])))
    return fitted, tuple(alternatives), tuple(rivals)


def _missing(fitted: Fitted) -> float:
    """Loss of a fit by simulation above that of noise."""
    if not isinstance(fitted, LedFit) or fitted.is_noise:
        return 0.0
    return float(np.log(fitted.cost / fitted.y.size))


def _others(
    fitter: Fitter, fitted: Fitted, k: int, as_good: float
) -> tuple[list[Fitted], list[tuple[str, float]]]:
    """Other effects in place of the k-th after a refit, where they are nearly as good; what each is worse by."""
    others = [c for c in fitter.candidates(fitted, instead_of=k) if c.form.name != fitted.chosen[k].name]
    worse = [(c.form.name, float(np.log(c.cost / fitted.cost))) for c in others]
    near = [c for c, (_, w) in zip(others, worse, strict=True) if w < LOOKED_AT and not c.refused]
    rest = without(fitted.chosen, k)
    refits = fitter.relaxed(fitted, [(*rest, Chosen(c.form, c.shape)) for c in near])
    return [f for f in refits if f.loss - fitted.loss < as_good], worse
