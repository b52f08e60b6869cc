"""Choice of the band by the error that it leaves: noise against distortion, weighed on the record itself.

A narrow band leaves out information, a wide one lets noise in, and with it what no model predicts: a torque that
changes between its samples, a sign whose reversals are blurred, physics that lives above the resonance. Each band is
tried with a fit of its own; its random error, what noise in its columns may move the estimates by, and its distortion
are all known from the record, so the band with the smallest error of Jm, K and JL together can be taken.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flexid_cli.errors import DataError
from flexid_cli.estimate.band import BAND_OVER_F1, Tuning
from flexid_cli.pipeline.chain import Chain

if TYPE_CHECKING:
    from flexid_cli.config.schema import Config

Array = NDArray[np.float64]

# Bands over f1 that are tried beside the usual one.
OTHERS = {"two_encoders": (1.2, 1.5, 2.5, 3.0), "motor_only": (1.1, 1.7, 2.0)}
# A standard error of nu degrees of freedom is itself known to 1 / sqrt(2 nu): another band is taken where its error
# is smaller by more than two of these. Less would be a choice by chance, and its intervals too short.
SURE = 2.0
MEANING = (
    "relative standard error of Jm, K and JL together in each band: random, noise in the columns, distortion; another"
    " band than the usual one is taken only where its error is smaller by more than the doubt about it"
)


@dataclass(frozen=True)
class Outcome:
    """What a fit in one band gives of Jm, K and JL.

    Attributes
    ----------
    estimate : ndarray, shape (3,)
    random, noise, systematic : ndarray, shape (3,)
        Standard errors: random, doubt about noise in the columns, all other sources.
    degrees_of_freedom : float
        Least one of the random parts.
    """

    estimate: Array
    random: Array
    noise: Array
    systematic: Array
    degrees_of_freedom: float

    @property
    def total(self) -> Array:
        """Standard errors of all sources together, shape (3,)."""
        return np.asarray(np.sqrt(self.random**2 + self.noise**2 + self.systematic**2))


@dataclass(frozen=True)
class Trial:
    """One band: its settings and its errors, as shares of the estimates (root mean square over Jm, K, JL)."""

    tuning: Tuning
    band_hz: float
    random: float
    noise: float
    distortion: float

    @property
    def error(self) -> float:
        """All of it together."""
        return float(np.sqrt(self.random**2 + self.noise**2 + self.distortion**2))


@dataclass(frozen=True)
class BandChoice:
    """The bands that were tried, by frequency, and which were the usual and the taken one."""

    trials: tuple[Trial, ...]
    usual: int
    taken: int

    @property
    def tuning(self) -> Tuning:
        """Settings of the band that was taken."""
        return self.trials[self.taken].tuning

    @property
    def moved(self) -> bool:
        """Whether it is another one than the usual band."""
        return self.taken != self.usual

    def test(self) -> dict[str, Any]:
        """For the report."""
        return {
            "band_hz": self.trials[self.taken].band_hz,
            "usual_band_hz": self.trials[self.usual].band_hz,
            "bands_hz": [t.band_hz for t in self.trials],
            "error_percent": [100.0 * t.error for t in self.trials],
            "random_percent": [100.0 * t.random for t in self.trials],
            "noise_percent": [100.0 * t.noise for t in self.trials],
            "distortion_percent": [100.0 * t.distortion for t in self.trials],
            "meaning": MEANING,
        }


def is_automatic(config: Config) -> bool:
    """Whether the configuration leaves band and decimation to the data."""
    pipeline = config.pipeline
    return (
        pipeline.band_hz is None
        and pipeline.decimation is None
        and pipeline.lowpass is None
        and config.estimate.covariance == "hac"
    )


def weigh(
    model_id: str, tuned: Callable[[float], Tuning], outcome: Callable[[Tuning], Outcome]
) -> BandChoice | None:
    """Try bands about the usual one.

    Parameters
    ----------
    model_id : {"two_encoders", "motor_only"}
    tuned : callable
        Settings for a band over f1.
    outcome : callable
        The fit in the band of such settings; a `DataError` says that there is none.

    Returns
    -------
    BandChoice or None
        None where the usual band cannot be judged.
    """
    usual = tuned(BAND_OVER_F1[model_id])
    found: dict[int, tuple[Tuning, Outcome]] = {}
    for tuning in (usual, *(tuned(multiple) for multiple in OTHERS[model_id])):
        decimation = tuning.chain.decimation
        if decimation in found:
            continue
        try:
            result = outcome(tuning)
        except DataError:
            continue
        if np.all(result.estimate > 0.0) and np.all(np.isfinite(result.total)):
            found[decimation] = tuning, result
    if usual.chain.decimation not in found:
        return None
    order = sorted(found, reverse=True)
    narrowest = found[order[0]][1]
    trials = tuple(_trial(*found[d], narrowest) for d in order)
    own = order.index(usual.chain.decimation)
    best = min(range(len(order)), key=lambda k: trials[k].error)
    doubt = SURE / np.sqrt(2.0 * found[usual.chain.decimation][1].degrees_of_freedom)
    worth = trials[best].error < (1.0 - doubt) * trials[own].error
    return BandChoice(trials, own, best if worth else own)


def _trial(tuning: Tuning, found: Outcome, narrowest: Outcome) -> Trial:
    """Errors of a band; what it is off from the narrowest band beyond both their errors is distortion."""
    away = (found.estimate - narrowest.estimate) ** 2 - found.total**2 - narrowest.total**2
    distortion = np.sqrt(found.systematic**2 + np.maximum(away, 0.0))

    def relative(part: Array) -> float:
        return float(np.sqrt(np.mean((part / found.estimate) ** 2)))

    band_hz = Chain(tuning.chain).band_hz
    return Trial(tuning, band_hz, relative(found.random), relative(found.noise), relative(distortion))
