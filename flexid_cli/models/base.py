"""What a model is: blocks of filtered columns and the coefficients that the parameters give them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# column(signal, derivative) -> filtered and decimated rows; signals are those of pipeline.columns
ColumnSource = Callable[[str, int], Array]


@dataclass(frozen=True)
class Parameter:
    """One physical parameter.

    Attributes
    ----------
    name, symbol : str
        Report name and symbol of DESIGN: ``joint_stiffness``, ``K``.
    quantity : str
        Key of `unit_of`.
    positive : bool
        Physics forbids a negative value.
    effect : str
        Name of the effect that this parameter belongs to where it is beyond the declared baseline.
    split : bool
        Only its sum with another parameter stands firmly in the model's equation.
    """

    name: str
    symbol: str
    quantity: str
    positive: bool = False
    effect: str = ""
    split: bool = False


@dataclass(frozen=True)
class Block:
    """One equation: residual = columns @ coefficients(theta).

    Attributes
    ----------
    name : str
        ``motor``, ``load``, ``total``, ``torsion``.
    columns : tuple of (str, int)
        Signal and order of derivative of each column.
    """

    name: str
    columns: tuple[tuple[str, int], ...]


class Model(Protocol):
    """A model that is linear in its filtered columns, with coefficients that depend on the parameters."""

    @property
    def id(self) -> str:
        """Name of the model in configuration and report."""
        ...

    @property
    def equation(self) -> str:
        """The equation in the report's symbols."""
        ...

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters in the order of theta."""
        ...

    @property
    def blocks(self) -> tuple[Block, ...]:
        """Equations; the first predicts the motor torque, with coefficient one on its first column."""
        ...

    def coefficients(self, theta: Array) -> tuple[Array, ...]:
        """Coefficients of each block's columns, shapes (columns,)."""
        ...

    def jacobian(self, theta: Array) -> tuple[Array, ...]:
        """Their derivatives, shapes (columns, p)."""
        ...


# Units by (rotary, linear) of quantities whose torque unit is N.m or N; with an unknown torque constant the
# torque stays in ampere and the others follow.
_UNITS = {
    "inertia": ("kg.m2", "kg", "A.s2/rad", "A.s2/m"),
    "stiffness": ("N.m/rad", "N/m", "A/rad", "A/m"),
    "viscous": ("N.m.s/rad", "N.s/m", "A.s/rad", "A.s/m"),
    "torque": ("N.m", "N", "A", "A"),
    "first_moment": ("kg.m", "kg.m", "A.s2/m", "A.s2/m"),
    "position": ("rad", "m", "rad", "m"),
    "velocity": ("rad/s", "m/s", "rad/s", "m/s"),
    "frequency": ("Hz", "Hz", "Hz", "Hz"),
    "time": ("s", "s", "s", "s"),
    "time_squared": ("s2", "s2", "s2", "s2"),
    "inertia_time_squared": ("kg.m2.s2", "kg.s2", "A.s4/rad", "A.s4/m"),
    "inertia_time": ("kg.m2.s", "kg.s", "A.s3/rad", "A.s3/m"),
    "ratio": ("1", "1", "1", "1"),
}


def unit_of(quantity: str, *, linear: bool, torque_unit: str) -> str:
    """Unit of a quantity on a rotary or linear axis, with torque in N m (N) or in A."""
    return _UNITS[quantity][int(linear) + (2 if torque_unit == "A" else 0)]


# How gravity enters a model without a joint encoder, by the form's name: parameters, columns, and text of the
# equation, the constant torque first. Over a small motion cos q and sin q are no more than a constant and a slope,
# so the offset cannot be told from the gravity torque at the middle of the motion, nor one moment from the other.
GRAVITY_FORMS: dict[str, tuple[tuple[Parameter, ...], tuple[tuple[str, int], ...], str]] = {
    "none": (
        (Parameter("torque_offset", "offset", "torque", effect="torque_offset"),),
        (("one", 0),),
        " + offset",
    ),
    "spring": (
        (
            Parameter("constant_torque", "Q0", "torque", effect="gravity"),
            Parameter("gravity_stiffness", "kg", "stiffness", effect="gravity"),
        ),
        (("one", 0), ("joint_centred", 0)),
        " + Q0 + kg (q - q0)",
    ),
    "moments": (
        (
            Parameter("torque_offset", "offset", "torque", effect="torque_offset"),
            Parameter("gravity_moment_x", "MX", "first_moment", effect="gravity"),
            Parameter("gravity_moment_y", "MY", "first_moment", effect="gravity"),
        ),
        (("one", 0), ("gravity_cos", 0), ("gravity_sin", 0)),
        " + offset + MX g cos q + MY g sin q",
    ),
}
