"""Compilation of torque laws to machine addresses, and what kernels need to call them."""

from __future__ import annotations

from collections.abc import Sequence
from threading import Lock
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import cfunc, types
from numba.extending import intrinsic
from numpy.typing import NDArray

from flexid_cli.effects.base import Effect, Stage, TorqueLaw

_POINTER = types.CPointer(types.float64)  # type: ignore[no-untyped-call]
_SIGNATURE = types.void(*(_POINTER,) * 5)


_laws: dict[TorqueLaw, Any] = {}
_laws_lock = Lock()


def _address(function: TorqueLaw) -> int:
    """Address of the compiled law, which is kept for the life of the process; one law is compiled once."""
    with _laws_lock:
        if function not in _laws:
            try:
                _laws[function] = cfunc(_SIGNATURE, cache=True, error_model="numpy")(function)
            except RuntimeError:  # no place for the cache
                _laws[function] = cfunc(_SIGNATURE, error_model="numpy")(function)
        return int(_laws[function].address)


def _pointer(_context, array):  # type: ignore[no-untyped-def]
    """Address of a contiguous array's values; the array must outlive its use."""
    kind = types.CPointer(array.dtype)  # type: ignore[no-untyped-call]

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return context.make_array(signature.args[0])(context, builder, arguments[0]).data

    return kind(array), generate


def _shifted(_context, address, count):  # type: ignore[no-untyped-def]
    """Address so many values further on."""

    def generate(_context, builder, _signature, arguments):  # type: ignore[no-untyped-def]
        return builder.gep(arguments[0], [arguments[1]])

    return address(address, count), generate


def _call_law(_context, address, w, p, x, dx, g):  # type: ignore[no-untyped-def]
    """Call a compiled law by its address."""

    def generate(context, builder, _signature, arguments):  # type: ignore[no-untyped-def]
        # A C callback of numba has exactly this type: void (double*, ...).
        law_type = ir.FunctionType(ir.VoidType(), [a.type for a in arguments[1:]])
        builder.call(builder.inttoptr(arguments[0], law_type.as_pointer()), arguments[1:])
        return context.get_dummy_value()

    return types.void(address, w, p, x, dx, g), generate


pointer: Any = intrinsic(_pointer)
shifted: Any = intrinsic(_shifted)
call_law: Any = intrinsic(_call_law)


def law_table(effects: Sequence[Effect]) -> tuple[NDArray[np.int64], NDArray[np.int64], int]:
    """Compiled laws of these effects in the order in which they act.

    Parameters
    ----------
    effects : sequence of Effect
        In the order of their parameters and states in the simulation's vectors.

    Returns
    -------
    laws : ndarray of int64, shape (laws, 4)
        Address; first parameter, first state (after the axis's four) and first guard (after its two).
    stages : ndarray of int64, shape (len(Stage) + 1,)
        First law of each stage.
    guards : int
        Number of switching functions.
    """
    rows: list[tuple[int, str, int, int, int, int]] = []
    parameter, state, guard = 0, 4, 2
    for effect in effects:
        places = (parameter, state, guard)
        rows += [(law.stage, effect.code, _address(law.function), *places) for law in effect.laws]
        parameter += len(effect.parameters)
        state += len(effect.states)
        guard += effect.guards
    rows.sort(key=lambda row: row[:2])
    laws = np.array([row[2:] for row in rows], dtype=np.int64).reshape(len(rows), 4)
    stages = np.searchsorted([row[0] for row in rows], np.arange(len(Stage) + 1)).astype(np.int64)
    return laws, stages, guard
