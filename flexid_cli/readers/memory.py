"""Memory that is used again and again while chunks are unpacked."""

from __future__ import annotations

import numpy as np

_KEPT = 24 << 20  # bytes; below the limit up to which glibc learns


def keep_freed_memory() -> None:
    """Have glibc keep freed blocks for the next chunk, instead of giving their pages back to the system.

    It keeps blocks up to the size of the largest one freed so far; pages that come fresh from the system take
    about as long as unpacking into them. The memory asked for here is never touched. Elsewhere this does
    nothing.
    """
    np.empty(_KEPT, dtype=np.uint8)
