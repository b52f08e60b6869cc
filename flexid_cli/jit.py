"""Compilation of inner loops to machine code."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile on first use, without the interpreter's lock, cached on disk where a place can be written."""
    from numba import njit

    try:
        return njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError:  # no place for the cache: compile anew in every process
        return njit(nogil=True, error_model="numpy")(function)
