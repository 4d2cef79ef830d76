"""Targets of views, as weighted points: the objects' surfaces, unseen space, relations.

And goals: which of them matter, and when to stop, if one object is to be removed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeGuard

import numpy as np
import shapely
from numpy.typing import NDArray

from caryatid.config import ActiveVisionConfig, SupportConfig
from caryatid.geometry.polygons import hull
from caryatid.geometry.shapes import Primitives
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject, SupportGraph
from caryatid.planning.points_of_interest import PointOfInterest
from caryatid.sensing.voxel_map import UNKNOWN, Occluders, VoxelMap
from caryatid.support.relations import Removal, removal_of

SPACE = "unseen space"
"""Subject of a sample of unseen space."""
SURFACE_SAMPLES = 400
"""Points on the fitted shapes that are tested for being seen [1]."""
SPACE_WEIGHT = 0.5
"""Weight of all the space on support surfaces, relative to all surfaces of objects [1]; little of it holds
any."""


@dataclass(frozen=True, eq=False, slots=True)
class Samples:
    """Points that a view should show.

    Attributes:
        points_world: (K, 3) [m].
        normals_world: Outward unit normals (K, 3); zero where a point looks the same from all sides.
        weights: Weight (K,) of each, 0 or more.
        subjects: Index (K,) into `names`.
        names: Ids of objects, or `SPACE`.
    """

    points_world: Array
    normals_world: Array
    weights: Array
    subjects: NDArray[np.intp]
    names: tuple[str, ...]

    def select(self, which: NDArray[np.bool_]) -> Samples:
        """Return some of the points (K,); all names remain."""
        points, normals = self.points_world[which], self.normals_world[which]
        return Samples(points, normals, self.weights[which], self.subjects[which], self.names)


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


def surface_samples(graph: SupportGraph, occluders: Occluders) -> Samples:
    """Spread points over the objects' surfaces; together they weigh 1.

    Every object weighs the same, small or large: each is one vertex of the graph. Points that touch another
    shape or a support surface can never be seen and are left out.
    """
    objects = graph.movable
    size = occluders.voxels.config.size
    x, y, z = np.array([o.shape.extents for o in objects]).reshape(-1, 3).T
    areas = 2.0 * (x * y + y * z + z * x)
    spacings = np.maximum(np.sqrt(areas * len(objects) / SURFACE_SAMPLES), size)
    nothing = np.zeros((0, 3))
    surfaces = [o.shape.surface(spacing) for o, spacing in zip(objects, spacings, strict=True)]
    points, normals = map(np.concatenate, zip((nothing, nothing), *surfaces, strict=True))
    counts = np.array([len(found) for found, _ in surfaces], dtype=np.intp)
    subjects = np.repeat(np.arange(len(objects)), counts)
    open_ = np.flatnonzero(~occluders.holds(points + 1.5 * size * normals))
    subjects = subjects[open_]
    weights = (1.0 / (len(objects) * counts))[subjects]
    return Samples(points[open_], normals[open_], weights, subjects, tuple(o.id for o in objects))


def space_above(graph: SupportGraph, voxels: VoxelMap) -> tuple[Array, Array] | None:
    """Find the box around all space over the support surfaces that may hold something.

    Return its corners (3,) and (3,) [m], or None without a support surface, objects, or space between them.
    """
    spaces = spaces_above(graph, voxels)
    if not spaces:
        return None
    lows, highs = zip(*((low, high) for _, low, high in spaces), strict=True)
    return np.min(lows, axis=0), np.max(highs, axis=0)


def spaces_above(graph: SupportGraph, voxels: VoxelMap) -> list[tuple[SceneObject, Array, Array]]:
    """Find the box over each support surface, within the map, that may hold something.

    It is as high as the highest heap over its surface, and begins two voxels over the surface, clear of
    readings of its top.

    Returns:
        The surface and the corners (3,) and (3,) [m] of its box; none without objects or without space.
    """
    bases = bases_of(graph)
    if not bases:
        return []
    axes = np.eye(3)
    room = max(_top(graph[i]) - _top(base) for i, base in bases.items())
    spaces = []
    for surface in graph.support_surfaces:
        reach = surface.shape.support(axes)
        low, high = surface.centre_world - reach, surface.centre_world + reach
        low[2], high[2] = high[2] + 2.0 * voxels.config.size, high[2] + room
        low, high = np.maximum(low, voxels.origin_world), np.minimum(high, voxels.end_world)
        if (high > low).all():
            spaces.append((surface, low, high))
    return spaces


def bases_of(graph: SupportGraph) -> dict[str, SceneObject]:
    """Find the support surface that each object is over, by its id: the highest one below its centre.

    Objects over none count as over the main one; without support surfaces, the dict is empty.
    """
    surfaces, objects = graph.support_surfaces, graph.movable
    if not surfaces or not objects:
        return {}
    low, high = Primitives.of([o.shape for o in objects]).bounds()
    start, end = Primitives.of([o.shape for o in surfaces]).bounds()
    over = ((low[:, None, :2] < end[:, :2]) & (start[:, :2] < high[:, None, :2])).all(axis=-1)
    height = np.array([o.centre_world[2] for o in surfaces])
    over &= height < np.array([[o.centre_world[2]] for o in objects])
    best = np.where(over, height, -np.inf).argmax(axis=1)
    return {o.id: surfaces[k] for o, k in zip(objects, best.tolist(), strict=True)}


def _top(o: SceneObject) -> float:
    """Height [m] of an object's highest point."""
    return float(o.centre_world[2] + o.shape.support(np.eye(3)[2:])[0])


def space_samples(graph: SupportGraph, occluders: Occluders) -> Samples:
    """Spread points, four voxels apart, over the unseen space on support surfaces, which may hold something.

    Space counts up to the height of the highest heap or the next surface, fully at its surface and less the
    higher it is, because something must support its content. If completely unseen, it weighs `SPACE_WEIGHT`.
    The space among the objects, over the convex hull of the outlines of those over the same surface, weighs 1
    more, as much as all their surfaces: it holds whatever supports a heap or leans on it.
    """
    spacing = 4.0 * occluders.voxels.config.size
    parts = [_space_over(*space, graph, spacing) for space in spaces_above(graph, occluders.voxels)]
    if not parts:
        return relation_samples(())
    points, among, shares = map(np.concatenate, zip(*parts, strict=True))
    even, heaps = max(shares.sum(), 1.0), max((among * shares).sum(), 1.0)
    weights = (SPACE_WEIGHT / even + among / heaps) * shares
    unseen = occluders.voxels.state_at(points) == UNKNOWN
    unseen[unseen] = ~occluders.holds(points[unseen])
    points, weights = points[unseen], weights[unseen]
    return Samples(points, np.zeros_like(points), weights, np.zeros(len(points), dtype=np.intp), (SPACE,))


def _space_over(
    surface: SceneObject, low: Array, high: Array, graph: SupportGraph, spacing: float
) -> tuple[Array, NDArray[np.bool_], Array]:
    """Points (N, 3) in the box over a surface, below others; which are among its objects; their shares (N,).

    The shares of a column of points add up to 1.
    """
    x, y, z = (np.arange(a, b, spacing) for a, b in zip(low, high, strict=True))
    places = np.stack(np.meshgrid(x, y, surface.centre_world[2]), axis=-1).reshape(-1, 3)
    places = places[_within(surface, places)]
    outlines = [graph[i].shape.footprint() for i, base in bases_of(graph).items() if base is surface]
    heap = shapely.Polygon(hull(np.concatenate(outlines)) if outlines else None)
    shapely.prepare(heap)
    among = np.repeat(shapely.contains_xy(heap, places[:, :2]), len(z))
    upwards = 1.0 - (z - low[2]) / (high[2] - low[2])
    shares = np.tile(upwards / upwards.sum(), len(places))
    points = np.repeat(places, len(z), axis=0)
    points[:, 2] = np.tile(z, len(places))
    free = np.ones(len(points), dtype=np.bool_)
    for cover in graph.support_surfaces:
        if cover.centre_world[2] > surface.centre_world[2]:
            free &= (points[:, 2] < cover.centre_world[2]) | ~_within(cover, points)
    return points[free], among[free], shares[free]


def _within(surface: SceneObject, points: Array) -> NDArray[np.bool_]:
    """Which points (N, 3) are over or under a support surface."""
    T, half = surface.shape.T_world_object, surface.shape.extents / 2.0
    return np.asarray((np.abs((points - T[:3, 3]) @ T[:3, :2]) <= half[:2]).all(axis=1))


def relation_samples(points: Sequence[PointOfInterest]) -> Samples:
    """Use the points of interest of Algorithm 1 as points visible from any side; together they weigh 1."""
    positions = np.array([p.position_world for p in points]).reshape(-1, 3)
    saliency = np.array([p.saliency for p in points])
    weights = saliency / max(float(saliency.sum()), 1e-9)
    names = tuple(p.subject[-1] for p in points)
    return Samples(positions, np.zeros_like(positions), weights, np.arange(len(points)), names)


def visibility(
    samples: Samples, T_world_camera: Array, occluders: Occluders, config: ActiveVisionConfig
) -> Array:
    """How well each camera (T, 4, 4) sees each sample: (K, T) from 0 hidden to 1."""
    alike = replace(samples, weights=np.ones_like(samples.weights))
    return newly_visible(alike, np.zeros_like(samples.weights), T_world_camera, occluders, config)


def newly_visible(
    samples: Samples, before: Array, T_world_camera: Array, occluders: Occluders, config: ActiveVisionConfig
) -> Array:
    """Value (K, T) of what cameras (T, 4, 4) show of samples beyond how well those were seen before (K,).

    A sample is seen when its line of sight is free and within the image; surface turned away by more than
    60° is seen less well, as the cosine. The first 2½ voxels of a line of sight do not count: they are the
    sample's own surface. Lines of sight are all free if `config.occlusion` is `ignore`, and not followed if
    they cannot show anything new; `before` is from 0 to 1.
    """
    if config.occlusion == "ignore":
        occluders = replace(occluders, grid=np.zeros((0, 0, 0), dtype=np.uint8))
    points, eyes, axes = samples.points_world, T_world_camera[:, :3, 3], T_world_camera[:, :3, 2]
    clearance, cone = 2.5 * occluders.voxels.config.size, float(np.cos(np.deg2rad(config.view_cone)))
    return occluders.shown(
        points, samples.normals_world, before, samples.weights, eyes, axes, clearance, cone
    )


def unseen_shares(samples: Samples, seen: Array) -> Array:
    """How much of its subject is left to be seen (K,), by how well each sample was seen (K,), 0 … 1."""
    count = np.bincount(samples.subjects, minlength=len(samples.names))
    left = np.bincount(samples.subjects, weights=1.0 - seen, minlength=len(samples.names))
    return (left / np.maximum(count, 1))[samples.subjects]


def relevant(graph: SupportGraph, goal: str) -> set[str]:
    """Ids of the goal, of the objects it supports, directly or not, and of their other supporters."""
    moving = {goal}
    while above := {s.supported for s in graph.supports if s.supporter in moving} - moving:
        moving |= above
    return moving | {s.supporter for s in graph.supports if s.supported in moving}


def matter(samples: Samples, graph: SupportGraph, goal: str | None) -> NDArray[np.bool_]:
    """Whether each of the samples (K,) is about the goal's removal; all are without a known goal.

    That is, about one of the relevant objects, or unseen space over the convex hull of their outlines.
    """
    if not _knows(goal, graph):
        return np.ones(len(samples.weights), dtype=np.bool_)
    ids = relevant(graph, goal)
    outlines = [o.shape.footprint() for o in graph.movable if o.id in ids]
    near = shapely.contains_xy(shapely.Polygon(hull(np.concatenate(outlines))), samples.points_world[:, :2])
    about, space = (np.isin(samples.names, names)[samples.subjects] for names in ([*ids], [SPACE]))
    return about | (space & near)


def predict_goal(
    graph: SupportGraph, goal: str | None, voxels: VoxelMap, config: SupportConfig
) -> Removal | None:
    """Say what moves when the goal is removed; None without a goal, or if no view has shown it."""
    if not _knows(goal, graph):
        return None
    samples = surface_samples(graph, voxels.occluders([o.shape for o in graph.objects]))
    level = samples.normals_world[:, 2] > np.cos(np.radians(config.max_tilt))
    top = level & (samples.subjects == samples.names.index(goal))
    above = samples.points_world[top] + 1.5 * voxels.config.size * samples.normals_world[top]
    unseen = voxels.state_at(above) == UNKNOWN
    share = float(unseen.mean()) if len(unseen) else 0.0
    return replace(removal_of(graph, goal, config), unseen=share)


def settled(graph: SupportGraph, goal: str | None, until: float, removal: Removal | None) -> bool:
    """Whether everything relevant is known with a probability of at least `until`.

    Without a goal, this is the existence of every support. With a goal, it is whether each object moves or
    stays when the goal is removed, and that nothing unseen rests on the goal: at least that share of its
    free upper side lies next to seen space. The removal is what `predict_goal` says.
    """
    if goal is None:
        return all(s.belief >= until for s in graph.supports)
    if removal is None or any(1.0 - until < e.probability < until for e in removal.effects):
        return False
    return removal.unseen <= 1.0 - until


def _knows(goal: str | None, graph: SupportGraph) -> TypeGuard[str]:
    return any(o.id == goal for o in graph.objects)
