"""Figures as SVG text; the same result gives the same bytes."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from flexid_cli.report.diagnosis_words import RESIDUAL_FIGURE, SHAPE_FIGURE, labelled, map_key, phrase
from flexid_cli.report.drawing import BAND, MEASURED, PREDICTED, RESIDUAL, RESONANCE, UNDERNEATH, legend
from flexid_cli.report.drawing import svg as _svg
from flexid_cli.report.locality_words import tells
from flexid_cli.report.numbers import format_significant
from flexid_cli.report.words import quantity

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from flexid_cli.diagnose.result import Diagnosis, Locality, ResidualMap, Traces, Where
    from flexid_cli.estimate.result import ModelResult, PipelineSummary

    Array = NDArray[np.float64]

_BINS = 1500
_GAP_PERIODS = 4.0
_LOWEST_DB = -80.0
_FLOOR_DB = -200.0
_DECADES = 6.0


def model_figures(model: ModelResult) -> dict[str, str]:
    """Return every figure of a model as SVG text, by kind: torque, filter, spectrum."""
    return {
        "torque": figure_torque(model),
        "filter": figure_filter(model),
        "spectrum": figure_spectrum(model),
    }


def figure_torque(model: ModelResult) -> str:
    """Draw measured and predicted torque over time (the paper's figure 2), the residual below.

    Long records are drawn as the envelope of their minima and maxima, so that peaks survive.
    """

    def draw(figure: Figure) -> None:
        trace = model.trace
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[3, 1])
        # Wide and light, or a good prediction would hide it.
        _line(upper, trace.time_s, trace.measured, color=UNDERNEATH, linewidth=3.2, label="measured")
        _line(upper, trace.time_s, trace.predicted, color=PREDICTED, linewidth=0.9, label="predicted")
        residual = trace.measured - trace.predicted
        _line(lower, trace.time_s, residual, color=RESIDUAL, linewidth=0.9, label="residual")
        upper.set_ylabel(f"motor {quantity(trace.unit)} ({trace.unit})")
        lower.set_ylabel(f"residual ({trace.unit})")
        lower.set_xlabel("time (s)")
        lower.axhline(0.0, color=MEASURED, linewidth=0.6)
        upper.margins(x=0.01)
        legend(upper, columns=2)

    return _svg(draw, f"Measured and predicted motor {quantity(model.trace.unit)}, model {model.id}", 5.4)


def figure_filter(model: ModelResult) -> str:
    """Draw the magnitude of the filter chain common to all columns, with the band that is used."""

    def draw(figure: Figure) -> None:
        pipeline = model.pipeline
        axes = figure.subplots()
        frequency, magnitude = _positive(pipeline.magnitude_hz, pipeline.magnitude)
        floor = 10.0 ** (_FLOOR_DB / 20.0)
        decibel = 20.0 * np.log10(np.clip(np.abs(magnitude), floor, None))
        axes.set_xscale("log")
        _line(axes, frequency, decibel, logarithmic=True, color=MEASURED, linewidth=1.6, label="filters")
        axes.set_ylim(_LOWEST_DB, max(6.0, float(np.max(decibel, initial=0.0)) + 3.0))
        axes.set_ylabel("magnitude (dB)")
        _frequency_axis(axes, pipeline, frequency)
        legend(axes, columns=3)

    return _svg(draw, f"Magnitude of the filter chain, model {model.id}", 3.9)


def figure_spectrum(model: ModelResult) -> str:
    """Draw the amplitude spectrum of the unfiltered torque with the band that is used."""

    def draw(figure: Figure) -> None:
        spectrum = model.spectrum
        axes = figure.subplots()
        frequency, density = _positive(spectrum.frequency_hz, np.abs(spectrum.density))
        axes.set_xscale("log")
        top = float(np.max(density, initial=0.0))
        if top > 0.0:
            axes.set_yscale("log")
            density = np.clip(density, top * 10.0**-_DECADES, None)
        _line(axes, frequency, density, color=MEASURED, linewidth=1.2, label="measured", logarithmic=True)
        axes.set_ylabel(f"{quantity(model.trace.unit)} density ({spectrum.unit})")
        _frequency_axis(axes, model.pipeline, frequency)
        legend(axes, columns=3)

    return _svg(draw, f"Amplitude spectrum of the motor {quantity(model.trace.unit)}, model {model.id}", 3.9)


def diagnosis_figures(diagnosis: Diagnosis) -> dict[str, str]:
    """Return every figure of a diagnosis as SVG text, by the keys of `diagnosis_words.captions`."""
    from flexid_cli.report.locality_figures import locality_figures

    figures: dict[str, str] = {}
    if diagnosis.traces is not None and diagnosis.traces.before:
        marks = diagnosis.locality if tells(diagnosis.verdict) else None
        figures[RESIDUAL_FIGURE] = figure_residual(diagnosis.traces, marks)
    for k, one in enumerate(diagnosis.maps):
        figures[map_key(k)] = figure_map(one)
    if diagnosis.location is not None and diagnosis.location.shape is not None:
        figures[SHAPE_FIGURE] = figure_shape(diagnosis.location)
    if diagnosis.locality is not None and tells(diagnosis.verdict):
        figures |= locality_figures(diagnosis.locality)
    return figures


def figure_residual(traces: Traces, found: Locality | None = None) -> str:
    """Draw the residual of each equation over time, before and after; the same scale for both.

    Where nothing changed there is one line. Changes and isolated events are marked.
    """
    changed = any(not np.array_equal(a, traces.after.get(e, a)) for e, a in traces.before.items())

    def draw(figure: Figure) -> None:
        rows = figure.subplots(len(traces.before), 1, sharex=True, squeeze=False)[:, 0]
        for axes, (equation, before) in zip(rows, traces.before.items(), strict=True):
            if changed:
                # Light, or what is left would hide behind what was there.
                _line(axes, traces.time_s, before, color=UNDERNEATH, linewidth=1.4, label="before")
            after = traces.after.get(equation, before)
            label = "after" if changed else "residual"
            _line(axes, traces.time_s, after, color=RESIDUAL, linewidth=0.9, label=label)
            axes.set_ylabel(f"{phrase(equation)} ({traces.unit})")
            axes.margins(x=0.01)
            _mark(axes, equation, found)
        rows[-1].set_xlabel("time (s)")
        legend(rows[0], columns=4)

    title = f"Residual of each equation{' before and after' if changed else ''}"
    return _svg(draw, title, 1.6 + 1.9 * len(traces.before))


def _mark(axes: Axes, equation: str, found: Locality | None) -> None:
    """Mark changes in every equation, and events in their own."""
    for k, change in enumerate(() if found is None else found.changes):
        label = "change" if k == 0 else None
        axes.axvline(change.time_s, color=RESONANCE, linestyle="--", linewidth=1.2, label=label)
    own = [] if found is None else [e for e in found.events if e.equation == equation]
    for k, event in enumerate(own):
        label = "event" if k == 0 else None
        axes.axvspan(event.start_s, event.end_s, color=PREDICTED, alpha=0.25, linewidth=0.0, label=label)


def figure_map(one: ResidualMap) -> str:
    """Draw the mean residual over a variable, before and after, about the band in which it is no residual."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        label = "95 % band of no difference"
        axes.fill_between(one.x, -one.band, one.band, color=BAND, alpha=0.3, linewidth=0.0, label=label)
        axes.axhline(0.0, color=MEASURED, linewidth=0.6)
        axes.plot(
            one.x, one.before, color=PREDICTED, marker="o", markersize=3.5, linewidth=1.2, label="before"
        )
        axes.plot(one.x, one.after, color=RESIDUAL, marker="s", markersize=3.5, linewidth=1.2, label="after")
        axes.set_xlabel(labelled(phrase(one.variable), one.x_unit))
        axes.set_ylabel(f"mean residual ({one.unit})")
        legend(axes, columns=3)

    title = f"Residual of the {phrase(one.equation)} equation over {phrase(one.variable)}"
    return _svg(draw, title, 3.9)


def figure_shape(where: Where) -> str:
    """Draw what stays unexplained over the variable that it was located in, with its band."""
    shape = where.shape

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        if shape is None:
            return
        axes.fill_between(
            shape.x, shape.low, shape.high, color=BAND, alpha=0.3, linewidth=0.0, label="95 % band"
        )
        axes.axhline(0.0, color=MEASURED, linewidth=0.6)
        axes.plot(shape.x, shape.y, color=PREDICTED, marker="o", markersize=3.5, linewidth=1.2, label="mean")
        axes.set_xlabel(labelled(phrase(where.variable), shape.x_unit))
        axes.set_ylabel(f"unexplained ({shape.unit})")
        legend(axes, columns=2)

    return _svg(draw, f"What stays unexplained, {phrase(where.equation)} equation", 3.9)


def _line(axes: Axes, x: Array, y: Array, *, logarithmic: bool = False, **appearance: Any) -> None:
    """Draw a line of at most a few thousand points, interrupted at gaps."""
    if x.size == 0:
        axes.text(0.5, 0.5, "no data", transform=axes.transAxes, ha="center", va="center")
        return
    if logarithmic:
        parts = [_envelope(x, y, _log_edges(x))]
    else:
        parts = [_envelope(x[p], y[p], _even_edges(x[p].size, x.size)) for p in _pieces(x)]
    axes.plot(_joined([px for px, _ in parts]), _joined([py for _, py in parts]), **appearance)


def _pieces(x: Array) -> list[slice]:
    """Stretches of ``x`` without a step much longer than the usual one."""
    steps = np.diff(x)
    usual = float(np.median(steps)) if steps.size else 0.0
    breaks = np.flatnonzero(steps > _GAP_PERIODS * usual) + 1 if usual > 0.0 else np.array([], dtype=np.intp)
    edges = [0, *(int(b) for b in breaks), x.size]
    return [slice(a, b) for a, b in pairwise(edges)]


def _even_edges(size: int, total: int) -> NDArray[np.intp]:
    """Edges of bins of equal count; a piece gets its share of the bins of the whole record."""
    share = min(size, max(1, round(_BINS * size / total)))
    return np.unique(np.linspace(0, size, share + 1).astype(np.intp))


def _log_edges(x: Array) -> NDArray[np.intp]:
    """Edges of bins of equal width on a logarithmic axis, where most samples crowd at the right end."""
    marks = np.geomspace(x[0], x[-1], _BINS + 1)[1:-1] if x[-1] > x[0] else np.array([])
    return np.unique(np.concatenate([[0], np.searchsorted(x, marks), [x.size]]).astype(np.intp))


def _envelope(x: Array, y: Array, edges: NDArray[np.intp]) -> tuple[Array, Array]:
    """Keep the smallest and the largest sample of each bin, in the order they were measured."""
    kept: set[int] = set()
    for start, stop in pairwise(edges):
        part = y[start:stop]
        kept.update((int(start + np.argmin(part)), int(start + np.argmax(part))))
    kept.update((0, x.size - 1))
    index = np.array(sorted(kept), dtype=np.intp)
    return x[index], y[index]


def _joined(parts: Sequence[Array]) -> Array:
    """Concatenate with a NaN between parts, at which matplotlib lifts the pen."""
    separated = [piece for part in parts for piece in (part, np.array([np.nan]))]
    return np.concatenate(separated[:-1])


def _positive(frequency: Array, values: Array) -> tuple[Array, Array]:
    """Leave out frequency zero, which a logarithmic axis cannot show, and what is not a number."""
    shown = (frequency > 0.0) & np.isfinite(frequency) & np.isfinite(values)
    return frequency[shown], values[shown]


def _frequency_axis(axes: Axes, pipeline: PipelineSummary, frequency: Array) -> None:
    """Label the frequency axis, shade the effective band and mark the first resonance."""
    axes.set_xlabel("frequency (Hz)")
    axes.xaxis.set_major_formatter("{x:g}")
    if frequency.size == 0:
        return
    low, high = pipeline.effective_band_hz
    low = max(low, float(frequency[0]))
    if np.isfinite(high) and high > low:
        label = f"band used, up to {format_significant(high, 3)} Hz"
        axes.axvspan(low, high, color=BAND, alpha=0.3, linewidth=0.0, label=label)
    f1 = pipeline.f1_hz
    if f1 is not None and np.isfinite(f1) and f1 > 0.0:
        label = f"first resonance f1, {format_significant(f1, 3)} Hz"
        axes.axvline(f1, color=RESONANCE, linestyle="--", linewidth=1.2, label=label)
    axes.set_xlim(float(frequency[0]), float(frequency[-1]) if frequency[-1] > frequency[0] else None)
