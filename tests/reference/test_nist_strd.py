"""The project's least squares on NIST's Statistical Reference Datasets (linear regression).

Data and certified values: NIST/ITL StRD, https://www.itl.nist.gov/div898/strd/ (public domain). They are
stored as decimal numbers in ``nist_strd/*.json``; a first test solves every set in rational arithmetic, so
that neither a wrong datum nor a wrong certificate can hide behind the tolerance of the second one.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from decimal import Decimal, localcontext
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexid_cli.estimate.least_squares import solve

FOLDER = Path(__file__).with_name("nist_strd")
NAMES = [
    "norris", "pontius",
    "noint1", "noint2",
    "filip", "longley", "wampler1", "wampler2", "wampler3", "wampler4", "wampler5",
]  # fmt: skip
REQUIRED_DIGITS = 7
CERTIFIED_DIGITS = 15


@dataclass(frozen=True)
class DataSet:
    """One certified regression; every number is the exact decimal that NIST prints."""

    name: str
    observation_matrix: list[list[Fraction]]
    measurements: list[Fraction]
    estimate: list[Fraction]
    stderr: list[Fraction]
    residual_sd: Fraction

    @property
    def dof(self) -> int:
        return len(self.measurements) - len(self.estimate)


def load(name: str) -> DataSet:
    content = json.loads((FOLDER / f"{name}.json").read_text(), parse_float=Fraction, parse_int=Fraction)
    if content.get("intercept"):
        rows = [[Fraction(1), *row] for row in content["x"]]
    else:
        rows = [[x ** int(power) for power in content["powers"]] for x in content["x"]]
    certified = content["certified"]
    return DataSet(
        content["name"],
        rows,
        content["y"],
        certified["estimate"],
        certified["stderr"],
        certified["residual_sd"],
    )


def as_floats(values: list[Any]) -> np.ndarray:
    """Nearest double of every entry, so that a power of x carries one rounding and not several."""
    return np.array(values, dtype=object).astype(float)


def matching_digits(value: float, certified: float) -> float:
    """Log relative error, at most 15; log absolute error where the certified value is zero (NIST's rule)."""
    error = abs(value - certified) / (abs(certified) if certified else 1.0)
    if math.isnan(error):
        return 0.0
    return CERTIFIED_DIGITS if error == 0 else min(CERTIFIED_DIGITS, max(0.0, -math.log10(error)))


def invert(matrix: list[list[Fraction]]) -> list[list[Fraction]]:
    """Inverse by Gauss-Jordan elimination, without any rounding."""
    size = len(matrix)
    work = [[*row, *(Fraction(i == j) for j in range(size))] for i, row in enumerate(matrix)]
    for i in range(size):
        pivot = next(k for k in range(i, size) if work[k][i])
        work[i], work[pivot] = work[pivot], work[i]
        head = work[i][i]
        work[i] = [value / head for value in work[i]]
        for k in range(size):
            factor = work[k][i]
            if k != i and factor:
                work[k] = [a - factor * b for a, b in zip(work[k], work[i], strict=True)]
    return [row[size:] for row in work]


def dot(a: list[Fraction], b: list[Fraction]) -> Fraction:
    return sum((x * y for x, y in zip(a, b, strict=True)), Fraction(0))


def solve_exactly(data: DataSet) -> tuple[list[Fraction], list[Fraction], Fraction]:
    """Estimate, squared standard errors and squared residual standard deviation, without any rounding."""
    columns = [list(column) for column in zip(*data.observation_matrix, strict=True)]
    inverse = invert([[dot(a, b) for b in columns] for a in columns])
    projected = [dot(column, data.measurements) for column in columns]
    estimate = [dot(row, projected) for row in inverse]
    residuals = [
        y - dot(row, estimate) for row, y in zip(data.observation_matrix, data.measurements, strict=True)
    ]
    variance = dot(residuals, residuals) / data.dof
    return estimate, [variance * inverse[i][i] for i in range(len(inverse))], variance


def rounded(value: Fraction, *, root: bool = False) -> Decimal:
    """``value`` or its square root in 40 digits."""
    with localcontext(prec=40):
        decimal = Decimal(value.numerator) / Decimal(value.denominator)
        return decimal.sqrt() if root else decimal


def assert_same_to_last_digit(exact: Decimal, certified: Fraction) -> None:
    """One unit of the fifteenth digit is allowed: some certificates are cut off, not rounded."""
    reference = rounded(certified)
    unit = Decimal(1).scaleb(reference.adjusted() + 1 - CERTIFIED_DIGITS) if reference else Decimal(0)
    assert abs(exact - reference) <= unit


def test_every_stored_set_is_tested():
    assert sorted(NAMES) == sorted(path.stem for path in FOLDER.glob("*.json"))


@pytest.mark.parametrize("name", NAMES)
def test_data_and_certified_values_agree_in_exact_arithmetic(name: str):
    data = load(name)
    estimate, squared_stderr, variance = solve_exactly(data)
    for exact, certified in zip(estimate, data.estimate, strict=True):
        assert_same_to_last_digit(rounded(exact), certified)
    for exact, certified in zip(squared_stderr, data.stderr, strict=True):
        assert_same_to_last_digit(rounded(exact, root=True), certified)
    assert_same_to_last_digit(rounded(variance, root=True), data.residual_sd)


@pytest.mark.parametrize("name", NAMES)
def test_solver_reaches_the_certified_digits(name: str):
    data = load(name)
    result = solve(as_floats(data.observation_matrix), as_floats(data.measurements))

    estimate_digits = [
        matching_digits(float(got), float(want))
        for got, want in zip(result.estimate, data.estimate, strict=True)
    ]
    stderr_digits = [
        matching_digits(float(got), float(want)) for got, want in zip(result.stderr, data.stderr, strict=True)
    ]
    print(f"\n{data.name}: matching digits    estimate    standard error")
    for i, (in_estimate, in_stderr) in enumerate(zip(estimate_digits, stderr_digits, strict=True)):
        print(f"  {i:2d} {in_estimate:28.1f} {in_stderr:17.1f}")
    assert min(estimate_digits) >= REQUIRED_DIGITS
    assert min(stderr_digits) >= REQUIRED_DIGITS


@pytest.mark.parametrize(
    ("value", "certified", "digits"),
    [
        (1.001, 1.0, 3.0),
        (-2.0, -2.0, 15.0),
        (1e-9, 0.0, 9.0),
        (0.0, 0.0, 15.0),
        (5.0, 1.0, 0.0),
        (math.nan, 1.0, 0.0),
    ],
)
def test_matching_digits(value: float, certified: float, digits: float):
    assert matching_digits(value, certified) == pytest.approx(digits, abs=1e-9)
