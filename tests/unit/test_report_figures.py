"""Figures: well-formed, reproducible, small, and honest about peaks and gaps."""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree as ET

import matplotlib as mpl
import numpy as np
import pytest

from flexid_cli.estimate.result import Spectrum, Trace
from flexid_cli.report import figures

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = SimpleNamespace(**runpy.run_path(str(ROOT / "tests" / "report_examples.py")))
DRAWERS = {
    "torque": figures.figure_torque,
    "filter": figures.figure_filter,
    "spectrum": figures.figure_spectrum,
}
AGAIN = """
import runpy, sys
from types import SimpleNamespace
from flexid_cli.report.figures import figure_filter
E = SimpleNamespace(**runpy.run_path(sys.argv[1]))
sys.stdout.buffer.write(figure_filter(E.model()).encode())
"""


@pytest.mark.parametrize("kind", DRAWERS)
def test_well_formed_svg_without_date(kind):
    text = DRAWERS[kind](EXAMPLES.model())
    root = ET.fromstring(text)  # the project's own output
    assert root.tag == "{http://www.w3.org/2000/svg}svg"
    assert "dc:date" not in text
    assert "two_encoders" in text


def test_all_kinds_come_together():
    assert set(figures.model_figures(EXAMPLES.model())) == {"torque", "filter", "spectrum"}


def test_same_bytes_in_another_process():
    environment = os.environ | {"PYTHONHASHSEED": "7", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", AGAIN, str(ROOT / "tests" / "report_examples.py")]
    again = subprocess.run(command, env=environment, check=True, capture_output=True).stdout
    assert again.decode() == figures.figure_filter(EXAMPLES.model())


def test_the_users_matplotlib_settings_change_nothing():
    expected = figures.figure_spectrum(EXAMPLES.model())
    with mpl.rc_context({"lines.linewidth": 9.0, "axes.facecolor": "black", "svg.fonttype": "none"}):
        assert figures.figure_spectrum(EXAMPLES.model()) == expected


def test_pyplot_stays_out():
    code = "import sys, flexid_cli.report.write; assert not {'matplotlib', 'rich'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": str(ROOT)}, check=True)


def test_a_million_samples_stay_small_and_keep_their_peak():
    n = 1_000_000
    time = np.arange(n) / 1000.0
    measured = np.random.default_rng(3).normal(0.0, 1.0, n)
    measured[314_159] = 50.0
    model = replace(EXAMPLES.model(), trace=Trace(time, measured, np.zeros(n), "N.m"))
    assert len(figures.figure_torque(model)) < 1_000_000
    x, y = figures._envelope(time, measured, figures._even_edges(n, n))
    assert x.size <= 2 * figures._BINS + 2
    assert (y.max(), y.min()) == (50.0, measured.min())
    assert np.all(np.diff(x) > 0.0)


def test_a_long_spectrum_keeps_its_lines():
    n = 500_000
    frequency = np.linspace(0.0, 500.0, n)
    density = np.ones(n)
    density[77_777] = 30.0
    model = replace(EXAMPLES.model(), spectrum=Spectrum(frequency, density, "N.m/sqrt(Hz)"))
    assert len(figures.figure_spectrum(model)) < 500_000
    x, y = figures._envelope(frequency[1:], density[1:], figures._log_edges(frequency[1:]))
    assert x.size <= 2 * figures._BINS + 2
    assert frequency[77_777] in x
    assert y.max() == 30.0


def test_a_short_line_keeps_every_sample():
    x = np.arange(10.0)
    assert np.array_equal(figures._envelope(x, x**2, figures._even_edges(10, 10))[0], x)


def test_the_line_is_lifted_at_gaps():
    x = np.concatenate([np.arange(5.0), 100.0 + np.arange(5.0)])
    pieces = figures._pieces(x)
    assert pieces == [slice(0, 5), slice(5, 10)]
    joined = figures._joined([x[piece] for piece in pieces])
    assert np.flatnonzero(np.isnan(joined)).tolist() == [5]


@pytest.mark.parametrize("samples", [0, 1, 2])
def test_hardly_any_data_is_no_crash(samples):
    empty = EXAMPLES.model(
        trace=EXAMPLES.trace("N.m", samples),
        spectrum=EXAMPLES.spectrum("N.m", samples),
        pipeline=EXAMPLES.pipeline(magnitude_hz=np.arange(float(samples)), magnitude=np.ones(samples)),
    )
    for text in figures.model_figures(empty).values():
        ET.fromstring(text)


def test_numbers_that_are_none_are_no_crash():
    trace = EXAMPLES.trace("A")
    broken = trace.measured.copy()
    broken[::7] = np.nan
    model = EXAMPLES.model(
        unit="A",
        trace=replace(trace, measured=broken),
        spectrum=Spectrum(np.linspace(0, 10, 50), np.full(50, np.nan), "A/sqrt(Hz)"),
        pipeline=EXAMPLES.pipeline(f1_hz=None, effective_band_hz=(0.0, np.nan), magnitude=np.zeros(400)),
    )
    for text in figures.model_figures(model).values():
        ET.fromstring(text)
