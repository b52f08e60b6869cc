"""Markdown, read back with a CommonMark parser that is not part of the project."""

from __future__ import annotations

import runpy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from markdown_it import MarkdownIt

from flexid_cli.estimate.result import Identification
from flexid_cli.report.document import Damage, InputFile
from flexid_cli.report.markdown import escape, render_markdown
from flexid_cli.report.words import duration

EXAMPLES = SimpleNamespace(**runpy.run_path(str(Path(__file__).resolve().parents[1] / "report_examples.py")))
KINDS = ("torque", "filter", "spectrum")
PARSER = MarkdownIt("commonmark").enable(["table", "strikethrough"])


def links(document):
    return {f"{m['id']}_{k}": f"run_{m['id']}_{k}.svg" for m in document["models"] for k in KINDS}


def markdown(name):
    _, document = EXAMPLES.case(name)
    return render_markdown(document, links(document))


def plain(inline):
    """Text of a parsed inline token."""
    return "".join("\n" if t.type == "softbreak" else t.content for t in inline.children or [])


def tables(text):
    """Every table as rows of cells."""
    found, row = [], []
    for token in PARSER.parse(text):
        if token.type == "table_open":
            found.append([])
        elif token.type == "tr_open":
            row = []
            found[-1].append(row)
        elif token.type == "inline" and token.level == 4 + (row is None):
            row.append(plain(token))
    return found


def headings(text):
    tokens = PARSER.parse(text)
    return [
        plain(tokens[i + 1])
        for i, t in enumerate(tokens)
        if t.type == "heading_open" and t.tag in ("h1", "h2")
    ]


@pytest.mark.parametrize("name", sorted(EXAMPLES.CASES))
def test_golden(name):
    EXAMPLES.check_golden(f"report_{name}.md", markdown(name))


def test_order_is_verdict_results_warnings_quality_pipeline_method_reproducibility():
    assert headings(markdown("flexible")) == [
        "Drive parameters of axis3", "Verdict", "Model two_encoders", "Model motor_only", "Warnings",
        "Data quality", "Pipeline", "Method", "Reproducibility", "References",
    ]  # fmt: skip


def test_tables_parse_to_what_the_document_holds():
    found = tables(markdown("flexible"))
    assert found[0][0] == [
        "Symbol",
        "Name",
        "Estimate",
        "95 % interval",
        "Unit",
        "Rel. std. dev. %",
        "Verdict",
    ]
    assert found[0][2] == ["K", "joint_stiffness", "20340", "19910 to 20770", "N.m/rad", "1.1", "identified"]
    regression = found[3]
    assert [row[0] for row in regression[1:]] == ["X1", "X2", "X3", "X4", "X5", "X6", "X7"]
    assert regression[1][2:4] == ["0.002100", "0.001993 to 0.002207"]
    assert all(len(row) == len(table[0]) for table in found for row in table)


def test_no_html_and_alt_text_says_the_finding():
    text = markdown("flexible")
    tokens = [child for t in PARSER.parse(text) for child in [t, *(t.children or [])]]
    assert not [t for t in tokens if t.type in ("html_block", "html_inline")]
    images = [t for t in tokens if t.type == "image"]
    assert [t.attrs["src"] for t in images] == list(links(EXAMPLES.case("flexible")[1]).values())
    assert "a fit of 92.6 %" in images[0].content
    assert "0.05 to 5.398 Hz" in images[1].content


def test_figures_without_link_are_left_out():
    _, document = EXAMPLES.case("rigid")
    assert "![" not in render_markdown(document, {})


def test_levels_that_differ_stand_in_the_cells():
    stiffness, inertia = EXAMPLES.TABLE_1[1], EXAMPLES.TABLE_1[0]
    other = replace(inertia, interval=replace(inertia.interval, level=0.99))
    model = EXAMPLES.model(parameters=(stiffness, other), derived=())
    table = tables(render_markdown(EXAMPLES.document(Identification((model,), (), ())), {}))[0]
    assert [row[3] for row in table] == ["Interval", "19910 to 20770 (95 %)", "172.1 to 177.5 (99 %)"]


def test_one_sided_intervals_are_words():
    stiffness = replace(EXAMPLES.TABLE_1[1], verdict="weak", reason="only a lower bound")
    lower = replace(stiffness, interval=replace(stiffness.interval, high=float("inf")))
    model = EXAMPLES.model(parameters=(lower,), derived=())
    table = tables(render_markdown(EXAMPLES.document(Identification((model,), (), ())), {}))[0]
    assert table[1][3] == "above 19910"


def test_damage_is_told():
    file = InputFile("a_*.csv", "ab" * 32, "csv", damage=Damage(90, 7, 3))
    text = render_markdown(EXAMPLES.document(EXAMPLES.rigid(), inputs=(file,)), {})
    assert r"- a\_\*.csv: damaged file, samples: 90 trusted, 7 suspect, 3 lost" in text


@given(st.text(alphabet=st.characters(codec="utf-8", exclude_categories=("Cc", "Zs", "Zl", "Zp"))))
def test_escaped_text_reads_as_it_was_in_a_list_and_in_a_table(text):
    escaped = escape(text)
    if not escaped:
        return
    inline = [t for t in PARSER.parse(f"- {escaped}") if t.type == "inline"]
    assert [plain(t) for t in inline] == [text]
    assert tables(f"| a | b |\n| --- | --- |\n| {escaped} | end |")[0][1] == [text, "end"]


def test_escape_joins_lines_and_leaves_names_readable():
    assert escape("motor_position\n  at 3 s") == "motor_position at 3 s"
    assert escape("$x$ ^2^ ~~y~~ 1. <b>") == r"\$x\$ \^2\^ \~\~y\~\~ 1. \<b\>"
    assert escape("12. x") == r"12\. x"


def test_plain_numbers_have_no_unit_and_small_p_values_no_digits():
    ratio = EXAMPLES.estimate("inertia_ratio", "JL/Jm", "1", 2.2, 0.02)
    model = EXAMPLES.model(derived=(ratio,), warnings=("two_encoders: the band is narrow",))
    text = render_markdown(EXAMPLES.document(Identification((model,), (), ())), {})
    assert tables(text)[1][1][4] == "\N{EN DASH}"
    assert "p value below 0.001" in text
    assert "- two_encoders: the band is narrow" in text


def test_times_are_in_the_unit_that_reads_best():
    times = (None, 0.0, 36.0, 0.002, 0.99999e-3, 24e-6, 20.73e-9)
    assert [duration(t) for t in times] == ["\N{EN DASH}", "0", "36 s", "2 ms", "1 ms", "24 us", "20.73 ns"]
