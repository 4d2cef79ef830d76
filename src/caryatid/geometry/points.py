"""Compiled loops over many points, beside the plain reference in `frames` they are held to."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.geometry.transforms import Array


def transform(T_a_b: Array, which: NDArray[np.intp], points_b: Array) -> Array:
    """Do as `frames.transform` does, for points (N, 3) each with one (N,) of several transforms (K, 4, 4)."""
    return _transformed(np.ascontiguousarray(T_a_b), which, np.ascontiguousarray(points_b), 1.0)


def rotate(T_a_b: Array, which: NDArray[np.intp], vectors_b: Array) -> Array:
    """Do as `frames.rotate` does, for vectors (N, 3) each with one (N,) of several transforms (K, 4, 4)."""
    return _transformed(np.ascontiguousarray(T_a_b), which, np.ascontiguousarray(vectors_b), 0.0)


@njit(cache=True)
def _transformed(T, which, points, last):  # type: ignore[no-untyped-def]
    """Transform homogeneous points with this last coordinate."""
    moved = np.empty((len(points), 3))
    for i in range(len(points)):
        t = which[i]
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for k in range(3):
            moved[i, k] = T[t, k, 0] * x + T[t, k, 1] * y + T[t, k, 2] * z + T[t, k, 3] * last
    return moved
