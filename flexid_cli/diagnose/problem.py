"""The baseline and the columns of effects in whitened rows: what the search for effects works on."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from flexid_cli.diagnose.mean_sign import mean_sign
from flexid_cli.diagnose.rows import Complex, Weights, motor_only_noise, two_encoder_noise
from flexid_cli.diagnose.stretch import (
    HIGHEST_CUTOFF,
    JOINT_SIGN_BAND,
    MOTOR_SIGN_BAND,
    SMOOTH_BAND,
    Stretch,
    later,
)
from flexid_cli.effects.motion import Base, Motion, Terms
from flexid_cli.effects.signature import Scale
from flexid_cli.estimate.budget import NoiseLevels
from flexid_cli.estimate.driven import follow
from flexid_cli.pipeline.columns import reversal

if TYPE_CHECKING:
    from flexid_cli.config.schema import ModelName
    from flexid_cli.diagnose.search import Form

Array = NDArray[np.float64]
Numbers = TypeVar("Numbers", Array, Complex)
Part = Callable[[Stretch, Motion], Sequence[Complex | None]]
Effects = Sequence[tuple[Callable[[Motion], Terms], Array]]  # columns of effects and their amplitudes


# Torque that no model of a drive predicts, as a share of the torque's RMS: timing, rounding, the finite filters.
# See docs/diagnosis.md for the calibration.
MODEL_FLOOR = 0.001
ASTRAY = 1.6
BOTH_NAMES = ("Jm", "FVm", "FSm", "K", "c", "JL", "FV", "FS", "MX", "MY")
ZERO_STEP = 0.01  # of the torsion's standard deviation, for the slope of what effects add to the spring
SHARED = 1  # c, the spring's torque at its zero, stands in both equations
SPRING_ALONE = 1e-3  # share of an effect of the transmission outside of a spring that can be anything
PROBE_SEED, LEAST_PROBE = 20010523, 1e-4  # of the torsion's standard deviation
SCALED = ("JL", "FV", "FS", "MX", "MY")  # both encoders: times K at the linearisation over K
ALONE_NAMES = ("Jm", "FVm", "FSm", "K", "JL", "FV", "FS")
RIGID_NAMES = ("Jm", "FVm", "FSm", "offset")  # of motor and load together


class Joined(NamedTuple):
    """An effect of the model: its columns, their amplitudes, and whether it has a zero of its own."""

    columns: Callable[[Motion], Terms]
    amplitudes: Array
    centred: bool = False


class Problem:
    """Baseline columns, measurement and effect columns of one record, linearised at ``base``.

    With both encoders the load equation is one for the torsion, 0 = K0 (qm - q) - (K0 / K) (JL q'' + ...): as it
    stands, whatever it lacks would draw K and all load parameters to zero together, for there it is fulfilled too.
    K0 is the stiffness at the linearisation, so that effects have one amplitude in both equations. For the same
    reason what a transmission effect has in common with a spring is left to K, which then is the stiffness of both
    together.

    Parameters
    ----------
    stretches : sequence of Stretch
    base : Base
        Where the equations are linearised, and what their noise is shaped by.
    noise : NoiseLevels
        Of the signals.
    band_hz : float
        Highest frequency of the rows.
    gravity, gear_ratio, duration_s : float
    both : bool
        Motor and load equation from both encoders, or eq. (18) from the motor's alone.
    applied : mapping of Form to ndarray
        Errors of positions that are taken out of the stretches (both encoders), with their amplitudes.
    anchor : Base, optional
        What stiffness and inertias may not leave by more than `ASTRAY`: without a joint encoder they take up what
        the model lacks.
    settled : bool
        Whether the linearisation began at an estimate that can be trusted.
    shift : float
        Periods by which the torque acts later than its stamp says: half a one where it is held unsaid.
    rigid : bool
        The motor's encoder alone, and an axis that is taken for rigid: what ``base`` says of the load stays.
    stiffening : float
        Stiffness of the effects that the linearisation holds, beside that of ``base``.
    led : bool
        Without a joint encoder, whether the load's reversals are those of a simulation that the measured motor leads,
        or of the position that the torque shows: the one lacks effects, the other is blurred by noise.
    trust : sequence of ndarray, optional
        Further weight of each row, shape (equations, rows), by stretch.
    passing : sequence of Joined, optional
        Effects of the model that others come after: by which the transmission passes on more than its spring does,
        and limits of the torque.
    """

    def __init__(
        self,
        stretches: Sequence[Stretch],
        base: Base,
        noise: NoiseLevels,
        band_hz: float,
        *,
        gravity: float,
        gear_ratio: float,
        duration_s: float,
        both: bool,
        shift: float,
        applied: Mapping[Form, Array] | None = None,
        anchor: Base | None = None,
        settled: bool = True,
        stiffening: float = 0.0,
        rigid: bool = False,
        led: bool = False,
        trust: Sequence[Array] | None = None,
        passing: Sequence[Joined] = (),
    ) -> None:
        self.stretches, self.noise, self.band_hz = stretches, noise, band_hz
        self.base = replace(base, gear_ratio=gear_ratio)
        self.gravity, self.gear_ratio, self.duration_s = gravity, gear_ratio, duration_s
        self.both, self.shift, self.anchor = both, shift, anchor
        self.settled, self.stiffening, self.passing = settled, stiffening, passing
        self.applied: Mapping[Form, Array] = applied or {}
        self.recorded = stretches
        self.rigid, self.led = rigid, led
        self.names = BOTH_NAMES if both else RIGID_NAMES if rigid else ALONE_NAMES
        self.motions = [self.motion(s) for s in stretches]
        # A controller that winds up asks for a thousand times what a limit lets through.
        acting = np.concatenate([m.limited_torque for m in self.motions])
        self.torque_rms = float(np.sqrt(np.mean(acting**2)))
        self.trust = trust
        each = trust if trust is not None else [None] * len(stretches)
        self.weights = [Weights(s.taper, self.spectral(s), t) for s, t in zip(stretches, each, strict=True)]
        # Eq. (18) is 1 + X2 s + X1 s^2 times the torque: the likelihood is that of the torque.
        self.level = float(np.mean([w.level - self._passing(w) for w in self.weights]))

    def at(
        self,
        base: Base,
        *,
        stretches: Sequence[Stretch] | None = None,
        shift: float | None = None,
        applied: Mapping[Form, Array] | None = None,
        stiffening: float | None = None,
        led: bool | None = None,
        trust: Sequence[Array] | None = None,
        passing: Sequence[Joined] | None = None,
    ) -> Problem:
        """The same record linearised elsewhere, with other errors of positions taken out."""
        recorded = self.recorded if stretches is None else stretches
        stretches = self.stretches if stretches is None else stretches
        if applied is not None and (applied or self.applied):
            stretches = [_without_errors(s, applied, self.gear_ratio) for s in recorded]
        other = Problem(
            stretches,
            base,
            self.noise,
            self.band_hz,
            gravity=self.gravity,
            gear_ratio=self.gear_ratio,
            duration_s=self.duration_s,
            both=self.both,
            shift=self.shift if shift is None else shift,
            applied=self.applied if applied is None else applied,
            anchor=self.anchor,
            settled=self.settled,
            stiffening=self.stiffening if stiffening is None else stiffening,
            rigid=self.rigid,
            led=self.led if led is None else led,
            trust=self.trust if trust is None else trust,
            passing=self.passing if passing is None else passing,
        )
        other.recorded = recorded
        return other

    @property
    def model(self) -> ModelName:
        """Name of the baseline, as configurations have it."""
        return "two_encoders" if self.both else "rigid" if self.rigid else "motor_only"

    def linearised(self, symbol: str) -> float:
        """Value of a parameter that the columns are steps from; zero where they are whole ones."""
        if self.both or symbol == "offset":
            return 0.0
        return float(getattr(self.base, symbol)) + (self.base.JL if self.rigid and symbol == "Jm" else 0.0)

    @property
    def row_times(self) -> Array:
        """Time of each row, s."""
        parts = [s.start_s + w.seconds for s, w in zip(self.stretches, self.weights, strict=True)]
        return np.concatenate(parts)

    @property
    def stiffness(self) -> float:
        """Stiffness of the spring and of what effects add to it, at the linearisation."""
        return self.base.K + self.stiffening

    @property
    def equations(self) -> int:
        """Number of equations: rows of `Rows` come equation by equation."""
        return 2 if self.both else 1

    def _passing(self, weights: Weights) -> float:
        """Mean logarithm of the torque's gain in the rows."""
        if self.both:
            return 0.0
        omega = 2.0 * np.pi * weights.taper.frequency_hz
        b = self.base
        return float(np.mean(np.log(np.abs(1.0 + (1j * b.FV * omega - b.JL * omega**2) / b.K) ** 2)))

    def spectral(self, stretch: Stretch) -> Complex:
        """Spectral matrix of the equations' noise and of what no model predicts, shape (frequencies, m, m)."""
        omega = 2.0 * np.pi * stretch.taper.frequency_hz
        floor = self.floor(stretch.rate_hz)
        if self.both:
            return two_encoder_noise(self.base, self.noise, omega) + floor * np.eye(2)
        # What the model lacks at the motor passes 1 + X2 s + X1 s^2 as the torque itself does.
        passed = np.abs(1.0 + (self.base.FV * 1j * omega - self.base.JL * omega**2) / self.base.K) ** 2
        return np.asarray(
            motor_only_noise(self.base, self.noise, omega) + floor * (1.0 + passed)[:, None, None]
        )

    def floor(self, rate_hz: float) -> float:
        """Variance a sample of white noise that stands for what no model predicts."""
        return (MODEL_FLOOR * self.torque_rms) ** 2 * 0.5 * rate_hz / self.band_hz

    def motion(self, s: Stretch) -> Motion:
        """Motion of a stretch at the linearisation."""
        base = self.base
        if self.both:
            joint = s.joint_smooth
            velocity, acceleration = s.joint_derivatives
            motor_sign = mean_sign(s.motor_fine, base.motor_reversal)
            joint_sign = mean_sign(s.joint_fine, base.load_reversal)
        else:
            motor_sign = s.motor_sign(base.motor_reversal)
            friction = base.FVm * s.motor_velocity + base.FSm * s.lowpass(motor_sign, SMOOTH_BAND)
            inertial = base.Jm * s.motor_acceleration
            joint = s.motor_smooth - (s.torque_smooth - inertial - friction) / base.K
            joint = s.lowpass(joint, SMOOTH_BAND)
            velocity, acceleration = s.derivative(joint, 1), s.derivative(joint, 2)
            sharp = s.derivative(self.led_position(s), 1) if self.led else velocity
            joint_sign = reversal(sharp, base.load_reversal)
        deflection = s.motor_smooth - joint - base.torsion_zero
        motion = Motion(
            time_s=s.time_s,
            torque=s.torque,
            limited_torque=s.torque,
            motor_position=s.motor_smooth,
            motor_velocity=s.motor_velocity if s.sharpener is None else s.motor_sharp,
            joint_position=joint,
            joint_velocity=velocity,
            joint_acceleration=acceleration,
            motor_sign=motor_sign,
            joint_sign=joint_sign,
            deflection=deflection,
            torsion=deflection,
            torsion_rate=s.motor_velocity - velocity,
            joint_torque=base.K * deflection,
            period_s=s.period_s,
            base=base,
            gravity=self.gravity,
            gear_ratio=self.gear_ratio,
            joint_encoder=self.both,
            duration_s=self.duration_s,
        )
        return self._with_effects(motion, s) if self.passing else motion

    def _with_effects(self, motion: Motion, s: Stretch) -> Motion:
        """The motion as effects see it that come after others of the model: kinematics, then torques."""
        seen = [one.columns(motion) for one in self.passing]
        errors = [
            t.torsion @ one.amplitudes
            for t, one in zip(seen, self.passing, strict=True)
            if t.torsion is not None
        ]
        if errors:
            twist = np.sum(errors, axis=0)
            motion = replace(
                motion,
                torsion=motion.torsion + twist,
                torsion_rate=motion.torsion_rate + s.derivative(twist, 1),
            )
            seen = [one.columns(motion) for one in self.passing]
        passed, limited = motion.joint_torque, motion.torque
        for terms, one in zip(seen, self.passing, strict=True):
            if terms.transmission is not None:
                passed = passed + terms.transmission @ one.amplitudes
            if terms.motor is not None:
                limited = limited - terms.motor @ one.amplitudes
        return replace(motion, joint_torque=passed, limited_torque=limited)

    def led_position(self, s: Stretch) -> Array:
        """Where the load goes when the motor moves as measured: no noise of the torque is in it, and no effect."""
        b = self.base
        return follow(b.K * s.motor, b.JL, max(b.FV, 0.0), b.K, max(b.FS, 0.0), b.load_reversal, s.period_s)

    def _rows(self, part: Part) -> Array:
        """Rows of all stretches, equation by equation, shape (equations * rows, k)."""
        parts = [
            w.apply(part(s, m)) for s, m, w in zip(self.stretches, self.motions, self.weights, strict=True)
        ]
        stacked = np.concatenate(parts, axis=1)
        return stacked.reshape(-1, stacked.shape[-1])

    def through(self, s: Stretch, x: Array) -> Array:
        """1 + X2 d/dt + X1 d2/dt2 of a motor-side torque: how it stands in eq. (18)."""
        return (
            x
            + self.base.FV / self.base.K * s.derivative(x, 1)
            + self.base.JL / self.base.K * s.derivative(x, 2)
        )

    def _one(self, spectrum: Complex, equation: str) -> list[Complex | None]:
        if not self.both:
            return [spectrum]
        return [spectrum, None] if equation == "motor" else [None, spectrum]

    def target(self, *, shift: float | None = None) -> Array:
        """What the columns are to explain, shape (r,).

        Both encoders: the torque, and the spring's torque at the linearisation. Motor alone: the misfit of eq. (18)
        at the linearisation.
        """
        late = self.shift if shift is None else shift

        def part(s: Stretch, m: Motion) -> list[Complex | None]:
            if self.both:
                return [later(s, s.both_spectra["torque"], late), self.stiffness * self._twist(s)]
            known, b = s.alone_spectra, self.base
            acceleration, velocity = known["acceleration"], known["velocity"]
            motor = b.Jm * acceleration + b.FVm * velocity + b.FSm * s.differentiated(m.motor_sign)
            load = b.JL * acceleration[:, :1] + b.FV * velocity[:, :1] + b.FS * s.spectrum(m.joint_sign)
            return [later(s, self._passed(known["torque"]), late) - self._passed(motor) - load]

        return self._rows(part)[:, 0]

    def _twist(self, s: Stretch) -> Complex:
        """Transform of the torsion without its zero, shape (f, 1)."""
        known = s.both_spectra
        return np.asarray(known["torsion"] - self.base.torsion_zero * known["one"])

    def _passed(self, differentiated: Complex) -> Complex:
        """`through` of a signal that is given with its derivatives, (f, 3) to (f, 1)."""
        b = self.base
        return np.asarray(differentiated @ np.array([[1.0], [b.FV / b.K], [b.JL / b.K]]))

    def signal(self) -> float:
        """RMS of the torque in the whitened rows of the motor equation: how far it stands above its noise."""

        def part(s: Stretch, _: Motion) -> list[Complex | None]:
            return self._one(s.spectrum(s.torque if self.both else self.through(s, s.torque)), "motor")

        rows = self._rows(part)[: self.row_times.size, 0]
        return float(np.sqrt(np.mean(rows**2)))

    def base_rows(self) -> Array:
        """Rows of the baseline's columns, in the order of ``names``."""
        return self._rows(self._base_both if self.both else self._base_alone)

    def _base_both(self, s: Stretch, m: Motion) -> list[Complex]:
        known = s.both_spectra
        gravity = self.gravity * known["gravity"]
        one = s.spectrum(self._zero_moved(s, m)) if self.passing else known["one"]
        motor = [known["motor"], s.spectrum(m.motor_sign), self._twist(s), one]
        load = [-one, known["joint"], s.spectrum(m.joint_sign), gravity]
        return self._side_by_side(np.hstack(motor), np.hstack(load))

    def _zero_moved(self, s: Stretch, m: Motion) -> Array:
        """What a step of the spring's zero changes, but for effects with a zero of their own; one in the mean."""
        moved = [one for one in self.passing if not one.centred]
        return self._passed_on(s, m, np.ones((m.torsion.size, 1)), moved)[:, 0] / self.stiffness

    def _passed_on(self, s: Stretch, m: Motion, twist: Array, joined: Sequence[Joined]) -> Array:
        """Torque that spring and effects pass on for a torsion that is larger by each column, to first order."""
        passed = self.base.K * twist
        for k, column in enumerate(twist.T if joined else ()):
            step = ZERO_STEP * float(np.std(m.deflection)) / max(float(np.abs(column).max()), 1e-300)
            rate = s.derivative(column, 1)
            more, less = (
                replace(m, torsion=m.torsion + h * column, torsion_rate=m.torsion_rate + h * rate)
                for h in (0.5 * step, -0.5 * step)
            )
            for one in joined:
                change = one.columns(more).since(one.columns(less)).transmission
                if change is not None:
                    passed[:, k] += change @ one.amplitudes / step
        return passed

    @staticmethod
    def _side_by_side(M: Complex, L: Complex) -> list[Complex]:
        """Columns of both equations; the last of the motor's are the first of the load's."""
        own = L.shape[1] - SHARED, M.shape[1] - SHARED
        return [
            np.hstack([M, np.zeros((M.shape[0], own[0]))]),
            np.hstack([np.zeros((M.shape[0], own[1])), L]),
        ]

    def _base_alone(self, s: Stretch, m: Motion) -> list[Complex | None]:
        b, known = self.base, s.alone_spectra
        acceleration, velocity, sign = (
            known["acceleration"], known["velocity"], s.differentiated(m.motor_sign)
        )  # fmt: skip
        columns = [self._passed(x) for x in (acceleration, velocity, sign)]
        if self.rigid:
            return [np.hstack([*columns, s.spectrum(np.ones(s.torque.size))])]
        passed = known["torque"] - b.Jm * acceleration - b.FVm * velocity - b.FSm * sign
        first, second = passed[:, 1:2], passed[:, 2:3]
        columns += [
            (b.JL * second + b.FV * first) / b.K**2,
            acceleration[:, :1] - second / b.K,
            velocity[:, :1] - first / b.K,
            s.spectrum(m.joint_sign),
        ]
        return [np.hstack(columns)]

    def sign_rows(self, field: str, width: float) -> Array:
        """Rows of one Coulomb column for another reversal width, shape (r,)."""

        def part(s: Stretch, m: Motion) -> list[Complex | None]:
            motor = field == "motor_reversal"
            if self.both:
                sign = mean_sign(s.motor_fine if motor else s.joint_fine, width)
                return self._one(s.spectrum(sign), "motor" if motor else "load")
            if motor:
                return [s.spectrum(self.through(s, s.motor_sign(width)))]
            return [s.spectrum(reversal(m.joint_velocity, width))]

        return self._rows(part)[:, 0]

    def noise_rows(self, noisy: Sequence[Stretch]) -> tuple[Array, Array]:
        """Target and baseline columns of stretches of pure noise, weighted as this record's (both encoders).

        Signs, gravity and constants are not linear in the noise and stay zero. Shapes (r,) and (r, p).
        """

        def part(s: Stretch) -> list[Complex | None]:
            zero = np.zeros(s.torque.size)
            motor = [s.derivative(s.motor, 2), s.derivative(s.motor, 1), zero, s.motor - s.joint, zero]
            load = [zero, s.derivative(s.joint, 2), s.derivative(s.joint, 1), zero, zero, zero]
            M, L = self._side_by_side(*(s.spectrum(np.column_stack(x)) for x in (motor, load)))
            spring = s.spectrum(self.stiffness * (s.motor - s.joint))
            return [np.hstack([np.zeros_like(spring), M]), np.hstack([spring, L])]

        parts = [w.apply(part(s)) for s, w in zip(noisy, self.weights, strict=True)]
        stacked = np.concatenate(parts, axis=1)
        rows = stacked.reshape(-1, stacked.shape[-1])
        return rows[:, 0], rows[:, 1:]

    def effect_rows(
        self, terms_of: Callable[[Motion], Terms], slopes: Array | None = None
    ) -> tuple[Array, Array]:
        """Rows of what an effect adds, shape (r, k), without the spring in it, and its stiffness, shape (k,).

        Both for unit amplitudes; with ``slopes`` a spring of that stiffness is left out, not the effect's own.
        """
        seen: list[Terms] = []

        def part(s: Stretch, m: Motion) -> list[Complex | None]:
            seen.append(terms_of(m))
            return self.place(s, m, seen[-1])

        rows = self._rows(part)
        if not self.both or seen[0].transmission is None:
            return rows, np.zeros(rows.shape[1])
        slopes = self._slopes(terms_of, seen) if slopes is None else slopes
        return self._without_spring(rows, slopes), slopes

    def slopes(self, terms_of: Callable[[Motion], Terms]) -> Array:
        """Stiffness of a transmission effect for unit amplitudes, shape (k,), whatever is measured."""
        return self._slopes(terms_of, [terms_of(m) for m in self.motions])

    def _slopes(self, terms_of: Callable[[Motion], Terms], seen: Sequence[Terms]) -> Array:
        """Mean answer of a transmission effect to a little more torsion, shape (k,).

        Noise of the torsion, which is most of what the load equation leaves, passes the effect with this stiffness.
        """
        answer, size = np.zeros(1), 0.0
        for (probe, moved), terms in zip(self._probed, seen, strict=True):
            other = terms_of(moved).transmission
            if other is not None and terms.transmission is not None:
                answer = answer + probe @ (other - terms.transmission)
                size += float(probe @ probe)
        return np.asarray(answer / size, dtype=np.float64)

    @cached_property
    def _probed(self) -> list[tuple[Array, Motion]]:
        """Noise of the size of the encoders' (at least) for each stretch, and the motion with it in the torsion."""
        rng, out = np.random.default_rng(PROBE_SEED), []
        for s, m in zip(self.stretches, self.motions, strict=True):
            probe = s.lowpass(rng.standard_normal(m.deflection.size), SMOOTH_BAND)
            noise = float(np.hypot(self.noise.motor_position, self.noise.joint_position))
            size = max(noise * probe.std(), LEAST_PROBE * float(np.std(m.deflection)))
            probe = size / probe.std() * probe
            moved = replace(
                m,
                deflection=m.deflection + probe,
                torsion=m.torsion + probe,
                torsion_rate=m.torsion_rate + s.derivative(probe, 1),
            )
            out.append((probe, moved))
        return out

    def _without_spring(self, rows: Array, slopes: Array) -> Array:
        left = rows - np.outer(self._torsion, slopes)
        # What is a spring and no more is nothing at all, not the rounding errors of the difference.
        nothing = np.linalg.norm(left, axis=0) < SPRING_ALONE * np.linalg.norm(rows, axis=0)
        left[:, nothing] = 0.0
        return np.asarray(left, dtype=np.float64)

    @cached_property
    def _torsion(self) -> Array:
        """Rows of a spring of unit stiffness, shape (r,)."""

        def part(s: Stretch, m: Motion) -> list[Complex | None]:
            return self._place_both(s, m, Terms(transmission=m.deflection[:, None]))

        return self._rows(part)[:, 0]

    def place(self, s: Stretch, m: Motion, t: Terms) -> list[Complex | None]:
        """Spectra of what an effect adds to each equation."""
        return self._place_both(s, m, t) if self.both else self._place_alone(s, t)

    def _place_both(self, s: Stretch, m: Motion, t: Terms) -> list[Complex | None]:
        b = self.base
        motor, load = (None if x is None else s.spectrum(x) for x in (t.motor, t.load))
        if t.transmission is not None:
            passed_on = s.spectrum(t.transmission)
            motor, load = _plus(motor, passed_on), _plus(load, -passed_on)
        if t.joint_error is not None:
            e, passed = t.joint_error, self._passed_on(s, m, t.joint_error, self.passing)
            motor = _plus(motor, s.spectrum(passed))
            load = _plus(load, -s.spectrum(b.JL * s.derivative(e, 2) + b.FV * s.derivative(e, 1) + passed))
        if t.motor_error is not None:
            e, passed = t.motor_error, self._passed_on(s, m, t.motor_error, self.passing)
            motor = _plus(motor, -s.spectrum(b.Jm * s.derivative(e, 2) + b.FVm * s.derivative(e, 1) + passed))
            load = _plus(load, s.spectrum(passed))
        return [motor, load]

    def _place_alone(self, s: Stretch, t: Terms) -> list[Complex | None]:
        b = self.base
        total = t.load
        if t.motor is not None:
            total = _plus(total, self.through(s, t.motor))
        if t.transmission is not None:
            total = _plus(total, self.through(s, t.transmission) - t.transmission)
        if t.motor_error is not None:
            e = t.motor_error
            motor = b.Jm * s.derivative(e, 2) + b.FVm * s.derivative(e, 1)
            load = b.JL * s.derivative(e, 2) + b.FV * s.derivative(e, 1)
            total = _plus(total, -self.through(s, motor) - load)
        return [None if total is None else s.spectrum(total)]

    def back(self, rows: Array, equation: str) -> list[Array]:
        """Transpose of `effect_rows` for a column of one equation: one array (n,) a stretch."""
        blocks = rows.reshape(self.equations, -1)
        out, first = [], 0
        for s, w in zip(self.stretches, self.weights, strict=True):
            size = int(w.open.sum())
            g = w.back(blocks[:, first : first + size])
            first += size
            if self.both:
                out.append(
                    g[0] if equation == "motor" else g[0] - g[1] if equation == "transmission" else g[1]
                )
                continue
            # The transpose of a derivative is its negative, of a second one itself.
            inertial, viscous = self.base.JL / self.base.K, self.base.FV / self.base.K
            passed = inertial * s.derivative(g[0], 2) - viscous * s.derivative(g[0], 1)
            out.append({"motor": g[0] + passed, "transmission": passed, "load": g[0]}[equation])
        return out

    def scale(self) -> Scale:
        """Sizes of the record from which ranges of shapes follow."""
        b, rate = self.base, self.stretches[0].rate_hz
        narrow = np.sqrt(min(1.0, 2.0 * SMOOTH_BAND * self.band_hz / rate))

        def all_of(name: str) -> Array:
            return np.asarray(np.abs(np.concatenate([getattr(m, name) for m in self.motions])))

        def travel(name: str) -> float:
            return float(np.ptp(np.concatenate([getattr(m, name) for m in self.motions])))

        return Scale(
            duration_s=self.duration_s,
            period_s=1.0 / rate,
            band_hz=self.band_hz,
            motor_speed=float(np.quantile(all_of("motor_velocity"), 0.98)),
            joint_speed=float(np.quantile(all_of("joint_velocity"), 0.98)),
            motor_reversal_step=_reversal_step(
                [s.motor_sharp for s in self.stretches], rate, MOTOR_SIGN_BAND * self.band_hz
            ),
            joint_reversal_step=_reversal_step(
                [
                    s.joint_sharp if self.both else m.joint_velocity
                    for s, m in zip(self.stretches, self.motions, strict=True)
                ],
                rate,
                (JOINT_SIGN_BAND if self.both else SMOOTH_BAND) * self.band_hz,
            ),
            motor_range=travel("motor_position"),
            joint_range=travel("joint_position"),
            deflection=float(np.quantile(all_of("deflection"), 0.99)),
            deflection_noise=float(np.hypot(self.noise.motor_position, self.noise.joint_position) * narrow),
            torque=float(np.max(all_of("torque"))),
            resonance_hz=float(np.sqrt(b.K * (1.0 / b.Jm + 1.0 / b.JL)) / (2.0 * np.pi)),
            gear_ratio=self.gear_ratio,
            joint_encoder=self.both,
            base=b,
        )

    def moved(self, coefficients: Array, stiffening: float = 0.0) -> Base:
        """The baseline that a solution for the base columns gives beside effects with a ``stiffening``.

        The motor alone is solved for steps, which are kept short: the equation is linear only nearby.
        """
        v = dict(zip(self.names, (float(x) for x in coefficients), strict=True))
        b = self.base
        if self.both:
            v |= {n: v[n] * v["K"] / self.stiffness for n in SCALED if v["K"] > 0.0}
            v["K"] -= stiffening
            new = {n: v[n] for n in ("FVm", "FSm", "FV", "FS")}
            strong = {n: v[n] if v[n] > 0.05 * getattr(b, n) else getattr(b, n) for n in ("Jm", "K", "JL")}
            return replace(
                b, **new, **strong, torsion_zero=b.torsion_zero - v["c"] / (strong["K"] + stiffening)
            )
        strong = {
            n: getattr(b, n) * float(np.clip(1.0 + v[n] / getattr(b, n), 0.7, 1.4))
            for n in ("Jm", "K", "JL")
            if n in v
        }
        if self.anchor is not None:
            held = {n: float(getattr(self.anchor, n)) for n in strong}
            strong = {n: float(np.clip(x, held[n] / ASTRAY, held[n] * ASTRAY)) for n, x in strong.items()}
        friction = {n: getattr(b, n) + v[n] for n in ("FVm", "FSm", "FV", "FS") if n in v}
        return replace(b, **friction, **strong)


def _reversal_step(velocities: Sequence[Array], rate_hz: float, cutoff_hz: float) -> float:
    """Median change of a velocity about its reversals within the reach of a low pass, 1 / (2 pi cutoff)."""
    slopes = [np.abs(np.diff(v))[np.sign(v[1:]) != np.sign(v[:-1])] for v in velocities]
    found = np.concatenate(slopes) * rate_hz
    reach = 1.0 / (2.0 * np.pi * min(cutoff_hz, HIGHEST_CUTOFF * rate_hz))
    return float(np.median(found) * reach) if found.size else 0.0


def _without_errors(s: Stretch, applied: Mapping[Form, Array], gear_ratio: float) -> Stretch:
    """The stretch with the positions as they were before errors of measurement."""
    true = {"motor": s.motor, "joint": s.joint}

    def banded(x: Array, order: int) -> Array:
        """Derivative without noise above the band, which a skew of some samples would lift a hundred times."""
        return s.derivative(s.lowpass(x, JOINT_SIGN_BAND), order)

    for form, amplitudes in applied.items():
        sensor = form.signature.corrects
        if form.signature.corrected is not None:
            true[sensor] = form.signature.corrected(true[sensor], amplitudes, banded, gear_ratio)
    if not applied:
        return s
    return s.like(replace(s.segment, motor_position=true["motor"], joint_position=true["joint"]))


def _plus(a: Numbers | None, b: Numbers) -> Numbers:
    return b if a is None else a + b
