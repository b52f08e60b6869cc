"""What figures of a diagnosis show: residuals over time, and over the variable that they were located in."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flexid_cli.diagnose.evidence import by_equation
from flexid_cli.diagnose.fitter import Fitted
from flexid_cli.diagnose.location import VARIABLES, Map, unit_of_variable
from flexid_cli.diagnose.physical import torque_scale
from flexid_cli.diagnose.result import ResidualMap, Traces
from flexid_cli.signals.recording import Recording

Array = NDArray[np.float64]

BINS = 24
BLOCK_S = 1.0  # blocks that the bands' spread is taken over
LEAST_IN_BIN = 5


def traces(before: Fitted, after: Fitted, unit: str) -> Traces:
    """Residuals of both models over time, in torque units."""

    def scaled(fitted: Fitted) -> dict[str, Array]:
        size = torque_scale(fitted.problem)
        return {n: size[n] * x for n, x in by_equation(fitted.problem, fitted.basis.residual).items()}

    return Traces(before.problem.row_times, scaled(before), scaled(after), unit)


def residual_map(before: Fitted, after: Fitted, found: Map, recording: Recording) -> ResidualMap:
    """Binned mean of the residuals over the variable of a map, with 95 % bands of the later one."""
    equation = "motor" if found.equation == "motor" or not before.problem.both else "load"
    variable = "time" if found.variable == "frequency" else found.variable  # a line is shown over time
    t, value = before.problem.row_times, VARIABLES[variable][0]
    own = np.concatenate([m.time_s for m in before.problem.motions])
    x = np.interp(t, own, np.concatenate([value(m, found.equation) for m in before.problem.motions]))
    low, high = np.quantile(x, [0.002, 0.998])
    edges = np.linspace(float(low), float(high), BINS + 1)
    which = np.digitize(x, edges) - 1
    size = torque_scale(before.problem)[equation]
    first = size * by_equation(before.problem, before.basis.residual)[equation]
    last = size * by_equation(after.problem, after.basis.residual)[equation]
    rows = [k for k in range(BINS) if np.count_nonzero(which == k) >= LEAST_IN_BIN]
    return ResidualMap(
        equation=equation,
        variable=variable.split("_times_")[0],
        x=np.array([0.5 * (edges[k] + edges[k + 1]) for k in rows]),
        before=np.array([first[which == k].mean() for k in rows]),
        after=np.array([last[which == k].mean() for k in rows]),
        band=np.array([_band(last[which == k], t[which == k]) for k in rows]),
        x_unit=unit_of_variable(variable, recording),
        unit=recording.torque_unit,
    )


def _band(values: Array, t: Array) -> float:
    """Half width of a 95 % band of a mean, from the means of blocks of time."""
    block = np.floor(t / BLOCK_S)
    means = np.array([values[block == b].mean() for b in np.unique(block)])
    if means.size < 2:
        return float(1.96 * values.std())
    return float(1.96 * means.std(ddof=1) / np.sqrt(means.size))
