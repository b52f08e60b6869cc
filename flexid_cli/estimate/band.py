"""Choice of band, decimation and filters from the data, where the configuration is silent."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from flexid_cli.errors import DataError
from flexid_cli.estimate.covariance import robust_covariance
from flexid_cli.estimate.least_squares import solve
from flexid_cli.models.two_encoders import TwoEncoders
from flexid_cli.pipeline.chain import MIN_ROWS, Chain, ChainSettings
from flexid_cli.pipeline.columns import Columns
from flexid_cli.pipeline.spectrum import welch
from flexid_cli.pipeline.tuning import DECIMATION_EDGE, tune_filter
from flexid_cli.threads import side_by_side

if TYPE_CHECKING:
    from flexid_cli.config.schema import Config
    from flexid_cli.signals.recording import Recording

Array = NDArray[np.float64]

# The band over f1. Both encoders: the paper's lower bound of wc. Motor alone: the paper's own 5.4 Hz over 3.9 Hz;
# above it the fourth derivative carries more encoder noise than information.
BAND_OVER_F1 = {"two_encoders": 2.0, "motor_only": 1.4}
# One mass describes the axis below its antiresonance only: at a third of f1 the spring adds about a tenth of JL.
RIGID_BAND_OVER_F1 = 0.3
# Signals are used up to the frequency at which their power still is ten times their noise floor.
SIGNAL_TO_NOISE = 10.0
# A rigid axis has no resonance to tune to: its band holds nearly all of the torque's power and no more.
TORQUE_POWER = 0.999
# The velocity whose sign is taken keeps this many times the columns' band.
SIGN_BAND = 8.0
SCAN_STEP = 1.25
SCAN_RANGE = (0.5, 0.95)
SCAN_MAX_RELATIVE_STDERR = 0.1
# A band shows a resonance only where the load inertia behind the spring, X5 - X3/X1, stands out of its noise: five
# standard errors, for some twenty bands are looked at.
CLEAR_LOAD = 5.0
LOWPASS_ORDER = {"two_encoders": 4, "motor_only": 6, "rigid": 4}
HIGHEST_DERIVATIVE = {"two_encoders": 2, "motor_only": 4, "rigid": 2}
MAX_BAND_OVER_RATE = 0.2


@dataclass(frozen=True)
class Tuning:
    """Settings for one model.

    Attributes
    ----------
    chain : ChainSettings
        Filters of all columns.
    sign_cutoff_hz : float
        Band of the velocity whose sign is taken.
    f1_hz, f1_source : float or None, str
        Free-free resonance and where it came from (``configuration``, ``data``, empty).
    """

    chain: ChainSettings
    sign_cutoff_hz: float
    f1_hz: float | None
    f1_source: str


def choose_tuning(
    recording: Recording, config: Config, model_id: str, f1_hz: float | None, over_f1: float | None = None
) -> Tuning:
    """Settings for ``model_id``; ``f1_hz`` is the resonance found in the data, used unless configured.

    ``over_f1`` is the band over the resonance, `BAND_OVER_F1` unless given.

    Raises
    ------
    DataError
        Motor encoder alone, and no resonance in the band that the record excites.
    """
    configured = config.axis.f1_hz
    f1 = configured or f1_hz
    source = "configuration" if configured else ("data" if f1 else "")
    rate = recording.sample_rate_hz
    band = _band(recording, config, model_id, f1, over_f1 or BAND_OVER_F1.get(model_id))
    decimation = config.pipeline.decimation or max(1, int(0.5 * DECIMATION_EDGE * rate / band))
    if config.pipeline.decimation is not None:
        band = 0.5 * DECIMATION_EDGE * rate / decimation
    order, cutoff = _lowpass(config, model_id, f1, band, rate, decimation)
    chain = ChainSettings(
        sample_rate_hz=rate,
        lowpass_order=order,
        lowpass_cutoff_hz=cutoff,
        derivative=config.pipeline.derivative or "exact",
        decimation=decimation,
        trim_s=config.pipeline.trim_s,
    )
    sign_cutoff = config.pipeline.sign_cutoff_hz or min(SIGN_BAND * band, MAX_BAND_OVER_RATE * rate)
    return Tuning(chain, sign_cutoff, f1, source)


def narrower(tuning: Tuning, config: Config, recording: Recording) -> Tuning | None:
    """The same settings with a band a fifth narrower, or None where the record is too short for less."""
    rate = recording.sample_rate_hz
    current = 0.5 * DECIMATION_EDGE * rate / tuning.chain.decimation
    wanted = 0.8 * min(current, tuning.chain.lowpass_cutoff_hz or current)
    decimation = max(tuning.chain.decimation + 1, round(0.5 * DECIMATION_EDGE * rate / wanted))
    if max(s.samples for s in recording.segments) / decimation < 20 * MIN_ROWS:
        return None
    reached = 0.5 * DECIMATION_EDGE * rate / decimation
    order, cutoff = _lowpass(config, "rigid", None, reached, rate, decimation)
    chain = replace(tuning.chain, decimation=decimation, lowpass_order=order, lowpass_cutoff_hz=cutoff)
    sign_cutoff = config.pipeline.sign_cutoff_hz or min(SIGN_BAND * reached, MAX_BAND_OVER_RATE * rate)
    return replace(tuning, chain=chain, sign_cutoff_hz=sign_cutoff)


def _band(
    recording: Recording, config: Config, model_id: str, f1: float | None, over_f1: float | None
) -> float:
    """Wanted upper edge of the band, Hz."""
    rate = recording.sample_rate_hz
    if config.pipeline.band_hz is not None:
        return config.pipeline.band_hz
    usable = usable_band(recording, joint=model_id == "two_encoders")
    if model_id == "rigid":
        wanted = RIGID_BAND_OVER_F1 * f1 if f1 else min(usable, torque_band(recording))
    elif f1 and over_f1:
        wanted = over_f1 * f1
    elif model_id == "two_encoders" or config.pipeline.decimation is not None:
        wanted = usable
    else:
        raise DataError(
            "no resonance stands out of the record, so the motor encoder alone does not show the flexibility",
            "excite the axis around its first resonance, give axis.f1_hz, record the joint encoder, or use the"
            " model `rigid`",
        )
    shortest = max(s.samples for s in recording.segments) / rate
    lowest = MIN_ROWS / shortest
    return float(np.clip(min(wanted, max(usable, 1.2 * f1 if f1 and model_id != "rigid" else 0.0)),
                         lowest, MAX_BAND_OVER_RATE * rate))  # fmt: skip


def _lowpass(
    config: Config, model_id: str, f1: float | None, band: float, rate: float, decimation: int
) -> tuple[int, float | None]:
    if config.pipeline.lowpass is not None:
        return config.pipeline.lowpass.order, config.pipeline.lowpass.cutoff_hz
    order = LOWPASS_ORDER[model_id]
    cutoff = 4.0 * band
    if f1 and model_id != "rigid":
        cutoff = max(cutoff, tune_filter(f1, HIGHEST_DERIVATIVE[model_id], m=order).wn_hz)
    if decimation == 1:
        cutoff = min(band, MAX_BAND_OVER_RATE * rate)
    return (order, cutoff) if cutoff < 0.4 * rate else (order, None)


def usable_band(recording: Recording, *, joint: bool) -> float:
    """Highest frequency at which the positions' power is ten times their noise floor, Hz."""
    segment = max(recording.segments, key=lambda s: s.samples)
    rate = recording.sample_rate_hz
    positions = [segment.motor_position]
    if joint and segment.joint_position is not None:
        positions.append(segment.joint_position)
    edges = []
    for position in positions:
        length = int(min(position.size - 2, max(256, 8 * rate)))
        frequency, density = welch(np.diff(position, 2), rate, length)
        shaped = density / np.maximum((2.0 * np.sin(np.pi * frequency / rate)) ** 4, 1e-30)
        floor = np.median(shaped[frequency > 0.3 * rate])
        above = frequency[1:][shaped[1:] > SIGNAL_TO_NOISE * floor]
        edges.append(float(above[-1]) if above.size else rate * MAX_BAND_OVER_RATE)
    return (
        min(*edges, MAX_BAND_OVER_RATE * rate) if len(edges) > 1 else min(edges[0], MAX_BAND_OVER_RATE * rate)
    )


def torque_band(recording: Recording) -> float:
    """Frequency below which 99.9 % of the torque's power about its mean lies, Hz."""
    segment = max(recording.segments, key=lambda s: s.samples)
    rate = recording.sample_rate_hz
    length = int(min(segment.samples, max(256, 8 * rate)))
    frequency, density = welch(segment.torque - segment.torque.mean(), rate, length)
    share = np.cumsum(density) / np.sum(density)
    return float(frequency[min(int(np.searchsorted(share, TORQUE_POWER)), frequency.size - 1)])


def find_resonance(recording: Recording, gravity_m_per_s2: float) -> float | None:
    """Free-free resonance from the data, Hz, or None where the record does not show one.

    A linear fit at each of a series of bands gives a resonance; the one whose band reaches just above its own
    resonance, and whose columns determine it best, is taken.
    """
    solver = _resonance_both if recording.has_joint_position else _resonance_motor
    rate = recording.sample_rate_hz
    longest = max(s.samples for s in recording.segments) / rate
    band = max(4.0 * MIN_ROWS / longest, 0.2)
    highest = min(MAX_BAND_OVER_RATE * rate, usable_band(recording, joint=recording.has_joint_position))
    bands = []
    while band <= highest:
        bands.append(band)
        band *= SCAN_STEP
    best: tuple[float, float] | None = None
    results = side_by_side(lambda b: _resonance_at(recording, b, solver, gravity_m_per_s2), bands)
    for band, found in zip(bands, results, strict=True):
        if found is not None:
            resonance, uncertainty = found
            inside = SCAN_RANGE[0] < resonance / band < SCAN_RANGE[1]
            if inside and uncertainty < SCAN_MAX_RELATIVE_STDERR and (best is None or uncertainty < best[1]):
                best = (resonance, uncertainty)
    return best[0] if best else None


def _resonance_at(
    recording: Recording,
    band: float,
    solver: Callable[[Columns], tuple[float, float] | None],
    gravity_m_per_s2: float,
) -> tuple[float, float] | None:
    """Resonance by ``solver`` in one band, or None where it has no meaning there."""
    rate = recording.sample_rate_hz
    decimation = max(1, int(0.5 * DECIMATION_EDGE * rate / band))
    cutoff = 3.0 * band if decimation > 1 else band
    chain = Chain(
        ChainSettings(rate, lowpass_cutoff_hz=cutoff if cutoff < 0.4 * rate else None, decimation=decimation)
    )
    try:
        columns = Columns(
            recording, chain, min(SIGN_BAND * band, MAX_BAND_OVER_RATE * rate), gravity_m_per_s2
        )
        return solver(columns) if columns.segments else None
    except DataError:
        return None


def _resonance_motor(columns: Columns) -> tuple[float, float] | None:
    """sqrt(X5 / X3) / 2 pi and its relative standard error, from the paper's columns and two more."""
    signs = [-1.0, -1.0] + 7 * [1.0]
    names = [("torque", 2), ("torque", 1), ("motor", 4), ("motor", 3), ("motor", 2), ("motor", 1)]
    names += [("sign_motor", 0), ("one", 0), ("motor", 0)]
    W = np.column_stack([s * columns(*c) for s, c in zip(signs, names, strict=True)])
    result = solve(W, columns("torque", 0))
    robust = robust_covariance(W * result.residuals[:, None], result.bread, columns.lengths)
    index = [0, 2, 4]
    X1, X3, X5 = (float(x) for x in result.estimate[index])
    if not (X1 > 0.0 and X3 > 0.0 and X5 > X3 / X1):
        return None
    covariance = robust.covariance[np.ix_(index, index)]
    gradient = np.array([X3 / X1**2, -1.0 / X1, 1.0])
    if CLEAR_LOAD * float(np.sqrt(gradient @ covariance @ gradient)) > X5 - X3 / X1:
        return None
    relative = np.sqrt(np.diag(covariance)) / np.array([X1, X3, X5])
    return float(np.sqrt(X5 / X3) / (2.0 * np.pi)), float(np.max(relative))


def _resonance_both(columns: Columns) -> tuple[float, float] | None:
    """sqrt(K (1/Jm + 1/JL)) / 2 pi and the largest relative standard error of K, Jm, JL, equation by equation."""
    motor = TwoEncoders.blocks[0]
    W = np.column_stack([columns(*c) for c in motor.columns[1:]])
    first = solve(W, columns("torque", 0))
    Jm, K = first.estimate[[0, 3]]
    # q'' regressed on torsion is K/JL; the reverse would be drawn to zero by noise in q''.
    W = np.column_stack(
        [columns("torsion", 0), columns("joint", 1), columns("sign_joint", 0), columns("one", 0)]
    )
    second = solve(W, columns("joint", 2))
    ratio = second.estimate[0]
    if not (Jm > 0.0 and K > 0.0 and ratio > 0.0):
        return None
    relative = [*(first.stderr[[0, 3]] / first.estimate[[0, 3]]), second.stderr[0] / ratio]
    return float(np.sqrt(K / Jm + ratio) / (2.0 * np.pi)), float(np.max(relative))
