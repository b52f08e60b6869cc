"""Numbers for people: the only place that rounds. JSON never passes through here."""

from __future__ import annotations

import math
from dataclasses import dataclass
from decimal import ROUND_HALF_EVEN, Context, Decimal

MISSING = "–"
_DIGITS_OF_STDERR = 2
_DIGITS_WITHOUT_STDERR = 4
_DIGITS_OF_A_DOUBLE = 15
_SMALLEST_FIXED_EXPONENT = -3
_LARGEST_FIXED_EXPONENT = 6
_MOST_DECIMALS = 7
_LARGEST_PERCENT = 999  # a deviation of ten times the value: how much larger says nothing more
_CONTEXT = Context(prec=1000, rounding=ROUND_HALF_EVEN)


@dataclass(frozen=True)
class Rounded:
    """One estimate as text; every number has the same decimals and the same power of ten.

    Attributes
    ----------
    estimate, stderr, low, high : str
        An en dash where the number is missing.
    """

    estimate: str
    stderr: str
    low: str
    high: str


def round_estimate(
    value: float | None, stderr: float | None, low: float | None = None, high: float | None = None
) -> Rounded:
    """Round an estimate and its interval to two significant digits of the standard error.

    Numbers from 0.001 to 9,999,999 are written out; others get a power of ten that is a multiple of three
    (``12.00e-6``), the same for the four of them.

    Parameters
    ----------
    value, stderr, low, high : float or None
        None, NaN and infinity become an en dash. Without a standard error four digits of the value are kept.
    """
    given = [_decimal(number) for number in (value, stderr, low, high)]
    numbers = [number for number in given if number is not None]
    if not numbers:
        return Rounded(MISSING, MISSING, MISSING, MISSING)
    last = _last_digit(given[0], given[1], numbers)
    power = _power_of_ten(numbers, last)
    return Rounded(*(MISSING if n is None else _write(n, last, power) for n in given))


def format_significant(value: float | None, digits: int = _DIGITS_WITHOUT_STDERR) -> str:
    """Write a number that has no standard error (a frequency, an RMS) with at most ``digits`` digits."""
    number = _decimal(value)
    if number is None:
        return MISSING
    if not number:
        return "0"
    last = _last_digit_of(number, digits)
    power = _power_of_ten([number], last)
    mantissa, mark, exponent = _write(number, last, power).partition("e")
    if "." in mantissa:
        mantissa = mantissa.rstrip("0").rstrip(".")
    return mantissa + mark + exponent


def format_percent(value: float | None) -> str:
    """Write a relative standard deviation in percent with two digits, without the sign of percent."""
    number = _decimal(value)
    if number is None:
        return MISSING
    if number > _LARGEST_PERCENT:
        return f">{_LARGEST_PERCENT}"
    if number < Decimal("0.001"):
        return "<0.001" if number else "0"
    last = max(_last_digit_of(number, 2), -3)
    return _write(number, last, 0)


def format_level(level: float | None) -> str:
    """Write a confidence level as a percentage: ``95 %``."""
    return MISSING if level is None else f"{format_significant(100.0 * level, 6)} %"


def _decimal(value: float | None) -> Decimal | None:
    """Return the number as it prints (0.1 is 0.1); None where there is no finite number."""
    return None if value is None or not math.isfinite(value) else Decimal(repr(float(value)))


def _last_digit(value: Decimal | None, stderr: Decimal | None, numbers: list[Decimal]) -> int:
    """Power of ten of the last digit that is shown."""
    largest = max(abs(number) for number in numbers)
    if stderr is not None and stderr > 0:
        last = _last_digit_of(stderr, _DIGITS_OF_STDERR)
    else:
        last = _last_digit_of(value or largest, _DIGITS_WITHOUT_STDERR)
    return max(last, largest.adjusted() - _DIGITS_OF_A_DOUBLE + 1) if largest else last


def _last_digit_of(number: Decimal, digits: int) -> int:
    """Power of ten of the last of ``digits`` significant digits, where 0.0996 rounds to 0.10, not 0.100."""
    if not number:
        return 0
    last = number.adjusted() - digits + 1
    rounded = number.quantize(Decimal(1).scaleb(last), context=_CONTEXT)
    return last + (rounded.adjusted() - number.adjusted())


def _power_of_ten(numbers: list[Decimal], last: int) -> int:
    """Return 0 for numbers that are written out, else a multiple of three."""
    lead = max((number.adjusted() for number in numbers if number), default=0)
    fits = _SMALLEST_FIXED_EXPONENT <= lead <= _LARGEST_FIXED_EXPONENT
    return 0 if fits and -last <= _MOST_DECIMALS else 3 * math.floor(lead / 3)


def _write(number: Decimal, last: int, power: int) -> str:
    """Write ``number`` up to the digit 10**last, in units of 10**power."""
    rounded = number.quantize(Decimal(1).scaleb(last), context=_CONTEXT).scaleb(-power, context=_CONTEXT)
    if not rounded:
        rounded = abs(rounded)
    text = f"{rounded:f}"
    return f"{text}e{power}" if power else text
