"""The terminal report: goldens, widths, colour and plain ASCII."""

from __future__ import annotations

import io
import re
import runpy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from flexid_cli.estimate.result import Identification
from flexid_cli.report.console import print_report, render_console

EXAMPLES = SimpleNamespace(**runpy.run_path(str(Path(__file__).resolve().parents[1] / "report_examples.py")))
ESCAPE = re.compile(r"\x1b\[[0-9;]*m")


@pytest.mark.parametrize("name", sorted(EXAMPLES.CASES))
def test_golden(name):
    EXAMPLES.check_golden(f"report_{name}.txt", render_console(EXAMPLES.case(name)[1]))


@pytest.mark.parametrize(("width", "encoding"), [(120, "utf-8"), (30, "ascii")])
def test_golden_of_other_terminals(width, encoding):
    text = render_console(EXAMPLES.case("flexible")[1], width=width, encoding=encoding)
    EXAMPLES.check_golden(f"report_flexible_{width}.txt", text)


@pytest.mark.parametrize("name", sorted(EXAMPLES.CASES))
@pytest.mark.parametrize("width", [40, 80, 132])
def test_no_line_is_wider_than_the_terminal(name, width):
    text = render_console(EXAMPLES.case(name)[1], width=width)
    assert max(map(len, text.splitlines())) <= width
    assert not [line for line in text.splitlines() if line != line.rstrip()]


@pytest.mark.parametrize("width", [8, 20, 40, 79, 80, 200])
def test_numbers_are_whole_at_every_width(width):
    lines = render_console(EXAMPLES.case("flexible")[1], width=width).splitlines()
    for number in ("20340", "19910 to 20770", "174.21", "172.45 to 175.97", "-0.72", "-1.90 to 0.45"):
        assert any(number in line for line in lines), number


def test_long_numbers_stay_whole():
    stiffness = EXAMPLES.TABLE_1[1]
    exact = replace(stiffness, stderr=1e-9, interval=replace(stiffness.interval, low=-2e11, high=2e11))
    model = EXAMPLES.model(parameters=(exact,), derived=())
    text = render_console(EXAMPLES.document(Identification((model,), (), ())), width=40)
    assert re.search(r"-200\.\d+e9 to 200\.\d+e9\n", text)


def test_no_escape_codes_without_colour():
    assert not ESCAPE.search(render_console(EXAMPLES.case("flexible")[1]))


def test_colour_adds_nothing_but_colour(monkeypatch):
    monkeypatch.delenv("NO_COLOR", raising=False)
    document = EXAMPLES.case("flexible")[1]
    coloured = render_console(document, colour=True)
    assert "\x1b[32midentified" in coloured
    assert "\x1b[31mnot identifiable" in coloured
    assert ESCAPE.sub("", coloured) == render_console(document)


def test_no_color_wins(monkeypatch):
    monkeypatch.setenv("NO_COLOR", "1")
    text = render_console(EXAMPLES.case("flexible")[1], colour=True)
    assert not re.search(r"\x1b\[(3|4|9)\d", text)


def test_plain_ascii_for_other_encodings():
    notes = ("Länge ± 3 µm ≥ 2",)
    document = EXAMPLES.document(EXAMPLES.flexible(), EXAMPLES.recording(notes=notes))
    text = render_console(document, encoding="latin-1")
    assert text.isascii()
    assert "L\\xe4nge +/- 3 um >= 2" in text


def test_the_console_says_its_encoding():
    raw = io.BytesIO()
    stream = io.TextIOWrapper(raw, encoding="ascii")
    print_report(EXAMPLES.case("flexible")[1], Console(file=stream, width=80))
    stream.flush()
    assert raw.getvalue().decode("ascii") == render_console(EXAMPLES.case("flexible")[1], encoding="ascii")


def test_brackets_in_words_are_not_markup():
    document = EXAMPLES.document(EXAMPLES.rigid(), EXAMPLES.recording(notes=("see [red]position[2][/red]",)))
    assert "Warning: see [red]position[2][/red]" in render_console(document)
