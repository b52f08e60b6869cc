"""From two views of one axis, model and recording, to what physics the model left out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from flexid_cli.diagnose import evidence, verdict
from flexid_cli.diagnose.estimates import Solved, base_estimates, effect_estimates, solved
from flexid_cli.diagnose.figures import matter, residual_map, traces
from flexid_cli.diagnose.fitter import Fitted, Fitter
from flexid_cli.diagnose.locality import locality
from flexid_cli.diagnose.location import Map, located, residual_maps
from flexid_cli.diagnose.physical import torque_scale
from flexid_cli.diagnose.result import (
    Diagnosis,
    Evidence,
    HeldOut,
    Locality,
    NamedEffect,
    SimulationError,
    Tested,
    Verdict,
    Where,
)
from flexid_cli.diagnose.search import Candidate, Form, gained
from flexid_cli.diagnose.selection import Selection, least_gain, select
from flexid_cli.diagnose.simulation import simulation_error
from flexid_cli.diagnose.start import first_problems, has_joint
from flexid_cli.diagnose.suggest import interval, suggestions
from flexid_cli.effects.base import EffectValues
from flexid_cli.effects.registry import effects as library
from flexid_cli.estimate.result import Estimate
from flexid_cli.estimate.verdict import demoted

if TYPE_CHECKING:
    from flexid_cli.config.schema import Config
    from flexid_cli.signals.recording import Recording

Array = NDArray[np.float64]


def diagnose(
    recording: Recording,
    config: Config,
    validation: Recording | None = None,
    *,
    known: Mapping[str, float] | None = None,
) -> Diagnosis:
    """Find where the declared baseline and a recording differ, and what was left out.

    Parameters
    ----------
    recording : Recording
        Joint side, SI; with both encoders the baseline is eq. (13), else eq. (18) without gravity and offset.
    config : Config
        Axis, signals and confidence level.
    validation : Recording, optional
        Another recording of the axis: effects fitted to the first one are checked on it.
    known : mapping of str to float, optional
        Parameters by symbol that are held to be true, as a report or a data sheet gives them: the simulation before
        runs with them, and a note names those that the recording contradicts.

    Returns
    -------
    Diagnosis

    Raises
    ------
    DataError
        The recording is too short, or shows no flexible axis at all.
    """
    both = has_joint(recording, config)
    fitter = Fitter(forms_of(both, linear=recording.linear), torque_shifts(config))
    selection = select(fitter, first_problems(recording, config, fitter))
    own = _Report(fitter, selection, recording, config, validation, known or {})
    if validation is None or own.verdict != "adequate" or own.holds_elsewhere():
        return own.diagnosis()
    selection = select(fitter, first_problems(validation, config, fitter, own.final.problem))
    other = _Report(fitter, selection, validation, config, recording, known or {})
    told = other.verdict in ("explained", "ambiguous") and other.holds_elsewhere()
    return _exchanged(other.diagnosis()) if told else _doubtful(own.diagnosis())


def forms_of(both: bool, *, linear: bool = False) -> list[Form]:
    """Forms of all effects that the signals allow: with both encoders or one, on a rotary or a linear axis."""
    return [
        Form(effect, k)
        for effect in library()
        for k, signature in enumerate(effect.signatures)
        if not (signature.motor_alone if both else signature.needs_joint)
        and not (signature.rotary and linear)
    ]


def torque_shifts(config: Config) -> tuple[float, ...]:
    """Periods by which the torque may act later than it is taken to.

    Whether a drive's torque is held from its stamp is a convention that few people know of their logs: half a period
    is never reported as physics.
    """
    return (0.0, -0.5) if config.signals.torque.hold == "sample" else (0.0, 0.5)


class _Report:
    """Everything that a selection is reported with."""

    def __init__(
        self,
        fitter: Fitter,
        selection: Selection,
        recording: Recording,
        config: Config,
        validation: Recording | None,
        known: Mapping[str, float],
    ) -> None:
        self.fitter, self.selection, self.recording, self.config = fitter, selection, recording, config
        self.known = known
        after = selection.after
        self.remaining = residual_maps(after.problem, after.basis)
        left = verdict.remainder(after.basis.rms, self.remaining, both=after.problem.both)
        self.verdict = verdict.decide(selection, left)
        # What does not explain the record is not named: the baseline stands, and the place of its mismatch.
        self._take(
            after if self.verdict not in ("unexplained", "inconclusive") else selection.before, validation
        )
        self.refuted = ""
        if self.final.chosen and self._fails_elsewhere():
            self.verdict = verdict.elsewhere(*self.unseen)
            if self.verdict == "unexplained":
                self.refuted = ", ".join(c.name for c in after.chosen)
                self._take(selection.before, validation)
        self.maps = residual_maps(selection.before.problem, selection.before.basis)

    def _take(self, final: Fitted, validation: Recording | None) -> None:
        """Report this model, and what it leaves on data that it was not fitted to."""
        self.final = final
        self.other = None
        if validation is not None:
            self.other = first_problems(validation, self.config, self.fitter, final.problem)[0]
        self.unseen = self._unseen()

    def diagnosis(self) -> Diagnosis:
        """Assemble the result."""
        before, after = self.selection.before, self.final
        solved_before = solved(before)
        solved_after = solved(after) if after is not before else solved_before
        named = self._effects(solved_after, evidence.held_out_gain(*self.unseen))
        doubt = self._doubt()
        parameters_before = self._base_parameters(before, solved_before, doubt)
        alternatives = [f for group in self.selection.alternatives for f in group] if named else []
        alternatives += self.selection.elsewhere
        parameters_after = self._base_parameters(after, solved_after, doubt, alternatives)
        place, where = self._place(parameters_before, parameters_after)
        share = 1.0 - max(after.cost - after.y.size, 0.0) / max(before.cost - before.y.size, 1e-300)
        equation, variable = (place.equation, place.variable) if place else ("motor", "velocity")
        return Diagnosis(
            verdict=self.verdict,
            sentence=_with_suggestion(
                verdict.sentence(self.verdict, named, equation, variable, share), place, self.verdict
            ),
            model=before.problem.model,
            effects=_timed(named, place),
            location=place if self.verdict in ("unexplained", "partly_explained") else None,
            held_out=self._held_out(*self.unseen),
            simulation=self._simulation(parameters_before, parameters_after),
            parameters_before=parameters_before,
            parameters_after=parameters_after,
            tested=self._tested(),
            next_recording=verdict.advice(
                named, {e.name: e.best_recording for e in library()}, self.verdict, variable
            ),
            notes=(*self._notes(), *self._contradicted(parameters_after)),
            traces=traces(before, after, self.recording.torque_unit),
            maps=tuple(
                residual_map(before, after, m, self.recording)
                for m in matter(self.maps, both=before.problem.both)
            ),
            locality=where,
        )

    def _doubt(self) -> str:
        """Why no parameter counts as identified, or nothing."""
        if verdict.is_poor(self.selection.before.problem):
            return "the torque hardly stands above its own noise"
        if self.verdict in ("unexplained", "partly_explained"):
            return "the model leaves out something that is not known"
        if not self.final.problem.both and not self.final.problem.settled:
            return "no resonance stands out of the record, so the motor encoder alone does not show the stiffness"
        if self._fails_elsewhere():
            return "the model does not hold on the other recording"
        return ""

    def _fails_elsewhere(self) -> float:
        """RMS of the other recording's rows where that is more than a complete model leaves, else zero."""
        if self.other is None:
            return 0.0
        parts = evidence.by_equation(self.other, self.unseen[1]).values()
        worst = max(float(np.sqrt(np.mean(part**2))) for part in parts)
        return worst if worst > verdict.UNEXPLAINED_RMS else 0.0

    def holds_elsewhere(self) -> bool:
        """Whether the model leaves less on the other recording than what could name an effect there."""
        _, left = self.unseen
        return gained(float(left @ left), float(left.size), left.size) < least_gain(self.final)

    def _base_parameters(
        self, fitted: Fitted, result: Solved, doubt: str, alternatives: Sequence[Fitted] = ()
    ) -> tuple[Estimate, ...]:
        found = base_estimates(
            fitted,
            result,
            alternatives,
            linear=self.recording.linear,
            torque_unit=self.recording.torque_unit,
            level=self.config.estimate.confidence_level,
        )
        return tuple(demoted(e, doubt) for e in found)

    def _effects(self, result: Solved, validated: float) -> tuple[NamedEffect, ...]:
        """The chosen effects, in the order of what they explain."""
        if not self.final.chosen:
            return ()
        gains = evidence.gains(self.fitter, self.final)
        named = [self._effect(k, result, gain, validated) for k, gain in enumerate(gains)]
        return tuple(named[int(k)] for k in np.argsort(gains)[::-1])

    def _effect(self, k: int, result: Solved, gain: float, validated: float) -> NamedEffect:
        final, effect = self.final, self.final.chosen[k].form.effect
        score = evidence.score(self.fitter, final, k, len(self.fitter.forms))
        parameters = effect_estimates(
            final,
            k,
            result,
            linear=self.recording.linear,
            torque_unit=self.recording.torque_unit,
            level=self.config.estimate.confidence_level,
        )
        return NamedEffect(
            name=effect.name,
            code=effect.code,
            family=effect.family,
            alternatives=tuple(dict.fromkeys(f.chosen[-1].name for f in self.selection.alternatives[k])),
            parameters=parameters,
            evidence=Evidence(gain, least_gain(final), score.p_value, validated, score.stability),
            where=Where(effect.equation, _variable(effect.equation, self.maps)),
        )

    def _unseen(self) -> tuple[Array, Array]:
        """Residual rows of the baseline and of the final model on data that they were not fitted to."""
        before, after = self.selection.before, self.final
        if self.other is None:
            return evidence.cross_validated(before), evidence.cross_validated(after)
        first = evidence.predicted(self.other, self.fitter, before)
        return first, evidence.predicted(self.other, self.fitter, after)

    def _held_out(self, before: Array, after: Array) -> HeldOut:
        problem = self.final.problem
        scale = torque_scale(problem)

        def rms(rows: Array) -> dict[str, float]:
            parts = evidence.by_equation(problem, rows)
            return {name: scale[name] * float(np.sqrt(np.mean(part**2))) for name, part in parts.items()}

        data = "blocks of the record" if self.other is None else "the other recording"
        return HeldOut(rms(before), rms(after), dict(scale), data, self.recording.torque_unit)

    def _simulation(self, before: tuple[Estimate, ...], after: tuple[Estimate, ...]) -> SimulationError:
        final = self.final
        values = [
            EffectValues(c.name, c.form.signature.values(final.amplitudes(k), c.shape, final.problem.base))
            for k, c in enumerate(final.chosen)
        ]
        return simulation_error(
            final.problem,
            {e.symbol: e.value for e in before if e.value is not None} | dict(self.known),
            {e.symbol: e.value for e in after if e.value is not None},
            values,
            unit=self.recording.torque_unit,
            position_unit="m" if self.recording.linear else "rad",
        )

    def _place(self, before: Sequence[Estimate], after: Sequence[Estimate]) -> tuple[Where | None, Locality]:
        """Where the mismatch is, or what the named effects leave of it, and every view of that."""
        left = self.verdict == "partly_explained"
        fitted, maps = (self.selection.after, self.remaining) if left else (self.selection.before, self.maps)
        model = "with the named effects" if left else "baseline"
        found = locality(fitted, maps, self.recording, after if left else before, model)
        if not maps:
            return None, found
        where = located(maps[0], fitted.problem, fitted.basis, self.recording)
        where = replace(where, interval=interval(found, float(fitted.problem.row_times[-1])))
        return replace(where, suggests=suggestions(where, found, maps[0].gain)), found

    def _tested(self) -> tuple[Tested, ...]:
        met = {c.form.name: c for c in self.selection.tested}
        return tuple(
            Tested(
                e.name,
                e.code,
                met[e.name].gain if e.name in met else None,
                self._reason(e.name, met.get(e.name)),
            )
            for e in library()
        )

    def _reason(self, name: str, candidate: Candidate | None) -> str:
        """Why an effect was not named, or nothing."""
        chosen = {c.name for c in self.final.chosen}
        rivals = {n: worse for group in self.selection.rivals for n, worse in group}
        if name in chosen:
            return ""
        if self.verdict == "inconclusive":
            return "the record is too poor to judge"
        if name in {c.name for c in self.selection.after.chosen}:
            if self.refuted:
                return "what it explains here it does not explain on the other recording"
            if not self.selection.after.is_possible:
                return "with it an inertia or the stiffness comes out negative"
            return "with it the model still leaves structure that it does not explain"
        if name in {f.chosen[-1].name for group in self.selection.alternatives for f in group}:
            return "explains the record as well as the effect that was named: an alternative"
        if candidate is None:
            return "this record cannot show it, or the baseline holds it"
        if candidate.refused:
            return candidate.refused
        if chosen and name in rivals:
            return f"leaves {100.0 * np.expm1(rivals[name]):.3g} % more than the effects that were named"
        return f"explains too little (gain below {least_gain(self.final):g})"

    def _contradicted(self, estimates: tuple[Estimate, ...]) -> tuple[str, ...]:
        """Known parameters that lie outside their intervals."""
        return tuple(
            f"{e.symbol} = {self.known[e.symbol]:.6g} {e.unit} was given; the recording says {e.interval.low:.6g} to"
            f" {e.interval.high:.6g}"
            for e in estimates
            if e.symbol in self.known
            and e.interval is not None
            and not e.interval.low <= self.known[e.symbol] <= e.interval.high
        )

    def _notes(self) -> tuple[str, ...]:
        problem = self.final.problem
        notes = [f"compared up to {problem.band_hz:.3g} Hz, where the encoders resolve the motion"]
        if stays := self._fails_elsewhere():
            notes.append(
                f"on the other recording {stays:.2g} times the noise floor stays: what was fitted here does not hold"
                " there (if it is the same axis, check signs and units of that log)"
            )
        if self.refuted:
            notes.append(f"{self.refuted} would explain this recording, but not the other one")
        role = self.config.signals.torque_role
        if problem.shift > 0.0:
            notes.append(
                f"the torque fits best as held from its stamp for one sample: signals.{role}.hold: sample"
            )
        if problem.shift < 0.0:
            notes.append(
                f"the torque fits best as measured at its stamp, not held: signals.{role}.hold: instant"
            )
        return tuple(notes)


def _timed(named: tuple[NamedEffect, ...], place: Where | None) -> tuple[NamedEffect, ...]:
    """One effect alone acts when the whole mismatch does."""
    if len(named) != 1 or place is None or place.interval is None:
        return named
    return (replace(named[0], where=replace(named[0].where, interval=place.interval)),)


def _exchanged(diagnosis: Diagnosis) -> Diagnosis:
    """The diagnosis of the recording for validation, where that alone shows what the model lacks."""
    note = (
        "the recording holds nothing that the model lacks, the one for validation does: that was diagnosed and the"
        " other one was the check; parameters, places and times are those of the recording for validation"
    )
    text = f"Only the recording for validation shows it. {diagnosis.sentence}"
    return replace(diagnosis, sentence=text, notes=(note, *diagnosis.notes))


def _doubtful(diagnosis: Diagnosis) -> Diagnosis:
    """A diagnosis that nothing contradicts but what the other recording leaves, which no effect explains there."""
    note = (
        "the other recording leaves more than its noise, and no effect that explains it explains this one too"
    )
    return replace(diagnosis, notes=(*diagnosis.notes, note))


def _with_suggestion(text: str, place: Where | None, verdict: Verdict) -> str:
    """The sentence, with what the place of something unknown suggests."""
    if verdict != "unexplained" or place is None or not place.suggests:
        return text
    return f"{text} What it looks like: {place.suggests[0]}."


def _variable(equation: str, maps: list[Map]) -> str:
    return next((m.variable for m in maps if m.equation == equation), "velocity")
