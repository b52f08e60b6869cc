"""What can be hidden in a record: every effect of the library in its variants, and some that no library has.

An effect's size is its share: the RMS of what it adds to an equation over the RMS of the torque there (motor torque
at the motor, T in the transmission and at the load). What one parameter of the plain machine takes up exactly is
taken off first (a viscosity that drifts has a mean, and the mean is no effect). Effects of measurement add to no
equation; theirs is K times what they do to the torsion, over T.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from .axis import Axis, Record, rms

Parameters = dict[str, float]

DROPPED_FRICTION = "dropped_friction"
DROPPED_BAND = 1.4  # times the first resonance: where the paper's decimation ends (5.4 Hz over 3.9 Hz)


@dataclass(frozen=True)
class Scene:
    """The plain record in which an effect is going to act, in the numbers that shapes are drawn from."""

    axis: Axis
    gear_ratio: float
    duration_s: float
    speed: float  # RMS of qm', rad/s
    load_speed: float
    torsion: float  # RMS, rad
    torque: float  # RMS, N m
    peak: float  # largest torque, N m
    joint_torque: float  # RMS of T, N m
    low: float  # 10 and 90 % of the joint's positions, rad
    high: float

    @classmethod
    def of(cls, axis: Axis, gear_ratio: float, record: Record) -> Scene:
        """Measure a record."""
        means, q = record.truth.means, record.truth.joint_position
        return cls(
            axis=axis,
            gear_ratio=gear_ratio,
            duration_s=float(record.time_s[-1]),
            speed=rms(means["qm_d"]),
            load_speed=rms(means["q_d"]),
            torsion=record.truth.torsion_rms,
            torque=record.truth.torque_rms,
            peak=float(np.max(np.abs(record.truth.acting_torque))),
            joint_torque=rms(means["T"]),
            low=float(np.quantile(q, 0.1)),
            high=float(np.quantile(q, 0.9)),
        )


Draw = Callable[[np.random.Generator, Scene], Parameters]


@dataclass(frozen=True)
class Effect:
    """One way in which a machine differs from the plain one.

    Attributes
    ----------
    kind : str
        The library's name, or one of its own for what no library has.
    where : str
        Equation in which it acts: motor, transmission, load or measurement.
    draw : callable
        Draws the parameters for a scene, of about the right size.
    scale : tuple of str
        Parameters that the size multiplies; names of the axis's own parameters are allowed.
    divide : tuple of str
        Parameters that the size divides.
    absorbed : str
        The name in `axis.MEANS` of the plain machine's column that takes up a part, or empty.
    shares : tuple of float
        Shares in which it occurs.
    """

    kind: str
    where: str
    draw: Draw
    scale: tuple[str, ...] = ()
    divide: tuple[str, ...] = ()
    absorbed: str = ""
    shares: tuple[float, float] = (0.02, 0.12)

    def sized(self, parameters: Parameters, size: float) -> Parameters:
        """Parameters at ``size`` times what was drawn."""
        factor = dict.fromkeys(self.scale, size) | dict.fromkeys(self.divide, 1.0 / size)
        return {name: value * factor.get(name, 1.0) for name, value in parameters.items()}


def applied(axis: Axis, parameters: Mapping[str, float]) -> tuple[Axis, Parameters]:
    """Split what belongs to the axis from what belongs to the effect.

    Returns
    -------
    axis : Axis
        With the parameters that have one of its names in place of its own.
    extra : dict
        The rest.
    """
    own = {k: v for k, v in parameters.items() if hasattr(axis, k)}
    return replace(axis, **own), {k: v for k, v in parameters.items() if k not in own}


def share(effect: Effect, record: Record, axis: Axis) -> float:
    """Size of an effect in a record with ideal sensors in which it acts alone."""
    means = record.truth.means
    if effect.kind == DROPPED_FRICTION:
        return _dropped_friction(record, axis) / record.truth.torque_rms
    if effect.kind == "gravity":
        load = axis.gravity * (axis.MX * means["cos_q"] + axis.MY * means["sin_q"])
        return rms(load) / rms(means["T"])
    if effect.where == "measurement":
        motor = record.motor_position - record.truth.motor_position
        joint = record.joint_position - record.truth.joint_position
        return axis.K * float(np.std(motor - joint)) / rms(means["T"])
    added = means[{"motor": "motor", "transmission": "trans", "load": "load"}[effect.where]]
    if effect.absorbed:
        column = record.truth.acting_torque if effect.absorbed == "torque" else means[effect.absorbed]
        added = added - column * float(column @ added) / float(column @ column)
    reference = record.truth.acting_torque if effect.where == "motor" else means["T"]
    return rms(added) / rms(reference)


def _dropped_friction(record: Record, axis: Axis) -> float:
    """RMS of the friction that the paper leaves out of eq. (18): FSm (X2 S' + X1 S'') + FS sgn q'.

    Below `DROPPED_BAND`, for a sign's derivatives have no size but in a band.
    """
    means = record.truth.means
    omega = 2.0 * np.pi * np.fft.rfftfreq(means["sgn_m"].size, 1.0 / record.rate_hz)
    through = (1j * axis.FV * omega - axis.JL * omega**2) / axis.K
    dropped = axis.FSm * through * np.fft.rfft(means["sgn_m"]) + axis.FS * np.fft.rfft(means["sgn_l"])
    dropped[omega > 2.0 * np.pi * DROPPED_BAND * axis.free_hz] = 0.0
    return rms(np.fft.irfft(dropped, means["sgn_m"].size))


def at_rest(kind: str, parameters: Parameters) -> Parameters:
    """The same moment of gravity with its rest position, hanging or upright, at zero (eq. 17 of the paper)."""
    if kind != "gravity":
        return parameters
    moment = float(np.hypot(parameters["MX"], parameters["MY"]))
    return {"MX": 0.0, "MY": float(np.copysign(moment, parameters["MY"]))}


def visible(record: Record, axis: Axis) -> float:
    """What the plain model cannot take up of all that is hidden, over the RMS of the motor torque.

    The two equations' additions, less their projection on the plain model's columns (eq. 13 of the paper and the
    encoders' zeros); full band, both encoders, no noise. An effect of a large share that is little visible looks like
    another machine.
    """
    m = record.truth.means
    motor, joint = (
        getattr(record, name) - getattr(record.truth, name) for name in ("motor_position", "joint_position")
    )
    torsion = axis.K * (motor - joint)
    rest = np.zeros_like(torsion)
    added = np.concatenate([m["motor"] + m["trans"] - torsion, m["load"] - m["trans"] + torsion])
    shared = (np.concatenate([column, -column]) for column in (m["d"], np.ones_like(rest)))
    own = (np.concatenate([m[name], rest]) for name in ("qm_dd", "qm_d", "sgn_m"))
    other = (np.concatenate([rest, m[name]]) for name in ("q_dd", "q_d", "sgn_l", "cos_q", "sin_q"))
    columns = np.column_stack([*shared, *own, *other])
    columns = columns / np.sqrt(np.mean(np.square(columns), axis=0))
    left = added - columns @ np.linalg.lstsq(columns, added, rcond=None)[0]
    return float(np.sqrt(2.0)) * rms(left) / record.truth.torque_rms


def variants(kind: str) -> list[Effect]:
    """Forms in which a kind of effect occurs.

    Raises
    ------
    KeyError
        There is no such kind.
    """
    found = [effect for effect in (*LIBRARY, *OUTSIDE, *PAPER) if effect.kind == kind]
    if not found:
        raise KeyError(kind)
    return found


def _log(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _sign(rng: np.random.Generator) -> float:
    return 1.0 if rng.random() < 0.5 else -1.0


def _phase(rng: np.random.Generator) -> float:
    return float(rng.uniform(0.0, 2.0 * np.pi))


def _waves(rng: np.random.Generator, scene: Scene) -> float:
    """Periods a radian: several in the range of motion, and not too fast for a drive at its usual speed."""
    least = 2.5 * 2.0 * np.pi / (scene.high - scene.low)
    return max(float(np.round(rng.uniform(20.0, 150.0))), float(np.ceil(least)))


def _offset(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"offset": 0.07 * scene.torque * _sign(rng)}


def _asymmetry(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"asym": 0.07 * scene.torque / scene.speed * _sign(rng)}


def _stribeck_motor(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"strib_f": 0.15 * scene.torque, "strib_v": scene.speed * _log(rng, 0.12, 0.6)}


def _quadratic(rng: np.random.Generator, scene: Scene) -> Parameters:  # noqa: ARG001
    return {"quad": 0.05 * scene.torque / scene.speed**2}


def _cubic(rng: np.random.Generator, scene: Scene) -> Parameters:  # noqa: ARG001
    return {"cub": 0.03 * scene.torque / scene.speed**3}


def _power(rng: np.random.Generator, scene: Scene) -> Parameters:
    power = float(rng.uniform(0.35, 0.65))
    return {"pow_f": 0.07 * scene.torque / scene.speed**power, "pow_n": power}


def _load_dependent(rng: np.random.Generator, scene: Scene) -> Parameters:  # noqa: ARG001
    return {"load": 0.07 * scene.torque / scene.joint_torque}


def _cogging(rng: np.random.Generator, scene: Scene) -> Parameters:
    second = 0.0 if rng.random() < 0.6 else rng.uniform(0.2, 0.6)
    a = 0.1 * scene.torque
    return {"cog_a": a, "cog_n": _waves(rng, scene), "cog_p": _phase(rng), "cog_b": float(second)}


def _lag(rng: np.random.Generator, scene: Scene) -> Parameters:  # noqa: ARG001
    return {"lag": 0.003}


def _saturation(rng: np.random.Generator, scene: Scene) -> Parameters:  # noqa: ARG001
    return {"sat": 0.7 * scene.peak}


def _thermal(rng: np.random.Generator, scene: Scene) -> Parameters:
    viscosity = max(scene.axis.FVm, scene.axis.Jm)
    return {"FVm": viscosity, "therm_gain": float(rng.uniform(0.35, 0.8)), "therm_tau": _log(rng, 4.0, 15.0)}


def _damping(rng: np.random.Generator, scene: Scene) -> Parameters:  # noqa: ARG001
    rate = 2.0 * np.pi * scene.axis.locked_motor_hz
    return {"c": 0.1 * scene.axis.K / rate}


def _backlash(rng: np.random.Generator, scene: Scene) -> Parameters:  # noqa: ARG001
    return {"gap": 0.15 * scene.torsion}


def _hardening_cubic(rng: np.random.Generator, scene: Scene) -> Parameters:  # noqa: ARG001
    return {"k3": 0.03 * scene.axis.K / scene.torsion**2}


def _hardening_piecewise(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"pw_k": 0.3 * scene.axis.K, "pw_d": scene.torsion * float(rng.uniform(0.6, 1.4))}


def _dahl(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"hyst_f": 0.08 * scene.joint_torque, "hyst_d": scene.torsion * _log(rng, 0.2, 0.6)}


def _slip(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"slip_f": 0.08 * scene.joint_torque, "slip_d": scene.torsion * _log(rng, 0.2, 0.6)}


def _transmission_error(rng: np.random.Generator, scene: Scene) -> Parameters:
    a = 0.1 * scene.joint_torque / scene.axis.K
    return {"te_a": a, "te_n": _waves(rng, scene), "te_p": _phase(rng)}


def _gravity(rng: np.random.Generator, scene: Scene) -> Parameters:
    moment, angle = 0.07 * scene.joint_torque / scene.axis.gravity, _phase(rng)
    return {"MX": moment * float(np.cos(angle)), "MY": moment * float(np.sin(angle))}


def _stribeck_load(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"lstrib_f": 0.15 * scene.joint_torque, "lstrib_v": scene.load_speed * _log(rng, 0.12, 0.6)}


def _second_mode(rng: np.random.Generator, scene: Scene) -> Parameters:
    part = float(rng.uniform(0.2, 0.5)) * scene.axis.JL
    omega = 2.0 * np.pi * scene.axis.free_hz * 3.0
    return {
        "JL": scene.axis.JL - part,
        "m2_J": part,
        "m2_K": part * omega**2,
        "m2_c": 2.0 * float(rng.uniform(0.01, 0.05)) * part * omega,
    }


def _payload(rng: np.random.Generator, scene: Scene) -> Parameters:
    change = 0.2 * scene.axis.JL * (1.0 if rng.random() < 0.6 else -1.0)
    return {"jump_dJ": change, "jump_t": scene.duration_s * float(rng.uniform(0.3, 0.7))}


def _skew(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"skew": 0.07 * scene.torsion / scene.speed * _sign(rng)}


def _joint_lag(rng: np.random.Generator, scene: Scene) -> Parameters:  # noqa: ARG001
    return {"joint_lag": 0.07 * scene.torsion / scene.speed}


def _motor_lag(rng: np.random.Generator, scene: Scene) -> Parameters:  # noqa: ARG001
    return {"motor_lag": 0.07 * scene.torsion / scene.speed}


def _joint_eccentricity(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"ecc_a": 0.2 * scene.torsion, "ecc_p": _phase(rng)}


def _motor_eccentricity(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"mecc_a": 0.1 * scene.torsion, "mecc_n": scene.gear_ratio, "mecc_p": _phase(rng)}


def _coulomb(rng: np.random.Generator, scene: Scene) -> Parameters:  # noqa: ARG001
    return {"FSm": scene.axis.FSm, "FS": scene.axis.FS}


def _end_stop(rng: np.random.Generator, scene: Scene) -> Parameters:
    at = scene.low + float(rng.uniform(0.65, 0.9)) * (scene.high - scene.low)
    return {"stop_k": scene.joint_torque / (scene.high - scene.low), "stop_q": at}


def _position_friction(rng: np.random.Generator, scene: Scene) -> Parameters:
    n = 2.0 * np.pi * float(rng.uniform(0.7, 2.0)) / (scene.high - scene.low)
    return {"pf_a": 0.1 * scene.torque, "pf_n": n, "pf_p": _phase(rng)}


def _position_stiffness(rng: np.random.Generator, scene: Scene) -> Parameters:
    n = 2.0 * np.pi * float(rng.uniform(0.7, 2.0)) / (scene.high - scene.low)
    return {"ks_a": 0.1, "ks_n": n, "ks_p": _phase(rng)}


def _bristle(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"br_f": 0.1 * scene.torque, "br_d": (scene.high - scene.low) * _log(rng, 0.02, 0.15)}


def _motor_disturbance(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"dist_m": 0.1 * scene.torque, "dist_f": _log(rng, 0.5, 8.0), "dist_p": _phase(rng)}


def _load_disturbance(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"dist_l": 0.1 * scene.joint_torque, "dist_f": _log(rng, 0.5, 8.0), "dist_p": _phase(rng)}


def _constant_change(rng: np.random.Generator, scene: Scene) -> Parameters:
    return {"kt_a": 0.1 * _sign(rng), "kt_t": scene.duration_s * float(rng.uniform(0.3, 0.7))}


def _dead_zone(rng: np.random.Generator, scene: Scene) -> Parameters:  # noqa: ARG001
    return {"dead": 0.08 * scene.torque}


def _position_inertia(rng: np.random.Generator, scene: Scene) -> Parameters:
    n = 2.0 * np.pi * float(rng.uniform(0.5, 1.5)) / (scene.high - scene.low)
    return {"ji_a": 0.1, "ji_n": n, "ji_p": _phase(rng)}


LIBRARY = (
    Effect("torque_offset", "motor", _offset, ("offset",)),
    Effect("viscous_asymmetry", "motor", _asymmetry, ("asym",)),
    Effect("stribeck_motor", "motor", _stribeck_motor, ("strib_f",)),
    Effect("viscous_nonlinear", "motor", _quadratic, ("quad",)),
    Effect("viscous_nonlinear", "motor", _cubic, ("cub",)),
    Effect("viscous_nonlinear", "motor", _power, ("pow_f",)),
    Effect("load_dependent_friction", "motor", _load_dependent, ("load",)),
    Effect("cogging", "motor", _cogging, ("cog_a",)),
    Effect("actuator_lag", "motor", _lag, ("lag",)),
    Effect("torque_saturation", "motor", _saturation, divide=("sat",)),
    Effect("thermal_drift", "motor", _thermal, ("FVm",), absorbed="qm_d", shares=(0.02, 0.05)),
    Effect("joint_damping", "transmission", _damping, ("c",)),
    Effect("backlash", "transmission", _backlash, ("gap",)),
    Effect("hardening_stiffness", "transmission", _hardening_cubic, ("k3",)),
    Effect("hardening_stiffness", "transmission", _hardening_piecewise, ("pw_k",)),
    Effect("hysteresis", "transmission", _dahl, ("hyst_f",)),
    Effect("hysteresis", "transmission", _slip, ("slip_f",)),
    Effect("transmission_error", "transmission", _transmission_error, ("te_a",)),
    Effect("gravity", "load", _gravity, ("MX", "MY")),
    Effect("stribeck_load", "load", _stribeck_load, ("lstrib_f",)),
    Effect("second_mode", "load", _second_mode, divide=("m2_K",), absorbed="q_dd"),
    Effect("payload_change", "load", _payload, ("jump_dJ",), absorbed="q_dd"),
    Effect("clock_skew", "measurement", _skew, ("skew",)),
    Effect("sensor_lag", "measurement", _joint_lag, ("joint_lag",)),
    Effect("sensor_lag", "measurement", _motor_lag, ("motor_lag",)),
    Effect("encoder_eccentricity", "measurement", _joint_eccentricity, ("ecc_a",)),
    Effect("encoder_eccentricity", "measurement", _motor_eccentricity, ("mecc_a",)),
)

OUTSIDE = (
    Effect("end_stop", "load", _end_stop, ("stop_k",), shares=(0.04, 0.15)),
    Effect(
        "position_friction", "motor", _position_friction, ("pf_a",), absorbed="sgn_m", shares=(0.04, 0.15)
    ),
    Effect(
        "position_stiffness",
        "transmission",
        _position_stiffness,
        ("ks_a",),
        absorbed="d",
        shares=(0.04, 0.15),
    ),
    Effect("bristle_friction", "motor", _bristle, ("br_f",), absorbed="sgn_m", shares=(0.04, 0.15)),
    Effect("disturbance_motor", "motor", _motor_disturbance, ("dist_m",), shares=(0.04, 0.15)),
    Effect("disturbance_load", "load", _load_disturbance, ("dist_l",), shares=(0.04, 0.15)),
    Effect(
        "torque_constant_change", "motor", _constant_change, ("kt_a",), absorbed="torque", shares=(0.04, 0.15)
    ),
    Effect("drive_dead_zone", "motor", _dead_zone, ("dead",), shares=(0.04, 0.15)),
    Effect("position_inertia", "load", _position_inertia, ("ji_a",), absorbed="q_dd", shares=(0.04, 0.15)),
)

# What the paper itself leaves out of eqs. (18) to (20) beside gravity: the friction's terms that pass the spring.
PAPER = (Effect(DROPPED_FRICTION, "load", _coulomb, ("FSm", "FS")),)
# Gravity and an offset are not asked for together: over a small motion MX g cos q is a constant, too.
PAPER_KINDS = ((DROPPED_FRICTION,), ("gravity",), ("torque_offset",), (DROPPED_FRICTION, "gravity"))

KINDS = tuple(dict.fromkeys(effect.kind for effect in LIBRARY))
OUTSIDE_KINDS = tuple(dict.fromkeys(effect.kind for effect in OUTSIDE))
BOTH_ENCODERS = tuple(k for k in KINDS if k != "gravity")  # with both encoders gravity is in the plain model
MEASUREMENT = ("clock_skew", "sensor_lag", "encoder_eccentricity")
MOTOR_ONLY = tuple(
    k for k in KINDS if k not in MEASUREMENT
)  # the joint encoder's errors need a joint encoder
