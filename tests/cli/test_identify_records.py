"""``flexid identify a.mcap b.mcap c.mcap``: records of one axis fitted together, as the user meets it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jsonschema
import numpy as np
import pytest
from click.testing import CliRunner, Result

from flexid_cli.cli.main import main
from flexid_cli.simulate.axis import Controller, Sensors, chirp, simulate
from flexid_cli.writers.csv import write_csv
from flexid_cli.writers.mcap import write_mcap
from flexid_cli.writers.rosbag1 import write_rosbag1
from flexid_cli.writers.table import LogTable

if TYPE_CHECKING:
    from flexid_cli.simulate.axis import Axis

ROOT = Path(__file__).resolve().parents[2]
RATE_HZ = 200.0
START_NS = 10**18
APART_NS = 10**11
PAYLOADS = {"empty": (4.7, -0.5, -5.0), "half": (6.0, -0.2, -7.0), "full": (8.0, 0.3, -9.0)}
CONFIG = """\
version: 1
axis: {name: wrist, gear_ratio: 50, torque_constant_nm_per_a: 0.35}
signals:
  motor_current:      {source: /axis/current, unit: A, hold: sample}
  motor_position:     {source: /axis/motor, unit: rad, side: motor}
  joint_position:     {source: /axis/joint, unit: rad}
models: [two_encoders]
"""
OWN = ("--set", "estimate.per_record=[load_inertia, MX, MY]")


def identify(*arguments: str | Path, **options: Any) -> Result:
    return CliRunner().invoke(main, ["identify", *map(str, arguments)], **options)


@pytest.fixture(scope="session")
def tables(short_axis: Axis) -> dict[str, LogTable]:
    """Three records of 20 s with other payloads, a hundred seconds apart."""
    made = {}
    for k, (name, (JL, MX, MY)) in enumerate(PAYLOADS.items()):
        run = simulate(
            replace(short_axis, JL=JL, MX=MX, MY=MY),
            Controller(kp=8.0, kv=300.0, ki=800.0, velocity_feedforward=0.0),
            0.08 * chirp(0.1, 15.0, 20.0, RATE_HZ),
            RATE_HZ,
            sensors=Sensors(motor_resolution=2e-6, joint_resolution=1e-5, torque_noise=0.2),
            seed=k,
            substeps=8,
        )
        made[name] = LogTable(
            START_NS + k * APART_NS + np.rint(run.time_s * 1e9).astype(np.int64),
            {
                "/axis/current": run.torque / 50.0 / 0.35,
                "/axis/motor": 50.0 * run.motor_position,
                "/axis/joint": run.joint_position,
            },
        )
    return made


def part(table: LogTable, which: slice, without: str = "") -> LogTable:
    channels = {name: values[which] for name, values in table.channels.items() if name != without}
    return LogTable(table.stamps_ns[which], channels)


@pytest.fixture(scope="session")
def folder(tables: dict[str, LogTable], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The records as MCAP files, pieces of the first, short ones, one without its joint encoder, a config."""
    folder = tmp_path_factory.mktemp("records")
    (folder / "axis.yaml").write_text(CONFIG, encoding="utf-8")
    for name, table in tables.items():
        write_mcap(folder / f"{name}.mcap", table)
    first = tables["empty"]
    write_mcap(folder / "empty_0.mcap", part(first, slice(0, 1777)))
    write_mcap(folder / "empty_1.mcap", part(first, slice(1777, None)))
    later = LogTable(first.stamps_ns + 10 * APART_NS, first.channels)
    write_mcap(folder / "short.mcap", part(later, slice(0, 20)))
    write_mcap(folder / "stub.mcap", part(later, slice(0, 150)))
    write_mcap(folder / "blind.mcap", part(later, slice(None), without="/axis/joint"))
    return folder


Run = Callable[..., Result]


@pytest.fixture
def run(folder: Path) -> Run:
    def run(*names: str, options: tuple[str | Path, ...] = (), **more: Any) -> Result:
        return identify(*(folder / name for name in names), "-c", folder / "axis.yaml", *options, **more)

    return run


THREE = ("empty.mcap", "half.mcap", "full.mcap")


def parameters(document: dict[str, Any]) -> dict[str, dict[str, Any]]:
    [model] = document["models"]
    return {p["symbol"]: p for p in model["parameters"]}


def holds(parameter: dict[str, Any], truth: float) -> bool:
    return bool(parameter["ci"]["low"] <= truth <= parameter["ci"]["high"])


def test_records_with_payloads_of_their_own(run: Run, folder: Path, tmp_path: Path, short_axis: Axis) -> None:
    files = ["-o", tmp_path / "r.json", "-o", tmp_path / "r.md", "--set", "estimate.confidence_level=0.99"]
    result = run(*THREE, options=(*OWN, *files), env={"COLUMNS": "80"})
    assert result.exit_code == 0, result.output
    assert result.stderr.splitlines()[0] == (
        "3 records of one axis, fitted together: empty, half, full (--records one: files of one run)"
    )
    document = json.loads((tmp_path / "r.json").read_text(encoding="utf-8"))
    schema = json.loads((ROOT / "flexid_cli/schemas/report-1.schema.json").read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator(schema).validate(document)
    found = parameters(document)
    for symbol in ("Jm", "K", "FVm", "FSm", "FV", "FS"):
        assert holds(found[symbol], getattr(short_axis, symbol)), symbol
    for name, truth in PAYLOADS.items():
        for symbol, value in zip(("JL", "MX", "MY"), truth, strict=True):
            assert holds(found[f"{symbol}[{name}]"], value), (symbol, name)
        assert found[f"JL[{name}]"]["name"] == "load_inertia"
    _check_document(document)
    _check_text(result.stdout, (tmp_path / "r.md").read_text(encoding="utf-8"))


def _check_document(document: dict[str, Any]) -> None:
    [model] = document["models"]
    assert model["method"] == "joint fit of 3 records"
    assert [record["name"] for record in model["records"]] == list(PAYLOADS)
    assert [record["inputs"] for record in model["records"]] == [[0], [1], [2]]
    assert [entry["record"] for entry in document["inputs"]] == list(PAYLOADS)
    assert all(record["used"] for record in model["records"])
    for record, truth in zip(model["records"], PAYLOADS.values(), strict=True):
        [own] = [p for p in record["parameters"] if p["symbol"] == "JL"]
        assert own["estimate"] == pytest.approx(truth[0], rel=0.01)
    assert [entry["samples"] for entry in document["inputs"]] == [4000] * 3
    assert sum(record["samples"] for record in model["records"]) == document["recording"]["samples"]
    assert document["config"]["resolved"]["estimate"]["per_record"] == ["JL", "MX", "MY"]
    assert model["tests"]["consistency"]["restrictions"] == 12


def _check_text(shown: str, markdown: str) -> None:
    assert max(map(len, shown.splitlines())) <= 80
    [row] = [line for line in shown.splitlines() if line.startswith("K ") and "±" in line]
    assert row.count("±") == 4
    [row] = [line for line in shown.splitlines() if line.startswith("JL ") and "its own" in line]
    assert row.count("±") == 3
    [row] = [line for line in markdown.splitlines() if line.startswith("| K |") and "±" in line]
    assert row.count("±") == 4
    assert "| Symbol | Together | empty | half | full |" in markdown
    assert "joint fit of 3 records" in markdown


def test_the_same_axis_in_any_order_and_container(
    run: Run, folder: Path, tmp_path: Path, tables: dict[str, LogTable]
) -> None:
    write_csv(tmp_path / "half.csv", tables["half"])
    write_rosbag1(tmp_path / "full.bag", tables["full"])
    one = json.loads(run(*THREE, options=(*OWN, "--json")).stdout)
    logs = [tmp_path / "full.bag", tmp_path / "half.csv", folder / "empty.mcap"]
    other = json.loads(identify(*logs, "-c", folder / "axis.yaml", *OWN, "--json").stdout)
    found, again = parameters(one), parameters(other)
    assert set(found) == set(again)
    for symbol, parameter in found.items():
        assert again[symbol]["estimate"] == pytest.approx(
            parameter["estimate"], abs=0.01 * parameter["stderr"]
        )
        assert again[symbol]["stderr"] == pytest.approx(parameter["stderr"], rel=0.01)


def test_a_split_bag_is_still_one_run(run: Run) -> None:
    whole = json.loads(run("empty.mcap", options=("--json",)).stdout)
    result = run("empty_0.mcap", "empty_1.mcap", options=("--json",))
    assert result.stderr == (
        "2 files taken as one run, for their stamps continue each other (--records each: records of their own)\n"
    )
    split = json.loads(result.stdout)
    assert split["models"] == whole["models"]
    assert "record" not in split["inputs"][0]
    assert run("empty_0.mcap", "empty_1.mcap", options=("--json", "-q")).stderr == ""


def test_a_payload_that_was_not_declared(run: Run) -> None:
    result = run("empty.mcap", "full.mcap", options=("--json",))
    assert result.exit_code == 0
    document = json.loads(result.stdout)
    found = parameters(document)
    assert found["JL"]["verdict"] != "identified"
    assert "the two records contradict each other in JL" in found["JL"]["reason"]
    assert any("name it in estimate.per_record" in text for text in document["models"][0]["warnings"])


def test_a_record_that_is_too_short_is_left_out(run: Run) -> None:
    result = run("empty.mcap", "half.mcap", "short.mcap", "stub.mcap", options=(*OWN, "--json"))
    assert result.exit_code == 0
    document = json.loads(result.stdout)
    assert "warning: record short was left out: " in result.stderr
    assert any(text.startswith("record short was left out: ") for text in document["warnings"])
    [model] = document["models"]
    assert model["method"] == "joint fit of 2 records"
    assert [record["used"] for record in model["records"]] == [True, True, False]
    assert model["records"][2]["name"] == "stub"
    assert any("record stub was left out: " in text for text in model["warnings"])
    assert [entry["record"] for entry in document["inputs"]] == ["empty", "half", "stub"]


def test_one_record_that_remains_is_solved_alone(run: Run) -> None:
    result = run("empty.mcap", "short.mcap", options=("--json",))
    document = json.loads(result.stdout)
    assert document["models"][0]["method"] == "structured"
    assert "records" not in document["models"][0]
    assert any(text.startswith("record short was left out: ") for text in document["warnings"])


def test_a_record_with_the_wrong_signals(run: Run) -> None:
    forced = run("empty.mcap", "blind.mcap", options=("--records", "each"))
    assert forced.exit_code == 2
    assert "blind.mcap" in forced.stderr
    assert "joint" in forced.stderr
    guessed = run("empty.mcap", "half.mcap", "blind.mcap", options=(*OWN, "--json"))
    assert "blind.mcap was taken for a further file of the run of half.mcap" in guessed.stderr


@pytest.mark.parametrize(
    ("value", "told"),
    [
        ("[JL, MZ]", "per_record[1] must be one of JL, MX, MY, offset"),
        ("[K]", "per_record[0] must be one of JL"),
        ("[JL, load_inertia]", "JL is listed twice"),
        ("JL", "per_record must be a list"),
    ],
)
def test_what_cannot_differ_between_records(value: str, told: str, run: Run) -> None:
    result = run("empty.mcap", "half.mcap", options=("--set", f"estimate.per_record={value}"))
    assert result.exit_code == 2
    assert told in result.stderr


@pytest.mark.parametrize(
    ("option", "told"),
    [
        (("--route", "paper"), "route paper"),
        (("--essential",), "essential"),
        (("--with", "backlash"), "effects"),
    ],
)
def test_what_is_for_one_record(option: tuple[str, ...], told: str, run: Run) -> None:
    result = run("empty.mcap", "half.mcap", options=option)
    assert result.exit_code == 2
    assert told in result.stderr
    assert "--records one" in result.stderr
