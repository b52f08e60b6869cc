"""``flexid identify``: the main job."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from flexid_cli.cli.effect_names import complete_effects, load_config_with_effects, with_override
from flexid_cli.cli.files import STDOUT, check_outputs, write_text_atomic
from flexid_cli.cli.options import (
    Console,
    config_option,
    example,
    force_option,
    json_option,
    output_option,
    pass_console,
    set_option,
    verbosity_options,
)
from flexid_cli.cli.reading import read_options, reading
from flexid_cli.cli.records import left_out, records_option, run_records, tell_of_records
from flexid_cli.cli.reports import QUIETEST, input_files, show_report, tell_of_reading, write_reports

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Any

    from flexid_cli.config.schema import Config
    from flexid_cli.estimate.result import Identification
    from flexid_cli.readers.base import RawLog, ReadOptions
    from flexid_cli.signals.recording import Recording
    from flexid_cli.signals.records import Mode, Records

NOTHING_IDENTIFIED = 3


@click.command(
    short_help="Estimate stiffness, inertias and friction from a log.",
    epilog=example(
        "flexid identify sample_logs/axis3.mcap --config configs/axis3.yaml",
        "flexid identify sample_logs/axis3.bag -c configs/axis3.yaml -o report.md",
        "flexid identify sample_logs/axis3.csv -c configs/axis3.yaml --with cogging",
    ),
)
@click.argument("logs", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="LOG...")
@config_option
@click.option(
    "--route",
    type=click.Choice(["direct", "paper"]),
    help="direct: fit the physical parameters, all terms kept (default); paper: reproduce the tables of Pham,"
    " Gautier and Poignet, two sigma and Table 3's inversion included.",
)
@click.option(
    "--with",
    "effects",
    multiple=True,
    metavar="EFFECT,...",
    shell_complete=complete_effects,
    help="Effects of the library that join the models (`flexid effects` lists them); the report has the"
    " parameters with and without them.",
)
@click.option(
    "--essential",
    is_flag=True,
    help="Set friction, gravity and offsets that the data cannot tell from zero to zero, and fit the rest again.",
)
@click.option(
    "--replay",
    type=click.IntRange(0, 1000),
    metavar="N",
    help="Simulate the fitted axis N times with the record's noise, estimate again, and report each parameter's"
    " bias; the estimates stay as they are (50 replays are plenty).",
)
@records_option
@set_option
@read_options
@json_option
@output_option
@force_option
@verbosity_options
@pass_console
def identify(
    console: Console,
    logs: tuple[Path, ...],
    config: Path,
    route: str | None,
    effects: tuple[str, ...],
    essential: bool,
    replay: int | None,
    records_mode: Mode,
    overrides: tuple[str, ...],
    start: float | None,
    end: float | None,
    strict: bool,
    keep_suspect: bool,
    as_json: bool,
    outputs: tuple[Path, ...],
    force: bool,
) -> None:
    """Estimate stiffness, inertias, friction and gravity of one axis from LOG, with confidence intervals.

    LOG is a CSV (also .gz, .zst), an MCAP, a rosbag2 folder or .db3, or a ROS 1 .bag; several LOGs are the files
    of one run, or records of one axis that are fitted together (--records). The report goes to the terminal, and with
    -o to .json and .md files (figures as SVG beside the Markdown); -o - prints the JSON instead, and -qq prints no
    report. Exit code 3: the data do not determine any parameter.
    """
    from flexid_cli.report.write import check_formats
    from flexid_cli.signals.records import read_records

    check_formats([path for path in outputs if path != STDOUT])
    check_outputs(outputs, force=force, inputs=[*logs, config])
    if route is not None:
        overrides = (*overrides, f"estimate.route={route}")
    if essential:
        overrides = (*overrides, "estimate.essential=true")
    if replay is not None:
        overrides = (*overrides, f"estimate.replay={replay}")
    overrides = (*overrides, *with_override(effects))
    loaded = load_config_with_effects(config, overrides)
    with reading(console, start, end, strict=strict, keep_suspect=keep_suspect) as options:
        found = read_records(logs, loaded, options, records_mode)
    identification, document = _run(found, loaded, console, options)
    write_reports(
        [path for path in outputs if path != STDOUT], document, identification, console, force=force
    )
    if as_json or STDOUT in outputs:
        from flexid_cli.report.json import render_json

        write_text_atomic(STDOUT, render_json(document))
    elif console.verbosity >= QUIETEST:
        show_report(document)
    if not _anything_identified(identification):
        console.error(
            "no parameter could be identified from this recording",
            "the reasons stand in the report; `flexid inspect LOG` shows what was recorded",
        )
        raise SystemExit(NOTHING_IDENTIFIED)


def _run(
    found: Records, config: Config, console: Console, options: ReadOptions
) -> tuple[Identification, dict[str, Any]]:
    tell_of_records(console, found)
    if len(found.records) > 1:
        return run_records(found, config, console, options)
    [one] = found.records
    notes = (*left_out(found), *one.recording.notes)
    return run_identify(one.paths, config, console, replace(one.recording, notes=notes), one.raw, options)


def run_identify(
    logs: Sequence[Path],
    config: Config,
    console: Console,
    recording: Recording,
    raw: RawLog,
    options: ReadOptions,
) -> tuple[Identification, dict[str, Any]]:
    """Identify, and build the report document."""
    from flexid_cli.config.load import config_digest
    from flexid_cli.report.document import build_document

    tell_of_reading(console, recording, raw, options)
    identification = _estimate(recording, config)
    document = build_document(
        identification=identification,
        recording=recording,
        inputs=input_files(logs, raw),
        config_digest=config_digest(config),
        config_resolved=config.resolved(),
    )
    return identification, document


def _estimate(recording: Recording, config: Config) -> Identification:
    if config.estimate.effects:
        from flexid_cli.diagnose.given import identify_with

        return identify_with(recording, config, config.estimate.effects)
    from flexid_cli.estimate.identify import identify as estimate

    return estimate(recording, config)


def _anything_identified(identification: Identification) -> bool:
    return any(e.verdict == "identified" for model in identification.models for e in model.parameters)
