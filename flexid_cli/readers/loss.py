"""What a container could not give: counted while it is read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

_MOST_REASONS = 20  # a file that is damaged everywhere needs no longer list


@dataclass
class Loss:
    """Damage that a container met in the messages it was asked for.

    Attributes
    ----------
    messages : int or None
        Messages that are lost; None where their number cannot be known.
    size : int
        Bytes of the file that gave nothing.
    chunks : int
        Chunks (pages) that gave nothing.
    spans_ns : list of (int, int)
        Log times before and after each lost stretch, where they are known.
    reasons : list of str
        One sentence each, with positions in the file.
    """

    messages: int | None = 0
    size: int = 0
    chunks: int = 0
    spans_ns: list[tuple[int, int]] = field(default_factory=list)
    reasons: list[str] = field(default_factory=list)

    def add(self, reason: str, messages: int | None = 0, size: int = 0, chunks: int = 0) -> None:
        """Count one damaged place."""
        if self.messages is not None:
            self.messages = None if messages is None else self.messages + messages
        self.size += size
        self.chunks += chunks
        if reason not in self.reasons:
            if len(self.reasons) < _MOST_REASONS:
                self.reasons.append(reason)
            elif len(self.reasons) == _MOST_REASONS:
                self.reasons.append("more places are damaged")

    @property
    def any(self) -> bool:
        """Whether anything is damaged."""
        return bool(self.reasons)


class TimeGaps:
    """Finds the times between which messages are lost, from those that follow each other in a file.

    Parameters
    ----------
    loss : Loss
        Gets the spans.
    """

    def __init__(self, loss: Loss) -> None:
        self._loss = loss
        self._last: int | None = None
        self._is_open = False

    def take(self, times: NDArray[np.int64], places: Sequence[int] = ()) -> None:
        """Take the next messages that can be trusted.

        Parameters
        ----------
        times : ndarray of int64, shape (n,)
            Their log times in ns, in the order of the file.
        places : sequence of int
            Numbers of the messages before which something is missing, from 0; n: after the last.
        """
        if not times.size:
            self._is_open |= bool(places)
            return
        inside = {place for place in places if place < times.size}
        for place in sorted(inside | ({0} if self._is_open else set())):
            before = int(times[place - 1]) if place else self._last
            if before is not None and before < times[place]:
                self._loss.spans_ns.append((before, int(times[place])))
        self._last = int(times[-1])
        self._is_open = len(inside) < len(set(places))
