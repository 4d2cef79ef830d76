"""The floor the robot drives on: where its platform may stand, how far it is, what walls hide."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.ndimage
import scipy.sparse.csgraph
import shapely
from numpy.typing import ArrayLike, NDArray

from caryatid.config import RobotConfig
from caryatid.geometry.shapes import Box
from caryatid.geometry.transforms import Array
from caryatid.support.stability import ground_outline

STEP = 0.02
"""Anything on the floor lower than this is no obstacle to the platform [m]."""

TABLE_MARGIN = 0.1
"""Furniture met this near to the view sphere's centre is the table, not a wall in the line of sight [m]."""


@dataclass(frozen=True, eq=False)
class FloorGrid:
    """A grid over the floor, indexed [row along y, column along x].

    Attributes:
        free: Cells (H, W) where the platform's centre may stand: obstacles are grown by its footprint.
        origin_world: Corner (2,) of cell [0, 0], x and y [m].
        cell: Edge of a cell [m].
        furniture: Static boxes, for lines of sight.
    """

    free: NDArray[np.bool_]
    origin_world: Array
    cell: float
    furniture: tuple[Box, ...] = ()

    @classmethod
    def from_boxes(
        cls, furniture: Sequence[Box], config: RobotConfig, around_world: ArrayLike = (0.0, 0.0)
    ) -> FloorGrid:
        """Build the grid around static furniture.

        Args:
            furniture: What stands on the floor.
            config: Footprint, cell, size of the floor and heights that matter.
            around_world: Middle (2,) of the floor the robot may use, x and y [m].
        """
        origin = np.asarray(around_world, dtype=np.float64)[:2] - config.floor
        count = max(1, round(2.0 * config.floor / config.cell))
        x, y = (low + config.cell * (np.arange(count) + 0.5) for low in origin)
        cells = shapely.points(*np.meshgrid(x, y))
        free = np.ones((count, count), dtype=np.bool_)
        # What the head cannot meet, 15 cm above the highest camera centre, does not hinder.
        head = config.camera_height[1] + 0.15
        for box in furniture:
            middle, reach = box.T_world_object[2, 3], box.support(np.array([[0.0, 0.0, 1.0]]))[0]
            if middle + reach > STEP and middle - reach < head:
                free &= shapely.distance(shapely.Polygon(ground_outline(box)), cells) >= config.footprint
        return cls(free, origin, config.cell, tuple(furniture))

    @classmethod
    def from_occupancy(
        cls, occupied: NDArray[np.bool_], origin_world: ArrayLike, cell: float, config: RobotConfig
    ) -> FloorGrid:
        """Build the grid from a map of obstacles (H, W), rows along y, as a robot's own mapping gives.

        Args:
            occupied: Cells (H, W) with an obstacle.
            origin_world: Corner (2,) of cell [0, 0], x and y [m].
            cell: Edge of a cell [m].
            config: Footprint. Heights are not known, so no wall hides anything.
        """
        free = np.ones(occupied.shape, dtype=np.bool_)
        if occupied.any():
            distance = scipy.ndimage.distance_transform_edt(~np.pad(occupied, 1))[1:-1, 1:-1]
            free = distance * cell >= config.footprint
        return cls(free, np.asarray(origin_world, dtype=np.float64), cell)

    def cells(self, points_world: Array) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """Find the cells under points (N, 2+) [m].

        Returns:
            Flat cell indices (N,), 0 where outside, and which points are on the floor (N,).
        """
        column, row = np.floor((points_world[:, :2] - self.origin_world) / self.cell).astype(np.intp).T
        height, width = self.free.shape
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        return np.where(inside, row * width + column, 0), inside

    def path_lengths(self, start_world: ArrayLike) -> Array:
        """Length [m] of the shortest path over the floor from a point (x, y) to each cell, by one Dijkstra.

        A platform that stands beside the free cells (because the grid is coarse) starts at the nearest one.

        Returns:
            (H, W), inf where no path leads.
        """
        if not self.free.any():
            return np.full(self.free.shape, np.inf)
        start = np.asarray(start_world, dtype=np.float64)[None, :2]
        (cell,), (inside,) = self.cells(start)
        if not (inside and self.free.ravel()[cell]):
            rows, columns = np.nonzero(self.free)
            centres = self.origin_world + self.cell * (np.stack([columns, rows], axis=-1) + 0.5)
            nearest = np.argmin(np.linalg.norm(centres - start, axis=-1))
            cell = rows[nearest] * self.free.shape[1] + columns[nearest]
        lengths = scipy.sparse.csgraph.dijkstra(self._graph, directed=False, indices=int(cell))
        return np.asarray(lengths).reshape(self.free.shape)

    def hidden(self, eyes_world: Array, target_world: Array) -> NDArray[np.bool_]:
        """Test which eyes (N, 3) [m] have furniture between themselves and a target (3,) [m]."""
        blocked = np.zeros(len(eyes_world), dtype=np.bool_)
        ray_world = target_world - eyes_world
        length = np.linalg.norm(ray_world, axis=-1)
        last = 1.0 - TABLE_MARGIN / np.maximum(length, TABLE_MARGIN)
        for box in self.furniture:
            T_world_box, half = box.T_world_object, box.extents / 2.0
            eye_box = (eyes_world - T_world_box[:3, 3]) @ T_world_box[:3, :3]
            ray_box = ray_world @ T_world_box[:3, :3]
            ray_box = np.where(np.abs(ray_box) < 1e-12, 1e-12, ray_box)
            a, b = (-half - eye_box) / ray_box, (half - eye_box) / ray_box
            enter, leave = np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)
            blocked |= np.maximum(enter, 0.0) < np.minimum(leave, last)
        return blocked

    @cached_property
    def _graph(self) -> scipy.sparse.csr_array:
        """Free cells and the steps between them [m]; a diagonal step needs both cells beside it."""
        height, width = self.free.shape
        index = np.arange(height * width).reshape(height, width)
        edges = []
        # Half of the eight neighbours of a cell; the other half are the same edges backwards.
        for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
            here = (slice(0, height - down), slice(max(0, -right), width - max(0, right)))
            there = (slice(down, height), slice(max(0, right), width + min(0, right)))
            passable = self.free[here] & self.free[there]
            if down and right:
                passable = passable & self.free[here[0], there[1]] & self.free[there[0], here[1]]
            length = np.full(passable.sum(), self.cell * np.hypot(down, right))
            edges.append((length, index[here][passable], index[there][passable]))
        lengths, sources, sinks = (np.concatenate(parts) for parts in zip(*edges, strict=True))
        return scipy.sparse.csr_array((lengths, (sources, sinks)), shape=(height * width, height * width))
