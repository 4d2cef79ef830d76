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
) -> dict[int, int]:
    """Give each new part the label of the object it belongs to, or a label never used before.

    Args:
        points_world: (N, 3) [m].
        labels: Part of each point (N,); 0 belongs to none.
        known_points: Points (M, 3) [m] of each known object.
        known_shapes: Fitted shape of each known object that has one.
        config: Share that must overlap, and the distance that counts as overlap.
        labels_used: Highest label ever given; new objects are numbered from the next one.

    Returns:
        Label of the part → label of the object.
    """
    parts = [int(k) for k in np.unique(labels) if k != 0]
    names: dict[int, int] = {}
    fresh = max(labels_used, *known_points, 0)
    trees = {k: cKDTree(p) for k, p in known_points.items()}
    for part in parts:
        points = points_world[labels == part]
        points = points[:: max(1, len(points) // 500)]
        shares = {
            k: float(_belongs(points, trees[k], known_shapes.get(k), config.overlap_reach).mean())
            for k in trees
        }
        best = max(shares, key=lambda k: shares[k], default=None)
        if best is not None and shares[best] >= config.overlap:
            names[part] = best
        else:
            fresh += 1
            names[part] = fresh
    return names


def duplicates(
    known_points: Mapping[int, Array], known_shapes: Mapping[int, Shape], config: SegmentationConfig
) -> dict[int, int]:
    """Find objects most of whose points lie in another's shape: two labels of one object.

    Returns:
        Label to give up → label that takes its points.
    """
    given_up: dict[int, int] = {}
    by_size = sorted(known_shapes, key=lambda k: (-known_shapes[k].volume, k))
    for k, big in enumerate(by_size):
        for small in by_size[k + 1 :]:
            if big in given_up or small in given_up:
                continue
            inside = known_shapes[big].signed_distance(known_points[small]) < config.overlap_reach / 2.0
            if inside.mean() >= config.same_share:
                given_up[small] = big
    return given_up


def _belongs(points: Array, tree: cKDTree, shape: Shape | None, reach: float) -> NDArray[np.bool_]:
    gap, _ = tree.query(points, distance_upper_bound=reach)
    near: NDArray[np.bool_] = np.isfinite(gap)
    return near if shape is None else near | (np.abs(shape.signed_distance(points)) < reach / 2.0)
