"""Numbers out of many messages at once: messages of one layout are decoded together, as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from flexid_cli.errors import InputError
from flexid_cli.readers.batch import Batch
from flexid_cli.readers.damage import explain, failures
from flexid_cli.readers.decoders import ZSTD_MAGIC, Decoder, TopicType, inflate, make_decoder, type_fields
from flexid_cli.readers.json_values import TypedJson
from flexid_cli.readers.messages import MISSING, Picker, follow, stamp_ns, stamp_steps
from flexid_cli.readers.parts import Decoded, Part, column_series, join, listed_series
from flexid_cli.readers.path import Leaf, Step
from flexid_cli.readers.payloads import Block, Pattern, Payloads, agreement, patterns
from flexid_cli.readers.schema import Anatomy, NoLayoutError, Number, RosAnatomist

_INT64 = 2**63
_NS = 1_000_000_000
_LAST_SECOND = _INT64 // _NS - 10  # nanoseconds since the epoch beyond it are no int64
_MOST_LAYOUTS = 64
_FREE_TRIES = 4  # new layouts that are tried in a batch before they must have paid
_PAYS_FROM = 12  # messages that a new layout must serve on average: taking one apart costs as much


class Anatomist(Protocol):
    """Finds where everything stands in one message."""

    def dissect(self, data: bytes, message: Any) -> Anatomy:
        """Find everything in ``data``, which the library decodes to ``message``."""
        ...


class LayoutDecoder:
    """Decodes batches of one topic.

    Messages are grouped by what decides where their numbers stand (lengths of texts and arrays, names of
    joints); of each group one message is decoded by the library and taken apart, and the numbers of all others
    are taken from the same places. Messages for which that does not pay are decoded one by one.

    Parameters
    ----------
    kind : TopicType
        The topic and how its messages are encoded.
    leaves : sequence of Leaf
        The numbers that are wanted.
    named : dict, optional
        See `Picker`; shared by all decoders of one recording.
    """

    def __init__(self, kind: TopicType, leaves: Sequence[Leaf], named: dict[Leaf, str] | None = None) -> None:
        self.kind = kind
        self.leaves = tuple(leaves)
        self._named: dict[Leaf, str] = {} if named is None else named
        self._decode: Decoder = make_decoder(kind)
        self._pickers = [Picker(leaf, self._named) for leaf in self.leaves]
        self._anatomist = _anatomist(kind, self.leaves)
        self._typed = TypedJson(leaves, self._named, self._decode) if kind.encoding == "json" else None
        self._layouts: list[Layout] = []
        self._numbers: NDArray[np.int64] = np.arange(0)

    def decode(self, batch: Batch) -> Decoded:
        """Take the wanted numbers out of ``batch``.

        Raises
        ------
        InputError
            A text stands where a number is expected, or names and numbers do not match, in a batch that is
            trusted; in others such messages are bad.
        """
        count = batch.starts.size
        if count == 0:
            return join(0, [])
        if self.kind.encoding == "cdr":
            batch = _inflated(batch)
        parts: list[Part] = []
        pending = self._all(count)
        if self._anatomist is not None:
            pending = self._by_known_layouts(batch, pending, parts)
            pending = self._by_new_layouts(batch, pending, parts)
        elif self._typed is not None:
            more, pending = self._typed.decode(batch, pending)
            parts += more
        reason = ""
        if pending.size:
            slow = _OneByOne(self._decode, self._pickers, batch)
            parts.append(slow.decode(pending))
            reason = slow.reason
        return join(count, parts, reason or "its stamp is beyond all times")

    def _all(self, count: int) -> NDArray[np.int64]:
        """Return the numbers from 0 to ``count`` - 1, the same array for batches of one size."""
        if self._numbers.size != count:
            self._numbers = np.arange(count)
        return self._numbers

    def unlike(self, batch: Batch) -> list[bytes]:
        """Return one payload of each layout that was not met before; all where there are no layouts."""
        if not batch.starts.size:
            return []
        if self.kind.encoding == "cdr":
            batch = _inflated(batch)
        pending = self._all(batch.starts.size)
        learned: list[Part] = []
        if self._anatomist is not None:
            pending = self._by_known_layouts(batch, pending, [])
            pending = self._by_new_layouts(batch, pending, learned)
        rows = [int(part.members[0]) for part in learned] + pending.tolist()
        return [batch.payload(row) for row in sorted(rows)]

    def _by_known_layouts(
        self, batch: Batch, pending: NDArray[np.int64], parts: list[Part]
    ) -> NDArray[np.int64]:
        for place, layout in enumerate(tuple(self._layouts)):
            if not pending.size:
                break
            part, pending = layout.take(batch, pending)
            if part is not None:
                parts.append(part)
                if place:
                    self._layouts.remove(layout)
                    self._layouts.insert(0, layout)
        return pending

    def _by_new_layouts(
        self, batch: Batch, pending: NDArray[np.int64], parts: list[Part]
    ) -> NDArray[np.int64]:
        """Learn layouts while that pays; return the messages that are left."""
        left: list[NDArray[np.int64]] = []
        tried = served = 0
        while pending.size and tried * _PAYS_FROM <= served + _FREE_TRIES * _PAYS_FROM:
            tried += 1
            layout = self._learn(batch, int(pending[0]))
            if layout is None:
                left.append(pending[:1])
                pending = pending[1:]
                continue
            part, pending = layout.take(batch, pending)
            if part is not None:  # it is not None: the message that the layout was learned from has it
                parts.append(part)
                served += part.members.size
            self._layouts.insert(0, layout)
            del self._layouts[_MOST_LAYOUTS:]
        return np.sort(np.concatenate([*left, pending])) if left else pending

    def _learn(self, batch: Batch, row: int) -> Layout | None:
        """Return the layout of one message, or None where it must be decoded by itself."""
        if self._anatomist is None:
            return None
        data = batch.payload(row)
        try:
            message = self._decode(data)
            anatomy = self._anatomist.dissect(data, message)
            layout = _layout(data, message, anatomy, self.leaves, self._named)
        except (NoLayoutError, InputError):
            return None
        except failures():
            return None  # decoded by itself, it gives the reason again
        return layout if layout.gives(data, message) else None


def _anatomist(kind: TopicType, leaves: Sequence[Leaf]) -> Anatomist | None:
    # without leaves every array of text counts as names, for any of them may name what is looked for
    names = [leaf.names for leaf in leaves if leaf.names is not None] if leaves else None
    if kind.encoding in {"cdr", "ros1"}:
        fields, name = type_fields(kind)
        return RosAnatomist(fields, name, kind.encoding, names)
    if kind.encoding == "protobuf":
        from flexid_cli.readers.wire import ProtobufAnatomist

        return ProtobufAnatomist(names)
    return None


@dataclass(frozen=True, eq=False)
class Layout:
    """Where the wanted numbers stand in messages that have one shape.

    Attributes
    ----------
    length : int
        Bytes of every such message.
    shape : sequence of Pattern and Block
        What shows that a message is one of them.
    numbers : dict of Leaf to (Number, steps)
        Where the numbers stand; leaves that these messages lack are not in it.
    stamp : pair of Number, or None
        Seconds and nanoseconds of the message's own stamp.
    """

    length: int
    shape: Sequence[Pattern | Block]
    numbers: dict[Leaf, tuple[Number, tuple[Step, ...]]]
    stamp: tuple[Number, Number] | None

    def take(self, batch: Batch, rows: NDArray[np.int64]) -> tuple[Part | None, NDArray[np.int64]]:
        """Decode those of the messages ``rows`` that have this layout; return also the others."""
        starts, lengths, stride = batch.starts, batch.lengths, batch.stride
        if rows.size != starts.size:
            starts, lengths, stride = starts[rows], lengths[rows], 0
        others = rows[:0]
        # one element that stands for all is compared once
        fit = (lengths[:1] if lengths.strides == (0,) else lengths) == self.length
        if not fit.all():
            if not fit.any():
                return None, rows
            others, rows, starts, stride = rows[~fit], rows[fit], starts[fit], 0
        payloads = Payloads(batch.buffer, starts, stride).gathered(self.length)
        agreeing = agreement(self.shape, payloads)
        if agreeing is not None:
            others = np.sort(np.concatenate([others, rows[~agreeing]]))
            rows = rows[agreeing]
            if not rows.size:
                return None, others
            payloads = payloads.chosen(agreeing)
        return self._read(payloads, rows), others

    def _read(self, payloads: Payloads, members: NDArray[np.int64]) -> Part:
        """Take the numbers out of payloads that have this layout.

        Messages whose stamp no int64 holds are no members of the result.
        """
        stamps = None
        if self.stamp is not None:
            coarse, fine = (number.read(payloads) for number in self.stamp)
            if coarse.dtype.itemsize == 8:
                near = (coarse <= _LAST_SECOND) & (coarse >= -_LAST_SECOND)
                if not near.all():
                    if not near.any():
                        return Part(members[:0], {}, None)
                    return self._read(payloads.chosen(near), members[near])
            stamps = coarse.astype(np.int64)
            stamps *= _NS
            stamps += fine
        numbers = self.numbers.items()
        series = {leaf: column_series(members, number.read(payloads)) for leaf, (number, _) in numbers}
        return Part(members, series, stamps)

    def gives(self, data: bytes, message: Any) -> bool:
        """Whether this layout takes out of ``data`` what the library decoded it to."""
        rows = Payloads(np.frombuffer(data, dtype=np.uint8), np.zeros(1, dtype=np.int64))
        if agreement(self.shape, rows) is not None:
            return False
        for number, steps in self.numbers.values():
            expected, found = float(follow(message, steps)), float(number.read(rows)[0])
            if expected != found and not (np.isnan(expected) and np.isnan(found)):
                return False
        stamps = None if self.stamp is None else [int(number.read(rows)[0]) for number in self.stamp]
        return stamp_ns(message) == (None if stamps is None else stamps[0] * _NS + stamps[1])


def _layout(
    data: bytes, message: Any, anatomy: Anatomy, leaves: Sequence[Leaf], named: dict[Leaf, str]
) -> Layout:
    numbers: dict[Leaf, tuple[Number, tuple[Step, ...]]] = {}
    for leaf in leaves:
        picker = Picker(leaf, named)
        value = picker.pick(message)
        if value is not MISSING:
            steps = _from_the_beginning(message, picker.steps(message) or ())
            numbers[leaf] = _number(anatomy, steps), steps
    found = stamp_steps(message)
    stamp = None if found is None else (_number(anatomy, found[0]), _number(anatomy, found[1]))
    return Layout(len(data), patterns(data, anatomy.shape), numbers, stamp)


def _number(anatomy: Anatomy, steps: tuple[Step, ...]) -> Number:
    number = anatomy.number(steps)
    if number is None:
        raise NoLayoutError
    return number


def _from_the_beginning(message: Any, steps: tuple[Step, ...]) -> tuple[Step, ...]:
    """Return ``steps`` with places that count from the end of an array made to count from its beginning."""
    result: list[Step] = []
    for step in steps:
        back = isinstance(step, int) and step < 0
        result.append(len(follow(message, result)) + int(step) if back else step)
    return tuple(result)


class _OneByOne:
    """Decodes messages by the library, one at a time."""

    def __init__(self, decode: Decoder, pickers: Sequence[Picker], batch: Batch) -> None:
        self._decode = decode
        self._pickers = pickers
        self._batch = batch
        self.reason = ""

    def decode(self, rows: NDArray[np.int64]) -> Part:
        """Decode the messages ``rows``; those that cannot be are no members of the result."""
        members: list[int] = []
        stamps: list[int | None] = []
        taken: dict[Leaf, tuple[list[int], list[Any]]] = {picker.leaf: ([], []) for picker in self._pickers}
        for row in rows.tolist():
            found = self._pick(row)
            if found is None:
                continue
            members.append(row)
            stamps.append(found[0])
            for (places, values), value in zip(taken.values(), found[1], strict=True):
                if value is not MISSING:
                    places.append(row)
                    values.append(value)
        series = {
            leaf: listed_series(np.array(places, dtype=np.int64), values)
            for leaf, (places, values) in taken.items()
        }
        whole = None if None in stamps else np.array(stamps, dtype=np.int64)
        return Part(np.array(members, dtype=np.int64), series, whole)

    def _pick(self, row: int) -> tuple[int | None, list[Any]] | None:
        try:
            message = self._decode(self._batch.payload(row))
            stamp = stamp_ns(message)
        except failures() as error:
            self.reason = self.reason or explain(error)
            return None
        if stamp is not None and abs(stamp) > _LAST_SECOND * _NS:
            self.reason = self.reason or f"its stamp is {stamp} ns"
            return None
        try:
            return stamp, [picker.pick(message) for picker in self._pickers]
        except InputError as error:
            if self._batch.trusted:
                raise
            self.reason = self.reason or error.message
            return None


def _inflated(batch: Batch) -> Batch:
    """Unpack a bag that is compressed message by message; no CDR header begins as its messages do.

    Where the first message is not packed, packed ones are left to the decoder of single messages.
    """
    if batch.payload(0)[: len(ZSTD_MAGIC)] != ZSTD_MAGIC:
        return batch
    contents = [batch.payload(row) for row in range(batch.starts.size)]
    for row, content in enumerate(contents):
        if content.startswith(ZSTD_MAGIC):
            try:
                contents[row] = inflate(content)
            except failures():
                continue  # the decoder fails on it in its turn and says why
    lengths = np.array([len(content) for content in contents], dtype=np.int64)
    starts = np.cumsum(lengths) - lengths
    return replace(batch, buffer=np.frombuffer(b"".join(contents), np.uint8), starts=starts, lengths=lengths)
