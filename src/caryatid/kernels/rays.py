"""Compiled inner loops over the voxel grid, each beside the plain NumPy reference it is tested against.

A ray is the part t ∈ [t_from, t_to] of the segment start + t · (end − start), t from 0 at the start to 1
at the end. It traverses the voxels one after the other (Amanatides and Woo, 1987).
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from caryatid.frames import Array

Grid = NDArray[np.uint8]
"""One byte a voxel, indexed [x, y, z]."""


Triple = tuple[float, float, float]
"""One number an axis."""
Voxel = tuple[int, int, int]
"""Index of a voxel."""


@njit(cache=True)
def enter(
    shape: Voxel, start: Triple, ray: Triple, t_from: float, t_to: float
) -> tuple[float, float, Voxel, Triple, Triple]:
    """Cut a ray to a grid and find where it enters.

    Args:
        shape: Voxels of the grid along each axis.
        start: Start of the ray in voxels from the grid's corner.
        ray: Its direction, length 1 in t, in voxels.
        t_from: Where it begins.
        t_to: Where it ends.

    Returns:
        Begin and end within the grid (nothing is left where the end is not beyond the begin), the first
        voxel, how much t there is between planes of each axis, and t at the next plane of each axis.
    """
    for axis in range(3):
        position, direction, count = start[axis], ray[axis], shape[axis]
        if direction == 0.0:
            if position < 0.0 or position >= count:
                t_to = t_from
            continue
        near, far = -position / direction, (count - position) / direction
        t_from, t_to = max(t_from, min(near, far)), min(t_to, max(near, far))
    x, y, z = start
    dx, dy, dz = ray
    if t_from >= t_to:
        return t_from, t_from, (-1, -1, -1), (np.inf, np.inf, np.inf), (np.inf, np.inf, np.inf)
    i = min(max(int(np.floor(x + t_from * dx)), 0), shape[0] - 1)
    j = min(max(int(np.floor(y + t_from * dy)), 0), shape[1] - 1)
    k = min(max(int(np.floor(z + t_from * dz)), 0), shape[2] - 1)
    step = (
        abs(1.0 / dx) if dx != 0.0 else np.inf,
        abs(1.0 / dy) if dy != 0.0 else np.inf,
        abs(1.0 / dz) if dz != 0.0 else np.inf,
    )
    ahead = (
        (i + (1 if dx > 0.0 else 0) - x) / dx if dx != 0.0 else np.inf,
        (j + (1 if dy > 0.0 else 0) - y) / dy if dy != 0.0 else np.inf,
        (k + (1 if dz > 0.0 else 0) - z) / dz if dz != 0.0 else np.inf,
    )
    return t_from, t_to, (i, j, k), step, ahead


@njit(cache=True)
def advance(voxel: Voxel, ray: Triple, step: Triple, ahead: Triple) -> tuple[Voxel, Triple]:
    """Go on to the next voxel of a ray: the one beyond the nearest plane.

    Args:
        voxel: Where the ray is.
        ray: Its direction.
        step: How much t there is between planes of each axis.
        ahead: t at the next plane of each axis.

    Returns:
        The next voxel, and t at the next planes from there.
    """
    i, j, k = voxel
    x, y, z = ahead
    if x <= y and x <= z:
        return (i + (1 if ray[0] > 0.0 else -1), j, k), (x + step[0], y, z)
    if y <= z:
        return (i, j + (1 if ray[1] > 0.0 else -1), k), (x, y + step[1], z)
    return (i, j, k + (1 if ray[2] > 0.0 else -1)), (x, y, z + step[2])


@njit(cache=True)
def within(voxel: Voxel, shape: Voxel) -> bool:
    """Whether a voxel belongs to a grid."""
    return 0 <= voxel[0] < shape[0] and 0 <= voxel[1] < shape[1] and 0 <= voxel[2] < shape[2]


@njit(cache=True)
def _walk(grid: Grid, start: Triple, ray: Triple, t_from: float, t_to: float, mark: bool) -> bool:
    """Follow one ray, start and direction in voxel units: mark its voxels, or stop at one that is not 0."""
    t, end, voxel, step, ahead = enter(grid.shape, start, ray, t_from, t_to)
    while t < end and within(voxel, grid.shape):
        if mark:
            grid[voxel] = 1
        elif grid[voxel] != 0:
            return True
        t = min(ahead[0], ahead[1], ahead[2])
        voxel, ahead = advance(voxel, ray, step, ahead)
    return False


@njit(cache=True, parallel=True)
def carve(passed: Grid, start: Array, ends: Array, t_to: Array, origin: Array, size: float) -> None:
    """Mark with 1 every voxel the rays from one point traverse.

    Args:
        passed: Grid (X, Y, Z), written to.
        start: The rays' common start (3,) [m].
        ends: Where they end (N, 3) [m].
        t_to: Up to which share of its length each ray counts (N,).
        origin: Corner (3,) [m] of voxel [0, 0, 0].
        size: Edge of a voxel [m].
    """
    x, y, z = (start[0] - origin[0]) / size, (start[1] - origin[1]) / size, (start[2] - origin[2]) / size
    for n in prange(len(ends)):
        dx = (ends[n, 0] - start[0]) / size
        dy = (ends[n, 1] - start[1]) / size
        dz = (ends[n, 2] - start[2]) / size
        _walk(passed, (x, y, z), (dx, dy, dz), 0.0, t_to[n], True)


def carve_reference(passed: Grid, start: Array, ends: Array, t_to: Array, origin: Array, size: float) -> None:
    """Do the same as `carve`, ray by ray from all crossings with the grid's planes."""
    for end, limit in zip(ends, t_to, strict=True):
        voxels = traversed_reference(passed.shape, start, end, 0.0, float(limit), origin, size)
        passed[tuple(voxels.T)] = 1


@njit(cache=True, parallel=True)
def blocked(
    occupied: Grid,
    points: Array,
    targets: Array,
    asked: NDArray[np.bool_],
    clearance: float,
    origin: Array,
    size: float,
) -> NDArray[np.bool_]:
    """Test whether the ray from each point to each target meets an occupied voxel.

    Args:
        occupied: Grid (X, Y, Z), not 0 = occupied.
        points: Where the rays start (P, 3) [m].
        targets: Where they end (T, 3) [m].
        asked: Which rays to follow (P, T); the others count as free.
        clearance: Length of each ray's beginning that does not count [m].
        origin: Corner (3,) [m] of voxel [0, 0, 0].
        size: Edge of a voxel [m].

    Returns:
        (P, T), True where the ray is blocked.
    """
    result = np.zeros((len(points), len(targets)), dtype=np.bool_)
    for n in prange(len(points) * len(targets)):
        p, q = n // len(targets), n % len(targets)
        if not asked[p, q]:
            continue
        x = (points[p, 0] - origin[0]) / size
        y = (points[p, 1] - origin[1]) / size
        z = (points[p, 2] - origin[2]) / size
        dx = (targets[q, 0] - points[p, 0]) / size
        dy = (targets[q, 1] - points[p, 1]) / size
        dz = (targets[q, 2] - points[p, 2]) / size
        length = size * np.sqrt(dx * dx + dy * dy + dz * dz)
        if length > clearance:
            result[p, q] = _walk(occupied, (x, y, z), (dx, dy, dz), clearance / length, 1.0, False)
    return result


def blocked_reference(
    occupied: Grid,
    points: Array,
    targets: Array,
    asked: NDArray[np.bool_],
    clearance: float,
    origin: Array,
    size: float,
) -> NDArray[np.bool_]:
    """Do the same as `blocked`, ray by ray from all crossings with the grid's planes."""
    result = np.zeros((len(points), len(targets)), dtype=np.bool_)
    for p, point in enumerate(points):
        for q, target in enumerate(targets):
            length = float(np.linalg.norm(target - point))
            if asked[p, q] and length > clearance:
                voxels = traversed_reference(
                    occupied.shape, point, target, clearance / length, 1.0, origin, size
                )
                result[p, q] = bool(occupied[tuple(voxels.T)].any())
    return result


def traversed_reference(
    shape: tuple[int, ...], start: Array, end: Array, t_from: float, t_to: float, origin: Array, size: float
) -> NDArray[np.intp]:
    """Voxels (K, 3) a ray traverses: between two neighbouring plane crossings it is inside one voxel."""
    position, direction = (start - origin) / size, (end - start) / size
    crossings = [np.array([t_from, t_to])]
    for axis in range(3):
        if direction[axis] != 0.0:
            crossings.append((np.arange(shape[axis] + 1) - position[axis]) / direction[axis])
    t = np.unique(np.concatenate(crossings))
    t = t[(t >= t_from) & (t <= t_to)]
    middle = (t[1:] + t[:-1]) / 2.0
    voxels = np.floor(position + middle[:, None] * direction).astype(np.intp)
    return voxels[((voxels >= 0) & (voxels < shape)).all(axis=1)]
