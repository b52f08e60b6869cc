"""Message decoders: from the bytes of one message to an object with fields."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any

from flexid_cli.errors import InputError

if TYPE_CHECKING:
    from rosbags.interfaces.typing import Typesdict
    from rosbags.typesys.store import Typestore

Decoder = Callable[[bytes], Any]
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_IDL_RULE = "=" * 80


@dataclass(frozen=True)
class TopicType:
    """A topic and how its messages are encoded.

    Attributes
    ----------
    topic, msgtype : str
        Names of the topic and of the message type.
    encoding : str
        Encoding of the messages: ``cdr``, ``ros1``, ``json``, ``protobuf``.
    schema_encoding : str
        ``ros2msg``, ``ros2idl``, ``ros1msg``, ``jsonschema``, ``protobuf``, or empty: no schema in the log.
    schema : bytes
        The schema as it stands in the log.
    """

    topic: str
    msgtype: str
    encoding: str
    schema_encoding: str = ""
    schema: bytes = b""

    @property
    def lacks_schema(self) -> bool:
        """Whether the messages cannot be read by what the log itself holds."""
        return self.encoding == "cdr" and not self.schema.strip()


@lru_cache(maxsize=64)
def make_decoder(kind: TopicType) -> Decoder:
    """Return the function that decodes messages of ``kind``.

    Raises
    ------
    InputError
        The encoding is not known, or the type is not described in the log.
    Exception
        Whatever rosbags or mcap raise where the schema itself is damaged.
    """
    if kind.encoding == "cdr" and kind.schema_encoding in {"ros2msg", "ros2idl", "omgidl", ""}:
        return _cdr_decoder(kind)
    if kind.encoding == "ros1" and kind.schema_encoding in {"ros1msg", ""}:
        return _ros1_decoder(kind)
    if kind.encoding == "json":
        return json.loads
    if kind.encoding == "protobuf" and kind.schema_encoding == "protobuf":
        return _protobuf_decoder(kind)
    raise InputError(
        f"topic {kind.topic!r} has messages in {kind.encoding or 'an unnamed encoding'!r} with a schema in "
        f"{kind.schema_encoding or 'no language'!r}, which flexid does not read",
        "record it as CDR (ROS 2), ROS 1, JSON or protobuf",
    )


def full_name(msgtype: str) -> str:
    """Return a type's name with its ``msg`` part: ``sensor_msgs/msg/JointState``."""
    parts = msgtype.replace("::", "/").split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else "/".join(parts)


def _cdr_decoder(kind: TopicType) -> Decoder:
    name = full_name(kind.msgtype)
    store = _store(kind)

    def decode(data: bytes) -> Any:
        # a bag compressed message by message; no CDR header begins with these bytes
        return store.deserialize_cdr(inflate(data) if data[:4] == ZSTD_MAGIC else data, name)

    return decode


def inflate(data: bytes) -> bytes:
    """Unpack one zstd frame; raises EOFError where it is cut short."""
    import zstandard

    frame = zstandard.ZstdDecompressor().decompressobj()
    plain = frame.decompress(data)
    if not frame.eof:
        raise EOFError("its compressed message is cut short")
    return bytes(plain)


def _ros1_decoder(kind: TopicType) -> Decoder:
    name = full_name(kind.msgtype)
    store = _store(kind)
    return lambda data: store.deserialize_ros1(data, name)


def type_fields(kind: TopicType) -> tuple[Typesdict, str]:
    """Return the definitions of a CDR or ROS 1 topic's types, and the name of its own; raises as `make_decoder`."""
    return _store(kind).fielddefs, full_name(kind.msgtype)


@lru_cache(maxsize=64)
def _store(kind: TopicType) -> Typestore:
    """Return a type store of its own for each schema, so that two versions of a type do not collide."""
    from rosbags.typesys import Stores, get_typestore

    name = full_name(kind.msgtype)
    defined = {} if not kind.schema.strip() else _definitions(kind, name)
    store = get_typestore(Stores.EMPTY)
    known = _standard_types(kind.encoding)
    wanted = [name]
    chosen: Typesdict = {}
    while wanted:
        this = wanted.pop()
        if this in chosen:
            continue
        fields = defined.get(this) or store.fielddefs.get(this) or known.get(this)
        if fields is None:
            raise InputError(
                f"topic {kind.topic!r}: the log does not describe message type {this!r}",
                "record with a tool that stores message definitions (MCAP, or rosbag2 since Iron)",
            )
        chosen[this] = fields
        wanted += [part for _, description in fields[1] if (part := _nested(description))]
    store.register(chosen)
    store.get_msgdef(name)
    return store


def _nested(description: Any) -> str | None:
    """Name of the message type inside a field's description, or None for a base type."""
    from rosbags.interfaces import Nodetype

    kind, rest = description
    if kind in {Nodetype.ARRAY, Nodetype.SEQUENCE}:
        return _nested(rest[0])
    return str(rest) if kind == Nodetype.NAME else None


@cache
def _standard_types(encoding: str) -> Typesdict:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.LATEST).fielddefs


def _definitions(kind: TopicType, name: str) -> Typesdict:
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    text = kind.schema.decode("utf-8").replace("\r\n", "\n")
    if kind.schema_encoding not in {"ros2idl", "omgidl"}:
        return get_types_from_msg(text, name)
    types: Typesdict = {}
    for part in text.split(f"{_IDL_RULE}\n"):
        idl = part.split("\n", 1)[1] if part.startswith("IDL: ") else part
        if idl.strip():
            types.update(get_types_from_idl(idl))
    return types


def _protobuf_decoder(kind: TopicType) -> Decoder:
    try:
        from mcap_protobuf.decoder import DecoderFactory
    except ImportError as error:
        raise InputError(
            f"topic {kind.topic!r} holds protobuf messages, and the library for them is not installed",
            "pip install 'flexid[protobuf]'",
        ) from error
    from mcap.records import Schema

    schema = Schema(id=1, name=kind.msgtype, encoding="protobuf", data=kind.schema)
    decoder: Decoder | None = DecoderFactory().decoder_for("protobuf", schema)
    if decoder is None:
        raise InputError(f"topic {kind.topic!r}: its protobuf schema cannot be used")
    return decoder
