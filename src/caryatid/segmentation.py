"""Automatic segmentation: what stands on the support surface, cut into locally convex parts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from caryatid import frames
from caryatid.clouds import normals_from_depth
from caryatid.config import CloudConfig, SegmentationConfig
from caryatid.convexity import convex_parts
from caryatid.frames import Array
from caryatid.surface import SupportSurface, find_support_surface
from caryatid.views import Cloud, View

__all__ = ["SupportSurface", "find_support_surface", "on_surface", "segment", "segment_cloud"]

Labels = NDArray[np.int32]

NORMAL_RADIUS = (2, 6)
"""Least and greatest radius of the window for normals [px]: fewer leave the noise, more cost time."""


def on_surface(points_world: Array, surface: SupportSurface, config: SegmentationConfig) -> NDArray[np.bool_]:
    """Which points (N, 3) [m] belong to what stands on the support surface: above it, within its outline."""
    height = surface.height(points_world)
    kept = (height > config.clearance) & (height < config.max_height)
    index = np.flatnonzero(kept)
    kept[index] = surface.distance_outside(points_world[index]) <= config.margin
    return kept


def segment(
    view: View, surface: SupportSurface, config: SegmentationConfig, clouds: CloudConfig | None = None
) -> Labels:
    """Cut one view into the parts that stand on the support surface.

    Args:
        view: The view; without a pose, the surface is in the camera frame.
        surface: The support surface.
        config: Sampling, sizes and angles.
        clouds: Working range and normals.

    Returns:
        Label image (H, W): parts 1 … n, 0 = nothing and the surface itself.
    """
    clouds = clouds or CloudConfig()
    T = np.eye(4) if view.T_world_camera is None else view.T_world_camera
    in_range = (view.depth >= clouds.min_depth) & (view.depth <= clouds.max_depth)
    foreground = np.zeros(view.depth.shape, dtype=bool)
    foreground[in_range] = on_surface(frames.transform(T, view.points_camera[in_range]), surface, config)

    if not foreground.any():
        return np.zeros(view.depth.shape, dtype=np.int32)

    width = config.normal_size * view.K[0, 0] / float(np.median(view.depth[foreground]))
    window = 2 * int(np.clip(np.floor(width / 2.0), *NORMAL_RADIUS)) + 1
    normals_image = normals_from_depth(view, replace(clouds, normal_window=window))
    grid = (slice(None, None, config.stride),) * 2
    points_camera, normals = view.points_camera[grid], normals_image[grid].astype(np.float64)
    sampled = foreground[grid] & (np.abs(normals).max(axis=-1) > 0.0)
    edges = _grid_edges(sampled, points_camera, normals, config)
    coarse = np.zeros(sampled.shape, dtype=np.int32)
    coarse[sampled] = convex_parts(points_camera[sampled], normals[sampled], edges, config)
    return _fill(coarse, foreground, view.depth, config)


def segment_cloud(cloud: Cloud, surface: SupportSurface, config: SegmentationConfig) -> Labels:
    """Cut an unorganised cloud into the parts that stand on the support surface.

    Returns:
        Label of each point (N,): parts 1 … n, 0 = nothing and the surface itself.
    """
    labels = np.zeros(len(cloud), dtype=np.int32)
    index = np.flatnonzero(on_surface(cloud.points_world, surface, config))
    if len(index) < 2:
        return labels
    points = cloud.points_world[index]
    count = min(config.neighbours + 1, len(index))
    distance, neighbour = cKDTree(points).query(points, k=count)
    source = np.repeat(np.arange(len(index)), count - 1)
    target, near = neighbour[:, 1:].ravel(), distance[:, 1:].ravel() <= config.reach
    near &= source != target
    low, high = np.minimum(source, target)[near], np.maximum(source, target)[near]
    keys = np.unique(low * len(index) + high)
    edges = np.stack(np.divmod(keys, len(index)), axis=-1)
    labels[index] = convex_parts(points, cloud.normals_world[index], edges, config)
    return labels


def _grid_edges(
    sampled: NDArray[np.bool_], points: Array, normals: Array, config: SegmentationConfig
) -> NDArray[np.intp]:
    """Pairs (E, 2) of samples that are neighbours in the image, diagonals too, with no depth step between.

    There is a step where neither sample's inverse depth lies near the other's tangent plane: unlike the bare
    difference this does not grow on steep surfaces.
    """
    height, width = sampled.shape
    number = np.cumsum(sampled).reshape(sampled.shape) - 1
    inverse_depth = np.where(sampled, 1.0 / np.where(sampled, points[..., 2], 1.0), 0.0)
    rays = points * inverse_depth[..., None]
    offset = np.einsum("hwi,hwi->hw", normals, points)
    planes = normals / np.where(offset == 0.0, np.inf, offset)[..., None]
    pairs = []
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        here = (slice(0, height - down), slice(max(-right, 0), width - max(right, 0)))
        there = (slice(down, height), slice(max(right, 0), width + min(right, 0)))
        from_here = np.abs(np.einsum("hwi,hwi->hw", planes[here], rays[there]) - inverse_depth[there])
        from_there = np.abs(np.einsum("hwi,hwi->hw", planes[there], rays[here]) - inverse_depth[here])
        joined = sampled[here] & sampled[there] & (np.minimum(from_here, from_there) <= config.edge_jump)
        joined &= np.abs(inverse_depth[here] - inverse_depth[there]) <= config.max_jump
        pairs.append(np.stack([number[here][joined], number[there][joined]], axis=-1))
    return np.concatenate(pairs)


def _fill(
    coarse: Labels, foreground: NDArray[np.bool_], depth: NDArray[np.float32], config: SegmentationConfig
) -> Labels:
    """Bring sampled labels to every foreground pixel that lies no depth step from a labelled neighbour."""
    height, width = foreground.shape
    labels = np.zeros((height, width), dtype=np.int32)
    labels[:: config.stride, :: config.stride] = coarse
    for _ in range(2 * config.stride):
        for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            here = (slice(max(-down, 0), height - max(down, 0)), slice(max(-right, 0), width - max(right, 0)))
            there = (slice(max(down, 0), height + min(down, 0)), slice(max(right, 0), width + min(right, 0)))
            taken = (labels[here] == 0) & (labels[there] > 0) & foreground[here]
            jump = 2.0 * config.edge_jump * depth[here] * depth[there]
            taken &= np.abs(depth[here] - depth[there]) <= jump
            labels[here][taken] = labels[there][taken]
    return labels
