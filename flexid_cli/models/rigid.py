"""One mass: for an axis whose flexibility the record does not excite.

Gm = (Jm + JL) qm'' + FV qm' + FS sgn(qm') + offset + gravity
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flexid_cli.models.base import Block, Parameter

Array = NDArray[np.float64]


class Rigid:
    """Total inertia, viscous and Coulomb friction, offset, gravity.

    Parameters
    ----------
    gravity : {"spring", "moments", "none"}
        As in `motor_only.MotorOnly`, with the motor's position for the joint's.
    """

    id = "rigid"

    def __init__(self, gravity: str) -> None:
        extra = {
            "spring": (Parameter("gravity_stiffness", "kg", "stiffness"),),
            "moments": (
                Parameter("gravity_moment_x", "MX", "first_moment"),
                Parameter("gravity_moment_y", "MY", "first_moment"),
            ),
            "none": (),
        }[gravity]
        columns = {
            "spring": (("joint_centred", 0),),
            "moments": (("gravity_cos", 0), ("gravity_sin", 0)),
            "none": (),
        }[gravity]
        self.parameters = (
            Parameter("total_inertia", "Jm+JL", "inertia", positive=True),
            Parameter("viscous_friction", "FVm+FV", "viscous", positive=True),
            Parameter("coulomb_friction", "FSm+FS", "torque", positive=True),
            Parameter("torque_offset", "offset", "torque"),
            *extra,
        )
        self.blocks = (
            Block("motor", (("torque", 0), ("motor", 2), ("motor", 1), ("sign_motor", 0), ("one", 0), *columns)),
        )
        gravity_text = {"spring": " + kg (q - q0)", "moments": " + MX g cos q + MY g sin q", "none": ""}[gravity]
        self.equation = f"Gm = (Jm+JL) q'' + (FVm+FV) q' + (FSm+FS) sgn(q') + offset{gravity_text}"

    def coefficients(self, theta: Array) -> tuple[Array]:
        """Coefficients of the columns, shape (1 + p,)."""
        return (np.concatenate([[1.0], -theta]),)

    def jacobian(self, theta: Array) -> tuple[Array]:
        """Constant: the equation is linear."""
        return (np.vstack([np.zeros(theta.size), -np.eye(theta.size)]),)
