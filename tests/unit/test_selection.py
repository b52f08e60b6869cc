"""The growing of a model effect by effect."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from flexid_cli.diagnose import selection
from flexid_cli.diagnose.fitter import WIDEST
from flexid_cli.diagnose.fitter import Fitter as RecordFitter
from flexid_cli.diagnose.led import LedFit
from flexid_cli.diagnose.problem import Problem
from flexid_cli.diagnose.search import Form
from flexid_cli.diagnose.stretch import Stretch
from flexid_cli.effects.base import EffectValues
from flexid_cli.effects.motion import Base
from flexid_cli.effects.registry import effect
from flexid_cli.estimate.budget import NoiseLevels
from flexid_cli.signals.recording import Segment
from flexid_cli.simulate.engine import simulate_closed_loop
from flexid_cli.simulate.machine import Axis, Controller

PROBLEM = SimpleNamespace(both=True, rigid=False)


class Model:
    """A fit that says of every change that it gains."""

    def __init__(self, *names: str, loss: float = 0.0) -> None:
        self.chosen = tuple(SimpleNamespace(name=n) for n in names)
        self.problem, self.loss, self.basis, self.search = PROBLEM, loss, SimpleNamespace(rms=1.0), None

    def gain(self, _: Model) -> float:
        return 1.0


def names(model: Model) -> list[str]:
    return sorted(c.name for c in model.chosen)


class Fitter:
    """Effects are offered in turn; weighting the rows anew leaves a model as it is.

    Moving its shapes again gives each time one of the fits that are told.
    """

    def __init__(self, *further: Model) -> None:
        self.further = list(further)

    def relax(self, *_: object) -> Model:
        return self.further.pop(0) if self.further else Model()

    def candidates(self, _: Model) -> list:
        return []

    def fit(self, _: object, chosen: tuple, __: object) -> Model:
        return Model(*(c.name for c in chosen))

    def reweighted(self, model: Model) -> Model:
        return model


def test_effects_that_displace_each_other_do_not_go_round_for_ever(monkeypatch):
    """Each of two effects looks best beside the other one, and makes it needless."""
    other = {"backlash": "hysteresis", "hysteresis": "backlash"}

    def added(_, fitted, found):
        return [Model("backlash" if not fitted.chosen else other[fitted.chosen[0].name])]

    monkeypatch.setattr(selection, "_added", added)
    monkeypatch.setattr(selection, "_needed", lambda fitter, fitted, enough: fitted)
    assert names(selection._grown(Fitter(), Model(), [])) == ["hysteresis"]


def test_a_pair_takes_the_place_of_a_wrong_effect_that_alone_neither_of_them_could(monkeypatch):
    """Beside the wrong effect the first of them looks needless, and so it goes again until both are there."""
    offered = {"": "hysteresis", "hysteresis": "error", "error,hysteresis": "damping"}
    kept = {"error,hysteresis": ["hysteresis"], "damping,error,hysteresis": ["damping", "error"]}

    def added(_, fitted, found):
        have = names(fitted)
        return [Model(*have, offered[",".join(have)])] if ",".join(have) in offered else []

    monkeypatch.setattr(selection, "_added", added)
    monkeypatch.setattr(
        selection, "_needed", lambda _, f, enough: Model(*kept.get(",".join(names(f)), names(f)))
    )
    assert names(selection._grown(Fitter(), Model(), [])) == ["damping", "error"]


def test_effects_join_until_nothing_gains(monkeypatch):
    order = ["backlash", "cogging"]

    def added(_, fitted, found):
        have = [c.name for c in fitted.chosen]
        return [Model(*have, order[len(have)])] if len(have) < len(order) else []

    monkeypatch.setattr(selection, "_added", added)
    monkeypatch.setattr(selection, "_needed", lambda fitter, fitted, enough: fitted)
    assert names(selection._grown(Fitter(), Model(), [])) == order


def test_the_same_effects_fitted_better_take_the_place_of_the_first_fit(monkeypatch):
    """An effect that stood in for a bad shape of another one goes again, and leaves the other one better."""
    trials = [Model("backlash", loss=1.0), Model("backlash", loss=-1.0)]
    monkeypatch.setattr(selection, "_added", lambda *_: [trials.pop(0)])
    monkeypatch.setattr(selection, "_needed", lambda fitter, fitted, enough: fitted)
    assert selection._grown(Fitter(), Model(), []).loss == -1.0


def test_shapes_are_moved_until_they_stay():
    further = [Model("backlash", loss=loss) for loss in (3.0, 1.0, 0.999, -5.0)]
    assert selection._settled(Fitter(*further), Model("backlash", loss=4.0)).loss == 1.0


RATE, BAND, SAMPLES = 500.0, 30.0, 10_000
BASE = Base(
    Jm=3.0, K=4000.0, JL=2.0, FVm=4.0, FSm=3.0, FV=2.0, FS=0.5, motor_reversal=0.004, load_reversal=0.01
)
NOISE = NoiseLevels(0.2, 1e-7, 1e-7)


def rubbing(power: float, exponent: float) -> Problem:
    """A record of an axis whose motor has a friction beyond the baseline's, linearised at a start that is off."""
    rng, t = np.random.default_rng(5), np.arange(SAMPLES) / RATE
    waves = [
        0.3 / (1.0 + f) * np.sin(2.0 * np.pi * (f * t + rng.random())) for f in (0.2, 0.5, 1.3, 3.1, 7.0)
    ]
    axis = Axis(
        Jm=BASE.Jm, K=BASE.K, JL=BASE.JL, FVm=BASE.FVm, FSm=BASE.FSm, FV=BASE.FV, FS=BASE.FS, MX=0.0, MY=0.0,
        reversal_velocity=BASE.motor_reversal, load_reversal_velocity=BASE.load_reversal,
    )  # fmt: skip
    hidden = EffectValues("viscous_nonlinear", {"power_friction": power, "power_exponent": exponent})
    controller = Controller(15.0, 150.0, 300.0)
    run = simulate_closed_loop(axis, controller, np.sum(waves, axis=0), RATE, effects=[hidden])
    segment = Segment(
        0.0,
        run.torque + NOISE.torque * rng.standard_normal(SAMPLES),
        run.motor_position + NOISE.motor_position * rng.standard_normal(SAMPLES),
        run.joint_position + NOISE.joint_position * rng.standard_normal(SAMPLES),
    )
    start = replace(BASE, FVm=20.0, FSm=6.0, motor_reversal=0.02)
    return Problem(
        [Stretch(segment, RATE, BAND)], start, NOISE, BAND, gravity=9.81, gear_ratio=1.0, duration_s=SAMPLES / RATE,
        both=True, shift=0.5,
    )  # fmt: skip


FRICTIONS = [
    Form(effect(n), k)
    for n in ("viscous_nonlinear", "stribeck_motor")
    for k in range(len(effect(n).signatures))
]


def test_a_flat_friction_is_found_although_a_wide_reversal_has_taken_its_place():
    """The width that fits the reversal without the effect looks like a part of |v|^a: the effect's start is wrong."""
    found = selection.select(RecordFitter(FRICTIONS, (0.5,)), [rubbing(12.0, 0.5)]).after
    assert [c.name for c in found.chosen] == ["viscous_nonlinear"]
    assert found.chosen[0].shape[0] == pytest.approx(0.5, abs=0.1)
    assert found.basis.rms < 1.3


def test_a_reversal_does_not_become_a_curve_of_the_friction():
    """A sign that turns over twice the highest speed is a cubic friction, and hides the one that was left out."""
    problem = rubbing(5.0, 3.0)
    most = WIDEST * problem.scale().motor_speed
    fitter = RecordFitter(FRICTIONS, (0.5,))
    baseline = fitter.relax(problem)
    assert baseline.problem.base.motor_reversal <= 1.001 * most
    found = selection.select(fitter, [problem]).after
    assert [c.name for c in found.chosen] == ["viscous_nonlinear"]
    assert found.chosen[0].shape[0] == pytest.approx(3.0, abs=0.1)
    assert found.basis.rms < 1.3


def test_a_further_effect_is_not_named_where_the_friction_of_the_model_had_the_wrong_shape(monkeypatch):
    friction, curved, both = (
        Model("friction", loss=1.0),
        Model("friction", loss=0.1),
        Model("friction", "other"),
    )
    for model in (friction, curved, both):
        monkeypatch.setattr(model, "gain", lambda other, m=model: other.loss - m.loss, raising=False)
    monkeypatch.setattr(selection, "_added", lambda *_: [both])
    monkeypatch.setattr(selection, "_simulated", lambda _, f: f)
    monkeypatch.setattr(selection, "_confirmed", lambda _, f: f)
    for found, expected in ((curved, ["friction"]), (friction, ["friction", "other"])):
        monkeypatch.setattr(selection, "_reshaped", lambda *_, f=found: f)
        assert names(selection._grown_led(Fitter(), friction, [])) == expected


@pytest.mark.parametrize(("rms", "excluded"), [(1.0, True), (1.6, False)])
def test_what_a_model_misses_is_no_ground_to_exclude_another(monkeypatch, rms, excluded):
    def led(name: str, loss: float) -> LedFit:
        model = object.__new__(LedFit)
        values = {
            "chosen": (SimpleNamespace(name=name),),
            "y": np.zeros(100),
            "problem": SimpleNamespace(both=False),
        }
        for field, value in {**values, "basis": SimpleNamespace(cost=100.0 * rms**2)}.items():
            object.__setattr__(model, field, value)
        model.__dict__["loss"] = loss
        model.problem.rigid, model.problem.level = False, loss - np.log(100.0 * rms**2)
        return model

    other = led("other", 0.5)
    monkeypatch.setattr(selection, "_others", lambda *_: ([other], [("other", 0.5)]))
    monkeypatch.setattr(selection, "_simulated", lambda _, f: f)
    _, (alternatives,), _ = selection._alternatives(Fitter(), led("named", 0.0))
    assert (alternatives == ()) == excluded


@pytest.mark.parametrize(("rms", "expected"), [(3.0, "cubic"), (1.1, "knee")])
def test_a_form_chosen_before_the_others_were_there_is_looked_at_again(rms, expected):
    plain = SimpleNamespace(extends=False, curved=False)
    knee, cubic = (SimpleNamespace(name="hardening", kind=k, signature=plain) for k in ("knee", "cubic"))
    search = SimpleNamespace(best=lambda form, _: SimpleNamespace(form=form, shape=(), refused=""))

    def model(form: SimpleNamespace, loss: float) -> Model:
        made = Model("hardening", "backlash", loss=loss)
        made.chosen[0].form, made.search, made.basis.rms = form, search, rms
        return made

    fitter = Fitter()
    fitter.forms = (knee, cubic)
    fitter.fit = lambda *_: model(knee, 9.0)
    fitter.relaxed = lambda _, models: [model(chosen[0].form, 1.0) for chosen in models]
    assert selection._reformed(fitter, model(knee, 2.0)).chosen[0].form.kind == expected


@pytest.mark.parametrize(("rms", "expected"), [(2.0, ["backlash", "sensor_lag"]), (1.1, ["backlash"])])
def test_effects_that_promise_little_are_tried_where_more_than_noise_stays(monkeypatch, rms, expected):
    def added(_, fitted, found, wide=0):
        more = "sensor_lag" if wide else "hysteresis"
        model = Model("backlash", more)
        model.gain = lambda _: 1.0 if wide and len(fitted.chosen) == 1 else 0.0
        return [model]

    before = Model("backlash")
    before.basis.rms = rms
    monkeypatch.setattr(selection, "_added", added)
    monkeypatch.setattr(selection, "_needed", lambda fitter, fitted, enough: fitted)
    monkeypatch.setattr(selection, "_settled", lambda fitter, fitted: fitted)
    assert names(selection._grown(Fitter(), before, [])) == expected


def test_what_explains_nothing_in_the_end_goes_again(monkeypatch):
    model = Model("hysteresis", "ripple", "payload")
    model.gain = lambda rest: 1.0 if "ripple" in names(rest) else 0.01
    monkeypatch.setattr(selection, "_settled", lambda _, fitted: fitted)
    assert names(selection._pruned(Fitter(), model)) == ["hysteresis", "payload"]
