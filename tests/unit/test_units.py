"""Conversion factors against the SI brochure's definitions, written down a second time."""

from __future__ import annotations

import math

import pytest

from flexid_cli.errors import UsageError
from flexid_cli.units import known_units, parse_unit

FACTORS = {
    "rad": 1.0, "mrad": 0.001, "deg": 2 * math.pi / 360, "arcmin": 2 * math.pi / 21600,
    "arcsec": 2 * math.pi / 1296000, "rev": 2 * math.pi,
    "m": 1.0, "mm": 0.001, "um": 0.000001, "nm": 0.000000001,
    "N.m": 1.0, "mN.m": 0.001, "kN.m": 1000.0, "N": 1.0, "mN": 0.001, "kN": 1000.0,
    "A": 1.0, "mA": 0.001, "V": 1.0, "mV": 0.001, "count": 1.0,
    "s": 1.0, "ms": 0.001, "us": 0.000001, "ns": 0.000000001,
}  # fmt: skip


@pytest.mark.parametrize(("name", "factor"), FACTORS.items())
def test_factor(name: str, factor: float) -> None:
    assert parse_unit(name).factor == pytest.approx(factor, rel=1e-15)
    assert parse_unit(f" {name} ").name == name


def test_every_unit_is_tested() -> None:
    assert set(known_units()) == set(FACTORS)


@pytest.mark.parametrize(
    ("spelling", "name"),
    [
        ("Nm", "N.m"),
        ("N·m", "N.m"),
        ("N*m", "N.m"),
        ("degrees", "deg"),
        ("°", "deg"),
        ("µm", "um"),
        ("counts", "count"),
    ],
)
def test_usual_spellings(spelling: str, name: str) -> None:
    assert parse_unit(spelling).name == name


def test_case_counts() -> None:
    with pytest.raises(UsageError) as caught:
        parse_unit("RAD")
    assert "'rad'" in caught.value.hint
    assert parse_unit("mN").dimension == "force"


def test_nanometre_is_no_newton_metre() -> None:
    assert parse_unit("nm").dimension == "length"
    assert parse_unit("Nm").dimension == "torque"


def test_unknown_unit_names_the_nearest() -> None:
    with pytest.raises(UsageError, match="unknown unit 'degre'") as caught:
        parse_unit("degre")
    assert "'deg'" in caught.value.hint


def test_known_units_by_dimension() -> None:
    assert known_units("current") == ["A", "mA"]
    assert known_units("force", "time")[:2] == ["N", "mN"]
