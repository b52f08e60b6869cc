"""One mass: for an axis whose flexibility the record does not excite.

Gm = (Jm + JL) qm'' + FV qm' + FS sgn(qm') + offset + gravity
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from flexid_cli.models.base import GRAVITY_FORMS, Block, Parameter

Array = NDArray[np.float64]


_COLUMNS = (("torque", 0), ("motor", 2), ("motor", 1), ("sign_motor", 0))


class Rigid:
    """Total inertia, viscous and Coulomb friction, offset, gravity.

    Parameters
    ----------
    gravity : {"spring", "moments", "none"}
        As in `motor_only.MotorOnly`, with the motor's position for the joint's.
    """

    id = "rigid"

    def __init__(self, gravity: str) -> None:
        extra, columns, text = GRAVITY_FORMS[gravity]
        self.parameters = (
            Parameter("total_inertia", "Jm+JL", "inertia", positive=True),
            Parameter("viscous_friction", "FVm+FV", "viscous", positive=True),
            Parameter("coulomb_friction", "FSm+FS", "torque", positive=True),
            # The rigid baseline holds offset and gravity: they are no added effects here.
            *(replace(p, effect="") for p in extra),
        )
        self.blocks = (Block("motor", (*_COLUMNS, *columns)),)
        self.equation = f"Gm = (Jm+JL) q'' + (FVm+FV) q' + (FSm+FS) sgn(q'){text}"

    def coefficients(self, theta: Array) -> tuple[Array]:
        """Coefficients of the columns, shape (1 + p,)."""
        return (np.concatenate([[1.0], -theta]),)

    def jacobian(self, theta: Array) -> tuple[Array]:
        """Constant: the equation is linear."""
        return (np.vstack([np.zeros(theta.size), -np.eye(theta.size)]),)
