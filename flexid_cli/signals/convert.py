"""From the numbers of a log to joint-side SI: units, scale, offset, sign, side, gear, encoder turns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from flexid_cli.errors import InputError
from flexid_cli.signals.recording import Array
from flexid_cli.signals.timebase import IntArray
from flexid_cli.units import parse_unit

if TYPE_CHECKING:
    from flexid_cli.config.schema import Axis, Config, PositionSignal, TorqueSignal

TURN = 2.0 * np.pi
WRAP_SHARE = 0.8
TORQUE_ROLES = ("motor_current", "motor_torque", "joint_torque")


@dataclass(frozen=True)
class Converted:
    """A signal in joint-side SI units.

    Attributes
    ----------
    values : ndarray, shape (n,)
        rad or m; N m, N or A.
    unit : str
        Unit of ``values``.
    steps : tuple of str
        What was done, in words with numbers; empty where the log already has this unit and side.
    notes : tuple of str
        What a person should know.
    """

    values: Array
    unit: str
    steps: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def in_declared_unit(raw: Array, scale: float, offset: float, sign: int) -> Array:
    """``sign * (scale * raw + offset)``, shape (n,)."""
    return np.asarray(sign * (scale * raw + offset))


def convert_torque(raw: Array, role: str, signal: TorqueSignal, axis: Axis, *, linear: bool) -> Converted:
    """Torque at the joint side (force of a linear axis), or current where the torque constant is unknown.

    Parameters
    ----------
    raw : ndarray, shape (n,)
        Samples as they stand in the log.
    role : str
        ``motor_current`` and ``motor_torque`` are at the motor shaft, ``joint_torque`` is at the joint.
    signal, axis : TorqueSignal, Axis
        Of the configuration.
    linear : bool
        Whether the axis is linear.
    """
    unit = parse_unit(signal.unit)
    values = in_declared_unit(raw, signal.scale, signal.offset, signal.sign)
    steps = _affine_steps(signal.scale, signal.offset, signal.sign)
    at_motor = role != "joint_torque"
    result = "N" if linear else "N.m"
    if unit.dimension == "voltage" and signal.torque_per_volt is not None:
        values = values * (unit.factor * signal.torque_per_volt)
        steps.append(f"{signal.torque_per_volt:g} {result} per V")
    elif unit.dimension == "current":
        values, result, at_motor = _from_current(values * unit.factor, result, axis, steps)
    elif unit.dimension in {"torque", "force"}:
        values = values * unit.factor
        if unit.factor != 1.0:
            steps.append(f"{unit.name} to {result}")
    else:
        raise InputError(
            f"signals.{role}.unit is {signal.unit}, which needs a factor to become a torque",
            "give torque_per_volt, or another unit",
        )
    if at_motor and axis.gear_ratio != 1.0:
        values = values * axis.gear_ratio
        steps.append(f"motor shaft to joint side: times {axis.gear_ratio:g}")
    return Converted(values, result, tuple(steps))


def _from_current(current: Array, unit: str, axis: Axis, steps: list[str]) -> tuple[Array, str, bool]:
    """Torque, its unit, and whether it stands at the motor shaft. An unknown constant leaves amperes."""
    constant = axis.torque_constant_nm_per_a
    if constant is None or isinstance(constant, str):
        steps.append("torque constant unknown: the torque stays a current in A")
        return current, "A", False
    at_motor = axis.torque_constant_side == "motor"
    steps.append(f"times {constant:g} {unit}/A at the {axis.torque_constant_side} side")
    return current * constant, unit, at_motor


def convert_position(
    raw: Array, role: str, signal: PositionSignal, config: Config, periods: IntArray | None = None
) -> Converted:
    """Position at the joint side, in rad or m, without the jumps of an encoder that wraps.

    Parameters
    ----------
    raw : ndarray, shape (n,)
        Samples in time order, all finite.
    role : str
        ``motor_position``, ``joint_position`` or ``reference_position``.
    signal, config : PositionSignal, Config
        Of the configuration.
    periods : ndarray of int, shape (n - 1,), optional
        Sampling periods from each sample to the next; 0 for gaps and resets, where nothing is known.

    Raises
    ------
    InputError
        ``unwrap: true`` for an encoder whose turn is not known.
    """
    values = in_declared_unit(raw, signal.scale, signal.offset, signal.sign)
    steps = _affine_steps(signal.scale, signal.offset, signal.sign)
    factor = _position_factor(role, signal, linear=config.linear)
    if factor != 1.0:
        steps.append(f"{signal.unit} to {'m' if config.linear else 'rad'}")
    values, notes = _without_wraps(values, role, signal, TURN / factor, linear=config.linear, periods=periods)
    values = values * factor
    if signal.side == "motor" and config.axis.gear_ratio != 1.0:
        values = values / config.axis.gear_ratio
        steps.append(f"motor side to joint side: divided by {config.axis.gear_ratio:g}")
    return Converted(values, "m" if config.linear else "rad", tuple(steps), tuple(notes))


def _position_factor(role: str, signal: PositionSignal, *, linear: bool) -> float:
    unit = parse_unit(signal.unit)
    if unit.dimension in {"angle", "length"}:
        return unit.factor
    if unit.dimension == "count" and linear and signal.counts_per_m is not None:
        return 1.0 / signal.counts_per_m
    if unit.dimension == "count" and not linear and signal.counts_per_rev is not None:
        return TURN / signal.counts_per_rev
    raise InputError(
        f"signals.{role}.unit is {signal.unit}, which needs a factor to become a position",
        f"give {'counts_per_m' if linear else 'counts_per_rev'}, or another unit",
    )


def _without_wraps(
    values: Array, role: str, signal: PositionSignal, turn: float, *, linear: bool, periods: IntArray | None
) -> tuple[Array, list[str]]:
    if linear and signal.unwrap:
        raise InputError(f"signals.{role}.unwrap: a linear axis has no turn", "remove unwrap")
    if linear or signal.unwrap is False:
        return values, []
    turns = count_wraps(values, turn, certain=bool(signal.unwrap), periods=periods)
    jumps = int(np.count_nonzero(turns))
    if jumps == 0:
        return values, []
    why = "as configured" if signal.unwrap else "found from the velocity; unwrap: false turns this off"
    what = f"{jumps} jumps of a turn ({turn:g} {signal.unit})"
    unwrapped = values - turn * np.concatenate(([0], np.cumsum(turns)))
    return unwrapped, [f"{role}: the encoder wraps; {what} were removed, {why}"]


def count_wraps(
    values: Array, turn: float, *, certain: bool = False, periods: IntArray | None = None
) -> IntArray:
    """Count the turns by which an encoder wraps from one sample to the next.

    Parameters
    ----------
    values : ndarray, shape (n,)
        Positions.
    turn : float
        One turn in their unit.
    certain : bool
        Whether the encoder is known to wrap: then every jump of more than half a turn counts. Otherwise only
        those that stand alone and whose removal makes the velocity continuous: an axis that really moves that
        far per sample does so on both sides, too.
    periods : ndarray of int, shape (n - 1,), optional
        Sampling periods from each sample to the next: more than one where samples are missing, 0 where
        nothing is known of the time between. Such steps are no evidence; if there is evidence elsewhere, they
        are judged by the velocity on both sides.

    Returns
    -------
    ndarray of int, shape (n - 1,)
        Turns to take off each step; all zero where the encoder does not wrap.
    """
    steps = np.diff(values)
    periods = np.ones(steps.size, dtype=np.int64) if periods is None else periods
    single = periods == 1
    far = np.flatnonzero((np.abs(steps) > 0.5 * turn) | (periods > 1))
    short = steps - turn * np.rint(steps / turn)
    left, right = np.maximum(far - 1, 0), np.minimum(far + 1, steps.size - 1)
    left, right = np.where(far == 0, right, left), np.where(far == steps.size - 1, left, right)
    speed = short / np.maximum(periods, 1)
    expected, spread = 0.5 * (speed[left] + speed[right]), np.abs(speed[left] - speed[right])
    turns = np.zeros(steps.size, dtype=np.int64)
    if not certain:
        alone = np.minimum(np.abs(steps[far] - steps[left]), np.abs(steps[far] - steps[right])) > 0.5 * turn
        good = single[far] & alone & (np.abs(short[far] - expected) < 0.1 * turn + 0.5 * spread)
        if np.count_nonzero(good) < max(1.0, WRAP_SHARE * np.count_nonzero(single[far])):
            return turns
        far, expected = far[good | ~single[far]], expected[good | ~single[far]]
    guess = np.where(single[far], 0.0, expected * periods[far])
    turns[far] = np.rint((steps[far] - guess) / turn).astype(np.int64)
    return turns


def _affine_steps(scale: float, offset: float, sign: int) -> list[str]:
    if scale == 1.0 and offset == 0.0 and sign == 1:
        return []
    text = "raw" if scale == 1.0 else f"{scale:g} raw"
    text += f" {'+' if offset > 0 else '-'} {abs(offset):g}" if offset else ""
    return [f"-({text})" if sign < 0 else text]
