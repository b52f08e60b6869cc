"""The recording that models see: one axis, joint side, SI units, uniform samples in gap-free segments."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ClockStatistics:
    """What the stamps of one signal say.

    Attributes
    ----------
    signal, clock : str
        Role (``motor_position``) and clock (``header_stamp``, ``log_time``, ``publish_time``, ``column``).
    samples : int
        Samples in the log.
    period_s : float
        Median difference of successive stamps.
    jitter_s : float
        Standard deviation of the differences about the median, gaps left out.
    gaps, lost_s : int, float
        Gaps longer than the permitted one, and the time they take.
    bridged : int
        Missing samples inside shorter gaps, filled by the interpolation.
    duplicates, reordered, resets, invalid : int
        Equal stamps dropped, samples put back in order, jumps back of the clock, NaN or infinite samples.
    """

    signal: str
    clock: str
    samples: int
    period_s: float
    jitter_s: float
    gaps: int = 0
    lost_s: float = 0.0
    bridged: int = 0
    duplicates: int = 0
    reordered: int = 0
    resets: int = 0
    invalid: int = 0


@dataclass(frozen=True)
class Segment:
    """A stretch of uniform samples without a gap. Joint side, SI (rad or m, N m or N, s).

    Attributes
    ----------
    start_s : float
        Time of the first sample from the start of the record.
    torque : ndarray, shape (n,)
        Motor torque referred to the joint side (or current, where the torque constant is unknown).
    motor_position : ndarray, shape (n,)
        Motor position referred to the joint side.
    joint_position, reference_position : ndarray, shape (n,), or None
        Joint-side position and the position set point, where recorded.
    """

    start_s: float
    torque: Array
    motor_position: Array
    joint_position: Array | None = None
    reference_position: Array | None = None

    @property
    def samples(self) -> int:
        """Number of samples."""
        return int(self.torque.size)


@dataclass(frozen=True)
class Recording:
    """One axis over one run, ready for the pipeline.

    Attributes
    ----------
    sample_rate_hz : float
        Rate of every segment.
    segments : tuple of Segment
        Gap-free stretches in time order.
    linear : bool
        A linear axis (m, N, kg) instead of a rotary one.
    torque_unit : str
        ``N.m``, ``N`` or ``A`` (torque constant unknown).
    duration_s : float
        From first to last sample, gaps included.
    start_ns : int
        Stamp of the log at which its segments' times are zero, ns; apart from this nothing depends on when it was
        recorded.
    clocks : tuple of ClockStatistics
        One per signal.
    history : tuple of str
        What was done to the samples, in order.
    notes : tuple of str
        What a person should know (warnings of the report).
    """

    sample_rate_hz: float
    segments: tuple[Segment, ...]
    linear: bool = False
    torque_unit: str = "N.m"
    duration_s: float = 0.0
    start_ns: int = field(default=0, compare=False)
    clocks: tuple[ClockStatistics, ...] = ()
    history: tuple[str, ...] = ()
    notes: tuple[str, ...] = field(default_factory=tuple)

    @property
    def has_joint_position(self) -> bool:
        """Whether the joint encoder was recorded."""
        return all(segment.joint_position is not None for segment in self.segments)

    @property
    def samples(self) -> int:
        """Samples in all segments."""
        return sum(segment.samples for segment in self.segments)
