"""The paper's figure 1 for a tuned filter: magnitudes of the low-pass, the derivatives and their product."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from flexid_cli.pipeline.tuning import MagnitudeCurves, TuningAssessment

SIZE_INCHES = (8.0, 5.4)
# Okabe and Ito's palette, which colour-blind readers can tell apart; line styles differ too.
BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#555555"


def draw_tuning(assessment: TuningAssessment, curves: MagnitudeCurves) -> str:
    """Draw the filters' magnitudes over angular frequency, both axes logarithmic.

    Parameters
    ----------
    assessment : TuningAssessment
        The filter, and the rate and the decimation that it is seen with.
    curves : MagnitudeCurves
        What to draw.

    Returns
    -------
    str
        An SVG document; the same input gives the same bytes.
    """
    import io

    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context():
        # A reader's own matplotlibrc must not change the bytes.
        mpl.rcdefaults()
        mpl.rcParams.update({"svg.hashsalt": "flexid", "svg.fonttype": "path", "font.size": 10.0})
        figure = Figure(figsize=SIZE_INCHES, layout="constrained")
        axes = figure.add_subplot()
        _draw_curves(axes, curves, assessment.tuning.nd)
        _draw_marks(axes, assessment, curves.w_rad_s[-1])
        _label(axes, assessment, curves)
        stream = io.StringIO()
        figure.savefig(stream, format="svg", metadata={"Date": None, "Title": _title(assessment)})
    return stream.getvalue()


def _draw_curves(axes: Axes, curves: MagnitudeCurves, nd: int) -> None:
    w = curves.w_rad_s
    axes.loglog(w, curves.lowpass, color=ORANGE, linestyle="--", label="low-pass |H| (forward and backward)")
    if nd == 0:
        return
    power = "" if nd == 1 else f"^{nd}"
    axes.loglog(w, curves.ideal, color=GREY, linestyle=":", label=f"ideal derivative w{power}")
    axes.loglog(w, curves.difference, color=GREEN, linestyle="-.", label=f"central difference |D|{power}")
    axes.loglog(w, curves.product, color=BLUE, linewidth=2.2, label=f"band-limited derivative |H| |D|{power}")


def _draw_marks(axes: Axes, assessment: TuningAssessment, highest: float) -> None:
    """Vertical lines up to the highest frequency drawn, each named at the top of the axes."""
    from math import pi

    tuning = assessment.tuning
    marks = [(tuning.w1_rad_s, "w1"), (tuning.wc_rad_s, "wc"), (tuning.wn_rad_s, "wn")]
    if assessment.decimated is not None:
        edge = 2.0 * pi * assessment.effective_band_hz
        axes.axvspan(axes.get_xlim()[0], edge, color=BLUE, alpha=0.08, linewidth=0)
        if assessment.decimated.is_limit:
            marks.append((edge, "band"))
    previous, level = 0.0, 0
    for w, name in sorted(mark for mark in marks if mark[0] <= highest):
        # Neighbours closer than a name is wide take turns between two heights.
        level = 1 - level if w < 1.35 * previous else 0
        axes.axvline(w, color=GREY, linewidth=0.8, alpha=0.7)
        axes.annotate(
            name,
            (w, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0, 3 + 11 * level),
            textcoords="offset points",
            ha="center",
            va="bottom",
            fontsize=9,
            color=GREY,
        )
        previous = w


def _label(axes: Axes, assessment: TuningAssessment, curves: MagnitudeCurves) -> None:
    nd = assessment.tuning.nd
    axes.set_title(_title(assessment), pad=28, fontsize=10)
    axes.set_xlabel("angular frequency w (rad/s), up to the Nyquist frequency")
    axes.set_ylabel(
        "magnitude (1 for |H|"
        + ("" if nd == 0 else f", (rad/s){'' if nd == 1 else f'^{nd}'} for derivatives")
        + ")"
    )
    axes.set_xlim(curves.w_rad_s[0], curves.w_rad_s[-1])
    axes.set_ylim(min(1e-3, 0.3 * curves.product[0]), 5.0 * max(1.0, *curves.ideal))
    axes.grid(visible=True, which="major", alpha=0.35)
    axes.legend(loc="upper left" if nd else "lower left", fontsize=9, framealpha=0.95)


def _title(assessment: TuningAssessment) -> str:
    tuning = assessment.tuning
    rate = tuning.fs_hz if assessment.sampled is None else assessment.sampled.fs_hz
    text = f"Filters for f1 = {tuning.f1_hz:g} Hz, nd = {tuning.nd}, m = {tuning.m}"
    text += f": wn = {tuning.wn_rad_s:.5g} rad/s"
    if rate is not None:
        text += f", sampled at {rate:.5g} Hz"
    if assessment.decimated is not None:
        text += f"\ndecimated by {assessment.decimated.factor}: "
        text += f"shaded band to {assessment.effective_band_hz:.4g} Hz"
    return text
