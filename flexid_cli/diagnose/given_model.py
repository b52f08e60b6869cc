"""A model with named effects as the result of an identification: estimates, evidence, fit and what was done."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from flexid_cli.diagnose import evidence, verdict
from flexid_cli.diagnose.estimates import (
    BASE_PARAMETERS,
    RIGID,
    Solved,
    base_estimates,
    effect_estimates,
    solved,
)
from flexid_cli.diagnose.estimates import METHOD as WHITENED
from flexid_cli.diagnose.fitter import Chosen, Fitted, Fitter
from flexid_cli.diagnose.location import residual_maps
from flexid_cli.diagnose.problem import Problem
from flexid_cli.diagnose.rows import TAPER_S, Weights
from flexid_cli.diagnose.search import Search
from flexid_cli.diagnose.selection import threshold
from flexid_cli.diagnose.stretch import HALF_WIDTH, MARGIN, MOTOR_SIGN_BAND
from flexid_cli.effects.base import Effect, unit_of
from flexid_cli.effects.registry import effects as library
from flexid_cli.estimate.result import Estimate, Fit, ModelEffect, ModelResult, PipelineSummary, Trace
from flexid_cli.estimate.summary import TORSION_ZERO, correlation_of, resonances, sums, torque_spectrum
from flexid_cli.estimate.verdict import demoted, judge, undetermined
from flexid_cli.models.base import Parameter
from flexid_cli.models.base import unit_of as model_unit
from flexid_cli.models.motor_only import MotorOnly
from flexid_cli.models.rigid import Rigid
from flexid_cli.models.two_encoders import TwoEncoders

if TYPE_CHECKING:
    from flexid_cli.config.schema import Config
    from flexid_cli.signals.recording import Recording

Array = NDArray[np.float64]

SIGNIFICANT = 0.05  # p value above which an effect counts as not there
EDGE = 0.01  # share of its range within which a shape stands at the range's end
LINES = 400  # of the filter's magnitude, for the figure
METHOD = "whitened least squares with {}"


@dataclass(frozen=True)
class Joined:
    """A model without named effects and with them.

    Attributes
    ----------
    model_id : str
    fitter : Fitter
    before, after : Fitted
        Without the named effects, and with those that could be joined.
    effects : tuple of Effect
        What was named and is not part of the model anyhow.
    refused : mapping of str to str
        Those that could not be joined, and why.
    told : tuple of str
        Warnings.
    recording, config : Recording, Config
        As the model sees them: without the joint encoder where it does not use it.
    """

    model_id: str
    fitter: Fitter
    before: Fitted
    after: Fitted
    effects: tuple[Effect, ...]
    refused: Mapping[str, str]
    told: tuple[str, ...]
    recording: Recording
    config: Config

    @cached_property
    def solved(self) -> Solved:
        """Coefficients and covariance with the effects."""
        return solved(self.after)

    @cached_property
    def gains(self) -> list[float]:
        """What leaving out each effect of the model costs."""
        return evidence.gains(self.fitter, self.after)

    @cached_property
    def held_out_gain(self) -> float:
        """What the effects together explain of blocks that they were not fitted to."""
        return evidence.held_out_gain(*(evidence.cross_validated(f) for f in (self.before, self.after)))

    @cached_property
    def doubt(self) -> str:
        """Why no parameter counts as identified, or nothing; as in a diagnosis."""
        after = self.after
        if verdict.is_poor(after.problem):
            return "the torque hardly stands above its own noise"
        if not after.is_possible:
            return "an inertia or the stiffness comes out negative: the model lacks something"
        if verdict.remainder(
            after.basis.rms, residual_maps(after.problem, after.basis), both=after.problem.both
        ):
            return "the model still leaves out something; `flexid diagnose` says where"
        if self.model_id == "motor_only" and not after.problem.settled:
            return "no resonance stands out of the record, so the motor encoder alone does not show the stiffness"
        return ""


def model_result(joined: Joined) -> ModelResult:
    """Everything that the report says of the model."""
    after, names = joined.after, [c.name for c in joined.after.chosen]
    own = [e.name for e in joined.effects if e.name in names]
    held = [e.name for e in library() if e.name in names and e.name not in own]
    X = after.basis.columns
    trace, fit = _fit(joined)
    symbols, correlation = _correlation(joined)
    parameters = _parameters(joined, after, joined.solved, held)
    return ModelResult(
        id=joined.model_id,
        method=METHOD.format(", ".join(own)) if own else METHOD.format("no effect"),
        method_reason="rows weighted by the signals' own noise, shapes of the effects searched, as `flexid diagnose`"
        " does; all parameters estimated together",
        equation=_equation(joined, [*held, *own]),
        parameters=parameters,
        regression=(),
        derived=_derived(joined, parameters),
        correlation_names=symbols,
        correlation=correlation,
        condition_number=float(np.linalg.cond(X / np.maximum(np.linalg.norm(X, axis=0), 1e-300))),
        rank=after.basis.Q.shape[1],
        columns=X.shape[1],
        fit=fit,
        pipeline=_pipeline(joined),
        trace=trace,
        spectrum=torque_spectrum(joined.recording),
        added_terms=(*held, *own),
        tests={},
        warnings=_warnings(joined),
        effects=tuple(_effect(joined, e) for e in joined.effects),
        parameters_before=_parameters(joined, joined.before, solved(joined.before), held) if own else (),
    )


def _parameters(joined: Joined, fitted: Fitted, result: Solved, held: Sequence[str]) -> tuple[Estimate, ...]:
    """The baseline's parameters, and those of the effects that the model of `identify` holds anyhow."""
    recording, level = joined.recording, joined.config.estimate.confidence_level
    linear, unit = recording.linear, recording.torque_unit
    found = list(base_estimates(fitted, result, linear=linear, torque_unit=unit, level=level))
    if "c" in fitted.problem.names:
        found.append(_torsion_zero(joined, fitted, result))
    places = {chosen.name: k for k, chosen in enumerate(fitted.chosen)}
    for name in held:
        found += effect_estimates(fitted, places[name], result, linear=linear, torque_unit=unit, level=level)
    return tuple(demoted(e, joined.doubt) for e in found)


def _torsion_zero(joined: Joined, fitted: Fitted, result: Solved) -> Estimate:
    """Difference of the encoders' zeros; the columns hold the spring's torque at the one of the linearisation."""
    problem, recording = fitted.problem, joined.recording
    c = problem.names.index("c")
    value = problem.base.torsion_zero - float(result.coefficients[c]) / problem.stiffness
    stderr = float(np.sqrt(max(result.covariance[c, c], 0.0))) / problem.stiffness
    unit = unit_of(TORSION_ZERO.quantity, linear=recording.linear, torque_unit=recording.torque_unit)
    level, dof = joined.config.estimate.confidence_level, float(result.degrees_of_freedom[c])
    return judge(TORSION_ZERO, unit, value, stderr, dof, level=level, method=WHITENED)


def _derived(joined: Joined, parameters: Sequence[Estimate]) -> tuple[Estimate, ...]:
    """Resonance, antiresonance, inertia ratio, and with the motor's encoder alone the sums of friction."""
    problem, result, recording = joined.after.problem, joined.solved, joined.recording
    values = {e.symbol: e.value for e in parameters if e.symbol in problem.names and e.value is not None}
    if problem.rigid or not {"Jm", "K", "JL"} <= values.keys() or not joined.after.is_possible:
        return ()
    friction = () if problem.both else sums(MotorOnly("none"), values)
    out = []
    for parameter, value, slopes in (*resonances(values), *friction):
        index = [problem.names.index(symbol) for symbol in slopes]
        g = np.array(list(slopes.values()))
        stderr = float(np.sqrt(g @ result.covariance[np.ix_(index, index)] @ g))
        dof = float(np.min(result.degrees_of_freedom[index]))
        # Not the effects' units: these know no frequency.
        unit = model_unit(parameter.quantity, linear=recording.linear, torque_unit=recording.torque_unit)
        level = joined.config.estimate.confidence_level
        out.append(judge(parameter, unit, value, stderr, dof, level=level, method=WHITENED))
    return tuple(demoted(e, joined.doubt) for e in out)


def _effect(joined: Joined, effect: Effect) -> ModelEffect:
    """A named effect with its parameters, or why the record does not give them."""
    nan = float("nan")
    names = [c.name for c in joined.after.chosen]
    recording = joined.recording
    linear, unit = recording.linear, recording.torque_unit
    if effect.name not in names:
        why = f"{effect.name} could not join the model: {joined.refused[effect.name]}"
        lost = tuple(
            undetermined(
                Parameter(p.name, p.symbol, p.quantity),
                unit_of(p.quantity, linear=linear, torque_unit=unit),
                why,
            )
            for p in effect.parameters
        )
        return ModelEffect(effect.name, effect.code, effect.family, lost, nan, nan, nan, nan, nan)
    k = names.index(effect.name)
    forms = sum(f.name == effect.name for f in joined.fitter.forms)
    score = evidence.score(joined.fitter, joined.after, k, forms)
    least = threshold(joined.after.problem)
    level = joined.config.estimate.confidence_level
    found = effect_estimates(joined.after, k, joined.solved, linear=linear, torque_unit=unit, level=level)
    ends = _at_the_end(joined.after, joined.after.chosen[k])
    return ModelEffect(
        name=effect.name,
        code=effect.code,
        family=effect.family,
        parameters=tuple(
            _judged(e, joined.gains[k], score.p_value, least, ends, joined.doubt) for e in found
        ),
        statistic=joined.gains[k],
        threshold=least,
        p_value=score.p_value,
        held_out_gain=joined.held_out_gain,
        stability=score.stability,
    )


def _judged(
    estimate: Estimate, gain: float, p_value: float, least: float, ends: Sequence[str], doubt: str
) -> Estimate:
    """An effect's parameter, no better than the evidence for the effect.

    A shape that nothing depends on has an interval too, for it is linearised where the search stopped.
    """
    if gain <= 0.0 or p_value > SIGNIFICANT:
        size = f"gain {gain:.2g}, p = {p_value:.2g}"
        why = f"the record shows no such effect, or it was not active ({size})"
        return replace(estimate, verdict="not_identifiable", reason=why)
    if estimate.name in ends:
        why = "the search stopped at the edge of what this record could show"
        return replace(estimate, verdict="not_identifiable", reason=why)
    if gain < least and estimate.verdict != "not_identifiable":
        why = f"the effect explains too little to be named (gain {gain:.2g}, {least:g} names one)"
        return replace(estimate, verdict="not_identifiable" if _holds_zero(estimate) else "weak", reason=why)
    return demoted(estimate, doubt)


def _holds_zero(estimate: Estimate) -> bool:
    interval = estimate.interval
    return interval is not None and interval.low <= 0.0 <= interval.high


def _at_the_end(fitted: Fitted, chosen: Chosen) -> list[str]:
    """Shapes that the search left at an end of their range."""
    out = []
    for shape, value in zip(fitted.search.shapes(chosen.form) or (), chosen.shape, strict=False):
        low, high, at = shape.low, shape.high, value
        if shape.spacing == "log":
            low, high, at = (float(np.log(x)) for x in (low, high, value))
        if min(at - low, high - at) < EDGE * (high - low):
            out.append(shape.name)
    return out


def _warnings(joined: Joined) -> tuple[str, ...]:
    texts = [f"{joined.model_id}: {joined.doubt}; no parameter counts as identified"] if joined.doubt else []
    texts += [f"{joined.model_id}: {n} could not join the model: {why}" for n, why in joined.refused.items()]
    problem = joined.after.problem
    role = joined.config.signals.torque_role
    if problem.shift:
        hold = "sample" if problem.shift > 0.0 else "instant"
        texts.append(f"{joined.model_id}: the torque's timing fits best with signals.{role}.hold: {hold}")
    return (*texts, *joined.told)


def _equation(joined: Joined, added: Sequence[str]) -> str:
    """The model's own equation, and the terms of the effects that stand beside it."""
    equations = {
        "two_encoders": TwoEncoders.equation,
        "motor_only": MotorOnly("none").equation,
        "rigid": Rigid("none").equation,
    }
    own = () if joined.model_id == "two_encoders" else ("torque_offset",)
    terms = {c.name: c.form.effect.term for c in joined.after.chosen}
    lines = [f"{name}: {terms[name]}" for name in added if name not in own]
    return ";  ".join([equations[joined.model_id], *lines])


def _correlation(joined: Joined) -> tuple[tuple[str, ...], Array]:
    """Symbols of the baseline's parameters and their correlation."""
    names = joined.after.problem.names
    own = [p.symbol for p in BASE_PARAMETERS if p.symbol in names]
    index = [names.index(symbol) for symbol in own]
    symbols = [RIGID[s].symbol if joined.model_id == "rigid" else s for s in own]
    return tuple(symbols), correlation_of(joined.solved.covariance[np.ix_(index, index)])


def _fit(joined: Joined) -> tuple[Trace, Fit]:
    """Torque of the motor equation in the band, measured and predicted, without the rows' weighting."""
    after, problem = joined.after, joined.after.problem
    there = problem.at(problem.base)
    there.weights = [_even(problem, w) for w in problem.weights]
    held = {c.form: after.slopes(k) for k, c in enumerate(after.chosen)}
    fitted = joined.fitter.fit(there, after.chosen, Search(there, joined.fitter.forms, held))
    rows = problem.row_times.size
    residual = (fitted.y - fitted.basis.columns @ after.basis.coefficients)[:rows]
    measured = np.concatenate(
        [
            _plain(w).apply([s.spectrum(s.torque)])[0, :, 0]
            for s, w in zip(problem.stretches, problem.weights, strict=True)
        ]
    )
    unit = joined.recording.torque_unit
    spread = float(np.linalg.norm(measured - measured.mean()))
    fit = Fit(
        torque_rms=float(np.sqrt(np.mean(measured**2))),
        residual_rms=float(np.sqrt(np.mean(residual**2))),
        fit_percent=100.0 * (1.0 - float(np.linalg.norm(residual)) / spread) if spread else 0.0,
        unit=unit,
    )
    return Trace(problem.row_times, measured, measured - residual, unit), fit


def _plain(weights: Weights) -> Weights:
    """The same rows of one equation, as they are."""
    size = weights.taper.transform / weights.rows
    return Weights(weights.taper, np.full((weights.taper.frequency_hz.size, 1, 1), size, dtype=np.complex128))


def _even(problem: Problem, weights: Weights) -> Weights:
    """Rows in torque units, every frequency alike.

    Eq. (18) holds the motor's torque times 1 + X2 s + X1 s^2 and the load's as it is: a difference is given as the
    smallest torque at either place that would make it.
    """
    m, omega = weights.equations, 2.0 * np.pi * weights.taper.frequency_hz
    size = np.full(omega.size, weights.taper.transform / weights.rows)
    if not problem.both and not problem.rigid:
        b = problem.base
        size *= np.maximum(1.0, np.abs(1.0 + (1j * b.FV * omega - b.JL * omega**2) / b.K) ** 2)
    return Weights(weights.taper, (size[:, None, None] * np.eye(m)).astype(np.complex128))


def _pipeline(joined: Joined) -> PipelineSummary:
    problem, base = joined.after.problem, joined.after.problem.base
    rate, band = joined.recording.sample_rate_hz, problem.band_hz
    trimmed = MARGIN / rate + 0.5 * TAPER_S
    grid = np.geomspace(max(0.01, band / 300.0), 0.5 * rate, LINES)
    flexible = not problem.rigid and min(base.Jm, base.K, base.JL) > 0.0
    resonance = float(np.sqrt(base.K * (1.0 / base.Jm + 1.0 / base.JL)) / (2.0 * np.pi)) if flexible else None
    width = base.motor_reversal
    return PipelineSummary(
        sample_rate_hz=rate,
        steps=(
            f"exact derivative, {2 * HALF_WIDTH + 1}-point maximally flat difference",
            f"friction sign tanh(v / {width:.3g}) from the velocity below {MOTOR_SIGN_BAND * band:.4g} Hz",
            f"tapered over {TAPER_S:g} s at each edge of each segment, {trimmed:.3g} s left out",
            "weighted by the spectral matrix of encoder and torque noise, as the signals show it",
            f"cut at {band:.4g} Hz, rows at {2.0 * band:.4g} Hz",
        ),
        lowpass_order=0,
        lowpass_cutoff_hz=None,
        derivative="exact",
        decimation=1,
        effective_band_hz=(1.0 / problem.duration_s, band),
        limited_by="the noise of the signals",
        sign_cutoff_hz=MOTOR_SIGN_BAND * band,
        reversal_velocity=width,
        rows=int(problem.row_times.size),
        trimmed_s=trimmed,
        f1_hz=resonance,
        f1_source="data" if resonance else "",
        magnitude_hz=grid,
        magnitude=np.where(grid <= band, 1.0, 0.0),
    )
