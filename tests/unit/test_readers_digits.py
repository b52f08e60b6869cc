"""Numbers of plain tables: every one as Python reads it, to the last bit; what is not plain is refused."""

from __future__ import annotations

import math
import random
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexid_cli.readers.digits import read_numbers


def column(texts: list[str]) -> np.ndarray | None:
    """One column as the reader reads it; a second one keeps its fields apart from blank lines."""
    found = read_numbers("".join(f"0,{text}\n" for text in texts).encode(), ",", ".", 2, (1,))
    return None if found is None else found[1][1]


def midpoint(rng: random.Random) -> str:
    """A number of at most 19 digits just between two doubles, written out or with a power of ten."""
    odd = 2 * (rng.getrandbits(53) | (1 << 52)) + 1
    shift = rng.randint(0, 1)
    exact = odd * 5**shift
    assert Fraction(exact, 10**shift) == Fraction(odd, 2**shift)
    return f"{exact}e-{shift}"


def text_of(rng: random.Random) -> str:
    kind = rng.randrange(6)
    if kind == 0:
        return repr(rng.gauss(0.0, 1.0) * 10.0 ** rng.randint(-300, 300))
    if kind == 1:
        return f"{rng.gauss(0.0, 1.0) * 10.0 ** rng.randint(-250, 250):.18e}"
    if kind == 2:
        return f"{rng.randint(0, 10**19 - 1)}e{rng.randint(-300, 280)}"
    if kind == 3:
        return midpoint(rng)
    if kind == 4:
        return f"{rng.uniform(-1e5, 1e5):.{rng.randint(0, 12)}f}"
    return rng.choice(
        [".5", "5.", "-0.0", "-0", "+7", "1e22", "1e23", "000.000000000000000000001", "1E+05", "8.5e-15"]
    )


def test_every_number_is_rounded_correctly():
    rng = random.Random(20260101)
    texts = [*(text_of(rng) for _ in range(40_000)), "0.5"]
    values = column(texts)
    expected = np.array([float(text) for text in texts])
    assert values is not None
    assert np.array_equal(values.view(np.int64), expected.view(np.int64))


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1, max_size=40))
@settings(max_examples=100, deadline=None)
def test_doubles_survive_a_round_trip(numbers):
    values = column([repr(x) for x in numbers])
    if values is None:  # below the normal numbers, which is left to another way
        assert any(0.0 < abs(x) < 2.3e-308 for x in numbers)
    else:
        assert np.array_equal(values.view(np.int64), np.array(numbers).view(np.int64))


@given(st.lists(st.integers(-(2**63) + 1, 2**63 - 1), min_size=1, max_size=40))
@settings(max_examples=100, deadline=None)
def test_integers_stay_exact(numbers):
    values = column([str(x) for x in numbers])
    assert values is not None
    assert values.dtype == np.int64
    assert values.tolist() == numbers


def test_a_column_becomes_floats_where_it_must():
    for texts in (
        ["9007199254740993", "0.5"],
        ["3", "-0"],
        ["3", ""],
        ["4", "nan", "NaN", "NAN"],
        ["5", "1e3"],
    ):
        values = column(texts)
        expected = np.array([float(text or "nan") for text in texts])
        assert values is not None
        assert values.dtype == np.float64
        same = values.view(np.int64) == expected.view(np.int64)
        assert np.all(same | np.isnan(values) & np.isnan(expected))
    assert math.copysign(1.0, column(["3", "-0"])[1]) == -1.0


@pytest.mark.parametrize(
    "text",
    ["1,2,3\n", "1\n", "1,\n\n", "1,2", "1,x\n", "1,-\n", "1,1e\n", "1,1e+\n", "1,1.2.3\n", "1,.\n", "1,- 2\n",
     '1,"2"\n', "1,2 3\n", "#1,2\n", "1,2\r\n", "1,2\0\n", "1,+-2\n", "1,inf\n", "1,Nan\n", "1,nano\n", "1,1_0\n",
     "1,12345678901234567890\n", "1,9223372036854775808\n", "1,1e400\n", "1,1e-320\n", "1,0x10\n", "1,n\n"],
)  # fmt: skip
def test_what_is_not_plain_is_refused(text):
    assert read_numbers(text.encode(), ",", ".", 2, (0, 1)) is None


def test_fields_that_are_not_wanted_may_hold_words():
    found = read_numbers(b"1;abc;2\n3;x-y;4\n", ";", ".", 3, (2, 0))
    assert found is not None
    assert found[0] == 2
    assert found[1][0].tolist() == [1, 3]
    assert found[1][2].tolist() == [2, 4]
    for text in (b"1;a b;2\n", b'1;"a";2\n', b"1;abc\n", b"1;a;2;3\n"):
        assert read_numbers(text, ";", ".", 3, (0, 2)) is None
        assert read_numbers(text, ";", ".", 3, (0,)) is None


def test_decimal_comma_and_spaces():
    found = read_numbers(b" 1,5 ; -2 \n3,25;4\n", ";", ",", 2, (0, 1))
    assert found is not None
    assert found[1][0].tolist() == [1.5, 3.25]
    assert found[1][1].tolist() == [-2, 4]
    for text in (b"1,;2\n", b",5;2\n", b"1.5;2\n"):
        assert read_numbers(text, ";", ",", 2, (0, 1)) is None
    found = read_numbers(b"1 2\n3 4.5\n", " ", ".", 2, (0, 1))
    assert found is not None
    assert found[1][1].tolist() == [2.0, 4.5]
    assert read_numbers(b"1  2\n", " ", ".", 2, (0, 1)) is None
