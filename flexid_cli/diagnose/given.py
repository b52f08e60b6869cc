"""Named effects joined to the models: nothing is selected, the fits are those of a diagnosis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from flexid_cli.diagnose.diagnose import forms_of, torque_shifts
from flexid_cli.diagnose.fitter import Chosen, Fitted, Fitter, without
from flexid_cli.diagnose.given_model import Joined, model_result
from flexid_cli.diagnose.problem import Problem
from flexid_cli.diagnose.search import Candidate
from flexid_cli.diagnose.start import first_problems
from flexid_cli.effects.base import Effect
from flexid_cli.effects.registry import effect as effect_named
from flexid_cli.errors import DataError, UsageError
from flexid_cli.estimate.identify import model_ids, without_joint
from flexid_cli.estimate.result import Identification, ModelResult, Skipped

if TYPE_CHECKING:
    from flexid_cli.config.schema import Config
    from flexid_cli.signals.recording import Recording

RESEARCHED = 1e-3  # share of the cost that another search of an effect's shape must take off
# Effects that a model of `identify` holds anyhow, and those of them that the diagnosis' baseline does not.
PART_OF = {
    "two_encoders": ("gravity",),
    "motor_only": ("torque_offset", "gravity"),
    "rigid": ("torque_offset", "gravity"),
}
JOINED_TO = {"two_encoders": (), "motor_only": ("torque_offset", "gravity"), "rigid": ("gravity",)}


def identify_with(recording: Recording, config: Config, names: Sequence[str]) -> Identification:
    """Identify the models of the configuration with named effects joined to them.

    Parameters
    ----------
    recording : Recording
        Joint side, SI.
    config : Config
        ``models`` as for `flexid_cli.estimate.identify.identify`.
    names : sequence of str
        Names or codes of effects.

    Returns
    -------
    Identification
        Models that the signals do not allow with these effects are among ``skipped``.

    Raises
    ------
    DataError
        No model can be solved with these effects on this recording.
    UsageError
        There is no such effect, the signals allow none of them, or an estimator was asked for that cannot hold it.
    """
    wanted = tuple(dict.fromkeys(effect_named(name) for name in names))
    _check_options(config)
    models: list[ModelResult] = []
    refusals: dict[str, DataError | UsageError] = {}
    for model_id in model_ids(recording, config):
        try:
            models.append(model_result(_joined_model(recording, config, model_id, wanted)))
        except (DataError, UsageError) as error:
            refusals[model_id] = error
    if not models and len(refusals) == 1:
        raise next(iter(refusals.values()))
    skipped = tuple(
        Skipped(i, error.message + (f" ({error.hint})" if error.hint else ""))
        for i, error in refusals.items()
    )
    if not models:
        told = "; ".join(f"{s.id}: {s.reason}" for s in skipped)
        hopeless = all(isinstance(error, UsageError) for error in refusals.values())
        raise (UsageError if hopeless else DataError)(
            f"no model can be solved with these effects: {told}",
            "leave out the effects that the reasons name",
        )
    return Identification(tuple(models), skipped, tuple(recording.notes))


def _check_options(config: Config) -> None:
    if config.estimate.route != "direct":
        raise UsageError(
            "the paper's route has no room for effects beyond its model",
            "leave out --route paper (estimate.route), or the effects (--with, estimate.with)",
        )
    if config.estimate.essential:
        raise UsageError(
            "essential parameters are not selected beside named effects",
            "leave out estimate.essential, or the effects (--with, estimate.with)",
        )
    if config.estimate.method != "auto":
        raise UsageError(
            f"effects are fitted by whitened least squares, not by estimate.method: {config.estimate.method}",
            "leave out estimate.method, or the effects (--with, estimate.with)",
        )


def _joined_model(recording: Recording, config: Config, model_id: str, wanted: Sequence[Effect]) -> Joined:
    """Fit one model without the effects and with them."""
    view = recording if model_id == "two_encoders" else without_joint(recording)
    config = config.model_copy(update={"models": (model_id,)})
    fitter = Fitter(forms_of(view.has_joint_position, linear=view.linear), torque_shifts(config))
    own = tuple(e for e in wanted if e.name not in PART_OF[model_id] or view.linear)
    for effect in own:
        _check_signals(effect, fitter, model_id, linear=view.linear)
    fits = [
        _before_and_after(fitter, problem, JOINED_TO[model_id], own)
        for problem in first_problems(view, config, fitter)
    ]
    before, after, refused = min(fits, key=lambda fit: (not fit[1].is_possible, fit[1].loss))
    names = [e.name for e in own if e.name not in {c.name for c in before.chosen}]
    told = tuple(
        f"{model_id}: {e.name} is part of the model with and without being named"
        for e in wanted
        if e.name not in names
    )
    effects = tuple(e for e in own if e.name in names)
    return Joined(model_id, fitter, before, after, effects, refused, told, view, config)


def _before_and_after(
    fitter: Fitter, problem: Problem, always: Sequence[str], own: Sequence[Effect]
) -> tuple[Fitted, Fitted, Mapping[str, str]]:
    """The model without and with the effects from one start, and why some could not join."""
    before, _ = _joined(fitter, fitter.relax(problem), always)
    names = [e.name for e in own if e.name not in {c.name for c in before.chosen}]
    after, refused = _joined(fitter, before, names)
    return before, _searched_again(fitter, after, names) if len(names) > 1 else after, refused


def _check_signals(effect: Effect, fitter: Fitter, model_id: str, *, linear: bool) -> None:
    """Refuse an effect of which the signals have no form.

    Raises
    ------
    UsageError
        It needs a joint encoder, or such an axis has none.
    """
    if any(f.name == effect.name for f in fitter.forms):
        return
    if linear and all(s.rotary for s in effect.signatures):
        raise UsageError(f"a linear axis has no {effect.name}", "leave it out of the effects that are named")
    raise UsageError(
        f"{effect.name} cannot be seen without a joint encoder, which the model {model_id} does not use",
        "record joint_position and name it in the configuration, or leave the effect out",
    )


def _joined(fitter: Fitter, fitted: Fitted, names: Sequence[str]) -> tuple[Fitted, Mapping[str, str]]:
    """The model with effects added, what explains most first; and why some could not be.

    They are added as `selection.select` adds what it finds, but whether they are worth it is not asked.
    """
    left = list(names)
    while left:
        found = {name: _best(fitter, fitted, name) for name in left}
        possible = {n: c for n, c in found.items() if c is not None and not c.refused}
        if not possible:
            why = {n: "this record cannot show it" if c is None else c.refused for n, c in found.items()}
            return fitted, why
        name, best = min(possible.items(), key=lambda item: item[1].cost)
        fitted = fitter.relax(fitted.problem, (*fitted.chosen, Chosen(best.form, best.shape)), rounds=2)
        fitted = fitter.reweighted(fitted)
        left.remove(name)
    return fitted, {}


def _best(fitter: Fitter, now: Fitted, name: str) -> Candidate | None:
    """The best form of an effect against what a model leaves."""
    plain = [f for f in fitter.forms if f.name == name and not f.signature.extends]
    found = [c for c in (now.search.best(f, now.basis) for f in plain) if c is not None]
    return fitter.richest(now, min(found, key=lambda c: c.rank)) if found else None


def _searched_again(fitter: Fitter, fitted: Fitted, names: Sequence[str]) -> Fitted:
    """Forms and shapes searched once more beside all the others, not all of which stood there the first time."""
    for k, chosen in enumerate(fitted.chosen):
        if chosen.name not in names:
            continue
        rest = fitter.fit(fitted.problem, without(fitted.chosen, k), fitted.search)
        best = _best(fitter, rest, chosen.name)
        if best is None or best.refused or best.cost > (1.0 - RESEARCHED) * fitted.cost:
            continue
        moved = (*fitted.chosen[:k], Chosen(best.form, best.shape), *fitted.chosen[k + 1 :])
        other = fitter.reweighted(fitter.relax(fitted.problem, moved))
        fitted = other if other.loss < fitted.loss else fitted
    return fitted
