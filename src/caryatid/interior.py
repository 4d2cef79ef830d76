"""What the voxel map says of the inside of a shape: a solid fills no space that was seen free."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from caryatid import frames
from caryatid.shapes import Shape
from caryatid.voxels import FREE, VoxelMap


def interior_states(shape: Shape, voxels: VoxelMap, inset: float) -> NDArray[np.int8]:
    """States (N,) of the space well inside a shape, one for each cube of a voxel's size.

    Args:
        shape: In the world frame.
        voxels: What has been seen.
        inset: How far inside the surface to begin [m]; a surface voxel may be half free.
    """
    size = voxels.config.size
    half = shape.extents / 2.0 - inset
    if (half <= 0.0).any():
        return np.zeros(0, dtype=np.int8)
    ticks = [np.arange(-h + size / 2.0, h, size) if h > size / 2.0 else np.zeros(1) for h in half]
    local = np.stack([g.ravel() for g in np.meshgrid(*ticks, indexing="ij")], axis=-1)
    if shape.kind != "box":
        radius = np.hypot(local[:, 0], local[:, 1]) / half[0]
        if shape.kind == "sphere":
            radius = np.linalg.norm(local, axis=1) / half[0]
        local = local[radius <= 1.0]
    return voxels.state_at(frames.transform(shape.T_world_object, local))


def free_share(shape: Shape, voxels: VoxelMap, inset: float) -> float:
    """Share of a shape's inside that was seen free; 0 where it is too thin to have one."""
    states = interior_states(shape, voxels, inset)
    return float((states == FREE).mean()) if len(states) else 0.0
