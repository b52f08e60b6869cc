"""Fits of the motor alone by a simulation that the measured motor leads."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from flexid_cli.diagnose.evidence import predicted
from flexid_cli.diagnose.fitter import Chosen, Fitted, Fitter
from flexid_cli.diagnose.led import LedFit, Point, refined, residual
from flexid_cli.diagnose.problem import Problem
from flexid_cli.diagnose.reversals import motor_sharpened
from flexid_cli.diagnose.search import Form
from flexid_cli.diagnose.stretch import Stretch
from flexid_cli.effects.base import EffectValues
from flexid_cli.effects.motion import Base
from flexid_cli.effects.registry import effect
from flexid_cli.estimate.budget import NoiseLevels
from flexid_cli.signals.recording import Segment
from flexid_cli.simulate.engine import simulate_closed_loop, simulate_motor_driven
from flexid_cli.simulate.machine import Axis, Controller

RATE, BAND, SAMPLES = 500.0, 30.0, 8_000
NOISE = NoiseLevels(1.0, 1e-8, 0.0)
BASE = Base(
    Jm=3.0, K=4000.0, JL=2.0, FVm=2.0, FSm=3.0, FV=10.0, FS=1.0, motor_reversal=0.01, load_reversal=0.01
)
CUBIC = 3e5
HARDENING = Form(effect("hardening_stiffness"), 0)
HARDENS = EffectValues("hardening_stiffness", {"cubic_stiffness": CUBIC})


def problem(seed: int, base: Base = BASE, hidden: EffectValues = HARDENS) -> Problem:
    """A record of an axis whose spring hardens, as the motor's encoder and the current sensor show it."""
    rng, t = np.random.default_rng(seed), np.arange(SAMPLES) / RATE
    frequency = np.geomspace(0.2, 14.0, 24)
    waves = [0.06 / (1.0 + f**1.6) * np.sin(2.0 * np.pi * (f * t + rng.random())) for f in frequency]
    fade = np.clip(t, 0.0, 1.0)
    motor = np.asarray(np.sum(waves, axis=0) * fade**3 * (10.0 - 15.0 * fade + 6.0 * fade**2))
    axis = Axis(
        Jm=BASE.Jm, K=BASE.K, JL=BASE.JL, FVm=BASE.FVm, FSm=BASE.FSm, FV=BASE.FV, FS=BASE.FS, MX=0.0, MY=0.0,
        reversal_velocity=BASE.motor_reversal, load_reversal_velocity=BASE.load_reversal,
    )  # fmt: skip
    torque = simulate_motor_driven(axis, motor, RATE, effects=[hidden]).torque
    segment = Segment(
        0.0,
        torque + NOISE.torque * rng.standard_normal(SAMPLES),
        motor + NOISE.motor_position * rng.standard_normal(SAMPLES),
        None,
    )
    return Problem(
        [Stretch(segment, RATE, BAND)],
        base,
        NOISE,
        BAND,
        gravity=9.81,
        gear_ratio=1.0,
        duration_s=SAMPLES / RATE,
        both=False,
        shift=0.0,
    )


@cache
def fits() -> tuple[Fitter, Fitted, LedFit]:
    """The linear fit from a start that is somewhat off, and what the simulation makes of it."""
    fitter = Fitter([HARDENING], (0.0,))
    start = replace(BASE, K=1.03 * BASE.K, JL=0.98 * BASE.JL, FS=0.7)
    linear = fitter.fit(problem(1, start), [Chosen(HARDENING, ())])
    found = refined(fitter, linear)
    assert found is not None
    return fitter, linear, found


def rms(rows: np.ndarray) -> float:
    return float(np.sqrt(np.mean(rows**2)))


def test_the_true_axis_leaves_the_torque_noise_and_no_more():
    p = problem(1)
    truth = Point(BASE, (np.array([CUBIC]),), (Chosen(HARDENING, ()),), np.zeros(2))
    left = residual(p, truth)
    assert left is not None
    assert rms(left) == pytest.approx(1.0, abs=0.12)


def test_it_finds_the_axis_and_its_effect_closer_than_the_linear_fit():
    _, linear, found = fits()
    assert found.basis.rms == pytest.approx(1.0, abs=0.12)
    assert linear.basis.rms > 1.1 * found.basis.rms
    assert pytest.approx(BASE.K, rel=2e-3) == found.problem.base.K
    assert pytest.approx(BASE.JL, rel=2e-3) == found.problem.base.JL
    assert pytest.approx(BASE.FS, rel=0.03) == found.problem.base.FS
    assert found.amplitudes(0)[0] == pytest.approx(CUBIC, rel=0.05)


def test_its_columns_are_derivatives_about_the_solution():
    _, _, found = fits()
    k = found.problem.names.index("K")
    assert found.basis.coefficients[k] == 0.0
    step = 1e-3 * BASE.K
    moved = replace(found.point, base=replace(found.point.base, K=found.point.base.K + step))
    there = residual(found.problem, moved)
    assert there is not None
    by_difference = (found.basis.residual - there) / step
    column = found.basis.columns[:, k]
    assert np.linalg.norm(by_difference - column) < 0.05 * np.linalg.norm(column)


def test_another_record_is_predicted_by_simulation_down_to_its_noise():
    fitter, _, found = fits()
    assert rms(predicted(problem(2), fitter, found)) == pytest.approx(1.0, abs=0.15)


def test_an_event_has_its_own_instant_in_another_record():
    """With the first record's instant, a payload that changed earlier there leaves a multiple of the noise."""
    payload, more = Form(effect("payload_change"), 0), 0.5

    def changed(when: float) -> EffectValues:
        return EffectValues("payload_change", {"inertia_change": more, "time_of_change": when})

    fitter = Fitter([payload], (0.0,))
    found = refined(fitter, fitter.fit(problem(1, hidden=changed(11.0)), [Chosen(payload, (10.9,))]))
    assert found is not None
    assert found.amplitudes(0)[0] == pytest.approx(more, rel=0.03)
    other = problem(2, hidden=changed(6.3))
    there = replace(found.point, starts=np.zeros(2))
    held = residual(other.at(there.base), there)
    assert held is not None
    assert rms(held) > 2.0
    assert rms(predicted(other, fitter, found)) == pytest.approx(1.0, abs=0.15)


def test_no_simulation_follows_a_wrong_stiffness():
    fitter, _, found = fits()
    wrong = fitter.fit(problem(1, replace(BASE, K=0.3 * BASE.K)))
    other = refined(fitter, wrong, most=2)
    assert other is None or other.loss > found.loss + 1.0


def test_an_axis_that_cannot_be_simulated_gives_nothing():
    p = problem(1)
    assert residual(p, Point(replace(BASE, K=-1.0), (), (), np.zeros(2))) is None


def test_how_the_load_starts_is_found():
    """The record begins while the load swings: what it swings by is no friction and no noise."""
    fitter, _, found = fits()
    p = problem(1)
    cut = replace(p.stretches[0].segment, **{
        name: getattr(p.stretches[0].segment, name)[1200:] for name in ("torque", "motor_position")
    })  # fmt: skip
    late = Problem(
        [Stretch(cut, RATE, BAND)], BASE, NOISE, BAND, gravity=9.81, gear_ratio=1.0, duration_s=13.0, both=False,
        shift=0.0,
    )  # fmt: skip
    assert rms(predicted(late, fitter, found)) == pytest.approx(1.0, abs=0.15)


STICKING = replace(BASE, FSm=10.0, motor_reversal=2e-3)
COARSE = NoiseLevels(1.0, 4e-5, 0.0)  # turns the sign of the motor's velocity about its reversals


def sticking(seed: int, base: Base = STICKING, factor: float = 1.0) -> Problem:
    """A record of an axis with much friction under its controller, which holds the torque for a period.

    Positions times ``factor``, torques over it.
    """
    rng, t = np.random.default_rng(seed), np.arange(SAMPLES) / RATE
    waves = [
        0.1 / (1.0 + f) * np.sin(2.0 * np.pi * (f * t + rng.random())) for f in (0.3, 0.7, 1.9, 4.1, 8.3)
    ]
    axis = Axis(
        Jm=STICKING.Jm, K=STICKING.K, JL=STICKING.JL, FVm=STICKING.FVm, FSm=STICKING.FSm, FV=STICKING.FV,
        FS=STICKING.FS, MX=0.0, MY=0.0, reversal_velocity=STICKING.motor_reversal,
        load_reversal_velocity=STICKING.load_reversal,
    )  # fmt: skip
    run = simulate_closed_loop(axis, Controller(15.0, 150.0, 300.0), np.sum(waves, axis=0), RATE)
    torque = run.torque + COARSE.torque * rng.standard_normal(SAMPLES)
    motor = run.motor_position + COARSE.motor_position * rng.standard_normal(SAMPLES)
    segment = Segment(0.0, torque / factor, motor * factor, None)
    noise = NoiseLevels(COARSE.torque / abs(factor), COARSE.motor_position * abs(factor), 0.0)
    return Problem(
        [Stretch(segment, RATE, BAND)], base, noise, BAND, gravity=9.81, gear_ratio=1.0, duration_s=SAMPLES / RATE,
        both=False, shift=0.5,
    )  # fmt: skip


def test_reversals_of_the_motor_are_told_by_encoder_and_torque_together():
    p = sticking(3)
    truth = Point(STICKING, (), (), np.zeros(2))
    blurred, sharp = residual(p, truth), residual(motor_sharpened(p), truth)
    assert blurred is not None
    assert sharp is not None
    assert rms(blurred) > 1.4 * rms(sharp)
    assert rms(sharp) < 1.25


def test_a_fit_about_noisy_reversals_finds_the_axis():
    """Each fit tells the reversals anew, by the axis and the effects that it has."""
    start = replace(STICKING, K=1.04 * BASE.K, JL=0.97 * BASE.JL, FSm=8.0)
    fitter = Fitter([HARDENING], (0.5,))
    found = refined(fitter, fitter.fit(sticking(3, start)))
    assert found is not None
    assert found.basis.rms == pytest.approx(1.0, abs=0.15)
    assert pytest.approx(BASE.K, rel=3e-3) == found.problem.base.K
    assert pytest.approx(STICKING.FSm, rel=0.03) == found.problem.base.FSm
    assert rms(predicted(sticking(4, start), fitter, found)) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("factor", [-1.0, 1e-3])
def test_a_reversed_axis_and_another_unit_leave_the_same(factor):
    scaled = {n: getattr(STICKING, n) / factor**2 for n in ("Jm", "JL", "K", "FVm", "FV")}
    scaled |= {n: getattr(STICKING, n) / abs(factor) for n in ("FSm", "FS")}
    scaled |= {n: getattr(STICKING, n) * abs(factor) for n in ("motor_reversal", "load_reversal")}
    base = replace(STICKING, **scaled)
    here = residual(motor_sharpened(sticking(3)), Point(STICKING, (), (), np.zeros(2)))
    there = residual(motor_sharpened(sticking(3, base, factor)), Point(base, (), (), np.zeros(2)))
    assert here is not None
    assert there is not None
    assert np.allclose(np.sign(factor) * there, here, atol=1e-3 * rms(here))
