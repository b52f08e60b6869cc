"""The band by its error: what is taken, what is not worth it, and what the report says of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import coverage
from flexid_cli.errors import DataError
from flexid_cli.estimate import band_choice
from flexid_cli.estimate.band import BAND_OVER_F1, Tuning
from flexid_cli.estimate.identify import identify
from flexid_cli.pipeline.chain import ChainSettings

TRUTH = np.array([3.0, 3000.0, 2.0])
MACHINE = coverage.BY_NAME["3"]


def tuned(over_f1):
    """A rate of 600 Hz and a resonance of 8 Hz, as the real choice would tune to them."""
    return Tuning(ChainSettings(600.0, decimation=int(240.0 / (8.0 * over_f1))), 64.0, 8.0, "data")


def outcome(tuning, *, random=1e-3, noise=0.0, systematic=0.0, away=0.0, dof=50.0):
    sizes = (np.full(3, share) * TRUTH for share in (random, noise, systematic))
    return band_choice.Outcome(TRUTH * (1.0 + away), *sizes, dof)


def over_f1(tuning):
    return 240.0 / tuning.chain.decimation / 8.0


def test_noise_that_grows_with_the_band_makes_it_narrow():
    found = band_choice.weigh("motor_only", tuned, lambda t: outcome(t, noise=1e-3 * over_f1(t) ** 6))
    assert found.moved
    assert found.taken == 0
    assert found.tuning == tuned(band_choice.OTHERS["motor_only"][0])


def test_information_that_grows_with_the_band_makes_it_wide():
    found = band_choice.weigh("two_encoders", tuned, lambda t: outcome(t, random=1e-3 * over_f1(t) ** -2))
    assert found.tuning == tuned(band_choice.OTHERS["two_encoders"][-1])


@pytest.mark.parametrize(
    ("gain", "dof", "moved"), [(0.15, 50.0, False), (0.25, 50.0, True), (0.4, 8.0, False)]
)
def test_a_gain_within_the_doubt_about_standard_errors_is_none(gain, dof, moved):
    """Two of 1 / sqrt(2 nu): a fifth of the error at 50 degrees of freedom, half of it at 8."""
    usual = tuned(BAND_OVER_F1["motor_only"])

    def at(tuning):
        return outcome(tuning, random=1e-3 * (1.0 if tuning == usual else 1.0 - gain), dof=dof)

    assert band_choice.weigh("motor_only", tuned, at).moved is moved


def test_what_contradicts_the_narrowest_band_is_distortion():
    """Wider bands promise less random error, but their estimates move by ten times of what the errors allow."""

    def at(tuning):
        wide = over_f1(tuning) > 1.5
        return outcome(tuning, random=4e-4 if wide else 1e-3, away=0.01 if wide else 0.0)

    found = band_choice.weigh("motor_only", tuned, at)
    assert not found.moved
    assert found.trials[-1].distortion == pytest.approx(0.01, rel=0.02)


def test_a_band_without_a_fit_is_left_out():
    def at(tuning):
        if over_f1(tuning) > 1.5:
            raise DataError("too short", "record longer")
        return outcome(tuning)

    found = band_choice.weigh("motor_only", tuned, at)
    assert [over_f1(t.tuning) < 1.5 for t in found.trials] == [True, True]


def test_no_choice_where_the_usual_band_has_no_fit():
    def at(tuning):
        raise DataError("too short", "record longer")

    assert band_choice.weigh("motor_only", tuned, at) is None


def record(noise, model):
    setting = coverage.Setting(MACHINE.name, noise, "white", "multisine")
    run = coverage.simulated(replace(MACHINE, duration_s=20.0), setting, 0)
    config = coverage.configuration(MACHINE, model, "direct")
    return coverage.recording_of(run, config, joint=model == "two_encoders"), config


def error(model):
    by = {e.symbol: e for e in model.parameters}
    return np.sqrt(np.mean([(by[s].stderr / by[s].value) ** 2 for s in coverage.JUDGED]))


def test_a_noisy_record_of_the_motor_alone_gets_a_narrower_band_and_smaller_errors():
    recording, config = record("1%", "motor_only")
    taken = identify(recording, config).models[0]
    test = taken.tests["band"]
    assert test["band_hz"] < test["usual_band_hz"] == pytest.approx(1.4 * MACHINE.f1_hz, rel=0.05)
    assert taken.pipeline.effective_band_hz[1] == test["band_hz"]
    fixed = config.pipeline.model_copy(update={"band_hz": 1.4 * MACHINE.f1_hz})
    usual = identify(recording, config.model_copy(update={"pipeline": fixed})).models[0]
    assert "band" not in usual.tests
    assert error(taken) < 0.8 * error(usual)
    K = next(e for e in taken.parameters if e.symbol == "K")
    assert K.interval.low <= MACHINE.K <= K.interval.high


def test_a_quiet_record_keeps_the_usual_band():
    recording, config = record("0.01%", "two_encoders")
    test = identify(recording, config).models[0].tests["band"]
    assert test["band_hz"] == test["usual_band_hz"]
    assert len(test["bands_hz"]) == len(test["error_percent"]) == 5
