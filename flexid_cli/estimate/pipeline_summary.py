"""What was done to the data before the solve, for the report."""

from __future__ import annotations

import numpy as np

from flexid_cli.estimate.result import PipelineSummary
from flexid_cli.estimate.solution import Solution
from flexid_cli.pipeline.tuning import DECIMATION_EDGE


def pipeline_summary(solution: Solution) -> PipelineSummary:
    """What was done to the data, in numbers and in words."""
    columns, tuning = solution.columns, solution.tuning
    chain, settings = columns.chain, columns.chain.settings
    rate = settings.sample_rate_hz
    longest = max(s.samples for s in columns.segments)
    trimmed = chain.trim_samples(longest) / rate
    grid = np.geomspace(max(0.01, chain.band_hz / 300.0), 0.5 * rate, 400)
    return PipelineSummary(
        sample_rate_hz=rate,
        steps=_steps(solution, trimmed),
        lowpass_order=settings.lowpass_order,
        lowpass_cutoff_hz=settings.lowpass_cutoff_hz,
        derivative=settings.derivative,
        decimation=settings.decimation,
        effective_band_hz=(rate / longest, chain.band_hz),
        limited_by=chain.limited_by,
        sign_cutoff_hz=tuning.sign_cutoff_hz,
        reversal_velocity=columns.reversal_velocity,
        rows=sum(columns.lengths),
        trimmed_s=trimmed,
        f1_hz=tuning.f1_hz,
        f1_source=tuning.f1_source,
        magnitude_hz=grid,
        magnitude=chain.magnitude(grid),
    )


def _steps(solution: Solution, trimmed: float) -> tuple[str, ...]:
    settings = solution.columns.chain.settings
    steps = []
    if settings.lowpass_cutoff_hz is not None:
        steps.append(
            f"zero-phase Butterworth low pass on every column, order {settings.lowpass_order} each way,"
            f" {settings.lowpass_cutoff_hz:.4g} Hz (-6 dB)"
        )
    if settings.derivative == "exact":
        steps.append(
            f"exact derivative, {2 * solution.columns.chain.half_width + 1}-point maximally flat difference"
        )
    else:
        steps.append("central difference, repeated for higher derivatives (eq. 22)")
    width = solution.columns.reversal_velocity
    shape = f"tanh(v / {width:.3g})" if width else "sgn v"
    steps.append(f"friction sign {shape} from the velocity below {solution.tuning.sign_cutoff_hz:.4g} Hz")
    if settings.decimation > 1:
        edge = 0.5 * DECIMATION_EDGE * settings.sample_rate_hz / settings.decimation
        steps.append(
            f"parallel decimation by {settings.decimation}: zero-phase Chebyshev I, order 8, 0.05 dB,"
            f" {edge:.4g} Hz, one row in {settings.decimation}"
        )
    steps.append(f"{trimmed:.3g} s trimmed at each edge of each segment")
    return tuple(steps)
