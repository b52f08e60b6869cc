"""A first configuration for a log: roles guessed from names, placeholders for what only a person knows."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass

from flexid_cli.config.schema import PLACEHOLDER
from flexid_cli.errors import UsageError
from flexid_cli.signals.inspect import ChannelSummary, Inspection
from flexid_cli.units import known_units, parse_unit

_POSITION = frozenset(
    (
        "pos",
        "position",
        "positions",
        "angle",
        "angles",
        "q",
        "qm",
        "ql",
        "qj",
        "theta",
        "phi",
        "encoder",
        "enc",
        "x",
        "lage",
        "winkel",
    )
)
_CURRENT = frozenset(("current", "currents", "iq", "amp", "amps", "ampere", "cur", "strom"))
_TORQUE = frozenset(("torque", "torques", "tau", "effort", "efforts", "force", "trq", "moment", "drehmoment"))
_VOLTAGE = frozenset(("voltage", "volt", "volts"))
_NOT_MEASURED = frozenset(
    (
        "ref",
        "reference",
        "cmd",
        "command",
        "commanded",
        "desired",
        "des",
        "setpoint",
        "target",
        "goal",
        "soll",
        "demand",
    )
)
_MOTOR = frozenset(("motor", "mot", "qm", "rotor", "drive", "actuator", "shaft", "primary"))
_LOAD = frozenset(("joint", "link", "load", "output", "arm", "ql", "qj", "secondary", "side2"))
_OTHER = frozenset(
    (
        "vel",
        "velocity",
        "velocities",
        "speed",
        "rate",
        "acc",
        "acceleration",
        "accelerations",
        "error",
        "err",
        "integral",
        "temperature",
        "temp",
    )
)
_JOINT_STATE_UNITS = {"position": "rad", "effort": "N.m"}
_PERMITTED = {
    "motor_current": ("current", "voltage"),
    "motor_torque": ("torque", "force", "voltage"),
    "joint_torque": ("torque", "force", "voltage"),
}


@dataclass(frozen=True)
class _Candidate:
    """A channel and what the words of its name say."""

    channel: ChannelSummary
    words: frozenset[str]
    context: frozenset[str]

    @property
    def source(self) -> str:
        return self.channel.info.source

    @property
    def is_demand(self) -> bool:
        return bool((self.words | self.context) & _NOT_MEASURED)

    @property
    def moves(self) -> bool:
        return self.channel.minimum != self.channel.maximum

    def motor_score(self) -> int:
        everything = self.words | self.context
        return (
            2 * bool(everything & _MOTOR) - bool(self.words & _LOAD) - bool(everything & (_LOAD - {"joint"}))
        )


def guess_roles(inspection: Inspection) -> dict[str, ChannelSummary]:
    """Guess which channel is which signal, from names.

    Returns
    -------
    dict of role to ChannelSummary
        Only what was found; at most one of motor_current, motor_torque and joint_torque.
    """
    candidates = [_candidate(c) for c in inspection.channels if c.info.source != inspection.time_column]
    candidates = [candidate for candidate in candidates if not candidate.words & _OTHER]
    positions = [c for c in candidates if _kind_of(c) == "position"]
    roles: dict[str, _Candidate] = {}
    measured = [c for c in positions if not c.is_demand]
    if measured:
        roles["motor_position"] = max(measured, key=lambda c: (c.moves, c.motor_score()))
        motor = roles["motor_position"]
        others = [
            c
            for c in measured
            if c is not motor and (c.words | c.context) & _LOAD and _same_axis(c, motor, measured)
        ]
        if others:
            roles["joint_position"] = max(others, key=lambda c: (c.moves, -c.motor_score()))
    torque = _guess_torque(candidates, roles.get("motor_position"))
    if torque is not None:
        roles[torque[0]] = torque[1]
    demands = [c for c in positions if c.is_demand]
    if demands:
        roles["reference_position"] = _nearest(demands, roles.get("motor_position"))
    return {role: candidate.channel for role, candidate in roles.items()}


def _candidate(channel: ChannelSummary) -> _Candidate:
    parts = [part for part in re.split(r"[/.]", channel.info.source) if part]
    own = parts[-1] if parts else channel.info.source
    if own == "data" and len(parts) > 1:  # std_msgs: the topic is the name
        own = parts[-2]
    return _Candidate(channel, _words(own), _words(" ".join(parts[:-1])))


def _words(text: str) -> frozenset[str]:
    spaced = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", text)
    spaced = re.sub(r"[(\[{].*", " ", spaced)
    return frozenset(
        re.sub(r"\d+$", "", word) or word for word in re.split(r"[^a-z0-9]+", spaced.lower()) if word
    )


def _kind_of(candidate: _Candidate) -> str | None:
    kinds = (("current", _CURRENT), ("torque", _TORQUE), ("voltage", _VOLTAGE), ("position", _POSITION))
    for kind, words in kinds:
        if candidate.words & words:
            return kind if kind == "position" else _declared_kind(candidate) or kind
    return "position" if candidate.words & _NOT_MEASURED and not candidate.words & {"pulses"} else None


def _declared_kind(candidate: _Candidate) -> str | None:
    """Kind of torque signal by the declared unit, for many drives put the current where JointState has effort."""
    try:
        dimension = parse_unit(candidate.channel.info.unit or "").dimension
    except UsageError:
        return None
    return {"current": "current", "torque": "torque", "force": "torque", "voltage": "voltage"}.get(dimension)


def _guess_torque(
    candidates: Sequence[_Candidate], motor: _Candidate | None
) -> tuple[str, _Candidate] | None:
    for kind, role in (("current", "motor_current"), ("torque", "motor_torque"), ("voltage", "motor_torque")):
        fitting = [c for c in candidates if _kind_of(c) == kind]
        fitting = [c for c in fitting if not c.is_demand] or fitting
        if fitting:
            best = _nearest(fitting, motor)
            return ("joint_torque" if kind == "torque" and best.words & _LOAD else role), best
    return None


def _nearest(candidates: Sequence[_Candidate], motor: _Candidate | None) -> _Candidate:
    """Return the candidate whose name shares the longest beginning with the motor's position."""
    if motor is None:
        return candidates[0]
    return max(candidates, key=lambda c: (c.moves, _shared_beginning(c.source, motor.source)))


def _shared_beginning(one: str, other: str) -> int:
    return next((n for n, (a, b) in enumerate(zip(one, other, strict=False)) if a != b), len(other))


def _same_axis(one: _Candidate, motor: _Candidate, measured: Sequence[_Candidate]) -> bool:
    """Whether two positions may be of one axis: those of several joints in one message are not.

    ``/states/joint_1/position`` and ``/states/joint_2/position`` differ in a name that says nothing of a
    side.
    """
    if one.words != motor.words:
        return True
    return bool((one.context ^ motor.context) & (_MOTOR | _LOAD)) or len(measured) == 2


def propose_config(inspection: Inspection) -> str:
    """Write a configuration for the log, as YAML with comments.

    ``FILL_IN`` stands where a value cannot be known from the log; the loader refuses it until it is replaced.
    """
    roles = guess_roles(inspection)
    torque = next((role for role in _PERMITTED if role in roles), None)
    lines = [
        "# Proposed by `flexid inspect` from the names in the log: check every line,",
        f"# and replace every {PLACEHOLDER}.",
        "version: 1",
        *_axis_lines(inspection, torque),
        "signals:",
        *_time_lines(inspection, list(roles.values()) or list(inspection.channels)),
        *_torque_lines(torque, roles),
        *_position_lines("motor_position", roles.get("motor_position")),
    ]
    for role in ("joint_position", "reference_position"):
        if role in roles:
            lines += _position_lines(role, roles[role])
    if "reference_position" in roles:
        lines += [
            "# controller:  # u = kv e + ki integral(e dt), e = kp (ref - qm) + ref' - qm', joint side",
            "#   {kp: 1.6, kv: 2.7, ki: 2.2}  # or {law: external} where it is not known",
        ]
    return "\n".join(lines) + "\n"


def _axis_lines(inspection: Inspection, torque: str | None) -> list[str]:
    stem = re.sub(r"\W+", "_", inspection.paths[0].name.split(".")[0]).strip("_") if inspection.paths else ""
    lines = [
        "axis:",
        f"  name: {_quoted(stem or 'axis')}",
        f"  gear_ratio: {PLACEHOLDER}  # motor angle / joint angle; 1 for a direct or linear drive",
    ]
    if torque == "motor_current":
        lines.append(
            "  torque_constant_nm_per_a: unknown  # N.m per A at the motor shaft; unknown: results per ampere"
        )
    return lines


def _time_lines(inspection: Inspection, channels: Sequence[ChannelSummary]) -> list[str]:
    if inspection.time_column is not None:
        return [
            "  time:",
            f"    source: {_quoted(inspection.time_column)}",
            f"    unit: {inspection.time_unit}  # s, ms, us or ns",
        ]
    running = [set(channel.clocks) for channel in channels]
    if not any(running):
        return ["  time:", f"    rate_hz: {PLACEHOLDER}  # no column looks like time: sampling rate in Hz"]
    common = set.intersection(*running)
    offered = [clock for clock in ("header_stamp", "log_time", "publish_time") if clock in common]
    if not offered:
        return []
    return ["  time:", f"    source: {offered[0]}  # running in all of these: {', '.join(offered)}"]


def _torque_lines(role: str | None, roles: dict[str, ChannelSummary]) -> list[str]:
    if role is None:
        return [
            "  motor_current:  # or motor_torque (motor shaft), or joint_torque: exactly one of them",
            f"    source: {PLACEHOLDER}  # no channel looks like a current or a torque",
            f"    unit: {PLACEHOLDER}  # A or mA",
        ]
    channel = roles[role]
    unit = _unit_of(channel, _PERMITTED[role])
    volts = unit[0] in {"V", "mV"} or bool(_candidate(channel).words & _VOLTAGE)
    if volts and unit[0] == PLACEHOLDER:
        unit = ("V", "guessed from the name")
    place = "at the joint" if role == "joint_torque" else "at the motor shaft"
    lines = [
        f"  {role}:  # {place}; else motor_current, motor_torque or joint_torque",
        f"    source: {_quoted(channel.info.source)}",
        f"    unit: {unit[0]}  # {unit[1]}",
    ]
    if volts:
        lines.append(f"    torque_per_volt: {PLACEHOLDER}  # N.m (linear axis: N) per volt, {place}")
    return lines


def _position_lines(role: str, channel: ChannelSummary | None) -> list[str]:
    lines = [f"  {role}:"]
    if channel is None:
        lines.append(f"    source: {PLACEHOLDER}  # no channel looks like a position")
        unit = (PLACEHOLDER, ", ".join(known_units("angle", "length", "count")))
    else:
        lines.append(f"    source: {_quoted(channel.info.source)}")
        unit = _unit_of(channel, ("angle", "length", "count"))
    lines.append(f"    unit: {unit[0]}  # {unit[1]}")
    if unit[0] in {"count", PLACEHOLDER}:
        mark = "" if unit[0] == "count" else "# "
        lines.append(
            f"    {mark}counts_per_rev: {PLACEHOLDER}  # with unit count (linear axis: counts_per_m)"
        )
    if role != "joint_position":
        lines.append(f"    side: {PLACEHOLDER}  # motor or joint: where the number is referred to")
    return lines


def _unit_of(channel: ChannelSummary, dimensions: tuple[str, ...]) -> tuple[str, str]:
    """Return the unit and where it comes from."""
    if channel.info.unit is not None:
        try:
            unit = parse_unit(channel.info.unit)
        except UsageError:
            return PLACEHOLDER, f"the log says {channel.info.unit!r}; " + ", ".join(known_units(*dimensions))
        if unit.dimension in dimensions:
            return unit.name, "declared by the log"
    field = re.split(r"[/.\[]", channel.info.source.rstrip("]0123456789[").rstrip("/"))[-1]
    if channel.info.kind.endswith("JointState") and field in _JOINT_STATE_UNITS:
        unit_name = _JOINT_STATE_UNITS[field]
        if parse_unit(unit_name).dimension in dimensions:
            return unit_name, "as sensor_msgs/JointState wants it for a rotary joint"
    return PLACEHOLDER, "one of " + ", ".join(known_units(*dimensions))


def _quoted(text: str) -> str:
    """Plain YAML where that is safe, else a double-quoted scalar (JSON's escapes are YAML's)."""
    if re.fullmatch(r"[A-Za-z/_][A-Za-z0-9_/.\-]*", text) and text.lower() not in {
        "null",
        "true",
        "false",
        "y",
        "n",
    }:
        return text
    return text if re.fullmatch(r"[1-9]\d{0,5}", text) else json.dumps(text, ensure_ascii=False)
