"""Output error: the simulated torque (and joint position) brought as near to the measured ones as they come.

The simulation is driven by the measured motor position, so that no derivative beyond the acceleration is taken of any
measured signal, and noise of the torque enters linearly: with it alone the estimate has no bias and the least
variance. Gauss-Newton steps with the simulation's derivatives by differences; the load's unknown state at the start
of each segment is fitted beside the parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flexid_cli.estimate import iv
from flexid_cli.estimate.covariance import robust_covariance
from flexid_cli.estimate.fit import FitResult
from flexid_cli.models.base import Model
from flexid_cli.pipeline.columns import Columns

Array = NDArray[np.float64]

MAX_STEPS = 15
MAX_HALVINGS = 8
SETTLED = 0.01
STEP = 1e-5


@dataclass(frozen=True)
class OutputFit:
    """An output-error fit, or why there is none.

    Attributes
    ----------
    result : FitResult or None
        ``residuals`` are measured minus simulated: torque, and joint position where it is measured.
    reason : str
        Why there is none.
    """

    result: FitResult | None
    reason: str = ""


def refine_output(model: Model, columns: Columns, start: FitResult) -> OutputFit:
    """Refine the parameters of a fit on the motor-driven simulation.

    Parameters
    ----------
    model : Model
        `two_encoders` or `motor_only`.
    columns : Columns
        Of the record; with the joint's motion as the fit had it.
    start : FitResult
        The fit.
    """
    theta = start.theta.copy()
    outputs = _residuals(model, columns, theta)
    if outputs is None:
        return OutputFit(None, "the fitted axis is not one that could be simulated")
    # Weights once, from where the start leaves them: weights that follow the fit could favour either output at will.
    weights = [1.0 / max(float(np.std(e)), np.finfo(float).tiny) for e in outputs]
    for _ in range(MAX_STEPS):
        free = _transients(model, columns, theta, weights)
        derivatives = _jacobian(model, columns, theta, outputs, start.stderr)
        if free is None or derivatives is None:
            return OutputFit(None, "the simulation left the passive axes")
        e = _project(free, _stack(weights, outputs))
        J = _project(free, np.vstack([w * D for w, D in zip(weights, derivatives, strict=True)]))
        step, bread = _step(J, e)
        robust = robust_covariance(_scores(J, e, len(outputs)), bread, columns.lengths)
        fitted = replace(
            start,
            theta=theta,
            covariance=robust.covariance,
            degrees_of_freedom=robust.degrees_of_freedom,
            residuals=tuple(part / w for part, w in zip(np.split(e, len(outputs)), weights, strict=True)),
            sigmas=tuple(float(np.std(x)) for x in outputs),
            jacobian=J,
            weights=tuple(weights),
            bread=bread,
            instruments=J,
        )
        if float(np.max(np.abs(step) / np.maximum(fitted.stderr, np.finfo(float).tiny))) < SETTLED:
            return OutputFit(fitted)
        moved = _shortened(model, columns, theta, step, free, weights, float(np.linalg.norm(e)))
        if moved is None:
            return OutputFit(None, "no step makes the output error smaller")
        theta, outputs = moved
    return OutputFit(None, f"not settled after {MAX_STEPS} steps")


def _shortened(
    model: Model,
    columns: Columns,
    theta: Array,
    step: Array,
    free: Array,
    weights: Sequence[float],
    before: float,
) -> tuple[Array, list[Array]] | None:
    """Parameters after the longest halving of the step that does not make the output error larger."""
    for _ in range(MAX_HALVINGS):
        outputs = _residuals(model, columns, theta + step)
        if outputs is not None and _norm(free, weights, outputs) <= before * (1.0 + 1e-9):
            return theta + step, outputs
        step = 0.5 * step
    return None


def _stack(weights: Sequence[float], outputs: Sequence[Array]) -> Array:
    return np.concatenate([w * e for w, e in zip(weights, outputs, strict=True)])


def _project(free: Array, x: Array) -> Array:
    """Take out what the load's free oscillations explain; ``free`` has orthonormal columns."""
    return np.asarray(x - free @ (free.T @ x), dtype=np.float64)


def _norm(free: Array, weights: Sequence[float], outputs: Sequence[Array]) -> float:
    return float(np.linalg.norm(_project(free, _stack(weights, outputs))))


def _residuals(model: Model, columns: Columns, theta: Array) -> list[Array] | None:
    """Measured minus simulated, through the chain: torque, and joint position where it is measured."""
    axis = iv.mechanism(model, theta)
    if axis is None:
        return None
    simulated = iv.driven_joint(columns, axis)
    torsion = columns.of([s.motor_position - q for s, q in zip(columns.segments, simulated, strict=True)], 0)
    values = dict(zip((p.symbol for p in model.parameters), theta, strict=True))
    offset = values.get("c", 0.0)
    torque = (
        axis.Jm * columns("motor", 2)
        + axis.FVm * columns("motor", 1)
        + axis.FSm * columns("sign_motor", 0)
        + axis.K * torsion
    )
    residuals = [columns("torque", 0) - torque]
    if model.id == "two_encoders":
        measured = columns("torsion", 0) - offset / axis.K * columns("one", 0)
        residuals.append(torsion - measured)
    return residuals


def _jacobian(
    model: Model, columns: Columns, theta: Array, residuals: Sequence[Array], stderr: Array
) -> list[Array] | None:
    """Derivative of each output's residual by forward differences, in steps of a part of the standard error."""
    parts: list[list[Array]] = [[] for _ in residuals]
    for k in range(theta.size):
        step = max(0.1 * float(stderr[k]), STEP * abs(float(theta[k])))
        if step == 0.0:  # held at zero
            for part, old in zip(parts, residuals, strict=True):
                part.append(np.zeros_like(old))
            continue
        moved = theta.copy()
        moved[k] += step
        changed = _residuals(model, columns, moved)
        if changed is None:
            return None
        for part, new, old in zip(parts, changed, residuals, strict=True):
            part.append((new - old) / step)
    return [np.column_stack(part) for part in parts]


def _transients(model: Model, columns: Columns, theta: Array, weights: Sequence[float]) -> Array | None:
    """Orthonormal basis of the load's free oscillations in the stacked outputs, two a segment."""
    axis = iv.mechanism(model, theta)
    if axis is None:
        return None
    waves = []
    for wave in iv.transients(columns, axis):
        column = columns.of(wave, 0)
        # In the residuals the torsion has the opposite sign of the joint position.
        parts = [axis.K * column, -column][: len(weights)]
        waves.append(np.concatenate([w * p for w, p in zip(weights, parts, strict=True)]))
    Q, _ = np.linalg.qr(np.column_stack(waves))
    return np.asarray(Q, dtype=np.float64)


def _step(J: Array, stacked: Array) -> tuple[Array, Array]:
    scale = np.linalg.norm(J, axis=0)
    scale[scale == 0.0] = 1.0
    inverse = np.linalg.pinv((J / scale).T @ (J / scale), rcond=1e-13, hermitian=True) / np.outer(
        scale, scale
    )
    return -inverse @ (J.T @ stacked), inverse


def _scores(J: Array, stacked: Array, outputs: int) -> Array:
    """Sum over the outputs of each instant."""
    return np.asarray((J * stacked[:, None]).reshape(outputs, -1, J.shape[1]).sum(axis=0))
