"""The unfiltered signals behind the columns of the observation matrix, and the columns themselves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexid_cli.pipeline import derivatives, filters
from flexid_cli.pipeline.chain import Chain
from flexid_cli.signals.recording import Recording, Segment

Array = NDArray[np.float64]

SIGN_FILTER_ORDER = 2
HALF_WIDTH = 3


@dataclass(frozen=True)
class Velocities:
    """Velocities of a wider band than the chain's, whose sign Coulomb friction follows.

    A velocity filtered as narrowly as the columns would lose reversals above the band.
    """

    cutoff_hz: float
    sample_rate_hz: float

    def lowpass(self, x: Array) -> Array:
        """Zero-phase low pass at the sign's own cutoff."""
        sos = filters.butterworth(SIGN_FILTER_ORDER, self.cutoff_hz, self.sample_rate_hz)
        return filters.zero_phase(x, sos)

    def derivative(self, x: Array, order: int = 1) -> Array:
        """Derivative of the low-passed signal; what it cannot reach at the ends is as the nearest that it can."""
        smooth = self.lowpass(x)
        result = derivatives.differentiate(smooth, order, 1.0 / self.sample_rate_hz, half_width=HALF_WIDTH)
        reach = derivatives.reach("exact", order, HALF_WIDTH)
        result[:reach], result[-reach:] = result[reach], result[-reach - 1]
        return result


class Columns:
    """Columns of one recording through one chain, each computed once.

    Parameters
    ----------
    recording : Recording
        Joint side, SI.
    chain : Chain
        The filters common to all columns.
    sign_cutoff_hz : float
        Band of the velocities whose sign is taken.
    gravity_m_per_s2 : float
        For the gravity columns g cos q and g sin q.
    """

    def __init__(
        self, recording: Recording, chain: Chain, sign_cutoff_hz: float, gravity_m_per_s2: float = 9.81
    ) -> None:
        self.recording = recording
        self.chain = chain
        self.gravity = gravity_m_per_s2
        self.velocities = Velocities(sign_cutoff_hz, recording.sample_rate_hz)
        self._rebuilt_from: tuple[float, float, float, float] | None = None
        self._given_joint = False
        self.segments = tuple(s for s in recording.segments if chain.rows(s.samples) > 0)
        self._cache: dict[tuple[str, int], Array] = {}
        self._smooth: dict[str, list[Array]] = {}
        self._sides: list[tuple[Array, Array, Array]] = []
        self._signals: dict[str, Callable[[int, Segment], Array]] = {
            "torque": lambda _, s: s.torque,
            "motor": lambda _, s: s.motor_position,
            "joint": lambda i, _: self.joint[i],
            "torsion": lambda i, s: s.motor_position - self.joint[i],
            "joint_centred": lambda i, _: self.joint[i] - self.centre,
            "gravity_cos": lambda i, _: self.gravity * np.cos(self.joint[i]),
            "gravity_sin": lambda i, _: self.gravity * np.sin(self.joint[i]),
            "sign_motor": lambda i, _: reversal(self.motor_velocity[i], self.reversal_velocity),
            "sign_joint": lambda i, _: reversal(self.joint_velocity[i], self.reversal_velocity),
            "one": lambda _, s: np.ones(s.samples),
        }
        self.reversal_velocity: float | None = None
        self.motor_velocity = [self.velocities.derivative(s.motor_position) for s in self.segments]
        self.joint: list[Array] = []
        self.joint_velocity: list[Array] = []
        self._take_joint(
            [s.motor_position if s.joint_position is None else s.joint_position for s in self.segments]
        )
        positions = [(float(s.motor_position.min()), float(s.motor_position.max())) for s in self.segments]
        self.centre = (
            0.5 * (min(p[0] for p in positions) + max(p[1] for p in positions)) if positions else 0.0
        )

    @property
    def lengths(self) -> tuple[int, ...]:
        """Rows of each segment."""
        return tuple(self.chain.rows(s.samples) for s in self.segments)

    @property
    def times(self) -> Array:
        """Time of each row from the start of the record, s."""
        return np.concatenate([self.chain.row_times(s.samples, s.start_s) for s in self.segments])

    def __call__(self, signal: str, derivative: int) -> Array:
        """One column over all segments, shape (rows,)."""
        key = (signal, derivative)
        if key not in self._cache:
            parts = [self.chain.finish(x, derivative) for x in self._smoothed(signal)]
            self._cache[key] = np.concatenate(parts)
        return self._cache[key]

    def signal(self, name: str) -> list[Array]:
        """A signal before the chain, by segment, each shape (samples,)."""
        return [self._signals[name](i, s) for i, s in enumerate(self.segments)]

    def of(self, parts: Sequence[Array], derivative: int) -> Array:
        """A column of a signal that is not one of the record's, given by segment, shape (rows,)."""
        return np.concatenate([self.chain.apply(part, derivative) for part in parts])

    def _smoothed(self, signal: str) -> list[Array]:
        """The signal of each segment after the low pass, which all its derivatives share."""
        if signal not in self._smooth:
            make = self._signals[signal]
            self._smooth[signal] = [self.chain.smooth(make(i, s)) for i, s in enumerate(self.segments)]
        return self._smooth[signal]

    def set_reversal_velocity(self, velocity: float | None) -> None:
        """Take sgn v as tanh(v / velocity); None or 0: as the plain sign."""
        if velocity != self.reversal_velocity:
            self.reversal_velocity = velocity
            self._forget("sign_motor", "sign_joint")

    def like(self, *, sign_cutoff_hz: float | None = None) -> Columns:
        """The same columns anew, with another band of the signs where one is given."""
        cutoff = sign_cutoff_hz or self.velocities.cutoff_hz
        other = Columns(self.recording, self.chain, cutoff, self.gravity)
        other.set_reversal_velocity(self.reversal_velocity)
        if self._given_joint:
            other.set_joint(self.joint)
        elif self._rebuilt_from is not None:
            other.rebuild_joint(*self._rebuilt_from)
        return other

    def rebuild_joint(self, Jm: float, FVm: float, FSm: float, K: float) -> None:
        """Rebuild the unmeasured joint position from the motor's side, eq. (14), in the band of the signs."""
        self._rebuilt_from, self._given_joint = (Jm, FVm, FSm, K), False
        if not self._sides:
            self._sides = [self._motor_side(segment) for segment in self.segments]
        rebuilt = []
        for (torque, motor, acceleration), velocity in zip(self._sides, self.motor_velocity, strict=True):
            friction = FVm * velocity + FSm * reversal(velocity, self.reversal_velocity)
            rebuilt.append(motor - (torque - Jm * acceleration - friction) / K)
        self._take_joint(rebuilt)

    def _motor_side(self, segment: Segment) -> tuple[Array, Array, Array]:
        """Torque, motor position and its acceleration in the band of the signs."""
        lowpass = self.velocities.lowpass
        acceleration = self.velocities.derivative(segment.motor_position, 2)
        return lowpass(segment.torque), lowpass(segment.motor_position), acceleration

    def set_joint(self, joint: list[Array]) -> None:
        """Take these as the unmeasured joint positions, one a segment, each shape (samples,)."""
        self._given_joint = True
        self._take_joint(joint)

    def _take_joint(self, joint: list[Array]) -> None:
        self.joint = joint
        self.joint_velocity = [self.velocities.derivative(x) for x in joint]
        self._forget("joint", "torsion", "joint_centred", "gravity_cos", "gravity_sin", "sign_joint")

    def _forget(self, *signals: str) -> None:
        self._cache = {key: column for key, column in self._cache.items() if key[0] not in signals}
        self._smooth = {key: parts for key, parts in self._smooth.items() if key not in signals}


def reversal(velocity: Array, width: float | None) -> Array:
    """Sign of the velocity, tanh(v / width) for a reversal of that width.

    A reversal falls between samples. Its tanh is averaged from half a sample before to half a sample after, by the
    integral v0 ln cosh(v / v0) over the velocity, and the average's own damping undone: - second difference / 24.
    """
    if not width:
        return np.sign(velocity)
    from flexid_cli.pipeline.loops import averaged_sign

    sign = np.empty(velocity.size)
    averaged_sign(np.ascontiguousarray(velocity), float(width), sign)
    sign[1:-1] -= np.diff(sign, 2) / 24.0
    return sign


_sign = reversal
