"""``flexid identify``: the main job."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

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
from flexid_cli.cli.reports import QUIETEST, input_files, show_report, tell_of_reading, write_reports

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Any

    from flexid_cli.config.schema import Config
    from flexid_cli.estimate.result import Identification
    from flexid_cli.readers.base import RawLog, ReadOptions
    from flexid_cli.signals.recording import Recording

NOTHING_IDENTIFIED = 3


@click.command(
    short_help="Estimate stiffness, inertias and friction from a log.",
    epilog=example(
        "flexid identify sample_logs/axis3.mcap --config configs/axis3.yaml",
        "flexid identify sample_logs/axis3.bag -c configs/axis3.yaml -o report.md",
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
    of one run. The report goes to the terminal, and with -o to .json and .md files (figures as SVG beside the
    Markdown); -o - prints the JSON instead, and -qq prints no report. Exit code 3: the data do not determine any
    parameter.
    """
    from flexid_cli.config.load import load_config
    from flexid_cli.report.write import check_formats
    from flexid_cli.signals.build import build_recording

    check_formats([path for path in outputs if path != STDOUT])
    check_outputs(outputs, force=force, inputs=[*logs, config])
    if route is not None:
        overrides = (*overrides, f"estimate.route={route}")
    loaded = load_config(config, overrides)
    with reading(console, start, end, strict=strict, keep_suspect=keep_suspect) as options:
        recording, raw = build_recording(logs, loaded, options)
    identification, document = run_identify(logs, loaded, console, recording, raw, options)
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
    from flexid_cli.estimate.identify import identify as estimate
    from flexid_cli.report.document import build_document

    tell_of_reading(console, recording, raw, options)
    identification = estimate(recording, config)
    document = build_document(
        identification=identification,
        recording=recording,
        inputs=input_files(logs, raw),
        config_digest=config_digest(config),
        config_resolved=config.resolved(),
    )
    return identification, document


def _anything_identified(identification: Identification) -> bool:
    return any(e.verdict == "identified" for model in identification.models for e in model.parameters)
