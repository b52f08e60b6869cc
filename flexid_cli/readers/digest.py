"""SHA-256 of a log, so that a report says exactly what it was made from."""

from __future__ import annotations

import hashlib
from pathlib import Path

from flexid_cli.errors import InputError


def digest(path: Path) -> str:
    """SHA-256 of a file; of a folder, that of the names and digests of the files in it, sorted.

    Raises
    ------
    InputError
        The file cannot be read.
    """
    try:
        if not path.is_dir():
            with path.open("rb") as file:
                return hashlib.file_digest(file, "sha256").hexdigest()
        files = sorted(p for p in path.rglob("*") if p.is_file())
    except OSError as error:
        raise InputError(
            f"{path}: {error.strerror or error}", "check the file and its permissions"
        ) from error
    lines = (f"{digest(p)}  {p.relative_to(path).as_posix()}\n" for p in files)
    return hashlib.sha256("".join(lines).encode()).hexdigest()
