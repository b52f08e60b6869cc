"""From what a model leaves to a verdict."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from flexid_cli.diagnose.location import Map
from flexid_cli.diagnose.verdict import (
    UNEXPLAINED_GAIN,
    UNEXPLAINED_RMS,
    decide,
    elsewhere,
    remainder,
    sentence,
)


def found(gain: float) -> Map:
    return Map("motor", "velocity", gain, np.zeros(1), np.zeros(1), np.zeros(1), plain=True)


def selection(
    names: list[str], *, settled: bool = True, signal: float = 100.0, possible: bool = True
) -> SimpleNamespace:
    problem = SimpleNamespace(settled=settled, signal=lambda: signal)
    return SimpleNamespace(
        before=SimpleNamespace(problem=problem),
        after=SimpleNamespace(chosen=names, is_possible=possible),
        alternatives=[()] * len(names),
    )


def test_what_is_left_is_a_function_or_a_size_or_nothing():
    assert remainder(1.0, [found(0.5 * UNEXPLAINED_GAIN)], both=True) == ""
    assert remainder(1.0, [found(2.0 * UNEXPLAINED_GAIN)], both=True) == "function"
    assert remainder(2.0 * UNEXPLAINED_RMS, [found(0.0)], both=True) == "size"
    assert remainder(2.0 * UNEXPLAINED_RMS, [found(2.0 * UNEXPLAINED_GAIN)], both=True) == "function"


@pytest.mark.parametrize(
    ("names", "left", "verdict"),
    [
        ([], "", "adequate"),
        (["cogging"], "", "explained"),
        (["cogging"], "size", "partly_explained"),
        ([], "size", "unexplained"),
        (["cogging"], "function", "unexplained"),
        ([], "function", "unexplained"),
    ],
)
def test_verdicts(names, left, verdict):
    assert decide(selection(names), left) == verdict


def test_a_start_that_cannot_be_trusted_is_inconclusive_unless_an_effect_explains_the_record():
    assert decide(selection([], settled=False), "") == "inconclusive"
    assert decide(selection(["cogging"], settled=False), "size") == "inconclusive"
    assert decide(selection(["cogging"], settled=False), "") == "explained"
    assert decide(selection(["cogging"], signal=1.0), "") == "inconclusive"


def test_a_fit_with_a_negative_stiffness_explains_nothing():
    assert decide(selection(["cogging"], possible=False), "") == "unexplained"
    assert decide(selection([], possible=False), "") == "inconclusive"


def test_a_part_that_stays_is_told_with_its_place():
    effect = SimpleNamespace(name="cogging", alternatives=())
    text = sentence("partly_explained", [effect], "load", "position", 0.9)
    assert "cogging" in text
    assert "90 %" in text
    assert "in the load equation, as a function of position" in text


def test_effects_that_explain_nothing_elsewhere_are_not_named():
    before, little, most = (size * np.ones(100) for size in (9.0, 8.5, 4.1))
    assert elsewhere(before, little) == "unexplained"
    assert elsewhere(10.0 * before, most) == "partly_explained"
