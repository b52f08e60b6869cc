"""Where a residual lives, on residuals whose truth is known."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from flexid_cli.diagnose.angle import ALPHA as ANGLE_ALPHA
from flexid_cli.diagnose.angle import NEIGHBOURS, Angles, false_alarm, spectrum, threshold
from flexid_cli.diagnose.bands import binned, correlated_rows, spread
from flexid_cli.diagnose.basis import solve
from flexid_cli.diagnose.change_points import ALPHA, Record, changes
from flexid_cli.diagnose.drift import drifts
from flexid_cli.diagnose.events import events
from flexid_cli.diagnose.location import located, residual_maps
from flexid_cli.diagnose.loop_width import log_slope, loop_width
from flexid_cli.diagnose.problem import Problem
from flexid_cli.diagnose.result import Locality, Shape, Where
from flexid_cli.diagnose.reversal_windows import reversals, turns
from flexid_cli.diagnose.stretch import Stretch
from flexid_cli.diagnose.suggest import interval, suggestions
from flexid_cli.effects.motion import Base
from flexid_cli.estimate.bootstrap import block_spread
from flexid_cli.estimate.budget import NoiseLevels
from flexid_cli.signals.recording import Segment

ROWS, STEP = 3000, 0.0125
TIME = STEP * np.arange(ROWS)
LENGTHS = (1400, ROWS - 1400)  # a gap in the middle


def coloured(seed: int, pole: float = 0.7, rows: int = ROWS) -> np.ndarray:
    """First-order noise of unit variance."""
    white = np.random.default_rng(seed).standard_normal(rows + 200)
    return np.asarray(np.sqrt(1.0 - pole**2) * lfilter([1.0], [1.0, -pole], white)[200:])


def motion(seed: int) -> dict[str, np.ndarray]:
    """Position, velocity and acceleration of a rich trajectory, and the columns of a load."""
    rng = np.random.default_rng(seed)
    f, phase, size = rng.uniform(0.1, 3.0, 8), rng.uniform(0.0, 6.3, 8), rng.uniform(0.3, 1.0, 8)
    w = 2.0 * np.pi * f[:, None]
    q, v, a = (
        (size[:, None] * s * w**k * fn(w * TIME + phase[:, None])).sum(axis=0) / 8.0
        for k, s, fn in ((0, 1.0, np.sin), (1, 1.0, np.cos), (2, -1.0, np.sin))
    )
    return {"q": q, "v": v, "JL": a / a.std(), "FV": v / v.std(), "FS": np.sign(v), "MY": np.sin(q)}


def record(seed: int, added: dict[str, np.ndarray] | None = None, pole: float = 0.7) -> Record:
    """Coloured noise and what is added to factors of columns over time, after the fit of constant factors."""
    columns = {n: c for n, c in motion(seed).items() if n not in ("q", "v")}
    e = coloured(seed, pole) + sum(columns[n] * course for n, course in (added or {}).items())
    basis = solve(np.column_stack(list(columns.values())), e)
    return Record(columns, basis.Q, basis.residual, TIME, LENGTHS)


# --- bands ---


def test_bands_of_a_binned_mean_cover_zero_as_often_as_they_say():
    which = np.digitize(motion(3)["q"], np.quantile(motion(3)["q"], np.linspace(0.0, 1.0, 13)[1:-1]))
    inside, naive = [], []
    for seed in range(120):
        e = coloured(seed, 0.9)
        mean, half = binned(e, which, range(12), LENGTHS)
        inside.append(np.abs(mean) < half)
        naive.append(np.abs(mean) < 1.96 * e.std() / np.sqrt(np.bincount(which)))
    assert 0.92 < np.mean(inside) < 0.98
    assert np.mean(naive) < 0.8  # the bands are not white noise's


def test_the_spread_is_that_of_infinitely_many_draws():
    parts = np.column_stack([coloured(1, 0.9), coloured(2, 0.0)])
    drawn = block_spread(parts, LENGTHS, 25, draws=4000)
    found = spread(parts - parts.mean(axis=0), LENGTHS, 25)
    np.testing.assert_allclose(found.stderr, drawn, rtol=0.06)


def test_a_longer_correlation_makes_longer_blocks():
    assert correlated_rows(coloured(1, 0.0), LENGTHS) < correlated_rows(coloured(1, 0.95), LENGTHS)


def test_bands_of_a_shape_hold_zero_where_nothing_is():
    made, y = axis_with(lambda w: 0.0 * w)
    now = solve(made.base_rows(), y)
    recording = SimpleNamespace(linear=False, torque_unit="N.m")
    places = [located(m, made, now, recording) for m in residual_maps(made, now) if m.knots.size > 1]
    inside = np.concatenate([(p.shape.low < 0.0) & (p.shape.high > 0.0) for p in places])
    assert inside.size > 100
    assert 0.88 < np.mean(inside) <= 1.0


# --- changes and drift ---


@pytest.mark.parametrize("column", ["JL", "FV", "FS"])
@pytest.mark.parametrize("at", [8.0, 22.0])
def test_a_step_of_one_factor_is_found_timed_and_named(column, at):
    [found] = changes(record(5, {column: 0.6 * (at <= TIME)}))
    assert found.column == column
    assert found.time_s == pytest.approx(at, abs=0.6)
    assert found.earliest_s <= at <= found.latest_s
    assert found.size == pytest.approx(0.6, abs=4.0 * found.stderr)
    assert found.p_value < ALPHA


def test_two_changes_that_undo_each_other_are_an_interval():
    found = changes(record(6, {"JL": 1.5 * ((TIME >= 10.0) & (TIME < 20.0))}))
    assert [c.column for c in found] == ["JL", "JL"]
    start, end = interval(Locality("baseline", tuple(replace(c, share=0.8) for c in found)), 37.5)
    assert (start, end) == (pytest.approx(10.0, abs=0.6), pytest.approx(20.0, abs=0.6))


def test_what_another_variable_explains_better_is_no_change():
    one = record(5, {"JL": 0.6 * (TIME >= 20.0)})
    explained = changes(one)[0].share * float(one.residual @ one.residual)
    assert len(changes(one, rival=0.9 * explained)) == 1
    assert changes(one, rival=1.1 * explained) == ()


@pytest.mark.parametrize("pole", [0.0, 0.9])
def test_nothing_changes_in_coloured_noise_more_often_than_stated(pole):
    found = [bool(changes(record(seed, pole=pole))) for seed in range(100)]
    assert sum(found) <= 5  # 100 times ALPHA is 1; more than 5 has a chance of 0.05 %


def test_a_trend_is_a_drift_and_no_change():
    course = 0.5 * (TIME - TIME.mean()) / 10.0
    one = record(7, {"FV": course})
    assert changes(one) == ()
    first = drifts(one, {"FV": 2.0})[0]
    assert first.column == "FV"
    assert first.per_minute == pytest.approx(3.0, abs=4.0 * first.stderr)
    assert first.percent_per_minute == pytest.approx(50.0 * first.per_minute)
    assert first.p_value < 1e-3


def test_noise_drifts_no_more_often_than_stated():
    p = [min(d.p_value for d in drifts(record(seed, pole=0.9), {})) for seed in range(100)]
    assert np.mean(np.array(p) < 0.05) < 0.12


# --- events ---


def test_a_burst_is_found_and_what_recurs_is_not():
    burst = np.where(np.abs(TIME - 12.3) < 0.1, 12.0, 0.0)
    [found] = events("motor", coloured(8) + burst, TIME, LENGTHS)
    assert found.start_s < 12.3 < found.end_s
    assert found.end_s - found.start_s < 1.0
    assert found.share > 0.2
    recurring = np.where(np.abs((TIME % 1.5) - 0.7) < 0.1, 12.0, 0.0)
    assert events("motor", coloured(8) + recurring, TIME, LENGTHS) == ()


@pytest.mark.parametrize("pole", [0.0, 0.9])
def test_noise_has_no_events(pole):
    assert sum(bool(events("motor", coloured(seed, pole), TIME, LENGTHS)) for seed in range(100)) <= 5


# --- reversals ---


def at_reversals(e: np.ndarray, velocity: np.ndarray):
    return reversals("load", e, TIME, LENGTHS, turns(TIME, velocity), scale=2.0, unit="N.m")


def test_a_mismatch_at_reversals_is_told_with_its_course():
    v = motion(9)["v"]
    turned, way = turns(TIME, v)
    kick = sum(w * np.exp(-(((TIME - t) / 0.03) ** 2)) for t, w in zip(turned, way, strict=True))
    found = at_reversals(4.0 * kick + 0.3 * coloured(9), v)
    assert found.count == turned.size
    assert found.low > found.time_share
    assert found.energy_share > 0.8
    assert found.p_value < 1e-3
    middle = found.lag_s.size // 2
    assert found.mean[middle] == pytest.approx(8.0, rel=0.1)
    assert abs(found.mean[0]) < 1.0


def test_noise_does_not_live_at_reversals():
    v = motion(9)["v"]
    p = np.array([at_reversals(coloured(seed), v).p_value for seed in range(100)])
    assert np.mean(p < 0.05) < 0.12
    assert abs(np.mean(p) - 0.5) < 0.1


def test_a_standing_axis_has_no_reversals():
    v = np.where(TIME < 5.0, 1.0, 0.0) + 1e-3 * coloured(1)
    turned, _ = turns(TIME, v)
    assert turned.size == 0
    assert at_reversals(coloured(1), v) is None


# --- angle ---


def over_angle(e: np.ndarray, angle: np.ndarray, velocity: np.ndarray):
    def rows(cycles: float) -> np.ndarray:
        return np.column_stack([np.cos(cycles * angle), np.sin(cycles * angle)])

    return spectrum("motor", e, Angles.of(angle, velocity, 40.0, 10.0), rows, scale=1.0, unit="N.m")


ANGLE = 3.0 * np.abs((TIME / 7.5) % 2.0 - 1.0) ** 1.2 + 0.2 * motion(4)["q"]
SPEED = np.gradient(ANGLE, STEP)


def test_two_lines_are_found_with_amplitude_and_phase():
    e = coloured(4) + 1.0 * np.cos(23.0 * ANGLE + 0.4) + 0.6 * np.cos(40.0 * ANGLE - 1.0)
    found = over_angle(e, ANGLE, SPEED)
    first, second = found.lines
    assert (first.cycles_per_joint_revolution, second.cycles_per_joint_revolution) == (
        pytest.approx(23.0, abs=0.15), pytest.approx(40.0, abs=0.15),
    )  # fmt: skip
    assert first.cycles_per_motor_revolution == pytest.approx(2.3, abs=0.015)
    assert first.amplitude == pytest.approx(1.0, abs=0.15)
    assert second.amplitude == pytest.approx(0.6, abs=0.15)
    assert first.share + second.share < 1.0
    assert first.share > 2.0 * second.share
    assert first.phase == pytest.approx(0.4, abs=0.3)
    assert max(first.false_alarm, second.false_alarm) < ANGLE_ALPHA
    at = int(np.argmin(np.abs(found.cycles - 23.0)))
    assert found.amplitude[at] > found.level[at]


def test_noise_has_lines_no_more_often_than_stated():
    found = [bool(over_angle(coloured(seed), ANGLE, SPEED).lines) for seed in range(100)]
    assert sum(found) <= 5


def test_what_is_smooth_over_the_travel_is_no_line():
    e = 0.1 * coloured(4) + 3.0 * ANGLE**2 - ANGLE**3 + np.cos(0.7 * ANGLE)
    assert over_angle(e, ANGLE, SPEED).lines == ()


def test_the_false_alarm_level_is_that_of_its_probability():
    assert false_alarm(threshold(300.0), 300.0) == pytest.approx(ANGLE_ALPHA)
    rng = np.random.default_rng(2)
    ratios = rng.exponential(size=(4000, 50)) / rng.gamma(NEIGHBOURS, 1.0 / NEIGHBOURS, (4000, 50))
    alarms = np.mean(ratios.max(axis=1) > threshold(50.0))
    assert alarms == pytest.approx(ANGLE_ALPHA, abs=0.006)


def test_a_short_travel_has_no_spectrum():
    assert over_angle(coloured(1), np.full(ROWS, 0.3), np.zeros(ROWS)) is None


# --- loop ---

RATE, BAND, SAMPLES = 500.0, 40.0, 20_000
BASE = Base(
    Jm=2.0, K=3000.0, JL=1.5, FVm=1.0, FSm=0.0, FV=0.4, FS=0.0, motor_reversal=0.01, load_reversal=0.01
)


def axis_with(loss) -> tuple[Problem, np.ndarray]:
    """An axis whose transmission passes ``loss(omega)`` i times the torsion beside the spring."""
    rng = np.random.default_rng(12)
    f = np.fft.rfftfreq(SAMPLES, 1.0 / RATE)
    s = 2j * np.pi * f
    inside = (f > 0.3) & (f < 35.0)
    size = np.where(inside, 1.0 / np.maximum(f, 0.3) ** 0.3, 0.0)
    torsion = size * (rng.standard_normal(f.size) + 1j * rng.standard_normal(f.size))
    passed = (BASE.K + 1j * loss(2.0 * np.pi * f)) * torsion
    joint = np.where(inside, passed / np.where(inside, BASE.JL * s**2 + BASE.FV * s, 1.0), 0.0)
    motor = joint + torsion
    torque = BASE.Jm * s**2 * motor + BASE.FVm * s * motor + passed
    scale = 1e-3 / np.std(np.fft.irfft(torsion, SAMPLES))
    qm, q, u = (scale * np.fft.irfft(x, SAMPLES) for x in (motor, joint, torque))
    noise = NoiseLevels(0.01, 1e-7, 1e-7)
    segment = Segment(
        0.0,
        u + noise.torque * rng.standard_normal(SAMPLES),
        qm + noise.motor_position * rng.standard_normal(SAMPLES),
        q + noise.joint_position * rng.standard_normal(SAMPLES),
    )
    made = Problem(
        [Stretch(segment, RATE, BAND)], BASE, noise, BAND, gravity=9.81, gear_ratio=1.0,
        duration_s=SAMPLES / RATE, both=True, shift=0.0,
    )  # fmt: skip
    return made, made.target()


@pytest.mark.parametrize(
    ("loss", "slope"),
    [(lambda w: np.full(w.size, 60.0), 0.0), (lambda w: 2.0 * w, 1.0)],
    ids=["hysteresis", "damping"],
)
def test_the_loops_slope_tells_friction_from_damping(loss, slope):
    made, y = axis_with(loss)
    found = loop_width(made, solve(made.base_rows(), y), unit="N.m/rad", torque_unit="N.m")
    sure = found.stiffness > found.band
    assert np.count_nonzero(sure) >= 3
    expected = loss(2.0 * np.pi * found.frequency_hz)
    np.testing.assert_allclose(found.stiffness[sure], expected[sure], rtol=0.15)
    assert found.slope == pytest.approx(slope, abs=max(0.1, 3.0 * found.slope_stderr))
    np.testing.assert_allclose(found.width, 2.0 * np.abs(found.stiffness) * found.torsion)
    told = suggestions(Where("transmission", "torsion"), Locality("baseline", loop=found), 0.0)
    assert len(told) == 1
    assert ("friction" if slope == 0.0 else "damping") in told[0]


def test_without_a_loop_there_is_no_slope():
    made, y = axis_with(lambda w: 0.0 * w)
    found = loop_width(made, solve(made.base_rows(), y), unit="N.m/rad", torque_unit="N.m")
    assert found.slope is None
    assert np.mean(np.abs(found.stiffness) < 1.5 * found.band) > 0.8


def test_scatter_about_a_line_widens_its_slope():
    f = np.array([1.0, 2.0, 4.0, 8.0])
    _, narrow = log_slope(f, f, 0.01 * f, 0.02 * f)
    _, wide = log_slope(f, f * np.array([1.0, 1.5, 0.7, 1.0]), 0.01 * f, 0.02 * f)
    assert wide > 10.0 * narrow


# --- words ---


def shape(x, y) -> Shape:
    return Shape(x, y, y - 0.1, y + 0.1, "rad", "N.m")


@pytest.mark.parametrize(
    ("variable", "y", "words"),
    [
        ("velocity", lambda x: np.tanh(20.0 * x), "saturates"),
        ("velocity", lambda x: x**3, "does not grow steadily"),
        ("velocity", lambda x: x**2, "even in the velocity"),
        ("position", lambda x: np.where(x > 0.6, 10.0 * (x - 0.6), 0.0), "upper end"),
        ("position_times_sign", lambda x: np.sin(9.0 * x), "friction that depends on the position"),
    ],
)
def test_the_shape_suggests_a_law(variable, y, words):
    half = np.array([0.01, 0.04, 0.1, 0.25, 0.5, 1.0])
    x = np.concatenate([-half[::-1], half]) if variable == "velocity" else np.linspace(-1.0, 1.0, 10)
    where = Where("motor", variable, shape=shape(x, y(x)))
    [told] = suggestions(where, Locality("baseline"), 2.0)
    assert words in told
    assert suggestions(where, Locality("baseline"), 0.1) == ()  # a map that explains little says nothing


def test_a_change_that_explains_most_is_the_interval_and_told_first():
    found = changes(record(5, {"JL": 3.0 * (TIME >= 20.0)}))
    place = Locality("baseline", tuple(replace(c, unit="kg.m2") for c in found))
    assert interval(place, 37.5) == (pytest.approx(20.0, abs=0.2), 37.5)
    first = suggestions(Where("load", "time"), place, 0.0)[0]
    assert first.startswith("from 20")
    assert "load's inertia" in first
    assert interval(Locality("baseline"), 37.5) is None
