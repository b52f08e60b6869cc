"""The references that `flexid simulate` offers, against what their names promise."""

from __future__ import annotations

import numpy as np
import pytest

from flexid_cli.errors import UsageError
from flexid_cli.simulate.reference import KINDS, Motion, reference

RATE = 500.0
MOTIONS = {kind: Motion(kind, 0.3, 0.1, 1.0 if kind == "updown" else 8.0, centre=0.7) for kind in KINDS}
DURATIONS = (10.0, 37.3)


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=lambda motion: f"{motion.kind}_")
@pytest.mark.parametrize("duration", DURATIONS)
def test_from_rest_to_rest_over_the_whole_amplitude(motion: Motion, duration: float) -> None:
    values = reference(motion, duration, RATE)
    assert values.size == round(duration * RATE)
    assert values[0] == motion.centre
    assert np.abs(values - 0.7).max() == pytest.approx(0.3, rel=1e-2)
    speed = np.diff(values) * RATE
    assert abs(speed[0]) < 1e-2 * np.abs(speed).max()
    assert abs(speed[-1]) < 5e-2 * np.abs(speed).max()  # one sample before rest; ramps have a dozen
    # Nowhere a jump of the speed: the second difference is that of a smooth curve.
    assert np.abs(np.diff(speed)).max() < 0.15 * np.abs(speed).max()


@pytest.mark.parametrize("kind", ["chirp", "multisine"])
def test_power_lies_in_the_band(kind: str) -> None:
    values = reference(MOTIONS[kind], 37.3, RATE) - 0.7
    power = np.abs(np.fft.rfft(np.gradient(values))) ** 2
    frequency = np.fft.rfftfreq(values.size, 1.0 / RATE)
    band = (frequency > 0.05) & (frequency < 8.5)
    assert power[band].sum() > 0.99 * power.sum()
    thirds = [power[(frequency > a) & (frequency < a + 2.5)].sum() for a in (0.2, 2.7, 5.2)]
    assert max(thirds) < (6.0 if kind == "multisine" else 40.0) * min(thirds)


def test_updown_moves_at_constant_speeds_that_grow() -> None:
    values = reference(MOTIONS["updown"], 60.0, RATE)
    speed = np.abs(np.diff(values) * RATE)
    constant = np.abs(np.diff(speed)) < 1e-9
    levels = np.unique(np.round(speed[1:][constant], 6))
    assert constant.mean() > 0.6
    assert 10 < levels.size < 100
    assert levels[-1] / levels[0] == pytest.approx(1.0 / 0.1, rel=0.01)


def test_slow_reaches_both_sides_at_one_speed() -> None:
    values = reference(MOTIONS["slow"], 20.0, RATE) - 0.7
    assert values.max() == pytest.approx(0.3, rel=1e-4)
    assert values.min() == pytest.approx(-0.3, rel=1e-4)
    speed = np.abs(np.diff(values))
    assert np.mean(np.abs(speed / speed.max() - 1.0) < 1e-9) > 0.7


@pytest.mark.parametrize(
    ("motion", "duration", "words"),
    [
        (Motion("walk", 1.0, 0.1, 1.0), 10.0, "there is no trajectory"),
        (Motion("chirp", 1.0, 0.1, 300.0), 10.0, "above half the rate"),
        (Motion("chirp", 1.0, 2.0, 1.0), 10.0, "is not possible"),
        (Motion("multisine", 1.0, 0.11, 0.12), 2.0, "no multiple"),
        (Motion("slow", 1.0, 0.1, 1.0), 0.1, "are 50 samples"),
    ],
    ids=["kind", "rate", "band", "empty", "short"],
)
def test_refusals(motion: Motion, duration: float, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        reference(motion, duration, RATE)
