"""``flexid effects`` and ``flexid explain``: the whole library, by discovery."""

from __future__ import annotations

import inspect
import json
import re
from typing import Any

import pytest
from click.shell_completion import CompletionItem
from click.testing import CliRunner, Result

from flexid_cli.cli.explain import explain
from flexid_cli.cli.main import main
from flexid_cli.effects.base import Effect
from flexid_cli.effects.registry import effects
from flexid_cli.report.effect_text import effect_text

EVERY = pytest.mark.parametrize("effect", effects(), ids=lambda e: e.name)


def run(*arguments: str) -> Result:
    return CliRunner().invoke(main, list(arguments))


def words_of(text: str) -> list[str]:
    return re.findall(r"\S+", text)


def test_the_table_has_every_effect_in_80_columns() -> None:
    result = run("effects")
    assert (result.exit_code, result.stderr) == (0, "")
    lines = result.stdout.splitlines()
    assert max(map(len, lines)) <= 80
    for effect in effects():
        [row] = [k for k, line in enumerate(lines) if line.startswith(effect.code)]
        assert lines[row].split() == [effect.code, effect.name, effect.family, effect.equation]
        assert lines[row + 1].strip() == effect.text.splitlines()[0]


def test_json_holds_the_library_and_no_infinity() -> None:
    result = run("effects", "--json")

    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is not JSON")

    listed = json.loads(result.stdout, parse_constant=refuse)["effects"]
    assert [e["code"] for e in listed] == [e.code for e in effects()]
    for entry, effect in zip(listed, effects(), strict=True):
        assert [p["name"] for p in entry["parameters"]] == [p.name for p in effect.parameters]
        assert all(p["unit"] and p["unit_linear"] for p in entry["parameters"])
        assert entry["best_recording"] == effect.best_recording
    [limit] = [e for e in listed if e["name"] == "torque_saturation"]
    assert limit["parameters"][0]["high"] is None


@EVERY
def test_the_text_is_split_without_losing_a_word(effect: Effect) -> None:
    text = effect_text(effect)
    parts = [text.summary]
    for title, paragraphs in text.sections:
        assert paragraphs
        parts += [title, *paragraphs]
    assert words_of(" ".join(parts)) == words_of(inspect.cleandoc(effect.text))


@EVERY
def test_explain_prints_all_of_it_in_80_columns(effect: Effect) -> None:
    result = run("explain", effect.name)
    assert (result.exit_code, result.stderr) == (0, "")
    assert max(map(len, result.stdout.splitlines())) <= 80
    printed = " ".join(words_of(result.stdout))
    text = effect_text(effect)
    whole = [effect.code, text.summary, effect.term, effect.best_recording, *effect.needs]
    whole += [piece for title, paragraphs in text.sections for piece in (title, *paragraphs)]
    whole += [f"{p.symbol} {p.name} (" for p in effect.parameters]
    for piece in whole:
        assert " ".join(words_of(piece)) in printed
    assert "inf " not in printed
    assert "1e+" not in printed


def test_units_and_admitted_values_stand_beside_the_parameters() -> None:
    lines = run("explain", "cogging").stdout.splitlines()
    assert "  A cogging_torque (N.m, on a linear axis N): at least 0, no effect at 0" in lines
    assert "  phi cogging_phase (rad): -6.3 to 6.3, shape" in lines


@pytest.mark.parametrize("word", ["backlash", "Backlash", "FX202", "fx202", " BACKLASH "])
def test_names_and_codes_as_people_type_them(word: str) -> None:
    assert run("explain", word).stdout.startswith("FX202 backlash\n")


@pytest.mark.parametrize("word", ["joint-damping", "joint damping"])
def test_other_separators(word: str) -> None:
    assert run("explain", word).stdout.startswith("FX201 joint_damping\n")


@pytest.mark.parametrize(
    ("word", "meant"), [("backlsh", "backlash"), ("histeresis", "hysteresis"), ("FX2O2", "FX202")]
)
def test_an_unknown_name_gets_the_nearest(word: str, meant: str) -> None:
    result = run("explain", word)
    assert (result.exit_code, result.stdout) == (2, "")
    assert f"did you mean {meant}?" in result.stderr
    assert result.stderr.startswith("error: there is no effect")


def test_nothing_near_gives_the_list() -> None:
    result = run("explain", "zzzz")
    assert result.exit_code == 2
    assert "did you mean" not in result.stderr
    assert all(effect.name in result.stderr for effect in effects())


def test_explain_as_json_is_the_entry_of_the_list() -> None:
    listed: list[dict[str, Any]] = json.loads(run("effects", "--json").stdout)["effects"]
    [entry] = [e for e in listed if e["name"] == "backlash"]
    assert json.loads(run("explain", "backlash", "--json").stdout) == entry


def test_names_are_completed() -> None:
    [argument] = [p for p in explain.params if p.name == "effect"]
    with explain.make_context("explain", ["backlash"]) as context:
        found = argument.shell_complete(context, "stri")
    assert all(isinstance(item, CompletionItem) for item in found)
    assert [item.value for item in found] == [e.name for e in effects() if e.name.startswith("stri")]
