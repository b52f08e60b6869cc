"""What every renderer of the report must do; a renderer is a module ``report/X.py`` with ``render_X``."""

from __future__ import annotations

import copy
import importlib
import json
import pkgutil
import re
import runpy
from pathlib import Path
from types import SimpleNamespace

import pytest

import flexid_cli.report
from flexid_cli.report.json import render_json

EXAMPLES = SimpleNamespace(**runpy.run_path(str(Path(__file__).resolve().parents[1] / "report_examples.py")))
FIGURES = {"two_encoders_torque": "run_two_encoders_torque.svg"}


def _renderers():
    for found in pkgutil.iter_modules(flexid_cli.report.__path__):
        module = importlib.import_module(f"flexid_cli.report.{found.name}")
        renderer = getattr(module, f"render_{found.name}", None)
        if renderer is not None:
            yield found.name, renderer


RENDERERS = dict(_renderers())
everything = pytest.mark.parametrize(
    ("renderer", "case"), [(r, c) for r in sorted(RENDERERS) for c in sorted(EXAMPLES.CASES)]
)


def render(name, document):
    renderer = RENDERERS[name]
    return renderer(document, FIGURES) if name == "markdown" else renderer(document)


def test_the_renderers_are_found():
    assert {"json", "markdown", "console"} <= set(RENDERERS)


@everything
def test_same_document_same_text_and_nothing_changed(renderer, case):
    _, document = EXAMPLES.case(case)
    before = copy.deepcopy(document)
    first = render(renderer, document)
    assert document == before
    assert render(renderer, EXAMPLES.case(case)[1]) == first


@everything
def test_renders_a_report_read_back_from_json(renderer, case):
    _, document = EXAMPLES.case(case)
    assert render(renderer, json.loads(render_json(document))) == render(renderer, document)


@everything
def test_ends_in_one_newline_and_holds_no_python(renderer, case):
    text = render(renderer, EXAMPLES.case(case)[1])
    assert text.endswith("\n")
    assert not text.endswith("\n\n")
    assert not re.search(r"\b(nan|NaN|inf|Infinity|None|True|False)\b|\bnumpy\b|np\.", text)
    assert "\r" not in text


@everything
def test_says_verdict_and_reason_of_every_parameter(renderer, case):
    text = " ".join(render(renderer, EXAMPLES.case(case)[1]).split())
    for model in EXAMPLES.case(case)[1]["models"]:
        for parameter in model["parameters"]:
            assert parameter["symbol"] in text
            assert re.search(parameter["verdict"].replace("_", "[_ ]"), text)
            plain = re.escape(parameter["reason"]).replace(r"\|", r"\\?\|")
            assert re.search(re.sub("([<>])", r"\\\\?\1", plain), text)


@everything
def test_says_what_was_skipped_and_warned_of(renderer, case):
    text = " ".join(render(renderer, EXAMPLES.case(case)[1]).split())
    document = EXAMPLES.case(case)[1]
    for sentence in [*(s["reason"] for s in document["skipped"]), *document["warnings"]]:
        assert sentence in text
