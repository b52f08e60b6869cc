"""Results of commands: to standard output for ``-``, else to files that are written whole or not at all."""

from __future__ import annotations

import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from flexid_cli.errors import OutputError
from flexid_cli.writers.files import check_targets, write_files

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

STDOUT = Path("-")


def check_outputs(outputs: Iterable[Path], *, force: bool = False, inputs: Sequence[Path] = ()) -> None:
    """Refuse impossible outputs before a long computation starts.

    Parameters
    ----------
    outputs : iterable of Path
        Files that will be written; ``-`` is standard output.
    force : bool
        Whether existing files may be replaced.
    inputs : sequence of Path
        Files and folders that are read; neither they nor files inside them are replaced, not even with
        ``force``.

    Raises
    ------
    OutputError
        A file exists, is an input, is named twice, or its folder does not exist.
    """
    files = [path for path in outputs if path != STDOUT and not _is_stream(path)]
    for path in files:
        if any(_is_or_holds(other, path) for other in inputs):
            message = f"{path} is an input of this run and cannot also be its output"
            raise OutputError(message, "give the output another name")
    check_targets(files, force=force)


def write_text_atomic(path: Path, text: str, force: bool = False) -> None:
    r"""Write ``text`` as UTF-8 with ``\n`` line ends; see `write_bytes_atomic`."""
    write_bytes_atomic(path, text.encode("utf-8"), force=force)


def write_bytes_atomic(path: Path, data: bytes, force: bool = False) -> None:
    """Write a file so that a reader sees either the old content or all of the new one.

    Parameters
    ----------
    path : Path
        The file; ``-`` is standard output. Devices and pipes are written to as they are.
    data : bytes
        Its whole content.
    force : bool
        Whether an existing file may be replaced.

    Raises
    ------
    OutputError
        The file exists and ``force`` is not given, or it cannot be written.
    """
    if path == STDOUT:
        _write_stdout(data)
    elif _is_stream(path):
        _write_stream(path, data)
    else:
        write_files({path: data}, force=force)


def _is_stream(path: Path) -> bool:
    """Whether ``path`` is a device or a pipe, which nothing can replace."""
    with suppress(OSError):
        return path.exists() and not path.is_file() and not path.is_dir()
    return False


def _is_or_holds(source: Path, output: Path) -> bool:
    with suppress(OSError):
        if output.exists() and source.exists() and source.samefile(output):
            return True
        return source.is_dir() and output.exists() and output.resolve().is_relative_to(source.resolve())
    return False


def _write_stream(path: Path, data: bytes) -> None:
    try:
        path.write_bytes(data)
    except BrokenPipeError:
        raise
    except OSError as error:
        message = f"cannot write {path}: {error.strerror or error}"
        raise OutputError(message) from error


def _write_stdout(data: bytes) -> None:
    binary = getattr(sys.stdout, "buffer", None)
    sys.stdout.flush()
    if binary is None:
        sys.stdout.write(data.decode("utf-8"))
    else:
        binary.write(data)
    sys.stdout.flush()
