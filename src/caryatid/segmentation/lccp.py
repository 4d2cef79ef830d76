"""Locally convex parts of a sampled surface: surfels, the verdict on each edge between them, clustering."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from caryatid.config import SegmentationConfig
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.segmentation.clusters import OneBody, cluster_by_mean
from caryatid.segmentation.concavity import convex
from caryatid.segmentation.sample_graph import bent_lengths, count_borders, nearest_seeds
from caryatid.sensing.clouds import thin

Index = NDArray[np.intp]

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
    distances, turns = bent_lengths(points, normals, edges)
    costs = distances / config.surfel + config.crease * turns
    surfels = gather_surfels(points, normals, edges, costs, thin(points, config.surfel))
    count = len(surfels.sizes)
    pairs, lengths = count_borders(surfels.owner, edges, count)
    borders = pairs, border_attraction(surfels, pairs, config), lengths
    if steps is not None:
        borders = _with_steps(*borders, *count_borders(surfels.owner, steps, count), count)
    cluster = cluster_by_mean(
        *borders, np.column_stack([surfels.centres, surfels.normals]), _one_body(config)
    )
    min_width = config.min_width / _usual(distances)
    cluster = _absorb_slivers(cluster, surfels.sizes, pairs, lengths, config.min_size, min_width)
    part = np.where(surfels.owner >= 0, cluster[surfels.owner], -1)
    large = np.bincount(part + 1)[1:] >= config.min_size
    return number_by_appearance(np.where((part >= 0) & np.append(large, False)[part], part, -1))


def gather_surfels(points: Array, normals: Array, edges: Index, costs: Array, seeds: Index) -> Surfels:
    """Give each sample (N, 3) to the seed (S,) nearest along the edges (E, 2) at their costs (E,).

    Args:
        points: Samples (N, 3) [m].
        normals: Unit normals (N, 3).
        edges: Both ends (E, 2) of each.
        costs: What an edge takes (E,).
        seeds: Samples that begin a surfel (S,).
    """
    owner = nearest_seeds(len(points), edges, costs, seeds)
    count = len(seeds)
    sizes = np.bincount(owner + 1, minlength=count + 1)[1:]
    centres = _sum_by(owner, points, count) / np.maximum(sizes, 1)[:, None]
    return Surfels(owner, centres, transforms.unit(_sum_by(owner, normals, count)), sizes)


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
    pairs: Index, attraction: Array, lengths: Array, apart: Index, apart_lengths: Array, count: int
) -> tuple[Index, Array, Array]:
    """Borders with their mean attraction and length once the depth steps along them repel."""
    if len(apart) == 0:
        return pairs, attraction, lengths
    keys = np.concatenate([pairs, apart]) @ np.array([count, 1])
    keys, inverse = np.unique(keys, return_inverse=True)
    total = np.bincount(inverse, np.concatenate([attraction * lengths, STEP_ATTRACTION * apart_lengths]))
    length = np.bincount(inverse, np.concatenate([lengths, apart_lengths])).astype(np.float64)
    return np.stack(np.divmod(keys, count), axis=-1), total / length, length


def _one_body(config: SegmentationConfig) -> OneBody:
    """When two clusters of surfels may be one body."""
    bend = float(np.sin(np.radians(config.concavity)))
    return OneBody(config.least_surfels, config.hollow, config.rise, bend, config.concave_share)


def convex_together(first: Array, second: Array, share: float, config: SegmentationConfig) -> bool:
    """Whether hardly a point of one patch rises above the tangent plane of a point of the other.

    Args:
        first: Points [m] and unit normals (N, 6).
        second: Points [m] and unit normals (M, 6).
        share: Greatest share of the pairs of points of which one rises [1].
        config: How far counts: a height, and an angle as normals err.
    """
    return convex(first, second, config.rise, float(np.sin(np.radians(config.concavity))), share)


def number_by_appearance(part: NDArray[np.integer]) -> NDArray[np.int32]:
    """Number the parts (N,) of samples 1 … n in the order of their first ones; negative = 0."""
    first = np.full(int(part.max(initial=-1)) + 2, len(part))
    first[part[::-1] + 1] = np.arange(len(part))[::-1]
    known = np.flatnonzero(first[1:] < len(part))
    number = np.zeros(len(first), dtype=np.int32)
    number[known[np.argsort(first[1:][known])] + 1] = np.arange(1, len(known) + 1)
    return number[np.maximum(part, -1) + 1]


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


def _usual(distances: Array) -> float:
    """Usual distance between neighbouring samples [m] of all there are (E,)."""
    distances = distances[distances > 0.0]
    return float(np.median(distances)) if len(distances) else np.inf


def _roots(parent: Index) -> Index:
    """Follow each node's parent to the end of its chain."""
    roots = parent
    while not np.array_equal(roots, roots[roots]):
        roots = roots[roots]
    return roots


def _sum_by(owner: Index, vectors: Array, count: int) -> Array:
    """Sums (count, 3) of the vectors (N, 3) of each owner; −1 = none."""
    sums = [np.bincount(owner + 1, vectors[:, axis], minlength=count + 1)[1:] for axis in range(3)]
    return np.stack(sums, axis=-1)
