"""Bias budget by replay: simulate the fitted axis with the record's own noise, estimate again, look at the shift.

Indirect inference (Gourieroux, Monfort and Renault, J. Applied Econometrics 8 (1993) S85): what the same estimator
makes of records whose parameters are known is what it made of this one, to first order. The mean shift holds whatever
filters, decimation, noise in the columns and guards do to the estimates; their spread can be held against the claimed
standard error. Nothing is corrected by it: the report offers the number.

A replay is a record of the simulated axis, driven by this record's motor position: the load follows it, and the
torque is what that takes. The measured position, low-passed at three times the band of the columns, is the true one;
fresh noise is laid on all signals. What that leaves out:

- Motion above that low pass. It lies outside the columns' band, but can reverse a velocity and so matter to friction.
- Encoder noise that the low pass lets through is a part of the true motion, of which the torque then consists too. It
  excites, but biases nothing, for the fresh noise is as large as the record's whole.
- The loop: noise that the controller feeds back moves the real axis and so correlates with the torque. In a replay
  motion and noise are independent.
- The start: the simulated load is at rest at the start of each gap-free segment.
- Noise that comes and goes: the torque's has the spectrum that it has over the whole record (what is left of the
  measured torque beyond the simulated one, less what the encoder's noise in the driving motion makes of it), the
  encoders' is white. What the model lacks counts as noise of the torque.
- Whatever else the model lacks: a replay of a wrong model is a record of the wrong model.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flexid_cli.errors import FlexidError
from flexid_cli.estimate import driven, iv, noise
from flexid_cli.estimate.result import ModelResult
from flexid_cli.estimate.solution import Solution
from flexid_cli.estimate.summary import Uncertainty
from flexid_cli.models.base import Model
from flexid_cli.pipeline import derivatives, filters
from flexid_cli.pipeline.columns import Columns, reversal
from flexid_cli.pipeline.spectrum import welch
from flexid_cli.signals.recording import Recording, Segment

Array = NDArray[np.float64]
Estimator = Callable[[Recording, float | None], Solution]

SEED = 19930521
METHOD = "simulation along the record's motor motion, the record's noise, the same estimator"
MEANING = (
    "how far estimates of simulated records of the fitted axis lie from its parameters; offered, not applied; the"
    " JSON holds it by parameter"
)
# The true motion ends at this multiple of the columns' band, where the chain lets next to nothing through.
SMOOTH_OVER_BAND = 3.0
SMOOTH_ORDER = 6
HIGHEST_SMOOTH = 0.25
# The step response of the low pass has settled within so many periods of its cutoff.
LEAD_PERIODS = 5.0
# A replay without noise returns the parameters to this much (gravity's; stiffness and inertias to a tenth of it).
OWN_ERROR_PERCENT = 0.05
# The load is stepped this many times a sample: its own errors must stay far below those that are looked for.
FINER = 8
# Gravity acts where the joint is, which follows from gravity; passes end when the load moves by less than this share
# of the torsion.
GRAVITY_PASSES = 30
SETTLED = 1e-6
# A mean over fewer of the replays than this would be one over those that happened to work.
LEAST_SHARE = 0.75
SPECTRUM_PARTS = 16
MIN_SPECTRUM = 64
# A spectrum is averaged from each frequency over this to this times it: half an octave.
AVERAGED = 2.0**0.25
CLEAR_SIGMAS = 3.0
NOTABLE_SHARE = 1.0 / 3.0


@dataclass(frozen=True)
class Truth:
    """What the replays are made from.

    Attributes
    ----------
    theta : ndarray, shape (p,)
        Parameters of the simulated axis: the fitted ones, friction of the load raised to what can be simulated.
    recording : Recording
        Its signals without noise.
    sigma : tuple of float
        White noise of motor and joint encoder, one sigma a sample.
    frequency, density : ndarray, shape (f,)
        One-sided spectrum of the torque's noise over cycles a sample.
    """

    theta: Array
    recording: Recording
    sigma: tuple[float, float]
    frequency: Array
    density: Array


def with_replays(
    found: ModelResult, solution: Solution, uncertainty: Uncertainty, count: int, estimate: Estimator
) -> ModelResult:
    """The result with the test `replay`, and a warning for each bias that is clear and not small.

    Parameters
    ----------
    found : ModelResult
        What is reported; its estimates stay as they are.
    solution, uncertainty
        What it was made from.
    count : int
        Replays, at least 2.
    estimate : callable
        Solves the same model on a recording in the same way, given the resonance, Hz, to tune to.
    """
    truth = truth_of(solution)
    if isinstance(truth, str):
        return _with_test(found, {"method": METHOD, "replays": 0, "reason": truth})
    thetas, failures = _estimates(truth, solution, count, estimate)
    if len(thetas) < max(2.0, LEAST_SHARE * count):
        reason = f"{len(failures)} of {count} replays could not be solved: {failures[0]}"
        return _with_test(found, {"method": METHOD, "replays": count, "reason": reason})
    parameters = _budget(np.array(thetas), truth, solution, uncertainty)
    test = {
        "method": METHOD,
        "replays": count,
        "failed": len(failures),
        **_largest(parameters),
        "parameters": parameters,
        "meaning": MEANING,
    }
    return _with_test(found, test, _warnings(found, parameters))


def _with_test(found: ModelResult, test: Mapping[str, Any], warnings: tuple[str, ...] = ()) -> ModelResult:
    tests = {**found.tests, "replay": dict(test)}
    return replace(found, tests=tests, warnings=(*found.warnings, *warnings))


def _estimates(
    truth: Truth, solution: Solution, count: int, estimate: Estimator
) -> tuple[list[Array], list[str]]:
    """Estimates of the replays, and why the others have none."""
    thetas: list[Array] = []
    failures: list[str] = []
    for k in range(count):
        try:
            again = estimate(noisy(truth, k), solution.tuning.f1_hz)
        except FlexidError as error:
            failures.append(error.message)
            continue
        if again.model.parameters != solution.model.parameters:
            failures.append("the model takes another form there")
        elif not np.all(np.isfinite(again.reported.theta)):
            failures.append("its estimates are not finite")
        else:
            thetas.append(again.reported.theta)
    return thetas, failures


def truth_of(solution: Solution) -> Truth | str:
    """The noise-free record of the fitted axis and the noise to lay on it, or why there is none."""
    model, result = solution.model, solution.result
    if model.id == "rigid":
        return "what biases a rigid model is the flexibility that it leaves out, which its own replay cannot show"
    fixed = () if solution.reduction is None else solution.reduction.fixed
    dependent = [model.parameters[k].symbol for k in result.dependent if k not in fixed]
    if dependent:
        return f"the record does not determine {', '.join(dependent)}: there is no one axis to simulate"
    theta = solution.reported.theta
    axis = iv.mechanism(model, theta)
    if axis is None:
        return "the fitted axis is not one that could be simulated (Jm, K and JL must be positive)"
    columns = solution.columns
    zero = dict(zip((p.symbol for p in model.parameters), theta, strict=True)).get("c", 0.0) / axis.K
    recording, torques = _simulated(columns, axis, float(zero), joint=model.id == "two_encoders")
    levels = noise.floors(columns.recording)
    frequency, density = _torque_noise(columns, axis, torques, levels)
    return Truth(
        _simulated_parameters(model, theta, axis),
        recording,
        (levels.sigma[1], levels.sigma[2]),
        frequency,
        density,
    )


def _simulated_parameters(model: Model, theta: Array, axis: iv.Mechanism) -> Array:
    """Parameters that the simulation really has: it needs a little damping, and no friction that drives."""
    symbols = [p.symbol for p in model.parameters]
    simulated = theta.copy()
    simulated[symbols.index("FV")] = axis.damping
    simulated[symbols.index("FS")] = max(axis.FS, 0.0)
    return simulated


def _smoothing(columns: Columns) -> float:
    """Cutoff of the low pass that makes the true motion of the measured one, Hz."""
    highest = HIGHEST_SMOOTH * columns.recording.sample_rate_hz
    return min(SMOOTH_OVER_BAND * columns.chain.band_hz, columns.velocities.cutoff_hz, highest)


def _simulated(
    columns: Columns, axis: iv.Mechanism, zero: float, *, joint: bool
) -> tuple[Recording, list[Array]]:
    """The axis along the smoothed motion: its record (joint position only where ``joint``), and its torques."""
    rate, cutoff = columns.recording.sample_rate_hz, _smoothing(columns)
    sos = filters.butterworth(SMOOTH_ORDER, cutoff, rate)
    lead = int(np.ceil(LEAD_PERIODS * rate / cutoff))
    torques, segments = [], []
    for segment in columns.segments:
        # Held before its start, for the load starts at rest: else the low pass would set the motor off at full speed.
        held = np.concatenate([np.full(lead, segment.motor_position[0]), segment.motor_position])
        motor = filters.zero_phase(held, sos)
        load = _load(motor, axis, columns, zero)
        torque = _torque(motor, load, axis, columns, cutoff)[lead:]
        position = load[lead:] - zero if joint else None
        torques.append(torque)
        segments.append(replace(segment, torque=torque, motor_position=motor[lead:], joint_position=position))
    return replace(columns.recording, segments=tuple(segments)), torques


def _load(motor: Array, axis: iv.Mechanism, columns: Columns, zero: float) -> Array:
    """Position of the load behind the moving motor, from rest, simulated between the samples too.

    The joint encoder's zero is ``zero`` below the spring's, and gravity's angle is the encoder's.
    """
    from scipy.interpolate import make_interp_spline

    samples = np.arange(motor.size)
    fine = np.linspace(0.0, motor.size - 1.0, FINER * (motor.size - 1) + 1)
    motion = make_interp_spline(samples, motor, k=5)(fine)
    period = 1.0 / (FINER * columns.recording.sample_rate_hz)
    width = columns.reversal_velocity or 0.0
    centred = axis.load.get("joint_centred", 0.0)
    MX, MY = (columns.gravity * axis.load.get(name, 0.0) for name in ("gravity_cos", "gravity_sin"))
    # Gravity's mean slope counts as a stiffness, which leaves little for the passes to settle.
    slope = float(np.mean(MY * np.cos(motion) - MX * np.sin(motion)))
    slope = slope if abs(slope) < 0.5 * axis.K else 0.0
    stiffness = axis.K + centred + slope
    outside = axis.K * motion - axis.load.get("one", 0.0) + centred * columns.centre
    load = motion
    for _ in range(GRAVITY_PASSES):
        angle = load - zero
        drive = outside + slope * load - MX * np.cos(angle) - MY * np.sin(angle)
        moved = driven.follow(drive, axis.JL, axis.damping, stiffness, max(axis.FS, 0.0), width, period)
        change = float(np.max(np.abs(moved - load)))
        load = moved
        if change <= SETTLED * float(np.max(np.abs(motion - load))):
            break
    return np.asarray(load[::FINER], dtype=np.float64)


def _torque(motor: Array, joint: Array, axis: iv.Mechanism, columns: Columns, cutoff_hz: float) -> Array:
    """Torque that moves motor and spring so; derivatives by a stencil that is exact up to the cutoff."""
    rate = columns.recording.sample_rate_hz
    half = derivatives.half_width_for(cutoff_hz / rate)
    velocity, acceleration = (_derivative(motor, order, 1.0 / rate, half) for order in (1, 2))
    friction = axis.FVm * velocity + axis.FSm * reversal(velocity, columns.reversal_velocity)
    return np.asarray(axis.Jm * acceleration + friction + axis.K * (motor - joint), dtype=np.float64)


def _derivative(x: Array, order: int, period_s: float, half_width: int) -> Array:
    """Derivative at every sample; what the stencil cannot reach at the ends is as the nearest that it can."""
    result = derivatives.differentiate(x, order, period_s, half_width=half_width)
    reach = derivatives.reach("exact", order, half_width)
    result[:reach], result[-reach:] = result[reach], result[-reach - 1]
    return result


def _torque_noise(
    columns: Columns, axis: iv.Mechanism, torques: list[Array], levels: noise.Floors
) -> tuple[Array, Array]:
    """Spectrum of what the simulation does not explain of the torque, over cycles a sample, in the longest segment.

    The driving motion holds encoder noise n, so that the remainder is the torque's noise less G n, G the torque that
    a motion takes: its expected density is taken off. The floor of the torque's own spectrum says nothing of it: what
    the controller makes of the encoders' noise is torque that moves the motor.
    """
    longest = max(range(len(torques)), key=lambda i: torques[i].size)
    remainder = columns.segments[longest].torque - torques[longest]
    # The real load need not start at rest; its free oscillation is no noise.
    waves = [parts[longest] for parts in iv.transients(columns, axis)[2 * longest : 2 * longest + 2]]
    W = np.column_stack(waves)
    remainder = remainder - W @ np.linalg.lstsq(W, remainder, rcond=None)[0]
    rate = columns.recording.sample_rate_hz
    edge = min(int(rate / columns.chain.band_hz), remainder.size // 8)
    inner = remainder[edge : remainder.size - edge]
    length = min(inner.size, max(MIN_SPECTRUM, inner.size // SPECTRUM_PARTS))
    frequency, density = welch(inner, 1.0, length)
    shaped = 2.0 * levels.sigma[1] ** 2 * _encoder_gain(columns, axis, frequency * rate)
    return frequency, np.maximum(_averaged(density - shaped), 0.0)


def _averaged(density: Array) -> Array:
    """Each bin's mean over a part of an octave: a difference of two spectra is noise bin by bin."""
    sums = np.concatenate([[0.0], np.cumsum(density)])
    k = np.arange(density.size)
    low = np.floor(k / AVERAGED).astype(int)
    high = np.minimum(np.ceil(k * AVERAGED).astype(int), density.size - 1) + 1
    return np.asarray((sums[high] - sums[low]) / (high - low), dtype=np.float64)


def _encoder_gain(columns: Columns, axis: iv.Mechanism, frequency_hz: Array) -> Array:
    """Squared gain from noise of the motor encoder to the simulated torque, through the smoothing."""
    omega = 2.0 * np.pi * frequency_hz
    s = np.asarray(1j * omega, dtype=np.complex128)
    gain = np.abs(iv.response(axis)(("torque", 0), omega, s)[1])
    low_pass = 1.0 / (1.0 + (frequency_hz / _smoothing(columns)) ** (2 * SMOOTH_ORDER))
    return np.asarray((gain * low_pass) ** 2, dtype=np.float64)


def noisy(truth: Truth, index: int) -> Recording:
    """One replay: the simulated record with its own draw of the noise, the same for the same ``index``."""
    rng = np.random.default_rng([SEED, index])
    segments = tuple(_noisy(segment, truth, rng) for segment in truth.recording.segments)
    return replace(truth.recording, segments=segments)


def _noisy(segment: Segment, truth: Truth, rng: np.random.Generator) -> Segment:
    n = segment.samples
    torque = segment.torque + coloured(rng, n, truth.frequency, truth.density)
    motor = segment.motor_position + truth.sigma[0] * rng.standard_normal(n)
    joint = segment.joint_position
    if joint is not None:
        joint = joint + truth.sigma[1] * rng.standard_normal(n)
    return replace(segment, torque=torque, motor_position=motor, joint_position=joint)


def coloured(rng: np.random.Generator, samples: int, frequency: Array, density: Array) -> Array:
    """Gaussian noise of a one-sided spectral density over cycles a sample, shape (samples,)."""
    # Twice the length, so that the end of the noise does not join its start.
    spectrum = np.fft.rfft(rng.standard_normal(2 * samples))
    amplitude = np.sqrt(0.5 * np.interp(np.fft.rfftfreq(2 * samples), frequency, density))
    return np.asarray(np.fft.irfft(spectrum * amplitude, 2 * samples)[:samples], dtype=np.float64)


def _budget(
    thetas: Array, truth: Truth, solution: Solution, uncertainty: Uncertainty
) -> dict[str, dict[str, Any]]:
    """Bias, its Monte Carlo error, and the replays' spread, by symbol; all but ratios in per cent of the estimate."""
    theta, count = solution.reported.theta, thetas.shape[0]
    bias = thetas.mean(axis=0) - truth.theta
    spread = thetas.std(axis=0, ddof=1)
    error = spread / np.sqrt(count)
    clear = _clear(count)
    budget: dict[str, dict[str, Any]] = {}
    for k, parameter in enumerate(solution.model.parameters):
        random = float(np.sqrt(max(uncertainty.random[k, k], 0.0)))
        claimed = float(np.sqrt(max(uncertainty.covariance[k, k], 0.0)))
        # The zero of the torsion has no size that a share of it could refer to.
        if parameter.symbol == "c" or theta[k] == 0.0 or random == 0.0 or claimed == 0.0:
            continue
        percent = 100.0 / abs(float(theta[k]))
        budget[parameter.symbol] = {
            "bias_percent": percent * float(bias[k]),
            "bias_error_percent": percent * float(error[k]),
            "spread_percent": percent * float(spread[k]),
            "claimed_percent": percent * claimed,
            "spread_over_claimed": float(spread[k]) / random,
            "bias_over_claimed": float(bias[k]) / claimed,
            "significant": bool(abs(bias[k]) > clear * error[k]),
        }
    return budget


def _clear(count: int) -> float:
    """Monte Carlo errors beyond which a mean of ``count`` replays is no chance: 3, wider where few tell the error."""
    from scipy.special import ndtr, stdtrit

    return -float(stdtrit(count - 1, ndtr(-CLEAR_SIGMAS)))


def _largest(parameters: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The bias that is largest beside its standard error among those that are no chance."""
    sure = [s for s, p in parameters.items() if p["significant"]]
    if not sure:
        return {"largest_bias": "none beyond the Monte Carlo error"}
    symbol = max(sure, key=lambda s: abs(parameters[s]["bias_over_claimed"]))
    return {
        "largest_bias": symbol,
        "bias_percent": parameters[symbol]["bias_percent"],
        "bias_error_percent": parameters[symbol]["bias_error_percent"],
        "bias_over_claimed": parameters[symbol]["bias_over_claimed"],
    }


def _warnings(found: ModelResult, parameters: Mapping[str, Mapping[str, Any]]) -> tuple[str, ...]:
    """What a correction would do to each estimate whose bias is clear and more than a third of its standard error."""
    warnings = []
    for estimate in found.parameters:
        entry = parameters.get(estimate.symbol)
        if entry is None or estimate.value is None or not entry["significant"]:
            continue
        bias = entry["bias_percent"]
        if abs(entry["bias_over_claimed"]) <= NOTABLE_SHARE or abs(bias) <= OWN_ERROR_PERCENT:
            continue
        corrected = estimate.value - 0.01 * bias * abs(estimate.value)
        warnings.append(
            f"{found.id}: replays of the fitted axis give {estimate.symbol} {abs(bias):.2g} ±"
            f" {entry['bias_error_percent']:.1g} % too {'high' if bias > 0.0 else 'low'},"
            f" {abs(entry['bias_over_claimed']):.2g} of its standard error: without this bias it would be"
            f" {corrected:.5g} instead of {estimate.value:.5g} {estimate.unit}; not applied"
        )
    return tuple(warnings)
