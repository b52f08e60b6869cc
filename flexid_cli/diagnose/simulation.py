"""Simulation error before and after: the load simulated behind the measured motor motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from flexid_cli.diagnose.problem import Problem
from flexid_cli.diagnose.result import SimulationError
from flexid_cli.diagnose.stretch import SMOOTH_BAND, Stretch
from flexid_cli.effects.base import EffectValues
from flexid_cli.errors import FlexidError

Array = NDArray[np.float64]
EDGE_S = 1.0  # left out at each end: the state at the start is not known


def simulation_error(
    problem: Problem,
    before: Mapping[str, float],
    after: Mapping[str, float],
    effects: Sequence[EffectValues],
    *,
    unit: str,
    position_unit: str,
) -> SimulationError:
    """Difference of simulation and recording, by the parameters of both models (symbols to values)."""
    if problem.rigid:
        return SimulationError(
            None, None, "torque", unit, "a rigid axis has no motion of its own to simulate"
        )
    stretch = max(problem.stretches, key=lambda s: s.torque.size)
    quantity = "joint_position" if problem.both else "torque"
    try:
        first = _error(problem, stretch, before, ())
        second = _error(problem, stretch, after, effects) if effects or after != before else first
    except FlexidError as error:
        return SimulationError(None, None, quantity, unit, error.message)
    return SimulationError(first, second, quantity, position_unit if problem.both else unit)


def _error(
    problem: Problem, s: Stretch, values: Mapping[str, float], effects: Sequence[EffectValues]
) -> float:
    from flexid_cli.simulate.engine import simulate_motor_driven
    from flexid_cli.simulate.machine import Axis

    axis = Axis(
        Jm=values["Jm"],
        K=values["K"],
        JL=values["JL"],
        FVm=max(values["FVm"], 0.0),
        FSm=max(values["FSm"], 0.0),
        FV=max(values["FV"], 0.0),
        FS=max(values["FS"], 0.0),
        MX=values.get("MX", 0.0),
        MY=values.get("MY", 0.0),
        gravity=problem.gravity,
        torque_offset=0.0,
        reversal_velocity=problem.base.motor_reversal,
        load_reversal_velocity=problem.base.load_reversal,
    )
    run = simulate_motor_driven(axis, s.motor_smooth, s.rate_hz, effects=effects)
    edge = round(EDGE_S * s.rate_hz)
    inside = slice(edge, -edge)
    if problem.both:
        difference = run.joint_position - (s.joint + problem.base.torsion_zero)
    else:
        difference = s.lowpass(run.torque - s.torque, SMOOTH_BAND)
    kept = difference[inside]
    return float(np.sqrt(np.mean((kept - kept.mean() if problem.both else kept) ** 2)))
