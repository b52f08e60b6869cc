"""What else than random residuals can move an estimate: encoder noise, torque timing, reversal width.

Each source is linearised about the solution. What it may move an estimate by joins the standard error, so that
an interval does not stay narrow around a biased value.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flexid_cli.estimate.covariance import robust_covariance
from flexid_cli.estimate.fit import FitResult
from flexid_cli.models.base import Block, Model
from flexid_cli.pipeline.columns import Columns
from flexid_cli.pipeline.spectrum import welch
from flexid_cli.signals.recording import Recording, Segment

Array = NDArray[np.float64]

# The encoders' noise floor is read where a drive's motion has died out: the upper part of the spectrum.
NOISE_BAND = (0.6, 0.95)
NOISE_SEED = 20010521
SIGN_BAND_STEP = 0.7
MAX_NOISE_SHARE = 0.9
_JOINT_SIGNALS = frozenset({"joint", "gravity_cos", "gravity_sin", "sign_joint"})
_NOISY_SIGNALS = frozenset({"torque", "motor", "joint", "torsion"})


@dataclass(frozen=True)
class NoiseLevels:
    """White noise of each signal that would give the floor of its spectrum (one sigma a sample, SI).

    The torque's may fall with frequency: its density is that of a first-order low pass at ``torque_corner_hz``.
    """

    torque: float
    motor_position: float
    joint_position: float
    torque_corner_hz: float = math.inf

    def torque_at(self, omega: Array) -> Array:
        """Noise of the torque by frequency (rad/s), as white noise of the same density."""
        return np.asarray(self.torque / np.hypot(1.0, omega / (2.0 * np.pi * self.torque_corner_hz)))


@dataclass(frozen=True)
class Nuisance:
    """A neglected quantity, estimated beside the parameters.

    Attributes
    ----------
    value, stderr : float
        Its estimate, one Gauss-Newton step from the solution, and robust standard error; infinite where the
        parameters take up all that it could do.
    per_unit : ndarray, shape (p,)
        What the parameters change by for each unit of it that is neglected.
    """

    value: float
    stderr: float
    per_unit: Array

    def shift(self, at_most: float) -> Array:
        """Standard error that neglecting it adds, shape (p,); ``at_most`` is its size where it is not known."""
        size = float(np.hypot(self.value, self.stderr))
        return self.per_unit * (size if np.isfinite(size) else at_most)


def noise_levels(recording: Recording) -> NoiseLevels:
    """Noise of the signals from the upper part of their spectra."""
    segment = max(recording.segments, key=lambda s: s.samples)
    joint = 0.0 if segment.joint_position is None else _floor(segment.joint_position)
    return NoiseLevels(_floor(segment.torque), _floor(segment.motor_position), joint)


def _floor(x: Array) -> float:
    """Standard deviation of white noise with the median density of the upper band."""
    length = min(1024, x.size - 2)
    # The second difference flattens the steep spectrum of a motion, whose leakage would hide the floor.
    frequency, density = welch(np.diff(x, 2), 1.0, length)
    gain = (2.0 * np.sin(np.pi * frequency)) ** 4
    use = (frequency > 0.5 * NOISE_BAND[0]) & (frequency < 0.5 * NOISE_BAND[1])
    return float(np.sqrt(np.median(density[use] / gain[use]) * 0.5))


def noise_bias(model: Model, result: FitResult, columns: Columns, levels: NoiseLevels) -> Array:
    """Shift of the estimates by noise in the columns (errors in variables), to second order in the noise.

    A synthetic record of the signals' noise alone passes the same chain; its columns V add V'V to the normal
    matrix, which moves the minimum by -(H - N)^-1 sum_k w_k^2 D_k' V_k' V_k a_k, N the noise's part of H.

    Returns
    -------
    ndarray, shape (p,)
    """
    noise = _noise_columns(columns, levels)
    size = result.theta.size
    gradient, curvature = np.zeros(size), np.zeros((size, size))
    coefficients = model.coefficients(result.theta)
    derivatives = model.jacobian(result.theta)
    for block, w, a, D in zip(model.blocks, result.weights, coefficients, derivatives, strict=True):
        V = w * _block_noise(block, noise)
        gradient += (V @ D).T @ (V @ a)
        curvature += (V @ D).T @ (V @ D)
    return -_solve_without(result, curvature, gradient)


def _solve_without(result: FitResult, curvature: Array, right: Array) -> Array:
    """(J'J - curvature)^-1 right: the normal matrix that the signals have without their noise.

    In the eigenvectors of the noise's share of J'J; the share is cut at MAX_NOISE_SHARE, for a direction that is
    nearly all noise has no bias that could be named.
    """
    scale = np.linalg.norm(result.jacobian, axis=0)
    scale[scale == 0.0] = 1.0
    _, s, Vt = np.linalg.svd(result.jacobian / scale, full_matrices=False)
    root = Vt[: result.rank].T / s[: result.rank]
    share, U = np.linalg.eigh(root.T @ (curvature / np.outer(scale, scale)) @ root)
    inside = U.T @ (root.T @ (right / scale)) / (1.0 - np.clip(share, 0.0, MAX_NOISE_SHARE))
    return np.asarray(root @ (U @ inside) / scale, dtype=np.float64)


def limited_torque_noise(
    model: Model, result: FitResult, columns: Columns, levels: NoiseLevels
) -> NoiseLevels:
    """The levels with the torque's raised to what the residual allows.

    Ripple and disturbances within the band are not seen in the floor of the spectrum; the residual bounds them:
    at most all of it is torque noise, shaped by the torque's own columns.
    """
    unit = _noise_columns(columns, NoiseLevels(1.0, 0.0, 0.0))
    shaped = _block_noise(model.blocks[0], unit) @ model.coefficients(result.theta)[0]
    largest = result.sigmas[0] / max(float(np.std(shaped)), 1e-300)
    return replace(levels, torque=max(levels.torque, largest))


def _noise_columns(columns: Columns, levels: NoiseLevels) -> Columns:
    rng = np.random.default_rng(NOISE_SEED)

    def noisy(segment: Segment) -> Segment:
        n = segment.samples
        torque = levels.torque * rng.standard_normal(n)
        motor = levels.motor_position * rng.standard_normal(n)
        joint = levels.joint_position * rng.standard_normal(n) if segment.joint_position is not None else None
        return replace(segment, torque=torque, motor_position=motor, joint_position=joint)

    record = replace(columns.recording, segments=tuple(noisy(s) for s in columns.segments))
    return Columns(record, columns.chain, columns.velocities.cutoff_hz, columns.gravity)


def _block_noise(block: Block, noise: Columns) -> Array:
    rows = sum(noise.lengths)
    return np.column_stack([noise(*c) if c[0] in _NOISY_SIGNALS else np.zeros(rows) for c in block.columns])


def torque_delay(model: Model, result: FitResult, columns: Columns, lengths: Sequence[int]) -> Nuisance:
    """Delay of the acting torque after its stamp, s, and what it would do to the parameters.

    A delay tau turns Gm into Gm - tau Gm'; every torque column moves with it.
    """
    gradients = []
    for block, a in zip(model.blocks, model.coefficients(result.theta), strict=True):
        gradient = np.zeros(sum(columns.lengths))
        for (signal, order), coefficient in zip(block.columns, a, strict=True):
            if signal == "torque":
                gradient -= coefficient * columns("torque", order + 1)
        gradients.append(gradient)
    return _nuisance(result, gradients, lengths)


def encoder_skew(model: Model, result: FitResult, columns: Columns) -> Nuisance:
    """Age of the joint position at its stamp beside the motor position's, s; both encoders only.

    A joint position that is a old is q(t) = q_stamped(t + a): its columns lack a q', the torsion has a q' too much.
    The part a q' = a (qm' - d') that follows qm' is what friction of motor and load takes up; what tells the age from
    them is a torque that follows the torsion's velocity d' and acts the same way in both equations, unlike that of a
    damping in the joint (`joint_damping`), which acts on motor and load in opposite ways.
    """
    gradients = []
    for block, a in zip(model.blocks, model.coefficients(result.theta), strict=True):
        gradient = np.zeros(sum(columns.lengths))
        for (signal, order), coefficient in zip(block.columns, a, strict=True):
            if signal in _JOINT_SIGNALS:
                gradient += coefficient * columns(signal, order + 1)
            elif signal == "torsion":
                gradient -= coefficient * columns("joint", order + 1)
        gradients.append(gradient)
    return _nuisance(result, gradients, columns.lengths)


def joint_damping(model: Model, result: FitResult, columns: Columns) -> Nuisance:
    """Damping parallel to the joint's spring; both encoders only. It adds D d' wherever K d stands."""
    K = result.theta[[p.symbol for p in model.parameters].index("K")]
    gradients = []
    for block, a in zip(model.blocks, model.coefficients(result.theta), strict=True):
        k = [signal for signal, _ in block.columns].index("torsion")
        gradients.append(a[k] / K * columns("torsion", 1))
    return _nuisance(result, gradients, columns.lengths)


def torque_hold(model: Model, result: FitResult, columns: Columns) -> Array:
    """Shift of the parameters if the torque acts as steps held for one sample, shape (p,).

    Beside its half-sample delay a hold of T damps the torque by sinc(f T), about 1 - (w T)^2 / 24.
    """
    period = 1.0 / columns.recording.sample_rate_hz
    gradients = []
    for block, a in zip(model.blocks, model.coefficients(result.theta), strict=True):
        gradient = np.zeros(sum(columns.lengths))
        for (signal, order), coefficient in zip(block.columns, a, strict=True):
            if signal == "torque":
                gradient += coefficient * columns("torque", order + 2) * period**2 / 24.0
        gradients.append(gradient)
    column = np.concatenate([w * g for w, g in zip(result.weights, gradients, strict=True)])
    return -_solve_normal(result, column)


def gear_error(model: Model, result: FitResult, columns: Columns) -> Nuisance:
    """Relative error of the gear ratio, and what it would do to the parameters; both encoders only.

    A motor motion too large by a share e puts e qm into the torsion.
    """
    gradients = []
    for block, a in zip(model.blocks, model.coefficients(result.theta), strict=True):
        k = [signal for signal, _ in block.columns].index("torsion")
        gradients.append(-a[k] * columns("motor", 0))
    return _nuisance(result, gradients, columns.lengths)


def left_out_flexibility(result: FitResult, columns: Columns) -> Nuisance:
    """JL^2/K that the rigid model leaves out, and what it would do to the parameters.

    To first order a spring makes the inertia at frequency w larger by JL^2/K w^2: the column of the fourth
    derivative is missing.
    """
    return _nuisance(result, [columns("motor", 4)], columns.lengths)


def reversal_width(
    model: Model, result: FitResult, columns: Columns, lengths: Sequence[int]
) -> Nuisance | None:
    """Error of ln v0, the reversal width, and what it would do to the parameters; None for a plain sign.

    By the change of the columns over a factor of e: a narrow reversal is known to no better than that, and hardly
    changes with less.
    """
    width = columns.reversal_velocity
    if not width:
        return None
    other = columns.like()
    other.set_reversal_velocity(width * float(np.e))
    return _nuisance(result, _sign_changes(model, result, columns, other), lengths)


def sign_band(model: Model, result: FitResult, columns: Columns) -> Array:
    """Shift of the parameters if the velocity whose sign is taken had a narrower band, shape (p,).

    A reversal that the filter smooths, or noise that it lets through, changes the friction columns.
    """
    other = columns.like(sign_cutoff_hz=SIGN_BAND_STEP * columns.velocities.cutoff_hz)
    other.set_reversal_velocity(columns.reversal_velocity)
    gradients = _sign_changes(model, result, columns, other)
    column = np.concatenate([w * g for w, g in zip(result.weights, gradients, strict=True)])
    return -_solve_normal(result, column)


def _sign_changes(model: Model, result: FitResult, columns: Columns, other: Columns) -> list[Array]:
    """Change of each block's residual when the sign columns are those of ``other``."""
    changes = []
    for block, a in zip(model.blocks, model.coefficients(result.theta), strict=True):
        change = np.zeros(sum(columns.lengths))
        for coefficient, (signal, order) in zip(a, block.columns, strict=True):
            if signal.startswith("sign_"):
                change += coefficient * (other(signal, order) - columns(signal, order))
        changes.append(change)
    return changes


def _nuisance(result: FitResult, gradients: Sequence[Array], lengths: Sequence[int]) -> Nuisance:
    """One step of the fit with a further parameter whose derivative of the residuals is given."""
    column = np.concatenate([w * g for w, g in zip(result.weights, gradients, strict=True)])
    residual = np.concatenate([w * e for w, e in zip(result.weights, result.residuals, strict=True)])
    projection = _solve_normal(result, column)
    free = column - result.jacobian @ projection
    energy = float(free @ free)
    if energy <= 1e-12 * float(column @ column):
        return Nuisance(0.0, float("inf"), -projection)
    value = -float(free @ residual) / energy
    scores = (free * (residual + value * free)).reshape(len(gradients), -1).sum(axis=0)
    covariance = robust_covariance(scores[:, None], np.array([[1.0 / energy]]), lengths).covariance
    return Nuisance(value, float(np.sqrt(covariance[0, 0])), -projection)


def _solve_normal(result: FitResult, column: Array) -> Array:
    """What the parameters take up of a column, shape (p,)."""
    return np.asarray(result.bread @ (result.instruments.T @ column), dtype=np.float64)
