"""Compiled loops over depth images and sample graphs, each beside the plain reference it is held to."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from caryatid.frames import Array

Image = NDArray[np.float32]


def inverse_depth_normals(
    inverse_depth: Image, K: Array, radius: int, edge_jump: float, max_slope: float
) -> Image:
    """Normals (H, W, 3) in the camera frame, towards the camera, zero where too few readings agree.

    Fits 1/z = a·du + b·dv + c by least squares to each pixel's window.

    Args:
        inverse_depth: 1/z (H, W) [1/m], 0 = no reading.
        K: Pinhole matrix (3, 3) [px].
        radius: The window is 2·radius + 1 pixels wide [px].
        edge_jump: Readings further than this from the pixel's own lie beyond a depth edge [1/m].
        max_slope: Added to it a pixel of distance, so that steep surfaces hold together [1/m per px].
    """
    image = np.ascontiguousarray(inverse_depth, dtype=np.float32)
    a, b, c = _window_planes(image, radius, np.float32(edge_jump), np.float32(max_slope))
    return _plane_normals(a, b, c, K)


def inverse_depth_normals_reference(
    inverse_depth: Image, K: Array, radius: int, edge_jump: float, max_slope: float
) -> Image:
    """Do as `inverse_depth_normals` does, by NumPy over all the windows at once in double precision."""
    side = 2 * radius + 1
    padded = np.pad(inverse_depth.astype(np.float64), radius)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (side, side))
    dv, du = np.mgrid[-radius : radius + 1, -radius : radius + 1].astype(np.float64)
    own = inverse_depth.astype(np.float64)[:, :, None, None]
    allowed = edge_jump + max_slope * np.maximum(np.abs(du), np.abs(dv))
    weight = ((windows > 0) & (own > 0) & (np.abs(windows - own) <= allowed)).astype(np.float64)
    terms = np.stack([np.ones_like(du), du, dv])
    moments = np.einsum("hwij,aij,bij->hwab", weight, terms, terms)
    right = np.einsum("hwij,hwij,aij->hwa", weight, windows, terms)
    enough = (moments[..., 0, 0] >= side * side / 4.0) & (np.linalg.det(moments) > 0.5)
    moments[~enough] = np.eye(3)
    solution = np.linalg.solve(moments, right[..., None])[..., 0]
    solution[~enough] = 0.0
    c, a, b = np.moveaxis(solution, -1, 0)
    return _plane_normals(a.astype(np.float32), b.astype(np.float32), c.astype(np.float32), K)


def _plane_normals(a: Image, b: Image, c: Image, K: Array) -> Image:
    """Turn planes of inverse depth into unit normals: n ∝ −(a·fx, b·fy, c − a·(u−cx) − b·(v−cy))."""
    height, width = c.shape
    u = (np.arange(width) - K[0, 2]).astype(np.float32)[None, :]
    v = (np.arange(height) - K[1, 2]).astype(np.float32)[:, None]
    normals = np.empty((height, width, 3), dtype=np.float32)
    normals[..., 0] = a * np.float32(-K[0, 0])
    normals[..., 1] = b * np.float32(-K[1, 1])
    normals[..., 2] = a * u + b * v - c
    length = np.sqrt(np.einsum("hwi,hwi->hw", normals, normals))
    length[c <= 0.0] = np.inf
    normals /= length[..., None]
    return normals


@njit(cache=True)
def _window_planes(image, radius, edge_jump, max_slope):  # type: ignore[no-untyped-def]
    """Coefficients of 1/z = a·du + b·dv + c over each pixel's window; c = 0 where readings are too few."""
    height, width = image.shape
    a = np.zeros((height, width), np.float32)
    b = np.zeros((height, width), np.float32)
    c = np.zeros((height, width), np.float32)
    zero, one = np.float32(0.0), np.float32(1.0)
    side = 2 * radius + 1
    enough = np.float32(side * side / 4.0)
    padded = np.zeros(width + 2 * radius, np.float32)
    sums = np.zeros((9, width), np.float32)
    for row in range(height):
        sums[:] = zero
        own = image[row]
        for dv in range(-radius, radius + 1):
            if row + dv < 0 or row + dv >= height:
                continue
            padded[radius : radius + width] = image[row + dv]
            fv = np.float32(dv)
            for du in range(-radius, radius + 1):
                fu = np.float32(du)
                allowed = edge_jump + max_slope * np.float32(max(abs(du), abs(dv)))
                for col in range(width):
                    other = padded[col + radius + du]
                    difference = other - own[col]
                    near = abs(difference) <= allowed and other > zero
                    weight = one if near else zero
                    weighted = weight * difference
                    sums[0, col] += weight
                    sums[1, col] += weight * fu
                    sums[2, col] += weight * fv
                    sums[3, col] += weight * (fu * fu)
                    sums[4, col] += weight * (fu * fv)
                    sums[5, col] += weight * (fv * fv)
                    sums[6, col] += weighted
                    sums[7, col] += weighted * fu
                    sums[8, col] += weighted * fv
        for col in range(width):
            n = sums[0, col]
            if own[col] <= zero or n < enough:
                continue
            mean_u, mean_v, mean_w = sums[1, col] / n, sums[2, col] / n, sums[6, col] / n
            uu = sums[3, col] - n * mean_u * mean_u
            uv = sums[4, col] - n * mean_u * mean_v
            vv = sums[5, col] - n * mean_v * mean_v
            uw = sums[7, col] - n * mean_u * mean_w
            vw = sums[8, col] - n * mean_v * mean_w
            determinant = uu * vv - uv * uv
            if n * determinant <= np.float32(0.5):
                continue
            slope_u = (uw * vv - vw * uv) / determinant
            slope_v = (vw * uu - uw * uv) / determinant
            a[row, col] = slope_u
            b[row, col] = slope_v
            c[row, col] = own[col] + mean_w - slope_u * mean_u - slope_v * mean_v
    return a, b, c


def nearest_seeds(
    count: int, edges: NDArray[np.intp], costs: Array, seeds: NDArray[np.intp]
) -> NDArray[np.intp]:
    """For each node of an undirected graph, which seed (0 … S−1) is nearest along the edges, −1 = none.

    Args:
        count: Number of nodes N.
        edges: Pairs of nodes (E, 2).
        costs: Length of each edge (E,), ≥ 0.
        seeds: Nodes (S,) to start from.
    """
    start, neighbour, length = _adjacency(count, edges, costs)
    return _spread(start, neighbour, length, np.asarray(seeds, dtype=np.intp))


def nearest_seeds_reference(
    count: int, edges: NDArray[np.intp], costs: Array, seeds: NDArray[np.intp]
) -> NDArray[np.intp]:
    """Do as `nearest_seeds` does, by one Dijkstra a seed."""
    graph = coo_array((np.maximum(costs, 1e-12), (edges[:, 0], edges[:, 1])), shape=(count, count)).tocsr()
    distance = dijkstra(graph, directed=False, indices=seeds)
    return np.where(np.isfinite(distance).any(axis=0), np.argmin(distance, axis=0), -1)


def _adjacency(
    count: int, edges: NDArray[np.intp], costs: Array
) -> tuple[NDArray[np.intp], NDArray[np.intp], Array]:
    """Neighbour lists: those of node i are neighbour[start[i]:start[i + 1]], at the lengths beside them."""
    both = coo_array(
        (np.concatenate([costs, costs]), (edges.T.ravel(), edges[:, ::-1].T.ravel())), shape=(count, count)
    ).tocsr()
    return both.indptr.astype(np.intp), both.indices.astype(np.intp), both.data.astype(np.float64)


@njit(cache=True)
def _spread(start, neighbour, length, seeds):  # type: ignore[no-untyped-def]
    """Relax edges in sweeps back and forth until nothing changes (Bellman and Ford)."""
    count = len(start) - 1
    distance = np.full(count, np.inf)
    owner = np.full(count, -1, np.intp)
    for k in range(len(seeds)):
        if distance[seeds[k]] > 0.0:
            distance[seeds[k]] = 0.0
            owner[seeds[k]] = k
    changed, forward = True, True
    while changed:
        changed = False
        for step in range(count):
            node = step if forward else count - 1 - step
            best, best_owner = distance[node], owner[node]
            for j in range(start[node], start[node + 1]):
                other = neighbour[j]
                through = distance[other] + length[j]
                if through < best:
                    best, best_owner = through, owner[other]
            if best < distance[node]:
                distance[node], owner[node] = best, best_owner
                changed = True
        forward = not forward
    return owner
