"""Locally convex parts of a sampled surface: surfels, the verdict on each edge between them, clustering."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from caryatid import frames
from caryatid.clouds import thin
from caryatid.config import SegmentationConfig
from caryatid.frames import Array
from caryatid.kernels.images import nearest_seeds

Index = NDArray[np.intp]

SAMPLED = 60
"""Surfels of a cluster at the most that are compared with another's [1]; bounds time."""

EDGES_ACROSS = 3.0
"""Sample edges that cross a border for each sample along it, on a grid with diagonals."""


STEP_ATTRACTION = -1.0
"""Attraction over a depth step, as strong as that over a flat surface."""


@dataclass(frozen=True, eq=False, slots=True)
class Surfels:
    """Patches of samples.

    Attributes:
        owner: Surfel of each sample (N,), −1 = none.
        centres: Means of the samples (S, 3) [m].
        normals: Unit means of the samples' normals (S, 3).
        sizes: Samples of each surfel (S,).
    """

    owner: Index
    centres: Array
    normals: Array
    sizes: Index


def convex_parts(
    points: Array, normals: Array, edges: Index, config: SegmentationConfig, steps: Index | None = None
) -> NDArray[np.int32]:
    """Cut a sampled surface where it is concave.

    The samples are gathered into surfels that end at creases. Each boundary between two surfels attracts
    where it is flat or convex and repels where it is concave or a step (locally convex connected patches;
    Stein et al., 2014). Surfels are then merged, the most attractive boundary first, each boundary between
    clusters weighing the mean over its length, so that one bad edge joins nothing.

    Args:
        points: Samples (N, 3) [m].
        normals: Unit normals (N, 3), all on the sensor's side.
        edges: Pairs of samples (E, 2) that are neighbours on one surface.
        config: Sizes and angles.
        steps: Pairs of samples (F, 2) that are neighbours in the image, one in front of the other: they
            repel, for a convex body does not hide itself. None where there is no image.

    Returns:
        Part of each sample (N,), 1 … n in the order of their first samples, 0 = none.
    """
    if len(points) == 0:
        return np.zeros(0, dtype=np.int32)
    surfels = gather_surfels(points, normals, edges, config)
    pairs, lengths = surfel_borders(surfels, edges)
    attraction = border_attraction(surfels, pairs, config)
    repelled = _with_steps(surfels, pairs, attraction, lengths, steps)

    def convex(first: list[int], second: list[int]) -> bool:
        return convex_together(surfels, first, second, config)

    cluster = cluster_by_mean(len(surfels.sizes), *repelled, allowed=convex)
    min_width = config.min_width / _spacing(points, edges)
    cluster = _absorb_slivers(cluster, surfels.sizes, pairs, lengths, config.min_size, min_width)
    part = np.where(surfels.owner >= 0, cluster[surfels.owner], -1)
    kept = np.flatnonzero(np.bincount(part[part >= 0], minlength=len(cluster)) >= config.min_size)
    part = np.where(np.isin(part, kept), part, -1)
    return number_by_appearance(part)


def gather_surfels(points: Array, normals: Array, edges: Index, config: SegmentationConfig) -> Surfels:
    """Give each sample (N, 3) to the seed nearest along the surface; turns of the normal add distance."""
    difference = points[edges[:, 0]] - points[edges[:, 1]]
    turn = 1.0 - np.einsum("ij,ij->i", normals[edges[:, 0]], normals[edges[:, 1]])
    costs = np.sqrt(np.einsum("ij,ij->i", difference, difference)) / config.surfel + config.crease * turn
    seeds = thin(points, config.surfel)
    owner = nearest_seeds(len(points), edges, costs, seeds)
    count = len(seeds)
    known = owner >= 0
    sizes = np.bincount(owner[known], minlength=count)
    centres = _sum_by(owner[known], points[known], count) / np.maximum(sizes, 1)[:, None]
    return Surfels(owner, centres, frames.unit(_sum_by(owner[known], normals[known], count)), sizes)


def surfel_borders(surfels: Surfels, edges: Index) -> tuple[Index, Array]:
    """Pairs of surfels (B, 2) that touch, i < j, and the number of sample edges across each border (B,)."""
    ends = surfels.owner[edges]
    across = (ends[:, 0] != ends[:, 1]) & (ends >= 0).all(axis=1)
    low, high = ends[across].min(axis=1), ends[across].max(axis=1)
    keys, lengths = np.unique(low * len(surfels.sizes) + high, return_counts=True)
    return np.stack(np.divmod(keys, len(surfels.sizes)), axis=-1), lengths.astype(np.float64)


def border_attraction(surfels: Surfels, pairs: Index, config: SegmentationConfig) -> Array:
    """Attraction (B,) of surfels over each border: 1 flat or convex, 0 at the limit, down to −2 beyond it."""
    i, j = pairs.T
    between = surfels.centres[j] - surfels.centres[i]
    rise_j = np.einsum("ij,ij->i", surfels.normals[i], between)
    rise_i = -np.einsum("ij,ij->i", surfels.normals[j], between)
    distance = np.maximum(np.linalg.norm(between, axis=-1), 1e-9)
    bend = 1.0 - np.maximum(rise_i + rise_j, 0.0) / distance / np.radians(config.concavity)
    step = 1.0 - np.maximum(rise_i, rise_j) / config.step
    return np.clip(np.minimum(bend, step), -2.0, 1.0)


def _with_steps(
    surfels: Surfels, pairs: Index, attraction: Array, lengths: Array, steps: Index | None
) -> tuple[Index, Array, Array]:
    """Borders with their mean attraction and length once the depth steps along them repel."""
    if steps is None or len(steps) == 0:
        return pairs, attraction, lengths
    apart, count = surfel_borders(surfels, steps)
    keys = np.concatenate([pairs, apart]) @ np.array([len(surfels.sizes), 1])
    keys, inverse = np.unique(keys, return_inverse=True)
    total = np.bincount(inverse, np.concatenate([attraction * lengths, STEP_ATTRACTION * count]))
    length = np.bincount(inverse, np.concatenate([lengths, count])).astype(np.float64)
    return np.stack(np.divmod(keys, len(surfels.sizes)), axis=-1), total / length, length


def convex_together(
    surfels: Surfels, first: list[int], second: list[int], config: SegmentationConfig
) -> bool:
    """Whether two clusters of surfels may be one body where their border attracts: few rise over the other's.

    Too few surfels tell nothing, and two patches of the inside of a bowl rise over each other.
    """
    if min(len(first), len(second)) < config.least_surfels:
        return True
    i, j = (np.array(m[:: max(1, len(m) // SAMPLED)]) for m in (first, second))
    if all(hollowness(surfels.centres[k], surfels.normals[k]) > config.hollow for k in (i, j)):
        return True
    share = concave_share(
        (surfels.centres[i], surfels.normals[i]), (surfels.centres[j], surfels.normals[j]), config
    )
    return share <= config.concave_share


def hollowness(points: Array, normals: Array) -> float:
    """How much a patch looks inwards: mean cosine between normals (N, 3) and the way to its middle (N, 3).

    0 on a plane, positive on the inside of a bowl, negative on the outside.
    """
    inwards = points.mean(axis=0) - points
    length = np.maximum(np.linalg.norm(inwards, axis=-1), 1e-9)
    return float(np.mean(np.einsum("ij,ij->i", normals, inwards) / length))


def concave_share(
    first: tuple[Array, Array], second: tuple[Array, Array], config: SegmentationConfig
) -> float:
    """Share of the pairs of points of two patches of which one rises above the other's tangent plane.

    Args:
        first: Points (N, 3) [m] and unit normals (N, 3).
        second: Points (M, 3) [m] and unit normals (M, 3).
        config: How far counts: a height, and an angle as normals err.
    """
    (p, n), (q, m) = first, second
    between = q[None] - p[:, None]
    slack = config.rise + np.linalg.norm(between, axis=-1) * np.sin(np.radians(config.concavity))
    over_first = np.einsum("abi,ai->ab", between, n) > slack
    over_second = -np.einsum("abi,bi->ab", between, m) > slack
    return float((over_first | over_second).mean())


def cluster_by_mean(
    count: int,
    pairs: Index,
    attraction: Array,
    lengths: Array,
    allowed: Callable[[list[int], list[int]], bool] | None = None,
) -> Index:
    """Merge the two clusters whose common border attracts most in the mean, while one attracts at all.

    Args:
        count: Number of nodes.
        pairs: Borders (B, 2) between nodes.
        attraction: Signed attraction of each border (B,).
        lengths: Weight of each border in the mean (B,).
        allowed: Says of the nodes of two clusters whether they may be merged; a border across which they may
            not repels from then on.

    Returns:
        Cluster of each node (count,): the number of one of its nodes.
    """
    borders: list[dict[int, tuple[float, float]]] = [{} for _ in range(count)]
    heap: list[tuple[float, int, int, float]] = []
    for (i, j), weight, length in zip(pairs.tolist(), attraction.tolist(), lengths.tolist(), strict=True):
        borders[i][j] = borders[j][i] = (weight * length, length)
        if weight > 0.0:
            heap.append((-weight, i, j, length))
    heapq.heapify(heap)
    parent = list(range(count))
    members = [[k] for k in range(count)]
    while heap:
        _, i, j, length = heapq.heappop(heap)
        if parent[i] != i or parent[j] != j or borders[i][j][1] != length:
            continue
        if allowed is not None and not allowed(members[i], members[j]):
            borders[i][j] = borders[j][i] = (-length, length)
            continue
        if len(borders[i]) < len(borders[j]):
            i, j = j, i
        parent[j] = i
        members[i] += members[j]
        del borders[i][j]
        for k, (total, size) in borders[j].items():
            if k == i:
                continue
            del borders[k][j]
            known_total, known_size = borders[i].get(k, (0.0, 0.0))
            total, size = known_total + total, known_size + size
            borders[i][k] = borders[k][i] = (total, size)
            if total > 0.0:
                heapq.heappush(heap, (-total / size, min(i, k), max(i, k), size))
        borders[j] = {}
    return _roots(np.array(parent, dtype=np.intp))


def number_by_appearance(part: Index) -> NDArray[np.int32]:
    """Number parts 1 … n in the order of their first samples; negative = 0."""
    values, first, inverse = np.unique(part, return_index=True, return_inverse=True)
    first = np.where(values < 0, -1, first)
    rank = np.argsort(np.argsort(first)) + (0 if (values < 0).any() else 1)
    return rank[inverse].astype(np.int32)


def _absorb_slivers(
    cluster: Index, sizes: Index, pairs: Index, lengths: Array, min_size: int, min_width: float
) -> Index:
    """Give clusters too small or too narrow for an object to the neighbour with the longest common border.

    A sliver lies along a larger neighbour: its width [samples] is its size over the length of their border.
    """
    cluster = cluster.copy()
    for _ in range(3):
        total = np.bincount(cluster, weights=sizes, minlength=len(cluster))
        i, j = cluster[pairs[:, 0]], cluster[pairs[:, 1]]
        outer = i != j
        keys, inverse = np.unique(
            np.concatenate([i[outer], j[outer]]) * len(cluster) + np.concatenate([j[outer], i[outer]]),
            return_inverse=True,
        )
        if len(keys) == 0:
            break
        border = np.bincount(inverse, weights=np.concatenate([lengths[outer], lengths[outer]]))
        small, large = np.divmod(keys, len(cluster))
        narrow = total[small] * EDGES_ACROSS < min_width * border
        absorbed = (total[small] < total[large]) & (narrow | (total[small] < min_size))
        small, large, border = small[absorbed], large[absorbed], border[absorbed]
        order = np.lexsort((large, border, small))
        merged = np.arange(len(cluster))
        merged[small[order]] = large[order]
        cluster = _roots(merged)[cluster]
    return cluster


def _spacing(points: Array, edges: Index) -> float:
    """Usual distance between neighbouring samples [m]."""
    distance = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=-1)
    distance = distance[distance > 0.0]
    return float(np.median(distance)) if len(distance) else np.inf


def _roots(parent: Index) -> Index:
    """Follow each node's parent to the end of its chain."""
    roots = parent
    while not np.array_equal(roots, roots[roots]):
        roots = roots[roots]
    return roots


def _sum_by(owner: Index, vectors: Array, count: int) -> Array:
    return np.stack([np.bincount(owner, vectors[:, axis], minlength=count) for axis in range(3)], axis=-1)
