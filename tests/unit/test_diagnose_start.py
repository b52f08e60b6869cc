"""The first linearisation: a simple fit finds the axis, or says that there is none."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from flexid_cli.diagnose.start import _first_base
from flexid_cli.diagnose.stretch import Stretch
from flexid_cli.errors import DataError
from flexid_cli.signals.recording import Segment

RATE, BAND, SAMPLES = 500.0, 50.0, 8_000
Jm, K, JL, FVm, FV = 2.0, 3000.0, 1.5, 1.0, 0.4


def stretch(*, lag: float = 0.0, damping: float = 0.0, sign: float = 1.0) -> Stretch:
    """A linear axis, in closed form; the torque as it was asked for, before the actuator's lag."""
    rng = np.random.default_rng(11)
    time = np.arange(SAMPLES) / RATE
    motor, joint, torque = np.zeros(SAMPLES), np.zeros(SAMPLES), np.zeros(SAMPLES)
    for f in np.geomspace(0.2, 30.0, 25):
        s = 2j * np.pi * f
        wave = 0.3 / (1.0 + f) ** 2 * np.exp(s * time + 1j * rng.uniform(0.0, 6.0))
        load = JL * s**2 + FV * s
        twist = load / (K + damping * s)
        joint += wave.real
        motor += ((1.0 + twist) * wave).real
        torque += ((1.0 + lag * s) * ((Jm * s**2 + FVm * s) * (1.0 + twist) + load) * wave).real
    return Stretch(Segment(0.0, sign * torque, motor, joint), RATE, BAND)


def test_a_simple_fit_finds_a_linear_axis():
    base = _first_base([stretch()], 0.01, True, None)
    assert [base.Jm, base.K, base.JL] == pytest.approx([Jm, K, JL], rel=1e-3)


@pytest.mark.parametrize(("lag", "damping"), [(0.016, 60.0), (0.02, 60.0), (0.032, 60.0)])
def test_a_lag_that_turns_the_torque_does_not_hide_the_axis(lag, damping):
    base = _first_base([stretch(lag=lag, damping=damping)], 0.01, True, None)
    assert [base.Jm, base.K, base.JL] == pytest.approx([Jm, K, JL], rel=0.3)


def test_a_torque_of_the_wrong_sign_shows_no_axis():
    with pytest.raises(DataError, match="do not show a flexible axis"):
        _first_base([stretch(sign=-1.0)], 0.01, True, None)


def test_another_record_of_the_axis_begins_where_the_fitted_one_stands():
    known = _first_base([stretch()], 0.01, True, None)
    fitted = SimpleNamespace(base=known)
    assert _first_base([stretch(sign=-1.0)], 0.01, True, fitted) is known
