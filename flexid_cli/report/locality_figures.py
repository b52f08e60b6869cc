"""Figures of where and when a mismatch shows."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from flexid_cli.report.diagnosis_words import labelled
from flexid_cli.report.drawing import BAND, MEASURED, PREDICTED, RESIDUAL, legend, svg
from flexid_cli.report.locality_words import ANGLE_FIGURE, LOOP_FIGURE, REVERSAL_FIGURE
from flexid_cli.report.numbers import format_significant

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from flexid_cli.diagnose.result import AngleSpectrum, Locality, LoopWidth, Reversals

_CERTAIN = 0.01
_MOST_LABELS = 3


def locality_figures(found: Locality) -> dict[str, str]:
    """Every figure that has something to show, by the keys of `locality_words.captions`."""
    figures: dict[str, str] = {}
    turned = [r for r in found.reversals if np.all(np.isfinite(r.mean))]
    if any(r.p_value < _CERTAIN for r in turned):
        figures[REVERSAL_FIGURE] = figure_reversals(turned)
    if any(spectrum.lines for spectrum in found.angle):
        figures[ANGLE_FIGURE] = figure_angle(found.angle)
    if found.loop is not None and found.loop.slope is not None:
        figures[LOOP_FIGURE] = figure_loop(found.loop)
    return figures


def figure_reversals(found: list[Reversals]) -> str:
    """Draw the folded mean of each equation about reversals."""

    def draw(figure: Figure) -> None:
        row = figure.subplots(1, len(found), squeeze=False)[0]
        for axes, one in zip(row, found, strict=True):
            low, high = one.mean - one.band, one.mean + one.band
            axes.fill_between(one.lag_s, low, high, color=BAND, alpha=0.3, linewidth=0.0, label="95 % band")
            axes.axhline(0.0, color=MEASURED, linewidth=0.6)
            axes.axvline(0.0, color=MEASURED, linewidth=0.6)
            axes.plot(one.lag_s, one.mean, color=PREDICTED, linewidth=1.4, label="mean")
            axes.locator_params(axis="x", nbins=5)
            axes.set_xlabel("time from the reversal (s)")
            axes.set_ylabel(f"{one.equation} residual ({one.unit})")
            legend(axes, columns=2)

    return svg(draw, "Residual about velocity reversals, folded by the direction after", 3.9)


def figure_angle(found: tuple[AngleSpectrum, ...]) -> str:
    """Draw the spectra over the motor's angle, with the level that noise stays below and the lines found."""

    def draw(figure: Figure) -> None:
        rows = figure.subplots(len(found), 1, sharex=True, squeeze=False)[:, 0]
        for axes, one in zip(rows, found, strict=True):
            axes.plot(one.cycles, one.amplitude, color=RESIDUAL, linewidth=0.9, label="residual")
            axes.plot(
                one.cycles,
                one.level,
                color=MEASURED,
                linewidth=1.0,
                linestyle="--",
                label="1 % level of noise beside the lines",
            )
            axes.set_yscale("log")
            axes.set_ylabel(f"{one.equation} ({one.unit})")
            for k, line in enumerate(one.lines[:_MOST_LABELS]):
                axes.axvline(line.cycles_per_joint_revolution, color=PREDICTED, linewidth=0.8, alpha=0.7)
                axes.annotate(
                    f"{format_significant(line.cycles_per_motor_revolution, 4)} per motor revolution",
                    (line.cycles_per_joint_revolution, 1.0),
                    xycoords=("data", "axes fraction"),
                    xytext=(4, -2 - 11 * k),
                    textcoords="offset points",
                    va="top",
                    fontsize=8,
                    color=PREDICTED,
                )
        rows[-1].set_xlabel("cycles per joint revolution")
        legend(rows[0], columns=2)

    return svg(draw, "Spectrum of the residual over the motor's angle", 1.6 + 1.9 * len(found))


def figure_loop(loop: LoopWidth) -> str:
    """Draw the loss stiffness against frequency, with a line of either slope through its middle."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        shown = loop.stiffness > 0.0
        x, y = loop.frequency_hz[shown], loop.stiffness[shown]
        below = np.minimum(loop.band[shown], 0.9 * y)  # a logarithmic axis has no zero
        bars = np.vstack([below, loop.band[shown]])
        axes.errorbar(
            x, y, yerr=bars, fmt="o", color=RESIDUAL, markersize=4.5, capsize=3, label="with 95 % band"
        )
        sure = y > loop.band[shown]
        fx, fy = (float(np.exp(np.mean(np.log(v[sure])))) for v in (x, y))
        ends = np.array([x.min(), x.max()])
        axes.plot(ends, [fy, fy], color=MEASURED, linewidth=1.0, linestyle="--", label="as friction, slope 0")
        axes.plot(
            ends, fy * ends / fx, color=PREDICTED, linewidth=1.0, linestyle="--", label="as damping, slope 1"
        )
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.xaxis.set_major_formatter("{x:g}")
        axes.set_xlabel("frequency (Hz)")
        axes.set_ylabel(labelled("loss stiffness", loop.unit))
        legend(axes, columns=3)

    return svg(draw, "Loop of torque over torsion against frequency", 3.9)
