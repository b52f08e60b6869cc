"""``flexid identify`` as its user meets it: results, streams, outputs, containers, interruptions."""

from __future__ import annotations

import dataclasses
import gzip
import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jsonschema
import numpy as np
import pytest
import zstandard
from click.testing import CliRunner, Result

from flexid_cli.cli.main import main
from flexid_cli.estimate import identify as estimation
from flexid_cli.writers.csv import write_csv
from flexid_cli.writers.mcap import write_mcap
from flexid_cli.writers.rosbag1 import write_rosbag1
from flexid_cli.writers.rosbag2 import write_db3, write_rosbag2
from flexid_cli.writers.table import LogTable

if TYPE_CHECKING:
    from conftest import Columns

    from flexid_cli.simulate.axis import Axis

ROOT = Path(__file__).resolve().parents[2]
CHANNELS = {
    "/joint_states/motor/effort": "current",
    "/joint_states/motor/position": "motor",
    "/joint_states/joint/position": "joint",
    "/joint_states/reference/position": "reference",
}
START_NS = 10**18
ONE = ("--set", "models=[two_encoders]")  # for tests that look at no number


def identify(*arguments: str | Path, **options: Any) -> Result:
    return CliRunner().invoke(main, ["identify", *map(str, arguments)], **options)


def report(*arguments: str | Path) -> dict[str, Any]:
    result = identify(*arguments, "--json")
    assert result.exit_code == 0, result.output
    document: dict[str, Any] = json.loads(result.stdout)
    return document


def parameters(document: dict[str, Any], model: str) -> dict[str, dict[str, Any]]:
    [found] = [m for m in document["models"] if m["id"] == model]
    return {p["symbol"]: p for p in found["parameters"]}


@pytest.fixture
def remembered(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Estimate once for recordings that are equal to the last bit; gives the fingerprints met.

    The estimate is a function of recording and configuration, so equal ones need not be solved again.
    """
    met: list[str] = []
    results: dict[str, Any] = {}
    solve = estimation.identify

    def remember(recording: Any, config: Any) -> Any:
        plain = dataclasses.asdict(recording)
        del plain["history"]  # names the clock, which is a column in one container and a header in another
        for clock in plain["clocks"]:
            del clock["clock"]
        text = json.dumps([plain, config.resolved()], default=lambda array: array.tobytes().hex())
        met.append(hashlib.sha256(text.encode()).hexdigest())
        if met[-1] not in results:
            results[met[-1]] = solve(recording, config)
        return results[met[-1]]

    monkeypatch.setattr(estimation, "identify", remember)
    return met


# --- results ---


def test_the_intervals_hold_what_was_simulated(log: Path, config: Path, short_axis: Axis) -> None:
    document = report(log, "-c", config)
    for model, tolerance in (("two_encoders", 0.01), ("motor_only", 0.03)):
        found = parameters(document, model)
        assert abs(found["K"]["estimate"] / short_axis.K - 1.0) < tolerance
        for symbol in ("Jm", "K", "JL"):
            assert found[symbol]["verdict"] == "identified"
            assert found[symbol]["ci"]["low"] <= getattr(short_axis, symbol) <= found[symbol]["ci"]["high"]
    schema = json.loads((ROOT / "flexid_cli/schemas/report-1.schema.json").read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator(schema).validate(document)


def test_an_unknown_constant_gives_parameters_per_ampere(log: Path, config: Path) -> None:
    unknown = report(log, "-c", config, "--set", "axis.torque_constant_nm_per_a=unknown")
    known = report(log, "-c", config)
    assert unknown["recording"]["torque_unit"] == "A"
    for model in ("two_encoders", "motor_only"):
        amperes, newtons = parameters(unknown, model), parameters(known, model)
        assert amperes["Jm"]["unit"] == "A.s2/rad"
        assert amperes["K"]["unit"] == "A/rad"
        for symbol in ("Jm", "K", "JL"):
            ratio = newtons[symbol]["estimate"] / amperes[symbol]["estimate"]
            assert ratio == pytest.approx(50 * 0.35, rel=1e-5)
    shown = identify(log, "-c", config, "--set", "axis.torque_constant_nm_per_a=unknown").stdout
    assert "per ampere" in shown
    assert "A.s2/rad" in shown


@pytest.mark.parametrize("model", ["two_encoders", "motor_only"])
def test_the_route_of_the_paper(model: str, log: Path, config: Path, short_axis: Axis) -> None:
    document = report(log, "-c", config, "--route", "paper", "--set", f"models=[{model}]")
    assert document["config"]["resolved"]["estimate"]["route"] == "paper"
    found = parameters(document, model)
    assert found["Jm"]["estimate"] == pytest.approx(short_axis.Jm, rel=0.05)
    assert found["Jm"]["ci"]["level"] == pytest.approx(0.9545, abs=1e-4)
    if model == "motor_only":
        assert [x["name"] for x in document["models"][0]["regression"]] == [f"X{k}" for k in range(1, 8)]
    else:
        assert found["K"]["estimate"] == pytest.approx(short_axis.K, rel=0.01)


def test_overrides_count_and_stand_in_the_report(log: Path, config: Path) -> None:
    options = ["--set", "models=[two_encoders]", "--set", "estimate.confidence_level=0.99"]
    document = report(log, "-c", config, *options)
    assert [m["id"] for m in document["models"]] == ["two_encoders"]
    assert parameters(document, "two_encoders")["K"]["ci"]["level"] == 0.99
    assert document["config"]["resolved"]["estimate"]["confidence_level"] == 0.99
    assert document["inputs"][0]["sha256"] == hashlib.sha256(log.read_bytes()).hexdigest()


def test_a_motor_alone(log: Path, config: Path) -> None:
    document = report(log, "-c", config, "--set", "signals.joint_position=null")
    assert [m["id"] for m in document["models"]] == ["motor_only"]


# --- streams ---


def test_json_is_one_document_and_nothing_else(log: Path, config: Path, tmp_path: Path) -> None:
    plain = identify(log, "-c", config, *ONE, "--json")
    assert plain.stderr == ""
    document = json.loads(plain.stdout)
    for options in (["-o", "-"], ["--json", "-o", "-"], ["--json", "-o", tmp_path / "r.json"]):
        result = identify(log, "-c", config, *ONE, *options)
        assert result.exit_code == 0
        assert json.loads(result.stdout) == document
    assert json.loads((tmp_path / "r.json").read_text(encoding="utf-8")) == document
    assert result.stderr == f"wrote {tmp_path / 'r.json'}\n"


def test_verbosity(log: Path, config: Path, tmp_path: Path) -> None:
    normal = identify(log, "-c", config, *ONE)
    assert normal.stderr == ""
    quiet = identify(log, "-c", config, *ONE, "-q", "-o", tmp_path / "a.json")
    assert (quiet.stderr, quiet.stdout) == ("", normal.stdout)
    quietest = identify(log, "-c", config, *ONE, "-qq", "-o", tmp_path / "b.json")
    assert (quietest.stderr, quietest.stdout) == ("", "")
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()
    verbose = identify(log, "-c", config, *ONE, "-v")
    assert verbose.stdout == normal.stdout
    assert "common grid: 200 Hz" in verbose.stderr


@pytest.mark.parametrize("width", [40, 80])
def test_no_line_is_wider_than_the_terminal(width: int, log: Path, config: Path) -> None:
    lines = identify(log, "-c", config, env={"COLUMNS": str(width)}).stdout.splitlines()
    assert max(map(len, lines)) <= width
    assert any("kg.m2" in line for line in lines)


def test_colour(log: Path, config: Path) -> None:
    options = ["-c", config, "--set", "models=[two_encoders]"]
    coloured = identify(log, *options, env={"FORCE_COLOR": "1", "NO_COLOR": None}, color=True).stdout
    plain = identify(log, *options, env={"FORCE_COLOR": "1", "NO_COLOR": "1"}, color=True).stdout
    assert "\x1b[32midentified" in coloured
    assert not re.search(r"\x1b\[(3|4|9)\d", plain)
    assert "\x1b" not in identify(log, *options).stdout


# --- files ---


def test_force_replaces(log: Path, config: Path, tmp_path: Path) -> None:
    target = tmp_path / "r.json"
    target.write_text("old", encoding="utf-8")
    assert identify(log, "-c", config, "-o", target).exit_code == 2
    assert target.read_text(encoding="utf-8") == "old"
    assert identify(log, "-c", config, "-o", target, "--force").exit_code == 0
    assert json.loads(target.read_text(encoding="utf-8"))["schema"] == "flexid-report/1"


def test_a_configuration_from_standard_input(log: Path, config: Path) -> None:
    text = config.read_text(encoding="utf-8")
    result = identify(log, "-c", "-", "--set", "models=[two_encoders]", input=text)
    assert result.exit_code == 0
    assert "Drive parameters of short" in result.stdout


# --- containers ---


def table(columns: Columns, part: slice = slice(None)) -> LogTable:
    stamps = START_NS + np.rint(columns["time"] * 1e9).astype(np.int64)
    return LogTable(stamps[part], {path: columns[name][part] for path, name in CHANNELS.items()})


def halves(write: Callable[..., None], name: str) -> Callable[[Path, Columns], list[Path]]:
    def write_both(folder: Path, columns: Columns) -> list[Path]:
        paths = [folder / name.format(k) for k in range(2)]
        for path, part in zip(paths, (slice(0, 1777), slice(1777, None)), strict=True):
            write(path, table(columns, part))
        return paths

    return write_both


def whole(write: Callable[..., None], name: str, **options: Any) -> Callable[[Path, Columns], list[Path]]:
    def write_it(folder: Path, columns: Columns) -> list[Path]:
        write(folder / name, table(columns), **options)
        return [folder / name]

    return write_it


CONTAINERS = {
    "csv": whole(write_csv, "run.csv"),
    "csv.gz": whole(write_csv, "run.csv.gz"),
    "csv.zst": whole(write_csv, "run.csv.zst"),
    "csv in two parts": halves(write_csv, "run_{}.csv"),
    "mcap": whole(write_mcap, "run.mcap"),
    "mcap with ros2idl": whole(write_mcap, "run.mcap", encoding="ros2idl"),
    "mcap with ros1": whole(write_mcap, "run.mcap", encoding="ros1"),
    "mcap with json": whole(write_mcap, "run.mcap", encoding="json"),
    "mcap in two parts": halves(write_mcap, "run_{}.mcap"),
    "rosbag2 of sqlite3": whole(write_rosbag2, "run", storage="sqlite3"),
    "rosbag2 of mcap": whole(write_rosbag2, "run", storage="mcap"),
    "db3": whole(write_db3, "run.db3"),
    "bag": whole(write_rosbag1, "run.bag"),
    "bag in two parts": halves(write_rosbag1, "run_{}.bag"),
}


@pytest.fixture
def paths_config(tmp_path: Path, config: Path) -> Path:
    """The configuration with signal paths, which every container understands."""
    text = config.read_text(encoding="utf-8").replace("  time:               {source: time, unit: s}\n", "")
    for source, name in CHANNELS.items():
        text = text.replace(f"source: {name},", f"source: {source},")
    path = tmp_path / "paths.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_the_same_report_from_every_container(
    tmp_path: Path, columns: Columns, paths_config: Path, remembered: list[str]
) -> None:
    reports = {}
    for name, write in CONTAINERS.items():
        folder = tmp_path / name.replace(" ", "_")
        folder.mkdir()
        logs = write(folder, columns)
        document = report(*logs, "-c", paths_config)
        inputs = document.pop("inputs")
        assert [entry["path"] for entry in inputs] == [str(log) for log in logs]
        reports[name] = json.dumps(document)
    assert {name for name, text in reports.items() if text != reports["csv"]} == set()
    assert len(set(remembered)) == 1


def sample_logs(folder: Path) -> list[Path]:
    """Every sample log, and what a user could make of them: packed CSV and the database without its folder."""
    logs = ROOT / "sample_logs"
    table = (logs / "axis3.csv").read_bytes()
    (folder / "axis3.csv.gz").write_bytes(gzip.compress(table, 1))
    (folder / "axis3.csv.zst").write_bytes(zstandard.compress(table))
    packed = (logs / "axis3_rosbag2_sqlite3" / "axis3_rosbag2_sqlite3.db3.zstd").read_bytes()
    with zstandard.ZstdDecompressor().stream_reader(packed) as stream:
        (folder / "axis3.db3").write_bytes(stream.read())
    names = ("axis3.csv", "axis3.mcap", "axis3.bag", "axis3_rosbag2_sqlite3", "axis3_rosbag2_mcap")
    return [*(logs / name for name in names), *sorted(folder.iterdir())]


def test_the_same_report_from_every_sample_log(tmp_path: Path, remembered: list[str]) -> None:
    texts = set()
    for log in sample_logs(tmp_path):
        document = report(log, "-c", ROOT / "configs" / "axis3.yaml")
        document.pop("inputs")
        texts.add(json.dumps(document))
    assert len(remembered) == 8
    assert len(set(remembered)) == len(texts) == 1


# --- real processes ---


def command(*arguments: str | Path) -> list[str]:
    return [sys.executable, "-m", "flexid_cli", "identify", *map(str, arguments)]


def test_the_slowest_imports_are_not_needed(log: Path, config: Path) -> None:
    code = (
        "import sys\n"
        "from flexid_cli.cli.main import main\n"
        "try:\n    main(sys.argv[1:])\n"
        "except SystemExit as end:\n    assert not end.code\n"
        "sys.exit(' '.join({'scipy.signal', 'scipy.stats', 'matplotlib'} & set(sys.modules)) or 0)\n"
    )
    command = [
        sys.executable,
        "-c",
        code,
        "identify",
        str(log),
        "--config",
        str(config),
        "--essential",
        "-qq",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_outputs_are_whole_and_the_same_in_another_process(log: Path, config: Path, tmp_path: Path) -> None:
    """There with an encoding that lacks the table's lines, and with other hashes of words."""
    here, there = tmp_path / "here", tmp_path / "there"
    for folder in (here, there):
        folder.mkdir()
    files = ["-o", here / "r.json", "-o", here / "r.md"]
    result = identify(log, "-c", config, *files)
    assert result.stderr == f"wrote {here / 'r.json'}, {here / 'r.md'} and 6 figures beside\n"
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0", "PYTHONHASHSEED": "17"}
    environment |= {"COLUMNS": "80", "PYTHONPATH": str(ROOT)}
    arguments = [str(argument).replace(str(here), str(there)) for argument in files]
    done = subprocess.run(
        command(log, "-c", config, *arguments), env=environment, capture_output=True, cwd=ROOT, check=True
    )
    assert done.stdout.isascii()
    assert b"identified" in done.stdout
    contents = {path.name: path.read_bytes() for path in here.iterdir()}
    assert contents == {path.name: path.read_bytes() for path in there.iterdir()}
    links = re.findall(r"!\[[^\]]*\]\(([^)]*)\)", contents["r.md"].decode())
    assert sorted([*links, "r.json", "r.md"]) == sorted(contents)
    assert len(links) == 6


def test_names_beyond_ascii_survive_as_json(log: Path, config: Path) -> None:
    environment = {**os.environ, "PYTHONIOENCODING": "latin-1", "PYTHONUTF8": "0", "PYTHONPATH": str(ROOT)}
    options = ["--set", "axis.name=Hüfte µ→", "--set", "models=[two_encoders]", "--json"]
    done = subprocess.run(
        command(log, "-c", config, *options), env=environment, capture_output=True, cwd=ROOT, check=True
    )
    assert json.loads(done.stdout.decode("utf-8"))["config"]["resolved"]["axis"]["name"] == "Hüfte µ→"


def test_a_reader_that_goes_away_is_no_failed_gate(log: Path, config: Path) -> None:
    """Not 1 either, as rich would have it: 1 says that a gate failed."""
    with subprocess.Popen(
        command(log, "-c", config), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT
    ) as running:
        assert running.stdout is not None
        assert running.stderr is not None
        running.stdout.close()
        assert running.stderr.read() == ""
        assert running.wait() == 141


@pytest.mark.skipif(os.name == "nt", reason="needs SIGINT")
@pytest.mark.parametrize("after_s", [0.5, 1.1])
def test_an_interrupt_leaves_nothing_behind(after_s: float, log: Path, config: Path, tmp_path: Path) -> None:
    before = set(tmp_path.iterdir())
    files = ["-o", tmp_path / "r.json", "-o", tmp_path / "r.md"]
    with subprocess.Popen(
        command(log, "-c", config, *files),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    ) as running:
        time.sleep(after_s)
        running.send_signal(signal.SIGINT)
        out, err = running.communicate(timeout=60)
    if running.returncode == 0:
        pytest.skip("the machine was faster than the signal")
    # Where the signal met a compiled module, Python ends itself by the signal: for a shell that is 130, too.
    assert running.returncode in {130, -signal.SIGINT}
    assert (out, err.strip()) == ("", "interrupted")
    assert set(tmp_path.iterdir()) == before


def test_an_interrupt_that_a_library_swallows_is_still_one(
    log: Path, config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A compiled module that is being imported turns Ctrl-C into an ImportError."""

    def importing(*_: object) -> None:
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise ImportError("initialization failed") from None

    monkeypatch.setattr(estimation, "identify", importing)
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    try:
        result = identify(log, "-c", config)
        assert (result.exit_code, result.stderr) == (130, "interrupted\n")
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, handler)
