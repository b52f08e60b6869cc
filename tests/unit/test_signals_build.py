"""From channels in memory to a recording: alignment, faults, plausibility; and some real recordings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flexid_cli.config.load import parse_config
from flexid_cli.errors import DataError, InputError
from flexid_cli.readers.base import Note, RawChannel, RawLog
from flexid_cli.signals.build import build_recording, find_time_column, recording_from_raw, time_unit_of

NS = 1e9
CONFIG = """
version: 1
axis: {name: a, gear_ratio: 50}
signals:
  motor_torque: {source: i, unit: N.m}
  motor_position: {source: m, unit: rad, side: motor}
  joint_position: {source: j, unit: rad}
"""


def motion(seconds: np.ndarray) -> np.ndarray:
    return np.sin(2 * np.pi * 0.7 * seconds) + 0.3 * np.sin(2 * np.pi * 4.1 * seconds + 1.0)


def effort(seconds: np.ndarray) -> np.ndarray:
    return np.cos(2 * np.pi * 0.7 * seconds) + 0.2 * np.sin(2 * np.pi * 9.0 * seconds)


def stamped(source: str, stamps: np.ndarray, values: np.ndarray, clock: str = "header_stamp") -> RawChannel:
    return RawChannel(source, values, {clock: stamps, "log_time": stamps + 1_000_000})


def log_of(*channels: RawChannel, kind: str = "mcap") -> RawLog:
    return RawLog(kind, (Path("run.mcap"),), {channel.source: channel for channel in channels})


def stamps_of(rate_hz: float, seconds: float, start_s: float = 1000.0) -> np.ndarray:
    return np.rint((start_s + np.arange(int(rate_hz * seconds)) / rate_hz) * NS).astype(np.int64)


def usual(rate: float = 500.0, joint_rate: float | None = None, seconds: float = 8.0) -> list[RawChannel]:
    stamps, joint = stamps_of(rate, seconds), stamps_of(joint_rate or rate, seconds)
    return [
        stamped("i", stamps, effort(stamps / NS - 1000)),
        stamped("m", stamps, 50 * motion(stamps / NS - 1000)),
        stamped("j", joint, motion(joint / NS - 1000)),
    ]


def csv_log(columns: dict[str, np.ndarray], time: np.ndarray, unit: str | None = None):
    channels = {name: RawChannel(name, values) for name, values in columns.items()}
    return RawLog("csv", (Path("run.csv"),), channels), RawChannel("time", time, {}, unit)


def csv_usual(samples: int = 4000, rate: float = 500.0):
    time = np.arange(samples) / rate
    return csv_log({"i": effort(time), "m": 50 * motion(time), "j": motion(time)}, time)


def test_shared_stamps_come_out_bit_for_bit():
    channels = usual()
    result = recording_from_raw(log_of(*channels), parse_config(CONFIG))
    (segment,) = result.segments
    assert result.sample_rate_hz == 500.0
    assert np.array_equal(segment.torque, channels[0].values * 50)
    assert np.array_equal(segment.motor_position, channels[1].values / 50)
    assert np.array_equal(segment.joint_position, channels[2].values)
    assert segment.start_s == 0.0
    assert result.duration_s == pytest.approx(8.0 - 1 / 500)
    assert result.torque_unit == "N.m"
    assert result.notes == ()
    assert [clock.clock for clock in result.clocks] == ["header_stamp"] * 3


def test_the_slowest_measured_signal_gives_the_rate_and_the_others_are_lowpassed():
    result = recording_from_raw(log_of(*usual(1000, 250)), parse_config(CONFIG))
    (segment,) = result.segments
    assert result.sample_rate_hz == pytest.approx(250.0)
    time = segment.start_s + np.arange(segment.samples) / 250.0
    assert np.abs(segment.torque / 50 - effort(time))[50:-50].max() < 3e-4
    assert np.abs(segment.motor_position - motion(time))[50:-50].max() < 3e-4
    assert any("low-passed" in line and "125 Hz" in line for line in result.history)


def test_the_reference_never_limits_the_rate():
    slow = stamps_of(50, 8)
    config = parse_config(CONFIG + "  reference_position: {source: r, unit: rad, side: joint}\n")
    result = recording_from_raw(log_of(*usual(), stamped("r", slow, motion(slow / NS - 1000))), config)
    (segment,) = result.segments
    assert result.sample_rate_hz == 500.0
    time = segment.start_s + np.arange(segment.samples) / 500.0
    assert np.abs(segment.reference_position - motion(time))[100:-100].max() < 3e-4


def test_delay_and_hold_move_the_stamps():
    text = CONFIG.replace("source: i, unit: N.m", "source: i, unit: N.m, hold: sample")
    text = text.replace("source: j, unit: rad", "source: j, unit: rad, delay_s: 0.0031")
    (segment,) = recording_from_raw(log_of(*usual()), parse_config(text)).segments
    time = (
        segment.start_s + np.arange(segment.samples) / 500.0 - 0.0031
    )  # the record starts with the joint's stamp
    core = slice(40, -40)
    assert np.abs(segment.motor_position - motion(time))[core].max() < 1e-12
    assert np.abs(segment.torque / 50 - effort(time - 0.001))[core].max() < 2e-4
    assert np.abs(segment.joint_position - motion(time + 0.0031))[core].max() < 2e-4


def test_gap_in_one_signal_splits_all():
    channels = usual()
    gone = channels[2].values.copy()
    gone[1000:1010] = np.nan
    result = recording_from_raw(
        log_of(channels[0], channels[1], RawChannel("j", gone, channels[2].stamps)), parse_config(CONFIG)
    )
    assert [segment.samples for segment in result.segments] == [1000, 2990]
    assert result.segments[1].start_s == pytest.approx(1010 / 500)
    assert any("1 gap above" in note for note in result.notes)
    assert any("10 of 4000 samples without a number" in note for note in result.notes)


def test_reset_gives_two_segments_and_a_note():
    channels = usual()
    stamps = channels[0].stamps["header_stamp"].copy()
    stamps[2000:] -= stamps[2000] - stamps[100]
    broken = [RawChannel(c.source, c.values, {"header_stamp": stamps}) for c in channels]
    result = recording_from_raw(log_of(*broken), parse_config(CONFIG))
    assert [segment.samples for segment in result.segments] == [2000, 2000]
    assert np.array_equal(result.segments[1].joint_position, channels[2].values[2000:])
    assert result.segments[1].start_s > result.segments[0].start_s + 4.0
    assert any("1 jump back of the clock" in note for note in result.notes)


def test_no_overlap_names_the_spans():
    late = stamps_of(500, 8, 2000.0)
    channels = [*usual()[:2], stamped("j", late, motion(late / NS))]
    with pytest.raises(DataError, match="do not overlap") as caught:
        recording_from_raw(log_of(*channels), parse_config(CONFIG))
    assert "joint_position 1000.000 to 1007.998 s" in caught.value.message
    assert caught.value.exit_code == 3


def test_record_too_short():
    with pytest.raises(DataError, match="the longest has 20"):
        recording_from_raw(log_of(*usual(seconds=0.04)), parse_config(CONFIG))


@pytest.mark.parametrize(
    ("index", "role"), [(0, "motor_torque"), (1, "motor_position"), (2, "joint_position")]
)
def test_constant_signal(index, role):
    channels = usual()
    channels[index] = RawChannel(channels[index].source, np.full(4000, 2.5), channels[index].stamps)
    channels[index].values[7] = np.nan
    with pytest.raises(DataError, match=f"{role}: .*never changes") as caught:
        recording_from_raw(log_of(*channels), parse_config(CONFIG))
    assert caught.value.hint


@pytest.mark.parametrize(
    ("factor", "words", "hint"),
    [
        (-1.0, "directions differ", "sign: -1"),
        (50.0, "that is gear_ratio", "side"),
        (1 / 50.0, "1/gear_ratio", "side"),
        (180 / np.pi, "deg per rad", "unit"),
        (-np.pi / 180, "one over the factor deg per rad", "sign: -1"),
    ],
)
def test_encoders_that_contradict_each_other(factor, words, hint):
    channels = usual()
    channels[2] = RawChannel("j", channels[2].values * factor, channels[2].stamps)
    with pytest.raises(InputError, match=words) as caught:
        recording_from_raw(log_of(*channels), parse_config(CONFIG))
    assert hint in caught.value.hint


def test_an_odd_ratio_is_a_note():
    channels = usual()
    channels[2] = RawChannel("j", channels[2].values * 3.0, channels[2].stamps)
    result = recording_from_raw(log_of(*channels), parse_config(CONFIG))
    assert any("3 times" in note for note in result.notes)


def test_flexibility_is_no_contradiction():
    channels = usual()
    time = channels[0].stamps["log_time"] / NS
    channels[2] = RawChannel(
        "j", channels[2].values + 0.1 * np.sin(2 * np.pi * 20 * time), channels[2].stamps
    )
    assert recording_from_raw(log_of(*channels), parse_config(CONFIG)).notes == ()


def test_impossible_speed_is_a_note():
    channels = usual()
    channels[1:] = [RawChannel(c.source, c.values * 1e4, c.stamps) for c in channels[1:]]
    notes = recording_from_raw(log_of(*channels), parse_config(CONFIG)).notes
    assert any("hardly possible" in note for note in notes)


class TestCsvTime:
    def test_column(self):
        raw, time = csv_usual()
        result = recording_from_raw(raw, parse_config(CONFIG), time)
        assert result.sample_rate_hz == 500.0
        assert np.array_equal(result.segments[0].joint_position, raw.channels["j"].values)
        assert result.clocks[0].clock == "column"

    def test_epoch_nanoseconds_are_exact(self):
        raw, _ = csv_usual()
        exact = np.int64(1_763_000_000_123_456_789) + np.arange(4000, dtype=np.int64) * 2_000_001
        column = RawChannel("time", exact.astype(float), {}, "ns", exact)
        result = recording_from_raw(raw, parse_config(CONFIG), column)
        assert result.sample_rate_hz == pytest.approx(1e9 / 2_000_001, rel=1e-14)
        assert result.clocks[0].jitter_s == 0.0

    def test_fixed_rate(self):
        raw, _ = csv_usual()
        result = recording_from_raw(raw, parse_config(CONFIG + "  time: {rate_hz: 350.87}\n"))
        assert result.sample_rate_hz == pytest.approx(350.87, rel=1e-9)
        assert result.segments[0].samples == 4000

    def test_fixed_rate_needs_equal_lengths(self):
        with pytest.raises(InputError, match="cannot be that of joint_position"):
            recording_from_raw(log_of(*usual(500, 250)), parse_config(CONFIG + "  time: {rate_hz: 500}\n"))

    def test_declared_unit_counts_unless_configured(self):
        raw, time = csv_usual()
        column = RawChannel("time", time.values * 1e3, {}, "ms")
        assert recording_from_raw(raw, parse_config(CONFIG), column).sample_rate_hz == pytest.approx(500.0)
        text = CONFIG + "  time: {source: time, unit: s}\n"
        result = recording_from_raw(raw, parse_config(text), column)
        assert result.sample_rate_hz == pytest.approx(0.5)
        assert any("the log declares ms" in note for note in result.notes)
        assert any("is the unit of time right?" in note for note in result.notes)

    def test_time_beyond_int64(self):
        raw, time = csv_usual()
        with pytest.raises(InputError, match="2262"):
            recording_from_raw(raw, parse_config(CONFIG), RawChannel("time", time.values + 1.7e18))

    def test_nan_in_time_drops_samples(self):
        raw, time = csv_usual()
        holes = time.values.copy()
        holes[[5, 77]] = np.nan
        result = recording_from_raw(raw, parse_config(CONFIG), RawChannel("time", holes))
        assert result.clocks[0].invalid == 2
        assert result.segments[0].samples == 4000

    @pytest.mark.parametrize(
        ("names", "found"),
        [
            (["i", "t", "q"], "t"),
            (["timestamp", "time"], "time"),
            (["q", "Time [ms]"], "Time [ms]"),
            (["q", "time_ns"], "time_ns"),
            (["header_stamp", "q"], "header_stamp"),
            (["torque", "position"], None),
            (["1", "2"], None),
        ],
    )
    def test_which_column_looks_like_time(self, names, found):
        assert find_time_column(names) == found

    @pytest.mark.parametrize(
        ("name", "declared", "unit"),
        [
            ("time", None, "s"),
            ("time", "ms", "ms"),
            ("time_ns", None, "ns"),
            ("t_us", None, "us"),
            ("t", None, "s"),
        ],
    )
    def test_unit_of_the_time_column(self, name, declared, unit):
        assert time_unit_of(RawChannel(name, np.zeros(1), {}, declared)) == unit


def test_notes_of_the_reader_are_handed_on():
    raw = log_of(*usual())
    raw = RawLog(raw.format, raw.paths, raw.channels, (Note("run.mcap: the last chunk is damaged"),))
    assert recording_from_raw(raw, parse_config(CONFIG)).notes == ("run.mcap: the last chunk is damaged",)


def test_current_without_a_constant_stays_a_current():
    text = CONFIG.replace("motor_torque: {source: i, unit: N.m}", "motor_current: {source: i, unit: mA}")
    text = text.replace("gear_ratio: 50", "gear_ratio: 50, torque_constant_nm_per_a: unknown")
    channels = usual()
    result = recording_from_raw(log_of(*channels), parse_config(text))
    assert result.torque_unit == "A"
    assert np.array_equal(result.segments[0].torque, channels[0].values * 1e-3)


REAL = {
    "odrive_slow_a": """
version: 1
axis: {name: od, gear_ratio: 1, torque_constant_nm_per_a: unknown}
signals:
  motor_current: {source: motor_current, unit: A}
  motor_position: {source: motor_position, unit: count, counts_per_rev: 8192}
""",
    "emps_tracking": """
version: 1
axis: {name: emps, gear_ratio: 1}
signals:
  motor_torque: {source: drive_voltage, unit: V, torque_per_volt: 35.15}
  motor_position: {source: motor_position, unit: m}
  reference_position: {source: reference_position, unit: m}
""",
    "kuka_kr300_a_axis2": """
version: 1
axis: {name: kuka, gear_ratio: 267.42857142857144}
signals:
  motor_torque: {source: motor_torque, unit: N.m}
  motor_position: {source: motor_position, unit: deg, side: joint}
  joint_position: {source: joint_position, unit: deg}
""",
}


class TestRealRecordings:
    def build(self, recordings: Path, name: str, text: str | None = None):
        return build_recording([recordings / "real" / f"{name}.csv.gz"], parse_config(text or REAL[name]))

    def test_irregular_stamps(self, recordings):
        result, raw = self.build(recordings, "odrive_slow_a")
        (segment,) = result.segments
        assert result.sample_rate_hz == pytest.approx(442.6, abs=0.1)
        assert result.clocks[0].jitter_s / result.clocks[0].period_s == pytest.approx(0.11, abs=0.01)
        counts = raw.channels["motor_position"].values
        assert np.ptp(segment.motor_position) == pytest.approx(np.ptp(counts) * 2 * np.pi / 8192, rel=1e-3)

    def test_nearly_uniform_stamps_are_kept(self, recordings):
        result, raw = self.build(recordings, "emps_tracking")
        (segment,) = result.segments
        assert result.sample_rate_hz == pytest.approx(1000.0, rel=1e-6)
        assert np.array_equal(segment.motor_position, raw.channels["motor_position"].values)
        assert result.notes == ()
        assert result.linear
        assert result.torque_unit == "N"

    def test_two_encoders(self, recordings):
        result, _ = self.build(recordings, "kuka_kr300_a_axis2")
        assert result.has_joint_position
        assert result.sample_rate_hz == 250.0
        assert result.notes == ()

    def test_wrong_side_is_found(self, recordings):
        wrong = REAL["kuka_kr300_a_axis2"].replace("unit: deg, side: joint", "unit: deg, side: motor")
        with pytest.raises(InputError, match="that is gear_ratio"):
            self.build(recordings, "kuka_kr300_a_axis2", wrong)

    def test_missing_channel(self, recordings):
        text = REAL["emps_tracking"].replace("source: reference_position", "source: refrence_position")
        with pytest.raises(InputError, match="refrence_position"):
            self.build(recordings, "emps_tracking", text)


def test_fallback_to_log_time_is_a_note():
    channels = usual()
    channels[2] = RawChannel("j", channels[2].values, {"log_time": channels[2].stamps["log_time"]})
    result = recording_from_raw(log_of(*channels), parse_config(CONFIG))
    assert {clock.clock for clock in result.clocks} == {"log_time"}
    assert any("joint_position has none" in note for note in result.notes)


def test_a_signal_that_ends_early_is_a_note():
    channels = usual()
    short = stamps_of(500, 3)
    channels[2] = stamped("j", short, motion(short / NS - 1000))
    result = recording_from_raw(log_of(*channels), parse_config(CONFIG))
    assert result.segments[0].samples == 1500
    assert any("joint_position has 2.998 s" in note for note in result.notes)


def test_signals_that_share_damage_share_the_note():
    channels = usual()
    stamps = channels[0].stamps["header_stamp"].copy()
    stamps[[10, 11]] = stamps[[11, 10]]
    broken = [RawChannel(c.source, c.values, {"header_stamp": stamps}) for c in channels]
    assert recording_from_raw(log_of(*broken), parse_config(CONFIG)).notes == (
        "motor_torque, motor_position, joint_position: 1 sample out of order, now sorted",
    )
