"""Compiled kernels of linear algebra, for other kernels to call."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.geometry.transforms import Array


@njit(cache=True, error_model="numpy")
def solve_positive(A: NDArray[np.float64], b: NDArray[np.float64]) -> Array:
    """Solution x (N,) of A x = b for a symmetric positive definite A (N, N), by Cholesky's factors.

    `numpy.linalg.solve` gives the same; called in a kernel it takes ten times as long to compile. Where A is
    not positive definite x has NaN.

    Args:
        A: (N, N); overwritten by its factor.
        b: Right side (N,).
    """
    size = len(b)
    x = np.empty(size)
    for i in range(size):
        for j in range(i + 1):
            rest = A[i, j]
            for k in range(j):
                rest -= A[i, k] * A[j, k]
            A[i, j] = np.sqrt(rest) if i == j else rest / A[j, j]
    for i in range(size):
        rest = b[i]
        for k in range(i):
            rest -= A[i, k] * x[k]
        x[i] = rest / A[i, i]
    for i in range(size - 1, -1, -1):
        rest = x[i]
        for k in range(i + 1, size):
            rest -= A[k, i] * x[k]
        x[i] = rest / A[i, i]
    return x
