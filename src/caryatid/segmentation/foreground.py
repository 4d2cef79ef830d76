"""Compiled choice of the pixels that show what stands on the support surface.

The tests hold `segmentation.on_surface` beside it, which does the same with the points.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from caryatid.geometry.transforms import Array

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

TURNS = 32
"""Threads take turns at the rows in this many lots [1], for objects fill some rows and not others."""


def standing_pixels(
    depth: Image,
    K: Array,
    in_range: tuple[float, float],
    height: Array,
    heights: tuple[float, float],
    sides: Array,
    margin: float,
) -> tuple[Mask, Image]:
    """Choose the pixels whose points lie between two heights over a plane and within an outline on it.

    Args:
        depth: Readings (H, W) [m], 0 = none.
        K: Pinhole matrix (3, 3) [px].
        in_range: Least and greatest reading [m] that counts.
        height: Normal and offset (4,) of the plane: a point's height is n·p + d [m].
        heights: Least and greatest height [m], themselves left out.
        sides: Outward normals and offsets (M, 4) of the outline's sides: a point is n·p + d outside [m].
        margin: How far outside a point may lie [m].

    Returns:
        The pixels (H, W), and the inverse depth (H, W) [1/m] of all readings that count, 0 elsewhere.
    """
    depth = np.ascontiguousarray(depth, dtype=np.float32)
    x, y = ((np.arange(n) - K[i, 2]) / K[i, i] for i, n in ((0, depth.shape[1]), (1, depth.shape[0])))
    limits = np.array([*heights, margin], dtype=np.float64)
    chosen, inverse_depth = np.empty(depth.shape, dtype=np.bool_), np.empty_like(depth)
    outside = np.empty((TURNS, depth.shape[1]))
    planes = np.concatenate([height[None], sides])
    _choose(depth, x, y, np.array(in_range, dtype=np.float32), planes, limits, outside, chosen, inverse_depth)
    return chosen, inverse_depth


@njit(cache=True, parallel=True)
def _choose(
    depth: Image,
    x: Array,
    y: Array,
    in_range: Image,
    planes: Array,
    limits: Array,
    outside: Array,
    chosen: Mask,
    inverse_depth: Image,
) -> None:
    """Choose in all rows, some by each thread."""
    for lot in prange(TURNS):
        for row in range(lot, len(depth), TURNS):
            _choose_in(
                depth[row],
                x,
                y[row],
                in_range,
                planes,
                limits,
                outside[lot],
                chosen[row],
                inverse_depth[row],
            )


@njit(cache=True)
def _choose_in(
    depth: Image,
    x: Array,
    y: float,
    in_range: Image,
    planes: Array,
    limits: Array,
    outside: Array,
    chosen: Mask,
    inverse_depth: Image,
) -> None:
    """Choose in one row (W,), whose rays have the slopes x (W,) and y.

    Of the planes (1 + M, 4) the first is the surface, the others are the sides of its outline; the limits
    (3,) are heights and margin; `outside` (W,) is room to work in.
    """
    nearest, furthest = in_range[0], in_range[1]
    along, ahead, offset = planes[0, 0], planes[0, 1] * y + planes[0, 2], planes[0, 3]
    for col in range(len(x)):
        z = depth[col]
        counts = z >= nearest and z <= furthest
        inverse_depth[col] = np.float32(1.0) / z if counts else np.float32(0.0)
        over = z * (along * x[col] + ahead) + offset
        chosen[col] = counts and over > limits[0] and over < limits[1]
        outside[col] = -np.inf
    first, last = 0, len(x)
    while first < last and not chosen[first]:
        first += 1
    while last > first and not chosen[last - 1]:
        last -= 1
    for k in range(1, len(planes)):
        along, ahead, offset = planes[k, 0], planes[k, 1] * y + planes[k, 2], planes[k, 3]
        for col in range(first, last):
            beyond = depth[col] * (along * x[col] + ahead) + offset
            outside[col] = beyond if beyond > outside[col] else outside[col]
    for col in range(first, last):
        chosen[col] = chosen[col] and outside[col] <= limits[2]
