"""Whole diagnoses of records that another simulator made: what was hidden is named, and symmetries hold.

The machine of the benchmarks shares no code with flexid. Seeds are those of its calibration, never of its test.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.machine.cases import FIRST_SEED, NONE, Case, case, columns, configuration
from flexid_cli.config.load import parse_config
from flexid_cli.config.schema import Config
from flexid_cli.diagnose.diagnose import diagnose
from flexid_cli.diagnose.result import Diagnosis
from flexid_cli.effects.base import EffectValues
from flexid_cli.readers.base import RawChannel, RawLog
from flexid_cli.signals.build import recording_from_raw
from flexid_cli.signals.recording import Recording, Segment
from flexid_cli.simulate.engine import simulate_closed_loop
from flexid_cli.simulate.machine import Axis, Controller

SEED = FIRST_SEED["calibration"]
LATER_NS = 1_700_000_000_000_000_000


def read(made: Case, *, later_ns: int = 0, **units: Any) -> tuple[Config, Recording]:
    """Record and configuration as from a log; ``units`` changes the motor position's, by (unit, side, factor)."""
    plain, table = configuration(made), columns(made, made.a)
    for role, (unit, side, factor) in units.items():
        plain["signals"][role] |= {"unit": unit, "side": side}
        table[role] = table[role] * factor
    stamps = {"header_stamp": np.round(table.pop("time") * 1e9).astype(np.int64) + later_ns}
    channels = {name: RawChannel(name, np.asarray(v, dtype=float), stamps) for name, v in table.items()}
    config = parse_config(yaml.safe_dump(plain, sort_keys=False), made.task.name)
    return config, recording_from_raw(RawLog("memory", (), channels), config)


def answer(kinds: tuple[str, ...], seed: int, *, motor_only: bool = False) -> tuple[Case, Diagnosis]:
    made = case(kinds, seed, seconds=(20.0, 25.0), motor_only=motor_only)
    config, recording = read(made)
    return made, diagnose(recording, config)


def names(found: Diagnosis) -> set[str]:
    return {e.name for e in found.effects}


def estimate(found: Diagnosis, symbol: str) -> Any:
    return next(e for e in found.parameters_after if e.symbol == symbol)


def assert_holds(found: Diagnosis, made: Case, symbol: str = "K") -> None:
    truth, e = made.truth["base"][symbol], estimate(found, symbol)
    assert e.verdict == "identified", (symbol, e.reason)
    assert e.interval.low <= truth <= e.interval.high, (symbol, truth, e.value, e.interval)


def test_nothing_hidden_is_adequate():
    made, found = answer((NONE,), SEED + 100_000)
    assert found.verdict == "adequate"
    assert not found.effects
    assert found.location is None
    assert_holds(found, made)
    assert {t.name for t in found.tested if not t.reason} == set()
    assert found.held_out is not None
    assert found.held_out.before == found.held_out.after


def test_a_recording_on_which_the_model_does_not_hold_is_told():
    """Validated on a record of a larger torque for the same motion: that of another axis."""
    made = case((NONE,), SEED + 100_000, seconds=(20.0, 25.0))
    config, recording = read(made)
    segments = tuple(replace(s, torque=1.3 * s.torque) for s in recording.segments)
    found = diagnose(recording, config, replace(recording, segments=segments))
    assert any("does not hold there" in note for note in found.notes)
    assert any("leaves more than its noise" in note for note in found.notes)
    stiffness = estimate(found, "K")
    assert stiffness.verdict == "weak"
    assert "other recording" in stiffness.reason
    same = diagnose(recording, config, recording)
    assert not any("does not hold there" in note for note in same.notes)
    assert_holds(same, made)


def limited(amplitude: float, like: Recording, seed: int) -> Recording:
    """An axis whose drive gives no more than 60 N m, moved by so much of a usual trajectory."""
    rng, rate = np.random.default_rng(seed), like.sample_rate_hz
    t = np.arange(round(15.0 * rate)) / rate
    waves = [0.3 / (1.0 + f) * np.sin(2.0 * np.pi * (f * t + rng.random())) for f in (0.3, 0.9, 2.1, 4.0)]
    run = simulate_closed_loop(
        Axis(
            Jm=3.0, K=4000.0, JL=2.0, FVm=4.0, FSm=3.0, FV=2.0, FS=0.5, MX=0.0, MY=0.0,
            reversal_velocity=0.004, load_reversal_velocity=0.01,
        ),
        Controller(15.0, 150.0, 300.0),
        amplitude * np.sum(waves, axis=0),
        rate,
        effects=[EffectValues("torque_saturation", {"torque_limit": 60.0})],
    )  # fmt: skip
    noisy = (x + s * rng.standard_normal(t.size) for x, s in (
        (run.torque, 0.1), (run.motor_position, 1e-7), (run.joint_position, 1e-7),
    ))  # fmt: skip
    return replace(like, segments=(Segment(0.0, *noisy),))


def test_what_only_the_other_recording_shows_is_found_there():
    """Motion within the drive's limit shows none; the recording for validation, of larger motion, does."""
    made = case((NONE,), SEED + 100_000, seconds=(20.0, 25.0))
    _, like = read(made)
    plain = configuration(made)
    plain["signals"]["motor_current"]["hold"] = "instant"  # told by the diagnosis itself
    config = parse_config(yaml.safe_dump(plain), "limited")
    small, large = limited(0.12, like, 1), limited(0.2, like, 2)
    assert diagnose(small, config).verdict == "adequate"
    found = diagnose(small, config, large)
    assert found.verdict == "explained"
    assert names(found) == {"torque_saturation"}
    assert "Only the recording for validation" in found.sentence
    assert any("holds nothing that the model lacks" in note for note in found.notes)
    assert "Only the recording" not in diagnose(large, config, small).sentence


slow = pytest.mark.slow


@pytest.mark.parametrize(
    ("kind", "offset", "value"),
    [
        ("backlash", 5, ("gap", "gap")),
        ("cogging", 1, ("cogging_cycles", "cog_n")),
        pytest.param("joint_damping", 2, ("joint_damping", "c"), marks=slow),
        pytest.param("stribeck_motor", 13, ("stribeck_torque", "strib_f"), marks=slow),
        pytest.param("hysteresis", 14, None, marks=slow),
    ],
)
def test_a_hidden_effect_is_named_and_modelled(kind, offset, value):
    made, found = answer((kind,), SEED + offset)
    assert found.verdict in ("explained", "ambiguous")
    (effect,) = found.effects
    assert effect.name == kind
    assert_holds(found, made)
    assert effect.evidence.statistic > effect.evidence.threshold
    assert effect.evidence.p_value < 0.01
    assert effect.evidence.held_out_gain > 0.0
    assert found.simulation is not None
    assert found.simulation.after < found.simulation.before
    assert found.held_out is not None
    equations = ("motor", "load")
    assert sum(found.held_out.after[e] for e in equations) < sum(found.held_out.before[e] for e in equations)
    if value is not None:
        name, hidden = value
        parameter = next(p for p in effect.parameters if p.symbol == name or p.name == name)
        assert parameter.value == pytest.approx(made.truth["extra"][hidden], rel=0.1)


def test_two_hidden_effects_are_both_named():
    made, found = answer(("cogging", "joint_damping"), SEED + 200_000)
    assert names(found) == {"cogging", "joint_damping"}
    assert_holds(found, made)


def test_motor_encoder_alone():
    """The stiffness is not asked for: whether a record of the motor alone shows it depends on its resonance."""
    made, found = answer(("torque_offset",), SEED + 300_000, motor_only=True)
    assert found.model == "motor_only"
    (effect,) = found.effects
    assert "torque_offset" in {effect.name, *effect.alternatives}
    (offset,) = (p for p in effect.parameters if effect.name == "torque_offset")
    assert offset.value == pytest.approx(made.truth["extra"]["offset"], rel=0.1)


@slow
def test_what_the_library_lacks_is_located_and_not_named():
    made, found = answer(("disturbance_motor",), SEED + 400_000)
    assert found.verdict == "unexplained"
    assert not found.effects
    assert found.location is not None
    assert found.location.equation in made.truth["where"]
    assert all(e.verdict != "identified" for e in found.parameters_after)


# --- symmetries ---


@cache
def small() -> tuple[Case, Diagnosis]:
    made = case(("cogging",), SEED + 1, seconds=(9.0, 10.0))
    config, recording = read(made)
    return made, diagnose(recording, config)


def assert_same(found: Diagnosis, flipped: tuple[str, ...] = (), rel: float = 1e-5) -> None:
    """Same verdict, same effects, same parameters; ``flipped`` symbols have the other sign."""
    first = small()[1]
    assert (found.verdict, found.sentence) == (first.verdict, first.sentence)
    assert [(e.name, e.alternatives) for e in found.effects] == [
        (e.name, e.alternatives) for e in first.effects
    ]
    for a, b in zip(first.parameters_after, found.parameters_after, strict=True):
        sign = -1.0 if a.symbol in flipped else 1.0
        assert (b.symbol, b.unit, b.verdict) == (a.symbol, a.unit, a.verdict)
        assert b.value == pytest.approx(sign * a.value, rel=rel, abs=0.01 * a.stderr)
        assert b.stderr == pytest.approx(a.stderr, rel=1e-2)
    for one, other in zip(first.effects, found.effects, strict=True):
        for a, b in zip(one.parameters, other.parameters, strict=True):
            sign = -1.0 if a.symbol in flipped else 1.0
            assert b.value == pytest.approx(sign * a.value, rel=rel, abs=0.01 * a.stderr)


def test_units_side_and_time_of_recording_change_nothing():
    """In degrees at the joint in place of radians at the motor's shaft, and years later."""
    made = small()[0]
    factor = np.degrees(1.0) / made.plant.gear_ratio
    config, recording = read(made, later_ns=LATER_NS, motor_position=("deg", "joint", factor))
    assert_same(diagnose(recording, config))


def test_an_axis_that_counts_the_other_way_has_the_same_physics():
    config, recording = read(small()[0])
    turned = tuple(_turned(s) for s in recording.segments)
    assert_same(diagnose(replace(recording, segments=turned), config), flipped=("MX", "phi", "phi2"))


def _turned(s: Segment) -> Segment:
    assert s.joint_position is not None
    return replace(
        s,
        torque=-s.torque,
        motor_position=-s.motor_position,
        joint_position=-s.joint_position,
        reference_position=None if s.reference_position is None else -s.reference_position,
    )


def test_a_torque_that_hardly_stands_above_its_noise_is_inconclusive():
    config, recording = read(small()[0])
    rng = np.random.default_rng(1)
    loud = tuple(
        replace(s, torque=s.torque + 12.0 * np.std(s.torque) * rng.standard_normal(s.samples))
        for s in recording.segments
    )
    found = diagnose(replace(recording, segments=loud), config)
    assert found.verdict == "inconclusive"
    assert not found.effects
    assert found.location is None
    assert found.next_recording
    assert all(e.verdict != "identified" for e in found.parameters_after)
