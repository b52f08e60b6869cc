"""Rows that a damaged table has lost become gaps; what follows them keeps its time, or is refused."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from flexid_cli.config.load import parse_config
from flexid_cli.errors import InputError
from flexid_cli.readers.base import LostRows, RawLog, ReadOptions
from flexid_cli.readers.registry import read_log
from flexid_cli.signals.build import build_recording
from flexid_cli.signals.inspect import inspect_log
from flexid_cli.signals.recording import Recording

RATE = 200.0
ROWS = 2400
TIME = np.arange(ROWS) / RATE
MOTOR = 30 * np.sin(2 * np.pi * 0.7 * TIME) + 9 * np.sin(2 * np.pi * 4.1 * TIME + 1.0)
CONFIG = """
version: 1
axis: {name: a, gear_ratio: 1}
signals:
  motor_torque: {source: i, unit: N.m, hold: instant}
  motor_position: {source: m, unit: rad, side: motor}
"""
FIXED = f"{CONFIG}  time: {{rate_hz: {RATE:g}}}\n"
HEAD = "time,i,m\n"
Change = Callable[[list[str]], None]


def lines() -> list[str]:
    effort = 3 + np.cos(2 * np.pi * 0.7 * TIME) + 0.2 * np.sin(2 * np.pi * 9.0 * TIME)
    return [f"{t:.3f},{i:.9f},{m:.9f}" for t, i, m in zip(TIME, effort, MOTOR, strict=True)]


def save(folder: Path, change: Change, name: str = "run.csv") -> Path:
    rows = lines()
    change(rows)
    (folder / name).write_text(HEAD + "\n".join(rows) + "\n", encoding="utf-8")
    return folder / name


def text_for_a_number(rows: list[str]) -> None:
    rows[1000] = rows[1000].replace(",", ",x", 1)


def cut_line(rows: list[str]) -> None:
    rows[1000] = rows[1000][:9]


def two_in_one(rows: list[str]) -> None:
    rows[1000] += "J" + rows.pop(1001)


def commented_out(rows: list[str]) -> None:
    assert rows[1000][0] == "5"
    rows[1000] = "%" + rows[1000][1:]


def read(path: Path, **options: object) -> RawLog:
    return read_log([path], ["time", "i", "m"], options=ReadOptions(**options))  # type: ignore[arg-type]


def assert_every_sample_has_its_time(recording: Recording) -> None:
    for segment in recording.segments:
        rows = round(segment.start_s * RATE) + np.arange(segment.samples)
        assert np.allclose(segment.motor_position, MOTOR[rows], atol=1e-8, rtol=0)


@pytest.mark.parametrize(
    ("change", "lost", "known"),
    [(text_for_a_number, 1, 1), (cut_line, 1, None), (two_in_one, 2, None), (commented_out, 1, None)],
)
def test_a_lost_row_is_a_gap(change: Change, lost: int, known: int | None, tmp_path: Path) -> None:
    path = save(tmp_path, change)
    raw = read(path)
    assert raw.lost_rows == (LostRows(path, 1000, known),)
    assert raw.channels["m"].values.size == ROWS - lost
    recording, raw = build_recording([path], parse_config(CONFIG))
    assert raw.damage[0].spans_s == (pytest.approx((999 / RATE, (1000 + lost) / RATE)),)
    assert [segment.samples for segment in recording.segments] == [1000, ROWS - 1000 - lost]
    assert (recording.clocks[0].gaps, recording.clocks[0].bridged) == (1, 0)
    assert_every_sample_has_its_time(recording)
    with pytest.raises(InputError):
        read(path, strict=True)


def test_inspect_shows_the_gap_and_its_time(tmp_path: Path) -> None:
    path = save(tmp_path, text_for_a_number)
    found = inspect_log([path])
    assert all(channel.clock is not None and channel.clock.gaps == 1 for channel in found.channels)
    assert found.damage[0].spans_s == (pytest.approx((4.995, 5.005)),)


def test_a_fixed_rate_keeps_the_time_where_the_number_is_known(tmp_path: Path) -> None:
    def change(rows: list[str]) -> None:
        for row in (300, 301, 1000):
            rows[row] = rows[row].replace(",", ",x", 1)

    recording, raw = build_recording([save(tmp_path, change)], parse_config(FIXED))
    assert raw.damage[0].lost == 3
    assert [round(segment.start_s * RATE) for segment in recording.segments] == [0, 302, 1001]
    assert_every_sample_has_its_time(recording)


@pytest.mark.parametrize("change", [cut_line, two_in_one, commented_out])
def test_a_fixed_rate_is_refused_where_it_is_not(change: Change, tmp_path: Path) -> None:
    path = save(tmp_path, change)
    with pytest.raises(InputError, match="fixed rate_hz") as caught:
        build_recording([path], parse_config(FIXED))
    assert ":1002:" in caught.value.message or "1002" in caught.value.message
    assert caught.value.message.count(str(path)) == 1
    recording, _ = build_recording([path], parse_config(FIXED), ReadOptions(end_s=4.5))
    assert recording.samples == 900
    with pytest.raises(InputError, match="fixed rate_hz"):
        build_recording([path], parse_config(FIXED), ReadOptions(end_s=5.5))


@pytest.mark.parametrize("config", [CONFIG, FIXED])
def test_a_dropped_last_line_moves_nothing(config: str, tmp_path: Path) -> None:
    path = save(tmp_path, lambda _: None)
    path.write_bytes(path.read_bytes()[:-5])
    recording, raw = build_recording([path], parse_config(config))
    assert raw.damage[0].lost == 1
    assert raw.damage[0].spans_s == ()
    assert [segment.samples for segment in recording.segments] == [ROWS - 1]
    assert_every_sample_has_its_time(recording)


def test_a_last_line_dropped_before_another_file_does(tmp_path: Path) -> None:
    parts = []
    for number, part in enumerate((slice(0, 1000), slice(1000, None))):
        path = tmp_path / f"{number}.csv"
        path.write_text(HEAD + "\n".join(lines()[part]) + "\n", encoding="utf-8")
        parts.append(path)
    build_recording(parts, parse_config(FIXED))
    parts[0].write_bytes(parts[0].read_bytes()[:-5])
    recording, raw = build_recording(parts, parse_config(CONFIG))
    assert [segment.samples for segment in recording.segments] == [999, 1400]
    assert raw.damage[0].spans_s == (pytest.approx((998 / RATE, 1000 / RATE)),)
    assert raw.damage[1].spans_s == ()
    with pytest.raises(InputError, match="fixed rate_hz"):
        build_recording(parts, parse_config(FIXED))


def packed_in_four(folder: Path, broken: int) -> Path:
    """Members of 600 rows, one with a hole in its packed bytes."""
    rows, content = lines(), b""
    for number in range(4):
        text = "\n".join(rows[600 * number : 600 * (number + 1)]) + "\n"
        member = bytearray(gzip.compress((HEAD * (number == 0) + text).encode()))
        if number == broken:
            member[2000:2040] = bytes(40)
        content += bytes(member)
    (folder / "run.csv.gz").write_bytes(content)
    return folder / "run.csv.gz"


def test_damage_inside_a_packed_table_is_a_gap(tmp_path: Path) -> None:
    path = packed_in_four(tmp_path, 2)
    recording, raw = build_recording([path], parse_config(CONFIG))
    assert raw.damage[0].lost is None
    (span,) = raw.damage[0].spans_s
    assert span[0] <= 1199 / RATE + 1e-9
    assert span[1] >= 1800 / RATE - 1e-9
    assert all(
        not segment.start_s < 1300 / RATE < segment.start_s + segment.samples / RATE
        for segment in recording.segments
    )
    assert_every_sample_has_its_time(recording)
    with pytest.raises(InputError, match="fixed rate_hz"):
        build_recording([path], parse_config(FIXED))


def test_a_window_takes_its_own_gaps_along(tmp_path: Path) -> None:
    path = save(tmp_path, text_for_a_number)
    recording, raw = build_recording([path], parse_config(CONFIG), ReadOptions(start_s=4.0, end_s=6.0))
    assert [segment.samples for segment in recording.segments] == [200, 199]
    assert raw.damage[0].spans_s == (pytest.approx((4.995, 5.005)),)
    recording, raw = build_recording([path], parse_config(CONFIG), ReadOptions(start_s=6.0))
    assert len(recording.segments) == 1
    assert raw.damage[0].spans_s == ()


def wrong_exponent(rows: list[str]) -> None:
    time, effort, motor = rows[1000].split(",")
    rows[1000] = f"{time},{effort.replace('.', '')},{motor}"  # a lost point


def test_a_sample_that_cannot_be_is_left_out(tmp_path: Path) -> None:
    path = save(tmp_path, wrong_exponent)
    raw = read(path)
    assert raw.lost_rows == (LostRows(path, 1000, 1),)
    assert (raw.damage[0].trusted, raw.damage[0].suspect, raw.damage[0].lost) == (ROWS - 1, 1, 0)
    assert "1 sample of 'i' jumps farther" in raw.damage[0].reasons[0]
    assert "sample 1001" in raw.damage[0].reasons[0]
    for config in (CONFIG, FIXED):
        recording, raw = build_recording([path], parse_config(config))
        assert raw.damage[0].spans_s == (pytest.approx((4.995, 5.005)),)
        assert [segment.samples for segment in recording.segments] == [1000, ROWS - 1001]
        assert_every_sample_has_its_time(recording)
    with pytest.raises(InputError, match="jumps"):
        read(path, strict=True)


def test_a_sample_that_cannot_be_may_be_kept(tmp_path: Path) -> None:
    path = save(tmp_path, wrong_exponent)
    raw = read(path, keep_suspect=True)
    assert raw.channels["i"].suspect is not None
    assert np.flatnonzero(raw.channels["i"].suspect).tolist() == [1000]
    recording, raw = build_recording([path], parse_config(CONFIG), ReadOptions(keep_suspect=True))
    assert len(recording.segments) == 1
    assert raw.damage[0].spans_s == (pytest.approx((4.995, 5.005)),)


def test_a_checksum_is_believed_rather(tmp_path: Path) -> None:
    """What was recorded so is no damage."""
    path = save(tmp_path, wrong_exponent)
    packed = tmp_path / "packed.csv.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    raw = read(packed, strict=True)
    assert raw.channels["i"].values.size == ROWS
    assert raw.damage[0].is_harmless


def test_a_wrong_time_is_left_out(tmp_path: Path) -> None:
    def change(rows: list[str]) -> None:
        rows[1000] = "9" + rows[1000]

    recording, raw = build_recording([save(tmp_path, change)], parse_config(CONFIG))
    assert raw.damage[0].suspect == 1
    assert_every_sample_has_its_time(recording)


def test_comments_that_are_none_of_the_rows_are_no_damage(tmp_path: Path) -> None:
    def change(rows: list[str]) -> None:
        rows[1000:1000] = ["# trial 2, warm", "#3", "% 1.5, 2.5", "#"]

    raw = read(save(tmp_path, change), strict=True)
    assert raw.lost_rows == ()
    assert raw.channels["m"].values.size == ROWS
