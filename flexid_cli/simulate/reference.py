"""References that a simulated axis follows: chirp, up and down, multisine, slow, or out of a file.

All start and end at rest, joint side, and are the same for the same arguments.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from flexid_cli.errors import InputError, UsageError

if TYPE_CHECKING:
    from flexid_cli.config.schema import Config, PositionSignal
    from flexid_cli.readers.base import RawChannel, RawLog

Array = NDArray[np.float64]

KINDS = ("chirp", "updown", "multisine", "slow")
FADE_S = 1.0  # at both ends of an oscillation, at most a tenth of the record
ROUNDING = 0.05  # part of a period that a reversal of updown or slow takes
MOST_WAYS = 1000
_NS = 1e9


@dataclass(frozen=True)
class Motion:
    """What the reference does; joint side.

    Attributes
    ----------
    kind : str
        One of `KINDS`.
    amplitude : float
        Largest distance from the centre, rad (m).
    start_hz, stop_hz : float
        Ends of the chirp, of the multisine's band; slowest and fastest period of updown. `slow` has none.
    centre : float
        Where it starts and ends.
    """

    kind: str
    amplitude: float
    start_hz: float
    stop_hz: float
    centre: float = 0.0


def reference(motion: Motion, duration_s: float, rate_hz: float) -> Array:
    """Set points at the instants of the record.

    Parameters
    ----------
    motion : Motion
        What it does.
    duration_s, rate_hz : float
        Of the record.

    Returns
    -------
    ndarray, shape (round(duration_s * rate_hz),)

    Raises
    ------
    UsageError
        Too short, too slowly sampled, or without such a frequency.
    """
    n = round(duration_s * rate_hz)
    _check(motion, n, duration_s, rate_hz)
    time = np.arange(n) / rate_hz
    length = n / rate_hz
    shape = {"chirp": _chirp, "updown": _updown, "multisine": _multisine, "slow": _slow}[motion.kind]
    return motion.centre + motion.amplitude * shape(motion, time, length)


def _check(motion: Motion, n: int, duration_s: float, rate_hz: float) -> None:
    if motion.kind not in KINDS:
        raise UsageError(f"there is no trajectory {motion.kind!r}", f"choose one of {', '.join(KINDS)}")
    if n < 64:
        raise UsageError(
            f"{duration_s:g} s at {rate_hz:g} Hz are {n} samples", "simulate longer, or at a higher rate"
        )
    if motion.kind == "slow":
        return
    if not 0.0 < motion.start_hz < motion.stop_hz:
        raise UsageError(
            f"a {motion.kind} from {motion.start_hz:g} to {motion.stop_hz:g} Hz is not possible",
            "let the lower frequency be above 0 and the upper one above it",
        )
    if motion.stop_hz >= 0.5 * rate_hz:
        raise UsageError(
            f"{motion.stop_hz:g} Hz lie above half the rate of the record ({rate_hz:g} Hz)",
            "lower --stop-hz, or raise --rate",
        )


def _chirp(motion: Motion, time: Array, length: float) -> Array:
    """Sine whose frequency rises in proportion to time."""
    sweep = (motion.stop_hz - motion.start_hz) / length
    phase = 2.0 * math.pi * time * (motion.start_hz + 0.5 * sweep * time)
    return np.asarray(np.sin(phase) * _fade(time, length))


def _multisine(motion: Motion, time: Array, length: float) -> Array:
    """All harmonics of the record's length in the band, equal in velocity, of low crest by Schroeder's phases.

    M. R. Schroeder, "Synthesis of low-peak-factor signals and binary sequences with low autocorrelation", IEEE
    Transactions on Information Theory 16(1), 1970.
    """
    first, last = math.ceil(motion.start_hz * length), math.floor(motion.stop_hz * length)
    if last < first:
        raise UsageError(
            f"no multiple of {1.0 / length:.3g} Hz lies between {motion.start_hz:g} and {motion.stop_hz:g} Hz",
            "simulate longer, or widen the band",
        )
    count = last - first + 1
    total = np.zeros(time.size)
    for k in range(count):
        w = 2.0 * math.pi * (first + k) / length
        total += np.sin(w * time - math.pi * k * (k + 1) / count) / (first + k)
    total *= _fade(time, length)
    return np.asarray(total / np.abs(total).max())


def _updown(motion: Motion, time: Array, length: float) -> Array:
    """There and back at constant speeds, each time faster than before; the periods are stretched to fill the time."""
    periods = _periods(1.0 / motion.start_hz, 1.0 / motion.stop_hz, length)
    ends = np.concatenate(([0.0], np.cumsum(periods)))
    k = np.clip(np.searchsorted(ends, time, side="right") - 1, 0, periods.size - 1)
    return _there_and_back((time - ends[k]) / periods[k])


def _periods(longest: float, shortest: float, length: float) -> Array:
    """Geometric series of periods that fills the length, of as many periods as need the least stretching."""
    best = np.array([length])
    stretch = abs(math.log(length / longest))
    for count in range(2, MOST_WAYS):
        series = np.geomspace(longest, shortest, count)
        off = abs(math.log(length / series.sum()))
        if off >= stretch:
            break
        best, stretch = series * (length / series.sum()), off
    return best


def _slow(_: Motion, time: Array, length: float) -> Array:
    """Once to one side, to the other and back."""
    return _there_and_back(time / length)


def _there_and_back(part: Array) -> Array:
    """A period from 0 over 1 and -1 to 0 at constant speed, with round reversals and rest at both ends.

    The speed changes along raised cosines that take ``r`` of the period each: from rest, at both reversals, to rest.
    """
    r = ROUNDING
    up = 0.25 * (1.0 - 5.0 * r)  # so that both sides are reached equally
    knots = np.cumsum([0.0, r, up, r, r + 2.0 * up, r, up, r])
    speeds = np.array([0.0, 1.0, 1.0, -1.0, -1.0, 1.0, 1.0, 0.0])
    k = np.clip(np.searchsorted(knots, part, side="right") - 1, 0, knots.size - 2)
    width = np.diff(knots)
    mean, half = 0.5 * (speeds[1:] + speeds[:-1]), 0.5 * np.diff(speeds)
    reached = np.concatenate(([0.0], np.cumsum(mean * width)))
    s = (part - knots[k]) / width[k]
    # Speed mean - half cos(pi s) within an interval.
    position = reached[k] + width[k] * (mean[k] * s - half[k] * np.sin(math.pi * s) / math.pi)
    return np.asarray(position / (0.5 * r + up + r / math.pi))


def _fade(time: Array, length: float) -> Array:
    """Raised cosines from 0 to 1 at the start and back at the end."""
    width = min(FADE_S, 0.1 * length)
    edge = np.clip(np.minimum(time, length - time) / width, 0.0, 1.0)
    return np.asarray(0.5 - 0.5 * np.cos(math.pi * edge))


def reference_from_file(path: Path, config: Config, rate_hz: float) -> Array:
    """The set points of a log, brought to the record's rate by straight lines.

    Parameters
    ----------
    path : Path
        A log that holds the configuration's reference_position; or a CSV of two columns, time and the reference in
        the configuration's own terms.
    config : Config
        Says source, unit and side.
    rate_hz : float
        Rate of the record.

    Returns
    -------
    ndarray, shape (n,)
        Joint side, rad (m).

    Raises
    ------
    InputError
        There is no reference in the file, or it is not one.
    """
    from flexid_cli.signals.convert import convert_position

    signal = config.signals.reference_position or config.signals.motor_position
    seconds, raw = _read(path, signal, config)
    values = convert_position(raw, "reference_position", signal, config).values
    order = np.argsort(seconds, kind="stable")
    seconds, values = seconds[order] - seconds[order[0]], values[order]
    if seconds.size < 2 or seconds[-1] <= 0.0:
        raise InputError(f"{path} holds no reference: {seconds.size} samples over {np.ptp(seconds):g} s")
    n = int(seconds[-1] * rate_hz * (1.0 + 1e-12)) + 1
    return np.interp(np.arange(n) / rate_hz, seconds, values)


def _read(path: Path, signal: PositionSignal, config: Config) -> tuple[Array, Array]:
    """Times in s and the file's numbers, where both are numbers."""
    from flexid_cli.readers.registry import list_channels, open_reader, read_log
    from flexid_cli.signals.build import find_time_column, time_unit_of
    from flexid_cli.units import parse_unit

    if open_reader([path], csv=config.csv).name != "csv":
        raw = read_log([path], [signal.source])
        channel = raw.channels[str(signal.source)]
        return _times_of(channel, raw), channel.values
    names = [info.source for info in list_channels([path], csv=config.csv)]
    wanted = None if config.signals.time is None else config.signals.time.source
    time = str(wanted) if str(wanted) in names else find_time_column(names) or names[0]
    source: str | int = signal.source
    if str(source) not in names:
        others = [name for name in names if name != time]
        if len(others) != 1:
            raise InputError(
                f"{path} has no column {str(source)!r}; its columns: {', '.join(names)}",
                "name the column as the configuration's reference_position, or write time and reference only",
            )
        source = others[0]
    raw = read_log([path], [source], csv=config.csv, time_source=time)
    stamps, values = raw.channels[time], raw.channels[str(source)].values
    good = np.isfinite(stamps.values) & np.isfinite(values)
    return stamps.values[good] * parse_unit(time_unit_of(stamps)).factor, values[good]


def _times_of(channel: RawChannel, raw: RawLog) -> Array:
    for clock in ("header_stamp", "log_time", "publish_time"):
        if clock in channel.stamps:
            stamps = channel.stamps[clock]
            return np.asarray((stamps - stamps[:1]) / _NS, dtype=np.float64)
    raise InputError(f"{raw.paths[0]} holds no times")
