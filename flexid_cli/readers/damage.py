"""Failures of the libraries that read containers, told in the program's own words."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from flexid_cli.errors import InputError

CURE = "copy the log again from where it was recorded; if it is damaged there too, record again"


def damaged(path: Path, detail: str) -> InputError:
    """Return the error for a log whose bytes are not what its format asks for."""
    return InputError(f"{path} is damaged: {detail}", CURE)


@cache
def failures() -> tuple[type[Exception], ...]:
    """Return the exceptions by which the libraries say that bytes are not what they should be."""
    import sqlite3
    import struct
    import zlib

    import zstandard
    from mcap.exceptions import McapError
    from rosbags.rosbag1 import ReaderError
    from rosbags.serde import SerdeError
    from rosbags.typesys import TypesysError

    own = (McapError, ReaderError, SerdeError, TypesysError, sqlite3.Error, zlib.error, zstandard.ZstdError)
    # what those libraries let through where a length or an index in the file is wrong
    bare = (struct.error, EOFError, ValueError, LookupError, ArithmeticError, AssertionError, RuntimeError)
    return (*own, *bare, TypeError, AttributeError, MemoryError)


def explain(error: BaseException) -> str:
    """Say in one line what a library's exception says, without its full stop."""
    text = " ".join(str(error).split()).rstrip(".")
    return text or type(error).__name__


@contextmanager
def decoding(path: Path, what: str) -> Iterator[None]:
    """Turn any failure of a library inside the block into one InputError about ``what`` in ``path``.

    Only calls into libraries belong into the block: a mistake of this program would be blamed on the file.
    """
    try:
        yield
    except OSError as error:
        raise unreadable(path, error) from error
    except failures() as error:
        raise damaged(path, f"{what} cannot be read ({explain(error)})") from error


def unreadable(path: Path, error: OSError) -> InputError:
    """Return the error for a file that the system does not give out, or that a codec refuses."""
    if error.strerror is None:
        return damaged(path, explain(error))
    return InputError(
        f"cannot read {path}: {error.strerror.lower()}", "check its permissions, or copy it first"
    )
