"""The load behind a moving motor, stepped fast: linear part exact, Coulomb friction implicit (first order).

Used where a simulation is needed at every pass of a fit; `simulate` does the same with located events.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

SUBSTEPS = 4
NEWTON_STEPS = 30


def follow(
    drive: Array,
    inertia: float,
    damping: float,
    stiffness: float,
    coulomb: float,
    width: float,
    period_s: float,
) -> Array:
    """Solve J q'' + D q' + K q + F tanh(q' / w) = drive from rest.

    Parameters
    ----------
    drive : ndarray, shape (n,)
        Samples of a torque whose motion lies well below the sampling rate.
    inertia, damping, stiffness, coulomb, width
        J, D, K, F, w; the load's stiffness holds it at drive / K.
    period_s : float
        Sampling period.

    Returns
    -------
    ndarray, shape (n,)
        q at the samples.
    """
    step = period_s / SUBSTEPS
    # Straight lines between samples damp a sine by (w T)^2 / 12: undone, to (w T)^4, by the second difference.
    drive = drive.copy()
    drive[1:-1] -= np.diff(drive, 2) / 12.0
    transition, force = _exact_step(inertia, damping, stiffness, step)
    rest = np.array([drive[0] / stiffness, 0.0])
    return np.asarray(_run(drive, transition, force, rest, coulomb, max(width, 1e-300), SUBSTEPS))


def _exact_step(inertia: float, damping: float, stiffness: float, step: float) -> tuple[Array, Array]:
    """Transition of (q, q') over one step, and what a constant torque of one adds."""
    from scipy.linalg import expm

    system = np.zeros((3, 3))
    system[0, 1] = 1.0
    system[1] = np.array([-stiffness, -damping, 1.0]) / inertia
    exact = expm(system * step)
    return np.ascontiguousarray(exact[:2, :2]), np.ascontiguousarray(exact[:2, 2])


@njit(cache=True)
def _run(drive, transition, force, start, coulomb, width, substeps):  # type: ignore[no-untyped-def] # pragma: no cover
    n = drive.size
    position = np.empty(n)
    q, v = start[0], start[1]
    position[0] = q
    for i in range(n - 1):
        change = drive[i + 1] - drive[i]
        for k in range(substeps):
            torque = drive[i] + change * (k + 0.5) / substeps
            free = transition[1, 0] * q + transition[1, 1] * v + force[1] * torque
            friction = friction_sign(free, v, force[1] * coulomb, width) * coulomb
            position_next = transition[0, 0] * q + transition[0, 1] * v + force[0] * (torque - friction)
            v = free - force[1] * friction
            q = position_next
        position[i + 1] = q
    return position


@njit(cache=True)
def friction_sign(free, v, gain, width):  # type: ignore[no-untyped-def] # pragma: no cover
    """Sign at the end x of a step, x = free - gain tanh(x / width), by Newton steps kept inside a bracket."""
    low, high = free - abs(gain), free + abs(gain)
    x = min(max(v, low), high)
    for _ in range(NEWTON_STEPS):
        s = np.tanh(x / width)
        f = x - free + gain * s
        if f > 0.0:
            high = x
        else:
            low = x
        slope = 1.0 + gain * (1.0 - s * s) / width
        step = f / slope
        new = x - step
        if not (low <= new <= high):
            new = 0.5 * (low + high)
        if abs(new - x) < 1e-9 * width + 1e-15:
            x = new
            break
        x = new
    return np.tanh(x / width)
