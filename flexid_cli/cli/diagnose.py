"""``flexid diagnose``: where simulation and recording differ, and what physics was left out."""

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
from flexid_cli.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Any

    from flexid_cli.config.schema import Config
    from flexid_cli.diagnose.result import Diagnosis
    from flexid_cli.report.document import InputFile
    from flexid_cli.signals.recording import Recording

MISMATCH = 1
INCONCLUSIVE = 3


@click.command(
    short_help="Find what physics a model leaves out of a recording.",
    epilog=example(
        "flexid diagnose sample_logs/axis3.mcap --config configs/axis3.yaml",
        "flexid diagnose sample_logs/axis3.bag -c configs/axis3.yaml -o diagnosis.md",
    ),
)
@click.argument("logs", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="LOG...")
@config_option
@click.option(
    "--validate",
    "validation",
    multiple=True,
    metavar="LOG",
    type=click.Path(path_type=Path),
    help="Another run of the same axis, on which the result is checked; --start and --end do not cut it"
    " (repeatable: the files of that run).",
)
@click.option(
    "--report",
    "known",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="Report (JSON) whose parameters the model takes as known, instead of those that LOG itself gives.",
)
@click.option(
    "--simulation",
    metavar="LOG",
    type=click.Path(path_type=Path),
    help="Log of your own simulator with the same channels, whose parameters the model takes as known; told is too"
    " what the simulator itself holds beside the model.",
)
@click.option(
    "--fail-on",
    type=click.Choice(["mismatch"]),
    help="mismatch: exit with 1 unless the verdict is `adequate` (for CI).",
)
@set_option
@read_options
@json_option
@output_option
@force_option
@verbosity_options
@pass_console
def diagnose(
    console: Console,
    logs: tuple[Path, ...],
    config: Path,
    validation: tuple[Path, ...],
    known: Path | None,
    simulation: Path | None,
    fail_on: str | None,
    overrides: tuple[str, ...],
    start: float | None,
    end: float | None,
    strict: bool,
    keep_suspect: bool,
    as_json: bool,
    outputs: tuple[Path, ...],
    force: bool,
) -> None:
    """Find where the model and LOG differ, name what was left out, and show that the fit improves.

    LOG is a CSV (also .gz, .zst), an MCAP, a rosbag2 folder or .db3, or a ROS 1 .bag; several LOGs are the files
    of one run. The verdict is `adequate`, `explained`, `partly explained`, `ambiguous` (with the recording that
    would decide), `unexplained` (with the place) or `inconclusive`. The report goes to the terminal, and with -o
    to .json and .md files (figures as SVG beside the Markdown); -o - prints the JSON instead, and -qq prints no
    report. Exit code 3: the data are too poor to judge.
    """
    from flexid_cli.cli.known import known_input, known_parameters, simulated_parameters
    from flexid_cli.config.load import load_config
    from flexid_cli.report.write import check_formats

    if simulation is not None and known is not None:
        raise UsageError(
            "--simulation and --report both give the model's parameters", "leave out one of the two"
        )
    files = [path for path in outputs if path != STDOUT]
    check_formats(files)
    sources = [*logs, *validation, config, *(p for p in (known, simulation) if p is not None)]
    check_outputs(outputs, force=force, inputs=sources)
    loaded = load_config(config, overrides)
    recording, inputs = _read(logs, loaded, console, "recording", (start, end), strict, keep_suspect)
    other: Recording | None = None
    if validation:
        other, more = _read(validation, loaded, console, "validation", (None, None), strict, keep_suspect)
        inputs += more
    parameters: dict[str, float] | None = None
    if known is not None:
        parameters = known_parameters(known, recording, console)
        inputs.append(known_input(known))
    if simulation is not None:
        simulated, more = _read(
            (simulation,), loaded, console, "parameters", (None, None), strict, keep_suspect
        )
        inputs += more
        parameters = simulated_parameters(simulation, simulated, loaded, console)
    diagnosis, document = _diagnose(recording, other, loaded, inputs, parameters)
    write_reports(files, document, diagnosis, console, force=force)
    if as_json or STDOUT in outputs:
        from flexid_cli.report.json import render_json

        write_text_atomic(STDOUT, render_json(document))
    elif console.verbosity >= QUIETEST:
        show_report(document)
    _leave(diagnosis, console, fail_on)


def _read(
    logs: Sequence[Path],
    config: Config,
    console: Console,
    role: str,
    window: tuple[float | None, float | None],
    strict: bool,
    keep_suspect: bool,
) -> tuple[Recording, list[InputFile]]:
    from flexid_cli.signals.build import build_recording

    with reading(console, *window, strict=strict, keep_suspect=keep_suspect) as options:
        recording, raw = build_recording(logs, config, options)
    tell_of_reading(console, recording, raw, options)
    return recording, input_files(logs, raw, role)


def _diagnose(
    recording: Recording,
    validation: Recording | None,
    config: Config,
    inputs: list[InputFile],
    known: dict[str, float] | None,
) -> tuple[Diagnosis, dict[str, Any]]:
    from flexid_cli.config.load import config_digest
    from flexid_cli.diagnose.diagnose import diagnose as find
    from flexid_cli.report.document import build_document

    diagnosis = find(recording, config, validation, known=known)
    document = build_document(
        recording=recording,
        inputs=inputs,
        config_digest=config_digest(config),
        config_resolved=config.resolved(),
        diagnosis=diagnosis,
        validation=validation,
    )
    return diagnosis, document


def _leave(diagnosis: Diagnosis, console: Console, fail_on: str | None) -> None:
    """End with the exit code of the verdict; return where it is 0."""
    if diagnosis.verdict == "inconclusive":
        console.error(
            "the data are too poor to say whether the model left anything out",
            "the reasons stand in the report; `flexid inspect LOG` shows what was recorded",
        )
        raise SystemExit(INCONCLUSIVE)
    if fail_on == "mismatch" and diagnosis.verdict != "adequate":
        console.error(f"--fail-on mismatch: the verdict is {diagnosis.verdict.replace('_', ' ')}")
        raise SystemExit(MISMATCH)
