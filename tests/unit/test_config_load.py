"""Every way in which a configuration can be wrong: place, line and cure, all at once, no traceback."""

# ruff: noqa: E501 - one row per mistake

from __future__ import annotations

import io
import sys
from pathlib import Path

import pytest

from flexid_cli.config.load import config_digest, load_config, load_located, parse_config
from flexid_cli.errors import ConfigError, InputError, Problem

GOOD = """\
version: 1
axis:
  name: axis3
  gear_ratio: 50
  torque_constant_nm_per_a: 0.3475
signals:
  time: {source: time, unit: s}
  motor_current: {source: current, unit: A}
  motor_position: {source: motor, unit: rad, side: motor}
  joint_position: {source: joint, unit: rad}
controller: {kp: 1.6, kv: 2.7, ki: 2.2}
models: [two_encoders, motor_only]
"""
KT = "  torque_constant_nm_per_a: 0.3475\n"
CURRENT = "  motor_current: {source: current, unit: A}"
MOTOR = "  motor_position: {source: motor, unit: rad, side: motor}"
JOINT = "  joint_position: {source: joint, unit: rad}"
CONTROLLER = "controller: {kp: 1.6, kv: 2.7, ki: 2.2}"
MODELS = "models: [two_encoders, motor_only]"

# name: (what is replaced, by what, path, what the caret points at, part of the message, part of the hint)
WRONG: dict[str, tuple[str, str, str, str, str, str]] = {
    "unknown key": ("version: 1", "version: 1\nfoo: 2", "foo", "foo", "unknown key 'foo'", "permitted here: version, axis"),
    "misspelt key": ("  gear_ratio:", "  gear_ration:", "axis.gear_ration", "gear_ration", "unknown key", "did you mean gear_ratio?"),
    "misspelt section": ("signals:", "signal:", "signal", "signal", "unknown key", "did you mean signals?"),
    "misspelt role": ("  motor_current", "  motor_curent", "signals.motor_curent", "motor_curent", "unknown key", "did you mean motor_current?"),
    "misspelt in braces": ("source: motor,", "sourc: motor,", "signals.motor_position.sourc", "sourc", "unknown key", "did you mean source?"),
    "no space after colon": ("source: motor,", "source:motor,", "signals.motor_position.source:motor", "source:motor", "no value", "source: motor"),
    "key of another section": (CONTROLLER, "f1_hz: 3.9", "f1_hz", "f1_hz", "unknown key", "belongs under axis"),
    "duplicate key": (KT, KT + "  gear_ratio: 50\n", "axis.gear_ratio", "gear_ratio: 50\nsig", "second time", "line 4"),
    "duplicate in braces": ("unit: A}", "unit: A, unit: mA}", "signals.motor_current.unit", "unit: mA", "second time", "line 8"),
    "missing key": ("  gear_ratio: 50\n", "", "axis.gear_ratio", "axis:", "gear_ratio is missing", "motor angle / joint angle"),
    "missing in braces": ("source: motor, ", "", "signals.motor_position.source", "motor_position", "source is missing", "column"),
    "missing version": ("version: 1\n", "", "version", "axis:", "version is missing", "version: 1"),
    "missing axis": (GOOD[11:GOOD.index("signals:")], "", "axis", "version", "axis is missing", "name, gear_ratio"),
    "missing motor_position": (MOTOR + "\n", "", "signals.motor_position", "signals:", "motor_position is missing", "Encoder at the motor"),
    "unknown version": ("version: 1", "version: 2", "version", "2", "version 2", "version: 1"),
    "version as text": ("version: 1", "version: '1'", "version", "'1'", "must be 1", ""),
    "version true": ("version: 1", "version: true", "version", "true", "but is true", ""),
    "unknown unit": ("unit: A}", "unit: Ampere}", "signals.motor_current.unit", "Ampere", "unknown unit 'Ampere'", "permitted here: A, mA, V, mV"),
    "unit in wrong case": ("motor, unit: rad", "motor, unit: Rad", "signals.motor_position.unit", "Rad", "unknown unit", "did you mean rad?"),
    "unit of the wrong dimension": ("unit: A}", "unit: rad}", "signals.motor_current.unit", "rad}", "cannot be in rad", "permitted here: A"),
    "torque unit for current": ("unit: A}", "unit: Nm}", "signals.motor_current.unit", "Nm", "cannot be in N.m", "A, mA"),
    "current unit for torque": (CURRENT, "  motor_torque: {source: current, unit: A}", "signals.motor_torque.unit", "A}", "cannot be in A", "N.m, mN.m"),
    "current unit for position": ("motor, unit: rad", "motor, unit: mA", "signals.motor_position.unit", "mA", "cannot be in mA", "rad"),
    "time in rad": ("time, unit: s", "time, unit: rad", "signals.time.unit", "rad", "cannot be in rad", "s, ms, us, ns"),
    "no unit": ("current, unit: A", "current", "signals.motor_current.unit", "motor_current", "unit is missing", "Unit"),
    "A without constant": (KT, "", "signals.motor_current", "{source: current", "torque_constant_nm_per_a is missing", "`unknown`"),
    "two torques": (CURRENT, CURRENT + "\n  joint_torque: {source: tau, unit: N.m}", "signals.joint_torque", "{source: tau", "too many", "exactly one of motor_current"),
    "no torque": (CURRENT + "\n", "", "signals", "signals:", "no signal says what drives", "exactly one of"),
    "side missing": ("unit: rad, side: motor", "unit: rad", "signals.motor_position", "{source: motor,", "side", "side: motor"),
    "bad side": ("side: motor", "side: moter", "signals.motor_position.side", "moter", "one of motor, joint", "did you mean motor?"),
    "gear 0": ("gear_ratio: 50", "gear_ratio: 0", "axis.gear_ratio", "0\n", "greater than 0, but is 0", "sign: -1"),
    "gear negative": ("gear_ratio: 50", "gear_ratio: -50", "axis.gear_ratio", "-50", "greater than 0, but is -50", "sign: -1"),
    "gear true": ("gear_ratio: 50", "gear_ratio: true", "axis.gear_ratio", "true", "must be a number, but is true", ""),
    "gear as ratio": ("gear_ratio: 50", "gear_ratio: 50:1", "axis.gear_ratio", "50:1", "the text '50:1'", "number alone: 50"),
    "text for number": ("gear_ratio: 50", "gear_ratio: fifty", "axis.gear_ratio", "fifty", "must be a number, but is the text 'fifty'", ""),
    "quoted number": ("gear_ratio: 50", "gear_ratio: '50'", "axis.gear_ratio", "'50'", "the text '50'", "remove the quotes: 50"),
    "decimal comma": ("0.3475", "0,3475", "axis.torque_constant_nm_per_a", "0,3475", "must be a number or unknown", "0.3475"),
    "number with unit": ("0.3475", "0.3475 Nm/A", "axis.torque_constant_nm_per_a", "0.3475 Nm", "must be a number or unknown", "alone: 0.3475"),
    "underscore": ("gear_ratio: 50", "gear_ratio: 1_000", "axis.gear_ratio", "1_000", "must be a number", "1000"),
    "constant misspelt unknown": ("0.3475", "unkown", "axis.torque_constant_nm_per_a", "unkown", "or unknown", "did you mean unknown?"),
    "constant negative": ("0.3475", "-0.3", "axis.torque_constant_nm_per_a", "-0.3", "greater than 0", ""),
    "no is not False": ("source: joint, unit: rad", "source: joint, unit: rad, unwrap: no", "signals.joint_position.unwrap", "no}", "true or false, but is the text 'no'", "write true or false"),
    "nan": ("gear_ratio: 50", "gear_ratio: .nan", "axis.gear_ratio", ".nan", "but is nan", ""),
    "inf": ("gear_ratio: 50", "gear_ratio: .inf", "axis.gear_ratio", ".inf", "finite number, but is inf", ""),
    "inf by overflow": ("gear_ratio: 50", "gear_ratio: 1e999", "axis.gear_ratio", "1e999", "finite number, but is inf", ""),
    "scale 0": ("unit: A}", "unit: A, scale: 0}", "signals.motor_current.scale", "0}", "scale is 0", "leave it out"),
    "sign 2": ("unit: A}", "unit: A, sign: 2}", "signals.motor_current.sign", "2}", "one of 1, -1", ""),
    "sign true": ("unit: A}", "unit: A, sign: true}", "signals.motor_current.sign", "true", "but is true", ""),
    "column 0": ("source: current", "source: 0", "signals.motor_current.source", "0,", "at least 1", ""),
    "source is a float": ("source: current", "source: 1.5", "signals.motor_current.source", "1.5", "but is 1.5", "quotes"),
    "empty source": ("source: current", "source: ''", "signals.motor_current.source", "''", "not empty", ""),
    "same source twice": ("source: joint,", "source: motor,", "signals.joint_position.source", "motor, unit: rad}", "same source as motor_position", "leave out"),
    "name is a number": ("name: axis3", "name: 3", "axis.name", "3\n", "must be text, but is 3", "quotes"),
    "null for a number": ("gear_ratio: 50", "gear_ratio: null", "axis.gear_ratio", "null", "must be a number, but is null", ""),
    "no value": ("gear_ratio: 50", "gear_ratio:", "axis.gear_ratio", "gear_ratio", "no value", "null"),
    "signal is text": ("{source: joint, unit: rad}", "joint", "signals.joint_position", "joint\n", "group of keys", "{source: joint, unit: rad}"),
    "axis is a list": ("axis:\n  name: axis3\n  gear_ratio: 50\n" + KT, "axis: [axis3]\n", "axis", "[axis3]", "group of keys, but is a list", "name, gear_ratio"),
    "model unknown": ("motor_only]", "motor_onli]", "models[1]", "motor_onli", "one of two_encoders, motor_only, rigid", "did you mean motor_only?"),
    "models not a list": (MODELS, "models: rigid", "models", "rigid", "must be a list", "[rigid]"),
    "models empty": (MODELS, "models: []", "models", "[]", "not empty", ""),
    "model twice": ("motor_only]", "two_encoders]", "models[1]", "two_encoders]", "listed twice", "remove"),
    "model without its encoder": (JOINT + "\n", "", "models[0]", "two_encoders", "needs joint_position", "motor_only"),
    "bad enum": (MODELS, "estimate: {method: structurd}", "estimate.method", "structurd", "one of auto, ols, wls, irls, iv, structured, minimum_distance, output_error", "did you mean structured?"),
    "percent": (MODELS, "estimate: {confidence_level: 95}", "estimate.confidence_level", "95", "less than 1", "0.95 for 95 %"),
    "linear joint, rotary motor": ("joint, unit: rad", "joint, unit: mm", "signals.joint_position.unit", "mm", "in mm (linear)", "rad, mrad"),
    "force on a rotary axis": (CURRENT, "  joint_torque: {source: f, unit: N}", "signals.joint_torque.unit", "N}", "in N (linear)", "N.m"),
    "torque on a linear axis": (CURRENT + "\n" + MOTOR + "\n" + JOINT, "  joint_torque: {source: f, unit: N.m}\n  motor_position: {source: x, unit: m, side: joint}\n  joint_position: {source: y, unit: m}", "signals.joint_torque.unit", "N.m}", "makes this a linear axis", "N, mN, kN"),
    "count without counts_per_rev": ("motor, unit: rad", "motor, unit: count", "signals.motor_position", "{source: motor", "counts_per_rev is missing", "counts_per_m"),
    "counts_per_rev without count": ("motor, unit: rad", "motor, unit: rad, counts_per_rev: 4096", "signals.motor_position.counts_per_rev", "4096", "means nothing", "unit as count"),
    "both counts": ("motor, unit: rad", "motor, unit: count, counts_per_rev: 4096, counts_per_m: 1", "signals.motor_position.counts_per_m", "1,", "exclude each other", "keep"),
    "V without torque_per_volt": ("unit: A}", "unit: V}", "signals.motor_current", "{source: current", "torque_per_volt is missing", "per volt"),
    "torque_per_volt without V": ("unit: A}", "unit: A, torque_per_volt: 2}", "signals.motor_current.torque_per_volt", "2}", "means nothing", "unit as V"),
    "controller without kv": ("kv: 2.7, ", "", "controller", "{kp", "controller.kv is missing", "law: external"),
    "rate and time column": ("time, unit: s", "time, rate_hz: 100", "signals.time.rate_hz", "100", "exclude each other", "keep one"),
    "filter order 0": (MODELS, "pipeline: {lowpass: {order: 0, cutoff_hz: 5}}", "pipeline.lowpass.order", "0,", "at least 1", ""),
    "filter order 4.0": (MODELS, "pipeline: {lowpass: {order: 4.0, cutoff_hz: 5}}", "pipeline.lowpass.order", "4.0", "whole number", "write 4"),
    "filter without cutoff": (MODELS, "pipeline: {lowpass: {order: 4}}", "pipeline.lowpass.cutoff_hz", "lowpass", "cutoff_hz is missing", "-3 dB"),
    "decimation huge": (MODELS, f"pipeline: {{decimation: 1{'0' * 30}}}", "pipeline.decimation", "1000", "at most 100000, but is a number of 31 digits", ""),
    "pipeline is null": (MODELS, "pipeline: null", "pipeline", "null", "group of keys, but is null", ""),
    "delimiter is the decimal sign": (MODELS, 'csv: {delimiter: ",", decimal: ","}', "csv.decimal", '","}', "both ','", "semicolons"),
    "unknown encoding": (MODELS, "csv: {encoding: utf-9}", "csv.encoding", "utf-9", "unknown encoding", "latin-1"),
}  # fmt: skip


def problems_of(text: str, *overrides: str) -> tuple[Problem, ...]:
    with pytest.raises(ConfigError) as caught:
        parse_config(text, "axis.yaml", overrides)
    assert caught.value.exit_code == 2
    return caught.value.problems


@pytest.mark.parametrize("case", WRONG)
def test_one_mistake_gives_one_problem_at_its_place(case: str) -> None:
    old, new, path, at, message, hint = WRONG[case]
    assert GOOD.count(old) >= 1
    text = GOOD.replace(old, new, 1)
    problems = problems_of(text)
    assert [problem.path for problem in problems] == [path]
    problem = problems[0]
    lines = text.split("\n")
    pointed_at = "\n".join([lines[problem.line - 1][problem.column - 1 :], *lines[problem.line :]])
    assert pointed_at.startswith(at)
    assert problem.source_line == text.split("\n")[problem.line - 1]
    assert message in problem.message
    assert hint in problem.hint
    shown = str(ConfigError("axis.yaml", [problem]))
    assert shown.startswith(f"axis.yaml:{problem.line}:{problem.column}: ")
    assert problem.source_line in shown
    assert not any(word in shown for word in ("pydantic", "Traceback", "Input should", "Literal"))


def test_there_are_more_than_thirty_rows() -> None:
    assert len(WRONG) >= 30


ACCEPTED = {
    "1e4 is a number": ("gear_ratio: 50", "gear_ratio: 1e4", ("axis", "gear_ratio"), 10000.0),
    "no stays text": ("name: axis3", "name: no", ("axis", "name"), "no"),
    "whole number for a float": ("gear_ratio: 50", "gear_ratio: 50", ("axis", "gear_ratio"), 50.0),
    "octal": ("source: current", "source: 0o2", ("signals", "motor_current", "source"), 2),
    "unknown constant": ("0.3475", "unknown", ("axis", "torque_constant_nm_per_a"), "unknown"),
    "spelling of a unit": ("motor, unit: rad", "motor, unit: degrees", ("signals", "motor_position", "unit"), "deg"),
    "quoted brackets": ("source: motor,", 'source: "/j.p[2]",', ("signals", "motor_position", "source"), "/j.p[2]"),
    "sign": ("unit: A}", "unit: A, sign: -1}", ("signals", "motor_current", "sign"), -1),
    "side with gear 1": ("gear_ratio: 50", "gear_ratio: 1", ("axis", "gear_ratio"), 1.0),
}  # fmt: skip


@pytest.mark.parametrize("case", ACCEPTED)
def test_accepted(case: str) -> None:
    old, new, path, value = ACCEPTED[case]
    node: object = parse_config(GOOD.replace(old, new, 1)).resolved()
    for step in path:
        assert isinstance(node, dict)
        node = node[step]
    assert node == value
    assert type(node) is type(value)


def test_side_is_not_needed_without_a_gear() -> None:
    text = GOOD.replace("gear_ratio: 50", "gear_ratio: 1").replace(", side: motor", "")
    assert parse_config(text).signals.motor_position.side is None


def test_volts_need_no_torque_constant() -> None:
    text = GOOD.replace(KT, "").replace("unit: A}", "unit: V, torque_per_volt: 2}")
    assert parse_config(text).signals.torque.torque_per_volt == 2.0


SIX = """\
version: 1
axis:
  name: axis3
  gear_ration: 50
  f1_hz: fast
signals:
  motor_current: {source: current, unit: A, unit: mA}
  motor_position: {source: motor, unit: volt, side: motor}
estimate: {method: best}
"""


def test_all_mistakes_are_reported_in_the_order_of_lines() -> None:
    problems = problems_of(SIX)
    assert [(p.line, p.column, p.path) for p in problems] == [
        (4, 3, "axis.gear_ration"),
        (5, 10, "axis.f1_hz"),
        (7, 18, "signals.motor_current"),
        (7, 45, "signals.motor_current.unit"),
        (8, 41, "signals.motor_position.unit"),
        (9, 20, "estimate.method"),
    ]
    text = str(ConfigError("axis.yaml", list(problems)))
    assert text.count("axis.yaml:") == 6
    for line in text.splitlines():
        if line.startswith(" 5 | "):
            caret = text.splitlines()[text.splitlines().index(line) + 1]
            assert caret.index("^") == line.index("fast")


WHOLE = {
    "empty": ("", "empty", "inspect"),
    "comments only": ("# nothing\n", "empty", "inspect"),
    "null": ("null\n", "empty", "inspect"),
    "list at the top": ("- 1\n- 2\n", "this is a list", "log itself"),
    "a CSV file": ("time,current,motor\n0,1,2\n0.1,2,3\n", "this is text", "log itself"),
    "tab": ("version: 1\naxis:\n\tname: a\n", "tab", "spaces"),
    "brackets": ("a: {source: /topic/effort[2]}\n", "cannot stand unquoted", "quotes"),
    "two documents": (GOOD + "---\n" + GOOD, "second document", "---"),
}


@pytest.mark.parametrize("case", WHOLE)
def test_wrong_as_a_whole(case: str) -> None:
    text, message, hint = WHOLE[case]
    problems = problems_of(text)
    assert len(problems) == 1
    assert message in problems[0].message
    assert hint in problems[0].hint


def test_bytes_that_are_no_text(tmp_path: Path) -> None:
    file = tmp_path / "axis.yaml"
    for data, message in [
        (GOOD.encode("utf-16"), "UTF-16"),
        (b"\x89MCAP0\r\n\x00\x01", "binary"),
        (b"version: 1\n# 5\xb0\n", "byte 0xb0 is not UTF-8"),
        (b"a: 1\n" * 300_000, "too large"),
    ]:
        file.write_bytes(data)
        with pytest.raises(ConfigError, match=message):
            load_config(file)
    file.write_bytes(b"version: 1\n# 5\xb0\n")
    with pytest.raises(ConfigError) as caught:
        load_config(file)
    assert (caught.value.problems[0].line, caught.value.problems[0].column) == (2, 4)


def test_byte_order_mark_is_no_mistake(tmp_path: Path) -> None:
    file = tmp_path / "axis.yaml"
    file.write_bytes(b"\xef\xbb\xbf" + GOOD.replace("\n", "\r\n").encode())
    assert load_config(file) == parse_config(GOOD)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "axis3.yaml").write_text(GOOD)
    with pytest.raises(InputError, match=r"no configuration file") as caught:
        load_config(tmp_path / "axsi3.yaml")
    assert "axis3.yaml?" in caught.value.hint
    with pytest.raises(InputError, match="is a folder"):
        load_config(tmp_path)
    with pytest.raises(InputError) as caught:
        load_config(tmp_path / "none" / "x.yaml")
    assert "inspect" in caught.value.hint


def test_standard_input(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(GOOD.encode())))
    assert load_located(Path("-")).file == "<stdin>"


def test_overrides() -> None:
    config = parse_config(
        GOOD,
        overrides=[
            "axis.f1_hz=3.9e0",
            "models=[motor_only]",
            "signals.motor_position.source=/topic/p[2]",
            "controller=null",
            "pipeline.lowpass.order=4",
            "pipeline.lowpass.cutoff_hz=5",
            "csv.comment='#'",
            "axis.name=no",
        ],
    )
    assert config.axis.f1_hz == 3.9
    assert config.models == ("motor_only",)
    assert config.signals.motor_position.source == "/topic/p[2]"
    assert config.controller is None
    assert config.pipeline.lowpass is not None
    assert config.pipeline.lowpass.cutoff_hz == 5.0
    assert config.csv.comment == "#"
    assert config.axis.name == "no"


def test_an_override_cures_a_mistake_in_the_file() -> None:
    assert parse_config(GOOD.replace("50", "fifty"), overrides=["axis.gear_ratio=50"]) == parse_config(GOOD)


# option, path, part of the message, part of the hint
BAD_OPTIONS = [
    ("axis.f1_hz=-1", "axis.f1_hz", "f1_hz must be greater than 0, but is -1", ""),
    ("axis.f1hz=3", "axis.f1hz", "unknown key 'f1hz'", "did you mean f1_hz?"),
    ("axi.x=2", "axi", "unknown key 'axi'", "permitted here"),
    ("foo", "", "not KEY=VALUE", "axis.f1_hz=3.9"),
    ("axis..x=1", "", "not KEY=VALUE", "axis.f1_hz=3.9"),
    ("=1", "", "not KEY=VALUE", ""),
    ("axis.name.x=3", "", "axis.name has no keys", "as a whole"),
    ("models.0=rigid", "", "models has no keys", "as a whole"),
    ("csv.comment=#", "", "no value after the =", "quote"),
    ("axis.f1_hz=", "", "no value after the =", "null"),
    ("axis.gear_ratio=[1", "", "']' is missing", "quote"),
    ("axis.name=@x", "", "cannot start with '@'", "quotes"),
    ("signals.motor_current.unit=N", "signals.motor_current.unit", "cannot be in N", "permitted"),
    ("pipeline.lowpass.order=4", "pipeline.lowpass.cutoff_hz", "cutoff_hz is missing", "-3 dB"),
]


@pytest.mark.parametrize(("option", "path", "message", "hint"), BAD_OPTIONS)
def test_wrong_overrides_name_the_option(option: str, path: str, message: str, hint: str) -> None:
    (problem,) = problems_of(GOOD, option)
    assert problem.message.startswith(f"--set {option}: ")
    assert message in problem.message
    assert (problem.path, problem.line) == (path, 0)
    assert hint in problem.hint


def test_mistakes_of_the_file_come_before_those_of_options() -> None:
    problems = problems_of(GOOD.replace("50", "0"), "axis.f1_hz=-1")
    assert [problem.line for problem in problems] == [4, 0]


def test_digest_is_that_of_the_meaning() -> None:
    digest = config_digest(parse_config(GOOD))
    spelt = (
        GOOD.replace("0.3475", "34.75e-2").replace("unit: rad", "unit: radians").replace("1\n", "1 # x\n", 1)
    )
    assert config_digest(parse_config(spelt)) == digest
    assert config_digest(parse_config(GOOD.replace("50", "51"))) != digest
    assert len(digest) == 64


def test_long_lines_are_cut_around_the_mistake() -> None:
    text = GOOD.replace(CONTROLLER, "controller: {" + " " * 300 + "kp: x, kv: 1" + " " * 300 + "}")
    (problem,) = problems_of(text)
    shown = str(ConfigError("a.yaml", [problem])).splitlines()
    assert len(shown[1]) < 130
    assert shown[1][shown[2].index("^")] == "x"


def test_located_problem_points_into_the_file(tmp_path: Path) -> None:
    file = tmp_path / "axis.yaml"
    file.write_text(GOOD)
    loaded = load_located(file)
    problem = loaded.problem("not in the log", ("signals", "motor_current", "source"), "x")
    assert (problem.line, problem.column) == (8, 27)
    assert loaded.file == str(file)
