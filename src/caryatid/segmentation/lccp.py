"""Locally convex connected patches (LCCP): a sampled surface is cut where it is concave or has a step."""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import ndimage

from caryatid.config import SegmentationConfig
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.sensing.clouds import thin

Index = NDArray[np.intp]

TOUCHING = ((0, 1), (1, 0), (1, 1), (1, -1))
"""Rows down and columns right of a sample's later neighbours, diagonals too."""
EDGES_ACROSS = 3.0
"""Sample edges that cross a border for each sample along it, on a grid with diagonals."""
MAX_JUMP = 0.009
"""A difference in inverse depth beyond this parts two surfaces, however steep [1/m]."""
MIN_RISE = 0.015
"""Height over a neighbour's plane from which a depth step repels [m]; above staircases on steep faces."""
GAP = 3
"""Depth steps are looked for across this many samples without a reading [1]; sensors leave 2 px a side."""
STEP_ATTRACTION = -1.0
"""Attraction over a depth step, as strong as that over a flat surface."""


def grid_edges(
    places: NDArray[np.bool_],
    points: Array,
    normals: Array,
    edge_jump: float,
) -> tuple[Index, Index]:
    """Pairs of samples that are neighbours in the image: on one surface, and at a step.

    There is a step where neither sample's inverse depth lies near the other's tangent plane: unlike the bare
    difference this does not grow on steep surfaces. Steps are also looked for across short gaps without
    readings, which sensors leave there.

    Args:
        places: Which places of the grid hold a sample (H, W).
        points: Samples (N, 3) [m] in the camera frame.
        normals: Unit normals (N, 3).
        edge_jump: Distance from the neighbour's plane beyond which a sample is another surface's [1/m].

    Returns:
        Pairs (E, 2) on one surface, and pairs (F, 2) at a step.
    """
    number = np.where(places, np.cumsum(places).reshape(places.shape) - 1, -1)
    offset = np.einsum("ij,ij->i", normals, points)
    planes = normals / np.where(offset == 0.0, np.inf, offset)[:, None]
    ways = np.array([*TOUCHING, *(way for k in range(2, GAP + 1) for way in ((0, k), (k, 0)))])
    edges = np.empty((len(TOUCHING) * len(points), 2), dtype=np.intp)
    steps = np.empty((len(ways) * len(points), 2), dtype=np.intp)
    counts = _find_pairs(number, points, normals, planes, ways, edge_jump, edges, steps)
    return edges[: counts[0]], steps[: counts[1]]


@njit(cache=True, error_model="numpy")
def _find_pairs(number, points, normals, planes, ways, edge_jump, edges, steps):  # type: ignore[no-untyped-def]
    """Write the pairs that `grid_edges` returns, and say how many there are of each."""
    height, width = number.shape
    edge_count = step_count = 0
    for place in range(height * width):
        row, col = place // width, place % width
        i = number[row, col]
        if i < 0:
            continue
        for k in range(len(ways)):
            down, right = ways[k]
            if row + down >= height or col + right < 0 or col + right >= width:
                continue
            j = number[row + down, col + right]
            for between in range(1, max(down, right)):
                if number[row + min(between, down), col + min(between, right)] >= 0:
                    j = -1
            if j < 0:
                continue
            rise_i = rise_j = from_i = from_j = 0.0
            for axis in range(3):
                way = points[j, axis] - points[i, axis]
                rise_j += normals[i, axis] * way
                rise_i -= normals[j, axis] * way
                from_i += planes[i, axis] * points[j, axis]
                from_j += planes[j, axis] * points[i, axis]
            first, second = 1.0 / points[i, 2], 1.0 / points[j, 2]
            off = min(abs(from_i - 1.0) * second, abs(from_j - 1.0) * first)
            if abs(first - second) <= MAX_JUMP and off <= edge_jump:
                if k < len(TOUCHING):
                    edges[edge_count, 0], edges[edge_count, 1] = i, j
                    edge_count += 1
            elif max(rise_i, rise_j) > MIN_RISE:
                steps[step_count, 0], steps[step_count, 1] = i, j
                step_count += 1
    return edge_count, step_count


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
    distances, turns = np.empty(len(edges)), np.empty(len(edges))
    _measure_edges(points, normals, edges, distances, turns)
    costs = distances / config.surfel + config.crease * turns
    surfels = gather_surfels(points, normals, edges, costs, thin(points, config.surfel))
    count = len(surfels.sizes)
    pairs, lengths = count_borders(surfels.owner, edges, count)
    borders = pairs, border_attraction(surfels, pairs, config), lengths
    if steps is not None:
        borders = _with_steps(*borders, *count_borders(surfels.owner, steps, count), count)
    cluster = cluster_by_mean(count, *borders)
    min_width = config.min_width / _usual(distances)
    cluster = _absorb_slivers(cluster, surfels.sizes, pairs, lengths, config.min_size, min_width)
    part = np.where(surfels.owner >= 0, cluster[surfels.owner], -1)
    large = np.bincount(part + 1)[1:] >= config.min_size
    return number_by_appearance(np.where((part >= 0) & np.append(large, False)[part], part, -1))


@njit(cache=True)
def _measure_edges(points, normals, edges, lengths, turns):  # type: ignore[no-untyped-def]
    """Write how long each edge (E,) is [m] and how far the normal turns along it: 1 − cosine."""
    for e in range(len(edges)):
        i, j = edges[e]
        square, cosine = 0.0, 0.0
        for axis in range(3):
            square += (points[i, axis] - points[j, axis]) ** 2
            cosine += normals[i, axis] * normals[j, axis]
        lengths[e], turns[e] = np.sqrt(square), 1.0 - cosine


def gather_surfels(points: Array, normals: Array, edges: Index, costs: Array, seeds: Index) -> Surfels:
    """Give each sample (N, 3) to the seed (S,) nearest along the edges (E, 2) at their costs (E,).

    Args:
        points: Samples (N, 3) [m].
        normals: Unit normals (N, 3).
        edges: Both ends (E, 2) of each.
        costs: What an edge takes (E,).
        seeds: Samples that begin a surfel (S,).
    """
    owner = _nearest_seeds(len(points), edges, costs, seeds)
    count = len(seeds)
    sizes = np.bincount(owner + 1, minlength=count + 1)[1:]
    centres = _sum_by(owner, points, count) / np.maximum(sizes, 1)[:, None]
    return Surfels(owner, centres, transforms.unit(_sum_by(owner, normals, count)), sizes)


def _nearest_seeds(count: int, edges: Index, costs: Array, seeds: Index) -> Index:
    """For each of the nodes, the number of the seed (S,) nearest along the edges (E, 2), −1 = none."""
    start = np.concatenate([[0], np.cumsum(np.bincount(edges.ravel(), minlength=count))])
    distance, owner = np.full(count, np.inf), np.full(count, -1)
    distance[seeds], owner[seeds] = 0.0, np.arange(len(seeds))
    _spread_seeds(edges, costs, start, distance, owner)
    return owner


@njit(cache=True)
def _spread_seeds(edges, costs, start, distance, owner):  # type: ignore[no-untyped-def]
    """Relax edges in sweeps back and forth until nothing changes (Bellman and Ford); faster than a heap here.

    The neighbours of node i are neighbour[start[i]:start[i + 1]], at the lengths beside them.
    """
    neighbour, length = np.empty(2 * len(edges), dtype=np.intp), np.empty(2 * len(edges))
    free = start[:-1].copy()
    for e in range(len(edges)):
        for k in range(2):
            at = free[edges[e, k]]
            free[edges[e, k]] += 1
            neighbour[at], length[at] = edges[e, 1 - k], costs[e]
    count = len(distance)
    changed, forward = True, True
    while changed:
        changed = False
        for step in range(count):
            node = step if forward else count - 1 - step
            for at in range(start[node], start[node + 1]):
                through = distance[neighbour[at]] + length[at]
                if through < distance[node]:
                    distance[node], owner[node] = through, owner[neighbour[at]]
                    changed = True
        forward = not forward


def count_borders(owner: Index, edges: Index, owners: int) -> tuple[Index, Array]:
    """Pairs of owners that edges lead across, and how many.

    Args:
        owner: Owner of each node (N,), −1 = none.
        edges: Pairs of nodes (E, 2).
        owners: Number of owners S.

    Returns:
        Pairs (B, 2), i < j, in ascending order, and the number of edges across each (B,).
    """
    first, second = owner[edges].T
    across = (first != second) & (first >= 0) & (second >= 0)
    first, second = first[across], second[across]
    keys = np.minimum(first, second) * owners + np.maximum(first, second)
    keys, lengths = np.unique(keys, return_counts=True)
    return np.stack(np.divmod(keys, owners), axis=-1), lengths.astype(np.float64)


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


def cluster_by_mean(count: int, pairs: Index, attraction: Array, lengths: Array) -> Index:
    """Merge the two clusters whose common border attracts most in the mean, while one attracts at all.

    Args:
        count: Number of nodes N.
        pairs: Borders (B, 2) between nodes, each once.
        attraction: Signed attraction of each border (B,).
        lengths: Weight of each border in the mean (B,).

    Returns:
        Cluster of each node (N,): the number of one of its nodes.
    """
    node = np.array(pairs, dtype=np.intp).ravel()
    return _roots(_merge_all(count, node, attraction, attraction * lengths, np.array(lengths, dtype=float)))


@njit(cache=True, error_model="numpy")
def _merge_all(count, node, attraction, total, length):  # type: ignore[no-untyped-def]
    """Do as `cluster_by_mean` says, and return the cluster that each node was merged into.

    The sides 2e and 2e + 1 of border e lie at the nodes `node` (2B,). `first` (N,) is the first side at each
    node and `after` (2B,) the next at the same one, −1 = none; `degree` (N,) is how many there are. `total`
    (B,) is attraction times length, and 0 the `length` of a border that is no more.
    """
    first, after, degree = np.full(count, -1), np.full(len(node), -1), np.zeros(count, dtype=np.intp)
    parent, shared = np.arange(count), np.full(count, -1)
    for side in range(len(node)):
        after[side] = first[node[side]]
        first[node[side]] = side
        degree[node[side]] += 1
    heap = [(0.0, 0, 0, 0, 0.0) for _ in range(0)]
    for e in range(len(total)):
        i, j = node[2 * e], node[2 * e + 1]
        if attraction[e] > 0.0:
            heap.append((-attraction[e], min(i, j), max(i, j), e, length[e]))
    heapq.heapify(heap)
    while len(heap) > 0:
        _, i, j, e, known_length = heapq.heappop(heap)
        if parent[i] != i or parent[j] != j or length[e] != known_length:
            continue
        if degree[i] < degree[j]:
            i, j = j, i
        parent[j] = i
        length[e] = 0.0
        degree[i] -= 1
        side = first[i]
        while side >= 0:
            if length[side >> 1] > 0.0:
                shared[node[side ^ 1]] = side >> 1
            side = after[side]
        side = first[j]
        while side >= 0:
            following, border, other = after[side], side >> 1, node[side ^ 1]
            if length[border] > 0.0:
                joint = shared[other]
                if joint < 0:
                    joint = border
                    node[side] = i
                    after[side] = first[i]
                    first[i] = side
                    degree[i] += 1
                else:
                    total[joint] += total[border]
                    length[joint] += length[border]
                    length[border] = 0.0
                    degree[other] -= 1
                if total[joint] > 0.0:
                    mean = total[joint] / length[joint]
                    heapq.heappush(heap, (-mean, min(i, other), max(i, other), joint, length[joint]))
            side = following
        side = first[i]
        while side >= 0:
            shared[node[side ^ 1]] = -1
            side = after[side]
    return parent


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


def wide_parts(labels: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Which parts 0 … n of a label image (H, W) have a sample amid eight of their own.

    At the image's border what lies beyond it speaks for neither.
    """
    wide = np.zeros(int(labels.max(initial=0)) + 1, dtype=np.bool_)
    around = (
        extreme(labels, size=3, mode="nearest")
        for extreme in (ndimage.minimum_filter, ndimage.maximum_filter)
    )
    wide[labels[np.equal(*around)]] = True
    return wide


def convex_together(first: Array, second: Array, share: float, config: SegmentationConfig) -> bool:
    """Whether hardly a point of one patch rises above the tangent plane of a point of the other.

    Args:
        first: Points [m] and unit normals (N, 6).
        second: Points [m] and unit normals (M, 6).
        share: Greatest share of the pairs of points of which one rises [1].
        config: How far counts: a height, and an angle as normals err.
    """
    between = second[None, :, :3] - first[:, None, :3]
    over = np.einsum("nmi,ni->nm", between, first[:, 3:])
    under = -np.einsum("nmi,mi->nm", between, second[:, 3:])
    bend = np.sin(np.radians(config.concavity)) * np.linalg.norm(between, axis=-1)
    return float((np.maximum(over, under) > config.rise + bend).mean()) <= share


def hollowness(patch: Array) -> float:
    """How much a patch looks inwards: mean cosine between its normals and the way to its middle.

    0 on a plane, positive on the inside of a bowl, negative on the outside.

    Args:
        patch: Points [m] and unit normals (N, 6).
    """
    inwards = transforms.unit(patch[:, :3].mean(axis=0) - patch[:, :3])
    return float(np.einsum("ij,ij->i", inwards, patch[:, 3:]).mean())


def number_by_appearance(part: NDArray[np.integer]) -> NDArray[np.int32]:
    """Number the parts (N,) of samples 1 … n in the order of their first ones; negative = 0."""
    first = np.full(int(part.max(initial=-1)) + 2, len(part))
    first[part[::-1] + 1] = np.arange(len(part))[::-1]
    known = np.flatnonzero(first[1:] < len(part))
    number = np.zeros(len(first), dtype=np.int32)
    number[known[np.argsort(first[1:][known])] + 1] = np.arange(1, len(known) + 1)
    return number[np.maximum(part, -1) + 1]


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
