"""Lines of plain numbers to arrays, compiled: one pass over the bytes that checks every one of them.

What is not plain (quotes, comments, words, more digits than a machine word holds) is refused, never guessed at; the
caller has slower ways for it. Numbers are rounded correctly, by Clinger's fast path (PLDI 1990) where mantissa and
power of ten are exact doubles, else by the algorithm of Eisel and Lemire (Lemire, Number parsing at a gigabyte per
second, Software: Practice and Experience 51, 2021).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexid_cli.jit import compiled

NOT_PLAIN = -1

_NEWLINE, _SPACE, _PLUS, _COMMA, _MINUS, _ZERO = (ord(c) for c in "\n +,-0")
_MOST_DIGITS = 19  # of any number below 2**64
_EXACT = np.uint64(1 << 53)  # integers up to here are doubles
_TENS = 10.0 ** np.arange(23)  # the powers of ten that are doubles
_LOWEST, _HIGHEST = -342, 308  # powers of ten beyond which every number of 19 digits is zero or infinite
_LARGEST_EXPONENT = 10_000  # longer exponents need not be told apart
_NO_DOUBLE = np.uint64(2**64 - 1)
_NO_NUMBER, _INTEGER, _REAL, _EMPTY = range(4)  # what a field is
_ONE = np.uint64(1)


def _fives() -> NDArray[np.uint64]:
    """First 128 bits of 5**q, rounded down, and up where q is negative; shape (651, 2), high word first."""
    rows = []
    for q in range(_LOWEST, _HIGHEST + 1):
        if q >= 0:
            size = (5**q).bit_length()
            bits = 5**q << (128 - size) if size <= 128 else 5**q >> (size - 128)
        else:
            size = (5**-q).bit_length()
            bits = (1 << (127 + size)) // 5**-q + 1
        rows.append((bits >> 64, bits & (2**64 - 1)))
    return np.array(rows, dtype=np.uint64)


_FIVES = _fives()


@compiled
def _product(a, b):  # type: ignore[no-untyped-def]
    """High and low word of the product of two words."""
    half, low = np.uint64(32), np.uint64(0xFFFFFFFF)
    a1, a0, b1, b0 = a >> half, a & low, b >> half, b & low
    middle = a1 * b0 + ((a0 * b0) >> half)
    other = a0 * b1 + (middle & low)
    return a1 * b1 + (middle >> half) + (other >> half), a * b


@compiled
def _rounded(mantissa, power):  # type: ignore[no-untyped-def]
    """Bits of the double nearest to mantissa * 10**power; ``_NO_DOUBLE`` where that is no normal one."""
    if power < _LOWEST or power > _HIGHEST:
        return _NO_DOUBLE
    shift = np.int64(0)
    for step in (32, 16, 8, 4, 2, 1):
        if mantissa < (_ONE << np.uint64(64 - step)):
            mantissa <<= np.uint64(step)
            shift += step
    high, low = _product(mantissa, _FIVES[power - _LOWEST, 0])
    if (high & np.uint64(0x1FF)) == np.uint64(0x1FF):
        more, _ = _product(mantissa, _FIVES[power - _LOWEST, 1])
        low += more
        if low < more:
            high += _ONE
    top = np.int64(high >> np.uint64(63))
    digits = high >> np.uint64(top + 9)
    exponent = ((217706 * power) >> 16) + 63 + top - shift + 1023
    # Just between two doubles, which can be in this range only: to the even one.
    between = low <= _ONE and -4 <= power <= 23 and (digits << np.uint64(top + 9)) == high
    if between and (digits & np.uint64(3)) == _ONE:
        digits &= ~_ONE
    digits = (digits + (digits & _ONE)) >> _ONE
    if digits >= np.uint64(1 << 53):
        digits = np.uint64(1 << 52)
        exponent += 1
    if exponent <= 0 or exponent > 2046:
        return _NO_DOUBLE
    return (digits & np.uint64((1 << 52) - 1)) | (np.uint64(exponent) << np.uint64(52))


@compiled
def _digits(text, i, mantissa):  # type: ignore[no-untyped-def]
    """Append the digits from ``i`` on to the mantissa; return where they end, and it."""
    while np.uint8(text[i] - _ZERO) < 10:
        mantissa = mantissa * np.uint64(10) + np.uint64(text[i] - _ZERO)
        i += _ONE
    return i, mantissa


@compiled
def _exponent(text, i):  # type: ignore[no-untyped-def]
    """Exponent whose sign or first digit is at ``i``; where it ends, and it; it ends at ``i`` where there is none."""
    start, exponent = i, np.int64(0)
    below = text[i] == _MINUS
    if below or text[i] == _PLUS:
        i += _ONE
    first = i
    while np.uint8(text[i] - _ZERO) < 10:
        exponent = min(exponent * 10 + np.int64(text[i] - _ZERO), np.int64(_LARGEST_EXPONENT))
        i += _ONE
    return start if i == first else i, -exponent if below else exponent


@compiled
def _number(text, i, decimal):  # type: ignore[no-untyped-def]
    """Read the number at ``i``, behind its sign; return where it ends, what it is, its mantissa and power of ten."""
    first = i
    i, mantissa = _digits(text, i, np.uint64(0))
    before, power, kind = np.int64(i - first), np.int64(0), _INTEGER
    if text[i] == decimal:
        start = i + _ONE
        i, mantissa = _digits(text, start, mantissa)
        power, kind = -np.int64(i - start), _REAL
        if decimal == _COMMA and (before == 0 or power == 0):  # it may be a field and a separator
            return i, _NO_NUMBER, mantissa, power
    count = before - power
    while count > _MOST_DIGITS and (text[first] == _ZERO or text[first] == decimal):
        count -= text[first] == _ZERO
        first += _ONE
    if count == 0 or count > _MOST_DIGITS:
        return i, _NO_NUMBER, mantissa, power
    if text[i] == 69 or text[i] == 101:  # E, e
        start = i + _ONE
        i, exponent = _exponent(text, start)
        power, kind = power + exponent, _NO_NUMBER if i == start else _REAL
    return i, kind, mantissa, power


@compiled
def _is_nan(text, i):  # type: ignore[no-untyped-def]
    """Whether nan, NaN or NAN stands at ``i``."""
    if text[i] == 110:
        return text[i + _ONE] == 97 and text[i + np.uint64(2)] == 110
    return text[i] == 78 and (text[i + _ONE] | 32) == 97 and text[i + np.uint64(2)] == 78


@compiled
def _field(text, i, end, decimal, spaced):  # type: ignore[no-untyped-def]
    """Read a field; return where the next begins, what it is, whether it is negative, mantissa and power of ten."""
    while spaced and text[i] == _SPACE:
        i += _ONE
    mantissa, power, negative, kind = np.uint64(0), np.int64(0), False, _EMPTY
    if _is_nan(text, i):
        i += np.uint64(3)
    elif text[i] != end:
        negative = text[i] == _MINUS
        if negative or text[i] == _PLUS:
            i += _ONE
        i, kind, mantissa, power = _number(text, i, decimal)
    while spaced and text[i] == _SPACE:
        i += _ONE
    return i + _ONE, kind if text[i] == end else _NO_NUMBER, negative, mantissa, power


@compiled
def _behind(text, i, end, delimiter):  # type: ignore[no-untyped-def]
    """Where the next field begins, behind one that is not wanted; 0 where a character is in the way."""
    while text[i] != end:
        if text[i] < _PLUS or text[i] == delimiter:
            return np.uint64(0)
        i += _ONE
    return i + _ONE


@compiled
def _float(negative, mantissa, power):  # type: ignore[no-untyped-def]
    """The double nearest to a number, as its bits; ``_NO_DOUBLE`` where it is none that is normal or zero."""
    bits = np.uint64(0)
    if mantissa != 0:
        bits = _rounded(mantissa, power)
        if bits == _NO_DOUBLE:
            return bits
    return bits | (np.uint64(negative) << np.uint64(63))


@compiled
def _parse(text, delimiter, decimal, places, values, words, integers):  # type: ignore[no-untyped-def]
    """Read whole lines, each of ``len(places)`` fields.

    Parameters
    ----------
    text : ndarray of uint8
        Lines, each with a line feed at its end.
    delimiter, decimal : int
        Between the fields, and in the numbers.
    places : ndarray of int64, shape (fields,)
        Row of ``values`` for each field, or -1 where it is not wanted; such a field may hold any text without a
        character below the plus sign.
    values, words : ndarray of float64 and of int64, shape (columns, lines)
        The same memory: numbers, as int64 while all fields of the column are integers. An empty field is NaN.
    integers : ndarray of bool, shape (columns,)
        Set: whether all fields of a column are integers.

    Returns
    -------
    int
        Number of lines, or ``NOT_PLAIN``.
    """
    width, size, i, line = len(places), np.uint64(len(text)), np.uint64(0), 0
    while i < size:
        for field in range(width):
            end = delimiter if field < width - 1 else _NEWLINE
            column = places[field]
            if column < 0:
                i = _behind(text, i, end, delimiter)
                if i == 0:
                    return NOT_PLAIN
                continue
            start, mantissa, power, kind = i, np.uint64(0), np.int64(0), _INTEGER
            negative = text[i] == _MINUS
            if negative:
                i += _ONE
            first = i
            while np.uint8(text[i] - _ZERO) < 10:
                mantissa = mantissa * np.uint64(10) + np.uint64(text[i] - _ZERO)
                i += _ONE
            count = np.int64(i - first)
            if text[i] == decimal and text[i] != end:
                i += _ONE
                first, kind = i, _REAL
                while np.uint8(text[i] - _ZERO) < 10:
                    mantissa = mantissa * np.uint64(10) + np.uint64(text[i] - _ZERO)
                    i += _ONE
                power = -np.int64(i - first)
            if text[i] == end and 0 < count < _MOST_DIGITS + power and (power or kind == _INTEGER):
                i += _ONE
            else:  # what most tables have nowhere
                i, kind, negative, mantissa, power = _field(text, start, end, decimal, delimiter != _SPACE)
            if kind == _NO_NUMBER or (kind == _EMPTY and width == 1):
                return NOT_PLAIN
            if integers[column]:
                if kind == _INTEGER and not (negative and mantissa == 0):
                    if mantissa >> np.uint64(63):
                        return NOT_PLAIN
                    words[column, line] = -np.int64(mantissa) if negative else np.int64(mantissa)
                    continue
                integers[column] = False
                for k in range(line):
                    values[column, k] = np.float64(words[column, k])
            if kind == _EMPTY:
                values[column, line] = np.nan
            elif mantissa <= _EXACT and -22 <= power <= 22:
                value = np.float64(mantissa)
                value = value / _TENS[-power] if power < 0 else value * _TENS[power]
                values[column, line] = -value if negative else value
            else:
                bits = _float(negative, mantissa, power)
                if bits == _NO_DOUBLE:
                    return NOT_PLAIN
                words[column, line] = np.int64(bits)
        line += 1
    return line


def read_numbers(
    text: bytes, delimiter: str, decimal: str, width: int, wanted: tuple[int, ...]
) -> tuple[int, dict[int, NDArray[Any]]] | None:
    """Number of lines and the wanted columns of a block of whole lines; None where it is not plain.

    Parameters
    ----------
    text : bytes
        Whole lines.
    delimiter, decimal : str
        One character each.
    width : int
        Fields of every line.
    wanted : tuple of int
        Fields from 0.

    Returns
    -------
    tuple of int and dict of int to ndarray of int64 or float64, shape (lines,), or None
    """
    if not text.endswith(b"\n"):
        return None
    marks = np.frombuffer(text, dtype=np.uint8)
    lines = int(np.count_nonzero(marks == _NEWLINE))
    places = np.full(width, -1, dtype=np.int64)
    places[list(wanted)] = np.arange(len(wanted))
    values = np.empty((len(wanted), lines))
    words, integers = values.view(np.int64), np.ones(len(wanted), dtype=np.bool_)
    found = _parse(marks, ord(delimiter), ord(decimal), places, values, words, integers)
    if found == NOT_PLAIN:
        return None
    return found, {place: (words if integers[row] else values)[row] for row, place in enumerate(wanted)}
