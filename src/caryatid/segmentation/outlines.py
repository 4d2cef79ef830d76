"""Compiled loop over what lies over a convex outline, beside the plain reference it is held to."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.geometry.transforms import Array


def within_prism(
    points: Array, origin: Array, axes: Array, sides: Array, low: float, high: float, margin: float
) -> NDArray[np.bool_]:
    """Which points (N, 3) [m] lie over a convex polygon, or no further than the margin beside it.

    Args:
        points: (N, 3) [m].
        origin: Point (3,) [m] of the polygon's plane.
        axes: Two unit vectors in the plane and its normal (3, 3), as rows.
        sides: Outward unit normal in the plane's coordinates and offset [m] of each side (M, 3).
        low: Least height over the plane [m].
        high: Greatest height over the plane [m].
        margin: Distance outside the lines of all sides within which points still count [m].
    """
    inside = np.zeros(len(points), dtype=np.bool_)
    _find_within(np.ascontiguousarray(points), origin, axes, sides, low, high, margin, inside)
    return inside


def within_prism_reference(
    points: Array, origin: Array, axes: Array, sides: Array, low: float, high: float, margin: float
) -> NDArray[np.bool_]:
    """Do as `within_prism` does."""
    x, y, z = ((points - origin) @ axes.T).T
    outside = np.max(np.outer(x, sides[:, 0]) + np.outer(y, sides[:, 1]) - sides[:, 2], axis=1)
    return (z > low) & (z < high) & (outside <= margin)


@njit(cache=True)
def _find_within(points, origin, axes, sides, low, high, margin, inside):  # type: ignore[no-untyped-def]
    """Mark the points (N,) that are within."""
    for i in range(len(points)):
        u, v, w = points[i, 0] - origin[0], points[i, 1] - origin[1], points[i, 2] - origin[2]
        z = axes[2, 0] * u + axes[2, 1] * v + axes[2, 2] * w
        if not low < z < high:
            continue
        x = axes[0, 0] * u + axes[0, 1] * v + axes[0, 2] * w
        y = axes[1, 0] * u + axes[1, 1] * v + axes[1, 2] * w
        k = 0
        while k < len(sides) and sides[k, 0] * x + sides[k, 1] * y - sides[k, 2] <= margin:
            k += 1
        inside[i] = k == len(sides)
