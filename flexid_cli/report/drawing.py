"""The style that all figures of a report share."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito's palette, which people with any of the usual colour deficiencies can tell apart.
MEASURED = "#444444"
UNDERNEATH = "#AAAAAA"
PREDICTED = "#D55E00"
RESIDUAL = "#0072B2"
BAND = "#56B4E9"
RESONANCE = "#B3007D"
STYLE: dict[str, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 10.0,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#DDDDDD",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "legend.borderaxespad": 0.0,
    "path.simplify": True,
    "path.simplify_threshold": 0.2,
    "svg.fonttype": "path",
    "svg.hashsalt": "flexid",
}


def svg(draw: Any, title: str, height_in: float) -> str:
    """Run ``draw`` on a new figure in the project's style, whatever the user's matplotlibrc says."""
    import io

    from matplotlib import style
    from matplotlib.figure import Figure

    with style.context(["default", STYLE]):
        figure = Figure(figsize=(9.375, height_in), layout="constrained", facecolor="white")
        figure.suptitle(title, x=0.01, ha="left", fontsize=11)
        draw(figure)
        buffer = io.StringIO()
        metadata = {"Date": None, "Creator": "flexid", "Title": title}
        figure.savefig(buffer, format="svg", metadata=metadata, facecolor="white")
    return buffer.getvalue()


def legend(axes: Axes, *, columns: int) -> None:
    """Put the legend above the axes, where it covers no data."""
    if axes.get_legend_handles_labels()[1]:
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.01), ncols=columns)
