"""What there is to see, as weighted points: the objects' surfaces, unseen space, relations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from caryatid.config import ActiveVisionConfig
from caryatid.geometry.polygons import hull
from caryatid.geometry.shapes import Primitives, Shape
from caryatid.geometry.transforms import Array
from caryatid.graph import SupportGraph
from caryatid.planning.points_of_interest import PointOfInterest
from caryatid.sensing.visibility import shown
from caryatid.sensing.voxel_map import UNKNOWN, Solid, VoxelMap
from caryatid.support.stability import ground_outline

SPACE = "unseen space"
"""What a sample of unseen space is about."""
SURFACE_SAMPLES = 400
"""Points on the fitted shapes that are tested for being seen [1]."""
SAMPLE_CLEARANCE = 0.025
"""Length of a surface point's line of sight that does not count [m]; its own surface, 2½ voxels."""
GOOD_INCIDENCE = 60.0
"""A surface met at less than this from its normal is seen as well as can be [deg]."""
SPACE_SPACING = 0.04
"""Spacing of the points in unseen space that are tested for being seen [m]."""
SPACE_WEIGHT = 0.5
"""Worth of all the space on the table against all surfaces of objects [1]; little of it holds any."""
HEAP_WEIGHT = 1.0
"""Worth of the space among the objects against all their surfaces [1]; objects hide in it."""


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


def surface_samples(graph: SupportGraph, solid: Solid) -> Samples:
    """Spread points over the objects' surfaces; together they weigh 1.

    Every object weighs the same, small or large: each is one vertex of the graph. What touches another
    shape or the table can never be seen and is left out.
    """
    objects = [o for o in graph.objects if o.role == "object"]
    if not objects:
        return _nothing()
    size = solid.voxels.config.size
    x, y, z = np.array([o.shape.extents for o in objects]).T
    areas = 2.0 * (x * y + y * z + z * x)
    spacings = np.maximum(np.sqrt(areas * len(objects) / SURFACE_SAMPLES), size)
    points, normals, counts = Primitives.of([o.shape for o in objects]).surface(spacings)
    subjects = np.repeat(np.arange(len(objects)), counts)
    open_ = np.flatnonzero(~solid.holds(points + 1.5 * size * normals))
    subjects = subjects[open_]
    weights = (1.0 / (len(objects) * counts))[subjects]
    return Samples(points[open_], normals[open_], weights, subjects, tuple(o.id for o in objects))


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


def space_samples(graph: SupportGraph, solid: Solid) -> Samples:
    """Spread points over the unseen space on the table, where something may stand.

    Space counts up to the height of the highest object, fully at the table and less the higher it is: what
    stands there has to be carried. All of the table unseen up to there weighs `SPACE_WEIGHT`; the
    space among the objects, over the convex hull of their outlines, weighs `HEAP_WEIGHT` beside: what
    holds up a heap, or leans on it, is in there.
    """
    table = graph.support_surface
    corners = space_above(graph, solid.voxels)
    if table is None or corners is None:
        return _nothing()
    low, high = corners
    x, y, z = (np.arange(a, b, SPACE_SPACING) for a, b in zip(low, high, strict=True))
    outlines = [ground_outline(o.shape) for o in graph.objects if o.role == "object"]
    heap = hull(np.concatenate(outlines))
    points, on_table, in_heap = unseen_space(x, y, z, float(high[2] - low[2]), table.shape, heap, solid)
    weights = SPACE_WEIGHT * on_table + HEAP_WEIGHT * in_heap
    return Samples(points, np.zeros_like(points), weights, np.zeros(len(points), dtype=np.intp), (SPACE,))


def relation_samples(points: Sequence[PointOfInterest]) -> Samples:
    """Take the points of interest of Algorithm 1 as points seen from any side; together they weigh 1."""
    if not points:
        return _nothing()
    positions = np.stack([p.position_world for p in points])
    saliency = np.array([p.saliency for p in points])
    total = max(float(saliency.sum()), 1e-9)
    names = tuple(p.subject[-1] for p in points)
    return Samples(positions, np.zeros_like(positions), saliency / total, np.arange(len(points)), names)


def visibility(samples: Samples, T_world_camera: Array, solid: Solid, config: ActiveVisionConfig) -> Array:
    """How well each camera (T, 4, 4) sees each sample: (K, T) from 0 hidden to 1.

    A sample is seen when its line of sight is free and within the image; surface turned away by more than
    `GOOD_INCIDENCE` is seen less well, as the cosine. Lines of sight are all free where
    `config.occlusion` is `ignore`.
    """
    alike = replace(samples, weights=np.ones_like(samples.weights))
    return shown_anew(alike, np.zeros_like(samples.weights), T_world_camera, solid, config)


def shown_anew(
    samples: Samples, before: Array, T_world_camera: Array, solid: Solid, config: ActiveVisionConfig
) -> Array:
    """Worth (K, T) of what cameras (T, 4, 4) show of samples beyond how well those were seen before (K,).

    Lines of sight that could show nothing new are not followed; `before` is from 0 to 1.
    """
    see_through = config.occlusion == "ignore"
    return shown(
        np.zeros((0, 0, 0), dtype=np.uint8) if see_through else solid.grid,
        solid.origin_world,
        solid.voxels.config.size,
        samples.points_world,
        samples.normals_world,
        before,
        samples.weights,
        np.ascontiguousarray(T_world_camera[:, :3, 3].T),
        np.ascontiguousarray(T_world_camera[:, :3, 2].T),
        SAMPLE_CLEARANCE,
        float(np.cos(np.deg2rad(GOOD_INCIDENCE))),
        float(np.cos(np.deg2rad(config.view_cone))),
    )


def unseen_shares(samples: Samples, seen: Array) -> Array:
    """How much of its subject is left to be seen (K,), by how well each sample was seen (K,), 0 … 1."""
    count = np.bincount(samples.subjects, minlength=len(samples.names))
    left = np.bincount(samples.subjects, weights=1.0 - seen, minlength=len(samples.names))
    return (left / np.maximum(count, 1))[samples.subjects]


def _nothing() -> Samples:
    return Samples(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0, dtype=np.intp), ())


def unseen_space(
    x: Array, y: Array, z: Array, height: float, table: Shape, heap: Array, solid: Solid
) -> tuple[Array, Array, Array]:
    """Pick the points of a lattice that are over a table, in voxels no view has seen, and in nothing solid.

    Args:
        x: Coordinates (X,) of the lattice [m].
        y: The same (Y,) [m].
        z: The same (Z,) [m], from the lowest on.
        height: How far over the lowest points a point is worth nothing [m]; there they are worth 1.
        table: Its z is up.
        heap: Corners (M, 2) [m] of a convex polygon on the ground, in either turn; the last may be the first.
        solid: What is solid, and what views have seen.

    Returns:
        Points (N, 3) [m]; their worth (N,) in shares of that of all the lattice over the table, seen or not;
        and in shares of that of all over the heap.
    """
    points = np.stack(np.meshgrid(y, x, z, indexing="ij"), axis=-1).reshape(-1, 3)[:, [1, 0, 2]]
    T, half = table.T_world_object, table.extents / 2.0
    u, v, w = (points - T[:3, 3]).T
    over = np.abs(T[0, 0] * u + T[1, 0] * v + T[2, 0] * w) <= half[0]
    over &= np.abs(T[0, 1] * u + T[1, 1] * v + T[2, 1] * w) <= half[1]
    points = points[over]
    lowness = 1.0 - (points[:, 2] - z[0]) / height
    among = np.where(_within(heap, points), lowness, 0.0)
    unseen = (solid.voxels.state_at(points) == UNKNOWN) & ~solid.holds(points)
    on_table, in_heap = (worth[unseen] / max(float(worth.sum()), 1e-9) for worth in (lowness, among))
    return points[unseen], on_table, in_heap


def _within(polygon: Array, points: Array) -> NDArray[np.bool_]:
    """Which points (N, 2+) are inside a convex polygon (M, 2), and not on its border."""
    start, along = np.roll(polygon, 1, axis=0), polygon - np.roll(polygon, 1, axis=0)
    start, along = start[along.any(axis=1)], along[along.any(axis=1)]
    offset = points[:, None, :2] - start
    turn = along[:, 0] * offset[..., 1] - along[:, 1] * offset[..., 0]
    return (turn > 0.0).all(axis=1) != (turn < 0.0).all(axis=1)
