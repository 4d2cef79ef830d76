"""Which views a session refuses: another camera, or an implausible one; a pose that cannot be right."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.scene import Scene
from caryatid.sensing.views import View

SAME_CAMERA = 1e-3
"""Pinhole matrices that differ by less than this share of the focal length are of the same camera [1]."""


def check_view(view: View, scene: Scene, first: View | None) -> None:
    """Refuse a view that cannot belong to a session.

    Args:
        view: A view with a pose.
        scene: The scene so far.
        first: The session's first view, or None before it.

    Raises:
        InputError: Its camera is implausible, pose or depth are in other units than metres, its camera or
            size differ from the first view's, labels are missing or unexpected, or the pose cannot be right.
    """
    _check_camera(view, scene.config.session.max_coordinate)
    if first is not None:
        _check_same_camera(view, first)
    _check_labels(view, scene, first)
    _check_pose(view, scene)


def _check_camera(view: View, most: float) -> None:
    height, width = view.depth.shape
    (fx, _, cx), (_, fy, cy) = view.K[:2]
    # Focal lengths of 0.05 and 50 image widths are 168° and 1° of view.
    sound = min(fx, fy) >= 0.05 * width and max(fx, fy) <= 50.0 * width
    if not (sound and -width <= cx <= 2 * width and -height <= cy <= 2 * height):
        reason = f"no camera of {width}×{height} pixels has {_described(view.K)}"
        raise InputError(view.name, reason, "give K in pixels of this image")
    pinhole = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    if not np.allclose(view.K, pinhole, atol=SAME_CAMERA * fx):
        raise InputError(view.name, "K is no pinhole matrix", "give [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    far = float(np.abs(view.pose[:3, 3]).max())
    if far > most:
        reason = f"the camera is {far:.4g} m from the world's origin"
        raise InputError(view.name, reason, "give T_world_camera in metres")
    if float(view.depth.max()) > most:
        raise InputError(view.name, f"holds depths of {view.depth.max():.4g} m", "give depth in metres")


def _check_same_camera(view: View, first: View) -> None:
    remedy = "use the same camera, or a new session"
    if view.depth.shape != first.depth.shape:
        (height, width), (h, w) = view.depth.shape, first.depth.shape
        raise InputError(view.name, f"is {width}×{height}, the views so far are {w}×{h}", remedy)
    if not np.allclose(view.K, first.K, atol=SAME_CAMERA * float(first.K[0, 0])):
        reason = f"its camera has {_described(view.K)}, that of the views so far has {_described(first.K)}"
        raise InputError(view.name, reason, remedy)


def _check_labels(view: View, scene: Scene, first: View | None) -> None:
    if scene.segmentation == "labels" and view.labels is None:
        remedy = "give a label image, or a session with --segmentation auto"
        raise InputError(view.name, "has no labels", remedy)
    if scene.segmentation is None and first is not None and (first.labels is None) != (view.labels is None):
        reason = "has labels, the views so far have none"
        if view.labels is None:
            reason = "has no labels, the views so far have some"
        raise InputError(view.name, reason, "give them for every view, or for none")


def _check_pose(view: View, scene: Scene) -> None:
    """Refuse a pose that cannot be right, given the scene; before the first view none is refused.

    A camera below the table's plane does not see its top, and one farther away than depth is used shows
    nothing of it. Of what a view shows around the table, a share of at least `session.common` must lie where
    earlier views saw something, within the largest error that registration corrects: the table does not
    move. Where less does, the pose has jumped, or is the inverse of the right one.
    """
    surface, voxels = scene.surface, scene.voxels
    if surface is None or voxels is None:
        return
    eye_world, config = view.pose[:3, 3], scene.config
    height = float(surface.height(eye_world))
    if height <= 0.0:
        raise _jumped(view, f"the camera would be {-height:.2f} m below the table top")
    away = float(np.linalg.norm(eye_world - surface.point_world))
    size = voxels.end_world - voxels.origin_world
    if away > config.cloud.max_depth + float(np.hypot(size[0], size[1]) / 2.0):
        raise _jumped(view, f"the camera would be {away:.2f} m from the table, too far to see it")
    points_world = _sampled(view, config.cloud.min_depth, config.cloud.max_depth)
    inside = ((points_world >= voxels.origin_world) & (points_world < voxels.end_world)).all(axis=1)
    points_world = points_world[inside]
    if len(points_world) == 0:
        raise _jumped(view, "nothing it shows is anywhere near the table")
    distances = np.linalg.norm(points_world - eye_world, axis=1)
    limits = config.registration
    tolerance = limits.max_translation + np.radians(limits.max_rotation) * distances
    occupied = cKDTree(voxels.centres_world(voxels.occupied.T))
    gap = occupied.query(points_world, distance_upper_bound=float(tolerance.max()))[0]
    common = float((gap <= tolerance).mean())
    if common < config.session.common:
        raise _jumped(view, f"only {common:.0%} of what it shows is where earlier views saw anything")


def _jumped(view: View, reason: str) -> InputError:
    remedy = (
        "check T_world_camera: p_world = T_world_camera @ p_camera, in metres, in the frame of the first view"
    )
    return InputError(view.name, f"its pose cannot be right, {reason}", remedy)


def _described(K: Array) -> str:
    return f"focal lengths {K[0, 0]:.4g}, {K[1, 1]:.4g} and centre {K[0, 2]:.4g}, {K[1, 2]:.4g} px"


def _sampled(view: View, nearest: float, farthest: float) -> Array:
    """About 4000 of the view's points (N, 3) [m] in the world, evenly over the image: shares right to 1 %."""
    stride = max(1, int(np.sqrt(view.depth.size / 4000)))
    picked = view.points_camera[stride // 2 :: stride, stride // 2 :: stride].reshape(-1, 3)
    within = (picked[:, 2] >= nearest) & (picked[:, 2] <= farthest)
    return transforms.transform(view.pose, picked[within])
