"""Inner loops over the samples as machine code: a derivative's stencil, and the sign of a velocity."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from flexid_cli.jit import compiled

Array = NDArray[np.float64]

BLOCK = 1024  # samples that stay in the processor's nearest cache while the stencil's points are gone through
SETTLED = 20.0  # tanh is one from there on, to the last bit, and ln cosh its argument
SLOW_CHANGE = (
    1e-3  # of v / v0 within a sample: below it the average is the value, to the change squared over 24
)


@compiled
def stencil(padded: Array, weights: Array, turn: float, out: Array) -> None:
    """Sum of a symmetric or antisymmetric stencil about every sample.

    Parameters
    ----------
    padded : ndarray, shape (n + 2 h,)
        Samples with h more at either end.
    weights : ndarray, shape (h + 1,)
        Of the sample itself, and of those 1 to h behind it.
    turn : {1.0, -1.0}
        What the weights of the samples before it are turned by.
    out : ndarray, shape (n,)
    """
    reach, n = weights.size - 1, out.size
    for start in range(0, n, BLOCK):
        count = min(BLOCK, n - start)
        target = out[start : start + count]
        middle = padded[start + reach : start + reach + count]
        for i in range(count):
            target[i] = weights[0] * middle[i]
        for k in range(1, reach + 1):
            w = weights[k]
            behind = padded[start + reach + k : start + reach + k + count]
            before = padded[start + reach - k : start + reach - k + count]
            for i in range(count):
                target[i] += w * (behind[i] + turn * before[i])


@compiled
def averaged_sign(velocity: Array, width: float, out: Array) -> None:
    """Average of tanh(v / width) from half a sample before to half a sample after, for v linear between samples."""
    n = velocity.size
    if n == 0:
        return
    before = velocity[0] / width
    below = _log_cosh(before)
    for i in range(n):
        after = (0.5 * (velocity[i] + velocity[i + 1]) if i < n - 1 else velocity[i]) / width
        above = _log_cosh(after)
        change = after - before
        if abs(change) < SLOW_CHANGE:
            x = velocity[i] / width
            out[i] = math.tanh(x) if abs(x) < SETTLED else (1.0 if x > 0.0 else -1.0)
        else:
            out[i] = (above - below) / change
        before, below = after, above


@compiled
def _log_cosh(x):  # type: ignore[no-untyped-def] # pragma: no cover
    """Logarithm of 2 cosh x."""
    size = abs(x)
    return size + math.log1p(math.exp(-2.0 * size)) if size < SETTLED else size
