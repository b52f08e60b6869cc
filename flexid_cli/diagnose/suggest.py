"""What the place of a mismatch suggests, in words that name no effect: shape, time, events, reversals, lines, loop.

Only what holds most of the mismatch is said: the rest stands in the data.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from flexid_cli.diagnose.result import Change, Event, Locality, Where

Array = NDArray[np.float64]

MOST = 0.5  # of the residual's sum of squares
PURE = 0.8  # share of a shape's power that is odd, or even, or at an end
CROWDED = 1.5  # energy share over time share, at reversals
CERTAIN = 0.01  # p value
ALIKE = 0.2  # slopes of a loop
SATURATED = 0.75  # height at half of the range over that at its end

TERMS = {
    "Jm": "motor's inertia",
    "FVm": "motor's viscous friction",
    "FSm": "motor's Coulomb friction",
    "K": "stiffness",
    "c": "torsion's zero",
    "JL": "load's inertia",
    "FV": "load's viscous friction",
    "FS": "load's Coulomb friction",
    "MX": "gravity moment",
    "MY": "gravity moment",
    "offset": "torque's offset",
    "motor_offset": "motor's torque offset",
    "load_offset": "load's torque offset",
    "torque_scale": "torque's factor",
}
FACTORS = {
    "position_times_sign": "friction that depends on the position",
    "position_times_acceleration": "inertia that depends on the position",
    "position_times_torsion": "stiffness that depends on the position",
    "torsion": "stiffness that depends on the torsion",
    "load_times_sign": "friction that depends on the load",
    "torque": "a torque that is no constant multiple of the recorded one",
}


def suggestions(where: Where, found: Locality, gain: float) -> tuple[str, ...]:
    """Short phrases, the most telling first; ``gain`` is that of the free function that located the mismatch."""
    told = (*_in_time(found), *_lines(found), *_loop(found))
    shape = _shape(where) if -np.expm1(-gain) >= MOST else ()
    return (*told, *shape, *_at_reversals(found))


def interval(found: Locality, end_s: float) -> tuple[float, float] | None:
    """Times between which most of a mismatch acts, or None: all the time.

    From a change to the next one that undoes it, else to the record's end; or from the first to the last event.
    """
    change = _main_change(found)
    if change is not None:
        undone = [c.time_s for c in found.changes if _undoes(c, change)]
        return change.time_s, min(undone, default=end_s)
    loud = _main_events(found)
    return (loud[0].start_s, loud[-1].end_s) if loud else None


def _undoes(later: Change, change: Change) -> bool:
    return later.column == change.column and later.time_s > change.time_s and later.size * change.size < 0.0


def _main_change(found: Locality) -> Change | None:
    """The first of the changes of the column that explains most of the mismatch."""
    largest = max(found.changes, key=lambda c: c.share, default=None)
    if largest is None or largest.share < MOST:
        return None
    return min((c for c in found.changes if c.column == largest.column), key=lambda c: c.time_s)


def _main_events(found: Locality) -> list[Event]:
    """Events that hold most of an equation's mismatch, in the order of time."""
    for equation in dict.fromkeys(e.equation for e in found.events):
        own = [e for e in found.events if e.equation == equation]
        if sum(e.share for e in own) >= MOST:
            return own
    return []


def _in_time(found: Locality) -> Iterator[str]:
    change, loud = _main_change(found), _main_events(found)
    if change is not None:
        undone = [c.time_s for c in found.changes if _undoes(c, change)]
        until = (
            f"from {change.time_s:.4g} s to {min(undone):.4g} s"
            if undone
            else f"from {change.time_s:.4g} s on"
        )
        others = [TERMS[c] for c in change.alternatives if c in TERMS]
        text = f"{until} the {TERMS[change.column]} differs by {_amount(change.size, change.unit)}"
        yield text + (f" (or the {' or the '.join(dict.fromkeys(others))})" if others else "")
    elif loud:
        share = 100.0 * sum(e.share for e in loud)
        first = f"the first at {loud[0].start_s:.4g} s" if len(loud) > 1 else f"at {loud[0].start_s:.4g} s"
        yield f"{share:.0f} % of it is in {len(loud)} short burst{'s'[: len(loud) > 1]}, {first}"
    sure = [d for d in found.drift if d.share >= MOST and d.p_value < CERTAIN]
    if sure and change is None:
        d = max(sure, key=lambda d: d.share)
        yield f"the {TERMS[d.column]} drifts, by {_amount(d.per_minute, d.unit)} a minute"


def _amount(size: float, unit: str) -> str:
    return f"{100.0 * size:+.3g} %" if unit == "1" else f"{size:+.3g} {unit}".rstrip()


def _at_reversals(found: Locality) -> Iterator[str]:
    for r in found.reversals:
        if r.p_value < CERTAIN and r.energy_share >= max(MOST, CROWDED * r.time_share):
            yield (
                f"it peaks at reversals: {100.0 * r.energy_share:.0f} % of the {r.equation} residual's energy in"
                f" {100.0 * r.time_share:.0f} % of the time"
            )


def _lines(found: Locality) -> Iterator[str]:
    for spectrum in found.angle:
        if spectrum.lines and sum(one.share for one in spectrum.lines) >= MOST:
            cycles = [f"{one.cycles_per_motor_revolution:.4g}" for one in spectrum.lines]
            plural = "s" if len(cycles) > 1 else ""
            yield (
                f"a ripple over the motor's angle in the {spectrum.equation} equation, line{plural} of"
                f" {' and '.join(cycles)} cycles per motor revolution"
            )


def _loop(found: Locality) -> Iterator[str]:
    loop = found.loop
    if loop is None or loop.slope is None or loop.slope_stderr is None or loop.share < MOST:
        return
    flat, viscous = (abs(loop.slope - s) < max(3.0 * loop.slope_stderr, ALIKE) for s in (0.0, 1.0))
    if flat and not viscous:
        yield "torque over torsion makes a loop whose width does not depend on the frequency, as friction does"
    if viscous and not flat:
        yield "torque over torsion makes a loop that widens with the frequency, as damping does"


def _shape(where: Where) -> Iterator[str]:
    if where.variable in FACTORS:
        yield FACTORS[where.variable]
    if where.variable == "frequency" and where.frequency_hz is not None:
        yield f"a tone of {where.frequency_hz[0]:.4g} Hz, whatever the axis does"
    if where.shape is None:
        return
    x, y = where.shape.x, where.shape.y
    y = y - y.mean() if where.variable != "velocity" else y
    if where.variable == "velocity":
        yield from _over_velocity(y)
    if where.variable == "position":
        yield from _over_position(x, y)


def _over_velocity(y: Array) -> Iterator[str]:
    """The knots lie symmetrically about zero."""
    odd, even = 0.5 * (y - y[::-1]), 0.5 * (y + y[::-1])
    share = float(odd @ odd) / max(float(y @ y), 1e-300)
    if share >= PURE:
        half = odd[y.size // 2 :]
        steady = abs(half[-1]) > 0.0 and half[-2] / half[-1] >= SATURATED
        law = "saturates" if steady and np.all(half * half[-1] >= 0.0) else "does not grow steadily"
        yield f"it is odd in the velocity and {law}: a law of friction"
    elif float(even @ even) >= PURE * float(y @ y):
        yield "it is even in the velocity: it does not depend on the direction"


def _over_position(x: Array, y: Array) -> Iterator[str]:
    power = np.square(y)
    ends = max(2, x.size // 5)
    for name, part in (("lower", power[:ends]), ("upper", power[-ends:])):
        if float(part.sum()) >= PURE * float(power.sum()):
            yield f"it stands at the {name} end of the travel"
