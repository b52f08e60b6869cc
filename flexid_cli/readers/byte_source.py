"""Bytes of a file by position, for several threads at once."""

from __future__ import annotations

import os
from pathlib import Path
from threading import Lock
from types import TracebackType

from flexid_cli.readers.damage import unreadable

_AHEAD = 1 << 12  # bytes; holds the heads of several small records


class ByteSource:
    """An open file that is read by position; its size is that at opening.

    Parameters
    ----------
    path : Path
        The file.
    shown : Path
        The file that errors name.
    """

    def __init__(self, path: Path, shown: Path) -> None:
        self._shown = shown
        try:
            self._stream = path.open("rb", buffering=0)
            self.size = self._stream.seek(0, os.SEEK_END)
        except OSError as error:
            raise unreadable(shown, error) from error
        self._lock = Lock()
        self._near = b""
        self._near_start = 0

    def __enter__(self) -> ByteSource:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stream.close()

    def read(self, position: int, count: int) -> bytes:
        """Return ``count`` bytes from ``position`` on, fewer at the end of the file; thread-safe."""
        count = min(count, self.size - position)
        if count <= 0:
            return b""
        try:
            part = self._read_once(position, count)
            if len(part) == count or not part:
                return part
            parts = [part]
            while part and (missing := count - sum(map(len, parts))):
                part = self._read_once(position + count - missing, missing)
                parts.append(part)
        except OSError as error:
            raise unreadable(self._shown, error) from error
        return b"".join(parts)

    def peek(self, position: int, count: int) -> bytes:
        """Like `read` for a few bytes near those read before; for one thread only."""
        start = position - self._near_start
        if start < 0 or start + count > len(self._near):
            self._near, self._near_start, start = self.read(position, max(count, _AHEAD)), position, 0
        return self._near[start : start + count]

    def _read_once(self, position: int, count: int) -> bytes:
        if hasattr(os, "pread"):
            return os.pread(self._stream.fileno(), count, position)
        with self._lock:
            self._stream.seek(position)
            return self._stream.read(count)
