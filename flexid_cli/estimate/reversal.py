"""Width of the friction reversal, fitted: sgn v as tanh(v / v0)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from flexid_cli.pipeline.columns import Columns

# Searched from a reversal that is a step at any sampling rate to one as wide as the motion itself.
NARROWEST = 2e-5
WIDEST = 0.7
GRID = 15


def fit_reversal_velocity(columns: Columns, cost: Callable[[], float]) -> float | None:
    """Velocity v0 that makes the residual smallest, or None where a plain sign fits as well.

    Parameters
    ----------
    columns : Columns
        Their reversal velocity is changed; the caller sets the result.
    cost : callable
        Sum of the logarithms of the residuals' sizes with the columns as they stand.
    """
    from scipy.optimize import minimize_scalar

    speed = float(np.sqrt(np.mean(np.concatenate(columns.motor_velocity) ** 2)))
    if speed == 0.0:
        return None

    def at(log_width: float) -> float:
        columns.set_reversal_velocity(float(np.exp(log_width)))
        return cost()

    grid = np.linspace(np.log(NARROWEST * speed), np.log(WIDEST * speed), GRID)
    costs = [at(x) for x in grid]
    best = int(np.argmin(costs))
    if best == 0:
        return None
    low, high = grid[best - 1], grid[min(best + 1, GRID - 1)]
    found = minimize_scalar(at, bounds=(low, high), method="bounded", options={"xatol": 0.05})
    return float(np.exp(found.x if found.fun < costs[best] else grid[best]))
