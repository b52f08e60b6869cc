"""Where the numbers stand in a serialised message: CDR and ROS 1 by their definitions, protobuf by its tags."""

from __future__ import annotations

import keyword
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexid_cli.readers.path import Step
from flexid_cli.readers.payloads import Payloads

Steps = tuple[Step, ...]
MOST_FIELDS = 20_000  # a message with more is not worth a layout: taking it apart costs more than it saves
_LIKELY_TEXT = 64  # bytes; shorter texts (frames, states) are mostly the same in all messages
_DTYPES = {
    "bool": "?",
    "byte": "i1",
    "int8": "i1",
    "char": "u1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float32": "f4",
    "float64": "f8",
}


class NoLayoutError(Exception):
    """The message cannot be taken apart here; the library's decoder can say what is in it."""


class Number:
    """One number of a layout, in every message at the same place."""

    def read(self, payloads: Payloads) -> NDArray[Any]:
        """Return the number of every payload, shape (n,), in its own type."""
        raise NotImplementedError


@dataclass(frozen=True)
class Fixed(Number):
    """A number of fixed size.

    Attributes
    ----------
    offset : int
        Its first byte.
    dtype : str
        NumPy's name of its type with the order of bytes.
    """

    offset: int
    dtype: str

    def read(self, payloads: Payloads) -> NDArray[Any]:
        """Return the number of every payload, shape (n,), in its own type."""
        if self.dtype.endswith("?"):
            return np.asarray(payloads.column(self.offset, "u1") != 0)
        return payloads.column(self.offset, self.dtype)


@dataclass(frozen=True)
class Constant(Number):
    """A number that all messages of the layout share: protobuf leaves out what has its default."""

    value: float | int | bool

    def read(self, payloads: Payloads) -> NDArray[Any]:
        """Return the number of every payload, shape (n,), in its own type."""
        return np.full(payloads.count, self.value)


@dataclass
class Anatomy:
    """What was found in one message.

    Attributes
    ----------
    shape : list of (int, int, int)
        Bytes that decide where everything stands: first, end, and the bits that matter; ascending.
    scalars : dict
        Numbers by their steps.
    arrays : dict
        Runs of numbers by their steps: first byte, type, and how many.
    absent : dict of steps to Number
        Numbers that the message leaves out because they have their default.
    """

    shape: list[tuple[int, int, int]] = field(default_factory=list)
    scalars: dict[Steps, Number] = field(default_factory=dict)
    arrays: dict[Steps, tuple[int, str, int]] = field(default_factory=dict)

    def number(self, steps: Steps) -> Number | None:
        """Return the number at ``steps``, whose places in arrays all count from the beginning, or None."""
        found = self.scalars.get(steps)
        if found is not None or not steps or not isinstance(steps[-1], int):
            return found
        run = self.arrays.get(steps[:-1])
        if run is None or not 0 <= steps[-1] < run[2]:
            return None
        first, dtype, _ = run
        return Fixed(first + steps[-1] * np.dtype(dtype).itemsize, dtype)


class RosAnatomist:
    """Takes messages apart that are serialised as CDR (XCDR 1, plain) or by ROS 1.

    Parameters
    ----------
    fields : mapping
        Definitions of all types as rosbags holds them: name to constants and fields.
    name : str
        The message's type.
    encoding : str
        ``cdr`` or ``ros1``.
    names : sequence of steps, or None
        Arrays of text whose content must not change either, for numbers are found by it; None: all.
    """

    def __init__(
        self, fields: Mapping[str, Any], name: str, encoding: str, names: Sequence[Steps] | None = ()
    ) -> None:
        self._fields = fields
        self._name = name
        self._plain = encoding == "ros1"
        self._names = None if names is None else frozenset(names)

    def dissect(self, data: bytes, message: Any) -> Anatomy:  # noqa: ARG002 - protobuf needs the message
        """Find everything in one message.

        Raises
        ------
        NoLayoutError
            The message is cut short, too large or of a kind that is not known here.
        """
        return _RosWalk(data, self._fields, self._names, self._plain).message(self._name)


class _RosWalk:
    """One walk through one message."""

    def __init__(
        self, data: bytes, fields: Mapping[str, Any], names: frozenset[Steps] | None, plain: bool
    ) -> None:
        self._data = data
        self._fields = fields
        self._names = names
        self._plain = plain
        self._anatomy = Anatomy()
        self._left = MOST_FIELDS
        self._origin = 0 if plain else 4
        self._position = self._origin
        self._order = "<"
        if not plain:
            if data[:2] not in {b"\0\0", b"\0\1"}:
                raise NoLayoutError
            self._order = "<" if data[1] else ">"
            self._anatomy.shape.append((0, 2, 255))
        self._word = struct.Struct(f"{self._order}I")

    def message(self, name: str) -> Anatomy:
        self._type(name, ())
        left = len(self._data) - self._position
        if left < 0 or left > (0 if self._plain else 3):
            raise NoLayoutError
        return self._anatomy

    def _type(self, name: str, steps: Steps) -> None:
        for field_name, description in self._fields[name][1]:
            if self._plain and field_name == "structure_needs_at_least_one_member":
                continue
            self._field(description, (*steps, _without_underscore(field_name)))

    def _field(self, description: Any, steps: Steps) -> None:
        from rosbags.interfaces import Nodetype

        self._left -= 1
        if self._left < 0 or self._position > len(self._data):
            raise NoLayoutError
        kind, rest = description
        if kind == Nodetype.NAME:
            self._type(rest, steps)
        elif kind == Nodetype.BASE:
            self._base(rest[0], steps)
        elif kind == Nodetype.ARRAY:
            self._elements(rest[0], rest[1], steps)
        else:
            self._elements(rest[0], self._shape_word(), steps)

    def _base(self, name: str, steps: Steps) -> None:
        if name == "string":
            self._text(whole=False)
            return
        dtype = self._dtype(name)
        size = np.dtype(dtype).itemsize
        self._align(size)
        self._anatomy.scalars[steps] = Fixed(self._position, dtype)
        self._position += size

    def _elements(self, element: Any, count: int, steps: Steps) -> None:
        from rosbags.interfaces import Nodetype

        kind, rest = element
        if kind != Nodetype.BASE or rest[0] == "string":
            if count > self._left:
                raise NoLayoutError
            for place in range(count):
                if kind == Nodetype.BASE:
                    self._text(whole=self._names is None or steps in self._names)
                else:
                    self._field(element, (*steps, place))
        elif count:
            dtype = self._dtype(rest[0])
            size = np.dtype(dtype).itemsize
            self._align(size)
            self._anatomy.arrays[steps] = (self._position, dtype, count)
            self._position += size * count

    def _text(self, *, whole: bool) -> None:
        length = self._shape_word()
        first, self._position = self._position, self._position + length
        content = length if self._plain else length - 1  # every text of CDR ends with a zero
        if whole or content > _LIKELY_TEXT:
            self._must_agree(first if whole else first + content, self._position)
        else:
            self._must_agree(first, first + content, bits=0)
            self._must_agree(first + content, self._position)

    def _shape_word(self) -> int:
        self._align(4)
        first = self._position
        if first + 4 > len(self._data):
            raise NoLayoutError
        self._position += 4
        self._must_agree(first, self._position)
        return int(self._word.unpack_from(self._data, first)[0])

    def _must_agree(self, first: int, end: int, bits: int = 255) -> None:
        if end > len(self._data):
            raise NoLayoutError
        shape = self._anatomy.shape
        if shape and shape[-1][1:] == (first, bits):
            shape[-1] = (shape[-1][0], end, bits)
        elif end > first:
            shape.append((first, end, bits))

    def _align(self, size: int) -> None:
        if not self._plain:
            self._position += -(self._position - self._origin) % size

    def _dtype(self, name: str) -> str:
        dtype = _DTYPES.get(name)
        if dtype is None:
            raise NoLayoutError
        return dtype if np.dtype(dtype).itemsize == 1 else self._order + dtype


def _without_underscore(name: str) -> str:
    return name[:-1] if name.endswith("_") and keyword.iskeyword(name[:-1]) else name
