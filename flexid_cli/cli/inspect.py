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
)
from flexid_cli.cli.reading import read_options, reading, warn_of_damage

if TYPE_CHECKING:
    from flexid_cli.signals.inspect import ChannelSummary, Inspection

PIPE_WIDTH = 80
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
@read_options
@json_option
@force_option
@verbosity_options
@pass_console
def inspect(
    console: Console,
    logs: tuple[Path, ...],
    config_file: Path | None,
    start: float | None,
    end: float | None,
    strict: bool,
    keep_suspect: bool,
    as_json: bool,
    force: bool,
) -> None:
    """List the channels of a log: rates, gaps, clock jitter, units, range; propose a configuration.

    Several LOG files are the parts of one recording.
    """
    from flexid_cli.signals.inspect import as_document, inspect_log
    from flexid_cli.signals.propose import propose_config

    if config_file is not None:
        check_outputs([config_file], force=force, inputs=logs)
    with reading(console, start, end, strict=strict, keep_suspect=keep_suspect) as options:
        inspection = inspect_log(logs, options=options)
    proposal = propose_config(inspection)
    if as_json:
        import json

        text = json.dumps(as_document(inspection, proposal), indent=2, ensure_ascii=False, allow_nan=False)
        write_text_atomic(STDOUT, text + "\n")
    elif config_file is None or str(config_file) != "-":
        click.echo(_render(inspection), nl=False)
        if config_file is None:
            click.echo("\nProposed configuration (--write-config FILE writes it):\n")
            click.echo(proposal, nl=False)
    warn_of_damage(console, inspection.damage, suspect_kept=keep_suspect)
    for note in inspection.notes:
        console.warning(note)
    if config_file is not None:
        write_text_atomic(config_file, proposal, force=force)
        console.info(f"wrote {config_file}; replace every FILL_IN, then run `flexid check {config_file}`")


def _render(inspection: Inspection) -> str:
    """Return the table as text; where a name leaves no room for the numbers, they stand below it."""
    rows = [
        ("channel", COLUMNS),
        *((channel.info.source, _cells(channel)) for channel in inspection.channels),
    ]
    widths = [max(len(cells[n]) for _, cells in rows) for n in range(len(COLUMNS))]
    name_width = max(len(name) for name, _ in rows)
    fits = name_width + sum(widths) + 2 * len(widths) <= _terminal_width()
    lines = [_summary_line(inspection)]
    for name, cells in rows:
        numbers = "  ".join(map(str.rjust, cells[:-1], widths))
        text = f"{numbers}  {cells[-1]}"
        lines += [f"{name:<{name_width}}  {text}"] if fits else [name, f"  {text}"]
    return "\n".join(line.rstrip() for line in lines) + "\n"


def _terminal_width() -> int:
    """Columns of the terminal; 80 for a pipe."""
    import shutil
    import sys

    return shutil.get_terminal_size().columns if sys.stdout.isatty() else PIPE_WIDTH


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
