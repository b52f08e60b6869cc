"""Several LOGs of `identify`: files of one run, or records of one axis that are fitted together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

import click

from flexid_cli.cli.reports import input_files, tell_of_reading

if TYPE_CHECKING:
    from flexid_cli.cli.options import Console
    from flexid_cli.config.schema import Config
    from flexid_cli.estimate.result import Identification
    from flexid_cli.readers.base import ReadOptions
    from flexid_cli.report.document import InputFile
    from flexid_cli.signals.records import Record, Records

Command = TypeVar("Command", bound=Callable[..., Any])


def records_option(function: Command) -> Command:
    """``--records MODE``, parameter ``records_mode: str``."""
    return click.option(
        "--records",
        "records_mode",
        type=click.Choice(["auto", "each", "one"]),
        default="auto",
        show_default=True,
        help="What several LOGs are. each: records of one axis, fitted together; one: the files of one run; auto: as"
        " their stamps say, files that continue each other or lack a signal being of one run.",
    )(function)


def tell_of_records(console: Console, found: Records) -> None:
    """Say what was decided about the files, and which records are left out."""
    if found.decision:
        console.info(found.decision)
    if found.doubt:
        console.warning(found.doubt)
    for sentence in left_out(found):
        console.warning(sentence)


def left_out(found: Records) -> tuple[str, ...]:
    """One sentence about each record that could not be used."""
    return tuple(f"record {name} was left out: {reason}" for name, reason in found.left_out)


def run_records(
    found: Records, config: Config, console: Console, options: ReadOptions
) -> tuple[Identification, dict[str, Any]]:
    """Identify several records together, and build the report document."""
    from flexid_cli.config.load import config_digest
    from flexid_cli.estimate.records import identify_records
    from flexid_cli.report.document import build_document
    from flexid_cli.signals.records import pooled

    for record in found.records:
        tell_of_reading(console, record.recording, record.raw, options)
    identification = identify_records(found.records, config)
    identification = replace(identification, warnings=(*left_out(found), *identification.warnings))
    document = build_document(
        identification=identification,
        recording=pooled(found.records),
        inputs=[file for record in found.records for file in _inputs(record)],
        config_digest=config_digest(config),
        config_resolved=config.resolved(),
        records={record.name: record.recording for record in found.records},
    )
    return identification, document


def _inputs(record: Record) -> list[InputFile]:
    return [replace(file, record=record.name) for file in input_files(record.paths, record.raw)]
