"""What `identify` and `diagnose` have in common: inputs of the report, files, the report on the terminal."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from flexid_cli.cli.options import Console, wants_color
from flexid_cli.cli.reading import warn_of_damage

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Any

    from flexid_cli.diagnose.result import Diagnosis
    from flexid_cli.estimate.result import Identification
    from flexid_cli.readers.base import Damage as RawDamage
    from flexid_cli.readers.base import RawLog, ReadOptions
    from flexid_cli.report.document import InputFile
    from flexid_cli.signals.recording import Recording

QUIETEST = -1  # with -qq the report stays out too


def tell_of_reading(console: Console, recording: Recording, raw: RawLog, options: ReadOptions) -> None:
    """Warn of damage; with -v say what was read and what was done to it."""
    warn_of_damage(console, raw.damage, suspect_kept=options.keep_suspect)
    console.detail(f"read {recording.samples} samples at {recording.sample_rate_hz:.6g} Hz from {raw.format}")
    for step in recording.history:
        console.detail(f"  {step}")


def input_files(logs: Sequence[Path], raw: RawLog, role: str = "recording") -> list[InputFile]:
    """Inputs of the report: every log with its digest and what is damaged in it."""
    from flexid_cli.readers.digest import digest
    from flexid_cli.report.document import Damage, InputFile

    notes = tuple(note.message for note in raw.notes)
    damage = dict(zip(raw.paths, raw.damage, strict=False))
    return [
        InputFile(
            path=str(log),
            sha256=digest(log),
            format=raw.format,
            damage=None if log not in damage else Damage(**_fields_of(damage[log])),
            notes=notes if k == 0 else (),
            role=role,
        )
        for k, log in enumerate(logs)
    ]


def _fields_of(damage: RawDamage) -> dict[str, Any]:
    from dataclasses import fields

    return {field.name: getattr(damage, field.name) for field in fields(damage) if field.name != "path"}


def write_reports(
    files: Sequence[Path],
    document: dict[str, Any],
    result: Identification | Diagnosis,
    console: Console,
    *,
    force: bool,
) -> None:
    """Write every report that was asked for, all or none."""
    from flexid_cli.report.write import render_outputs
    from flexid_cli.writers.files import write_files

    if not files:
        return
    contents = render_outputs(document, result, files)
    write_files(contents, force=force)
    figures = len(contents) - len(files)
    beside = f" and {figures} figure{'' if figures == 1 else 's'} beside" if figures else ""
    console.info(f"wrote {', '.join(str(path) for path in files)}{beside}")


def show_report(document: dict[str, Any]) -> None:
    """Print the report on standard output, in the width of the terminal."""
    import sys

    from rich.console import Console as Terminal

    from flexid_cli.report.console import print_report

    terminal = Terminal(file=sys.stdout, no_color=wants_color() is False, highlight=False)
    # Captured, for rich itself would end the program with 1 where nobody reads the output any more.
    with terminal.capture() as capture:
        print_report(document, terminal)
    click.echo(capture.get(), nl=False, color=True)
