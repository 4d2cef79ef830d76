"""From views and raw clouds to oriented points: normals, valid readings, thinning."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from caryatid import frames
from caryatid.config import CloudConfig
from caryatid.errors import InputError
from caryatid.frames import Array
from caryatid.kernels.images import LocalSurface, local_surface
from caryatid.kernels.thinning import nearest_to_means
from caryatid.views import View

CHUNK = 100_000
"""Points whose neighbourhoods are held in memory at once [1]; bounds memory, changes no result."""


def normals_from_depth(view: View, config: CloudConfig) -> NDArray[np.float32]:
    """Normals (H, W, 3) of a view in the camera frame, towards the camera, zero where unreliable.

    Given normals (`view.normals_camera`) are passed on.

    Args:
        view: Depth [m] and intrinsics [px]; no pose needed.
        config: Window, working range and depth edges.
    """
    if view.normals_camera is not None:
        return view.normals_camera
    return surface_from_depth(view, config, sharp=False).normals


def surface_from_depth(view: View, config: CloudConfig, *, sharp: bool = True) -> LocalSurface:
    """Smooth a view's depth by local planes that end at creases and depth edges, and measure its noise.

    A plane is linear in inverse depth over the image, and the noise of a structured-light sensor nearly even
    in it. Over 7 × 7 readings it falls to a quarter or less.

    Args:
        view: Depth [m] and intrinsics [px]; no pose needed.
        config: Window, working range and depth edges.
        sharp: Whether creases stay sharp (`local_surface`).
    """
    in_range = (view.depth >= config.min_depth) & (view.depth <= config.max_depth)
    inverse_depth = np.zeros_like(view.depth)
    np.divide(np.float32(1.0), view.depth, out=inverse_depth, where=in_range)
    radius = config.normal_window // 2
    if in_range.any():
        width = config.normal_size * view.K[0, 0] / float(np.median(view.depth[in_range]))
        radius = min(radius, max(1, round((width - 1.0) / 2.0)))
    return local_surface(inverse_depth, view.K, radius, config.edge_jump, config.max_slope, sharp=sharp)


def oriented_points(
    view: View, config: CloudConfig, stride: int = 1
) -> tuple[Array, Array, NDArray[np.intp]]:
    """Oriented points of a view: the readings in working range that have a normal, smoothed by local planes.

    A view with normals of its own (`view.normals_camera`) is taken as exact.

    Args:
        view: The view; without a pose, "world" below is the camera frame.
        config: Working range and normal estimation.
        stride: Take every stride-th row and column [px].

    Returns:
        Points (N, 3) [m] and unit normals (N, 3) in the world frame, and the flat pixel index (N,) of each.
    """
    normals, depth = view.normals_camera, view.depth
    if normals is None:
        surface = surface_from_depth(view, config)
        normals = surface.normals
        known = surface.inverse_depth > 0.0
        depth = np.where(known, 1.0 / np.where(known, surface.inverse_depth, 1.0), 0.0)
    keep = np.zeros(view.depth.shape, dtype=bool)
    sampled = view.depth[::stride, ::stride]
    keep[::stride, ::stride] = (sampled >= config.min_depth) & (sampled <= config.max_depth)
    pixels = np.flatnonzero(keep)
    normals_camera = normals.reshape(-1, 3)[pixels].astype(np.float64)
    oriented = np.einsum("ij,ij->i", normals_camera, normals_camera) > 0.5
    pixels, normals_camera = pixels[oriented], normals_camera[oriented]
    points_camera = view.points_camera.reshape(-1, 3)[pixels]
    points_camera = points_camera * (depth.ravel()[pixels] / view.depth.ravel()[pixels])[:, None]
    if view.T_world_camera is None:
        return points_camera, normals_camera, pixels
    T = view.T_world_camera
    return frames.transform(T, points_camera), frames.rotate(T, normals_camera), pixels


def estimate_normals(points: Array, viewpoint: Array, neighbours: int) -> Array:
    """Normals of an unorganised cloud: the direction of least spread among each point's neighbours.

    Where the neighbours lie on one line, or on one spot, the normal points straight at the viewpoint.

    Args:
        points: (N, 3) [m].
        viewpoint: Where the sensor was (3,) [m], in the points' frame; normals point to its side.
        neighbours: How many nearest points, the point itself included, a normal is estimated from.

    Returns:
        Unit normals (N, 3).

    Raises:
        InputError: Points are not (N, 3) and finite.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise InputError(
            "points", f"shape {points.shape} with NaN or not (N, 3)", "give finite points (N, 3) [m]"
        )
    normals = np.zeros_like(points)
    if len(points) == 0:
        return normals
    tree = cKDTree(points)
    count = min(max(neighbours, 1), len(points))
    for start in range(0, len(points), CHUNK):
        part = slice(start, start + CHUNK)
        _, index = tree.query(points[part], k=count)
        offsets = points[index.reshape(-1, count)] - points[part, None, :]
        offsets -= offsets.mean(axis=1, keepdims=True)
        normals[part] = _least_direction(np.einsum("nki,nkj->nij", offsets, offsets))
    towards = frames.unit(np.asarray(viewpoint, dtype=np.float64) - points)
    degenerate = np.einsum("ij,ij->i", normals, normals) < 0.5
    normals[degenerate] = towards[degenerate]
    away = np.einsum("ij,ij->i", normals, towards) < 0.0
    normals[away] *= -1.0
    return normals


def thin(points: Array, voxel: float) -> NDArray[np.intp]:
    """Pick one of the points in each occupied voxel: the one nearest to the mean of its voxel.

    Args:
        points: (N, 3) [m].
        voxel: Edge length of a voxel [m]; the grid starts at the world's origin.

    Returns:
        Indices (M,), ascending.

    Raises:
        InputError: The voxel's size is not positive.
    """
    if not voxel > 0.0:
        raise InputError("thin", f"voxel size {voxel:g} is not positive", "give metres above zero")
    return np.flatnonzero(nearest_to_means(np.ascontiguousarray(points, dtype=np.float64), voxel))


def _least_direction(covariance: Array) -> Array:
    """Unit eigenvector (N, 3) of the smallest eigenvalue of (N, 3, 3); zero where it is not unique."""
    values, vectors = np.linalg.eigh(covariance)
    flat = values[:, 1] > 1e-6 * np.maximum(values[:, 2], 1e-18)
    return np.where(flat[:, None], vectors[:, :, 0], 0.0)
