"""Which known object is a segment of a new view: the one in whose points or shape it lies."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from caryatid.config import SegmentationConfig
from caryatid.geometry.points import most_central
from caryatid.geometry.shapes import Shape
from caryatid.geometry.transforms import Array


def associate(
    points_world: Array,
    labels: NDArray[np.int32],
    known_points: Mapping[int, Array],
    known_shapes: Mapping[int, Shape],
    config: SegmentationConfig,
    labels_used: int = 0,
) -> NDArray[np.int32]:
    """Give the points of each new segment the label of the object they belong to, or one never used before.

    A segment that lies at several known objects, with a tenth of its points or more, is divided among them:
    each point goes to the nearest.

    Args:
        points_world: (N, 3) [m].
        labels: Segment of each point (N,); 0 belongs to none.
        known_points: Points (M, 3) [m] of each known object.
        known_shapes: Fitted shape of each known object that has one.
        config: Share that must overlap, and the distance that counts as overlap.
        labels_used: Highest label ever given; new objects are numbered from the next one.

    Returns:
        Label of the object (N,) of each point; 0 where there was no segment.
    """
    names = np.array(sorted(known_points), dtype=np.int32)
    spacing = config.overlap_reach / 4.0
    owners = np.repeat(np.arange(len(names), dtype=np.int32), [len(known_points[k]) for k in names])
    points = np.concatenate([np.zeros((0, 3)), *(known_points[k] for k in names)])
    thinned = most_central(points, owners, np.full(len(names), spacing))
    points, owners = points[thinned], owners[thinned]
    shapes = [known_shapes.get(k) for k in names.tolist()]
    counts = np.bincount(labels, minlength=1)
    kept = most_central(points_world, labels, np.where(np.arange(len(counts)) > 0, spacing, 0.0))
    owner = _nearest_objects(points_world[kept], points, owners, shapes, config.overlap_reach)
    fresh = max(labels_used, int(names.max(initial=0)))
    result = np.zeros(len(labels), dtype=np.int32)
    for segment in np.flatnonzero(counts[1:]) + 1:
        own = owner[labels[kept] == segment]
        index = np.flatnonzero(labels == segment)
        shares = np.bincount(own[own >= 0], minlength=len(names)) / len(own)
        if shares.sum() < config.overlap or not (own >= 0).any():
            fresh += 1
            result[index] = fresh
            continue
        among = np.flatnonzero(shares >= min(0.1, shares.max()))
        result[index] = names[among[0]]
        if len(among) > 1:
            theirs = np.isin(owners, among)
            some = [shape if k in among else None for k, shape in enumerate(shapes)]
            nearest = _nearest_objects(
                points_world[index], points[theirs], owners[theirs], some, config.overlap_reach
            )
            far = nearest < 0
            if far.any():
                nearest[far] = owners[theirs][cKDTree(points[theirs]).query(points_world[index[far]])[1]]
            result[index] = names[nearest]
    return result


def _nearest_objects(
    points: Array, known: Array, owners: NDArray[np.int32], shapes: list[Shape | None], reach: float
) -> NDArray[np.int32]:
    """Which object (N,) is nearest to each point (N, 3), by its points or its shape's surface; −1 = none.

    Args:
        points: (N, 3) [m].
        known: Points (M, 3) [m] of all objects.
        owners: Object (M,) of each: 0 … K−1.
        shapes: Shape of each object, or None.
        reach: Objects from here on count as none [m].
    """
    nearest, gap = np.full(len(points), -1, dtype=np.int32), np.full(len(points), reach)
    if len(known):
        distance, index = cKDTree(known, compact_nodes=False, balanced_tree=False).query(
            points, distance_upper_bound=reach
        )
        found = np.isfinite(distance)
        nearest[found], gap[found] = owners[index[found]], distance[found]
    for number, shape in enumerate(shapes):
        if shape is not None:
            distance = np.abs(shape.signed_distance(points))
            nearer = distance < gap
            nearest[nearer], gap[nearer] = number, distance[nearer]
    return nearest
