"""Rounding: tables worked out by hand by the convention of two digits of the standard error, and laws."""

from __future__ import annotations

import math
from decimal import Decimal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexid_cli.report.numbers import (
    MISSING,
    Rounded,
    format_level,
    format_percent,
    format_significant,
    round_estimate,
)

INF, NAN = math.inf, math.nan


@pytest.mark.parametrize(
    ("value", "stderr", "low", "high", "expected"),
    [
        # the paper's Table 1 and 2
        (174.7996, 1.38705, 172.0255, 177.5737, ("174.8", "1.4", "172.0", "177.6")),
        (20341.0458, 218.57845, 19903.8889, 20778.2027, ("20340", "220", "19900", "20780")),
        (-0.7241, 0.5974, -1.9189, 0.4707, ("-0.72", "0.60", "-1.92", "0.47")),
        (0.0021, 5.455e-5, 0.00199, 0.00221, ("0.002100", "0.000055", "0.001990", "0.002210")),
        (1246.569, 82.568, 1081.4, 1411.7, ("1247", "83", "1081", "1412")),
        # the standard error keeps two digits when it rounds up to the next power of ten
        (1.23456, 0.0996, None, None, ("1.23", "0.10", MISSING, MISSING)),
        (1.23456, 0.0994, None, None, ("1.235", "0.099", MISSING, MISSING)),
        (1234.5, 99.6, None, None, ("1230", "100", MISSING, MISSING)),
        (20341.2, 44.4, 20254.2, 20428.2, ("20341", "44", "20254", "20428")),
        # uncertainties writes 3.14159+/-0.00265 as 3.1416+/-0.0026 (half to even) with two digits
        (3.14159, 0.00265, None, None, ("3.1416", "0.0026", MISSING, MISSING)),
        # powers of ten are multiples of three and the same throughout
        (1.2e-5, 3e-7, 1.14e-5, 1.26e-5, ("12.00e-6", "0.30e-6", "11.40e-6", "12.60e-6")),
        (2.03e9, 1.2e7, 2.006e9, 2.054e9, ("2.030e9", "0.012e9", "2.006e9", "2.054e9")),
        (0.001, 1e-4, None, None, ("0.00100", "0.00010", MISSING, MISSING)),
        (9999999.0, 12.0, None, None, ("9999999", "12", MISSING, MISSING)),
        # an estimate far below its standard error
        (1e-12, 1000.0, None, None, ("0", "1000", MISSING, MISSING)),
        (-0.01, 1.0, None, None, ("0.0", "1.0", MISSING, MISSING)),
        # no standard error: four digits
        (5.0, 0.0, None, None, ("5.000", "0.000", MISSING, MISSING)),
        (123.456, None, None, None, ("123.5", MISSING, MISSING, MISSING)),
        (0.0, None, None, None, ("0", MISSING, MISSING, MISSING)),
        # what is missing is a dash
        (None, None, None, None, (MISSING,) * 4),
        (NAN, INF, -INF, NAN, (MISSING,) * 4),
        (1.0, 0.1, -INF, 1.2, ("1.00", "0.10", MISSING, "1.20")),
    ],
)
def test_round_estimate(value, stderr, low, high, expected):
    assert round_estimate(value, stderr, low, high) == Rounded(*expected)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (5.398, "5.398"), (350.87719, "350.9"), (30.0, "30"), (100.0, "100"), (99999.6, "100000"),
        (1234567.0, "1235000"), (12345678.0, "12.35e6"), (1e-5, "10e-6"), (0.05, "0.05"), (0.0, "0"),
        (-0.0, "0"), (-3.1648, "-3.165"), (1e9, "1e9"), (None, MISSING), (NAN, MISSING), (-INF, MISSING),
    ],
)  # fmt: skip
def test_format_significant(value, text):
    assert format_significant(value) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.7952, "0.80"), (1.0746, "1.1"), (27.1137, "27"), (82.5056, "83"), (99.7, "100"), (157.0, "160"),
        (1200.0, ">999"), (0.0456, "0.046"), (0.0001, "<0.001"), (0.0, "0"), (None, MISSING), (INF, MISSING),
    ],
)  # fmt: skip
def test_format_percent(value, text):
    assert format_percent(value) == text


def test_level_is_a_percentage():
    assert [format_level(level) for level in (0.95, 0.99, 0.999, None)] == ["95 %", "99 %", "99.9 %", MISSING]


finite = st.floats(allow_nan=False, allow_infinity=False)
positive = st.floats(min_value=1e-300, max_value=1e300)


@given(finite, positive, finite, finite)
def test_all_four_numbers_share_decimals_and_power(value, stderr, low, high):
    rounded = round_estimate(value, stderr, low, high)
    texts = (rounded.estimate, rounded.stderr, rounded.low, rounded.high)
    assert len({_decimals(text) for text in texts}) == 1
    assert len({text.partition("e")[2] for text in texts}) == 1
    assert int(texts[0].partition("e")[2] or "0") % 3 == 0


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e6))
def test_rounding_errs_by_less_than_a_twentieth_of_the_standard_error(value, stderr):
    rounded = round_estimate(value, stderr)
    # half a unit of the second digit of a standard error that is at least 10 of those units
    assert abs(Decimal(rounded.estimate) - Decimal(repr(value))) <= Decimal(repr(stderr)) / 20
    digits = rounded.stderr.partition("e")[0].replace(".", "").lstrip("0")
    assert digits.rstrip("0") == digits[:2].rstrip("0")


@given(finite, st.one_of(st.none(), st.floats()))
def test_numbers_are_never_written_as_python_writes_them(value, stderr):
    for text in (
        round_estimate(value, stderr).estimate,
        format_significant(value),
        format_percent(abs(value)),
    ):
        assert "E" not in text
        assert "e+" not in text
        assert "e-0" not in text
        assert not text.startswith("-0") or any(digit in text for digit in "123456789")


def _decimals(text: str) -> int:
    return len(text.partition("e")[0].partition(".")[2])
