"""Which views cannot be right: by their camera, and by what earlier views have shown."""

from __future__ import annotations

import logging

import numpy as np

from caryatid.config import Config
from caryatid.errors import WrongViewError
from caryatid.geometry.transforms import Array
from caryatid.segmentation.support_plane import SupportSurface
from caryatid.sensing.views import Cloud, View
from caryatid.sensing.voxel_map import FREE, VoxelMap

log = logging.getLogger(__name__)

COARSER = 4
"""Edge of the cells in which views are compared [voxels]; points of small images are nearer to each other."""
THROUGH = 0.2
"""Share of what a view shows over the table, in space that earlier views looked through, that leads to a
warning [1]; with right poses it is a twentieth.
"""
UNALIGNED = 0.1
"""The same for a view that could not be aligned with earlier ones, counting all voxels seen free [1]; with
right poses it is a twentieth, with swapped poses and mirrored images a fifth.
"""


def check_camera(view: View, max_coordinate: float) -> None:
    """Refuse a view whose camera or units cannot be right; coordinates are up to a largest one [m].

    Raises:
        WrongViewError: Its camera is implausible, or pose or depth are in other units than metres.
    """
    height, width = view.depth.shape
    (fx, _, cx), (_, fy, cy) = view.K[:2]
    pinhole = np.allclose(view.K, [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], atol=1e-3 * fx)
    # Focal lengths of 0.05 and 50 image widths are 168° and 1° of view.
    wide = min(fx, fy) >= 0.05 * width and max(fx, fy) <= 50.0 * width
    if not (pinhole and wide and -width <= cx <= 2 * width and -height <= cy <= 2 * height):
        remedy = "give [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels of this image"
        raise WrongViewError(view.name, f"K cannot be right for a camera with {described(view)}", remedy)
    far = 0.0 if view.T_world_camera is None else float(np.abs(view.T_world_camera[:3, 3]).max())
    if far > max_coordinate:
        reason = f"the camera is {far:.4g} m from the world's origin"
        raise WrongViewError(view.name, reason, "give T_world_camera in metres")
    if float(view.depth.max(initial=0.0)) > max_coordinate:
        raise WrongViewError(view.name, f"holds depths of {view.depth.max():.4g} m", "give depth in metres")


def check_place(
    cloud: Cloud, aligned: bool, surface: SupportSurface, voxels: VoxelMap, config: Config
) -> None:
    """Refuse a view whose camera is below the table, or that shows another place than earlier views saw.

    Args:
        cloud: What the view shows, registered.
        aligned: Whether registration matched it with earlier views.
        surface: The support surface.
        voxels: The map of earlier views.
        config: All settings.

    Raises:
        WrongViewError: Its pose cannot be right.
    """

    def refused(why: str) -> WrongViewError:
        convention = "p_world = T_world_camera @ p_camera, in metres, in the frame of the first view"
        reason = f"its pose cannot be right, {why}"
        return WrongViewError(cloud.name, reason, f"check T_world_camera: {convention}")

    eye_world = cloud.viewpoint_world
    height = 1.0 if eye_world is None else float((eye_world - surface.point_world) @ surface.normal_world)
    if height <= 0.0:
        raise refused(f"the camera would be {-height:.2f} m below the table top")
    points = cloud.points_world[:: max(1, len(cloud.points_world) // 20_000)]
    voxel = np.floor((points - voxels.origin_world) / voxels.config.size).astype(np.intp)
    within = ((voxel > 0) & (voxel < np.array(voxels.hits.shape) - 1)).all(axis=1)
    if not within.any():
        raise refused("nothing it shows is anywhere near the table")
    seen = np.zeros(np.array(voxels.hits.shape) // COARSER + 1, dtype=np.bool_)
    seen[tuple(voxels.occupied // COARSER)] = True
    common = float(seen[tuple(voxel[within].T // COARSER)].mean())
    if not aligned and common < config.registration.common:
        raise refused(f"only {common:.0%} of what it shows is where earlier views saw anything")


def check_free(
    name: str, points_world: Array, aligned: bool, surface: SupportSurface, voxels: VoxelMap, config: Config
) -> None:
    """Warn if a view shows much in space over the table that earlier views looked through.

    Args:
        name: Name of the view.
        points_world: Points (N, 3) [m] of it that no change explains.
        aligned: Whether registration found what it shows in earlier views.
        surface: The support surface.
        voxels: The map of earlier views.
        config: All settings.
    """
    points = points_world[:: max(1, len(points_world) // 20_000)]
    over = (points - surface.point_world) @ surface.normal_world > 2.0 * config.surface.tolerance
    over &= ((points > voxels.origin_world) & (points < voxels.end_world)).all(axis=1)
    free = voxels.free_around(points[over]) if aligned else voxels.state_at(points[over]) == FREE
    if free.sum() > (THROUGH if aligned else UNALIGNED) * len(free):
        log.warning(
            "%s: %.0f%% of what it shows over the table is where earlier views looked through; its pose is "
            "wrong, or objects have been moved",
            name, 100.0 * free.mean(),
        )  # fmt: skip


def described(view: View) -> str:
    """Size of its images, focal lengths and centre of a view's camera."""
    height, width = view.depth.shape
    (fx, _, cx), (_, fy, cy) = view.K[:2]
    return f"{width}×{height} pixels, focal lengths {fx:.4g}, {fy:.4g} and centre {cx:.4g}, {cy:.4g} px"
