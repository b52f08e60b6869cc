"""What every effect must do, whatever it is: found by discovery, so that a new one is tested as it comes."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from flexid_cli.effects.base import FAMILIES, QUANTITIES, Effect, EffectValues, Stage, unit_of
from flexid_cli.effects.registry import effect as effect_named
from flexid_cli.effects.registry import effects
from flexid_cli.errors import UsageError
from flexid_cli.simulate.engine import simulate_closed_loop, simulate_motor_driven, simulate_torque_driven
from flexid_cli.simulate.machine import Axis, Controller, InitialState, Sensors, Trajectory

EVERY = pytest.mark.parametrize("effect", effects(), ids=lambda e: e.name)
RATE = 1000.0
LOOP = Controller(8.0, 3000.0, 8000.0)
HEADINGS = ("What it is", "In the data", "How to confirm", "What to do", "Literature")
NAMES = {
    "motor": "torque_offset viscous_asymmetry stribeck_motor viscous_nonlinear load_dependent_friction cogging"
    " actuator_lag torque_saturation thermal_drift",
    "transmission": "joint_damping backlash hardening_stiffness hysteresis transmission_error",
    "load": "gravity stribeck_load second_mode payload_change",
    "measurement": "clock_skew sensor_lag encoder_eccentricity",
}


def fields(run: Trajectory) -> dict[str, bytes]:
    """Everything that was simulated except the effects' own states."""
    return {k: v.tobytes() for k, v in vars(run).items() if isinstance(v, np.ndarray)}


def reference(n: int = 2500) -> np.ndarray:
    time = np.arange(n) / RATE
    return 0.1 * np.sin(2 * np.pi * 0.7 * time) + 0.02 * np.sin(2 * np.pi * 3.1 * time)


def test_the_names_of_the_contract_are_there():
    found = {e.name: e.family for e in effects()}
    for family, names in NAMES.items():
        for name in names.split():
            assert found[name] == family
    codes = [e.code for e in effects()]
    assert len(set(codes)) == len(codes) == len(found)


def test_unknown_effect_is_answered_with_the_nearest():
    with pytest.raises(UsageError, match="no effect 'backlsh'") as error:
        effect_named("backlsh")
    assert "did you mean backlash?" in error.value.hint
    assert effect_named("FX202") is effect_named("backlash")


@EVERY
def test_facts(effect: Effect):
    assert re.fullmatch(r"FX[1-4]\d\d", effect.code)
    assert re.fullmatch(r"[a-z][a-z_]+", effect.name)
    assert effect.family in FAMILIES
    assert effect.equation in FAMILIES
    assert set(effect.needs) <= {"torque", "motor_position", "joint_position"}
    assert effect.best_recording.endswith(".")
    assert effect.term
    assert [h for h in HEADINGS if f"\n{h}\n" in effect.text] == list(HEADINGS)
    assert effect.text.index("\n") > 10
    assert effect.parameters
    assert any(p.neutral is not None for p in effect.parameters)
    assert len({p.symbol for p in effect.parameters}) == len(effect.parameters)
    for p in effect.parameters:
        assert p.quantity in QUANTITIES
        assert p.low <= p.example <= p.high
        assert p.neutral is None or p.low <= p.neutral <= p.high
        for linear in (False, True):
            assert unit_of(p.quantity, linear=linear, torque_unit="N" if linear else "N.m")
    assert not effect.is_neutral(effect.examples)
    assert effect.is_neutral(effect.neutral)
    assert effect.is_neutral({})
    np.testing.assert_array_equal(effect.vector({}), effect.vector(effect.neutral))


@EVERY
def test_impossible_values_are_refused(effect: Effect):
    with pytest.raises(UsageError, match="no parameter"):
        effect.vector({"no_such_thing": 1.0})
    for p in effect.parameters:
        with pytest.raises(UsageError, match="not possible"):
            effect.vector({p.name: math.nan})
        if math.isfinite(p.low):
            with pytest.raises(UsageError, match="not possible"):
                effect.vector({p.name: p.low - max(1.0, abs(p.low))})


@EVERY
@pytest.mark.parametrize("axis", [Axis(), Axis(reversal_velocity=0.0)], ids=["smooth", "dry"])
def test_neutral_is_the_baseline_bit_for_bit(effect: Effect, axis: Axis):
    """Closed loop with noise and counts, under torque, and driven by the motor; shapes anything."""
    sensors = Sensors(motor_resolution=2e-6, joint_resolution=1e-5, torque_noise=2.0, motor_noise=1e-6)
    shapes = {p.name: p.example for p in effect.parameters if p.neutral is None}
    off = (EffectValues(effect.name, {**effect.neutral, **shapes}),)
    torque = 300.0 * np.sin(reference() * 60.0)
    motor = simulate_torque_driven(axis, torque, RATE).true_motor_position
    for make in (
        lambda e: simulate_closed_loop(axis, LOOP, reference(), RATE, sensors=sensors, seed=5, effects=e),
        lambda e: simulate_torque_driven(axis, torque, RATE, effects=e),
        lambda e: simulate_motor_driven(axis, motor, RATE, effects=e),
    ):
        assert fields(make(off)) == fields(make(()))


@EVERY
def test_example_changes_the_record(effect: Effect):
    on = (EffectValues(effect.name, effect.examples),)
    base = simulate_closed_loop(Axis(), LOOP, reference(), RATE)
    run = simulate_closed_loop(Axis(), LOOP, reference(), RATE, effects=on)
    assert fields(run) != fields(base)
    again = simulate_closed_loop(Axis(), LOOP, reference(), RATE, effects=on)
    assert fields(run) == fields(again)
    assert all(name.startswith(effect.name + ".") for name in run.states)
    assert len(run.states) == len(effect.states)


def cycle_work(axis: Axis, effect: Effect) -> tuple[float, float]:
    """Work that one steady cycle takes beyond the axis's own friction, and the work that goes back and forth."""
    rate, turn, cycles = 8000.0, 8000, 6
    phase = np.arange(cycles * turn + 200) * 2.0 * np.pi / turn
    motor = 0.03 * np.sin(phase) + 0.01 * np.sin(2.0 * phase + 0.4)
    run = simulate_motor_driven(axis, motor, rate, effects=(EffectValues(effect.name, effect.examples),))
    last = slice(-200 - turn, -200)
    sign_motor = np.tanh(run.motor_velocity / axis.reversal_velocity)
    own = axis.FVm * run.motor_velocity**2 + axis.FSm * run.motor_velocity * sign_motor
    sign_load = np.tanh(run.joint_velocity / axis.reversal_velocity)
    own += axis.FV * run.joint_velocity**2 + axis.FS * run.joint_velocity * sign_load
    power = run.torque * run.motor_velocity
    return float(np.mean((power - own)[last])), float(np.mean(np.abs(power)[last]))


@pytest.mark.parametrize("effect", [e for e in effects() if e.energy != "exchanges"], ids=lambda e: e.name)
def test_no_effect_creates_energy_over_a_cycle(effect: Effect):
    """Periodic motion of the motor, load in steady state: what is stored comes back, what is missing was taken."""
    taken, scale = cycle_work(Axis(FV=600.0, reversal_velocity=5e-3), effect)
    if effect.energy == "conserves":
        assert abs(taken) < 2e-5 * scale
    else:
        assert taken > 1e-5 * scale


@EVERY
def test_alone_with_set_valued_friction_and_all_together(effect: Effect):
    """With stick and slip, and together with all others: finite, same bytes, and not beyond the limits of steps."""
    dry = replace(Axis(), reversal_velocity=0.0)
    on = EffectValues(effect.name, effect.examples)
    run = simulate_closed_loop(dry, LOOP, reference(1500), RATE, effects=(on,))
    assert np.all(np.isfinite(run.torsion))
    everything = tuple(EffectValues(e.name, e.examples) for e in effects())
    first = simulate_closed_loop(dry, LOOP, reference(800), RATE, effects=everything)
    second = simulate_closed_loop(dry, LOOP, reference(800), RATE, effects=everything[::-1])
    assert fields(first) == fields(second)


def test_stages_have_the_order_of_the_kernel():
    from flexid_cli.simulate import kernel

    for stage in Stage:
        assert getattr(kernel, stage.name) == stage
    assert InitialState(0.0, 0.0).motor_velocity == 0.0
