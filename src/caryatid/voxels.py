"""The voxel map: which space around the scene has been seen free, seen occupied, or not seen at all.

Each voxel counts the views that hit it (a reading ends in it) and the views that looked through it (a ray
crosses it and none ends in it: within a view a hit wins). Over several views it is occupied while
log-odds of `config.hit` and `config.miss` sum to more than nought: with 0.7 and 0.4 one hit outweighs two
views that looked through. So a surface outlives a registration error that puts it a voxel off in the next
views, and a stray reading is gone after three views. A ray ends `config.margin` short of its reading, so
noise in depth never carves the surface it hits.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from caryatid import frames
from caryatid.config import VoxelConfig
from caryatid.frames import Array
from caryatid.kernels import rays
from caryatid.shapes import Shape
from caryatid.views import View

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
        """Build a map in which nothing is known, around the view sphere's centre (3,) [m]."""
        extent = np.asarray(config.extent, dtype=np.float64)
        shape = tuple(int(n) for n in np.ceil(extent / config.size - 1e-9))
        corner = np.array([-extent[0] / 2.0, -extent[1] / 2.0, -config.below])
        empty = np.zeros(shape, dtype=np.uint8)
        return cls(np.asarray(center_world, dtype=np.float64) + corner, empty, empty, config)

    @cached_property
    def states(self) -> NDArray[np.int8]:
        """State (X, Y, Z) of each voxel: 0 unknown, 1 free, 2 occupied."""
        table = np.where(self._log_odds() <= 0.0, FREE, OCCUPIED).astype(np.int8)
        table[0, 0] = UNKNOWN
        return self._looked_up(table)

    @property
    def occupancy(self) -> NDArray[np.float32]:
        """Probability (X, Y, Z) that a voxel is occupied: 0.5 where nothing is known, else within the clamp.

        A view weighs as much as `config.readings` readings.
        """
        low, high = (np.log(p / (1.0 - p)) for p in self.config.clamp)
        log_odds = np.clip(self.config.readings * self._log_odds(), low, high)
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
        T_world_camera = view.pose
        stride = self.config.stride
        points_camera = view.points_camera[::stride, ::stride].reshape(-1, 3)
        points_camera = points_camera[points_camera[:, 2] > 0.0]
        depth = points_camera[:, 2]
        near = depth <= max_depth
        ends_world = frames.transform(T_world_camera, points_camera)
        length = np.linalg.norm(points_camera, axis=-1)
        share = np.where(near, 1.0 - self.config.margin / length, max_depth / depth)
        passed = np.zeros(self.hits.shape, dtype=np.uint8)
        eye_world = np.ascontiguousarray(T_world_camera[:3, 3])
        rays.carve(passed, eye_world, ends_world, share, self.origin_world, self.config.size)
        hit = np.zeros(self.hits.shape, dtype=np.uint8)
        index, inside = self._index(ends_world[near])
        hit[tuple(index[inside].T)] = 1
        passed[hit > 0] = 0
        return VoxelMap(self.origin_world, _count(self.hits, hit), _count(self.passes, passed), self.config)

    def with_shapes(self, shapes: Iterable[Shape]) -> VoxelMap:
        """Return the map with everything inside the shapes occupied, as if seen from everywhere.

        Args:
            shapes: Fitted shapes in the world frame: what is hidden of them hides what is behind.
        """
        hits, passes = self.hits.copy(), self.passes.copy()
        axes = np.eye(3)
        for shape in shapes:
            centre, reach = shape.T_world_object[:3, 3], shape.support(axes)
            low = np.floor((centre - reach - self.origin_world) / self.config.size).astype(int)
            high = np.ceil((centre + reach - self.origin_world) / self.config.size).astype(int)
            low, high = np.clip(low, 0, hits.shape), np.clip(high, 0, hits.shape)
            if (low >= high).any():
                continue
            window = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
            points_world = self.centres_world(np.indices(high - low).reshape(3, -1).T + low)
            inside = (shape.signed_distance(points_world) < 0.0).reshape(high - low)
            hits[window][inside] = 1
            passes[window][inside] = 0
        return VoxelMap(self.origin_world, hits, passes, self.config)

    def cut(self, low_world: Array, high_world: Array) -> VoxelMap:
        """Return the part of the map whose voxels lie, all or in part, between two corners (3,) [m]."""
        ends = (low_world - self.origin_world, high_world - self.origin_world)
        low = np.clip(np.floor(ends[0] / self.config.size + 1e-9).astype(int), 0, self.hits.shape)
        high = np.clip(np.ceil(ends[1] / self.config.size - 1e-9).astype(int), low, self.hits.shape)
        window = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        origin_world = self.origin_world + self.config.size * low
        return VoxelMap(origin_world, self.hits[window], self.passes[window], self.config)

    def centres_world(self, index: NDArray[np.integer]) -> Array:
        """Centres (N, 3) [m] of the voxels with these indices (N, 3)."""
        return self.origin_world + (index + 0.5) * self.config.size

    def state_at(self, points_world: Array) -> NDArray[np.int8]:
        """State (N,) of the voxels that hold points (N, 3) [m]; 0 outside the map."""
        index, inside = self._index(points_world)
        state = np.zeros(len(points_world), dtype=np.int8)
        state[inside] = self.states[tuple(index[inside].T)]
        return state

    def blocked(
        self,
        points_world: Array,
        targets_world: Array,
        clearance: float,
        asked: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.bool_]:
        """Test lines of sight against the occupied voxels.

        Args:
            points_world: Points of interest (P, 3) [m].
            targets_world: Camera positions (T, 3) [m].
            clearance: Occupied voxels this near to the point do not count [m]: its own surface.
            asked: Which lines to test (P, T), or None for all; the others count as free.

        Returns:
            (P, T), True where something stands between.
        """
        grid, origin_world = self._occupied
        points, targets = (np.ascontiguousarray(a, dtype=np.float64) for a in (points_world, targets_world))
        if asked is None:
            asked = np.ones((len(points), len(targets)), dtype=np.bool_)
        return rays.blocked(grid, points, targets, asked, float(clearance), origin_world, self.config.size)

    @cached_property
    def _occupied(self) -> tuple[NDArray[np.uint8], Array]:
        """The occupied voxels, cut to the box around them, and that box's corner (3,) [m]."""
        occupied = self.states == OCCUPIED
        window = []
        for axis in range(3):
            filled = np.flatnonzero(occupied.any(axis=tuple({0, 1, 2} - {axis})))
            window.append(slice(filled[0], filled[-1] + 1) if len(filled) else slice(0, 1))
        corner = self.origin_world + self.config.size * np.array([w.start for w in window])
        return np.ascontiguousarray(occupied[tuple(window)], dtype=np.uint8), corner

    def _log_odds(self) -> Array:
        """Log-odds of being occupied (256, 256) by how many views looked through and how many hit."""
        hit = np.log(self.config.hit / (1.0 - self.config.hit))
        miss = np.log(self.config.miss / (1.0 - self.config.miss))
        return np.arange(256) * hit + np.arange(256)[:, None] * miss

    def _looked_up(self, table: NDArray[Number]) -> NDArray[Number]:
        """Value of each voxel (X, Y, Z) in a table (256, 256) as `_log_odds`."""
        return np.take(table.ravel(), self.passes.astype(np.uint16) * np.uint16(256) + self.hits)

    def _index(self, points_world: Array) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        index = np.floor((points_world - self.origin_world) / self.config.size).astype(np.intp)
        inside = np.logical_and(index >= 0, index < self.hits.shape)
        return index, np.all(inside, axis=-1)


def _count(total: NDArray[np.uint8], once: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Add, staying at 255."""
    return total + np.minimum(once, 255 - total)
