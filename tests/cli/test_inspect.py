"""``flexid inspect``: the table, the document, and the proposed configuration."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from flexid_cli.cli.main import main
from flexid_cli.config.load import parse_config
from flexid_cli.errors import ConfigError
from flexid_cli.readers.base import ChannelInfo
from flexid_cli.signals.build import build_recording
from flexid_cli.signals.inspect import ChannelSummary, Inspection, inspect_log
from flexid_cli.signals.propose import PLACEHOLDER, guess_roles, propose_config


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["inspect", *map(str, arguments)])


@pytest.fixture
def log(tmp_path: Path) -> Path:
    time = np.arange(600) / 250.0
    table = np.column_stack(
        [time, np.cos(time), 50 * np.sin(time), np.sin(time), 50 * np.sin(time) + 1e-3, -123456.789 + time]
    )
    table = np.delete(table, slice(300, 320), axis=0)
    header = "time [s],motor_current [A],motor_position [rad],joint_position [rad],ref_position,temperature"
    path = tmp_path / "axis7.csv"
    np.savetxt(path, table, delimiter=",", header=header, comments="", fmt="%.9g")
    return path


def filled(text: str) -> str:
    text = text.replace(f"gear_ratio: {PLACEHOLDER}", "gear_ratio: 50")
    text = re.sub(rf"(?<!# )counts_per_rev: {PLACEHOLDER}", "counts_per_rev: 4096", text)
    text = text.replace(f"torque_per_volt: {PLACEHOLDER}", "torque_per_volt: 1.5")
    text = re.sub(rf"rate_hz: {PLACEHOLDER}", "rate_hz: 250", text)
    text = re.sub(rf"side: {PLACEHOLDER}", "side: motor", text)
    text = re.sub(rf"unit: {PLACEHOLDER}(  # one of A)", r"unit: A\1", text)
    text = re.sub(rf"unit: {PLACEHOLDER}(  # one of N)", r"unit: N.m\1", text)
    return re.sub(rf"unit: {PLACEHOLDER}(  # one of rad)", r"unit: rad\1", text)


def test_table_fits_a_pipe_and_truncates_no_number(log):
    result = run(log)
    assert result.exit_code == 0, result.stderr
    table = result.stdout.split("\n\n")[0]
    assert max(map(len, table.splitlines())) <= 80
    assert "…" not in result.stdout
    row = next(line for line in table.splitlines() if line.startswith("temperature"))
    assert row.split()[1:] == ["580", "250", "0", "1", "-123457", "-123454", "-"]
    assert "Proposed configuration" in result.stdout


def test_numbers_are_whole_where_names_are_long(tmp_path):
    name = "a_very_long_name_" * 6
    path = tmp_path / "long.csv"
    rows = "".join(f"{k / 250},{-1.23456e-200 * k},{1.23456e200 * k}\n" for k in range(100))
    path.write_text(f"time,{name},q\n{rows}", encoding="utf-8")
    table = run(path).stdout.split("\n\n")[0]
    assert "1.22221e+202" in table
    assert "-1.22221e-198" in table
    assert "…" not in table


def test_json_is_one_document_and_nothing_else(log):
    result = run(log, "--json")
    document = json.loads(result.stdout)
    assert document["schema"] == "flexid-inspect/1"
    assert document["time_column"]
    channel = next(c for c in document["channels"] if c["source"].startswith("motor_current"))
    assert channel["samples"] == 580
    assert channel["rate_hz"] == pytest.approx(250.0)
    assert channel["unit"] == "A"
    assert channel["clock"]["gaps"] == 1
    assert channel["clock"]["lost_s"] == pytest.approx(0.084)
    assert document["proposed_config"].startswith("#")


def test_proposal_is_refused_until_it_is_filled_in_and_then_builds(log, tmp_path):
    target = tmp_path / "axis7.yaml"
    result = run(log, "--write-config", target)
    assert result.exit_code == 0, result.stderr
    assert "FILL_IN" in result.stderr
    text = target.read_text(encoding="utf-8")
    with pytest.raises(ConfigError):
        parse_config(text)
    config = parse_config(filled(text))
    assert config.signals.torque_role == "motor_current"
    assert config.signals.motor_position.unit == "rad"
    assert config.signals.joint_position is not None
    assert config.signals.reference_position is not None
    recording, _ = build_recording([log], config)
    assert [segment.samples for segment in recording.segments] == [300, 280]


def test_existing_file_is_only_replaced_with_force(log, tmp_path):
    target = tmp_path / "mine.yaml"
    target.write_text("precious", encoding="utf-8")
    refused = run(log, "--write-config", target)
    assert refused.exit_code == 2
    assert "--force" in refused.stderr
    assert target.read_text(encoding="utf-8") == "precious"
    assert run(log, "--write-config", target, "--force").exit_code == 0
    assert "version: 1" in target.read_text(encoding="utf-8")
    assert run(log, "--write-config", log, "--force").exit_code == 2
    assert log.read_text(encoding="utf-8").startswith("time")


def test_quiet_says_nothing_on_standard_error(log, tmp_path):
    assert run(log, "-q", "--write-config", tmp_path / "c.yaml").stderr == ""


@pytest.mark.parametrize("content", [None, "", "hello world\n"])
def test_bad_input_is_one_message_and_exit_code_2(tmp_path, content):
    path = tmp_path / "bad.csv"
    if content is not None:
        path.write_text(content, encoding="utf-8")
    result = run(path)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert result.stderr.startswith("error:")
    assert "Traceback" not in result.stderr


def test_help_ends_with_an_example():
    assert "sample_logs/" in run("--help").stdout.strip().splitlines()[-1]


def summary(source: str, kind: str = "column", unit: str | None = None, clocks: tuple[str, ...] = ()):
    return ChannelSummary(ChannelInfo(source, 100, unit, kind), -1.0, 1.0, 0, None, clocks)


def inspection(*channels: ChannelSummary, time_column: str | None = None) -> Inspection:
    return Inspection("csv", (Path("run_1.csv"),), 1.0, time_column, "s" if time_column else None, channels)


@pytest.mark.parametrize(
    ("names", "roles"),
    [
        (
            ["motor_torque", "motor_position", "joint_position", "reference_position"],
            ["motor_torque", "motor_position", "joint_position", "reference_position"],
        ),
        (["iq", "theta"], ["motor_current", "motor_position"]),
        (
            ["Iq_ref", "Iq_meas", "MotorAngle", "LinkAngle", "MotorSpeed"],
            [None, "motor_current", "motor_position", "joint_position", None],
        ),
        (
            ["drive_voltage", "motor_position", "reference_position"],
            ["motor_torque", "motor_position", "reference_position"],
        ),
        (["link_torque", "qm", "ql", "dqm"], ["joint_torque", "motor_position", "joint_position", None]),
        (
            ["/js/a1/position", "/js/a1/velocity", "/js/a1/effort", "/js/a2/position", "/js/a3/position"],
            ["motor_position", None, "motor_torque", None, None],
        ),
        (
            ["/motor/current.data", "/motor/position.data", "/link/position.data"],
            ["motor_current", "motor_position", "joint_position"],
        ),
        (["temperature", "error"], [None, None]),
    ],
)
def test_roles_are_guessed_from_names(names, roles):
    found = {
        channel.info.source: role for role, channel in guess_roles(inspection(*map(summary, names))).items()
    }
    assert [found.get(name) for name in names] == roles


@pytest.mark.parametrize(
    "channels",
    [
        inspection(summary("motor_current"), summary("motor_position"), time_column="time"),
        inspection(summary("u [V]", unit="V"), summary("drive_voltage"), summary('x: "q"', unit="count")),
        inspection(
            summary("/js/a1/position", "sensor_msgs/msg/JointState", clocks=("header_stamp", "log_time")),
            summary("/js/a1/effort", "sensor_msgs/msg/JointState", clocks=("log_time",)),
        ),
        inspection(
            summary("2"), summary("pos deg", unit="deg"), summary("tau", unit="furlong"), time_column="1"
        ),
        inspection(summary("temperature")),
    ],
)
def test_every_proposal_loads_once_it_is_filled_in(channels):
    text = propose_config(channels)
    text = re.sub(rf"source: {PLACEHOLDER}.*\n(\s+unit: ){PLACEHOLDER}  # A", r"source: left\n\1A  # A", text)
    text = re.sub(
        rf"source: {PLACEHOLDER}.*\n(\s+unit: ){PLACEHOLDER}  # rad", r"source: right\n\1rad  # rad", text
    )
    text = text.replace(f"unit: {PLACEHOLDER}  # the log says", "unit: N.m  # the log says")
    text = filled(text)
    if "axis.torque_constant" not in text and "motor_current:" in text and "torque_constant_nm" not in text:
        text = text.replace("gear_ratio: 50", "gear_ratio: 50\n  torque_constant_nm_per_a: unknown")
    assert parse_config(text).version == 1


def test_clock_of_every_channel_is_proposed():
    channels = inspection(
        summary("/m/position", clocks=("header_stamp", "log_time")),
        summary("/m/current", clocks=("log_time",)),
    )
    assert "source: log_time" in propose_config(channels)


class TestRealRecordings:
    @pytest.mark.parametrize(
        "name", ["odrive_slow_b", "emps_pulses", "kuka_kr300_a_axis3", "quanser_2dsfl_stage1"]
    )
    def test_roles_and_rates(self, recordings, name):
        found = inspect_log([recordings / "real" / f"{name}.csv.gz"])
        facts = json.loads((recordings / "real" / f"{name}.facts.json").read_text(encoding="utf-8"))
        roles = {role: channel.info.source for role, channel in guess_roles(found).items()}
        assert found.time_column == "time"
        for role in (
            "motor_position",
            "joint_position",
            "reference_position",
            "motor_current",
            "motor_torque",
        ):
            if role in facts["units"]:
                assert roles[role] == role
        if "sample_rate_hz" in facts:
            assert all(c.rate_hz == pytest.approx(facts["sample_rate_hz"], rel=1e-6) for c in found.channels)
