"""``flexid identify --with``: named effects join the models, and what cannot join is said."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jsonschema
import pytest
from click.testing import CliRunner, Result

from flexid_cli.cli.identify import identify as command
from flexid_cli.cli.main import main
from flexid_cli.simulate.parameters import from_report

if TYPE_CHECKING:
    from flexid_cli.simulate.axis import Axis

ROOT = Path(__file__).resolve().parents[2]
BOTH = ("--set", "models=[two_encoders]")
ALONE = ("--set", "models=[motor_only]")


def identify(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, ["identify", *map(str, arguments)])


def model(result: Result) -> dict[str, Any]:
    document = json.loads(result.stdout)
    schema = json.loads((ROOT / "flexid_cli/schemas/report-1.schema.json").read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator(schema).validate(document)
    [found] = document["models"]
    return dict(found)


def by_symbol(parameters: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    return {p["symbol"]: p for p in parameters}


def test_the_report_has_the_model_with_and_without(log: Path, config: Path, short_axis: Axis) -> None:
    """Nothing is hidden in the record: the asymmetry is none, and the axis is found with it and without."""
    found = model(identify(log, "-c", config, *BOTH, "--with", "viscous-asymmetry", "--json"))
    assert "viscous_asymmetry" in found["method"]
    assert found["added_terms"] == ["viscous_asymmetry"]
    [effect] = found["effects"]
    assert (effect["name"], effect["code"]) == ("viscous_asymmetry", "FX102")
    [asymmetry] = effect["parameters"]
    assert asymmetry["verdict"] != "identified"
    assert abs(asymmetry["estimate"]) < 0.01 * short_axis.FVm
    after, before = by_symbol(found["parameters"]), by_symbol(found["parameters_before"])
    for symbol in ("Jm", "K", "JL"):
        for estimate in (after[symbol], before[symbol]):
            assert estimate["ci"]["low"] <= getattr(short_axis, symbol) <= estimate["ci"]["high"]
    assert found["fit"]["fit_percent"] > 99.0
    resonance = by_symbol(found["derived"])["f1"]
    truth = math.sqrt(short_axis.K * (1.0 / short_axis.Jm + 1.0 / short_axis.JL)) / (2.0 * math.pi)
    assert resonance["ci"]["low"] <= truth <= resonance["ci"]["high"]
    assert found["equation"].endswith(f"viscous_asymmetry: {effect['term']}")


def test_the_configuration_names_them_as_well(log: Path, config: Path) -> None:
    named = model(
        identify(log, "-c", config, *BOTH, "--with", "FX102,viscous_asymmetry", "--with", "FX101", "--json")
    )
    config.write_text(
        config.read_text() + "estimate: {with: [viscous_asymmetry, torque_offset]}\nmodels: [two_encoders]\n"
    )
    assert model(identify(log, "-c", config, "--json")) == named
    assert [e["name"] for e in named["effects"]] == ["viscous_asymmetry", "torque_offset"]


def test_the_motor_alone_keeps_gravity_and_offset(log: Path, config: Path, short_axis: Axis) -> None:
    found = model(identify(log, "-c", config, *ALONE, "--with", "viscous_asymmetry,gravity", "--json"))
    assert found["added_terms"] == ["torque_offset", "gravity", "viscous_asymmetry"]
    assert [e["name"] for e in found["effects"]] == ["viscous_asymmetry"]
    assert {"offset", "MX", "MY"} <= by_symbol(found["parameters"]).keys()
    assert any("gravity is part of the model" in w for w in found["warnings"])
    friction = by_symbol(found["derived"])["FVm + FV"]
    assert friction["estimate"] == pytest.approx(short_axis.FVm + short_axis.FV, rel=0.02)
    stiffness = by_symbol(found["parameters"])["K"]
    assert stiffness["ci"]["low"] <= short_axis.K <= stiffness["ci"]["high"]


def test_what_could_not_join_says_why(log: Path, config: Path) -> None:
    """The record's torque is never limited: an effect that is not active."""
    found = model(identify(log, "-c", config, *BOTH, "--with", "backlash,torque_saturation", "--json"))
    for effect in found["effects"]:
        assert {p["verdict"] for p in effect["parameters"]} == {"not_identifiable"}
        assert all(p["reason"] for p in effect["parameters"])
    assert by_symbol(found["parameters"])["K"]["verdict"] == "identified"


def test_renderings_show_the_effect(log: Path, config: Path, tmp_path: Path) -> None:
    markdown = tmp_path / "report.md"
    result = identify(log, "-c", config, *BOTH, "--with", "viscous_asymmetry", "-o", markdown)
    assert result.exit_code == 0, result.output
    for text in (result.stdout, markdown.read_text(encoding="utf-8")):
        assert "viscous_asymmetry (FX102" in text
        assert "without these effects" in text


def test_a_report_with_effects_can_be_simulated(log: Path, config: Path, tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    result = identify(log, "-c", config, *BOTH, "--with", "torque_offset", "-o", report, "-q")
    assert result.exit_code == 0, result.output
    [effect] = from_report(report).effects
    assert effect.name == "torque_offset"
    assert set(effect.values) == {"torque_offset"}


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ("backlsh", "did you mean backlash?"),
        ("joint_damping,nonsense", "`flexid effects` lists them"),
        (",", "--with names no effect"),
    ],
)
def test_unknown_names(names: str, message: str, log: Path, config: Path) -> None:
    result = identify(log, "-c", config, "--with", names)
    assert (result.exit_code, result.stdout) == (2, "")
    assert message in result.stderr


def test_an_unknown_name_in_the_configuration_has_its_place(log: Path, config: Path) -> None:
    config.write_text(config.read_text() + "estimate:\n  with: [backlash, backlsh]\n")
    result = identify(log, "-c", config)
    assert result.exit_code == 2
    assert f"{config}:10:20" in result.stderr
    assert "did you mean backlash" in result.stderr


def test_an_effect_that_the_signals_do_not_allow(log: Path, config: Path) -> None:
    result = identify(log, "-c", config, *ALONE, "--with", "clock_skew")
    assert (result.exit_code, result.stdout) == (2, "")
    assert "clock_skew cannot be seen without a joint encoder" in result.stderr


@pytest.mark.parametrize("option", [("--route", "paper"), ("--set", "estimate.method=iv")])
def test_estimators_that_hold_no_effects(option: tuple[str, str], log: Path, config: Path) -> None:
    result = identify(log, "-c", config, *option, "--with", "backlash")
    assert result.exit_code == 2
    assert "leave out" in result.stderr


def test_the_last_of_several_names_is_completed() -> None:
    [option] = [p for p in command.params if p.name == "effects"]
    with command.make_context("identify", ["log", "-c", "config"]) as context:
        found = option.shell_complete(context, "backlash,stribeck_m")
    assert [item.value for item in found] == ["backlash,stribeck_motor"]
