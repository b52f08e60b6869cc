"""Where the numbers stand in a protobuf message (https://protobuf.dev/programming-guides/encoding)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexid_cli.readers.messages import follow
from flexid_cli.readers.payloads import Payloads
from flexid_cli.readers.schema import MOST_FIELDS, Anatomy, Constant, Fixed, NoLayoutError, Number, Steps

_VARINT, _EIGHT, _TEXT, _FOUR = 0, 1, 2, 5
_LONGEST_VARINT = 10
# field types of google.protobuf.FieldDescriptorProto
_FIXED = {1: "<f8", 2: "<f4", 6: "<u8", 7: "<u4", 15: "<i4", 16: "<i8"}
_VARINTS = {
    3: "int64",
    4: "uint64",
    5: "int32",
    8: "bool",
    13: "uint32",
    14: "int32",
    17: "sint32",
    18: "sint64",
}
_STRING, _MESSAGE, _ENUM = 9, 11, 14


@dataclass(frozen=True)
class Varint(Number):
    """A number of seven bits per byte.

    Attributes
    ----------
    offset, size : int
        Its first byte and its number of bytes.
    kind : str
        How protobuf calls its type.
    """

    offset: int
    size: int
    kind: str

    def read(self, payloads: Payloads) -> NDArray[Any]:
        """Return the number of every payload, shape (n,), in its own type."""
        digits = payloads.column(self.offset, "u1", self.size).reshape(payloads.count, self.size)
        bits = np.zeros(payloads.count, dtype=np.uint64)
        for place in range(self.size):
            bits |= (digits[:, place] & np.uint8(0x7F)).astype(np.uint64) << np.uint64(7 * place)
        return _typed(bits, self.kind)


def _typed(bits: NDArray[np.uint64], kind: str) -> NDArray[Any]:
    if kind == "bool":
        return np.asarray(bits != 0)
    if kind == "uint64":
        return bits
    if kind == "int64":
        return bits.view(np.int64)
    if kind == "sint64":
        return ((bits >> np.uint64(1)) ^ (-(bits & np.uint64(1)).view(np.int64)).view(np.uint64)).view(
            np.int64
        )
    short = bits.astype(np.uint32)
    if kind == "uint32":
        return short
    if kind == "int32":
        return short.view(np.int32)
    return ((short >> np.uint32(1)) ^ (-(short & np.uint32(1)).view(np.int32)).view(np.uint32)).view(np.int32)


@dataclass
class _WireAnatomy(Anatomy):
    """What was found in one protobuf message; what is not there has its default."""

    message: Any = None
    unknown: set[Steps] = field(default_factory=set)

    def number(self, steps: Steps) -> Number | None:
        """Return the number at ``steps``, or None where it cannot be told."""
        found = self.scalars.get(steps)
        hidden = any(steps[:end] in self.unknown for end in range(1, len(steps) + 1))
        if found is not None or hidden or not steps or isinstance(steps[-1], int):
            return None if hidden else found
        return Constant(follow(self.message, steps))


class ProtobufAnatomist:
    """Takes protobuf messages apart.

    Parameters
    ----------
    names : sequence of steps, or None
        Arrays of text whose content must not change either, for numbers are found by it; None: all.
    """

    def __init__(self, names: Sequence[Steps] | None = ()) -> None:
        self._names = None if names is None else frozenset(names)

    def dissect(self, data: bytes, message: Any) -> Anatomy:
        """Find everything in ``data``, which the library decodes to ``message``.

        Raises
        ------
        NoLayoutError
            The message holds something whose meaning depends on more than its tags.
        """
        walk = _WireWalk(data, message, self._names)
        walk.message(message.DESCRIPTOR, len(data), ())
        return walk.anatomy


class _WireWalk:
    """One walk through one message."""

    def __init__(self, data: bytes, message: Any, names: frozenset[Steps] | None) -> None:
        self.anatomy = _WireAnatomy(message=message)
        self._data = data
        self._names = names
        self._position = 0
        self._left = MOST_FIELDS

    def message(self, descriptor: Any, end: int, steps: Steps) -> None:
        counts: dict[str, int] = {}
        groups: dict[str, str] = {}
        while self._position < end:
            self._spend(1)
            tag = self._varint(bits=255)
            known = descriptor.fields_by_number.get(tag >> 3)
            group = None if known is None else known.containing_oneof
            if group is not None and groups.setdefault(group.name, known.name) != known.name:
                raise NoLayoutError  # of several members the last one counts, and clears the others
            self._field(known, tag & 7, steps, counts)
            if self._position > end:
                raise NoLayoutError

    def _field(self, known: Any, wire: int, steps: Steps, counts: dict[str, int]) -> None:
        own: Steps = () if known is None else (*steps, known.name)
        if wire == _TEXT:
            length = self._varint(bits=255)
            if self._position + length > len(self._data):
                raise NoLayoutError
            self._text(known, length, own, counts)
            return
        if wire not in {_VARINT, _EIGHT, _FOUR}:
            raise NoLayoutError
        number = self._number(None if known is None else known.type, wire)
        if number is not None:
            self._record(known, number, own, counts)

    def _number(self, kind: int | None, wire: int) -> Number | None:
        """Pass over one number; None where the schema has another type at its place, which means nothing."""
        first = self._position
        if wire == _VARINT:
            self._varint(bits=128)
            name = _VARINTS.get(kind or 0)
            return None if name is None else Varint(first, self._position - first, name)
        size = 8 if wire == _EIGHT else 4
        self._position += size
        dtype = _FIXED.get(kind or 0)
        return Fixed(first, dtype) if dtype is not None and np.dtype(dtype).itemsize == size else None

    def _record(self, known: Any, number: Number, own: Steps, counts: dict[str, int]) -> None:
        if known.type == _ENUM and getattr(known.enum_type, "is_closed", True):
            self.anatomy.unknown.add(own)  # a value that the schema does not have would be left out
        elif _is_repeated(known):
            self.anatomy.scalars[(*own, counts.get(known.name, 0))] = number
            counts[known.name] = counts.get(known.name, 0) + 1
        else:
            self.anatomy.scalars[own] = number

    def _text(self, known: Any, length: int, own: Steps, counts: dict[str, int]) -> None:
        end = self._position + length
        if known is None:
            self._position = end
        elif known.type == _MESSAGE and not known.message_type.GetOptions().map_entry:
            self._nested(known, end, own, counts)
        elif known.type == _STRING and (self._names is None or own in self._names):
            self._agree(self._position, end, 255)
            self._position = end
        elif _is_repeated(known) and (known.type in _FIXED or known.type in _VARINTS):
            self._packed(known, end, own, counts)
        else:
            if known.type == _MESSAGE:
                self.anatomy.unknown.add(own)
            self._position = end
        if self._position != end:
            raise NoLayoutError

    def _nested(self, known: Any, end: int, own: Steps, counts: dict[str, int]) -> None:
        count = counts.get(known.name, 0)
        counts[known.name] = count + 1
        if _is_repeated(known):
            own = (*own, count)
        elif count:
            raise NoLayoutError  # two parts of one message are merged
        self.message(known.message_type, end, own)

    def _packed(self, known: Any, end: int, own: Steps, counts: dict[str, int]) -> None:
        wire = _VARINT if known.type in _VARINTS else _EIGHT if _FIXED[known.type].endswith("8") else _FOUR
        while self._position < end:
            self._spend(1)
            number = self._number(known.type, wire)
            if number is not None:
                self._record(known, number, own, counts)

    def _varint(self, bits: int) -> int:
        """Pass over a varint whose ``bits`` must agree in all messages, and return it."""
        first, value = self._position, 0
        for place in range(_LONGEST_VARINT):
            if self._position >= len(self._data):
                raise NoLayoutError
            digit = self._data[self._position]
            self._position += 1
            value |= (digit & 127) << 7 * place
            if digit < 128:
                self._agree(first, self._position, bits)
                return value
        raise NoLayoutError

    def _agree(self, first: int, end: int, bits: int) -> None:
        shape = self.anatomy.shape
        if shape and shape[-1][1] == first and shape[-1][2] == bits:
            shape[-1] = (shape[-1][0], end, bits)
        elif end > first:
            shape.append((first, end, bits))

    def _spend(self, count: int) -> None:
        self._left -= count
        if self._left < 0:
            raise NoLayoutError


def _is_repeated(known: Any) -> bool:
    flag = getattr(known, "is_repeated", None)
    return bool(known.label == known.LABEL_REPEATED) if flag is None else bool(flag)
