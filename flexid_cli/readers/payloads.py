"""Equal-sized payloads in one buffer, looked at column by column without copying where possible."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

_WORD = 8
_TILE = 1 << 16  # bytes
_WORTH_GATHERING = 1 << 10  # bytes of a payload that is copied as a whole rather than number by number
_UNSIGNED = {8: "<u8", 4: "<u4", 2: "<u2", 1: "u1"}


class Payloads:
    """The payloads that begin at ``starts``, all of one length.

    Parameters
    ----------
    buffer : ndarray of uint8
        Where they lie.
    starts : ndarray of int64, shape (n,), n > 0
        First byte of each.
    stride : int, optional
        Bytes from one to the next where they are known to lie evenly; 0: not known.
    """

    def __init__(self, buffer: NDArray[np.uint8], starts: NDArray[np.int64], stride: int = 0) -> None:
        self._buffer = buffer
        self._starts = starts
        self.count = starts.size
        self._stride = stride or _even_stride(starts)
        self._first = int(starts[0])

    def column(self, offset: int, dtype: DTypeLike, width: int = 1) -> NDArray[Any]:
        """Return the numbers that stand ``offset`` bytes into each payload.

        Returns
        -------
        ndarray, shape (n,), or (n, width) where ``width`` > 1 numbers follow each other
            A view into the buffer where the payloads lie evenly, else a copy.
        """
        kind = np.dtype(dtype)
        if self._stride and width == 1:
            return np.ndarray((self.count,), kind, self._buffer, self._first + offset, (self._stride,))
        shape: tuple[int, ...] = (self.count,) if width == 1 else (self.count, width)
        if self._stride:
            first = self._first + offset
            return np.ndarray(shape, kind, self._buffer, first, (self._stride, kind.itemsize))
        size = kind.itemsize * width
        # every byte of the buffer begins an item of this view, so that one indexing copies whole items
        items: NDArray[np.void] = np.ndarray(
            (self._buffer.size - size + 1,), f"V{size}", self._buffer, 0, (1,)
        )
        return items[self._starts + offset].view(kind).reshape(shape)

    def gathered(self, length: int) -> Payloads:
        """Return the same payloads, of ``length`` bytes each, lying evenly; copied where they do not."""
        if self._stride or not 0 < length <= _WORTH_GATHERING:
            return self
        rows = self.column(0, f"V{length}")
        return Payloads(rows.view(np.uint8), np.arange(0, self.count * length, length), length)

    def all_have(self, offset: int, tile: bytes, count: int) -> bool:
        """Whether the same bytes stand ``offset`` bytes into each payload.

        Parameters
        ----------
        offset : int
            First of them.
        tile : bytes
            The bytes ``count`` times over, so many as the allocator gives out without asking the system.
        count : int
            How many times.
        """
        width = len(tile) // count
        rows = self.column(offset, f"V{width}")
        # copying rows of bytes and comparing them as one piece is faster than any comparison by elements
        for first in range(0, self.count, count):
            piece = rows[first : first + count].tobytes()
            if piece != (tile if len(piece) == len(tile) else tile[: len(piece)]):
                return False
        return True

    def chosen(self, which: NDArray[np.bool_]) -> Payloads:
        """Return some of the payloads."""
        return Payloads(self._buffer, self._starts[which])


def _even_stride(starts: NDArray[np.int64]) -> int:
    """Distance between the starts where it is always the same and positive, else 0."""
    if starts.size == 1:
        return _WORD
    stride = int(starts[1]) - int(starts[0])
    if stride <= 0 or int(starts[-1]) - int(starts[0]) != stride * (starts.size - 1):
        return 0
    return stride if bool(np.all(starts[1:] - starts[:-1] == stride)) else 0


@dataclass(frozen=True, eq=False)
class Pattern:
    """Bytes at one place of a payload that must be what they are in another payload.

    Attributes
    ----------
    offset : int
        First byte.
    wanted : ndarray of unsigned words, shape (k,)
        The words that follow each other from there.
    mask : ndarray of the same shape, or None
        The bits that matter; None: all.
    likely_whole : bool
        Whether the bits that do not matter are the same in practice (padding), so that it pays to compare
        without the mask first.
    """

    offset: int
    wanted: NDArray[Any]
    mask: NDArray[Any] | None
    likely_whole: bool

    def agree(self, payloads: Payloads) -> NDArray[np.bool_] | None:
        """Return which payloads have the pattern, shape (n,), or None where all have."""
        words = payloads.column(self.offset, self.wanted.dtype, self.wanted.size)
        same: NDArray[np.bool_] = np.empty(0, dtype=np.bool_)
        if self.mask is None or self.likely_whole:
            same = words == self.wanted
            if bool(same.all()):
                return None
        if self.mask is not None:
            same = (words & self.mask) == (self.wanted & self.mask)
            if bool(same.all()):
                return None
        return same if same.ndim == 1 else np.asarray(same.all(axis=1))


@dataclass(eq=False)
class Block:
    """A longer stretch of bytes, most of which must be what they are in another payload.

    Attributes
    ----------
    offset : int
        First byte.
    tile : bytes
        The stretch in the other payload, ``count`` times over; what does not matter in it is mostly the same
        too.
    count : int
        How many times.
    parts : sequence of Pattern
        What matters in it.
    """

    offset: int
    tile: bytes
    count: int
    parts: Sequence[Pattern]
    _differs: bool = False  # whether what does not matter turned out to differ

    def agree(self, payloads: Payloads) -> NDArray[np.bool_] | None:
        """Return which payloads have the pattern, shape (n,), or None where all have."""
        if not self._differs and payloads.all_have(self.offset, self.tile, self.count):
            return None
        agreeing = agreement(self.parts, payloads)
        self._differs = self._differs or agreeing is None
        return agreeing


def agreement(parts: Sequence[Pattern | Block], payloads: Payloads) -> NDArray[np.bool_] | None:
    """Return which payloads have all patterns, shape (n,), or None where all have."""
    agreeing: NDArray[np.bool_] | None = None
    for part in parts:
        same = part.agree(payloads)
        if same is not None:
            agreeing = same if agreeing is None else agreeing & same
    return agreeing


def patterns(
    reference: bytes, matters: Sequence[tuple[int, int, int]], bridge: int = 3
) -> list[Pattern | Block]:
    """Compile what must be equal in all payloads of a layout.

    Parameters
    ----------
    reference : bytes
        A payload that has the layout.
    matters : sequence of (int, int, int)
        First byte, byte after the last, and the bits of each byte (0 to 255) that must agree; ascending and
        without overlap. No bits: bytes that probably agree, but need not.
    bridge : int
        Up to so many bytes between two such places, which are padding, are compared along with them.

    Returns
    -------
    list of Pattern and Block
    """
    mask = np.zeros(len(reference), dtype=np.uint8)
    spans: list[list[int]] = []
    for first, end, bits in matters:
        mask[first:end] = bits
        if spans and first - spans[-1][1] <= bridge:
            spans[-1][1] = end
        else:
            spans.append([first, end])
    return [part for first, end in spans for part in _compiled(reference, mask, first, end)]


def _compiled(reference: bytes, mask: NDArray[np.uint8], first: int, end: int) -> list[Pattern | Block]:
    content = np.frombuffer(reference, dtype=np.uint8)
    parts = [_pattern(content, mask, *piece) for piece in _pieces(first, end - first)]
    wanted = [part for part in parts if part.mask is None or bool(part.mask.any())]
    if end - first <= _WORD or not all(part.likely_whole for part in parts):
        return list(wanted)
    count = max(1, _TILE // (end - first))
    return [Block(first, reference[first:end] * count, count, wanted)]


def _pieces(first: int, width: int) -> list[tuple[int, int, int]]:
    """Cover ``width`` bytes with words (offset, size, count), the last of which may overlap the one before."""
    pieces = []
    if width >= _WORD:
        pieces.append((first, _WORD, width // _WORD))
        if width % _WORD:
            pieces.append((first + width - _WORD, _WORD, 1))
        return pieces
    for size in (4, 2, 1):
        if width & size:
            pieces.append((first, size, 1))
            first += size
    return pieces


def _pattern(
    content: NDArray[np.uint8], mask: NDArray[np.uint8], offset: int, size: int, count: int
) -> Pattern:
    place = slice(offset, offset + size * count)
    bits = mask[place]
    wanted = content[place].view(_UNSIGNED[size])
    if bool((bits == 255).all()):
        return Pattern(offset, wanted, None, likely_whole=True)
    partly = bool(((bits != 0) & (bits != 255)).any())
    return Pattern(offset, wanted, bits.view(_UNSIGNED[size]), likely_whole=not partly)
