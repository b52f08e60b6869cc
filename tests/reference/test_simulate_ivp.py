"""The simulation against scipy's integrators, with the equations of every effect written here once more.

Smooth laws against Radau. Set-valued ones against an integration that ends at each event (scipy's root finding) and
goes on with the equations of the new mode.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from flexid_cli.effects.base import EffectValues
from flexid_cli.simulate.engine import simulate_torque_driven
from flexid_cli.simulate.machine import Axis, InitialState

RATE = 1000.0
KNOT = 100  # samples between corners of the torque
START = InitialState(0.03, 0.028, 0.05, 0.02)
SMOOTH = {
    "torque_offset": {"torque_offset": 20.0},
    "viscous_asymmetry": {"viscous_asymmetry": 80.0},
    "stribeck_motor": {"stribeck_torque": 25.0, "stribeck_velocity": 0.03},
    "viscous_nonlinear": {"quadratic_friction": 900.0, "power_friction": 30.0, "power_exponent": 0.6},
    "load_dependent_friction": {"load_friction_coefficient": 0.15},
    "cogging": {"cogging_torque": 30.0, "cogging_cycles": 250.0, "cogging_phase": 0.7},
    "actuator_lag": {"lag": 4e-3},
    "thermal_drift": {"friction_change": 0.6, "warming_time": 0.5},
    "joint_damping": {"joint_damping": 150.0},
    "hardening_stiffness": {"cubic_stiffness": 3e7},
    "hysteresis": {"hysteresis_torque": 25.0, "hysteresis_length": 1e-3},
    "transmission_error": {"error_amplitude": 1e-3, "error_cycles": 120.0, "error_phase": 0.4},
    "gravity": {"gravity_moment_x": 4.0, "gravity_moment_y": 9.0},
    "stribeck_load": {"stribeck_torque": 12.0, "stribeck_velocity": 0.03},
    "second_mode": {"second_inertia": 9.0, "second_stiffness": 3e4, "second_damping": 30.0},
    "payload_change": {"inertia_change": 15.0, "moment_change_x": 1.5, "time_of_change": 0.12},
}
MEASURED_ONLY = {"clock_skew", "sensor_lag", "encoder_eccentricity"}
KINKED = {"backlash", "torque_saturation"}


@dataclass
class Modes:
    """Which equations hold: friction of motor and load, side of the gap, side of the limit."""

    motor: float | None = None  # None: tanh
    load: float | None = None
    gap: int = 0
    limit: int = 0


class Machine:
    """The equations once more, straight from the table of effects."""

    def __init__(self, axis: Axis, values: dict[str, dict[str, float]], torque: np.ndarray) -> None:
        self.axis, self.values, self.torque = axis, values, torque
        self.names = [n for n in ("actuator_lag", "hysteresis", "second_mode") if n in values]

    def of(self, effect: str, name: str) -> float:
        return self.values.get(effect, {}).get(name, 0.0)

    def command(self, t: float) -> float:
        return float(np.interp(t, np.arange(self.torque.size) / RATE, self.torque))

    def parts(self, t: float, x: np.ndarray, modes: Modes) -> dict[str, float]:
        a, of = self.axis, self.of
        qm, q, vm, v = x[:4]
        extra = dict(zip(self.names, (4, 5 if "actuator_lag" in self.names else 4, 0), strict=False))
        u = self.command(t)
        limit = self.values.get("torque_saturation", {}).get("torque_limit", math.inf)
        if modes.limit:
            u = modes.limit * limit
        rates: list[float] = []
        if "actuator_lag" in self.names:
            rates.append((u - x[extra["actuator_lag"]]) / of("actuator_lag", "lag"))
            u = x[extra["actuator_lag"]]
        A, n, phi = (of("transmission_error", k) for k in ("error_amplitude", "error_cycles", "error_phase"))
        d = qm - q + A * math.sin(n * qm + phi)
        gear = 1.0 + A * n * math.cos(n * qm + phi)
        rate = gear * vm - v
        spring = d
        if "backlash" in self.values:
            spring = 0.0 if modes.gap == 0 else d - modes.gap * 0.5 * of("backlash", "gap")
        T = a.K * spring + of("hardening_stiffness", "cubic_stiffness") * spring**3
        T += of("joint_damping", "joint_damping") * rate
        if "hysteresis" in self.names:
            z = x[extra["hysteresis"]]
            length = of("hysteresis", "hysteresis_length")
            rates.append(of("hysteresis", "hysteresis_torque") / length * rate - abs(rate) * z / length)
            T += z
        warm = 1.0
        if "thermal_drift" in self.values:
            fall = math.exp(-t / of("thermal_drift", "warming_time")) - 1.0
            warm += of("thermal_drift", "friction_change") * fall
        other = a.torque_offset + of("torque_offset", "torque_offset") + a.FVm * warm * vm
        other += of("viscous_asymmetry", "viscous_asymmetry") * abs(vm)
        other += of("viscous_nonlinear", "quadratic_friction") * vm * abs(vm)
        other += of("cogging", "cogging_torque") * math.sin(
            of("cogging", "cogging_cycles") * qm + of("cogging", "cogging_phase")
        )
        level = a.FSm + of("load_dependent_friction", "load_friction_coefficient") * abs(T)
        if "stribeck_motor" in self.values:
            level += of("stribeck_motor", "stribeck_torque") * math.exp(
                -((vm / of("stribeck_motor", "stribeck_velocity")) ** 2)
            )
        if "viscous_nonlinear" in self.values:
            level += of("viscous_nonlinear", "power_friction") * abs(vm) ** of(
                "viscous_nonlinear", "power_exponent"
            )
        MX, MY = a.MX + of("gravity", "gravity_moment_x"), a.MY + of("gravity", "gravity_moment_y")
        JL = a.JL
        if "payload_change" in self.values and t >= of("payload_change", "time_of_change"):
            JL += of("payload_change", "inertia_change")
            MX += of("payload_change", "moment_change_x")
        load = a.FV * v + a.gravity * (MX * math.cos(q) + MY * math.sin(q))
        load_level = a.FS
        if "stribeck_load" in self.values:
            load_level += of("stribeck_load", "stribeck_torque") * math.exp(
                -((v / of("stribeck_load", "stribeck_velocity")) ** 2)
            )
        if "second_mode" in self.names:
            q2, v2 = x[-2:]
            force = of("second_mode", "second_stiffness") * (q2 - q) + of("second_mode", "second_damping") * (
                v2 - v
            )
            load -= force
            rates += [v2, -force / of("second_mode", "second_inertia")]
        return {
            "net": u - other - gear * T, "level": level, "load_net": T - load, "load_level": load_level, "JL": JL,
            "d": d, "T": T, "u": self.command(t), "rates": rates,
        }  # fmt: skip

    def rhs(self, t: float, x: np.ndarray, modes: Modes) -> np.ndarray:
        c = self.parts(t, x, modes)
        a = self.axis
        motor = math.tanh(x[2] / a.reversal_velocity) if modes.motor is None else modes.motor
        load = math.tanh(x[3] / a.reversal_velocity) if modes.load is None else modes.load
        am = 0.0 if modes.motor == 0 else (c["net"] - motor * c["level"]) / a.Jm
        al = 0.0 if modes.load == 0 else (c["load_net"] - load * c["load_level"]) / c["JL"]
        return np.array([x[2], x[3], am, al, *c["rates"]])

    def start(self) -> np.ndarray:
        extra = [0.0] * sum(n in self.names for n in ("actuator_lag", "hysteresis"))
        if "second_mode" in self.names:
            extra += [START.joint_position, START.joint_velocity]
        return np.array(
            [START.motor_position, START.joint_position, START.motor_velocity, START.joint_velocity, *extra]
        )


def torque_line(seconds: float, size: float, seed: int = 2) -> np.ndarray:
    """Torque that is straight between corners."""
    n = round(seconds * RATE)
    corners = np.random.default_rng(seed).uniform(-size, size, n // KNOT + 2)
    corners[::2] = np.abs(corners[::2])
    corners[1::2] = -np.abs(corners[1::2])
    return np.interp(np.arange(n + 1), np.arange(corners.size) * KNOT, corners)


def simulated(axis: Axis, values: dict[str, dict[str, float]], torque: np.ndarray):
    effects = tuple(EffectValues(name, given) for name, given in values.items())
    return simulate_torque_driven(axis, torque, RATE, hold="linear", effects=effects, initial=START)


def compare(run, machine: Machine, states: np.ndarray, modes: list[Modes]) -> None:
    parts = [machine.parts(t, x, m) for t, x, m in zip(run.time_s, states, modes, strict=True)]
    torsion = np.array([p["d"] for p in parts])
    torque = np.array([p["T"] for p in parts])
    assert np.abs(run.torsion - torsion).max() < 1e-4 * np.abs(torsion).max()
    assert np.abs(run.joint_torque - torque).max() < 1e-4 * np.abs(torque).max()
    assert np.abs(run.true_motor_position - states[:, 0]).max() < 1e-4 * np.abs(torsion).max()


def smooth(machine: Machine) -> np.ndarray:
    """Radau between the torque's corners."""
    x = machine.start()
    n = machine.torque.size
    out = np.empty((n, x.size))
    out[0] = x
    cuts = [*range(0, n - 1, KNOT), n - 1]
    for first, last in pairwise(cuts):
        grid = np.arange(first, last + 1) / RATE
        for piece in pieces(grid, machine.of("payload_change", "time_of_change")):
            found = solve_ivp(
                lambda t, x: machine.rhs(t, x, Modes()),
                (piece[0], piece[-1]),
                x,
                "Radau",
                piece,
                rtol=1e-9,
                atol=1e-12,
            )
            assert found.success
            x = found.y[:, -1]
            out[np.rint(piece * RATE).astype(int)] = found.y.T
    return out


def pieces(grid: np.ndarray, cut: float) -> list[np.ndarray]:
    inside = (cut > grid[0]) & (cut < grid[-1])
    return [grid[grid <= cut], grid[grid >= cut]] if inside else [grid]


@pytest.mark.parametrize("effect", SMOOTH)
def test_smooth_laws_against_radau(effect):
    values = {effect: SMOOTH[effect]}
    torque = torque_line(0.2, 300.0)
    axis = replace(Axis(), reversal_velocity=5e-3)
    run = simulated(axis, values, torque)
    machine = Machine(axis, values, torque)
    states = smooth(machine)
    compare(run, machine, states, [Modes()] * torque.size)
    # The comparison would notice the effect's absence.
    without = simulated(axis, {}, torque)
    assert np.abs(without.torsion - run.torsion).max() > 1e-3 * np.abs(run.torsion).max()


def test_every_effect_is_compared():
    from flexid_cli.effects.registry import effects

    assert {e.name for e in effects()} == set(SMOOTH) | MEASURED_ONLY | KINKED


def test_several_smooth_laws_together_with_a_narrow_reversal():
    names = ("stribeck_motor", "load_dependent_friction", "hysteresis", "second_mode", "actuator_lag")
    values = {name: SMOOTH[name] for name in names}
    torque = torque_line(0.3, 400.0, seed=5)
    run = simulated(Axis(), values, torque)
    machine = Machine(Axis(), values, torque)
    compare(run, machine, smooth(machine), [Modes()] * torque.size)


def located(machine: Machine) -> tuple[np.ndarray, list[Modes]]:
    """Integration that ends at every event and goes on with the new mode's equations."""
    x = machine.start()
    modes = settle(machine, 0.0, x, Modes(1.0, 1.0))
    n = machine.torque.size
    out, history = np.empty((n, x.size)), [modes] * n
    out[0], t, row = x, 0.0, 1
    while row < n:
        end = min(math.ceil(round(t * RATE / KNOT + 1e-9, 6) + 1e-6) * KNOT, n - 1) / RATE
        events = watched(machine, modes)
        found = solve_ivp(
            lambda t, x, m=modes: machine.rhs(t, x, m), (t, end), x, "DOP853", dense_output=True, events=events,
            rtol=1e-11, atol=1e-14, max_step=2e-3,
        )  # fmt: skip
        t, x = float(found.t[-1]), found.y[:, -1].copy()
        while row < n and row / RATE <= t + 1e-12:
            out[row], history[row] = found.sol(row / RATE), modes
            row += 1
        if found.status == 1:
            fired = next(i for i, times in enumerate(found.t_events) if times.size)
            modes = switched(machine, t, x, modes, events[fired].kind)
    return out, history


def watched(machine: Machine, modes: Modes) -> list:
    """Functions that fall through zero where a mode ends."""
    out = []

    def add(kind, function):
        function.terminal, function.direction, function.kind = True, -1.0, kind
        out.append(function)

    for index, net, level, mode in (
        (2, "net", "level", modes.motor),
        (3, "load_net", "load_level", modes.load),
    ):
        if mode == 0:
            add(index, lambda t, x, n=net, k=level: (c := machine.parts(t, x, modes))[k] - abs(c[n]))
        elif mode is not None:
            add(index, lambda t, x, i=index, m=mode: m * x[i])
    half = 0.5 * machine.of("backlash", "gap")
    if half and modes.gap:
        add("gap0", lambda t, x: modes.gap * machine.parts(t, x, modes)["d"] - half)
    elif half:
        add("gap1", lambda t, x: half - machine.parts(t, x, modes)["d"])
        add("gap-1", lambda t, x: half + machine.parts(t, x, modes)["d"])
    limit = machine.of("torque_saturation", "torque_limit")
    if limit and modes.limit:
        add("limit0", lambda t, x: modes.limit * machine.command(t) - limit)
    elif limit:
        add("limit1", lambda t, x: limit - machine.command(t))
        add("limit-1", lambda t, x: limit + machine.command(t))
    return out


def switched(machine: Machine, t: float, x: np.ndarray, modes: Modes, kind: int | str) -> Modes:
    if isinstance(kind, str):
        name = kind.rstrip("-01")
        return replace(modes, **{name: int(kind[len(name) :])})
    x[kind] = 0.0
    role, net, level = ("motor", "net", "level") if kind == 2 else ("load", "load_net", "load_level")
    was = getattr(modes, role)
    c = machine.parts(t, x, modes)
    if was != 0 and abs(c[net]) <= c[level]:
        return replace(modes, **{role: 0.0})
    return replace(modes, **{role: math.copysign(1.0, c[net])})


def settle(machine: Machine, t: float, x: np.ndarray, modes: Modes) -> Modes:
    half = 0.5 * machine.of("backlash", "gap")
    d = machine.parts(t, x, modes)["d"]
    limit = machine.of("torque_saturation", "torque_limit") or math.inf
    u = machine.command(t)
    return replace(
        modes,
        gap=0 if abs(d) <= half else int(math.copysign(1, d)),
        limit=0 if abs(u) <= limit else int(math.copysign(1, u)),
    )


GAP = {"backlash": {"gap": 2e-3}}
LIMIT = {"torque_saturation": {"torque_limit": 150.0}}


@pytest.mark.parametrize(
    ("values", "size"),
    [
        ({}, 120.0),
        ({}, 60.0),
        (GAP, 200.0),
        (LIMIT, 300.0),
        ({**GAP, **LIMIT}, 300.0),
        ({"stribeck_motor": SMOOTH["stribeck_motor"], "stribeck_load": SMOOTH["stribeck_load"]}, 130.0),
        ({"load_dependent_friction": SMOOTH["load_dependent_friction"], **GAP}, 150.0),
        ({"hysteresis": SMOOTH["hysteresis"], **GAP, "joint_damping": SMOOTH["joint_damping"]}, 150.0),
    ],
    ids=[
        "stick",
        "mostly-stick",
        "gap",
        "limit",
        "gap-limit",
        "stribeck",
        "load-dependent-gap",
        "hysteresis-gap",
    ],
)
def test_set_valued_laws_against_located_events(values, size):
    axis = replace(Axis(), reversal_velocity=0.0, MX=0.5, MY=3.0)
    torque = torque_line(1.0, size, seed=4)
    run = simulated(axis, values, torque)
    machine = Machine(axis, values, torque)
    states, modes = located(machine)
    compare(run, machine, states, modes)
    stuck = np.array([m.motor == 0 for m in modes])
    if "stick" in str(values) or not values:
        assert stuck.any()
    assert np.all(run.motor_velocity[stuck] == 0.0)
    if "backlash" in values:
        assert np.count_nonzero(np.diff([m.gap for m in modes])) >= 4
    if "torque_saturation" in values:
        assert {m.limit for m in modes} == {-1, 0, 1}


def test_backlash_without_friction_keeps_its_energy():
    """Free motion through a gap for ten seconds: kinetic and spring energy stay, contact by contact."""
    axis = Axis(FVm=0.0, FSm=0.0, FV=0.0, FS=0.0, MX=0.0, MY=0.0)
    start = InitialState(0.0, 0.0, 0.05, -0.05)
    effects = (EffectValues("backlash", {"gap": 2e-3}),)
    run = simulate_torque_driven(axis, np.zeros(10_000), RATE, effects=effects, initial=start)
    spring = run.joint_torque**2 / (2.0 * axis.K)
    energy = 0.5 * axis.Jm * run.motor_velocity**2 + 0.5 * axis.JL * run.joint_velocity**2 + spring
    assert np.abs(energy / energy[0] - 1.0).max() < 1e-6
    assert np.sum(np.diff(np.abs(run.torsion) > 1e-3) != 0) > 50
