"""From views and raw clouds to oriented points: normals, valid readings, thinning."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from caryatid.config import CloudConfig
from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.points import most_central
from caryatid.geometry.transforms import Array
from caryatid.sensing.local_planes import LocalSurface, local_surface
from caryatid.sensing.views import View

CHUNK = 100_000
"""Points whose neighbourhoods are held in memory at once [1]; bounds memory, changes no result."""

SPARSE = 4
"""Every fourth row and column of an image give its median depth [px]."""


def surface_from_depth(
    view: View, config: CloudConfig, *, among: NDArray[np.bool_] | None = None
) -> LocalSurface:
    """Smooth a view's depth by local planes that end at creases and depth edges, and measure its noise.

    A plane is linear in inverse depth over the image, and the noise of a structured-light sensor nearly even
    in it. Over 7 × 7 readings it falls to a quarter or less.

    Args:
        view: Depth [m] and intrinsics [px]; no pose needed.
        config: Window, working range and depth edges.
        among: Which readings (H, W) to take, or None for all of them.
    """
    inverse_depth, radius = _inverse_depth(view, config)
    if among is not None:
        inverse_depth[~among] = 0.0
    return local_surface(inverse_depth, radius, config.edge_jump, config.max_slope)


def oriented_points(
    view: View, config: CloudConfig, stride: int = 1, *, among: NDArray[np.bool_] | None = None
) -> tuple[Array, Array, NDArray[np.intp]]:
    """Oriented points of a view: the readings in working range that have a normal, smoothed by local planes.

    A view with normals of its own (`view.normals_camera`) is taken as exact.

    Args:
        view: The view; without a pose, "world" below is the camera frame.
        config: Working range and normal estimation.
        stride: Take every stride-th row and column [px].
        among: Which readings (H, W) to take, or None for all of them.

    Returns:
        Points (N, 3) [m] and unit normals (N, 3) in the world frame, and the flat pixel index (N,) of each.
    """
    T = np.eye(4) if view.T_world_camera is None else view.T_world_camera
    if view.normals_camera is None:
        surface = surface_from_depth(view, config, among=among)
        pixels = _strided(surface.planes[2] > 0.0, stride)
        return *surface.oriented(pixels, view.K, T), pixels
    given = view.normals_camera
    kept = _in_range(view, config) & (np.einsum("hwi,hwi->hw", given, given) > 0.5)
    pixels = _strided(kept if among is None else kept & among, stride)
    row, column = np.divmod(pixels, view.depth.shape[1])
    z = np.take(view.depth, pixels).astype(np.float64)
    x, y = (column - view.K[0, 2]) / view.K[0, 0] * z, (row - view.K[1, 2]) / view.K[1, 1] * z
    normals_camera = np.take(given.reshape(-1, 3), pixels, axis=0).astype(np.float64)
    return transforms.transform(T, np.stack([x, y, z], axis=-1)), transforms.rotate(T, normals_camera), pixels


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
    towards = transforms.unit(np.asarray(viewpoint, dtype=np.float64) - points)
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
    points = np.asarray(points, dtype=np.float64)
    return most_central(points, np.zeros(len(points), dtype=np.int32), np.array([voxel]))


def _in_range(view: View, config: CloudConfig) -> NDArray[np.bool_]:
    return (view.depth >= config.min_depth) & (view.depth <= config.max_depth)


def _strided(mask: NDArray[np.bool_], stride: int) -> NDArray[np.intp]:
    """Flat indices of the pixels of a mask (H, W) in every stride-th row and column."""
    sampled = np.zeros_like(mask)
    sampled[::stride, ::stride] = mask[::stride, ::stride]
    return np.flatnonzero(sampled)


def _inverse_depth(view: View, config: CloudConfig) -> tuple[NDArray[np.float32], int]:
    """1/z (H, W) [1/m] of the readings in range, else 0, and the radius [px] of their windows."""
    inverse_depth = np.divide(
        np.float32(1.0), view.depth, out=np.zeros_like(view.depth), where=_in_range(view, config)
    )
    radius = config.normal_window // 2
    readings = view.depth[::SPARSE, ::SPARSE][inverse_depth[::SPARSE, ::SPARSE] > 0.0]
    if len(readings) > 0:
        width = config.normal_size * view.K[0, 0] / float(np.median(readings))
        radius = min(radius, max(1, round((width - 1.0) / 2.0)))
    return inverse_depth, radius


def _least_direction(covariance: Array) -> Array:
    """Unit eigenvector (N, 3) of the smallest eigenvalue of (N, 3, 3); zero where it is not unique."""
    values, vectors = np.linalg.eigh(covariance)
    flat = values[:, 1] > 1e-6 * np.maximum(values[:, 2], 1e-18)
    return np.where(flat[:, None], vectors[:, :, 0], 0.0)
