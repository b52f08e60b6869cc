"""Fits the baseline with any set of effects to one record, and moves the linearisation until it settles."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from flexid_cli.diagnose.basis import Basis, solve
from flexid_cli.diagnose.problem import Effects, Joined, Problem
from flexid_cli.diagnose.reversals import sharpened
from flexid_cli.diagnose.search import Candidate, Form, Search, gained, minimum
from flexid_cli.diagnose.trust import trusted
from flexid_cli.effects.base import Stage
from flexid_cli.effects.motion import Base, Motion, Terms
from flexid_cli.threads import side_by_side

Array = NDArray[np.float64]

SETTLED = 1e-3  # change of the cost's logarithm
# Of the logarithm of a reversal width about the present one: its range, where it is looked at first, and how near.
WIDTH_RANGE, WIDTH_STEP, WIDTH_NEAR, MOST_WIDTHS = 1.2, 0.4, 0.02, 6
NEAR = 0.03  # of the search's steps: an instant of change is told to a sample
REVERSALS = {"motor_reversal": "FSm", "load_reversal": "FS"}  # widths of the base and their friction
REVERSAL = 3.0  # widths about zero velocity that a reversal takes
NARROWEST = 1e-5  # reversal width, rad/s or m/s
# Of the highest speed (both encoders): such a sign has turned within a fifth of the speeds, tanh(2) = 0.96. A wider
# one is a curve of the friction, and takes an effect's place.
WIDEST = 0.1
SETTLED_STIFFNESS, SETTLING_STEPS = 1e-4, 6  # relative change of the stiffness
# Gain of an effect whose richer form is tried, and what that needs beyond it.
PROMISING, EXTENDED = 0.05, 0.02


@dataclass(frozen=True)
class Chosen:
    """A form of an effect with its shape, in the model."""

    form: Form
    shape: tuple[float, ...]

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.form.name

    def terms(self, motion: Motion) -> Terms:
        """What it adds to the equations for unit amplitudes."""
        return self.form.signature.columns(motion, self.shape)


@dataclass(frozen=True)
class Fitted:
    """Baseline and chosen effects fitted together in one linearisation."""

    problem: Problem
    search: Search
    chosen: tuple[Chosen, ...]
    basis: Basis
    y: Array

    @property
    def cost(self) -> float:
        """Sum of squares that is left."""
        return self.basis.cost

    @property
    def loss(self) -> float:
        """Logarithm of the cost, comparable between linearisations that weigh the rows differently.

        Twice the negative logarithm of the likelihood, for noise of the known shape and a free size, a row.
        """
        return float(np.log(max(self.basis.cost, 1e-300))) + self.problem.level

    def gain(self, before: Fitted) -> float:
        """What it explains that another fit does not, see `gained`; their rows may be weighted differently."""
        other = self.cost * float(np.exp(before.loss - self.loss))
        return gained(other, self.cost, self.y.size)

    def amplitudes(self, k: int) -> Array:
        """Amplitudes of the k-th chosen effect."""
        chosen = self.chosen[k]
        if chosen.form.signature.fixed is not None:
            return np.array([chosen.form.signature.fixed])
        return self.basis.coefficients[self.columns(k)]

    @cached_property
    def stiffening(self) -> float:
        """Stiffness of the chosen effects, which K of the columns holds too."""
        return float(sum(self.amplitudes(k) @ self.slopes(k) for k in range(len(self.chosen))))

    @property
    def is_possible(self) -> bool:
        """Whether inertias and stiffness are positive."""
        names, problem = self.problem.names, self.problem
        strong = {
            n: problem.linearised(n) + float(self.basis.coefficients[names.index(n)])
            for n in ("Jm", "K", "JL")
            if n in names
        }
        strong["K"] = strong.get("K", np.inf) - self.stiffening
        return min(strong.values()) > 0.0

    def at_reversal(self, symbol: str, width: float) -> float:
        """Friction about a reversal of the motor or the load: Coulomb's, and that of effects."""
        problem = self.problem
        total = problem.linearised(symbol) + float(self.basis.coefficients[problem.names.index(symbol)])
        for k, c in enumerate(self.chosen):
            product = size = 0.0
            for m in problem.motions:
                terms = c.terms(m)
                motor = symbol == "FSm"
                torque = terms.motor if motor else terms.load
                sign, v = (m.motor_sign, m.motor_velocity) if motor else (m.joint_sign, m.joint_velocity)
                slow = np.abs(v) < REVERSAL * width
                if torque is not None:
                    product += float(sign[slow] @ (torque @ self.amplitudes(k))[slow])
                    size += float(sign[slow] @ sign[slow])
            total += product / size if size > 0.0 else 0.0
        return total

    def slopes(self, k: int) -> Array:
        """Stiffness of the k-th chosen effect for unit amplitudes."""
        chosen = self.chosen[k]
        return self.search.slopes(chosen.form, chosen.shape)

    def columns(self, k: int) -> slice:
        """Where the columns of the k-th chosen effect stand; it has a free amplitude."""
        first = len(self.problem.names)
        for c in self.chosen[:k]:
            first += 0 if c.form.signature.fixed is not None else self.search.rows(c.form, c.shape).shape[1]
        return slice(first, first + self.search.rows(self.chosen[k].form, self.chosen[k].shape).shape[1])


class Fitter:
    """Fits of one record.

    Parameters
    ----------
    forms : sequence of Form
        Effects that may be tried.
    shifts : tuple of float
        Periods by which the torque may act later than its stamp says.
    """

    def __init__(self, forms: Sequence[Form], shifts: tuple[float, ...]) -> None:
        self.forms, self.shifts = tuple(forms), shifts

    def fit(self, problem: Problem, chosen: Sequence[Chosen] = (), search: Search | None = None) -> Fitted:
        """Linear fit at the given shapes."""
        search = search or Search(problem, self.forms)
        y, columns = search.target, [search.base]
        for form, amplitudes in problem.applied.items():
            # What was taken out of the signals counts as found, so that amplitudes are whole ones.
            y = y + search.rows(form, ()) @ amplitudes
        for c in chosen:
            rows = search.rows(c.form, c.shape)
            if c.form.signature.fixed is not None:
                y = y - rows[:, 0] * c.form.signature.fixed
            else:
                columns.append(rows)
        return Fitted(problem, search, tuple(chosen), solve(np.hstack(columns), y), y)

    def relax(
        self,
        problem: Problem,
        chosen: Sequence[Chosen] = (),
        rounds: int = 3,
        search: Search | None = None,
    ) -> Fitted:
        """Fit; move linearisation, reversal widths, the torque's timing and shapes.

        That is repeated until nothing changes, or ``rounds`` times. A ``search`` of the problem spares its columns.
        """
        fitted = self.fit(problem, chosen, search)
        best = fitted
        for _ in range(rounds):
            base = self._widths(fitted, self.moved(fitted))
            moved = problem.at(
                base,
                shift=self._shift(fitted),
                applied=self._errors(fitted),
                stiffening=fitted.stiffening,
                passing=passing(fitted),
            )
            fitted = self._shapes(self._reversing(self.fit(moved, fitted.chosen)))
            gained = best.loss - fitted.loss
            best = fitted if gained > 0.0 else best
            if abs(gained) < SETTLED:
                break
        return best

    def relaxed(self, fitted: Fitted, models: Iterable[Sequence[Chosen]], rounds: int = 2) -> list[Fitted]:
        """Other sets of effects in the place of a fit's, each relaxed from where that is linearised."""
        return side_by_side(lambda m: self.relax(fitted.problem, m, rounds, fitted.search), models)

    def reweighted(self, fitted: Fitted) -> Fitted:
        """The same model with reversals and weights of rows that know of its effects (both encoders)."""
        if not fitted.problem.both:
            return fitted
        relaxed = self.relax(informed(fitted.problem, fitted), fitted.chosen, rounds=1)
        return self.settled(self._shapes(relaxed, NEAR))

    def settled(self, fitted: Fitted) -> Fitted:
        """The same model linearised where its own fit is: only there an effect has one amplitude in both equations.

        Elsewhere the cost may be lower, and the stiffness is another one.
        """
        for _ in range(SETTLING_STEPS):
            base = self.moved(fitted)
            if abs(base.K / fitted.problem.base.K - 1.0) < SETTLED_STIFFNESS:
                break
            problem = fitted.problem.at(
                base, applied=self._errors(fitted), stiffening=fitted.stiffening, passing=passing(fitted)
            )
            fitted = self.fit(problem, fitted.chosen)
        return fitted

    def _reversing(self, fitted: Fitted) -> Fitted:
        """Without a joint encoder, the likelier of the two ways to tell when the load reverses."""
        problem = fitted.problem
        if problem.both or problem.rigid:
            return fitted
        other = self.fit(problem.at(problem.base, led=not problem.led), fitted.chosen)
        return min(fitted, other, key=lambda f: f.loss)

    @staticmethod
    def _errors(fitted: Fitted) -> dict[Form, Array]:
        """Errors of positions that the model holds (both encoders; a simulation takes them out itself)."""
        if not fitted.problem.both:
            return {}
        return {
            c.form: fitted.amplitudes(k)
            for k, c in enumerate(fitted.chosen)
            if c.form.signature.corrected is not None
        }

    @staticmethod
    def moved(fitted: Fitted) -> Base:
        """The baseline that a fit gives."""
        names = fitted.problem.names
        return fitted.problem.moved(fitted.basis.coefficients[: len(names)], fitted.stiffening)

    def _widths(self, fitted: Fitted, base: Base) -> Base:
        """The likeliest reversal widths, of all friction that changes its sign there."""
        problem = fitted.problem
        for field, symbol in REVERSALS.items():
            if symbol not in problem.names:
                continue
            friction = fitted.at_reversal(symbol, getattr(problem.base, field))
            now = float(np.log(getattr(problem.base, field)))
            sign = problem.sign_rows(field, float(np.exp(now)))

            def cost(u: float, field: str = field, friction: float = friction, sign: Array = sign) -> float:
                change = problem.sign_rows(field, float(np.exp(u))) - sign
                e = fitted.basis.outside(fitted.y - friction * change)
                return float(e @ e)

            low = max(now - WIDTH_RANGE, np.log(NARROWEST))
            high = max(min(now + WIDTH_RANGE, self._widest(fitted, symbol)), now)
            first = (max(now - WIDTH_STEP, low), now, min(now + WIDTH_STEP, high))
            best, least = minimum(cost, low, high, first, WIDTH_NEAR, MOST_WIDTHS)
            if least < fitted.cost:
                base = replace(base, **{field: float(np.exp(best))})
        return base

    @staticmethod
    def _widest(fitted: Fitted, symbol: str) -> float:
        """Logarithm of the widest reversal of the motor or the load."""
        if not fitted.problem.both:
            return np.inf
        scale = fitted.search.scale
        speed = scale.motor_speed if symbol == "FSm" else scale.joint_speed
        return float(np.log(max(WIDEST * speed, NARROWEST)))

    def _shift(self, fitted: Fitted) -> float:
        if len(self.shifts) == 1:
            return self.shifts[0]

        def cost(shift: float) -> float:
            e = fitted.basis.outside(fitted.y + fitted.problem.target(shift=shift) - fitted.search.target)
            return float(e @ e)

        return min(self.shifts, key=cost)

    def _shapes(self, fitted: Fitted, reach: float = 1.0) -> Fitted:
        """Refine the shapes of all effects, one after the other, given the rest; ``reach`` as in `Search.refine`."""
        for k, c in enumerate(fitted.chosen):
            if not fitted.search.shapes(c.form):
                continue
            rest = self.fit(fitted.problem, without(fitted.chosen, k), fitted.search)
            now = fitted.search.evaluate(c.form, c.shape, rest.basis)
            best = fitted.search.refine(now, rest.basis, reach=reach)
            chosen = (*fitted.chosen[:k], Chosen(c.form, best.shape), *fitted.chosen[k + 1 :])
            fitted = self.fit(fitted.problem, chosen, fitted.search)
        return fitted

    def candidates(self, fitted: Fitted, instead_of: int | None = None) -> list[Candidate]:
        """The best form of every effect that is not in the model, best first, refused ones last.

        ``instead_of`` takes one of the model's effects out before: what could stand in its place (itself included).
        """
        now = (
            fitted
            if instead_of is None
            else self.fit(fitted.problem, without(fitted.chosen, instead_of), fitted.search)
        )
        taken = {c.name for c in now.chosen}
        forms = [f for f in self.forms if f.name not in taken and not f.signature.extends]
        best = side_by_side(lambda f: fitted.search.best(f, now.basis), forms)
        found = [c for c in best if c is not None]
        by_name: dict[str, Candidate] = {}
        for c in found:
            if c.form.name not in by_name or c.rank < by_name[c.form.name].rank:
                by_name[c.form.name] = c
        for name in {f.name for f in self.forms if f.signature.extends} & set(by_name):
            by_name[name] = self.richest(now, by_name[name])
        return sorted(by_name.values(), key=lambda c: c.rank)

    def richest(self, now: Fitted, plain: Candidate) -> Candidate:
        """The form that extends a candidate's, where it explains clearly more."""
        richer = [f for f in self.forms if f.name == plain.form.name and f.signature.extends]
        if not richer or plain.refused or plain.gain < PROMISING:
            return plain
        found = now.search.extended(richer[0], plain, now.basis)
        return found if not found.refused and found.gain - plain.gain > EXTENDED else plain


def informed(problem: Problem, fitted: Fitted) -> Problem:
    """A record with reversals and weights of rows that know of a model.

    With the motor's encoder alone, of its friction only: the joint's motion is rebuilt, its reversals are its own.
    """
    if not problem.both:
        return trusted(problem)
    effects = held(fitted)
    friction = [
        fitted.at_reversal(symbol, getattr(fitted.problem.base, field)) for field, symbol in REVERSALS.items()
    ]
    return trusted(
        sharpened(problem.at(problem.base, passing=passing(fitted)), [*effects, _gravity(fitted)], friction),
        effects,
    )


def held(fitted: Fitted) -> Effects:
    """The effects of a model with their amplitudes."""
    return [(c.terms, fitted.amplitudes(k)) for k, c in enumerate(fitted.chosen)]


def passing(fitted: Fitted) -> list[Joined]:
    """Those that others come after: what the transmission passes on beside its spring, limits of the torque."""
    pairs = zip(fitted.chosen, held(fitted), strict=True)
    return [
        Joined(*pair, centred=c.form.signature.centred)
        for c, pair in pairs
        if c.form.effect.equation == "transmission" or _limits(c)
    ]


def _limits(chosen: Chosen) -> bool:
    return any(law.stage is Stage.LIMIT for law in chosen.form.effect.laws)


def _gravity(fitted: Fitted) -> tuple[Callable[[Motion], Terms], Array]:
    """The baseline's gravity as an effect (both encoders)."""
    first = fitted.problem.names.index("MX")
    share = fitted.problem.base.K / fitted.problem.stiffness

    def columns(m: Motion) -> Terms:
        return Terms(load=m.gravity * np.column_stack([np.cos(m.joint_position), np.sin(m.joint_position)]))

    return columns, share * fitted.basis.coefficients[first : first + 2]


def without(chosen: Sequence[Chosen], k: int) -> tuple[Chosen, ...]:
    """All chosen effects but the k-th."""
    return (*chosen[:k], *chosen[k + 1 :])
