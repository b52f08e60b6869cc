"""``flexid diagnose`` around its engine: exit codes, streams, outputs, other runs, known parameters."""

from __future__ import annotations

import json
import re
import runpy
import sys
import types
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import jsonschema
import pytest
from click.testing import CliRunner, Result

from flexid_cli.cli.main import main
from flexid_cli.effects.registry import effects
from flexid_cli.errors import DataError

if TYPE_CHECKING:
    from conftest import Columns, WriteLog

    from flexid_cli.config.schema import Config
    from flexid_cli.diagnose.result import Diagnosis
    from flexid_cli.signals.recording import Recording

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = SimpleNamespace(**runpy.run_path(str(ROOT / "tests" / "diagnosis_examples.py")))
SCHEMA = json.loads((ROOT / "flexid_cli/schemas/report-1.schema.json").read_text("utf-8"))
Engine = SimpleNamespace


def diagnose(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, ["diagnose", *map(str, arguments)])


@pytest.fixture
def engine(monkeypatch: pytest.MonkeyPatch) -> Engine:
    """An engine that finds ``verdict`` and remembers what it was asked."""
    asked = SimpleNamespace(verdict="explained", calls=[])

    def find(
        recording: Recording,
        config: Config,
        validation: Recording | None = None,
        *,
        known: Mapping[str, float] | None = None,
    ) -> Diagnosis:
        asked.calls.append(SimpleNamespace(recording=recording, config=config, other=validation, known=known))
        made: Diagnosis = EXAMPLES.CASES[asked.verdict]()
        return made

    module = types.ModuleType("flexid_cli.diagnose.diagnose")
    module.diagnose = find  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, module.__name__, module)
    return asked


@pytest.fixture
def report(tmp_path: Path) -> Callable[..., Path]:
    """Write the report of an identification, changed as a test wants it."""

    def write(change: Callable[[dict[str, Any]], Any] = lambda _: None) -> Path:
        _, document = EXAMPLES.REPORT.case("flexible")
        change(document)
        path = tmp_path / "known.json"
        path.write_text(json.dumps(document), encoding="utf-8")
        return path

    return write


# --- exit codes and streams ---


@pytest.mark.parametrize(
    ("verdict", "plain", "gated"),
    [
        ("adequate", 0, 0), ("explained", 0, 1), ("pair", 0, 1), ("ambiguous", 0, 1), ("unexplained", 0, 1),
        ("inconclusive", 3, 3),
    ],
)  # fmt: skip
def test_exit_codes(engine: Engine, log: Path, config: Path, verdict: str, plain: int, gated: int) -> None:
    engine.verdict = verdict
    assert diagnose(log, "-c", config).exit_code == plain
    result = diagnose(log, "-c", config, "--fail-on", "mismatch")
    assert result.exit_code == gated
    assert EXAMPLES.CASES[verdict]().sentence in " ".join(result.stdout.split())
    assert bool(result.stderr) == bool(gated)


def test_a_gate_that_fails_has_written_its_report(
    engine: Engine, log: Path, config: Path, tmp_path: Path
) -> None:
    out = tmp_path / "run.json"
    result = diagnose(log, "-c", config, "--fail-on", "mismatch", "-o", out, "-qq")
    assert (result.exit_code, result.stdout) == (1, "")
    assert "the verdict is explained" in result.stderr
    assert json.loads(out.read_text("utf-8"))["diagnosis"]["verdict"] == "explained"


def test_data_that_the_engine_refuses_exit_3(
    engine: Engine, log: Path, config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise DataError("the record is too short", "record more")

    monkeypatch.setattr(sys.modules["flexid_cli.diagnose.diagnose"], "diagnose", refuse)
    result = diagnose(log, "-c", config, "--json")
    assert (result.exit_code, result.stdout) == (3, "")
    assert result.stderr == "error: the record is too short\n  hint: record more\n"


def test_json_is_the_document_and_nothing_else(engine: Engine, log: Path, config: Path) -> None:
    for option in (("--json",), ("-o", "-")):
        result = diagnose(log, "-c", config, *option)
        document = json.loads(result.stdout)
        jsonschema.Draft202012Validator(SCHEMA).validate(document)
        assert document["models"] == []
        assert document["diagnosis"]["effects"][0]["name"] == "backlash"
        assert [i["role"] for i in document["inputs"]] == ["recording"]


def test_the_report_on_the_terminal_is_80_columns_wide(engine: Engine, log: Path, config: Path) -> None:
    shown = diagnose(log, "-c", config)
    assert shown.stderr == ""
    assert max(map(len, shown.stdout.splitlines())) <= 80
    assert shown.stdout.startswith("Diagnosis of short: explained\n")
    assert diagnose(log, "-c", config, "-qq").stdout == ""
    assert "read 3999 samples" in diagnose(log, "-c", config, "-v").stderr


# --- outputs ---


def test_files_and_figures(engine: Engine, log: Path, config: Path, tmp_path: Path) -> None:
    text, data = tmp_path / "run.md", tmp_path / "run.json"
    result = diagnose(log, "-c", config, "-o", text, "-o", data)
    assert "and 3 figures beside" in result.stderr
    figures = {path.name for path in tmp_path.glob("*.svg")}
    assert figures == {f"run_diagnosis_{kind}.svg" for kind in ("residual", "map_1", "map_2")}
    assert all(f"({name})" in text.read_text("utf-8") for name in figures)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    again = diagnose(log, "-c", config, "-o", text)
    assert again.exit_code == 2
    assert "exists already" in again.stderr
    assert diagnose(log, "-c", config, "-o", text, "-o", data, "--force").exit_code == 0
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_what_cannot_be_written_is_refused_before_the_work(
    engine: Engine, log: Path, config: Path, report: Callable[..., Path], tmp_path: Path
) -> None:
    other = tmp_path / "other.md"
    known = report()
    for arguments in (
        ("-o", tmp_path / "run.docx"),
        ("-o", tmp_path / "nowhere" / "run.json"),
        ("-o", other, "-o", other),
        ("--report", known, "-o", known, "--force"),
    ):
        result = diagnose(log, "-c", config, *arguments)
        assert (result.exit_code, result.stdout) == (2, "")
    other.write_bytes(log.read_bytes())
    assert diagnose(log, "-c", config, "--validate", other, "-o", other, "--force").exit_code == 2
    assert not engine.calls


# --- what the engine is given ---


def test_the_window_cuts_the_run_and_not_the_other_one(
    engine: Engine, log: Path, config: Path, write_log: WriteLog, columns: Columns
) -> None:
    half = {name: values[:3000] for name, values in columns.items()}
    other = write_log(half, "other.csv")
    result = diagnose(log, "-c", config, "--validate", other, "--start", "5", "--end", "15", "--json")
    assert result.exit_code == 0, result.stderr
    [call] = engine.calls
    assert call.recording.duration_s == pytest.approx(10.0, abs=0.02)
    assert call.other.duration_s == pytest.approx(15.0, abs=0.02)
    assert call.known is None
    inputs = json.loads(result.stdout)["inputs"]
    assert [(i["role"], Path(i["path"]).name) for i in inputs] == [
        ("recording", "run.csv"),
        ("validation", "other.csv"),
    ]
    assert [i["samples"] for i in inputs] == [
        call.recording.clocks[0].samples,
        call.other.clocks[0].samples,
    ]


def test_settings_reach_the_engine(engine: Engine, log: Path, config: Path) -> None:
    diagnose(log, "-c", config, "--set", "axis.f1_hz=4.1")
    assert engine.calls[0].config.axis.f1_hz == 4.1


def test_known_parameters_come_by_their_symbols(
    engine: Engine, log: Path, config: Path, report: Callable[..., Path]
) -> None:
    path = report()
    result = diagnose(log, "-c", config, "--report", path, "--json")
    assert result.exit_code == 0, result.stderr
    known = engine.calls[0].known
    table = {p.symbol: p.value for p in EXAMPLES.REPORT.TABLE_1}
    assert {symbol: known[symbol] for symbol in table} == table
    last = json.loads(result.stdout)["inputs"][-1]
    assert (last["role"], last["path"], last["format"]) == ("parameters", str(path), "flexid-report/1")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda d: d.update(schema="flexid-overlay/1"), "no report"),
        (lambda d: d["recording"].update(torque_unit="A"), "torque in A"),
        (lambda d: d["recording"].update(linear=True), "linear axis"),
        (lambda d: d.update(models=[]), "flexible axis"),
    ],
)
def test_reports_that_do_not_fit_are_refused(
    engine: Engine,
    log: Path,
    config: Path,
    report: Callable[..., Path],
    change: Callable[[dict[str, Any]], Any],
    said: str,
) -> None:
    result = diagnose(log, "-c", config, "--report", report(change))
    assert (result.exit_code, result.stdout) == (2, "")
    assert said in result.stderr
    assert "hint:" in result.stderr
    assert not engine.calls


@pytest.mark.parametrize("content", [b"", b"[1]", b"\xff\xfe", b"{", b'{"schema": "flexid-report/1"}'])
def test_files_that_are_no_report_are_refused(
    engine: Engine, log: Path, config: Path, tmp_path: Path, content: bytes
) -> None:
    path = tmp_path / "known.json"
    path.write_bytes(content)
    result = diagnose(log, "-c", config, "--report", path)
    assert result.exit_code == 2
    assert str(path) in result.stderr
    assert "internal error" not in result.stderr


def test_a_log_of_a_simulator_gives_the_parameters(
    engine: Engine, log: Path, config: Path, write_log: WriteLog, columns: Columns
) -> None:
    simulated = write_log(columns, "sim.csv")
    result = diagnose(log, "-c", config, "--simulation", simulated, "--json")
    assert result.exit_code == 0, result.stderr
    own, asked = engine.calls
    roles = {Path(entry["path"]).name: entry["role"] for entry in json.loads(result.stdout)["inputs"]}
    assert roles == {log.name: "recording", "sim.csv": "parameters"}
    estimates = EXAMPLES.CASES["explained"]().parameters_after
    assert own.known is None
    assert asked.known == {e.symbol: e.value for e in estimates if e.value is not None}
    assert "the simulation is not the plain model itself" in result.stderr


def test_a_simulation_and_a_report_are_one_too_many(engine: Engine, log: Path, config: Path) -> None:
    result = diagnose(log, "-c", config, "--simulation", log, "--report", log)
    assert (result.exit_code, result.stdout) == (2, "")
    assert "leave out one of the two" in result.stderr
    assert not engine.calls


def test_damage_of_either_run_is_told(
    engine: Engine, log: Path, config: Path, write_log: WriteLog, columns: Columns
) -> None:
    whole = write_log(columns, "other.csv")
    lines = whole.read_text("utf-8").splitlines()
    lines[1500] = "torn"
    whole.write_text("\n".join(lines) + "\n", encoding="utf-8")
    result = diagnose(log, "-c", config, "--validate", whole)
    assert result.exit_code == 0, result.stderr
    assert "other.csv" in result.stderr
    assert "run.csv" not in result.stderr
    strict = diagnose(log, "-c", config, "--validate", whole, "--strict")
    assert strict.exit_code == 2


def test_one_figure_is_one_figure(
    engine: Engine, log: Path, config: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = replace(EXAMPLES.explained(), maps=())
    monkeypatch.setitem(EXAMPLES.CASES, "explained", lambda: made)
    result = diagnose(log, "-c", config, "-o", tmp_path / "run.md")
    assert "and 1 figure beside" in result.stderr


def test_with_its_own_engine(log: Path, config: Path, tmp_path: Path) -> None:
    text, data = tmp_path / "run.md", tmp_path / "run.json"
    result = diagnose(log, "-c", config, "-o", text, "-o", data)
    assert result.exit_code in (0, 3), result.stderr
    document = json.loads(data.read_text("utf-8"))
    jsonschema.Draft202012Validator(SCHEMA).validate(document)
    assert max(map(len, result.stdout.splitlines())) <= 80
    found = document["diagnosis"]
    tried = {one["name"] for one in found["tested"]}
    assert tried == {effect.name for effect in effects()}
    stiffness = [p for p in found["parameters_after"] if p["symbol"] == "K"]
    assert stiffness[0]["estimate"] == pytest.approx(2400.0, rel=0.02)
    links = re.findall(r"\]\(([^()]*\.svg)\)", text.read_text("utf-8"))
    assert links
    assert all((tmp_path / link).stat().st_size for link in links)
