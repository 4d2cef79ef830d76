"""The floor the robot drives on: where its platform may stand, how far it is, what walls hide."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.ndimage
import scipy.sparse.csgraph
import shapely
from numpy.typing import ArrayLike, NDArray

from caryatid.config import RobotConfig
from caryatid.geometry.transforms import Array

NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1))
"""Half of the eight neighbours of a cell; the other half are the same edges backwards."""

STEP = 0.02
"""Anything on the floor lower than this is no obstacle to the platform [m]."""

HEAD_ROOM = 0.15
"""What the head needs above the highest camera centre [m]; higher obstacles do not hinder."""

TABLE_MARGIN = 0.1
"""Furniture met this near to the view sphere's centre is the table, not a wall in the line of sight [m]."""


@dataclass(frozen=True, eq=False)
class FloorGrid:
    """A grid over the floor, indexed [row along y, column along x].

    Attributes:
        free: Cells (H, W) where the platform's centre may stand: obstacles are grown by its footprint.
        origin_world: Corner (2,) of cell [0, 0], x and y [m].
        cell: Edge of a cell [m].
        boxes: Static furniture as T_world_box (B, 4, 4) and half extents (B, 3) [m], for lines of sight.
    """

    free: NDArray[np.bool_]
    origin_world: Array
    cell: float
    boxes: tuple[Array, Array]

    @classmethod
    def from_boxes(
        cls,
        centres_world: ArrayLike,
        half_extents: ArrayLike,
        R_world_boxes: ArrayLike,
        config: RobotConfig,
        around_world: ArrayLike = (0.0, 0.0),
    ) -> FloorGrid:
        """Build the grid from boxes around the static furniture.

        Args:
            centres_world: Box centres (B, 3) [m]; B may be 0.
            half_extents: Half edge lengths (B, 3) [m].
            R_world_boxes: Box orientations (B, 3, 3).
            config: Footprint, cell, size of the floor and heights that matter.
            around_world: Middle (2,) of the floor the robot may use, x and y [m].
        """
        centres = np.asarray(centres_world, dtype=np.float64).reshape(-1, 3)
        half = np.asarray(half_extents, dtype=np.float64).reshape(-1, 3)
        rotations = np.asarray(R_world_boxes, dtype=np.float64).reshape(-1, 3, 3)
        T_world_boxes = np.tile(np.eye(4), (len(centres), 1, 1))
        T_world_boxes[:, :3, :3], T_world_boxes[:, :3, 3] = rotations, centres

        origin = np.asarray(around_world, dtype=np.float64)[:2] - config.floor
        count = max(1, round(2.0 * config.floor / config.cell))
        x = origin[0] + config.cell * (np.arange(count) + 0.5)
        y = origin[1] + config.cell * (np.arange(count) + 0.5)
        cells = shapely.points(*np.meshgrid(x, y))
        free = np.ones((count, count), dtype=np.bool_)
        signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], dtype=np.float64)
        for centre, extent, R in zip(centres, half, rotations, strict=True):
            corners = centre + (signs * extent) @ R.T
            low, high = corners[:, 2].min(), corners[:, 2].max()
            if high > STEP and low < config.camera_height[1] + HEAD_ROOM:
                footprint = shapely.MultiPoint(corners[:, :2]).convex_hull
                free &= shapely.distance(footprint, cells) >= config.footprint
        return cls(free, origin, config.cell, (T_world_boxes, half))

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
        origin = np.asarray(origin_world, dtype=np.float64)
        return cls(free, origin, cell, (np.zeros((0, 4, 4)), np.zeros((0, 3))))

    def cells(self, points_world: Array) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """Find the cells under points (N, 2+) [m].

        Returns:
            Flat cell indices (N,), 0 where outside, and which points are on the floor (N,).
        """
        column_row = np.floor((points_world[:, :2] - self.origin_world) / self.cell).astype(np.intp)
        column, row = column_row[:, 0], column_row[:, 1]
        height, width = self.free.shape
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        return np.where(inside, row * width + column, 0), inside

    def path_lengths(self, start_world: ArrayLike) -> Array:
        """Length [m] of the shortest path over the floor from a point (x, y) to each cell, by one Dijkstra.

        A platform that stands beside the free cells (because the grid is coarse) starts at the nearest one.

        Returns:
            (H, W), inf where no path leads.
        """
        lengths = np.full(self.free.shape, np.inf)
        if not self.free.any():
            return lengths
        start = np.asarray(start_world, dtype=np.float64)[None, :2]
        cell, inside = self.cells(start)
        if not (inside[0] and self.free.ravel()[cell[0]]):
            rows, columns = np.nonzero(self.free)
            centres = self.origin_world + self.cell * (np.stack([columns, rows], axis=-1) + 0.5)
            nearest = int(np.argmin(np.linalg.norm(centres - start, axis=-1)))
            cell = np.array([rows[nearest] * self.free.shape[1] + columns[nearest]])
        reached = scipy.sparse.csgraph.dijkstra(self._graph, directed=False, indices=int(cell[0]))
        lengths.ravel()[:] = reached
        return lengths

    def hidden(self, eyes_world: Array, target_world: Array) -> NDArray[np.bool_]:
        """Test which eyes (N, 3) [m] have furniture between themselves and a target (3,) [m]."""
        blocked = np.zeros(len(eyes_world), dtype=np.bool_)
        ray_world = target_world - eyes_world
        length = np.linalg.norm(ray_world, axis=-1)
        last = 1.0 - TABLE_MARGIN / np.maximum(length, TABLE_MARGIN)
        for T_world_box, half in zip(*self.boxes, strict=True):
            eye_box = (eyes_world - T_world_box[:3, 3]) @ T_world_box[:3, :3]
            ray_box = ray_world @ T_world_box[:3, :3]
            ray_box = np.where(np.abs(ray_box) < 1e-12, 1e-12, ray_box)
            a, b = (-half - eye_box) / ray_box, (half - eye_box) / ray_box
            enter = np.minimum(a, b).max(axis=-1)
            leave = np.maximum(a, b).min(axis=-1)
            blocked |= np.maximum(enter, 0.0) < np.minimum(leave, last)
        return blocked

    @cached_property
    def _graph(self) -> scipy.sparse.csr_array:
        """Free cells and the steps between them [m]; a diagonal step needs both cells beside it."""
        height, width = self.free.shape
        index = np.arange(height * width).reshape(height, width)
        sources, sinks, lengths = [], [], []
        for down, right in NEIGHBOURS:
            here = (slice(0, height - down), slice(max(0, -right), width - max(0, right)))
            there = (slice(down, height), slice(max(0, right), width + min(0, right)))
            passable = self.free[here] & self.free[there]
            if down and right:
                passable = passable & self.free[here[0], there[1]] & self.free[there[0], here[1]]
            sources.append(index[here][passable])
            sinks.append(index[there][passable])
            lengths.append(np.full(passable.sum(), self.cell * np.hypot(down, right)))
        edges = (np.concatenate(lengths), (np.concatenate(sources), np.concatenate(sinks)))
        return scipy.sparse.csr_array(edges, shape=(height * width, height * width))
