"""Sentences and cells about where and when a mismatch shows. Reads the document, finds nothing out."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from flexid_cli.report.numbers import MISSING, format_significant

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

REVERSAL_FIGURE = "diagnosis_reversals"
ANGLE_FIGURE = "diagnosis_angle"
LOOP_FIGURE = "diagnosis_loop"
_CERTAIN = 0.01  # p value of what is said in words
_DIGITS = 3
_LEAST_SHARE = 0.01  # that a trend explains
_MOST_EVENTS = 6  # that a sentence lists
_LEAST_PERCENT = 0.1
# Nothing is looked for where the model explains the record, and nothing can be said of one that is too poor.
_QUIET = ("adequate", "inconclusive")

_COLUMNS = {
    "c": "the torsion's zero torque",
    "motor_offset": "the motor's torque offset",
    "load_offset": "the load's torque offset",
    "torque_scale": "the torque's factor",
}

Rows = list[tuple[str, ...]]


def shown(diagnosis: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The section, where its renderings show it."""
    found: Mapping[str, Any] | None = diagnosis["locality"]
    return found if tells(diagnosis["verdict"]) else None


def tells(verdict: str) -> bool:
    """Whether something is said of the mismatch's place."""
    return verdict not in _QUIET


def captions(diagnosis: Mapping[str, Any]) -> dict[str, str]:
    """What the figures show, by their keys."""
    found = shown(diagnosis)
    if found is None:
        return {}
    of = _of(found)
    return {
        REVERSAL_FIGURE: f"Mean residual {of} about velocity reversals, folded by direction, with its 95 % band. "
        + " ".join(_reversals(found)),
        ANGLE_FIGURE: f"Spectrum of the residual {of} over the motor's angle, and what noise stays below. "
        + " ".join(_lines(found)),
        LOOP_FIGURE: f"Loss stiffness of the transmission against frequency {of}, with 95 % bands. "
        + " ".join(_loop(found)),
    }


def sentences(diagnosis: Mapping[str, Any]) -> list[str]:
    """What can be said for sure of time, reversals, angle, loop and drift, one sentence each."""
    found = shown(diagnosis)
    if found is None:
        return []
    return [
        *_changes(found),
        *_events(found),
        *_reversals(found),
        *_lines(found),
        *_loop(found),
        *_drift(found),
    ]


def introduction(diagnosis: Mapping[str, Any]) -> str:
    """Whose residual it is; empty where nothing is shown."""
    found = shown(diagnosis)
    return "" if found is None else f"Residual {_of(found)}."


def _of(found: Mapping[str, Any]) -> str:
    return "of the baseline model" if found["model"] == "baseline" else "that the named effects leave"


def change_rows(found: Mapping[str, Any]) -> Rows:
    """Column, from when, interval, change, share, alternatives."""
    return [
        (
            _column(c["column"]),
            _number(c["time_s"], 4),
            f"{_number(c['earliest_s'], 4)} to {_number(c['latest_s'], 4)}",
            _signed(c["size"]),
            _unit(c["unit"]),
            _percent(c["share"]),
            ", ".join(map(_column, c["alternatives"])) or MISSING,
        )
        for c in found["changes"]
    ]


def line_rows(found: Mapping[str, Any]) -> Rows:
    """Equation, cycles per motor and joint revolution, amplitude, share, phase, false alarm."""
    return [
        (
            spectrum["equation"],
            _number(one["cycles_per_motor_revolution"], 4),
            _number(one["cycles_per_joint_revolution"], 4),
            _number(one["amplitude"]),
            spectrum["unit"],
            _percent(one["share"]),
            _number(one["phase"]),
            _p(one["false_alarm"]),
        )
        for spectrum in found["angle"]
        for one in spectrum["lines"]
    ]


def loop_rows(found: Mapping[str, Any]) -> Rows:
    """Frequency, loss stiffness, half width of its band, loop's width; nothing where there is no loop."""
    loop = found["loop"]
    if loop is None or loop["slope"] is None:
        return []
    cells = zip(loop["frequency_hz"], loop["stiffness"], loop["band"], loop["width"], strict=True)
    return [tuple(_number(x) for x in row) for row in cells]


def drift_rows(found: Mapping[str, Any]) -> Rows:
    """Column, change a minute with its standard error, percent, p value; only what is sure."""
    return [
        (
            _column(d["column"]),
            _signed(d["per_minute"]),
            _number(d["stderr"], 2),
            _unit(d["unit"]),
            _signed(d["percent_per_minute"]),
            _percent(d["share"]),
            _p(d["p_value"]),
        )
        for d in _drifting(found)
    ]


def _drifting(found: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    return [d for d in _sure(found["drift"]) if d["share"] is not None and d["share"] >= _LEAST_SHARE]


def _column(name: str) -> str:
    """Symbol of a parameter, or what else changes in words."""
    return _COLUMNS.get(name, name)


def _sure(entries: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    return [e for e in entries if e["p_value"] is not None and e["p_value"] < _CERTAIN]


def _changes(found: Mapping[str, Any]) -> Iterator[str]:
    for c in found["changes"]:
        others = (
            f" ({' or '.join(map(_column, c['alternatives']))} would do nearly as well)"
            if c["alternatives"]
            else ""
        )
        yield (
            f"From {_number(c['time_s'], 4)} s on {_column(c['column'])} differs by "
            f"{_quantity(_signed(c['size']), c['unit'])}: that explains {_percent(c['share'])} % of the residual's"
            f" sum of squares{others}."
        )


def _events(found: Mapping[str, Any]) -> Iterator[str]:
    events = found["events"]
    if not events:
        return
    listed = [f"{_number(e['start_s'], 4)} s" for e in events[:_MOST_EVENTS]]
    more = f" and {len(events) - _MOST_EVENTS} more" if len(events) > _MOST_EVENTS else ""
    yield f"Isolated bursts at {', '.join(listed)}{more}, up to {_loudest(events)} times the usual energy."


def _loudest(events: Sequence[Mapping[str, Any]]) -> str:
    return _number(max((e["times_usual"] for e in events if e["times_usual"] is not None), default=None), 2)


def _reversals(found: Mapping[str, Any]) -> Iterator[str]:
    for r in _sure(found["reversals"]):
        yield (
            f"{_percent(r['energy_share'])} % of the {r['equation']} residual's energy ({_percent(r['low'])} to"
            f" {_percent(r['high'])} %) is within 0.1 s of one of {r['count']} reversals, in"
            f" {_percent(r['time_share'])} % of the time."
        )


def _lines(found: Mapping[str, Any]) -> Iterator[str]:
    for spectrum in found["angle"]:
        cycles = [_number(one["cycles_per_motor_revolution"], 4) for one in spectrum["lines"]]
        if cycles:
            yield (
                f"The {spectrum['equation']} residual has {'lines' if len(cycles) > 1 else 'a line'} of "
                f"{', '.join(cycles)} cycles per motor revolution."
            )


def _loop(found: Mapping[str, Any]) -> Iterator[str]:
    loop = found["loop"]
    if loop is None or loop["slope"] is None:
        return
    yield (
        f"The loop of torque over torsion grows with frequency to the power of {_number(loop['slope'], 2)} (standard "
        f"error {_number(loop['slope_stderr'], 1)}; 0 as friction does, 1 as damping does), and explains "
        f"{_percent(loop['share'])} % of the residual's sum of squares."
    )


def _drift(found: Mapping[str, Any]) -> Iterator[str]:
    sure = [
        f"{_column(d['column'])} by {_quantity(_signed(d['per_minute']), d['unit'])}"
        for d in _drifting(found)
    ]
    if sure:
        yield f"Over the record drift: {', '.join(sure)} a minute (each alone)."


def _number(value: float | None, digits: int = _DIGITS) -> str:
    return format_significant(value, digits)


def _signed(value: float | None) -> str:
    text = _number(value)
    return f"+{text}" if value is not None and value > 0.0 else text


def _unit(unit: str) -> str:
    return MISSING if unit in ("", "1") else unit


def _quantity(number: str, unit: str) -> str:
    return number if unit in ("", "1") else f"{number} {unit}"


def _percent(share: float | None) -> str:
    if share is not None and 100.0 * abs(share) < _LEAST_PERCENT:
        return f"<{_LEAST_PERCENT:g}"
    return _number(None if share is None else 100.0 * share, 2)


def _p(value: float | None) -> str:
    return "<0.001" if value is not None and value < 0.001 else _number(value, 2)
