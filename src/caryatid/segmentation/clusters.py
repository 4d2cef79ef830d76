"""Compiled clustering of a graph by the mean of its borders, beside the plain reference it is held to."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.geometry.transforms import Array
from caryatid.segmentation.concavity import convex, hollowness

Index = NDArray[np.intp]

SAMPLED = 60
"""Patches of a cluster, about, that are compared with another's [1]; bounds time."""


class OneBody(NamedTuple):
    """When two clusters of patches may be one body where their border attracts.

    Attributes:
        least: Patches a cluster needs for that to be asked [1]; fewer tell nothing.
        hollow: Hollowness from which both are the inside of something, where they rise over each other [1].
        rise: Height of a patch over another's plane from which the two are concave [m].
        bend: Added to it a metre between them [1].
        share: Greatest share of concave pairs [1].
    """

    least: int
    hollow: float
    rise: float
    bend: float
    share: float


def cluster_by_mean(pairs: Index, attraction: Array, lengths: Array, patches: Array, body: OneBody) -> Index:
    """Merge the two clusters whose common border attracts most in the mean, while one attracts at all.

    A border across which two clusters may not be one body repels from then on.

    Args:
        pairs: Borders (B, 2) between nodes, each once.
        attraction: Signed attraction of each border (B,).
        lengths: Weight of each border in the mean (B,).
        patches: What the nodes are: middles [m] and unit normals (N, 6).
        body: Which clusters may be one body.

    Returns:
        Cluster of each node (N,): the number of one of its nodes.
    """
    count = len(patches)
    node = np.array(pairs, dtype=np.intp).ravel()
    lengths = np.array(lengths, dtype=np.float64)
    borders = (
        node,
        np.empty(len(node), dtype=np.intp),
        np.full(count, -1),
        np.bincount(node, minlength=count),
        attraction * lengths,
        lengths,
        np.negative(attraction, dtype=np.float64),
        np.zeros(len(pairs) + 1, dtype=np.intp),
        np.zeros(len(pairs), dtype=np.intp),
    )
    cluster, link, shared = np.arange(count), np.full(count, -1), np.full(count, -1)
    last, size, room = np.arange(count), np.ones(count, dtype=np.intp), np.empty((2, 2 * SAMPLED, 6))
    patches = np.ascontiguousarray(patches, dtype=np.float64)
    _merge_all(*borders, shared, patches, *body, link, last, size, room, cluster)
    return cluster


def cluster_by_mean_reference(
    count: int,
    pairs: Index,
    attraction: Array,
    lengths: Array,
    allowed: Callable[[list[int], list[int]], bool],
) -> Index:
    """Do as `cluster_by_mean` does, by dictionaries; `allowed` says whether two clusters may be one."""
    borders: list[dict[int, tuple[float, float]]] = [{} for _ in range(count)]
    heap: list[tuple[float, int, int, float]] = []
    for (i, j), weight, length in zip(pairs.tolist(), attraction.tolist(), lengths.tolist(), strict=True):
        borders[i][j] = borders[j][i] = (weight * length, length)
        if weight > 0.0:
            heap.append((-weight, i, j, length))
    heapq.heapify(heap)
    parent = np.arange(count)
    members = [[k] for k in range(count)]
    while heap:
        _, i, j, length = heapq.heappop(heap)
        if parent[i] != i or parent[j] != j or borders[i][j][1] != length:
            continue
        if not allowed(members[i], members[j]):
            borders[i][j] = borders[j][i] = (-length, length)
            continue
        if len(borders[i]) < len(borders[j]):
            i, j = j, i
        members[i] += members[j]
        parent[members[i]] = i
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
    return parent


@njit(cache=True, error_model="numpy")
def _merge_all(  # type: ignore[no-untyped-def]
    node,
    following,
    start,
    degree,
    total,
    length,
    repulsion,
    heap,
    place,
    shared,
    patches,
    least,
    hollow,
    rise,
    bend,
    share,
    link,
    last,
    size,
    room,
    cluster,
):
    """Do as `cluster_by_mean` says.

    Two sides of border e, 2e and 2e + 1, lie at the nodes `node` (2B,). The first side at each node is
    `start` (N,), the next at the same one `following` (2B,), −1 = none; `degree` (N,) is how many there are.
    `total` (B,) is attraction times length, and 0 the `length` of a border that is no more. The heap (1 + B,)
    holds its size and then the borders that attract, the most attractive at place 1; 0 is the `place` of the
    others. A cluster's nodes are its first one and those linked to it by `link` (N,), up to its `last`.
    """
    for e in range(len(place)):
        for side in range(2 * e, 2 * e + 2):
            following[side] = start[node[side]]
            start[node[side]] = side
        _put(heap, place, repulsion, node, e)
    while heap[0] > 0:
        e = heap[1]
        i, j = node[2 * e], node[2 * e + 1]
        repulsion[e] = 1.0
        _put(heap, place, repulsion, node, e)
        if size[i] >= least and size[j] >= least:
            first = room[0, : _gather(i, size[i], link, patches, room[0])]
            second = room[1, : _gather(j, size[j], link, patches, room[1])]
            if not (hollowness(first) > hollow and hollowness(second) > hollow) and not convex(
                first, second, rise, bend, share
            ):
                total[e] = -length[e]
                continue
        if degree[i] < degree[j] or (degree[i] == degree[j] and i > j):
            i, j = j, i
        length[e] = 0.0
        _unite(node, following, start, degree, total, length, repulsion, heap, place, shared, i, j)
        link[last[i]] = j
        last[i] = last[j]
        size[i] += size[j]
        cluster[j] = i
    for k in range(len(cluster)):
        while cluster[k] != cluster[cluster[k]]:
            cluster[k] = cluster[cluster[k]]


@njit(cache=True, error_model="numpy")
def _unite(  # type: ignore[no-untyped-def]
    node, following, start, degree, total, length, repulsion, heap, place, shared, i, j
):
    """Give the borders of cluster j to cluster i; those with a common neighbour become one.

    `shared` (N,) is room to work in: −1 before and after. The other arrays are as in `_merge_all`.
    """
    degree[i] -= 1
    side, before = start[i], -1
    while side >= 0:
        after = following[side]
        if length[side >> 1] > 0.0:
            shared[node[side ^ 1]] = side >> 1
            before = side
        elif before < 0:
            start[i] = after
        else:
            following[before] = after
        side = after
    side = start[j]
    while side >= 0:
        after, e = following[side], side >> 1
        if length[e] > 0.0:
            neighbour = node[side ^ 1]
            one = shared[neighbour]
            if one < 0:
                one = e
                node[side] = i
                following[side] = start[i]
                start[i] = side
                degree[i] += 1
            else:
                total[one] += total[e]
                length[one] += length[e]
                length[e] = 0.0
                repulsion[e] = 1.0
                _put(heap, place, repulsion, node, e)
                degree[neighbour] -= 1
            repulsion[one] = -total[one] / length[one]
            _put(heap, place, repulsion, node, one)
        side = after
    side = start[i]
    while side >= 0:
        shared[node[side ^ 1]] = -1
        side = following[side]


@njit(cache=True, error_model="numpy")
def _gather(first, size, link, patches, room):  # type: ignore[no-untyped-def]
    """Copy every so many patches of a cluster, from its first on by their links, and say how many."""
    every = size // SAMPLED if size > SAMPLED else 1
    node = first
    for k in range(size):
        if k % every == 0:
            for c in range(6):
                room[k // every, c] = patches[node, c]
        node = link[node]
    return (size + every - 1) // every


@njit(cache=True, error_model="numpy")
def _put(heap, place, repulsion, node, e):  # type: ignore[no-untyped-def]
    """Put a border in the place its attraction gives it, or take it out if it repels."""
    at = place[e]
    if repulsion[e] < 0.0:
        moved = e
        if at == 0:
            heap[0] += 1
            at = heap[0]
    else:
        if at == 0:
            return
        place[e] = 0
        moved = heap[heap[0]]
        heap[0] -= 1
        if moved == e:
            return
    while at > 1 and _before(repulsion, node, moved, heap[at >> 1]):
        heap[at] = heap[at >> 1]
        place[heap[at]] = at
        at >>= 1
    while True:
        below = 2 * at
        if below < heap[0] and _before(repulsion, node, heap[below + 1], heap[below]):
            below += 1
        if below > heap[0] or not _before(repulsion, node, heap[below], moved):
            break
        heap[at] = heap[below]
        place[heap[at]] = at
        at = below
    heap[at] = moved
    place[moved] = at


@njit(cache=True, error_model="numpy")
def _before(repulsion, node, e, other):  # type: ignore[no-untyped-def]
    """Whether a border attracts more than another; of two alike, whether it parts lower numbers."""
    if repulsion[e] != repulsion[other]:
        return repulsion[e] < repulsion[other]
    a, b, c, d = node[2 * e], node[2 * e + 1], node[2 * other], node[2 * other + 1]
    a, b = (a, b) if a < b else (b, a)
    c, d = (c, d) if c < d else (d, c)
    return a < c or (a == c and b < d)
