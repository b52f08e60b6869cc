"""What figures of a diagnosis show: residuals over time, and over the variable that they were located in."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from flexid_cli.diagnose.bands import binned
from flexid_cli.diagnose.evidence import by_equation
from flexid_cli.diagnose.fitter import Fitted
from flexid_cli.diagnose.location import VARIABLES, Map, unit_of_variable
from flexid_cli.diagnose.physical import torque_scale
from flexid_cli.diagnose.result import ResidualMap, Traces
from flexid_cli.signals.recording import Recording

Array = NDArray[np.float64]

BINS = 24
LEAST_IN_BIN = 5
MOST_MAPS = 4
LEAST_SHARE, LEAST_GAIN = 0.25, 0.05  # gain of a further map: of the largest, and at all


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
    bins = [k for k in range(BINS) if np.count_nonzero(which == k) >= LEAST_IN_BIN]
    rows = [w.seconds.size for w in before.problem.weights]
    after_mean, band = binned(last, which, bins, rows)
    return ResidualMap(
        equation=equation,
        variable=variable.split("_times_")[0],
        x=np.array([0.5 * (edges[k] + edges[k + 1]) for k in bins]),
        before=np.array([first[which == k].mean() for k in bins]),
        after=after_mean,
        band=band,
        x_unit=unit_of_variable(variable, recording),
        unit=recording.torque_unit,
    )


def matter(maps: Sequence[Map], *, both: bool) -> list[Map]:
    """The maps to show: the largest, and others that explain a good part of what it does; no figure twice."""
    shown: dict[tuple[bool, str], Map] = {}
    for m in maps:
        key = (both and m.equation != "motor", m.variable.split("_times_")[0].replace("frequency", "time"))
        if len(shown) < MOST_MAPS and (m is maps[0] or m.gain >= max(LEAST_SHARE * maps[0].gain, LEAST_GAIN)):
            shown.setdefault(key, m)
    return list(shown.values())
