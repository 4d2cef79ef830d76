"""The robot's floor: where its platform may stand, path lengths, and walls that block views."""

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

STEP = 0.02
"""Anything lower than this on the floor is not an obstacle to the platform [m]."""

TABLE_MARGIN = 0.1
"""Furniture this close to the view sphere's centre is the table, not a wall in the line of sight [m]."""


@dataclass(frozen=True, eq=False)
class FloorGrid:
    """A grid over the floor, indexed [row along y, column along x].

    Attributes:
        free: Cells (H, W) where the platform's footprint meets no obstacle, wherever in the cell it stands.
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
        """Build the grid around static furniture; the middle (2,) of the usable floor is given [m]."""
        origin = np.asarray(around_world, dtype=np.float64)[:2] - config.floor
        count = max(1, round(2.0 * config.floor / config.cell))
        x, y = (low + config.cell * (np.arange(count) + 0.5) for low in origin)
        cells = shapely.points(*np.meshgrid(x, y))
        free = np.ones((count, count), dtype=np.bool_)
        corners = 0.5 * config.cell * np.array([(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)])
        # Anything above the head, 15 cm over the highest camera centre, is not an obstacle.
        head = config.camera_height[1] + 0.15
        for box in furniture:
            middle, reach = box.T_world_object[2, 3], box.support(np.array([[0.0, 0.0, 1.0]]))[0]
            if middle + reach > STEP and middle - reach < head:
                # A cell is as far from an outline as its centre is from the outline grown by the cell.
                grown = (box.footprint()[:, None] + corners).reshape(-1, 2)
                free &= shapely.distance(shapely.MultiPoint(grown).convex_hull, cells) >= config.footprint
        return cls(free, origin, config.cell, tuple(furniture))

    @classmethod
    def from_occupancy(
        cls, occupied: NDArray[np.bool_], origin_world: ArrayLike, cell: float, config: RobotConfig
    ) -> FloorGrid:
        """Build the grid from a map of obstacles (H, W), rows along y, such as a robot's own map.

        Its corner (2,) and cell are those of the attributes [m]. No wall hides anything: heights are unknown.
        """
        free = np.ones(occupied.shape, dtype=np.bool_)
        if occupied.any():
            # Between squares: from the centre of one to those of the other and its neighbours.
            grown = scipy.ndimage.binary_dilation(np.pad(occupied, 1), np.ones((3, 3)))
            free = scipy.ndimage.distance_transform_edt(~grown)[1:-1, 1:-1] * cell >= config.footprint
        return cls(free, np.asarray(origin_world, dtype=np.float64), cell)

    def cells(self, points_world: Array) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """Find the cells under points (N, 2+) [m]: flat indices (N,), 0 if outside, and which exist (N,)."""
        column, row = np.floor((points_world[:, :2] - self.origin_world) / self.cell).astype(np.intp).T
        height, width = self.free.shape
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        return np.where(inside, row * width + column, 0), inside

    def centres(self, cells: NDArray[np.intp]) -> Array:
        """Centres (..., 2) [m] of cells by their flat indices (...)."""
        row, column = np.divmod(cells, self.free.shape[1])
        return self.origin_world + self.cell * (np.stack([column, row], axis=-1) + 0.5)

    def paths_from(self, start_world: ArrayLike) -> FloorPaths:
        """Find the shortest paths over the floor from a point (2,), x and y [m], by one Dijkstra.

        A platform outside the free cells (because the grid is coarse) starts at the nearest one.
        """
        start = np.asarray(start_world, dtype=np.float64)[:2]
        (cell,), (inside,) = self.cells(start[None])
        free = np.flatnonzero(self.free)
        if len(free) == 0:
            return FloorPaths(self, start, -1, np.full(self.free.size, np.inf))
        if not (inside and self.free.flat[cell]):
            cell = free[np.argmin(np.linalg.norm(self.centres(free) - start, axis=-1))]
        first_leg = np.linalg.norm(start - self.centres(cell))
        between = scipy.sparse.csgraph.dijkstra(self.graph, indices=int(cell))
        return FloorPaths(self, start, int(cell), first_leg + between)

    def hidden(self, eyes_world: Array, target_world: Array) -> NDArray[np.bool_]:
        """Which eyes (N, 3) [m] have furniture between them and a target (3,) [m]."""
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
    def graph(self) -> scipy.sparse.csr_array:
        """Free cells and the steps between them [m]; a diagonal step needs both cells beside it."""
        height, width = self.free.shape
        index = np.arange(height * width).reshape(height, width)
        edges = []
        # Half of the eight neighbours of a cell; the other half has the same edges reversed.
        for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
            here = (slice(0, height - down), slice(max(0, -right), width - max(0, right)))
            there = (slice(down, height), slice(max(0, right), width + min(0, right)))
            passable = self.free[here] & self.free[there]
            if down and right:
                passable = passable & self.free[here[0], there[1]] & self.free[there[0], here[1]]
            length = np.full(passable.sum(), self.cell * np.hypot(down, right))
            edges.append((length, index[here][passable], index[there][passable]))
        lengths, sources, sinks = (np.concatenate(parts) for parts in zip(*edges, strict=True))
        half = scipy.sparse.csr_array((lengths, (sources, sinks)), shape=(height * width, height * width))
        return half + half.T


@dataclass(frozen=True, eq=False, slots=True)
class FloorPaths:
    """The shortest paths over a floor from one place.

    They lead over the centre of its cell from centre to centre, and stay in free cells: a diagonal step has
    free cells on both sides.

    Attributes:
        grid: The floor.
        start_world: Where they begin (2,), x and y [m].
        cell: Flat index of the cell they begin in.
        to_centres: Length [m] to the centre of each cell (H·W,), inf where no path leads.
    """

    grid: FloorGrid
    start_world: Array
    cell: int
    to_centres: Array

    def lengths(self, points_world: Array) -> Array:
        """Path length (N,) [m] to each point (N, 2+); straight within the first cell."""
        points = points_world[:, :2]
        cells, _ = self.grid.cells(points)
        last_leg = np.linalg.norm(points - self.grid.centres(cells), axis=-1)
        straight = np.linalg.norm(points - self.start_world, axis=-1)
        return np.where(cells == self.cell, straight, self.to_centres[cells] + last_leg)

    def corners(self, point_world: Array) -> Array:
        """Corners (C, 2) [m] of the path to a point (2+,), with both ends; a path of few corners."""
        end_world = point_world[None, :2]
        (cell,), _ = self.grid.cells(end_world)
        if cell == self.cell:
            return np.concatenate([self.start_world[None], end_world])
        graph, corners, heading = self.grid.graph, [int(cell)], 0
        while corners[-1] != self.cell:
            here = corners[-1]
            beside = slice(graph.indptr[here], graph.indptr[here + 1])
            before, steps = graph.indices[beside], graph.data[beside]
            before = before[np.abs(self.to_centres[before] + steps - self.to_centres[here]) < 1e-9]
            if here + heading not in before:
                heading = int(before[0]) - here
                corners.append(here)
            corners[-1] = here + heading
        return np.concatenate([self.start_world[None], self.grid.centres(np.array(corners[::-1])), end_world])
