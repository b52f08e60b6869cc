"""What is wrong with a field, in the words of the person who wrote the file."""

from __future__ import annotations

import re
import types
import typing
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel

from flexid_cli.config.schema import (
    PLACEHOLDER,
    POSITION_ROLES,
    RULE_ERROR,
    TORQUE_ROLES,
    UNFILLED,
    Config,
    nearest_word,
)
from flexid_cli.config.yaml12 import Path, parse_scalar, path_text

if typing.TYPE_CHECKING:
    from pydantic.fields import FieldInfo
    from pydantic_core import ErrorDetails

_LIMITS = {
    "greater_than": ("gt", "greater than {}"),
    "greater_than_equal": ("ge", "at least {}"),
    "less_than": ("lt", "less than {}"),
    "less_than_equal": ("le", "at most {}"),
}
_WANTED = {
    "float_type": "a number",
    "int_type": "a whole number",
    "string_type": "text",
    "bool_type": "true or false",
    "tuple_type": "a list",
    "model_type": "a group of keys",
    "finite_number": "a finite number",
    "string_too_short": "text that is not empty",
    "too_short": "a list that is not empty",
}
_NUMBER_START = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*[^\d\s.,eE].*")
_DECIMAL_COMMA = re.compile(r"\s*([-+]?\d*),(\d+)\s*")


@dataclass(frozen=True)
class Finding:
    """One mistake in a field.

    Attributes
    ----------
    message, hint : str
        What is wrong, and the cure.
    path : path
        The node that is wrong; for a missing key, the key that is missing.
    kind : str
        ``missing``, ``unknown`` (key) or ``value``.
    meant : str
        For an unknown key, the permitted sibling that was probably meant.
    """

    message: str
    path: Path
    hint: str = ""
    kind: str = "value"
    meant: str = ""


def explain_errors(errors: Iterable[ErrorDetails], data: object) -> list[Finding]:
    """Say in plain words what pydantic found wrong in ``data``.

    Several errors about one node (the branches of a union) become one finding. A missing key is not reported
    where an unknown neighbour is its misspelling. Errors of rules that join fields are left out.
    """
    unknown: list[Finding] = []
    missing: list[Path] = []
    values: dict[Path, list[ErrorDetails]] = {}
    for error in errors:
        path = tuple(error["loc"])
        if error["type"] == "extra_forbidden":
            unknown.append(_explain_unknown(path, data))
        elif error["type"] == "missing":
            missing.append(path)
        elif error["type"] != RULE_ERROR:
            values.setdefault(_existing_part(path, data), []).append(error)
    meant = {(*finding.path[:-1], finding.meant) for finding in unknown}
    findings = [*unknown, *(_explain_missing(path) for path in missing if path not in meant)]
    return findings + [_explain_value(path, group, value_at(data, path)) for path, group in values.items()]


def value_at(data: object, path: Path) -> Any:
    """Return the value at ``path``, which exists."""
    for step in path:
        data = data[step]  # type: ignore[index]
    return data


def _existing_part(path: Path, data: object) -> Path:
    """Return the longest part of ``path`` that is a node; pydantic appends names of union branches."""
    for index, step in enumerate(path):
        inside = (
            step in data if isinstance(data, Mapping) else isinstance(data, list) and isinstance(step, int)
        )
        if not inside:
            return path[:index]
        data = value_at(data, (step,))
    return path


def _model_at(path: Path) -> type[BaseModel] | None:
    """Find the model that describes the section at ``path``."""
    model: type[BaseModel] | None = Config
    for step in path:
        fields = {} if model is None else _fields(model)
        if step not in fields:
            return None
        model = _model_in(fields[str(step)].annotation)
    return model


def _fields(model: type[BaseModel]) -> dict[str, FieldInfo]:
    """Fields by the names that a file gives them: some are no names of Python."""
    return {field.alias or name: field for name, field in model.model_fields.items()}


def _model_in(annotation: Any) -> type[BaseModel] | None:
    if typing.get_origin(annotation) in {typing.Union, types.UnionType}:
        return next(filter(None, map(_model_in, typing.get_args(annotation))), None)
    return annotation if isinstance(annotation, type) and issubclass(annotation, BaseModel) else None


def _all_sections(model: type[BaseModel] = Config, path: Path = ()) -> dict[Path, list[str]]:
    """Keys of every section by its path."""
    sections = {path: list(_fields(model))}
    for name, field in _fields(model).items():
        child = _model_in(field.annotation)
        if child is not None:
            sections |= _all_sections(child, (*path, name))
    return sections


def _explain_unknown(path: Path, data: object) -> Finding:
    section, key = path[:-1], str(path[-1])
    model = _model_at(section)
    permitted = list(_fields(model)) if model is not None else []
    listing = "permitted here: " + ", ".join(permitted)
    head, colon, tail = key.partition(":")
    if colon and head in permitted:
        return Finding(
            f"unknown key {key!r}",
            path,
            f"write a space after the colon: {head}: {tail}",
            kind="unknown",
            meant=head,
        )
    present = value_at(data, section)
    meant = nearest_word(key, [name for name in permitted if name not in present])
    homes = [path_text(home) for home, keys in _all_sections().items() if key in keys and home != section]
    hint = listing
    if meant:
        hint = f"did you mean {meant}? {listing}"
    elif homes and len(homes) <= 2:
        hint = f"{key} belongs under {' or '.join(home or 'the top level' for home in homes)}; {listing}"
    return Finding(f"unknown key {key!r}", path, hint, kind="unknown", meant=meant)


def _explain_missing(path: Path) -> Finding:
    model = _model_at(path[:-1])
    field = _fields(model).get(str(path[-1])) if model is not None else None
    hint = ""
    if path == ("version",):
        hint = "add the line `version: 1`"
    elif field is not None and field.description:
        hint = f"add {path[-1]}: {field.description}"
    elif field is not None:
        child = _model_at(path)
        needed = [] if child is None else [k for k, f in _fields(child).items() if f.is_required()]
        hint = f"add the section {path[-1]} with {', '.join(needed)}"
    return Finding(f"{path[-1]} is missing", path, hint, kind="missing")


def _explain_value(path: Path, errors: list[ErrorDetails], value: object) -> Finding:
    label = path_text(path[-2:] if isinstance(path[-1], int) else path[-1:])
    wants = _wants_of(errors)
    if path == ("version",) and isinstance(value, int) and not isinstance(value, bool):
        return Finding(
            f"version {value} of the configuration is not known", path, "this flexid reads version: 1"
        )
    if value == PLACEHOLDER:
        return Finding(UNFILLED.format(label), path, f"replace it by {' or '.join(wants)}")
    message = f"{label} must be {' or '.join(wants)}, but is {_describe(value)}"
    hint = _hint_for(path, value, errors)
    return Finding(message, path, hint)


def _wants_of(errors: list[ErrorDetails]) -> list[str]:
    """Say what would be right; where one branch only misses a limit, that limit is the point."""
    limits = [error for error in errors if error["type"] in {*_LIMITS, "finite_number", "string_too_short"}]
    wants: list[str] = []
    for error in limits or errors:
        kind, context = error["type"], error.get("ctx", {})
        if kind in _LIMITS:
            name, text = _LIMITS[kind]
            want = text.format(f"{context[name]:g}")
        elif kind == "literal_error":
            words = _permitted_words([error])
            want = words[0] if len(words) == 1 else "one of " + ", ".join(words)
        else:
            want = _WANTED.get(kind, error["msg"])
        if want not in wants:
            wants.append(want)
    return wants


def _permitted_words(errors: list[ErrorDetails]) -> list[str]:
    expected = " ".join(str(e["ctx"]["expected"]) for e in errors if e["type"] == "literal_error")
    return [quoted or number for quoted, number in re.findall(r"'([^']*)'|(-?\d+)", expected)]


def _describe(value: object) -> str:
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        short = value if len(value) <= 40 else value[:37] + "..."
        return f"the text {short!r}"
    if isinstance(value, list):
        return "a list"
    if isinstance(value, Mapping):
        return "a group of keys"
    return f"{value:g}" if isinstance(value, float) else _shorten_integer(value)


def _shorten_integer(value: object) -> str:
    text = str(value)
    return text if len(text) <= 20 else f"a number of {len(text)} digits"


def _hint_for(path: Path, value: object, errors: list[ErrorDetails]) -> str:
    kinds = {error["type"] for error in errors}
    words = _permitted_words(errors)
    if value is None:
        return "give a value, or remove the line"
    if "model_type" in kinds:
        return _hint_for_section(path, value)
    if "tuple_type" in kinds:
        return f"write a list, for example [{value}]" if isinstance(value, str) else "write a list"
    if kinds & {"float_type", "int_type"} and isinstance(value, str) and "string_type" not in kinds:
        hint = _hint_for_number(value)
        if hint or not words:
            return hint
    if words and isinstance(value, str):
        meant = nearest_word(value, words)
        return f"did you mean {meant}?" if meant else ""
    if "string_type" in kinds and isinstance(value, bool | int | float):
        return "put text in quotes, as in " + path_text(path[-1:]) + ': "..."'
    if "bool_type" in kinds and isinstance(value, str):
        return "in YAML 1.2 yes, no, on and off are text; write true or false"
    if "int_type" in kinds and isinstance(value, float) and value.is_integer():
        return f"write {int(value)}"
    if path[-1] == "confidence_level" and isinstance(value, int | float) and 50 < value < 100:
        return f"write {value / 100:g} for {value:g} %"
    if "greater_than" in kinds and path[-1] == "gear_ratio":
        return "give the ratio as a positive number, and turn a signal round with sign: -1"
    return ""


def _hint_for_number(text: str) -> str:
    parsed = parse_scalar(text.strip())
    if isinstance(parsed, int | float) and not isinstance(parsed, bool):
        return f"remove the quotes: {text.strip()}"
    comma = _DECIMAL_COMMA.fullmatch(text)
    if comma:
        return f"write the decimal sign as a point: {comma[1] or 0}.{comma[2]}"
    if re.fullmatch(r"[-+]?[\d_]+(\.[\d_]*)?", text):
        return f"write the digits without underscores: {text.replace('_', '')}"
    number = _NUMBER_START.fullmatch(text)
    return f"write the number alone: {number[1]}" if number else ""


def _hint_for_section(path: Path, value: object) -> str:
    name = str(path[-1]) if path else ""
    unit = {"motor_current": "A"}.get(name, "N.m" if name in TORQUE_ROLES else "rad")
    if isinstance(value, str) and name in {*TORQUE_ROLES, *POSITION_ROLES}:
        entry = f"{{source: {_quote_if_needed(value)}, unit: {unit}}}"
        return f"write {name}: {entry}, with the unit that is recorded"
    if isinstance(value, str) and name == "time":
        return f"write time: {{source: {_quote_if_needed(value)}}}"
    model = _model_at(path)
    keys = list(_fields(model)) if model is not None else []
    return f"its keys are {', '.join(keys)}" + (
        "; {} leaves all at their defaults" if name == "pipeline" else ""
    )


def _quote_if_needed(text: str) -> str:
    return f'"{text}"' if re.search(r"[\[\]{},#:&*!|>'%@`]", text) else text
