"""``flexid inspect``: what a log holds, and a first configuration for it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from flexid_cli.cli.files import STDOUT, check_outputs, write_text_atomic
from flexid_cli.cli.options import (
    Console,
    example,
    force_option,
    json_option,
    pass_console,
    verbosity_options,
    wants_color,
)

if TYPE_CHECKING:
    from flexid_cli.signals.inspect import ChannelSummary, Inspection

PIPE_WIDTH = 80
NAME_WIDTH = 12
COLUMNS = ("samples", "rate Hz", "jitter %", "gaps", "min", "max", "unit")


@click.command(
    "inspect",
    epilog=example(
        "flexid inspect sample_logs/axis3.mcap",
        "flexid inspect sample_logs/axis3.csv --write-config axis3.yaml",
    ),
)
@click.argument("logs", nargs=-1, required=True, metavar="LOG...", type=click.Path(path_type=Path))
@click.option(
    "--write-config",
    "config_file",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="Write the proposed configuration to FILE.",
)
@json_option
@force_option
@verbosity_options
@pass_console
def inspect(
    console: Console, logs: tuple[Path, ...], config_file: Path | None, as_json: bool, force: bool
) -> None:
    """List the channels of a log: rates, gaps, clock jitter, units, range; propose a configuration.

    Several LOG files are the parts of one recording.
    """
    from flexid_cli.signals.inspect import as_document, inspect_log
    from flexid_cli.signals.propose import propose_config

    if config_file is not None:
        check_outputs([config_file], force=force, inputs=logs)
    inspection = inspect_log(logs)
    proposal = propose_config(inspection)
    if as_json:
        import json

        text = json.dumps(as_document(inspection, proposal), indent=2, ensure_ascii=False, allow_nan=False)
        write_text_atomic(STDOUT, text + "\n")
    elif config_file is None or str(config_file) != "-":
        click.echo(_render(inspection), color=wants_color(), nl=False)
        if config_file is None:
            click.echo("\nProposed configuration (--write-config FILE writes it):\n")
            click.echo(proposal, nl=False)
    for note in inspection.notes:
        console.warning(note)
    if config_file is not None:
        write_text_atomic(config_file, proposal, force=force)
        console.info(f"wrote {config_file}; replace every FILL_IN, then run `flexid check {config_file}`")


def _render(inspection: Inspection) -> str:
    """Return the table as text: as wide as the terminal or 80 columns, wider where numbers need it."""
    import sys

    from rich.console import Console as RichConsole
    from rich.table import Table
    from rich.text import Text

    rows = [(channel.info.source, _cells(channel)) for channel in inspection.channels]
    widths = [max(len(title), *(len(cells[n]) for _, cells in rows)) for n, title in enumerate(COLUMNS)]
    needed = sum(widths) + 2 * len(widths) + NAME_WIDTH
    terminal = sys.stdout.isatty()
    own = RichConsole().width if terminal else PIPE_WIDTH
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column("channel", overflow="fold", min_width=NAME_WIDTH)
    for title, width in zip(COLUMNS, widths, strict=True):
        justify = "left" if title == "unit" else "right"
        table.add_column(title, justify=justify, no_wrap=True, min_width=width)  # type: ignore[arg-type]
    for source, cells in rows:
        table.add_row(Text(source), *(Text(cell) for cell in cells))
    rich = RichConsole(
        width=max(own, needed), force_terminal=terminal, no_color=wants_color() is False, highlight=False
    )
    with rich.capture() as capture:
        rich.print(Text(_summary_line(inspection)), soft_wrap=True)
        rich.print(table)
    return "\n".join(line.rstrip() for line in capture.get().splitlines()) + "\n"


def _summary_line(inspection: Inspection) -> str:
    channels = inspection.channels
    clocks = sorted({channel.clock.clock for channel in channels if channel.clock is not None})
    if inspection.time_column is not None:
        clocks = [f"column {inspection.time_column} in {inspection.time_unit}"]
    clock = f"clock: {', '.join(clocks)}" if clocks else "no clock found"
    duration = f", {inspection.duration_s:.6g} s" if inspection.duration_s is not None else ""
    return f"{inspection.format}: {len(channels)} channels{duration}, {clock}"


def _cells(channel: ChannelSummary) -> tuple[str, ...]:
    clock = channel.clock
    return (
        str(channel.info.count),
        _number(channel.rate_hz),
        f"{100.0 * clock.jitter_s / clock.period_s:.2g}" if clock is not None and clock.period_s else "-",
        str(clock.gaps) if clock is not None else "-",
        _number(channel.minimum),
        _number(channel.maximum),
        channel.info.unit or "-",
    )


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.6g}"
