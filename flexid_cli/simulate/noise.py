"""Noise of the sensors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def coloured(random: np.random.Generator, n: int, sigma: float, time_s: float, at: Array) -> Array:
    """Stationary first-order Markov noise, exact at unequally spaced instants.

    Parameters
    ----------
    random : Generator
        Drawn from only where sigma is not zero.
    n : int
        Number of values.
    sigma : float
        Standard deviation.
    time_s : float
        Correlation time; 0: white.
    at : ndarray, shape (n,)
        Instants, s.

    Returns
    -------
    ndarray, shape (n,)
    """
    if sigma == 0.0:
        return np.zeros(n)
    white = random.normal(0.0, 1.0, n)
    if time_s <= 0.0:
        return white * sigma
    from flexid_cli.simulate.kernel import markov

    return np.asarray(markov(white, np.exp(-np.diff(at) / time_s))) * sigma
