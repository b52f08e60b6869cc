"""Files written all or none: no reader ever sees half a file, and no failure leaves half a set."""

from __future__ import annotations

import os
import secrets
import shutil
from contextlib import contextmanager
from typing import TYPE_CHECKING

from flexid_cli.errors import OutputError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from pathlib import Path


def write_files(contents: Mapping[Path, str | bytes], *, force: bool = False) -> None:
    """Write every file, or none of them.

    All contents are first written to temporary files beside their targets and only then renamed. Where a
    rename fails, files already in place are taken back. A symbolic link stays one: the file behind it is
    replaced.

    Parameters
    ----------
    contents : mapping of Path to str or bytes
        Content of each file; text is written as UTF-8 with the line ends it has.
    force : bool
        Replace files that exist.

    Raises
    ------
    OutputError
        A file exists (and ``force`` is off), a folder is missing, or the system refuses; nothing has changed.
    """
    check_targets(contents, force=force)
    temporary: dict[Path, Path] = {}
    with _explained():
        try:
            for path, content in contents.items():
                target = path.resolve()
                temporary[target] = _temporary(target)
                _write(temporary[target], content)
            _replace_all(temporary)
        finally:
            for source in temporary.values():
                source.unlink(missing_ok=True)


def check_targets(paths: Iterable[Path], *, force: bool = False) -> None:
    """Refuse paths that cannot be written; to be called before long work, too.

    Raises
    ------
    OutputError
        A folder is missing, a path is a folder, exists (and ``force`` is off) or is named twice.
    """
    seen: set[Path] = set()
    with _explained():
        for path in paths:
            target = path.resolve()
            _check_target(path, target, force=force)
            if target in seen:
                message = f"cannot write {path}: it is asked for twice"
                raise OutputError(message, "give each output its own file name")
            seen.add(target)


def _check_target(path: Path, target: Path, *, force: bool) -> None:
    if not target.parent.is_dir():
        message = f"cannot write {path}: there is no folder {path.parent}"
        raise OutputError(message, "create the folder first, or give another one")
    if target.is_dir():
        message = f"cannot write {path}: it is a folder"
        raise OutputError(message, "give the name of a file")
    if target.exists() and not force:
        message = f"{path} exists already"
        raise OutputError(message, "give another name, or --force to replace it")


@contextmanager
def _explained() -> Iterator[None]:
    """Turn what the system refuses into an error with a cure."""
    try:
        yield
    except OSError as error:
        where = error.filename2 or error.filename or "the output"
        message = f"cannot write {where}: {error.strerror or error}"
        hint = "check free space and permissions of the folder; no output was changed"
        raise OutputError(message, hint) from error


def _temporary(target: Path) -> Path:
    return target.with_name(f".flexid-{secrets.token_hex(8)}.tmp")


def _write(path: Path, content: str | bytes) -> None:
    """Write a new file with the permissions that the user's umask grants, down to the disk."""
    data = content.encode("utf-8") if isinstance(content, str) else content
    with path.open("xb") as stream:
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())


def _replace_all(temporary: Mapping[Path, Path]) -> None:
    """Rename every temporary file to its target; undo the renames that were done where one fails."""
    backups: dict[Path, Path | None] = {}
    done = False
    try:
        for target, source in temporary.items():
            backups[target] = _backup(target)
            source.replace(target)
        done = True
    finally:
        for target, backup in backups.items():
            _settle(target, backup, temporary[target], keep=done)


def _backup(target: Path) -> Path | None:
    """Keep the old content of ``target`` under another name, with its permissions; None where it is new."""
    if not target.exists():
        return None
    backup = _temporary(target)
    shutil.copy2(target, backup)
    return backup


def _settle(target: Path, backup: Path | None, source: Path, *, keep: bool) -> None:
    """Drop the backup where the new content stays, else put the old content back."""
    replaced = not source.exists()
    if not keep and replaced:
        if backup is None:
            target.unlink(missing_ok=True)
        else:
            backup.replace(target)
    if backup is not None:
        if keep and target.exists():
            shutil.copymode(backup, target)
        backup.unlink(missing_ok=True)
