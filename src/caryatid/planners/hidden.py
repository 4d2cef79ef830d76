"""What there is to see, as weighted points: the objects' surfaces, unseen space, relations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from caryatid.config import ActiveVisionConfig
from caryatid.frames import Array
from caryatid.graph import SceneObject, SupportGraph
from caryatid.interest import PointOfInterest
from caryatid.stability import ground_outline
from caryatid.voxels import OCCUPIED, UNKNOWN, VoxelMap

SPACE = "unseen space"
"""What a sample of unseen space is about."""


@dataclass(frozen=True, eq=False, slots=True)
class Samples:
    """Points a view is to show.

    Attributes:
        points_world: (K, 3) [m].
        normals_world: Outward unit normals (K, 3); zero where a point looks the same from all sides.
        weights: Worth (K,) of each, 0 or more.
        subjects: Index (K,) into `names`.
        names: Ids of objects, or `SPACE`.
    """

    points_world: Array
    normals_world: Array
    weights: Array
    subjects: NDArray[np.intp]
    names: tuple[str, ...]


def join(parts: Sequence[Samples]) -> Samples:
    """Put samples together; each part keeps its own names."""
    starts = np.cumsum([0] + [len(part.names) for part in parts])
    return Samples(
        np.concatenate([part.points_world for part in parts]),
        np.concatenate([part.normals_world for part in parts]),
        np.concatenate([part.weights for part in parts]),
        np.concatenate([part.subjects + start for part, start in zip(parts, starts, strict=False)]),
        tuple(name for part in parts for name in part.names),
    )


def surface_samples(graph: SupportGraph, solid: VoxelMap, config: ActiveVisionConfig) -> Samples:
    """Spread points over the objects' surfaces; together they weigh 1.

    Every object weighs the same, small or large: each is one vertex of the graph. What touches another
    shape or the table can never be seen and is left out.

    Args:
        graph: The objects.
        solid: The voxel map with the shapes filled in.
        config: How many points.
    """
    objects = [o for o in graph.objects if o.role == "object"]
    parts = []
    for o in objects:
        spacing = np.sqrt(_area(o) * len(objects) / config.surface_samples)
        points, normals = o.shape.surface(max(float(spacing), solid.config.size))
        before = solid.state_at(points + 1.5 * solid.config.size * normals)
        keep = before != OCCUPIED
        share = 1.0 / (len(objects) * len(points))
        zeros = np.zeros(keep.sum(), dtype=np.intp)
        parts.append(Samples(points[keep], normals[keep], np.full(keep.sum(), share), zeros, (o.id,)))
    return join(parts) if parts else _nothing()


def space_above(graph: SupportGraph, voxels: VoxelMap) -> tuple[Array, Array] | None:
    """Find the box over the table in which something may stand, up to the height of the highest object.

    Args:
        graph: The objects and the table.
        voxels: Bounds the box; it begins two voxels over the table, clear of readings of its top.

    Returns:
        Its corners (3,) and (3,) [m], or None without a table, objects, or space between them.
    """
    table = graph.support_surface
    objects = [o for o in graph.objects if o.role == "object"]
    if table is None or not objects:
        return None
    axes = np.eye(3)
    reach = table.shape.support(axes)
    low, high = table.centre_world - reach, table.centre_world + reach
    low[2] = high[2] + 2.0 * voxels.config.size
    high[2] = max(float(o.centre_world[2] + o.shape.support(axes[2:])[0]) for o in objects)
    low, high = np.maximum(low, voxels.origin_world), np.minimum(high, voxels.end_world)
    return None if (high <= low).any() else (low, high)


def space_samples(graph: SupportGraph, solid: VoxelMap, config: ActiveVisionConfig) -> Samples:
    """Spread points over the unseen space on the table, where something may stand.

    Space counts up to the height of the highest object, fully at the table and less the higher it is: what
    stands there has to be carried. All of the table unseen up to there weighs `config.space_weight`; the
    space among the objects, over the convex hull of their outlines, weighs `config.heap_weight` beside: what
    holds up a heap, or leans on it, is in there.

    Args:
        graph: The objects and the table.
        solid: The voxel map with the shapes filled in.
        config: Spacing of the points, and their worth.
    """
    table = graph.support_surface
    corners = space_above(graph, solid)
    if table is None or corners is None:
        return _nothing()
    low, high = corners
    grid = np.meshgrid(*(np.arange(a, b, config.space_spacing) for a, b in zip(low, high, strict=True)))
    points = np.stack([g.ravel() for g in grid], axis=-1)
    local = (points - table.centre_world) @ table.shape.T_world_object[:3, :3]
    on_table = (np.abs(local[:, :2]) <= table.shape.extents[:2] / 2.0).all(axis=1)
    lowness = np.where(on_table, 1.0 - (points[:, 2] - low[2]) / (high[2] - low[2]), 0.0)
    outlines = [ground_outline(o.shape) for o in graph.objects if o.role == "object"]
    heap = shapely.MultiPoint(np.concatenate([np.empty((0, 2)), *outlines])).convex_hull
    among = np.where(shapely.contains_xy(heap, points[:, 0], points[:, 1]), lowness, 0.0)
    weights = config.space_weight * _shares(lowness) + config.heap_weight * _shares(among)
    unseen = on_table & (solid.state_at(points) == UNKNOWN)
    points = points[unseen]
    zeros = np.zeros(len(points), dtype=np.intp)
    return Samples(points, np.zeros_like(points), weights[unseen], zeros, (SPACE,))


def relation_samples(points: Sequence[PointOfInterest]) -> Samples:
    """Take the points of interest of Algorithm 1 as points seen from any side; together they weigh 1."""
    if not points:
        return _nothing()
    positions = np.stack([p.position_world for p in points])
    saliency = np.array([p.saliency for p in points])
    total = max(float(saliency.sum()), 1e-9)
    names = tuple(p.subject[-1] for p in points)
    return Samples(positions, np.zeros_like(positions), saliency / total, np.arange(len(points)), names)


def weighted(samples: Samples, weight: float | Array) -> Samples:
    """Scale all weights, by one number or each by its own (K,)."""
    return Samples(
        samples.points_world,
        samples.normals_world,
        samples.weights * weight,
        samples.subjects,
        samples.names,
    )


def visibility(samples: Samples, T_world_camera: Array, solid: VoxelMap, config: ActiveVisionConfig) -> Array:
    """How well each camera (T, 4, 4) sees each sample: (K, T) from 0 hidden to 1.

    A sample is seen when its line of sight is free and within the image; surface turned away by more than
    `config.good_incidence` is seen less well, as the cosine. Lines of sight are all free where
    `config.occlusion` is `ignore`.
    """
    origin = samples.points_world.mean(axis=0) if len(samples.points_world) else np.zeros(3)
    points, eyes = samples.points_world - origin, T_world_camera[:, :3, 3] - origin
    axes, normals = T_world_camera[:, :3, 2], samples.normals_world
    squared = (points**2).sum(axis=1)[:, None] + (eyes**2).sum(axis=1) - 2.0 * points @ eyes.T
    distance = np.sqrt(np.maximum(squared, 1e-12))
    facing = (normals @ eyes.T - (normals * points).sum(axis=1)[:, None]) / distance
    facing = np.clip(facing / np.cos(np.deg2rad(config.good_incidence)), 0.0, 1.0)
    facing[~normals.any(axis=1)] = 1.0
    along = (points @ axes.T - (eyes * axes).sum(axis=1)) / distance
    facing[along < np.cos(np.deg2rad(config.view_cone))] = 0.0
    if config.occlusion == "ignore":
        return facing
    eyes_world = T_world_camera[:, :3, 3]
    hidden = solid.blocked(samples.points_world, eyes_world, config.sample_clearance, facing > 0.0)
    facing[hidden] = 0.0
    return facing


def unseen_shares(samples: Samples, seen: Array) -> Array:
    """How much of what each sample is about has not been seen (K,): 1 nothing, 0 all of it.

    Args:
        samples: Points.
        seen: How well each has been seen (K,), from 0 to 1.
    """
    count = np.bincount(samples.subjects, minlength=len(samples.names))
    left = np.bincount(samples.subjects, weights=1.0 - seen, minlength=len(samples.names))
    return (left / np.maximum(count, 1))[samples.subjects]


def _shares(weights: Array) -> Array:
    return weights / max(float(weights.sum()), 1e-9)


def _area(subject: SceneObject) -> float:
    """Surface of the box around a shape [m²]."""
    x, y, z = subject.shape.extents
    return float(2.0 * (x * y + y * z + z * x))


def _nothing() -> Samples:
    return Samples(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0, dtype=np.intp), ())


__all__ = [
    "SPACE",
    "Samples",
    "join",
    "relation_samples",
    "space_above",
    "space_samples",
    "surface_samples",
    "unseen_shares",
    "visibility",
    "weighted",
]
