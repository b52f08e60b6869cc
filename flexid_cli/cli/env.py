"""``flexid env``: what a bug report should say about the machine."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import click

from flexid_cli.cli.options import example

if TYPE_CHECKING:
    from collections.abc import Iterator

DISTRIBUTION = "flexid"
# Where flexid runs from a checkout its metadata are not installed; the list must not be empty then.
_USUAL = (
    "click",
    "matplotlib",
    "mcap",
    "numba",
    "numpy",
    "pandas",
    "pydantic",
    "pyyaml",
    "rich",
    "rosbags",
    "scipy",
    "zstandard",
)


@click.command(short_help="Print versions, for a bug report.", epilog=example("flexid env > environment.txt"))
def env() -> None:
    """Print the versions of flexid, Python, the system and all libraries, to be put into a bug report.

    No names of users, folders or files are printed.
    """
    rows = [*_system_rows(), *_library_rows()]
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        click.echo(f"{name:<{width}}  {value}")


def _system_rows() -> Iterator[tuple[str, str]]:
    import os
    import platform
    import sys

    from flexid_cli import __version__

    yield "flexid", __version__
    yield "python", f"{platform.python_version()} ({platform.python_implementation()})"
    yield "platform", platform.platform()
    yield "machine", f"{platform.machine()}, {os.cpu_count()} processors"
    yield "encoding", f"stdout {sys.stdout.encoding}, files {sys.getfilesystemencoding()}"


def _library_rows() -> Iterator[tuple[str, str]]:
    from importlib.metadata import PackageNotFoundError, version

    for name in _dependencies():
        try:
            yield name, version(name)
        except PackageNotFoundError:
            yield name, "not installed"


def _dependencies() -> list[str]:
    from importlib.metadata import PackageNotFoundError, requires

    try:
        requirements = requires(DISTRIBUTION) or []
    except PackageNotFoundError:
        return list(_USUAL)
    base = [text for text in requirements if "extra ==" not in text]
    return sorted(re.split(r"[^A-Za-z0-9_.-]", text, maxsplit=1)[0] for text in base)
