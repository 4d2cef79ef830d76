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
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from caryatid.config import VoxelConfig
from caryatid.geometry.shapes import Primitives, Shape
from caryatid.geometry.transforms import Array
from caryatid.runtime.parallel import for_each
from caryatid.sensing.solids import Filling, fill_layer
from caryatid.sensing.views import View
from caryatid.sensing.visibility import shown
from caryatid.sensing.voxel_map_kernels import enter_view, states_of, voxels_at

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

        A view weighs as much as `config.readings` readings.
        """
        low, high = (np.log(p / (1.0 - p)) for p in self.config.clamp)
        log_odds = np.clip(self.config.readings * _log_odds(self.config), low, high)
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
