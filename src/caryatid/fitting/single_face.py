"""Compiled starts of a fit that need no luck: what points of one face alone suggest.

The tests hold a NumPy reference.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.fitting.ransac import LEAST_RADIUS, set_axes, trimmed_range
from caryatid.geometry import BOX
from caryatid.geometry.points import quantile

Direction = tuple[float, float, float]
"""Unit vector."""

AGREEING = float(np.cos(np.radians(25.0)))
"""Least cosine between normals of one face [1]."""
TURN = 3.0
"""Step between the directions tried for the sides of a flat box [deg]; least squares do the rest."""


@njit(cache=True, error_model="numpy")
def main_normal(normals: NDArray[np.float64]) -> tuple[Direction, NDArray[np.bool_]]:
    """The direction most normals (N, 3) agree on, their mean, and which do (N,)."""
    count = len(normals)
    best, most = 0, 0
    for i in range(count):
        x, y, z = normals[i, 0], normals[i, 1], normals[i, 2]
        agreeing = 0
        for j in range(count):
            agreeing += x * normals[j, 0] + y * normals[j, 1] + z * normals[j, 2] > AGREEING
        if agreeing > most:
            best, most = i, agreeing
    x, y, z = normals[best, 0], normals[best, 1], normals[best, 2]
    u = v = w = 0.0
    agree = np.empty(count, np.bool_)
    for j in range(count):
        agree[j] = x * normals[j, 0] + y * normals[j, 1] + z * normals[j, 2] > AGREEING
        if agree[j]:
            u, v, w = u + normals[j, 0], v + normals[j, 1], w + normals[j, 2]
    length = np.sqrt(u * u + v * v + w * w)
    return (u / length, v / length, w / length), agree


@njit(cache=True, error_model="numpy")
def of_one_face(
    kind: int,
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    trim: float,
    min_extent: float,
    max_radius: float,
    max_extent: float,
    R: NDArray[np.float64],
    centre: NDArray[np.float64],
    half: NDArray[np.float64],
) -> bool:
    """Make a box or a cylinder for points of one face: their main normal, and what holds the points along it.

    A box has the least rectangle around them, a cylinder the circle that reaches as far.

    Args:
        kind: Code of the shape, box or cylinder.
        points: (N, 3) [m], centred.
        normals: Unit normals (N, 3).
        trim: Share of the points beyond each end that count as noise.
        min_extent: Least depth behind the face [m].
        max_radius: [m].
        max_extent: [m].
        R: Axes (3, 3), columns = x, y, z; written to.
        centre: (3,) [m]; written to.
        half: Half extents (3,) [m]; written to.

    Returns:
        Whether it is within the limits.
    """
    (x, y, z), on_face = main_normal(normals)
    if not x * x + y * y + z * z > 0.0:
        return False
    ux, uy, uz = _across(points, x, y, z)
    set_axes(R, ux, uy, uz, x, y, z, 0)
    if kind == BOX:
        best, least = 0.0, np.inf
        for step in range(int(90.0 / TURN)):
            angle = np.radians(step * TURN)
            area = 1.0
            for quarter in range(2):
                c, s = np.cos(angle + quarter * np.pi / 2.0), np.sin(angle + quarter * np.pi / 2.0)
                low, high = trimmed_range(
                    points,
                    c * R[0, 0] + s * R[0, 1],
                    c * R[1, 0] + s * R[1, 1],
                    c * R[2, 0] + s * R[2, 1],
                    trim,
                )
                area *= high - low
            if area < least:
                best, least = angle, area
        c, s = np.cos(best), np.sin(best)
        ux, uy, uz = (c * R[0, 0] + s * R[0, 1], c * R[1, 0] + s * R[1, 1], c * R[2, 0] + s * R[2, 1])
        set_axes(R, ux, uy, uz, x, y, z, 0)
    low, high = np.empty(3), np.empty(3)
    for a in range(3):
        low[a], high[a] = trimmed_range(points, R[0, a], R[1, a], R[2, a], trim)
    heights = np.empty(len(points))
    count = 0
    for i in range(len(points)):
        if on_face[i]:
            heights[count] = points[i, 0] * x + points[i, 1] * y + points[i, 2] * z
            count += 1
    high[2] = quantile(heights[:count], 0.5)
    low[2] = min(low[2], high[2] - min_extent)
    for a in range(3):
        half[a] = (high[a] - low[a]) / 2.0
        centre[a] = 0.0
        for b in range(3):
            centre[a] += R[a, b] * (low[b] + high[b]) / 2.0
    if kind == BOX:
        return 2.0 * max(half[0], half[1], half[2]) <= max_extent
    half[0] = half[1] = (half[0] + half[1]) / 2.0
    return LEAST_RADIUS < half[0] <= max_radius and 2.0 * half[2] <= max_extent


@njit(cache=True, error_model="numpy", no_cpython_wrapper=True)
def _across(points: NDArray[np.float64], x: float, y: float, z: float) -> Direction:
    """A direction across an axis that turns with the points: to the first one well off their middle."""
    count = len(points)
    mx = my = mz = 0.0
    for i in range(count):
        mx, my, mz = mx + points[i, 0] / count, my + points[i, 1] / count, mz + points[i, 2] / count
    farthest = 0.0
    for turn in range(2):
        for i in range(count):
            u, v, w = points[i, 0] - mx, points[i, 1] - my, points[i, 2] - mz
            along = u * x + v * y + w * z
            u, v, w = u - along * x, v - along * y, w - along * z
            reach = np.sqrt(u * u + v * v + w * w)
            if turn == 0:
                farthest = max(farthest, reach)
            elif reach > 0.5 * farthest:
                return u / reach, v / reach, w / reach
        if farthest < 1e-6:
            break
    # Points on the axis leave it open: across the world axis that is least along it.
    u, v, w = 0.0, 0.0, 1.0
    if abs(x) <= abs(y) and abs(x) <= abs(z):
        u, v, w = 1.0, 0.0, 0.0
    elif abs(y) <= abs(z):
        u, v, w = 0.0, 1.0, 0.0
    along = u * x + v * y + w * z
    u, v, w = u - along * x, v - along * y, w - along * z
    length = np.sqrt(u * u + v * v + w * w)
    return u / length, v / length, w / length
