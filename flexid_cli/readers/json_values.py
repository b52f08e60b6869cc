"""Numbers out of JSON messages: only the wanted fields are built, and only as what they should be."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import groupby
from operator import attrgetter, itemgetter
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import UNSET, Meta, Raw, UnsetType
from numpy.typing import NDArray

from flexid_cli.readers.batch import Batch
from flexid_cli.readers.damage import failures
from flexid_cli.readers.messages import MISSING, STAMP_FIELDS, STAMP_PLACES, Picker, follow, stamp_steps
from flexid_cli.readers.parts import Part, Series, listed_series
from flexid_cli.readers.path import Leaf, Step

Steps = tuple[Step, ...]
Stamp = tuple[Steps, Steps]
_NS = 1_000_000_000
_LAST_SECOND = 9_000_000_000
# What must be so is said to the parser: it looks at each value anyway, and the message is left to the general
# decoder where it refuses. Fields without a default are read twice as fast.
_NUMBER = int | float | bool | None
_SECONDS = Annotated[int, Meta(ge=-_LAST_SECOND, le=_LAST_SECOND)]
_NANOSECONDS = Annotated[int, Meta(ge=-_NS * _NS, le=_NS * _NS)]
_ABSENT = Literal["\0"]  # no number, so it is no stamp either
_NO_OBJECT = str | int | float | bool | list | None  # type: ignore[type-arg]
_MAY_LACK = (_ABSENT, _NO_OBJECT)
_MOST_COUNTED = 64  # elements; an array of known length is read faster than a list
_FEW = 8  # where more than one message in so many is unlike the first, lengths are no part of the type
_AT_ONCE = 512  # messages whose objects exist at the same time; more keep the garbage collector busy


class NotTypedError(Exception):
    """What is wanted of the messages cannot be written as one type."""


class TypedJson:
    """Decodes JSON messages to nothing but the numbers that are wanted.

    Messages that are not as the first one (a text at a number's place, a field that is missing, NaN, which
    JSON does not have) are left to the general decoder.

    Parameters
    ----------
    leaves : sequence of Leaf
        The numbers that are wanted.
    named : dict
        See `Picker`.
    decode : callable
        The general decoder.
    """

    def __init__(
        self, leaves: Sequence[Leaf], named: dict[Leaf, str], decode: Callable[[bytes], Any]
    ) -> None:
        self._leaves = tuple(leaves)
        self._named = named
        self._general = decode
        self._types: dict[tuple[Stamp | None, tuple[int, ...]], _Typed | None] = {}
        self._arrays = list(dict.fromkeys(leaf.steps[:-1] for leaf in leaves if _is_element(leaf)))
        self._counted = True  # until the arrays' lengths turn out to change

    def decode(self, batch: Batch, rows: NDArray[np.int64]) -> tuple[list[Part], NDArray[np.int64]]:
        """Decode those of the messages ``rows`` that are as expected; return also the others.

        Raises
        ------
        InputError
            Names and numbers do not match.
        """
        parts = self._alike(batch, rows)
        left = _without(rows, parts)
        if self._counted and left.size * _FEW > rows.size:
            self._counted = False
            more = self._alike(batch, left)
            parts, left = [*parts, *more], _without(left, more)
        return parts, left

    def _alike(self, batch: Batch, rows: NDArray[np.int64]) -> list[Part]:
        """Decode those messages that are of the type of the first."""
        parts: list[Part] = []
        typed = self._type(batch.payload(int(rows[0])))
        if typed is not None:
            for start in range(0, rows.size, _AT_ONCE):
                parts += self._parts(typed, batch, rows[start : start + _AT_ONCE])
        return parts

    def _parts(self, typed: _Typed, batch: Batch, rows: NDArray[np.int64]) -> Iterator[Part]:
        objects, members = _decoded(typed, batch, rows)
        for chosen in typed.by_names(objects):
            alike = objects if len(chosen) == len(objects) else [objects[place] for place in chosen]
            numbers = members[chosen]
            part = self._part(typed, alike, numbers, batch.payload(int(numbers[0])))
            if part is not None:
                yield part

    def _type(self, data: bytes) -> _Typed | None:
        try:
            message = self._general(data)
            stamp = stamp_steps(message)
        except failures():
            return None
        counts = tuple(_count(follow(message, steps)) for steps in self._arrays) if self._counted else ()
        key = stamp, counts
        if key not in self._types:
            try:
                self._types[key] = _Typed(self._leaves, stamp, dict(zip(self._arrays, counts, strict=False)))
            except (NotTypedError, TypeError, ValueError):
                self._types[key] = None
        return self._types[key]

    def _part(
        self, typed: _Typed, objects: Sequence[Any], members: NDArray[np.int64], data: bytes
    ) -> Part | None:
        """Decode messages that have the names of the one whose bytes are ``data``."""
        try:
            message = self._general(data)
        except ValueError:  # not JSON, or bytes that are no text: the caller decodes these one by one
            return None
        taken: dict[Leaf, list[Any]] = {}
        good = np.ones(members.size, dtype=np.bool_)
        for leaf in self._leaves:
            picker = Picker(leaf, self._named)
            steps = picker.steps(message)
            if steps is None or picker.pick(message) is MISSING:
                return None
            if leaf.names is None:
                taken[leaf] = typed.values(objects, steps, good)
            else:
                count = len(follow(message, steps[:-1]))
                taken[leaf] = typed.elements(objects, steps, count, good)
        stamps = typed.stamps(objects)
        if not good.any():
            return None
        places = np.flatnonzero(good).tolist() if not good.all() else None
        members = members[good]
        series: dict[Leaf, Series] = {}
        for leaf, values in taken.items():
            kept = values if places is None else [values[place] for place in places]
            series[leaf] = listed_series(members, kept)
        return Part(members, series, None if stamps is None else stamps[good])


def _is_element(leaf: Leaf) -> bool:
    return bool(leaf.steps) and isinstance(leaf.steps[-1], int)


def _count(array: Any) -> int:
    """Return the number of elements of an array whose length may be part of the type, else 0."""
    return len(array) if isinstance(array, list) and len(array) <= _MOST_COUNTED else 0


def _decoded(typed: _Typed, batch: Batch, rows: NDArray[np.int64]) -> tuple[list[Any], NDArray[np.int64]]:
    """Return the messages ``rows`` that are of the type, and their numbers."""
    view = memoryview(batch.buffer.data)
    starts = batch.starts[rows]
    ends = (starts + batch.lengths[rows]).tolist()
    pieces = [view[start:end] for start, end in zip(starts.tolist(), ends, strict=True)]
    try:
        return list(map(typed.decode, pieces)), rows
    except msgspec.MsgspecError:
        objects = list(map(typed.attempt, pieces))
    good = [place for place, one in enumerate(objects) if one is not UNSET]
    return [objects[place] for place in good], rows[good]


def _without(rows: NDArray[np.int64], parts: Sequence[Part]) -> NDArray[np.int64]:
    found = sum(part.members.size for part in parts)
    if found == rows.size:
        return rows[:0]
    return np.setdiff1d(rows, np.concatenate([part.members for part in parts])) if parts else rows


class _Node:
    """What is wanted of one value: a number, raw text, fields, or elements (all of one type)."""

    def __init__(self) -> None:
        self.leaf: Any = None
        self.fields: dict[str, _Node] = {}
        self.element: _Node | None = None
        self.count = 0  # of elements, where all messages have as many

    def want(self, steps: Iterable[Step], leaf: Any) -> None:
        node = self
        for step in steps:
            node = node._below(step)
        if node.leaf not in {None, leaf} or node.fields or node.element:
            raise NotTypedError
        node.leaf = leaf

    def _below(self, step: Step) -> _Node:
        if self.leaf is not None or (self.fields if isinstance(step, int) else self.element):
            raise NotTypedError
        if isinstance(step, str):
            return self.fields.setdefault(step, _Node())
        self.element = self.element or _Node()
        return self.element

    def get(self, steps: Iterable[Step]) -> _Node | None:
        node: _Node | None = self
        for step in steps:
            if node is not None:
                node = node.element if isinstance(step, int) else node.fields.get(step)
        return node

    def type(self) -> Any:
        if self.leaf is not None:
            return self.leaf
        if self.element is not None and self.count and self.element.leaf is not None:
            return tuple[(self.element.leaf,) * self.count]  # type: ignore[misc]
        if self.element is not None:
            return list[self.element.type()]  # type: ignore[misc]
        names = [_attribute(self, name) for name in self.fields]
        fields: list[Any] = []
        for name, node in zip(names, self.fields.values(), strict=True):
            kind = node.type()
            fields.append((name, kind | UnsetType, UNSET) if node.may_lack else (name, kind))
        rename = dict(zip(names, self.fields, strict=True))
        return msgspec.defstruct("Wanted", fields, rename=rename, gc=False, kw_only=True)

    @property
    def may_lack(self) -> bool:
        """Whether messages need not have it."""
        if self.leaf is not None:
            return self.leaf in _MAY_LACK
        return self.element is None and all(node.may_lack for node in self.fields.values())


def _attribute(node: _Node, name: str) -> str:
    return f"f{list(node.fields).index(name)}"


class _Typed:
    """The type of messages with a stamp at one place, and what is taken out of them."""

    def __init__(self, leaves: Sequence[Leaf], stamp: Stamp | None, counts: Mapping[Steps, int]) -> None:
        self._root = _Node()
        self._stamp = stamp
        self._known_getters: dict[Steps, list[Callable[[Any], Any]]] = {}
        for leaf in leaves:
            self._want(leaf.steps, _NUMBER)
        self._names = list(dict.fromkeys(leaf.names for leaf in leaves if leaf.names is not None))
        for names in self._names:
            self._want(names, Raw)
        if self._root.leaf is None and self._root.element is None:
            self._want_stamps()
        for steps, count in counts.items():
            node = self._root.get(steps)
            if node is not None:
                node.count = count
        self.decode = msgspec.json.Decoder(self._root.type()).decode

    def _want(self, steps: Steps, leaf: Any) -> None:
        node = self._root.get(steps)
        if node is None or node.leaf is None:
            self._root.want(steps, leaf)
        elif node.leaf is not leaf and node.leaf != leaf:
            raise NotTypedError

    def _want_stamps(self) -> None:
        for place in STAMP_PLACES:
            if self._stamp is not None and self._stamp[0][:-1] == place:
                for pair in STAMP_FIELDS:
                    if (*place, pair[0]) == self._stamp[0] and (*place, pair[1]) == self._stamp[1]:
                        break
                    for name in pair:
                        if (*place, name) not in self._stamp:
                            self._want((*place, name), _ABSENT)
                self._want(self._stamp[0], _SECONDS)
                self._want(self._stamp[1], _NANOSECONDS)
                return
            node = self._root.get(place)
            if node is None:  # an object there may be a stamp, which would count first
                self._root.want(place, _NO_OBJECT)
            elif node.leaf is None:
                raise NotTypedError

    def attempt(self, data: memoryview) -> Any:
        """Return one message, or UNSET where it is not of this type."""
        try:
            return self.decode(data)
        except msgspec.MsgspecError:
            return UNSET

    def by_names(self, objects: Sequence[Any]) -> Iterator[list[int]]:
        """Yield the places of messages whose names are the same text."""
        everything = range(len(objects))
        if not self._names or not objects:
            if objects:
                yield list(everything)
            return
        raw = [self._got(objects, steps)[0] for steps in self._names]
        if all(one.count(one[0]) == len(one) for one in raw):
            yield list(everything)
            return
        keys = list(zip(*(map(_content, one) for one in raw), strict=True))
        for _, group in groupby(sorted(everything, key=keys.__getitem__), key=keys.__getitem__):
            yield sorted(group)

    def values(self, objects: Sequence[Any], steps: Steps, good: NDArray[np.bool_]) -> list[Any]:
        """Return what stands at ``steps``; clear ``good`` where nothing does."""
        found, complete = self._got(objects, steps)
        if not complete:
            good &= np.fromiter((value is not UNSET for value in found), np.bool_, len(found))
        return found

    def elements(
        self, objects: Sequence[Any], steps: Steps, count: int, good: NDArray[np.bool_]
    ) -> list[Any]:
        """Return elements of arrays; clear ``good`` where the array has not ``count`` elements."""
        arrays, complete = self._got(objects, steps[:-1])
        pick = itemgetter(steps[-1])
        if complete and list(map(len, arrays)).count(count) == len(arrays):
            return list(map(pick, arrays))
        fit = [one is not UNSET and len(one) == count for one in arrays]
        good &= np.array(fit, dtype=np.bool_)
        return [pick(one) if fits else UNSET for one, fits in zip(arrays, fit, strict=True)]

    def stamps(self, objects: Sequence[Any]) -> NDArray[np.int64] | None:
        """Return the messages' stamps, which are of the kind that the type asks for."""
        if self._stamp is None:
            return None
        seconds, rest = (np.array(self._got(objects, steps)[0], dtype=np.int64) for steps in self._stamp)
        return seconds * _NS + rest

    def _got(self, objects: Sequence[Any], steps: Steps) -> tuple[list[Any], bool]:
        """Return what stands at ``steps`` in each message, UNSET where nothing does, and whether all have it."""
        if steps not in self._known_getters:
            self._known_getters[steps] = list(self._getters(steps))
        getters = self._known_getters[steps]
        found: Iterable[Any] = objects
        for getter in getters:
            found = map(getter, found)
        try:
            return list(found), True
        except (AttributeError, LookupError, TypeError):
            return [_one(value, getters) for value in objects], False

    def _getters(self, steps: Steps) -> Iterator[Callable[[Any], Any]]:
        node = self._root
        names: list[str] = []
        for step in steps:
            if isinstance(step, str):
                names.append(_attribute(node, step))
                node = node.fields[step]
                continue
            if names:
                yield attrgetter(".".join(names))
            names = []
            yield itemgetter(step)
            node = node.element or node
        if names:
            yield attrgetter(".".join(names))


def _one(value: Any, getters: Sequence[Callable[[Any], Any]]) -> Any:
    try:
        for getter in getters:
            value = getter(value)
    except (AttributeError, LookupError, TypeError):
        return UNSET
    return value


def _content(raw: Any) -> bytes:
    """Return the text of a field that is kept as it stands, or nothing where the field is not there."""
    return b"" if raw is UNSET else bytes(raw)
