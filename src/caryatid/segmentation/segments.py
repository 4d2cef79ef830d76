"""Automatic segmentation: what stands on the support surface, cut into locally convex parts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from caryatid.config import CloudConfig, FitConfig, SegmentationConfig
from caryatid.geometry.transforms import Array
from caryatid.segmentation.colour_cut import cut_by_colour
from caryatid.segmentation.lccp import convex_parts, number_by_appearance
from caryatid.segmentation.occlusion_merge import rejoin
from caryatid.segmentation.sample_grid import grid_edges, spread_labels, wide_parts
from caryatid.segmentation.samples import Samples, find_foreground, take_samples
from caryatid.segmentation.support_plane import SupportSurface, find_support_surface
from caryatid.sensing.views import Cloud, View

__all__ = ["SupportSurface", "find_support_surface", "on_surface", "segment", "segment_cloud"]

Labels = NDArray[np.int32]


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
    labels = np.zeros(view.depth.shape, dtype=np.int32)
    foreground = find_foreground(view, surface, config, clouds)
    if not foreground.pixels.any():
        return labels
    samples = take_samples(view, foreground, config, clouds)
    part = _parts(samples, config)
    if rng is not None:
        part = number_by_appearance(rejoin(samples, part, config, fit or FitConfig(), rng) - 1)
    labels[samples.grid] = samples.image(part)
    around = tuple(slice(side.start, side.stop) for side in samples.grid)
    labels[around] = spread_labels(
        labels[around],
        foreground.pixels[around],
        view.depth[around],
        2.0 * config.edge_jump,
        2 * config.stride,
    )
    return labels


def _parts(samples: Samples, config: SegmentationConfig) -> Labels:
    """Cut the samples into parts (N,), 0 = none, where they are concave and where their colours say so."""
    points, normals = samples.points_camera, samples.normals_camera
    jumps = config.edge_jump, config.max_jump, config.min_rise
    edges, steps = grid_edges(samples.places, points, normals, *jumps, config.gap)
    part = convex_parts(points, normals, edges, config, steps)
    wide = wide_parts(samples.image(part))
    part = number_by_appearance(np.where(wide[part], part, 0) - 1)
    if samples.rgb is None:
        return part
    return cut_by_colour(samples.image(part), samples.rgb, config)[samples.places]


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
