"""Second-order sections in cascade as machine code, which works without the interpreter's lock.

The sums are those of `scipy.signal.sosfilt` in their order (transposed direct form II), so that results agree to the
last bit; two sections go through the samples together, for either waits for its own last result only.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flexid_cli.jit import compiled

Array = NDArray[np.float64]


@compiled
def filter_in_place(x: Array, sos: Array, rest: Array, backward: bool) -> None:
    """Filter the samples in place, from the first to the last or backward.

    Parameters
    ----------
    x : ndarray, shape (n,)
        Samples, contiguous.
    sos : ndarray, shape (sections, 6)
        Sections with a0 = 1.
    rest : ndarray, shape (sections, 2)
        States after a long constant input of one; the filter starts from those of its first sample. Zeros: at rest.
    backward : bool
        From the last sample to the first.
    """
    sections = sos.shape[0]
    # Of an odd number the last is paired with one that lets everything through.
    even = np.zeros((sections + sections % 2, 6))
    even[:, 0] = 1.0
    even[:sections] = sos
    state = np.zeros((even.shape[0], 2))
    state[:sections] = rest * x[-1 if backward else 0]
    for k in range(0, even.shape[0], 2):
        _two(x, even[k], even[k + 1], state[k], state[k + 1], backward)


@compiled
def _two(x, s, t, z, w, backward):  # type: ignore[no-untyped-def] # pragma: no cover
    b0, b1, b2, a1, a2 = s[0], s[1], s[2], s[4], s[5]
    d0, d1, d2, c1, c2 = t[0], t[1], t[2], t[4], t[5]
    p, q = z[0], z[1]
    r, u = w[0], w[1]
    n = x.size
    for i in range(n):
        k = n - 1 - i if backward else i
        v = x[k]
        y = b0 * v + p
        p = b1 * v - a1 * y + q
        q = b2 * v - a2 * y
        out = d0 * y + r
        r = d1 * y - c1 * out + u
        u = d2 * y - c2 * out
        x[k] = out
