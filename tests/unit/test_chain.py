"""The chain of filters: one linear operator for every column, edges included, and rows that know their time."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from flexid_cli.errors import DataError
from flexid_cli.pipeline import derivatives
from flexid_cli.pipeline.chain import Chain, ChainSettings
from flexid_cli.pipeline.columns import Columns
from flexid_cli.signals.recording import Recording, Segment

RATE = 200.0
SETTINGS = {
    "decimated": ChainSettings(RATE, decimation=10),
    "decimated and low-passed": ChainSettings(RATE, lowpass_order=6, lowpass_cutoff_hz=35.0, decimation=8),
    "low-passed": ChainSettings(RATE, lowpass_cutoff_hz=12.0),
    "central": ChainSettings(RATE, lowpass_cutoff_hz=30.0, derivative="central", decimation=8),
    "central, untrimmed": ChainSettings(RATE, derivative="central", trim_s=0.0),
    "trim given": ChainSettings(RATE, decimation=5, trim_s=1.5),
}


@pytest.fixture(params=SETTINGS, ids=lambda name: name.replace(" ", "_"))
def chain(request: pytest.FixtureRequest) -> Chain:
    return Chain(SETTINGS[request.param])


def noise(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(n)


# --- linearity


@pytest.mark.parametrize("samples", [700, 4000])
def test_a_linear_relation_between_signals_holds_between_columns_edges_included(chain: Chain, samples: int):
    """Offsets of a thousand times the noise: what a filter that starts on the first sample would not survive."""
    x, y = 1e3 + noise(samples, 1), -2e3 + np.cumsum(noise(samples, 2))
    z = 3.0 * x - 0.25 * y + 11.0
    if chain.rows(samples) < 1:
        pytest.skip("too short for this chain")
    for order in range(5):
        one = chain.apply(np.ones(samples), order)
        columns = [chain.apply(s, order) for s in (x, y, z)]
        expected = 3.0 * columns[0] - 0.25 * columns[1] + 11.0 * one
        scale = max(float(np.abs(c).max()) for c in columns)
        # A derivative multiplies the rounding of the samples, not of the result, by (4 / Ts)^order at most.
        rounding = 1e4 * 100 * np.finfo(float).eps * (4.0 * RATE) ** order
        assert np.abs(columns[2] - expected).max() <= 1e-10 * scale + rounding


def test_an_equation_of_motion_holds_between_columns_edges_included():
    """u = 5 x'' + 2 x' + 3 x with u made by the chain's own derivative: exact to rounding in every row."""
    chain = Chain(SETTINGS["decimated"])
    samples = 3000
    time = np.arange(samples) / RATE
    x = 40.0 + np.sin(3.0 * time**1.5) + 0.01 * noise(samples)
    d = [derivatives.differentiate(x, k, 1.0 / RATE, half_width=chain.half_width) for k in (0, 1, 2)]
    u = 5.0 * d[2] + 2.0 * d[1] + 3.0 * d[0]
    left = chain.apply(u)
    right = 5.0 * chain.apply(x, 2) + 2.0 * chain.apply(x, 1) + 3.0 * chain.apply(x)
    assert left.size > 100
    np.testing.assert_allclose(left, right, atol=1e-10 * np.abs(u).max())


# --- distortion


@pytest.mark.parametrize("name", ["decimated", "decimated and low-passed", "low-passed"])
@pytest.mark.parametrize("share", [0.15, 0.6, 1.0])
def test_every_derivative_of_a_wave_is_distorted_by_the_same_magnitude(name: str, share: float):
    chain = Chain(SETTINGS[name])
    samples = 8000
    frequency = share * chain.band_hz
    w = 2.0 * np.pi * frequency
    times = chain.row_times(samples, 0.0)
    gain = chain.magnitude(np.array([frequency]))[0]
    middle = slice(times.size // 3, 2 * times.size // 3)
    wave = np.cos(w * np.arange(samples) / RATE + 0.2)
    for order in range(5):
        column = chain.apply(wave, order)
        expected = gain * w**order * np.cos(w * times + 0.2 + 0.5 * np.pi * order)
        # The derivative's own promise at the band's edge, the first and third a little less than the others.
        p = chain.half_width
        x = 2.0 * np.pi * chain.band_hz / RATE
        first = abs(derivatives.response("exact", 1, x, p) / x - 1.0)
        tolerance = (order // 2) * 1e-6 + (order % 2) * first + 1e-7
        assert np.abs(column - expected)[middle].max() < 1.1 * tolerance * gain * w**order


def test_central_differences_distort_each_derivative_differently():
    """What the exact derivative avoids: the paper's A(w) of eq. (26) differs from column to column."""
    chain = Chain(SETTINGS["central"])
    samples, frequency = 8000, 8.0
    w = 2.0 * np.pi * frequency
    wave = np.cos(w * np.arange(samples) / RATE)
    times = chain.row_times(samples, 0.0)
    middle = slice(times.size // 3, 2 * times.size // 3)
    gain = chain.magnitude(np.array([frequency]))[0]
    sinc = np.sin(w / RATE) / (w / RATE)
    for order in range(5):
        expected = gain * (w * sinc) ** order * np.cos(w * times + 0.5 * np.pi * order)
        np.testing.assert_allclose(chain.apply(wave, order)[middle], expected[middle], atol=1e-6 * w**order)


def test_frequencies_beyond_the_new_nyquist_do_not_fold_into_the_rows():
    chain = Chain(SETTINGS["decimated"])
    samples = 6000
    for frequency in (1.25 * 10.0, 20.0, 47.0):
        wave = np.cos(2.0 * np.pi * frequency * np.arange(samples) / RATE)
        rows = chain.apply(wave)
        inside = slice(rows.size // 4, 3 * rows.size // 4)
        assert np.abs(rows[inside]).max() < 1.01 * chain.magnitude(np.array([frequency]))[0] + 1e-9
        assert np.abs(rows[inside]).max() < 1e-3


# --- time of the rows


def test_a_ramp_in_time_comes_out_as_the_time_of_the_rows(chain: Chain):
    samples, start = 6000, 12.5
    ramp = start + np.arange(samples) / RATE
    rows = chain.apply(ramp)
    times = chain.row_times(samples, start)
    assert rows.shape == times.shape == (chain.rows(samples),)
    middle = slice(times.size // 3, 2 * times.size // 3)
    constant = chain.magnitude(np.array([1e-9]))[0]
    np.testing.assert_allclose(rows[middle], constant * times[middle], rtol=1e-7)
    np.testing.assert_allclose(chain.apply(ramp, 1)[middle], constant, rtol=1e-6)
    np.testing.assert_allclose(np.diff(times), chain.row_period_s)


def test_an_impulse_comes_out_largest_at_its_row_and_symmetric():
    chain = Chain(SETTINGS["decimated and low-passed"])
    samples = 4000
    margin = round(chain.row_times(samples, 0.0)[0] * RATE)
    at = margin + 8 * 150
    impulse = np.zeros(samples)
    impulse[at] = 1.0
    rows = chain.apply(impulse)
    assert int(np.argmax(rows)) == 150
    np.testing.assert_allclose(rows[151:250], rows[51:150][::-1], atol=1e-9)


def test_trim_is_what_is_asked_for_or_three_samples_a_filter_order():
    samples = 20000
    given = Chain(SETTINGS["trim given"])
    assert given.trim_samples(samples) == 300
    automatic = Chain(SETTINGS["decimated"])
    assert automatic.trim_samples(samples) == 3 * 8 * 10
    reach = derivatives.reach("exact", derivatives.MAX_ORDER, automatic.half_width)
    times = automatic.row_times(samples, 0.0)
    assert times[0] == pytest.approx((240 + reach) / RATE)
    assert times[-1] < (samples - 240 - reach) / RATE


def test_a_short_segment_is_trimmed_by_a_part_of_its_length_only():
    chain = Chain(SETTINGS["decimated"])
    assert chain.trim_samples(1000) == 80
    assert chain.rows(1000) > 0


def test_a_segment_shorter_than_the_filters_is_refused_with_a_cure(chain: Chain):
    reach = derivatives.reach(chain.settings.derivative, derivatives.MAX_ORDER, chain.half_width)
    for samples in (0, 1, 2 * reach):
        assert chain.rows(samples) == 0
        with pytest.raises(DataError) as caught:
            chain.apply(np.zeros(samples))
        assert caught.value.hint


@pytest.mark.parametrize("samples", range(20, 120, 7))
def test_rows_announced_are_rows_delivered(chain: Chain, samples: int):
    if chain.rows(samples):
        assert chain.apply(noise(samples), 4).size == chain.rows(samples)
        assert chain.row_times(samples, 0.0).size == chain.rows(samples)


# --- columns of a recording


def recording(*lengths: int) -> Recording:
    segments, start = [], 0.0
    for k, n in enumerate(lengths):
        x = np.cumsum(np.cumsum(noise(n, k))) / RATE
        segments.append(Segment(start, noise(n, 10 + k), x, x - 1e-3 * noise(n, 20 + k)))
        start += n / RATE + 3.0
    return Recording(RATE, tuple(segments))


def test_segments_are_filtered_each_for_itself_and_put_one_after_the_other():
    record = recording(3000, 2000)
    chain = Chain(SETTINGS["decimated"])
    both = Columns(record, chain, 40.0)
    assert both.lengths == (chain.rows(3000), chain.rows(2000))
    for signal, order in (("torque", 2), ("motor", 4), ("torsion", 0), ("one", 0), ("joint", 1)):
        parts = []
        for segment in record.segments:
            alone = Columns(Recording(RATE, (segment,)), chain, 40.0)
            parts.append(alone(signal, order))
        np.testing.assert_array_equal(both(signal, order), np.concatenate(parts))
    assert both.times.size == both("one", 0).size
    assert np.diff(both.times).max() > 3.0


def test_a_segment_too_short_is_left_out_of_every_column():
    chain = Chain(SETTINGS["decimated"])
    record = recording(3000, 2 * derivatives.reach("exact", 4, chain.half_width), 2000)
    columns = Columns(record, chain, 40.0)
    assert len(columns.segments) == 2
    assert columns("motor", 1).size == sum(columns.lengths) == columns.times.size


def test_signs_follow_the_width_and_are_computed_anew_when_it_changes():
    columns = Columns(recording(3000), Chain(SETTINGS["decimated"]), 40.0)
    plain = columns("sign_motor", 0).copy()
    columns.set_reversal_velocity(1e9)
    assert np.abs(columns("sign_motor", 0)).max() < 1e-6
    columns.set_reversal_velocity(None)
    np.testing.assert_array_equal(columns("sign_motor", 0), plain)


@pytest.mark.parametrize("width", [1e-9, 1e-3, 0.05])
def test_sign_is_averaged_over_the_sample_and_the_average_undone(width):
    """Against a fine sum over each sample, the velocity straight between the middles of the intervals."""
    chain = Chain(SETTINGS["decimated"])
    columns = Columns(recording(3000), chain, 40.0)
    columns.set_reversal_velocity(width)
    v = columns.motor_velocity[0]
    middle = np.concatenate([v[:1], 0.5 * (v[1:] + v[:-1]), v[-1:]])
    steps = (np.arange(4000) + 0.5) / 4000
    average = np.array([np.tanh((a + (b - a) * steps) / width).mean() for a, b in pairwise(middle)])
    expected = average.copy()
    expected[1:-1] -= np.diff(average, 2) / 24.0
    # The sum errs by half a step where a jump falls into it.
    np.testing.assert_allclose(columns("sign_motor", 0), chain.apply(expected), atol=1e-3)


def test_like_gives_the_same_columns_anew():
    columns = Columns(recording(3000, 2500), Chain(SETTINGS["decimated"]), 40.0)
    columns.set_reversal_velocity(0.02)
    columns.rebuild_joint(170.0, 200.0, 40.0, 2e4)
    other = columns.like()
    for signal in ("sign_motor", "sign_joint", "joint", "gravity_sin", "joint_centred"):
        np.testing.assert_array_equal(other(signal, 0), columns(signal, 0))
    wider = columns.like(sign_cutoff_hz=10.0)
    assert np.abs(wider("sign_joint", 0) - columns("sign_joint", 0)).max() > 1e-6


def test_gravity_columns_are_those_of_equation_7():
    record = recording(3000)
    chain = Chain(SETTINGS["decimated"])
    columns = Columns(record, chain, 40.0, gravity_m_per_s2=1.62)
    joint = record.segments[0].joint_position
    np.testing.assert_allclose(columns("gravity_cos", 0), chain.apply(1.62 * np.cos(joint)), atol=1e-12)
    np.testing.assert_allclose(columns("gravity_sin", 0), chain.apply(1.62 * np.sin(joint)), atol=1e-12)
