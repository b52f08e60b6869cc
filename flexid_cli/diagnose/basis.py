"""Least squares of rows on columns by an orthonormal basis, to which further columns can be tried."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

DEPENDENT = 1e-10  # of the largest singular value of scaled columns


@dataclass(frozen=True)
class Basis:
    """Rows ``y`` on ``columns``.

    Attributes
    ----------
    columns : ndarray, shape (r, p)
    Q : ndarray, shape (r, rank)
        Orthonormal basis of the columns.
    residual : ndarray, shape (r,)
        Part of y outside it.
    coefficients : ndarray, shape (p,)
        The shortest solution in scaled units.
    cost : float
        Sum of squares of the residual.
    """

    columns: Array
    Q: Array
    residual: Array
    coefficients: Array

    @property
    def cost(self) -> float:
        """Sum of squares of the residual."""
        return float(self.residual @ self.residual)

    @property
    def rms(self) -> float:
        """Root mean square of the residual."""
        return float(np.sqrt(self.cost / self.residual.size))

    def outside(self, columns: Array) -> Array:
        """What of further columns lies outside the basis, shape (r, k)."""
        return np.asarray(columns - self.Q @ (self.Q.T @ columns), dtype=np.float64)


def solve(columns: Array, y: Array) -> Basis:
    """Solve a least-squares problem whose columns may depend on each other.

    Parameters
    ----------
    columns : ndarray, shape (r, p)
    y : ndarray, shape (r,)

    Returns
    -------
    Basis
    """
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0.0] = 1.0
    # A Gram matrix would be faster and lose half the digits of nearly dependent columns.
    U, s, Vt = np.linalg.svd(columns / scale, full_matrices=False)
    keep = s > DEPENDENT * s[0]
    Q = U[:, keep]
    projected = Q.T @ y
    solution = Vt[keep].T / s[keep]
    residual = y - Q @ projected
    residual -= Q @ (Q.T @ residual)
    return Basis(columns, Q, residual, (solution @ projected) / scale)
