"""Options that mean the same in every command, and the voice in which commands speak to people."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import click

Command = TypeVar("Command", bound=Callable[..., Any])


def is_debug() -> bool:
    """Whether FLEXID_DEBUG asks for tracebacks and the warnings of libraries."""
    return os.environ.get("FLEXID_DEBUG", "") not in {"", "0"}


def wants_color() -> bool | None:
    """Return False where NO_COLOR is set (https://no-color.org), else None: click looks at the terminal."""
    return False if os.environ.get("NO_COLOR") else None


class Console:
    """Messages to people, on standard error; standard output carries results only.

    Attributes
    ----------
    verbosity : int
        Number of ``-v`` minus number of ``-q``.
    """

    def __init__(self) -> None:
        self.verbosity = 0

    @property
    def is_quiet(self) -> bool:
        """Whether only results and errors are wanted."""
        return self.verbosity < 0

    @property
    def is_verbose(self) -> bool:
        """Whether details are wanted."""
        return self.verbosity > 0

    def info(self, text: str) -> None:
        """Say what is going on; silent with ``-q``."""
        if not self.is_quiet:
            self._say(text)

    def detail(self, text: str) -> None:
        """Say what only ``-v`` asks for."""
        if self.is_verbose:
            self._say(text)

    def warning(self, text: str) -> None:
        """Say what a person should know although the result stands; silent with ``-q``."""
        if not self.is_quiet:
            self._say(click.style("warning:", fg="yellow", bold=True) + f" {text}")

    def error(self, message: str, hint: str = "") -> None:
        """Say why there is no result; never silent."""
        self._say(click.style("error:", fg="red", bold=True) + f" {message}")
        if hint:
            self._say(f"  {click.style('hint:', fg='cyan')} {hint}")

    def plain(self, text: str) -> None:
        """Say something that belongs to an error; never silent."""
        self._say(text)

    def _say(self, text: str) -> None:
        # Where standard error is closed there is nobody left to tell.
        with suppress(OSError, ValueError):
            click.echo(_wrapped(text), err=True, color=wants_color())


def _wrapped(text: str) -> str:
    """Break a long line between words where a terminal would break it within one."""
    if "\n" in text or not sys.stderr.isatty():
        return text
    import shutil
    import textwrap

    indent = " " * (2 + len(text) - len(text.lstrip()))
    width = max(shutil.get_terminal_size().columns, 40)
    return textwrap.fill(
        text, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )  # fmt: skip


pass_console = click.make_pass_decorator(Console, ensure=True)


def example(*lines: str) -> str:
    """Epilog of a command: example lines that can be pasted into a shell as they stand."""
    return "\b\nExample:\n" + "\n".join(f"  {line}" for line in lines)


def config_option(function: Command) -> Command:
    """``-c/--config FILE``, parameter ``config: Path``."""
    return click.option(
        "-c",
        "--config",
        required=True,
        metavar="FILE",
        type=click.Path(path_type=Path),
        help="Configuration of the axis and its signals (YAML; - reads standard input).",
    )(function)


def set_option(function: Command) -> Command:
    """``--set KEY=VALUE`` (repeatable), parameter ``overrides: tuple[str, ...]``."""
    return click.option(
        "--set",
        "overrides",
        multiple=True,
        metavar="KEY=VALUE",
        help="Replace a value of the configuration, for example axis.f1_hz=3.9 (repeatable).",
    )(function)


def json_option(function: Command) -> Command:
    """``--json``, parameter ``as_json: bool``."""
    return click.option(
        "--json", "as_json", is_flag=True, help="Print the result as JSON on standard output, nothing else."
    )(function)


def output_option(function: Command) -> Command:
    """``-o/--output FILE`` (repeatable), parameter ``outputs: tuple[Path, ...]``."""
    return click.option(
        "-o",
        "--output",
        "outputs",
        multiple=True,
        metavar="FILE",
        type=click.Path(path_type=Path),
        help="Write the result to FILE, its format by suffix (repeatable).",
    )(function)


def force_option(function: Command) -> Command:
    """``--force``, parameter ``force: bool``."""
    return click.option("--force", is_flag=True, help="Replace output files that exist.")(function)


def verbosity_options(function: Command) -> Command:
    """``-q/--quiet`` and ``-v/--verbose``; they set the `Console` and pass no parameter."""
    quiet = click.option(
        "-q",
        "--quiet",
        count=True,
        expose_value=False,
        callback=lambda context, _, count: _change_verbosity(context, -count),
        help="Say nothing but the result and errors.",
    )
    verbose = click.option(
        "-v",
        "--verbose",
        count=True,
        expose_value=False,
        callback=lambda context, _, count: _change_verbosity(context, count),
        help="Say more; show the traceback of an internal error.",
    )
    return verbose(quiet(function))


def _change_verbosity(context: click.Context, change: int) -> None:
    context.ensure_object(Console).verbosity += change
