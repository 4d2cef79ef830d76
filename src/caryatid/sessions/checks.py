"""Which views a session refuses: another camera, or an implausible one; a pose that cannot be right."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.scene import Scene
from caryatid.sensing.views import View


def check_view(view: View, scene: Scene, first: View | None) -> None:
    """Refuse a view that cannot belong to a session with this scene and this first view, if there is one.

    Raises:
        InputError: Its camera is implausible, pose or depth are in other units than metres, its camera or
            size differ from the first view's, labels are missing or unexpected, or the pose cannot be right.
    """
    _check_camera(view, first, scene.config.session.max_coordinate)
    if scene.segmentation == "labels" and view.labels is None:
        remedy = "give a label image, or a session with --segmentation auto"
        raise InputError(view.name, "has no labels", remedy)
    if scene.segmentation is None and first is not None and (first.labels is None) != (view.labels is None):
        reason = f"has {'no ' if view.labels is None else ''}labels, unlike the views so far"
        raise InputError(view.name, reason, "give them for every view, or for none")
    wrong = _wrong_pose(view, scene)
    if wrong is not None:
        convention = "p_world = T_world_camera @ p_camera, in metres, in the frame of the first view"
        raise InputError(
            view.name, f"its pose cannot be right, {wrong}", f"check T_world_camera: {convention}"
        )


def _check_camera(view: View, first: View | None, max_coordinate: float) -> None:
    height, width = view.depth.shape
    (fx, _, cx), (_, fy, cy) = view.K[:2]
    pinhole = np.allclose(view.K, [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], atol=1e-3 * fx)
    # Focal lengths of 0.05 and 50 image widths are 168° and 1° of view.
    wide = min(fx, fy) >= 0.05 * width and max(fx, fy) <= 50.0 * width
    if not (pinhole and wide and -width <= cx <= 2 * width and -height <= cy <= 2 * height):
        remedy = "give [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels of this image"
        raise InputError(view.name, f"K cannot be right for a camera with {_described(view)}", remedy)
    if first is not None:
        same_size = view.depth.shape == first.depth.shape
        if not same_size or not np.allclose(view.K, first.K, atol=1e-3 * float(first.K[0, 0])):
            reason = f"its camera has {_described(view)}, that of the views so far has {_described(first)}"
            raise InputError(view.name, reason, "use the same camera, or a new session")
    far = float(np.abs(view.pose[:3, 3]).max())
    if far > max_coordinate:
        reason = f"the camera is {far:.4g} m from the world's origin"
        raise InputError(view.name, reason, "give T_world_camera in metres")
    if float(view.depth.max()) > max_coordinate:
        raise InputError(view.name, f"holds depths of {view.depth.max():.4g} m", "give depth in metres")


def _wrong_pose(view: View, scene: Scene) -> str | None:
    """Why a pose cannot be right, given the scene; nothing is known of that before the first view.

    A camera below the table's plane does not see its top. Of what a view shows around the table, a share of
    at least `session.common` must lie where earlier views saw something, within the largest error that
    registration corrects: the table does not move. Where less does, the pose has jumped, or is the inverse of
    the right one.
    """
    surface, voxels, config = scene.surface, scene.voxels, scene.config
    if surface is None or voxels is None:
        return None
    eye_world = view.pose[:3, 3]
    height = float(surface.height(eye_world))
    if height <= 0.0:
        return f"the camera would be {-height:.2f} m below the table top"
    # About 4000 points, evenly over the image: shares are right to 1 %.
    stride = max(1, int(np.sqrt(view.depth.size / 4000)))
    points = view.points_camera[stride // 2 :: stride, stride // 2 :: stride].reshape(-1, 3)
    used = (points[:, 2] >= config.cloud.min_depth) & (points[:, 2] <= config.cloud.max_depth)
    points_world = transforms.transform(view.pose, points[used])
    inside = ((points_world >= voxels.origin_world) & (points_world < voxels.end_world)).all(axis=1)
    if not inside.any():
        return "nothing it shows is anywhere near the table"
    points_world = points_world[inside]
    limits = config.registration
    distances = np.linalg.norm(points_world - eye_world, axis=1)
    tolerance = limits.max_translation + np.radians(limits.max_rotation) * distances
    occupied = cKDTree(voxels.centres_world(voxels.occupied.T))
    gap = occupied.query(points_world, distance_upper_bound=float(tolerance.max()))[0]
    common = float((gap <= tolerance).mean())
    if common < config.session.common:
        return f"only {common:.0%} of what it shows is where earlier views saw anything"
    return None


def _described(view: View) -> str:
    height, width = view.depth.shape
    (fx, _, cx), (_, fy, cy) = view.K[:2]
    return f"{width}×{height} pixels, focal lengths {fx:.4g}, {fy:.4g} and centre {cx:.4g}, {cy:.4g} px"
