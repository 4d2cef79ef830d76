"""What a view must be like to be taken in: a plausible camera, the same as before, where it can have been."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from caryatid.config import Config, SegmentationMethod
from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.scene import Scene
from caryatid.segmentation.support_plane import SupportSurface
from caryatid.sensing.views import View
from caryatid.sensing.voxel_map import VoxelMap

SAME_CAMERA = 1e-3
"""Pinhole matrices that differ by less than this share of the focal length are of the same camera [1]."""
NARROWEST, WIDEST = 50.0, 0.05
"""Focal lengths a depth camera may have, in image widths [1]: 1° and 168° of view."""
SAMPLES = 4000
"""Readings, about, that are looked at to tell whether a pose has jumped [1]; their share is right to 1 %."""


def check_camera(view: View, config: Config) -> None:
    """Refuse a camera that no depth camera is like, and a pose or depth in other units than metres.

    Raises:
        InputError: It is one.
    """
    height, width = view.depth.shape
    fx, fy, cx, cy = view.K[0, 0], view.K[1, 1], view.K[0, 2], view.K[1, 2]
    sound = WIDEST * width <= fx <= NARROWEST * width and WIDEST * width <= fy <= NARROWEST * width
    pinhole = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    if not (sound and -width <= cx <= 2 * width and -height <= cy <= 2 * height):
        raise InputError(
            view.name,
            f"no camera of {width}×{height} pixels has {_told(view.K)}",
            "give K in pixels of this image",
        )
    if not np.allclose(view.K, pinhole, atol=SAME_CAMERA * fx):
        raise InputError(view.name, "K is no pinhole matrix", "give [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    most = config.session.max_coordinate
    far = float(np.abs(view.pose[:3, 3]).max())
    if far > most:
        raise InputError(
            view.name, f"the camera is {far:.4g} m from the world's origin", "give T_world_camera in metres"
        )
    if float(view.depth.max()) > most:
        raise InputError(view.name, f"holds depths of {view.depth.max():.4g} m", "give depth in metres")


def check_same_camera(view: View, K: Array, size: tuple[int, int]) -> None:
    """Refuse a view of another camera than the session's, or of another size.

    Args:
        view: The view.
        K: Pinhole matrix (3, 3) of the session's first view.
        size: Its height and width [px].

    Raises:
        InputError: It is of another.
    """
    if view.depth.shape != size:
        (height, width), (h, w) = view.depth.shape, size
        raise InputError(
            view.name,
            f"is {width}×{height}, the views so far are {w}×{h}",
            "use the same camera, or a new session",
        )
    if not np.allclose(view.K, K, atol=SAME_CAMERA * float(K[0, 0])):
        raise InputError(
            view.name,
            f"its camera has {_told(view.K)}, that of the views so far has {_told(K)}",
            "use the same camera, or a new session",
        )


def check_labels(view: View, segmentation: SegmentationMethod | None, before: bool | None) -> None:
    """Refuse a view without labels where they are demanded, or where the views so far have been otherwise.

    Args:
        view: The view.
        segmentation: Where parts come from; None = labels where the first view had them.
        before: Whether the views so far had labels; None = there are none.

    Raises:
        InputError: Labels are missing, or there are some where there were none.
    """
    given = view.labels is not None
    if segmentation == "labels" and not given:
        raise InputError(
            view.name, "has no labels", "give a label image, or a session with --segmentation auto"
        )
    if segmentation is None and before is not None and before != given:
        said = ("has labels", "have none") if given else ("has no labels", "have some")
        raise InputError(
            view.name, f"{said[0]}, the views so far {said[1]}", "give them for every view, or for none"
        )


def check_pose(view: View, scene: Scene) -> None:
    """Refuse a pose that cannot be right, given what is known.

    A camera under the table's plane does not see its top, and one farther from the scene than depth is used
    shows nothing of it. Of what a view shows around the table, `session.common` at least has to lie where
    earlier views saw something, give or take the greatest error that registration puts right: the table does
    not move. Where less does, the pose has jumped, or is the inverse of what it ought to be.

    Args:
        view: A view with a pose.
        scene: What is known; before the first view nothing is.

    Raises:
        InputError: The pose cannot be right.
    """
    surface, voxels, sphere = scene.surface, scene.voxels, scene.sphere
    if surface is None or voxels is None or sphere is None:
        return
    eye_world, config = view.pose[:3, 3], scene.config
    _check_place(view, surface, config.cloud.max_depth + _reach(voxels))
    points = _points(view, config.cloud.min_depth, config.cloud.max_depth)
    inside = ((points >= voxels.origin_world) & (points < voxels.end_world)).all(axis=1)
    points = points[inside]
    if len(points) == 0:
        raise _jumped(view, "nothing it shows is anywhere near the table")
    limits = config.registration
    away = np.linalg.norm(points - eye_world, axis=1)
    tolerance = limits.max_translation + np.radians(limits.max_rotation) * away
    seen_world = voxels.centres_world(voxels.occupied.T)
    gap = cKDTree(seen_world).query(points, distance_upper_bound=float(tolerance.max()))[0]
    common = float((gap <= tolerance).mean())
    if common < config.session.common:
        raise _jumped(view, f"only {common:.0%} of what it shows is where earlier views saw anything")


def _check_place(view: View, surface: SupportSurface, most: float) -> None:
    eye_world = view.pose[:3, 3]
    height = float(surface.height(eye_world))
    if height <= 0.0:
        raise _jumped(view, f"the camera would be {-height:.2f} m below the table top")
    away = float(np.linalg.norm(eye_world - surface.point_world))
    if away > most:
        raise _jumped(view, f"the camera would be {away:.2f} m from the table, too far to see it")


def _jumped(view: View, reason: str) -> InputError:
    remedy = (
        "check T_world_camera: p_world = T_world_camera @ p_camera, in metres, in the frame of the first view"
    )
    return InputError(view.name, f"its pose cannot be right, {reason}", remedy)


def _told(K: Array) -> str:
    return f"focal lengths {K[0, 0]:.4g}, {K[1, 1]:.4g} and centre {K[0, 2]:.4g}, {K[1, 2]:.4g} px"


def _reach(voxels: VoxelMap) -> float:
    """Half the diagonal [m] of the map's ground."""
    size = voxels.end_world - voxels.origin_world
    return float(np.hypot(size[0], size[1]) / 2.0)


def _points(view: View, nearest: float, farthest: float) -> Array:
    """Some of the view's points (N, 3) [m] in the world, evenly over the image."""
    stride = max(1, int(np.sqrt(view.depth.size / SAMPLES)))
    picked = view.points_camera[stride // 2 :: stride, stride // 2 :: stride].reshape(-1, 3)
    within = (picked[:, 2] >= nearest) & (picked[:, 2] <= farthest)
    return transforms.transform(view.pose, picked[within])
