"""From a solved model to the result that the report renders."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flexid_cli.errors import DataError
from flexid_cli.estimate import bootstrap, budget, checks, identifiability, overdetermination, timing
from flexid_cli.estimate.essential import reduce_solution
from flexid_cli.estimate.pipeline_summary import pipeline_summary
from flexid_cli.estimate.result import Estimate, Fit, ModelResult, Spectrum, Trace
from flexid_cli.estimate.solution import Solution
from flexid_cli.estimate.verdict import correlated_with, demoted, judge, model_doubt, undetermined
from flexid_cli.models.base import Model, Parameter, unit_of
from flexid_cli.pipeline.spectrum import welch

if TYPE_CHECKING:
    from flexid_cli.config.schema import Config
    from flexid_cli.signals.recording import Recording

Array = NDArray[np.float64]

HAC = "Student's t, standard error robust to correlated residuals, with noise and timing budget"
IID = "Student's t, independent residuals"
TORSION_ZERO = Parameter("torsion_zero", "z", "position")
DERIVED = (
    Parameter("resonance", "f1", "frequency"),
    Parameter("antiresonance", "fa", "frequency"),
    Parameter("inertia_ratio", "JL/Jm", "ratio"),
)
SUMS = (
    (Parameter("viscous_friction", "FVm + FV", "viscous"), ("FVm", "FV")),
    (Parameter("coulomb_friction", "FSm + FS", "torque"), ("FSm", "FS")),
)
# Sources of systematic errors that are noise in the columns: what is subtracted, or all of it.
NOISES = ("doubt about the noise in the columns", "encoder and torque noise in the columns")
GEAR_DOUBT = "a doubt about the gear ratio"
CLEAR_GEAR_SIGMA = 5.0
# A ratio of tooth numbers is off by one tooth or not at all: by a thousandth for a ratio of a thousand.
SMALLEST_GEAR_ERROR = 1e-3
SPECTRUM_SEGMENT_S = 8.0
# The restrictions' p value below which their violation widens the intervals.
CONTRADICTED = 0.05
# A uniform doubt between zero and the full shift has this standard deviation about zero.
UNIFORM = 1.0 / np.sqrt(3.0)


@dataclass(frozen=True)
class Uncertainty:
    """Total standard errors and what they are made of.

    Attributes
    ----------
    covariance : ndarray, shape (p, p)
        Random part plus the outer products of the systematic shifts.
    degrees_of_freedom : ndarray, shape (p,)
        Of the total: the systematic part counts as known.
    largest : tuple of str
        The largest systematic source of each parameter where it exceeds the random part, else empty.
    delay : budget.Nuisance
        Torque delay as the residuals show it.
    skew : budget.Nuisance or None
        Age of the joint position beside the motor's, where both are measured.
    gear : budget.Nuisance or None
        Relative error of the gear ratio, where both encoders show one clearly.
    shifts : mapping of str to ndarray, shape (p,)
        Standard error that each systematic source adds.
    random : ndarray, shape (p, p)
        Covariance of the random part.
    """

    covariance: Array
    degrees_of_freedom: Array
    largest: tuple[str, ...]
    delay: budget.Nuisance
    gear: budget.Nuisance | None = None
    skew: budget.Nuisance | None = None
    shifts: Mapping[str, Array] = field(default_factory=dict)
    random: Array = field(default_factory=lambda: np.zeros((0, 0)))


def summarise(solution: Solution, config: Config, *, regression: bool = True) -> ModelResult:
    """Parameters with intervals and verdicts, derived quantities, fit, tests and figures' data."""
    return analyse(solution, config, regression=regression)[0]


def analyse(
    solution: Solution, config: Config, *, regression: bool = True
) -> tuple[ModelResult, Uncertainty]:
    """The result, and what its standard errors are made of, in the model's own parameters."""
    free: tuple[Estimate, ...] = ()
    tests: dict[str, dict[str, Any]] = {}
    misfit = 1.0
    if regression and solution.model.id == "motor_only":
        free, tests["over_determination"] = _free_regression(solution, config)
        misfit = _misfit(tests["over_determination"])
    uncertainty = total_uncertainty(solution, config, misfit)
    parameters, theta, covariance = reported_parameters(
        solution.model, solution.reported.theta, uncertainty.covariance
    )
    estimates = _estimates(solution, config, uncertainty, parameters, theta, covariance)
    fitted = _fit(solution)
    doubt = model_doubt(estimates, fitted.fit_percent)
    if solution.bands is not None:
        tests["band"] = solution.bands.test()
    tests["torque_delay"] = timing.timing_test(uncertainty.delay, solution, timing.DELAY_MEANING)
    if uncertainty.skew is not None:
        tests["encoder_skew"] = timing.timing_test(uncertainty.skew, solution, timing.SKEW_MEANING)
    if regression:
        tests |= checks.solution_tests(solution)
        tests["bootstrap"] = bootstrap.interval_check(solution)
        tests["identifiability"] = identifiability.before_the_solve(solution)
        tests |= _profile(solution, config, uncertainty)
        tests["bias_budget"] = _bias_budget(solution, uncertainty, parameters)
    if solution.reduction is not None:
        tests["essential"] = solution.reduction.test()
    effects = dict.fromkeys(p.effect for p in parameters if p.effect)
    found = ModelResult(
        id=solution.model.id,
        method=solution.method,
        method_reason=solution.method_reason,
        equation=solution.model.equation,
        parameters=identifiability.with_advice([demoted(e, doubt) for e in estimates], solution, doubt),
        regression=tuple(demoted(e, doubt) for e in free),
        derived=identifiability.with_advice(
            [demoted(e, doubt) for e in _derived(solution, config, uncertainty)], solution, doubt
        ),
        correlation_names=tuple(p.symbol for p in parameters),
        correlation=correlation_of(covariance),
        condition_number=solution.result.condition_number,
        rank=solution.result.rank,
        columns=solution.result.theta.size - len(_set_to_zero(solution)),
        fit=fitted,
        pipeline=pipeline_summary(solution),
        trace=_trace(solution),
        spectrum=torque_spectrum(solution.columns.recording),
        added_terms=tuple(effects),
        tests=tests,
        warnings=_warnings(solution, uncertainty, config, doubt),
    )
    return found, uncertainty


def _misfit(test: Mapping[str, Any]) -> float:
    """How much larger than the residuals explain the contradiction of the free coefficients is, where it is sure."""
    p_value = test.get("p_value")
    if p_value is None or p_value > CONTRADICTED:
        return 1.0
    return max(1.0, float(test["scaled_statistic"]))


def _free_regression(solution: Solution, config: Config) -> tuple[tuple[Estimate, ...], dict[str, Any]]:
    """X1..X7 without restrictions and the test of these, or why there are none."""
    try:
        return overdetermination.regression(
            solution, config, make=lambda p, v, s, d: _judge(solution, config, p, v, s, d)
        )
    except DataError as error:
        return (), {"statistic": None, "p_value": None, "reason": error.message}


def reduced(solution: Solution, config: Config) -> Solution:
    """The solution with what the data cannot tell from zero set to zero (`essential`)."""
    misfit = 1.0
    if solution.model.id == "motor_only":
        misfit = _misfit(_free_regression(solution, config)[1])
    shifts = total_uncertainty(solution, config, misfit).shifts
    return reduce_solution(
        solution,
        misfit * solution.reported.covariance,
        shifts,
        level=round(1.0 - config.estimate.confidence_level, 12),
        misfit=misfit,
        covariance=config.estimate.covariance,
    )


def total_uncertainty(solution: Solution, config: Config, misfit: float = 1.0) -> Uncertainty:
    """Random and systematic part of the estimates' uncertainty.

    ``misfit`` multiplies the random covariance (Birge, Phys. Rev. 40 (1932) 207): the free coefficients contradict
    each other by more than the residuals explain, so whatever does that is taken to act on the parameters too.
    """
    model, result, columns = solution.model, solution.result, solution.columns
    lengths = columns.lengths
    delay = budget.torque_delay(model, result, columns, lengths)
    skew = budget.encoder_skew(model, result, columns) if model.id == "two_encoders" else None
    shifts: dict[str, Array] = {}
    if solution.reduction is not None:
        shifts |= solution.reduction.shifts
    if config.estimate.covariance == "hac":
        if solution.correction is not None:
            shifts[NOISES[0]] = solution.correction.doubt
        else:
            levels = budget.limited_torque_noise(
                model, result, columns, budget.noise_levels(columns.recording)
            )
            shifts[NOISES[1]] = budget.noise_bias(model, result, columns, levels)
        torque = config.signals.torque
        if torque.hold != "instant":
            # Declared held, its damping has been applied; but no current controller makes exact steps.
            held = UNIFORM * budget.torque_hold(model, result, columns)
            shifts["the torque between its samples"] = held
        if torque.hold is None and torque.delay_s is None:
            shifts["the torque's timing"] = delay.shift(at_most=0.5 / columns.recording.sample_rate_hz)
        joint = config.signals.joint_position
        if skew is not None and joint is not None and joint.delay_s is None:
            shifts["the encoders' timing"] = skew.shift(at_most=0.5 / columns.recording.sample_rate_hz)
        width = budget.reversal_width(model, result, columns, lengths)
        if width is not None:
            shifts["the width of the friction reversal"] = width.shift(at_most=1.0)
        shifts["the band of the friction's velocity"] = budget.sign_band(model, result, columns)
        if model.id == "rigid":
            flexibility = budget.left_out_flexibility(result, columns)
            shifts["flexibility, which the rigid model leaves out"] = flexibility.shift(at_most=0.0)
    gear = _clear_gear_error(solution)
    if gear is not None:
        shifts[GEAR_DOUBT] = gear.shift(at_most=0.0)
    # An output-error fit has its own random part; what systematic sources do to it is taken from its start.
    random_part = misfit * solution.reported.covariance
    covariance = random_part + sum(np.outer(s, s) for s in shifts.values())
    random = np.maximum(np.diag(random_part), np.finfo(float).tiny)
    share = np.minimum(np.diag(covariance) / random, 1e6)
    dof = np.minimum(solution.reported.degrees_of_freedom * share**2, 1e6)
    largest = []
    for k in range(result.theta.size):
        sizes = {name: abs(float(shift[k])) for name, shift in shifts.items()}
        name = max(sizes, key=sizes.__getitem__, default="")
        largest.append(name if name and shifts[name][k] ** 2 > random[k] else "")
    return Uncertainty(covariance, dof, tuple(largest), delay, gear, skew, shifts, random_part)


def _clear_gear_error(solution: Solution) -> budget.Nuisance | None:
    """The gear ratio's error where the residuals show one beyond doubt: it is a number that people look up."""
    if solution.model.id != "two_encoders":
        return None
    gear = budget.gear_error(solution.model, solution.result, solution.columns)
    clear = np.isfinite(gear.stderr) and abs(gear.value) > CLEAR_GEAR_SIGMA * gear.stderr
    return gear if clear and abs(gear.value) > SMALLEST_GEAR_ERROR else None


def reported_parameters(
    model: Model, theta: Array, covariance: Array
) -> tuple[tuple[Parameter, ...], Array, Array]:
    """Parameters as the report names them, their values and covariance."""
    parameters, reported, G = report_form(model, theta)
    return parameters, reported, G @ covariance @ G.T


def report_form(model: Model, theta: Array) -> tuple[tuple[Parameter, ...], Array, Array]:
    """Parameters as the report names them, values, and derivatives with respect to the model's own, shape (p, p).

    The spring's torque c at zero torsion becomes the zero z = c / K.
    """
    symbols = [p.symbol for p in model.parameters]
    G = np.eye(theta.size)
    if "c" not in symbols:
        return model.parameters, theta, G
    c, k = symbols.index("c"), symbols.index("K")
    G[c, c], G[c, k] = 1.0 / theta[k], -theta[c] / theta[k] ** 2
    reported = theta.copy()
    reported[c] = theta[c] / theta[k]
    parameters = tuple(TORSION_ZERO if p.symbol == "c" else p for p in model.parameters)
    return parameters, reported, G


def _estimates(
    solution: Solution,
    config: Config,
    uncertainty: Uncertainty,
    parameters: tuple[Parameter, ...],
    theta: Array,
    covariance: Array,
) -> tuple[Estimate, ...]:
    correlation = correlation_of(covariance)
    symbols = tuple(p.symbol for p in parameters)
    estimates = []
    for k, parameter in enumerate(parameters):
        if k in solution.result.dependent:
            estimates.append(_without_estimate(solution, parameters, theta, covariance, k))
            continue
        apart = (*solution.result.dependent, *identifiability.others_of(symbols, k))
        sum_ = identifiability.determined(theta, covariance, k, apart)
        unit = _unit(solution, parameter)
        in_words = identifiability.in_words(sum_, symbols, theta, covariance, unit)
        doubts = [correlated_with(correlation, symbols, k), in_words]
        if uncertainty.largest[k]:
            doubts.append(f"limited by {uncertainty.largest[k]}")
        estimates.append(
            _judge(
                solution,
                config,
                parameter,
                float(theta[k]),
                float(np.sqrt(covariance[k, k])),
                float(uncertainty.degrees_of_freedom[k]),
                "; ".join(d for d in doubts if d),
            )
        )
    return tuple(estimates)


def _without_estimate(
    solution: Solution, parameters: tuple[Parameter, ...], theta: Array, covariance: Array, k: int
) -> Estimate:
    """A parameter that was set to zero, or whose column depends on others."""
    parameter, unit = parameters[k], _unit(solution, parameters[k])
    fixed = _set_to_zero(solution)
    if solution.reduction is not None and k in fixed:
        return undetermined(parameter, unit, solution.reduction.reason(k))
    symbols = [p.symbol for p in parameters]
    others = ", ".join(symbols[j] for j in solution.result.dependent if j not in {k, *fixed})
    if not others or not np.any(solution.result.jacobian[:, k]):
        return undetermined(parameter, unit, "its column is zero")
    sum_ = identifiability.exact(solution.result.jacobian, k)
    in_words = identifiability.in_words(sum_, symbols, theta, covariance, unit)
    reason = f"its column depends on those of {others}" + (f": {in_words}" if in_words else "")
    return undetermined(parameter, unit, reason)


def _judge(
    solution: Solution,
    config: Config,
    parameter: Parameter,
    value: float,
    stderr: float,
    dof: float,
    doubt: str = "",
) -> Estimate:
    return judge(
        parameter,
        _unit(solution, parameter),
        value,
        stderr,
        dof,
        level=config.estimate.confidence_level,
        method=HAC if config.estimate.covariance == "hac" else IID,
        doubt=doubt,
    )


def _unit(solution: Solution, parameter: Parameter) -> str:
    recording = solution.columns.recording
    return unit_of(parameter.quantity, linear=recording.linear, torque_unit=recording.torque_unit)


def fitted_resonance(model: Model, theta: Array) -> float | None:
    """Free-free resonance of the fitted parameters, Hz; None for a rigid model or forbidden signs."""
    symbols = [p.symbol for p in model.parameters]
    if "K" not in symbols:
        return None
    Jm, K, JL = (float(theta[symbols.index(s)]) for s in ("Jm", "K", "JL"))
    if min(Jm, K, JL) <= 0.0:
        return None
    return float(np.sqrt(K * (1.0 / Jm + 1.0 / JL)) / (2.0 * np.pi))


def _derived(solution: Solution, config: Config, uncertainty: Uncertainty) -> tuple[Estimate, ...]:
    """Quantities that are functions of the parameters, where they exist, by the delta method."""
    symbols = tuple(p.symbol for p in solution.model.parameters)
    if "K" not in symbols:
        return ()
    strong = {symbols.index(s) for s in ("Jm", "K", "JL")}
    if strong & set(solution.result.dependent):  # they may be zero then
        return ()
    theta = solution.reported.theta
    values = dict(zip(symbols, (float(x) for x in theta), strict=True))
    found = []
    zero = {symbols[k] for k in _set_to_zero(solution)}
    for parameter, value, slopes in (*resonances(values), *sums(solution.model, values)):
        left = {s: x for s, x in slopes.items() if s not in zero}
        index = [symbols.index(s) for s in left]
        if index and not set(index) & set(solution.result.dependent):
            g = np.array(list(left.values()))
            stderr = float(np.sqrt(g @ uncertainty.covariance[np.ix_(index, index)] @ g))
            dof = float(np.min(uncertainty.degrees_of_freedom[index]))
            found.append(_judge(solution, config, parameter, value, stderr, dof))
    return tuple(found)


def _set_to_zero(solution: Solution) -> tuple[int, ...]:
    return () if solution.reduction is None else solution.reduction.fixed


def resonances(v: Mapping[str, float]) -> Iterator[tuple[Parameter, float, Mapping[str, float]]]:
    """Resonance, antiresonance and inertia ratio: parameter, value and its derivatives by symbol."""
    Jm, K, JL = v["Jm"], v["K"], v["JL"]
    for parameter, square, slopes in (
        (DERIVED[0], K / Jm + K / JL, {"Jm": -K / Jm**2, "K": 1.0 / Jm + 1.0 / JL, "JL": -K / JL**2}),
        (DERIVED[1], K / JL, {"Jm": 0.0, "K": 1.0 / JL, "JL": -K / JL**2}),
    ):
        if square > 0.0:
            frequency = float(np.sqrt(square)) / (2.0 * np.pi)
            yield parameter, frequency, {s: x * 0.5 * frequency / square for s, x in slopes.items()}
    yield DERIVED[2], JL / Jm, {"Jm": -JL / Jm**2, "K": 0.0, "JL": 1.0 / Jm}


def sums(model: Model, v: Mapping[str, float]) -> Iterator[tuple[Parameter, float, Mapping[str, float]]]:
    """Friction of motor and load together, where a model hardly tells one from the other."""
    split = {p.symbol for p in model.parameters if p.split}
    for parameter, (motor, load) in SUMS:
        if {motor, load} <= split:
            yield parameter, v[motor] + v[load], {motor: 1.0, load: 1.0}


def correlation_of(covariance: Array) -> Array:
    """Correlation matrix; NaN where a parameter has no variance."""
    size = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    size[size == 0.0] = np.nan
    return np.asarray(covariance / np.outer(size, size), dtype=np.float64)


def _fit(solution: Solution) -> Fit:
    torque = solution.columns("torque", 0)
    residual = solution.result.residuals[0]
    spread = float(np.linalg.norm(torque - torque.mean()))
    return Fit(
        torque_rms=float(np.sqrt(np.mean(torque**2))),
        residual_rms=float(np.sqrt(np.mean(residual**2))),
        fit_percent=100.0 * (1.0 - float(np.linalg.norm(residual)) / spread) if spread else 0.0,
        unit=solution.columns.recording.torque_unit,
    )


def _trace(solution: Solution) -> Trace:
    torque = solution.columns("torque", 0)
    predicted = torque - solution.result.residuals[0]
    return Trace(solution.columns.times, torque, predicted, solution.columns.recording.torque_unit)


def torque_spectrum(recording: Recording) -> Spectrum:
    """Spectrum of the unfiltered torque of the longest segment."""
    segment = max(recording.segments, key=lambda s: s.samples)
    length = int(min(segment.samples, max(256, SPECTRUM_SEGMENT_S * recording.sample_rate_hz)))
    frequency, density = welch(segment.torque, recording.sample_rate_hz, length)
    return Spectrum(frequency[1:], np.sqrt(density[1:]), f"{recording.torque_unit}/sqrt(Hz)")


def _profile(solution: Solution, config: Config, uncertainty: Uncertainty) -> dict[str, dict[str, Any]]:
    """Profile interval of the stiffness, for estimates that the estimating equations give directly."""
    symbols = [p.symbol for p in solution.model.parameters]
    if "K" not in symbols or solution.method in {"irls", "minimum_distance", "output_error"}:
        return {}
    k = symbols.index("K")
    if k in solution.result.dependent or not uncertainty.covariance[k, k] > 0.0:
        return {}
    stderr = float(np.sqrt(uncertainty.covariance[k, k]))
    return {"stiffness_profile": checks.stiffness_profile(solution, stderr, config.estimate.confidence_level)}


def _bias_budget(
    solution: Solution, uncertainty: Uncertainty, parameters: tuple[Parameter, ...]
) -> dict[str, Any]:
    """What was corrected, and what each systematic source may still add, in per cent of each parameter."""
    theta = solution.reported.theta
    budget_of: dict[str, Any] = {}
    for k, parameter in enumerate(parameters):
        if k in solution.result.dependent or parameter is TORSION_ZERO or theta[k] == 0.0:
            continue
        sources = {name: 100.0 * abs(float(s[k] / theta[k])) for name, s in uncertainty.shifts.items()}
        entry: dict[str, Any] = {"random_percent": 100.0 * abs(solution.reported.stderr[k] / theta[k])}
        if solution.correction is not None:
            entry["corrected_percent"] = 100.0 * float(solution.correction.shift[k] / theta[k])
        budget_of[parameter.symbol] = {**entry, "systematic_percent": sources}
    share = None if solution.correction is None else solution.correction.share
    return {
        "noise_share": share,
        "parameters": budget_of,
        "meaning": "largest share of noise in what the parameters rest on; the JSON holds the budget by parameter",
    }


def _warnings(solution: Solution, uncertainty: Uncertainty, config: Config, doubt: str) -> tuple[str, ...]:
    model = solution.model.id
    warnings = [f"{model}: {doubt}; no parameter counts as identified"] if doubt else []
    warnings += solution.notes
    # With physics missing the residuals' delay is a symptom, not a timing that could be set.
    if not doubt:
        warnings += timing.delay_warning(solution, uncertainty.delay, config)
        if uncertainty.skew is not None:
            warnings += timing.skew_warning(solution, uncertainty.skew, config)
    if uncertainty.gear is not None:
        ratio = config.axis.gear_ratio * (1.0 + uncertainty.gear.value)
        warnings.append(
            f"{model}: motor and joint move as if the gear ratio were {ratio:.6g} instead of"
            f" {config.axis.gear_ratio:.6g}; check axis.gear_ratio, or the transmission or gravity hides more"
        )
    if not solution.result.converged:
        warnings.append(f"{model}: the fit did not settle; treat its numbers with care")
    f1 = fitted_resonance(solution.model, solution.result.theta) or solution.tuning.f1_hz
    band = solution.columns.chain.band_hz
    if f1 and model != "rigid" and band < f1:
        warnings.append(
            f"{model}: the effective band ends at {band:.3g} Hz, below the resonance at {f1:.3g} Hz"
        )
    return tuple(warnings)
