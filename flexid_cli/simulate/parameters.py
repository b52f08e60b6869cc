"""Where the parameters of a simulated axis come from: a report, a truth file, the configuration, single values."""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flexid_cli.effects.base import Effect, EffectValues
from flexid_cli.effects.registry import effect as effect_named
from flexid_cli.errors import InputError, UsageError
from flexid_cli.simulate.machine import Axis, Sensors

if TYPE_CHECKING:
    from flexid_cli.config.schema import Simulation

NEEDED = ("Jm", "K", "JL")
NOT_NEGATIVE = ("FVm", "FSm", "FV", "FS", "reversal_velocity", "load_reversal_velocity")
SYMBOLS = tuple(f.name for f in fields(Axis) if f.name != "gravity")
NAMES = {
    "motor_inertia": "Jm",
    "joint_stiffness": "K",
    "load_inertia": "JL",
    "motor_viscous_friction": "FVm",
    "motor_coulomb_friction": "FSm",
    "load_viscous_friction": "FV",
    "load_coulomb_friction": "FS",
    "gravity_moment_x": "MX",
    "gravity_moment_y": "MY",
    "offset": "torque_offset",
}
# Models of a report that hold a flexible axis, the better determined first.
FLEXIBLE_MODELS = ("two_encoders", "motor_only")
DEFAULT_REVERSAL_VELOCITY = 1e-3
_SPRING_GRAVITY = ("Q0", "kg")  # gravity as `motor_only` has it over a small motion: Q0 + kg (q - q0)
_SENSORS = tuple(f.name for f in fields(Sensors))


@dataclass(frozen=True)
class Given:
    """Parameters by symbol, and what else their source says.

    Attributes
    ----------
    values : mapping
        By the names of `Axis`; also Q0 and kg, gravity as a spring about the middle of a motion.
    effects : tuple of EffectValues
    sensors : mapping
        By the names of `Sensors`.
    source : str
        Where they come from, for messages.
    sample_rate_hz : float or None
        Of the record that they come from.
    cutoff_hz : float or None
        Low-pass of the fit.
    notes : tuple of str
        What a person should know.
    """

    values: Mapping[str, float] = field(default_factory=dict)
    effects: tuple[EffectValues, ...] = ()
    sensors: Mapping[str, float] = field(default_factory=dict)
    source: str = "the command line"
    sample_rate_hz: float | None = None
    cutoff_hz: float | None = None
    notes: tuple[str, ...] = ()


def from_config(section: Simulation) -> Given:
    """What the configuration's section ``simulation`` gives."""
    values = {k: float(v) for k, v in section.parameters.model_dump(exclude_none=True).items()}
    effects = tuple(EffectValues(effect_named(n).name, dict(v)) for n, v in section.effects.items())
    return Given(values, effects, source="section `simulation` of the configuration")


def from_truth(path: Path) -> Given:
    """What a truth file says was simulated (`sample_logs/axis3.truth.json`, or one that `simulate` wrote).

    Raises
    ------
    InputError
        It cannot be read, or is no truth file.
    """
    data = _json(path, "truth file")
    axis = data.get("axis")
    if not isinstance(axis, dict) or not set(NEEDED) <= axis.keys():
        raise InputError(
            f"{path} is no truth file: it has no `axis` with {', '.join(NEEDED)}",
            "for a report of `flexid identify` use --report",
        )
    effects = data.get("effects") or {}
    sensors = data.get("sensors") or {}
    by_name = all(isinstance(x, dict) for x in (effects, sensors))
    if not by_name or not all(isinstance(x, dict) for x in effects.values()):
        raise InputError(f"{path}: `effects` and `sensors` must hold values by name")
    return Given(
        values={k: _number(path, k, v) for k, v in axis.items() if k in SYMBOLS and v is not None},
        effects=tuple(
            EffectValues(effect_named(n).name, {k: _number(path, k, v) for k, v in dict(values).items()})
            for n, values in effects.items()
        ),
        sensors={k: _number(path, k, v) for k, v in sensors.items() if k in _SENSORS},
        source=str(path),
        sample_rate_hz=_optional(data.get("sample_rate_hz")),
    )


def from_report(path: Path, model: str | None = None) -> Given:
    """Estimates of a report.

    All estimates of one model are taken together, for together they fit the record; those that are not identified
    are named in the notes. Effects that the report's diagnosis explains the record with are taken too, with the
    parameters after it, and those that were named to `flexid identify --with`.

    Parameters
    ----------
    path : Path
        A report of `flexid identify` or `flexid diagnose`, JSON.
    model : str, optional
        Else the best one that holds a flexible axis.

    Raises
    ------
    InputError
        It cannot be read, is no report, or has no estimate of inertias and stiffness that could be simulated.
    """
    data = _json(path, "report")
    if data.get("schema") != "flexid-report/1":
        raise InputError(
            f"{path} is no report of flexid: its schema is {data.get('schema')!r}",
            "write one by `flexid identify LOG --config FILE -o report.json`; for a truth file use --truth",
        )
    chosen = _model(path, data, model)
    diagnosis = _object(data.get("diagnosis"))
    explained = diagnosis.get("verdict") in {"explained", "partly_explained"}
    effects = _report_effects(diagnosis if explained else chosen)
    after = _objects(diagnosis.get("parameters_after")) if explained and model is None else []
    values, notes = _estimates(path, after or _objects(chosen.get("parameters")))
    pipeline = _object(chosen.get("pipeline"))
    zero = values.pop("z", 0.0)
    width = _optional(pipeline.get("reversal_velocity"))
    if width is not None:
        values.setdefault("reversal_velocity", width)
    return Given(
        values=values,
        effects=effects,
        sensors={"joint_zero": -zero} if zero else {},
        source=f"{path} ({chosen['id']})",
        sample_rate_hz=_optional(_object(data.get("recording")).get("sample_rate_hz")),
        cutoff_hz=_optional(_object(pipeline.get("lowpass")).get("cutoff_hz")),
        notes=tuple(notes),
    )


def _model(path: Path, data: Mapping[str, Any], wanted: str | None) -> dict[str, Any]:
    models = {str(m["id"]): m for m in _objects(data.get("models")) if "id" in m}
    if wanted is not None and wanted not in models:
        raise InputError(
            f"{path} has no model {wanted}", f"it has {', '.join(models) or 'none'}; --model chooses one"
        )
    names = [wanted] if wanted else [m for m in FLEXIBLE_MODELS if m in models]
    for name in names:
        estimates = _objects(models[name].get("parameters"))
        if set(NEEDED) <= {p.get("symbol") for p in estimates if p.get("estimate") is not None}:
            return models[name]
    raise InputError(
        f"{path} has no estimate of a flexible axis ({', '.join(NEEDED)}); it has {', '.join(models) or 'no model'}",
        "identify one of the models two_encoders and motor_only, or give the values by --parameter",
    )


def _estimates(path: Path, parameters: Iterable[Mapping[str, Any]]) -> tuple[dict[str, float], list[str]]:
    values: dict[str, float] = {}
    doubtful, clamped = [], []
    for p in parameters:
        symbol = NAMES.get(str(p.get("symbol")), str(p.get("symbol")))
        estimate = _optional(p.get("estimate"))
        if estimate is None or symbol not in {*SYMBOLS, *_SPRING_GRAVITY, "z"}:
            continue
        if symbol in NEEDED and estimate <= 0.0:
            raise InputError(
                f"{path}: the estimate of {symbol} is {estimate:g}, which no axis can have",
                "identify from a record that determines it, or give it by --parameter",
            )
        if symbol in NOT_NEGATIVE and estimate < 0.0:
            clamped.append(symbol)
            estimate = 0.0
        elif p.get("verdict") != "identified" and symbol != "z":
            doubtful.append(f"{symbol} ({p.get('verdict')})")
        values[symbol] = estimate
    notes = []
    if doubtful:
        notes.append(f"{path}: used although not identified: {', '.join(doubtful)}")
    if clamped:
        notes.append(f"{path}: taken as 0, for their estimates are negative: {', '.join(clamped)}")
    return values, notes


def _report_effects(diagnosis: Mapping[str, Any]) -> tuple[EffectValues, ...]:
    found = []
    for entry in _objects(diagnosis.get("effects")):
        effect = effect_named(str(entry.get("name")))
        values = {str(p.get("name")): _optional(p.get("estimate")) for p in _objects(entry.get("parameters"))}
        known = {k: v for k, v in values.items() if v is not None and k in effect.neutral}
        found.append(EffectValues(effect.name, known))
    return tuple(found)


def axis_of(values: Mapping[str, float], gravity: float, centre: float = 0.0) -> Axis:
    """The axis with these parameters; friction and gravity that are not given are zero.

    Parameters
    ----------
    values : mapping
        As in `Given`.
    gravity : float
        m/s2.
    centre : float
        Middle of the motion that Q0 and kg belong to.

    Raises
    ------
    UsageError
        Inertias or stiffness are missing.
    """
    missing = [symbol for symbol in NEEDED if symbol not in values]
    if missing:
        raise UsageError(
            f"nothing says how large {', '.join(missing)} {'is' if len(missing) == 1 else 'are'}",
            "give --report (of flexid identify), --truth, section `simulation` of the configuration, or"
            f" --parameter {missing[0]}=VALUE",
        )
    plain = {k: v for k, v in values.items() if k not in _SPRING_GRAVITY}
    neutral = dict.fromkeys(SYMBOLS, 0.0) | {
        "reversal_velocity": DEFAULT_REVERSAL_VELOCITY,
        "load_reversal_velocity": None,
    }
    full: dict[str, Any] = {**neutral, **plain, "gravity": gravity}
    if any(k in values for k in _SPRING_GRAVITY):
        constant, slope = values.get("Q0", 0.0), values.get("kg", 0.0)
        if gravity > 0.0:
            # Same torque and slope at the centre as the spring.
            c, s = math.cos(centre), math.sin(centre)
            full["MX"] += (constant * c - slope * s) / gravity
            full["MY"] += (constant * s + slope * c) / gravity
        else:
            full["torque_offset"] += constant
    return Axis(**full)


def parse_parameters(options: Sequence[str]) -> dict[str, float]:
    """Values of ``SYMBOL=VALUE``; a symbol of the report or its name.

    Raises
    ------
    UsageError
        Not of this form, no such symbol, given twice, or a value that no axis has.
    """
    values: dict[str, float] = {}
    for option in options:
        symbol, value = _assignment(option, "--parameter", "for example --parameter K=20341")
        symbol = NAMES.get(symbol, symbol)
        if symbol not in SYMBOLS:
            known = [*SYMBOLS, *NAMES]
            raise UsageError(
                f"--parameter {option}: there is no parameter {symbol!r}",
                _nearest(symbol, known) + f"known: {', '.join(SYMBOLS)}",
            )
        if symbol in values:
            raise UsageError(f"--parameter {option}: {symbol} is given twice", "keep one of the two")
        if (symbol in NEEDED and value <= 0.0) or (symbol in NOT_NEGATIVE and value < 0.0):
            limit = "must be above zero" if symbol in NEEDED else "cannot be negative"
            raise UsageError(f"--parameter {option}: {symbol} {limit}")
        values[symbol] = value
    return values


def parse_effects(options: Sequence[str]) -> tuple[tuple[EffectValues, ...], tuple[str, ...]]:
    """Effects of ``NAME.PARAMETER=VALUE``, or ``NAME=VALUE`` where the effect has one parameter.

    Parameters
    ----------
    options : sequence of str
        Each may hold several, separated by commas.

    Returns
    -------
    tuple of EffectValues
    tuple of str
        What was taken for parameters that were not given and have no neutral value.

    Raises
    ------
    UsageError
        Not of this form, no such effect or parameter, given twice, or a value that physics does not admit.
    """
    values: dict[str, dict[str, float]] = {}
    for option in (part.strip() for text in options for part in text.split(",")):
        path, value = _assignment(option, "--effects", "for example --effects backlash.gap=0.001")
        name, _, parameter = path.partition(".")
        effect = effect_named(name)
        parameter = parameter or _only_parameter(effect, option)
        if parameter not in effect.neutral:
            raise UsageError(
                f"--effects {option}: {effect.name} has no parameter {parameter!r}",
                _nearest(parameter, list(effect.neutral)) + f"it has {', '.join(effect.neutral)}",
            )
        if parameter in values.setdefault(effect.name, {}):
            raise UsageError(f"--effects {option}: {effect.name}.{parameter} is given twice")
        values[effect.name][parameter] = value
    found = tuple(EffectValues(name, given) for name, given in values.items())
    notes = [note for chosen in found for note in _filled(chosen)]
    return found, tuple(notes)


def _only_parameter(effect: Effect, option: str) -> str:
    if len(effect.parameters) == 1:
        return effect.parameters[0].name
    example = " ".join(f"--effects {effect.name}.{p.name}={p.example:g}" for p in effect.parameters)
    raise UsageError(
        f"--effects {option}: {effect.name} has {len(effect.parameters)} parameters", f"write {example}"
    )


def _filled(chosen: EffectValues) -> list[str]:
    """Check the values, and name the shapes that are filled in."""
    effect = effect_named(chosen.name)
    effect.vector(chosen.values)
    shapes = [p for p in effect.parameters if p.neutral is None and p.name not in chosen.values]
    return [f"{effect.name}.{p.name} is not given: {p.example:g} is used" for p in shapes]


def _assignment(option: str, flag: str, hint: str) -> tuple[str, float]:
    name, equals, text = option.partition("=")
    if not equals or not name.strip() or not text.strip():
        raise UsageError(f"{flag} {option}: this is not NAME=VALUE", hint)
    try:
        value = float(text)
    except ValueError:
        raise UsageError(f"{flag} {option}: {text.strip()!r} is no number", hint) from None
    if not math.isfinite(value):
        raise UsageError(f"{flag} {option}: the value must be finite", hint)
    return name.strip(), value


def _nearest(word: str, known: Sequence[str]) -> str:
    folded = {name.lower(): name for name in known}
    near = difflib.get_close_matches(word.lower(), folded, n=1, cutoff=0.5)
    return f"did you mean {folded[near[0]]}? " if near else ""


def _json(path: Path, kind: str) -> dict[str, Any]:
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is no {kind}, for it is no text", "give the JSON file") from error
    except OSError as error:
        raise InputError(
            f"cannot read the {kind} {path}: {(error.strerror or str(error)).lower()}"
        ) from error
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is no {kind}, for it is no JSON ({error})", "give the JSON file") from error
    if not isinstance(data, dict):
        raise InputError(f"{path} is no {kind}", "give the JSON file")
    return data


def _object(value: object) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _objects(value: object) -> list[dict[str, Any]]:
    return [item for item in value if isinstance(item, dict)] if isinstance(value, list) else []


def _number(path: Path, name: str, value: object) -> float:
    number = _optional(value)
    if number is None:
        raise InputError(f"{path}: {name} is no number: {value!r}")
    return number


def _optional(value: object) -> float | None:
    """The value as a finite number, else None."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return None
    return float(value)
