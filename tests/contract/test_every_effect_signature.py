"""Every effect's signature: well formed, and the same physics as its law in the simulation."""

from __future__ import annotations

import numpy as np
import pytest

from flexid_cli.diagnose.problem import Problem
from flexid_cli.diagnose.search import Form
from flexid_cli.diagnose.stretch import Stretch
from flexid_cli.effects.base import EffectValues
from flexid_cli.effects.motion import Base, Motion, Terms
from flexid_cli.effects.registry import effect, effects
from flexid_cli.estimate.budget import NoiseLevels
from flexid_cli.signals.recording import Segment
from flexid_cli.simulate.engine import simulate_motor_driven, simulate_torque_driven
from flexid_cli.simulate.machine import Axis, Trajectory

RATE, BAND, SAMPLES, GEAR = 1000.0, 40.0, 8000, 50.0
AXIS = Axis(Jm=2.0, K=3000.0, JL=1.5, FVm=3.0, FSm=0.5, FV=1.0, FS=0.2, MX=0.0, MY=0.0, reversal_velocity=0.1)
BASE = Base(
    Jm=2.0, K=3000.0, JL=1.5, FVm=3.0, FSm=0.5, FV=1.0, FS=0.2, motor_reversal=0.1, load_reversal=0.1, gear_ratio=GEAR
)  # fmt: skip
NOISE = NoiseLevels(0.02, 1e-6, 1e-6)
FORMS = [Form(e, k) for e in effects() for k in range(len(e.signatures))]
EVERY = pytest.mark.parametrize("form", FORMS, ids=lambda f: f"{f.name}-{f.index}")
PLACES = ("motor", "transmission", "load", "motor_error", "joint_error")

# Form, shape and amplitudes of a small effect. Sliders in place of Dahl's element (hysteresis, further forms) have
# no law of their own: all are forms of one effect.
SMALL: dict[tuple[str, int], tuple[tuple[float, ...], tuple[float, ...]]] = {
    ("torque_offset", 0): ((), (0.5,)),
    ("viscous_asymmetry", 0): ((), (0.5,)),
    ("stribeck_motor", 0): ((0.3,), (0.5,)),
    ("viscous_nonlinear", 0): ((), (0.3,)),
    ("viscous_nonlinear", 1): ((0.5,), (0.5,)),
    ("load_dependent_friction", 0): ((), (0.03,)),
    ("cogging", 0): ((20.0,), (0.3, -0.2)),
    ("cogging", 1): ((15.0,), (0.2, -0.1, 0.15, 0.1)),
    ("torque_saturation", 0): ((12.0,), (1.0,)),
    ("actuator_lag", 0): ((2e-3,), (1.0,)),
    ("thermal_drift", 0): ((4.0,), (1.0,)),
    ("joint_damping", 0): ((), (3.0,)),
    ("backlash", 0): ((1e-3, 0.0), (3000.0,)),
    ("hardening_stiffness", 0): ((), (3e5,)),
    ("hardening_stiffness", 1): ((2e-3,), (200.0,)),
    ("hysteresis", 0): ((1e-3,), (0.3,)),
    ("hysteresis", 3): ((1e-3, 4.0), (0.3,)),
    # Few cycles: the columns leave out that the motor feels T A n cos(n qm + phi), small against K A. Without
    # a joint encoder K A hardly shows at low frequency, and what is left out is not small: see `sides_of_law`.
    ("transmission_error", 0): ((5.0,), (1e-4, 5e-5)),
    ("gravity", 0): ((), (0.2, -0.1)),
    ("stribeck_load", 0): ((0.3,), (0.3,)),
    ("second_mode", 0): ((25.0, 0.05), (0.1,)),
    ("second_mode", 1): ((25.0, 0.05), (0.1,)),
    ("payload_change", 0): ((4.1,), (0.2,)),
    ("clock_skew", 0): ((), (3e-4,)),
    ("sensor_lag", 0): ((), (3e-4,)),
    ("sensor_lag", 1): ((), (3e-4,)),
    ("encoder_eccentricity", 0): ((), (1e-4, 5e-5)),
    ("encoder_eccentricity", 1): ((), (1e-5, 2e-5)),
}


def waves(sizes: dict[float, float]) -> np.ndarray:
    time = np.arange(SAMPLES) / RATE
    phases = np.random.default_rng(9).uniform(0.0, 6.0, len(sizes))
    return np.asarray(
        sum(a * np.sin(2.0 * np.pi * f * time + p) for (f, a), p in zip(sizes.items(), phases, strict=True))
    )


MOTOR = waves({0.31: 0.6, 0.83: 0.15, 2.3: 0.03, 5.1: 0.01, 13.0: 0.001})
TORQUE = waves({0.31: 8.0, 0.83: 6.0, 2.3: 4.0, 5.1: 2.0})


def run_of(name: str, values: dict[str, float] | None) -> Trajectory:
    on = () if values is None else (EffectValues(name, values),)
    if name == "torque_saturation":  # it limits a torque, so it needs one
        return simulate_torque_driven(AXIS, TORQUE, RATE, effects=on)
    return simulate_motor_driven(AXIS, MOTOR, RATE, effects=on)


def problem_of(run: Trajectory, both: bool, shift: float = 0.0) -> Problem:
    segment = Segment(0.0, run.torque, run.motor_position, run.joint_position if both else None)
    return Problem(
        [Stretch(segment, RATE, BAND)],
        BASE,
        NOISE,
        BAND,
        gravity=AXIS.gravity,
        gear_ratio=GEAR,
        duration_s=SAMPLES / RATE,
        both=both,
        shift=shift,
    )


def misfit(problem: Problem) -> np.ndarray:
    """What the baseline at its true parameters leaves; `torque = columns + effect`."""
    if not problem.both:
        return problem.target()
    true = {**vars(BASE), "c": 0.0, "MX": 0.0, "MY": 0.0}
    return problem.target() - problem.base_rows() @ np.array([true[n] for n in problem.names])


@pytest.fixture(scope="module")
def plain() -> dict[bool, Problem]:
    run = run_of("", None)
    return {both: problem_of(run, both) for both in (True, False)}


def middle(form: Form, problem: Problem) -> tuple[float, ...]:
    shapes = form.signature.shapes(problem.scale())
    assert shapes is not None
    return tuple(float(s.grid()[s.points // 2]) if s.points > 1 else 0.5 * (s.low + s.high) for s in shapes)


def sides(form: Form) -> list[bool]:
    """With both encoders, with the motor's alone, as far as the form is looked for there."""
    signature = form.signature
    return [True] * (not signature.motor_alone) + [False] * (not signature.needs_joint)


def sides_of_law(form: Form) -> list[bool]:
    """Where the columns stand for the whole law to first order."""
    return [True] if form.name == "transmission_error" else sides(form)


def parts(form: Form, motion: Motion, shape: tuple[float, ...]) -> dict[str, np.ndarray]:
    terms: Terms = form.signature.columns(motion, shape)
    return {place: getattr(terms, place) for place in PLACES if getattr(terms, place) is not None}


def test_every_effect_has_a_signature_and_every_form_a_small_case():
    assert all(e.signatures for e in effects())
    assert {(f.name, f.index) for f in FORMS} - set(SMALL) == {("hysteresis", 1), ("hysteresis", 2)}


@EVERY
def test_columns_and_values_are_well_formed(form: Form, plain: dict[bool, Problem]):
    for both in sides(form):
        problem = plain[both]
        shape, motion = middle(form, problem), problem.motions[0]
        found = parts(form, motion, shape)
        assert found
        widths = {x.shape[1] for x in found.values()}
        assert len(widths) == 1
        for x in found.values():
            assert x.shape[0] == SAMPLES
            assert np.all(np.isfinite(x))
            assert np.any(x != 0.0)
        rows, slopes = problem.effect_rows(lambda m, s=shape: form.signature.columns(m, s))
        assert slopes.shape == (rows.shape[1],)
        assert rows.shape == (problem.target().size, *widths)
        assert np.all(np.isfinite(rows))
        fixed = form.signature.fixed
        assert fixed is None or rows.shape[1] == 1
        amplitudes = np.full(rows.shape[1], 0.01 if fixed is None else fixed)
        values = form.signature.values(amplitudes, shape, problem.base)
        assert values
        assert set(values) <= {p.name for p in form.effect.parameters}
        assert all(isinstance(v, float) and np.isfinite(v) for v in values.values())
        if form.signature.tied is not None:
            assert isinstance(form.signature.tied(amplitudes, shape, problem.base), str)


@EVERY
def test_the_neutral_amplitude_adds_nothing(form: Form, plain: dict[bool, Problem]):
    """No amplitude means neutral values; where all is in the shape, its neutral end has no columns."""
    problem = plain[sides(form)[0]]
    shape, motion = middle(form, problem), problem.motions[0]
    (column, *_) = parts(form, motion, shape).values()
    values = form.signature.values(np.zeros(column.shape[1]), shape, BASE)
    if form.effect.is_neutral(values):
        return
    first = form.effect.parameters[0].neutral
    assert first is not None
    end = 1e-7 * shape[0] if first == 0.0 else 1e7 * shape[0]
    (neutral, *_) = parts(form, motion, (end, *shape[1:])).values()
    assert np.abs(neutral).max() < 1e-5 * np.abs(column).max()


@pytest.mark.parametrize(("name", "index"), list(SMALL), ids=str)
def test_columns_agree_with_the_law_of_the_simulation(name: str, index: int):
    """The misfit of the baseline at its true parameters is the columns times the amplitudes."""
    form, (shape, sizes) = Form(effect(name), index), SMALL[name, index]
    amplitudes = np.array(sizes)
    values = form.signature.values(amplitudes, shape, BASE)
    run, none = run_of(name, values), run_of(name, None)
    shift = 0.5 if name == "torque_saturation" else 0.0  # the torque that drives is held
    for both in sides_of_law(form):
        problem = problem_of(run, both, shift)
        whole, _ = problem.effect_rows(lambda m: form.signature.columns(m, shape), np.zeros(amplitudes.size))
        told = whole @ amplitudes
        seen = misfit(problem)
        size = float(np.linalg.norm(told))
        assert np.linalg.norm(misfit(problem_of(none, both, shift))) < 0.02 * size
        assert np.linalg.norm(seen - told) < (0.05 if both else 0.1) * size


@pytest.mark.parametrize(("index", "sizes"), [(0, (0.08, -0.05)), (1, (3e-3, 2e-3))])
def test_a_wave_of_an_encoder_is_taken_out_with_its_overtones(index: int, sizes: tuple[float, float]):
    """Its overtone, 3 to 9 % of it, would be named as an effect of its own."""
    form, amplitudes = Form(effect("encoder_eccentricity"), index), np.array(sizes)
    run, none = (run_of(form.name, v) for v in (form.signature.values(amplitudes, (), BASE), None))
    problem = problem_of(run, both=True)
    first_order = (
        misfit(problem) - problem.effect_rows(lambda m: form.signature.columns(m, ()))[0] @ amplitudes
    )
    taken_out = misfit(problem.at(BASE, applied={form: amplitudes}))
    plain = np.linalg.norm(misfit(problem_of(none, both=True)))
    assert np.linalg.norm(taken_out) < 1.1 * plain
    assert np.linalg.norm(first_order) > 20.0 * plain


def test_a_wave_that_no_encoder_could_have_is_not_taken_out():
    form = Form(effect("encoder_eccentricity"), 1)
    correct = form.signature.corrected
    assert correct is not None
    assert correct(MOTOR, np.array([0.02, 0.0]), lambda x, _: x, GEAR) is MOTOR
