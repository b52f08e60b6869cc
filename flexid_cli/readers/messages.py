"""Numbers inside decoded messages: finding them, and taking them out message by message."""

from __future__ import annotations

import dataclasses
import keyword
from array import array
from collections.abc import Iterator, Sequence
from numbers import Integral, Real
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from flexid_cli.errors import InputError
from flexid_cli.readers.path import Leaf, Step, canonical

LONGEST_ARRAY = 1024  # elements; longer ones are images and scans, not signals of a drive
_NAME_FIELDS = ("name", "names", "joint_names")
_STAMP_FIELDS = (("sec", "nanosec"), ("sec", "nsec"), ("secs", "nsecs"), ("seconds", "nanos"))
_STAMP_PLACES: tuple[tuple[Step, ...], ...] = (("header", "stamp"), ("stamp",), ("timestamp",))


class _Missing:
    """Marks a field or an element that a message does not have."""


MISSING: Final = _Missing()


def child(node: Any, step: Step) -> Any:
    """Return the field or element ``step`` of ``node``, or MISSING."""
    if isinstance(step, int):
        if not _is_array(node):
            return MISSING
        return node[step] if -len(node) <= step < len(node) else MISSING
    if isinstance(node, dict):
        return node.get(step, MISSING)
    value = getattr(node, step, MISSING)
    return getattr(node, f"{step}_", MISSING) if value is MISSING and keyword.iskeyword(step) else value


def follow(node: Any, steps: Sequence[Step]) -> Any:
    """Return what stands at ``steps`` below ``node``, or MISSING."""
    for step in steps:
        node = child(node, step)
        if node is MISSING:
            return MISSING
    return node


def stamp_ns(message: Any) -> int | None:
    """Return the message's own stamp in nanoseconds, or None where it has none.

    Looked for are ``header.stamp``, ``stamp`` and ``timestamp``, as seconds and nanoseconds in the spellings
    of ROS 1, ROS 2, Foxglove's JSON schemas and ``google.protobuf.Timestamp``.
    """
    for place in _STAMP_PLACES:
        seconds, nanoseconds = _stamp_parts(follow(message, place))
        if seconds is not None and nanoseconds is not None:
            return int(seconds) * 1_000_000_000 + int(nanoseconds)
    return None


def _stamp_parts(node: Any) -> tuple[int | None, int | None]:
    if node is MISSING or node is None or isinstance(node, str | bytes):
        return None, None
    for coarse, fine in _STAMP_FIELDS:
        seconds, nanoseconds = child(node, coarse), child(node, fine)
        if isinstance(seconds, Integral) and isinstance(nanoseconds, Integral):
            return int(seconds), int(nanoseconds)
    return None, None


def leaves_of(topic: str, message: Any) -> Iterator[Leaf]:
    """Yield every number of ``message``; stamps, texts, and the frame of a header are left out."""
    yield from _walk(topic, message, (), None)


def _walk(
    topic: str, node: Any, steps: tuple[Step, ...], named: tuple[tuple[Step, ...], list[str]] | None
) -> Iterator[Leaf]:
    if _is_number(node):
        yield Leaf(topic, steps)
    elif _is_array(node):
        if len(node) > LONGEST_ARRAY:
            return
        for place in range(len(node)):
            if not _is_number(node[place]) and node[place] is not None:
                yield from _walk(topic, node[place], (*steps, place), named)
            elif named is not None and len(named[1]) == len(node):
                yield Leaf(topic, (*steps, place), named[1][place], named[0])
            else:
                yield Leaf(topic, (*steps, place))
    elif _stamp_parts(node) == (None, None):
        fields = _fields(node)
        named = _names(fields, steps) or named
        for name, value in fields.items():
            if steps or name != "header":
                yield from _walk(topic, value, (*steps, name), named)


def _names(fields: dict[str, Any], steps: tuple[Step, ...]) -> tuple[tuple[Step, ...], list[str]] | None:
    for field in _NAME_FIELDS:
        value = fields.get(field)
        if value is None or isinstance(value, str | np.ndarray) or not _is_array(value) or not len(value):
            continue
        if all(isinstance(name, str) and name for name in value) and len(set(value)) == len(value):
            return (*steps, field), list(value)
    return None


def _fields(node: Any) -> dict[str, Any]:
    if isinstance(node, dict):
        return {str(name): value for name, value in node.items()}
    if dataclasses.is_dataclass(node):
        names = [field.name for field in dataclasses.fields(node)]
        return {_plain(name): getattr(node, name) for name in names}
    descriptor = getattr(node, "DESCRIPTOR", None)
    if descriptor is None:
        return {}
    return {field.name: getattr(node, field.name) for field in descriptor.fields}


def _plain(name: str) -> str:
    """Undo the underscore that rosbags puts after fields which are words of Python."""
    return name[:-1] if name.endswith("_") and keyword.iskeyword(name[:-1]) else name


def _is_number(node: Any) -> bool:
    return isinstance(node, Real | np.bool_)


def _is_array(node: Any) -> bool:
    if isinstance(node, str | bytes | dict):
        return False
    return hasattr(node, "__len__") and hasattr(node, "__getitem__")


class Column:
    """The samples of one channel, gathered message by message.

    Parameters
    ----------
    leaf : Leaf
        Where the number stands.
    """

    def __init__(self, leaf: Leaf) -> None:
        self.leaf = leaf
        self._values = array("d")
        self._rows = array("q")
        self._integers: array[int] | None = array("q")
        self._known_names: Any = None
        self._place: int | None = None

    def take(self, message: Any, row: int) -> None:
        """Take this channel's number out of ``message``, the ``row``-th of its topic.

        Raises
        ------
        InputError
            A text stands where a number is expected, or names and numbers do not match.
        """
        value = self._pick(message)
        if value is MISSING:
            return
        if isinstance(value, float):  # a numpy float64 is one too
            self._integers = None
        elif value is None:
            self._integers, value = None, float("nan")
        elif isinstance(value, Integral) and not isinstance(value, bool | np.bool_):
            self._keep_integer(int(value))
        elif _is_number(value):
            self._integers = None
        else:
            raise InputError(
                f"channel {canonical(self.leaf)!r}: message {row + 1} of its topic has {str(value)[:40]!r} "
                "where a number is expected"
            )
        self._values.append(float(value))
        self._rows.append(row)

    def _pick(self, message: Any) -> Any:
        leaf = self.leaf
        if leaf.names is None:
            return follow(message, leaf.steps)
        numbers = follow(message, leaf.steps[:-1])
        if numbers is MISSING or len(numbers) == 0:
            return MISSING
        place = self._named_place(follow(message, leaf.names), len(numbers))
        return MISSING if place is None else numbers[place]

    def _named_place(self, names: Any, length: int) -> int | None:
        """Place of this channel's joint in a message with ``names`` and as many numbers."""
        if names is MISSING or len(names) == 0:
            names = []
        if names != self._known_names:
            self._place = self._find_place(list(names), length)
            self._known_names = names
        if names and len(names) != length:
            raise InputError(
                f"channel {canonical(self.leaf)!r}: a message has {len(names)} names but {length} numbers",
                "the node that records must send as many numbers as names, or none",
            )
        return self._place

    def _find_place(self, names: list[str], length: int) -> int | None:
        leaf = self.leaf
        if leaf.joint:
            if names.count(leaf.joint) > 1:
                raise InputError(
                    f"channel {canonical(leaf)!r}: a message of topic {leaf.topic!r} has the name "
                    f"{leaf.joint!r} twice"
                )
            return names.index(leaf.joint) if leaf.joint in names else None
        place = int(leaf.steps[-1])
        if not -length <= place < length:
            return None
        if names and self._known_names and self._place is not None:
            before, now = self._known_names[self._place], names[place] if len(names) == length else ""
            if before != now:
                raise InputError(
                    f"channel {canonical(leaf)!r} is {before!r} in some messages and {now!r} in others",
                    f"use the name: {leaf.topic}/{before}/{leaf.steps[-2]}",
                )
        return place

    def _keep_integer(self, value: int) -> None:
        if self._integers is None:
            return
        if -(2**63) <= value < 2**63:
            self._integers.append(value)
        else:
            self._integers = None

    @property
    def values(self) -> NDArray[np.float64]:
        """Samples, shape (n,)."""
        return np.array(self._values, dtype=np.float64)

    @property
    def rows(self) -> NDArray[np.int64]:
        """Number of each sample's message within its topic, shape (n,)."""
        return np.array(self._rows, dtype=np.int64)

    @property
    def integers(self) -> NDArray[np.int64] | None:
        """The samples as integers, shape (n,), where all of them are."""
        return None if self._integers is None else np.array(self._integers, dtype=np.int64)


def needs_integers(integers: NDArray[np.int64]) -> bool:
    """Whether float64 cannot hold every one of ``integers``."""
    large = integers[np.abs(integers.astype(np.float64)) > 2.0**53]
    return any(int(float(value)) != value for value in large.tolist())
