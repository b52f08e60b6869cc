"""Timing between the signals as the residuals show it: reported and offered, never applied."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from flexid_cli.config.schema import Config
    from flexid_cli.estimate.budget import Nuisance
    from flexid_cli.estimate.solution import Solution

SIGNIFICANT_DELAY_SAMPLES = 0.1
SIGNIFICANT_SIGMA = 3.0
HALF_SAMPLE_TOLERANCE = 0.2
DELAY_MEANING = "delay of the acting torque after its stamp as the residuals show it; not applied"
SKEW_MEANING = (
    "by how much the joint position was taken before its stamp, beside the motor's, as the residuals show it;"
    " a damping in the joint looks alike; not applied"
)


def timing_test(found: Nuisance, solution: Solution, meaning: str) -> dict[str, Any]:
    """A time that the residuals show, for the report's tests; null where the parameters take up all of it."""
    rate = solution.columns.recording.sample_rate_hz
    known = bool(np.isfinite(found.stderr))
    return {
        "value_s": found.value if known else None,
        "stderr_s": found.stderr if known else None,
        "value_samples": found.value * rate if known else None,
        "meaning": meaning,
    }


def delay_warning(solution: Solution, delay: Nuisance, config: Config) -> list[str]:
    """What to set where the torque clearly acts at another time than its stamp says."""
    samples = delay.value * solution.columns.recording.sample_rate_hz
    if not _clear(delay, samples):
        return []
    role, torque = config.signals.torque_role, config.signals.torque
    cure = f"signals.{role}.delay_s: {(torque.delay_s or 0.0) - delay.value:.3g}"
    if torque.hold is None and abs(samples - 0.5) < HALF_SAMPLE_TOLERANCE:
        cure = f"signals.{role}.hold: sample"
    text = (
        f"{solution.model.id}: the torque seems to act {1e3 * delay.value:.3g} ms ({samples:.2g} samples) after its"
        f" stamp; if the drive's timing confirms it, set {cure}"
    )
    return [text]


def skew_warning(solution: Solution, skew: Nuisance, config: Config) -> list[str]:
    """What to set where the two encoders were clearly not read together."""
    samples = skew.value * solution.columns.recording.sample_rate_hz
    joint = config.signals.joint_position
    if joint is None or not _clear(skew, samples):
        return []
    when = "before" if skew.value > 0.0 else "after"
    text = (
        f"{solution.model.id}: the joint position seems to be taken {1e3 * abs(skew.value):.3g} ms"
        f" ({abs(samples):.2g} samples) {when} its stamp, beside the motor's, or there is a damping in the joint;"
        f" if the bus confirms it, set signals.joint_position.delay_s: {(joint.delay_s or 0.0) + skew.value:.3g}"
    )
    return [text]


def _clear(found: Nuisance, samples: float) -> bool:
    known = bool(np.isfinite(found.stderr)) and abs(found.value) >= SIGNIFICANT_SIGMA * found.stderr
    return known and abs(samples) >= SIGNIFICANT_DELAY_SAMPLES
