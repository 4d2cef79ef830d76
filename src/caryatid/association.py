"""Which known object is a part of a new view: the one in whose points or shape it lies."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from caryatid.config import SegmentationConfig
from caryatid.frames import Array
from caryatid.shapes import Shape


def associate(
    points_world: Array,
    labels: NDArray[np.int32],
    known_points: Mapping[int, Array],
    known_shapes: Mapping[int, Shape],
    config: SegmentationConfig,
    labels_used: int = 0,
) -> NDArray[np.int32]:
    """Give the points of each new part the label of the object they belong to, or one never used before.

    A part that lies at several known objects is divided among them: each point goes to the nearest.

    Args:
        points_world: (N, 3) [m].
        labels: Part of each point (N,); 0 belongs to none.
        known_points: Points (M, 3) [m] of each known object.
        known_shapes: Fitted shape of each known object that has one.
        config: Share that must overlap, and the distance that counts as overlap.
        labels_used: Highest label ever given; new objects are numbered from the next one.

    Returns:
        Label of the object (N,) of each point; 0 where there was no part.
    """
    result = np.zeros_like(labels)
    fresh = max(labels_used, *known_points, 0)
    trees = {k: cKDTree(p) for k, p in known_points.items()}
    for part in (int(k) for k in np.unique(labels) if k != 0):
        index = np.flatnonzero(labels == part)
        points = points_world[index]
        neighbours = [
            k for k in trees if may_touch(points, known_points[k], known_shapes.get(k), config.overlap_reach)
        ]
        gaps = np.array([_gaps(points, trees[k], known_shapes.get(k)) for k in neighbours])
        near = gaps < config.overlap_reach
        if not neighbours or near.any(axis=0).mean() < config.overlap:
            fresh += 1
            result[index] = fresh
            continue
        nearest = np.where(near.any(axis=0), np.argmin(gaps, axis=0), -1)
        shares = np.bincount(nearest[nearest >= 0], minlength=len(neighbours)) / len(points)
        owners = np.flatnonzero(shares >= min(config.divide_share, shares.max()))
        result[index] = np.array(neighbours)[owners[np.argmin(gaps[owners], axis=0)]]
    return result


def may_touch(points: Array, others: Array, shape: Shape | None, reach: float) -> bool:
    """Whether the axis-aligned boxes around points (N, 3) and around an object come within reach [m]."""
    low, high = others.min(axis=0), others.max(axis=0)
    if shape is not None:
        centre, half = shape.T_world_object[:3, 3], shape.support(np.eye(3))
        low, high = np.minimum(low, centre - half), np.maximum(high, centre + half)
    return bool(((points.min(axis=0) <= high + reach) & (points.max(axis=0) >= low - reach)).all())


def _gaps(points: Array, tree: cKDTree, shape: Shape | None) -> Array:
    """Distance (N,) [m] of points to an object: to its points, or its shape's surface if nearer."""
    gap, _ = tree.query(points)
    if shape is None:
        return np.asarray(gap)
    return np.minimum(gap, np.abs(shape.signed_distance(points)))
