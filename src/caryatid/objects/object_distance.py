"""Compiled search for the objects that points lie at, beside the plain reference it is held to."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.geometry.shapes import Shape
from caryatid.geometry.signed_distance import signed_distance
from caryatid.geometry.transforms import Array
from caryatid.runtime.parallel import for_each

SHARES = 16
"""Shares of the points that threads take [1]: every 16th point, as some places have more neighbours."""


@dataclass(frozen=True, eq=False, slots=True)
class KnownObjects:
    """Points and shapes of some objects, in arrays.

    Attributes:
        points: All their points (M, 3) [m].
        owners: Whose (M,) each is: 0 … K−1.
        kinds: Code (K,) of each object's shape; −1 = it has none.
        poses: Pose (K, 4, 4) of each shape.
        halves: Half extents (K, 3) [m] of each shape.
    """

    points: Array
    owners: NDArray[np.intp]
    kinds: NDArray[np.intp]
    poses: Array
    halves: Array

    @classmethod
    def of(cls, points: list[Array], shapes: list[Shape | None]) -> KnownObjects:
        """Gather the points (M, 3) [m] of each object and its shape, if it has one."""
        return cls(
            np.concatenate([np.zeros((0, 3)), *points]),
            np.repeat(np.arange(len(points)), [len(p) for p in points]),
            np.array([-1 if s is None else s.code for s in shapes], dtype=np.intp),
            np.array([np.eye(4) if s is None else s.T_world_object for s in shapes]).reshape(-1, 4, 4),
            np.array([np.zeros(3) if s is None else s.extents / 2.0 for s in shapes]).reshape(-1, 3),
        )

    def keep(self, points: NDArray[np.intp]) -> KnownObjects:
        """Return all the objects with some of their points, by indices (M,)."""
        return replace(self, points=np.take(self.points, points, axis=0), owners=self.owners[points])

    def select(self, objects: NDArray[np.intp]) -> KnownObjects:
        """Return some of the objects, by indices (M,) in this order."""
        number = np.full(len(self.kinds), -1)
        number[objects] = np.arange(len(objects))
        kept = np.flatnonzero(number[self.owners] >= 0)
        return KnownObjects(
            np.take(self.points, kept, axis=0),
            number[self.owners[kept]],
            self.kinds[objects],
            self.poses[objects],
            self.halves[objects],
        )


def gaps_to_objects(points: Array, known: KnownObjects, reach: float) -> Array:
    """Distance (N, K) [m] of points (N, 3) to each object: to its points, or its shape's surface if nearer.

    Args:
        points: (N, 3) [m].
        known: The objects.
        reach: Distances from here on are infinite [m].
    """
    count = 1 << (2 * len(known.points) + 128).bit_length()
    starts, order = np.zeros(count + 1, dtype=np.int64), np.empty(len(known.points), dtype=np.int64)
    _by_cell(known.points, reach, np.empty_like(order), starts, order)
    gaps = np.full((len(points), len(known.kinds)), reach * reach)
    others, owners = np.take(known.points, order, axis=0), known.owners[order]
    points = np.ascontiguousarray(points)
    search = _Search(
        points, others, owners, starts, known.kinds, known.poses, known.halves, float(reach), gaps
    )
    for_each(_find_gaps, SHARES, search)
    return gaps


def gaps_to_objects_reference(
    points: Array, known: KnownObjects, shapes: list[Shape | None], reach: float
) -> Array:
    """Do as `gaps_to_objects` does, by all the distances."""
    gaps = np.full((len(points), len(shapes)), np.inf)
    for k, shape in enumerate(shapes):
        own = known.points[known.owners == k]
        if len(own) > 0:
            gaps[:, k] = np.linalg.norm(points[:, None] - own, axis=-1).min(axis=1)
        if shape is not None:
            gaps[:, k] = np.minimum(gaps[:, k], np.abs(shape.signed_distance(points)))
    return np.where(gaps < reach, gaps, np.inf)


@njit(cache=True, error_model="numpy")
def _by_cell(points, size, cells, starts, order):  # type: ignore[no-untyped-def]
    """Order points (N,) by hashed cells of this size; those of hash h are from starts[h] to starts[h + 1]."""
    count = len(starts) - 1
    for i in range(len(points)):
        x, y, z = points[i, 0] / size, points[i, 1] / size, points[i, 2] / size
        cells[i] = _hash(math.floor(x), math.floor(y), math.floor(z), count)
        starts[cells[i]] += 1
    for h in range(count):
        starts[h + 1] += starts[h]
    for i in range(len(points) - 1, -1, -1):
        starts[cells[i]] -= 1
        order[starts[cells[i]]] = i


@njit(cache=True, inline="always")
def _hash(x, y, z, count):  # type: ignore[no-untyped-def]
    """One of `count` hashes of a cell, a power of two (Teschner et al. 2003)."""
    return ((x * 73856093) ^ (y * 19349663) ^ (z * 83492791)) & (count - 1)


class _Search(NamedTuple):
    """What the gaps are found from, and the gaps (N, K), at first the reach squared.

    `others` and `owners` are the known objects' points in the order of their cells, which `starts` tells.
    """

    points: Array
    others: Array
    owners: NDArray[np.intp]
    starts: NDArray[np.int64]
    kinds: NDArray[np.intp]
    poses: Array
    halves: Array
    reach: float
    gaps: Array


@njit(cache=True, error_model="numpy")
def _find_gaps(share, search):  # type: ignore[no-untyped-def]
    """Write the gaps of one share of the points.

    Each point looks in the cells around its own; points in other cells with the same hash do no harm.
    """
    others, owners, starts, gaps = search.others, search.owners, search.starts, search.gaps
    points, kinds, poses, halves = search.points, search.kinds, search.poses, search.halves
    reach, count = search.reach, len(starts) - 1
    for i in range(share, len(points), SHARES):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        x, y, z = math.floor(px / reach), math.floor(py / reach), math.floor(pz / reach)
        for near in range(27):
            cell = _hash(x + near // 9 - 1, y + near // 3 % 3 - 1, z + near % 3 - 1, count)
            for j in range(starts[cell], starts[cell + 1]):
                u, v, w = others[j, 0] - px, others[j, 1] - py, others[j, 2] - pz
                squared = u * u + v * v + w * w
                if squared < gaps[i, owners[j]]:
                    gaps[i, owners[j]] = squared
        for k in range(len(kinds)):
            gap = np.sqrt(gaps[i, k])
            if kinds[k] >= 0:
                u, v, w = px - poses[k, 0, 3], py - poses[k, 1, 3], pz - poses[k, 2, 3]
                x_k = poses[k, 0, 0] * u + poses[k, 1, 0] * v + poses[k, 2, 0] * w
                y_k = poses[k, 0, 1] * u + poses[k, 1, 1] * v + poses[k, 2, 1] * w
                z_k = poses[k, 0, 2] * u + poses[k, 1, 2] * v + poses[k, 2, 2] * w
                signed = signed_distance(kinds[k], x_k, y_k, z_k, halves[k, 0], halves[k, 1], halves[k, 2])
                gap = min(gap, abs(signed))
            gaps[i, k] = gap if gap < reach else np.inf
