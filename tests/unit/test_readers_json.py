"""JSON messages that are read as one type give what they give when each is decoded by itself."""

from __future__ import annotations

import itertools
import json

import numpy as np
import pytest

from flexid_cli.readers.batch import Batch
from flexid_cli.readers.decoders import TopicType
from flexid_cli.readers.layout import LayoutDecoder
from flexid_cli.readers.parts import Decoded
from flexid_cli.readers.path import Leaf

KIND = TopicType("/a", "", "json")
BY_NAME = Leaf("/a", ("q", 1), "b", ("name",))
BY_PLACE = Leaf("/a", ("e", 0))
PLAIN = Leaf("/a", ("v",))
LEAVES = (BY_NAME, BY_PLACE, PLAIN)


def batch_of(messages: list[bytes]) -> Batch:
    lengths = np.array([len(one) for one in messages], dtype=np.int64)
    content = np.frombuffer(b"".join(messages), dtype=np.uint8)
    return Batch(KIND, content, np.cumsum(lengths) - lengths, lengths, np.zeros_like(lengths), None)


def message(stamp: object = None, /, **changed: object) -> dict[str, object]:
    """Return one message; fields that are given as ``...`` are left out."""
    fields: dict[str, object] = {"name": ["a", "b"], "q": [1.5, 2.5], "e": [3, 4.25], "v": 7.0}
    if stamp is not None:
        fields = {"header": {"stamp": stamp, "frame_id": "x"}, **fields}
    fields |= changed
    return {name: value for name, value in fields.items() if value is not ...}


def decoded(messages: list[bytes], *, typed: bool) -> Decoded:
    decoder = LayoutDecoder(KIND, LEAVES)
    if not typed:
        decoder._typed = None  # the general way is the reference
    return decoder.decode(batch_of(messages))


def assert_same(messages: list[dict[str, object]]) -> None:
    texts = [json.dumps(one).encode() for one in messages]
    found, expected = decoded(texts, typed=True), decoded(texts, typed=False)
    np.testing.assert_array_equal(found.bad, expected.bad)
    assert (found.header_stamp is None) == (expected.header_stamp is None)
    if found.header_stamp is not None:
        np.testing.assert_array_equal(found.header_stamp, expected.header_stamp)
    for leaf in LEAVES:
        np.testing.assert_array_equal(found.values.get(leaf, []), expected.values.get(leaf, []))
        if leaf in expected.rows:
            np.testing.assert_array_equal(found.rows[leaf], expected.rows[leaf])


STAMPS = [
    {"sec": 1, "nanosec": 5},
    {"sec": 2, "nsec": 6},
    {"sec": 2, "nsec": 6, "nanosec": 9},
    {"sec": 2, "nsec": 6, "nanosec": None},
    {"sec": 2, "nsec": 6, "nanosec": "\0"},
    {"sec": True, "nsec": 6},
    {"sec": 2.0, "nsec": 6},
    {"sec": 10**12, "nsec": 6},
    {"sec": 3, "nsec": 10**19},
    {"sec": -1, "nsec": -6},
    {"secs": 1, "nsecs": 2},
    {"sec": 4},
    "now",
    {},
]
ODD = [
    {"v": None},
    {"v": True},
    {"v": 2**60 + 1},
    {"v": ...},
    {"q": ...},
    {"e": []},
    {"e": [None, 1]},
    {"name": ["b", "a"]},
    {"name": ["c", "d"]},
    {"stamp": {"sec": 8, "nanosec": 1}},
    {"stamp": [1, 2]},
    {"timestamp": {"sec": 8, "nanosec": 1}},
    {"timestamp": 5.5},
    {"header": 5},
    {"header": ...},
]


@pytest.mark.parametrize(("first", "other"), list(itertools.product(STAMPS, STAMPS)))
def test_stamps_of_any_kind(first: object, other: object) -> None:
    assert_same([message(first), message(first), message(other), message(first)])


@pytest.mark.parametrize("stamp", [None, STAMPS[0], STAMPS[1]])
@pytest.mark.parametrize("odd", ODD, ids=str)
def test_messages_unlike_the_first(stamp: object, odd: dict[str, object]) -> None:
    plain = message(stamp)
    assert_same([plain, plain, message(stamp, **odd), plain])
    assert_same([message(stamp, **odd), plain, message(stamp, **odd), plain])


@pytest.mark.parametrize("place", ["stamp", "timestamp"])
def test_a_stamp_outside_a_header_gives_way_to_one_inside(place: str) -> None:
    later = {place: {"sec": 8, "nanosec": 1}}
    assert_same([message(None, **later), message(STAMPS[0], **later), message("now", **later)])


def test_more_messages_than_are_decoded_at_once() -> None:
    messages = [message({"sec": row, "nsec": row}, v=row / 8, e=[row, 0]) for row in range(1300)]
    messages[700] = message({"sec": 700, "nanosec": 1})
    assert_same(messages)


@pytest.mark.parametrize("text", [b"{", b"", b"[1]", b"nul", b'{"v": NaN}', b'{"v": "\xff"}'])
def test_what_is_no_such_message_is_left_to_the_general_decoder(text: bytes) -> None:
    good = json.dumps(message(STAMPS[1])).encode()
    found, expected = (decoded([good, text, good], typed=typed) for typed in (True, False))
    np.testing.assert_array_equal(found.bad, expected.bad)
    np.testing.assert_array_equal(found.values[PLAIN], expected.values[PLAIN])
