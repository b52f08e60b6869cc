"""Both encoders: eq. (13) of the paper, nine parameters and the difference of the encoders' zeros.

Motor:  0 = Gm - Jm qm'' - FVm qm' - FSm S - K (d - z)
Load:   0 = JL q'' + FV q' + FS SL + MX g cos q + MY g sin q - K (d - z),   d = qm - q

The parameter ``c = K z`` keeps the equations linear. Least squares on the pair as it stands is drawn towards the
trivial solution of the load equation (K, JL, ... all zero) by whatever that equation lacks: encoder noise, a load
torque from elsewhere. Divided by K it is an equation for the torsion, in which no such solution exists:

Torsion: 0 = d - (c + JL q'' + FV q' + FS SL + MX g cos q + MY g sin q) / K

Then K rests on the motor equation, and the load's parameters on the torsion that they cause. The sum of motor and
load equation, which holds no torsion, judges choices that must not depend on K:

Total:   0 = Gm - Jm qm'' - FVm qm' - FSm S - (JL q'' + FV q' + FS SL + MX g cos q + MY g sin q)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flexid_cli.models.base import Block, Parameter

Array = NDArray[np.float64]

PARAMETERS = (
    Parameter("motor_inertia", "Jm", "inertia", positive=True),
    Parameter("motor_viscous_friction", "FVm", "viscous", positive=True),
    Parameter("motor_coulomb_friction", "FSm", "torque", positive=True),
    Parameter("joint_stiffness", "K", "stiffness", positive=True),
    Parameter("load_inertia", "JL", "inertia", positive=True),
    Parameter("gravity_moment_x", "MX", "first_moment"),
    Parameter("gravity_moment_y", "MY", "first_moment"),
    Parameter("load_viscous_friction", "FV", "viscous", positive=True),
    Parameter("load_coulomb_friction", "FS", "torque", positive=True),
    Parameter("spring_zero_torque", "c", "torque"),
)
EQUATION = (
    "Gm = Jm qm'' + FVm qm' + FSm sgn(qm') + K (qm - q - z);  "
    "0 = JL q'' + FV q' + FS sgn(q') + MX g cos q + MY g sin q - K (qm - q - z)"
)
_MOTOR = (("torque", 0), ("motor", 2), ("motor", 1), ("sign_motor", 0))
_LOAD = (("joint", 2), ("gravity_cos", 0), ("gravity_sin", 0), ("joint", 1), ("sign_joint", 0))
_LOAD_PARAMETERS = (4, 5, 6, 7, 8)


class TwoEncoders:
    """Eq. (13) in the paper's form: motor and load equation, linear in all parameters."""

    id = "two_encoders"
    equation = EQUATION
    parameters = PARAMETERS
    blocks = (
        Block("motor", (*_MOTOR, ("torsion", 0), ("one", 0))),
        Block("load", (*_LOAD, ("torsion", 0), ("one", 0))),
    )

    def coefficients(self, theta: Array) -> tuple[Array, Array]:
        """Coefficients of motor and load equation."""
        J = self.jacobian(theta)
        motor, load = J[0] @ theta, J[1] @ theta
        motor[0] = 1.0
        return motor, load

    def jacobian(self, theta: Array) -> tuple[Array, Array]:
        """Constant: the equations are linear."""
        motor, load = np.zeros((6, theta.size)), np.zeros((7, theta.size))
        motor[[1, 2, 3, 4], [0, 1, 2, 3]] = -1.0
        load[[0, 1, 2, 3, 4], _LOAD_PARAMETERS] = 1.0
        load[5, 3] = -1.0
        motor[5, 9] = load[6, 9] = 1.0
        return motor, load


TOTAL = Block("total", (*_MOTOR, *_LOAD))


class TwoEncodersStructured:
    """Eq. (13) as motor and torsion equation: the same parameters, no trivial solution."""

    id = "two_encoders"
    equation = EQUATION
    parameters = PARAMETERS
    blocks = (
        TwoEncoders.blocks[0],
        Block("torsion", (("torsion", 0), ("one", 0), *_LOAD)),
    )

    def coefficients(self, theta: Array) -> tuple[Array, Array]:
        """Coefficients of motor and torsion equation."""
        motor, _ = TwoEncoders().coefficients(theta)
        load = theta[list(_LOAD_PARAMETERS)]
        return motor, np.concatenate([[1.0, -theta[9] / theta[3]], -load / theta[3]])

    def jacobian(self, theta: Array) -> tuple[Array, Array]:
        """Derivatives of the coefficients."""
        K = theta[3]
        motor, _ = TwoEncoders().jacobian(theta)
        torsion = np.zeros((7, theta.size))
        torsion[[2, 3, 4, 5, 6], _LOAD_PARAMETERS] = -1.0 / K
        torsion[1, 9] = -1.0 / K
        torsion[1, 3] = theta[9] / K**2
        torsion[2:, 3] = theta[list(_LOAD_PARAMETERS)] / K**2
        return motor, torsion
