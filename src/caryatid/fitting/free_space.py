"""What the voxel map says of the inside of a shape: a solid fills no space that was seen free."""

from __future__ import annotations

from caryatid.fitting.explaining import count_inside
from caryatid.geometry.shapes import Primitives, Shape
from caryatid.sensing.voxel_map import FREE, VoxelMap


def free_inside(shape: Shape, voxels: VoxelMap, inset: float) -> tuple[int, int]:
    """Of the space well inside a shape, how much there is and how much was seen free [voxels].

    Args:
        shape: In the world frame.
        voxels: What has been seen.
        inset: How far inside the surface to begin [m]; a surface voxel may be half free.

    Returns:
        Cubes of a voxel's size in all, none where the shape is too thin, and those in voxels seen free.
    """
    kind, R, centre, half = Primitives.of([shape]).row(0)
    inside, free = count_inside(
        kind, R, centre, half - inset, voxels.states, voxels.origin_world, voxels.config.size, FREE
    )
    return int(inside), int(free)


def free_share(shape: Shape, voxels: VoxelMap, inset: float) -> float:
    """Share of a shape's inside that was seen free; 0 where it is too thin to have one."""
    inside, free = free_inside(shape, voxels, inset)
    return free / inside if inside else 0.0
