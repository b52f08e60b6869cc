"""The command ``flexid``: finds the command that was asked for; turns every failure into an exit code.

Command modules are imported only when they run, so that ``--version``, ``--help`` and the light commands
start at once.
"""

from __future__ import annotations

import difflib
import errno
import importlib
import os
import signal
import sys
import warnings
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from flexid_cli import __version__
from flexid_cli.cli.options import Console, is_debug
from flexid_cli.errors import ConfigError, FlexidError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from types import FrameType

    from click.shell_completion import CompletionItem

# Matrices here are tall and narrow: threads of the linear algebra gain nothing on them, wait for each other where
# the processors are busy (a diagnosis took three times as long), and make the last digits depend on the machine.
# It counts only for who has not said otherwise, and only before numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

PROGRAM = "flexid"
EXIT_ERROR = 2
EXIT_INTERRUPTED = 130
EXIT_BROKEN_PIPE = 141  # as a shell reports a process that SIGPIPE ended


@dataclass(frozen=True)
class CommandEntry:
    """Where a command lives, and its line in ``flexid --help``."""

    module: str
    function: str
    summary: str


COMMANDS = {
    "identify": CommandEntry(
        "flexid_cli.cli.identify", "identify", "Estimate stiffness, inertias and friction from a log."
    ),
    "diagnose": CommandEntry(
        "flexid_cli.cli.diagnose", "diagnose", "Find what physics a model leaves out of a recording."
    ),
    "tune-filter": CommandEntry(
        "flexid_cli.cli.tune_filter", "tune_filter", "Design the data filter and the decimation."
    ),
    "simulate": CommandEntry(
        "flexid_cli.cli.simulate", "simulate", "Simulate a log of a known axis, or a recording once more."
    ),
    "inspect": CommandEntry(
        "flexid_cli.cli.inspect", "inspect", "List a log's channels, rates and gaps; propose a configuration."
    ),
    "check": CommandEntry(
        "flexid_cli.cli.check", "check", "Check a configuration, and that a log has its signals."
    ),
    "effects": CommandEntry("flexid_cli.cli.effects", "effects", "List the effects that diagnose knows."),
    "explain": CommandEntry(
        "flexid_cli.cli.explain", "explain", "Say what an effect is, and what to do about it."
    ),
    "schema": CommandEntry(
        "flexid_cli.cli.schema", "schema", "Print the JSON Schema of the configuration or the report."
    ),
    "env": CommandEntry("flexid_cli.cli.env", "env", "Print versions, for a bug report."),
    "completion": CommandEntry(
        "flexid_cli.cli.completion", "completion", "Print the completion script for bash, zsh or fish."
    ),
}


class LazyGroup(click.Group):
    """A group whose commands are imported when they are used; only `COMMANDS` is read for help."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        """Names in the order of the table, which is the order of use."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002
        """Import and return one command; None where it is not known."""
        entry = COMMANDS.get(cmd_name)
        if entry is None:
            return None
        command: click.Command = getattr(importlib.import_module(entry.module), entry.function)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        """Write the table without importing a command."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, entry.summary) for name, entry in COMMANDS.items()])

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Complete command names from the table, for completion has to be fast too."""
        from click.shell_completion import CompletionItem

        names = [
            CompletionItem(name, help=entry.summary)
            for name, entry in COMMANDS.items()
            if name.startswith(incomplete)
        ]
        return names + click.Command.shell_complete(self, ctx, incomplete)

    def make_context(self, *args: Any, **kwargs: Any) -> click.Context:
        """Parse the command line, which prints help and version."""
        with _closed_pipe_as_exit():
            return super().make_context(*args, **kwargs)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Without arguments: help, on standard error, for nothing was asked for."""
        if not args and not ctx.resilient_parsing:
            click.echo(ctx.get_help(), err=True)
            ctx.exit(EXIT_ERROR)
        return super().parse_args(ctx, args)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command, or name the one that was meant."""
        name = args[0]
        if name not in COMMANDS and not name.startswith("-") and not ctx.resilient_parsing:
            near = difflib.get_close_matches(name, COMMANDS, n=1, cutoff=0.5)
            guess = f" Did you mean {near[0]!r}?" if near else ""
            ctx.fail(f"there is no command {name!r}.{guess}")
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: click.Context) -> None:
        """Run the command; what it returns is no exit code."""
        with _silent_logging(), _closed_pipe_as_exit():
            super().invoke(ctx)

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,
        windows_expand_args: bool = True,
        **extra: Any,
    ) -> Any:
        """Run as a program: every failure ends in a message and an exit code (DESIGN.md section 7)."""

        def run(**more: Any) -> Any:
            return super(LazyGroup, self).main(
                args,
                prog_name=prog_name or PROGRAM,
                complete_var=complete_var,
                standalone_mode=False,
                windows_expand_args=windows_expand_args,
                **more,
            )

        if not standalone_mode:
            return run(**extra)
        console = extra.pop("obj", None) or Console()
        _survive_narrow_encodings()
        with _watched_interrupts() as interrupts:
            code = _guarded(lambda: run(obj=console, **extra), console, interrupts)
        sys.exit(code)


def _guarded(run: Callable[[], Any], console: Console, interrupts: Sequence[int] = ()) -> int:
    """Exit code of ``run``, with the message of whatever went wrong. A crash never gives 1."""
    try:
        with _silent_warnings():
            code = run()
        if code == EXIT_BROKEN_PIPE:
            _drop_broken_streams()
        sys.stdout.flush()
    except (FlexidError, click.ClickException) as error:
        return _tell_failure(error, console)
    except (KeyboardInterrupt, click.Abort) as error:
        cause = error.__cause__
        if isinstance(cause, EOFError):  # click takes any EOFError for a closed terminal
            return _tell_bug(cause, console)
        console.plain("interrupted")
        return EXIT_INTERRUPTED
    except OSError as error:
        return _tell_os_error(error, console)
    except MemoryError:
        console.error("not enough memory", "use a shorter record, or a machine with more memory")
        return EXIT_ERROR
    except Exception as error:  # noqa: BLE001 - the last resort of the whole program
        if interrupts:
            console.plain("interrupted")
            return EXIT_INTERRUPTED
        return _tell_bug(error, console)
    return code if isinstance(code, int) else 0


@contextmanager
def _watched_interrupts() -> Iterator[list[int]]:
    """Remember every Ctrl-C, for a library that it hits while it is imported turns it into an ImportError."""
    seen: list[int] = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        seen.append(number)
        signal.default_int_handler(number, frame)

    try:
        own = signal.getsignal(signal.SIGINT) is signal.default_int_handler
        previous = signal.signal(signal.SIGINT, interrupt) if own else None
    except ValueError:  # not the main thread, which alone is interrupted
        previous = None
    try:
        yield seen
    finally:
        if previous is not None:
            signal.signal(signal.SIGINT, previous)


def _tell_failure(error: FlexidError | click.ClickException, console: Console) -> int:
    if isinstance(error, ConfigError):
        count = len(error.problems)
        mistakes = "1 mistake" if count == 1 else f"{count} mistakes"
        console.error(f"{mistakes} in {error.file}")
        console.plain(error.message)
    elif isinstance(error, FlexidError):
        console.error(error.message, error.hint)
    else:
        if isinstance(error, click.UsageError) and error.ctx is not None:
            console.plain(error.ctx.get_usage())
            console.plain(f"Try '{error.ctx.command_path} --help'.\n")
        console.error(error.format_message())
    return error.exit_code if isinstance(error, FlexidError) else EXIT_ERROR


def _tell_os_error(error: OSError, console: Console) -> int:
    """Keep silent about closed pipes; missing permissions and full disks are failures, but no bugs."""
    if error.errno == errno.EPIPE:
        _drop_broken_streams()
        return EXIT_BROKEN_PIPE
    place = f"{error.filename}: " if error.filename else ""
    console.error(f"{place}{error.strerror or error}")
    if is_debug() or console.is_verbose:
        console.plain(_traceback_of(error))
    _drop_broken_streams()
    return EXIT_ERROR


def _tell_bug(error: BaseException, console: Console) -> int:
    summary = " ".join(f"{type(error).__name__}: {error}".split())
    console.error(
        f"internal error: {summary}",
        "this is a bug in flexid: please report it with the output of `flexid env`"
        " and of the same command with -v",
    )
    if is_debug() or console.is_verbose:
        console.plain(_traceback_of(error))
    return EXIT_ERROR


def _traceback_of(error: BaseException) -> str:
    import traceback

    return "".join(traceback.format_exception(error)).rstrip()


def _drop_broken_streams() -> None:
    """Point streams that nobody reads at the null device, or the interpreter complains when it ends."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            with suppress(OSError, ValueError):
                null = os.open(os.devnull, os.O_WRONLY)
                os.dup2(null, stream.fileno())
                os.close(null)


def _survive_narrow_encodings() -> None:
    """Let a terminal that cannot show µ or ° get an escape instead of an error."""
    for stream in (sys.stdout, sys.stderr):
        reconfigure = getattr(stream, "reconfigure", None)
        encoding = (getattr(stream, "encoding", "") or "").lower().replace("-", "")
        if reconfigure is not None and not encoding.startswith("utf"):
            reconfigure(errors="backslashreplace")


@contextmanager
def _closed_pipe_as_exit() -> Iterator[None]:
    """Say that nobody reads the output any more; click would take it for a failure and exit with 1."""
    try:
        yield
    except OSError as error:
        if error.errno != errno.EPIPE:
            raise
        raise click.exceptions.Exit(EXIT_BROKEN_PIPE) from error


@contextmanager
def _silent_warnings() -> Iterator[None]:
    """Keep the warnings of libraries from people who cannot act on them."""
    with warnings.catch_warnings():
        if not is_debug() and not sys.warnoptions:
            warnings.simplefilter("ignore")
        yield


@contextmanager
def _silent_logging() -> Iterator[None]:
    """Keep the log lines of libraries off standard error, where Python puts them by default."""
    import logging

    if is_debug():
        yield
        return
    handler = logging.NullHandler()
    root = logging.getLogger()
    root.addHandler(handler)
    try:
        yield
    finally:
        root.removeHandler(handler)


@click.group(
    cls=LazyGroup,
    name=PROGRAM,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="\b\nExample:\n  flexid identify sample_logs/axis3.mcap --config configs/axis3.yaml",
)
@click.version_option(__version__, prog_name=PROGRAM)
def main() -> None:
    """Stiffness, inertias and friction of one robot axis, from its motor current and encoder logs.

    Exit codes: 0 done; 1 a gate failed; 2 usage, configuration, input or internal error; 3 the data cannot
    decide; 130 interrupted.
    """
