"""Lines of the residual over the motor's angle: ripples of cogging, gears and bearings.

The residual is summed over the angle, not over time, with cosines of it: every row counts by the angle that it
passes, or an axis that stands would put one angle above all others and blur the lines; a Hann window over the
travel keeps what is smooth over it out of them. Where nothing but noise is left, the power of such a sum is
exponential about the spectrum's level, which is the median over the neighbouring lines, on the side where it is
larger, for what is no line falls with the number of cycles. That so few neighbours are known makes the tail that of
an F distribution. The false-alarm probability holds for all lines searched together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flexid_cli.diagnose.result import AngleLine, AngleSpectrum

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
# Column of cosine and sine of one number of cycles -> their rows in the residual's units, shape (r, 2).
Rows = Callable[[float], Array]

ALPHA = 0.01
MOST = 5
OVERSAMPLED = 4  # points of the grid in the width of a line
NEIGHBOURS = 20  # lines on either side that the level is taken from
FIRST = 4.0  # widths of a line: fewer cycles cannot be told from what is smooth over the travel
APART = 2.0  # widths of a line between lines
SURE = 4.0  # standard errors of a line's amplitude
MOST_CYCLES = 4000.0  # per joint revolution
SHOWN = 300  # points of the spectrum that are kept
TURN = 2.0 * np.pi


@dataclass(frozen=True)
class Angles:
    """Motor angles of the rows, joint side, and what lines may be searched.

    Attributes
    ----------
    angle : ndarray, shape (r,)
    passed : ndarray, shape (r,)
        Angle that each row passes, over its mean, times a Hann window over the travel.
    travel : float
        Range of the angle.
    most_cycles : float
        Per joint revolution: faster ripples leave the rows' band at the usual speed.
    gear_ratio : float
    """

    angle: Array
    passed: Array
    travel: float
    most_cycles: float
    gear_ratio: float

    @classmethod
    def of(cls, angle: Array, velocity: Array, band_hz: float, gear_ratio: float) -> Angles:
        """From the rows' angles and velocities."""
        speed = np.abs(velocity)
        usual = max(float(np.median(speed)), 1e-12)
        travel = float(np.ptp(angle))
        window = 1.0 - np.cos(TURN * (angle - angle.min()) / max(travel, 1e-12))
        passed = window * speed / max(float((window * speed).mean()), 1e-12)
        return cls(angle, passed, travel, min(TURN * band_hz / usual, MOST_CYCLES), gear_ratio)

    @property
    def step(self) -> float:
        """Width of a line, cycles per joint revolution."""
        return TURN / self.travel

    @property
    def grid(self) -> Array:
        """Cycles of the spectrum; those above `FIRST` widths are searched."""
        return np.arange(self.step, self.most_cycles, self.step / OVERSAMPLED)


def spectrum(
    equation: str, e: Array, angles: Angles, rows: Rows, *, scale: float, unit: str
) -> AngleSpectrum | None:
    """Spectrum and lines of one equation's residual; None where the travel is too short for any.

    Parameters
    ----------
    equation : str
    e : ndarray, shape (r,)
    angles : Angles
    rows : callable
        Rows, in the residual's units, of cosine and sine of a number of cycles per joint revolution with amplitude
        one in ``unit``.
    scale : float
        Torque that residual one stands for, in ``unit``.
    unit : str
    """
    grid = angles.grid if angles.travel > 0.0 else np.empty(0)
    if grid.size < 2 * NEIGHBOURS * OVERSAMPLED:
        return None
    power = np.square(np.abs(_sums(e, angles, grid)))
    level = _level(power)
    whole = power
    found: list[AngleLine] = []
    left, searched = e, grid >= FIRST * angles.step
    for _ in range(MOST):
        before = float(left @ left)
        ratio = np.where(searched, power / level, 0.0)
        k = int(np.argmax(ratio))
        chance = false_alarm(float(ratio[k]), grid.size / OVERSAMPLED)
        if chance > ALPHA:
            break
        line, left = _line(float(grid[k]), left, angles, rows, chance)
        line = replace(line, share=line.share * before / max(float(e @ e), 1e-300))
        found += [line] if line.amplitude > SURE * line.stderr else []
        searched &= np.abs(grid - grid[k]) > APART * angles.step
        power = np.square(np.abs(_sums(left, angles, grid)))
        level = _level(power)
    found.sort(key=lambda one: -one.amplitude)
    # The level is that of what stays beside the lines.
    shown = _shown(grid, whole, level, e.size)
    return AngleSpectrum(equation, shown[0], scale * shown[1], scale * shown[2], tuple(found), unit)


def false_alarm(ratio: float, lines: float) -> float:
    """Chance that any of so many lines of noise stands this far above the level of its neighbours."""
    single = (1.0 + ratio / NEIGHBOURS) ** -NEIGHBOURS
    return float(-np.expm1(lines * np.log1p(-min(single, 1.0 - 1e-16))))


def threshold(lines: float) -> float:
    """Ratio that has the false-alarm probability `ALPHA`."""
    single = -np.expm1(np.log1p(-ALPHA) / lines)
    return float(NEIGHBOURS * (single ** (-1.0 / NEIGHBOURS) - 1.0))


def _sums(e: Array, angles: Angles, grid: Array) -> Complex:
    """Sums of e exp(-i cycles angle) by a transform over the angle; shape of the grid."""
    from scipy.fft import next_fast_len, rfft

    # Bins eight times finer than the shortest ripple: what lies within one is shared between its two neighbours.
    per_turn = 8.0 * float(grid[-1])
    place = (angles.angle - angles.angle.min()) * (per_turn / TURN)
    size = next_fast_len(int(OVERSAMPLED * (int(place.max()) + 2)), real=True)
    first = place.astype(np.intp)
    share, e = place - first, e * angles.passed
    binned = np.bincount(first, e * (1.0 - share), size) + np.bincount(first + 1, e * share, size)
    found = rfft(binned)
    at = grid * (size / per_turn)
    return np.asarray(found[np.clip(np.rint(at).astype(np.intp), 0, found.size - 1)], dtype=np.complex128)


def _level(power: Array) -> Array:
    """Mean power of noise about each line, from the median of the neighbours."""
    from scipy.ndimage import median_filter

    # The line itself, a few widths wide, is none of its neighbours.
    reach, own = NEIGHBOURS * OVERSAMPLED, round(APART * OVERSAMPLED)
    middle = median_filter(power, reach, mode="reflect")
    away = own + reach // 2
    padded = np.pad(middle, away, mode="edge")
    either = np.maximum(padded[: power.size], padded[2 * away :])
    return np.asarray(np.maximum(either / np.log(2.0), 1e-300 + 1e-12 * float(power.max())))


def _line(cycles: float, e: Array, angles: Angles, rows: Rows, chance: float) -> tuple[AngleLine, Array]:
    """The line near a number of cycles, and the residual without it."""
    # A parabola through the neighbours would do; trying a few is as short.
    tried = cycles + angles.step * np.linspace(-0.25, 0.25, 11)
    best = float(tried[int(np.argmax(np.abs(_direct(e, angles, tried))))])
    C = rows(best)
    (a, b), *_ = np.linalg.lstsq(C, e, rcond=None)
    left = e - C @ np.array([a, b])
    size = float(np.sqrt(np.mean(np.square(C).sum(axis=0))))
    stderr = float(np.sqrt(np.mean(np.square(left)))) / max(size, 1e-300)
    line = AngleLine(
        cycles_per_motor_revolution=best / angles.gear_ratio,
        cycles_per_joint_revolution=best,
        amplitude=float(np.hypot(a, b)),
        stderr=stderr,
        share=1.0 - float(left @ left) / max(float(e @ e), 1e-300),
        phase=float(np.arctan2(-b, a)),
        false_alarm=chance,
    )
    return line, left


def _direct(e: Array, angles: Angles, cycles: Array) -> Complex:
    return np.asarray(np.exp(-1j * cycles[:, None] * angles.angle) @ (e * angles.passed), dtype=np.complex128)


def _shown(grid: Array, power: Array, level: Array, rows: int) -> tuple[Array, Array, Array]:
    """Envelope of the spectrum with the level that noise exceeds in one of a hundred records."""
    edges: Sequence[int] = np.unique(np.linspace(0, grid.size, SHOWN + 1).astype(np.intp))[:-1].tolist()
    top = np.maximum.reduceat(power, edges)
    limit = level * threshold(grid.size / OVERSAMPLED)
    at = [a + int(np.argmax(power[a:b])) for a, b in zip(edges, [*edges[1:], grid.size], strict=True)]
    scale = 2.0 / rows
    return grid[at], scale * np.sqrt(top), scale * np.sqrt(limit[at])
