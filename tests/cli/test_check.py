"""``flexid check``: what it says about a configuration, and about a log that lacks something."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING

import pytest
from click.testing import CliRunner, Result

from flexid_cli.cli.main import main

if TYPE_CHECKING:
    from pathlib import Path

CONFIG = """\
version: 1
axis: {name: axis3, gear_ratio: 50, torque_constant_nm_per_a: 0.3475}
signals:
  time: {source: time, unit: s}
  motor_current: {source: current, unit: A}
  motor_position: {source: motor, unit: rad, side: motor}
"""


def check(*arguments: str | Path, text: str | None = None) -> Result:
    return CliRunner().invoke(main, ["check", *map(str, arguments)], input=text)


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "axis.yaml"
    path.write_text(CONFIG, encoding="utf-8")
    return path


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "run.csv"
    rows = [f"{i * 0.01:.2f},{math.sin(i / 5):.6f},{math.cos(i / 7):.6f}" for i in range(200)]
    path.write_text("time [s],current [mA],motor\n" + "\n".join(rows) + "\n", encoding="utf-8")
    return path


def test_ok_says_what_the_configuration_means(config: Path) -> None:
    result = check(config)
    assert result.exit_code == 0
    assert result.stderr == ""
    assert result.stdout.splitlines()[0] == f"ok: {config}"
    for words in (
        "axis3, rotary, gear ratio 50",
        "0.3475 N.m/A at the motor",
        "motor = ",
        "rad, motor side",
        "time in s",
    ):
        assert words.replace("motor = ", "motor_position = motor") in result.stdout


def test_json(config: Path) -> None:
    result = check(config, "--json", "--set", "axis.f1_hz=3.9")
    document = json.loads(result.stdout)
    assert document["ok"] is True
    assert document["config"]["axis"]["f1_hz"] == 3.9
    assert len(document["sha256"]) == 64


def test_standard_input() -> None:
    result = check("-", text=CONFIG)
    assert result.stdout.startswith("ok: <stdin>")
    result = check("-", text=CONFIG.replace("gear_ratio: 50", "gear_ratio: 0"))
    assert result.exit_code == 2
    assert "<stdin>:2:33: gear_ratio must be greater than 0" in result.stderr


def test_missing_file(tmp_path: Path) -> None:
    result = check(tmp_path / "none.yaml")
    assert result.exit_code == 2
    assert "error: there is no configuration file" in result.stderr
    assert result.stdout == ""


@pytest.mark.parametrize(
    "changes", [[], ["models=[rigid]"], ["signals.time=null"], ["controller.law=external"]]
)
def test_variants(config: Path, changes: list[str]) -> None:
    options = [word for change in changes for word in ("--set", change)]
    assert check(config, *options).exit_code == 0


def test_log_with_all_signals(config: Path, log: Path) -> None:
    result = check(config, log, "--set", "signals.motor_current.unit=mA")
    assert result.exit_code == 0
    assert f"every signal is in {log}" in result.stdout
    assert result.stderr == ""


def test_log_with_another_unit_is_a_warning(config: Path, log: Path) -> None:
    result = check(config, log)
    assert result.exit_code == 0
    assert "warning: motor_current: the log says mA, the configuration A" in result.stderr
    assert check(config, log, "-q").stderr == ""


def test_missing_channels_are_all_reported_in_the_configuration(config: Path, log: Path) -> None:
    config.write_text(
        CONFIG.replace("source: current", "source: curent").replace("source: motor", "source: motr")
    )
    result = check(config, log)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert "error: 2 mistakes in" in result.stderr
    assert f"{config}:5:27: " in result.stderr
    assert f"{config}:6:28: " in result.stderr
    assert "'current'" in result.stderr
    assert "'motor'" in result.stderr
    assert "Traceback" not in result.stderr


def test_a_clock_that_a_csv_does_not_have(config: Path, log: Path) -> None:
    result = check(config, log, "--set", "signals.time.source=log_time")
    assert result.exit_code == 2
    assert "no clock log_time" in result.stderr
    assert "--set signals.time.source=log_time" in result.stderr


def test_columns_by_number(config: Path, log: Path) -> None:
    numbers = ["time.source=1", "motor_current.source=2", "motor_position.source=3"]
    options = [word for number in numbers for word in ("--set", f"signals.{number}")]
    assert check(config, log, *options).exit_code == 0
    result = check(config, log, *options, "--set", "signals.motor_position.source=9")
    assert result.exit_code == 2
    assert "9" in result.stderr


def test_missing_log(config: Path, tmp_path: Path) -> None:
    result = check(config, tmp_path / "none.csv")
    assert result.exit_code == 2
    assert "none.csv" in result.stderr
    assert "Traceback" not in result.stderr
    assert "internal error" not in result.stderr
