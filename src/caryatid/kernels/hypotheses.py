"""Compiled kernels of model search: many hypotheses against all points, and points against points.

Each stands beside a NumPy reference in the tests.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.frames import Array
from caryatid.kernels.fitting import signed_distance


@njit(cache=True, error_model="numpy")
def hypothesis_distances(
    kind: int,
    R: NDArray[np.float64],
    centre: NDArray[np.float64],
    half: NDArray[np.float64],
    valid: NDArray[np.bool_],
    points: NDArray[np.float64],
) -> Array:
    """Unsigned distance (B, N) [m] of points (N, 3) to the surface of each hypothesis; infinite if not valid.

    Args:
        kind: Code of the shape.
        R: Axes (B, 3, 3), columns = x, y, z of the object.
        centre: (B, 3) [m].
        half: Half extents (B, 3) [m] along the axes.
        valid: (B,).
        points: (N, 3) [m].
    """
    distance = np.full((len(R), len(points)), np.inf)
    for b in range(len(R)):
        if not valid[b]:
            continue
        axes = R[b]
        cx, cy, cz = centre[b]
        hx, hy, hz = half[b]
        for i in range(len(points)):
            u, v, w = points[i, 0] - cx, points[i, 1] - cy, points[i, 2] - cz
            x = axes[0, 0] * u + axes[1, 0] * v + axes[2, 0] * w
            y = axes[0, 1] * u + axes[1, 1] * v + axes[2, 1] * w
            z = axes[0, 2] * u + axes[1, 2] * v + axes[2, 2] * w
            distance[b, i] = abs(signed_distance(kind, x, y, z, hx, hy, hz))
    return distance


@njit(cache=True)
def trimmed_ranges(
    points: NDArray[np.float64], directions: NDArray[np.float64], beyond: int
) -> tuple[Array, Array]:
    """Least and greatest coordinate (B,) [m] of points (N, 3) along directions (B, 3), ends left out.

    Args:
        points: (N, 3) [m], more than twice `beyond`.
        directions: Unit vectors (B, 3).
        beyond: How many points lie beyond either end.
    """
    low, high = np.empty(len(directions)), np.empty(len(directions))
    least, greatest = np.empty(beyond + 1), np.empty(beyond + 1)
    for b in range(len(directions)):
        least[:], greatest[:] = np.inf, -np.inf
        dx, dy, dz = directions[b]
        for i in range(len(points)):
            c = points[i, 0] * dx + points[i, 1] * dy + points[i, 2] * dz
            if c < least[beyond]:
                k = beyond
                while k > 0 and least[k - 1] > c:
                    least[k] = least[k - 1]
                    k -= 1
                least[k] = c
            if c > greatest[beyond]:
                k = beyond
                while k > 0 and greatest[k - 1] < c:
                    greatest[k] = greatest[k - 1]
                    k -= 1
                greatest[k] = c
        low[b], high[b] = least[beyond], greatest[beyond]
    return low, high


@njit(cache=True)
def any_within(samples: NDArray[np.float64], points: NDArray[np.float64], reach: float) -> NDArray[np.bool_]:
    """Which samples (M, 3) have one of the points (N, 3) within `reach` [m]."""
    found = np.zeros(len(samples), dtype=np.bool_)
    squared = reach * reach
    last = 0
    for m in range(len(samples)):
        x, y, z = samples[m]
        for n in range(-1, len(points)):
            i = last if n < 0 else n
            u, v, w = points[i, 0] - x, points[i, 1] - y, points[i, 2] - z
            if u * u + v * v + w * w <= squared:
                found[m] = True
                last = i
                break
    return found


@njit(cache=True)
def count_agreeing(normals: NDArray[np.float64], least_cosine: float) -> NDArray[np.intp]:
    """With how many normals (N, 3) each of them encloses less than the angle of this cosine (N,)."""
    count = np.zeros(len(normals), dtype=np.intp)
    for i in range(len(normals)):
        x, y, z = normals[i]
        for j in range(len(normals)):
            if x * normals[j, 0] + y * normals[j, 1] + z * normals[j, 2] > least_cosine:
                count[i] += 1
    return count
