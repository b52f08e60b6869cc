"""Whitened rows: noise becomes white with unit variance, relations hold, and the transpose is one."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.fft import next_fast_len

from flexid_cli.diagnose.basis import solve
from flexid_cli.diagnose.problem import Problem
from flexid_cli.diagnose.rows import Taper, Weights
from flexid_cli.diagnose.search import Form
from flexid_cli.diagnose.start import _first_order
from flexid_cli.diagnose.stretch import Stretch
from flexid_cli.diagnose.torque_noise import MOST_FALL
from flexid_cli.effects.motion import Base, Terms
from flexid_cli.effects.registry import effect
from flexid_cli.estimate.budget import NoiseLevels
from flexid_cli.signals.recording import Segment

RATE, BAND, SAMPLES = 1000.0, 60.0, 16_000
BASE = Base(
    Jm=2.0, K=3000.0, JL=1.5, FVm=1.0, FSm=0.0, FV=0.4, FS=0.0, motor_reversal=0.01, load_reversal=0.01
)
LINEAR = {"Jm": BASE.Jm, "FVm": BASE.FVm, "K": BASE.K, "JL": BASE.JL, "FV": BASE.FV}
TIME = np.arange(SAMPLES) / RATE


def problem(segment: Segment, noise: NoiseLevels, shift: float = 0.0) -> Problem:
    return Problem(
        [Stretch(segment, RATE, BAND)],
        BASE,
        noise,
        BAND,
        gravity=9.81,
        gear_ratio=1.0,
        duration_s=SAMPLES / RATE,
        both=segment.joint_position is not None,
        shift=shift,
    )


def noise_only(noise: NoiseLevels, both: bool) -> Problem:
    rng = np.random.default_rng(7)
    torque, motor, joint = (
        size * rng.standard_normal(SAMPLES)
        for size in (noise.torque, noise.motor_position, noise.joint_position)
    )
    return problem(Segment(0.0, torque, motor, joint if both else None), noise)


def misfit(p: Problem) -> np.ndarray:
    """What the linear baseline leaves of both equations, shape (2, rows)."""
    columns = p.base_rows()[:, [p.names.index(name) for name in LINEAR]]
    return (p.target() - columns @ np.array(list(LINEAR.values()))).reshape(2, -1)


def smooth(seed: int) -> np.ndarray:
    """A signal well inside the band."""
    rng = np.random.default_rng(seed)
    waves = [np.sin(2.0 * np.pi * f * TIME + phase) for f, phase in rng.uniform(0.3, 30.0, (12, 2))]
    return np.asarray(rng.standard_normal(12) @ np.array(waves))


@pytest.mark.parametrize("trusted_less", [False, True])
@pytest.mark.parametrize("equations", [1, 2])
def test_back_is_the_transpose_of_apply_over_the_taper(equations, trusted_less):
    rng = np.random.default_rng(3)
    taper = Taper.of(SAMPLES, RATE, BAND, 48)
    root = rng.standard_normal((equations, equations)) + 1j * rng.standard_normal((equations, equations))
    ramp = 1.0 + taper.frequency_hz / BAND
    spectral = (root @ root.conj().T + 2.0 * np.eye(equations)) * ramp[:, None, None]
    spectral = spectral.real.astype(np.complex128)
    plain = Weights(taper, spectral)
    trust = rng.uniform(0.1, 1.0, (equations, int(plain.open.sum())))
    weights = Weights(taper, spectral, trust) if trusted_less else plain
    columns = [smooth(k) for k in range(equations)]
    rows = weights.apply([taper.spectrum(c[:, None]) for c in columns])[:, :, 0]
    other = rng.standard_normal(rows.shape)
    forth = float(np.sum(rows * other))
    back = float(np.sum(np.array(columns) * weights.back(other)))
    # Rows that count less are those of a larger noise: the likelihood's level says so.
    expected = -2.0 * np.mean(np.log(trust)) if trusted_less else 0.0
    assert weights.level - plain.level == pytest.approx(expected)
    assert back == pytest.approx(forth, abs=1e-5 * np.linalg.norm(rows) * np.linalg.norm(other))


@pytest.mark.parametrize("both", [True, False])
@pytest.mark.parametrize("equation", ["motor", "transmission", "load"])
def test_back_through_the_model_is_the_transpose_of_an_effects_rows(both, equation):
    p = noise_only(NoiseLevels(0.05, 1e-5, 2e-5), both)
    column = smooth(5)
    rows = p.effect_rows(lambda _: Terms(**{equation: column[:, None]}), np.zeros(1))[0][:, 0]
    other = np.random.default_rng(11).standard_normal(rows.size)
    (back,) = p.back(other, equation)
    assert back @ column == pytest.approx(rows @ other, abs=1e-5 * np.linalg.norm(rows) * rows.size**0.5)


# Where the torque's noise rules, where both do, and where only the encoders' is left.
@pytest.mark.parametrize("torque", [5.0, 0.05, 0.001])
def test_noise_of_all_signals_gives_white_rows_of_unit_variance(torque):
    noise = NoiseLevels(torque, 1e-5, 2e-5)
    e = misfit(noise_only(noise, both=True))
    rows = e.shape[1]
    np.testing.assert_allclose(e.std(axis=1), 1.0, atol=4.0 / np.sqrt(2.0 * rows))
    assert abs(np.corrcoef(e)[0, 1]) < 4.0 / np.sqrt(rows)
    for x in e:
        assert abs(np.corrcoef(x[1:], x[:-1])[0, 1]) < 4.0 / np.sqrt(rows)


# With no torque noise at all the taper leaks some of the encoder's, which grows with the fourth power of frequency.
@pytest.mark.parametrize("torque", [5.0, 0.05])
def test_noise_of_the_motors_signals_alone(torque):
    p = noise_only(NoiseLevels(torque, 1e-5, 0.0), both=False)
    e = p.target()
    assert e.std() == pytest.approx(1.0, abs=4.0 / np.sqrt(2.0 * e.size))


def test_a_linear_relation_holds_in_the_rows():
    """Signals that obey the equations exactly leave nothing beside their size."""
    joint, w = 1e-2 * np.sin(2.0 * np.pi * 3.0 * TIME), 2.0 * np.pi * 3.0
    rate = 1e-2 * w * np.cos(w * TIME)
    spring = BASE.JL * (-(w**2) * joint) + BASE.FV * rate
    motor = joint + spring / BASE.K
    response = (BASE.JL * -(w**2) + 1j * w * BASE.FV) / BASE.K + 1.0
    wave = 1e-2 * response * np.exp(1j * w * TIME) / 1j
    torque = (BASE.Jm * (1j * w) ** 2 * wave + BASE.FVm * 1j * w * wave).real + spring
    np.testing.assert_allclose(wave.real, motor, atol=1e-12)
    p = problem(Segment(0.0, torque, motor, joint), NoiseLevels(0.01, 1e-7, 1e-7))
    assert np.abs(misfit(p)).max() < 1e-5 * np.abs(p.target()).max()
    alone = problem(Segment(0.0, torque, motor, None), NoiseLevels(0.01, 1e-7, 0.0))
    assert np.abs(alone.target()).max() < 1e-5 * alone.signal()


def wave(sizes: dict[float, float], order: int) -> np.ndarray:
    """Derivative of a sum of sines of the given frequencies and amplitudes."""
    return np.asarray(
        sum((a * (2j * np.pi * f) ** order * np.exp(2j * np.pi * f * TIME)).imag for f, a in sizes.items())
    )


def test_a_load_torque_from_elsewhere_does_not_draw_the_stiffness_to_zero():
    """K = JL = 0 fulfils the load equation whatever it lacks; K rests on the motor equation alone."""
    joint, strange = {0.7: 3e-2, 3.0: 5e-3}, {0.41: 0.4, 1.9: 0.5}

    def spring(order: int) -> np.ndarray:
        own = BASE.JL * wave(joint, order + 2) + BASE.FV * wave(joint, order + 1)
        return own + BASE.JL * wave(strange, order)

    motor = wave(joint, 0) + spring(0) / BASE.K
    rate, acceleration = (wave(joint, k) + spring(k) / BASE.K for k in (1, 2))
    torque = BASE.Jm * acceleration + BASE.FVm * rate + spring(0)
    p = problem(Segment(0.0, torque, motor, wave(joint, 0)), NoiseLevels(0.01, 1e-7, 1e-7))
    names = ("Jm", "FVm", "K", "c", "JL", "FV")
    found = solve(p.base_rows()[:, [p.names.index(n) for n in names]], p.target())
    values = dict(zip(names, found.coefficients, strict=True))
    assert found.rms > 100.0
    assert values["K"] == pytest.approx(BASE.K, rel=5e-3)
    assert values["Jm"] == pytest.approx(BASE.Jm, rel=5e-3)


def test_the_spring_in_an_effect_of_the_transmission_is_left_to_the_stiffness():
    joint = wave({0.7: 3e-2, 3.0: 5e-3}, 0)
    motor = joint + wave({0.9: 1e-3, 4.0: 2e-4}, 0)
    p = problem(Segment(0.0, np.zeros(SAMPLES), motor, joint), NoiseLevels(0.01, 1e-7, 1e-7))
    cube = lambda m: Terms(transmission=m.deflection[:, None] ** 3)  # noqa: E731
    spring, _ = p.effect_rows(lambda m: Terms(transmission=m.deflection[:, None]), np.zeros(1))
    whole, _ = p.effect_rows(cube, np.zeros(1))
    rows, slopes = p.effect_rows(cube)
    np.testing.assert_allclose(rows + spring * slopes, whole, atol=1e-9 * np.abs(whole).max())
    assert slopes[0] == pytest.approx(3.0 * np.mean((motor - joint) ** 2), rel=0.1)
    place, none = p.effect_rows(lambda m: Terms(transmission=np.cos(m.joint_position)[:, None]))
    assert none[0] == 0.0
    assert place.any()
    nothing, stiffness = p.effect_rows(lambda m: Terms(transmission=7.0 * m.deflection[:, None]))
    assert stiffness[0] == pytest.approx(7.0)
    assert not nothing.any()


def test_a_held_torque_is_the_same_as_one_that_acts_half_a_period_later():
    """A staircase of a sine is the sine half a period late, damped by the hold."""
    w, late = 2.0 * np.pi * 20.0, 0.5 / RATE
    damping = np.sinc(20.0 / RATE)
    zero = np.zeros(SAMPLES)
    at_stamp = problem(Segment(0.0, np.sin(w * TIME), zero, zero), NoiseLevels(1.0, 1e-9, 1e-9))
    acting = problem(
        Segment(0.0, damping * np.sin(w * (TIME - late)), zero, zero), NoiseLevels(1.0, 1e-9, 1e-9)
    )
    np.testing.assert_allclose(
        at_stamp.target(shift=0.5), acting.target(), atol=2e-3 * np.ptp(acting.target())
    )
    assert np.abs(at_stamp.target() - acting.target()).max() > 0.02 * np.ptp(acting.target())


def test_the_signal_is_the_torque_over_its_noise():
    rng = np.random.default_rng(2)
    zero = np.zeros(SAMPLES)
    for size in (0.5, 20.0):
        # White torque of `size` times the noise stands `size` times above it at every frequency.
        p = problem(
            Segment(0.0, size * rng.standard_normal(SAMPLES), zero, zero), NoiseLevels(1.0, 1e-12, 1e-12)
        )
        assert p.signal() == pytest.approx(size, rel=0.08)


@pytest.mark.parametrize("corner", [30.0, np.inf])
def test_the_torques_noise_is_continued_below_the_range_where_it_is_seen(corner):
    rng = np.random.default_rng(4)
    f = np.arange(66.0, 132.0, 1.0)
    seen = 2.0 / (1.0 + (f / corner) ** 2) * rng.chisquare(60, f.size) / 60.0
    level, found = _first_order(f, seen)
    assert level == pytest.approx(2.0, rel=0.5)
    below = level / (1.0 + (20.0 / found) ** 2)
    assert below == pytest.approx(2.0 / (1.0 + (20.0 / corner) ** 2), rel=0.35)


def test_a_steep_fall_is_continued_only_so_far():
    f = np.arange(66.0, 132.0, 1.0)
    level, _ = _first_order(f, 1e6 / f**6)
    assert level == pytest.approx(MOST_FALL * np.median((1e6 / f**6)[:33]))
    assert _first_order(f, np.full(f.size, 3.0)) == (3.0, np.inf)


@pytest.mark.parametrize("band", [7.3, 41.25, 123.4, 187.0])
def test_the_number_of_rows_is_one_that_transforms_fast_and_costs_hardly_any_band(band):
    taper = Taper.of(33_333, 1000.0, band, 48)
    lines = taper.frequency_hz.size - 1
    assert next_fast_len(lines) == lines
    assert 0.97 * band < taper.frequency_hz[-1] <= band


def test_taking_out_a_skew_of_some_samples_does_not_lift_the_encoders_noise():
    """Derivatives up to the third lift noise at a third of the sampling rate a hundred times."""
    skew = Form(effect("clock_skew"), 0)
    p = noise_only(NoiseLevels(1.0, 1e-6, 1e-6), both=True)
    [plain], [corrected] = p.stretches, p.at(p.base, applied={skew: np.array([5e-3])}).stretches
    assert not np.array_equal(plain.joint, corrected.joint)
    assert corrected.joint.std() < 4.0 * plain.joint.std()
