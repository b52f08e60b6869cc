"""Essential parameters: those whose data tell them from zero. The others are set to zero and the rest fitted again.

Backward elimination by Wald's test: the parameter with the largest p value is dropped while that exceeds the level,
one at a time, each time with a new fit. The test takes the covariance that the report states (robust to correlated
residuals, systematic parts included) and its degrees of freedom, so correlated rows do not count as many. A second
test, of all dropped parameters together in the full model, keeps several small steps from making a large one, and a
parameter without which the residual grows by a tenth stays whatever the tests say.

Only a parameter that physics lets be zero can go: friction, gravity, an offset, the encoders' zeros. Inertias and the
stiffness stay. The rest does not become surer by the choice: what the dropped ones may be after all stays in its
intervals (intervals of a model that was chosen by a test, as if it had been given, are too narrow: Leeb and Potscher,
Econometric Theory 21 (2005) 21).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flexid_cli.errors import DataError
from flexid_cli.estimate.corrected import correct
from flexid_cli.estimate.fit import FitResult, fit, scaled_inverse
from flexid_cli.estimate.irls import fit_irls
from flexid_cli.estimate.minimum_distance import fit_minimum_distance
from flexid_cli.estimate.output_error import refine_output
from flexid_cli.models.base import Block, Model, Parameter

if TYPE_CHECKING:
    from flexid_cli.estimate.solution import Solution

Array = NDArray[np.float64]

# Without these there is no axis to speak of.
NEVER_ZERO = frozenset({"Jm", "K", "JL", "Jm+JL"})
# Where the spring is without torque is reported as an angle; both are zero together.
REPORTED = {"c": "z"}
# A systematic doubt (timing, the width of a reversal) may leave a parameter without a clear value although the torque
# needs it: where the residual would grow by a tenth, it stays.
MATTERS = 1.1
# Degrees of freedom beyond which Student's t is a normal variable.
MANY = 1e6


@dataclass(frozen=True)
class Step:
    """One parameter dropped.

    Attributes
    ----------
    index, symbol : int, str
        The parameter.
    statistic, degrees_of_freedom, p_value : float
        Wald's F with one restriction, in the model that was left before this step.
    """

    index: int
    symbol: str
    statistic: float
    degrees_of_freedom: float
    p_value: float


@dataclass(frozen=True)
class Reduction:
    """What was set to zero, in order.

    Attributes
    ----------
    level : float
        A parameter goes while its p value exceeds this.
    steps : tuple of Step
        In the order of the elimination.
    statistic, p_value : float or None
        F of all dropped parameters together in the full model.
    shifts : mapping of str to ndarray, shape (p,)
        Standard errors that setting them to zero adds to the others.
    kept : tuple of str
        Parameters that stay although the level would let them go, each with the reason.
    """

    level: float
    steps: tuple[Step, ...] = ()
    statistic: float | None = None
    p_value: float | None = None
    shifts: Mapping[str, Array] = field(default_factory=dict)
    kept: tuple[str, ...] = ()

    @property
    def fixed(self) -> tuple[int, ...]:
        """Indices of the dropped parameters, in order."""
        return tuple(step.index for step in self.steps)

    def reason(self, index: int) -> str:
        """Why a parameter was dropped; empty where it was not."""
        for order, step in enumerate(self.steps, 1):
            if step.index == index:
                return (
                    f"not essential: F = {step.statistic:.3g}, p = {step.p_value:.2g}, dropped as number {order}"
                    " and set to zero"
                )
        return ""

    def test(self) -> dict[str, Any]:
        """For the report's tests."""
        steps = [
            {
                "order": order,
                "symbol": s.symbol,
                "statistic": s.statistic,
                "degrees_of_freedom": s.degrees_of_freedom,
                "p_value": s.p_value,
            }
            for order, s in enumerate(self.steps, 1)
        ]
        found: dict[str, Any] = {
            "level": self.level,
            "dropped": ", ".join(s.symbol for s in self.steps) or "none",
            "steps": steps,
            "statistic": self.statistic,
            "p_value": self.p_value,
            "meaning": "F of all dropped parameters together; those that are left differ from zero at this level, and"
            " their intervals hold what the dropped ones may be after all",
        }
        return {**found, "kept": "; ".join(self.kept)} if self.kept else found


class Restricted:
    """A model with some parameters held at zero: the same parameters and columns, no derivative by these.

    Parameters
    ----------
    model : Model
        The full model.
    fixed : sequence of int
        Parameters held at zero.
    """

    def __init__(self, model: Model, fixed: Sequence[int]) -> None:
        self._model = model
        self._free = ~np.isin(np.arange(len(model.parameters)), list(fixed))

    @property
    def id(self) -> str:
        """Name of the full model."""
        return self._model.id

    @property
    def equation(self) -> str:
        """Equation of the full model."""
        return self._model.equation

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """All parameters, those at zero too."""
        return self._model.parameters

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Equations of the full model."""
        return self._model.blocks

    def coefficients(self, theta: Array) -> tuple[Array, ...]:
        """Coefficients of each block's columns."""
        return self._model.coefficients(np.where(self._free, theta, 0.0))

    def jacobian(self, theta: Array) -> tuple[Array, ...]:
        """Their derivatives; zero by the parameters that are held."""
        return tuple(D * self._free for D in self._model.jacobian(np.where(self._free, theta, 0.0)))


def reduce_solution(
    solution: Solution,
    random: Array,
    shifts: Mapping[str, Array],
    *,
    level: float,
    misfit: float = 1.0,
    covariance: str = "hac",
) -> Solution:
    """Drop what is not essential, and fit the rest again.

    Parameters
    ----------
    solution : Solution
        The full model.
    random : ndarray, shape (p, p)
        Random part of its covariance as reported.
    shifts : mapping of str to ndarray, shape (p,)
        Standard error by each systematic source.
    level : float
        Largest p value of what stays.
    misfit : float
        Factor of the random part of the reduced fits.
    covariance : {"hac", "iid"}
        As `fit.fit`.

    Returns
    -------
    Solution
        With ``reduction``, and the reduced fit where something was dropped.
    """
    systematic = np.column_stack(list(shifts.values())) if shifts else np.zeros((random.shape[0], 0))
    full = _Tested(solution.reported, random, systematic, covariance == "hac")
    reduction, current, staying = Reduction(level), solution, set[int]()
    while True:
        tested = _after(current, full, reduction.fixed, systematic, misfit)
        step = _weakest(solution, tested, {*reduction.fixed, *staying})
        if step is None or step.p_value <= level:
            break
        fixed = (*reduction.fixed, step.index)
        statistic, p_value = full.joint(fixed)
        refitted = None if p_value <= level else _refit(solution, fixed, covariance)
        why = _matters(solution, refitted, p_value, level)
        if why or refitted is None:
            staying.add(step.index)
            reduction = replace(reduction, kept=(*reduction.kept, f"{step.symbol}: {why}"))
            continue
        current = refitted
        reduction = replace(reduction, steps=(*reduction.steps, step), statistic=statistic, p_value=p_value)
    return replace(current, reduction=replace(reduction, shifts=_left_open(full, reduction)))


@dataclass(frozen=True)
class _Tested:
    """A fit with the covariance that its tests use: random part, and systematic shifts as columns."""

    result: FitResult
    random: Array
    systematic: Array
    robust: bool

    @property
    def covariance(self) -> Array:
        return np.asarray(self.random + self.systematic @ self.systematic.T)

    @property
    def degrees_of_freedom(self) -> Array:
        """Of the total, whose systematic part counts as known."""
        random = np.diag(self.random)
        share = np.diag(self.covariance) / np.where(random > 0.0, random, np.inf)
        dof = np.minimum(self.result.degrees_of_freedom * np.minimum(share, MANY) ** 2, MANY)
        return np.asarray(dof, dtype=np.float64)

    def joint(self, fixed: Sequence[int]) -> tuple[float, float]:
        """F that all of these are zero, and its p value."""
        from scipy.special import fdtrc

        pick, count = list(fixed), len(fixed)
        theta = self.result.theta[pick]
        wald = float(theta @ scaled_inverse(self.covariance[np.ix_(pick, pick)]) @ theta)
        series = float(np.min(self.degrees_of_freedom[pick]))
        # A robust covariance has an error in every direction (Hotelling); the textbook's only one, of its scale.
        remaining = max(series - count + 1.0, 1.0) if self.robust else series
        statistic = wald / count * remaining / series
        return statistic, float(fdtrc(count, remaining, max(statistic, 0.0)))


def _matters(solution: Solution, refitted: Solution | None, p_value: float, level: float) -> str:
    """Why a parameter stays that by itself could go, or empty."""
    if p_value <= level:
        return "with those dropped before it differs from zero"
    if refitted is None:
        return "the fit without it does not settle"
    growth = _size(refitted.reported) / max(_size(solution.reported), np.finfo(float).tiny)
    return f"without it the residual grows by {100.0 * growth - 100.0:.0f} %" if growth > MATTERS else ""


def _size(result: FitResult) -> float:
    """Of the weighted residuals of all equations."""
    parts = [w * e for w, e in zip(result.weights, result.residuals, strict=True)]
    return float(np.sqrt(sum(float(x @ x) for x in parts)))


def _weakest(solution: Solution, tested: _Tested, held: set[int]) -> Step | None:
    """The parameter that can least be told from zero among those that may be zero."""
    steps = []
    for k, parameter in enumerate(solution.model.parameters):
        out = k in held or k in solution.result.dependent or parameter.symbol in NEVER_ZERO
        if not out and tested.random[k, k] > 0.0:
            statistic, p_value = tested.joint([k])
            dof = float(tested.degrees_of_freedom[k])
            symbol = REPORTED.get(parameter.symbol, parameter.symbol)
            steps.append(Step(k, symbol, statistic, dof, p_value))
    return max(steps, key=lambda s: (s.p_value, -s.statistic, -s.index), default=None)


def _after(
    current: Solution, full: _Tested, fixed: Sequence[int], systematic: Array, misfit: float
) -> _Tested:
    """The reduced fit, its systematic shifts those of the full one with the dropped parameters held."""
    if not fixed:
        return full
    gain = _gain(full.result.bread, fixed)
    shifts = systematic - gain @ systematic[list(fixed)]
    return _Tested(current.reported, misfit * current.reported.covariance, shifts, full.robust)


def _gain(matrix: Array, fixed: Sequence[int]) -> Array:
    """What the parameters change by for each unit that the fixed ones are held away from their estimate."""
    pick = list(fixed)
    return np.asarray(matrix[:, pick] @ scaled_inverse(matrix[np.ix_(pick, pick)]), dtype=np.float64)


def _left_open(full: _Tested, reduction: Reduction) -> dict[str, Array]:
    """Shifts of the others by what the dropped parameters may be: their estimate, and its own standard error."""
    if not reduction.steps:
        return {}
    pick = list(reduction.fixed)
    theta = full.result.theta[pick]
    size = full.covariance[np.ix_(pick, pick)] + np.outer(theta, theta)
    scale = np.sqrt(np.diag(size))
    values, vectors = np.linalg.eigh(size / np.outer(scale, scale))
    roots = (vectors * np.sqrt(np.maximum(values, 0.0))) * scale[:, None]
    open_ = _gain(full.result.bread, pick) @ roots
    open_[pick] = 0.0
    one = f"{reduction.steps[0].symbol}, set to zero"
    if len(pick) == 1:
        return {one: open_[:, 0]}
    return {f"what was set to zero ({k} of {len(pick)})": open_[:, k - 1] for k in range(1, len(pick) + 1)}


def _refit(solution: Solution, fixed: Sequence[int], covariance: str) -> Solution | None:
    """The solution by the same estimator with these parameters at zero, or None where it does not settle."""
    model = Restricted(solution.model, fixed)
    theta = solution.result.theta.copy()
    theta[list(fixed)] = 0.0
    try:
        result = _equations(replace(solution, model=model), theta, covariance)
    except DataError:
        return None
    if result is None:
        return None
    result = _without(result, solution.result.dependent, fixed)
    reduced = replace(solution, model=model, result=result, correction=_cut(solution, fixed))
    if solution.outputs is None:
        return reduced
    outputs = refine_output(model, solution.columns, result).result
    return None if outputs is None else replace(reduced, outputs=outputs)


def _equations(solution: Solution, theta: Array, covariance: str) -> FitResult | None:
    """Fit of the restricted model by the solution's estimator."""
    model, lengths = solution.model, solution.columns.lengths
    if solution.method == "irls":
        return fit_irls(model, solution.matrices, theta, lengths, weighted=len(model.blocks) > 1)[0]
    start = replace(solution.result, theta=theta)
    if solution.method == "minimum_distance":
        instruments = None if solution.instruments is None else solution.instruments[0]
        return fit_minimum_distance(model, solution.matrices[0], lengths, start, instruments)
    if solution.correction is None and solution.instruments is None:
        weighted = len(model.blocks) > 1 and solution.method != "ols"
        result = fit(model, solution.matrices, theta, lengths, weighted=weighted, covariance=covariance)
        return result if result.converged else None
    moments = () if solution.correction is None else solution.correction.moments
    none = tuple(np.zeros((M.shape[1], M.shape[1])) for M in solution.matrices)
    return correct(
        model, solution.matrices, start, lengths, moments=moments or none, instruments=solution.instruments
    )


def _without(result: FitResult, dependent: Sequence[int], fixed: Sequence[int]) -> FitResult:
    """The fit with rank and condition number of the parameters that are left."""
    theta = result.theta.copy()
    theta[list(fixed)] = 0.0
    J = np.delete(result.jacobian, list(fixed), axis=1)
    scale = np.linalg.norm(J, axis=0)
    scale[scale == 0.0] = 1.0
    s = np.linalg.svd(J / scale, compute_uv=False)
    return replace(
        result,
        theta=theta,
        condition_number=float(s[0] / s[-1]) if s[-1] > 0.0 else float("inf"),
        rank=int(np.sum(s > J.shape[0] * np.finfo(float).eps * s[0])),
        dependent=tuple(sorted({*dependent, *fixed})),
    )


def _cut(solution: Solution, fixed: Sequence[int]) -> Any:
    """The correction, with nothing left of it for the parameters at zero."""
    if solution.correction is None:
        return None
    shift, doubt = solution.correction.shift.copy(), solution.correction.doubt.copy()
    shift[list(fixed)] = doubt[list(fixed)] = 0.0
    return replace(solution.correction, shift=shift, doubt=doubt)
