"""``flexid check``: whether a configuration is right, and whether a log has what it asks for."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from flexid_cli.cli.options import (
    Console,
    example,
    json_option,
    pass_console,
    set_option,
    verbosity_options,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from flexid_cli.config.load import LoadedConfig
    from flexid_cli.config.schema import Config, PositionSignal, TorqueSignal
    from flexid_cli.errors import Problem
    from flexid_cli.readers.base import ChannelInfo

CLOCKS = ("header_stamp", "log_time", "publish_time")
_POSITIONS = ("motor_position", "joint_position", "reference_position")


@click.command(
    short_help="Check a configuration, and that a log has its signals.",
    epilog=example("flexid check configs/axis3.yaml sample_logs/axis3.csv"),
)
@click.argument("config", type=click.Path(path_type=Path), metavar="CONFIG")
@click.argument("logs", nargs=-1, type=click.Path(path_type=Path), metavar="[LOG]...")
@set_option
@json_option
@verbosity_options
@pass_console
def check(
    console: Console, config: Path, logs: tuple[Path, ...], overrides: tuple[str, ...], as_json: bool
) -> None:
    """Check CONFIG and say what it means; with LOG, also that every signal is in the log.

    All mistakes are reported at once, each with file, line and column (exit code 2). Several LOGs are the
    parts of one run. CONFIG may be - for standard input.
    """
    from flexid_cli.config.load import config_digest, load_located

    loaded = load_located(config, overrides)
    if logs:
        _check_log(loaded, logs, console)
    digest = config_digest(loaded.config)
    if as_json:
        import json

        document = {"ok": True, "sha256": digest, "config": loaded.config.resolved()}
        click.echo(json.dumps(document, indent=2, allow_nan=False))
        return
    click.echo(f"ok: {loaded.file}")
    for label, text in _essentials(loaded.config):
        click.echo(f"  {label:<11} {text}")
    if logs:
        click.echo(f"  {'log':<11} every signal is in {', '.join(str(log) for log in logs)}")
    console.detail(f"sha256 of the resolved configuration: {digest}")


def _essentials(config: Config) -> Iterator[tuple[str, str]]:
    axis, signals = config.axis, config.signals
    kind = "linear" if config.linear else "rotary"
    yield "axis", f"{axis.name}, {kind}, gear ratio {axis.gear_ratio:g}"
    yield "torque", f"{_describe(signals.torque_role, signals.torque)}{_constant(config)}"
    for role in _POSITIONS:
        signal = getattr(signals, role)
        if signal is not None:
            yield role.split("_")[0], _describe(role, signal)
    yield "time", _time(config)
    if config.controller is not None:
        yield "controller", config.controller.law
    yield "models", ", ".join(config.models) if config.models else "all that the signals allow"
    options = config.estimate
    yield "estimate", f"{options.method}, {options.confidence_level:.4g} intervals ({options.covariance})"


def _describe(role: str, signal: TorqueSignal | PositionSignal) -> str:
    side = getattr(signal, "side", None)
    source = f"column {signal.source}" if isinstance(signal.source, int) else signal.source
    return f"{role} = {source} in {signal.unit}" + (f", {side} side" if side else "")


def _constant(config: Config) -> str:
    constant, side = config.axis.torque_constant_nm_per_a, config.axis.torque_constant_side
    if config.signals.motor_current is None or constant is None:
        return ""
    if constant == "unknown":
        return ", torque constant unknown: parameters per ampere"
    return f", {constant:g} {'N' if config.linear else 'N.m'}/A at the {side}"


def _time(config: Config) -> str:
    time = config.signals.time
    if time is None or (time.source is None and time.rate_hz is None):
        return "chosen from the log"
    if time.rate_hz is not None:
        return f"{time.rate_hz:g} Hz, no time column"
    return str(time.source) if time.source in CLOCKS else f"{time.source} in {time.unit}"


def _check_log(loaded: LoadedConfig, logs: Sequence[Path], console: Console) -> None:
    """Raise ConfigError where the log lacks a source; a unit that the log contradicts is a warning."""
    from flexid_cli.errors import ConfigError
    from flexid_cli.readers.registry import list_channels

    channels = list_channels(logs, csv=loaded.config.csv)
    known = {name: channel for channel in channels for name in (channel.source, *channel.aliases)}
    problems = [
        problem
        for role, source in _sources(loaded.config)
        if source not in known and (problem := _look_up(loaded, logs, role, source)) is not None
    ]
    if not problems:
        problems = list(_check_clock(loaded, logs))
    if problems:
        raise ConfigError(loaded.file, sorted(problems, key=lambda p: (p.line, p.column)))
    for warning in _unit_conflicts(loaded.config, known):
        console.warning(warning)


def _sources(config: Config) -> Iterator[tuple[str, str]]:
    """Role and source of every channel that the log must have."""
    time = config.signals.time
    if time is not None and time.source is not None and time.source not in CLOCKS:
        yield "time", str(time.source)
    for role in (config.signals.torque_role, *_POSITIONS):
        signal = getattr(config.signals, role)
        if signal is not None:
            yield role, str(signal.source)


def _look_up(loaded: LoadedConfig, logs: Sequence[Path], role: str, source: str) -> Problem | None:
    """Ask the reader itself, which knows more spellings than the list of channels shows."""
    from flexid_cli.errors import InputError
    from flexid_cli.readers.registry import read_log

    try:
        read_log(logs, [source], csv=loaded.config.csv)
    except InputError as error:
        return loaded.problem(error.message, ("signals", role, "source"), error.hint)
    return None


def _check_clock(loaded: LoadedConfig, logs: Sequence[Path]) -> Iterator[Problem]:
    from flexid_cli.readers.registry import read_log

    time, torque = loaded.config.signals.time, str(loaded.config.signals.torque.source)
    if time is None or time.source not in CLOCKS:
        return
    stamps = read_log(logs, [torque], csv=loaded.config.csv).channels[torque].stamps
    if time.source not in stamps:
        has = f"it has {', '.join(stamps)}" if stamps else "name its time column, or give rate_hz"
        yield loaded.problem(f"the log has no clock {time.source}", ("signals", "time", "source"), has)


def _unit_conflicts(config: Config, known: dict[str, ChannelInfo]) -> Iterator[str]:
    from flexid_cli.errors import UsageError
    from flexid_cli.units import parse_unit

    for role, source in _sources(config):
        channel = known.get(source)
        if channel is None or channel.unit is None:
            continue
        try:
            declared = parse_unit(channel.unit)
        except UsageError:
            continue
        signal = getattr(config.signals, role)
        is_scaled = getattr(signal, "scale", 1.0) != 1.0
        if declared.name != signal.unit and not is_scaled:
            yield f"{role}: the log says {declared.name}, the configuration {signal.unit}, which counts"
