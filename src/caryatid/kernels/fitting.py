"""Compiled kernels of the shape fits: signed distances, and the normal equations of one least-squares step.

`refine.linearise` is the NumPy reference the tests compare them with.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.frames import Array

SPHERE, CYLINDER, BOX = 0, 1, 2
"""Codes of the shapes."""


@njit(cache=True)
def signed_distances(
    kind: int,
    R: NDArray[np.float64],
    centre: NDArray[np.float64],
    half: NDArray[np.float64],
    points: NDArray[np.float64],
) -> Array:
    """Distance (N,) [m] of points (N, 3) to a shape's surface, negative inside.

    Args:
        kind: Code of the shape.
        R: Axes (3, 3), columns = x, y, z of the object.
        centre: (3,) [m].
        half: Half extents (3,) [m] along the axes.
        points: (N, 3) [m].
    """
    distance = np.empty(len(points))
    gradient = np.empty(3)
    local = np.empty(3)
    for i in range(len(points)):
        distance[i] = _distance(kind, R, centre, half, points[i], local, gradient)
    return distance


@njit(cache=True)
def normal_equations(
    kind: int,
    R: NDArray[np.float64],
    centre: NDArray[np.float64],
    half: NDArray[np.float64],
    points: NDArray[np.float64],
    scale: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gauss–Newton matrix (9, 9) and gradient (9,) of the mean Geman–McClure cost over the points.

    Columns: translation [m] and rotation [rad] in the object's frame, then half extents [m]; of a cylinder
    x and y share the radius (column 6, half height in column 8), of a sphere all three (column 6).
    """
    H = np.zeros((9, 9))
    g = np.zeros(9)
    gradient = np.empty(3)
    p = np.empty(3)
    J = np.zeros(9)
    for i in range(len(points)):
        d = _distance(kind, R, centre, half, points[i], p, gradient)
        w = 1.0 / (1.0 + (d / scale) ** 2) ** 2 / len(points)
        for k in range(3):
            J[k] = -gradient[k]
            J[6 + k] = 0.0
        J[3] = -(p[1] * gradient[2] - p[2] * gradient[1])
        J[4] = -(p[2] * gradient[0] - p[0] * gradient[2])
        J[5] = -(p[0] * gradient[1] - p[1] * gradient[0])
        if kind == BOX:
            for k in range(3):
                J[6 + k] = -abs(gradient[k])
        elif kind == CYLINDER:
            J[6] = -np.sqrt(gradient[0] ** 2 + gradient[1] ** 2)
            J[8] = -abs(gradient[2])
        else:
            J[6] = -1.0
        for a in range(9):
            g[a] += w * d * J[a]
            for b in range(a + 1):
                H[a, b] += w * J[a] * J[b]
    for a in range(9):
        for b in range(a):
            H[b, a] = H[a, b]
    return H, g


@njit(cache=True)
def _distance(
    kind: int,
    R: NDArray[np.float64],
    centre: NDArray[np.float64],
    half: NDArray[np.float64],
    point: NDArray[np.float64],
    p: NDArray[np.float64],
    gradient: NDArray[np.float64],
) -> float:
    """Signed distance of one point; fills its local coordinates `p` and the distance's gradient there."""
    for k in range(3):
        p[k] = 0.0
        gradient[k] = 0.0
        for j in range(3):
            p[k] += R[j, k] * (point[j] - centre[j])
    if kind == SPHERE:
        length = np.sqrt(p[0] ** 2 + p[1] ** 2 + p[2] ** 2)
        for k in range(3):
            gradient[k] = p[k] / max(length, 1e-12)
        return length - half[0]
    if kind == CYLINDER:
        ring = np.sqrt(p[0] ** 2 + p[1] ** 2)
        q0, q2 = ring - half[0], abs(p[2]) - half[2]
        outside = np.sqrt(max(q0, 0.0) ** 2 + max(q2, 0.0) ** 2)
        if outside > 1e-9:
            s0, s2, d = max(q0, 0.0) / outside, max(q2, 0.0) / outside, outside
        elif q0 >= q2:
            s0, s2, d = 1.0, 0.0, q0
        else:
            s0, s2, d = 0.0, 1.0, q2
        gradient[0] = s0 * p[0] / max(ring, 1e-12)
        gradient[1] = s0 * p[1] / max(ring, 1e-12)
        gradient[2] = s2 * np.sign(p[2])
        return d
    squared, best, nearest = 0.0, -np.inf, 0
    for k in range(3):
        q = abs(p[k]) - half[k]
        squared += max(q, 0.0) ** 2
        if q > best:
            best, nearest = q, k
    outside = np.sqrt(squared)
    if outside > 1e-9:
        for k in range(3):
            gradient[k] = max(abs(p[k]) - half[k], 0.0) / outside * np.sign(p[k])
        return outside
    gradient[nearest] = np.sign(p[nearest])
    return best
