"""Compiled: shapes filled into a voxel grid, beside the plain NumPy reference."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.geometry.rays import Grid
from caryatid.geometry.shapes import Shape
from caryatid.geometry.signed_distance import signed_distance
from caryatid.geometry.transforms import Array


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


def filled_reference(grid: Grid, shapes: Sequence[Shape], origin: Array, size: float) -> Grid:
    """Return a grid (X, Y, Z) with the shapes filled in, by arrays over the whole of it."""
    centres = origin + (np.indices(grid.shape).reshape(3, -1).T + 0.5) * size
    inside = [(shape.signed_distance(centres) < 0.0).reshape(grid.shape) for shape in shapes]
    return np.logical_or.reduce([grid > 0, *inside]).astype(np.uint8)
