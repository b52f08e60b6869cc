"""Units, sides, gears and encoder turns."""

from __future__ import annotations

import numpy as np
import pytest

from flexid_cli.config.load import parse_config
from flexid_cli.errors import InputError
from flexid_cli.signals.convert import convert_position, convert_torque, count_wraps

RAW = np.array([0.5, -1.25, 2.0])


def config_of(axis: str = "gear_ratio: 50", torque: str = "", motor: str = "unit: rad, side: joint"):
    torque = torque or "motor_torque: {source: i, unit: N.m}"
    return parse_config(
        f"version: 1\naxis: {{name: a, {axis}}}\n"
        f"signals:\n  {torque}\n  motor_position: {{source: q, {motor}}}\n"
    )


def torque_of(axis: str, torque: str, motor: str = "unit: rad, side: joint"):
    config = config_of(axis, torque, motor)
    role = config.signals.torque_role
    return convert_torque(RAW, role, config.signals.torque, config.axis, linear=config.linear)


def position_of(axis: str, motor: str, raw=RAW):
    linear = "unit: m" in motor or "counts_per_m" in motor or "unit: um" in motor
    config = config_of(axis, "motor_torque: {source: i, unit: N}" if linear else "", motor)
    return convert_position(np.asarray(raw), "motor_position", config.signals.motor_position, config)


@pytest.mark.parametrize(
    ("axis", "torque", "factor", "unit"),
    [
        ("gear_ratio: 50", "motor_torque: {source: i, unit: N.m}", 50.0, "N.m"),
        ("gear_ratio: 50", "motor_torque: {source: i, unit: mN.m}", 0.05, "N.m"),
        ("gear_ratio: 50", "joint_torque: {source: i, unit: kN.m}", 1000.0, "N.m"),
        ("gear_ratio: 50", "motor_torque: {source: i, unit: V, torque_per_volt: 3}", 150.0, "N.m"),
        ("gear_ratio: 50", "joint_torque: {source: i, unit: mV, torque_per_volt: 3}", 3e-3, "N.m"),
        ("gear_ratio: 50, torque_constant_nm_per_a: 0.3", "motor_current: {source: i, unit: A}", 15.0, "N.m"),
        (
            "gear_ratio: 50, torque_constant_nm_per_a: 0.3",
            "motor_current: {source: i, unit: mA}",
            15e-3,
            "N.m",
        ),
        (
            "gear_ratio: 50, torque_constant_nm_per_a: 8.925, torque_constant_side: joint",
            "motor_current: {source: i, unit: A}",
            8.925,
            "N.m",
        ),
        (
            "gear_ratio: 50, torque_constant_nm_per_a: unknown",
            "motor_current: {source: i, unit: mA}",
            1e-3,
            "A",
        ),
        ("gear_ratio: 1", "motor_torque: {source: i, unit: N.m, scale: 2, sign: -1}", -2.0, "N.m"),
    ],
)
def test_torque(axis, torque, factor, unit):
    result = torque_of(axis, torque)
    assert result.values == pytest.approx(RAW * factor, rel=1e-14)
    assert result.unit == unit


def test_force_of_a_linear_axis():
    result = torque_of(
        "gear_ratio: 1", "motor_torque: {source: i, unit: V, torque_per_volt: 35.15}", "unit: m"
    )
    assert result.values == pytest.approx(RAW * 35.15)
    assert result.unit == "N"


def test_scale_offset_and_sign_come_in_this_order():
    result = torque_of("gear_ratio: 1", "motor_torque: {source: i, unit: N.m, scale: 2, offset: 3, sign: -1}")
    assert result.values.tolist() == [-4.0, -0.5, -7.0]
    assert result.steps == ("-(2 raw + 3)",)


@pytest.mark.parametrize(
    ("axis", "motor", "factor"),
    [
        ("gear_ratio: 50", "unit: rad, side: motor", 0.02),
        ("gear_ratio: 50", "unit: rad, side: joint", 1.0),
        ("gear_ratio: 50", "unit: deg, side: motor", np.pi / 9000),
        ("gear_ratio: 1", "unit: rev", 2 * np.pi),
        ("gear_ratio: 10", "unit: count, counts_per_rev: 8192, side: motor", 2 * np.pi / 81920),
        ("gear_ratio: 1", "unit: um", 1e-6),
        ("gear_ratio: 4", "unit: count, counts_per_m: 1e6, side: motor", 2.5e-7),
    ],
)
def test_position(axis, motor, factor):
    raw = RAW * 0.1
    assert position_of(axis, motor, raw).values == pytest.approx(raw * factor, rel=1e-14)


def test_values_that_need_nothing_are_untouched():
    result = position_of("gear_ratio: 1", "unit: rad")
    assert np.array_equal(result.values, RAW)
    assert result.steps == ()


TIME = np.linspace(0.0, 10.0, 5001)


@pytest.mark.parametrize(
    ("motor", "turn"),
    [
        ("unit: rad", 2 * np.pi),
        ("unit: deg", 360.0),
        ("unit: rev", 1.0),
        ("unit: count, counts_per_rev: 4096", 4096),
    ],
)
@pytest.mark.parametrize("low", [0.0, -0.5])
def test_wrapping_encoder_is_unwrapped(motor, turn, low):
    true = 8.0 * np.sin(2 * np.pi * 0.3 * TIME) + 0.1  # turns; up to 15 turns/s
    wrapped = ((true - low) % 1.0 + low) * turn
    result = position_of("gear_ratio: 1", motor, wrapped)
    difference = result.values / (2 * np.pi) - true
    assert np.ptp(difference) < 1e-9
    assert "wraps" in result.notes[0]


def test_fast_axis_is_not_unwrapped():
    turns = np.cumsum(0.9 * np.sin(2 * np.pi * 0.1 * TIME))  # up to 0.9 turns a sample
    result = position_of("gear_ratio: 1", "unit: rev", turns)
    assert np.array_equal(result.values, turns * (2 * np.pi))
    assert result.notes == ()


def test_a_single_outlier_is_no_wrap():
    turns = np.sin(TIME)
    turns[1000] += 0.7
    assert not count_wraps(turns, 1.0).any()


def test_unwrap_can_be_forced_and_forbidden():
    steps = np.array([0.0, 0.9, 0.1, 0.3])
    assert position_of("gear_ratio: 1", "unit: rev, unwrap: true", steps).values[1] == pytest.approx(
        -0.2 * np.pi
    )
    wrapped = (3.0 * TIME) % 1.0
    untouched = position_of("gear_ratio: 1", "unit: rev, unwrap: false", wrapped)
    assert np.array_equal(untouched.values, wrapped * (2 * np.pi))


@pytest.mark.parametrize("missing", [3, 40, 150])
def test_a_step_over_missing_samples_is_judged_by_the_velocity(missing):
    true = 3.0 * TIME  # 150 samples take 0.9 turns
    keep = np.ones(TIME.size, dtype=bool)
    keep[2000 : 2000 + missing] = False
    wrapped, periods = (true % 1.0)[keep], np.diff(np.flatnonzero(keep))
    turns = np.concatenate(([0], np.cumsum(count_wraps(wrapped, 1.0, periods=periods))))
    assert np.ptp(wrapped - turns - true[keep]) < 1e-9


def test_a_fast_step_over_missing_samples_is_no_evidence():
    turns = np.delete(np.sin(5 * TIME) * 3.0, slice(1000, 1100))
    periods = np.diff(np.delete(np.arange(TIME.size), slice(1000, 1100)))
    assert np.abs(np.diff(turns)).max() > 0.5
    assert not count_wraps(turns, 1.0, periods=periods).any()


def test_linear_axis_has_no_turn():
    with pytest.raises(InputError, match="no turn"):
        position_of("gear_ratio: 1", "unit: m, unwrap: true")
