"""Compiled: points in the unseen space over a table, beside the plain NumPy reference."""

from __future__ import annotations

import numpy as np
import shapely
from numba import njit
from numpy.typing import NDArray

from caryatid.geometry.transforms import Array


@njit(cache=True, error_model="numpy")
def unseen_space(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    z: NDArray[np.float64],
    height: float,
    T_world_table: Array,
    half: NDArray[np.float64],
    heap: NDArray[np.float64],
    states: NDArray[np.int8],
    origin: Array,
    solid: NDArray[np.int8],
    solid_origin: Array,
    size: float,
) -> tuple[Array, Array, Array]:
    """Pick the points of a lattice that are over a table, in voxels no view has seen, and in nothing solid.

    Args:
        x: Coordinates (X,) of the lattice [m].
        y: The same (Y,) [m].
        z: The same (Z,) [m], from the lowest on.
        height: How far over the lowest points a point is worth nothing [m]; there they are worth 1.
        T_world_table: Pose (4, 4) of the table.
        half: Half extents (2,) of its top [m].
        heap: Corners (M, 2) [m] of a convex polygon on the ground, in either turn; the last may be the first.
        states: State (X, Y, Z) of each voxel: 0 = unseen.
        origin: Corner (3,) [m] of voxel [0, 0, 0].
        solid: Not 0 = solid (X, Y, Z).
        solid_origin: Corner (3,) [m] of its voxel [0, 0, 0].
        size: Edge of a voxel [m].

    Returns:
        Points (N, 3) [m]; their worth (N,) in shares of that of all the lattice over the table, seen or not;
        and in shares of that of all over the heap.
    """
    most = len(x) * len(y) * len(z)
    points, on_table, in_heap = np.empty((most, 3)), np.empty(most), np.empty(most)
    table_total, heap_total, count = 0.0, 0.0, 0
    for b in y:
        for a in x:
            among = 1.0 if _within(heap, a, b) else 0.0
            for c in z:
                u, v, w = a - T_world_table[0, 3], b - T_world_table[1, 3], c - T_world_table[2, 3]
                if (
                    abs(T_world_table[0, 0] * u + T_world_table[1, 0] * v + T_world_table[2, 0] * w) > half[0]
                    or abs(T_world_table[0, 1] * u + T_world_table[1, 1] * v + T_world_table[2, 1] * w)
                    > half[1]
                ):
                    continue
                lowness = 1.0 - (c - z[0]) / height
                table_total += lowness
                heap_total += among * lowness
                if (
                    _value(states, origin, size, a, b, c) == 0
                    and _value(solid, solid_origin, size, a, b, c) == 0
                ):
                    points[count, 0], points[count, 1], points[count, 2] = a, b, c
                    on_table[count], in_heap[count] = lowness, among * lowness
                    count += 1
    return (
        points[:count],
        on_table[:count] / max(table_total, 1e-9),
        in_heap[:count] / max(heap_total, 1e-9),
    )


@njit(cache=True)
def _within(polygon: NDArray[np.float64], x: float, y: float) -> bool:
    """Whether a point is inside a convex polygon, and not on its border."""
    left, right = False, False
    for n in range(len(polygon)):
        ax, ay = polygon[n - 1, 0], polygon[n - 1, 1]
        bx, by = polygon[n, 0], polygon[n, 1]
        if ax == bx and ay == by:
            continue
        turn = (bx - ax) * (y - ay) - (by - ay) * (x - ax)
        left, right = left or turn >= 0.0, right or turn <= 0.0
    return left != right


@njit(cache=True, error_model="numpy")
def _value(grid: NDArray[np.int8], origin: Array, size: float, x: float, y: float, z: float) -> int:
    """What a grid holds at a point; 0 outside."""
    i = int(np.floor((x - origin[0]) / size))
    j = int(np.floor((y - origin[1]) / size))
    k = int(np.floor((z - origin[2]) / size))
    if 0 <= i < grid.shape[0] and 0 <= j < grid.shape[1] and 0 <= k < grid.shape[2]:
        return int(grid[i, j, k])
    return 0


def unseen_space_reference(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    z: NDArray[np.float64],
    height: float,
    T_world_table: Array,
    half: NDArray[np.float64],
    heap: NDArray[np.float64],
    states: NDArray[np.int8],
    origin: Array,
    solid: NDArray[np.int8],
    solid_origin: Array,
    size: float,
) -> tuple[Array, Array, Array]:
    """Do the same as `unseen_space` with arrays and shapely's polygons."""
    points = np.stack([g.ravel() for g in np.meshgrid(x, y, z)], axis=-1)
    local = (points - T_world_table[:3, 3]) @ T_world_table[:3, :2]
    over = np.asarray((np.abs(local) <= half).all(axis=1))
    lowness = np.where(over, 1.0 - (points[:, 2] - z[0]) / height, 0.0)
    hull = shapely.MultiPoint(heap).convex_hull
    among = np.where(shapely.contains_xy(hull, points[:, 0], points[:, 1]), lowness, 0.0)
    for grid, corner in ((states, origin), (solid, solid_origin)):
        index = np.floor((points - corner) / size).astype(np.intp)
        inside = ((index >= 0) & (index < grid.shape)).all(axis=1)
        over[inside] &= grid[tuple(index[inside].T)] == 0
    totals = max(float(lowness.sum()), 1e-9), max(float(among.sum()), 1e-9)
    return points[over], lowness[over] / totals[0], among[over] / totals[1]
