"""What a configuration may say: frozen models, and the rules that join several fields.

The models are the documented contract; `config_schema` turns them into the JSON Schema that editors use. The
rules are a separate pass over plain data (`broken_rules`), so that they can be checked, and reported at the
right place, even where other fields are wrong.
"""

from __future__ import annotations

import codecs
import difflib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from flexid_cli.errors import UsageError
from flexid_cli.units import Unit, known_units, parse_unit

SCHEMA_ID = "urn:flexid:config:1"
PLACEHOLDER = "FILL_IN"  # stands in a proposed configuration where the log does not tell the value
RULE_ERROR = "flexid_rule"
UNFILLED = "{} still holds the placeholder " + PLACEHOLDER
TORQUE_ROLES = ("motor_current", "motor_torque", "joint_torque")
POSITION_ROLES = ("motor_position", "joint_position", "reference_position")

Path = tuple[str | int, ...]
Side = Literal["motor", "joint"]
ModelName = Literal["two_encoders", "motor_only", "rigid"]


def _refuse_bool_and_float(value: object) -> object:
    """Keep ``true`` and ``1.0`` from passing for 1, which they equal in Python."""
    if isinstance(value, bool | float):
        raise PydanticCustomError("int_type", "not a whole number")
    return value


def _to_tuple(value: object) -> object:
    return tuple(value) if isinstance(value, list) else value


def _to_symbols(names: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(PER_RECORD.get(name, name) for name in names)


def _canonical_unit(text: str) -> str:
    """Replace usual spellings by the unit's own name; what is unknown is left for the rules to report."""
    try:
        return parse_unit(text).name
    except UsageError:
        return text


Number = Annotated[float, Field(description="a finite number")]
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Text = Annotated[str, Field(min_length=1)]
UnitName = Annotated[str, AfterValidator(_canonical_unit), Field(min_length=1)]
ColumnNumber = Annotated[int, Field(ge=1)]
Source = Text | ColumnNumber
One = Annotated[Literal[1], BeforeValidator(_refuse_bool_and_float)]
Sign = Annotated[Literal[1, -1], BeforeValidator(_refuse_bool_and_float)]


class Model(BaseModel):
    """Base of all sections: strict types, no unknown keys, no NaN, no change after loading."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)


class Axis(Model):
    """The axis itself."""

    name: Text = Field(description="Name of the axis, used in reports.", examples=["axis3"])
    gear_ratio: Positive = Field(
        description="Physical ratio motor angle / joint angle, always; 1 for a direct or linear drive.",
        examples=[50],
    )
    torque_constant_nm_per_a: Positive | Literal["unknown"] | None = Field(
        default=None,
        description="Torque (or force) per ampere, needed with motor_current; `unknown` gives parameters per"
        " ampere.",
        examples=[0.3475],
    )
    torque_constant_side: Side = Field(
        default="motor", description="Where the torque constant counts: at the motor shaft or at the joint."
    )
    gravity_m_per_s2: NotNegative = Field(default=9.81, description="Gravity; 0 for an axis it cannot move.")
    f1_hz: Positive | None = Field(
        default=None,
        description="First resonance of the free-free axis in Hz; estimated from the data where not given.",
        examples=[3.9],
    )


class TimeSignal(Model):
    """Where the time comes from."""

    source: Source | None = Field(
        default=None,
        description="CSV: column name, or number from 1. MCAP and rosbag: header_stamp, log_time or"
        " publish_time. Not given: the CSV column that looks like time, header_stamp where there is one.",
        examples=["time", "header_stamp", 1],
    )
    unit: UnitName = Field(
        default="s", description="Unit of a CSV time column.", examples=known_units("time")
    )
    rate_hz: Positive | None = Field(
        default=None, description="Sampling rate of a CSV file that has no time column."
    )
    max_gap_s: Positive | None = Field(
        default=None, description="Gaps longer than this split the record into segments."
    )


class _Signal(Model):
    """What every measured signal has: value = sign * (scale * raw + offset), in ``unit``."""

    source: Source = Field(
        description="CSV column name, or number from 1; or a path into the messages such as"
        " /joint_states/joint_3/position, /topic/field[2] or /topic.field[2].",
        examples=["motor_position", "/joint_states/joint_3/position", 2],
    )
    unit: UnitName = Field(description="Unit of the recorded number, after scale and offset.")
    scale: Number = Field(default=1.0, description="Factor on the recorded number; not zero.")
    offset: Number = Field(default=0.0, description="Added after the scale, in the signal's unit.")
    sign: Sign = Field(default=1, description="-1 turns the direction round.")
    delay_s: Number | None = Field(
        default=None, description="Known delay of the stamps: true time = stamp - delay_s."
    )


class TorqueSignal(_Signal):
    """What drives the axis: a current, a torque, or a force."""

    unit: UnitName = Field(
        description="Unit of the recorded number, after scale and offset.",
        examples=known_units("current", "torque", "force", "voltage"),
    )
    torque_per_volt: Positive | None = Field(
        default=None,
        description="N.m (or N) per volt, at the place that the signal's role says, for units V and mV.",
    )
    hold: Literal["sample", "instant"] | None = Field(
        default=None,
        description="sample: the value is held from its stamp for one sampling period, so it acts half a"
        " period later on average; instant: measured at its stamp; not given: chosen automatically.",
    )


class PositionSignal(_Signal):
    """An encoder, or a reference for one."""

    unit: UnitName = Field(
        description="Unit of the recorded number, after scale and offset.",
        examples=known_units("angle", "length", "count"),
    )
    side: Side | None = Field(
        default=None,
        description="Where the number is referred to: the motor shaft or the joint (required unless"
        " gear_ratio is 1).",
    )
    counts_per_rev: Positive | None = Field(
        default=None,
        description="Counts per revolution of the side it is referred to, where the unit is count.",
    )
    counts_per_m: Positive | None = Field(
        default=None, description="Counts per metre on a linear axis, where the unit is count."
    )
    unwrap: bool | None = Field(
        default=None, description="Whether jumps of one revolution are undone; not given: where they occur."
    )


class JointPositionSignal(PositionSignal):
    """The encoder at the joint; referred to the joint unless told otherwise."""

    side: Side | None = Field(default="joint", description="Where the number is referred to.")


class Signals(Model):
    """Which recorded numbers are what. Exactly one of motor_current, motor_torque and joint_torque."""

    model_config = ConfigDict(
        json_schema_extra={"oneOf": [{"required": [role]} for role in TORQUE_ROLES]},
    )

    time: TimeSignal | None = Field(default=None, description="Time; automatic where not given.")
    motor_current: TorqueSignal | None = Field(
        default=None, description="Motor current; needs axis.torque_constant_nm_per_a."
    )
    motor_torque: TorqueSignal | None = Field(default=None, description="Torque or force at the motor shaft.")
    joint_torque: TorqueSignal | None = Field(
        default=None, description="Motor torque or force referred to the joint."
    )
    motor_position: PositionSignal = Field(description="Encoder at the motor.")
    joint_position: JointPositionSignal | None = Field(
        default=None, description="Encoder at the joint, behind the flexibility."
    )
    reference_position: PositionSignal | None = Field(
        default=None, description="Reference that the position loop follows."
    )

    @property
    def torque_role(self) -> str:
        """Which of motor_current, motor_torque, joint_torque is given."""
        return next(role for role in TORQUE_ROLES if getattr(self, role) is not None)

    @property
    def torque(self) -> TorqueSignal:
        """The signal of `torque_role`."""
        signal: TorqueSignal = getattr(self, self.torque_role)
        return signal


class Controller(Model):
    """The loop that moved the axis: u = kv e + ki integral(e dt), joint side.

    e = kp (ref - qm) + velocity_feedforward ref' - qm'.
    """

    law: Literal["pi_velocity", "external"] = Field(
        default="pi_velocity", description="external where the controller is not known."
    )
    kp: NotNegative | None = Field(default=None, description="Position gain in 1/s.")
    kv: Positive | None = Field(default=None, description="Velocity gain, N.m.s/rad (linear: N.s/m).")
    ki: NotNegative = Field(default=0.0, description="Integral gain of the velocity loop, N.m/rad.")
    velocity_feedforward: Number = Field(default=1.0, description="Factor on the reference's velocity.")
    period_s: Positive | None = Field(
        default=None, description="Sampling period of the controller; not given: that of the log."
    )


class Lowpass(Model):
    """Zero-phase Butterworth low-pass."""

    order: int = Field(ge=1, le=12, description="Order of the one-way filter.")
    cutoff_hz: Positive = Field(description="-3 dB frequency of the one-way filter in Hz.")


class Pipeline(Model):
    """How the data are filtered; what is not given is chosen from the data."""

    lowpass: Lowpass | None = Field(default=None, description="Data filter.")
    derivative: Literal["exact", "central"] | None = Field(
        default=None, description="exact: band-limited; central: central differences."
    )
    decimation: int | None = Field(
        default=None, ge=1, le=100_000, description="Parallel decimation: keep one sample in this many (Nd)."
    )
    trim_s: NotNegative | None = Field(default=None, description="Cut from both ends of every segment.")
    sign_cutoff_hz: Positive | None = Field(
        default=None, description="Cutoff of the wider band from which the sign of the velocity is taken."
    )
    band_hz: Positive | None = Field(
        default=None, description="Wanted upper edge of the band; the decimation is then chosen."
    )


# What a payload, a posture, the temperature or a drive's offset change from one record to the next, by the models'
# symbols. Motor inertia and stiffness are what the records of one axis share.
PER_RECORD = {
    "load_inertia": "JL",
    "gravity_moment_x": "MX",
    "gravity_moment_y": "MY",
    "torque_offset": "offset",
    "motor_viscous_friction": "FVm",
    "motor_coulomb_friction": "FSm",
    "load_viscous_friction": "FV",
    "load_coulomb_friction": "FS",
}
PerRecordName = Literal[
    "JL", "MX", "MY", "offset", "FVm", "FSm", "FV", "FS",
    "load_inertia", "gravity_moment_x", "gravity_moment_y", "torque_offset",
    "motor_viscous_friction", "motor_coulomb_friction", "load_viscous_friction", "load_coulomb_friction",
]  # fmt: skip


class EstimateOptions(Model):
    """How parameters and their intervals are estimated."""

    method: Literal["auto", "ols", "wls", "irls", "iv", "structured", "minimum_distance", "output_error"] = (
        Field(
            default="auto",
            description="Least squares: ordinary, weighted by equation, robust (Huber), structured nonlinear;"
            " instrumental variables; minimum distance from the free coefficients; output error on a simulation.",
        )
    )
    route: Literal["direct", "paper"] = Field(
        default="direct", description="direct: physical parameters are fitted; paper: Table 3's inversion."
    )
    confidence_level: float = Field(
        default=0.95, gt=0.5, lt=1.0, description="Level of the confidence intervals."
    )
    covariance: Literal["hac", "iid"] = Field(
        default="hac", description="hac allows for correlated residuals; iid does not."
    )
    per_record: (
        Annotated[
            tuple[PerRecordName, ...],
            BeforeValidator(_to_tuple),
            AfterValidator(_to_symbols),
            Field(min_length=1),
        ]
        | None
    ) = Field(
        default=None,
        description="With several records of one axis: parameters, by symbol or name, that differ between them"
        " because payload, posture or temperature do. All others are shared.",
        examples=[["JL", "MX", "MY"]],
    )
    essential: bool = Field(
        default=False,
        description="Set friction, gravity and offsets that the data cannot tell from zero to zero, by backward"
        " elimination at the level 1 - confidence_level, and fit the rest again.",
    )
    replay: int = Field(
        default=0,
        ge=0,
        le=1000,
        description="Simulate the fitted axis this many times (2 or more; 0: not at all) with the record's noise,"
        " estimate again, and report the bias of each parameter; the estimates stay as they are.",
        examples=[50],
    )
    effects: Annotated[tuple[Text, ...], BeforeValidator(_to_tuple)] | None = Field(
        default=None,
        alias="with",
        description="Effects of the library joined to the models by `identify` (`flexid effects` lists them).",
        examples=[["backlash", "stribeck_motor"]],
    )


class CsvOptions(Model):
    """How a CSV file is written; what is not given is detected."""

    delimiter: Text | None = Field(default=None, description="Column separator.", examples=[";", "\t"])
    decimal: Literal[".", ","] | None = Field(default=None, description="Decimal sign.")
    header: bool | None = Field(default=None, description="Whether the first row holds column names.")
    comment: Text | None = Field(default=None, description="Start of comment lines.", examples=["#"])
    encoding: Text | None = Field(default=None, description="Text encoding.", examples=["utf-8", "latin-1"])
    skip_rows: int | None = Field(default=None, ge=0, description="Rows to skip before the header.")


class SimulatedParameters(Model):
    """The simulated axis by the paper's symbols, joint side, SI (linear: m, N, kg)."""

    Jm: Positive | None = Field(default=None, description="Motor inertia.")
    K: Positive | None = Field(default=None, description="Joint stiffness.")
    JL: Positive | None = Field(default=None, description="Load inertia.")
    FVm: NotNegative | None = Field(default=None, description="Viscous friction of the motor.")
    FSm: NotNegative | None = Field(default=None, description="Coulomb friction of the motor.")
    FV: NotNegative | None = Field(default=None, description="Viscous friction of the load.")
    FS: NotNegative | None = Field(default=None, description="Coulomb friction of the load.")
    MX: Number | None = Field(default=None, description="First moment along x: gravity MX g cos q.")
    MY: Number | None = Field(default=None, description="First moment along y: gravity MY g sin q.")
    torque_offset: Number | None = Field(default=None, description="Constant torque on the motor.")
    reversal_velocity: NotNegative | None = Field(
        default=None,
        description="Width v0 of the friction's sign, tanh(v/v0), joint side; 0: the axis sticks and breaks loose.",
    )
    load_reversal_velocity: NotNegative | None = Field(
        default=None, description="The load's width where it differs from the motor's."
    )


class SimulatedSensors(Model):
    """What measuring adds, joint side, SI; what is not given is ideal (an encoder in counts has its counts)."""

    motor_counts_per_rev: Positive | None = Field(
        default=None, description="Counts of the motor encoder per revolution of the motor."
    )
    joint_counts_per_rev: Positive | None = Field(
        default=None, description="Counts of the joint encoder per revolution of the joint."
    )
    motor_resolution: NotNegative | None = Field(
        default=None, description="In place of motor_counts_per_rev: one step in rad (m) at the joint side."
    )
    joint_resolution: NotNegative | None = Field(
        default=None, description="In place of joint_counts_per_rev: one step in rad (m)."
    )
    torque_noise: NotNegative | None = Field(default=None, description="One sigma, N.m (N), joint side.")
    motor_noise: NotNegative | None = Field(
        default=None, description="One sigma, rad (m), joint side; the controller sees it too."
    )
    joint_noise: NotNegative | None = Field(default=None, description="One sigma, rad (m).")
    torque_noise_time_s: NotNegative | None = Field(default=None, description="Correlation time; 0 is white.")
    motor_noise_time_s: NotNegative | None = Field(default=None, description="Correlation time; 0 is white.")
    joint_noise_time_s: NotNegative | None = Field(default=None, description="Correlation time; 0 is white.")
    torque_delay_s: Number | None = Field(default=None, description="Age of the torque at its stamp.")
    motor_delay_s: NotNegative | None = Field(
        default=None, description="Age of the motor position at its stamp; the controller sees it late too."
    )
    joint_delay_s: Number | None = Field(default=None, description="Age of the joint position at its stamp.")
    skew_s: Number | None = Field(
        default=None,
        description="How far the joint encoder's clock is behind the motor's (added to its delay).",
    )
    joint_zero: Number | None = Field(
        default=None, description="Added to the joint position: the encoders' zeros differ."
    )


class SimulatedTrajectory(Model):
    """What the reference does, joint side."""

    kind: Literal["chirp", "updown", "multisine", "slow"] | None = Field(
        default=None,
        description="chirp: a sine of rising frequency; updown: there and back at many speeds; multisine: all"
        " frequencies at once; slow: once there and back at constant speed.",
    )
    amplitude: Positive | None = Field(default=None, description="Largest distance from the start, rad (m).")
    start_hz: Positive | None = Field(
        default=None, description="Lowest frequency of chirp and multisine (and of updown's first way)."
    )
    stop_hz: Positive | None = Field(
        default=None, description="Highest frequency of chirp and multisine (and of updown's last way)."
    )
    centre: Number | None = Field(default=None, description="Position around which it moves, rad (m).")


class Simulation(Model):
    """What `flexid simulate` simulates; options of the command line come first."""

    parameters: SimulatedParameters = Field(
        default=SimulatedParameters(), description="The axis; --report, --truth and --parameter replace it."
    )
    effects: dict[str, dict[str, Number]] = Field(
        default={},
        description="Effects by name with their parameters by name; see docs/simulation.md.",
        examples=[{"backlash": {"gap": 0.001}}],
    )
    sensors: SimulatedSensors = Field(default=SimulatedSensors(), description="What measuring adds.")
    trajectory: SimulatedTrajectory = Field(
        default=SimulatedTrajectory(), description="What the reference does."
    )
    duration_s: Positive | None = Field(default=None, description="Length of the record; not given: 60 s.")
    rate_hz: Positive | None = Field(
        default=None, description="Rate of the record, and of the controller without a period_s."
    )
    seed: int | None = Field(default=None, ge=0, description="Seed of all noise; not given: 0.")


class Config(Model):
    """Configuration of one axis and its log, version 1."""

    version: One = Field(description="Version of this format: 1.")
    axis: Axis
    signals: Signals
    controller: Controller | None = Field(
        default=None, description="The controller; with reference_position it allows closed-loop simulation."
    )
    pipeline: Pipeline = Pipeline()
    models: Annotated[tuple[ModelName, ...], BeforeValidator(_to_tuple), Field(min_length=1)] | None = Field(
        default=None, description="Models to fit; not given: all that the signals allow."
    )
    estimate: EstimateOptions = EstimateOptions()
    csv: CsvOptions = CsvOptions()
    simulation: Simulation | None = Field(
        default=None, description="The machine that `flexid simulate` simulates; no other command reads it."
    )

    @model_validator(mode="after")
    def _obey_rules(self) -> Config:
        broken = list(broken_rules(self.model_dump(mode="json", exclude_none=True, by_alias=True)))
        if broken:
            raise PydanticCustomError(RULE_ERROR, "{text}", {"text": "; ".join(b.message for b in broken)})
        return self

    @property
    def linear(self) -> bool:
        """Whether the positions are lengths (m, N, kg) instead of angles (rad, N.m, kg.m2)."""
        motor = self.signals.motor_position
        return motor.counts_per_m is not None or parse_unit(motor.unit).dimension == "length"

    def resolved(self) -> dict[str, Any]:
        """Everything as plain data, with all defaults filled in; what is chosen automatically is left out."""
        return self.model_dump(mode="json", exclude_none=True, by_alias=True)


def config_schema() -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of the configuration."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": SCHEMA_ID,
        **Config.model_json_schema(),
        "title": "flexid configuration, version 1",
    }


@dataclass(frozen=True)
class BrokenRule:
    """A contradiction between fields that are each right by themselves."""

    message: str
    path: Path
    hint: str = ""


def broken_rules(data: object, wrong: frozenset[Path] = frozenset()) -> Iterator[BrokenRule]:
    """Check the rules that join several fields.

    Parameters
    ----------
    data : object
        The configuration as plain data, which may be incomplete or wrong in other ways.
    wrong : frozenset of path
        Nodes already known to be wrong; no rule judges by them.

    Yields
    ------
    BrokenRule
        One contradiction, at the node where the cure belongs.
    """
    view = _View(data, wrong)
    for rule in _RULES:
        yield from rule(view)


class _View:
    """Plain data of unknown quality, read without stumbling."""

    def __init__(self, data: object, wrong: frozenset[Path]) -> None:
        self._data = data
        self._wrong = wrong

    def get(self, *path: str) -> Any:
        """Return the value at ``path``; None where there is none, or none that can be trusted."""
        if self.is_wrong(*path):
            return None
        value = self._data
        for key in path:
            if not isinstance(value, Mapping):
                return None
            value = value.get(key)
        return value

    def is_wrong(self, *path: str) -> bool:
        return any(path[:end] in self._wrong for end in range(1, len(path) + 1))

    def signals(self, *roles: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
        """Role and mapping of each signal that is given."""
        for role in roles:
            signal = self.get("signals", role)
            if isinstance(signal, Mapping):
                yield role, signal

    def unit(self, role: str) -> Unit | None:
        text = self.get("signals", role, "unit")
        try:
            return parse_unit(text) if isinstance(text, str) else None
        except UsageError:
            return None


def _torque_dimensions(role: str) -> tuple[str, ...]:
    return ("current", "voltage") if role == "motor_current" else ("torque", "force", "voltage")


def _permitted_dimensions(role: str) -> tuple[str, ...]:
    if role == "time":
        return ("time",)
    return _torque_dimensions(role) if role in TORQUE_ROLES else ("angle", "length", "count")


def _rule_one_torque(view: _View) -> Iterator[BrokenRule]:
    if not isinstance(view.get("signals"), Mapping):
        return
    given = [role for role in TORQUE_ROLES if view.get("signals", role) is not None]
    choice = "exactly one of " + ", ".join(TORQUE_ROLES)
    if not given and not any(view.is_wrong("signals", role) for role in TORQUE_ROLES):
        yield BrokenRule("no signal says what drives the axis", ("signals",), f"give {choice}")
    for extra in given[1:]:
        yield BrokenRule(
            f"{extra} is one torque signal too many, for {given[0]} is given too",
            ("signals", extra),
            f"keep {choice}",
        )


def _rule_known_units(view: _View) -> Iterator[BrokenRule]:
    for role, _ in view.signals("time", *TORQUE_ROLES, *POSITION_ROLES):
        text = view.get("signals", role, "unit")
        if not isinstance(text, str):
            continue
        permitted = known_units(*_permitted_dimensions(role))
        listing = "permitted here: " + ", ".join(permitted)
        path = ("signals", role, "unit")
        unit = view.unit(role)
        if unit is None:
            guess = nearest_word(text, permitted)
            hint = f"did you mean {guess}? {listing}" if guess else listing
            message = UNFILLED.format("unit") if text == PLACEHOLDER else f"unknown unit {text!r}"
            yield BrokenRule(message, path, listing if text == PLACEHOLDER else hint)
        elif unit.dimension not in _permitted_dimensions(role):
            yield BrokenRule(f"{role} cannot be in {unit.name}, a unit of {unit.dimension}", path, listing)


def _rule_torque_constant(view: _View) -> Iterator[BrokenRule]:
    constant = ("axis", "torque_constant_nm_per_a")
    unit = view.unit("motor_current")
    if unit is None or unit.dimension != "current" or view.is_wrong(*constant):
        return
    if view.get(*constant) is None and not view.is_wrong("axis"):
        yield BrokenRule(
            f"motor_current is in {unit.name}, but axis.torque_constant_nm_per_a is missing",
            ("signals", "motor_current"),
            "give axis.torque_constant_nm_per_a from the motor's data sheet, or write `unknown` there to get"
            " parameters per ampere",
        )


def _rule_volts(view: _View) -> Iterator[BrokenRule]:
    for role, signal in view.signals(*TORQUE_ROLES):
        unit = view.unit(role)
        given = signal.get("torque_per_volt") is not None
        if unit is None:
            continue
        if (
            unit.dimension == "voltage"
            and not given
            and not view.is_wrong("signals", role, "torque_per_volt")
        ):
            yield BrokenRule(
                f"{role} is in {unit.name}, but torque_per_volt is missing",
                ("signals", role),
                "give torque_per_volt, N.m (linear axis: N) per volt of the drive's monitor output",
            )
        elif unit.dimension != "voltage" and given:
            yield BrokenRule(
                f"torque_per_volt means nothing where the unit is {unit.name}",
                ("signals", role, "torque_per_volt"),
                "remove it, or give the unit as V",
            )


def _rule_counts(view: _View) -> Iterator[BrokenRule]:
    keys = ("counts_per_rev", "counts_per_m")
    for role, signal in view.signals(*POSITION_ROLES):
        unit = view.unit(role)
        given = [key for key in keys if signal.get(key) is not None]
        if unit is None or any(view.is_wrong("signals", role, key) for key in keys):
            continue
        if unit.dimension != "count":
            for key in given:
                yield BrokenRule(
                    f"{key} means nothing where the unit is {unit.name}",
                    ("signals", role, key),
                    "remove it, or give the unit as count",
                )
        elif not given:
            yield BrokenRule(
                f"{role} is in counts, but counts_per_rev is missing",
                ("signals", role),
                "give counts_per_rev (linear axis: counts_per_m)",
            )
        elif len(given) == 2:
            yield BrokenRule(
                "counts_per_rev and counts_per_m exclude each other",
                ("signals", role, "counts_per_m"),
                "keep counts_per_rev for a rotary axis, counts_per_m for a linear one",
            )


def _motion_of(view: _View, role: str) -> str | None:
    """``rotary`` or ``linear``; None where the unit does not say."""
    unit = view.unit(role)
    if unit is None:
        return None
    if unit.dimension == "count":
        rotary = view.get("signals", role, "counts_per_rev") is not None
        linear = view.get("signals", role, "counts_per_m") is not None
        if rotary == linear:
            return None
        return "linear" if linear else "rotary"
    return {
        "angle": "rotary",
        "torque": "rotary",
        "length": "linear",
        "force": "linear",
    }.get(unit.dimension)


def _rule_one_motion(view: _View) -> Iterator[BrokenRule]:
    motion = _motion_of(view, "motor_position")
    if motion is None or view.unit("motor_position") is None:
        return
    wanted = {
        ("rotary", "position"): known_units("angle"),
        ("rotary", "torque"): known_units("torque"),
        ("linear", "position"): known_units("length"),
        ("linear", "torque"): known_units("force"),
    }
    for role, _ in view.signals(*TORQUE_ROLES, *POSITION_ROLES[1:]):
        other, unit = _motion_of(view, role), view.unit(role)
        if other in {None, motion} or unit is None or unit.dimension not in _permitted_dimensions(role):
            continue
        kind = "torque" if role in TORQUE_ROLES else "position"
        yield BrokenRule(
            f"{role} is in {unit.name} ({other}), but motor_position makes this a {motion} axis",
            ("signals", role, "unit"),
            f"one axis is rotary or linear throughout; permitted here: {', '.join(wanted[motion, kind])}",
        )


def _rule_side(view: _View) -> Iterator[BrokenRule]:
    ratio = view.get("axis", "gear_ratio")
    if isinstance(ratio, bool) or not isinstance(ratio, int | float) or ratio == 1:
        return
    for role, signal in view.signals("motor_position", "reference_position"):
        if signal.get("side") is None and not view.is_wrong("signals", role, "side"):
            yield BrokenRule(
                f"{role} does not say its side, which matters with gear_ratio {ratio:g}",
                ("signals", role),
                "add side: motor where the number is the motor shaft's, side: joint where the drive has"
                " divided it by the ratio",
            )


def _rule_scale(view: _View) -> Iterator[BrokenRule]:
    for role, signal in view.signals(*TORQUE_ROLES, *POSITION_ROLES):
        scale = signal.get("scale")
        if isinstance(scale, int | float) and not isinstance(scale, bool) and scale == 0:
            yield BrokenRule(
                "scale is 0, so nothing of the signal would be left",
                ("signals", role, "scale"),
                "give the factor from the recorded number to the unit; leave it out where it is 1",
            )


def _rule_time(view: _View) -> Iterator[BrokenRule]:
    if view.get("signals", "time", "source") is None or view.get("signals", "time", "rate_hz") is None:
        return
    yield BrokenRule(
        "source and rate_hz exclude each other",
        ("signals", "time", "rate_hz"),
        "rate_hz is for CSV files without a time column; keep one of the two",
    )


def _rule_distinct_sources(view: _View) -> Iterator[BrokenRule]:
    users: dict[object, str] = {}
    for role, _ in view.signals("time", *TORQUE_ROLES, *POSITION_ROLES):
        source = view.get("signals", role, "source")
        if not isinstance(source, str | int):
            continue
        first = users.setdefault(source, role)
        if first != role:
            yield BrokenRule(
                f"{role} has the same source as {first}",
                ("signals", role, "source"),
                "two signals cannot be the same channel; leave out what was not recorded",
            )


def _rule_controller(view: _View) -> Iterator[BrokenRule]:
    controller = view.get("controller")
    if not isinstance(controller, Mapping) or view.is_wrong("controller", "law"):
        return
    if controller.get("law", "pi_velocity") != "pi_velocity":
        return
    for gain in ("kp", "kv"):
        if controller.get(gain) is None and not view.is_wrong("controller", gain):
            yield BrokenRule(
                f"controller.{gain} is missing",
                ("controller",),
                f"give {gain}; where the controller is not known, write law: external",
            )


def _rule_models(view: _View) -> Iterator[BrokenRule]:
    models = view.get("models")
    if not isinstance(models, list | tuple):
        return
    has_signals = isinstance(view.get("signals"), Mapping)
    no_encoder = has_signals and view.get("signals", "joint_position") is None
    for index, name in enumerate(models):
        if name in models[:index]:
            yield BrokenRule(f"{name} is listed twice", ("models", index), "remove one of the two")
        elif name == "two_encoders" and no_encoder and not view.is_wrong("signals", "joint_position"):
            yield BrokenRule(
                "model two_encoders needs joint_position, which is not given",
                ("models", index),
                "add signals.joint_position, or choose motor_only",
            )


def _rule_per_record(view: _View) -> Iterator[BrokenRule]:
    names = view.get("estimate", "per_record")
    if not isinstance(names, list | tuple):
        return
    symbols = [PER_RECORD.get(name, name) if isinstance(name, str) else name for name in names]
    for index, symbol in enumerate(symbols):
        if symbol in symbols[:index]:
            yield BrokenRule(
                f"{symbol} is listed twice", ("estimate", "per_record", index), "remove one of the two"
            )


def _rule_essential(view: _View) -> Iterator[BrokenRule]:
    if view.get("estimate", "essential") is True and view.get("estimate", "route") == "paper":
        yield BrokenRule(
            "route paper reproduces the paper's tables, which leave no parameter out",
            ("estimate", "essential"),
            "take one of `essential` and `route: paper` out",
        )


def _rule_replay(view: _View) -> Iterator[BrokenRule]:
    count = view.get("estimate", "replay")
    if not count or view.is_wrong("estimate", "replay"):
        return
    if count == 1:
        yield BrokenRule(
            "one replay tells no bias from chance",
            ("estimate", "replay"),
            "take 2 or more (50 are plenty), or 0 for none",
        )
    if view.get("estimate", "route") == "paper":
        yield BrokenRule(
            "route paper reproduces the paper's tables, which have no bias budget",
            ("estimate", "replay"),
            "take one of `replay` and `route: paper` out",
        )
    if view.get("estimate", "with"):
        yield BrokenRule(
            "the fitted axis is not replayed with named effects joined to the model",
            ("estimate", "replay"),
            "take one of `replay` and `with` (--with) out",
        )


def _rule_csv(view: _View) -> Iterator[BrokenRule]:
    delimiter, encoding = view.get("csv", "delimiter"), view.get("csv", "encoding")
    if delimiter is not None and delimiter == view.get("csv", "decimal"):
        yield BrokenRule(
            f"delimiter and decimal sign are both {delimiter!r}",
            ("csv", "decimal"),
            "files with a decimal comma are separated by semicolons or tabs",
        )
    if isinstance(encoding, str) and encoding:
        try:
            codecs.lookup(encoding)
        except (LookupError, ValueError):
            yield BrokenRule(
                f"unknown encoding {encoding!r}",
                ("csv", "encoding"),
                "usual ones: utf-8, utf-16, latin-1, cp1252",
            )


def _rule_simulation(view: _View) -> Iterator[BrokenRule]:
    for side in ("motor", "joint"):
        counts, step = (
            ("simulation", "sensors", f"{side}_{key}") for key in ("counts_per_rev", "resolution")
        )
        if view.get(*counts) is not None and view.get(*step) is not None:
            yield BrokenRule(f"{counts[-1]} and {step[-1]} exclude each other", step, "keep one of the two")
    start, stop = (view.get("simulation", "trajectory", key) for key in ("start_hz", "stop_hz"))
    if isinstance(start, int | float) and isinstance(stop, int | float) and start >= stop:
        yield BrokenRule(
            "stop_hz does not lie above start_hz",
            ("simulation", "trajectory", "stop_hz"),
            "give the lower frequency as start_hz",
        )


_RULES: tuple[Callable[[_View], Iterator[BrokenRule]], ...] = (
    _rule_one_torque,
    _rule_known_units,
    _rule_torque_constant,
    _rule_volts,
    _rule_counts,
    _rule_one_motion,
    _rule_side,
    _rule_scale,
    _rule_time,
    _rule_distinct_sources,
    _rule_controller,
    _rule_models,
    _rule_per_record,
    _rule_essential,
    _rule_replay,
    _rule_csv,
    _rule_simulation,
)


def nearest_word(word: str, permitted: list[str]) -> str:
    """Find the permitted word that ``word`` most likely stands for; empty where none is near."""
    folded = {name.lower(): name for name in permitted}
    near = difflib.get_close_matches(word.lower(), folded, n=1, cutoff=0.6)
    return folded[near[0]] if near else ""
