"""The machine itself: two masses, a spring, friction, gravity, every effect, and a sampled controller.

Joint side, SI, d = qm - q. What an effect adds stands in square brackets:

    Gm = Jm qm'' + FVm qm' + FSm tanh(qm'/v0) + T + [motor]
    T  = JL q'' + FV q' + FS tanh(q'/v0l) + MX g cos q + MY g sin q + [load]
    T  = K d + [transmission]

Fourth-order Runge-Kutta with a fixed number of steps a control period, and more of them in the periods in which a
velocity may reverse, for the friction changes within its small reversal width there. Elements with memory (Dahl,
Maxwell slip, bristle) are functions of the way gone, not of time, and advance by their exact solution.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

BASE = ("Jm", "JL", "K", "FVm", "FSm", "FV", "FS", "MX", "MY", "v0", "v0l", "gravity")
# Parameters of the effects; all zero is the plain machine. What each means stands in `effects`.
EXTRA = (
    *("offset", "asym", "strib_f", "strib_v", "quad", "cub", "pow_f", "pow_n", "load"),
    *("cog_a", "cog_n", "cog_p", "cog_b", "lag", "sat", "therm_gain", "therm_tau"),
    *("c", "gap", "k3", "pw_k", "pw_d", "hyst_f", "hyst_d", "slip_f", "slip_d", "te_a", "te_n", "te_p"),
    *("lstrib_f", "lstrib_v", "m2_J", "m2_K", "m2_c", "jump_dJ", "jump_t"),
    *("skew", "joint_lag", "motor_lag", "ecc_a", "ecc_p", "mecc_a", "mecc_n", "mecc_p"),
    *("stop_k", "stop_q", "pf_a", "pf_n", "pf_p", "ks_a", "ks_n", "ks_p", "br_f", "br_d"),
    *("dist_m", "dist_l", "dist_f", "dist_p", "kt_a", "kt_t", "dead", "ji_a", "ji_n", "ji_p"),
)
PARAMETERS = np.dtype([(name, np.float64) for name in (*BASE, *EXTRA)])

# Means over each control period, in the order in which the kernel writes them.
MEANS = (
    "qm_dd",
    "qm_d",
    "sgn_m",
    "d",
    "q_dd",
    "q_d",
    "sgn_l",
    "cos_q",
    "sin_q",
    "T",
    "motor",
    "trans",
    "load",
)

SLIP_ELEMENTS = 4
STEP_S = 3e-4
FINE = 5  # how many times more steps are taken where a velocity may reverse
LOST = 1e3  # rad away from the reference: the loop is unstable


class UnstableError(ArithmeticError):
    """The closed loop ran away."""


@dataclass(frozen=True)
class Axis:
    """A flexible axis without anything hidden, joint side, SI."""

    Jm: float
    JL: float
    K: float
    FVm: float
    FSm: float
    FV: float
    FS: float
    MX: float = 0.0
    MY: float = 0.0
    v0: float = 2e-3
    v0l: float = 2e-3
    gravity: float = 9.81

    @property
    def locked_motor_hz(self) -> float:
        """Antiresonance of the motor side, sqrt(K / JL) / 2 pi."""
        return float(np.sqrt(self.K / self.JL) / (2.0 * np.pi))

    @property
    def free_hz(self) -> float:
        """Resonance of the free axis, sqrt(K (1/Jm + 1/JL)) / 2 pi."""
        return float(np.sqrt(self.K * (1.0 / self.Jm + 1.0 / self.JL)) / (2.0 * np.pi))


@dataclass(frozen=True)
class Controller:
    """u = kv e + ki integral(e dt), e = kp (ref - qm) + velocity_feedforward ref' - qm'.

    Sampled at the record's rate and held; qm' and ref' by backward difference, qm as the encoder gives it.
    """

    kp: float
    kv: float
    ki: float
    velocity_feedforward: float = 1.0


@dataclass(frozen=True)
class Sensors:
    """What the record is made with.

    Attributes
    ----------
    motor_counts, joint_counts : float
        Counts a revolution, the motor's of the motor shaft; 0 is an ideal encoder.
    gear_ratio : float
        Motor angle over joint angle.
    motor_noise, joint_noise : float
        White noise of the encoders before they are quantised, joint-side rad, one sigma; the motor's is in the loop.
    torque_noise : float
        Noise of the recorded torque, N m, one sigma; the acting torque has none of it.
    torque_noise_corner_hz : float
        0: white; else first-order low-passed white noise with this corner.
    """

    motor_counts: float = 0.0
    joint_counts: float = 0.0
    gear_ratio: float = 1.0
    motor_noise: float = 0.0
    joint_noise: float = 0.0
    torque_noise: float = 0.0
    torque_noise_corner_hz: float = 0.0

    @property
    def motor_resolution(self) -> float:
        """One count, joint-side rad."""
        return 2.0 * np.pi / (self.motor_counts * self.gear_ratio) if self.motor_counts else 0.0

    @property
    def joint_resolution(self) -> float:
        """One count, rad."""
        return 2.0 * np.pi / self.joint_counts if self.joint_counts else 0.0


@dataclass(frozen=True)
class Truth:
    """What no sensor saw.

    Attributes
    ----------
    means : dict of str to ndarray, shape (n,)
        Means over each control period of the names in `MEANS`: accelerations, velocities, sgn terms, torsion,
        cos q, sin q, joint torque T, and what the effects add to the motor, transmission and load equations.
    motor_position, joint_position : ndarray, shape (n,)
        At the sampling instants, free of any error.
    acting_torque : ndarray, shape (n,)
        Torque that the controller asked for, free of the record's noise.
    """

    means: dict[str, Array]
    motor_position: Array
    joint_position: Array
    acting_torque: Array

    @property
    def torque_rms(self) -> float:
        """RMS of the motor torque, N m."""
        return rms(self.acting_torque)

    @property
    def torsion_rms(self) -> float:
        """RMS of the torsion about its mean, rad."""
        return float(np.std(self.means["d"]))


@dataclass(frozen=True)
class Record:
    """A record, joint side, SI; ``motor_torque`` is stamped at the instant from which it is held."""

    rate_hz: float
    time_s: Array
    motor_torque: Array
    motor_position: Array
    joint_position: Array
    reference_position: Array
    truth: Truth


def simulate(
    axis: Axis,
    controller: Controller,
    reference: Array,
    rate_hz: float,
    effects: Mapping[str, Mapping[str, float]] | None = None,
    sensors: Sensors | None = None,
    seed: int = 0,
    substeps: int | None = None,
) -> Record:
    """Move an axis along a reference in closed loop, and record it.

    Parameters
    ----------
    axis, controller, sensors
        The machine; ideal sensors unless given.
    reference : ndarray, shape (n,)
        Set point of the motor position at each control period, joint-side rad.
    rate_hz : float
        Rate of the controller and of the record.
    effects : mapping of kind to its parameters
        What is hidden, in the names of `EXTRA`.
    seed : int
        Of all noise; the same seed gives the same bytes.
    substeps : int, optional
        Integration steps a control period, `FINE` times as many near reversals; by default no step is longer than
        `STEP_S`.

    Returns
    -------
    Record

    Raises
    ------
    UnstableError
        The loop ran away.
    KeyError
        An effect's parameter does not exist.
    """
    sensors = sensors or Sensors()
    p = pack(axis, effects or {})
    reference = np.ascontiguousarray(reference, dtype=np.float64)
    noise = [np.random.default_rng([seed, k]).standard_normal(reference.size) for k in range(3)]
    gains = np.array(list(asdict(controller).values()))
    rest = _rest(axis, float(reference[0]))
    stamps, means, held, ok = _run(
        p,
        gains,
        reference,
        rest,
        1.0 / rate_hz,
        substeps or int(np.ceil(1.0 / (rate_hz * STEP_S))),
        sensors.motor_resolution,
        sensors.motor_noise * noise[0],
    )
    if not ok:
        raise UnstableError("the simulated loop is unstable")
    joint = _joint_encoder(p, stamps, 1.0 / rate_hz, sensors, noise[1])
    return Record(
        rate_hz=rate_hz,
        time_s=np.arange(reference.size) / rate_hz,
        motor_torque=held + _torque_noise(sensors, rate_hz, noise[2]),
        motor_position=stamps[:, 4].copy(),
        joint_position=joint,
        reference_position=reference,
        truth=Truth(
            {name: means[:, k] for k, name in enumerate(MEANS)},
            stamps[:, 0].copy(),
            stamps[:, 1].copy(),
            held,
        ),
    )


def pack(axis: Axis, effects: Mapping[str, Mapping[str, float]]) -> np.record:
    """Put the axis and the effects' parameters into the kernel's record."""
    row = np.zeros(1, dtype=PARAMETERS)
    for name, value in asdict(axis).items():
        row[name] = value
    for parameters in effects.values():
        for name, value in parameters.items():
            if name not in EXTRA:
                raise KeyError(name)
            row[name] += value
    return row[0]  # type: ignore[no-any-return]


def rms(values: Array) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def _rest(axis: Axis, motor_position: float) -> Array:
    """State at rest, with the spring carrying gravity: [qm, q, torque that holds it]."""
    q, load = motor_position, 0.0
    for _ in range(100):
        load = axis.gravity * (axis.MX * np.cos(q) + axis.MY * np.sin(q))
        q = motor_position - load / axis.K
    return np.array([motor_position, q, load])


def _torque_noise(sensors: Sensors, rate_hz: float, white: Array) -> Array:
    if sensors.torque_noise_corner_hz <= 0.0:
        return sensors.torque_noise * white
    pole = float(np.exp(-2.0 * np.pi * sensors.torque_noise_corner_hz / rate_hz))
    return np.asarray(sensors.torque_noise * _first_order(white, pole))


def _joint_encoder(p: np.record, stamps: Array, period: float, sensors: Sensors, white: Array) -> Array:
    """What the joint encoder's channel holds: the position of ``skew`` seconds ago, and its errors."""
    q = stamps[:, 5] if p["joint_lag"] > 0.0 else stamps[:, 1]
    qd = stamps[:, 6] if p["joint_lag"] > 0.0 else stamps[:, 3]
    q = _earlier(q, qd, float(p["skew"]) / period, period)
    q = q + p["ecc_a"] * np.sin(q + p["ecc_p"]) + sensors.joint_noise * white
    step = sensors.joint_resolution
    return np.asarray(np.floor(q / step + 0.5) * step if step else q)


def _earlier(q: Array, qd: Array, shift: float, period: float) -> Array:
    """The signal ``shift`` samples ago, by cubic Hermite interpolation of position and velocity."""
    if shift == 0.0:
        return q
    at = np.clip(np.arange(q.size) - shift, 0.0, q.size - 1.0)
    k = np.minimum(at.astype(np.int64), q.size - 2)
    s = at - k
    left = (1.0 + 2.0 * s) * (1.0 - s) ** 2 * q[k] + s * (1.0 - s) ** 2 * period * qd[k]
    right = s**2 * (3.0 - 2.0 * s) * q[k + 1] - s**2 * (1.0 - s) * period * qd[k + 1]
    return np.asarray(left + right)


@njit(cache=True)
def _first_order(white, pole):  # type: ignore[no-untyped-def] # pragma: no cover
    """Return unit-variance noise of first order, stationary from the first sample."""
    out = np.empty_like(white)
    gain = np.sqrt(1.0 - pole * pole)
    state = white[0]
    for i in range(white.size):
        if i > 0:
            state = pole * state + gain * white[i]
        out[i] = state
    return out


@njit(cache=True)
def _dahl(z, way, limit, length):  # type: ignore[no-untyped-def] # pragma: no cover
    """Force of a Dahl element after a one-way displacement: it nears +-limit exponentially."""
    if limit == 0.0 or way == 0.0:
        return z
    end = limit if way > 0.0 else -limit
    return end + (z - end) * np.exp(-abs(way) / length)


@njit(cache=True)
def _slip(z, way, limit, length, k):  # type: ignore[no-untyped-def] # pragma: no cover
    """Force of the k-th spring with a slider: the later ones slip later."""
    share = limit / SLIP_ELEMENTS
    reach = length * 2.0 * (k + 1.0) / (SLIP_ELEMENTS + 1.0)
    return min(max(z + share * way / reach, -share), share)


@njit(cache=True)
def _transmission(p, x, memory):  # type: ignore[no-untyped-def] # pragma: no cover
    """What is added to K d."""
    qm, vm, q, v = x[0], x[1], x[2], x[3]
    w = qm - q
    rate = vm - v
    added = 0.0
    if p.te_a != 0.0:
        phase = p.te_n * qm + p.te_p
        added += p.K * p.te_a * np.sin(phase)
        w += p.te_a * np.sin(phase)
        rate += p.te_a * p.te_n * np.cos(phase) * vm
    if p.gap > 0.0:
        half = 0.5 * p.gap
        added -= p.K * min(max(w, -half), half)
    added += p.k3 * w * w * w + p.c * rate
    if abs(w) > p.pw_d:
        added += p.pw_k * (w - np.sign(w) * p.pw_d)
    if p.ks_a != 0.0:
        added += p.K * p.ks_a * np.sin(p.ks_n * q + p.ks_p) * w
    if p.hyst_f != 0.0:
        added += _dahl(memory[1], w - memory[0], p.hyst_f, p.hyst_d)
    if p.slip_f != 0.0:
        for k in range(SLIP_ELEMENTS):
            added += _slip(memory[2 + k], w - memory[0], p.slip_f, p.slip_d, k)
    return added


@njit(cache=True)
def _motor(p, t, x, joint_torque, s, memory):  # type: ignore[no-untyped-def] # pragma: no cover
    """What is added at the motor."""
    qm, vm = x[0], x[1]
    speed = abs(vm)
    added = p.offset + p.asym * speed + p.quad * vm * speed + p.cub * vm * vm * vm
    added += p.load * abs(joint_torque) * s
    if p.strib_f != 0.0:
        added += p.strib_f * np.exp(-((vm / p.strib_v) ** 2)) * s
    if p.pow_f != 0.0:
        added += p.pow_f * s * speed**p.pow_n
    if p.cog_a != 0.0:
        added += p.cog_a * np.sin(p.cog_n * qm + p.cog_p)
        added += p.cog_a * p.cog_b * np.sin(2.0 * p.cog_n * qm + 3.0 * p.cog_p)
    if p.therm_gain != 0.0:
        added += p.FVm * p.therm_gain * (np.exp(-t / p.therm_tau) - 1.0) * vm
    if p.pf_a != 0.0:
        added += p.pf_a * np.sin(p.pf_n * qm + p.pf_p) * s
    if p.br_f != 0.0:
        added += _dahl(memory[7], qm - memory[6], p.br_f, p.br_d)
    if p.dist_m != 0.0:
        added += p.dist_m * np.sin(2.0 * np.pi * p.dist_f * t + p.dist_p)
    return added


@njit(cache=True)
def _acting(p, t, held, left_over):  # type: ignore[no-untyped-def] # pragma: no cover
    """The torque that acts where ``held`` is asked for; ``left_over`` of the lag's gap is still open."""
    torque = held
    if p.lag > 0.0:
        torque += left_over
    if p.sat > 0.0:
        torque = min(max(torque, -p.sat), p.sat)
    if p.dead > 0.0:
        torque -= min(max(torque, -p.dead), p.dead)
    if p.kt_a != 0.0 and t >= p.kt_t:
        torque *= 1.0 + p.kt_a
    return torque


@njit(cache=True)
def _load(p, t, x):  # type: ignore[no-untyped-def] # pragma: no cover
    """What is added at the load, without inertia, and the inertia that is added."""
    q, v = x[2], x[3]
    added = 0.0
    inertia = 0.0
    if p.lstrib_f != 0.0:
        added += p.lstrib_f * np.exp(-((v / p.lstrib_v) ** 2)) * np.tanh(v / p.v0l)
    if p.m2_J > 0.0:
        added += p.m2_K * (q - x[4]) + p.m2_c * (v - x[5])
    if p.stop_k > 0.0 and q > p.stop_q:
        added += p.stop_k * (q - p.stop_q)
    if p.dist_l != 0.0:
        added += p.dist_l * np.sin(2.0 * np.pi * p.dist_f * t + p.dist_p)
    if p.jump_dJ != 0.0 and t >= p.jump_t:
        inertia += p.jump_dJ
    if p.ji_a != 0.0:
        phase = p.ji_n * q + p.ji_p
        inertia += p.JL * p.ji_a * np.sin(phase)
        added += 0.5 * p.JL * p.ji_a * p.ji_n * np.cos(phase) * v * v
    return added, inertia


@njit(cache=True)
def _derivative(p, t, held, left_over, x, memory, out, seen):  # type: ignore[no-untyped-def] # pragma: no cover
    """State's derivative; ``seen`` receives what `MEANS` names."""
    vm, q, v = x[1], x[2], x[3]
    s = np.tanh(vm / p.v0)
    sl = np.tanh(v / p.v0l)
    added_t = _transmission(p, x, memory)
    torque = p.K * (x[0] - q) + added_t
    added_m = _motor(p, t, x, torque, s, memory)
    acting = _acting(p, t, held, left_over)
    added_l, inertia = _load(p, t, x)
    c, n = np.cos(q), np.sin(q)
    out[0] = vm
    out[1] = (acting - p.FVm * vm - p.FSm * s - torque - added_m) / p.Jm
    out[2] = v
    rest = torque - p.FV * v - p.FS * sl - p.gravity * (p.MX * c + p.MY * n) - added_l
    out[3] = rest / (p.JL + inertia)
    out[4] = x[5]
    out[5] = (p.m2_K * (q - x[4]) + p.m2_c * (v - x[5])) / p.m2_J if p.m2_J > 0.0 else 0.0
    out[6] = (q - x[6]) / p.joint_lag if p.joint_lag > 0.0 else 0.0
    out[7] = (x[0] - x[7]) / p.motor_lag if p.motor_lag > 0.0 else 0.0
    seen[0], seen[1], seen[2], seen[3] = out[1], vm, s, x[0] - q
    seen[4], seen[5], seen[6], seen[7], seen[8] = out[3], v, sl, c, n
    seen[9], seen[10], seen[11] = torque, added_m + held - acting, added_t
    seen[12] = added_l + inertia * out[3]


@njit(cache=True)
def _remember(p, x, memory):  # type: ignore[no-untyped-def] # pragma: no cover
    """Advance the elements with memory to the state x."""
    w = x[0] - x[2]
    if p.te_a != 0.0:
        w += p.te_a * np.sin(p.te_n * x[0] + p.te_p)
    memory[1] = _dahl(memory[1], w - memory[0], p.hyst_f, p.hyst_d)
    if p.slip_f != 0.0:
        for k in range(SLIP_ELEMENTS):
            memory[2 + k] = _slip(memory[2 + k], w - memory[0], p.slip_f, p.slip_d, k)
    memory[7] = _dahl(memory[7], x[0] - memory[6], p.br_f, p.br_d)
    memory[0] = w
    memory[6] = x[0]


@njit(cache=True)
def _measured(p, x, noise, step):  # type: ignore[no-untyped-def] # pragma: no cover
    """What the motor encoder says."""
    q = x[7] if p.motor_lag > 0.0 else x[0]
    if p.mecc_a != 0.0:
        q += p.mecc_a * np.sin(p.mecc_n * q + p.mecc_p)
    q += noise
    return np.floor(q / step + 0.5) * step if step > 0.0 else q


@njit(cache=True)
def _ahead(x, slope, h, out):  # type: ignore[no-untyped-def] # pragma: no cover
    """Return x + h slope, without a new array."""
    for n in range(x.size):
        out[n] = x[n] + h * slope[n]
    return out


@njit(cache=True)
def _advance(p, t, h, held, gap, x, memory, k, seen, scratch):  # type: ignore[no-untyped-def] # pragma: no cover
    """One Runge-Kutta step; ``gap`` is how far the lagging torque is behind at its start."""
    middle = gap * np.exp(-0.5 * h / p.lag) if p.lag > 0.0 else 0.0
    end = gap * np.exp(-h / p.lag) if p.lag > 0.0 else 0.0
    _derivative(p, t, held, gap, x, memory, k[0], seen)
    _derivative(p, t + 0.5 * h, held, middle, _ahead(x, k[0], 0.5 * h, k[4]), memory, k[1], scratch)
    _derivative(p, t + 0.5 * h, held, middle, _ahead(x, k[1], 0.5 * h, k[4]), memory, k[2], scratch)
    _derivative(p, t + h, held, end, _ahead(x, k[2], h, k[4]), memory, k[3], scratch)
    for n in range(x.size):
        x[n] += h / 6.0 * (k[0, n] + 2.0 * k[1, n] + 2.0 * k[2, n] + k[3, n])
    _remember(p, x, memory)
    return end


@njit(cache=True)
def _run(p, gains, reference, rest, period, substeps, step, noise):  # type: ignore[no-untyped-def] # pragma: no cover
    """Closed loop; returns states at the stamps, means over the periods, the torque, and whether it stayed near."""
    n = reference.size
    stamps, means, torque = np.empty((n, 7)), np.zeros((n, 13)), np.empty(n)
    x = np.array([rest[0], 0.0, rest[1], 0.0, rest[1], 0.0, rest[1], rest[0]])
    memory = np.zeros(8)
    memory[0] = rest[0] - rest[1]
    if p.te_a != 0.0:
        memory[0] += p.te_a * np.sin(p.te_n * rest[0] + p.te_p)
    memory[6] = rest[0]
    k, seen, scratch = np.zeros((5, 8)), np.zeros(13), np.zeros(13)
    previous, previous_reference = _measured(p, x, noise[0], step), reference[0]
    integral = rest[2] / gains[2] if gains[2] > 0.0 else 0.0
    acted = rest[2]
    for i in range(n):
        measured = _measured(p, x, noise[i], step)
        stamps[i, 0], stamps[i, 1], stamps[i, 2], stamps[i, 3] = x[0], x[2], x[1], x[3]
        stamps[i, 4], stamps[i, 5] = measured, x[6]
        stamps[i, 6] = (x[2] - x[6]) / p.joint_lag if p.joint_lag > 0.0 else 0.0
        error = gains[0] * (reference[i] - measured) + gains[3] * (reference[i] - previous_reference) / period
        error -= (measured - previous) / period
        integral += error * period
        held = gains[1] * error + gains[2] * integral
        torque[i], previous, previous_reference = held, measured, reference[i]
        if not abs(x[0] - reference[i]) < LOST:
            return stamps, means, torque, False
        gap = acted - held
        near = abs(x[1]) < 6.0 * p.v0 + 2.0 * period * (
            abs(k[0, 1]) + abs(held - torque[max(i - 1, 0)]) / p.Jm
        )
        near = near or abs(x[3]) < 6.0 * p.v0l + 2.0 * period * abs(k[0, 3])
        steps = substeps * FINE if near else substeps
        h = period / steps
        for j in range(steps):
            gap = _advance(p, (i + j / steps) * period, h, held, gap, x, memory, k, seen, scratch)
            for c in range(seen.size):
                means[i, c] += seen[c] / steps
        acted = held + gap
    return stamps, means, torque, True
