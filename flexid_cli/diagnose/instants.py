"""When an event of one record happened in another: it has an instant of its own there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flexid_cli.diagnose.fitter import Chosen
from flexid_cli.diagnose.problem import Problem
from flexid_cli.diagnose.search import minimum

Array = NDArray[np.float64]

INSTANTS, MOST_STEPS = 60, 20  # of the first look, and of closing in


def own_instant(problem: Problem, event: Chosen, amplitudes: Array, left: Array) -> Chosen:
    """The event at the instant that explains most in a record.

    At its start or its end where it did not happen: the record speaks for or against its size, not against its
    having been.

    Parameters
    ----------
    problem : Problem
        The record.
    event : Chosen
        With the instant of another record.
    amplitudes : ndarray, shape (k,)
        Its size.
    left : ndarray, shape (r,)
        Rows of the record without it.
    """

    def at(instant: float) -> Chosen:
        return Chosen(event.form, (instant,))

    def cost(instant: float) -> float:
        e = left - problem.effect_rows(at(instant).terms)[0] @ amplitudes
        return float(e @ e)

    points = np.linspace(0.0, problem.duration_s, INSTANTS)
    best = int(np.argmin([cost(float(t)) for t in points]))
    near = tuple(points[max(best - 1, 0) : best + 2])
    instant, _ = minimum(cost, 0.0, problem.duration_s, near, 0.5 * problem.stretches[0].period_s, MOST_STEPS)
    return at(instant)
