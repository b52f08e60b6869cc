"""A simulated run as a drive would log it: in the terms of a configuration, so that it reads what it would measure.

Every signal gets its source's name, unit, side, scale, offset and sign; encoders that wrap do; the torque stands at
the instant that `hold` says, and stamps are late by `delay_s`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flexid_cli.errors import OutputError
from flexid_cli.signals.build import DEFAULT_TORQUE_HOLD, POSITIONS
from flexid_cli.signals.convert import TURN, convert_position, convert_torque
from flexid_cli.signals.timebase import CLOCKS
from flexid_cli.units import parse_unit
from flexid_cli.writers.registry import format_of, write_log
from flexid_cli.writers.table import QUANTITIES, LogTable

if TYPE_CHECKING:
    from flexid_cli.config.schema import Config, PositionSignal
    from flexid_cli.simulate.machine import Trajectory

Array = NDArray[np.float64]

START_NS = 1_000_000 * 1_000_000_000  # far from zero, as a real clock is; exact in float64 seconds
_NS = 1e9
_ONE = np.ones(1)


@dataclass(frozen=True)
class LoggedSignals:
    """Channels by role, as their numbers stand in the log, and their stamps.

    Attributes
    ----------
    stamps_ns : ndarray of int64, shape (n,)
    values : mapping of role to ndarray, shape (n,)
    """

    stamps_ns: NDArray[np.int64]
    values: Mapping[str, Array]


def as_logged(
    run: Trajectory, rate_hz: float, config: Config, torque_noise: Array | None = None
) -> LoggedSignals:
    """The run in the configuration's terms.

    Parameters
    ----------
    run : Trajectory
        Of a closed loop: its torque is held from each instant on.
    rate_hz : float
        Of the record.
    config : Config
        The axis and its signals.
    torque_noise : ndarray, shape (n,), optional
        Added to the torque where it is measured, joint side.
    """
    signals, role = config.signals, config.signals.torque_role
    base = signals.motor_position.delay_s or 0.0
    torque = _late(
        at_stamp(run.torque, rate_hz, config),
        ((signals.torque.delay_s or 0.0) - base) * rate_hz,
    )
    torque = torque if torque_noise is None else torque + torque_noise
    joint_side: dict[str, Array] = {
        role: torque,
        "motor_position": run.motor_position,
        "joint_position": run.joint_position,
        "reference_position": run.reference_position,
    }
    values = {role: _torque_in_log(torque, role, config)}
    for name in POSITIONS:
        signal: PositionSignal | None = getattr(signals, name)
        if signal is None:
            continue
        late = _late(joint_side[name], ((signal.delay_s or 0.0) - base) * rate_hz)
        values[name] = _position_in_log(late, name, signal, config)
    stamps = START_NS + np.rint((run.time_s + base) * _NS).astype(np.int64)
    return LoggedSignals(stamps, values)


def at_stamp(torque: Array, rate_hz: float, config: Config, *, stepwise: bool = True) -> Array:
    """The torque as the configuration's `hold` says that it is recorded.

    Parameters
    ----------
    torque : ndarray, shape (n,)
        At the record's instants.
    rate_hz : float
        Of the record.
    config : Config
        With ``sample`` a value is what acts from its stamp on for one sample, with ``instant`` what is measured at
        it: in the middle of a step half of either side.
    stepwise : bool
        Whether the torque is held from each instant on; else it is smooth.
    """
    hold = config.signals.torque.hold or DEFAULT_TORQUE_HOLD
    if stepwise and hold == "instant":
        period = None if config.controller is None else config.controller.period_s
        share = 0.5 if period is None else 0.5 * min(period * rate_hz, 1.0)
        before = np.concatenate((torque[:1], torque[:-1]))
        return np.asarray((1.0 - share) * torque + share * before)
    if stepwise or hold == "instant":
        return torque.copy()
    # What acts is the mean over the sample: undone, to (w T)^4, by the second difference.
    middle = _late(torque, -0.5)
    middle[1:-1] -= np.diff(torque, 2) / 24.0
    return middle


def _late(values: Array, samples: float) -> Array:
    """Values so many samples before each instant, by a cubic spline; beyond the ends the end values."""
    if samples == 0.0:
        return values
    from scipy.interpolate import make_interp_spline

    index = np.arange(values.size, dtype=np.float64)
    spline = make_interp_spline(index, values, k=min(3, values.size - 1))
    return np.asarray(spline(np.clip(index - samples, 0.0, index[-1])))


def _torque_in_log(torque: Array, role: str, config: Config) -> Array:
    signal = config.signals.torque
    plain = signal.model_copy(update={"offset": 0.0})
    factor = convert_torque(_ONE, role, plain, config.axis, linear=config.linear).values[0]
    return np.asarray(torque / factor - signal.offset / signal.scale)


def unit_of_position(role: str, signal: PositionSignal, config: Config) -> float:
    """Joint-side rad (m) of one of the signal's units, after scale and sign."""
    plain = signal.model_copy(update={"offset": 0.0, "scale": 1.0, "sign": 1, "unwrap": False})
    return float(convert_position(_ONE, role, plain, config).values[0])


def _position_in_log(position: Array, role: str, signal: PositionSignal, config: Config) -> Array:
    values = position / unit_of_position(role, signal, config)
    unit = parse_unit(signal.unit)
    if unit.dimension == "count":
        values = np.rint(values)
    if signal.unwrap:
        turn = float(signal.counts_per_rev or 0.0) if unit.dimension == "count" else TURN / unit.factor
        values = np.mod(values, turn)
    return np.asarray((signal.sign * values - signal.offset) / signal.scale)


def write(path: Path, logged: LoggedSignals, config: Config, *, overwrite: bool = False) -> None:
    """Write a log in the format that the file's name says.

    Raises
    ------
    OutputError
        The format cannot hold what the configuration names, or the file cannot be written.
    """
    kind = format_of(path)
    check_sources(path, config)
    if kind == "csv":
        _write_table(path, logged, config, overwrite=overwrite)
    else:
        channels = {
            topic: values
            for role, values in logged.values.items()
            if (topic := _topic(getattr(config.signals, role).source)) is not None
        }
        write_log(path, LogTable(logged.stamps_ns, channels), kind, overwrite=overwrite)


def check_sources(path: Path, config: Config) -> None:
    """Refuse a format that cannot hold the configuration's sources, before anything is simulated.

    Raises
    ------
    OutputError
        There is such a source; or the name of the file says no format.
    """
    if format_of(path) == "csv":
        if config.csv.header is False and not _all_numbered(config):
            raise OutputError(
                f"{path}: a table without a header has no column names", "give sources as column numbers"
            )
        return
    names = [(role, getattr(config.signals, role)) for role in (config.signals.torque_role, *POSITIONS)]
    sources = {role: signal.source for role, signal in names if signal is not None}
    for role, source in sources.items():
        if _topic(source) is None:
            what = (
                "is a column number" if isinstance(source, int) else "names a field that no message here has"
            )
            raise OutputError(
                f"{path}: signals.{role}.source {source!r} {what}",
                "write CSV, or use sources like /joint_states/motor/position or /motor/current in the configuration",
            )
    time = config.signals.time
    if time is None or time.rate_hz is not None:
        return
    clock = time.source
    if clock is not None and clock not in CLOCKS:
        raise OutputError(
            f"{path}: signals.time.source {clock!r} is no clock of a message log",
            "write CSV, or leave signals.time.source out",
        )
    if clock == CLOCKS[0] and any(not _in_joint_state(source) for source in sources.values()):
        raise OutputError(
            f"{path}: only JointState messages have the header's stamp that signals.time.source asks for",
            "use sources like /joint_states/motor/position throughout, or another clock",
        )


def _topic(source: str | int) -> str | None:
    """The channel that writers know this source by; None where they have no message for it."""
    if isinstance(source, int):
        return None
    text = source if source.startswith("/") else f"/{source}"
    for ending in (".data", "/data"):
        text = text.removesuffix(ending)
    return None if set(text) & set(".[]{}") or text.endswith("/") else text


def _in_joint_state(source: str | int) -> bool:
    parts = str(source).strip("/").split("/")
    return len(parts) > 2 and parts[-1] in QUANTITIES


def _all_numbered(config: Config) -> bool:
    time = config.signals.time
    sources = [getattr(config.signals, role) for role in (config.signals.torque_role, *POSITIONS)]
    numbered = all(isinstance(s.source, int) for s in sources if s is not None)
    return numbered and time is not None and (time.rate_hz is not None or isinstance(time.source, int))


def _write_table(path: Path, logged: LoggedSignals, config: Config, *, overwrite: bool) -> None:
    from flexid_cli.writers.csv import write_csv

    time = config.signals.time
    time_source = None if time is None else time.source
    has_time = time is None or time.rate_hz is None
    time_name = str(time_source) if isinstance(time_source, str) else "time"
    units = {role: getattr(config.signals, role).unit for role in logged.values}
    places = {role: getattr(config.signals, role).source for role in logged.values}
    if has_time:
        places = {_TIME: 1 if time_source is None and not _numbered(places) else time_source, **places}
    order = _ordered(places)
    channels: dict[str, Array] = {}
    declared: dict[str, str] = {}
    for place, role in enumerate(order, start=1):
        if role == _TIME:
            continue
        if role is None:
            channels[f"unused_{place}"] = np.zeros(logged.stamps_ns.size)
            continue
        name = places[role] if isinstance(places[role], str) else role
        channels[name] = logged.values[role]
        declared[name] = units[role]
    options: dict[str, Any] = {
        "time_name": time_name if has_time else None,
        "time_place": order.index(_TIME) + 1 if has_time else 1,
        "header": config.csv.header is not False,
        "rows_before": config.csv.skip_rows or 0,
    }
    if time is not None and "unit" in time.model_fields_set:
        options["time_unit"] = parse_unit(time.unit).name
    write_csv(
        path,
        LogTable(logged.stamps_ns, channels, declared),
        overwrite=overwrite,
        **options,
        **_dialect(config),
    )


_TIME = "time"


def _dialect(config: Config) -> dict[str, Any]:
    csv = config.csv
    decimal = csv.decimal or "."
    delimiter = csv.delimiter or (";" if decimal == "," else ",")
    return {"delimiter": delimiter, "decimal": decimal, "encoding": csv.encoding or "utf-8"}


def _numbered(places: Mapping[str, Any]) -> bool:
    return any(isinstance(source, int) for source in places.values())


def _ordered(places: Mapping[str, Any]) -> list[str | None]:
    """Roles in the order of their columns: numbered ones in their places, the others in the gaps; None: unused."""
    fixed = {source: role for role, source in places.items() if isinstance(source, int)}
    others = [role for role, source in places.items() if not isinstance(source, int)]
    order: list[str | None] = []
    while fixed or others:
        place = len(order) + 1
        order.append(fixed.pop(place, None) or (others.pop(0) if others else None))
    return order
