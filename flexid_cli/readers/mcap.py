"""MCAP logs: chunked or not, zstd, lz4 or plain, with or without index and summary."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from flexid_cli.errors import InputError
from flexid_cli.readers.base import Note
from flexid_cli.readers.container import Container, Message, MessageReader, Probe
from flexid_cli.readers.damage import damaged, decoding, unreadable
from flexid_cli.readers.decoders import TopicType

MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQI")
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE_OP, _CHUNK_OP, _DATA_END = 1, 2, 3, 4, 5, 6, 15
_LARGEST_CHUNK = 1 << 32  # bytes; the format's own index cannot reach further into a chunk in practice


class McapReader(MessageReader):
    """Reader of MCAP files (https://mcap.dev/spec); every checksum that a file has is verified."""

    name = "mcap"
    suffixes: tuple[str, ...] = (".mcap",)

    def sniff(self, path: Path, head: bytes) -> bool:  # noqa: ARG002 - the protocol asks for it
        """Whether ``path`` begins with the MCAP magic."""
        return head.startswith(MAGIC)

    @contextmanager
    def open_files(self, paths: Sequence[Path]) -> Iterator[tuple[list[Container], list[Note]]]:
        """Open all files of one run."""
        yield [McapFile(path) for path in paths], []


@dataclass(frozen=True)
class _Schema:
    name: str
    encoding: str
    data: bytes


class McapFile:
    """One MCAP file, read from its beginning to its end so that it needs no index.

    Parameters
    ----------
    path : Path
        The file.
    shown : Path, optional
        The file that messages name, where ``path`` is an unpacked copy of it.
    """

    def __init__(self, path: Path, shown: Path | None = None) -> None:
        self.path = shown or path
        self.notes: list[Note] = []
        self._file = path

    def probe(self) -> Probe:
        """Count the messages of every topic; raise InputError where the file is damaged."""
        probe = Probe()
        for kind, log_time, _, data in self._messages(lambda _: True):
            probe.add(kind, log_time, data)
        return probe

    def messages(self, wanted: Callable[[str], bool]) -> Iterator[Message]:
        """Yield the messages of the wanted topics in the order of the file."""
        for kind, log_time, publish_time, data in self._messages(wanted):
            yield Message(kind, log_time, publish_time, bytes(data))

    def _messages(self, wanted: Callable[[str], bool]) -> Iterator[tuple[TopicType, int, int, memoryview]]:
        schemas: dict[int, _Schema] = {}
        kinds: dict[int, TopicType | None] = {}
        for opcode, body in self._records():
            if opcode == _MESSAGE_OP:
                if len(body) < _MESSAGE.size:
                    raise damaged(self.path, "a message record is too short")
                channel, _, log_time, publish_time = _MESSAGE.unpack_from(body)
                if channel not in kinds:
                    raise damaged(
                        self.path, f"a message belongs to channel {channel}, which is not described"
                    )
                kind = kinds[channel]
                if kind is not None:
                    yield kind, log_time, publish_time, body[_MESSAGE.size :]
            elif opcode == _SCHEMA:
                self._add_schema(bytes(body), schemas)
            elif opcode == _CHANNEL:
                number, kind = self._channel(bytes(body), schemas)
                kinds[number] = kind if wanted(kind.topic) else None

    def _add_schema(self, body: bytes, schemas: dict[int, _Schema]) -> None:
        from mcap.data_stream import ReadDataStream
        from mcap.records import Schema

        with decoding(self.path, "a schema record"):
            record = Schema.read(ReadDataStream(BytesIO(body)))
        schemas[record.id] = _Schema(record.name, record.encoding, record.data)

    def _channel(self, body: bytes, schemas: dict[int, _Schema]) -> tuple[int, TopicType]:
        from mcap.data_stream import ReadDataStream
        from mcap.records import Channel

        with decoding(self.path, "a channel record"):
            record = Channel.read(ReadDataStream(BytesIO(body)))
        if record.schema_id and record.schema_id not in schemas:
            raise damaged(
                self.path, f"channel {record.topic!r} names schema {record.schema_id}, which is not there"
            )
        schema = schemas.get(record.schema_id, _Schema("", "", b""))
        kind = TopicType(record.topic, schema.name, record.message_encoding, schema.encoding, schema.data)
        return record.id, kind

    def _records(self) -> Iterator[tuple[int, memoryview]]:
        """Yield schema, channel and message records, those inside chunks too."""
        for opcode, position, body in self._top_level():
            if opcode == _CHUNK_OP:
                yield from self._split(self._unpack(body, position), position)
            elif opcode in {_SCHEMA, _CHANNEL, _MESSAGE_OP}:
                yield opcode, memoryview(body)

    def _top_level(self) -> Iterator[tuple[int, int, bytes]]:
        """Yield the records of the data section with their positions, and verify the sections' checksums."""
        try:
            with self._file.open("rb") as stream:
                size = stream.seek(0, 2)
                stream.seek(0)
                if stream.read(len(MAGIC)) != MAGIC:
                    raise damaged(self.path, "it does not begin as an MCAP file")
                yield from self._data_section(stream, size)
                self._check_summary(stream, size)
        except OSError as error:
            raise unreadable(self.path, error) from error

    def _data_section(self, stream: BinaryIO, size: int) -> Iterator[tuple[int, int, bytes]]:
        checksum = zlib.crc32(MAGIC)
        while True:
            position = stream.tell()
            opcode, head, body = self._next(stream, size)
            if opcode == _DATA_END:
                self._compare("data section", body[:4], checksum)
                return
            if opcode == _FOOTER:
                raise damaged(self.path, f"the end of its data is not marked before byte {position}")
            checksum = zlib.crc32(body, zlib.crc32(head, checksum))
            yield opcode, position, body

    def _next(self, stream: BinaryIO, size: int) -> tuple[int, bytes, bytes]:
        position = stream.tell()
        head = stream.read(_RECORD.size)
        if len(head) < _RECORD.size:
            raise self._truncated(position, size)
        opcode, length = _RECORD.unpack(head)
        if opcode == 0:
            raise damaged(self.path, f"there is no record at byte {position} of {size}")
        if length > size - stream.tell():
            raise self._truncated(position, size)
        return opcode, head, stream.read(length)

    def _truncated(self, position: int, size: int) -> InputError:
        return InputError(
            f"{self.path} is damaged: the record at byte {position} goes beyond the end of the file "
            f"({size} bytes); the file is cut short or its recorder was killed",
            "copy it again from where it was recorded, or repair it with `mcap recover`",
        )

    def _check_summary(self, stream: BinaryIO, size: int) -> None:
        """Walk from the end of the data to the end of the file, whose checksum covers the summary."""
        checksum = 0
        while True:
            opcode, head, body = self._next(stream, size)
            if opcode == _FOOTER:
                break
            checksum = zlib.crc32(body, zlib.crc32(head, checksum))
        if len(body) < 20:
            raise damaged(self.path, "its footer is too short")
        self._compare("summary", body[16:20], zlib.crc32(body[:16], zlib.crc32(head, checksum)))
        if stream.read(len(MAGIC)) != MAGIC:
            raise damaged(self.path, "its closing magic is missing")
        if stream.tell() != size:
            raise damaged(self.path, f"{size - stream.tell()} bytes follow its end")

    def _compare(self, part: str, stored: bytes, computed: int) -> None:
        expected = int.from_bytes(stored, "little")
        if expected and expected != computed:
            raise damaged(self.path, f"the checksum of its {part} is wrong")

    def _unpack(self, body: bytes, position: int) -> bytes:
        """Return the records of a chunk, decompressed and verified."""
        where = f"the chunk at byte {position}"
        with decoding(self.path, where):
            _, _, size, checksum = _CHUNK.unpack_from(body)
            (name_length,) = struct.unpack_from("<I", body, _CHUNK.size)
            start = _CHUNK.size + 4 + name_length
            codec = body[_CHUNK.size + 4 : start].decode()
            (length,) = struct.unpack_from("<Q", body, start)
        packed = memoryview(body)[start + 8 : start + 8 + length]
        if len(packed) != length or size > _LARGEST_CHUNK:
            raise damaged(self.path, f"{where} has an impossible size")
        if codec not in {"", "zstd", "lz4"}:
            raise InputError(f"{self.path}: {where} is compressed with {codec!r}, which flexid does not read")
        with decoding(self.path, where):
            records = _decompress(codec, packed, size)
        if len(records) != size:
            raise damaged(self.path, f"{where} holds {len(records)} bytes instead of {size}")
        if checksum and zlib.crc32(records) != checksum:
            raise damaged(self.path, f"the checksum of {where} is wrong")
        return records

    def _split(self, records: bytes, chunk: int) -> Iterator[tuple[int, memoryview]]:
        view = memoryview(records)
        position, end = 0, len(records)
        while position < end:
            if end - position < _RECORD.size:
                raise damaged(self.path, f"the last record in the chunk at byte {chunk} is cut short")
            opcode, length = _RECORD.unpack_from(records, position)
            position += _RECORD.size
            if length > end - position:
                raise damaged(self.path, f"a record in the chunk at byte {chunk} is longer than the chunk")
            yield opcode, view[position : position + length]
            position += length


def _decompress(codec: str, packed: memoryview, size: int) -> bytes:
    if not size:
        return b""
    if codec == "zstd":
        import zstandard

        return bytes(zstandard.ZstdDecompressor().decompress(packed, max_output_size=size))
    if codec == "lz4":
        import lz4.frame

        return bytes(lz4.frame.decompress(packed))
    return bytes(packed)
