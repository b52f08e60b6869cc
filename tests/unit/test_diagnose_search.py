"""The search for one effect: what is planted in the rows is found, and what physics forbids is refused."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest

from flexid_cli.diagnose import evidence
from flexid_cli.diagnose.basis import Basis, solve
from flexid_cli.diagnose.fitter import Chosen
from flexid_cli.diagnose.problem import Joined, Problem
from flexid_cli.diagnose.search import Candidate, Form, Search, gained, minimum
from flexid_cli.diagnose.stretch import Stretch
from flexid_cli.effects.forms import LEAST_PERIODS, lagged
from flexid_cli.effects.motion import Base, Motion, Terms
from flexid_cli.effects.registry import effect, effects
from flexid_cli.estimate.budget import NoiseLevels
from flexid_cli.signals.recording import Segment

RATE, BAND, SAMPLES = 500.0, 50.0, 10_000
BASE = Base(
    Jm=2.0, K=3000.0, JL=1.5, FVm=1.0, FSm=0.5, FV=0.4, FS=0.2, motor_reversal=0.01, load_reversal=0.01
)


@dataclass(frozen=True)
class SimpleFit:
    """A fit of one effect."""

    chosen: tuple[Chosen, ...]
    size: np.ndarray

    def amplitudes(self, _: int) -> np.ndarray:
        return self.size


FORMS = [Form(e, k) for e in effects() for k in range(len(e.signatures))]


def form(name: str, index: int = 0) -> Form:
    return Form(effect(name), index)


@pytest.fixture(scope="module")
def search() -> Search:
    """A smooth motion of a linear flexible axis over three radians, with a little noise."""
    rng = np.random.default_rng(4)
    time = np.arange(SAMPLES) / RATE
    motor, joint, torque = np.zeros(SAMPLES), np.zeros(SAMPLES), np.zeros(SAMPLES)
    for f, size in [(0.11, 1.2), (0.37, 0.4), (1.3, 0.1), (4.1, 0.02), (7.7, 0.01)]:
        s = 2j * np.pi * f
        wave = size * np.exp(s * time + 1j * rng.uniform(0.0, 6.0))
        load = BASE.JL * s**2 + BASE.FV * s
        joint += wave.real
        motor += ((1.0 + load / BASE.K) * wave).real
        torque += ((BASE.Jm * s**2 + BASE.FVm * s) * (1.0 + load / BASE.K) * wave + load * wave).real
    noise = NoiseLevels(0.05, 2e-6, 2e-6)
    segment = Segment(
        0.0,
        torque + noise.torque * rng.standard_normal(SAMPLES),
        motor + noise.motor_position * rng.standard_normal(SAMPLES),
        joint + noise.joint_position * rng.standard_normal(SAMPLES),
    )
    problem = Problem(
        [Stretch(segment, RATE, BAND)],
        BASE,
        noise,
        BAND,
        gravity=9.81,
        gear_ratio=50.0,
        duration_s=SAMPLES / RATE,
        both=True,
        shift=0.0,
    )
    return Search(problem, FORMS)


def planted(search: Search, what: Form, shape: tuple[float, ...], amplitudes: list[float]) -> Basis:
    """The baseline's fit where an effect of this size is in the rows."""
    return solve(search.base, search.target + search.rows(what, shape) @ np.array(amplitudes))


def found(search: Search, what: Form, now: Basis) -> Candidate:
    candidate = search.best(what, now)
    assert candidate is not None
    return candidate


def values(search: Search, candidate: Candidate) -> dict[str, float]:
    signature = candidate.form.signature
    return signature.values(candidate.amplitudes, candidate.shape, search.problem.base)


# Smooth, smooth and skew, with a corner as the instant of a change has one, and flat but for a dent.
@pytest.mark.parametrize(
    ("shape", "most"),
    [
        (lambda d: d**2, 6),
        (lambda d: 1.0 - np.exp(-2.0 * d**2 * (1.0 + 0.3 * d)), 7),
        (lambda d: np.abs(d) * (2.0 if d > 0.0 else 0.5), 12),
        (lambda d: -np.exp(-((d / 0.2) ** 2)), 12),
    ],
)
@pytest.mark.parametrize("place", [-0.83, -0.2, 0.0, 0.31, 0.77])
def test_a_minimum_is_closed_in_on_with_few_points(shape, most, place):
    tried: list[float] = []

    def cost(x: float) -> float:
        tried.append(x)
        return float(shape(x - place))

    x, least = minimum(cost, -1.0, 1.0, (-1.0, 0.0, 1.0), 0.002, 12)
    assert least == min(shape(t - place) for t in tried) == shape(x - place)
    assert x == pytest.approx(place, abs=0.012)
    assert len(tried) <= 3 + most
    assert min(tried) >= -1.0
    assert max(tried) <= 1.0


def test_a_minimum_at_the_edge_is_approached():
    assert minimum(lambda x: x, 0.0, 1.0, (0.5,), 0.01, 12)[0] < 0.02


def test_a_flat_function_has_its_minimum_anywhere():
    assert minimum(lambda _: 1.0, 0.0, 1.0, (0.0, 0.5, 1.0), 0.01, 12)[1] == 1.0


# Between the points of the coarse search and on them, over the whole range.
@pytest.mark.parametrize("cycles", [7.13, 20.0, 41.7, 66.4])
@pytest.mark.parametrize("name", ["cogging", "transmission_error"])
def test_ripple_search_finds_the_cycles_of_a_planted_sine(search, name, cycles):
    size, phase = (0.4, 0.7) if name == "cogging" else (2e-4, 0.7)
    waves = [size * math.sin(phase), size * math.cos(phase)]
    now = planted(search, form(name), (cycles,), waves)
    candidate = found(search, form(name), now)
    assert candidate.shape[0] == pytest.approx(cycles, abs=0.03)  # one turn over the travel is two
    size_name, _, phase_name = (p.name for p in effect(name).parameters[:3])
    assert values(search, candidate)[size_name] == pytest.approx(size, rel=0.05)
    assert values(search, candidate)[phase_name] == pytest.approx(phase, abs=0.05)
    assert candidate.gain > 0.5


@pytest.mark.parametrize("second", [0.2, 1.5])
def test_the_overtone_of_a_ripple_is_found_with_it(search, second):
    """Also where it is the stronger one of the two waves, so that the plain form finds it alone."""
    plain, both = (f for f in FORMS if f.name == "cogging")
    now = planted(search, both, (14.3,), [0.4, 0.0, second * 0.4, 0.0])
    candidate = search.extended(both, found(search, plain, now), now)
    assert candidate.shape[0] == pytest.approx(14.3, abs=0.03)
    assert values(search, candidate)["cogging_torque"] == pytest.approx(0.4, rel=0.05)
    assert values(search, candidate)["second_torque"] == pytest.approx(second * 0.4, rel=0.05)


def test_a_wave_that_hardly_repeats_is_no_ripple(search):
    """A sine over the whole range of motion is a function of the position like any other."""
    once = 2.0 * math.pi / search.scale.motor_range
    [shape] = search.shapes(form("cogging"))
    assert shape.low == pytest.approx(LEAST_PERIODS * once)
    now = planted(search, form("cogging"), (1.5 * once,), [0.4, 0.0])
    assert found(search, form("cogging"), now).shape[0] >= LEAST_PERIODS * once


def test_a_record_that_hardly_moves_shows_no_ripple(search):
    short = Search(search.problem, FORMS)
    object.__setattr__(short, "scale", short.scale.__class__(**{**vars(short.scale), "motor_range": 1e-4}))
    assert short.best(form("cogging"), solve(short.base, short.target)) is None


@pytest.mark.parametrize(
    ("name", "index", "shape", "size"),
    [
        ("stribeck_motor", 0, (0.21,), 1.5),
        ("viscous_nonlinear", 1, (0.47,), 2.0),
        ("hardening_stiffness", 1, (0.0031,), 2000.0),
        ("hysteresis", 0, (0.0011,), 0.8),
        ("thermal_drift", 0, (9.0,), 1.0),
        ("payload_change", 0, (11.3,), 0.2),
    ],
)
def test_shapes_are_searched_not_gridded(search, name, index, shape, size):
    now = planted(search, form(name, index), shape, [size])
    candidate = found(search, form(name, index), now)
    assert not candidate.refused
    assert candidate.shape[0] == pytest.approx(shape[0], rel=0.05)
    assert candidate.amplitudes[0] == pytest.approx(size, rel=0.1)
    white = solve(search.base, search.target).cost
    assert candidate.gain > 0.9 * gained(now.cost, white, now.residual.size)


def test_a_sign_that_physics_forbids_is_refused(search):
    now = planted(search, form("joint_damping"), (), [-5.0])
    candidate = found(search, form("joint_damping"), now)
    assert "sign" in candidate.refused
    assert candidate.cost == candidate.before
    assert candidate.amplitudes[0] == pytest.approx(-5.0, rel=0.05)
    right = found(search, form("joint_damping"), planted(search, form("joint_damping"), (), [5.0]))
    assert not right.refused
    assert right.rank < candidate.rank


def test_values_that_tie_otherwise_are_refused(search):
    """A weak spot of the spring with a fifth of its stiffness missing is no gap."""
    shape, play = (0.002, 0.0), form("backlash")
    weak = search.evaluate(play, shape, planted(search, play, shape, [0.2 * BASE.K]))
    assert "inside the gap" in weak.refused
    gap = search.evaluate(play, shape, planted(search, play, shape, [BASE.K]))
    assert not gap.refused
    assert gap.amplitudes[0] == pytest.approx(BASE.K, rel=0.02)


def test_columns_of_the_baseline_are_refused(search):
    candidate = found(search, form("gravity"), solve(search.base, search.target))
    assert "depend" in candidate.refused
    assert candidate.gain == 0.0


def test_a_fixed_amplitude_is_not_fitted(search):
    """A limit takes off what is beyond it, not half of that."""
    what, limit = form("torque_saturation"), 0.7 * search.scale.torque
    whole = search.evaluate(what, (limit,), planted(search, what, (limit,), [1.0]))
    assert whole.amplitudes.tolist() == [1.0]
    white = solve(search.base, search.target).cost
    assert whole.cost == pytest.approx(white, rel=1e-6)
    half = search.evaluate(what, (limit,), planted(search, what, (limit,), [0.5]))
    assert half.cost > 1.2 * white
    best = found(search, what, planted(search, what, (limit,), [1.0]))
    assert values(search, best)["torque_limit"] == pytest.approx(limit, rel=0.01)


def test_what_is_in_the_model_explains_nothing_more(search):
    what, shape = form("cogging"), (20.0,)
    target = search.target + search.rows(what, shape) @ np.array([0.3, 0.2])
    now = solve(np.hstack([search.base, search.rows(what, shape)]), target)
    candidate = search.evaluate(what, shape, now)
    assert candidate.gain == 0.0
    assert candidate.refused


def test_what_lies_below_the_noise_is_no_finding():
    assert gained(100.0, 100.0, 10) == 0.0
    assert gained(0.5, 0.05, 10) < 0.05  # nine tenths of next to nothing
    assert gained(1e4, 1e2, 10) == pytest.approx(math.log(100.0), rel=0.05)


def test_friction_that_grows_with_the_load_sees_all_that_the_transmission_passes_on(search):
    def constant(m: Motion) -> Terms:
        return Terms(transmission=np.ones((m.time_s.size, 1)))

    problem = search.problem
    more = problem.at(problem.base, passing=[Joined(constant, np.array([5.0]))])
    plain, passed = problem.motions[0], more.motions[0]
    np.testing.assert_allclose(plain.joint_torque, BASE.K * plain.deflection)
    np.testing.assert_allclose(passed.joint_torque - plain.joint_torque, 5.0, rtol=1e-9)
    columns = form("load_dependent_friction").signature.columns
    motor = columns(passed, ()).motor
    assert motor is not None
    np.testing.assert_allclose(motor[:, 0], np.abs(passed.joint_torque) * passed.motor_sign)


@pytest.mark.parametrize(("index", "shape", "share"), [(0, (), 0.4), (1, (0.5,), 0.7)])
def test_a_step_of_the_springs_zero_moves_what_effects_add_to_it_too(search, index, shape, share):
    # Without that, the zero goes where a torque offset draws it, and the curve of the spring with it.
    hardening, p = form("hardening_stiffness", index), search.problem
    size = p.scale().deflection
    shape = tuple(x * size for x in shape)

    def columns(m: Motion) -> Terms:
        return hardening.signature.columns(m, shape)

    amplitude = share * p.base.K / p.slopes(columns)
    stiffening = share * p.base.K

    def misfit(zero: float) -> np.ndarray:
        q = p.at(
            replace(p.base, torsion_zero=zero), stiffening=stiffening, passing=[Joined(columns, amplitude)]
        )
        rows, slopes = q.effect_rows(columns)
        spring = q.base_rows()[:, q.names.index("K")] * (p.base.K + amplitude @ slopes)
        return q.target() - spring - rows @ amplitude

    step = 0.005 * size
    now = p.at(p.base, stiffening=stiffening, passing=[Joined(columns, amplitude)])
    moved = (misfit(step) - misfit(-step)) / (2.0 * step)
    column = now.base_rows()[:, now.names.index("c")] * now.stiffness
    plain = p.base_rows()[:, p.names.index("c")] * now.stiffness
    near, far = (np.linalg.norm(moved - one) / np.linalg.norm(moved) for one in (column, plain))
    assert near < 0.15 * far, (near, far)


@pytest.mark.parametrize("side", [0, 1], ids=["joint", "motor"])
@pytest.mark.parametrize(
    ("name", "index", "shape", "share"),
    [
        ("hardening_stiffness", 1, (0.5,), 0.7),
        ("backlash", 0, (0.4, 0.05), 0.9),
        ("joint_damping", 0, (), 0.01),
    ],
)
def test_an_encoders_error_passes_what_effects_add_to_the_spring_too(search, name, index, shape, share, side):
    # Without that, wave and zero trade places until both are wrong, and a knee of the stiffness with them.
    passing, error, p = form(name, index), form("encoder_eccentricity", side), search.problem
    size = p.scale().deflection
    shape = tuple(x * size for x in shape)

    def columns(m: Motion) -> Terms:
        return passing.signature.columns(m, shape)

    def errors(m: Motion) -> Terms:
        return error.signature.columns(m, ())

    amplitude = np.array([share * p.base.K])
    stiffening = float(amplitude @ p.slopes(columns))
    joined = [Joined(columns, amplitude, centred=passing.signature.centred)]
    s = p.stretches[0]
    terms = errors(p.motions[0])
    wave = terms.joint_error if side == 0 else terms.motor_error
    assert wave is not None
    own = {n: getattr(p.base, n, 0.0) for n in p.names} | {"FSm": 0.0, "FS": 0.0}

    def misfit(a: float) -> np.ndarray:
        joint, motor = (
            (s.joint + a * wave[:, 0], s.motor) if side == 0 else (s.joint, s.motor + a * wave[:, 0])
        )
        moved = s.like(replace(s.segment, joint_position=joint, motor_position=motor))
        q = p.at(p.base, stretches=[moved], stiffening=stiffening, passing=joined)
        rows, slopes = q.effect_rows(columns, p.slopes(columns))
        theta = np.array([own[n] for n in q.names])
        theta[q.names.index("K")] += amplitude @ slopes
        return q.target() - q.base_rows() @ theta - rows @ amplitude

    step = 0.005 * size
    now = p.at(p.base, stiffening=stiffening, passing=joined)
    moved = (misfit(step) - misfit(-step)) / (2.0 * step)
    near, far = (
        np.linalg.norm(moved - q.effect_rows(errors)[0][:, 0]) / np.linalg.norm(moved) for q in (now, p)
    )
    assert near < 0.15 * far, (near, far)


def test_a_lag_sees_the_torque_that_a_limit_lets_through_and_the_floor_too(search):
    limit, lag, p = form("torque_saturation"), form("actuator_lag"), search.problem
    windup = np.where(
        np.abs(p.stretches[0].torque) > 1.0, 1000.0, 1.0
    )  # what a controller asks for meanwhile
    segment = replace(p.stretches[0].segment, torque=windup * p.stretches[0].torque)
    asked = p.at(p.base, stretches=[p.stretches[0].like(segment)])
    height = 1.0

    def columns(m: Motion) -> Terms:
        return limit.signature.columns(m, (height,))

    limited = asked.at(p.base, passing=[Joined(columns, np.ones(1))])
    (motion,) = limited.motions
    acting = np.clip(motion.torque, -height, height)
    parts = [columns(motion).motor, lag.signature.columns(motion, (0.01,)).motor]
    expected = lagged(acting, 0.01, motion.period_s)
    np.testing.assert_allclose(motion.torque - sum(x[:, 0] for x in parts), expected, atol=1e-9)
    assert asked.torque_rms > 100.0 * limited.torque_rms
    assert limited.torque_rms == pytest.approx(np.sqrt(np.mean(acting**2)))


def test_play_and_damping_see_the_transmissions_error_of_the_model(search):
    error, p, cycles, size = form("transmission_error"), search.problem, 30.0, 2e-3

    def columns(m: Motion) -> Terms:
        return error.signature.columns(m, (cycles,))

    (plain,) = p.motions
    (motion,) = p.at(p.base, passing=[Joined(columns, np.array([0.0, size]))]).motions
    angle = cycles * motion.motor_position
    np.testing.assert_allclose(motion.torsion, plain.torsion + size * np.sin(angle), atol=1e-12)
    rate = plain.torsion_rate + size * cycles * np.cos(angle) * plain.motor_velocity
    inner = slice(50, -50)
    np.testing.assert_allclose(motion.torsion_rate[inner], rate[inner], atol=1e-3 * np.abs(rate).max())
    np.testing.assert_allclose(motion.joint_torque, p.base.K * motion.torsion, rtol=1e-9, atol=1e-6)
    np.testing.assert_array_equal(motion.deflection, plain.deflection)


@pytest.mark.parametrize("instant", [4.321, 13.77, 17.0])
def test_an_event_has_its_own_instant_in_another_record(search, monkeypatch, instant):
    payload, other, size = form("payload_change"), search.problem, np.array([0.3])

    def rows(when: float) -> np.ndarray:
        return other.effect_rows(Chosen(payload, (when,)).terms)[0] @ size

    fitted = SimpleFit(chosen=(Chosen(payload, (9.0,)),), size=size)
    monkeypatch.setattr(evidence, "_left", lambda _, __, f: rows(instant) - rows(*f.chosen[0].shape))
    found = evidence._with_own_instants(other, None, fitted)
    assert found.chosen[0].shape[0] == pytest.approx(instant, abs=3.0 / RATE)
