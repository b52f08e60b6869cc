"""From an estimate and its uncertainty to a verdict that a person can rely on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from flexid_cli.estimate.result import Estimate, Interval, Verdict
from flexid_cli.models.base import Parameter

Array = NDArray[np.float64]

# The paper calls its parameters of up to 9.7 % relative standard deviation identified and those of 15 % and more
# not significant (Tables 1 and 2). At 50 % the 95 % interval reaches zero.
IDENTIFIED_PERCENT = 10.0
WEAK_PERCENT = 50.0
NAMED_CORRELATION = 0.9
FORBIDDEN = "physics forbids a negative value"
SPLIT = "the motor encoder alone shows the sum of motor and load friction, hardly how it is split"


def judge(
    parameter: Parameter,
    unit: str,
    value: float,
    stderr: float,
    degrees_of_freedom: float,
    *,
    level: float,
    method: str,
    doubt: str = "",
) -> Estimate:
    """Estimate with interval and verdict.

    Parameters
    ----------
    parameter : Parameter
        What was estimated.
    unit : str
        Its unit.
    value, stderr : float
        Estimate and total standard error.
    degrees_of_freedom : float
        Of Student's t.
    level, method : float, str
        Level of the interval, and how it was made.
    doubt : str
        What makes the parameter uncertain (a correlated parameter, a source of the budget), for the reason.
    """
    if not (np.isfinite(value) and np.isfinite(stderr)):
        return undetermined(parameter, unit, doubt or "the columns of the record do not determine it")
    from scipy.special import stdtrit

    half = float(stdtrit(max(degrees_of_freedom, 1.0), 0.5 + 0.5 * level)) * stderr
    interval = Interval(value - half, value + half, level, method)
    relative = 100.0 * stderr / abs(value) if value else None
    verdict, reason = _verdict(parameter, value, interval, relative, doubt)
    return Estimate(
        parameter.name, parameter.symbol, unit, value, stderr, interval, relative, verdict, reason
    )


def undetermined(parameter: Parameter, unit: str, reason: str) -> Estimate:
    """A parameter without an estimate, and why."""
    return Estimate(
        parameter.name, parameter.symbol, unit, None, None, None, None, "not_identifiable", reason
    )


def _verdict(
    parameter: Parameter, value: float, interval: Interval, relative: float | None, doubt: str
) -> tuple[Verdict, str]:
    because = f"; {doubt}" if doubt else ""
    if parameter.positive and interval.high < 0.0:
        return "not_identifiable", FORBIDDEN + ": the model lacks something" + because
    if parameter.positive and value <= 0.0:
        return "not_identifiable", "the estimate is negative and its interval reaches zero" + because
    if relative is None or (interval.low <= 0.0 <= interval.high and relative > WEAK_PERCENT):
        return "not_identifiable", "the interval holds zero: the record does not show it" + because
    if relative > WEAK_PERCENT:
        return "not_identifiable", f"relative standard deviation {relative:.0f} %" + because
    if relative > IDENTIFIED_PERCENT:
        return "weak", f"relative standard deviation {relative:.0f} %" + because
    half = 0.5 * (interval.high - interval.low)
    if 100.0 * half > WEAK_PERCENT * abs(value):
        return "weak", "a short part of the record carries it, so its interval is wide" + because
    if parameter.split:
        return "weak", SPLIT + because
    return "identified", ""


def model_doubt(estimates: Sequence[Estimate], fit_percent: float) -> str:
    """Why no parameter of a model deserves `identified`, or nothing.

    A parameter that physics forbids, or a torque of which the model leaves more unexplained than the relative
    error that `identified` allows, shows that the model lacks something; its lack biases the others in a way that
    no interval of this model covers.
    """
    unexplained = 100.0 - fit_percent
    forbidden = [e for e in estimates if e.reason.startswith(FORBIDDEN)]
    inertias = [e for e in estimates if e.name.endswith("inertia")]
    if inertias and all(e.value is not None and e.value < 0.0 for e in inertias):
        return "the inertia came out negative, as if torque and motion had opposite signs: check `sign` of the torque"
    if unexplained > IDENTIFIED_PERCENT:
        return f"the model leaves {unexplained:.0f} % of the torque unexplained: it lacks something"
    if forbidden:
        symbols = ", ".join(e.symbol for e in forbidden)
        return f"{symbols} came out with a sign that physics forbids: the model lacks something"
    return ""


def demoted(estimate: Estimate, doubt: str) -> Estimate:
    """The estimate, no better than weak, for a doubt about the whole model."""
    if not doubt or estimate.verdict != "identified":
        return estimate
    return replace(estimate, verdict="weak", reason=doubt)


def correlated_with(correlation: Array, symbols: tuple[str, ...], index: int) -> str:
    """Name of the parameter that an estimate can hardly be told from, as a reason, or nothing."""
    row = np.abs(correlation[index]).copy()
    row[index] = 0.0
    row[~np.isfinite(row)] = 0.0
    other = int(np.argmax(row))
    if row[other] < NAMED_CORRELATION:
        return ""
    return f"hardly told from {symbols[other]} (correlation {correlation[index, other]:+.2f})"
