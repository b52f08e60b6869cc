"""``flexid tune-filter``: cutoff and rate of sampling of the derivatives, from the first resonance."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from flexid_cli.cli.options import (
    Console,
    example,
    force_option,
    json_option,
    pass_console,
    verbosity_options,
)
from flexid_cli.pipeline.tuning import DEFAULT_AC, DEFAULT_WC_RATIO, TuningAssessment, assess
from flexid_cli.pipeline.tuning import tune_filter as tune

WIDTH = 80
LABEL_WIDTH = 7
F1_MEANING = "free-free (coupled) resonance sqrt(K (1/Jm+1/JL))/2pi, not the locked-motor one sqrt(K/JL)/2pi"


@click.command(
    "tune-filter",
    short_help="Design the data filter and the decimation.",
    epilog=example(
        "flexid tune-filter --f1 3.9 --nd 4",
        "flexid tune-filter --f1 3.9 --nd 2 --fs 350.87 --decimate 26",
    ),
)
@click.option(
    "--f1",
    "f1_hz",
    type=float,
    required=True,
    metavar="HZ",
    help="First resonance with both sides free (the coupled one, sqrt(K (1/Jm + 1/JL)) / 2 pi), "
    "not the lower one seen with the motor locked.",
)
@click.option(
    "--nd",
    type=int,
    required=True,
    metavar="N",
    help="Highest order of derivative, 0 to 4: 2 with both encoders, 4 from the motor alone.",
)
@click.option(
    "--m",
    type=int,
    metavar="N",
    help="Order of one pass of the Butterworth filter, which runs forward and backward "
    "(default: 4 up to nd = 2, else 6).",
)
@click.option(
    "--ac",
    type=float,
    default=DEFAULT_AC,
    metavar="GAIN",
    help="Distortion allowed at the edge wc of the band: inside it A(w) >= Ac (default: 0.7071, -3 dB).",
)
@click.option(
    "--rc",
    type=float,
    metavar="RATIO",
    help="Gain of the low-pass over gain of the derivative at wc, between Ac and 1/Ac (default: 1).",
)
@click.option(
    "--wc-ratio",
    type=float,
    default=DEFAULT_WC_RATIO,
    show_default=True,
    metavar="RATIO",
    help="wc over the resonance; usually 2 to 10.",
)
@click.option(
    "--fs", "fs_hz", type=float, metavar="HZ", help="Rate of the log, to compare with the needed one."
)
@click.option(
    "--decimate",
    "factor",
    type=int,
    metavar="ND",
    help="Factor of the parallel decimation (the paper's Nd), to see the band that it leaves; needs --fs.",
)
@click.option(
    "--plot",
    type=click.Path(path_type=Path),
    metavar="FILE.svg",
    help="Draw the filters' magnitudes (the paper's figure 1).",
)
@force_option
@json_option
@verbosity_options
@pass_console
def tune_filter(
    console: Console,
    f1_hz: float,
    nd: int,
    m: int | None,
    ac: float,
    rc: float | None,
    wc_ratio: float,
    fs_hz: float | None,
    factor: int | None,
    plot: Path | None,
    force: bool,
    as_json: bool,
) -> None:
    """Tune low-pass and central differences for derivatives of order ND.

    From the first resonance f1, by eqs. (25)-(29) of Pham, Gautier, Poignet (ICRA 2001): the Butterworth
    cutoff wn and the lowest sampling rate Fs with which the derivatives keep at least Ac of their magnitude
    up to wc. With --fs and --decimate also what a log of that rate gives, and the band that is left.

    f1 is the free-free (coupled) resonance, where the motor turns too: the peak of the response from torque
    to motor velocity, not the dip before it, which is the locked-motor resonance.
    """
    assessment = assess(tune(f1_hz, nd, m, ac, rc, wc_ratio), fs_hz, factor)
    if plot is not None:
        _write_plot(plot, assessment, console, force=force)
    if as_json:
        import json

        click.echo(json.dumps(_document(assessment), indent=2, allow_nan=False))
    else:
        click.echo("\n".join(_text(assessment)))


def _write_plot(path: Path, assessment: TuningAssessment, console: Console, *, force: bool) -> None:
    from flexid_cli.cli.files import check_outputs, write_text_atomic
    from flexid_cli.errors import UsageError
    from flexid_cli.pipeline.tuning import magnitude_curves

    if path.suffix.lower() != ".svg":
        raise UsageError(f"--plot writes SVG, and {path} does not end in .svg", "name the file FILE.svg")
    check_outputs([path], force=force)
    from flexid_cli.report.tuning_figure import draw_tuning

    rate = None if assessment.sampled is None else assessment.sampled.fs_hz
    curves = magnitude_curves(assessment.tuning, rate)
    write_text_atomic(path, draw_tuning(assessment, curves), force=force)
    console.info(f"wrote {path}")


def _document(assessment: TuningAssessment) -> dict[str, Any]:
    """Everything that the text says, in SI and with full precision."""
    from flexid_cli import __version__

    tuning, sampled, decimated = assessment.tuning, assessment.sampled, assessment.decimated
    return {
        "schema": "flexid-tune-filter/1",
        "tool": {"name": "flexid", "version": __version__},
        "f1_meaning": F1_MEANING,
        "filter": {
            "f1_hz": tuning.f1_hz,
            "nd": tuning.nd,
            "m": tuning.m,
            "ac": tuning.ac,
            "rc": tuning.rc,
            "wc_ratio": tuning.wc_ratio,
            "wc_rad_s": tuning.wc_rad_s,
            "wc_hz": tuning.wc_hz,
            "wn_rad_s": tuning.wn_rad_s,
            "wn_hz": tuning.wn_hz,
            "xc": tuning.xc,
            "fs_hz": tuning.fs_hz,
            "ts_s": tuning.ts_s,
        },
        "sampled": None
        if sampled is None
        else {
            "fs_hz": sampled.fs_hz,
            "fs_ratio": sampled.fs_ratio,
            "distortion_at_wc": sampled.distortion_at_wc,
            "digital_distortion_at_wc": sampled.digital_distortion_at_wc,
            "band_hz": sampled.band_hz,
            "decimation_factors": assessment.factors,
        },
        "decimated": None
        if decimated is None
        else {
            "factor": decimated.factor,
            "fs_hz": decimated.fs_hz,
            "band_hz": decimated.band_hz,
            "f1_ratio": decimated.f1_ratio,
            "is_limit": decimated.is_limit,
        },
        "effective_band_hz": assessment.effective_band_hz,
        "distortion": [
            {
                "label": point.label,
                "w_rad_s": point.w_rad_s,
                "frequency_hz": point.frequency_hz,
                "tuned": point.tuned,
                "sampled": point.sampled,
                "digital": point.digital,
            }
            for point in assessment.points
        ],
        "warnings": [{"code": doubt.code, "message": doubt.message} for doubt in assessment.warnings],
    }


def _text(assessment: TuningAssessment) -> list[str]:
    lines = _filter_lines(assessment)
    if assessment.sampled is not None:
        lines += ["", *_sampled_lines(assessment)]
    lines += ["", *_table_lines(assessment)]
    for doubt in assessment.warnings:
        lines += ["", *_wrap("warning: " + doubt.message, 2)]
    return lines


def _filter_lines(assessment: TuningAssessment) -> list[str]:
    tuning = assessment.tuning
    what = f"Filter for derivatives up to order nd = {tuning.nd}" if tuning.nd else "Low-pass alone, nd = 0"
    lines = [f"{what} (Pham et al., ICRA 2001, eqs. 25-29)", ""]
    lines += _entry("f1", f"{tuning.f1_hz:g} Hz", F1_MEANING)
    lines += _entry(
        "wc",
        f"{_number(tuning.wc_rad_s)} rad/s",
        f"{_number(tuning.wc_hz)} Hz = {tuning.wc_ratio:g} f1; A(w) >= Ac = {tuning.ac:.6g} up to here",
    )
    lines += _entry(
        "wn",
        f"{_number(tuning.wn_rad_s)} rad/s",
        f"{_number(tuning.wn_hz)} Hz; Butterworth cutoff (-6 dB, two passes)",
    )
    lines += _entry("m", f"{tuning.m}", "order of one Butterworth pass")
    if tuning.rc is None or tuning.fs_hz is None or tuning.ts_s is None:
        return [*lines, *_entry("Fs", "any", "no derivative asks for a rate; stay above 2 wn")]
    lines += _entry("rc", f"{tuning.rc:g}", "low-pass gain over derivative gain at wc")
    return lines + _entry(
        "Fs",
        f"{_number(tuning.fs_hz)} Hz",
        f"lowest sampling rate (Ts = {_number(1e3 * tuning.ts_s)} ms)",
    )


def _sampled_lines(assessment: TuningAssessment) -> list[str]:
    sampled, decimated = assessment.sampled, assessment.decimated
    if sampled is None:
        return []
    ratio = "" if sampled.fs_ratio is None else f"{sampled.fs_ratio:.4g} Fs; "
    at_wc = "wc is not below the Nyquist frequency"
    if sampled.distortion_at_wc is not None:
        at_wc = f"A(wc) = {sampled.distortion_at_wc:.4f}"
    lines = _entry("fs", f"{sampled.fs_hz:g} Hz", f"rate of the log; {ratio}{at_wc}")
    if decimated is not None:
        lines += _entry("Nd", f"{decimated.factor}", f"decimation; new rate {_number(decimated.fs_hz)} Hz")
        edge = "the Nyquist frequency" if decimated.factor == 1 else "0.8 of the new Nyquist frequency"
        lines += _entry(
            "", f"{_number(decimated.band_hz)} Hz", f"its band, {edge} = {decimated.f1_ratio:.4g} f1"
        )
    elif assessment.factors is not None:
        low, high = assessment.factors
        span = f"{low} to {high}" if low <= high else f"{high}"
        lines += _entry("Nd", span, "decimation that keeps f1 and little above it")
    cause = "limited by the decimation" if decimated is not None and decimated.is_limit else "limited by A(w)"
    return lines + _entry("band", f"{_number(assessment.effective_band_hz)} Hz", f"effective band; {cause}")


def _table_lines(assessment: TuningAssessment) -> list[str]:
    """A(w): by eq. (26) as tuned; at the log's rate; and there with the digital filter's warp."""
    rate = assessment.sampled
    tuned = "at Fs" if assessment.tuning.nd else "low-pass"
    header = f"  {'A(w) at':<14}{'Hz':>10}{'rad/s':>11}{tuned:>10}"
    if rate is not None:
        header += f"{f'at {rate.fs_hz:g} Hz':>16}{'digital':>10}"
    lines = [header]
    for point in assessment.points:
        line = f"  {point.label:<14}{_number(point.frequency_hz):>10}{_number(point.w_rad_s):>11}"
        line += f"{point.tuned:>10.4f}"
        if rate is not None:
            line += f"{_gain(point.sampled):>16}{_gain(point.digital):>10}"
        lines.append(line)
    return lines


def _gain(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"


def _number(value: float) -> str:
    """Five significant digits, those of the paper and one more."""
    return f"{value:#.5g}".rstrip(".")


def _entry(label: str, value: str, remark: str) -> list[str]:
    return _wrap(f"  {label:<{LABEL_WIDTH}}{value:<16}{remark}", 2 + LABEL_WIDTH + 16)


def _wrap(text: str, indent: int) -> list[str]:
    """Break a line at 80 columns without touching the spaces that align it."""
    lines = []
    while len(text) > WIDTH and (cut := text.rfind(" ", indent + 1, WIDTH + 1)) > 0:
        lines.append(text[:cut].rstrip())
        text = " " * indent + text[cut + 1 :].lstrip()
    return [*lines, text]
