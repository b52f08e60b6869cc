"""What an SQLite recorder that was killed left beside its database: taken in, or said why not."""

from __future__ import annotations

import sqlite3
import struct
from pathlib import Path
from typing import Literal

import numpy as np

_HEAD = 32  # bytes before the first frame of a write-ahead log
_FRAME_HEAD = 24
_MAGICS = (0x377F0682, 0x377F0683)


def close_recording(database: Path) -> str | None:
    """Merge the ``-wal`` or ``-journal`` beside ``database`` into it; both files are changed.

    Where SQLite refuses the database, the frames of the ``-wal`` are laid over its pages without it.

    Returns
    -------
    str or None
        What of the log was not taken in, as the rest of a sentence; None where all was.
    """
    wal = Path(f"{database}-wal")
    content = wal.read_bytes()[:_HEAD] if wal.exists() else b""
    size = wal.stat().st_size if wal.exists() else 0
    written = _frames(wal, size) if content else 0
    try:
        taken = _checkpoint(database)
    except sqlite3.Error as error:
        if not content:
            return f"could not be rolled back ({error})"
        laid = _overlay(database, wal, size)
        return f"could not be taken in by SQLite ({error}); {laid} of its pages are whole and were used"
    if content and taken < written:
        return f"is damaged: {taken} of its {written} pages are whole and were used"
    return None


def _checkpoint(database: Path) -> int:
    """Let SQLite merge the log; return how many frames it found whole and committed."""
    connection = sqlite3.connect(database)
    try:
        connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
        found = connection.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()
        return int(found[1])
    finally:
        connection.close()


def _frame_size(wal: Path) -> int:
    """Bytes of a frame, or 0 where the head of the log is damaged."""
    with wal.open("rb") as stream:
        head = stream.read(_HEAD)
    page = int.from_bytes(head[8:12], "big")
    sound = len(head) == _HEAD and int.from_bytes(head[:4], "big") in _MAGICS
    return _FRAME_HEAD + page if sound and page in {1 << k for k in range(9, 17)} else 0


def _heads(wal: Path, size: int) -> np.ndarray[tuple[int, int], np.dtype[np.uint32]]:
    """Heads of the frames that belong to the log's present round, shape (n, 6), up to its last commit."""
    frame = _frame_size(wal)
    count = (size - _HEAD) // frame if frame else 0
    if count <= 0:
        return np.empty((0, 6), dtype=np.uint32)
    table = np.memmap(wal, dtype=np.uint8, mode="r", offset=_HEAD, shape=(count, frame))
    heads = np.ascontiguousarray(table[:, :_FRAME_HEAD]).view(">u4").astype(np.uint32)
    with wal.open("rb") as stream:
        salt = np.frombuffer(stream.read(_HEAD)[16:24], dtype=">u4")
    current = (heads[:, 2:4] == salt).all(axis=1)
    commits = np.flatnonzero(current & (heads[:, 1] > 0))
    return np.where(current[:, None], heads, 0)[: commits[-1] + 1] if commits.size else heads[:0]


def _frames(wal: Path, size: int) -> int:
    return len(_heads(wal, size))


def _whole(wal: Path, count: int) -> int:
    """How many of the first ``count`` frames are whole: each frame's checksum goes on from the one before it."""
    frame = _frame_size(wal)
    with wal.open("rb") as stream:
        head = stream.read(_HEAD)
        order: Literal[">", "<"] = ">" if int.from_bytes(head[:4], "big") == _MAGICS[1] else "<"
        sums = _checksum(head[:24], order, (0, 0))
        if sums != struct.unpack(">II", head[24:32]):
            return 0
        for number in range(count):
            content = stream.read(frame)
            sums = _checksum(content[:8] + content[_FRAME_HEAD:], order, sums)
            if sums != struct.unpack(">II", content[16:24]):
                return number
    return count


def _checksum(content: bytes, order: Literal[">", "<"], sums: tuple[int, int]) -> tuple[int, int]:
    """The checksum of section 4.2 of the file format, continued from ``sums``."""
    first, second = sums
    words = struct.unpack(f"{order}{len(content) // 4}I", content)
    for even, odd in zip(words[::2], words[1::2], strict=True):
        first = (first + even + second) & 0xFFFFFFFF
        second = (second + odd + first) & 0xFFFFFFFF
    return first, second


def _overlay(database: Path, wal: Path, size: int) -> int:
    """Write the whole, committed pages of the log over those of the database; the last of each page counts."""
    heads = _heads(wal, size)
    heads = heads[: _whole(wal, len(heads))]
    commits = np.flatnonzero(heads[:, 1] > 0)
    heads = heads[: commits[-1] + 1] if commits.size else heads[:0]
    frame = _frame_size(wal)
    latest = {int(page): place for place, page in enumerate(heads[:, 0]) if page}
    with wal.open("rb") as source, database.open("r+b") as target:
        for page, place in sorted(latest.items()):
            source.seek(_HEAD + place * frame + _FRAME_HEAD)
            target.seek((page - 1) * (frame - _FRAME_HEAD))
            target.write(source.read(frame - _FRAME_HEAD))
    return len(latest)
