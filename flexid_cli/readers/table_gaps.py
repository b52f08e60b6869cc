"""Where rows are missing among the samples of a table, and which of its samples cannot be."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flexid_cli.readers.base import Damage, LostRows, RawChannel
from flexid_cli.readers.plausibility import lone_jumps_in_parts

Mask = NDArray[np.bool_]


@dataclass
class TablePart:
    """The samples of one file among those of all files of a run.

    Attributes
    ----------
    path : Path
        The file.
    first, end : int
        Its samples.
    gaps : list of (int, int or None)
        Number of the sample, among those of all files, before which rows are missing, and how many are, or
        None.
    suspect : list of (int, int)
        First and end of the samples that may be wrong, and so may their number.
    doubts : list of int
        Samples that jump farther than the others allow, ascending.
    reasons : list of str
        One sentence for each column with such samples.
    """

    path: Path
    first: int
    end: int
    gaps: list[tuple[int, int | None]]
    suspect: list[tuple[int, int]]
    doubts: list[int] = field(default_factory=list)
    reasons: list[str] = field(default_factory=list)

    def doubt(self, columns: Iterable[RawChannel], threads: int | None = None) -> None:
        """Look for samples that physics does not allow in columns that no checksum covers."""
        found: set[int] = set()
        judged = list(columns)
        with ThreadPoolExecutor(threads) as pool:
            jumps = list(pool.map(self._jumps, judged))
        for column, places in zip(judged, jumps, strict=True):
            if places.size:
                found.update(places.tolist())
                samples = "1 sample" if places.size == 1 else f"{places.size} samples"
                jump = "jumps" if places.size == 1 else "jump"
                row = int(places[0]) - self.first + 1
                self.reasons.append(
                    f"{self.path}: {samples} of {column.source!r} {jump} farther than the others allow (the first is "
                    f"sample {row}), and no checksum covers them"
                )
        self.doubts = sorted(found)

    def _jumps(self, column: RawChannel) -> NDArray[np.int64]:
        return lone_jumps_in_parts(_finite(column.values[self.first : self.end])) + self.first

    def count(self, damage: Damage) -> Damage:
        """Return the account of the file with the samples in doubt."""
        already = sum(first <= place < end for place in self.doubts for first, end in self.suspect)
        count = len(self.doubts) - already
        return replace(
            damage,
            trusted=damage.trusted - count,
            suspect=damage.suspect + count,
            reasons=(*damage.reasons, *self.reasons),
        )


def suspect_samples(parts: Sequence[TablePart], size: int) -> Mask | None:
    """Mark the samples of all files that may be wrong, shape (size,); None where all are right."""
    if not any(part.suspect or part.doubts for part in parts):
        return None
    mask = np.zeros(size, dtype=np.bool_)
    for part in parts:
        for first, end in part.suspect:
            mask[first:end] = True
        mask[part.doubts] = True
    return mask


def lost_rows(parts: Sequence[TablePart], left_out: Mask | None) -> tuple[LostRows, ...]:
    """Return the places where rows are missing among the samples that are not ``left_out``.

    Parameters
    ----------
    parts : sequence of TablePart
        All files in order.
    left_out : ndarray of bool, shape (n,), or None
        Samples that are not given; None: all are, those that may be wrong too.
    """
    found: dict[int, LostRows] = {}
    for part in parts:
        gaps = list(part.gaps)
        is_kept = left_out is None
        gaps += [(place, 0 if is_kept else 1) for place in part.doubts]
        gaps += [(first, 0 if is_kept else None) for first, end in part.suspect if end > first]
        places = np.array([place for place, _ in gaps], dtype=np.int64)
        if left_out is not None:
            places -= np.concatenate(([0], np.cumsum(left_out)))[places]
        for before, (_, count) in zip(places.tolist(), gaps, strict=True):
            known = found[before].count if before in found else 0
            both = None if count is None or known is None else count + known
            found[before] = LostRows(part.path, before, both)
    return tuple(found[before] for before in sorted(found))


def without(channels: Mapping[int, RawChannel], left_out: Mask) -> dict[int, RawChannel]:
    """Return columns without the samples that are ``left_out``, shape (n,)."""
    kept = ~left_out
    return {
        place: replace(
            channel,
            values=channel.values[kept],
            exact=None if channel.exact is None else channel.exact[kept],
        )
        for place, channel in channels.items()
    }


def _finite(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Without infinite values: no damage writes one into a text, so the drive did, and it counts as invalid later."""
    if not np.isinf([np.fmin.reduce(values, initial=0.0), np.fmax.reduce(values, initial=0.0)]).any():
        return values  # no mask as long as the record
    return np.where(np.isinf(values), np.nan, values)
