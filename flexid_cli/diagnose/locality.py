"""Every view of where a mismatch lives, gathered: time, events, reversals, angle, loop and drift."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from flexid_cli.diagnose.angle import Angles, spectrum
from flexid_cli.diagnose.change_points import Record, changes
from flexid_cli.diagnose.drift import drifts
from flexid_cli.diagnose.events import events
from flexid_cli.diagnose.evidence import by_equation
from flexid_cli.diagnose.fitter import Fitted
from flexid_cli.diagnose.location import Map
from flexid_cli.diagnose.loop_width import loop_width
from flexid_cli.diagnose.physical import torque_scale
from flexid_cli.diagnose.problem import Problem
from flexid_cli.diagnose.result import AngleSpectrum, Event, Locality, Reversals
from flexid_cli.diagnose.reversal_windows import reversals, turns
from flexid_cli.effects.motion import Motion, Terms
from flexid_cli.estimate.result import Estimate
from flexid_cli.signals.recording import Recording

Array = NDArray[np.float64]

# What else may change: offsets, the factor of the torque, and with both encoders the spring on either side. The last
# two are what the equations are solved for: only their change is a column.
_COLUMNS: dict[str, Callable[[Motion], Terms]] = {
    "motor_offset": lambda m: Terms(motor=np.ones((m.time_s.size, 1))),
    "load_offset": lambda m: Terms(load=np.ones((m.time_s.size, 1))),
    "torque_scale": lambda m: Terms(motor=m.torque[:, None]),
    "K": lambda m: Terms(motor=m.deflection[:, None], load=-m.deflection[:, None]),
}


def locality(
    fitted: Fitted, maps: Sequence[Map], recording: Recording, estimates: Sequence[Estimate], model: str
) -> Locality:
    """Where and when a model's residual lives.

    Parameters
    ----------
    fitted : Fitted
    maps : sequence of Map
        Of its residual.
    recording : Recording
        For units.
    estimates : sequence of Estimate
        Parameters of the model.
    model : str
        What the report calls it.
    """
    record, torque = change_record(fitted), recording.torque_unit
    values = {e.symbol: e.value for e in estimates if e.value is not None}
    units = {e.symbol: e.unit for e in estimates} | {"torque_scale": "1"}
    found = tuple(replace(c, unit=units.get(c.column, torque)) for c in changes(record, _rival(fitted, maps)))
    drift = tuple(replace(d, unit=units.get(d.column, torque)) for d in drifts(record, values))
    stiffness = f"{torque}/{'m' if recording.linear else 'rad'}"
    return Locality(
        model=model,
        changes=found,
        events=_events(fitted),
        reversals=_reversals(fitted, torque),
        angle=() if recording.linear else _angle(fitted, torque),
        loop=loop_width(fitted.problem, fitted.basis, unit=stiffness, torque_unit=torque),
        drift=drift,
    )


def _rival(fitted: Fitted, maps: Sequence[Map]) -> float:
    """Sum of squares that the best function of another variable than time explains; see `gained`."""
    gain = max((m.gain for m in maps if not m.variable.startswith(("time", "frequency"))), default=0.0)
    return (fitted.cost + fitted.y.size) * -float(np.expm1(-gain))


def lengths(problem: Problem) -> list[int]:
    """Rows of each gap-free stretch."""
    return [w.seconds.size for w in problem.weights]


def change_record(fitted: Fitted) -> Record:
    """The residual with the columns of the baseline, offsets and the torque's factor."""
    problem, basis = fitted.problem, fitted.basis
    columns = {name: basis.columns[:, k] for k, name in enumerate(problem.names)}
    offsets = ["motor_offset", "load_offset"] if problem.both else ["motor_offset"]
    offsets = [] if "offset" in columns else offsets
    for name in (*offsets, "torque_scale", *(("K",) if problem.both else ())):
        columns[name] = problem.effect_rows(_COLUMNS[name])[0][:, 0]
    if not offsets:
        return Record(columns, basis.Q, basis.residual, problem.row_times, lengths(problem))
    added = basis.outside(np.column_stack([columns[n] for n in offsets]))
    U, s, _ = np.linalg.svd(added / np.maximum(np.linalg.norm(added, axis=0), 1e-300), full_matrices=False)
    U = U[:, s > 1e-6 * s[0]]
    residual = basis.residual - U @ (U.T @ basis.residual)
    return Record(columns, np.column_stack([basis.Q, U]), residual, problem.row_times, lengths(problem))


def _events(fitted: Fitted) -> tuple[Event, ...]:
    problem = fitted.problem
    parts = by_equation(problem, fitted.basis.residual)
    found = [e for name, x in parts.items() for e in events(name, x, problem.row_times, lengths(problem))]
    return tuple(sorted(found, key=lambda e: e.start_s))


def _reversals(fitted: Fitted, unit: str) -> tuple[Reversals, ...]:
    problem, scale = fitted.problem, torque_scale(fitted.problem)
    found = []
    for name, e in by_equation(problem, fitted.basis.residual).items():
        each = [
            turns(m.time_s, m.joint_velocity if name == "load" else m.motor_velocity) for m in problem.motions
        ]
        at = (np.concatenate([t for t, _ in each]), np.concatenate([w for _, w in each]))
        one = reversals(name, e, problem.row_times, lengths(problem), at, scale=scale[name], unit=unit)
        found += [] if one is None else [one]
    return tuple(found)


def _angle(fitted: Fitted, unit: str) -> tuple[AngleSpectrum, ...]:
    problem, basis = fitted.problem, fitted.basis
    own = np.concatenate([m.time_s for m in problem.motions])

    def on_rows(values: list[Array]) -> Array:
        return np.interp(problem.row_times, own, np.concatenate(values))

    angles = Angles.of(
        on_rows([m.motor_position for m in problem.motions]),
        on_rows([m.motor_velocity for m in problem.motions]),
        problem.band_hz,
        problem.gear_ratio,
    )
    found = []
    for k, (name, e) in enumerate(by_equation(problem, basis.residual).items()):

        def rows(cycles: float, name: str = name, k: int = k) -> Array:
            def terms(m: Motion) -> Terms:
                turned = cycles * m.motor_position
                return Terms(**{name: np.column_stack([np.cos(turned), np.sin(turned)])})

            whole = basis.outside(problem.effect_rows(terms)[0])
            return np.asarray(whole.reshape(problem.equations, -1, 2)[k])

        one = spectrum(name, e, angles, rows, scale=torque_scale(problem)[name], unit=unit)
        found += [] if one is None else [one]
    return tuple(found)
