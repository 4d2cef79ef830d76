"""Automatic segmentation: what stands on the support surface, cut into locally convex parts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from caryatid import frames
from caryatid.clouds import normals_from_depth
from caryatid.config import CloudConfig, FitConfig, SegmentationConfig
from caryatid.convexity import convex_parts, number_by_appearance
from caryatid.frames import Array
from caryatid.kernels.planes import refine_planes
from caryatid.plain_colours import cut_by_colour
from caryatid.rejoining import Samples, rejoin
from caryatid.surface import SupportSurface, find_support_surface
from caryatid.views import Cloud, View

__all__ = ["SupportSurface", "find_support_surface", "on_surface", "segment", "segment_cloud"]

Labels = NDArray[np.int32]

Crop = tuple[slice, slice]

MARGIN = 16
"""Pixels beyond the foreground that windows and gaps may look at [px]."""

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
    view: View,
    surface: SupportSurface,
    config: SegmentationConfig,
    clouds: CloudConfig | None = None,
    fit: FitConfig | None = None,
    rng: np.random.Generator | None = None,
) -> Labels:
    """Cut one view into the parts that stand on the support surface.

    Args:
        view: The view; without a pose, the surface is in the camera frame.
        surface: The support surface.
        config: Sampling, sizes and angles.
        clouds: Working range and normals.
        fit: Limits of the shapes that parts of one object are rejoined by.
        rng: Draws the samples of their fits; without it nothing is rejoined.

    Returns:
        Label image (H, W): parts 1 … n, 0 = nothing and the surface itself.
    """
    clouds = clouds or CloudConfig()
    T = np.eye(4) if view.T_world_camera is None else view.T_world_camera
    in_range = (view.depth >= clouds.min_depth) & (view.depth <= clouds.max_depth)
    foreground = np.zeros(view.depth.shape, dtype=bool)
    foreground[in_range] = on_surface(frames.transform(T, view.points_camera[in_range]), surface, config)

    labels = np.zeros(view.depth.shape, dtype=np.int32)
    if foreground.any():
        crop = _around(foreground, config.stride)
        labels[crop] = _parts(_cropped(view, crop), foreground[crop], surface, config, clouds, fit, rng)
    return labels


def _around(mask: NDArray[np.bool_], stride: int) -> Crop:
    """Rows and columns of a mask with a margin, starting on the sampling grid."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    top, left = (max(0, int(i[0]) - MARGIN) // stride * stride for i in (rows, columns))
    return slice(top, int(rows[-1]) + MARGIN + 1), slice(left, int(columns[-1]) + MARGIN + 1)


def _cropped(view: View, crop: Crop) -> View:
    """Cut a window out of a view."""
    K = view.K.copy()
    K[0, 2] -= crop[1].start
    K[1, 2] -= crop[0].start
    rgb = None if view.rgb is None else view.rgb[crop]
    normals = None if view.normals_camera is None else view.normals_camera[crop]
    return replace(view, depth=view.depth[crop], K=K, rgb=rgb, labels=None, normals_camera=normals)


def _parts(
    view: View,
    foreground: NDArray[np.bool_],
    surface: SupportSurface,
    config: SegmentationConfig,
    clouds: CloudConfig,
    fit: FitConfig | None,
    rng: np.random.Generator | None,
) -> Labels:
    """Cut the foreground (H, W) of a view; arguments as of `segment`."""
    width = config.normal_size * view.K[0, 0] / float(np.median(view.depth[foreground]))
    window = 2 * int(np.clip(np.floor(width / 2.0), *NORMAL_RADIUS)) + 1
    normals_image = normals_from_depth(view, replace(clouds, normal_window=window))
    grid = (slice(None, None, config.stride),) * 2
    points_camera, normals = view.points_camera[grid], normals_image[grid].astype(np.float64)
    sampled = foreground[grid] & (np.abs(normals).max(axis=-1) > 0.0)
    if view.normals_camera is None:
        points_camera, normals = _evened(view, sampled, points_camera, normals, config)
    edges, steps = _grid_edges(sampled, points_camera, normals, config)
    coarse = np.zeros(sampled.shape, dtype=np.int32)
    coarse[sampled] = convex_parts(points_camera[sampled], normals[sampled], edges, config, steps)
    coarse = _without_slivers(coarse)
    if view.rgb is not None:
        coarse = cut_by_colour(coarse, view.rgb[grid], config)
    if rng is not None:
        K = np.diag([1.0 / config.stride, 1.0 / config.stride, 1.0]) @ view.K
        T = np.eye(4) if view.T_world_camera is None else view.T_world_camera
        height = surface.height(frames.transform(T, points_camera))
        rgb = None if view.rgb is None else view.rgb[grid]
        samples = Samples(coarse, points_camera, normals, height, view.depth[grid], K, rgb)
        coarse = rejoin(samples, config, fit or FitConfig(), rng)
        coarse = number_by_appearance(np.where(coarse > 0, coarse, -1).ravel()).reshape(coarse.shape)
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


def _evened(
    view: View, sampled: NDArray[np.bool_], points: Array, normals: Array, config: SegmentationConfig
) -> tuple[Array, Array]:
    """Points and normals of the samples from their tangent planes refitted over a wider window."""
    pixels = np.argwhere(sampled) * config.stride
    p, n = points[sampled], normals[sampled]
    rays = p / p[:, 2:]
    focal = np.array([view.K[0, 0], view.K[1, 1]])
    slope = n / np.einsum("ij,ij->i", n, p)[:, None]
    inverse_depth = np.zeros_like(view.depth)
    np.divide(np.float32(1.0), view.depth, out=inverse_depth, where=view.depth > 0.0)
    planes = np.concatenate([1.0 / p[:, 2:], slope[:, :2] / focal], axis=-1)
    planes = refine_planes(inverse_depth, pixels, planes, config.plane_radius, config.plane_tolerance, 2)
    points, normals = points.copy(), normals.copy()
    a, b = (planes[:, 1:] * focal).T
    towards = -np.stack([a, b, planes[:, 0] - a * rays[:, 0] - b * rays[:, 1]], axis=-1)
    points[sampled], normals[sampled] = rays / planes[:, :1], frames.unit(towards)
    return points, normals


def _grid_edges(
    sampled: NDArray[np.bool_], points: Array, normals: Array, config: SegmentationConfig
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pairs (E, 2) of samples that are neighbours in the image, diagonals too: on one surface, and at a step.

    There is a step where neither sample's inverse depth lies near the other's tangent plane: unlike the bare
    difference this does not grow on steep surfaces. Steps are also looked for across short gaps without
    readings, which sensors leave there.
    """
    height, width = sampled.shape
    number = np.cumsum(sampled).reshape(sampled.shape) - 1
    inverse_depth = np.where(sampled, 1.0 / np.where(sampled, points[..., 2], 1.0), 0.0)
    rays = points * inverse_depth[..., None]
    offset = np.einsum("hwi,hwi->hw", normals, points)
    planes = normals / np.where(offset == 0.0, np.inf, offset)[..., None]
    pairs, steps = [], []
    offsets = [(0, 1), (1, 0), (1, 1), (1, -1)]
    offsets += [(k * down, k * right) for k in range(2, config.gap + 1) for down, right in ((0, 1), (1, 0))]
    for down, right in offsets:
        here = (slice(0, height - down), slice(max(-right, 0), width - max(right, 0)))
        there = (slice(down, height), slice(max(right, 0), width + min(right, 0)))
        both = sampled[here] & sampled[there]
        across = max(down, right) > 1
        if across:
            for k in range(1, max(down, right)):
                v, u = k * min(down, 1), k * min(right, 1)
                both &= ~sampled[v : v + height - down, u : u + width - right]
        from_here = np.abs(np.einsum("hwi,hwi->hw", planes[here], rays[there]) - inverse_depth[there])
        from_there = np.abs(np.einsum("hwi,hwi->hw", planes[there], rays[here]) - inverse_depth[here])
        joined = np.minimum(from_here, from_there) <= config.edge_jump
        joined &= np.abs(inverse_depth[here] - inverse_depth[there]) <= config.max_jump
        ends = np.stack([number[here], number[there]], axis=-1)
        if not across:
            pairs.append(ends[both & joined])
        between = points[there] - points[here]
        rise = np.maximum(
            np.einsum("hwi,hwi->hw", normals[here], between),
            -np.einsum("hwi,hwi->hw", normals[there], between),
        )
        steps.append(ends[both & ~joined & (rise > config.min_rise)])
    return np.concatenate(pairs), np.concatenate(steps)


def _without_slivers(coarse: Labels) -> Labels:
    """Take out the parts that are nowhere three samples wide: strips of grazing faces, flying pixels."""
    square = np.ones((3, 3), dtype=bool)
    core = ndimage.minimum_filter(coarse, footprint=square) == ndimage.maximum_filter(
        coarse, footprint=square
    )
    kept = np.unique(coarse[core & (coarse > 0)])
    return number_by_appearance(np.where(np.isin(coarse, kept), coarse, -1).ravel()).reshape(coarse.shape)


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
