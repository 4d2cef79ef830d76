"""Compiled passes over the voxel map, each beside the plain NumPy reference it is tested against."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.geometry.rays import Grid, Triple, Voxel, room, traverse, traversed_reference
from caryatid.geometry.transforms import Array
from caryatid.runtime.parallel import for_each

MOST = np.uint8(255)
"""Counts go no further."""
TILE = 8
"""Rays along each side of the tiles an image is cut into: neighbours meet the same voxels [1]."""
SHARES = 64
"""Parts the tiles are dealt out to in turn, so that every thread has as much to do [1]."""


class Entry(NamedTuple):
    """A view that is entered into a voxel map.

    Attributes:
        depth: Depth image (H, W) [m], 0 = no reading.
        K: Pinhole matrix (3, 3) [px].
        T_world_camera: Its pose (4, 4).
        origin: Corner (3,) [m] of voxel [0, 0, 0].
        size: Edge of a voxel [m].
        stride: Pixels between the rays that are followed.
        margin: Length before a reading that its ray does not clear [m].
        max_depth: Readings beyond this count as free space up to this depth [m].
        hits: Views (X, Y, Z) that had a reading in each voxel.
        passes: Views (X, Y, Z) that looked through it.
        new_hits: 0 at first (X, Y, Z), 1 where a reading ends, then `hits` with this view; written to.
        new_passes: 0 at first (X, Y, Z), 1 where a ray passes, then `passes` with this view; written to.
    """

    depth: NDArray[np.float32]
    K: Array
    T_world_camera: Array
    origin: Array
    size: float
    stride: int
    margin: float
    max_depth: float
    hits: Grid
    passes: Grid
    new_hits: Grid
    new_passes: Grid


def enter_view(
    hits: Grid,
    passes: Grid,
    depth: NDArray[np.float32],
    K: Array,
    T_world_camera: Array,
    origin: Array,
    size: float,
    stride: int,
    margin: float,
    max_depth: float,
) -> tuple[Grid, Grid]:
    """Count one more view in the voxels its rays traverse and those its readings end in; of both the latter.

    The arguments are as in `Entry`.

    Returns:
        The new counts of hits and of passes; they stay at 255.
    """
    entry = Entry(
        np.ascontiguousarray(depth, dtype=np.float32),
        np.ascontiguousarray(K, dtype=np.float64),
        np.ascontiguousarray(T_world_camera, dtype=np.float64),
        origin,
        float(size),
        int(stride),
        float(margin),
        float(max_depth),
        hits,
        passes,
        np.zeros_like(hits),
        np.zeros_like(passes),
    )
    for_each(look_through, SHARES, entry)
    for_each(end_in, -(-len(depth) // stride), entry)
    for_each(count, len(hits), entry)
    return entry.new_hits, entry.new_passes


@njit(cache=True, error_model="numpy")
def look_through(share: int, entry: Entry) -> None:
    """Mark what the rays of every so manieth tile of the image traverse."""
    height, width = entry.depth.shape
    rows, columns = (height + entry.stride - 1) // entry.stride, (width + entry.stride - 1) // entry.stride
    across = (columns + TILE - 1) // TILE
    T, shape, size = entry.T_world_camera, entry.hits.shape, entry.size
    passed = entry.new_passes.reshape(-1)
    start = (
        (T[0, 3] - entry.origin[0]) / size,
        (T[1, 3] - entry.origin[1]) / size,
        (T[2, 3] - entry.origin[2]) / size,
    )
    found = room(shape)
    for tile in range(share, (rows + TILE - 1) // TILE * across, SHARES):
        top, left = tile // across * TILE, tile % across * TILE
        for row in range(top, min(top + TILE, rows)):
            for column in range(left, min(left + TILE, columns)):
                (x, y, z), length, depth = _ray(entry, column * entry.stride, row * entry.stride)
                if depth <= 0.0:
                    continue
                far = depth > entry.max_depth
                t_to = entry.max_depth / depth if far else 1.0 - entry.margin / length
                slabs = traverse(found, shape, start, (x / size, y / size, z / size), 0.0, t_to)
                for n in range(slabs):
                    passed[np.uint32(found[0, n])] = 1
                    passed[np.uint32(found[1, n])] = 1
                    passed[np.uint32(found[2, n])] = 1


@njit(cache=True, error_model="numpy")
def end_in(row: int, entry: Entry) -> None:
    """Mark the voxels in which the rays of one row of the image end."""
    T, shape, size = entry.T_world_camera, entry.hits.shape, entry.size
    for u in range(0, entry.depth.shape[1], entry.stride):
        (x, y, z), _, depth = _ray(entry, u, row * entry.stride)
        i = int(np.floor((T[0, 3] + x - entry.origin[0]) / size))
        j = int(np.floor((T[1, 3] + y - entry.origin[1]) / size))
        k = int(np.floor((T[2, 3] + z - entry.origin[2]) / size))
        inside = 0 <= i < shape[0] and 0 <= j < shape[1] and 0 <= k < shape[2]
        if inside and 0.0 < depth <= entry.max_depth:
            entry.new_hits[i, j, k] = 1


@njit(cache=True)
def count(layer: int, entry: Entry) -> None:
    """Turn the marks in one layer of the map into counts, 255 at the most; no ray passes where one ends."""
    hits, passes = entry.hits[layer].reshape(-1), entry.passes[layer].reshape(-1)
    new_hits, new_passes = entry.new_hits[layer].reshape(-1), entry.new_passes[layer].reshape(-1)
    for n in range(len(hits)):
        hit, passed = new_hits[n], new_passes[n]
        new_hits[n] = hits[n] + np.uint8((hit > 0) & (hits[n] < MOST))
        new_passes[n] = passes[n] + np.uint8((passed > hit) & (passes[n] < MOST))


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _ray(entry: Entry, u: int, v: int) -> tuple[Triple, float, float]:
    """Way [m] along the world's axes from the camera to a pixel's reading, its length and its depth."""
    z = float(entry.depth[v, u])
    K, R = entry.K, entry.T_world_camera
    x, y = (u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z
    ray = (
        R[0, 0] * x + R[0, 1] * y + R[0, 2] * z,
        R[1, 0] * x + R[1, 1] * y + R[1, 2] * z,
        R[2, 0] * x + R[2, 1] * y + R[2, 2] * z,
    )
    return ray, np.sqrt(x * x + y * y + z * z), z


def enter_view_reference(
    hits: Grid,
    passes: Grid,
    depth: NDArray[np.float32],
    K: Array,
    T_world_camera: Array,
    origin: Array,
    size: float,
    stride: int,
    margin: float,
    max_depth: float,
) -> tuple[Grid, Grid]:
    """Do the same as `enter_view`, ray by ray from all crossings with the grid's planes."""
    hit, passed = np.zeros(hits.shape, dtype=np.bool_), np.zeros(hits.shape, dtype=np.bool_)
    eye = T_world_camera[:3, 3]
    for v in range(0, depth.shape[0], stride):
        for u in range(0, depth.shape[1], stride):
            z = float(depth[v, u])
            if z <= 0.0:
                continue
            point_camera = np.linalg.solve(K, np.array([u, v, 1.0])) * z
            end = eye + T_world_camera[:3, :3] @ point_camera
            t_to = max_depth / z if z > max_depth else 1.0 - margin / float(np.linalg.norm(point_camera))
            passed[tuple(traversed_reference(hits.shape, eye, end, 0.0, t_to, origin, size).T)] = True
            voxel = np.floor((end - origin) / size).astype(np.intp)
            if z <= max_depth and (voxel >= 0).all() and (voxel < hits.shape).all():
                hit[tuple(voxel)] = True
    total = (
        np.minimum(hits.astype(np.int64) + hit, 255),
        np.minimum(passes + (passed & ~hit).astype(int), 255),
    )
    return total[0].astype(np.uint8), total[1].astype(np.uint8)


class Known(NamedTuple):
    """What a voxel map comes to know.

    Attributes:
        hits: Views (X, Y, Z) that had a reading in each voxel.
        passes: Views (X, Y, Z) that looked through it.
        table: State (256, 256) by how many views looked through and how many hit; without a hit the same
            however many looked through.
        states: State (X, Y, Z) of each voxel; written to.
        sought: The state whose voxels are counted; one that takes a hit.
        counts: Voxels of that state in each layer (X,); written to.
    """

    hits: Grid
    passes: Grid
    table: NDArray[np.int8]
    states: NDArray[np.int8]
    sought: int
    counts: NDArray[np.intp]


class Found(NamedTuple):
    """Where the voxels of one state are.

    Attributes:
        states: State (X, Y, Z) of each voxel.
        sought: The state.
        ends: How many voxels of that state there are up to the end of each layer (X,).
        places: Their indices (3, N), in order; written to.
    """

    states: NDArray[np.int8]
    sought: int
    ends: NDArray[np.intp]
    places: NDArray[np.intp]


def states_of(
    hits: Grid, passes: Grid, table: NDArray[np.int8], sought: int
) -> tuple[NDArray[np.int8], NDArray[np.intp]]:
    """State of each voxel, and where one of the states is.

    The arguments are as in `Known`.

    Returns:
        States (X, Y, Z), and the indices (3, N) of the voxels whose state is sought.
    """
    hits, passes = np.ascontiguousarray(hits), np.ascontiguousarray(passes)
    counts = np.zeros(len(hits), dtype=np.intp)
    known = Known(hits, passes, table, np.empty(hits.shape, dtype=np.int8), sought, counts)
    for_each(look_up, len(hits), known)
    ends = np.cumsum(counts)
    index = np.empty((3, int(counts.sum())), dtype=np.intp)
    for_each(find, len(hits), Found(known.states, sought, ends, index))
    return known.states, index


def states_of_reference(
    hits: Grid, passes: Grid, table: NDArray[np.int8], sought: int
) -> tuple[NDArray[np.int8], NDArray[np.intp]]:
    """Do the same as `states_of` with arrays."""
    states = table[passes, hits]
    return states, np.stack(np.nonzero(states == sought))


@njit(cache=True)
def look_up(layer: int, known: Known) -> None:
    """Look up the states of one layer of the map."""
    hits, passes = known.hits[layer].reshape(-1), known.passes[layer].reshape(-1)
    states, table = known.states[layer].reshape(-1), known.table
    unknown, free = table[0, 0], table[1, 0]
    for n in range(len(hits)):
        states[n] = free if passes[n] > 0 else unknown
    # Nearly all voxels have no hit: all others without a look into the table take a quarter of the time.
    sought = 0
    for n in range(len(hits)):
        if hits[n] > 0:
            states[n] = table[passes[n], hits[n]]
            sought += states[n] == known.sought
    known.counts[layer] = sought


@njit(cache=True)
def find(layer: int, found: Found) -> None:
    """Write down where in one layer of the map the state is."""
    states = found.states[layer]
    n = found.ends[layer - 1] if layer > 0 else 0
    if n == found.ends[layer]:
        return
    for j in range(states.shape[0]):
        for k in range(states.shape[1]):
            if states[j, k] == found.sought:
                found.places[0, n], found.places[1, n], found.places[2, n] = layer, j, k
                n += 1


@njit(cache=True, error_model="numpy")
def voxels_at(points: Array, origin: Array, size: float, shape: Voxel) -> NDArray[np.intp]:
    """Flat index (N,) of the voxel of a grid that holds each point (N, 3) [m]; −1 outside.

    Args:
        points: (N, 3) [m].
        origin: Corner of the grid (3,) [m].
        size: Edge of a voxel [m].
        shape: Voxels along each axis.
    """
    index = np.empty(len(points), dtype=np.intp)
    for n in range(len(points)):
        i = int(np.floor((points[n, 0] - origin[0]) / size))
        j = int(np.floor((points[n, 1] - origin[1]) / size))
        k = int(np.floor((points[n, 2] - origin[2]) / size))
        inside = 0 <= i < shape[0] and 0 <= j < shape[1] and 0 <= k < shape[2]
        index[n] = (i * shape[1] + j) * shape[2] + k if inside else -1
    return index


def voxels_at_reference(points: Array, origin: Array, size: float, shape: Voxel) -> NDArray[np.intp]:
    """Do the same as `voxels_at` with arrays."""
    index = np.floor((points - origin) / size).astype(np.intp)
    inside = ((index >= 0) & (index < shape)).all(axis=1)
    return np.where(inside, np.ravel_multi_index(tuple(np.where(inside, index.T, 0)), shape), -1)
