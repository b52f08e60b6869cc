"""Decoded numbers of a batch, in parts and joined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from numbers import Integral
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flexid_cli.readers.messages import LARGEST_EXACT
from flexid_cli.readers.path import Leaf

_INT64 = 2**63


@dataclass(frozen=True)
class Decoded:
    """The numbers of one batch.

    Attributes
    ----------
    values : dict of Leaf to ndarray of float64, shape (m,)
        May be a view into the batch's buffer: copy what is to outlive it.
    rows : dict of Leaf to ndarray of int64, shape (m,)
        Number of each value's message in the batch, ascending.
    header_stamp : ndarray of int64, shape (n,), or None
        The messages' own stamps in nanoseconds; None where a message has none. Zero for bad messages.
    bad : ndarray of bool, shape (n,)
        Messages whose payload cannot be decoded.
    integral : dict of Leaf to bool
        Whether all values of the leaf are integers that int64 holds.
    exact : dict of Leaf to ndarray of int64, shape (m,)
        The values as integers, of leaves that are integral and beyond 2^53 somewhere.
    reason : str
        Why the first bad message cannot be decoded.
    """

    values: dict[Leaf, NDArray[np.float64]]
    rows: dict[Leaf, NDArray[np.int64]]
    header_stamp: NDArray[np.int64] | None
    bad: NDArray[np.bool_]
    integral: dict[Leaf, bool] = field(default_factory=dict)
    exact: dict[Leaf, NDArray[np.int64]] = field(default_factory=dict)
    reason: str = ""


class Series(NamedTuple):
    """Values of one leaf in some messages of a batch; rows count in the batch."""

    rows: NDArray[np.int64]
    values: NDArray[np.float64]
    integral: bool
    exact: NDArray[np.int64] | None = None


class Part(NamedTuple):
    """Some messages of a batch, decoded; ``stamps`` is None where one of them has none."""

    members: NDArray[np.int64]
    series: dict[Leaf, Series]
    stamps: NDArray[np.int64] | None


def column_series(members: NDArray[np.int64], numbers: NDArray[Any]) -> Series:
    """Return numbers in their own type as a series."""
    values = numbers if numbers.dtype == np.float64 else numbers.astype(np.float64)
    if numbers.dtype.kind not in "iu":
        return Series(members, values, integral=False)
    whole, exact = True, None
    if numbers.dtype.itemsize == 8:
        integers = _whole(numbers)
        whole = integers is not None
        if integers is not None and bool(np.any((integers > LARGEST_EXACT) | (integers < -LARGEST_EXACT))):
            exact = integers
    return Series(members, values, whole, exact)


def _whole(numbers: NDArray[Any]) -> NDArray[np.int64] | None:
    """Return ``numbers`` as int64, or None where one does not fit."""
    if numbers.dtype.kind == "u" and numbers.dtype.itemsize == 8 and bool((numbers >= _INT64).any()):
        return None
    return numbers.astype(np.int64)


def listed_series(rows: NDArray[np.int64], values: Sequence[Any]) -> Series:
    """Return numbers of Python, with None for a null, as a series."""
    kinds = set(map(type, values))
    if kinds == {float}:
        return Series(rows, np.array(values, dtype=np.float64), integral=False)
    numbers = np.array([np.nan if value is None else float(value) for value in values], dtype=np.float64)
    integral = not any(kind is bool or kind is np.bool_ or not issubclass(kind, Integral) for kind in kinds)
    exact = None
    if integral and bool(np.any(np.abs(numbers) >= LARGEST_EXACT)):
        integers = [int(value) for value in values]
        integral = min(integers) >= -_INT64 and max(integers) < _INT64
        exact = np.array(integers, dtype=np.int64) if integral else None
    return Series(rows, numbers, integral, exact)


def join(count: int, parts: Sequence[Part], reason: str = "") -> Decoded:
    """Put the parts of a batch of ``count`` messages together; messages in no part are bad."""
    if len(parts) == 1 and parts[0].members.size == count:
        return _whole_part(parts[0])
    found = sum(part.members.size for part in parts)
    bad = np.zeros(count, dtype=np.bool_)
    if found < count:
        bad[:] = True
        for part in parts:
            bad[part.members] = False
    decoded = Decoded({}, {}, _stamps(count, parts), bad, reason=reason if found < count else "")
    leaves = (
        parts[0].series if len(parts) == 1 else dict.fromkeys(leaf for part in parts for leaf in part.series)
    )
    for leaf in leaves:
        series = _joined([part.series[leaf] for part in parts if leaf in part.series])
        decoded.values[leaf], decoded.rows[leaf] = series.values, series.rows
        decoded.integral[leaf] = series.integral
        if series.exact is not None:
            decoded.exact[leaf] = series.exact
    return decoded


def _whole_part(part: Part) -> Decoded:
    """Return a part that holds all messages of its batch."""
    decoded = Decoded({}, {}, part.stamps, np.zeros(part.members.size, dtype=np.bool_))
    for leaf, (rows, values, integral, exact) in part.series.items():
        decoded.values[leaf], decoded.rows[leaf], decoded.integral[leaf] = values, rows, integral
        if exact is not None:
            decoded.exact[leaf] = exact
    return decoded


def _stamps(count: int, parts: Sequence[Part]) -> NDArray[np.int64] | None:
    if any(part.stamps is None for part in parts if part.members.size):
        return None
    stamps = np.zeros(count, dtype=np.int64)
    for part in parts:
        if part.stamps is not None:
            stamps[part.members] = part.stamps
    return stamps


def _joined(series: Sequence[Series]) -> Series:
    if len(series) == 1:
        return series[0]
    rows = np.concatenate([one.rows for one in series])
    order = np.argsort(rows, kind="stable")
    values = np.concatenate([one.values for one in series])[order]
    integral = all(one.integral for one in series)
    exact = None
    if integral and any(one.exact is not None for one in series):
        whole = [one.values.astype(np.int64) if one.exact is None else one.exact for one in series]
        exact = np.concatenate(whole)[order]
    return Series(rows[order], values, integral, exact)
