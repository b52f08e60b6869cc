"""``--help`` of every command: its width, and examples that really run."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import pytest
from click.testing import CliRunner

from flexid_cli.cli.main import COMMANDS, main
from flexid_cli.config.load import parse_config

if TYPE_CHECKING:
    from conftest import Columns, WriteLog

ROOT = Path(__file__).resolve().parents[2]


def help_of(name: str) -> str:
    result = CliRunner().invoke(main, [name, "--help"], env={"COLUMNS": "80"})
    assert (result.exit_code, result.stderr) == (0, "")
    return result.stdout


def examples(name: str) -> list[str]:
    """The lines below the last ``Example:``."""
    text = help_of(name).rpartition("Example:\n")[2]
    return [line.strip() for line in text.splitlines() if line.strip()]


EXAMPLES = [(name, line) for name in COMMANDS for line in examples(name)]


@pytest.fixture
def workplace(tmp_path: Path) -> Path:
    """What a user has: the sample logs, the configurations, a home, and ``flexid`` on the path."""
    place = tmp_path / "place"
    for folder in ("sample_logs", "configs"):
        shutil.copytree(ROOT / folder, place / folder, ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    for folder in ("home/.zfunc", "home/.config/fish/completions", "bin"):
        (tmp_path / folder).mkdir(parents=True)
    program = tmp_path / "bin" / "flexid"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m flexid_cli "$@"\n', encoding="utf-8")
    program.chmod(0o755)
    return place


@pytest.mark.parametrize("name", COMMANDS)
def test_help_ends_in_an_example_and_fits_80_columns(name: str) -> None:
    text = help_of(name)
    assert max(map(len, text.splitlines())) <= 80
    assert examples(name)
    assert all(line.startswith(f"flexid {name}") for line in examples(name))


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_is_explained(name: str) -> None:
    command = main.get_command(click.Context(main), name)
    assert command is not None
    for option in command.params:
        if isinstance(option, click.Option):
            assert option.help, f"{name} {option.opts}"
            assert option.help.endswith((".", "]")), f"{name} {option.opts}"


@pytest.mark.skipif(os.name == "nt", reason="the examples are written for a POSIX shell")
@pytest.mark.parametrize(("name", "line"), EXAMPLES, ids=[line for _, line in EXAMPLES])
def test_examples_run_as_they_stand(name: str, line: str, workplace: Path) -> None:
    for named in re.findall(r"(?:sample_logs|configs)/\S+", line):
        assert (workplace / named).exists(), named
    base = workplace.parent
    environment = {
        **os.environ,
        "PATH": f"{base / 'bin'}{os.pathsep}{os.environ['PATH']}",
        "HOME": str(base / "home"),
        "PYTHONPATH": str(ROOT),
        "COLUMNS": "80",
    }
    before = set(base.rglob("*"))
    done = subprocess.run(
        ["/bin/sh", "-c", line], cwd=workplace, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    made = {path for path in set(base.rglob("*")) - before if path.is_file()}
    assert done.stdout or made
    assert all(path.stat().st_size for path in made)
    if name == "identify":
        assert max(map(len, done.stdout.splitlines())) <= 80
        assert "identified" in done.stdout
    if "--write-config" in line:
        assert "version: 1" in next(iter(made)).read_text(encoding="utf-8")


def test_the_example_of_the_program_is_one_of_identify() -> None:
    text = CliRunner().invoke(main, ["--help"], env={"COLUMNS": "80"}).stdout
    assert text.rstrip().splitlines()[-1].strip() in examples("identify")


def test_what_a_newcomer_does(columns: Columns, write_log: WriteLog, tmp_path: Path) -> None:
    """Inspect, let it propose a configuration, fill it in, check it, identify."""
    names = ("time", "motor_current", "motor_position", "joint_position", "reference_position")
    log = write_log(dict(zip(names, columns.values(), strict=True)))
    runner = CliRunner()
    target = tmp_path / "axis7.yaml"
    result = runner.invoke(main, ["inspect", str(log), "--write-config", str(target)])
    assert result.exit_code == 0, result.output
    unfinished = runner.invoke(main, ["check", str(target), str(log)])
    assert unfinished.exit_code == 2
    assert unfinished.stderr.count("error: ") == 1
    assert runner.invoke(main, ["identify", str(log), "-c", str(target)]).exit_code == 2
    text = target.read_text(encoding="utf-8")
    for pattern, value in (
        (r"gear_ratio: FILL_IN", "gear_ratio: 50"),
        (r"per_a: unknown", "per_a: 0.35"),
        (r"(motor_current:(?:.*\n)*?.*unit: )FILL_IN", r"\1A"),
        (r"(?<!# )unit: FILL_IN", "unit: rad"),
        (r"side: FILL_IN", "side: motor"),
    ):
        text, count = re.subn(pattern, value, text)
        assert count, pattern
    parse_config(text)
    target.write_text(text, encoding="utf-8")
    checked = runner.invoke(main, ["check", str(target), str(log)])
    assert checked.exit_code == 0, checked.output
    first = stiffness(log, target)
    assert first["ci"]["low"] < 2400.0 < first["ci"]["high"]
    # The report has seen in the data what nobody told it: that the set point is held for one sample.
    shown = runner.invoke(main, ["identify", str(log), "-c", str(target)], env={"COLUMNS": "300"}).stdout
    advice = "signals.motor_current.hold: sample"
    assert f"set {advice}\n" in shown
    second = stiffness(log, target, "--set", advice.replace(": ", "="))
    assert second["estimate"] == pytest.approx(2400.0, rel=0.01)
    assert second["stderr"] < 0.2 * first["stderr"]


def stiffness(*arguments: str | Path) -> dict[str, Any]:
    words = [*map(str, arguments), "--set", "models=[two_encoders]", "--json"]
    result = CliRunner().invoke(main, ["identify", words[0], "-c", *words[1:]])
    assert result.exit_code == 0, result.output
    [found] = [p for p in json.loads(result.stdout)["models"][0]["parameters"] if p["symbol"] == "K"]
    return dict(found)
