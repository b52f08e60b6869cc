"""The shell around all commands: exit codes, streams, start-up, and what a crash looks like."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import types
import warnings
from pathlib import Path

import click
import jsonschema
import pytest
from click.testing import CliRunner, Result

from flexid_cli import __version__
from flexid_cli.cli import files
from flexid_cli.cli.main import COMMANDS, CommandEntry, main
from flexid_cli.cli.options import Console, pass_console, verbosity_options, wants_color
from flexid_cli.errors import ConfigError, DataError, InputError, OutputError, Problem

HEAVY = ("numpy", "scipy", "pydantic", "yaml", "rich", "matplotlib", "pandas", "numba", "rosbags", "mcap")
LIGHT = ("check", "schema", "env", "completion")


def invoke(*arguments: str, **options: object) -> Result:
    return CliRunner().invoke(main, list(arguments), **options)  # type: ignore[arg-type]


def process(*arguments: str, **options: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "flexid_cli", *arguments]
    root = Path(__file__).resolve().parents[2]
    return subprocess.run(command, capture_output=True, text=True, cwd=root, check=False, **options)  # type: ignore[call-overload, no-any-return]


@pytest.fixture
def crash(monkeypatch: pytest.MonkeyPatch) -> types.SimpleNamespace:
    """A command ``crash`` that runs ``crash.action``."""
    holder = types.SimpleNamespace(action=lambda: None)

    @click.command()
    @verbosity_options
    @pass_console
    def command(console: Console) -> object:
        return holder.action()

    module = types.ModuleType("flexid_crash")
    module.command = command  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "flexid_crash", module)
    monkeypatch.setitem(COMMANDS, "crash", CommandEntry("flexid_crash", "command", "Crash."))
    return holder


def raising(error: BaseException) -> object:
    def action() -> None:
        raise error

    return action


def test_version_and_help() -> None:
    assert invoke("--version").stdout.split()[-1] == __version__
    for flag in ("-h", "--help"):
        result = invoke(flag)
        assert result.exit_code == 0
        assert result.stderr == ""
        for name, entry in COMMANDS.items():
            assert f"  {name} " in result.stdout
            assert entry.summary in result.stdout
        assert "Example:" in result.stdout


def test_help_imports_no_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(COMMANDS, "absent", CommandEntry("flexid_cli.no_such_module", "x", "Not there."))
    assert "Not there." in invoke("--help").stdout


@pytest.mark.parametrize("name", LIGHT)
def test_every_command_has_help_that_ends_in_an_example(name: str) -> None:
    result = invoke(name, "-h")
    assert result.exit_code == 0
    assert "Example:" in result.stdout
    assert result.stdout.rstrip().splitlines()[-1].startswith(f"    flexid {name}")


@pytest.mark.parametrize("name", LIGHT)
def test_table_says_what_the_command_says(name: str) -> None:
    command = main.get_command(click.Context(main), name)
    assert command is not None
    assert command.name == name
    assert command.short_help == COMMANDS[name].summary


def test_no_arguments_is_a_usage_error() -> None:
    result = invoke()
    assert result.exit_code == 2
    assert result.stdout == ""
    assert "Commands:" in result.stderr


@pytest.mark.parametrize(
    ("word", "meant"), [("chek", "check"), ("tune_filter", "tune-filter"), ("identfy", "identify")]
)
def test_unknown_command(word: str, meant: str) -> None:
    result = invoke(word)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert f"there is no command '{word}'" in result.stderr
    assert f"Did you mean '{meant}'?" in result.stderr


def test_unknown_command_without_a_likeness() -> None:
    assert "Did you mean" not in invoke("zzzzzz").stderr


@pytest.mark.parametrize(
    "arguments", [["--no-such"], ["check"], ["check", "--no-such"], ["schema", "foo"], ["completion"]]
)
def test_usage_errors(arguments: list[str]) -> None:
    result = invoke(*arguments)
    assert result.exit_code == 2
    assert "error:" in result.stderr
    assert "Usage: flexid" in result.stderr
    assert result.stdout == ""


def test_errors_of_the_family(crash: types.SimpleNamespace) -> None:
    for error, code in [
        (InputError("no such channel", "take another"), 2),
        (DataError("too short", "longer"), 3),
    ]:
        crash.action = raising(error)
        result = invoke("crash")
        assert result.exit_code == code
        assert result.stdout == ""
        assert result.stderr == f"error: {error.message}\n  hint: {error.hint}\n"


def test_configuration_errors_begin_with_their_place(crash: types.SimpleNamespace) -> None:
    problems = [Problem("first", "a", 1, 1, "a: 1"), Problem("second", "b", 2, 4, "b: 2", "do this")]
    crash.action = raising(ConfigError("axis.yaml", problems))
    lines = invoke("crash").stderr.splitlines()
    assert lines[0] == "error: 2 mistakes in axis.yaml"
    assert lines[1].startswith("axis.yaml:1:1: first")
    assert any(line.startswith("axis.yaml:2:4: second") for line in lines)


def test_a_crash_is_a_bug_and_never_exits_1(crash: types.SimpleNamespace) -> None:
    for error in (
        TypeError("odd\nthing"),
        EOFError("short"),
        AssertionError(),
        RecursionError(),
        ImportError("x"),
    ):
        crash.action = raising(error)
        result = invoke("crash")
        assert result.exit_code == 2
        assert f"internal error: {type(error).__name__}" in result.stderr
        assert "bug" in result.stderr
        assert "flexid env" in result.stderr
        assert "Traceback" not in result.stderr
        assert result.stdout == ""


def test_traceback_for_those_who_ask(crash: types.SimpleNamespace, monkeypatch: pytest.MonkeyPatch) -> None:
    crash.action = raising(TypeError("odd"))
    assert "Traceback" in invoke("crash", "-v").stderr
    monkeypatch.setenv("FLEXID_DEBUG", "1")
    assert "Traceback" in invoke("crash").stderr
    monkeypatch.setenv("FLEXID_DEBUG", "0")
    assert "Traceback" not in invoke("crash").stderr


def test_an_import_that_fails_is_a_bug_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(COMMANDS, "absent", CommandEntry("flexid_cli.no_such_module", "x", "Not there."))
    result = invoke("absent")
    assert result.exit_code == 2
    assert "internal error: ModuleNotFoundError" in result.stderr


def test_other_endings(crash: types.SimpleNamespace) -> None:
    for error, code, words in [
        (KeyboardInterrupt(), 130, "interrupted"),
        (click.ClickException("odd option"), 2, "error: odd option"),
        (OSError(28, "No space left on device", "out.json"), 2, "error: out.json: No space left on device"),
        (PermissionError(13, "Permission denied", "run.csv"), 2, "run.csv: Permission denied"),
        (MemoryError(), 2, "not enough memory"),
        (click.exceptions.Exit(3), 3, ""),
        (SystemExit(3), 3, ""),
    ]:
        crash.action = raising(error)
        result = invoke("crash")
        assert result.exit_code == code
        assert words in result.stderr
        assert "Traceback" not in result.stderr


def test_what_a_command_returns_is_no_exit_code(crash: types.SimpleNamespace) -> None:
    crash.action = lambda: 7
    assert invoke("crash").exit_code == 0


def test_warnings_and_logs_of_libraries_stay_inside(crash: types.SimpleNamespace) -> None:
    def action() -> None:
        import logging

        warnings.warn("from a library", RuntimeWarning, stacklevel=1)
        logging.getLogger("library").warning("from a library")

    crash.action = action
    result = invoke("crash")
    assert (result.exit_code, result.stderr, result.stdout) == (0, "", "")


def test_no_color(monkeypatch: pytest.MonkeyPatch, crash: types.SimpleNamespace) -> None:
    crash.action = raising(InputError("x", "y"))
    monkeypatch.delenv("NO_COLOR", raising=False)
    assert wants_color() is None
    assert "\x1b[" in invoke("crash", color=True).stderr
    monkeypatch.setenv("NO_COLOR", "1")
    assert "\x1b[" not in invoke("crash", color=True).stderr


def test_console_levels(capsys: pytest.CaptureFixture[str]) -> None:
    console = Console()
    for verbosity, expected in [(-1, "e\n"), (0, "i\nwarning: w\ne\n"), (1, "i\nd\nwarning: w\ne\n")]:
        console.verbosity = verbosity
        console.info("i")
        console.detail("d")
        console.warning("w")
        console.plain("e")
        captured = capsys.readouterr()
        assert captured.err == expected
        assert captured.out == ""


def test_not_standalone_hands_errors_to_the_caller() -> None:
    with pytest.raises(click.UsageError):
        main.main(["chek"], standalone_mode=False)


# --- commands of the shell itself ---


def test_schema_config_is_the_committed_file(root: Path) -> None:
    result = invoke("schema", "config")
    assert result.stdout == (root / "flexid_cli/schemas/config-1.schema.json").read_text(encoding="utf-8")
    jsonschema.Draft202012Validator.check_schema(json.loads(result.stdout))


def test_schema_report(root: Path) -> None:
    result = invoke("schema", "report")
    assert result.exit_code == 0
    assert json.loads(result.stdout) == json.loads(
        (root / "flexid_cli/schemas/report-1.schema.json").read_text()
    )


def test_env_names_versions_and_no_places() -> None:
    result = invoke("env")
    assert result.exit_code == 0
    assert result.stdout.startswith("flexid ")
    for name in ("python", "numpy", "pydantic", "rosbags"):
        assert f"\n{name} " in result.stdout
    assert str(Path.home()) not in result.stdout
    assert sys.prefix not in result.stdout


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_scripts(shell: str) -> None:
    result = invoke("completion", shell)
    assert result.exit_code == 0
    assert result.stderr == ""
    assert f"_FLEXID_COMPLETE={shell}_complete" in result.stdout


def test_completion_of_commands_and_choices() -> None:
    environment = {**os.environ, "_FLEXID_COMPLETE": "bash_complete"}
    found = process(env={**environment, "COMP_WORDS": "flexid c", "COMP_CWORD": "1"}).stdout.split()
    assert found == ["plain,check", "plain,completion"]
    found = process(env={**environment, "COMP_WORDS": "flexid schema ", "COMP_CWORD": "2"}).stdout.split()
    assert found == ["plain,config", "plain,report"]


# --- real processes ---


@pytest.mark.parametrize(
    "arguments", [["--version"], ["--help"], ["check", "--help"], ["completion", "bash"]]
)
def test_start_imports_nothing_heavy(arguments: list[str]) -> None:
    code = (
        "import sys\n"
        "from flexid_cli.cli.main import main\n"
        "try:\n    main(sys.argv[1:])\n"
        f"except SystemExit:\n    sys.exit(' '.join(m for m in {HEAVY!r} if m in sys.modules))\n"
    )
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, cwd=root, check=False
    )
    assert done.stderr.strip() == ""


def test_a_process_ends_with_2_and_no_traceback(tmp_path: Path) -> None:
    file = tmp_path / "axis.yaml"
    file.write_text("version: 2\naxis: {name: a, gear_ratio: 0}\nsignals: {}\nfoo: no\n")
    done = process("check", str(file))
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.count(f"{file}:") == 5
    assert "error: 5 mistakes in" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_closed_pipe_is_no_crash() -> None:
    root = Path(__file__).resolve().parents[2]
    with subprocess.Popen(
        [sys.executable, "-m", "flexid_cli", "schema", "config"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=root,
    ) as running:  # fmt: skip
        assert running.stdout is not None
        assert running.stderr is not None
        running.stdout.close()
        assert running.stderr.read() == ""
        assert running.wait() == 141


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_is_said_in_words() -> None:
    root = Path(__file__).resolve().parents[2]
    with Path("/dev/full").open("w") as full:
        command = [sys.executable, "-m", "flexid_cli", "env"]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, cwd=root, check=False)
    assert done.returncode == 2
    assert done.stderr == "error: No space left on device\n"


def test_a_narrow_terminal_gets_escapes() -> None:
    done = process("check", "→.yaml", env={**os.environ, "PYTHONIOENCODING": "latin-1", "PYTHONUTF8": "0"})
    assert done.returncode == 2
    assert "\\u2192.yaml" in done.stderr


# --- files ---


def test_files_are_written_whole(tmp_path: Path) -> None:
    target = tmp_path / "out.json"
    files.write_text_atomic(target, "one\n")
    with pytest.raises(OutputError, match="exists already") as caught:
        files.write_text_atomic(target, "two\n")
    assert "--force" in caught.value.hint
    assert target.read_text() == "one\n"
    files.write_text_atomic(target, "µ\n", force=True)
    assert target.read_bytes() == b"\xc2\xb5\n"
    assert list(tmp_path.iterdir()) == [target]


def test_files_that_cannot_be_written(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "none" / "out.json"):
        with pytest.raises(OutputError, match="cannot write"):
            files.write_text_atomic(path, "x")
        with pytest.raises(OutputError, match="cannot write"):
            files.check_outputs([path])


def test_inputs_are_never_outputs(tmp_path: Path) -> None:
    log = tmp_path / "run.csv"
    log.write_text("t\n")
    link = tmp_path / "link.csv"
    link.symlink_to(log)
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "bag_0.mcap").write_text("x")
    for output, source in [(log, log), (link, log), (bag / "bag_0.mcap", bag)]:
        with pytest.raises(OutputError, match="is an input"):
            files.check_outputs([output], force=True, inputs=[source])
    files.check_outputs([tmp_path / "new.json", Path("-")], inputs=[log, tmp_path / "absent.csv"])


def test_the_same_output_twice(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="twice"):
        files.check_outputs([tmp_path / "a.json", tmp_path / "." / "a.json"])


def test_standard_output_and_devices(capfdbinary: pytest.CaptureFixture[bytes]) -> None:
    files.write_text_atomic(Path("-"), "µ\n")
    assert capfdbinary.readouterr().out == "µ\n".encode()
    files.check_outputs([Path(os.devnull)])
    files.write_text_atomic(Path(os.devnull), "x")
    assert Path(os.devnull).is_char_device()
