"""Fit a box, a cylinder or a sphere to the oriented points of one object."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from caryatid import frames
from caryatid.config import FitConfig
from caryatid.frames import Array
from caryatid.interior import free_share
from caryatid.kernels.hypotheses import any_within, count_agreeing
from caryatid.polish import polish
from caryatid.ransac import ransac
from caryatid.refine import distances, refine
from caryatid.shape_models import BoxModel, CylinderModel, ShapeModel, SphereModel
from caryatid.shapes import Box, Cylinder, Sphere
from caryatid.uncertainty import Uncertainty
from caryatid.voxels import VoxelMap

Seen = tuple[bool, bool, bool, bool, bool, bool]


@dataclass(frozen=True, eq=False, slots=True)
class Fit:
    """A shape and how well it explains the points.

    Attributes:
        shape: In the points' frame.
        residual: Mean absolute distance of the points to the surface, truncated at the threshold [m].
        inliers: Share of the points within the threshold.
        seen: Which sides (-x, +x, -y, +y, -z, +z of the object) points bear out.
        cost: What model choice compares [m].
        poor: No shape explains the points within the configured residual.
        uncertainty: How far off it may be; of the fit that was chosen only.
    """

    shape: Box | Cylinder | Sphere
    residual: float
    inliers: float
    seen: Seen
    cost: float
    poor: bool
    uncertainty: Uncertainty | None = None


@dataclass(frozen=True, slots=True)
class FitFailure:
    """No shape could be fitted.

    Attributes:
        reason: Why, for a person to read.
    """

    reason: str


def fit(
    points: Array,
    normals: Array,
    *,
    config: FitConfig,
    rng: np.random.Generator,
    space: VoxelMap | None = None,
) -> Fit | FitFailure:
    """Fit the best of box, cylinder and sphere.

    The result does not depend on the frame of the points, only on their order and the generator. Sides
    without points lie where the points of the faces beside them end.

    Args:
        points: (N, 3) [m], in any frame.
        normals: Unit normals (N, 3) towards the sensor.
        config: Limits and thresholds.
        rng: Source of the samples.
        space: What has been seen free, where points are in the world frame: shapes do not fill it.
    """
    fits = candidates(points, normals, config=config, rng=rng)
    if not fits:
        return FitFailure(_failure_reason(len(points), config))
    if space is not None:
        inset = config.free_inset * space.config.size
        fits.sort(key=lambda f: f.cost + config.free_weight * free_share(f.shape, space, inset))
    return _polished(fits[0], points, config)


def _polished(found: Fit, points: Array, config: FitConfig) -> Fit:
    """The fit with its shape refined on more points, and how sure it is."""
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) > config.final_points:
        points = points[np.linspace(0, len(points) - 1, config.final_points).astype(np.intp)]
    origin = points.mean(axis=0)
    centred = np.ascontiguousarray(points - origin)
    away, back = frames.rigid(np.eye(3), -origin), frames.rigid(np.eye(3), origin)
    shape, uncertainty = polish(found.shape.moved(away), np.array(found.seen), centred, config)
    absolute = np.abs(distances(shape, centred)[0])
    residual = float(np.minimum(absolute, config.threshold).mean())
    return replace(
        found,
        shape=shape.moved(back),
        residual=residual,
        inliers=float((absolute < config.threshold).mean()),
        poor=residual > config.max_residual,
        uncertainty=uncertainty,
    )


def candidates(points: Array, normals: Array, *, config: FitConfig, rng: np.random.Generator) -> list[Fit]:
    """Return the best fit of each shape that could be fitted, least cost first (arguments as of `fit`)."""
    keep = np.isfinite(points).all(axis=1) & np.isfinite(normals).all(axis=1)
    points, normals = points[keep], normals[keep]
    if len(points) < config.min_points:
        return []
    if len(points) > config.max_points:
        chosen = np.sort(rng.choice(len(points), config.max_points, replace=False))
        points, normals = points[chosen], normals[chosen]
    origin = points.mean(axis=0)
    centred = np.ascontiguousarray(points - origin)
    fits: list[Fit] = []
    for starts in _starts(centred, normals, config, rng):
        polished = [
            refine(s, centred, steps=config.steps, min_extent=config.min_extent, shrink=config.shrink)
            for s in starts
        ]
        judged = [judge(s, centred, normals, config) for s in polished]
        if judged:
            fits.append(min(judged, key=lambda f: f.cost))
    fits = [replace(f, cost=f.cost + config.bare_weight * bare_share(f, centred, config)) for f in fits]
    back = frames.rigid(np.eye(3), origin)
    return [
        replace(f, shape=f.shape.moved(back))
        for f in sorted(fits, key=lambda f: f.cost)
        if f.shape.extents.max() <= config.max_extent
    ]


def judge(shape: Box | Cylinder | Sphere, points: Array, normals: Array, config: FitConfig) -> Fit:
    """Say how well a shape explains oriented points, and draw in the sides that no point bears out."""
    shape, seen = draw_in(shape, points, normals, config)
    distance, outward = distances(shape, points)
    absolute = np.minimum(np.abs(distance), config.threshold)
    agreement = np.sum(outward * (normals @ shape.T_world_object[:3, :3]), axis=1)
    turned = np.clip(1.0 - agreement, 0.0, 1.0)
    residual = float(absolute.mean())
    size = float(np.mean(shape.extents**2))
    cost = residual + config.normal_weight * float(turned.mean()) + config.size_penalty * size
    inliers = float((np.abs(distance) < config.threshold).mean())
    return Fit(shape, residual, inliers, seen, cost, residual > config.max_residual)


def bare_share(fit: Fit, points: Array, config: FitConfig) -> float:
    """Share of the seen sides' area that has no point near it: a side that was seen should be seen whole."""
    samples, outward = fit.shape.surface(config.bare_spacing)
    local = outward @ fit.shape.T_world_object[:3, :3]
    side = np.argmax(np.abs(local), axis=1)
    side = 2 * side + (local[np.arange(len(local)), side] > 0.0)
    on_seen = np.array(fit.seen)[side]
    if not on_seen.any():
        return 1.0
    return 1.0 - float(any_within(samples[on_seen], points, 2.0 * config.bare_spacing).mean())


def draw_in(
    shape: Box | Cylinder | Sphere, points: Array, normals: Array, config: FitConfig
) -> tuple[Box | Cylinder | Sphere, Seen]:
    """Find the sides that points bear out, and move the others inwards to where the points end."""
    distance, outward = distances(shape, points)
    R = shape.T_world_object[:3, :3]
    agree = (np.abs(distance) < config.threshold) & (np.sum((normals @ R) * outward, axis=1) > 0.5)
    least = max(config.min_points / 3.0, config.side_share * len(points))
    facing = outward[agree]
    counts = np.stack([(facing < -0.7).sum(axis=0), (facing > 0.7).sum(axis=0)], axis=1)
    seen = counts.ravel() >= least
    if not isinstance(shape, Sphere):
        near = points[np.abs(distance) < config.threshold]
        shape = _to_points(shape, near if len(near) else points, seen, config)
    flags = [bool(s) for s in seen]
    return shape, (flags[0], flags[1], flags[2], flags[3], flags[4], flags[5])


def _to_points(
    shape: Box | Cylinder, points: Array, seen: NDArray[np.bool_], config: FitConfig
) -> Box | Cylinder:
    """Move every side that is not seen inwards to the trimmed end of the points."""
    T = shape.T_world_object
    local = (points - T[:3, 3]) @ T[:3, :3]
    low, high = -shape.extents / 2.0, shape.extents / 2.0
    for axis in (2,) if isinstance(shape, Cylinder) else (0, 1, 2):
        if seen[2 * axis] and seen[2 * axis + 1]:
            continue
        start, end = np.quantile(local[:, axis], (config.trim, 1.0 - config.trim))
        if not seen[2 * axis]:
            low[axis] = min(max(low[axis], start), high[axis] - config.min_extent)
        if not seen[2 * axis + 1]:
            high[axis] = max(min(high[axis], end), low[axis] + config.min_extent)
    T_moved = frames.rigid(T[:3, :3], frames.transform(T, (low + high) / 2.0))
    if isinstance(shape, Cylinder):
        return Cylinder(T_moved, shape.radius, float(high[2] - low[2]))
    return Box(T_moved, high - low)


def _starts(
    points: Array, normals: Array, config: FitConfig, rng: np.random.Generator
) -> list[list[Box | Cylinder | Sphere]]:
    """The best hypotheses of each shape, to be refined."""
    models: tuple[ShapeModel, ...] = (
        BoxModel(config.max_extent, config.trim),
        CylinderModel(config.max_radius, config.max_extent, config.trim),
        SphereModel(config.max_radius),
    )
    main = _main_normal(normals)
    starts: list[list[Box | Cylinder | Sphere]] = []
    for model in models:
        ranked = ransac(
            points,
            normals,
            model,
            threshold=config.threshold,
            hypotheses=config.hypotheses,
            confidence=config.confidence,
            keep=config.polish,
            rng=rng,
        )
        samples = np.array([r.sample for r in ranked], dtype=np.intp).reshape(-1, model.sample_size)
        found = model.estimate(samples, points, normals)
        shapes = [model.shape(found, k) for k in range(len(ranked))]
        if isinstance(model, BoxModel):
            shapes += _flat_boxes(points, *main, config)
        if isinstance(model, CylinderModel):
            shapes += _discs(points, *main, config)
        starts.append(shapes)
    return starts


def _flat_boxes(
    points: Array, axis: Array, agree: NDArray[np.bool_], config: FitConfig
) -> list[Box | Cylinder | Sphere]:
    """Boxes for points of one face: the main normal, and the least rectangle around the points along it."""
    x = _across(points, axis)
    y = np.cross(axis, x)
    plane = points @ np.stack([x, y], axis=1)
    angles = np.radians(np.arange(0.0, 90.0, 3.0))
    u = plane @ np.stack([np.cos(angles), np.sin(angles)])
    v = plane @ np.stack([-np.sin(angles), np.cos(angles)])
    q = (config.trim, 1.0 - config.trim)
    area = np.ptp(np.quantile(u, q, axis=0), axis=0) * np.ptp(np.quantile(v, q, axis=0), axis=0)
    best = angles[int(np.argmin(area))]
    side = np.cos(best) * x + np.sin(best) * y
    R = np.stack([side, np.cross(axis, side), axis], axis=1)
    low, high = np.quantile(points @ R, q, axis=0)
    low[2], high[2] = _slab(points @ axis, agree, config)
    if (high - low).max() > config.max_extent:
        return []
    return [Box(frames.rigid(R, R @ ((low + high) / 2.0)), high - low)]


def _discs(
    points: Array, axis: Array, agree: NDArray[np.bool_], config: FitConfig
) -> list[Box | Cylinder | Sphere]:
    """Cylinders for points of one end: the main normal, and the circle that holds the points along it."""
    x = _across(points, axis)
    R = np.stack([x, np.cross(axis, x), axis], axis=1)
    local = points @ R
    low, high = np.quantile(local, (config.trim, 1.0 - config.trim), axis=0)
    low[2], high[2] = _slab(local[:, 2], agree, config)
    radius, height = float(np.mean(high[:2] - low[:2]) / 2.0), float(high[2] - low[2])
    if not 1e-3 < radius <= config.max_radius or height > config.max_extent:
        return []
    return [Cylinder(frames.rigid(R, R @ ((low + high) / 2.0)), radius, height)]


def _main_normal(normals: Array) -> tuple[Array, NDArray[np.bool_]]:
    """The direction (3,) most normals agree on within 25°, their mean, and which do (N,)."""
    least_cosine = float(np.cos(np.radians(25.0)))
    count = count_agreeing(np.ascontiguousarray(normals), least_cosine)
    largest = normals @ normals[int(np.argmax(count))] > least_cosine
    return frames.unit(normals[largest].mean(axis=0)), largest


def _across(points: Array, axis: Array) -> Array:
    """A direction (3,) across an axis that turns with the points: to the first one well off their middle."""
    offsets = points - points.mean(axis=0)
    offsets = offsets - (offsets @ axis)[:, None] * axis
    reach = np.linalg.norm(offsets, axis=1)
    if reach.max() < 1e-6:
        return frames.perpendicular(axis)
    return frames.unit(offsets[int(np.argmax(reach > 0.5 * reach.max()))])


def _slab(heights: Array, on_face: NDArray[np.bool_], config: FitConfig) -> tuple[float, float]:
    """Bottom and top [m] along a face's normal: top at the face's points, bottom where all points end."""
    top = float(np.median(heights[on_face]))
    return min(float(np.quantile(heights, config.trim)), top - config.min_extent), top


def _failure_reason(count: int, config: FitConfig) -> str:
    if count < config.min_points:
        return f"{count} points are fewer than the {config.min_points} a shape needs"
    return f"every shape exceeds the longest extent of {config.max_extent:g} m"
