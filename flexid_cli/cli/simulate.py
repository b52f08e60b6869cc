"""``flexid simulate``: logs of a known axis, and recordings laid over their simulation."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
    wants_color,
)
from flexid_cli.cli.reading import read_options, reading, warn_of_damage
from flexid_cli.errors import OutputError, UsageError

if TYPE_CHECKING:
    from flexid_cli.config.schema import Config
    from flexid_cli.effects.base import EffectValues
    from flexid_cli.readers.base import ReadOptions
    from flexid_cli.simulate.overlay import Overlay
    from flexid_cli.simulate.parameters import Given
    from flexid_cli.simulate.setup import Wishes

TRUTH = ".json"
BAG_FOLDER_FILE = "metadata.yaml"
_POSITIVE = click.FloatRange(min=0.0, min_open=True)


@click.command(
    short_help="Simulate a log of a known axis, or a recording once more.",
    epilog=example(
        "flexid simulate -c configs/sim.yaml --effects backlash=0.001 -o run.mcap",
        "flexid simulate -c configs/sim.yaml --like sample_logs/axis3.mcap -o x.mcap",
    ),
)
@config_option
@click.option(
    "--report",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="Parameters: those that a JSON report of `flexid identify` estimated.",
)
@click.option(
    "--truth",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="Parameters: those of a truth file, as sample_logs/ has one and -o FILE.json writes one.",
)
@click.option(
    "--model",
    type=click.Choice(["two_encoders", "motor_only"]),
    help="Which model of the report (default: two_encoders where it has it).",
)
@click.option(
    "-p",
    "--parameter",
    "parameters",
    multiple=True,
    metavar="SYMBOL=VALUE",
    help="One parameter by its symbol (Jm, K, JL, FVm, FSm, FV, FS, MX, MY, torque_offset, reversal_velocity),"
    " joint side, SI (repeatable).",
)
@click.option(
    "--effects",
    multiple=True,
    metavar="NAME.PARAMETER=VALUE",
    help="Switch an effect on, for example backlash.gap=0.001 or backlash=0.001 (repeatable; commas separate).",
)
@click.option(
    "--trajectory",
    metavar="chirp|updown|multisine|slow|FILE",
    help="What the reference does (default: chirp); FILE is a log that holds a reference.",
)
@click.option("--amplitude", type=_POSITIVE, metavar="RAD", help="Of the trajectory, joint side, rad (m).")
@click.option("--start-hz", type=_POSITIVE, metavar="HZ", help="Lowest frequency of the trajectory.")
@click.option("--stop-hz", type=_POSITIVE, metavar="HZ", help="Highest frequency of the trajectory.")
@click.option("--duration", type=_POSITIVE, metavar="SECONDS", help="Length of the record (default: 60).")
@click.option(
    "--rate",
    type=_POSITIVE,
    metavar="HZ",
    help="Rate of record and controller (default: that of the parameters' source, else 1000).",
)
@click.option("--seed", type=click.IntRange(min=0), metavar="N", help="Seed of all noise (default: 0).")
@click.option(
    "--like",
    "likes",
    multiple=True,
    metavar="LOG",
    type=click.Path(path_type=Path),
    help="Simulate this recording once more, and write measured, simulated and residual signals (repeatable: the"
    " files of one run).",
)
@click.option(
    "--drive",
    type=click.Choice(["controller", "motor"]),
    help="With --like, what moves the simulation: the reference through the controller, or the measured motor"
    " position (default: the controller where both are known).",
)
@set_option
@read_options
@json_option
@output_option
@force_option
@verbosity_options
@pass_console
def simulate(
    console: Console,
    config: Path,
    report: Path | None,
    truth: Path | None,
    model: str | None,
    parameters: tuple[str, ...],
    effects: tuple[str, ...],
    trajectory: str | None,
    amplitude: float | None,
    start_hz: float | None,
    stop_hz: float | None,
    duration: float | None,
    rate: float | None,
    seed: int | None,
    likes: tuple[Path, ...],
    drive: str | None,
    overrides: tuple[str, ...],
    start: float | None,
    end: float | None,
    strict: bool,
    keep_suspect: bool,
    as_json: bool,
    outputs: tuple[Path, ...],
    force: bool,
) -> None:
    """Simulate the axis under its controller, and write what a drive would have logged.

    The log has the configuration's own terms (sources, units, sides, signs, counts), so that `flexid identify`
    reads it with the same configuration. Parameters come from --report, --truth or the configuration's section
    `simulation`; --parameter replaces single ones. The format is that of each -o: .mcap, .csv (.gz, .zst), .bag,
    .db3, a name without suffix for a rosbag2 folder, and .json for the truth. The same arguments give the same bytes.

    With --like LOG the recording is simulated once more and laid over itself: an .mcap for Foxglove and PlotJuggler.
    """
    from flexid_cli.config.load import load_config
    from flexid_cli.simulate.setup import Wishes

    inputs = [config, *likes, *(path for path in (report, truth) if path is not None)]
    _check_outputs(outputs, inputs, as_json=as_json, force=force)
    loaded = load_config(config, overrides)
    wishes = Wishes(trajectory, amplitude, start_hz, stop_hz, duration, rate, seed)
    if likes:
        _refuse_for_overlay(wishes)
        given, single, switched = _machine(console, loaded, report, truth, model, parameters, effects)
        with reading(console, start, end, strict=strict, keep_suspect=keep_suspect) as options:
            found = _overlay(console, likes, loaded, options, given, single, switched, drive)
        _write_overlay(console, found, given, outputs, as_json=as_json, force=force)
        return
    if drive is not None or start is not None or end is not None or strict or keep_suspect:
        raise UsageError(
            "--drive, --start, --end, --strict and --keep-suspect belong to --like LOG", "leave them out"
        )
    given, single, switched = _machine(console, loaded, report, truth, model, parameters, effects)
    _record(console, loaded, given, single, switched, wishes, outputs, as_json=as_json, force=force)


def _machine(
    console: Console,
    config: Config,
    report: Path | None,
    truth: Path | None,
    model: str | None,
    parameters: Sequence[str],
    effects: Sequence[str],
) -> tuple[Given, dict[str, float], tuple[EffectValues, ...]]:
    """Where the parameters come from, single ones, and effects."""
    from flexid_cli.simulate.parameters import (
        Given,
        from_config,
        from_report,
        from_truth,
        parse_effects,
        parse_parameters,
    )

    if report is not None and truth is not None:
        raise UsageError("--report and --truth exclude each other", "give the source of parameters once")
    if model is not None and report is None:
        raise UsageError(
            "--model chooses among the models of a report", "give --report FILE, or leave it out"
        )
    switched, notes = parse_effects(effects)
    single = parse_parameters(parameters)
    if report is not None:
        given = from_report(report, model)
    elif truth is not None:
        given = from_truth(truth)
    else:
        given = Given() if config.simulation is None else from_config(config.simulation)
    for note in given.notes:
        console.warning(note)
    for note in notes:
        console.info(note)
    return given, single, switched


def _record(
    console: Console,
    config: Config,
    given: Given,
    single: dict[str, float],
    switched: Sequence[EffectValues],
    wishes: Wishes,
    outputs: Sequence[Path],
    *,
    as_json: bool,
    force: bool,
) -> None:
    from flexid_cli.report.json import render_json
    from flexid_cli.simulate import logged
    from flexid_cli.simulate.setup import prepare, run, torque_noise
    from flexid_cli.simulate.setup import truth as truth_of

    logs = [path for path in outputs if path.suffix.lower() != TRUTH]
    for path in logs:
        logged.check_sources(path, config)
    setup = prepare(config, given, wishes, parameters=single, effects=switched)
    seconds = setup.reference.size / setup.rate_hz
    with _working(console, f"simulating {seconds:g} s"):
        result = run(setup)
    signals = logged.as_logged(result, setup.rate_hz, config, torque_noise(setup))
    document = render_json(truth_of(setup, config, given.source))
    record = f"{setup.reference.size} samples at {setup.rate_hz:g} Hz, {seconds:g} s"
    console.detail(
        f"{result.steps} steps, estimated error {result.error:.1g} of the largest torsion; parameters: {given.source}"
    )
    for path in outputs:
        with _working(console, f"writing {path}"):
            if path in logs:
                logged.write(path, signals, config, overwrite=force)
            else:
                write_text_atomic(path, document, force=force)
        console.info(f"wrote {path}: {record if path in logs else 'what was simulated'}")
    if as_json:
        write_text_atomic(STDOUT, document)


def _overlay(
    console: Console,
    logs: Sequence[Path],
    config: Config,
    options: ReadOptions,
    given: Given,
    single: dict[str, float],
    switched: Sequence[EffectValues],
    drive: Any,
) -> Overlay:
    from flexid_cli.signals.build import build_recording
    from flexid_cli.simulate.overlay import as_recorded, overlay

    recording, raw = build_recording(logs, as_recorded(config), options)
    warn_of_damage(console, raw.damage, suspect_kept=options.keep_suspect)
    with _working(console, f"simulating {recording.duration_s:g} s"):
        return overlay(recording, config, given, parameters=single, effects=switched, drive=drive)


def _write_overlay(
    console: Console, found: Overlay, given: Given, outputs: Sequence[Path], *, as_json: bool, force: bool
) -> None:
    from flexid_cli.report.json import render_json
    from flexid_cli.writers.registry import write_log

    for note in found.notes:
        console.info(note)
    document = {
        "schema": "flexid-overlay/1",
        "drive": found.drive,
        "source": given.source,
        "signals": {
            name: {
                "measured_rms": found.measured_rms[name],
                "residual_rms": found.residual_rms.get(name),
            }
            for name in found.measured_rms
        },
    }
    for path in outputs:
        with _working(console, f"writing {path}"):
            if path.suffix.lower() == TRUTH:
                write_text_atomic(path, render_json(document), force=force)
            else:
                write_log(path, found.table, overwrite=force)
        console.info(f"wrote {path}")
    if as_json:
        write_text_atomic(STDOUT, render_json(document))
        return
    moved = "the reference through the controller" if found.drive == "controller" else "the measured motor"
    click.echo(f"Simulated from {moved}; RMS, joint side, SI")
    click.echo(f"  {'signal':<16}{'measured':>12}{'residual':>12}")
    for name, measured in found.measured_rms.items():
        residual = found.residual_rms.get(name)
        click.echo(
            f"  {name:<16}{measured:>12.4g}"
            + (f"{residual:>12.4g}" if residual is not None else f"{'-':>12}")
        )


def _refuse_for_overlay(wishes: Wishes) -> None:
    from dataclasses import asdict

    names = {
        "trajectory": "--trajectory", "amplitude": "--amplitude", "start_hz": "--start-hz", "stop_hz": "--stop-hz",
        "duration_s": "--duration", "rate_hz": "--rate", "seed": "--seed",
    }  # fmt: skip
    given = [names[name] for name, value in asdict(wishes).items() if value is not None]
    if given:
        raise UsageError(
            f"{given[0]} means nothing with --like, where the recording says it", f"leave {given[0]} out"
        )


def _check_outputs(outputs: Sequence[Path], inputs: Sequence[Path], *, as_json: bool, force: bool) -> None:
    """Refuse outputs before the work; folders of rosbag2 are replaced as a whole, other folders never."""
    from flexid_cli.writers.registry import format_of

    if not outputs and not as_json:
        raise UsageError(
            "nothing says where the log goes", "give -o run.mcap (or .csv, .bag, a folder; repeatable)"
        )
    for path in outputs:
        if path == STDOUT:
            raise OutputError("a log cannot go to standard output", "give -o FILE; --json prints the truth")
        if path.suffix.lower() != TRUTH:
            format_of(path)
    folders = [path for path in outputs if path.is_dir() and not path.suffix]
    for folder in folders:
        if not force:
            raise OutputError(f"{folder} exists already", "give another name, or --force to replace it")
        if not (folder / BAG_FOLDER_FILE).is_file():
            raise OutputError(f"{folder} is a folder, but no rosbag2 recording", "give another name")
        if any(path.exists() and path.resolve().is_relative_to(folder.resolve()) for path in inputs):
            raise OutputError(f"{folder} holds an input of this run", "give the output another name")
    if len({folder.resolve() for folder in folders}) < len(folders):
        raise OutputError(
            f"cannot write {folders[0]}: it is asked for twice", "give each output its own name"
        )
    check_outputs([path for path in outputs if path not in folders], force=force, inputs=inputs)


@contextmanager
def _working(console: Console, text: str) -> Iterator[None]:
    """Say what takes its time, on a terminal only, and take it back."""
    if console.is_quiet or sys.stderr is None or not sys.stderr.isatty():
        yield
        return
    from rich.console import Console as Terminal

    with Terminal(stderr=True, no_color=wants_color() is False).status(text):
        yield
