"""The paper's own way, to reproduce it: plain sign, independent residuals, two sigma, Table 3's inversion."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from flexid_cli.estimate import summary
from flexid_cli.estimate.band import Tuning
from flexid_cli.estimate.fit import block_matrices, fit
from flexid_cli.estimate.result import Estimate, Interval, ModelResult
from flexid_cli.estimate.solution import Solution
from flexid_cli.estimate.verdict import judge
from flexid_cli.models.base import Block, unit_of
from flexid_cli.models.motor_only import PHYSICAL, REGRESSION, paper_inversion
from flexid_cli.models.two_encoders import TwoEncoders

if TYPE_CHECKING:
    from flexid_cli.config.schema import Config
    from flexid_cli.pipeline.columns import Columns

Array = NDArray[np.float64]

METHOD = "paper: 2 sigma, independent residuals"
CAUTION = (
    "route paper: its intervals suppose independent residuals and hold no bias; decide by the direct route"
)
# Probability of two sigma under the normal distribution.
LEVEL = 0.9544997361036416
NORMAL = 1e9


class PaperRegression:
    """Eqs. (18) to (20) as printed: seven columns, the derivatives of the sign and gravity left out."""

    id = "motor_only"
    equation = "Gm = -X1 Gm'' - X2 Gm' + X3 qm'''' + X4 qm''' + X5 qm'' + X6 qm' + X7 sgn(qm')"
    parameters = REGRESSION
    blocks = (
        Block(
            "motor",
            (
                ("torque", 0), ("torque", 2), ("torque", 1),
                ("motor", 4), ("motor", 3), ("motor", 2), ("motor", 1), ("sign_motor", 0),
            ),
        ),
    )  # fmt: skip

    def coefficients(self, theta: Array) -> tuple[Array]:
        """Coefficients of the torque and the seven columns, shape (8,)."""
        return (np.concatenate([[1.0], theta[:2], -theta[2:]]),)

    def jacobian(self, theta: Array) -> tuple[Array]:
        """Constant: the equation is linear in X1..X7."""
        signs = np.where(np.arange(theta.size) < 2, 1.0, -1.0)
        return (np.vstack([np.zeros(theta.size), np.diag(signs)]),)


def solve_paper(columns: Columns, config: Config, model_id: str, tuning: Tuning) -> ModelResult:
    """Reproduce Table 1 (both encoders) or Tables 2 and 3 (motor alone) on this recording.

    Raises
    ------
    DataError
        Too few rows.
    """
    columns.set_reversal_velocity(None)
    model = TwoEncoders() if model_id == "two_encoders" else PaperRegression()
    matrices = block_matrices(model, columns)
    start = np.ones(len(model.parameters))
    result = fit(model, matrices, start, columns.lengths, weighted=False, covariance="iid")
    solution = Solution(
        model, columns, matrices, result, tuning, "paper", "route `paper`: ordinary least squares, plain sign"
    )
    plain = config.model_copy(update={"estimate": config.estimate.model_copy(update={"covariance": "iid"})})
    table = summary.summarise(solution, plain, regression=False)
    estimates = tuple(_two_sigma(e) for e in table.parameters)
    table = replace(table, warnings=(*table.warnings, f"{model_id}: {CAUTION}"))
    if model_id == "two_encoders":
        return replace(table, parameters=estimates)
    names, correlation, physical = _table_3(solution)
    return replace(
        table,
        parameters=physical,
        regression=estimates,
        correlation_names=names,
        correlation=correlation,
    )


def _two_sigma(estimate: Estimate) -> Estimate:
    if estimate.value is None or estimate.stderr is None:
        return estimate
    half = 2.0 * estimate.stderr
    return replace(estimate, interval=Interval(estimate.value - half, estimate.value + half, LEVEL, METHOD))


def _table_3(solution: Solution) -> tuple[tuple[str, ...], Array, tuple[Estimate, ...]]:
    """Physical parameters by the inversion of Table 3, standard errors by the delta method."""
    X = solution.result.theta
    # Complex step: exact to rounding, for the inversion is a rational function.
    steps = np.diag(1e-30 * np.abs(X))
    J = np.column_stack([np.imag(paper_inversion(X + 1j * step)) / step.sum() for step in steps])
    covariance = J @ solution.result.covariance @ J.T
    recording = solution.columns.recording
    physical = tuple(
        _two_sigma(
            judge(
                parameter,
                unit_of(parameter.quantity, linear=recording.linear, torque_unit=recording.torque_unit),
                float(value),
                float(stderr),
                NORMAL,
                level=LEVEL,
                method=METHOD,
            )
        )
        for parameter, value, stderr in zip(
            PHYSICAL, paper_inversion(X), np.sqrt(np.diag(covariance)), strict=False
        )
    )
    symbols: tuple[str, ...] = tuple(p.symbol for p in PHYSICAL[: J.shape[0]])
    scale = np.sqrt(np.diag(covariance))
    return symbols, covariance / np.outer(scale, scale), physical
