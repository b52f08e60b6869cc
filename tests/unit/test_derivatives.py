"""Derivative stencils against analytic derivatives, the paper's eq. (24), and exact polynomial weights."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from flexid_cli.errors import UsageError
from flexid_cli.pipeline import derivatives

PERIOD = 0.004
ORDERS = (1, 2, 3, 4)


def inner(x: np.ndarray, kind: str, order: int, half_width: int) -> np.ndarray:
    reach = derivatives.reach(kind, order, half_width)
    return x[reach : x.size - reach]


def analytic(order: int, w: float, time: np.ndarray) -> np.ndarray:
    """Derivative of sin(w t + 0.3)."""
    return w**order * np.sin(w * time + 0.3 + 0.5 * np.pi * order)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("band", [0.01, 0.05, 0.12, 0.2, 0.3])
def test_exact_derivative_of_a_sine_is_right_to_the_tolerance(order: int, band: float):
    half_width = derivatives.half_width_for(band)
    time = np.arange(600) * PERIOD
    for fraction in (0.2, 0.7, 1.0):
        w = 2.0 * np.pi * fraction * band / PERIOD
        d = derivatives.differentiate(np.sin(w * time + 0.3), order, PERIOD, half_width=half_width)
        error = inner(d - analytic(order, w, time), "exact", order, half_width)
        # Rounding of samples of size one grows with each division by the period.
        rounding = 20.0 * np.finfo(float).eps * (4.0 / PERIOD) ** order
        # The second derivative errs by up to 1e-6, so the fourth by twice that; the first errs a few times more
        # than the second on the same points.
        first = abs(
            derivatives.response("exact", 1, 2.0 * np.pi * band, half_width) / (2.0 * np.pi * band) - 1.0
        )
        tolerance = (order // 2) * 1e-6 + (order % 2) * first
        assert np.abs(error).max() < 1.01 * tolerance * w**order + rounding


@pytest.mark.parametrize("band", [0.01, 0.05, 0.12, 0.2, 0.3])
def test_first_derivative_keeps_nearly_the_accuracy_of_the_second(band: float):
    """Fornberg's remainders of first and second derivative differ by a factor of about p."""
    p = derivatives.half_width_for(band)
    w = 2.0 * np.pi * band
    assert abs(derivatives.response("exact", 1, w, p) / w - 1.0) < 2.0 * (p + 1) * 1e-6


@pytest.mark.parametrize("half_width", [2, 3, 7, 20])
@pytest.mark.parametrize("order", [1, 2])
def test_stencils_are_exact_on_polynomials(order: int, half_width: int):
    """On 2p + 1 points polynomials up to degree 2p are differentiated exactly."""
    span = 2 * half_width + 1
    impulse = np.zeros(2 * span + 1)
    impulse[span] = 1.0
    # The response to an impulse holds the weights from future to past.
    weights = derivatives.differentiate(impulse, order, 1.0, half_width=half_width)[::-1]
    points = np.arange(-span, span + 1)
    for degree in range(min(2 * half_width, 12) + 1):
        exact = {1: 1.0 if degree == 1 else 0.0, 2: 2.0 if degree == 2 else 0.0}[order]
        terms = weights * points.astype(float) ** degree
        assert abs(terms.sum() - exact) <= 64 * np.finfo(float).eps * max(np.abs(terms).sum(), 1.0)


def test_maximally_flat_weights_are_the_known_fractions():
    """Fornberg (1988), Table 1: second and first derivative, sixth order."""
    impulse = np.zeros(15)
    impulse[7] = 1.0
    first = derivatives.differentiate(impulse, 1, 1.0, half_width=3)[4:11][::-1]
    second = derivatives.differentiate(impulse, 2, 1.0, half_width=3)[4:11][::-1]
    known_first = [Fraction(*f) for f in ((-1, 60), (3, 20), (-3, 4), (0, 1), (3, 4), (-3, 20), (1, 60))]
    known_second = [Fraction(*f) for f in ((1, 90), (-3, 20), (3, 2), (-49, 18), (3, 2), (-3, 20), (1, 90))]
    np.testing.assert_allclose(first, [float(f) for f in known_first], atol=1e-15)
    np.testing.assert_allclose(second, [float(f) for f in known_second], atol=1e-14)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("band", [0.02, 0.1, 0.2])
def test_central_difference_has_the_magnitude_of_equation_24(order: int, band: float):
    w = 2.0 * np.pi * band / PERIOD
    time = np.arange(400) * PERIOD
    d = derivatives.differentiate(np.sin(w * time + 0.3), order, PERIOD, kind="central")
    expected = analytic(order, w, time) * (np.sin(w * PERIOD) / (w * PERIOD)) ** order
    error = inner(d - expected, "central", order, 1)
    # The argument of the sine carries a rounding of its own size; a difference divides it by the period.
    rounding = 4.0 * np.finfo(float).eps * (w * time[-1] + 1.0)
    assert np.abs(error).max() < rounding * (1.0 / PERIOD) ** order


def test_central_difference_of_a_ramp_is_its_slope_as_in_equation_22():
    x = np.arange(20.0) * 3.0 + 1.0
    np.testing.assert_allclose(derivatives.differentiate(x, 1, 0.5, kind="central")[1:-1], 6.0)


@pytest.mark.parametrize("kind", ["exact", "central"])
@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("half_width", [2, 5])
def test_reach_is_exactly_the_samples_that_an_edge_spoils(kind: str, order: int, half_width: int):
    """A change outside the record changes the ``reach`` outermost samples and no other."""
    rng = np.random.default_rng(1)
    long = rng.standard_normal(120)
    cut = long[30:90]
    reach = derivatives.reach(kind, order, half_width)
    of_long = derivatives.differentiate(long, order, 1.0, kind=kind, half_width=half_width)[30:90]
    of_cut = derivatives.differentiate(cut, order, 1.0, kind=kind, half_width=half_width)
    wrong = np.flatnonzero(np.abs(of_long - of_cut) > 1e-9)
    assert set(wrong) <= {*range(reach), *range(60 - reach, 60)}
    assert reach - 1 in wrong
    assert 60 - reach in wrong


@pytest.mark.parametrize("kind", ["exact", "central"])
@pytest.mark.parametrize("order", ORDERS)
def test_reversed_time_changes_the_sign_of_odd_derivatives_only(kind: str, order: int):
    x = np.random.default_rng(2).standard_normal(200)
    forward = derivatives.differentiate(x, order, PERIOD, kind=kind, half_width=6)
    backward = derivatives.differentiate(x[::-1], order, PERIOD, kind=kind, half_width=6)[::-1]
    scale = np.abs(forward).max()
    np.testing.assert_allclose(backward, (-1.0) ** order * forward, atol=1e-12 * scale)


@pytest.mark.parametrize("kind", ["exact", "central"])
@pytest.mark.parametrize("order", ORDERS)
def test_response_is_what_differentiate_does_to_a_wave(kind: str, order: int):
    w = 0.9
    n = np.arange(300)
    wave = np.exp(1j * w * n)
    parts = [
        derivatives.differentiate(x, order, 1.0, kind=kind, half_width=6) for x in (wave.real, wave.imag)
    ]
    gain = (parts[0] + 1j * parts[1])[150] / wave[150]
    expected = derivatives.response(kind, order, w, 6) * (1j if order % 2 else 1.0)
    assert abs(gain - expected) < 1e-11


def test_order_zero_is_the_signal_and_higher_orders_are_refused():
    x = np.arange(5.0)
    assert derivatives.differentiate(x, 0, 1.0) is x
    for order in (-1, 5):
        with pytest.raises(UsageError, match="order"):
            derivatives.differentiate(x, order, 1.0)


def test_a_band_too_near_to_nyquist_is_refused_with_a_cure():
    with pytest.raises(UsageError) as caught:
        derivatives.half_width_for(0.49)
    assert caught.value.hint


def test_half_width_is_the_smallest_that_holds_the_tolerance():
    for band in (0.05, 0.2, 0.35):
        p = derivatives.half_width_for(band)
        w = 2.0 * np.pi * band
        errors = [abs(derivatives.response("exact", 2, w, k) / w**2 + 1.0) for k in (p - 1, p)]
        assert errors[1] < 1e-6
        assert p == 2 or errors[0] >= 1e-6
