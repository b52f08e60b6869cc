"""Which estimator solves a model: the configured one, or the one that `auto` takes, each with its guards.

Every method starts from the plain structured fit. Where a guard speaks (weak instruments, divergence, noise that
makes up most of the columns), that fit stands, its interval holds the noise's whole bias, and the report says why.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from flexid_cli.errors import DataError
from flexid_cli.estimate import iv, noise
from flexid_cli.estimate.fit import FitResult, block_matrices
from flexid_cli.estimate.irls import fit_irls
from flexid_cli.estimate.least_squares import triangle
from flexid_cli.estimate.minimum_distance import fit_minimum_distance
from flexid_cli.estimate.output_error import refine_output
from flexid_cli.estimate.refine import refine
from flexid_cli.estimate.reversal import fit_reversal_velocity
from flexid_cli.estimate.solution import Correction, Solution
from flexid_cli.models.base import Model
from flexid_cli.pipeline.columns import Columns

if TYPE_CHECKING:
    from flexid_cli.config.schema import Config

Array = NDArray[np.float64]

INSTRUMENTED = frozenset({"auto", "iv", "minimum_distance", "output_error"})
MAX_PASSES = 6
# Passes of simulation and fit end when no parameter moves by more of its standard error.
SETTLED_OVER_STDERR = 0.05
# Parameters of the motor-only model from here on are friction and gravity.
FRICTION = 3

BOTH_REASON = (
    "motor and torsion equation, weighted: what the load equation lacks cannot draw K to zero; the encoders' noise in"
    " the columns is subtracted"
)
BOTH_PLAIN = "motor and torsion equation, weighted: what the load equation lacks cannot draw K to zero"
MOTOR_PLAIN = "direct fit of the physical parameters to the exact equation (18), all terms kept"
DRIVEN_REASON = (
    "instruments from a simulation driven by the measured motor position: noise of the torque in its own derivatives"
    " does not draw the estimates; the motor encoder's noise is subtracted"
)
LOOP_REASON = (
    "instruments from a simulation of the closed loop along the set point: they hold no noise at all"
)


def takes_noise_out(config: Config) -> bool:
    """Whether the bias of the noise in the columns is to be taken out: by subtraction, and by instruments."""
    return config.estimate.method in INSTRUMENTED and config.estimate.covariance == "hac"


def two_encoders(plain: Solution, config: Config) -> Solution:
    """Solve the model of both encoders by the configured method, from the plain weighted fit."""
    method = config.estimate.method
    if method in {"ols", "wls"}:
        return plain
    plain = replace(plain, method="structured", method_reason=BOTH_PLAIN)
    if method == "structured" or config.estimate.covariance != "hac":
        return plain
    if method == "irls":
        return _robust(plain, weighted=True)
    free = subtracted(plain)
    if method == "iv":
        return _with_instruments(free, plain, config)
    if method == "output_error":
        return _output_error(free)
    if method == "minimum_distance":
        note = "minimum_distance is for the free coefficients of motor_only; structured was used"
        return replace(free, notes=(*free.notes, f"{plain.model.id}: {note}"))
    return free


def motor_only(plain: Solution, config: Config) -> Solution:
    """Solve the motor-only model by the configured method, from the plain structured fit."""
    method = config.estimate.method
    if method == "irls":
        return _robust(plain, weighted=False)
    if not takes_noise_out(config):
        return plain
    driven = _instrumented(plain)
    if driven.instruments is None:
        return driven
    if method == "iv":
        return _with_instruments(driven, driven, config, otherwise=driven)
    if method == "minimum_distance":
        return _minimum_distance(driven)
    if method == "output_error":
        return _output_error(driven)
    return driven


def subtracted(plain: Solution) -> Solution:
    """The fit without the bias of the noise in its columns."""
    levels = noise.floors(plain.columns.recording)
    refined = refine(plain.model, plain.columns, plain.matrices, plain.result, levels)
    if refined.result is None:
        return _noted(plain, f"the noise in the columns was not subtracted: {refined.reason}")
    return replace(plain, result=refined.result, correction=refined.correction, method_reason=BOTH_REASON)


def _robust(plain: Solution, *, weighted: bool) -> Solution:
    columns = plain.columns
    result, light = fit_irls(
        plain.model, plain.matrices, plain.result.theta, columns.lengths, weighted=weighted
    )
    reason = f"Huber's weights: {100.0 * light:.1f} % of the rows count less than the others"
    return replace(plain, result=result, method="irls", method_reason=reason)


def _minimum_distance(base: Solution) -> Solution:
    instruments = None if base.instruments is None else base.instruments[0]
    try:
        result = fit_minimum_distance(
            base.model, base.matrices[0], base.columns.lengths, base.result, instruments
        )
    except DataError as error:
        return _noted(base, f"no minimum distance: {error.message}")
    if result is None:
        return _noted(base, "the minimum distance did not settle")
    reason = (
        "physical parameters nearest to the free coefficients in their full robust covariance; "
        + DRIVEN_REASON
    )
    return replace(base, result=result, method="minimum_distance", method_reason=reason)


def _output_error(base: Solution) -> Solution:
    found = refine_output(base.model, base.columns, base.result)
    if found.result is None:
        return _noted(base, f"no output-error refinement: {found.reason}")
    reason = (
        "simulated torque nearest to the measured one, the simulation driven by the measured motor position"
    )
    return replace(base, outputs=found.result, method="output_error", method_reason=reason)


def _with_instruments(
    base: Solution, plain: Solution, config: Config, *, otherwise: Solution | None = None
) -> Solution:
    """Instruments of the closed loop where it is known, else of the motor-driven simulation."""
    axis = iv.mechanism(base.model, base.result.theta)
    loop = None if axis is None else iv.closed_loop(base.columns, axis, config)
    levels = noise.floors(base.columns.recording)
    notes: list[str] = []
    if loop is not None:
        refined = refine(base.model, base.columns, base.matrices, plain.result, levels, loop=loop)
        if refined.result is not None:
            return _iv(base, refined.result, refined.instruments, refined.correction, LOOP_REASON)
        notes.append(f"{base.model.id}: closed-loop instruments not used: {refined.reason}")
    if otherwise is not None:
        return replace(otherwise, notes=(*otherwise.notes, *notes))
    refined = refine(base.model, base.columns, base.matrices, plain.result, levels, driven=True)
    if refined.result is not None:
        return replace(
            _iv(base, refined.result, refined.instruments, refined.correction, DRIVEN_REASON),
            notes=tuple(notes),
        )
    return _noted(replace(base, notes=tuple(notes)), f"no instruments: {refined.reason}")


def _iv(
    base: Solution,
    result: FitResult,
    instruments: tuple[Array, ...] | None,
    correction: Correction | None,
    reason: str,
) -> Solution:
    return replace(
        base, result=result, instruments=instruments, correction=correction, method="iv", method_reason=reason
    )


def _noted(solution: Solution, reason: str) -> Solution:
    return replace(solution, notes=(*solution.notes, f"{solution.model.id}: {reason}"))


def _instrumented(plain: Solution) -> Solution:
    """The motor-only fit with instruments, whose simulation and joint motion follow from the fit before."""
    model, columns = plain.model, plain.columns
    levels = noise.floors(columns.recording)
    settled = _settle(plain, plain.result, levels)
    if isinstance(settled, str):
        return _noted(plain, f"no instruments: {settled}")

    def cost() -> float:
        return _friction_residual(model, columns, settled.result.theta)

    width = columns.reversal_velocity
    columns.set_reversal_velocity(fit_reversal_velocity(columns, cost))
    again = _settle(plain, settled.result, levels)
    if isinstance(again, str):
        columns.set_reversal_velocity(width)
        again = _settle(plain, settled.result, levels)
    if isinstance(again, str):
        return _noted(plain, f"no instruments: {again}")
    return replace(again, method="iv", method_reason=DRIVEN_REASON)


def _settle(plain: Solution, result: FitResult, levels: noise.Floors) -> Solution | str:
    """Instrumented fits until the simulation that they are made with agrees with them, or why there are none."""
    model, columns = plain.model, plain.columns
    solution = plain
    for _ in range(MAX_PASSES):
        axis = iv.mechanism(model, result.theta)
        if axis is None:
            return "the fitted axis is not one that could be simulated"
        columns.set_joint(iv.driven_joint(columns, axis))
        matrices = block_matrices(model, columns)
        refined = refine(model, columns, matrices, result, levels, driven=True)
        if refined.result is None or refined.correction is None:
            return refined.reason
        moved = np.max(np.abs(refined.result.theta - result.theta) / refined.result.stderr)
        result = refined.result
        correction = replace(refined.correction, shift=result.theta - plain.result.theta)
        solution = replace(
            plain, matrices=matrices, result=result, correction=correction, instruments=refined.instruments
        )
        if moved < SETTLED_OVER_STDERR:
            break
    return solution


def _friction_residual(model: Model, columns: Columns, theta: Array) -> float:
    """Logarithm of the residual's size with inertias and stiffness held, friction and gravity free.

    Were all free, noise in the derivatives of the torque would draw them, and the width of the reversal with them.
    """
    M = block_matrices(model, columns)[0]
    a, D = model.coefficients(theta)[0], model.jacobian(theta)[0]
    R = triangle(np.column_stack([M @ a, (M @ D)[:, FRICTION:]]))
    scale = np.linalg.norm(R[:, 1:], axis=0)
    scale[scale == 0.0] = 1.0
    rest = R[:, 0] - R[:, 1:] / scale @ np.linalg.lstsq(R[:, 1:] / scale, R[:, 0], rcond=None)[0]
    return float(np.log(max(float(np.linalg.norm(rest)), 1e-300)))
