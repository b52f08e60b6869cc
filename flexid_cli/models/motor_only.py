"""Motor encoder alone: eqs. (18) to (20) of the paper, with the terms that the paper dropped.

Eliminating q between the motor and the load equation gives, exactly,

    Gm + X1 Gm'' + X2 Gm' = X3 qm'''' + X4 qm''' + X5 qm'' + X6 qm'
                            + FSm (S + X2 S' + X1 S'') + FS SL + Q(q)
    X1 = JL/K, X2 = FV/K, X3 = Jm JL/K, X4 = (Jm FV + JL FVm)/K, X5 = Jm + JL + FV FVm/K, X6 = FV + FVm

with S = sgn qm', SL = sgn q'. The paper keeps X7 = FSm on S alone and leaves out S', S'', FS SL and Q. Here S is
filtered like every other column, so its derivatives exist; q in SL and Q is rebuilt from eq. (14).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flexid_cli.models.base import GRAVITY_FORMS, Block, Parameter

Array = NDArray[np.float64]

PHYSICAL = (
    Parameter("motor_inertia", "Jm", "inertia", positive=True),
    Parameter("joint_stiffness", "K", "stiffness", positive=True),
    Parameter("load_inertia", "JL", "inertia", positive=True),
    Parameter("motor_viscous_friction", "FVm", "viscous", positive=True, split=True),
    Parameter("load_viscous_friction", "FV", "viscous", positive=True, split=True),
    Parameter("motor_coulomb_friction", "FSm", "torque", positive=True, split=True),
    Parameter("load_coulomb_friction", "FS", "torque", positive=True, split=True),
)
_COLUMNS = (
    ("torque", 0), ("torque", 2), ("torque", 1),
    ("motor", 4), ("motor", 3), ("motor", 2), ("motor", 1),
    ("sign_motor", 0), ("sign_motor", 1), ("sign_motor", 2), ("sign_joint", 0),
)  # fmt: skip

REGRESSION = (
    Parameter("X1", "X1", "time_squared"),
    Parameter("X2", "X2", "time"),
    Parameter("X3", "X3", "inertia_time_squared"),
    Parameter("X4", "X4", "inertia_time"),
    Parameter("X5", "X5", "inertia"),
    Parameter("X6", "X6", "viscous"),
    Parameter("X7", "X7", "torque"),
)


def regression_coefficients(theta: Array) -> Array:
    """X1..X7 from (Jm, K, JL, FVm, FV, FSm), eq. (19); shape (7,)."""
    Jm, K, JL, FVm, FV, FSm = theta[:6]
    return np.array(
        [JL / K, FV / K, Jm * JL / K, (Jm * FV + JL * FVm) / K, Jm + JL + FV * FVm / K, FV + FVm, FSm]
    )


def regression_jacobian(theta: Array) -> Array:
    """Derivatives of X1..X7 with respect to (Jm, K, JL, FVm, FV, FSm), shape (7, 6)."""
    Jm, K, JL, FVm, FV, _ = theta[:6]
    X = regression_coefficients(theta)
    return np.array(
        [
            [0.0, -X[0] / K, 1.0 / K, 0.0, 0.0, 0.0],
            [0.0, -X[1] / K, 0.0, 0.0, 1.0 / K, 0.0],
            [JL / K, -X[2] / K, Jm / K, 0.0, 0.0, 0.0],
            [FV / K, -X[3] / K, FVm / K, JL / K, Jm / K, 0.0],
            [1.0, -FV * FVm / K**2, 1.0, FV / K, FVm / K, 0.0],
            [0.0, 0.0, 0.0, 1.0, 1.0, 0.0],
            [0.0, 0.0, 0.0, 0.0, 0.0, 1.0],
        ]
    )


def paper_inversion(X: Array) -> Array:
    """Table 3 of the paper: (Jm, K, JL, FVm, FV, FSm) from X1..X7.

    K = FV/X2 rests on a difference of two large numbers (X6 - FVm); kept to reproduce the paper only.
    """
    Jm = X[2] / X[0]
    FVm = (X[3] - Jm * X[1]) / X[0]
    FV = X[5] - FVm
    K = FV / X[1]
    return np.array([Jm, K, X[0] * K, FVm, FV, X[6]])


def starting_point(X: Array) -> Array:
    """(Jm, K, JL, FVm, FV, FSm) from X1..X7 by the well-conditioned route over X5, friction split evenly."""
    Jm = X[2] / X[0]
    JL = X[4] - Jm
    return np.array([Jm, JL / X[0], JL, 0.5 * X[5], 0.5 * X[5], X[6]])


class MotorOnly:
    """The exact equation, fitted for the physical parameters directly.

    Parameters
    ----------
    gravity : {"spring", "moments", "none"}
        Key of `base.GRAVITY_FORMS`: gravity as a spring about the middle of a small motion, as two moments, or
        none (a linear axis).
    """

    id = "motor_only"

    def __init__(self, gravity: str) -> None:
        extra, columns, text = GRAVITY_FORMS[gravity]
        self.parameters = (*PHYSICAL, *extra)
        self.blocks = (Block("motor", (*_COLUMNS, *columns)),)
        self.equation = (
            "Gm + X1 Gm'' + X2 Gm' = X3 qm'''' + X4 qm''' + X5 qm'' + X6 qm' + FSm (S + X2 S' + X1 S'')"
            f" + FS sgn(q'){text}, S = sgn(qm')"
        )

    def coefficients(self, theta: Array) -> tuple[Array]:
        """Coefficients of the columns, shape (12 + gravity columns,)."""
        X1, X2, X3, X4, X5, X6, FSm = regression_coefficients(theta)
        friction = [-FSm, -FSm * X2, -FSm * X1]
        return (np.concatenate([[1.0, X1, X2, -X3, -X4, -X5, -X6, *friction], -theta[6:]]),)

    def jacobian(self, theta: Array) -> tuple[Array]:
        """Derivatives of the coefficients, shape (12 + gravity columns, p)."""
        X = regression_coefficients(theta)
        dX = regression_jacobian(theta)
        J = np.zeros((4 + theta.size, theta.size))
        FSm = theta[5]
        J[[1, 2], :6] = dX[[0, 1]]
        J[[3, 4, 5, 6, 7], :6] = -dX[[2, 3, 4, 5, 6]]
        J[8, :6] = -FSm * dX[1] - X[1] * dX[6]
        J[9, :6] = -FSm * dX[0] - X[0] * dX[6]
        J[range(10, 4 + theta.size), range(6, theta.size)] = -1.0
        return (J,)
