"""rosbag2 recordings: folders (sqlite3 or MCAP, split, compressed), with or without metadata; .db3 files."""

from __future__ import annotations

import re
import shutil
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import quote

from flexid_cli.errors import InputError
from flexid_cli.readers.base import HEAD_BYTES, Note
from flexid_cli.readers.container import Container, Message, MessageReader, Probe
from flexid_cli.readers.damage import damaged, decoding, unreadable
from flexid_cli.readers.decoders import ZSTD_MAGIC, TopicType
from flexid_cli.readers.mcap import MAGIC as MCAP_MAGIC
from flexid_cli.readers.mcap import McapFile

SQLITE_MAGIC = b"SQLite format 3\x00"
METADATA = "metadata.yaml"
_STORAGE = re.compile(r"\.(db3|mcap)(\.zstd|\.zst)?$")


class Rosbag2Reader(MessageReader):
    """Reader of rosbag2 folders and of the sqlite3 files in them."""

    name = "rosbag2"
    suffixes: tuple[str, ...] = (".db3", ".db3.zstd", ".mcap.zstd")

    def sniff(self, path: Path, head: bytes) -> bool:
        """Whether ``path`` is a folder with a bag, an sqlite3 file, or a compressed storage file."""
        if path.is_dir():
            return (path / METADATA).is_file() or bool(_storage_files(path))
        return head.startswith(SQLITE_MAGIC) or is_packed_storage(head)

    @contextmanager
    def open_files(self, paths: Sequence[Path]) -> Iterator[tuple[list[Container], list[Note]]]:
        """Open all storage files of one run."""
        notes: list[Note] = []
        with ExitStack() as stack:
            files: list[Container] = []
            for path in paths:
                members = _members(path, notes) if path.is_dir() else [path]
                files += [_open_storage(stack, member) for member in members]
            yield files, notes


def is_packed_storage(head: bytes) -> bool:
    """Whether ``head`` is the start of a zstd file with an sqlite3 or MCAP file in it."""
    if not head.startswith(ZSTD_MAGIC):
        return False
    import zstandard

    try:
        start = zstandard.ZstdDecompressor().decompressobj().decompress(head)
    except zstandard.ZstdError:
        return False
    return bytes(start).startswith((SQLITE_MAGIC, MCAP_MAGIC))


def _storage_files(folder: Path) -> list[Path]:
    found = [path for path in folder.iterdir() if _STORAGE.search(path.name)]
    return sorted(
        found, key=lambda path: [(int(n or -1), t) for n, t in re.findall(r"(\d*)(\D*)", path.name)]
    )


def _members(folder: Path, notes: list[Note]) -> list[Path]:
    """List the storage files of a bag folder, as its metadata or, without that, the folder says."""
    metadata = folder / METADATA
    if not metadata.is_file():
        notes.append(Note(f"{folder} has no {METADATA}; all storage files in it were read"))
        return _storage_files(folder)
    names = _listed(metadata)
    if not names:
        raise damaged(metadata, "it lists no files")
    members = [folder / PurePath(name).name for name in names]
    for member in members:
        if not member.is_file():
            raise InputError(
                f"{folder} lacks the file {member.name!r} that its {METADATA} lists",
                f"copy the whole folder, or remove {METADATA} to read the files that are there",
            )
    left = [path.name for path in _storage_files(folder) if path not in members]
    if left:
        notes.append(Note(f"{folder}: {', '.join(left)} not read, for {METADATA} does not list it"))
    return members


def _listed(metadata: Path) -> list[str]:
    import yaml

    try:
        with decoding(metadata, "it"):
            document = yaml.safe_load(metadata.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        raise damaged(metadata, "it is not YAML") from error
    found = document.get("rosbag2_bagfile_information") if isinstance(document, dict) else None
    information: dict[str, Any] = found if isinstance(found, dict) else {}
    names: Any = information.get("relative_file_paths")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError(
            f"{metadata} is not the metadata of a bag (it has no list of files)",
            "remove it to read the storage files that are in the folder",
        )
    _check_format(metadata, information)
    return names


def _check_format(metadata: Path, information: dict[str, Any]) -> None:
    storage = information.get("storage_identifier") or ""
    if storage not in {"", "sqlite3", "mcap"}:
        raise InputError(f"{metadata}: flexid does not read the storage {storage!r}", "use sqlite3 or mcap")
    packing = information.get("compression_format") or ""
    if packing not in {"", "zstd"}:
        raise InputError(f"{metadata}: flexid does not read the compression {packing!r}", "use zstd")


def _open_storage(stack: ExitStack, path: Path) -> Container:
    try:
        with path.open("rb") as stream:
            head = stream.read(HEAD_BYTES)
    except OSError as error:
        raise unreadable(path, error) from error
    file = path
    if head.startswith(ZSTD_MAGIC):
        file = Path(stack.enter_context(TemporaryDirectory(prefix="flexid-"))) / "storage"
        head = _unpack(path, file)
    if head.startswith(MCAP_MAGIC):
        return McapFile(file, path)
    if head.startswith(SQLITE_MAGIC):
        return stack.enter_context(_opened(file, path))
    if not head:
        raise InputError(f"{path} is empty", "its recorder was killed before it wrote anything")
    raise damaged(path, "it begins neither as an sqlite3 nor as an MCAP file")


def _unpack(path: Path, file: Path) -> bytes:
    """Decompress ``path`` into ``file`` and return its first bytes."""
    import zstandard

    with decoding(path, "its zstd stream"), path.open("rb") as packed, file.open("wb") as plain:
        frame = zstandard.ZstdDecompressor().decompressobj()
        while block := packed.read(1 << 20):
            plain.write(frame.decompress(block))
            if frame.eof:
                break
        if not frame.eof:
            raise EOFError("it is cut short")
    with file.open("rb") as plain:
        return plain.read(HEAD_BYTES)


@contextmanager
def _opened(file: Path, shown: Path) -> Iterator[Container]:
    """Open an sqlite3 storage without writing beside it.

    A recorder that was killed leaves its last messages in a ``-wal`` file (or an unfinished transaction in a
    ``-journal``), which SQLite takes into account only when it may write beside the database: then a copy is
    opened.
    """
    left = [
        side
        for end in ("-wal", "-journal")
        if (side := Path(f"{file}{end}")).exists() and side.stat().st_size
    ]
    with ExitStack() as stack:
        flags = "immutable=1"
        if left:
            folder = Path(stack.enter_context(TemporaryDirectory(prefix="flexid-")))
            for part in (file, *left):
                try:
                    shutil.copyfile(part, folder / part.name)
                except OSError as error:
                    raise unreadable(part, error) from error
            file, flags = folder / file.name, "mode=rw"
        with decoding(shown, "its database"):
            database = sqlite3.connect(f"file:{quote(str(file))}?{flags}", uri=True)
        stack.callback(database.close)
        storage = _SqliteFile(shown, database)
        if left:
            storage.notes.append(Note(f"{shown} was not closed by its recorder; {left[0].name} was read too"))
        yield storage


class _SqliteFile:
    """One open sqlite3 storage file."""

    def __init__(self, path: Path, database: sqlite3.Connection) -> None:
        self.path = path
        self.notes: list[Note] = []
        self._database = database
        with decoding(path, "its database"):
            tables = {
                name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
            }
        if not {"topics", "messages"} <= tables:
            raise InputError(
                f"{path} is an sqlite3 file, but no rosbag2 recording", "it has no table of messages"
            )
        with decoding(path, "its tables"):
            self._kinds = self._topics("message_definitions" in tables)

    def _topics(self, described: bool) -> dict[int, TopicType]:
        definitions: dict[str, tuple[str, str]] = {}
        if described:
            query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            definitions = {name: (encoding, text) for name, encoding, text in self._database.execute(query)}
        kinds = {}
        for number, topic, msgtype, encoding in self._database.execute(
            "SELECT id, name, type, serialization_format FROM topics"
        ):
            schema_encoding, text = definitions.get(msgtype, ("", ""))
            if not text.strip():
                schema_encoding = ""
            kinds[number] = TopicType(topic, msgtype, encoding, schema_encoding, text.encode())
        return kinds

    def probe(self) -> Probe:
        """Count the messages, and keep every topic's first."""
        probe = Probe()
        with decoding(self.path, "its table of messages"):
            counts = self._database.execute(
                "SELECT topic_id, count(*) FROM messages GROUP BY topic_id"
            ).fetchall()
            first = self._database.execute("SELECT timestamp FROM messages ORDER BY id LIMIT 1").fetchone()
        for number, count in counts:
            if number not in self._kinds:
                raise damaged(self.path, f"a message belongs to topic {number}, which is not described")
            for message in self._read([number]):
                probe.add(message.kind, message.log_time, message.data)
                if probe.counts[message.kind] > len(probe.samples[message.kind]):
                    break
            seen = probe.counts[self._kinds[number]]
            probe.counts[self._kinds[number]] = max(seen, count)
        probe.first_log_time = first[0] if first else None
        return probe

    def messages(self, wanted: Callable[[str], bool]) -> Iterator[Message]:
        """Yield the messages of the wanted topics in the order they were recorded."""
        return self._read([number for number, kind in self._kinds.items() if wanted(kind.topic)])

    def _read(self, topics: Sequence[int]) -> Iterator[Message]:
        places = ",".join("?" * len(topics))
        query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({places}) ORDER BY id"  # noqa: S608
        with decoding(self.path, "its table of messages"):
            rows = self._database.execute(query, list(topics))
        count = 0
        while True:
            with decoding(self.path, f"what follows its message {count}"):
                batch = rows.fetchmany(4096)
            if not batch:
                return
            for number, log_time, data in batch:
                if not isinstance(log_time, int) or not isinstance(data, bytes):
                    raise damaged(self.path, f"its message {count + 1} has no stamp or no content")
                count += 1
                yield Message(self._kinds[number], log_time, None, data)
