"""The diagnosis in the report: document, schema, renderings and figures."""

from __future__ import annotations

import copy
import io
import json
import math
import re
import runpy
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jsonschema
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from markdown_it import MarkdownIt

from flexid_cli.diagnose.result import SimulationError, Where
from flexid_cli.effects.registry import effect as library_effect
from flexid_cli.effects.registry import effects as library
from flexid_cli.report import figures
from flexid_cli.report.console import render_console
from flexid_cli.report.diagnosis_words import captions
from flexid_cli.report.json import render_json
from flexid_cli.report.markdown import render_markdown
from flexid_cli.report.write import render_outputs

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = SimpleNamespace(**runpy.run_path(str(ROOT / "tests" / "diagnosis_examples.py")))
SCHEMA = json.loads((ROOT / "flexid_cli/schemas/report-1.schema.json").read_text("utf-8"))
VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)
PARSER = MarkdownIt("commonmark").enable(["table", "strikethrough"])
EVERY = pytest.mark.parametrize("name", sorted(EXAMPLES.CASES))
ANY_NUMBER = st.floats() | st.sampled_from([math.nan, math.inf, -math.inf, 0.0])


def strict_json(text):
    def refuse(word):
        raise AssertionError(f"{word} is not JSON")

    return json.loads(text, parse_constant=refuse)


def section(diagnosis):
    return EXAMPLES.document(diagnosis)["diagnosis"]


def markdown(name):
    _, document = EXAMPLES.case(name)
    return render_markdown(document, {key: f"run_{key}.svg" for key in captions(document["diagnosis"])})


def headings(text):
    tokens = PARSER.parse(text)
    return [tokens[i + 1].content for i, t in enumerate(tokens) if t.type == "heading_open" and t.tag == "h2"]


def tables(text):
    found, row = [], []
    for token in PARSER.parse(text):
        if token.type == "table_open":
            found.append([])
        elif token.type == "tr_open":
            row = []
            found[-1].append(row)
        elif token.type == "inline" and token.level == 4:
            row.append("".join(t.content for t in token.children or []))
    return found


# --- document ---


@EVERY
def test_examples_are_valid_and_survive_json(name):
    _, document = EXAMPLES.case(name)
    VALIDATOR.validate(document)
    assert strict_json(render_json(document)) == document


def test_the_section_is_the_one_of_the_design():
    found = section(EXAMPLES.pair())
    assert list(found) == [
        "verdict", "sentence", "model", "effects", "location", "fit", "parameters_before", "parameters_after",
        "maps", "locality", "tested", "next_recording", "notes",
    ]  # fmt: skip
    effect = found["effects"][0]
    assert (effect["name"], effect["code"], effect["family"]) == ("backlash", "FX202", "transmission")
    assert effect["where"]["frequency_hz"] == [1.8, 7.25]
    assert effect["parameters"][0]["estimate"] == 9.87e-4
    assert found["fit"]["held_out"]["before"] == {"motor": 9.234, "load": 8.871}
    assert found["fit"]["simulation"]["after"] == 0.00031
    assert [t["name"] for t in found["tested"] if t["chosen"]] == ["backlash"]


def test_the_document_holds_the_effects_text():
    found = section(EXAMPLES.explained())["effects"][0]
    source = " ".join(library_effect("backlash").text.split())
    assert found["text"]["summary"] in source
    assert len(found["text"]["sections"]) >= 4
    for part in found["text"]["sections"]:
        assert f"{part['title']} {' '.join(part['paragraphs'])}" in source


def test_a_number_that_is_none_has_a_reason():
    found = section(EXAMPLES.pair())["effects"][1]["evidence"]
    assert (found["held_out_gain"], found["stability"]) == (None, None)
    assert "held out gain" in found["reason"]
    assert "stability" in found["reason"]
    nothing = section(EXAMPLES.inconclusive())["fit"]
    assert nothing["held_out"]["reason"]
    assert nothing["simulation"]["reason"]


def test_a_reason_that_the_engine_gave_is_kept():
    failed = SimulationError(None, math.nan, "joint_position", "rad", "the loop is unstable")
    found = section(replace(EXAMPLES.explained(), simulation=failed))["fit"]["simulation"]
    assert (found["before"], found["after"], found["reason"]) == (None, None, "the loop is unstable")


@given(numbers=st.lists(ANY_NUMBER, min_size=6, max_size=6), other=ANY_NUMBER)
@settings(max_examples=40, deadline=None)
def test_no_number_of_the_engine_breaks_the_document(numbers, other):
    held = EXAMPLES.HELD_OUT
    sizes = {"motor": abs(numbers[0]), "load": abs(other)}
    evidence = replace(EXAMPLES.EVIDENCE, statistic=numbers[1], threshold=other, held_out_gain=numbers[2])
    where = Where("load", "time", (numbers[3], other), (other, numbers[4]), EXAMPLES.shape())
    where = replace(where, shape=replace(where.shape, y=np.full(15, numbers[5])))
    effect = replace(EXAMPLES.BACKLASH, evidence=evidence, where=where)
    diagnosis = replace(
        EXAMPLES.explained(),
        effects=(effect,),
        location=where,
        held_out=replace(held, before=sizes, after=sizes),
        simulation=SimulationError(abs(numbers[0]), abs(other), "torque", "N.m"),
        maps=(replace(EXAMPLES.residual_map(), band=np.full(25, abs(other))),),
        tested=(replace(EXAMPLES.TESTED[1], statistic=other),),
        locality=broken_locality(numbers, other),
    )
    document = EXAMPLES.document(diagnosis)
    VALIDATOR.validate(document)
    assert strict_json(render_json(document)) == document
    for text in (render_markdown(document, {}), render_console(document)):
        assert not re.search(r"\b(nan|inf|None)\b", text)


def broken_locality(numbers, other):
    """Every kind of entry with numbers of any kind."""
    one = EXAMPLES.locality()
    line = replace(one.angle[0].lines[0], amplitude=numbers[0], false_alarm=other)
    return replace(
        one,
        changes=(replace(one.changes[0], time_s=numbers[1], size=other, share=numbers[2]),),
        events=(replace(one.events[0], start_s=other, times_usual=numbers[3]),),
        reversals=(replace(one.reversals[1], energy_share=numbers[4], mean=np.full(21, other)),),
        angle=(replace(one.angle[0], lines=(line,)),),
        loop=replace(one.loop, slope=numbers[5], share=other, width=np.full(4, numbers[0])),
        drift=(replace(one.drift[0], per_minute=other, share=numbers[2]),),
    )


def test_inputs_have_their_roles_and_their_own_totals():
    record = EXAMPLES.REPORT.recording()
    clocks = tuple(replace(c, samples=777) for c in record.clocks)
    other = replace(record, clocks=clocks, duration_s=7.0, notes=("the other one is short",))
    known = replace(EXAMPLES.other_input("parameters"), format="flexid-report/1")
    inputs = (EXAMPLES.REPORT.INPUT, EXAMPLES.other_input("validation"), known)
    document = EXAMPLES.document(EXAMPLES.explained(), record, inputs, validation=other)
    VALIDATOR.validate(document)
    found = document["inputs"]
    assert [(f["role"], f["samples"], f["duration"]) for f in found] == [
        ("recording", 35087, 100.0),
        ("validation", 777, 7.0),
        ("parameters", None, None),
    ]
    assert found[2]["clock"] is None
    assert "the other one is short" in document["warnings"]
    text = render_markdown(document, {})
    assert "- Other run logs/validation.mcap" in text
    assert "- Known parameters logs/parameters.mcap" in text


# --- text ---


@EVERY
def test_renderings_keep_the_document_and_end_in_one_newline(name):
    _, document = EXAMPLES.case(name)
    before = copy.deepcopy(document)
    for render in (render_json, render_console, lambda d: render_markdown(d, {})):
        text = render(document)
        assert text == render(strict_json(render_json(document)))
        assert text.endswith("\n")
        assert not text.endswith("\n\n")
        assert not re.search(r"\b(nan|NaN|inf|None|True|False)\b|np\.", text)
    assert document == before


@EVERY
def test_every_rendering_says_sentence_verdict_and_advice(name):
    diagnosis, document = EXAMPLES.case(name)
    for text in (render_console(document), markdown(name).replace("\\", "")):
        flat = " ".join(text.split())
        assert diagnosis.sentence in flat
        assert diagnosis.verdict.replace("_", " ") in flat
        for words in (*diagnosis.next_recording, *diagnosis.notes):
            assert words in flat
        for effect in diagnosis.effects:
            assert effect.code in flat
            for other in effect.alternatives:
                assert other in flat


@EVERY
def test_console_golden(name):
    EXAMPLES.REPORT.check_golden(f"diagnosis_{name}.txt", render_console(EXAMPLES.case(name)[1]))


@EVERY
@pytest.mark.parametrize("width", [40, 80, 132])
def test_no_line_is_wider_than_the_terminal(name, width):
    text = render_console(EXAMPLES.case(name)[1], width=width)
    assert max(map(len, text.splitlines())) <= width
    assert not [line for line in text.splitlines() if line != line.rstrip()]


@pytest.mark.parametrize("width", [8, 30, 79, 120])
def test_numbers_are_whole_at_every_width(width):
    lines = render_console(EXAMPLES.case("explained")[1], width=width).splitlines()
    for number in ("20296 to 20380", "0.000965 to 0.001009", "18410", "41.2 %"):
        assert any(number in line for line in lines), number


@pytest.mark.parametrize("width", [30, 80])
def test_colour_adds_nothing_but_colour(monkeypatch, width):
    monkeypatch.delenv("NO_COLOR", raising=False)
    document = EXAMPLES.case("pair")[1]
    coloured = render_console(document, width=width, colour=True)
    assert "\x1b[33mweak" in coloured
    assert re.sub(r"\x1b\[[0-9;]*m", "", coloured) == render_console(document, width=width)


def test_the_longest_names_of_the_library_fit_80_columns():
    longest = max(library(), key=lambda e: len(e.name))
    where = Where(max(("motor", "transmission"), key=len), "motor_velocity")
    effect = replace(EXAMPLES.BACKLASH, name=longest.name, code=longest.code, where=where)
    text = render_console(EXAMPLES.document(replace(EXAMPLES.explained(), effects=(effect,))))
    assert re.search(rf"^{longest.name} +transmission +motor velocity +41.2 % +39.3 %$", text, re.MULTILINE)


def test_markdown_goes_from_the_sentence_to_what_to_do():
    assert headings(markdown("ambiguous")) == [
        "What was found", "Parameters before and after", "Fit before and after", "What else was tested",
        "What to record next", "What backlash is, and what to do about it", "Notes", "Warnings", "Data quality",
        "Reproducibility", "References",
    ]  # fmt: skip
    first = [t for t in PARSER.parse(markdown("ambiguous")) if t.type == "inline"][1]
    assert EXAMPLES.ambiguous().sentence in first.content


def test_markdown_tables_parse_to_what_the_document_holds():
    found = tables(markdown("explained"))
    assert all(len(row) == len(table[0]) for table in found for row in table)
    parameters = found[1]
    assert parameters[0][2:5] == ["Before", "After", "95 % interval"]
    assert parameters[2][:8] == [
        "K", "joint_stiffness", "18410", "20338", "20296 to 20380", "N.m/rad", "+10", "identified",
    ]  # fmt: skip
    assert parameters[4][2] == "–"
    assert found[2][1:] == [["motor", "9.23", "3.33", "3.31", "N.m"], ["load", "8.87", "2.1", "2.04", "N.m"]]
    others = [row[0] for row in found[3][1:]]
    assert others == ["hysteresis", "hardening_stiffness", "clock_skew"]


def test_what_stays_unexplained_is_a_table():
    found = tables(markdown("unexplained"))[0]
    assert found[0] == ["position (rad)", "Residual (N.m)", "95 % band"]
    assert found[8] == ["0", "5", "4.4 to 5.6"]


def test_unchanged_parameters_stand_once():
    text = markdown("adequate")
    assert "Parameters before and after" not in text
    assert text.count("joint\\_stiffness") + text.count("joint_stiffness") == 1


def test_no_html_and_every_figure_is_described():
    text = markdown("unexplained")
    tokens = [child for t in PARSER.parse(text) for child in [t, *(t.children or [])]]
    assert not [t for t in tokens if t.type in ("html_block", "html_inline")]
    images = {t.attrs["src"]: t.content for t in tokens if t.type == "image"}
    assert list(images) == [
        "run_diagnosis_residual.svg", "run_diagnosis_map_1.svg", "run_diagnosis_map_2.svg",
        "run_diagnosis_shape.svg", "run_diagnosis_reversals.svg", "run_diagnosis_angle.svg", "run_diagnosis_loop.svg",
    ]  # fmt: skip
    assert all(len(caption) > 30 for caption in images.values())


def test_where_and_when_is_told_of_a_mismatch_only():
    for name in ("unexplained", "pair"):
        flat = " ".join(markdown(name).replace("\\", "").split())
        assert "From 17.31 s on JL differs by +4.12 kg.m2" in flat
        assert "71 % of the load residual's energy" in flat
        assert "lines of 2, 0.46 cycles per motor revolution" in flat
        assert "to the power of 0.02" in flat
        assert "FVm by -3.1 N.m.s/rad a minute" in flat
        assert "23 % of the motor" not in flat  # not sure
    assert "Residual that the named effects leave" in markdown("pair")
    assert "17.31" not in render_console(EXAMPLES.case("adequate")[1])
    assert section(EXAMPLES.adequate())["locality"]["changes"][0]["column"] == "JL"


def test_the_sentence_on_top_is_not_said_again():
    found = EXAMPLES.unexplained()
    first, second = found.location.suggests
    said = replace(found, sentence=f"It is unknown. {first[0].upper()}{first[1:]}.")
    text = " ".join(render_console(EXAMPLES.document(said)).split())
    assert text.count(first[1:]) == 1
    assert second in text


def test_a_number_of_the_place_that_is_none_has_a_reason():
    one = EXAMPLES.locality()
    found = section(replace(EXAMPLES.explained(), locality=replace(one, drift=one.drift[:1])))["locality"]
    assert found["reason"] == ""
    assert section(replace(EXAMPLES.explained(), locality=one))["locality"]["reason"]
    nothing = section(replace(EXAMPLES.explained(), locality=replace(one, loop=None, drift=())))["locality"]
    assert (nothing["loop"], nothing["reason"]) == (None, "")


# --- figures ---


@EVERY
def test_links_and_figures_are_the_same(name, tmp_path):
    diagnosis, document = EXAMPLES.case(name)
    contents = render_outputs(document, diagnosis, [tmp_path / "run 1.md", tmp_path / "run.json"])
    drawn = {path.name for path in contents if path.suffix == ".svg"}
    links = set(re.findall(r"\]\(([^()]*\.svg)\)", contents[tmp_path / "run 1.md"]))
    assert {link.replace("%20", " ") for link in links} == drawn
    for path, text in contents.items():
        if path.suffix == ".svg":
            assert ET.fromstring(text).tag == "{http://www.w3.org/2000/svg}svg"
    assert contents == render_outputs(document, diagnosis, [tmp_path / "run 1.md", tmp_path / "run.json"])


def test_the_curves_are_drawn_at_their_values(monkeypatch):
    drawn = []

    def keep(draw, title, height_in):
        from matplotlib.figure import Figure

        figure = Figure()
        draw(figure)
        figure.savefig(io.BytesIO(), format="svg")
        drawn.append(figure)
        return "<svg/>"

    monkeypatch.setattr(figures, "_svg", keep)
    one, location = EXAMPLES.residual_map(), EXAMPLES.unexplained().location
    figures.figure_map(one)
    figures.figure_shape(location)
    lines = {line.get_label(): line for line in drawn[0].axes[0].get_lines()}
    assert np.array_equal(lines["before"].get_ydata(), one.before)
    assert np.array_equal(lines["after"].get_ydata(), one.after)
    [band] = drawn[0].axes[0].collections
    heights = band.get_paths()[0].vertices[:, 1]
    assert (heights.min(), heights.max()) == (-0.8, 0.8)
    [mean] = [line for line in drawn[1].axes[0].get_lines() if line.get_label() == "mean"]
    assert np.array_equal(mean.get_ydata(), location.shape.y)


def test_a_long_record_gives_a_small_figure():
    assert len(figures.figure_residual(EXAMPLES.traces(300_000))) < 1_000_000


@pytest.mark.parametrize("samples", [0, 1, 2])
def test_hardly_any_data_is_no_crash(samples):
    ET.fromstring(figures.figure_residual(EXAMPLES.traces(samples)))
    one = EXAMPLES.residual_map()
    cut = {k: getattr(one, k)[:samples] for k in ("x", "before", "after", "band")}
    ET.fromstring(figures.figure_map(replace(one, **cut)))
