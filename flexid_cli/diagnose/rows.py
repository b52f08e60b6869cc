"""Whitened rows: the equations of one record in the band that its sensors resolve, weighted by their own noise.

Every column passes the same chain: it is made at the full rate, tapered at the ends of its stretch, and taken to
the frequency domain; there the equations are weighted by the inverse root of the spectral matrix of their noise
(encoder noise through the model, torque noise), cut at the band, and brought back to rows in time at twice the
band. A relation that is linear in the columns holds in the rows as before, and the rows' noise is white with unit
variance where nothing but the sensors' noise is left.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexid_cli.effects.motion import Base
from flexid_cli.estimate.budget import NoiseLevels

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

TAPER_S = 0.5


@dataclass(frozen=True)
class Taper:
    """Window of one stretch and the frequencies kept of it."""

    window: Array
    samples: int
    transform: int
    frequency_hz: Array
    rate_hz: float

    @classmethod
    def of(cls, samples: int, rate_hz: float, band_hz: float, margin: int) -> Taper:
        """Taper with ``margin`` samples left out at each end."""
        from scipy.fft import next_fast_len

        ramp_samples = max(2, min(round(TAPER_S * rate_hz), (samples - 2 * margin) // 4))
        ramp = 0.5 - 0.5 * np.cos(np.pi * (np.arange(ramp_samples) + 0.5) / ramp_samples)
        window = np.zeros(samples)
        window[margin : samples - margin] = 1.0
        window[margin : margin + ramp_samples] = ramp
        window[samples - margin - ramp_samples : samples - margin] = ramp[::-1]
        # The zeros behind the record keep the weighting's reach from wrapping around.
        transform = next_fast_len(samples + round(rate_hz), real=True)
        frequency = np.asarray(np.fft.rfftfreq(transform, 1.0 / rate_hz), dtype=np.float64)
        kept = _fast(int(np.count_nonzero(frequency <= band_hz)) - 1) + 1
        return cls(window, samples, transform, frequency[:kept], rate_hz)

    def spectrum(self, x: Array) -> Complex:
        """Transform of the tapered columns, shape (frequencies, k) from (n, k)."""
        from scipy.fft import rfft

        kept = self.frequency_hz.size
        out = np.empty((x.shape[1], kept), dtype=np.complex128)
        tapered = np.empty(self.transform)
        # One after the other: all at once they would not fit into the processor's caches.
        for row, column in zip(out, x.T, strict=True):
            np.multiply(column, self.window, out=tapered[: self.samples])
            tapered[self.samples :] = 0.0
            row[:] = rfft(tapered)[:kept]
        return out.T


def _fast(count: int) -> int:
    """Largest number of lines up to ``count`` whose transform is fast: one to two percent less at most."""
    from scipy.fft import next_fast_len

    return next((n for n in range(count, 0, -1) if next_fast_len(n) == n), count)


class Weights:
    """Whitening of one stretch.

    Parameters
    ----------
    taper : Taper
    spectral : ndarray, shape (frequencies, m, m)
        Spectral matrix of the equations' noise, in units of (N m)^2 a sample.
    trust : ndarray, shape (m, rows), optional
        Further weight of each row that `apply` gives.
    """

    def __init__(self, taper: Taper, spectral: Complex, trust: Array | None = None) -> None:
        self.taper = taper
        root = np.linalg.cholesky(spectral)
        self.inverse = np.linalg.inv(root)
        self.equations = spectral.shape[-1]
        # Mean logarithm of the noise's determinant: what likelihoods of differently weighted rows differ by.
        self.level = float(2.0 * np.mean(np.log(np.abs(np.diagonal(root, axis1=1, axis2=2)))))
        self.rows = 2 * (taper.frequency_hz.size - 1)
        # Rows are kept where the taper is open at least by half.
        position = np.arange(self.rows) * (taper.transform / self.rows)
        self.open = np.interp(position, np.arange(taper.samples), taper.window, right=0.0) > 0.5
        inside = np.flatnonzero(self.open)
        self._inside = slice(int(inside[0]), int(inside[-1]) + 1) if inside.size else slice(0)
        self._mixing = np.ascontiguousarray(
            np.moveaxis(np.sqrt(self.rows / taper.transform) * self.inverse, 0, -1)
        )
        self.seconds = position[self.open] / taper.rate_hz
        self.trust = trust
        if trust is not None:
            self.level -= 2.0 * float(np.mean(np.log(trust)))

    def apply(self, columns: Sequence[Complex | None]) -> Array:
        """Rows of one or more columns, shape (equations, rows, k); None stands for zeros."""
        out = self.plain(columns)
        return out if self.trust is None else out * self.trust[:, :, None]

    def plain(self, columns: Sequence[Complex | None]) -> Array:
        """The rows without their trust."""
        from scipy.fft import irfft

        k = next(c.shape[1] for c in columns if c is not None)
        out = np.zeros((self.equations, k, int(self.open.sum())))
        for i in range(self.equations):
            mixed = None
            for j, column in enumerate(columns):
                if column is None or j > i:
                    continue
                part = self._mixing[i, j] * column.T
                mixed = part if mixed is None else mixed + part
            if mixed is not None:
                out[i] = irfft(mixed, self.rows, axis=1, overwrite_x=True)[:, self._inside]
        return out.swapaxes(1, 2)

    def back(self, rows: Array) -> Array:
        """Transpose of `apply` over the taper: what rows weigh each sample with, shape (equations, n).

        ``apply(spectrum(c))`` times ``rows`` is the sum of c times this, for any column c of an equation.
        """
        from scipy.fft import irfft, rfft

        spread = np.zeros((self.equations, self.rows))
        spread[:, self.open] = rows if self.trust is None else rows * self.trust
        Z = rfft(spread, axis=1)
        # The last frequency is real in the rows; the taper leaves nothing there to speak of.
        scale = np.sqrt(self.rows / self.taper.transform) * self.taper.transform / self.rows
        out = np.zeros((self.equations, self.taper.samples))
        for j in range(self.equations):
            mixed = np.einsum("fi,if->f", np.conj(self.inverse[:, :, j]), Z)
            out[j] = scale * irfft(mixed, self.taper.transform)[: self.taper.samples]
        return out * self.taper.window


def two_encoder_noise(base: Base, noise: NoiseLevels, omega: Array) -> Complex:
    """Spectral matrix of the noise of motor and load equation, shape (frequencies, 2, 2)."""
    s = 1j * omega
    zero = np.zeros_like(s)
    motor = base.Jm * s**2 + base.FVm * s + base.K
    load = base.JL * s**2 + base.FV * s + base.K
    A = np.stack(
        [
            np.stack(
                [
                    zero + noise.torque_at(omega),
                    motor * noise.motor_position,
                    zero - base.K * noise.joint_position,
                ],
                -1,
            ),
            # Noise of the torsion pulls on motor and load in opposite directions.
            np.stack([zero, zero - base.K * noise.motor_position, load * noise.joint_position], -1),
        ],
        -2,
    )
    return np.asarray(A @ np.conj(np.swapaxes(A, -1, -2)))


def motor_only_noise(base: Base, noise: NoiseLevels, omega: Array) -> Complex:
    """Spectral density of the noise of eq. (18), shape (frequencies, 1, 1)."""
    s = 1j * omega
    inverse = 1.0 + (base.FV * s + base.JL * s**2) / base.K
    motor = (base.Jm * s**2 + base.FVm * s) * inverse + base.JL * s**2 + base.FV * s
    density = np.abs(inverse * noise.torque_at(omega)) ** 2 + np.abs(motor * noise.motor_position) ** 2
    return np.asarray(density[:, None, None].astype(np.complex128))
