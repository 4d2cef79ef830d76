"""Regions without readings above the support surface that no shadow explains: glass, gloss, black."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from caryatid.config import SegmentationConfig
from caryatid.geometry.transforms import Array
from caryatid.segmentation.support_plane import SupportSurface
from caryatid.sensing.views import View

BASELINE = 0.1
"""Maximum distance of a depth camera's two eyes, or of eye and projector [m]; a Kinect's is 0.075."""
COARSER = 2
"""How much coarser holes are sampled than segments [1]; they are as wide as an object."""


def count_holes(view: View, surface: SupportSurface, config: SegmentationConfig) -> int:
    """Count the regions over the support surface that have no depth and are as wide as an object.

    Places that only one of the sensor's eyes sees have no depth either. Such a shadow lies beside the object
    that casts it, in the same row, and is no wider than the sensor's baseline makes it on the surface.

    Args:
        view: A view with a pose.
        surface: The support surface.
        config: Sampling, and width of the narrowest segment.
    """
    step = COARSER * config.stride
    every = np.s_[::step, ::step]
    K = view.K / np.array([[step], [step], [1.0]])
    depth = view.depth[every]
    ignored = np.zeros(depth.shape, dtype=bool) if view.ignored is None else view.ignored[every]
    v, u = np.indices(depth.shape)
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(depth.shape)], axis=-1)
    # 1/z of the surface; negative above its horizon.
    level: Array = rays @ (surface.normal_world @ view.pose[:3, :3]) / -surface.height(view.pose[:3, 3])
    there = np.divide(1.0, level, out=np.zeros(level.shape), where=level > 0.0)
    on_surface = View(there.astype(np.float32), K, view.pose, ignored=ignored)
    over = surface.pixels_over(on_surface, -config.clearance, config.clearance, 0.0)
    # Ignored pixels count as infinitely near: shadows beside them have any width.
    inverse_depth = np.divide(1.0, depth, out=np.where(ignored, np.inf, 0.0), where=depth > 0.0)
    known = inverse_depth > 0.0
    left = np.maximum.accumulate(np.where(known, u, 0), axis=1)
    right = np.minimum.accumulate(np.where(known, u, depth.shape[1] - 1)[:, ::-1], axis=1)[:, ::-1]
    ends = inverse_depth[v, left], inverse_depth[v, right]
    shadow = BASELINE * K[0, 0] * (np.maximum(*ends) - np.minimum(np.minimum(*ends), level))
    # A gap at the side of the image may be the shadow of something outside.
    hole = over & ~known & (np.minimum(*ends) > 0.0) & (right - left - 1 > shadow)
    parts, count = ndimage.label(hole)
    # Width of the largest circle that certainly fits between the readings around a region [m].
    width = 2.0 * (ndimage.distance_transform_edt(hole) - 1.0) / (K[0, 0] * np.where(hole, level, 1.0))
    return int(np.count_nonzero(ndimage.maximum(width, parts, np.arange(1, count + 1)) >= config.min_width))
