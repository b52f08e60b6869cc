"""Named effects in records of another simulator: sizes, what they had biased, and the diagnosis' own numbers."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.machine.cases import FIRST_SEED, Case, case, columns, configuration
from flexid_cli.config.load import parse_config
from flexid_cli.config.schema import Config
from flexid_cli.diagnose.diagnose import diagnose
from flexid_cli.diagnose.given import identify_with
from flexid_cli.estimate.result import Estimate, ModelResult
from flexid_cli.readers.base import RawChannel, RawLog
from flexid_cli.signals.build import recording_from_raw
from flexid_cli.signals.recording import Recording

SEED = FIRST_SEED["calibration"]


def read(made: Case, models: list[str]) -> tuple[Config, Recording]:
    table = columns(made, made.a)
    stamps = {"header_stamp": np.round(table.pop("time") * 1e9).astype(np.int64)}
    channels = {name: RawChannel(name, np.asarray(v, dtype=float), stamps) for name, v in table.items()}
    plain = configuration(made) | {"models": models}
    config = parse_config(yaml.safe_dump(plain, sort_keys=False), made.task.name)
    return config, recording_from_raw(RawLog("memory", (), channels), config)


def solved(config: Config, recording: Recording, *names: str) -> ModelResult:
    [model] = identify_with(recording, config, names).models
    return model


def one(estimates: tuple[Estimate, ...], symbol: str) -> Estimate:
    return next(e for e in estimates if e.symbol == symbol)


def holds(estimate: Estimate, truth: float) -> bool:
    assert estimate.interval is not None
    return estimate.interval.low <= truth <= estimate.interval.high


def test_backlash_that_had_biased_the_stiffness():
    made = case("backlash", SEED + 5, seconds=(20.0, 25.0))
    config, recording = read(made, ["two_encoders"])
    model = solved(config, recording, "backlash")
    truth, gap = made.truth["base"]["K"], made.truth["extra"]["gap"]
    [effect] = model.effects
    assert one(effect.parameters, "gap").value == pytest.approx(gap, rel=0.1)
    assert one(effect.parameters, "gap").verdict == "identified"
    assert effect.statistic > effect.threshold
    assert effect.p_value < 0.01
    assert effect.held_out_gain > 0.0
    assert holds(one(model.parameters, "K"), truth)
    before = one(model.parameters_before, "K")
    assert not holds(before, truth)
    after = abs(one(model.parameters, "K").value / truth - 1.0)
    assert after < 0.2 * abs(before.value / truth - 1.0)
    # What the diagnosis finds by itself has the same numbers: these are its fits.
    found = diagnose(recording, config)
    assert [e.name for e in found.effects] == ["backlash"]
    for symbol in ("Jm", "K", "JL"):
        mine, its = one(model.parameters, symbol), one(found.parameters_after, symbol)
        assert mine.value == pytest.approx(its.value, rel=1e-3)
        assert mine.stderr == pytest.approx(its.stderr, rel=0.1)


@pytest.mark.slow
def test_two_effects_in_any_order():
    made = case(("cogging", "joint_damping"), SEED + 200_000, seconds=(20.0, 25.0))
    config, recording = read(made, ["two_encoders"])
    models = [solved(config, recording, *names) for names in (("cogging", "FX201"), ("FX201", "cogging"))]
    for model in models:
        effects = {e.name: e.parameters for e in model.effects}
        assert one(effects["joint_damping"], "D").value == pytest.approx(made.truth["extra"]["c"], rel=0.1)
        assert one(effects["cogging"], "n").value == pytest.approx(made.truth["extra"]["cog_n"], rel=1e-3)
        assert holds(one(model.parameters, "K"), made.truth["base"]["K"])
    first, second = (one(m.parameters, "K") for m in models)
    assert first.value == pytest.approx(second.value, rel=1e-6)


@pytest.mark.slow
def test_without_a_joint_encoder():
    """The offset is no effect that must be named there: the model holds it, and gravity."""
    made = case("load_dependent_friction", SEED + 300_007, seconds=(20.0, 25.0), motor_only=True)
    config, recording = read(made, ["motor_only"])
    model = solved(config, recording, "load_dependent_friction")
    assert model.added_terms == ("torque_offset", "gravity", "load_dependent_friction")
    assert "gravity_moment_x" in {e.name for e in model.parameters}
    [effect] = model.effects
    assert effect.statistic > effect.threshold
    total = sum(one(model.parameters, s).value for s in ("Jm", "JL"))
    assert total == pytest.approx(made.truth["base"]["Jm"] + made.truth["base"]["JL"], rel=0.05)


@pytest.mark.slow
def test_a_model_that_lacks_more_than_the_effect_identifies_nothing():
    """The record moves a flexible axis through its resonance; friction does not make a rigid one of it."""
    made = case("load_dependent_friction", SEED + 300_007, seconds=(20.0, 25.0), motor_only=True)
    config, recording = read(made, ["rigid"])
    model = solved(config, recording, "load_dependent_friction")
    assert model.id == "rigid"
    assert all(e.verdict != "identified" for e in model.parameters)
    assert any("still leaves out something" in w for w in model.warnings)
