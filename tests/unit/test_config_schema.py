"""The models as a contract: defaults, derived properties, the committed JSON Schema, the example files."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import pytest
import yaml
from pydantic import ValidationError

from flexid_cli.config.load import load_config, parse_config
from flexid_cli.config.schema import Config, broken_rules, config_schema, nearest_word
from flexid_cli.errors import ConfigError

SIGNALS = {
    "joint_torque": {"source": "tau", "unit": "N.m"},
    "motor_position": {"source": "q", "unit": "rad"},
}
MINIMAL = {"version": 1, "axis": {"name": "a", "gear_ratio": 1}, "signals": SIGNALS}


def with_signal(role: str, **signal: object) -> dict[str, object]:
    return {**MINIMAL, "signals": {**SIGNALS, role: signal}}


def test_defaults_are_those_of_the_contract() -> None:
    resolved = Config.model_validate(MINIMAL).resolved()
    assert resolved["axis"] == {
        "name": "a",
        "gear_ratio": 1.0,
        "torque_constant_side": "motor",
        "gravity_m_per_s2": 9.81,
    }
    assert resolved["signals"]["motor_position"] == {
        "source": "q", "unit": "rad", "scale": 1.0, "offset": 0.0, "sign": 1,
    }  # fmt: skip
    assert resolved["estimate"] == {
        "method": "auto", "route": "direct", "confidence_level": 0.95, "covariance": "hac",
        "essential": False, "replay": 0,
    }  # fmt: skip
    assert resolved["pipeline"] == {}
    assert resolved["csv"] == {}
    assert "models" not in resolved
    json.dumps(resolved, allow_nan=False)


def test_resolved_is_a_configuration_itself() -> None:
    config = Config.model_validate({**MINIMAL, "models": ["rigid"]})
    assert Config.model_validate(config.resolved()) == config


def test_joint_position_is_at_the_joint_unless_told_otherwise() -> None:
    config = Config.model_validate(with_signal("joint_position", source="j", unit="rad"))
    assert config.signals.joint_position is not None
    assert config.signals.joint_position.side == "joint"


def test_torque_role() -> None:
    config = Config.model_validate(MINIMAL)
    assert config.signals.torque_role == "joint_torque"
    assert config.signals.torque.source == "tau"


@pytest.mark.parametrize(
    ("position", "torque_unit", "linear"),
    [
        ({"unit": "deg"}, "N.m", False),
        ({"unit": "um"}, "N", True),
        ({"unit": "count", "counts_per_rev": 4096}, "N.m", False),
        ({"unit": "count", "counts_per_m": 1e6}, "kN", True),
    ],
)
def test_linear(position: dict[str, object], torque_unit: str, linear: bool) -> None:
    signals = {
        "joint_torque": {"source": "tau", "unit": torque_unit},
        "motor_position": {"source": "q", **position},
    }
    assert Config.model_validate({**MINIMAL, "signals": signals}).linear is linear


def test_models_cannot_change() -> None:
    config = Config.model_validate(MINIMAL)
    with pytest.raises(ValidationError):
        config.axis.gear_ratio = 2.0  # type: ignore[misc]


def test_rules_hold_without_a_file_too() -> None:
    with pytest.raises(ValidationError, match="too many"):
        Config.model_validate(with_signal("motor_torque", source="x", unit="N.m"))


@pytest.mark.parametrize(
    "data", [None, [], 3, {"signals": 3}, {"signals": {"time": 4}}, {"models": 3}, {"csv": []}]
)
def test_rules_do_not_stumble(data: object) -> None:
    assert isinstance(list(broken_rules(data)), list)


def test_committed_schema_is_the_generated_one(root: Path) -> None:
    committed = (root / "flexid_cli/schemas/config-1.schema.json").read_text(encoding="utf-8")
    assert json.loads(committed) == config_schema(), (
        "regenerate: flexid schema config > flexid_cli/schemas/config-1.schema.json"
    )


def test_schema_is_valid_and_every_key_is_described() -> None:
    schema = config_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    assert schema["$schema"].endswith("2020-12/schema")
    sections = {"Config": schema, **schema["$defs"]}
    plain = {"axis", "signals", "pipeline", "estimate", "csv"}
    for name, section in sections.items():
        assert section["additionalProperties"] is False
        for key, node in section["properties"].items():
            assert "description" in node or key in plain, f"{name}.{key}"


CONFIGS = sorted((Path(__file__).resolve().parents[2] / "configs").glob("*.yaml"))


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_example_files(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    modeline = text.splitlines()[0]
    assert modeline.startswith("# yaml-language-server: $schema=")
    assert (path.parent / modeline.split("=", 1)[1]).is_file()
    load_config(path)
    jsonschema.validate(yaml.safe_load(text), config_schema())
    assert max(len(line) for line in text.splitlines()) <= 110


def test_there_are_examples() -> None:
    assert {"axis3", "minimal", "csv_current", "mcap_joint_states"} <= {path.stem for path in CONFIGS}


@pytest.mark.parametrize(
    "change", [{"version": 2}, {"foo": 1}, {"signals": {"motor_position": SIGNALS["motor_position"]}}]
)
def test_schema_refuses_what_the_loader_refuses(change: dict[str, object]) -> None:
    data = {**MINIMAL, **change}
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(data, config_schema())
    with pytest.raises(ConfigError):
        parse_config(json.dumps(data))


def test_json_is_a_configuration() -> None:
    assert parse_config(json.dumps(MINIMAL)) == Config.model_validate(MINIMAL)


def test_nearest_word() -> None:
    assert nearest_word("Gear_Ratio", ["name", "gear_ratio"]) == "gear_ratio"
    assert nearest_word("xyz", ["name", "gear_ratio"]) == ""
