"""The last word on a fit: every seen side where its points lie, every other where points of its neighbours end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from caryatid import frames
from caryatid.config import FitConfig
from caryatid.frames import Array
from caryatid.kernels.rims import likeliest_end
from caryatid.refine import distances, refine
from caryatid.shapes import Box, Cylinder, Sphere

OPEN = 5.0
"""Unseen sides are moved out of the points' way by as many MSAC thresholds."""
ON_FACE = 3.0
"""Points within as many standard deviations of a face's plane are the face's."""


def polish(
    shape: Box | Cylinder | Sphere, seen: NDArray[np.bool_], points: Array, config: FitConfig
) -> Box | Cylinder | Sphere:
    """Refine a fitted shape without the pulls that the search for it needs.

    The sides that points bear out (`seen`) are refined by least squares alone, the others out of the way: neither the pull
    on the extents nor points beyond a rim shift them. Then each unseen side is put where the points on the faces beside
    it end: at the likeliest end of an even density under the fit's own noise, which neither a trimmed share
    nor the spread of the noise biases. A side without such points stays.

    Args:
        shape: As found by the search, in the points' frame.
        seen: Which sides (6,) points bear out.
        points: (N, 3) [m].
        config: Limits and thresholds.
    """
    opened = _opened(shape, seen, config)
    refined = refine(opened, points, steps=config.steps, min_extent=config.min_extent, shrink=0.0)
    if isinstance(refined, Sphere) or isinstance(shape, Sphere):
        return refined
    distance, _ = distances(refined, points)
    near = np.abs(distance) < config.threshold
    if not near.any():
        return shape
    sigma = max(1.4826 * float(np.median(np.abs(distance[near]))), 1e-4)
    return _closed(refined, shape, seen, points, sigma, config)


def _opened(
    shape: Box | Cylinder | Sphere, seen: NDArray[np.bool_], config: FitConfig
) -> Box | Cylinder | Sphere:
    """Move the unseen sides out of the way."""
    if isinstance(shape, Sphere):
        return shape
    by = np.where(seen, 0.0, OPEN * config.threshold)
    radius = 0.0
    if isinstance(shape, Cylinder):
        radius = 0.0 if seen[:4].any() else OPEN * config.threshold
        by[:4] = 0.0
    return _resized(shape, -shape.extents / 2.0 - by[0::2], shape.extents / 2.0 + by[1::2], radius)


def _closed(
    refined: Box | Cylinder,
    shape: Box | Cylinder,
    seen: NDArray[np.bool_],
    points: Array,
    sigma: float,
    config: FitConfig,
) -> Box | Cylinder:
    """Put the unseen sides of a refined shape where the points end, or back to where they were."""
    T = refined.T_world_object
    local = frames.transform(frames.invert(T), points)
    low, high = -refined.extents / 2.0, refined.extents / 2.0
    before = frames.transform(frames.invert(T), shape.T_world_object[:3, 3])
    margin = ON_FACE * sigma
    radius = 0.0
    if isinstance(refined, Cylinder):
        reach = np.hypot(local[:, 0], local[:, 1])
        if not seen[:4].any():
            on_end = np.abs(np.abs(local[:, 2]) - high[2]) < margin
            found = _end(reach[on_end], sigma, config, growing=True)
            radius = (found if found is not None else shape.extents[0] / 2.0) - refined.radius
        beside = {2: np.abs(reach - refined.radius) < margin}
    else:
        gap = np.abs(local) - refined.extents / 2.0
        beside = {
            a: np.abs(np.maximum(gap[:, (a + 1) % 3], gap[:, (a + 2) % 3])) < margin for a in range(3)
        }
    for axis, on_side in beside.items():
        for sign, ends in ((-1.0, low), (1.0, high)):
            if seen[2 * axis + (sign > 0)]:
                continue
            found = _end(sign * local[on_side, axis], sigma, config, growing=False)
            ends[axis] = sign * found if found is not None else before[axis] + sign * shape.extents[axis] / 2
        if high[axis] - low[axis] < config.min_extent:
            fixed = seen[2 * axis + 1]
            low[axis], high[axis] = (
                (high[axis] - config.min_extent, high[axis])
                if fixed
                else (low[axis], low[axis] + config.min_extent)
            )
    return _resized(refined, low, high, radius)


def _end(coordinates: Array, sigma: float, config: FitConfig, *, growing: bool) -> float | None:
    """Upper end [m] of the points (N,), or None where there are too few to tell."""
    if len(coordinates) < config.min_points:
        return None
    start = float(np.quantile(coordinates, 1.0 - config.trim))
    span = start - (0.0 if growing else float(np.quantile(coordinates, config.trim)))
    window = max(4.0 * sigma, 0.1 * span)
    return float(likeliest_end(coordinates, start, sigma, window, growing)[0])


def _resized(shape: Box | Cylinder, low: Array, high: Array, radius: float) -> Box | Cylinder:
    """The shape between these sides (3,) [m] in its own frame; a cylinder's radius grown by `radius` [m]."""
    T = shape.T_world_object
    if isinstance(shape, Cylinder):
        middle = np.array([0.0, 0.0, (low[2] + high[2]) / 2.0])
        moved = frames.rigid(T[:3, :3], frames.transform(T, middle))
        return Cylinder(moved, shape.radius + radius, float(high[2] - low[2]))
    return Box(frames.rigid(T[:3, :3], frames.transform(T, (low + high) / 2.0)), high - low)
