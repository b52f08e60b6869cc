"""The simulation against closed forms."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from flexid_cli.effects.base import EffectValues
from flexid_cli.effects.transmission.hysteresis import _slip, _yielding
from flexid_cli.errors import UsageError
from flexid_cli.simulate.engine import simulate_closed_loop, simulate_motor_driven, simulate_torque_driven
from flexid_cli.simulate.machine import ACCURATE, Axis, Controller, InitialState, Sensors, Solver

LINEAR = Axis(FSm=0.0, FS=0.0, MX=0.0, MY=0.0)
SMALL = Axis(Jm=0.01, K=60.0, JL=0.02, FVm=0.05, FSm=0.0, FV=0.02, FS=0.0, MX=0.0, MY=0.0)
BOLTED = replace(LINEAR, JL=1e15, FVm=0.0, FV=0.0)  # the load does not move
RATE = 1000.0


def matrices(axis: Axis) -> tuple[np.ndarray, np.ndarray]:
    """State (qm, q, qm', q'), input torque."""
    A = np.zeros((4, 4))
    A[0, 2] = A[1, 3] = 1.0
    A[2] = np.array([-axis.K, axis.K, -axis.FVm, 0.0]) / axis.Jm
    A[3] = np.array([axis.K, -axis.K, 0.0, -axis.FV]) / axis.JL
    return A, np.array([0.0, 0.0, 1.0 / axis.Jm, 0.0])


def discrete(axis: Axis, step: float) -> tuple[np.ndarray, np.ndarray]:
    A, B = matrices(axis)
    big = np.zeros((5, 5))
    big[:4, :4], big[:4, 4] = A, B
    e = expm(big * step)
    return e[:4, :4], e[:4, 4]


def worst(a: np.ndarray, b: np.ndarray) -> float:
    """Largest difference relative to the largest value."""
    return float(np.abs(a - b).max() / np.abs(b).max())


@pytest.mark.parametrize("axis", [LINEAR, SMALL], ids=["large", "small"])
def test_linear_axis_under_torque_follows_the_matrix_exponential(axis):
    torque = np.repeat(np.random.default_rng(1).normal(0.0, axis.K * 1e-3, 100), 20)
    run = simulate_torque_driven(axis, torque, RATE)
    phi, gamma = discrete(axis, 1.0 / RATE)
    x = np.zeros((torque.size, 4))
    for i in range(torque.size - 1):
        x[i + 1] = phi @ x[i] + gamma * torque[i]
    assert worst(run.true_motor_position, x[:, 0]) < 1e-8
    assert worst(run.torsion, x[:, 0] - x[:, 1]) < 1e-8
    assert worst(run.joint_velocity, x[:, 3]) < 1e-8
    np.testing.assert_allclose(run.joint_torque, axis.K * run.torsion, rtol=1e-12)


def test_linear_closed_loop_follows_the_exact_recurrence():
    controller = Controller(kp=8.0, kv=3000.0, ki=8000.0, velocity_feedforward=0.7)
    reference = 0.05 * np.sin(2 * np.pi * 1.3 * np.arange(4000) / RATE) ** 3
    run = simulate_closed_loop(LINEAR, controller, reference, RATE)
    phi, gamma = discrete(LINEAR, 1.0 / RATE)
    x = np.zeros(4)
    integral, motor_before, wanted_before = 0.0, 0.0, reference[0]
    torque, torsion = np.empty(reference.size), np.empty(reference.size)
    for i, wanted in enumerate(reference):
        error = controller.kp * (wanted - x[0]) + 0.7 * (wanted - wanted_before) * RATE
        error -= (x[0] - motor_before) * RATE
        integral += error / RATE
        torque[i] = controller.kv * error + controller.ki * integral
        torsion[i] = x[0] - x[1]
        motor_before, wanted_before = x[0], wanted
        x = phi @ x + gamma * torque[i]
    assert worst(run.torque, torque) < 1e-8
    assert worst(run.torsion, torsion) < 1e-8


def test_resonance_and_antiresonance():
    """Steady response to sines: the transfer function's values, least at the antiresonance, most at the resonance."""
    A, B = matrices(LINEAR)
    frequencies = np.array([0.8, 0.97, 1.0, 1.03, 1.25])
    for centre, extreme in ((LINEAR.antiresonance_hz, np.argmin), (LINEAR.resonance_hz, np.argmax)):
        gains = []
        for f in centre * frequencies:
            samples = 400
            rate = samples * f
            time = np.arange(40 * samples) / rate
            run = simulate_torque_driven(LINEAR, 100.0 * np.sin(2 * np.pi * f * time), rate, hold="linear")
            last = slice(-4 * samples, None)
            # Velocity, because the position also keeps a constant from the start.
            wave = np.exp(-2j * np.pi * f * time[last])
            response = np.mean(run.motor_velocity[last] * wave) / np.mean(run.acting_torque[last] * wave)
            s = 2j * np.pi * f
            exact = (s * np.linalg.solve(s * np.eye(4) - A, B))[0]
            assert response == pytest.approx(exact, rel=2e-3)
            gains.append(abs(exact / s) * f)
        assert extreme(gains) == 2


def test_motor_driven_gives_the_exact_torque():
    """A sine of the motor: the load's steady motion and the torque by the transfer functions."""
    f, amplitude = 2.1, 0.05
    s = 2j * np.pi * f
    time = np.arange(30_000) / RATE
    run = simulate_motor_driven(LINEAR, amplitude * np.sin(2 * np.pi * f * time), RATE)
    joint = LINEAR.K / (LINEAR.JL * s**2 + LINEAR.FV * s + LINEAR.K)
    torque = LINEAR.Jm * s**2 + LINEAR.FVm * s + LINEAR.K * (1 - joint)
    late = slice(22_000, -50)  # the start has died out; before the spline's end
    wave = amplitude * np.exp(s * time[late])
    assert worst(run.torque[late], (torque * wave).imag) < 1e-6
    assert worst(run.torsion[late], ((1 - joint) * wave).imag) < 1e-6


def test_motor_driven_agrees_with_torque_driven():
    torque = 200.0 * np.sin(np.linspace(0.0, 30.0, 5000)) ** 3
    effects = (
        EffectValues("hysteresis", {"hysteresis_torque": 15.0}),
        EffectValues("cogging", {"cogging_torque": 5.0}),
    )
    first = simulate_torque_driven(Axis(), torque, RATE, hold="linear", effects=effects)
    initial = InitialState(first.true_motor_position[0], first.true_joint_position[0])
    again = simulate_motor_driven(Axis(), first.true_motor_position, RATE, effects=effects, initial=initial)
    inside = slice(20, -20)
    assert worst(again.torsion[inside], first.torsion[inside]) < 1e-4
    assert worst(again.torque[inside], torque[inside]) < 2e-3


def torsion_wave(amplitude: float, n: int = 4000) -> np.ndarray:
    time = np.arange(n) / RATE
    return amplitude * np.sin(2 * np.pi * time) * (0.4 + 0.15 * time)


def test_dahl_loop_follows_its_formula():
    """Between turns of the torsion z = s F + (z0 - s F) exp(-|d - d0| / dh)."""
    force, length = 15.0, 1e-3
    d = torsion_wave(5e-3)
    values = {"hysteresis_torque": force, "hysteresis_length": length}
    run = simulate_motor_driven(
        BOLTED, d, RATE, effects=(EffectValues("hysteresis", values),), initial=InitialState(0.0, 0.0)
    )
    z, at = 0.0, 0.0
    from scipy.interpolate import make_interp_spline

    spline = make_interp_spline(np.arange(d.size), d, k=5)
    turns = make_interp_spline(np.arange(d.size), d, k=5).derivative()
    exact = np.empty(d.size)
    for i in range(d.size):
        low = max(i - 1, 0)
        if i and turns(low) * turns(i) < 0.0:
            from scipy.optimize import brentq

            turn = float(spline(brentq(turns, low, i, xtol=1e-12)))
            z, at = advance(z, at, turn, force, length), turn
        z, at = advance(z, at, float(d[i]), force, length), float(d[i])
        exact[i] = z
    assert worst(run.states["hysteresis.z"], exact) < 1e-6
    assert worst(run.joint_torque, BOLTED.K * d + exact) < 1e-6


def test_an_element_that_yields_with_a_square_follows_its_formula():
    """On its first way z' = (F / dh) (1 - (z / F)^2): z = F tanh(d / dh); in the simulation and in the columns."""
    force, length = 15.0, 1e-3
    d = np.linspace(0.0, 3e-3, 2000)
    values = {"hysteresis_torque": force, "hysteresis_length": length, "hysteresis_exponent": 2.0}
    run = simulate_motor_driven(
        BOLTED, d, RATE, effects=(EffectValues("hysteresis", values),), initial=InitialState(0.0, 0.0)
    )
    exact = np.tanh(d / length)
    assert worst(run.states["hysteresis.z"], force * exact) < 1e-6
    state = np.zeros(d.size)
    _yielding(d, length, 2.0, state)
    assert worst(state, exact) < 1e-4


def test_a_large_exponent_is_a_spring_that_slips():
    d = torsion_wave(5e-3)
    slider, state = np.zeros(d.size), np.zeros(d.size)
    _slip(d, 1e-3, slider)
    _yielding(d, 1e-3, 200.0, state)
    assert np.std(state - slider) < 0.01 * np.std(slider)


def advance(z: float, start: float, end: float, force: float, length: float) -> float:
    side = math.copysign(force, end - start)
    return side + (z - side) * math.exp(-abs(end - start) / length)


def test_backlash_loop_is_the_dead_zone():
    d = torsion_wave(5e-3)
    run = simulate_motor_driven(
        BOLTED, d, RATE, effects=(EffectValues("backlash", {"gap": 2e-3}),), initial=InitialState(0.0, 0.0)
    )
    exact = BOLTED.K * np.sign(d) * np.maximum(np.abs(d) - 1e-3, 0.0)
    assert worst(run.joint_torque, exact) < 1e-9


DRY = replace(LINEAR, FSm=40.0, FVm=0.0, FV=0.0, reversal_velocity=0.0)


def test_stuck_axis_stays_where_it_is():
    """Pushed, released to just below the level: ten seconds without the last bit of a creep."""
    torque = np.concatenate([np.full(300, 100.0), np.full(12_000, 39.9)])
    axis = replace(DRY, FV=400.0, FS=5.0)
    run = simulate_torque_driven(axis, torque, RATE)
    held = run.true_motor_position[2300:]
    assert held[0] > 1e-3
    assert np.all(held == held[0])
    assert np.all(run.motor_velocity[2300:] == 0.0)
    late = run.true_joint_position[2300:]
    assert np.all(late[-8000:] == late[-1])
    # The spring's torque is held by the load's friction within its level.
    assert abs(run.joint_torque[-1]) <= 5.0


def test_rigid_pair_stops_when_the_formula_says():
    """Two equal motions: no torsion, so each mass slides as one with constant deceleration."""
    axis = replace(DRY, Jm=100.0, JL=50.0, FSm=40.0, FS=20.0)
    speed = 0.2
    initial = InitialState(0.0, 0.0, speed, speed)
    run = simulate_torque_driven(axis, np.zeros(2000), RATE, initial=initial)
    deceleration = 0.4
    stop = speed / deceleration
    time = np.minimum(run.time_s, stop)
    exact = speed * time - 0.5 * deceleration * time**2
    assert worst(run.true_motor_position, exact) < 1e-12
    assert np.all(run.motor_velocity[run.time_s > stop] == 0.0)


def test_breaking_loose_at_the_level():
    """A torque that grows linearly: the motor starts when it reaches the level, not before."""
    slope = 100.0
    time = np.arange(1000) / RATE
    run = simulate_torque_driven(replace(DRY, FSm=33.33), slope * time, RATE, hold="linear")
    start = 0.3333
    assert np.all(run.true_motor_position[time <= start] == 0.0)
    early = (time > start) & (time < start + 0.02)  # before the spring matters
    exact = slope * (time[early] - start) ** 3 / (6.0 * DRY.Jm)
    assert np.abs(run.true_motor_position[early] / exact - 1.0).max() < 0.01


def test_no_chatter():
    """Slow motion with stick and slip takes steps like a smooth one."""
    reference = 0.02 * np.sin(2 * np.pi * 0.2 * np.arange(20_000) / RATE)
    axis = replace(Axis(), reversal_velocity=0.0)
    effects = (EffectValues("stribeck_motor", {"stribeck_torque": 30.0, "stribeck_velocity": 0.01}),)
    run = simulate_closed_loop(axis, Controller(8.0, 3000.0, 8000.0), reference, RATE, effects=effects)
    assert run.steps < 3 * reference.size
    stuck = np.mean(run.motor_velocity == 0.0)
    assert 0.005 < stuck < 0.9


def test_fixed_steps_are_checked():
    torque = 300.0 * np.sin(np.arange(3000) / 40.0)
    exact = simulate_torque_driven(Axis(), torque, RATE, solver=ACCURATE)
    fine = simulate_torque_driven(Axis(), torque, RATE, solver=Solver(substeps=8))
    assert worst(fine.torsion, exact.torsion) < 1e-6
    assert worst(fine.torsion, exact.torsion) < fine.error + 1e-9
    assert fine.steps == 8 * (torque.size - 1)
    with pytest.raises(UsageError, match="too coarse"):
        simulate_torque_driven(
            replace(Axis(), reversal_velocity=1e-4), torque, RATE, solver=Solver(substeps=1)
        )


def test_default_accuracy_against_the_accurate_mode():
    reference = 0.05 * np.sin(np.arange(5000) / 60.0)
    controller = Controller(8.0, 3000.0, 8000.0)
    for axis in (Axis(), replace(Axis(), reversal_velocity=0.0), replace(SMALL, FSm=0.02, FS=0.01)):
        scale = axis.Jm / Axis().Jm
        loop = Controller(controller.kp, controller.kv * scale, controller.ki * scale)
        plain = simulate_closed_loop(axis, loop, reference, RATE)
        exact = simulate_closed_loop(axis, loop, reference, RATE, solver=ACCURATE)
        assert worst(plain.torsion, exact.torsion) < 1e-5


def test_controller_with_its_own_period():
    """A controller four times slower than the record is the same as a record at its rate."""
    reference = 0.02 * np.sin(np.arange(4001) / 300.0)
    slow = Controller(8.0, 3000.0, 8000.0, period_s=4.0 / RATE)
    fine = simulate_closed_loop(Axis(), slow, reference, RATE)
    coarse = simulate_closed_loop(Axis(), replace(slow, period_s=None), reference[::4], RATE / 4.0)
    assert worst(fine.torsion[::4], coarse.torsion) < 1e-6
    assert np.all(fine.torque[:-1].reshape(-1, 4) == fine.torque[:-1:4, None])


def test_controller_faster_than_the_record():
    reference = 0.02 * np.sin(np.arange(1001) / 75.0)
    fast = Controller(8.0, 3000.0, 8000.0, period_s=0.25 / 250.0)
    run = simulate_closed_loop(Axis(), fast, reference, 250.0)
    assert run.torque.size == reference.size
    fine = simulate_closed_loop(
        Axis(),
        replace(fast, period_s=None),
        np.interp(np.arange(4001) / 4.0, np.arange(1001), reference),
        RATE,
    )
    assert worst(run.torsion, fine.torsion[::4]) < 1e-6


def test_sensors():
    reference = 0.02 * np.sin(np.arange(20_000) / 300.0)
    controller = Controller(8.0, 3000.0, 8000.0)
    clean = simulate_closed_loop(Axis(), controller, reference, RATE)
    sensors = Sensors(torque_noise=2.0, joint_noise=1e-5, joint_noise_time_s=0.01, joint_zero=0.3)
    noisy = simulate_closed_loop(Axis(), controller, reference, RATE, sensors=sensors, seed=3)
    again = simulate_closed_loop(Axis(), controller, reference, RATE, sensors=sensors, seed=3)
    other = simulate_closed_loop(Axis(), controller, reference, RATE, sensors=sensors, seed=4)
    assert noisy.torque.tobytes() == again.torque.tobytes()
    assert noisy.joint_position.tobytes() == again.joint_position.tobytes()
    assert noisy.torque.tobytes() != other.torque.tobytes()
    white = noisy.torque - clean.torque
    assert white.std() == pytest.approx(2.0, rel=0.03)
    assert abs(np.corrcoef(white[1:], white[:-1])[0, 1]) < 0.03
    coloured = noisy.joint_position - clean.joint_position - 0.3
    assert coloured.std() == pytest.approx(1e-5, rel=0.15)
    assert np.corrcoef(coloured[1:], coloured[:-1])[0, 1] == pytest.approx(math.exp(-0.1), abs=0.02)


def test_delays_and_resolution():
    reference = 0.02 * np.sin(np.arange(3000) / 60.0)
    controller = Controller(8.0, 3000.0, 8000.0)
    clean = simulate_closed_loop(Axis(), controller, reference, RATE)
    late = simulate_closed_loop(
        Axis(), controller, reference, RATE, sensors=Sensors(joint_delay_s=3e-3, torque_delay_s=2e-3)
    )
    np.testing.assert_allclose(late.joint_position[3:], clean.joint_position[:-3], rtol=1e-9, atol=1e-15)
    np.testing.assert_array_equal(late.torque[2:], clean.torque[:-2])
    early = simulate_closed_loop(
        Axis(), controller, reference, RATE, effects=(EffectValues("clock_skew", {"skew": -2e-3}),)
    )
    np.testing.assert_allclose(early.joint_position[:-2], clean.joint_position[2:], rtol=1e-9, atol=1e-15)
    half = simulate_closed_loop(
        Axis(), controller, reference, RATE, effects=(EffectValues("clock_skew", {"skew": 5e-4}),)
    )
    fine = simulate_closed_loop(
        Axis(),
        replace(controller, period_s=1e-3),
        np.interp(np.arange(5999) / 2, np.arange(3000), reference),
        2 * RATE,
    )
    # Hermite's cubic between samples: least exact where friction turns round.
    assert worst(half.joint_position[1:], fine.true_joint_position[1:-1:2]) < 1e-6
    coarse = simulate_closed_loop(
        Axis(), controller, reference, RATE, sensors=Sensors(motor_resolution=1e-5, joint_resolution=1e-4)
    )
    for values, lsb in ((coarse.motor_position, 1e-5), (coarse.joint_position, 1e-4)):
        np.testing.assert_allclose(values / lsb, np.round(values / lsb), atol=1e-6)
    assert np.abs(coarse.joint_position - coarse.true_joint_position).max() <= 0.5001e-4
    # A late motor encoder is in the loop: the measured position is the true one of before.
    loop = simulate_closed_loop(Axis(), controller, reference, RATE, sensors=Sensors(motor_delay_s=2.5e-3))
    true = loop.true_motor_position
    middle = (9.0 * (true[1:-2] + true[2:-1]) - true[:-3] - true[3:]) / 16.0
    np.testing.assert_allclose(loop.motor_position[10:], middle[6:-1], atol=2e-8)
    whole = simulate_closed_loop(Axis(), controller, reference, RATE, sensors=Sensors(motor_delay_s=2e-3))
    np.testing.assert_allclose(
        whole.motor_position[2:], whole.true_motor_position[:-2], rtol=1e-9, atol=1e-14
    )


def pushed(
    axis: Axis = LINEAR, torque: np.ndarray | None = None, rate: float = RATE, **values: dict[str, float]
):
    """Torque-driven run with effects by name."""
    effects = tuple(EffectValues(name, given) for name, given in values.items())
    return simulate_torque_driven(axis, np.zeros(10) if torque is None else torque, rate, effects=effects)


WILD = np.sin(np.arange(3000.0))
REFUSED = {
    "no numbers": lambda: pushed(torque=np.array([1.0, np.nan, 2.0])),
    "rate": lambda: pushed(rate=0.0),
    "positive": lambda: pushed(replace(LINEAR, Jm=-1.0)),
    "no effect": lambda: pushed(backlsh={}),
    "not possible": lambda: pushed(backlash={"gap": -1.0}),
    "no parameter": lambda: pushed(backlash={"gp": 1.0}),
    "unstable": lambda: simulate_closed_loop(LINEAR, Controller(8.0, 1e7, 0.0), WILD, RATE),
    "stiff": lambda: pushed(replace(Axis(), reversal_velocity=1e-9), WILD),
}


@pytest.mark.parametrize("words", REFUSED)
def test_refusals(words):
    with pytest.raises(UsageError, match=words):
        REFUSED[words]()


def test_controller_from_the_configuration():
    from flexid_cli.config.schema import Controller as Section

    section = Section(kp=1.6, kv=2.7, ki=2.2, period_s=0.002)
    assert Controller.from_config(section) == Controller(1.6, 2.7, 2.2, 1.0, 0.002)
    for unknown in (None, Section(law="external")):
        with pytest.raises(UsageError, match="not known"):
            Controller.from_config(unknown)


def test_threads_compile_and_run_at_once():
    """Many threads, first use included, give what one thread gives."""
    from concurrent.futures import ThreadPoolExecutor

    reference = 0.03 * np.sin(np.arange(500) / 50.0)

    def one(gap: float) -> bytes:
        effects = (
            EffectValues("backlash", {"gap": gap}),
            EffectValues("joint_damping", {"joint_damping": 5.0}),
        )
        run = simulate_closed_loop(Axis(), Controller(8.0, 3000.0, 8000.0), reference, RATE, effects=effects)
        return run.torsion.tobytes()

    gaps = np.linspace(1e-4, 1e-3, 16)
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(one, gaps))
    assert together == [one(gap) for gap in gaps]
