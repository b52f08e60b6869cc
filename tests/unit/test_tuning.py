"""Tuning of the band-limited derivative, against the paper's numbers, scipy and the filters themselves."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq
from scipy.signal import butter, sosfiltfilt, sosfreqz

from flexid_cli.errors import UsageError
from flexid_cli.pipeline import filters
from flexid_cli.pipeline.tuning import (
    assess,
    band_edge_rad_s,
    decimated_band_hz,
    decimated_rate_hz,
    digital_distortion,
    distortion,
    lowpass_gain,
    magnitude_curves,
    tune_filter,
)

F1_HZ = 3.9
PAPER_RATE_HZ = 350.87
PAPER_FACTOR = 26

orders = st.integers(1, 12)
derivatives = st.integers(1, 4)
edges = st.floats(0.05, 0.98)
resonances = st.floats(0.05, 500.0)


@pytest.mark.parametrize(
    ("nd", "m", "wn_rad_s", "fs_hz"), [(2, 4, 181.04, 205.70), (4, 6, 168.91, 289.64)]
)  # fmt: skip
def test_numbers_of_the_paper(nd: int, m: int, wn_rad_s: float, fs_hz: float):
    tuning = tune_filter(F1_HZ, nd)
    assert tuning.m == m
    assert tuning.wn_rad_s == pytest.approx(wn_rad_s, abs=0.005)
    assert tuning.fs_hz == pytest.approx(fs_hz, abs=0.005)
    assert tuning.wc_rad_s == pytest.approx(147.03, abs=0.005)
    # The paper prints 181, 205, 169 and 289: the cutoffs rounded, the rates cut off.
    assert round(tuning.wn_rad_s) in {181, 169}
    assert math.floor(tuning.fs_hz or 0) in {205, 289}


def test_default_orders_are_the_papers():
    assert [tune_filter(F1_HZ, nd).m for nd in range(5)] == [4, 4, 4, 6, 6]


def test_band_after_the_papers_decimation():
    assert decimated_band_hz(PAPER_RATE_HZ, PAPER_FACTOR) == pytest.approx(5.398, abs=5e-4)
    assert decimated_rate_hz(PAPER_RATE_HZ, PAPER_FACTOR) == pytest.approx(13.495, abs=5e-4)


def test_band_is_that_of_the_decimation_that_the_pipeline_runs():
    """``tuning`` keeps its own copy of the number, for the filters need numpy and it does not."""
    assert decimated_band_hz(100.0, 5) == pytest.approx(filters.DECIMATION_EDGE * 10.0)
    assert decimated_band_hz(100.0, 1) == 50.0


@pytest.mark.parametrize(("nd", "m", "expected"), [(2, 4, 0.762), (4, 6, 0.797)])
def test_distortion_with_the_cutoff_that_the_paper_used(nd: int, m: int, expected: float):
    wc = tune_filter(F1_HZ, nd).wc_rad_s
    assert distortion(wc, 176.0, m, nd, 1.0 / PAPER_RATE_HZ) == pytest.approx(expected, abs=5e-4)


@settings(deadline=None)
@given(
    f1=resonances, nd=derivatives, m=orders, ac=edges, share=st.floats(0.01, 0.99), ratio=st.floats(1.0, 20.0)
)
def test_equations_hold_for_any_choice(f1: float, nd: int, m: int, ac: float, share: float, ratio: float):
    """Eqs. (26) and (27) at wc give Ac and rc back; inside the band the distortion is milder."""
    rc = ac ** (1.0 - 2.0 * share)
    tuning = tune_filter(f1, nd, m, ac, rc, ratio)
    assert tuning.fs_hz is not None
    ts = 1.0 / tuning.fs_hz
    at_edge = distortion(tuning.wc_rad_s, tuning.wn_rad_s, m, nd, ts)
    assert at_edge == pytest.approx(ac, rel=1e-12)
    lowpass = 1.0 / (1.0 + (tuning.wc_rad_s / tuning.wn_rad_s) ** (2 * m))
    derivative = np.sinc(tuning.wc_rad_s * ts / math.pi) ** nd
    assert lowpass / derivative == pytest.approx(rc, rel=1e-11)
    inside = [tuning.distortion(k / 16.0 * tuning.wc_rad_s) for k in range(17)]
    assert inside == sorted(inside, reverse=True)
    assert min(inside) >= ac * (1.0 - 1e-12)


@settings(deadline=None)
@given(nd=derivatives, m=orders, ac=edges, share=st.floats(0.05, 0.95))
def test_root_of_equation_29_against_scipy(nd: int, m: int, ac: float, share: float):
    rc = ac ** (1.0 - 2.0 * share)
    tuning = tune_filter(F1_HZ, nd, m, ac, rc)
    gain = (ac / rc) ** (1.0 / (2 * nd))
    root = brentq(lambda x: np.sinc(x) - gain, 1e-12, 1.0, xtol=1e-15, rtol=1e-14)
    assert tuning.xc == pytest.approx(root, rel=1e-9)
    assert tuning.fs_hz == pytest.approx(tuning.wc_rad_s / (math.pi * root), rel=1e-9)
    assert tuning.ts_s == pytest.approx(math.pi * root / tuning.wc_rad_s, rel=1e-9)


@pytest.mark.parametrize(("nd", "m"), [(1, 4), (2, 4), (3, 6), (4, 6)])
def test_distortion_is_that_of_the_filters_themselves(nd: int, m: int):
    """A sine through scipy's zero-phase filter and ``nd`` central differences loses what the formulae say."""
    tuning = tune_filter(F1_HZ, nd)
    rate = PAPER_RATE_HZ
    sections = butter(m, tuning.wn_rad_s / (math.pi * rate), output="sos")
    t = np.arange(6000) / rate
    middle = slice(2000, 4000)
    for w in (tuning.w1_rad_s, 0.5 * tuning.wc_rad_s, tuning.wc_rad_s, tuning.wn_rad_s):
        basis = np.stack([np.sin(w * t), np.cos(w * t)], axis=1)[middle]
        signal = sosfiltfilt(sections, np.sin(w * t))
        for _ in range(nd):
            signal = np.gradient(signal, 1.0 / rate)
        amplitude = np.hypot(*np.linalg.lstsq(basis, signal[middle], rcond=None)[0])
        measured = amplitude / w**nd
        assert measured == pytest.approx(digital_distortion(w, tuning.wn_rad_s, m, nd, 1.0 / rate), rel=1e-6)
        assert measured == pytest.approx(tuning.distortion(w, 1.0 / rate), rel=0.012)


@settings(deadline=None)
@given(m=orders, cutoff=st.floats(0.02, 0.9), position=st.floats(0.001, 0.999))
def test_digital_lowpass_against_scipy(m: int, cutoff: float, position: float):
    rate = 100.0
    w = position * math.pi * rate
    _, response = sosfreqz(butter(m, cutoff, output="sos"), worN=[w], fs=2.0 * math.pi * rate)
    expected = float(abs(response[0]) ** 2)
    assert digital_distortion(w, cutoff * math.pi * rate, m, 0, 1.0 / rate) == pytest.approx(
        expected, rel=1e-6, abs=1e-12
    )


@pytest.mark.parametrize(("w", "wn"), [(315.0, 10.0), (10.0, 315.0)])
def test_digital_filter_has_no_gain_above_nyquist(w: float, wn: float):
    with pytest.raises(ValueError, match="Nyquist"):
        digital_distortion(w, wn, 4, 2, 0.01)


@pytest.mark.parametrize("m", [1, 4, 12])
def test_lowpass_gain(m: int):
    assert lowpass_gain(0.0, 1.0, m) == 1.0
    assert lowpass_gain(1.0, 1.0, m) == 0.5
    assert lowpass_gain(3.0, 1.0, m) == pytest.approx(1.0 / (1.0 + 3.0 ** (2 * m)), rel=1e-13)
    assert lowpass_gain(1e200, 1e-100, m) == 0.0


def test_without_derivative_the_lowpass_takes_all_distortion():
    tuning = tune_filter(F1_HZ, 0)
    assert (tuning.rc, tuning.xc, tuning.fs_hz, tuning.ts_s) == (None, None, None, None)
    assert tuning.distortion(tuning.wc_rad_s) == pytest.approx(tuning.ac, rel=1e-12)
    assert tuning.wn_rad_s < tune_filter(F1_HZ, 1).wn_rad_s
    assert assess(tuning, 200.0).sampled.fs_ratio is None  # type: ignore[union-attr]


@pytest.mark.parametrize("ac", [0.2, 0.5, math.sqrt(0.5), 0.9])
@pytest.mark.parametrize("nd", [1, 4])
def test_share_outside_its_open_interval_is_refused(ac: float, nd: int):
    for rc in (ac, 1.0 / ac, 0.999 * ac, 1.001 / ac, 0.0, -1.0, math.inf, math.nan):
        with pytest.raises(UsageError, match=r"outside .* open interval \(Ac, 1/Ac\)") as caught:
            tune_filter(F1_HZ, nd, ac=ac, rc=rc)
        assert "--rc" in caught.value.hint
    for rc in (1.001 * ac, 0.999 / ac):
        assert tune_filter(F1_HZ, nd, ac=ac, rc=rc).distortion(tune_filter(F1_HZ, nd).wc_rad_s) == (
            pytest.approx(ac, rel=1e-9)
        )


@settings(deadline=None)
@given(
    ac=st.floats(1e-300, 1.0, exclude_max=True), steps=st.integers(1, 5), top=st.booleans(), nd=derivatives
)
def test_share_at_the_very_end_of_its_interval_is_solved_or_refused(
    ac: float, steps: int, top: bool, nd: int
):
    """Rounding must not turn an admissible share into a division by zero."""
    rc = 1.0 / ac if top else ac
    for _ in range(steps):
        rc = math.nextafter(rc, 0.0 if top else math.inf)
    try:
        tuning = tune_filter(F1_HZ, nd, ac=ac, rc=rc)
    except UsageError:
        return
    assert tuning.wn_rad_s > 0.0
    assert 0.0 < (tuning.xc or 0.0) < 1.0
    assert math.isfinite(tuning.fs_hz or math.nan)


@pytest.mark.parametrize(
    ("changes", "what", "option"),
    [
        ({"f1_hz": 0.0}, "f1", "--f1"),
        ({"f1_hz": -3.9}, "f1", "--f1"),
        ({"f1_hz": math.nan}, "f1", "--f1"),
        ({"f1_hz": math.inf}, "f1", "--f1"),
        ({"f1_hz": 1e308}, "f1", "--f1"),
        ({"nd": -1}, "nd is -1", "--nd"),
        ({"nd": 5}, "nd is 5", "--nd"),
        ({"nd": True}, "nd is True", "--nd"),
        ({"m": 0}, "m is 0", "--m"),
        ({"m": 13}, "m is 13", "--m"),
        ({"ac": 0.0}, "Ac = 0", "--ac"),
        ({"ac": 1.0}, "Ac = 1", "--ac"),
        ({"ac": -0.1}, "Ac = -0.1", "--ac"),
        ({"ac": math.nan}, "Ac = nan", "--ac"),
        ({"wc_ratio": 0.0}, "wc/w1", "--wc-ratio"),
        ({"wc_ratio": math.inf}, "wc/w1", "--wc-ratio"),
        ({"nd": 0, "rc": 1.0}, "nd = 0", "--rc"),
    ],
)
def test_impossible_values_are_refused_with_a_cure(changes: dict[str, float], what: str, option: str):
    with pytest.raises(UsageError, match=what) as caught:
        tune_filter(**{"f1_hz": F1_HZ, "nd": 2, **changes})  # type: ignore[arg-type]
    assert option in caught.value.hint


@pytest.mark.parametrize(
    ("fs_hz", "factor", "option"),
    [
        (None, 26, "--fs"),
        (0.0, None, "--fs"),
        (-1.0, 2, "--fs"),
        (math.nan, 2, "--fs"),
        (350.0, 0, "--decimate"),
        (350.0, -3, "--decimate"),
    ],
)
def test_impossible_rates_are_refused_with_a_cure(fs_hz: float | None, factor: int | None, option: str):
    with pytest.raises(UsageError) as caught:
        assess(tune_filter(F1_HZ, 2), fs_hz, factor)
    assert option in caught.value.hint


def codes(nd: int, fs_hz: float | None, factor: int | None = None, **changes: float) -> list[str]:
    return [doubt.code for doubt in assess(tune_filter(F1_HZ, nd, **changes), fs_hz, factor).warnings]


def test_the_papers_choice_is_limited_by_its_decimation():
    assessment = assess(tune_filter(F1_HZ, 4), PAPER_RATE_HZ, PAPER_FACTOR)
    assert assessment.effective_band_hz == pytest.approx(5.398, abs=5e-4)
    assert assessment.decimated is not None
    assert assessment.decimated.is_limit
    assert assessment.decimated.f1_ratio == pytest.approx(1.384, abs=1e-3)
    assert [doubt.code for doubt in assessment.warnings] == ["decimation_limits"]
    assert assessment.factors == (15, 35)


def test_little_decimation_leaves_the_band_to_the_filter():
    assessment = assess(tune_filter(F1_HZ, 4), PAPER_RATE_HZ, 5)
    assert assessment.decimated is not None
    assert not assessment.decimated.is_limit
    assert assessment.effective_band_hz == pytest.approx(6 * F1_HZ)
    assert [doubt.code for doubt in assessment.warnings] == ["band_too_wide"]


def test_decimation_below_the_resonance_is_the_first_doubt():
    assert codes(4, PAPER_RATE_HZ, 36) == ["resonance_removed", "decimation_limits"]
    assert codes(4, PAPER_RATE_HZ, 35) == ["decimation_limits"]


def test_decimation_that_leaves_noise_is_doubted():
    assert codes(4, PAPER_RATE_HZ, 14) == ["band_too_wide", "decimation_limits"]
    assert codes(4, PAPER_RATE_HZ, 15) == ["decimation_limits"]
    assert codes(0, PAPER_RATE_HZ, 14) == ["decimation_limits"]


def test_rate_below_the_needed_one_is_doubted():
    tuning = tune_filter(F1_HZ, 4)
    assessment = assess(tuning, 150.0)
    assert [doubt.code for doubt in assessment.warnings] == ["rate_too_low"]
    sampled = assessment.sampled
    assert sampled is not None
    assert sampled.fs_ratio == pytest.approx(150.0 / 289.638, rel=1e-5)
    assert sampled.distortion_at_wc == pytest.approx(
        distortion(tuning.wc_rad_s, tuning.wn_rad_s, 6, 4, 1 / 150)
    )
    assert sampled.distortion_at_wc < tuning.ac  # type: ignore[operator]
    assert tuning.distortion(2 * math.pi * sampled.band_hz, 1 / 150) == pytest.approx(tuning.ac, rel=1e-9)
    assert codes(4, 289.7) == []


def test_rate_far_too_low_has_no_filter():
    assessment = assess(tune_filter(F1_HZ, 4), 40.0)
    assert [doubt.code for doubt in assessment.warnings] == ["cutoff_above_nyquist", "rate_too_low"]
    assert assessment.sampled is not None
    assert assessment.sampled.distortion_at_wc is None
    assert assessment.sampled.digital_distortion_at_wc is None
    assert assessment.effective_band_hz < 20.0


@pytest.mark.parametrize(
    ("ratio", "expected"), [(1.5, ["wc_ratio"]), (2.0, []), (10.0, []), (12.0, ["wc_ratio"])]
)
def test_unusual_band_is_doubted(ratio: float, expected: list[str]):
    assert codes(2, None, wc_ratio=ratio) == expected


def test_rate_too_low_to_keep_the_resonance_offers_no_factor():
    assert assess(tune_filter(F1_HZ, 2), 9.0).factors is None


@settings(deadline=None)
@given(f1=resonances, nd=st.integers(0, 4), fs=st.floats(0.5, 1e5), factor=st.integers(1, 10_000))
def test_assessment_is_consistent(f1: float, nd: int, fs: float, factor: int):
    assessment = assess(tune_filter(f1, nd), fs, factor)
    assert assessment.sampled is not None
    assert assessment.decimated is not None
    bands = (assessment.sampled.band_hz, assessment.decimated.band_hz)
    assert assessment.effective_band_hz == min(bands)
    assert 0.0 < assessment.effective_band_hz <= 0.5 * fs
    found = {doubt.code for doubt in assessment.warnings}
    assert ("resonance_removed" in found) == (decimated_band_hz(fs, factor) < f1)
    assert ("rate_too_low" in found) == (nd > 0 and fs < assessment.tuning.fs_hz)  # type: ignore[operator]
    frequencies = [point.w_rad_s for point in assessment.points]
    assert frequencies == sorted(set(frequencies))
    assert {"f1", "wc", "wn"} <= {name for point in assessment.points for name in point.label.split(" = ")}


def test_band_edge_is_nyquist_where_nothing_falls():
    tuning = tune_filter(F1_HZ, 0)
    assert band_edge_rad_s(tuning, 1.0) == math.pi


def test_table_names_a_frequency_once():
    labels = [point.label for point in assess(tune_filter(F1_HZ, 2, wc_ratio=4.0)).points]
    assert labels == ["0.25 wc = f1", "0.5 wc = 2 f1", "0.75 wc", "wc = 4 f1", "wn"] or labels == [
        "f1 = 0.25 wc", "2 f1 = 0.5 wc", "0.75 wc", "4 f1 = wc", "wn"
    ]  # fmt: skip


def test_curves_of_figure_1():
    """The paper draws m = 2 up to a Nyquist frequency of 1000 rad/s."""
    tuning = tune_filter(F1_HZ, 1, m=2)
    curves = magnitude_curves(tuning, fs_hz=1000.0 / math.pi, count=200)
    w = np.array(curves.w_rad_s)
    assert (
        len(w)
        == len(curves.lowpass)
        == len(curves.ideal)
        == len(curves.difference)
        == len(curves.product)
        == 200
    )
    assert w[-1] == pytest.approx(999.0)
    assert np.ptp(np.diff(np.log(w))) < 1e-9
    assert curves.lowpass == pytest.approx(1.0 / (1.0 + (w / tuning.wn_rad_s) ** 4))
    assert curves.ideal == pytest.approx(w)
    assert curves.difference == pytest.approx(np.sin(w * np.pi / 1000.0) * 1000.0 / np.pi)
    assert curves.product == pytest.approx(np.array(curves.lowpass) * curves.difference)


@pytest.mark.parametrize("nd", range(5))
def test_curves_are_positive_for_logarithmic_axes(nd: int):
    curves = magnitude_curves(tune_filter(F1_HZ, nd))
    for values in (curves.lowpass, curves.ideal, curves.difference, curves.product):
        assert min(values) > 0.0
