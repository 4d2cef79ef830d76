"""Goals: where to look, and when to stop, if one object is to be removed."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeGuard

import numpy as np
import shapely
from numpy.typing import NDArray

from caryatid.config import SupportConfig
from caryatid.geometry.polygons import hull
from caryatid.graph import SupportGraph
from caryatid.planning.expected_visibility import SPACE, Samples, surface_samples
from caryatid.sensing.voxel_map import UNKNOWN, VoxelMap
from caryatid.support.relations import Removal, removal_of


def relevant(graph: SupportGraph, goal: str) -> set[str]:
    """Ids of the goal, of the objects it supports, directly or not, and of their other supporters."""
    moving = {goal}
    while above := {s.supported for s in graph.supports if s.supporter in moving} - moving:
        moving |= above
    return moving | {s.supporter for s in graph.supports if s.supported in moving}


def matter(samples: Samples, graph: SupportGraph, goal: str | None) -> NDArray[np.bool_]:
    """Whether each of the samples (K,) is about the goal's removal.

    That is, about one of the relevant objects, or unseen space over the convex hull of their outlines.

    Args:
        samples: Points that views may show.
        graph: The support graph.
        goal: Id of the object to remove. Without one, or before it is known, all matter.
    """
    if not _knows(goal, graph):
        return np.ones(len(samples.weights), dtype=np.bool_)
    ids = relevant(graph, goal)
    outlines = [o.shape.footprint() for o in graph.objects if o.role == "object" and o.id in ids]
    near = shapely.contains_xy(shapely.Polygon(hull(np.concatenate(outlines))), samples.points_world[:, :2])
    about, space = (np.isin(samples.names, names)[samples.subjects] for names in ([*ids], [SPACE]))
    return about | (space & near)


def predict_goal(
    graph: SupportGraph, goal: str | None, voxels: VoxelMap, config: SupportConfig
) -> Removal | None:
    """Say what moves when the goal is removed, or return None if no view has shown it.

    Args:
        graph: The support graph.
        goal: Id of the object to remove, or None.
        voxels: The voxel map.
        config: The numbers the graph was inferred with.
    """
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
    free upper side lies next to seen space.

    Args:
        graph: The support graph.
        goal: Id of the object to remove, or None.
        until: The probability [1].
        removal: What `predict_goal` says.
    """
    if goal is None:
        return all(s.belief >= until for s in graph.supports)
    if removal is None or any(1.0 - until < e.probability < until for e in removal.effects):
        return False
    return removal.unseen <= 1.0 - until


def _knows(goal: str | None, graph: SupportGraph) -> TypeGuard[str]:
    return any(o.id == goal for o in graph.objects)
