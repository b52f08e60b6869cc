"""Instruments: the columns as a simulation of the fitted axis gives them, free of the measurement's noise.

IDIM-IV (Janot, Vandanjon and Gautier, IEEE Trans. Control Systems Technology 22 (2014) 132). Where the controller and
the set point are known, the closed loop is simulated and the instruments hold no noise at all. Else the simulation is
driven by the measured motor position: the load follows it through the spring, and the torque is what that takes.
Such instruments hold the motor encoder's noise, whose expected effect is subtracted (`noise`), but none of the
torque's, whatever its colour, and none of the joint encoder's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from flexid_cli.errors import UsageError
from flexid_cli.estimate import driven, noise
from flexid_cli.models.base import Model
from flexid_cli.pipeline.columns import Columns, reversal
from flexid_cli.signals.recording import Segment

if TYPE_CHECKING:
    from flexid_cli.config.schema import Config

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Relative damping below which a fitted load is not simulated: its transient would outlast the record.
LEAST_DAMPING = 0.005
# Reversal width of the closed-loop simulation where the fit has none, rad/s or m/s.
LEAST_WIDTH = 1e-4
# Signals that are no longer measured but simulated, for the motor's own position is what drives the simulation.
SIMULATED = ("torque", "joint", "torsion")


@dataclass(frozen=True)
class Mechanism:
    """What the simulation needs of a model's parameters; ``load`` maps columns of the load side to coefficients."""

    Jm: float
    K: float
    JL: float
    FVm: float
    FV: float
    FSm: float
    FS: float
    load: Mapping[str, float]

    @property
    def damping(self) -> float:
        """Viscous friction of the load in the simulation, at least `LEAST_DAMPING` of the critical one."""
        return max(self.FV, 2.0 * LEAST_DAMPING * float(np.sqrt(self.K * self.JL)))


def mechanism(model: Model, theta: Array) -> Mechanism | None:
    """The simulated axis of a fitted model, or None where it is no passive one."""
    value = {p.symbol: float(x) for p, x in zip(model.parameters, theta, strict=True)}
    if not {"Jm", "K", "JL"} <= value.keys() or min(value["Jm"], value["K"], value["JL"]) <= 0.0:
        return None
    names = {"MX": "gravity_cos", "MY": "gravity_sin", "Q0": "one", "offset": "one", "kg": "joint_centred"}
    load = {column: value[symbol] for symbol, column in names.items() if symbol in value}
    Jm, K, JL, FVm, FV, FSm, FS = (value[s] for s in ("Jm", "K", "JL", "FVm", "FV", "FSm", "FS"))
    return Mechanism(Jm, K, JL, FVm, FV, FSm, FS, load)


def instruments(model: Model, columns: Columns, axis: Mechanism) -> tuple[Array, ...]:
    """Columns of each block of ``model`` with torque, joint and torsion from the motor-driven simulation."""
    simulated = motor_driven(columns, axis)
    return tuple(
        np.column_stack([simulated(*t) if t[0] in SIMULATED else columns(*t) for t in block.columns])
        for block in model.blocks
    )


def motor_driven(columns: Columns, axis: Mechanism) -> Columns:
    """The record as the axis makes it when its motor moves as measured: torque and joint position simulated."""
    segments = tuple(_drive(columns, i, segment, axis) for i, segment in enumerate(columns.segments))
    recording = replace(columns.recording, segments=segments)
    simulated = Columns(recording, columns.chain, columns.velocities.cutoff_hz, columns.gravity)
    simulated.set_reversal_velocity(columns.reversal_velocity)
    return simulated


def driven_joint(columns: Columns, axis: Mechanism) -> list[Array]:
    """Joint position of each segment when the motor moves as measured; no noise of the torque enters it."""
    return [_joint(columns, i, axis) for i in range(len(columns.segments))]


def _joint(columns: Columns, index: int, axis: Mechanism) -> Array:
    """The load follows the motor; gravity acts where the joint was in the fit before, its stiffness at once."""
    segment = columns.segments[index]
    drive = axis.K * segment.motor_position
    stiffness = axis.K
    for name, coefficient in axis.load.items():
        if name == "joint_centred":
            drive, stiffness = drive + coefficient * columns.centre, stiffness + coefficient
        else:
            drive = drive - coefficient * columns.signal(name)[index]
    period = 1.0 / columns.recording.sample_rate_hz
    width = columns.reversal_velocity or 0.0
    return driven.follow(drive, axis.JL, axis.damping, stiffness, max(axis.FS, 0.0), width, period)


def _drive(columns: Columns, index: int, segment: Segment, axis: Mechanism) -> Segment:
    width = columns.reversal_velocity
    motor = segment.motor_position
    joint = _joint(columns, index, axis)
    velocity = columns.motor_velocity[index]
    acceleration = columns.velocities.derivative(motor, 2)
    friction = axis.FVm * velocity + axis.FSm * reversal(velocity, width)
    torque = axis.Jm * acceleration + friction + axis.K * (motor - joint)
    return replace(segment, torque=torque, joint_position=joint)


def closed_loop(columns: Columns, axis: Mechanism, config: Config) -> Columns | None:
    """The record as the controller makes it along the set point, or None where that is not known.

    The simulation starts at rest, so a record of one gap-free segment is needed.
    """
    from flexid_cli.simulate.axis import Axis, Controller, simulate

    gains = config.controller
    segment = columns.segments[0]
    if gains is None or gains.law == "external" or len(columns.segments) > 1:
        return None
    if segment.reference_position is None or gains.kp is None or gains.kv is None:
        return None
    gravity = {"MX": axis.load.get("gravity_cos", 0.0), "MY": axis.load.get("gravity_sin", 0.0)}
    machine = Axis(
        axis.Jm, axis.K, axis.JL, axis.FVm, axis.FSm, axis.damping, axis.FS,
        gravity["MX"], gravity["MY"], columns.gravity,
        reversal_velocity=columns.reversal_velocity or LEAST_WIDTH,
    )  # fmt: skip
    controller = Controller(gains.kp, gains.kv, gains.ki or 0.0, gains.velocity_feedforward)
    try:
        run = simulate(machine, controller, segment.reference_position, columns.recording.sample_rate_hz)
    except UsageError:
        return None
    torque = run.torque
    if config.signals.torque.hold == "sample":
        torque = np.concatenate([torque[:1], 0.5 * (torque[1:] + torque[:-1])])
    simulated = replace(
        segment, torque=torque, motor_position=run.motor_position, joint_position=run.joint_position
    )
    loop = Columns(
        replace(columns.recording, segments=(simulated,)),
        columns.chain,
        columns.velocities.cutoff_hz,
        columns.gravity,
    )
    loop.set_reversal_velocity(columns.reversal_velocity)
    return loop


def transients(columns: Columns, axis: Mechanism) -> list[list[Array]]:
    """Free oscillations of the load from the start of each segment, two a segment; zero in the others."""
    period = 1.0 / columns.recording.sample_rate_hz
    decay = 0.5 * axis.damping / axis.JL
    omega = float(np.sqrt(max(axis.K / axis.JL - decay**2, 0.0)))
    waves: list[list[Array]] = []
    for i in range(len(columns.segments)):
        for shape in (np.cos, np.sin):
            parts = []
            for j, segment in enumerate(columns.segments):
                time = period * np.arange(segment.samples)
                wave = np.exp(-decay * time) * shape(omega * time) if i == j else 0.0 * time
                parts.append(np.asarray(wave, dtype=np.float64))
            waves.append(parts)
    return waves


def response(axis: Mechanism) -> noise.Response:
    """How the instruments respond to noise of the motor encoder; to other noise they do not."""

    def of(term: noise.Term, omega: Array, s: Complex) -> Complex:
        signal, order = term
        p = 1j * omega
        follow = axis.K / (axis.JL * p**2 + axis.damping * p + axis.K)
        transfer = {
            "motor": np.ones_like(follow),
            "joint": follow,
            "torsion": 1.0 - follow,
            "torque": axis.Jm * p**2 + axis.FVm * p + axis.K * (1.0 - follow),
        }
        result = np.zeros((3, omega.size), dtype=np.complex128)
        if signal in transfer:
            result[1] = transfer[signal] * s**order
        return result

    return of


def strength(instrumented: Sequence[Array], matrices: Sequence[Array]) -> float:
    """Smallest correlation between a column and its instrument: near zero the instruments are weak."""
    worst = 1.0
    for Z, M in zip(instrumented, matrices, strict=True):
        size = np.linalg.norm(Z, axis=0) * np.linalg.norm(M, axis=0)
        used = size > 0.0
        worst = min(worst, float(np.min(np.abs(np.sum(Z * M, axis=0)[used]) / size[used])))
    return worst
