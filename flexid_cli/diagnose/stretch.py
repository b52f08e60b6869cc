"""One gap-free stretch of a record: its signals, their motion, and the transforms that equations are made of."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from flexid_cli.diagnose.mean_sign import FINE, between, mean_sign
from flexid_cli.diagnose.rows import Complex, Taper
from flexid_cli.pipeline import filters
from flexid_cli.pipeline.columns import reversal
from flexid_cli.pipeline.derivatives import differentiate
from flexid_cli.signals.recording import Segment

Array = NDArray[np.float64]
Sharpener = Callable[[Segment, float], Sequence[Array]]

HALF_WIDTH = 12  # of the derivatives: exact to 1e-6 up to a third of the sampling rate
MARGIN = 4 * HALF_WIDTH  # samples at the ends that derivatives of derivatives cannot reach
# Bands over that of the rows: of the motion that columns are made of, and of the velocities whose sign is taken. A
# reversal is sharper than any band; the joint's encoder sees more noise and a load that reverses more softly.
SMOOTH_BAND, MOTOR_SIGN_BAND, JOINT_SIGN_BAND = 1.5, 4.0, 2.0
HIGHEST_CUTOFF = 0.44  # of the sampling rate; above it nothing is cut


class Stretch:
    """One gap-free segment: its signals and their smoothed motion.

    Parameters
    ----------
    segment : Segment
    rate_hz, band_hz : float
        Sampling rate, and band of the rows.
    sharpener : callable, optional
        (segment, rate) -> the velocities whose sign is taken, in place of low-passed ones.

    Attributes
    ----------
    torque, motor, joint : ndarray, shape (n,)
        The signals as recorded; the joint's is empty where it has no encoder.
    motor_smooth, motor_velocity, joint_smooth : ndarray, shape (n,)
        Low-passed for columns of effects.
    motor_sharp, joint_sharp : ndarray, shape (n,)
        Velocities whose sign is taken.
    """

    def __init__(
        self,
        segment: Segment,
        rate_hz: float,
        band_hz: float,
        sharpener: Sharpener | None = None,
    ) -> None:
        self.sharpener = sharpener
        self.rate_hz, self.period_s, self._band = rate_hz, 1.0 / rate_hz, band_hz
        self.torque, self.motor = segment.torque, segment.motor_position
        self.joint = np.empty(0) if segment.joint_position is None else segment.joint_position
        self.segment = segment
        self.start_s = segment.start_s
        self.time_s: Array = segment.start_s + np.arange(segment.samples, dtype=np.float64) * self.period_s
        self.taper = Taper.of(segment.samples, rate_hz, band_hz, MARGIN)
        self.motor_smooth = self.lowpass(self.motor, SMOOTH_BAND)
        self.motor_velocity = self.derivative(self.motor_smooth, 1)
        if self.joint.size:
            self.joint_smooth = self.lowpass(self.joint, SMOOTH_BAND)
        if sharpener is not None:
            self.motor_fine, *joint = sharpener(segment, rate_hz)
            self.motor_sharp = self.motor_fine[::FINE]
            for fine in joint:
                self.joint_fine, self.joint_sharp = fine, fine[::FINE]
            return
        self.motor_sharp = self.derivative(self.lowpass(self.motor, MOTOR_SIGN_BAND), 1)
        self.motor_fine = between(self.motor_sharp)
        if self.joint.size:
            self.joint_sharp = self.derivative(self.lowpass(self.joint, JOINT_SIGN_BAND), 1)
            self.joint_fine = between(self.joint_sharp)

    def motor_sign(self, width: float) -> Array:
        """Sign of the motor's velocity without a joint encoder, shape (n,)."""
        sharpened = self.sharpener is not None
        return mean_sign(self.motor_fine, width) if sharpened else reversal(self.motor_sharp, width)

    def like(self, segment: Segment) -> Stretch:
        """The same stretch with other signals."""
        return Stretch(segment, self.rate_hz, self._band, self.sharpener)

    @cached_property
    def motor_acceleration(self) -> Array:
        """Second derivative of the low-passed motor position, shape (n,)."""
        return self.derivative(self.motor_smooth, 2)

    @cached_property
    def torque_smooth(self) -> Array:
        """Low-passed torque, shape (n,)."""
        return self.lowpass(self.torque, SMOOTH_BAND)

    @cached_property
    def joint_derivatives(self) -> tuple[Array, Array]:
        """First and second derivative of the low-passed joint position, each (n,)."""
        return self.derivative(self.joint_smooth, 1), self.derivative(self.joint_smooth, 2)

    @cached_property
    def both_spectra(self) -> dict[str, Complex]:
        """Transforms that the equations of both encoders are made of, wherever they are linearised; each (f, k)."""
        one, joint = np.ones(self.torque.size), self.joint
        return {
            "torque": self.spectrum(self.torque),
            "one": self.spectrum(one),
            "torsion": self.spectrum(self.motor - joint),
            "motor": self._spectra([self.derivative(self.motor, 2), self.derivative(self.motor, 1)]),
            "joint": self._spectra([self.derivative(joint, 2), self.derivative(joint, 1)]),
            "gravity": self._spectra([np.cos(self.joint_smooth), np.sin(self.joint_smooth)]),
        }

    @cached_property
    def alone_spectra(self) -> dict[str, Complex]:
        """Transforms of torque, motor acceleration and velocity, each with its first and second derivative (f, 3)."""
        signals = {
            "torque": self.torque,
            "acceleration": self.derivative(self.motor, 2),
            "velocity": self.derivative(self.motor, 1),
        }
        return {name: self.differentiated(x) for name, x in signals.items()}

    def differentiated(self, x: Array) -> Complex:
        """Transform of a signal, of its first and of its second derivative, shape (f, 3)."""
        return self._spectra([x, self.derivative(x, 1), self.derivative(x, 2)])

    def _spectra(self, signals: Sequence[Array]) -> Complex:
        return np.hstack([self.spectrum(x) for x in signals])

    def sharpened(self, sharpener: Sharpener) -> Stretch:
        """The same stretch with another way to tell the velocities where they reverse."""
        return Stretch(self.segment, self.rate_hz, self._band, sharpener)

    def lowpass(self, x: Array, over_band: float) -> Array:
        """Zero-phase low pass at a multiple of the rows' band."""
        cutoff = over_band * self._band
        if cutoff >= HIGHEST_CUTOFF * self.rate_hz:
            return x
        return filters.zero_phase(x, filters.butterworth(4, cutoff, self.rate_hz))

    def derivative(self, x: Array, order: int) -> Array:
        """Derivative of a signal (n,) or of columns (n, k)."""
        if x.ndim == 2:
            return np.column_stack([self.derivative(c, order) for c in x.T])
        y = differentiate(x, order, self.period_s, half_width=HALF_WIDTH)
        # The ends cannot be differentiated; a spike there would ring through the effects' filters.
        reach = HALF_WIDTH * ((order + 1) // 2)
        y[:reach], y[-reach:] = y[reach], y[-reach - 1]
        return y

    def spectrum(self, x: Array) -> Complex:
        """Transform of a tapered signal or of columns."""
        return self.taper.spectrum(x[:, None] if x.ndim == 1 else x)


def later(s: Stretch, spectrum: Complex, periods: float) -> Complex:
    """A torque that acts later; half a period is a hold, which a sinc damps (and whose undoing lifts)."""
    if periods == 0.0:
        return spectrum
    f = s.taper.frequency_hz[:, None]
    damping = np.sinc(f * s.period_s) ** np.sign(periods)
    return np.asarray(spectrum * np.exp(-2j * np.pi * f * periods * s.period_s) * damping)
