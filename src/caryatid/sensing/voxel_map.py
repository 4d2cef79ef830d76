"""The voxel map: which space around the scene has been seen free, seen occupied, or not seen at all.

Each voxel counts the views that hit it (a reading ends in it) and the views that looked through it (a ray
crosses it and none ends in it: within a view a hit wins). Over several views it is occupied while
log-odds of `config.hit` and `config.miss` sum to more than nought: with 0.7 and 0.4 one hit outweighs two
views that looked through. So a surface outlives a registration error that puts it a voxel off in the next
views, and a stray reading is gone after three views. A ray ends `config.margin` short of its reading, so
noise in depth never carves the surface it hits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple, TypeVar

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from caryatid.config import VoxelConfig
from caryatid.geometry.rays import Grid, Triple, Voxel, room, traverse
from caryatid.geometry.shapes import Primitives, Shape
from caryatid.geometry.signed_distance import signed_distance
from caryatid.geometry.transforms import Array
from caryatid.runtime.parallel import for_each
from caryatid.sensing.views import View
from caryatid.sensing.visibility import shown

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


class Filling(NamedTuple):
    """A grid to be filled with shapes.

    Attributes:
        grid: What is solid (X, Y, Z), not 0 = solid; written to.
        origin: Corner (3,) [m] of its voxel [0, 0, 0].
        size: Edge of a voxel [m].
        kinds: Codes (S,) of the shapes.
        R: Their axes (S, 3, 3), columns = x, y, z of the object.
        centres: (S, 3) [m].
        half: Half extents (S, 3) [m] along the axes.
        low: First voxel (S, 3) of the box around each shape, within the grid.
        high: The voxel (S, 3) after its last.
    """

    grid: Grid
    origin: Array
    size: float
    kinds: NDArray[np.int64]
    R: Array
    centres: Array
    half: Array
    low: NDArray[np.int64]
    high: NDArray[np.int64]


@njit(cache=True, error_model="numpy")
def fill_layer(x: int, filling: Filling) -> None:
    """Mark the voxels of one layer of the grid whose centres are inside a shape."""
    R, half, size = filling.R, filling.half, filling.size
    for s in range(len(filling.kinds)):
        if not filling.low[s, 0] <= x < filling.high[s, 0]:
            continue
        u = filling.origin[0] + (x + 0.5) * size - filling.centres[s, 0]
        for y in range(filling.low[s, 1], filling.high[s, 1]):
            v = filling.origin[1] + (y + 0.5) * size - filling.centres[s, 1]
            for z in range(filling.low[s, 2], filling.high[s, 2]):
                w = filling.origin[2] + (z + 0.5) * size - filling.centres[s, 2]
                a = R[s, 0, 0] * u + R[s, 1, 0] * v + R[s, 2, 0] * w
                b = R[s, 0, 1] * u + R[s, 1, 1] * v + R[s, 2, 1] * w
                c = R[s, 0, 2] * u + R[s, 1, 2] * v + R[s, 2, 2] * w
                if signed_distance(filling.kinds[s], a, b, c, half[s, 0], half[s, 1], half[s, 2]) < 0.0:
                    filling.grid[x, y, z] = 1


Number = TypeVar("Number", np.int8, np.float32)
"""What a lookup table holds."""

UNKNOWN, FREE, OCCUPIED = 0, 1, 2
"""States of a voxel."""


@dataclass(frozen=True, eq=False)
class VoxelMap:
    """A dense voxel grid in a bounded box.

    Attributes:
        origin_world: Corner (3,) [m] of voxel [0, 0, 0]; the grid's axes are the world's.
        hits: Views (X, Y, Z) that had a reading in the voxel.
        passes: Views (X, Y, Z) that looked through it.
        config: Size and evidence.
    """

    origin_world: Array
    hits: NDArray[np.uint8]
    passes: NDArray[np.uint8]
    config: VoxelConfig

    @classmethod
    def around(cls, center_world: ArrayLike, config: VoxelConfig) -> VoxelMap:
        """Build a map in which nothing is known, around the view sphere's centre.

        Args:
            center_world: The middle of the table top (3,) [m].
            config: Size of the map and of its voxels, and the evidence.
        """
        extent = np.asarray(config.extent, dtype=np.float64)
        shape = tuple(int(n) for n in np.ceil(extent / config.size - 1e-9))
        corner = np.array([-extent[0] / 2.0, -extent[1] / 2.0, -config.below])
        empty = np.zeros(shape, dtype=np.uint8)
        return cls(np.asarray(center_world, dtype=np.float64) + corner, empty, empty, config)

    @property
    def states(self) -> NDArray[np.int8]:
        """State (X, Y, Z) of each voxel: 0 unknown, 1 free, 2 occupied."""
        return self._known[0]

    @property
    def occupied(self) -> NDArray[np.intp]:
        """Indices x, y, z (3, N) of the occupied voxels."""
        return self._known[1]

    @cached_property
    def _known(self) -> tuple[NDArray[np.int8], NDArray[np.intp]]:
        """States of the voxels, and where they are occupied."""
        return states_of(self.hits, self.passes, _states(self.config), OCCUPIED)

    @property
    def occupancy(self) -> NDArray[np.float32]:
        """Probability (X, Y, Z) that a voxel is occupied: 0.5 where nothing is known, else within the clamp.

        A view weighs as much as five images of a moving camera, from which the usual clamp is: as many misses
        reach its lower end.
        """
        low, high = (np.log(p / (1.0 - p)) for p in (0.12, 0.97))
        log_odds = np.clip(5.0 * _log_odds(self.config), low, high)
        return self._looked_up((1.0 / (1.0 + np.exp(-log_odds))).astype(np.float32))

    @property
    def end_world(self) -> Array:
        """Corner (3,) [m] opposite to the origin."""
        return self.origin_world + self.config.size * np.array(self.hits.shape)

    def integrate(self, view: View, max_depth: float) -> VoxelMap:
        """Return the map with one more view: free along its rays, occupied where they end.

        Args:
            view: A view with a pose. Pixels without a reading say nothing.
            max_depth: Readings beyond this count as free space up to this depth [m].
        """
        hits, passes = enter_view(
            self.hits,
            self.passes,
            view.depth,
            view.K,
            np.ascontiguousarray(view.pose),
            self.origin_world,
            self.config.size,
            self.config.stride,
            self.config.margin,
            float(max_depth),
        )
        return VoxelMap(self.origin_world, hits, passes, self.config)

    def solid(self, shapes: Sequence[Shape] = ()) -> Solid:
        """What blocks lines of sight: the voxels seen occupied, and everything inside the shapes.

        Args:
            shapes: Fitted shapes in the world frame: what is hidden of them hides what is behind.
        """
        arrays, size = Primitives.of(shapes), self.config.size
        low, high = ((corner - self.origin_world) / size for corner in arrays.bounds())
        low = np.clip(np.floor(low).astype(np.int64), 0, self.hits.shape)
        high = np.clip(np.ceil(high).astype(np.int64), 0, self.hits.shape)
        some = (low < high).all(axis=1)
        beyond = max(self.hits.shape)
        lowest = low[some].min(axis=0, initial=beyond)
        lowest = np.minimum(lowest, self.occupied.min(axis=1, initial=beyond))
        highest = high[some].max(axis=0, initial=0)
        highest = np.maximum(highest, self.occupied.max(axis=1, initial=-1) + 1)
        grid = np.zeros(np.maximum(highest - lowest, 0), dtype=np.uint8)
        grid[tuple(self.occupied - lowest[:, None])] = 1
        origin_world = self.origin_world + size * lowest
        for_each(
            fill_layer, len(grid), Filling(grid, origin_world, size, *arrays, low - lowest, high - lowest)
        )
        return Solid(origin_world, grid, self)

    def cut(self, low_world: Array, high_world: Array) -> VoxelMap:
        """Return the part of the map whose voxels lie, all or in part, between two corners.

        Args:
            low_world: The lower corner (3,) [m].
            high_world: The upper corner (3,) [m].
        """
        ends = (low_world - self.origin_world, high_world - self.origin_world)
        low = np.clip(np.floor(ends[0] / self.config.size + 1e-9).astype(int), 0, self.hits.shape)
        high = np.clip(np.ceil(ends[1] / self.config.size - 1e-9).astype(int), low, self.hits.shape)
        window = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        origin_world = self.origin_world + self.config.size * low
        hits, passes = (np.ascontiguousarray(counts[window]) for counts in (self.hits, self.passes))
        return VoxelMap(origin_world, hits, passes, self.config)

    def centres_world(self, index: NDArray[np.integer]) -> Array:
        """Centres (N, 3) [m] of the voxels with these indices (N, 3)."""
        return self.origin_world + (index + 0.5) * self.config.size

    def state_at(self, points_world: Array) -> NDArray[np.int8]:
        """State (N,) of the voxels that hold points (N, 3) [m]; 0 outside the map."""
        points = np.ascontiguousarray(points_world)
        index = voxels_at(points, self.origin_world, self.config.size, self.hits.shape)
        inside = index >= 0
        held = index[inside]
        states = np.full(len(index), UNKNOWN, dtype=np.int8)
        states[inside] = self.states.reshape(-1)[held]
        return states

    def _looked_up(self, table: NDArray[Number]) -> NDArray[Number]:
        """Value of each voxel (X, Y, Z) in a table (256, 256) as `_log_odds`."""
        return np.take(table.ravel(), self.passes.astype(np.uint16) * np.uint16(256) + self.hits)


@dataclass(frozen=True, eq=False, slots=True)
class Solid:
    """What stands in the way of looks.

    Attributes:
        origin_world: Corner (3,) [m] of voxel [0, 0, 0] of the grid.
        grid: 1 where a voxel is solid (X, Y, Z), 0 elsewhere; outside nothing is.
        voxels: The map it is of.
    """

    origin_world: Array
    grid: NDArray[np.uint8]
    voxels: VoxelMap

    def holds(self, points_world: Array) -> NDArray[np.bool_]:
        """Whether points (N, 3) [m] lie in solid voxels (N,)."""
        points = np.ascontiguousarray(points_world)
        index = voxels_at(points, self.origin_world, self.voxels.config.size, self.grid.shape)
        inside = index >= 0
        inside[inside] = self.grid.ravel()[index[inside]] > 0
        return inside

    def blocked(self, points_world: Array, targets_world: Array, clearance: float) -> NDArray[np.bool_]:
        """Test lines of sight.

        Args:
            points_world: Points of interest (P, 3) [m].
            targets_world: Camera positions (T, 3) [m].
            clearance: Solid voxels this near to the point do not count [m]: its own surface.

        Returns:
            (P, T), True where something stands between.
        """
        points = np.ascontiguousarray(points_world, dtype=np.float64)
        targets = np.ascontiguousarray(np.transpose(targets_world), dtype=np.float64)
        anywhere, known, worth = np.zeros_like(points), np.zeros(len(points)), np.ones(len(points))
        free = shown(
            self.grid, self.origin_world, self.voxels.config.size, points, anywhere, known, worth,
            targets, np.zeros_like(targets), float(clearance), 1.0, -1.0,
        )  # fmt: skip
        return free == 0.0


@cache
def _log_odds(config: VoxelConfig) -> Array:
    """Log-odds of being occupied (256, 256) by how many views looked through and how many hit."""
    hit = np.log(config.hit / (1.0 - config.hit))
    miss = np.log(config.miss / (1.0 - config.miss))
    return np.arange(256) * hit + np.arange(256)[:, None] * miss


@cache
def _states(config: VoxelConfig) -> NDArray[np.int8]:
    """State (256, 256) by how many views looked through and how many hit; without a hit none is occupied."""
    states = np.where(_log_odds(config) <= 0.0, FREE, OCCUPIED).astype(np.int8)
    states[:, 0] = FREE
    states[0, 0] = UNKNOWN
    return states
