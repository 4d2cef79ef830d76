"""Compiled loops over the graph of samples on a surface, each beside the plain reference it is held to."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from caryatid.geometry.transforms import Array

Index = NDArray[np.intp]


def nearest_seeds(count: int, edges: Index, costs: Array, seeds: Index) -> Index:
    """For each node of an undirected graph, which seed (0 … S−1) is nearest along the edges, −1 = none.

    Args:
        count: Number of nodes N.
        edges: Pairs of nodes (E, 2).
        costs: Length of each edge (E,), ≥ 0.
        seeds: Nodes (S,) to start from.
    """
    edges = np.ascontiguousarray(edges, dtype=np.intp)
    start = np.concatenate([[0], np.cumsum(np.bincount(edges.ravel(), minlength=count))])
    neighbour, length = np.empty(edges.size, dtype=np.intp), np.empty(edges.size)
    distance, owner = np.full(count, np.inf), np.full(count, -1)
    distance[seeds], owner[seeds[::-1]] = 0.0, np.arange(len(seeds))[::-1]
    costs = np.asarray(costs, dtype=np.float64)
    _spread(edges, costs, start, start[:-1].copy(), neighbour, length, distance, owner)
    return owner


def nearest_seeds_reference(count: int, edges: Index, costs: Array, seeds: Index) -> Index:
    """Do as `nearest_seeds` does, by one Dijkstra a seed."""
    graph = coo_array((np.maximum(costs, 1e-12), (edges[:, 0], edges[:, 1])), shape=(count, count)).tocsr()
    distance = dijkstra(graph, directed=False, indices=seeds)
    return np.where(np.isfinite(distance).any(axis=0), np.argmin(distance, axis=0), -1)


@njit(cache=True)
def _spread(edges, costs, start, free, neighbour, length, distance, owner):  # type: ignore[no-untyped-def]
    """Relax edges in sweeps back and forth until nothing changes (Bellman and Ford).

    The neighbours of node i are to be neighbour[start[i]:start[i + 1]], at the lengths beside them.
    """
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
            best, best_owner = distance[node], owner[node]
            for at in range(start[node], start[node + 1]):
                other = neighbour[at]
                through = distance[other] + length[at]
                if through < best:
                    best, best_owner = through, owner[other]
            if best < distance[node]:
                distance[node], owner[node] = best, best_owner
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
    first, second = owner[edges[:, 0]], owner[edges[:, 1]]
    across = (first != second) & (first >= 0) & (second >= 0)
    first, second = first[across], second[across]
    low, high = np.minimum(first, second), np.maximum(first, second)
    start = np.concatenate([[0], np.cumsum(np.bincount(low, minlength=owners))])
    higher, times, end = np.zeros(len(low), dtype=np.intp), np.zeros(len(low)), start[:-1].copy()
    _count(low, high, start, end, higher, times)
    found = times > 0.0
    pairs = np.stack([np.repeat(np.arange(owners), end - start[:-1]), higher[found]], axis=-1)
    return pairs, times[found]


def count_borders_reference(owner: Index, edges: Index, owners: int) -> tuple[Index, Array]:
    """Do as `count_borders` does, by `numpy.unique`."""
    ends = owner[edges]
    across = (ends[:, 0] != ends[:, 1]) & (ends >= 0).all(axis=1)
    keys, lengths = np.unique(
        ends[across].min(axis=1) * owners + ends[across].max(axis=1), return_counts=True
    )
    return np.stack(np.divmod(keys, owners), axis=-1), lengths.astype(np.float64)


@njit(cache=True)
def _count(low, high, start, end, higher, times):  # type: ignore[no-untyped-def]
    """Count for each owner the higher ones, which are kept in ascending order.

    Those of owner i are to be higher[start[i]:end[i]], as often as it says beside them.
    """
    for e in range(len(low)):
        i, j = low[e], high[e]
        at = end[i]
        while at > start[i] and higher[at - 1] >= j:
            at -= 1
        if at == end[i] or higher[at] != j:
            for k in range(end[i], at, -1):
                higher[k], times[k] = higher[k - 1], times[k - 1]
            higher[at], times[at] = j, 0.0
            end[i] += 1
        times[at] += 1.0


def bent_lengths(points: Array, normals: Array, edges: Index) -> tuple[Array, Array]:
    """How long each edge (E,) [m] is, and how far the normal turns along it: 1 − cosine.

    Args:
        points: Nodes (N, 3) [m].
        normals: Unit normals (N, 3).
        edges: Pairs of nodes (E, 2).
    """
    lengths, turns = np.empty(len(edges)), np.empty(len(edges))
    points, normals = (np.ascontiguousarray(v, dtype=np.float64) for v in (points, normals))
    _measure(points, normals, np.ascontiguousarray(edges, dtype=np.intp), lengths, turns)
    return lengths, turns


@njit(cache=True)
def _measure(points, normals, edges, lengths, turns):  # type: ignore[no-untyped-def]
    """Write the lengths and turns (E,)."""
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        square, cosine = 0.0, 0.0
        for axis in range(3):
            square += (points[i, axis] - points[j, axis]) ** 2
            cosine += normals[i, axis] * normals[j, axis]
        lengths[e], turns[e] = math.sqrt(square), 1.0 - cosine
