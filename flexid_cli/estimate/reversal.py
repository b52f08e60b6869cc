"""Width of the friction reversal, fitted: sgn v as tanh(v / v0)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from flexid_cli.pipeline.columns import Columns

# Searched from a reversal that is a step at any sampling rate to one as wide as the motion itself.
NARROWEST = 2e-5
WIDEST = 0.7
FINE_GRID = 10
# Enough for a starting point, without refinement.
COARSE_GRID = 6


def fit_reversal_velocity(
    columns: Columns, cost: Callable[[], float], *, grid: int = FINE_GRID
) -> float | None:
    """Velocity v0 that makes the residual smallest, or None where a plain sign fits as well.

    Parameters
    ----------
    columns : Columns
        Their reversal velocity is changed; the caller sets the result.
    cost : callable
        Sum of the logarithms of the residuals' sizes with the columns as they stand.
    grid : int
        Widths that are tried; with `COARSE_GRID` the best of them is the result.
    """
    from scipy.optimize import minimize_scalar

    speed = float(np.sqrt(np.mean(np.concatenate(columns.motor_velocity) ** 2)))
    if speed == 0.0:
        return None

    def at(log_width: float) -> float:
        columns.set_reversal_velocity(float(np.exp(log_width)))
        return cost()

    widths = np.linspace(np.log(NARROWEST * speed), np.log(WIDEST * speed), grid)
    costs = [at(x) for x in widths]
    best = int(np.argmin(costs))
    if best == 0:
        return None
    if grid <= COARSE_GRID:
        return float(np.exp(widths[best]))
    low, high = widths[best - 1], widths[min(best + 1, grid - 1)]
    found = minimize_scalar(at, bounds=(low, high), method="bounded", options={"xatol": 0.1})
    return float(np.exp(found.x if found.fun < costs[best] else widths[best]))
