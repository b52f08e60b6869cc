"""Decoding by layouts gives, message by message and bit by bit, what the libraries' decoders give."""

from __future__ import annotations

import json
import math
import re
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

from flexid_cli.errors import InputError
from flexid_cli.readers.batch import Batch
from flexid_cli.readers.decoders import TopicType, make_decoder
from flexid_cli.readers.layout import LayoutDecoder
from flexid_cli.readers.messages import leaves_of
from flexid_cli.readers.parts import Decoded
from flexid_cli.readers.path import Leaf, canonical
from flexid_cli.readers.registry import list_channels, read_log

PRIMITIVES = {
    "bool": "?",
    "int8": "i1",
    "uint8": "u1",
    "int16": "<i2",
    "uint16": "<u2",
    "int32": "<i4",
    "uint32": "<u4",
    "int64": "<i8",
    "uint64": "<u8",
    "float32": "<f4",
    "float64": "<f8",
}
QUICK = settings(
    max_examples=30, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large]
)
RULE = "=" * 80
TOPIC = "/t"

# --- random types: a type is a list of (field, kind, element, size); kind is one, array or sequence --------

elements = st.one_of(st.sampled_from(sorted(PRIMITIVES)), st.just("string"))
kinds = st.sampled_from(["one", "one", "array", "sequence"])


@st.composite
def types(draw: st.DrawFn) -> list[list[tuple[str, str, str, int]]]:
    """Some message types; each may hold those after it, the first is that of the topic."""
    count = draw(st.integers(1, 3))
    result = []
    for number in range(count):
        inner = [st.just(f"x/T{other}") for other in range(number + 1, count)]
        fields = draw(
            st.lists(st.tuples(kinds, st.one_of(elements, *inner), st.integers(1, 3)), min_size=1, max_size=5)
        )
        result.append([(f"f{place}", *field) for place, field in enumerate(fields)])
    return result


def msg_text(described: Sequence[Sequence[tuple[str, str, str, int]]]) -> str:
    parts = []
    for number, fields in enumerate(described):
        lines = [] if number == 0 else [f"MSG: x/T{number}"]
        for name, kind, element, size in fields:
            suffix = {"one": "", "array": f"[{size}]", "sequence": "[]"}[kind]
            lines.append(f"{element}{suffix} {name}")
        parts.append("\n".join(lines) + "\n")
    return f"{RULE}\n".join(parts)


IDL_NAMES = {
    "bool": "boolean",
    "int8": "int8",
    "uint8": "uint8",
    "int16": "short",
    "uint16": "unsigned short",
    "int32": "long",
    "uint32": "unsigned long",
    "int64": "long long",
    "uint64": "unsigned long long",
    "float32": "float",
    "float64": "double",
    "string": "string",
}


def idl_text(described: Sequence[Sequence[tuple[str, str, str, int]]]) -> str:
    structs = []
    for number, fields in reversed(list(enumerate(described))):
        members = []
        for name, kind, element, size in fields:
            word = IDL_NAMES.get(element, element.replace("x/", "x::msg::"))
            if kind == "sequence":
                members.append(f"sequence<{word}> {name};")
            else:
                members.append(f"{word} {name}{f'[{size}]' if kind == 'array' else ''};")
        structs.append(f"struct T{number} {{ {' '.join(members)} }};")
    return f"module x {{ module msg {{ {' '.join(structs)} }}; }};\n"


class Maker:
    """Builds messages of random types with rosbags; ``profile`` decides the lengths of texts and arrays."""

    def __init__(self, described: Sequence[Sequence[tuple[str, str, str, int]]], seed: int) -> None:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.described = described
        self.store = get_typestore(Stores.EMPTY)
        self.store.register(get_types_from_msg(msg_text(described), "x/msg/T0"))
        self.rng = np.random.default_rng(seed)

    def make(self, profile: int, number: int = 0) -> Any:
        values = []
        for place, (_, kind, element, size) in enumerate(self.described[number]):
            if kind == "one":
                values.append(self._one(element, profile))
            else:
                count = size if kind == "array" else (profile * (place + 1)) % 4
                values.append(self._several(element, profile, count))
        return self.store.types[f"x/msg/T{number}"](*values)

    def _several(self, element: str, profile: int, count: int) -> Any:
        if element in PRIMITIVES:
            return np.array([self._one(element, profile) for _ in range(count)], dtype=PRIMITIVES[element])
        return [self._one(element, profile) for _ in range(count)]

    def _one(self, element: str, profile: int) -> Any:
        if element == "string":
            size = profile * 2 if profile < 3 else int(self.rng.integers(9))
            letters = "abc\0" if profile < 3 else "aé"
            return "".join(letters[place] for place in self.rng.integers(len(letters), size=size))
        if element.startswith("x/"):
            return self.make(profile, int(element[3:]))
        if element == "bool":
            return bool(self.rng.integers(2))
        dtype = np.dtype(PRIMITIVES[element])
        if dtype.kind == "f":
            odd = [0.0, -0.0, math.nan, math.inf, 5e-324, 1e300, 0.1]
            value = odd[self.rng.integers(len(odd))] if self.rng.random() < 0.3 else self.rng.normal()
            return float(value) if dtype.itemsize == 8 else float(np.float32(np.clip(value, -3e38, 3e38)))
        limits = np.iinfo(dtype)
        return int(self.rng.integers(limits.min, limits.max, dtype=dtype, endpoint=True))


profiles = st.one_of(
    st.lists(st.integers(0, 3), min_size=1, max_size=25),  # a new layout at any message
    st.tuples(st.integers(0, 2), st.integers(0, 2), st.integers(1, 40)).map(  # a change in the middle
        lambda pair: [pair[0]] * pair[2] + [pair[1]] * pair[2]
    ),
)


def gapped(kind: TopicType, payloads: Sequence[bytes], gaps: Sequence[int]) -> Batch:
    """A batch with bytes of something else between its payloads."""
    buffer, starts = b"", []
    for place, payload in enumerate(payloads):
        buffer += b"\xa5" * gaps[place % len(gaps)]
        starts.append(len(buffer))
        buffer += payload
    times = np.arange(len(payloads), dtype=np.int64)
    lengths = np.array([len(payload) for payload in payloads], dtype=np.int64)
    return Batch(kind, np.frombuffer(buffer, np.uint8), np.array(starts), lengths, times, None)


def at(message: Any, path: str) -> Any:
    """The number at ``.field[2].sub`` in a decoded message, or None; written without the project's code."""
    for word in re.findall(r"\.(\w+)|\[(-?\d+)\]", path):
        if word[0]:
            message = message.get(word[0]) if isinstance(message, dict) else getattr(message, word[0], None)
        else:
            message = message[int(word[1])] if -len(message) <= int(word[1]) < len(message) else None
        if message is None:
            return None
    return message


def assert_equals(
    kind: TopicType, payloads: Sequence[bytes], messages: Sequence[Any], gaps: list[int]
) -> None:
    """All numbers of ``payloads``, decoded together, are those of the decoded ``messages``."""
    decode = make_decoder(kind)
    leaves = list(
        {canonical(leaf): leaf for data in payloads for leaf in leaves_of(TOPIC, decode(data))}.values()
    )
    decoder = LayoutDecoder(kind, leaves)
    half = len(payloads) // 2
    for chosen in (slice(0, half), slice(half, None), slice(None)):
        if not payloads[chosen]:
            continue
        decoded = decoder.decode(gapped(kind, payloads[chosen], gaps))
        assert not decoded.bad.any()
        for leaf in leaves:
            expected = [at(message, canonical(leaf)[len(TOPIC) :]) for message in messages[chosen]]
            rows = [row for row, value in enumerate(expected) if value is not None]
            assert decoded.rows.get(leaf, np.array([])).tolist() == rows
            numbers = np.array([float(expected[row]) for row in rows])
            got = np.asarray(decoded.values.get(leaf, np.array([])), dtype=np.float64)
            assert same_bits(got, numbers), (canonical(leaf), got, numbers)
            whole = [value for value in expected if value is not None]
            if whole and leaf in decoded.integral:
                plain = [value.item() if isinstance(value, np.generic) else value for value in whole]
                assert_exact(decoded, leaf, plain)


def same_bits(one: np.ndarray, other: np.ndarray) -> bool:
    both = np.isnan(one) & np.isnan(other)
    return one.shape == other.shape and np.array_equal(
        np.where(both, 0, one.view(np.int64)), np.where(both, 0, other.view(np.int64))
    )


@given(types(), profiles, st.integers(0, 2**32), st.booleans(), st.sampled_from([[31], [31, 31, 33], [0]]))
@QUICK
def test_cdr(described: Any, shapes: list[int], seed: int, little: bool, gaps: list[int]) -> None:
    maker = Maker(described, seed)
    made = [maker.make(profile) for profile in shapes]
    payloads = [bytes(maker.store.serialize_cdr(m, "x/msg/T0", little_endian=little)) for m in made]
    messages = [maker.store.deserialize_cdr(data, "x/msg/T0") for data in payloads]
    for encoding, text in (("ros2msg", msg_text(described)), ("ros2idl", idl_text(described))):
        kind = TopicType(TOPIC, "x/msg/T0", "cdr", encoding, text.encode())
        assert_equals(kind, payloads, messages, gaps)


@given(types(), st.integers(0, 2), st.integers(0, 2**32), st.booleans())
@QUICK
def test_messages_of_one_shape_are_never_decoded_one_by_one(
    described: Any, profile: int, seed: int, little: bool
) -> None:
    maker = Maker(described, seed)
    payloads = [
        bytes(maker.store.serialize_cdr(maker.make(profile), "x/msg/T0", little_endian=little))
        for _ in range(40)
    ]
    kind = TopicType(TOPIC, "x/msg/T0", "cdr", "ros2msg", msg_text(described).encode())
    decode, calls = make_decoder(kind), []
    leaves = list(leaves_of(TOPIC, decode(payloads[0])))
    assume(leaves)  # without leaves every text may be a name that counts
    decoder = LayoutDecoder(kind, leaves)
    decoder._decode = lambda data: calls.append(data) or decode(data)  # type: ignore[func-returns-value]
    decoder.decode(gapped(kind, payloads, [31]))
    assert len(calls) == 1
    count = len(calls)
    decoder.decode(gapped(kind, payloads[::-1], [31]))
    assert len(calls) == count


@given(types(), profiles, st.integers(0, 2**32), st.sampled_from([[31], [31, 31, 33]]))
@QUICK
def test_ros1(described: Any, shapes: list[int], seed: int, gaps: list[int]) -> None:
    maker = Maker(described, seed)
    payloads = [bytes(maker.store.serialize_ros1(maker.make(profile), "x/msg/T0")) for profile in shapes]
    messages = [maker.store.deserialize_ros1(data, "x/msg/T0") for data in payloads]
    kind = TopicType(TOPIC, "x/T0", "ros1", "ros1msg", msg_text(described).encode())
    assert_equals(kind, payloads, messages, gaps)


# --- whole files, against the decoders of mcap and rosbags -------------------------------------------------


def mcap_file(
    path: Path, payloads: Sequence[bytes], encoding: str, schema: tuple[str, str, bytes], compression: Any
) -> None:
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=700, compression=compression)
        writer.start("ros2")
        channel = writer.register_channel(TOPIC, encoding, writer.register_schema(*schema))
        for row, data in enumerate(payloads):
            writer.add_message(channel, row * 10, data, row * 10)
        writer.finish()


@given(types(), profiles, st.integers(0, 2**32), st.sampled_from(list(CompressionType)))
@settings(QUICK, max_examples=12)
def test_mcap_files_against_the_mcap_package(
    described: Any, shapes: list[int], seed: int, compression: Any
) -> None:
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    maker = Maker(described, seed)
    payloads = [bytes(maker.store.serialize_cdr(maker.make(p), "x/msg/T0")) for p in shapes]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.mcap"
        mcap_file(path, payloads, "cdr", ("x/msg/T0", "ros2msg", msg_text(described).encode()), compression)
        with path.open("rb") as stream:
            reader = make_reader(stream, decoder_factories=[DecoderFactory()])
            messages = [decoded for *_, decoded in reader.iter_decoded_messages()]
        assert_file_equals(path, messages)


@given(types(), profiles, st.integers(0, 2**32), st.sampled_from(["sqlite3", "mcap", "ros1"]))
@settings(QUICK, max_examples=12)
def test_bags_against_rosbags(described: Any, shapes: list[int], seed: int, storage: str) -> None:
    from rosbags.highlevel import AnyReader
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2

    maker = Maker(described, seed)
    made = [maker.make(profile) for profile in shapes]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / ("log.bag" if storage == "ros1" else "log")
        if storage == "ros1":
            with Writer1(path) as writer:
                connection = writer.add_connection(TOPIC, "x/msg/T0", typestore=maker.store)
                for row, message in enumerate(made):
                    writer.write(connection, row * 10, maker.store.serialize_ros1(message, "x/msg/T0"))
        else:
            plugin = StoragePlugin.SQLITE3 if storage == "sqlite3" else StoragePlugin.MCAP
            with Writer2(path, version=9, storage_plugin=plugin) as writer2:
                connection2 = writer2.add_connection(TOPIC, "x/msg/T0", typestore=maker.store)
                for row, message in enumerate(made):
                    writer2.write(connection2, row * 10, maker.store.serialize_cdr(message, "x/msg/T0"))
        with AnyReader([path]) as bag:
            messages = [bag.deserialize(data, one.msgtype) for one, _, data in bag.messages()]
        assert_file_equals(path, messages)


def assert_file_equals(path: Path, messages: Sequence[Any]) -> None:
    sources = [info.source for info in list_channels([path])]
    if not sources:
        return
    log = read_log([path], sources)
    for source in sources:
        expected = [at(message, source[len(TOPIC) :]) for message in messages]
        rows = [row for row, value in enumerate(expected) if value is not None]
        channel = log.channels[source]
        assert channel.stamps["log_time"].tolist() == [row * 10 for row in rows]
        assert same_bits(channel.values, np.array([float(expected[row]) for row in rows]))
        if channel.exact is not None:
            assert channel.exact.tolist() == [int(expected[row]) for row in rows]


# --- names that turn ---------------------------------------------------------------------------------------


@given(
    st.lists(st.permutations(["a", "bb", "elbow"]), min_size=1, max_size=30),
    st.integers(0, 3),
    st.sampled_from(["cdr le", "cdr be", "ros1", "json"]),
    st.integers(0, 2**32),
)
@QUICK
def test_joints_are_found_by_name(orders: list[list[str]], lacking: int, encoding: str, seed: int) -> None:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    text = "int32 seq\nstring frame\nstring[] name\nfloat64[] position\nfloat32[] effort\n"
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, "x/msg/T0"))
    rng = np.random.default_rng(seed)
    payloads, expected = [], []
    for row, order in enumerate(orders):
        names = list(order)[: 3 - (lacking if row % 5 == 4 else 0)]
        position, effort = rng.normal(size=len(names)), rng.normal(size=len(names)).astype(np.float32)
        expected.append((names, position, effort))
        if encoding == "json":
            fields = {"name": names, "position": position.tolist(), "effort": effort.tolist()}
            payloads.append(json.dumps(fields).encode())
            continue
        message = store.types["x/msg/T0"](row, "f" * (row // 7), names, position, effort)
        if encoding == "ros1":
            payloads.append(bytes(store.serialize_ros1(message, "x/msg/T0")))
        else:
            little = encoding == "cdr le"
            payloads.append(bytes(store.serialize_cdr(message, "x/msg/T0", little_endian=little)))
    kind = {
        "json": TopicType(TOPIC, "", "json"),
        "ros1": TopicType(TOPIC, "x/T0", "ros1", "ros1msg", text.encode()),
    }.get(encoding, TopicType(TOPIC, "x/msg/T0", "cdr", "ros2msg", text.encode()))
    decode = make_decoder(kind)
    found = {canonical(leaf): leaf for data in payloads for leaf in leaves_of(TOPIC, decode(data))}
    leaves = [leaf for name, leaf in found.items() if "seq" not in name]
    decoded = LayoutDecoder(kind, leaves).decode(gapped(kind, payloads, [7, 7, 8]))
    assert not decoded.bad.any()
    for leaf in leaves:
        assert leaf.joint
        place = {"position": 1, "effort": 2}[str(leaf.steps[0])]
        rows = [row for row, (names, *_) in enumerate(expected) if leaf.joint in names]
        values = [float(expected[row][place][expected[row][0].index(leaf.joint)]) for row in rows]
        assert decoded.rows[leaf].tolist() == rows
        assert same_bits(np.asarray(decoded.values[leaf], dtype=np.float64), np.array(values))


# --- JSON --------------------------------------------------------------------------------------------------

json_numbers = st.one_of(
    st.floats(allow_nan=True),
    st.integers(-(2**70), 2**70),
    st.integers(-9, 9),
    st.booleans(),
    st.none(),
)
json_keys = st.sampled_from(["q", "a b", "é", "class", "x1"])
json_stamps = st.one_of(
    st.just({}),
    st.sampled_from(
        [
            {"header": {"stamp": {"sec": 3, "nanosec": 4}}},
            {"timestamp": {"sec": 5, "nsec": 6}},
            {"timestamp": 7.5},
            {"stamp": {"secs": 8, "nsecs": 9}, "timestamp": {"sec": 1, "nsec": 1}},
            {"header": None},
        ]
    ),
)


def assert_json_equals(payloads: Sequence[bytes]) -> None:
    kind = TopicType(TOPIC, "", "json")
    messages = [json.loads(data) for data in payloads]
    found = {canonical(leaf): leaf for message in messages for leaf in leaves_of(TOPIC, message)}
    expected = {leaf: [json_at(message, leaf.steps) for message in messages] for leaf in found.values()}
    batch = gapped(kind, payloads, [3])
    decoder = LayoutDecoder(kind, list(expected))
    if any(isinstance(value, dict) for values in expected.values() for value in values):
        with pytest.raises(InputError, match="where a number is expected"):
            decoder.decode(batch)
        return
    decoded = decoder.decode(batch)
    assert not decoded.bad.any()
    for leaf, wanted in expected.items():
        rows = [row for row, value in enumerate(wanted) if value is not ...]
        assert decoded.rows[leaf].tolist() == rows
        values = [math.nan if wanted[row] is None else float(wanted[row]) for row in rows]
        assert same_bits(decoded.values[leaf], np.array(values))
        assert_exact(decoded, leaf, [wanted[row] for row in rows])
    stamps = [json_stamp(message) for message in messages]
    if None in stamps:
        assert decoded.header_stamp is None
    else:
        assert decoded.header_stamp is not None
        assert decoded.header_stamp.tolist() == stamps


def assert_exact(decoded: Decoded, leaf: Leaf, values: Sequence[Any]) -> None:
    integral = all(type(value) is int and -(2**63) <= value < 2**63 for value in values)
    assert decoded.integral[leaf] == integral
    if integral and any(abs(value) > 2**53 for value in values):
        assert decoded.exact[leaf].tolist() == values
    elif leaf in decoded.exact:
        assert integral
        assert decoded.exact[leaf].tolist() == values


@given(
    st.lists(
        st.tuples(
            st.dictionaries(json_keys, json_numbers, max_size=4),
            st.lists(json_numbers, max_size=3),
            json_stamps,
            st.booleans(),
        ),
        min_size=1,
        max_size=12,
    ),
    st.integers(1, 6),
)
@settings(QUICK, max_examples=80)
def test_json_of_many_shapes(drawn: list[Any], repeats: int) -> None:
    assert_json_equals(
        [
            json.dumps({**stamp, "d": fields, "l": numbers}, indent=1 if spread else None).encode()
            for fields, numbers, stamp, spread in drawn
            for _ in range(repeats)
        ]
    )


@given(
    st.lists(st.tuples(st.lists(json_numbers, min_size=7, max_size=7), json_stamps), min_size=1, max_size=12),
    json_stamps,
    st.integers(0, 12),
)
@settings(QUICK, max_examples=80)
def test_json_of_one_shape(drawn: list[Any], stamp: Any, turned: int) -> None:
    """The same fields in all messages, but for one that has another stamp."""
    payloads = []
    for row, (numbers, other) in enumerate(drawn):
        message = {
            **(other if row == turned else stamp),
            "name": ["a", "b"],
            "position": numbers[:2],
            "axes": [{"q": numbers[2], "w": [numbers[3]]}, {"q": numbers[4], "w": [numbers[5], 1]}],
            "class": numbers[6],
        }
        payloads.append(json.dumps(message).encode())
    assert_json_equals(payloads)


def json_at(node: Any, steps: Sequence[Any]) -> Any:
    for step in steps:
        try:
            node = node[step]
        except (KeyError, IndexError, TypeError):
            return ...
    return node


def json_stamp(message: Any) -> int | None:
    for place in (("header", "stamp"), ("stamp",), ("timestamp",)):
        node = json_at(message, place)
        for one, other in (("sec", "nanosec"), ("sec", "nsec"), ("secs", "nsecs")):
            if isinstance(node, dict) and one in node and other in node:
                return node[one] * 10**9 + node[other]
    return None


@pytest.mark.parametrize(
    "text",
    [
        b'{"q": 1, "q": 2}',
        b'{"q": -0}',
        b'{"q": 1e400}',
        b'{"q": -Infinity}',
        b'{"q": 18446744073709551616}',
        b'{"q": 1E-400, "deep": [[[{}]]]}',
        '{"q": 0.1, "\\u0071x": 3}'.encode("utf-16"),
        b'\n{ "\\u0071" : 3.5 }\t',
    ],
)
def test_json_at_the_edges_of_its_grammar(text: bytes) -> None:
    kind = TopicType(TOPIC, "", "json")
    plain = b'{"q": 0.5}'
    (leaf,) = leaves_of(TOPIC, json.loads(plain))
    for payloads in ([plain, text, plain], [text, plain]):
        decoded = LayoutDecoder(kind, [leaf]).decode(gapped(kind, payloads, [0]))
        expected = np.array([float(json.loads(data)["q"]) for data in payloads])
        assert same_bits(decoded.values[leaf], expected)


# --- protobuf ----------------------------------------------------------------------------------------------

PROTO_TYPES = {
    "double": 1,
    "float": 2,
    "int64": 3,
    "uint64": 4,
    "int32": 5,
    "fixed64": 6,
    "fixed32": 7,
    "bool": 8,
    "string": 9,
    "message": 11,
    "uint32": 13,
    "enum": 14,
    "sfixed32": 15,
    "sfixed64": 16,
    "sint32": 17,
    "sint64": 18,
}


@st.composite
def proto_types(draw: st.DrawFn) -> list[list[tuple[str, bool]]]:
    count = draw(st.integers(1, 3))
    result = []
    for number in range(count):
        names = sorted(set(PROTO_TYPES) - ({"message"} if number == count - 1 else set()))
        fields = st.tuples(st.sampled_from(names), st.booleans())
        result.append(draw(st.lists(fields, min_size=1, max_size=5)))
    return result


def proto_class(described: Sequence[Sequence[tuple[str, bool]]]) -> tuple[Any, bytes]:
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    file = descriptor_pb2.FileDescriptorProto(name="x.proto", package="x", syntax="proto3")
    enum = file.enum_type.add(name="E")
    for value in range(3):
        enum.value.add(name=f"E{value}", number=value)
    for number, fields in enumerate(described):
        message = file.message_type.add(name=f"T{number}")
        for place, (kind, repeated) in enumerate(fields):
            one = message.field.add(
                name=f"f{place}", number=place * 9 + 1, type=PROTO_TYPES[kind], label=3 if repeated else 1
            )
            if kind in {"message", "enum"}:
                one.type_name = f".x.T{number + 1}" if kind == "message" else ".x.E"
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    schema = descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("x.T0")), schema


def fill_proto(message: Any, described: Any, profile: int, rng: np.random.Generator, number: int = 0) -> None:
    for place, (kind, repeated) in enumerate(described[number]):
        name = f"f{place}"
        count = (profile * (place + 1)) % 4 if repeated else 1
        for _ in range(count):
            if kind == "message":
                target = getattr(message, name)
                fill_proto(target.add() if repeated else target, described, profile, rng, number + 1)
            elif repeated:
                getattr(message, name).append(proto_value(kind, profile, rng))
            elif profile or rng.random() < 0.7:
                setattr(message, name, proto_value(kind, profile, rng))


def proto_value(kind: str, profile: int, rng: np.random.Generator) -> Any:
    if kind == "string":
        return "x" * (profile if profile < 3 else int(rng.integers(5)))
    if kind == "bool":
        return bool(rng.integers(2))
    if kind == "enum":
        return int(rng.integers(3))
    if kind in {"double", "float"}:
        return float(np.float32(rng.normal())) if rng.random() < 0.9 else 0.0
    bits = 64 if kind.endswith("64") else 32
    signed = not kind.startswith(("u", "fixed"))
    low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
    size = int(rng.integers(1, bits))
    return max(
        low, min(high, int(rng.integers(-(2**62), 2**62)) >> (62 - min(size, 62)) if signed else high >> size)
    )


@given(proto_types(), profiles, st.integers(0, 2**32), st.sampled_from([[31], [31, 32]]))
@QUICK
def test_protobuf(described: Any, shapes: list[int], seed: int, gaps: list[int]) -> None:
    pytest.importorskip("mcap_protobuf")
    cls, schema = proto_class(described)
    rng = np.random.default_rng(seed)
    messages = []
    for profile in shapes:
        message = cls()
        fill_proto(message, described, profile, rng)
        messages.append(message)
    payloads = [message.SerializeToString() for message in messages]
    kind = TopicType(TOPIC, "x.T0", "protobuf", "protobuf", schema)
    assert_equals(kind, payloads, [cls.FromString(data) for data in payloads], gaps)


# --- messages that cannot be decoded -----------------------------------------------------------------------


@given(types(), profiles, st.integers(0, 2**32), st.data())
@QUICK
def test_damaged_messages_are_bad_or_what_the_library_says(
    described: Any, shapes: list[int], seed: int, data: st.DataObject
) -> None:
    """Any bytes: what the library refuses is bad or has the layout of a good one; what it reads is equal."""
    maker = Maker(described, seed)
    kind = TopicType(TOPIC, "x/msg/T0", "cdr", "ros2msg", msg_text(described).encode())
    decode = make_decoder(kind)
    payloads = [bytes(maker.store.serialize_cdr(maker.make(profile), "x/msg/T0")) for profile in shapes]
    leaves = list(
        {canonical(leaf): leaf for one in payloads for leaf in leaves_of(TOPIC, decode(one))}.values()
    )
    for row in range(0, len(payloads), 2):
        changed = bytearray(payloads[row])
        place = data.draw(st.integers(0, len(changed) - 1))
        changed[place] ^= 1 << data.draw(st.integers(0, 7))
        payloads[row] = bytes(changed[: data.draw(st.sampled_from([len(changed), len(changed), place]))])
    decoded = LayoutDecoder(kind, leaves).decode(gapped(kind, payloads, [31]))
    for row, payload in enumerate(payloads):
        try:
            message = decode(payload)
        except Exception:  # noqa: BLE001 - whatever the library raises
            continue
        assert not decoded.bad[row]
        for leaf in leaves:
            expected = at(message, canonical(leaf)[len(TOPIC) :])
            places = np.flatnonzero(decoded.rows.get(leaf, np.array([])) == row)
            assert (places.size == 0) == (expected is None)
            if expected is not None:
                got = np.asarray(decoded.values[leaf], dtype=np.float64)[places]
                assert same_bits(got, np.array([float(expected)]))
