"""Laws that a recording obeys whatever the log looks like: units, shifts, signs, splits, damage."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from flexid_cli.config.load import parse_config
from flexid_cli.readers.base import RawChannel, RawLog
from flexid_cli.signals.build import build_recording, recording_from_raw

if TYPE_CHECKING:
    from flexid_cli.signals.recording import Recording

quick = settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
seeds = st.integers(0, 2**32 - 1)
SAMPLES = 1500
RATE = 500.0
GEAR = 40.0


def config_of(
    torque: str = "unit: A",
    motor: str = "unit: rad",
    joint: str = "unit: rad",
    time: str = "unit: s",
    gap: str = "",
):
    return parse_config(
        f"""
version: 1
axis: {{name: a, gear_ratio: {GEAR}, torque_constant_nm_per_a: 0.35}}
signals:
  time: {{source: t, {time}{gap}}}
  motor_current: {{source: i, {torque}}}
  motor_position: {{source: m, side: motor, {motor}}}
  joint_position: {{source: j, {joint}}}
"""
    )


def columns_of(seed: int, samples: int = SAMPLES) -> dict[str, np.ndarray]:
    """A band-limited axis: sums of sines up to 20 Hz, sampled at 500 Hz."""
    rng = np.random.default_rng(seed)
    time = np.arange(samples) / RATE
    joint = sum(
        rng.normal() / f * np.sin(2 * np.pi * f * time + rng.uniform(0, 6)) for f in rng.uniform(0.3, 20, 4)
    ) + 2.0 * np.sin(2 * np.pi * 0.5 * time)
    twist = 0.002 * np.sin(2 * np.pi * rng.uniform(1, 20) * time)
    current = sum(rng.normal() * np.cos(2 * np.pi * f * time) for f in rng.uniform(0.3, 20, 4)) + time
    return {"t": time, "i": current, "m": GEAR * (joint + twist), "j": joint}


def build(columns: dict[str, np.ndarray], config=None) -> Recording:
    channels = {name: RawChannel(name, np.asarray(values, dtype=float)) for name, values in columns.items()}
    return recording_from_raw(RawLog("csv", (Path("a.csv"),), channels), config or config_of(), channels["t"])


def assert_same(one: Recording, other: Recording, tolerance: float = 1e-12) -> None:
    assert one.sample_rate_hz == pytest.approx(other.sample_rate_hz, rel=1e-12)
    assert [s.samples for s in one.segments] == [s.samples for s in other.segments]
    for a, b in zip(one.segments, other.segments, strict=True):
        assert a.start_s == pytest.approx(b.start_s, abs=1e-9)
        for name in ("torque", "motor_position", "joint_position"):
            first, second = getattr(a, name), getattr(b, name)
            assert np.abs(first - second).max() <= tolerance * np.abs(second).max()


@quick
@given(seeds)
def test_units_do_not_matter(seed):
    columns = columns_of(seed)
    other = {
        "t": columns["t"] * 1e3,
        "i": columns["i"] * 1e3,
        "m": columns["m"] * (8192 / (2 * np.pi)),
        "j": np.rad2deg(columns["j"]),
    }
    config = config_of("unit: mA", "unit: count, counts_per_rev: 8192", "unit: deg", "unit: ms")
    assert_same(build(other, config), build(columns))


@quick
@given(seeds, st.integers(-(10**6), 10**6))
def test_the_start_of_time_does_not_matter(seed, start):
    columns = columns_of(seed)
    assert_same(build(columns | {"t": columns["t"] + start}), build(columns), 0.0)


@quick
@given(seeds, st.floats(0.1, 10.0), st.floats(-5.0, 5.0))
def test_scale_and_offset_undo_each_other(seed, scale, offset):
    columns = columns_of(seed)
    recorded = columns | {"j": (columns["j"] - offset) / scale}
    result = build(recorded, config_of(joint=f"unit: rad, scale: {scale!r}, offset: {offset!r}"))
    assert_same(result, build(columns), 1e-11)


@quick
@given(seeds)
def test_a_sign_turned_twice_is_none(seed):
    columns = columns_of(seed)
    turned = columns | {name: -columns[name] for name in ("i", "m", "j")}
    signs = [f"unit: {unit}, sign: -1" for unit in ("A", "rad", "rad")]
    assert_same(build(turned, config_of(*signs)), build(columns), 0.0)


@quick
@given(seeds, st.integers(1, SAMPLES - 1))
def test_a_log_split_into_files_is_the_same(tmp_path, seed, cut):
    columns = columns_of(seed)
    table = np.column_stack(list(columns.values()))
    for name, part in (("whole", table), ("a", table[:cut]), ("b", table[cut:])):
        np.savetxt(tmp_path / f"{name}.csv", part, delimiter=",", header="t,i,m,j", comments="", fmt="%.17g")
    whole, _ = build_recording([tmp_path / "whole.csv"], config_of())
    split, _ = build_recording([tmp_path / "a.csv", tmp_path / "b.csv"], config_of())
    assert_same(split, whole, 0.0)
    assert_same(whole, build(columns), 0.0)


@quick
@given(seeds, st.integers(2, 30), st.data())
def test_order_and_doubles_do_not_matter(seed, block, data):
    columns = columns_of(seed)
    rng = np.random.default_rng(data.draw(seeds))
    count = SAMPLES // block
    order = np.arange(SAMPLES)
    order[: count * block] = rng.permuted(order[: count * block].reshape(count, block), axis=1).ravel()
    again = rng.integers(0, SAMPLES, 20)
    order = np.insert(order, np.sort(again), order[np.sort(again)])
    result = build({name: values[order] for name, values in columns.items()})
    assert_same(result, build(columns), 0.0)
    assert result.clocks[0].duplicates == 20
    assert result.clocks[0].resets == 0


@quick
@given(seeds, st.integers(50, SAMPLES - 100), st.integers(1, 60), st.sampled_from("imj"))
def test_a_gap_is_bridged_up_to_the_limit_and_never_beyond(seed, first, length, name):
    columns = columns_of(seed)
    damaged = columns[name].copy()
    damaged[first : first + length] = np.nan
    limit = 0.0501  # 25 periods: 24 missing samples
    result = build(columns | {name: damaged}, config_of(gap=f", max_gap_s: {limit}"))
    clock = next(c for c in result.clocks if c.invalid)
    assert clock.invalid == length
    if (length + 1) / RATE > limit:
        assert [s.samples for s in result.segments] == [first, SAMPLES - first - length]
        assert clock.gaps == 1
        return
    assert [s.samples for s in result.segments] == [SAMPLES]
    assert clock.bridged == length
    whole = build(columns).segments[0]
    outside = np.ones(SAMPLES, dtype=bool)
    outside[first : first + length] = False
    for signal in ("torque", "motor_position", "joint_position"):
        assert np.array_equal(getattr(result.segments[0], signal)[outside], getattr(whole, signal)[outside])


@quick
@given(seeds, st.integers(100, SAMPLES - 100), st.floats(0.1, 1e4))
def test_a_reset_keeps_every_sample(seed, at, back):
    columns = columns_of(seed)
    time = columns["t"].copy()
    time[at:] -= back
    assume(abs(time[-1]) > 0.05)  # else the second stretch ends where the first began: swapped, not reset
    result = build(columns | {"t": time})
    assert [s.samples for s in result.segments] == [at, SAMPLES - at]
    assert result.clocks[0].resets == 1
    joined = np.concatenate([s.joint_position for s in result.segments])
    assert np.array_equal(joined, columns["j"])
    assert result.segments[1].start_s > at / RATE


@quick
@given(seeds, st.integers(20, 60), st.floats(0.0, 0.95))
def test_different_rates_and_phases_align(seed, hundreds, phase):
    """Torque and motor at 2 to 6 kHz against a joint encoder at 500 Hz, content up to a tenth of that."""
    rate = 100.0 * hundreds
    rng = np.random.default_rng(seed)
    tones = [(rng.normal(), f, rng.uniform(0, 6)) for f in (0.7, *rng.uniform(1, 25, 3))]

    def signal(seconds):
        return sum(a * np.sin(2 * np.pi * f * seconds + p) for a, f, p in tones) + 5 * np.sin(seconds)

    fast = np.rint(np.arange(int(3 * rate)) / rate * 1e9).astype(np.int64)
    slow = np.rint((np.arange(int(3 * RATE)) + phase) / RATE * 1e9).astype(np.int64)
    channels = {
        "i": RawChannel("i", signal(fast / 1e9), {"header_stamp": fast}),
        "m": RawChannel("m", GEAR * signal(fast / 1e9), {"header_stamp": fast}),
        "j": RawChannel("j", signal(slow / 1e9), {"header_stamp": slow}),
    }
    config = config_of()
    config = config.model_copy(update={"signals": config.signals.model_copy(update={"time": None})})
    (segment,) = recording_from_raw(RawLog("mcap", (Path("a"),), channels), config).segments
    scale = np.abs(segment.joint_position).max()
    core = slice(40, -40)
    assert np.abs(segment.motor_position - segment.joint_position)[core].max() < 3e-4 * scale
    assert np.abs(segment.torque / (GEAR * 0.35) - segment.joint_position)[core].max() < 3e-4 * scale


@quick
@given(seeds, st.floats(0.003, 0.25))
def test_jittered_stamps_resample_to_the_analytic_signal(seed, jitter):
    columns = columns_of(seed)
    rng = np.random.default_rng(seed)
    time = columns["t"] + rng.uniform(-jitter, jitter, SAMPLES) / RATE

    def signal(seconds):
        return 2.0 * np.sin(2 * np.pi * 1.3 * seconds) + 0.5 * np.sin(2 * np.pi * 11.0 * seconds)

    exact = np.round(time * 1e9) / 1e9
    result = build({"t": time, "i": signal(exact), "m": GEAR * signal(exact), "j": signal(exact)})
    (segment,) = result.segments
    grid = exact[0] + np.arange(segment.samples) / result.sample_rate_hz
    assert np.abs(segment.joint_position - signal(grid))[10:-10].max() < 5e-4
    assert np.abs(segment.motor_position - segment.joint_position).max() < 1e-9


@quick
@given(seeds)
def test_the_order_of_channels_does_not_matter(seed):
    columns = columns_of(seed)
    assert_same(build(dict(reversed(columns.items()))), build(columns), 0.0)


def test_a_recording_is_not_changed_by_what_built_it():
    columns = columns_of(0)
    before = {name: values.copy() for name, values in columns.items()}
    result = build(columns)
    assert all(np.array_equal(columns[name], before[name]) for name in columns)
    assert replace(result) == result
