"""The unit of fast reading: many messages of one topic that lie in one buffer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexid_cli.readers.decoders import TopicType


@dataclass(frozen=True)
class Batch:
    """Messages of one topic that lie in one buffer (a decompressed chunk, a joined block of rows).

    Attributes
    ----------
    kind : TopicType
        The topic and how its messages are encoded.
    buffer : ndarray of uint8
        The whole buffer, a view that nobody writes to while the batch is in use.
    starts, lengths : ndarray of int64, shape (n,)
        First byte of each payload in ``buffer``, and its number of bytes. Every payload lies inside the
        buffer.
    log_time : ndarray of int64, shape (n,)
        Nanoseconds.
    publish_time : ndarray of int64, shape (n,), or None
        Nanoseconds; None where the container does not record it.
    trusted : bool
        False where the messages may be wrong: a stored checksum does not hold, or the place is damaged.
    checked : bool
        Whether a stored checksum covers these bytes and was verified.
    stride : int
        Bytes from one payload to the next, where it is known that it is always the same, else 0.
    """

    kind: TopicType
    buffer: NDArray[np.uint8]
    starts: NDArray[np.int64]
    lengths: NDArray[np.int64]
    log_time: NDArray[np.int64]
    publish_time: NDArray[np.int64] | None
    trusted: bool = True
    checked: bool = False
    stride: int = 0

    def payload(self, row: int) -> bytes:
        """Return the bytes of one message."""
        start = int(self.starts[row])
        return self.buffer[start : start + int(self.lengths[row])].tobytes()
