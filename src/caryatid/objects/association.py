"""Which known object is a part of a new view: the one in whose points or shape it lies."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from caryatid.config import SegmentationConfig
from caryatid.geometry.points import most_central
from caryatid.geometry.shapes import Shape
from caryatid.geometry.transforms import Array
from caryatid.objects.object_distance import KnownObjects, gaps_to_objects

DENSITY = 4
"""Points of a part, and of an object, along the distance that counts as overlap [1]; others are left out."""


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
    names = sorted(known_points)
    spacing = config.overlap_reach / DENSITY
    known = _thinned(
        KnownObjects.of([known_points[k] for k in names], [known_shapes.get(k) for k in names]), spacing
    )
    counts = np.bincount(labels, minlength=1)
    kept = most_central(points_world, labels, np.where(np.arange(len(counts)) > 0, spacing, 0.0))
    gaps = gaps_to_objects(np.take(points_world, kept, axis=0), known, config.overlap_reach)
    part_of = labels[kept]
    fresh = max(labels_used, *names, 0)
    name_of: NDArray[np.int32] = np.zeros(len(counts), dtype=np.int32)
    divided: dict[int, NDArray[np.intp]] = {}
    for part in (int(k) for k in np.flatnonzero(counts) if k != 0):
        own = gaps[part_of == part]
        near = np.isfinite(own).any(axis=1) if names else np.zeros(len(own), dtype=bool)
        if near.mean() < config.overlap or not near.any():
            fresh += 1
            name_of[part] = fresh
            continue
        shares = np.bincount(np.argmin(own[near], axis=1), minlength=len(names)) / len(own)
        owners = np.flatnonzero(shares >= min(config.divide_share, shares.max()))
        name_of[part] = names[owners[0]]
        if len(owners) > 1:
            divided[part] = owners
    result = np.take(name_of, labels)
    for part, owners in divided.items():
        index = np.flatnonzero(labels == part)
        nearest = _nearest(np.take(points_world, index, axis=0), known.select(owners), config.overlap_reach)
        result[index] = np.array(names)[owners[nearest]]
    return result


def _thinned(known: KnownObjects, spacing: float) -> KnownObjects:
    edges = np.full(len(known.kinds), spacing)
    return known.keep(most_central(known.points, known.owners.astype(np.int32), edges))


def _nearest(points: Array, known: KnownObjects, reach: float) -> NDArray[np.intp]:
    """Which of some objects is nearest to each point (N, 3) [m]; beyond the reach, to whose points."""
    gaps = gaps_to_objects(points, known, reach)
    nearest = np.argmin(gaps, axis=1)
    far = np.flatnonzero(~np.isfinite(gaps).any(axis=1))
    if len(far) > 0:
        _, index = cKDTree(known.points).query(points[far])
        nearest[far] = known.owners[index]
    return nearest
