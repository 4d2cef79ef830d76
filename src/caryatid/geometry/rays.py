"""Compiled paths of rays through a voxel grid.

A ray is the part t ∈ [t_from, t_to] of the segment start + t · (end − start), t from 0 at the start to 1
at the end. `traverse` finds all its voxels at once.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from caryatid.runtime.parallel import inner, kernel

Triple = tuple[float, float, float]
"""One number per axis."""
Voxel = tuple[int, int, int]
"""Index of a voxel."""

BATCH = 8
"""Slabs per batch; a ray uses a whole number of batches [1]."""


@kernel
def room(shape: Voxel) -> NDArray[np.int32]:
    """Make room (3, M) for the voxels of any ray through a grid, which `traverse` fills."""
    return np.empty((3, max(shape) + BATCH), dtype=np.int32)


@kernel(fastmath={"contract"})
def traverse(
    found: NDArray[np.int32], shape: Voxel, start: Triple, ray: Triple, t_from: float, t_to: float
) -> int:
    """Find the voxels a ray traverses, slab by slab along the axis it goes along most.

    Within a slab it meets at most three voxels: where it enters, where it leaves, and where it crosses over
    if both other axes change. All slabs are treated alike, without a branch, so several run at a time.

    Args:
        found: Flat indices (3, M), written to: the voxels of each slab, which may be the same; see `room`.
        shape: Voxels of the grid along each axis.
        start: Start of the ray in voxels from the grid's corner.
        ray: Its direction, length 1 in t, in voxels.
        t_from: Where it begins.
        t_to: Where it ends.

    Returns:
        Number of slabs it crosses.
    """
    x, y, z = start
    dx, dy, dz = ray
    nx, ny, nz = float(shape[0]), float(shape[1]), float(shape[2])
    per_x, t_from, t_to = _clip(x, dx, nx, t_from, t_to)
    per_y, t_from, t_to = _clip(y, dy, ny, t_from, t_to)
    per_z, t_from, t_to = _clip(z, dz, nz, t_from, t_to)
    if not t_from < t_to:
        return 0
    ax, ay, az = abs(dx), abs(dy), abs(dz)
    if ax >= ay and ax >= az:
        return _slabs(found, (nx, ny, nz), (ny * nz, nz, 1.0), start, ray, per_x, t_from, t_to)
    if ay >= az:
        return _slabs(found, (ny, nz, nx), (nz, 1.0, ny * nz), (y, z, x), (dy, dz, dx), per_y, t_from, t_to)
    return _slabs(found, (nz, nx, ny), (1.0, ny * nz, nz), (z, x, y), (dz, dx, dy), per_z, t_from, t_to)


@kernel(fastmath={"contract"}, inline="always")
def _clip(start, ray, count, t_from, t_to):  # type: ignore[no-untyped-def]
    """Clip a ray to the grid along one axis: t per voxel, begin and end; nothing if the end is not later."""
    if ray == 0.0:
        return np.inf, t_from, t_to if 0.0 <= start < count else t_from
    per_voxel = 1.0 / ray
    near, far = -start * per_voxel, (count - start) * per_voxel
    return per_voxel, max(t_from, min(near, far)), min(t_to, max(near, far))


@inner(fastmath={"contract"})
def _slabs(found, counts, strides, start, ray, per_voxel, t_from, t_to):  # type: ignore[no-untyped-def]
    """Like `traverse`, with the axes turned so that the ray goes along the first most."""
    x, y, z = start
    dx, dy, dz = ray
    last_x, last_y, last_z = counts[0] - 1.0, counts[1] - 1.0, counts[2] - 1.0
    first = min(max(np.floor(x + t_from * dx), 0.0), last_x)
    slabs = 1 + int(abs(min(max(np.floor(x + t_to * dx), 0.0), last_x) - first))
    direction = 1.0 if dx > 0.0 else -1.0
    t_slab = abs(per_voxel)
    t_first = (first - x if dx > 0.0 else first + 1.0 - x) * per_voxel
    steep_y, steep_z = abs(dy), abs(dz)
    for n in range((slabs + BATCH - 1) // BATCH * BATCH):
        t_in = min(max(t_first + n * t_slab, t_from), t_to)
        t_out = min(t_first + (n + 1) * t_slab, t_to)
        y_in, y_out, z_in, z_out = y + t_in * dy, y + t_out * dy, z + t_in * dz, z + t_out * dz
        j_in = min(max(np.floor(y_in), 0.0), last_y)
        j_out = min(max(np.floor(y_out), 0.0), last_y)
        k_in = min(max(np.floor(z_in), 0.0), last_z)
        k_out = min(max(np.floor(z_out), 0.0), last_z)
        y_first = abs(max(j_in, j_out) - y_in) * steep_z < abs(max(k_in, k_out) - z_in) * steep_y
        j_between = j_out if y_first else j_in
        k_between = k_in if y_first else k_out
        slab = (first + n * direction) * strides[0]
        found[0, n] = np.int32(slab + j_in * strides[1] + k_in * strides[2])
        found[1, n] = np.int32(slab + j_between * strides[1] + k_between * strides[2])
        found[2, n] = np.int32(slab + j_out * strides[1] + k_out * strides[2])
    return slabs
