"""Estimates as they stand in the document: finite numbers, and verdicts no better than the numbers allow."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from flexid_cli.estimate.result import Estimate, Interval

_NO_ESTIMATE = "the solve gave no finite number"
_NO_INTERVAL = "the estimate has no finite confidence interval"
_NO_REASON = "no reason was given"


def parameter_section(estimate: Estimate) -> dict[str, Any]:
    """One entry of ``parameters[]``.

    Returns
    -------
    dict
        NaN and infinity are None. An estimate without a number is never anything but ``not_identifiable``, one
        without an interval never ``identified``.
    """
    value, stderr = finite(estimate.value), finite(estimate.stderr)
    ci = _interval(estimate.interval)
    verdict, reason = _verdict(estimate, value, stderr, ci)
    has_value = value is not None
    return {
        "name": estimate.name,
        "symbol": estimate.symbol,
        "unit": estimate.unit,
        "estimate": value,
        "stderr": stderr if has_value else None,
        "ci": ci if has_value else None,
        "relative_stderr_percent": finite(estimate.relative_stderr_percent) if has_value else None,
        "verdict": verdict,
        "reason": reason,
        "advice": "" if verdict == "identified" else estimate.advice,
    }


def finite(value: float | None) -> float | None:
    """Return the number, or None where there is no finite one."""
    return None if value is None or not math.isfinite(value) else float(value)


def _verdict(
    estimate: Estimate, value: float | None, stderr: float | None, ci: dict[str, Any] | None
) -> tuple[str, str]:
    """Return verdict and reason, never better than what the numbers themselves allow."""
    if value is None:
        return "not_identifiable", estimate.reason or _NO_ESTIMATE
    if estimate.verdict == "identified":
        bounded = ci is not None and ci["low"] is not None and ci["high"] is not None
        if stderr is None or not bounded:
            return "weak", estimate.reason or _NO_INTERVAL
        return "identified", estimate.reason
    return estimate.verdict, estimate.reason or _NO_REASON


def _interval(interval: Interval | None) -> dict[str, Any] | None:
    """Return the interval; a bound that is not finite is None, and no interval is left without any bound."""
    if interval is None:
        return None
    low, high = finite(interval.low), finite(interval.high)
    if low is None and high is None:
        return None
    return {"low": low, "high": high, "level": interval.level, "method": interval.method}
