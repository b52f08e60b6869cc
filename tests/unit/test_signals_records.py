"""Which files are pieces of one run, and which are records of their own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from flexid_cli.config.load import parse_config
from flexid_cli.config.schema import Config
from flexid_cli.errors import DataError, InputError
from flexid_cli.readers.base import ReadOptions
from flexid_cli.signals.records import Records, pooled, read_records
from flexid_cli.writers.csv import write_csv
from flexid_cli.writers.mcap import write_mcap
from flexid_cli.writers.table import LogTable

RATE = 100
SAMPLES = 400
SIGNALS = ("/axis/u", "/axis/qm", "/axis/q")
TEXT = """
version: 1
axis: {name: axis, gear_ratio: 1}
signals:
  joint_torque: {source: /axis/u, unit: N.m}
  motor_position: {source: /axis/qm, unit: rad}
  joint_position: {source: /axis/q, unit: rad}
"""
CONFIG = parse_config(TEXT)


def write(path: Path, start_s: float, *, samples: int = SAMPLES, signals: Sequence[str] = SIGNALS) -> Path:
    number = round(start_s * RATE) + np.arange(samples)
    channels = {name: np.sin(0.01 * (k + 1) * number) for k, name in enumerate(SIGNALS) if name in signals}
    table = LogTable(10**18 + number * (10**9 // RATE), channels)
    (write_csv if ".csv" in path.name else write_mcap)(path, table)
    return path


def read(paths: Sequence[Path], mode: str = "auto", config: Config = CONFIG, **options: float) -> Records:
    return read_records(paths, config, ReadOptions(**options), mode)  # type: ignore[arg-type]


def names(found: Records) -> list[list[str]]:
    return [[path.name for path in record.paths] for record in found.records]


@pytest.mark.parametrize("suffix", ["mcap", "csv"])
@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (0, 2, 1)])
def test_a_split_run_is_one_run(suffix: str, order: tuple[int, ...], tmp_path: Path) -> None:
    parts = [write(tmp_path / f"run_{k}.{suffix}", 4.0 * k) for k in range(3)]
    found = read([parts[k] for k in order])
    assert names(found) == [[path.name for path in parts]]
    assert found.records[0].recording.samples == 3 * SAMPLES
    assert "3 files taken as one run, for their stamps continue each other" in found.decision
    assert "--records each" in found.decision
    assert not found.doubt


@pytest.mark.parametrize("starts", [(0.0, 0.0, 0.0), (0.0, 1.0, 2.0), (0.0, 50.0, 300.0), (50.0, 0.0, 300.0)])
def test_records_that_overlap_or_lie_apart_are_records(starts: tuple[float, ...], tmp_path: Path) -> None:
    files = [write(tmp_path / f"{name}.mcap", start) for name, start in zip("abc", starts, strict=True)]
    found = read(files)
    assert names(found) == [["a.mcap"], ["b.mcap"], ["c.mcap"]]
    assert found.decision == (
        "3 records of one axis, fitted together: a, b, c (--records one: files of one run)"
    )
    assert [record.name for record in found.records] == ["a", "b", "c"]


def test_a_record_may_be_split_itself(tmp_path: Path) -> None:
    files = [write(tmp_path / f"{n}.mcap", s) for n, s in (("a_0", 0.0), ("a_1", 4.0), ("b", 100.0))]
    found = read(files)
    assert names(found) == [["a_0.mcap", "a_1.mcap"], ["b.mcap"]]
    assert "a_0 (a_0.mcap, a_1.mcap), b" in found.decision


def test_a_piece_never_joins_two_files_of_the_same_time(tmp_path: Path) -> None:
    """Both a and c end where b begins: b goes on with its neighbour."""
    files = [write(tmp_path / f"{n}.mcap", s) for n, s in (("c", 0.0), ("a", 0.0), ("b", 4.0))]
    assert names(read(files)) == [["c.mcap"], ["a.mcap", "b.mcap"]]


def test_the_longest_gap_of_a_run_is_configured(tmp_path: Path) -> None:
    files = [write(tmp_path / "a.mcap", 0.0), write(tmp_path / "b.mcap", 6.0)]
    assert len(read(files).records) == 2
    patient = parse_config(TEXT + "  time: {max_gap_s: 3}\n")
    assert len(read(files, config=patient).records) == 1


def test_signals_in_several_files_are_one_run(tmp_path: Path) -> None:
    files = [
        write(tmp_path / "motor.mcap", 0.0, signals=SIGNALS[:2]),
        write(tmp_path / "joint.mcap", 0.0, signals=SIGNALS[2:]),
    ]
    found = read(files)
    assert names(found) == [["motor.mcap", "joint.mcap"]]
    assert "motor.mcap, joint.mcap alone are no complete record" in found.decision


def test_a_file_that_lacks_a_signal_beside_complete_ones_is_told(tmp_path: Path) -> None:
    files = [
        write(tmp_path / "a.mcap", 0.0),
        write(tmp_path / "b.mcap", 100.0),
        write(tmp_path / "odd.mcap", 200.0, signals=SIGNALS[:2]),
    ]
    found = read(files)
    assert names(found) == [["a.mcap"], ["b.mcap", "odd.mcap"]]
    assert "odd.mcap was taken for a further file of the run of b.mcap: " in found.doubt
    assert "/axis/q" in found.doubt
    with pytest.raises(InputError, match=r"odd\.mcap"):
        read(files, "each")


def test_the_decision_can_be_forced(tmp_path: Path) -> None:
    parts = [write(tmp_path / f"run_{k}.mcap", 4.0 * k) for k in range(2)]
    assert names(read(parts, "each")) == [["run_0.mcap"], ["run_1.mcap"]]
    apart = [parts[0], write(tmp_path / "late.mcap", 100.0)]
    one = read(apart, "one")
    assert names(one) == [["run_0.mcap", "late.mcap"]]
    assert len(one.records[0].recording.segments) == 2
    assert one.decision == ""


def test_one_file_needs_no_decision(tmp_path: Path) -> None:
    found = read([write(tmp_path / "a.mcap", 0.0)])
    assert (found.decision, found.doubt, found.left_out) == ("", "", ())


def test_a_record_that_is_too_short_is_left_out(tmp_path: Path) -> None:
    files = [write(tmp_path / "a.mcap", 0.0), write(tmp_path / "b.mcap", 50.0)]
    short = write(tmp_path / "short.mcap", 100.0, samples=20)
    found = read([*files, short])
    assert names(found) == [["a.mcap"], ["b.mcap"]]
    assert [name for name, _ in found.left_out] == ["short"]
    with pytest.raises(DataError, match="no record can be used; short: "):
        read([short, write(tmp_path / "shorter.mcap", 200.0, samples=10)])


def test_the_window_counts_from_the_start_of_each_record(tmp_path: Path) -> None:
    files = [write(tmp_path / "a.mcap", 0.0), write(tmp_path / "b.mcap", 50.0)]
    found = read(files, start_s=1.0, end_s=3.0)
    assert [record.recording.samples for record in found.records] == [200, 200]
    parts = [write(tmp_path / f"run_{k}.mcap", 4.0 * k) for k in range(2)]
    assert read(parts, start_s=1.0).records[0].recording.samples == 2 * SAMPLES - 100


def test_records_of_different_formats_and_equal_names(tmp_path: Path) -> None:
    folders = [tmp_path / "monday", tmp_path / "tuesday"]
    for folder in folders:
        folder.mkdir()
    files = [write(folders[0] / "run.mcap", 0.0), write(folders[1] / "run.mcap", 100.0)]
    found = read([*files, write(tmp_path / "late.csv", 200.0)])
    assert [record.name for record in found.records] == [str(files[0]), str(files[1]), "late"]
    assert [record.raw.format for record in found.records] == ["mcap", "mcap", "csv"]


def test_a_file_given_twice_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", 0.0)
    with pytest.raises(InputError, match="given twice"):
        read([path, path])


def test_without_stamps_nothing_tells_files_apart(tmp_path: Path) -> None:
    files = [write(tmp_path / f"{name}.csv", 0.0) for name in "ab"]
    config = parse_config(TEXT + "  time: {rate_hz: 100}\n")
    found = read(files, config=config)
    assert "they have no stamps to tell them apart by" in found.decision
    assert found.records[0].recording.samples == 2 * SAMPLES
    assert len(read(files, "each", config).records) == 2


def test_the_account_of_several_records(tmp_path: Path) -> None:
    files = [write(tmp_path / "a.mcap", 0.0), write(tmp_path / "b.mcap", 50.0)]
    found = read(files)
    together = pooled(found.records)
    assert together.samples == 2 * SAMPLES
    assert together.duration_s == pytest.approx(2 * (SAMPLES - 1) / RATE)
    assert {clock.signal for clock in together.clocks} >= {"motor_position (a)", "motor_position (b)"}
    assert all(step.startswith(("a: ", "b: ")) for step in together.history)
