"""rosbag2 recordings: folders (sqlite3 or MCAP, split, compressed), with or without metadata; .db3 files."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import Any

from flexid_cli.errors import InputError
from flexid_cli.readers.base import DEFAULT_OPTIONS, HEAD_BYTES, Note, Progress, ReadOptions
from flexid_cli.readers.container import Container, MessageReader
from flexid_cli.readers.damage import damaged, decoding, explain, unreadable
from flexid_cli.readers.decoders import ZSTD_MAGIC
from flexid_cli.readers.mcap import McapFile, McapReader
from flexid_cli.readers.mcap_records import MAGIC as MCAP_MAGIC
from flexid_cli.readers.sqlite_storage import SqliteFile
from flexid_cli.readers.wal import close_recording

SQLITE_MAGIC = b"SQLite format 3\x00"
METADATA = "metadata.yaml"
_PACKED_BYTES = 1 << 18
_PAGE = 4096
_STORAGE = re.compile(r"\.(db3|mcap)(\.zstd|\.zst)?$")


class Rosbag2Reader(MessageReader):
    """Reader of rosbag2 folders and of the sqlite3 files in them."""

    name = "rosbag2"
    suffixes: tuple[str, ...] = (".db3", ".db3.zstd", ".mcap.zstd")

    def sniff(self, path: Path, head: bytes) -> bool:
        """Whether ``path`` is a folder with a bag, an sqlite3 file, or a compressed storage file."""
        if path.is_dir():
            return (path / METADATA).is_file() or bool(_storage_files(path))
        if head.startswith(SQLITE_MAGIC) or is_packed_storage(head):
            return True
        # a database whose first page is destroyed can still be read; a table of text is none
        return path.suffix == ".db3" and not head.startswith(MCAP_MAGIC) and b"\x00" in head[:_PAGE]

    @contextmanager
    def open_files(
        self, paths: Sequence[Path], options: ReadOptions = DEFAULT_OPTIONS
    ) -> Iterator[tuple[list[Container], list[Note]]]:
        """Open all storage files of one run."""
        notes: list[Note] = []
        with ExitStack() as stack:
            members: list[Path] = []
            for path in paths:
                members += _members(path, notes) if path.is_dir() else [path]
            sizes = [path.stat().st_size for path in members if path.exists()]
            progress = Progress(options, sum(sizes))
            yield [_open_storage(stack, member, options, progress) for member in members], notes


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


def _open_storage(stack: ExitStack, path: Path, options: ReadOptions, progress: Progress) -> Container:
    try:
        with path.open("rb") as stream:
            head = stream.read(HEAD_BYTES)
    except OSError as error:
        raise unreadable(path, error) from error
    file, cut = path, None
    if head.startswith(ZSTD_MAGIC):
        file = _temporary(stack) / "storage"
        cut = _unpack(path, file)
        head = _head(file)
    if not head:
        raise InputError(f"{path} is empty", "its recorder was killed before it wrote anything")
    if McapReader().sniff(path, head):
        storage = McapFile(file, path, options, progress)
        storage.notes += [] if cut is None else [Note(cut)]
        return storage
    if not head.startswith(SQLITE_MAGIC) and ".db3" not in path.suffixes:
        raise damaged(path, "it begins neither as an sqlite3 nor as an MCAP file")
    return _open_sqlite(stack, file, path, progress, cut)


def _head(file: Path) -> bytes:
    with file.open("rb") as stream:
        return stream.read(HEAD_BYTES)


def _temporary(stack: ExitStack) -> Path:
    return Path(stack.enter_context(TemporaryDirectory(prefix="flexid-")))


def _unpack(path: Path, file: Path) -> str | None:
    """Decompress ``path`` into ``file`` as far as it goes, and say where that ends if not at its end."""
    import zstandard

    frame = zstandard.ZstdDecompressor().decompressobj()
    done = 0
    with path.open("rb") as packed, file.open("wb") as plain:
        while not frame.eof:
            block = packed.read(_PACKED_BYTES)
            if not block:
                return f"{path} is cut short: its zstd stream ends at byte {done} without its end"
            try:
                plain.write(frame.decompress(block))
            except zstandard.ZstdError as error:
                return (
                    f"{path} is damaged: its zstd stream cannot be read beyond byte {done} ({explain(error)})"
                )
            done += len(block)
    return None


def _open_sqlite(stack: ExitStack, file: Path, shown: Path, progress: Progress, cut: str | None) -> Container:
    """Open an sqlite3 storage without writing beside it.

    A recorder that was killed leaves its last messages in a ``-wal`` file (or an unfinished transaction in a
    ``-journal``), which SQLite takes in only where it may write: so a copy is made, and closed by it.
    """
    left = [
        side
        for end in ("-wal", "-journal")
        if (side := Path(f"{file}{end}")).exists() and side.stat().st_size
    ]
    failure = None
    if left:
        folder = _temporary(stack)
        for part in (file, *left):
            try:
                shutil.copyfile(part, folder / part.name)
            except OSError as error:
                raise unreadable(part, error) from error
        file = folder / file.name
        failure = close_recording(file)
    storage = SqliteFile(file, shown, stack, progress)
    if left:
        storage.notes.append(Note(f"{shown} was not closed by its recorder; {left[0].name} was read too"))
    if failure is not None:
        storage.report(f"{left[0]} {failure}", None)
    if cut is not None:
        storage.report(cut, None)
    return storage
