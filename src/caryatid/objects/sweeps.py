"""Compiled motion of points along a line until they meet shapes."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.geometry.signed_distance import signed_distance


@njit(cache=True, error_model="numpy")
def way_to_shapes(
    points: NDArray[np.float64],
    direction: NDArray[np.float64],
    limit: float,
    overlap: float,
    least: float,
    near: NDArray[np.int64],
    kinds: NDArray[np.int64],
    R: NDArray[np.float64],
    centres: NDArray[np.float64],
    half: NDArray[np.float64],
) -> float:
    """How far [m] points can move together before one meets a shape, by sphere tracing; `limit` if none does.

    Args:
        points: (N, 3) [m].
        direction: Unit vector (3,).
        limit: [m].
        overlap: How deep points may enter a shape [m].
        least: Gaps below this are none [m].
        near: Indices (K,) of the shapes that may be in the way.
        kinds: Codes (M,) of all shapes.
        R: Axes (M, 3, 3), columns = x, y, z of the object.
        centres: (M, 3) [m].
        half: Half extents (M, 3) [m] along the axes.
    """
    length = 0.0
    while length < limit:
        nearest = np.inf
        for m in near:
            for i in range(len(points)):
                u = points[i, 0] + length * direction[0] - centres[m, 0]
                v = points[i, 1] + length * direction[1] - centres[m, 1]
                w = points[i, 2] + length * direction[2] - centres[m, 2]
                x = R[m, 0, 0] * u + R[m, 1, 0] * v + R[m, 2, 0] * w
                y = R[m, 0, 1] * u + R[m, 1, 1] * v + R[m, 2, 1] * w
                z = R[m, 0, 2] * u + R[m, 1, 2] * v + R[m, 2, 2] * w
                gap = signed_distance(kinds[m], x, y, z, half[m, 0], half[m, 1], half[m, 2])
                nearest = min(nearest, gap)
        if nearest + overlap < least:
            return max(length - overlap, 0.0)
        length += nearest + overlap
    return limit
