"""Options of the commands that read logs, and the progress bar of a long read."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

import click

from flexid_cli.cli.options import Console, wants_color
from flexid_cli.errors import UsageError

if TYPE_CHECKING:
    from flexid_cli.readers.base import Damage, ReadOptions

Command = TypeVar("Command", bound=Callable[..., Any])

PATIENCE_S = 1.0


def read_options(function: Command) -> Command:
    """``--start``, ``--end``, ``--strict``, ``--keep-suspect``; parameters of the same names."""
    options = (
        click.option(
            "--start",
            type=click.FloatRange(min=0.0),
            metavar="SECONDS",
            help="Leave out what was recorded before this time, counted from the first message of the log.",
        ),
        click.option(
            "--end",
            type=click.FloatRange(min=0.0),
            metavar="SECONDS",
            help="Leave out what was recorded from this time on.",
        ),
        click.option(
            "--strict",
            is_flag=True,
            help="Refuse a damaged log; without it, every sample that can be trusted is used, and the rest counted.",
        ),
        click.option(
            "--keep-suspect",
            is_flag=True,
            help="Use the samples of damaged places too, which may be wrong.",
        ),
    )
    for option in reversed(options):
        function = option(function)
    return function


@contextmanager
def reading(
    console: Console, start: float | None, end: float | None, *, strict: bool, keep_suspect: bool
) -> Iterator[ReadOptions]:
    """Yield the options of a read, and show a progress bar where it takes longer than a second.

    Raises
    ------
    UsageError
        The window is empty, or ``strict`` and ``keep_suspect`` contradict each other.
    """
    from flexid_cli.readers.base import ReadOptions

    for name, value in (("--start", start), ("--end", end)):
        if value is not None and not math.isfinite(value):
            raise UsageError(f"{name} {value} is no time", "give seconds, for example --start 12.5")
    if end is not None and end <= (start or 0.0):
        raise UsageError(
            f"--end {end:g} does not lie after --start {start or 0.0:g}", "give a window that is not empty"
        )
    if strict and keep_suspect:
        raise UsageError("--strict refuses what --keep-suspect would use", "leave one of the two out")
    with _Bar(console) as bar:
        yield ReadOptions(start, end, strict, keep_suspect, progress=bar.update if bar.is_wanted else None)


def warn_of_damage(console: Console, damage: Sequence[Damage], *, suspect_kept: bool) -> None:
    """Say what is damaged in the logs that were read."""
    for one in damage:
        if not one.is_harmless:
            console.warning(one.sentence(suspect_kept=suspect_kept))


class _Bar:
    """A progress bar on standard error; it appears after a second, and vanishes at the end."""

    def __init__(self, console: Console) -> None:
        self.is_wanted = console.verbosity == 0 and sys.stderr is not None and sys.stderr.isatty()
        self._since = time.monotonic()
        self._stack = ExitStack()
        self._show: Callable[[int, int], None] | None = None

    def __enter__(self) -> _Bar:
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def update(self, done: int, total: int) -> None:
        """Show ``done`` of ``total`` bytes."""
        if self._show is None:
            if time.monotonic() - self._since < PATIENCE_S:
                return
            self._show = self._start()
        self._show(done, total)

    def _start(self) -> Callable[[int, int], None]:
        from rich.console import Console as Terminal
        from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (TextColumn("reading"), BarColumn(), DownloadColumn(), TimeRemainingColumn())
        terminal = Terminal(stderr=True, no_color=wants_color() is False)
        progress = self._stack.enter_context(Progress(*columns, console=terminal, transient=True))
        task = progress.add_task("reading")
        return lambda done, total: progress.update(task, completed=done, total=total)
