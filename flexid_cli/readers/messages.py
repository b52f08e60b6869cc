"""Numbers inside decoded messages: finding them, and taking them out message by message."""

from __future__ import annotations

import dataclasses
import keyword
from collections.abc import Iterator, Sequence
from numbers import Integral, Real
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from flexid_cli.errors import InputError
from flexid_cli.readers.path import Leaf, Step, canonical

LARGEST_EXACT = 2**53  # every integer up to here is a float64
LONGEST_ARRAY = 1024  # elements; longer ones are images and scans, not signals of a drive
_NAME_FIELDS = ("name", "names", "joint_names")
STAMP_FIELDS = (("sec", "nanosec"), ("sec", "nsec"), ("secs", "nsecs"), ("seconds", "nanos"))
STAMP_PLACES: tuple[tuple[Step, ...], ...] = (("header", "stamp"), ("stamp",), ("timestamp",))


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
    steps = stamp_steps(message)
    if steps is None:
        return None
    seconds, nanoseconds = (follow(message, part) for part in steps)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def stamp_steps(message: Any) -> tuple[tuple[Step, ...], tuple[Step, ...]] | None:
    """Return the steps to the seconds and the nanoseconds of the message's own stamp, or None."""
    for place in STAMP_PLACES:
        fields = _stamp_fields(follow(message, place))
        if fields is not None:
            return (*place, fields[0]), (*place, fields[1])
    return None


def _stamp_fields(node: Any) -> tuple[str, str] | None:
    if node is MISSING or node is None or isinstance(node, str | bytes):
        return None
    for coarse, fine in STAMP_FIELDS:
        if isinstance(child(node, coarse), Integral) and isinstance(child(node, fine), Integral):
            return coarse, fine
    return None


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
    elif _stamp_fields(node) is None:
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


class Picker:
    """Finds one channel's number in decoded messages.

    Parameters
    ----------
    leaf : Leaf
        Where the number stands.
    named : dict, optional
        Name that stands at the place of each leaf that has a place but no name; shared by all pickers of one
        recording, so that a change of names between two files is noticed too.
    """

    def __init__(self, leaf: Leaf, named: dict[Leaf, str] | None = None) -> None:
        self.leaf = leaf
        self._named = {} if named is None else named
        self._known_names: Any = None
        self._place: int | None = None

    def pick(self, message: Any) -> Any:
        """Return the number, None for a null, or MISSING.

        Raises
        ------
        InputError
            A text stands where a number is expected, or names and numbers do not match.
        """
        steps = self.steps(message)
        value = MISSING if steps is None else follow(message, steps)
        if value is MISSING or value is None or _is_number(value):
            return value
        raise InputError(
            f"channel {canonical(self.leaf)!r}: a message has {str(value)[:40]!r} where a number is expected"
        )

    def steps(self, message: Any) -> tuple[Step, ...] | None:
        """Return the steps to the number in ``message``, or None where an array of names says it lacks it.

        Raises
        ------
        InputError
            Names and numbers do not match.
        """
        leaf = self.leaf
        if leaf.names is None:
            return leaf.steps
        numbers = follow(message, leaf.steps[:-1])
        if not _is_array(numbers) or len(numbers) == 0:
            return None
        place = self._named_place(follow(message, leaf.names), len(numbers))
        return None if place is None else (*leaf.steps[:-1], place)

    def _named_place(self, names: Any, length: int) -> int | None:
        """Place of this channel's joint in a message with ``names`` and as many numbers."""
        if not _is_array(names) or len(names) == 0:
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
        if len(names) == length:
            before, now = self._named.setdefault(leaf, names[place]), names[place]
            if before != now:
                raise InputError(
                    f"channel {canonical(leaf)!r} is {before!r} in some messages and {now!r} in others",
                    f"use the name: {leaf.topic}/{before}/{leaf.steps[-2]}",
                )
        return place


def needs_integers(integers: NDArray[np.int64]) -> bool:
    """Whether float64 cannot hold every one of ``integers``."""
    large = integers[(integers > LARGEST_EXACT) | (integers < -LARGEST_EXACT)]
    rounded = large.astype(np.float64)
    beyond = rounded >= 2.0**63  # the largest integers round up to a number that int64 does not have
    return bool(np.any(beyond) or np.any(rounded.astype(np.int64) != large))
