"""The one chain of filters that every column of the observation matrix passes: equal distortion everywhere."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from flexid_cli.errors import DataError
from flexid_cli.pipeline import derivatives, filters
from flexid_cli.pipeline.tuning import DECIMATION_EDGE

Array = NDArray[np.float64]

MIN_ROWS = 12
MAX_TRIM_FRACTION = 0.08


@dataclass(frozen=True)
class ChainSettings:
    """What is done to each column.

    Attributes
    ----------
    sample_rate_hz : float
        Rate of the recording.
    lowpass_order, lowpass_cutoff_hz : int, float or None
        Zero-phase Butterworth, before the derivative, on every column alike; None: left out.
    derivative : {"exact", "central"}
        Kind of derivative.
    decimation : int
        Nd: filter, then keep one row in Nd.
    trim_s : float or None
        Cut off at each edge of each segment; None: three samples a filter order (24 Nd samples).
    """

    sample_rate_hz: float
    lowpass_order: int = 4
    lowpass_cutoff_hz: float | None = None
    derivative: str = "exact"
    decimation: int = 1
    trim_s: float | None = None


@dataclass(frozen=True)
class Chain:
    """Low pass, derivative, parallel decimation, trim: a linear operator, the same for every column.

    The decimation filter starts at rest on all columns, so that a linear relation between what enters it holds
    exactly between the rows; what the derivative cannot reach and the low pass has not settled on does not enter.
    """

    settings: ChainSettings

    @cached_property
    def _lowpass(self) -> Array | None:
        cutoff = self.settings.lowpass_cutoff_hz
        if cutoff is None:
            return None
        return filters.butterworth(self.settings.lowpass_order, cutoff, self.settings.sample_rate_hz)

    @cached_property
    def _decimation(self) -> Array:
        return filters.decimation_filter(self.settings.decimation)

    @cached_property
    def half_width(self) -> int:
        """Half width of the exact derivative for this band."""
        if self.settings.derivative == "central":
            return 1
        return derivatives.half_width_for(min(self.band_hz / self.settings.sample_rate_hz, 0.4))

    @cached_property
    def _reach(self) -> int:
        """Samples at each end that the derivative cannot reach or the low pass has not settled on.

        The low pass extends the signal beyond its ends, which does not commute with the derivative: these samples
        must be gone before the decimation filter spreads them.
        """
        settling = 0 if self._lowpass is None else filters.settling_samples(self._lowpass)
        kind = self.settings.derivative
        return derivatives.reach(kind, derivatives.MAX_ORDER, self.half_width) + settling

    @property
    def band_hz(self) -> float:
        """Upper edge of the effective band: the lower of decimation edge and low-pass cutoff."""
        nyquist = 0.5 * self.settings.sample_rate_hz
        edges = [nyquist]
        if self.settings.decimation > 1:
            edges.append(DECIMATION_EDGE * nyquist / self.settings.decimation)
        if self.settings.lowpass_cutoff_hz is not None:
            edges.append(self.settings.lowpass_cutoff_hz)
        return min(edges)

    @property
    def limited_by(self) -> str:
        """Which step sets the upper edge of the band."""
        cutoff = self.settings.lowpass_cutoff_hz
        return "lowpass" if cutoff is not None and self.band_hz == cutoff else "decimation"

    @property
    def row_period_s(self) -> float:
        """Time between rows."""
        return self.settings.decimation / self.settings.sample_rate_hz

    def trim_samples(self, samples: int) -> int:
        """Samples cut off at each edge of a segment of ``samples``, beyond the derivative's reach."""
        if self.settings.trim_s is not None:
            return round(self.settings.trim_s * self.settings.sample_rate_hz)
        if self.settings.decimation > 1:
            wanted = 3 * filters.DECIMATION_ORDER * self.settings.decimation
        else:
            wanted = round(
                3 * self.settings.lowpass_order * self.settings.sample_rate_hz / (4 * self.band_hz)
            )
        return min(wanted, int(MAX_TRIM_FRACTION * samples))

    def rows(self, samples: int) -> int:
        """Rows that a segment of ``samples`` gives; 0 where it is too short."""
        return max(0, len(range(*self._kept(samples))))

    def _kept(self, samples: int) -> tuple[int, int, int]:
        margin = self._reach + self.trim_samples(samples)
        return margin, samples - margin, self.settings.decimation

    def row_times(self, samples: int, start_s: float) -> Array:
        """Times of the rows of a segment that starts at ``start_s``."""
        return start_s + np.arange(*self._kept(samples)) / self.settings.sample_rate_hz

    def apply(self, x: Array, derivative: int = 0) -> Array:
        """One column: the derivative of a signal, filtered and decimated.

        Parameters
        ----------
        x : ndarray, shape (n,)
            A signal of one segment.
        derivative : int
            Order of the derivative, 0 to 4.

        Returns
        -------
        ndarray, shape (rows(n),)

        Raises
        ------
        DataError
            The segment is too short for the filters.
        """
        if self.rows(x.size) < 1:
            raise DataError(
                f"a segment of {x.size / self.settings.sample_rate_hz:.3g} s is too short for a band of"
                f" {self.band_hz:.3g} Hz",
                "record longer, or raise pipeline.band_hz",
            )
        return self.finish(self.smooth(x), derivative)

    def smooth(self, x: Array) -> Array:
        """The first step of `apply`, which all derivatives of a signal share: the low pass."""
        return x if self._lowpass is None else filters.zero_phase(x, self._lowpass)

    def finish(self, x: Array, derivative: int) -> Array:
        """The other steps of `apply`, on what `smooth` gave: derivative, decimation, trim."""
        reach = self._reach
        column = derivatives.differentiate(
            x,
            derivative,
            1.0 / self.settings.sample_rate_hz,
            kind=self.settings.derivative,
            half_width=self.half_width,
        )[reach : x.size - reach]
        if self.settings.decimation > 1:
            column = filters.zero_phase(column, self._decimation, settled_edges=False)
        start, stop, step = self._kept(x.size)
        return np.ascontiguousarray(column[start - reach : stop - reach : step])

    def magnitude(self, frequency_hz: Array) -> Array:
        """Magnitude of the chain, common to all columns (without the derivative)."""
        total = np.ones_like(frequency_hz)
        for sos in (self._lowpass, self._decimation):
            if sos is not None:
                total = total * filters.magnitude(sos, frequency_hz, self.settings.sample_rate_hz)
        return total
