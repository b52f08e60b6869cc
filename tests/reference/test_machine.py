"""The benchmarks' own machine, against mathematics: what judges the tool must itself be right."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.machine import Axis, Controller, Sensors, draw, rms, simulate
from benchmarks.machine import effects as effects_module
from benchmarks.machine.axis import EXTRA, MEANS
from benchmarks.machine.cases import LISTS, NONE, case, configuration, make, tasks, write_case
from benchmarks.machine.effects import LIBRARY, OUTSIDE, Scene, applied, share, variants
from flexid_cli.config.load import load_config
from flexid_cli.signals.build import build_recording

RATE = 500.0
LINEAR = Axis(Jm=2.0, JL=1.5, K=3000.0, FVm=1.0, FSm=0.0, FV=0.4, FS=0.0)
ROUGH = Axis(Jm=2.0, JL=1.5, K=3000.0, FVm=1.0, FSm=2.0, FV=0.4, FS=0.6, MX=0.1, MY=-0.2, v0=2e-3, v0l=2e-3)
GAINS = Controller(kp=4.0, kv=40.0, ki=60.0)
FORMS = [*LIBRARY, *OUTSIDE]
SHORT = (6.0, 7.0)


def _path(seconds=4.0, rate=RATE, seed=3):
    limits = draw.Limits(travel=0.5, speed=2.0, acceleration=15.0)
    return draw.reference(np.random.default_rng(seed), "rich", limits, rate, seconds)


def _scene(seconds=4.0):
    record = simulate(ROUGH, GAINS, _path(seconds), RATE)
    return record, Scene.of(ROUGH, 100.0, record)


def _form(effect):
    return f"{effect.kind}-{'-'.join((*effect.scale, *effect.divide))}"


def test_linear_axis_is_the_matrix_exponential():
    a, path = LINEAR, _path()
    record = simulate(a, GAINS, path, RATE)
    A = np.zeros((5, 5))
    A[0, 1] = A[2, 3] = 1.0
    A[1] = [-a.K / a.Jm, -a.FVm / a.Jm, a.K / a.Jm, 0.0, 1.0 / a.Jm]
    A[3, :4] = [a.K / a.JL, 0.0, -a.K / a.JL, -a.FV / a.JL]
    step = expm(A / RATE)
    x, previous, integral = np.zeros(5), 0.0, 0.0
    exact = np.empty((path.size, 3))
    for i, ref in enumerate(path):
        error = GAINS.kp * (ref - x[0]) + (ref - path[max(i - 1, 0)]) * RATE - (x[0] - previous) * RATE
        integral += error / RATE
        previous, x[4] = x[0], GAINS.kv * error + GAINS.ki * integral
        exact[i] = x[0], x[2], x[4]
        x = step @ x
    assert np.max(np.abs(record.motor_position - exact[:, 0])) < 1e-9
    assert np.max(np.abs(record.joint_position - exact[:, 1])) < 1e-9
    assert np.max(np.abs(record.motor_torque - exact[:, 2])) < 1e-6 * rms(exact[:, 2])


@pytest.mark.parametrize("seed", range(3))
def test_steps_are_short_enough(seed):
    rng = np.random.default_rng(seed)
    plant = draw.plant(rng)
    path = draw.reference(rng, "rich", plant.limits, plant.rate_hz, 6.0)
    # Ideal encoders: in the loop, a count that falls the other way would hide the integrator's own error.
    runs = [simulate(plant.axis, plant.controller, path, plant.rate_hz, substeps=n) for n in (None, 32)]
    finest = 2.0 * np.pi / 2**21
    for position in ("motor_position", "joint_position"):
        error = np.max(np.abs(getattr(runs[0], position) - getattr(runs[1], position)))
        assert error < finest / 100.0


@pytest.mark.parametrize("effect", FORMS, ids=_form)
def test_equations_hold_with_the_effect(effect):
    """The means of each period satisfy both equations, and the effect's part is the one written down for it."""
    record, scene = _scene()
    axis, extra = applied(ROUGH, effect.draw(np.random.default_rng(1), scene))
    m = simulate(axis, GAINS, _path(), RATE, {effect.kind: extra}).truth
    motor = axis.Jm * m.means["qm_dd"] + axis.FVm * m.means["qm_d"] + axis.FSm * m.means["sgn_m"]
    assert np.allclose(motor + m.means["T"] + m.means["motor"], m.acting_torque, atol=1e-9 * m.torque_rms)
    load = axis.JL * m.means["q_dd"] + axis.FV * m.means["q_d"] + axis.FS * m.means["sgn_l"] + m.means["load"]
    load += axis.gravity * (axis.MX * m.means["cos_q"] + axis.MY * m.means["sin_q"])
    assert np.allclose(load, m.means["T"], atol=1e-9 * m.torque_rms)
    assert np.allclose(axis.K * m.means["d"] + m.means["trans"], m.means["T"], atol=1e-9 * m.torque_rms)
    quiet = {"motor": "motor", "transmission": "trans", "load": "load"}
    for where, name in quiet.items():
        assert (rms(m.means[name]) > 0.0) == (where == effect.where and effect.kind != "gravity")
    assert record.truth.torque_rms > 0.0


@pytest.mark.parametrize("effect", FORMS, ids=_form)
def test_no_size_is_no_effect(effect):
    record, scene = _scene(2.0)
    parameters = effect.draw(np.random.default_rng(1), scene)
    nothing = {**parameters, **dict.fromkeys(effect.scale, 0.0)}
    if effect.kind == "thermal_drift":  # it scales a parameter of the axis
        nothing = {"FVm": ROUGH.FVm, "therm_gain": 0.0, "therm_tau": 1.0}
    if effect.kind == "gravity":
        nothing = {"MX": ROUGH.MX, "MY": ROUGH.MY}
    if effect.divide:  # an endless limit; a second mass that is stiff, and none
        nothing = (
            {"sat": 1e9} if "sat" in parameters else {"JL": ROUGH.JL, "m2_J": 0.0, "m2_K": 1.0, "m2_c": 1.0}
        )
    axis, extra = applied(ROUGH, nothing)
    same = simulate(axis, GAINS, _path(2.0), RATE, {effect.kind: extra})
    for name in ("motor_torque", "motor_position", "joint_position"):
        assert np.array_equal(getattr(same, name), getattr(record, name))


def test_a_stiff_second_mode_is_one_mass():
    record = simulate(ROUGH, GAINS, _path(2.0), RATE)
    axis = dataclasses.replace(ROUGH, JL=1.0)
    split = simulate(
        axis, GAINS, _path(2.0), RATE, {"second_mode": {"m2_J": 0.5, "m2_K": 3e6, "m2_c": 150.0}}, substeps=40
    )
    assert np.max(np.abs(split.joint_position - record.joint_position)) < 2e-3 * np.ptp(record.joint_position)


def _spring_energy(extra):
    """Work that a torsion cycle leaves behind in the transmission: none may come out of it."""
    axis = dataclasses.replace(ROUGH, FV=0.0, FS=0.0, MX=0.0, MY=0.0)
    record = simulate(axis, GAINS, _path(6.0), RATE, {"x": extra}, substeps=40)
    means = record.truth.means
    relative = means["qm_d"] - means["q_d"]
    return np.cumsum(means["trans"] * relative) / RATE, means


@pytest.mark.parametrize(
    "extra", [{"hyst_f": 1.0, "hyst_d": 1e-3}, {"slip_f": 1.0, "slip_d": 1e-3}, {"c": 3.0}]
)
def test_no_energy_from_nothing(extra):
    """A passive element can give back what it stored, and no more: the work done on it never falls below zero."""
    work, means = _spring_energy(extra)
    assert work[-1] > 0.0
    assert np.min(work) > -1e-3 * work[-1]
    assert rms(means["trans"]) > 0.01


@pytest.mark.parametrize("extra", [{"k3": 1e7}, {"pw_k": 1500.0, "pw_d": 2e-3}, {"gap": 1e-3}])
def test_springs_keep_no_energy(extra):
    """What an elastic element holds is a function of its torsion: after any way there and back, nothing is left."""
    work, means = _spring_energy(extra)
    d = means["d"]
    near = np.abs(d) < 2e-5
    assert near.sum() > 20
    assert np.max(np.abs(work[near])) < 0.02 * np.max(np.abs(work))


def test_dahl_element_turns_back_on_its_own_curve():
    """Its textbook loop: from +F, a way of s back leads to F (2 exp(-s / length) - 1)."""
    from benchmarks.machine.axis import _dahl, _slip

    assert _dahl(2.0, -0.3, 2.0, 0.1) == pytest.approx(2.0 * (2.0 * np.exp(-3.0) - 1.0))
    halves = _dahl(_dahl(0.4, 0.05, 2.0, 0.1), 0.05, 2.0, 0.1)
    assert halves == pytest.approx(_dahl(0.4, 0.1, 2.0, 0.1))
    assert sum(_slip(0.0, 1.0, 2.0, 0.1, k) for k in range(4)) == pytest.approx(2.0)
    assert sum(_slip(0.0, -1.0, 2.0, 0.1, k) for k in range(4)) == pytest.approx(-2.0)


def test_energy_decays_when_nothing_drives():
    """Released from a twist, without a controller, the energy only falls."""
    axis = dataclasses.replace(ROUGH, MX=0.0, MY=0.0)
    idle = Controller(kp=0.0, kv=0.0, ki=0.0)
    kick = {"dist_l": 0.0, "kt_a": 0.0}
    free = simulate(axis, idle, np.zeros(50), RATE, {"x": kick})
    assert np.all(free.motor_position == 0.0)  # at rest it stays at rest
    driven = simulate(axis, GAINS, _path(2.0), RATE)
    m = driven.truth.means
    power_in = np.sum(driven.truth.acting_torque * m["qm_d"]) / RATE
    friction = np.sum((axis.FVm * m["qm_d"] + axis.FSm * m["sgn_m"]) * m["qm_d"]) / RATE
    friction += np.sum((axis.FV * m["q_d"] + axis.FS * m["sgn_l"]) * m["q_d"]) / RATE
    x = driven.truth
    v = np.gradient(x.motor_position[-9:], 1.0 / RATE)[4], np.gradient(x.joint_position[-9:], 1.0 / RATE)[4]
    stored = 0.5 * axis.Jm * v[0] ** 2 + 0.5 * axis.JL * v[1] ** 2
    stored += 0.5 * axis.K * (x.motor_position[-5] - x.joint_position[-5]) ** 2
    assert power_in == pytest.approx(friction + stored, rel=0.03)


def test_skew_is_a_delay_of_the_joint_channel():
    shift = 3.0 / RATE
    plain = simulate(ROUGH, GAINS, _path(2.0), RATE)
    late = simulate(ROUGH, GAINS, _path(2.0), RATE, {"clock_skew": {"skew": shift}})
    assert np.allclose(late.joint_position[3:], plain.joint_position[:-3], atol=1e-12)
    part = simulate(ROUGH, GAINS, _path(2.0), RATE, {"clock_skew": {"skew": 0.4 / RATE}})
    fine = simulate(ROUGH, GAINS, _path(2.0), RATE).truth
    estimate = plain.joint_position - 0.4 / RATE * np.gradient(fine.joint_position, 1.0 / RATE)
    assert np.max(np.abs(part.joint_position - estimate)[5:-5]) < 2e-5


def test_sensor_lag_is_of_first_order():
    tau = 0.01
    record = simulate(ROUGH, GAINS, _path(2.0), RATE, {"sensor_lag": {"joint_lag": tau}})
    back = record.joint_position + tau * np.gradient(record.joint_position, 1.0 / RATE)
    assert np.max(np.abs(back - record.truth.joint_position)[5:-5]) < 1e-4


def test_noise_has_its_size_and_colour():
    quiet = simulate(ROUGH, GAINS, _path(), RATE)
    for corner, correlation in ((0.0, 0.0), (30.0, np.exp(-2.0 * np.pi * 30.0 / RATE))):
        sensors = Sensors(torque_noise=0.5, torque_noise_corner_hz=corner)
        noise = (
            simulate(ROUGH, GAINS, _path(), RATE, sensors=sensors, seed=5).motor_torque - quiet.motor_torque
        )
        assert np.std(noise) == pytest.approx(0.5, rel=0.1)
        assert np.corrcoef(noise[1:], noise[:-1])[0, 1] == pytest.approx(correlation, abs=0.06)


def test_encoders_count():
    sensors = Sensors(motor_counts=4096.0, joint_counts=2.0**17, gear_ratio=50.0)
    record = simulate(ROUGH, GAINS, _path(1.0), RATE, sensors=sensors)
    for values, step in (
        (record.motor_position, sensors.motor_resolution),
        (record.joint_position, sensors.joint_resolution),
    ):
        assert np.allclose(values / step, np.round(values / step), atol=1e-6)
    assert (
        np.max(np.abs(record.motor_position - record.truth.motor_position))
        <= 0.5001 * sensors.motor_resolution
    )


def test_every_parameter_belongs_to_an_effect():
    _, scene = _scene(2.0)
    used = {name for effect in FORMS for name in effect.draw(np.random.default_rng(0), scene)}
    assert set(EXTRA) <= used
    assert used <= set(EXTRA) | {f.name for f in dataclasses.fields(Axis)}
    assert len(MEANS) == len(set(MEANS))
    with pytest.raises(KeyError):
        simulate(ROUGH, GAINS, _path(1.0), RATE, {"x": {"no_such": 1.0}})


def test_the_library_is_the_one_of_the_contract(root):
    names = {path.stem for path in (root / "flexid_cli" / "effects").glob("*/*.py")}
    assert set(effects_module.KINDS) <= names
    assert not set(effects_module.OUTSIDE_KINDS) & names


@pytest.mark.parametrize(
    "kind", ["cogging", "backlash", "torque_saturation", "second_mode", "gravity", "end_stop"]
)
def test_share_is_what_was_asked_for(kind):
    made = case(kind, 11, motor_only=kind == "gravity", seconds=SHORT)
    low, high = variants(kind)[0].shares
    assert 0.95 * low <= made.truth["share"][0] <= 1.05 * high
    effect = next(
        e for e in variants(kind) if set(e.scale + e.divide) & ({*made.truth["extra"]} | {"MX", "FVm"})
    )
    again = simulate(
        made.plant.axis,
        made.plant.controller,
        made.a.reference_position,
        made.a.rate_hz,
        {kind: made.truth["extra"]},
    )
    assert share(effect, again, made.plant.axis) == pytest.approx(made.truth["share"][0], rel=0.1)
    # The record itself, with its encoders and noise, has the same share; what measures adds to no equation.
    assert share(effect, made.a, made.plant.axis) == pytest.approx(made.truth["share"][0], rel=0.1)


def test_seeds_reproduce_bytes(tmp_path):
    first = case("backlash", 3, seconds=SHORT)
    again = make(first.task, json.loads(json.dumps(first.recipe)))
    other = case("backlash", 4, seconds=SHORT)
    for made, folder in ((first, "one"), (again, "two")):
        write_case(made, tmp_path / folder)
    for name in ("a.csv.gz", "b.csv.gz", "config.yaml", "facts.json", "truth.json"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()
    assert not np.array_equal(first.a.motor_torque[:100], other.a.motor_torque[:100])
    assert not np.array_equal(first.a.reference_position[:3000], first.b.reference_position[:3000])


@pytest.mark.parametrize("motor_only", [False, True])
def test_files_are_read_as_they_were_written(tmp_path, motor_only):
    made = case(NONE, 8, motor_only=motor_only, seconds=SHORT)
    write_case(made, tmp_path)
    config = load_config(tmp_path / "config.yaml")
    assert configuration(made)["version"] == 1
    recording, _ = build_recording([tmp_path / "a.csv.gz"], config)
    segment = recording.segments[0]
    assert recording.has_joint_position is not motor_only
    # hold: sample moves the torque's stamps by half a period, which costs a sample at the ends.
    n = segment.samples
    assert abs(n - made.a.time_s.size) <= 2
    shift = round((segment.start_s) * made.a.rate_hz)
    assert np.ptp(segment.motor_position) == pytest.approx(np.ptp(made.a.motor_position[shift:]), rel=1e-3)
    assert np.std(segment.torque) == pytest.approx(np.std(made.a.motor_torque), rel=0.02)


def test_lists_are_large_and_disjoint():
    names, seeds = set(), []
    for which in ("calibration", "test"):
        found = {group: tasks(group, which) for group in LISTS}
        assert len(found["singles"]) >= 300
        assert len(found["nulls"]) == 600
        assert min(len(found["pairs"]), len(found["motor_only"])) >= 100
        assert len(found["outside"]) >= 60
        every = [t for group in found.values() for t in group]
        names |= {t.name for t in every}
        seeds.append({t.seed for t in every})
        assert len(seeds[-1]) == len(every)
        kinds = [t.kinds[0] for t in found["singles"]]
        assert all(kinds.count(k) >= 12 for k in set(kinds))
    assert not seeds[0] & seeds[1]
    assert len(names) == sum(map(len, seeds))


def test_the_first_lists_stay_as_they_were():
    """What was measured on their seeds would not be comparable else."""
    first = ("singles", "nulls", "pairs", "motor_only", "outside")
    begun = {"nulls": 300, "pairs": 100}  # more stand behind them
    for which, digest in (("calibration", "b63d3d67b4d254cd"), ("test", "e12fc81cf9450fc3")):
        lists = {group: tasks(group, which) for group in first}
        every = [t for group in first for t in lists[group][: begun.get(group)]]
        text = repr([(t.group, t.kinds, t.seed, t.motor_only, t.seconds) for t in every])
        assert hashlib.sha256(text.encode()).hexdigest()[:16] == digest
        assert not any(t.near_rest for t in every)


def test_the_list_of_the_paper():
    found = tasks("paper", "calibration")
    assert all(t.motor_only and t.near_rest for t in found)
    assert {t.kinds for t in found} == set(effects_module.PAPER_KINDS)
    gravity = next(t for t in found if t.kinds == ("gravity",))
    made = make(replace(gravity, seconds=SHORT))
    # Eq. (17): at the rest position, about which the axis moves, gravity has no moment.
    assert made.truth["extra"] == {}
    assert made.truth["base"]["MX"] == 0.0
    assert made.truth["base"]["MY"] != 0.0
    assert abs(np.mean(made.a.motor_position)) < 0.2 * np.ptp(made.a.motor_position)


def test_dropped_friction_is_what_eq_18_leaves_of_the_torque():
    """By the torque and the motion of the motor, and the true X1 to X7: nothing of this is in `share`."""
    task = next(t for t in tasks("paper", "calibration") if t.kinds == ("dropped_friction",))
    made = make(replace(task, seconds=(12.0, 13.0)))
    a, record = made.plant.axis, made.a
    x1, x2 = a.JL / a.K, a.FV / a.K
    x4, x5 = (a.Jm * a.FV + a.JL * a.FVm) / a.K, a.Jm + a.JL + a.FV * a.FVm / a.K
    n = record.truth.acting_torque.size
    taper = np.hanning(n)
    torque, acceleration, velocity, sign = (
        np.fft.rfft(taper * x)
        for x in (record.truth.acting_torque, *(record.truth.means[k] for k in ("qm_dd", "qm_d", "sgn_m")))
    )
    s = 2j * np.pi * np.fft.rfftfreq(n, 1.0 / record.rate_hz)
    motion = (a.Jm * x1 * s**2 + x4 * s + x5) * acceleration + (a.FVm + a.FV) * velocity
    left = (1.0 + x2 * s + x1 * s**2) * torque - motion - a.FSm * sign
    left[np.abs(s) > 2.0 * np.pi * effects_module.DROPPED_BAND * a.free_hz] = 0.0
    size = rms(np.fft.irfft(left, n)) / rms(taper * record.truth.acting_torque)
    assert size == pytest.approx(made.truth["share"][0], rel=0.2)


@pytest.mark.parametrize("size", ["small", "medium", "large", None])
def test_axes_are_plausible(size):
    for seed in range(20):
        plant = draw.plant(np.random.default_rng(seed), size)
        a = plant.axis
        if size is not None:
            assert 1 / 1.5 < a.Jm / draw.SIZES[size] < 1.5
        assert 3.0 <= a.locked_motor_hz <= 25.0
        assert 0.3 <= a.JL / a.Jm <= 1.5
        assert draw._largest_pole(a, plant.controller, plant.rate_hz) < 1.0
