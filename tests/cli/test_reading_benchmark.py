"""The reading benchmark measures, compares what was read with what was written, and judges by its limits."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "benchmarks"))

import reading  # noqa: E402 - a program beside the package


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    vector = [sys.executable, "benchmarks/reading.py", "--messages", "600", "--rounds", "1", "--fast-only"]
    return subprocess.run([*vector, *arguments], cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(("looser", "exit_code"), [("1000", 0), ("0", 1)])
def test_exit_code_follows_the_limits(looser: str, exit_code: int, tmp_path: Path) -> None:
    done = run("mcap_none", "--logs", str(tmp_path), "--looser", looser)
    assert (done.returncode, done.stderr) == (exit_code, "")
    assert "mcap_none       flexid 1" in done.stdout
    assert ("FAILED mcap_none: flexid 1 / limit" in done.stdout) == bool(exit_code)


def test_a_wrong_log_is_noticed(tmp_path: Path) -> None:
    assert run("mcap_none", "--logs", str(tmp_path)).returncode in {0, 1}
    (path,) = tmp_path.glob("mcap_none_600/*.mcap")
    (other,) = tmp_path.glob("mcap_none_300/*.mcap")
    path.write_bytes(other.read_bytes())
    done = run("mcap_none", "--logs", str(tmp_path))
    assert done.returncode == 2
    assert "read something else" in done.stderr


def table(**seconds: float) -> reading.Table:
    return {
        ("mcap_zstd", name.replace("_", " ")): [reading.Measured(value, 200.0, 100.0)]
        for name, value in seconds.items()
    }


def test_limits() -> None:
    good = table(limit=1.0, flexid_1=1.29, flexid=0.99, mcap=60.0, rosbags=40.0)
    assert not list(reading.failures(good, 1_000_000, 1.0))
    bad = table(limit=1.0, flexid_1=1.31, flexid=1.01, mcap=49.0, rosbags=29.0)
    assert len(list(reading.failures(bad, 1_000_000, 1.0))) == 4
    assert not list(reading.failures(bad, 1_000_000, 1.5))
    fat = {("sqlite3", "flexid"): [reading.Measured(1.0, 300.0, 140.0)]}
    assert "160 MB beside its arrays" in next(iter(reading.failures(fat, 1_000_000, 1.0)))
    slow = {("mcap_unchunked", "flexid"): [reading.Measured(0.7, 100.0, 10.0)]}
    assert "0.7 s for a million" in next(iter(reading.failures(slow, 1_000_000, 1.0)))


def test_a_limit_is_missed_by_what_is_slow_by_itself() -> None:
    other = [reading.Measured(1.0, 200.0, 100.0)] * 5
    for times, missed in (([0.9, 3.0, 3.5, 2.8, 1.0], False), ([1.4, 3.0, 3.5, 2.8, 1.5], True)):
        runs = [reading.Measured(one, 200.0, 100.0) for one in times]
        found = list(reading.failures({("csv", "flexid"): runs, ("csv", "pandas"): other}, 100_000, 1.0))
        assert [line for line in found if "pandas is" in line] == (
            ["csv: flexid / pandas is 1.34, above 1.2"] if missed else []
        )
