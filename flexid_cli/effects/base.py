"""What an effect is: the facts about it, its parameters, and its torque law for the simulation.

An effect is a module in `effects/<family>/` with a constant ``EFFECT``; its docstring is the report's text. The
simulator, the report and the command line find it by `registry.effects`; none of them knows a single name.

Torque laws
-----------
A law is a plain function ``law(w, p, x, dx, g) -> None`` that the simulator compiles:

- ``w``: the workspace, whose places are named in `slots`; the law reads what it needs and adds what it causes;
- ``p``: the effect's parameters, in the order of ``Effect.parameters``;
- ``x``, ``dx``: the effect's own states and where to write their derivatives, in the order of ``Effect.states``;
- ``g``: ``Effect.guards`` switching functions. Where one changes its sign, the law has a kink or a jump, and the
  integrator puts a step's end there.

It may use `math`, numbers, ``if`` and nothing else (no helper functions, no allocation). Friction proportional to
sgn of a velocity is added to the slots MOTOR_COULOMB and LOAD_COULOMB, so that it is set-valued, with stick and slip,
where the axis has no reversal width. At its neutral values a law must leave the simulation unchanged to the
last bit: it adds exact zeros, and its guards must not change sign.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from flexid_cli.effects.signature import Signature
from flexid_cli.errors import UsageError

Array = NDArray[np.float64]
TorqueLaw = Callable[[Array, Array, Array, Array, Array], None]

Family = Literal["motor", "transmission", "load", "measurement"]
FAMILIES: tuple[Family, ...] = ("motor", "transmission", "load", "measurement")
StateKind = Literal["torque", "motor_position", "joint_position", "joint_velocity"]


class Stage(IntEnum):
    """When a law acts; within a stage in the order of the effects' codes."""

    LIMIT = 0  # TORQUE: between the command and the current loop
    LAG = 1  # TORQUE: the current loop
    KINEMATICS = 2  # TORSION, TORSION_RATE, GEAR
    CONTACT = 3  # SPRING_TORSION
    TRANSMISSION = 4  # JOINT_TORQUE
    MOTOR = 5  # MOTOR_TORQUE, MOTOR_COULOMB, MOTOR_INERTIA
    LOAD = 6  # LOAD_TORQUE, LOAD_COULOMB, LOAD_INERTIA
    MEASUREMENT = 7  # MEASURED_*, *_DELAY; TORQUE must not be changed any more


@dataclass(frozen=True)
class EffectParameter:
    """One parameter of an effect.

    Attributes
    ----------
    name, symbol : str
        Report name and symbol.
    quantity : str
        Key of `unit_of`.
    low, high : float
        What physics admits.
    example : float
        A usual size on the axis of the paper's Table 1 (joint side, SI).
    neutral : float or None
        Value that switches the parameter's part of the effect off; None for a shape parameter, which means
        nothing once the others are neutral.
    """

    name: str
    symbol: str
    quantity: str
    low: float
    high: float
    example: float
    neutral: float | None = None


@dataclass(frozen=True)
class EffectState:
    """An internal state of a torque law.

    Attributes
    ----------
    name : str
        As in `Trajectory.states`, after the effect's name.
    kind : {"torque", "motor_position", "joint_position", "joint_velocity"}
        What it starts from (zero for a torque) and what its integration error is measured by.
    """

    name: str
    kind: StateKind = "torque"


@dataclass(frozen=True)
class Law:
    """A torque law and the stage at which it acts."""

    stage: Stage
    function: TorqueLaw


@dataclass(frozen=True)
class Effect:
    """One effect that a model can leave out.

    Attributes
    ----------
    code, name : str
        Part of the report's contract: never changed, never used again for another effect.
    family, equation : str
        Where the cause sits, and the equation that it enters.
    term : str
        What is added, in the report's symbols.
    parameters : tuple of EffectParameter
    needs : tuple of str
        Signals without which it cannot be seen: torque, motor_position, joint_position.
    best_recording : str
        The recording that shows it best, one sentence.
    text : str
        What it is, what it looks like in the data, how to confirm it, what to do about it, references.
    laws : tuple of Law
    states : tuple of EffectState
    guards : int
        Number of switching functions, shared by the laws.
    energy : {"conserves", "dissipates", "exchanges"}
        What it does over a closed cycle; exchanges: it may take or give (or it changes the machine).
    command : callable, optional
        ``command(torque, rate_hz, values)`` gives the command from the acting torque, where the effect stands
        between the two and the simulation is driven by the motor position.
    signatures : tuple of Signature
        What its forms look like in the equations, for the diagnosis.
    """

    code: str
    name: str
    family: Family
    equation: Family
    term: str
    parameters: tuple[EffectParameter, ...]
    needs: tuple[str, ...]
    best_recording: str
    text: str
    laws: tuple[Law, ...]
    states: tuple[EffectState, ...] = ()
    guards: int = 0
    energy: Literal["conserves", "dissipates", "exchanges"] = "dissipates"
    command: Callable[[Array, float, Mapping[str, float]], Array] | None = None
    signatures: tuple[Signature, ...] = ()

    @property
    def examples(self) -> dict[str, float]:
        """A usual size of every parameter."""
        return {p.name: p.example for p in self.parameters}

    @property
    def neutral(self) -> dict[str, float]:
        """Values at which the effect adds nothing."""
        return {p.name: p.example if p.neutral is None else p.neutral for p in self.parameters}

    def is_neutral(self, values: Mapping[str, float]) -> bool:
        """Whether the effect adds nothing at these values (missing ones are neutral)."""
        return all(
            values.get(p.name, p.neutral) == p.neutral for p in self.parameters if p.neutral is not None
        )

    def vector(self, values: Mapping[str, float]) -> Array:
        """Parameters in the order of the law; what is not given is neutral, or the example of a shape.

        Raises
        ------
        UsageError
            Unknown name, or a value that physics does not admit.
        """
        unknown = [name for name in values if name not in self.neutral]
        if unknown:
            raise UsageError(
                f"effect {self.name} has no parameter {unknown[0]!r}", f"it has {', '.join(self.neutral)}"
            )
        full = {**self.neutral, **values}
        for p in self.parameters:
            value = full[p.name]
            if math.isnan(value) or not p.low <= value <= p.high:
                raise UsageError(
                    f"{self.name}: {p.name} = {value:g} is not possible",
                    f"it lies in {p.low:g} to {p.high:g}",
                )
        return np.array([full[p.name] for p in self.parameters], dtype=np.float64)


@dataclass(frozen=True)
class EffectValues:
    """An effect by name with values of its parameters, for the simulation."""

    name: str
    values: Mapping[str, float]


# Units by (rotary, linear) with the torque in N.m or N, and the same with the torque in A (as in models.base,
# which this layer does not see).
_UNITS = {
    "torque": ("N.m", "N", "A", "A"),
    "inertia": ("kg.m2", "kg", "A.s2/rad", "A.s2/m"),
    "stiffness": ("N.m/rad", "N/m", "A/rad", "A/m"),
    "cubic_stiffness": ("N.m/rad3", "N/m3", "A/rad3", "A/m3"),
    "viscous": ("N.m.s/rad", "N.s/m", "A.s/rad", "A.s/m"),
    "quadratic_viscous": ("N.m.s2/rad2", "N.s2/m2", "A.s2/rad2", "A.s2/m2"),
    "first_moment": ("kg.m", "kg.m", "A.s2/m", "A.s2/m"),
    "position": ("rad", "m", "rad", "m"),
    "velocity": ("rad/s", "m/s", "rad/s", "m/s"),
    "cycles": ("1", "rad/m", "1", "rad/m"),
    "phase": ("rad", "rad", "rad", "rad"),
    "time": ("s", "s", "s", "s"),
    "ratio": ("1", "1", "1", "1"),
}
QUANTITIES = tuple(_UNITS)


def unit_of(quantity: str, *, linear: bool = False, torque_unit: str = "N.m") -> str:
    """Unit of a quantity on a rotary or linear axis, with the torque in N m (N) or in A."""
    return _UNITS[quantity][int(linear) + (2 if torque_unit == "A" else 0)]
