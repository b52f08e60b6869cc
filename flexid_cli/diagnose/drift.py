"""Drift: trend of each parameter over the record, from the residual's scores."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from flexid_cli.diagnose.bands import correlated_rows, spread
from flexid_cli.diagnose.change_points import LEAST_NEW, Record
from flexid_cli.diagnose.result import Drift

Array = NDArray[np.float64]

MINUTE_S = 60.0


def drifts(record: Record, values: Mapping[str, float]) -> tuple[Drift, ...]:
    """Slope of each column's factor over time, the others' constant factors free; the surest first.

    Parameters
    ----------
    record : Record
    values : mapping of str to float
        Of the parameters, for slopes in percent.
    """
    minutes = np.tile(
        (record.time_s - record.time_s.mean()) / MINUTE_S, record.residual.size // record.time_s.size
    )
    found = []
    for name, column in record.columns.items():
        trend = column * minutes
        P = trend - record.Q @ (record.Q.T @ trend)
        size = float(P @ P)
        if size <= LEAST_NEW**2 * float(trend @ trend):
            continue
        slope = float(P @ record.residual) / size
        scores = record.by_time(P * (record.residual - P * slope))
        s = spread(scores[:, None], record.lengths, correlated_rows(scores, record.lengths))
        p = float(s.p_value(np.array([slope * size]))[0])
        value = values.get(name, 0.0)
        percent = 100.0 * slope / abs(value) if value else None
        share = slope**2 * size / max(float(record.residual @ record.residual), 1e-300)
        p = min(1.0, p * len(record.columns))
        found.append(Drift(name, slope, float(s.stderr[0]) / size, percent, share, p))
    return tuple(sorted(found, key=lambda d: d.p_value))
