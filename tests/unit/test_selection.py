"""The growing of a model effect by effect."""

from __future__ import annotations

from types import SimpleNamespace

from flexid_cli.diagnose import selection

PROBLEM = SimpleNamespace(both=True, rigid=False)


class Model:
    """A fit that says of every change that it gains."""

    def __init__(self, *names: str) -> None:
        self.chosen = tuple(SimpleNamespace(name=n) for n in names)
        self.problem = PROBLEM

    def gain(self, _: Model) -> float:
        return 1.0


def names(model: Model) -> list[str]:
    return sorted(c.name for c in model.chosen)


class Fitter:
    """Effects are offered in turn; weighting the rows anew leaves a model as it is."""

    def candidates(self, _: Model) -> list:
        return []

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


def test_effects_join_until_nothing_gains(monkeypatch):
    order = ["backlash", "cogging"]

    def added(_, fitted, found):
        have = [c.name for c in fitted.chosen]
        return [Model(*have, order[len(have)])] if len(have) < len(order) else []

    monkeypatch.setattr(selection, "_added", added)
    monkeypatch.setattr(selection, "_needed", lambda fitter, fitted, enough: fitted)
    assert names(selection._grown(Fitter(), Model(), [])) == order
