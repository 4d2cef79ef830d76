"""Checks that reject wrong views, or warn of them: by camera, by content, and against earlier views."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np
from scipy.ndimage import generate_binary_structure, maximum_filter, minimum_filter

from caryatid.config import Config, SurfaceConfig
from caryatid.errors import WrongViewError
from caryatid.geometry.transforms import Array
from caryatid.segmentation.support_plane import SupportSurface
from caryatid.sensing.views import Cloud, View
from caryatid.sensing.voxel_map import VoxelMap

log = logging.getLogger(__name__)

COARSER = 4
"""Edge of the cells in which views are compared [voxels]; wider than the point spacing of small images."""


def check_range(view: View, config: Config) -> None:
    """Warn of a surface as large as an object that is too near for the camera's range."""
    near = view.depth[(view.depth > 0.0) & (view.depth < config.cloud.min_depth)]
    if ((near / view.K[0, 0]) ** 2).sum() >= config.segmentation.min_area:
        text = "%s: %d readings nearer than cloud.min_depth = %g m are ignored"
        log.warning(text, view.name, len(near), config.cloud.min_depth)


def check_masks(view: View, eye_world: Array | None, surface: SupportSurface, config: Config) -> None:
    """Warn of masks as large as an object with too few readings for a shape, as of transparent objects.

    Args:
        view: The view, with its masks.
        eye_world: Position of its camera (3,) [m].
        surface: The support surface.
        config: All settings.
    """
    assert view.labels is not None
    assert eye_world is not None
    distance = np.linalg.norm(eye_world - surface.point_world)
    enough = config.segmentation.min_area / (distance / view.K[0, 0]) ** 2
    if np.count_nonzero((view.depth <= 0.0) & (view.labels > 0)) < enough - config.fit.min_points:
        return
    # At the borders of masks, sensors often have no reading.
    cross = generate_binary_structure(2, 1)
    least, most = (
        f(view.labels, footprint=cross, mode="constant", cval=-1) for f in (minimum_filter, maximum_filter)
    )
    inner = np.where(least == most, view.labels, 0)
    pixels, readings = np.bincount(inner.ravel()), np.bincount(inner[view.depth > 0.0])
    readings = np.pad(readings, (0, len(pixels) - len(readings)))
    few = readings < np.minimum(pixels, config.fit.min_points)
    lost = np.flatnonzero((pixels >= enough) & few)
    if names := ", ".join(map(str, lost[lost > 0].tolist())):
        log.warning("%s: too few depth readings in mask %s; its object is missed", view.name, names)


def check_size(name: str, surface: SupportSurface, config: SurfaceConfig) -> None:
    """Warn of a support surface that is smaller than a table, such as the side of a box if z is not up."""
    if surface.width < config.min_width:
        remedy = "if it is not the table, show more of the table or use --level"
        log.warning("%s: the support surface is only %.2f m wide; %s", name, surface.width, remedy)


def check_place(
    cloud: Cloud, aligned: bool, surfaces: Sequence[SupportSurface], voxels: VoxelMap, config: Config
) -> None:
    """Reject a view whose camera is below all surfaces, or that does not overlap with earlier views.

    Args:
        cloud: Registered points of the view.
        aligned: Whether registration matched it with earlier views.
        surfaces: The support surfaces, the main one first.
        voxels: The map of earlier views.
        config: All settings.

    Raises:
        WrongViewError: The pose cannot be correct.
    """

    def refused(why: str) -> WrongViewError:
        convention = "p_world = T_world_camera @ p_camera, in metres, in the frame of the first view"
        reason = f"wrong camera pose, {why}"
        return WrongViewError(cloud.name, reason, f"check T_world_camera: {convention}")

    eye_world = cloud.viewpoint_world
    height = 1.0 if eye_world is None else max(float(s.height(eye_world)) for s in surfaces)
    if height <= 0.0:
        raise refused(f"the camera would be {-height:.2f} m below the table top")
    points = cloud.points_world[:: max(1, len(cloud.points_world) // 20_000)]
    voxel = np.floor((points - voxels.origin_world) / voxels.config.size).astype(np.intp)
    within = ((voxel > 0) & (voxel < np.array(voxels.hits.shape) - 1)).all(axis=1)
    if not within.any():
        away = np.linalg.norm(points.mean(axis=0) - surfaces[0].point_world)
        raise refused(f"none of its points are near the table, but {away:.3g} m away")
    seen = np.zeros(np.array(voxels.hits.shape) // COARSER + 1, dtype=np.bool_)
    seen[tuple(voxels.occupied // COARSER)] = True
    common = float(seen[tuple(voxel[within].T // COARSER)].mean())
    if not aligned and common < config.registration.common:
        raise refused(f"only {common:.0%} of its points lie on surfaces of earlier views")
