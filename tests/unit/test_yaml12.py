"""The YAML 1.2 core schema, against the tables of the specification and PyYAML's own idea of 1.1."""

from __future__ import annotations

import math

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from flexid_cli.config.yaml12 import Place, parse_scalar, path_text, read_yaml

# Section 10.3.2 of the YAML 1.2.2 specification, and the traps of 1.1.
SCALARS = [
    ("null", None), ("Null", None), ("NULL", None), ("~", None), ("nULL", "nULL"),
    ("true", True), ("True", True), ("TRUE", True), ("false", False), ("tRUE", "tRUE"),
    ("no", "no"), ("yes", "yes"), ("on", "on"), ("off", "off"), ("y", "y"), ("N", "N"),
    ("0", 0), ("-19", -19), ("+12", 12), ("017", 17), ("0o17", 15), ("0o18", "0o18"),
    ("0x3A", 58), ("-0x1", "-0x1"),
    ("0b1", "0b1"), ("1_000", "1_000"), ("1:30", "1:30"), ("190:20:30.15", "190:20:30.15"),
    ("0.", 0.0), ("-0.0", -0.0), (".5", 0.5), ("+12e03", 12000.0), ("-2E+05", -2e5),
    ("1e4", 1e4), ("1e-4", 1e-4),
    ("1.5e3", 1500.0), ("e5", "e5"), (".", "."), ("1.2.3", "1.2.3"), ("1e", "1e"), ("- 1", "- 1"),
    (".inf", math.inf), ("-.Inf", -math.inf), ("+.INF", math.inf), ("inf", "inf"), ("nan", "nan"),
    ("2001-01-01", "2001-01-01"), ("=", "="), ("<<", "<<"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "value"), SCALARS)
def test_core_schema(text: str, value: object) -> None:
    result = parse_scalar(text)
    assert result == value
    assert type(result) is type(value)


@pytest.mark.parametrize("text", [".nan", ".NaN", ".NAN"])
def test_nan(text: str) -> None:
    result = parse_scalar(text)
    assert isinstance(result, float)
    assert math.isnan(result)


def test_long_numbers_do_not_stop_the_program() -> None:
    assert read_yaml("a: " + "9" * 10_000).problems == []
    assert parse_scalar("1e999") == math.inf


@given(st.floats(allow_nan=False, allow_infinity=False))
@settings(max_examples=200, deadline=None)
def test_every_float_comes_back(number: float) -> None:
    assert parse_scalar(repr(number)) == number


def test_quoted_is_text() -> None:
    assert read_yaml("a: '1'\nb: \"true\"\nc: ''\nd: |\n  12\n").data == {
        "a": "1",
        "b": "true",
        "c": "",
        "d": "12\n",
    }


def test_structures_agree_with_pyyaml() -> None:
    text = "# c\na: {b: [1, 2.5, x y], c: {}}\nd:\n- - 1\n  - 2\n- e: f g\n  h: >\n    folded\n    text\n"
    assert read_yaml(text).data == yaml.safe_load(text)


def test_places_of_keys_and_values() -> None:
    document = read_yaml("a: 1\nb:\n  c:  {d: [x, y]}\n")
    assert document.keys[("b", "c")] == Place(3, 3)
    assert document.values[("b", "c")] == Place(3, 7)
    assert document.keys[("b", "c", "d")] == Place(3, 8)
    assert document.values[("b", "c", "d", 1)] == Place(3, 15)
    assert document.values[("a",)] == Place(1, 4)


def test_byte_order_mark_and_line_ends() -> None:
    document = read_yaml("\ufeffa: 1\r\nb: 2\r\n")
    assert document.data == {"a": 1, "b": 2}
    assert document.values[("b",)] == Place(2, 4)
    assert document.problems == []


# text, line, column, part of the message, part of the hint
BROKEN = [
    ("a: {source: /topic/effort[2]}", 1, 26, "cannot stand unquoted", '{source: "/topic/effort[2]"}'),
    ("a: {s: /j.p[2], u: rad}\n", 1, 12, "'[' cannot stand unquoted", "quotes"),
    ("a:\n\tb: 1", 2, 1, "tab", "spaces"),
    ("a:\n  b: 1\n\tc: 2", 3, 1, "tab", "spaces"),
    ("a: 1\n b: 2", 2, 3, "colon", "indent"),
    ("a: {b: 1\nc: {d: 2}\n", 1, 4, "not closed", "}"),
    ("a: [1, 2\nb: 3", 1, 4, "not closed", "]"),
    ("a: {n: #3, u: A}\nb: 2", 1, 4, "not closed", "#"),
    ("a: {b: c d: e}", 1, 11, "comma", "quote"),
    ("a: 'foo\nb: 2", 1, 4, "never closed", "quote"),
    ('a: "C:\\q"', 1, 8, "escape", "single quotes"),
    ("a: b\nversion 1\nc: 2", 2, 1, "neither", "colon"),
    ("a: @x", 1, 4, "cannot start with '@'", "quotes"),
    ("a: `x`", 1, 4, "cannot start with '`'", "quotes"),
    ("a: }", 1, 4, "no value can start with '}'", "quotes"),
    ("a: [1,,2]", 1, 7, "no value can start with ','", "quotes"),
    ("a: - b", 1, 4, "list item", "line"),
    ("a: {b: 1}}", 1, 10, "does not fit", "indentation"),
    ("a: b\x00c", 1, 5, "U+0000", "log"),
    ("a: 1\nb: \x07", 2, 4, "U+0007", "log"),
    ("? [a]\n: b", 1, 3, "has to be a word", ""),
    ("*a : 1", 1, 1, "has to be a word", "quote"),
    ("[" * 100, 1, 22, "too deeply", ""),
    ("a: 1\n...\nb: 2", 3, 1, "not YAML", ""),
]


@pytest.mark.parametrize(("text", "line", "column", "message", "hint"), BROKEN)
def test_what_is_no_yaml(text: str, line: int, column: int, message: str, hint: str) -> None:
    document = read_yaml(text)
    assert document.data is None
    problem = document.problems[-1]
    assert (problem.line, problem.column) == (line, column)
    assert message in problem.message
    assert hint in problem.hint


# text, path, line, column, part of the message, part of the hint
REFUSED = [
    ("a: 1\na: 2", "a", 2, 1, "second time", "line 1"),
    ("b: {c: 1, c: {d: 1, d: 2}}", "b.c", 1, 11, "second time", "line 1"),
    ("a: *x", "a", 1, 4, "aliases (*x)", "quote"),
    ("a: &x 3", "a", 1, 4, "anchors (&x)", "quote"),
    ("a: !!str 4", "a", 1, 4, "tags (!!str)", "quote"),
    ("a: !odd 4", "a", 1, 4, "tags (!odd)", "quote"),
    ("<<: {a: 1}", "<<", 1, 1, "merge keys", "in full"),
    ("a: 1\n---\nb: 2", "", 2, 1, "second document", "---"),
    ("%YAML 1.1\n---\na: 1", "", 1, 1, "only YAML 1.2", "%YAML"),
    ("a:\nb: 1", "a", 1, 1, "no value", "null"),
    ("a: # 3\nb: 1", "a", 1, 1, "no value", "quote text that starts with #"),
    ("a: {b:1}", "a.b:1", 1, 5, "no value", "b: 1"),
    ("a: {b, c: 1}", "a.b", 1, 5, "no value", "null"),
]


@pytest.mark.parametrize(("text", "path", "line", "column", "message", "hint"), REFUSED)
def test_what_is_yaml_but_refused(
    text: str, path: str, line: int, column: int, message: str, hint: str
) -> None:
    document = read_yaml(text)
    problem = document.problems[0]
    assert (problem.path, problem.line, problem.column) == (path, line, column)
    assert message in problem.message
    assert hint in problem.hint
    assert problem.source_line == text.split("\n")[line - 1]


def test_first_of_two_equal_keys_is_kept_for_further_checks() -> None:
    document = read_yaml("a: 1\nb: {c: 1, c: 2}\na: 3\n")
    assert document.data == {"a": 1, "b": {"c": 1}}
    assert [problem.path for problem in document.problems] == ["b.c", "a"]
    assert document.values[("a",)] == Place(1, 4)


def test_aliases_cannot_grow() -> None:
    bomb = "a: &a [x, x]\n" + "".join(
        f"{chr(98 + i)}: &{chr(98 + i)} [*{chr(97 + i)}, *{chr(97 + i)}]\n" for i in range(20)
    )
    document = read_yaml(bomb)
    assert len(document.problems) == 61


def test_empty_and_comments_only() -> None:
    for text in ("", "\n", "# nothing\n", "---\n", "\ufeff"):
        assert read_yaml(text).data is None
        assert read_yaml(text).problems == []


def test_path_text() -> None:
    assert path_text(("models", 1)) == "models[1]"
    assert path_text(("signals", "motor_current", "unit")) == "signals.motor_current.unit"
    assert path_text(()) == ""


@given(st.text(alphabet="ab: {}[],#'\"\n\t-&*!|>%@`0.e~?\\", max_size=40))
@settings(max_examples=400, deadline=None)
def test_no_text_raises(text: str) -> None:
    document = read_yaml(text)
    for problem in document.problems:
        assert problem.message
        assert 1 <= problem.line <= len(document.lines) + 1
        assert problem.column >= 1
