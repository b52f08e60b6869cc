"""Residuals in torque units, and what the sensors' noise alone would leave: for people and figures."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from flexid_cli.diagnose.problem import Problem

Array = NDArray[np.float64]


def torque_scale(problem: Problem) -> Mapping[str, float]:
    """RMS torque in the band that whitened rows of RMS one stand for, by equation.

    It is the noise that the signals themselves show, taken through the model, and the floor of what no model
    predicts.
    """
    s = max(problem.stretches, key=lambda x: x.torque.size)
    density = problem.spectral(s)
    share = 2.0 * problem.band_hz / s.rate_hz
    names = ("motor", "load") if problem.both else ("motor",)
    return {name: float(np.sqrt(np.mean(density[:, k, k].real) * share)) for k, name in enumerate(names)}
