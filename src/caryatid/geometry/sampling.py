"""Compiled: points spread over the surfaces of many shapes; each shape's own `surface` is the reference."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.geometry.signed_distance import CYLINDER, SPHERE
from caryatid.geometry.transforms import Array

GOLDEN = np.pi * (3.0 - np.sqrt(5.0))
"""Angle by which one point of a ball is turned against the last [rad]."""


@njit(cache=True, error_model="numpy")
def sample_surfaces(
    kinds: NDArray[np.int64],
    R: NDArray[np.float64],
    centres: Array,
    half: Array,
    spacings: NDArray[np.float64],
) -> tuple[Array, Array, NDArray[np.intp]]:
    """Spread points over the surfaces of S shapes, one after the other, as each one's `surface` does.

    Args:
        kinds: Codes (S,).
        R: Axes (S, 3, 3), columns = x, y, z of the object.
        centres: (S, 3) [m].
        half: Half extents (S, 3) [m] along the axes.
        spacings: About how far apart on each (S,) [m].

    Returns:
        Points (N, 3) [m], outward unit normals (N, 3), and how many are on each shape (S,).
    """
    most = 0
    for s in range(len(kinds)):
        # A box has the most points of all shapes with its extents.
        i, j = _cells(half[s, 0], spacings[s]), _cells(half[s, 1], spacings[s])
        k = _cells(half[s, 2], spacings[s])
        most += 2 * (i * j + j * k + k * i)
    points, normals = np.empty((most, 3)), np.empty((most, 3))
    ends = np.zeros(len(kinds) + 1, dtype=np.intp)
    for s in range(len(kinds)):
        start = ends[s]
        end = start
        round_ = kinds[s] == CYLINDER
        if kinds[s] == SPHERE:
            end = _ball(points, normals, start, half[s, 0], spacings[s])
        elif round_:
            end = _mantle(points, normals, start, half[s, 0], half[s, 2], spacings[s])
            for face in range(5, 3, -1):
                end = _face(points, normals, end, half[s], face, spacings[s], round_)
        else:
            for face in range(6):
                end = _face(points, normals, end, half[s], face, spacings[s], round_)
        for n in range(start, end):
            x, y, z = points[n, 0], points[n, 1], points[n, 2]
            u, v, w = normals[n, 0], normals[n, 1], normals[n, 2]
            for axis in range(3):
                a, b, c = R[s, axis, 0], R[s, axis, 1], R[s, axis, 2]
                points[n, axis] = a * x + b * y + c * z + centres[s, axis]
                normals[n, axis] = a * u + b * v + c * w
        ends[s + 1] = end
    return points[: ends[-1]], normals[: ends[-1]], ends[1:] - ends[:-1]


@njit(cache=True, error_model="numpy")
def _cells(half: float, spacing: float) -> int:
    """How many equal cells cover [−half, half]."""
    return max(2, int(np.ceil(2.0 * half / spacing)))


@njit(cache=True, error_model="numpy")
def _face(
    points: Array,
    normals: Array,
    start: int,
    half: NDArray[np.float64],
    face: int,
    spacing: float,
    disc: bool,
) -> int:
    """Write the points of face −x, +x, −y, …, or of the disc within it, and return the row after the last."""
    axis, sign = face // 2, 2.0 * (face % 2) - 1.0
    n, u, v = start, (axis + 1) % 3, (axis + 2) % 3
    along_u, along_v = _cells(half[u], spacing), _cells(half[v], spacing)
    for i in range(along_u):
        x = half[u] * (2.0 * (i + 0.5) / along_u - 1.0)
        for j in range(along_v):
            y = half[v] * (2.0 * (j + 0.5) / along_v - 1.0)
            if disc and x * x + y * y > half[u] * half[u]:
                continue
            normals[n, axis], normals[n, u], normals[n, v] = sign, 0.0, 0.0
            points[n, axis], points[n, u], points[n, v] = sign * half[axis], x, y
            n += 1
    return n


@njit(cache=True, error_model="numpy")
def _mantle(
    points: Array, normals: Array, start: int, radius: float, half_height: float, spacing: float
) -> int:
    """Write the points of a cylinder's mantle and return the row after the last."""
    n, around = start, max(8, int(np.rint(2.0 * np.pi * radius / spacing)))
    up = _cells(half_height, spacing)
    for k in range(up):
        z = half_height * (2.0 * (k + 0.5) / up - 1.0)
        for i in range(around):
            angle = 2.0 * np.pi * (i + 0.5) / around
            x, y = np.cos(angle), np.sin(angle)
            normals[n, 0], normals[n, 1], normals[n, 2] = x, y, 0.0
            points[n, 0], points[n, 1], points[n, 2] = radius * x, radius * y, z
            n += 1
    return n


@njit(cache=True, error_model="numpy")
def _ball(points: Array, normals: Array, start: int, radius: float, spacing: float) -> int:
    """Write the points of a ball from a row on and return the row after the last."""
    count = max(20, int(np.rint(4.0 * np.pi * (radius / spacing) ** 2)))
    for n in range(count):
        z = 1.0 - (2.0 * n + 1.0) / count
        ring = np.sqrt(1.0 - z * z)
        x, y = ring * np.cos(GOLDEN * n), ring * np.sin(GOLDEN * n)
        normals[start + n, 0], normals[start + n, 1], normals[start + n, 2] = x, y, z
        points[start + n, 0], points[start + n, 1], points[start + n, 2] = radius * x, radius * y, radius * z
    return start + count
