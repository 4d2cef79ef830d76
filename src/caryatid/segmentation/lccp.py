"""Locally convex connected patches (LCCP): a sampled surface is cut where it is concave or has a step."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from caryatid.config import SegmentationConfig
from caryatid.geometry import transforms
from caryatid.geometry.points import quantile
from caryatid.geometry.transforms import Array
from caryatid.runtime.parallel import kernel
from caryatid.sensing.clouds import thin

Index = NDArray[np.intp]
Borders = tuple[Index, Array, Array]
"""Pairs (B, 2) of surfels that meet, how much each attracts in all, and the length of their border."""
CONVEXITY = 10.0
"""Number of compared pairs of samples that weigh as much as the convexity of one edge [1].

Of 5 to 100 pairs across each edge, most are far from it and say the same."""


def grid_edges(
    places: NDArray[np.bool_], points: Array, normals: Array, edge_jump: float
) -> tuple[Index, Index]:
    """Pairs (E, 2) of samples that are neighbours on one surface, and pairs (F, 2) on either side of a step.

    There is a step where neither sample's inverse depth lies near the other's tangent plane, by `edge_jump`
    [1/m]: unlike the bare difference this does not grow on steep surfaces. Steps are also looked for across
    short gaps without readings, which sensors leave there. Samples are the places set in a grid (H, W), with
    points (N, 3) [m] in the camera frame and normals (N, 3).
    """
    number = np.where(places, np.cumsum(places).reshape(places.shape) - 1, -1)
    offset = np.einsum("ij,ij->i", normals, points)
    planes = normals / np.where(offset == 0.0, np.inf, offset)[:, None]
    # Rows down and columns right of a sample's later neighbours, and of those across a gap: sensors leave two
    # pixels without readings on either side of a step.
    ways = np.array([(0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0), (0, 3), (3, 0)])
    return _find_pairs(number, points, normals, planes, ways, edge_jump)


@kernel
def _find_pairs(number, points, normals, planes, ways, edge_jump):  # type: ignore[no-untyped-def]
    """The pairs that `grid_edges` returns; the first four ways lead to neighbours, the others across gaps."""
    height, width = number.shape
    edges = np.empty((4 * len(points), 2), dtype=np.intp)
    steps = np.empty((len(ways) * len(points), 2), dtype=np.intp)
    edge_count = step_count = 0
    for place in range(height * width):
        row, col = place // width, place % width
        i = number[row, col]
        if i < 0:
            continue
        for k in range(len(ways)):
            down, right = ways[k, 0], ways[k, 1]
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
            # A difference in inverse depth of more than 0.009 / m separates two surfaces, however steep; a
            # step repels from 1.5 cm on, above staircases on steep faces.
            if abs(first - second) <= 0.009 and off <= edge_jump:
                if k < 4:
                    edges[edge_count, 0], edges[edge_count, 1] = i, j
                    edge_count += 1
            elif max(rise_i, rise_j) > 0.015:
                steps[step_count, 0], steps[step_count, 1] = i, j
                step_count += 1
    return edges[:edge_count], steps[:step_count]


def convex_parts(
    points: Array,
    normals: Array,
    edges: Index,
    config: SegmentationConfig,
    steps: Index | None = None,
    borders: Callable[[Index], Borders] | None = None,
) -> NDArray[np.int32]:
    """Cut a sampled surface where it is concave, and where other evidence says so.

    The samples are gathered into surfels that end at creases. Each boundary between two surfels attracts
    where it is flat or convex and repels where it is concave or a step (locally convex connected patches;
    Stein et al., 2014). Surfels are then merged, the most attractive boundary first, each boundary between
    clusters weighing the mean over its length, so that one bad edge joins nothing (average linkage on a
    signed graph; Bailoni et al., 2022).

    Args:
        points: Samples (N, 3) [m].
        normals: Unit normals (N, 3).
        edges: Pairs (E, 2) of neighbours on one surface.
        config: Sizes and angles.
        steps: Pairs (F, 2) of neighbours in the image, one in front of the other: they repel, because a
            convex body does not hide itself.
        borders: Further evidence that surfels attract, given the surfel (N,) of each sample, −1 = none; its
            length counts pairs of samples.

    Returns:
        Parts (N,): 1 … n in the order of their first samples, 0 = none.
    """
    if len(points) == 0:
        return np.zeros(0, dtype=np.int32)
    seeds = thin(points, config.surfel)
    start = np.concatenate([[0], np.cumsum(np.bincount(edges.ravel(), minlength=len(points)))])
    owner, distances = _spread_seeds(points, normals, edges, start, seeds, config.surfel, config.crease)
    sizes = np.bincount(owner + 1, minlength=len(seeds) + 1)[1:]
    pairs, lengths = _count_borders(owner, edges)
    attraction = _border_attraction(points, normals, owner, sizes, pairs, config)
    witnesses = [(pairs, attraction * lengths, lengths)]
    if steps is not None:
        # Depth steps along a border repel, each as much as flat surface attracts.
        others, repelling = _count_borders(owner, steps)
        witnesses.append((others, -repelling, repelling))
    if borders is not None:
        joint, totals, weights = borders(owner)
        witnesses.append((joint, totals / CONVEXITY, weights / CONVEXITY))
    joint, totals, weights = summed(*map(np.concatenate, zip(*witnesses, strict=True)))
    cluster = _roots(_merge_all(len(seeds), joint.flatten(), totals, weights.copy()))
    apart = distances[distances > 0.0]
    if len(apart) == 0:
        return np.zeros(len(points), dtype=np.int32)
    spacing = float(np.median(apart))
    min_size = config.min_area / spacing**2
    cluster = _absorb_slivers(cluster, sizes, pairs, lengths, min_size, config.min_width / spacing)
    part = np.where(owner >= 0, cluster[owner], -1)
    large = np.bincount(part + 1) >= min_size
    return number_by_appearance(np.where(large[part + 1], part, -1))


@kernel
def _spread_seeds(points, normals, edges, start, seeds, surfel, crease):  # type: ignore[no-untyped-def]
    """For each node (N,), the number of the seed (S,) nearest along the edges (E, 2), −1 = none.

    Edges are longer where the normal turns [surfels]; their own lengths (E,) [m] come second. They are
    relaxed in sweeps back and forth until nothing changes (Bellman and Ford); faster than a heap here. The
    neighbours of node i are neighbour[start[i]:start[i + 1]], at the lengths beside them.
    """
    count = len(start) - 1
    distance, owner = np.full(count, np.inf), np.full(count, -1)
    for k in range(len(seeds)):
        distance[seeds[k]], owner[seeds[k]] = 0.0, k
    neighbour, length = np.empty(2 * len(edges), dtype=np.intp), np.empty(2 * len(edges))
    free, apart = start[:-1].copy(), np.empty(len(edges))
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        square, cosine = 0.0, 0.0
        for axis in range(3):
            square += (points[i, axis] - points[j, axis]) ** 2
            cosine += normals[i, axis] * normals[j, axis]
        apart[e] = np.sqrt(square)
        for node, other in ((i, j), (j, i)):
            at = free[node]
            free[node] += 1
            neighbour[at], length[at] = other, apart[e] / surfel + crease * (1.0 - cosine)
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
    return owner, apart


def _count_borders(owner: Index, edges: Index) -> tuple[Any, ...]:
    """Pairs (B, 2), ascending, of owners that edges (E, 2) lead across, and how many do; owner −1 = none."""
    first, second = owner[edges].T
    across = (first != second) & (first >= 0) & (second >= 0)
    pairs = np.sort(np.stack([first[across], second[across]], axis=-1), axis=1)
    return summed(pairs, np.ones(len(pairs)))


def summed(pairs: Index, *values: Array) -> tuple[Any, ...]:
    """Each pair of P (P, 2) once (B, 2), ascending, and the sums of its values (P,)."""
    factor = int(pairs.max(initial=0)) + 1
    keys, inverse = np.unique(pairs @ np.array([factor, 1]), return_inverse=True)
    sums = (np.bincount(inverse, v, len(keys)).astype(np.float64) for v in values)
    return np.stack(np.divmod(keys, factor), axis=-1), *sums


def _border_attraction(
    points: Array, normals: Array, owner: Index, sizes: Index, pairs: Index, config: SegmentationConfig
) -> Array:
    """Attraction (B,) of surfels over each border: 1 flat or convex, 0 at the limit, down to −2 beyond it."""
    sums = [np.bincount(owner + 1, v, minlength=len(sizes) + 1)[1:] for v in (*points.T, *normals.T)]
    centres = np.stack(sums[:3], axis=-1) / np.maximum(sizes, 1)[:, None]
    facing = transforms.unit(np.stack(sums[3:], axis=-1))
    i, j = pairs.T
    between = centres[j] - centres[i]
    rise_j = np.einsum("ij,ij->i", facing[i], between)
    rise_i = -np.einsum("ij,ij->i", facing[j], between)
    distance = np.maximum(np.linalg.norm(between, axis=-1), 1e-9)
    bend = 1.0 - np.maximum(rise_i + rise_j, 0.0) / distance / np.radians(config.concavity)
    step = 1.0 - np.maximum(rise_i, rise_j) / config.step
    return np.clip(np.minimum(bend, step), -2.0, 1.0)


@kernel
def _merge_all(count, node, total, length):  # type: ignore[no-untyped-def]
    """Merge the two clusters whose common border attracts most in the mean, while any attracts.

    Of the clusters of each node (N,) it gives one of its nodes, or one that was merged into it. The sides 2e
    and 2e + 1 of border e lie at the nodes `node` (2B,). `first` (N,) is the first side at each node and
    `after` (2B,) the next at the same one, −1 = none; `degree` (N,) is how many there are. `total` (B,) is
    attraction times length; the `length` of a border that is gone is 0.
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
        if total[e] > 0.0:
            heapq.heappush(heap, (-total[e] / length[e], min(i, j), max(i, j), e, length[e]))
    while len(heap) > 0:
        _, i, j, e, known_length = heapq.heappop(heap)
        if parent[i] != i or parent[j] != j or length[e] != known_length:
            continue
        if degree[i] < degree[j]:
            i, j = j, i
        parent[j] = i
        length[e] = 0.0
        degree[i] -= 1
        side, last = first[i], -1
        while side >= 0:
            if length[side >> 1] > 0.0:
                shared[node[side ^ 1]] = side >> 1
                last = side
            elif last >= 0:  # Borders that are gone leave the list.
                after[last] = after[side]
            else:
                first[i] = after[side]
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
    cluster: Index, sizes: Index, pairs: Index, lengths: Array, min_size: float, min_width: float
) -> Index:
    """Give clusters too small or too narrow for an object to the neighbour with the longest common border.

    A sliver lies along larger neighbours: its width [samples] is its size over the length of their borders.
    """
    cluster = cluster.copy()
    for _ in range(3):
        total = np.bincount(cluster, weights=sizes, minlength=len(cluster))
        joint = cluster[pairs]
        outer = joint[:, 0] != joint[:, 1]
        if not outer.any():
            break
        both_ways = np.concatenate([joint[outer], joint[outer, ::-1]])
        joint, border = summed(both_ways, np.tile(lengths[outer], 2))
        small, large = joint.T
        # On a grid with diagonals, three edges cross a border for each sample along it.
        around = np.bincount(small, border * (total[small] < total[large]), minlength=len(cluster))
        narrow = 3.0 * total[small] < min_width * around[small]
        absorbed = (total[small] < total[large]) & (narrow | (total[small] < min_size))
        small, large, border = small[absorbed], large[absorbed], border[absorbed]
        order = np.lexsort((large, border, small))
        merged = np.arange(len(cluster))
        merged[small[order]] = large[order]
        cluster = _roots(merged)[cluster]
    return cluster


def wide_parts(labels: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Which parts 0 … n of a label image (H, W) have a sample among eight of their own.

    Beyond the image's border, nothing counts for either.
    """
    wide = np.zeros(int(labels.max(initial=0)) + 1, dtype=np.bool_)
    wide[labels[ndimage.minimum_filter(labels, 3) == ndimage.maximum_filter(labels, 3)]] = True
    return wide


def hollowness(points: Array, normals: Array, part: NDArray[np.integer]) -> Array:
    """How much parts 0 … P − 1 face inwards: mean cosine (P,) of normals to the direction of the middle.

    0 on a plane, positive on the inside of a bowl, negative on the outside. Points are (N, 3) [m]; the middle
    is their median, which a stray piece does not move.
    """
    sizes = np.maximum(np.bincount(part), 1)
    every = np.arange(len(sizes))
    if len(sizes) == 1:
        middles = np.array([[quantile(x.copy(), 0.5) for x in points.T]])
    else:
        middles = np.stack([ndimage.median(x, part, every) for x in points.T], axis=-1)
    inwards = transforms.unit(middles[part] - points)
    return np.bincount(part, np.einsum("ij,ij->i", inwards, normals)) / sizes


def number_by_appearance(part: NDArray[np.integer]) -> NDArray[np.int32]:
    """Number the parts (N,) of samples 1 … n in the order of their first ones; negative = 0."""
    known = part >= 0
    names, first = np.unique(part[known], return_index=True)
    number = np.zeros(int(part.max(initial=-1)) + 2, dtype=np.int32)
    number[names[np.argsort(first)] + 1] = np.arange(1, len(names) + 1)
    return number[np.where(known, part, -1) + 1]


def _roots(parent: Index) -> Index:
    """Follow each node's parent to the end of its chain."""
    roots = parent
    while not np.array_equal(roots, roots[roots]):
        roots = roots[roots]
    return roots
