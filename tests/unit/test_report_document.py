"""The document: valid by its schema whatever the estimates are, and the same from every container."""

from __future__ import annotations

import json
import math
import runpy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jsonschema
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexid_cli.estimate.result import Estimate, Fit, Identification, Interval
from flexid_cli.report.document import InputFile
from flexid_cli.report.json import render_json

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = SimpleNamespace(**runpy.run_path(str(ROOT / "tests" / "report_examples.py")))
SCHEMA = json.loads((ROOT / "flexid_cli/schemas/report-1.schema.json").read_text("utf-8"))
VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)
MODEL = EXAMPLES.model()


def strict_json(text: str) -> dict:
    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is not JSON")

    return json.loads(text, parse_constant=refuse)


def test_the_schema_is_a_schema():
    jsonschema.Draft202012Validator.check_schema(SCHEMA)


def test_every_field_of_the_schema_is_described_and_closed():
    for name, definition in SCHEMA["$defs"].items():
        assert definition["description"], name
        for field, rule in definition.get("properties", {}).items():
            assert (
                "$ref" in rule
                or rule.get("description")
                or "enum" in rule
                or "const" in rule
                or "oneOf" in rule
            ), field
        if name not in {"plain", "where"}:
            assert definition["additionalProperties"] is False, name


@pytest.mark.parametrize("name", sorted(EXAMPLES.CASES))
def test_examples_are_valid(name):
    _, document = EXAMPLES.case(name)
    VALIDATOR.validate(document)
    assert strict_json(render_json(document)) == document


def test_top_level_is_the_one_of_the_design():
    _, document = EXAMPLES.case("flexible")
    assert list(document) == [
        "schema", "tool", "inputs", "config", "recording", "models", "skipped", "diagnosis", "warnings",
        "citations",
    ]  # fmt: skip
    assert document["schema"] == "flexid-report/1"
    assert document["diagnosis"] is None


def test_numbers_keep_full_precision():
    _, document = EXAMPLES.case("flexible")
    stiffness = strict_json(render_json(document))["models"][0]["parameters"][1]
    assert stiffness["estimate"] == 20341.0458
    assert stiffness["stderr"] == 218.57845
    assert stiffness["ci"] == {
        "low": 20341.0458 - 1.96 * 218.57845,
        "high": 20341.0458 + 1.96 * 218.57845,
        "level": 0.95,
        "method": EXAMPLES.HAC,
    }


def test_same_report_from_every_container_but_for_inputs():
    identification = EXAMPLES.flexible()
    record = EXAMPLES.recording()
    clocks = tuple(replace(c, clock="column") for c in record.clocks)
    history = ("clock: column (time, configured)", *record.history[1:])
    column = replace(record, clocks=clocks, history=history)
    reader_note = EXAMPLES.INPUT.notes[0]
    mcap = EXAMPLES.document(identification, replace(record, notes=(reader_note, *record.notes)))
    csv = EXAMPLES.document(identification, column, (InputFile("run.csv", "ef" * 32, "csv"),))
    assert mcap["inputs"] != csv["inputs"]
    assert (mcap["inputs"][0]["clock"], csv["inputs"][0]["clock"]) == ("header_stamp", "column")
    assert csv["inputs"][0]["clock_reason"] == "time, configured"
    assert render_json(mcap | {"inputs": []}) == render_json(csv | {"inputs": []})


def test_one_input_takes_its_totals_from_the_motor_position():
    record = EXAMPLES.recording()
    clocks = (replace(record.clocks[0], samples=7), replace(record.clocks[1], samples=35000))
    entry = EXAMPLES.document(EXAMPLES.rigid(), replace(record, clocks=clocks))["inputs"][0]
    assert (entry["samples"], entry["duration"]) == (35000, 100.0)


def test_several_inputs_say_where_the_totals_stand():
    files = (InputFile("a.mcap", "ab" * 32, "mcap"), InputFile("b.mcap", "ac" * 32, "mcap", 10, 1.5))
    document = EXAMPLES.document(EXAMPLES.rigid(), inputs=files)
    VALIDATOR.validate(document)
    first, second = document["inputs"]
    assert first["samples"] is None
    assert "under recording" in first["notes"][0]
    assert (second["samples"], second["duration"], second["notes"]) == (10, 1.5, [])


def test_unknown_damage_has_a_reason():
    entry = EXAMPLES.document(EXAMPLES.rigid(), inputs=(InputFile("a", "ab" * 32, "csv"),))["inputs"][0]
    assert entry["damage"] is None
    assert entry["damage_reason"]


def test_a_recording_without_stamps_has_no_clock():
    document = EXAMPLES.document(EXAMPLES.rigid(), EXAMPLES.recording(clocks=()))
    VALIDATOR.validate(document)
    assert document["inputs"][0]["clock"] is None


def test_warnings_are_not_repeated():
    identification = Identification((), (), ("same", "other"))
    assert EXAMPLES.document(identification, EXAMPLES.recording(notes=("same",)))["warnings"] == [
        "same",
        "other",
    ]


def test_numpy_numbers_become_plain_ones():
    tests = {"whiteness": {"statistic": np.float64(2.5), "lags": np.int64(20), "passed": np.bool_(True),
                           "by_lag": np.array([1.0, math.nan])}}  # fmt: skip
    identification = Identification((replace(MODEL, tests=tests, rank=np.int64(9)),), (), ())
    document = EXAMPLES.document(identification)
    VALIDATOR.validate(document)
    whiteness = document["models"][0]["tests"]["whiteness"]
    assert whiteness == {"statistic": 2.5, "lags": 20, "passed": True, "by_lag": [1.0, None]}
    assert [type(value) for value in whiteness.values()] == [float, int, bool, list]


def test_what_is_not_data_is_refused():
    broken = replace(MODEL, tests={"whiteness": {"statistic": object()}})
    with pytest.raises(TypeError, match="object has no place in a report"):
        EXAMPLES.document(Identification((broken,), (), ()))


def test_a_path_that_is_not_utf8_can_be_written():
    document = EXAMPLES.document(EXAMPLES.rigid(), inputs=(InputFile("run\udcff.csv", "ab" * 32, "csv"),))
    assert document["inputs"][0]["path"] == "run\\udcff.csv"
    render_json(document).encode("utf-8")


def test_schema_refuses_an_identified_parameter_without_interval():
    _, document = EXAMPLES.case("rigid")
    document["models"][0]["parameters"][0]["ci"] = None
    assert not VALIDATOR.is_valid(document)


def test_schema_refuses_an_estimate_without_verdict_and_unknown_keys():
    _, document = EXAMPLES.case("rigid")
    del document["models"][0]["parameters"][0]["verdict"]
    assert not VALIDATOR.is_valid(document)
    _, document = EXAMPLES.case("rigid")
    document["models"][0]["parameters"][0]["colour"] = "red"
    assert not VALIDATOR.is_valid(document)


numbers = st.one_of(st.none(), st.floats())
nonnegative = st.one_of(st.none(), st.floats(min_value=0.0), st.just(math.nan))
intervals = st.one_of(
    st.none(), st.builds(Interval, st.floats(), st.floats(), st.floats(0.51, 0.999), st.just("HAC"))
)
estimates = st.builds(
    Estimate,
    name=st.just("joint_stiffness"),
    symbol=st.just("K"),
    unit=st.just("N.m/rad"),
    value=numbers,
    stderr=nonnegative,
    interval=intervals,
    relative_stderr_percent=nonnegative,
    verdict=st.sampled_from(["identified", "weak", "not_identifiable"]),
    reason=st.sampled_from(["", "too small"]),
)


@given(st.lists(estimates, max_size=3), st.floats(), st.floats(max_value=100.0))
@settings(max_examples=60, deadline=None)
def test_any_estimate_gives_valid_json(parameters, condition_number, fit_percent):
    result = replace(
        MODEL,
        parameters=tuple(parameters),
        correlation_names=("K", "JL"),
        correlation=np.array([[1.0, math.nan], [math.inf, 1.0]]),
        condition_number=abs(condition_number),
        fit=Fit(math.nan, math.inf, fit_percent, "N.m"),
        pipeline=EXAMPLES.pipeline(effective_band_hz=(0.0, math.nan), sign_cutoff_hz=math.inf),
        tests={"j_test": {"p_value": math.nan}},
    )
    document = EXAMPLES.document(Identification((result,), (), ()))
    written = strict_json(render_json(document))
    VALIDATOR.validate(written)
    for parameter, given_ in zip(written["models"][0]["parameters"], parameters, strict=True):
        if parameter["verdict"] == "identified":
            assert given_.verdict == "identified"
        else:
            assert parameter["reason"]
        if given_.value is None or not math.isfinite(given_.value):
            assert parameter["verdict"] == "not_identifiable"
