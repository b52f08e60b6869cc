"""What goes in wrong: one message with its cure, the right exit code, and nothing half-written."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from click.testing import CliRunner, Result

from flexid_cli.cli.main import main

if TYPE_CHECKING:
    from conftest import Columns, WriteLog

USAGE, UNDECIDED = 2, 3
ALL = slice(None)


def identify(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, ["identify", *map(str, arguments)])


def listing(folder: Path) -> set[Path]:
    return set(folder.rglob("*"))


def refused(folder: Path, *arguments: str | Path, code: int = USAGE, hint: bool = True) -> str:
    """Run with outputs asked for; check that it is refused as it should, and return the message."""
    outputs = [] if "-o" in arguments else ["-o", folder / "report.json", "-o", folder / "report.md"]
    before = listing(folder)
    result = identify(*arguments, *outputs)
    assert result.exit_code == code, result.output
    assert result.stdout == ""
    assert len(re.findall("^error: ", result.stderr, flags=re.MULTILINE)) == 1
    assert len(re.findall("^  hint: ", result.stderr, flags=re.MULTILINE)) >= hint, result.stderr
    assert "Traceback" not in result.stderr
    assert "internal error" not in result.stderr
    assert "warning:" not in result.stderr
    assert listing(folder) == before
    return result.stderr


def undecided(folder: Path, *arguments: str | Path) -> Result:
    """Run on data from which nothing can be identified: a whole report, which says so, and exit code 3."""
    result = identify(*arguments, "-o", folder / "report.json")
    assert result.exit_code == UNDECIDED, result.output
    assert result.stderr.count("error: ") == 1
    assert "error: no parameter could be identified" in result.stderr
    assert "Traceback" not in result.stderr
    assert '"verdict": "identified"' not in (folder / "report.json").read_text(encoding="utf-8")
    assert result.stdout.startswith("Drive parameters of short")
    return result


# --- configurations, end to end; every rule has its own test in tests/unit/test_config_*.py ---


CONFIGURATIONS = {
    "unknown key": ("gear_ratio: 50", "gear_ration: 50", ":2:21: unknown key 'gear_ration'", "gear_ratio"),
    "gear of zero": ("gear_ratio: 50", "gear_ratio: 0", "gear_ratio must be greater than 0", "gear"),
    "unit of nothing": ("unit: A", "unit: Amp", ":5:47: unknown unit 'Amp'", "A, mA"),
    "unit of another quantity": ("source: joint, unit: rad", "source: joint, unit: A", "cannot be in A", "rad"),
    "no side": (", side: motor}\n  joint", "}\n  joint", "side", "motor"),
    "no motor position": ("  motor_position: ", "  # motor_position: ", "motor_position", "motor_position"),
    "constant missing": (", torque_constant_nm_per_a: 0.35", "", "torque_constant_nm_per_a", "`unknown`"),
    "constant in words": ("per_a: 0.35", "per_a: about 0.3", "'about 0.3'", "unknown"),
    "no torque": ("  motor_current: ", "  # motor_current: ", "motor_current", "joint_torque"),
    "key twice": ("version: 1", "version: 1\nversion: 1", "version", "version"),
    "no YAML": ("axis: {", "axis: {{", ":2:", "axis"),
}  # fmt: skip


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_wrong_configurations(name: str, tmp_path: Path, log: Path, config: Path) -> None:
    old, new, message, cure = CONFIGURATIONS[name]
    text = config.read_text(encoding="utf-8")
    assert old in text
    config.write_text(text.replace(old, new, 1), encoding="utf-8")
    said = refused(tmp_path, log, "-c", config, hint=False)  # the cure may be in the sentence itself
    assert said.startswith("error: 1 mistake in"), said
    assert message in said
    assert cure in said


def test_all_mistakes_of_a_configuration_are_one_error(tmp_path: Path, log: Path, config: Path) -> None:
    text = config.read_text(encoding="utf-8").replace("unit: A", "unit: Amp").replace("gear_ratio", "gear")
    config.write_text(text, encoding="utf-8")
    said = refused(tmp_path, log, "-c", config)
    assert said.count(f"{config}:") >= 2


def test_configuration_that_is_none(tmp_path: Path, log: Path) -> None:
    assert "there is no configuration file" in refused(tmp_path, log, "-c", tmp_path / "none.yaml")
    assert "is a folder" in refused(tmp_path, log, "-c", tmp_path)
    assert "or the log itself?" in refused(tmp_path, log, "-c", log)


OVERRIDES = {
    "foo": "is not KEY=VALUE",
    "axis.gear=3": "unknown key 'gear'",
    "axis.gear_ratio=[1": "gear_ratio",
    "estimate.confidence_level=95": "write 0.95 for 95 %",
    "signals.joint_position=null": "two_encoders needs joint_position",
    "estimate.route=quick": "direct, paper",
}


@pytest.mark.parametrize("override", OVERRIDES)
def test_wrong_overrides(override: str, tmp_path: Path, log: Path, config: Path) -> None:
    options = ["--set", "models=[two_encoders]", "--set", override]
    said = refused(tmp_path, log, "-c", config, *options, hint=False)
    assert OVERRIDES[override] in said
    assert "--set" in said


# --- files ---


def test_files_that_cannot_be_read(tmp_path: Path, config: Path) -> None:
    empty, folder, noise = tmp_path / "empty.csv", tmp_path / "folder", tmp_path / "run.mcap"
    empty.touch()
    folder.mkdir()
    noise.write_bytes(bytes(range(256)) * 9)
    assert "there is no file" in refused(tmp_path, tmp_path / "none.csv", "-c", config)
    assert f"{empty} is empty" in refused(tmp_path, empty, "-c", config)
    assert "without a rosbag2 recording" in refused(tmp_path, folder, "-c", config)
    assert "is of no known format" in refused(tmp_path, noise, "-c", config)
    assert "is of no known format" in refused(tmp_path, config, "-c", config)


@pytest.mark.skipif(not Path("/proc/self/mem").exists(), reason="needs /proc")
def test_a_file_that_the_system_does_not_hand_out(tmp_path: Path, config: Path) -> None:
    assert "/proc/self/mem" in refused(tmp_path, "/proc/self/mem", "-c", config)


@pytest.mark.parametrize("name", ["axis3.mcap", "axis3.bag"])
def test_damaged_containers(name: str, root: Path, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes((root / "sample_logs" / name).read_bytes()[:3000])
    said = refused(tmp_path, path, "-c", root / "configs" / "axis3.yaml")
    assert f"{path} is damaged" in said


def test_several_files_that_are_no_run(tmp_path: Path, log: Path, config: Path, root: Path) -> None:
    mcap = root / "sample_logs" / "axis3.mcap"
    result = identify(log, log, "-c", config)
    assert (result.exit_code, result.stdout) == (2, "")
    assert f"{log} is given twice" in result.stderr
    assert "different formats" in refused(tmp_path, log, mcap, "-c", config)


def test_tables_that_are_none(tmp_path: Path, config: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text("time,current,motor,joint,reference\n", encoding="utf-8")
    assert "has no rows of numbers" in refused(tmp_path, path, "-c", config)
    rows = "".join(f"{k / 200},{k % 7},{k % 5},word,0\n" for k in range(100))
    path.write_text("time,current,motor,joint,reference\n" + rows, encoding="utf-8")
    said = refused(tmp_path, path, "-c", config)
    assert f"{path}:2: column 'joint' has the text 'word'" in said


# --- channels ---


def test_channels_that_are_missing(tmp_path: Path, log: Path, config: Path, root: Path) -> None:
    said = refused(tmp_path, log, "-c", config, "--set", "signals.motor_current.source=curent")
    assert "there is no channel 'curent'" in said
    assert "did you mean 'current'?" in said
    said = refused(tmp_path, log, "-c", config, "--set", "signals.motor_position.source=9")
    assert "there is no column 9, for it has 5 columns" in said
    said = refused(tmp_path, log, "-c", config, "--set", "signals.time.source=clock")
    assert "there is no channel 'clock'" in said
    axis3 = root / "configs" / "axis3.yaml"
    source = "signals.joint_position.source=/joint_states/joint/positon"
    said = refused(tmp_path, root / "sample_logs" / "axis3.mcap", "-c", axis3, "--set", source)
    assert "/joint_states/joint/position'" in said


def test_a_record_without_a_time(tmp_path: Path, columns: Columns, write_log: WriteLog, config: Path) -> None:
    columns["index"] = columns.pop("time")
    log = write_log(columns)
    said = refused(tmp_path, log, "-c", config, "--set", "signals.time=null")
    assert "looks like time" in said
    assert "rate_hz" in said
    result = identify(log, "-c", config, "--set", "signals.time={rate_hz: 200}")
    assert result.exit_code == 0, result.output


# --- numbers ---


def constant(name: str, value: float) -> Callable[[Columns], None]:
    def change(columns: Columns) -> None:
        columns[name][:] = value

    return change


def cut(rows: int) -> Callable[[Columns], None]:
    def change(columns: Columns) -> None:
        for name in columns:
            columns[name] = columns[name][:rows]

    return change


NUMBERS = {
    "one sample": (cut(1), USAGE, "has only one sample", "record again"),
    "two samples": (cut(2), UNDECIDED, "only 2", "record longer"),
    "thirty samples": (cut(30), UNDECIDED, "the longest has 29", "record longer"),
    "a fifth of a second": (cut(40), UNDECIDED, "too short", "record longer"),
    "torque constant": (constant("current", 0.3), UNDECIDED, "'current' never changes", "while the axis moves"),
    "torque zero": (constant("current", 0.0), UNDECIDED, "'current' never changes", "motor_current.source"),
    "motor at rest": (constant("motor", 1.0), UNDECIDED, "'motor' never changes", "motor_position.source"),
    "joint at rest": (constant("joint", 1.0), UNDECIDED, "'joint' never changes", "joint_position.source"),
    "torque without numbers": (constant("current", np.nan), USAGE, "no number among its 4000", "record again"),
    "motor without numbers": (constant("motor", np.nan), USAGE, "no number among its 4000", "record again"),
    "motor of infinities": (constant("motor", np.inf), USAGE, "no number among its 4000", "record again"),
    "reference without numbers": (constant("reference", np.nan), USAGE, "no number", "reference_position.source"),
    "stamps all equal": (constant("time", 5.0), USAGE, "have the same stamp", "rate_hz"),
    "stamps without numbers": (constant("time", np.nan), USAGE, "none of its 4000", "signals.time.source"),
}  # fmt: skip


@pytest.mark.parametrize("name", NUMBERS)
def test_numbers_that_hold_nothing(
    name: str, tmp_path: Path, columns: Columns, write_log: WriteLog, config: Path
) -> None:
    change, code, message, cure = NUMBERS[name]
    change(columns)
    said = refused(tmp_path, write_log(columns), "-c", config, code=code)
    assert message in said
    assert cure in said


CONTRADICTIONS = {
    "joint in degrees": (("joint_position.unit=deg",), "one over the factor deg per rad", "units wrong?"),
    "motor in degrees": (("motor_position.unit=deg",), "the factor deg per rad", "units wrong?"),
    "motor at the joint side": (("motor_position.side=joint",), "1/gear_ratio (1/50)", "`side` or gear_ratio"),
    "joint at the motor side": (("joint_position.side=motor",), "1/gear_ratio (1/50)", "`side` or gear_ratio"),
    "joint against the motor": (("joint_position.sign=-1",), "directions differ", "sign: -1"),
    "motor against the joint": (("motor_position.sign=-1",), "directions differ", "sign: -1"),
    "side and sign": (("joint_position.sign=-1", "joint_position.side=motor"), "1/gear_ratio", "sign: -1"),
}  # fmt: skip


@pytest.mark.parametrize("name", CONTRADICTIONS)
def test_encoders_that_contradict_each_other(name: str, tmp_path: Path, log: Path, config: Path) -> None:
    changes, message, cure = CONTRADICTIONS[name]
    options = [word for change in changes for word in ("--set", f"signals.{change}")]
    said = refused(tmp_path, log, "-c", config, *options)
    assert message in said
    assert cure in said


def test_gaps_of_nan_are_a_report_that_counts_them(
    tmp_path: Path, columns: Columns, write_log: WriteLog, config: Path
) -> None:
    columns["motor"][1000:1060] = np.nan  # a gap
    columns["current"][2000:2002] = np.nan  # bridged
    columns["joint"][[3000, 3500]] = [np.inf, -np.inf]
    result = identify(write_log(columns), "-c", config, "-o", tmp_path / "r.md")
    assert result.exit_code == 0, result.output
    text = (tmp_path / "r.md").read_text(encoding="utf-8")
    clocks = {row.split(" | ")[0]: row.split(" | ") for row in text.splitlines() if row.startswith("| ")}
    title = clocks["| Signal"]
    counts = {
        role: {key: clocks[f"| {role}"][title.index(key)] for key in ("Gaps", "Bridged", "Invalid |")}
        for role in ("motor_position", "motor_current", "joint_position")
    }
    assert counts["motor_position"] == {"Gaps": "1", "Bridged": "0", "Invalid |": "60 |"}
    assert counts["motor_current"] == {"Gaps": "0", "Bridged": "2", "Invalid |": "2 |"}
    assert counts["joint_position"] == {"Gaps": "0", "Bridged": "2", "Invalid |": "2 |"}
    assert "Warning: " in result.stdout


def test_a_torque_against_the_motion_is_never_identified(tmp_path: Path, log: Path, config: Path) -> None:
    result = undecided(tmp_path, log, "-c", config, "--set", "signals.motor_current.sign=-1")
    assert "physics forbids" in result.stdout


def test_noise_is_never_identified(
    tmp_path: Path, columns: Columns, write_log: WriteLog, config: Path
) -> None:
    random = np.random.default_rng(5)
    for name, size in (("current", 0.01), ("motor", 1e-5), ("joint", 1e-6), ("reference", 0.0)):
        columns[name] = size * random.normal(size=columns["time"].size)
    undecided(tmp_path, write_log(columns), "-c", config)


def test_a_motor_that_shows_no_resonance(tmp_path: Path, log: Path, config: Path) -> None:
    """The chirp's first 3 s end below the resonance, which an encoder at the motor alone does not show then."""
    rows = log.read_text(encoding="utf-8").splitlines()
    log.write_text("\n".join(rows[:600]) + "\n", encoding="utf-8")
    said = refused(
        tmp_path, log, "-c", config, "--set", "models=[motor_only]", "--set", "signals.joint_position=null",
        code=UNDECIDED,
    )  # fmt: skip
    assert "no model can be solved" in said
    assert "resonance" in said


# --- the command line and its outputs ---


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run.csv"], "'--config'"),
        (["-c", "axis.yaml"], "LOG"),
        (["run.csv", "-c", "axis.yaml", "--route", "short"], "'direct', 'paper'"),
        (["run.csv", "-c", "axis.yaml", "--metod", "x"], "--metod"),
    ],
)
def test_usage(arguments: list[str], words: str) -> None:
    result = identify(*arguments)
    assert result.exit_code == USAGE
    assert result.stdout == ""
    assert words in result.stderr
    assert "Try 'flexid identify --help'" in result.stderr


def test_outputs_that_cannot_be_written_are_refused_at_once(tmp_path: Path, log: Path, config: Path) -> None:
    json = tmp_path / "axis.json"
    json.write_text(config.read_text(encoding="utf-8"), encoding="utf-8")
    for output, words in [
        (tmp_path / "report.xyz", "supported: .json, .md"),
        (tmp_path / "report", "its name has no suffix"),
        (tmp_path / "none" / "report.json", "there is no folder"),
        (json, "exists already"),
    ]:
        assert words in refused(tmp_path, log, "-c", config, "-o", output)
    assert "is an input" in refused(tmp_path, log, "-c", json, "-o", json, "--force")
    twice = ["-o", tmp_path / "a.json", "-o", tmp_path / "." / "a.json"]
    assert "twice" in refused(tmp_path, log, "-c", config, *twice)


@pytest.mark.skipif(not Path("/proc/version").exists(), reason="needs a folder in which nobody can write")
def test_a_folder_that_refuses_files_leaves_nothing_behind(tmp_path: Path, log: Path, config: Path) -> None:
    outputs = ["-o", tmp_path / "report.json", "-o", "/proc/report.json"]
    said = refused(tmp_path, log, "-c", config, *outputs)
    assert "cannot write /proc" in said


def test_a_figure_that_exists_keeps_the_whole_report_away(tmp_path: Path, log: Path, config: Path) -> None:
    (tmp_path / "report_two_encoders_torque.svg").write_text("mine", encoding="utf-8")
    said = refused(tmp_path, log, "-c", config)
    assert "report_two_encoders_torque.svg exists already" in said
    assert (tmp_path / "report_two_encoders_torque.svg").read_text(encoding="utf-8") == "mine"
