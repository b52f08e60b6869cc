"""Where the fits begin: band, noise, a first linearisation."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from flexid_cli.diagnose.basis import solve
from flexid_cli.diagnose.fitter import Chosen, Fitter, informed
from flexid_cli.diagnose.problem import Problem
from flexid_cli.diagnose.reversals import motor_sharpened
from flexid_cli.diagnose.rows import motor_only_noise, two_encoder_noise
from flexid_cli.diagnose.stretch import SMOOTH_BAND, Stretch
from flexid_cli.diagnose.torque_noise import ABOVE, HIGHEST, MOST_FALL, torque_noise
from flexid_cli.diagnose.trust import trusted
from flexid_cli.effects.forms import lagged
from flexid_cli.effects.motion import Base
from flexid_cli.errors import DataError
from flexid_cli.estimate.band import torque_band, usable_band
from flexid_cli.estimate.budget import NoiseLevels, noise_levels
from flexid_cli.pipeline.columns import reversal
from flexid_cli.pipeline.spectrum import welch
from flexid_cli.signals.recording import Recording

if TYPE_CHECKING:
    from flexid_cli.config.schema import Config

Array = NDArray[np.float64]

HIGHEST_BAND = 0.2  # of the sampling rate
SHORTEST_S = 2.0
FIRST_WIDTH = 0.004  # of the highest speed
SCAN_POINTS, SCAN_STEPS = 14, 4
SAME_MINIMUM = 0.25  # of the stiffness's logarithm
MOST_STARTS = 6
RIGID = 100.0  # times the band: a resonance that is nowhere in it
SCANNED_WITH = ("torque_offset", "gravity", "joint_damping", "load_dependent_friction", "viscous_nonlinear")
LEAST_LINES = 8  # of a spectrum, to read the torque's noise from
# Lags of the torque, sampling periods, that are tried where plain least squares find no axis.
LAGS = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
SCAN_LOW = 8.0  # lowest locked-motor frequency looked at, cycles in the record


def has_joint(recording: Recording, config: Config) -> bool:
    """Whether the baseline has a motor and a load equation: with a joint encoder, unless a rigid axis is declared."""
    return recording.has_joint_position and config.models != ("rigid",)


def first_problems(
    recording: Recording, config: Config, fitter: Fitter, fitted: Problem | None = None
) -> list[Problem]:
    """The record in its band, linearised where a simple fit puts it.

    There are several, the most likely one first, where the motor's encoder alone shows no resonance for sure. Band
    and (without a joint encoder) linearisation are those of another record of the axis where that was ``fitted``.

    Raises
    ------
    DataError
        The record is too short, or shows no flexible axis.
    """
    both = has_joint(recording, config)
    rate = recording.sample_rate_hz
    band = min(usable_band(recording, joint=both), HIGHEST_BAND * rate, fitted.band_hz if fitted else np.inf)
    rigid = config.models == ("rigid",)
    if rigid:
        band = min(band, torque_band(recording))  # above it springs and noise would be all there is
    segments = [s for s in recording.segments if s.samples > SHORTEST_S * rate]
    if not segments:
        raise DataError(
            f"no gap-free stretch of the recording is longer than {SHORTEST_S:g} s",
            "record longer, or permit longer gaps with signals.time.max_gap_s",
        )
    stretches = [Stretch(s, rate, band) for s in segments]
    speed = float(np.quantile(np.abs(np.concatenate([s.motor_velocity for s in stretches])), 0.98))
    width = FIRST_WIDTH * speed
    base = _first_base(stretches, width, both, fitted)
    if rigid:
        base = replace(
            base,
            K=_rigid_stiffness(base, band),
            FVm=base.FVm + base.FV,
            FV=0.0,
            FSm=base.FSm + base.FS,
            FS=0.0,
        )
    problem = Problem(
        stretches,
        base,
        noise_levels(recording),
        band,
        gravity=config.axis.gravity_m_per_s2,
        gear_ratio=config.axis.gear_ratio,
        duration_s=recording.duration_s,
        both=both,
        shift=fitter.shifts[0],
        rigid=rigid,
    )
    if both or rigid:
        first = fitter.relax(problem, rounds=1)
        return [informed(_with_torque_noise(first.problem), first)]
    known = _identified(recording, config, width) if fitted is None else fitted.base
    problems = _scanned(problem, fitter) if known is None else [problem.at(known)]
    for one in problems:
        one.anchor, one.settled = one.base, known is not None
    return [trusted(motor_sharpened(_with_torque_noise(one))) for one in problems]


def _first_base(stretches: list[Stretch], width: float, both: bool, fitted: Problem | None) -> Base:
    """A simple fit's parameters, or with both encoders those of another record of the axis where this one has none.

    With the motor alone a negative inertia has one cause: the sign or the unit of the torque.
    """
    if not both:
        return _rigid_base(stretches, width)
    try:
        return _both_base(stretches, width)
    except DataError:
        if fitted is None:
            raise
        return fitted.base


def _both_base(stretches: list[Stretch], width: float) -> Base:
    """Motor equation and load equation, each by plain least squares in the smooth band.

    Where that makes no axis, with what turns torque and torsion the most: damping in the joint, a lag of the torque.
    """
    found = _plain_base(stretches, width)
    if found is None:
        tried = (_plain_base(stretches, width, lag) for lag in LAGS)
        found = min((one for one in tried if one is not None), key=lambda one: one[0], default=None)
    if found is None:
        raise DataError(
            "the motor and joint positions do not show a flexible axis: inertia or stiffness come out negative",
            "check the signs and units of torque and positions with `flexid identify`, and excite the axis around its"
            " first resonance",
        )
    return found[1]


def _plain_base(
    stretches: list[Stretch], width: float, lag: float | None = None
) -> tuple[float, Base] | None:
    """What the motor equation leaves of the torque, as a share, and the base; None where that is no axis.

    With a ``lag`` of the torque (sampling periods) the joint is damped.
    """
    motor, load = [], []
    for s in stretches:
        torque = s.torque if lag is None else lagged(s.torque, lag, 1.0)
        joint = s.derivative(s.joint_smooth, 1)
        torsion, one = s.motor_smooth - s.joint_smooth, np.ones(s.torque.size)
        damped = [] if lag is None else [s.motor_velocity - joint]
        acceleration = s.derivative(s.motor_smooth, 2)
        sign = np.tanh(s.motor_velocity / width)
        spring = [torsion, s.motor_velocity, sign, one, *damped]
        motor.append(np.column_stack([s.lowpass(torque, SMOOTH_BAND), acceleration, *spring])[50:-50])
        # Torsion explained by the load's motion: the other way round noise would draw K to zero.
        moved = [s.derivative(s.joint_smooth, 2), joint, np.tanh(joint / width)]
        gravity = [np.cos(s.joint_smooth), np.sin(s.joint_smooth)]
        load.append(np.column_stack([torsion, *moved, one, *gravity, *damped])[50:-50])
    M, L = np.vstack(motor), np.vstack(load)
    fit = solve(M[:, 1:], M[:, 0])
    Jm, K, FVm, FSm, *_ = fit.coefficients
    inertia, viscous, coulomb, zero, *_ = solve(L[:, 1:], L[:, 0]).coefficients
    if not (Jm > 0.0 and K > 0.0 and inertia > 0.0):
        return None
    base = Base(
        Jm=float(Jm), K=float(K), JL=float(K * inertia), FVm=float(FVm), FSm=float(FSm), FV=float(K * viscous),
        FS=float(K * coulomb), motor_reversal=width, load_reversal=width, torsion_zero=float(zero),
    )  # fmt: skip
    return fit.cost / float(M[:, 0] @ M[:, 0]), base


def _rigid_base(stretches: list[Stretch], width: float) -> Base:
    """Total inertia and friction, split evenly; the stiffness is scanned for."""
    rows = []
    for s in stretches:
        acceleration = s.derivative(s.motor_smooth, 2)
        friction = np.tanh(s.motor_velocity / width)
        columns = [
            s.lowpass(s.torque, SMOOTH_BAND),
            acceleration,
            s.motor_velocity,
            friction,
            np.ones(s.torque.size),
        ]
        rows.append(np.column_stack(columns)[50:-50])
    M = np.vstack(rows)
    J, FV, FS, _ = (float(x) for x in solve(M[:, 1:], M[:, 0]).coefficients)
    if J <= 0.0:
        raise DataError(
            "the motor's acceleration does not follow the torque: the inertia comes out negative",
            "check the sign and unit of the torque signal with `flexid identify`",
        )
    FV, FS = max(FV, 0.0), max(FS, 0.0)
    return Base(
        Jm=0.5 * J, K=1.0, JL=0.5 * J, FVm=0.5 * FV, FSm=0.7 * FS, FV=0.5 * FV, FS=0.3 * FS,
        motor_reversal=width, load_reversal=width,
    )  # fmt: skip


def _rigid_stiffness(base: Base, band_hz: float) -> float:
    """Stiffness of a spring whose torsion is nothing in the band."""
    return base.JL * (2.0 * np.pi * RIGID * band_hz) ** 2


def _identified(recording: Recording, config: Config, width: float) -> Base | None:
    """Parameters by `identify`, which gravity and offset do not lead astray; None where it finds no resonance."""
    from flexid_cli.estimate.identify import identify

    try:
        model = identify(recording, config.model_copy(update={"models": ("motor_only",)})).models[0]
    except DataError:
        return None
    v = {e.symbol: e.value for e in model.parameters if e.value is not None}
    sure = any(e.symbol == "K" and e.verdict == "identified" for e in model.parameters)
    if not sure or not all(v.get(name, 0.0) > 0.0 for name in ("Jm", "K", "JL")):
        return None
    reversal_width = model.pipeline.reversal_velocity or width
    friction = {name: v.get(name, 0.0) for name in ("FVm", "FSm", "FV", "FS")}
    return Base(
        v["Jm"], v["K"], v["JL"], **friction, motor_reversal=reversal_width, load_reversal=reversal_width
    )


def _scanned(problem: Problem, fitter: Fitter) -> list[Problem]:
    """The minima that a series of locked-motor frequencies leads to, by a few Gauss-Newton steps each.

    Effects that are linear in their amplitudes are in the fit, so that what the baseline lacks does not draw its
    stiffness away. A rigid axis is one of the series.
    """
    free = [
        Chosen(f, ())
        for f in fitter.forms
        if f.name in SCANNED_WITH and not f.signature.shapes(problem.scale())
    ]
    base = problem.base
    rigid = problem.at(replace(base, K=_rigid_stiffness(base, problem.band_hz)))
    trials = [(fitter.fit(rigid, free).loss, rigid)]
    low = SCAN_LOW / problem.duration_s
    for frequency in np.geomspace(max(low, 0.02 * problem.band_hz), 0.8 * problem.band_hz, SCAN_POINTS):
        trial = problem.at(replace(base, K=base.JL * (2.0 * np.pi * float(frequency)) ** 2))
        for _ in range(SCAN_STEPS):
            trial = trial.at(fitter.moved(fitter.fit(trial, free)))
        trials.append((fitter.fit(trial, free).loss, trial))
    minima: list[Problem] = []
    for _, trial in sorted(trials, key=lambda t: t[0]):
        if all(abs(np.log(trial.base.K / other.base.K)) > SAME_MINIMUM for other in minima):
            minima.append(trial)
    return minima[:MOST_STARTS]


def _with_torque_noise(problem: Problem) -> Problem:
    """The problem with the torque's noise as the record shows it: a current's noise is seldom white.

    It is what no linear relation explains: what an equation leaves holds the effects that are looked for, too. With a
    rigid baseline, or where that cannot be told, it is what the motor equation leaves just above the band.
    """
    s = max(problem.stretches, key=lambda s: s.torque.size)
    found = None
    if not problem.rigid:
        found = torque_noise(s.segment, s.rate_hz, problem.band_hz)
    if found is None:
        found = _above_the_band(problem, s)
        if found is not None and found[0] < problem.noise.torque**2:
            found = problem.noise.torque**2, np.inf
    if found is None:
        return problem
    level, corner = found
    problem.noise = replace(problem.noise, torque=float(np.sqrt(level)), torque_corner_hz=corner)
    return problem.at(problem.base)


def _above_the_band(problem: Problem, s: Stretch) -> tuple[float, float] | None:
    """Level and corner of what the motor equation leaves above the band, without the encoders' part."""
    rest = _misfit(problem, s)[100:-100]
    f, density = welch(rest, s.rate_hz, int(min(rest.size, 1024)))
    use = (f > ABOVE * problem.band_hz) & (f < min(HIGHEST * problem.band_hz, 0.3 * s.rate_hz))
    if np.count_nonzero(use) < LEAST_LINES:
        return None
    omega = 2.0 * np.pi * f[use]
    encoders = NoiseLevels(0.0, problem.noise.motor_position, problem.noise.joint_position)
    make = two_encoder_noise if problem.both else motor_only_noise
    known = make(problem.base, encoders, omega)[:, 0, 0].real
    b = problem.base
    passed = 1.0 if problem.both else np.abs(1.0 + (1j * b.FV * omega - b.JL * omega**2) / b.K) ** 2
    return _first_order(f[use], (density[use] * 0.5 * s.rate_hz - known) / passed)


def _first_order(f: Array, density: Array) -> tuple[float, float]:
    """Level at low frequency and corner of a density 1 / (1 + (f / corner)^2), by its medians low and high in f.

    The level is at most `MOST_FALL` times what is seen: what lies below the range is not seen at all.
    """
    halves = np.array_split(np.arange(f.size), 2)
    (f1, f2), (p1, p2) = ([float(np.median(x[h])) for h in halves] for x in (f, density))
    whole = float(np.median(density))
    if not 0.0 < p2 < p1:
        return whole, np.inf
    slope = (1.0 / p2 - 1.0 / p1) / (f2**2 - f1**2)
    slope = min(slope, (1.0 - 1.0 / MOST_FALL) / (p1 * f1**2))
    level = 1.0 / (1.0 / p1 - slope * f1**2)
    return level, float(np.sqrt(1.0 / (level * slope)))


def _misfit(problem: Problem, s: Stretch) -> Array:
    """Misfit of the motor equation, or of eq. (18), over time."""
    b = problem.base
    acceleration, velocity = s.derivative(s.motor, 2), s.derivative(s.motor, 1)
    rest = (
        s.torque - b.Jm * acceleration - b.FVm * velocity - b.FSm * reversal(s.motor_sharp, b.motor_reversal)
    )
    if problem.both:
        return np.asarray(rest - b.K * (s.motor - s.joint))
    load = b.JL * acceleration + b.FV * velocity + b.FS * reversal(s.motor_sharp, b.load_reversal)
    return np.asarray(problem.through(s, rest) - load)
