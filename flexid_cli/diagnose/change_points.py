"""From when on another parameter holds: change points of the residual's scores.

Where a parameter changes at one time, the residual times its column sums up to a triangle over time. Without a
change the sum is a Brownian bridge at most (what further columns take up only lowers it), whose largest deviation
follows Kolmogorov's law; its size is the scores' own long-run variance, taken with the change out of the residual
(Andrews, Econometrica 61 (1993) 821; Ploberger and Kramer, Econometrica 60 (1992) 271). Bonferroni's correction
over the columns that are looked at. Which column it is, and when, is the one change that explains most of the
residual. What a gradual change explains as well is none: it belongs to the drift.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flexid_cli.diagnose.bands import Spread, correlated_rows, spread
from flexid_cli.diagnose.result import Change

Array = NDArray[np.float64]

ALPHA = 0.01  # chance of any change in a record that has none
MOST = 4
PERIOD = 2  # rows in a period of the highest frequency, in which nothing can be timed
EDGE = 0.03  # of the record, at either end, in which no change can be told
LEAST_NEW = 0.01  # share of a column's largest part outside the others: less cannot be told from them
LEAST_SHARE = 0.01  # of the residual's sum of squares, that a change explains
NEARLY = 0.9  # of what the best column explains
SETTLING = (0.1, 0.25, 0.5)  # time constants of gradual changes over the record's duration
# What the true time explains less than the best one, in the noise's units, is below this in 95 %: (1 - exp(-x/2))^2,
# the law of the maximum of a random walk's two arms (Eo and Morley, Quantitative Economics 6 (2015) 463).
LIKELY = 7.35


@dataclass(frozen=True)
class Record:
    """Rows of a residual with the columns whose factors may change.

    Attributes
    ----------
    columns : mapping of str to ndarray, shape (equations * rows,)
        Those that the model is not solved for (the spring on both sides, the torque) are no part of ``Q``: their
        changes are taken about their mean, in which the noise that they share with the residual falls out.
    Q : ndarray, shape (equations * rows, q)
        Orthonormal; the residual is orthogonal to it.
    residual : ndarray, shape (equations * rows,)
    time_s : ndarray, shape (rows,)
    lengths : sequence of int
        Rows of each gap-free segment.
    """

    columns: Mapping[str, Array]
    Q: Array
    residual: Array
    time_s: Array
    lengths: Sequence[int]

    def by_time(self, x: Array) -> Array:
        """Equations added, shape (rows, ...)."""
        return np.asarray(x.reshape(-1, self.time_s.size, *x.shape[1:]).sum(axis=0))

    def after(self, column: Array, row: int) -> Array:
        """A column from one row on, about its mean."""
        late = (np.arange(self.time_s.size) >= row) - (1.0 - row / self.time_s.size)
        return np.asarray(column * np.tile(late, column.size // late.size))

    def explained(self, x: Array) -> float:
        """Sum of squares that one more column explains."""
        p = x - self.Q @ (self.Q.T @ x)
        return float(p @ self.residual) ** 2 / max(float(p @ p), 1e-300)

    def without(self, x: Array) -> Record:
        """The record with one more column in the basis, and out of the residual."""
        p = x - self.Q @ (self.Q.T @ x)
        p = p / max(float(np.linalg.norm(p)), 1e-300)
        return Record(
            self.columns,
            np.column_stack([self.Q, p]),
            self.residual - p * float(p @ self.residual),
            self.time_s,
            self.lengths,
        )


@dataclass(frozen=True)
class _Best:
    """The best time for a change of one column, and what changes at each time explain."""

    name: str
    row: int
    explained: float
    largest_sum: float
    widest: float
    rows: NDArray[np.intp]
    profile: Array


def changes(record: Record, rival: float = 0.0) -> tuple[Change, ...]:
    """Changes of any column, the largest first; none where the residual's scores show none.

    Parameters
    ----------
    record : Record
    rival : float
        Sum of squares that a function of another variable than time explains: where that is more than all changes
        together do, a trajectory that changes its kind makes them up, and there are none.
    """
    found: list[_Best] = []
    now, whole = record, max(float(record.residual @ record.residual), 1e-300)
    for _ in range(MOST):
        best = _significant(now)
        if best is None or best.explained < LEAST_SHARE * whole:
            break
        column = now.columns[best.name]
        gradual = _gradual(now, column)
        if now.explained(gradual) >= best.explained:
            record, now = record.without(gradual), now.without(gradual)
            continue
        now = now.without(_at(now, best))
        found.append(best)
    found = _kept(record, [_settled(record, found, k) for k in range(len(found))], whole)
    left = _rest(record, found, len(found)).residual
    if whole - float(left @ left) < rival:
        return ()
    return tuple(_described(record, found, k, whole) for k in range(len(found)))


def _kept(record: Record, found: list[_Best], whole: float) -> list[_Best]:
    """Changes that are still needed beside the others: the first of two often stood in for both."""
    for k in range(len(found)):
        rest = _rest(record, found, k)
        alone = _at(rest, found[k])
        needless = rest.explained(alone) < LEAST_SHARE * whole
        if (
            needless
            or len(record.columns) * _p_value(rest, _search(rest, found[k].name) or found[k]) >= ALPHA
        ):
            left = found[:k] + found[k + 1 :]
            return _kept(record, [_settled(record, left, i) for i in range(len(left))], whole)
    return found


def _at(record: Record, best: _Best) -> Array:
    """Column of a change."""
    return record.after(record.columns[best.name], best.row)


def _significant(record: Record) -> _Best | None:
    """The change of a single column that explains most of those that chance does not make."""
    best = [b for n in record.columns if (b := _search(record, n)) is not None]
    best.sort(key=lambda b: -b.explained)
    return next((b for b in best if len(best) * _p_value(record, b) < ALPHA), None)


def _gradual(record: Record, column: Array) -> Array:
    """The gradual change of a column that explains most: a trend, or one that settles."""
    t = record.time_s - record.time_s[0]
    courses = [t, *(np.exp(-t / (part * float(t[-1]))) for part in SETTLING)]
    tried = [column * np.tile(course, column.size // t.size) for course in courses]
    return max(tried, key=record.explained)


def _search(record: Record, name: str) -> _Best | None:
    """The best time for a change of one column, others free."""
    c, rows = record.columns[name], record.time_s.size
    edge = max(2, round(EDGE * rows))
    at = np.arange(edge, rows - edge)
    products = record.by_time(c[:, None] * np.column_stack([record.Q, record.residual, c]))
    after = np.cumsum(products[::-1], axis=0)[::-1]
    total, sums, late = after[0], after[at], 1.0 - at / rows
    centred = sums - late[:, None] * total
    # About its mean, a column from one row on has this size.
    size = sums[:, -1] * (1.0 - 2.0 * late) + late**2 * total[-1]
    new = size - np.square(centred[:, :-2]).sum(axis=1)
    if float(new.max()) <= LEAST_NEW**2 * float(total[-1]):
        return None
    allowed = new > LEAST_NEW * new.max()
    score = centred[:, -2]
    profile = np.where(allowed, np.square(score) / np.where(allowed, new, 1.0), 0.0)
    k = int(np.argmax(profile))
    # A bridge over the time in which the column gathers has a quarter of its size in the middle.
    widest = max(1.0, float(np.max(new)) / (0.25 * float(total[-1])))
    return _Best(
        name, int(at[k]), float(profile[k]), float(np.max(np.abs(score))), float(np.sqrt(widest)), at, profile
    )


def _p_value(record: Record, best: _Best) -> float:
    """Kolmogorov's, of the largest deviation of the scores' sum."""
    from scipy.special import kolmogorov, ndtri, stdtr

    c = record.columns[best.name]
    size = _scores_spread(record, c, _at(record, best))
    t = best.largest_sum / max(best.widest * float(size.stderr[0]), 1e-300)
    # As far out as Student's t would be for a spread that is known from few blocks.
    tail = max(float(stdtr(size.degrees_of_freedom[0], -t)), 1e-300)
    return float(kolmogorov(-float(ndtri(tail))))


def _scores_spread(record: Record, weight: Array, change: Array) -> Spread:
    """Spread of the sum of the residual's scores, the change out of it."""
    scores = record.by_time(weight * record.without(change).residual)
    return spread(scores[:, None], record.lengths, correlated_rows(scores, record.lengths))


def _rest(record: Record, found: Sequence[_Best], k: int) -> Record:
    """The record without all changes but the k-th, if there is one."""
    for i, b in enumerate(found):
        if i != k:
            record = record.without(_at(record, b))
    return record


def _settled(record: Record, found: Sequence[_Best], k: int) -> _Best:
    """The k-th change with its time found again given the others."""
    return _search(_rest(record, found, k), found[k].name) or found[k]


def _described(record: Record, found: Sequence[_Best], k: int, whole: float) -> Change:
    """Size, time and share of one change given the others."""
    rest, best = _rest(record, found, k), found[k]
    change = _at(rest, best)
    P = change - rest.Q @ (rest.Q.T @ change)
    size = float(P @ P)
    error = float(_scores_spread(rest, P, change).stderr[0])
    # What noise alone explains by one column, on average.
    noise = error**2 / size
    near = np.flatnonzero(best.profile > best.explained - LIKELY * noise)
    others = [b for n in rest.columns if n != best.name and (b := _search(rest, n)) is not None]
    return Change(
        column=best.name,
        time_s=float(record.time_s[best.row]),
        earliest_s=float(record.time_s[max(best.rows[near[0]] - PERIOD, 0)]),
        latest_s=float(record.time_s[min(best.rows[near[-1]] + PERIOD, record.time_s.size - 1)]),
        size=float(P @ rest.residual) / size,
        stderr=error / size,
        share=best.explained / whole,
        p_value=min(1.0, len(record.columns) * _p_value(rest, best)),
        alternatives=tuple(b.name for b in others if b.explained > NEARLY * best.explained),
    )
