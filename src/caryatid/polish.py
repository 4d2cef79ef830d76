"""The last word on a fit: seen sides where their points lie, all others where the points beside them end."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from caryatid import frames
from caryatid.config import FitConfig
from caryatid.frames import Array
from caryatid.kernels.rims import likeliest_end
from caryatid.refine import NOISE_FLOOR, distances, refine
from caryatid.shapes import Box, Cylinder, Sphere
from caryatid.uncertainty import Uncertainty, estimate

Mask = NDArray[np.bool_]


def polish(
    shape: Box | Cylinder | Sphere, seen: Mask, points: Array, config: FitConfig
) -> tuple[Box | Cylinder | Sphere, Uncertainty]:
    """Refine a fitted shape without the pulls that the search for it needs, and say how sure it is.

    The sides that points bear out (`seen`) are refined by least squares alone, the others out of the way:
    neither the pull on the extents nor points beyond a rim shift them. Then each unseen side is put where the
    points on the faces beside it end: at the likeliest end of an even density blurred by the fit's own noise,
    which neither a trimmed share nor the spread of the noise biases. A side without such points stays.

    Args:
        shape: As found by the search, in the points' frame.
        seen: Which sides (6,) points bear out.
        points: (N, 3) [m].
        config: Limits and thresholds.
    """
    opened = refine(
        _opened(shape, seen, config), points, steps=config.steps, min_extent=config.min_extent, shrink=0.0
    )
    absolute = np.abs(distances(opened, points)[0])
    near = absolute < config.threshold
    sigma = max(1.4826 * float(np.median(absolute[near])), NOISE_FLOOR) if near.any() else config.threshold
    hidden = np.full(6, config.max_extent / np.sqrt(12.0))
    closed = opened
    if not (isinstance(opened, Sphere) or isinstance(shape, Sphere)):
        closed, hidden = _closed(opened, shape, seen, points, sigma, config)
    if closed.extents.max() > config.max_extent or not near.any():
        closed = shape
    return closed, estimate(opened, seen, hidden, points, sigma, config)


def _opened(shape: Box | Cylinder | Sphere, seen: Mask, config: FitConfig) -> Box | Cylinder | Sphere:
    """Move the unseen sides out of the way."""
    if isinstance(shape, Sphere):
        return shape
    by = np.where(seen, 0.0, config.opening)
    radius = 0.0
    if isinstance(shape, Cylinder):
        radius = 0.0 if seen[:4].any() else config.opening
        by[:4] = 0.0
    return _resized(shape, -shape.extents / 2.0 - by[0::2], shape.extents / 2.0 + by[1::2], radius)


def _closed(
    opened: Box | Cylinder,
    shape: Box | Cylinder,
    seen: Mask,
    points: Array,
    sigma: float,
    config: FitConfig,
) -> tuple[Box | Cylinder, Array]:
    """Put unseen sides where the points end, or back where they were; with their deviation (6,) [m]."""
    T_object_world = frames.invert(opened.T_world_object)
    local = frames.transform(T_object_world, points)
    before = frames.transform(T_object_world, shape.T_world_object[:3, 3])
    ends = np.stack([-opened.extents, opened.extents], axis=1) / 2.0
    hidden = np.full(6, config.max_extent / np.sqrt(12.0))
    margin = config.face_width * sigma
    radius = 0.0
    if isinstance(opened, Cylinder):
        reach = np.hypot(local[:, 0], local[:, 1])
        if not seen[:4].any():
            on_cap = np.abs(np.abs(local[:, 2]) - ends[2, 1]) < margin
            rim = _end(reach[on_cap], sigma, config, growing=True)
            radius = (shape.extents[0] / 2.0 if rim is None else rim[0]) - opened.radius
            hidden[:4] = hidden[:4] if rim is None else rim[1]
        beside = {2: np.abs(reach - opened.radius) < margin}
    else:
        gap = np.abs(local) - opened.extents / 2.0
        beside = {a: np.abs(np.delete(gap, a, axis=1).max(axis=1)) < margin for a in range(3)}
    for axis, on_face in beside.items():
        for side, sign in enumerate((-1.0, 1.0)):
            if seen[2 * axis + side]:
                continue
            rim = _end(sign * local[on_face, axis], sigma, config, growing=False)
            ends[axis, side] = before[axis] + sign * shape.extents[axis] / 2.0
            if rim is not None:
                ends[axis, side], hidden[2 * axis + side] = sign * rim[0], rim[1]
        short = max(config.min_extent - float(ends[axis, 1] - ends[axis, 0]), 0.0)
        ends[axis] += (-short, 0.0) if seen[2 * axis + 1] else (0.0, short)
    return _resized(opened, ends[:, 0], ends[:, 1], radius), hidden


def _end(coordinates: Array, sigma: float, config: FitConfig, *, growing: bool) -> tuple[float, float] | None:
    """Upper end [m] of the points (N,) and its standard deviation [m], or None where too few tell."""
    if len(coordinates) < config.min_points:
        return None
    start = float(np.quantile(coordinates, 1.0 - config.trim))
    span = start - (0.0 if growing else float(np.quantile(coordinates, config.trim)))
    window = max(4.0 * sigma, 0.1 * span)
    end, deviation = likeliest_end(
        np.ascontiguousarray(coordinates), start, sigma, window, growing, config.stray
    )
    return float(end), float(np.hypot(deviation * np.sqrt(config.correlated), config.rim))


def _resized(shape: Box | Cylinder, low: Array, high: Array, radius: float) -> Box | Cylinder:
    """The shape between these sides (3,) [m] in its own frame; a cylinder's radius grown by `radius` [m]."""
    T = shape.T_world_object
    if isinstance(shape, Cylinder):
        middle = np.array([0.0, 0.0, (low[2] + high[2]) / 2.0])
        moved = frames.rigid(T[:3, :3], frames.transform(T, middle))
        return Cylinder(moved, shape.radius + radius, float(high[2] - low[2]))
    return Box(frames.rigid(T[:3, :3], frames.transform(T, (low + high) / 2.0)), high - low)
