"""Foreground: which pixels of a view show what may stand on which support surface."""

from __future__ import annotations

from collections.abc import Sequence, Set

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from caryatid.config import Config
from caryatid.geometry import transforms
from caryatid.geometry.polygons import signed_distances
from caryatid.geometry.transforms import Array
from caryatid.runtime.parallel import kernel
from caryatid.segmentation.support_plane import Mask, SupportSurface
from caryatid.sensing.views import View

MOST = 0.8
"""Share of a body that lies in a place, from which all of it does [1]: noise at depth edges strays."""
PARTLY = 0.4
"""Share of a leg or wall along the border of what it carries [1]: from inside, half of it is seen."""
THIN = 0.03
"""Maximum thickness of a wall, as far as it is seen [m]: a board, and the noise of its readings."""
ENOUGH = 4000
"""Number of points that show where the parts of a view are [1]: a hundred of each."""


def find_foreground(
    view: View, surfaces: Sequence[SupportSurface], config: Config, carrying: Set[int] = frozenset()
) -> list[Mask]:
    """Find the pixels of what may stand, directly or not, on each of some surfaces.

    A pixel belongs to the highest surface below it. On other surfaces than the main one, objects reach
    down to it, are wholly in the image, no higher than objects are, and near the middle of the main surface.

    Args:
        view: The view, which has a pose.
        surfaces: The support surfaces, the main one first.
        config: Sampling, margins and sizes.
        carrying: Numbers of surfaces that carry something in earlier views.

    Returns:
        For each surface, which pixels (H, W).
    """
    settings = config.segmentation
    low, high, margin = settings.clearance, settings.max_height, settings.margin
    if len(surfaces) == 1:
        return [surfaces[0].pixels_over(view, low, high, margin)]
    owner: NDArray[np.int32] = np.zeros(view.depth.shape, dtype=np.int32)
    for k in sorted(range(len(surfaces)), key=lambda k: -surfaces[k].point_world[2]):
        # Walls of a room are over its floor.
        over = surfaces[k].pixels_over(view, -low, np.inf if k else high, margin) & (owner == 0)
        on = over & ~surfaces[k].pixels_over(view, low, np.inf, margin)
        owner[over] = k + 1
        owner[on] = -1
    step = settings.stride
    grid = np.s_[::step, ::step]
    depth, jump = view.depth[grid].astype(np.float64), 2.0 * settings.edge_jump
    inverse_depth = np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0.0)
    body = np.where(owner[grid] > 0, find_bodies(owner[grid], inverse_depth, jump), -1)
    rows = np.flatnonzero(body >= 0)
    names, index, sizes = np.unique(body.ravel()[rows], return_inverse=True, return_counts=True)
    stands_on = owner[grid].ravel()[names] - 1
    v, u = step * np.array(np.divmod(rows, body.shape[1]))
    rays = np.stack([u, v, np.ones(len(u))], axis=-1) @ np.linalg.inv(view.K).T
    points = transforms.transform(view.pose, depth.ravel()[rows, None] * rays)

    def share(which: Mask) -> Array:
        """Share of the samples of each body."""
        return np.asarray(np.bincount(index, which, len(names)) / sizes)

    near = (
        np.linalg.norm(points[:, :2] - surfaces[0].point_world[:2], axis=1)
        < min(config.voxels.extent[:2]) / 2.0
    )
    inner = np.zeros(body.shape, dtype=np.bool_)
    inner[1:-1, 1:-1] = True
    cut = share(~inner.ravel()[rows]) > 0.0
    # Noise of a far floor makes many small bodies.
    area = np.bincount(index, (step * depth.ravel()[rows]) ** 2, len(names)) / (view.K[0, 0] * view.K[1, 1])
    small = area < settings.min_area
    unfit = (stands_on > 0) & ((share(near) < 0.5) | cut | small)
    height = np.select(
        [stands_on[index] == k for k in range(len(surfaces))], [s.height(points) for s in surfaces]
    )
    top = np.full(len(names), -np.inf)
    np.maximum.at(top, index, height)
    unfit |= (stands_on > 0) & ((top > high) | (share(height > 2.0 * low) < 0.05))
    # Of a ball that stands on a surface, less than the lower half is hidden by itself.
    unfit |= (stands_on > 0) & (share(height < 0.5 * top[index]) == 0.0)
    # What hides the upper end of a body may be what it carries.
    highest = np.lexsort((height, index))[np.cumsum(sizes) - 1]
    row, column = np.divmod(rows[highest], body.shape[1])
    nearest = ndimage.maximum_filter(inverse_depth, 7)
    hidden = np.asarray(nearest[row, column] > inverse_depth[row, column] + jump)
    unfit |= find_furniture(points, index, stands_on, surfaces, config, hidden)
    lost = np.isin(body, names[unfit]).repeat(step, 0).repeat(step, 1)
    owner[lost[: owner.shape[0], : owner.shape[1]]] = 0
    numbers = sorted({0, *carrying, *stands_on[~unfit].tolist()})
    if len(numbers) < len(surfaces):
        # What carries nothing may itself be the top of an object.
        kept = {n for n, k in enumerate(numbers) if k in carrying}
        some = find_foreground(view, [surfaces[k] for k in numbers], config, kept)
        found = dict(zip(numbers, some, strict=True))
        return [found.get(k, np.zeros_like(view.valid)) for k in range(len(surfaces))]
    return [(owner == k + 1) & surface.pixels_over(view, low, high) for k, surface in enumerate(surfaces)]


def find_furniture(
    points_world: Array,
    part: NDArray[np.integer],
    stands_on: NDArray[np.integer],
    surfaces: Sequence[SupportSurface],
    config: Config,
    hidden: Mask,
) -> Mask:
    """Find the parts of a view that are legs, walls or uprights of surfaces, and no objects.

    In plan, these are under a higher surface, partly along its border, and reach up to it, or as far as can
    be seen; or a long one is close to the border of its own surface.

    Args:
        points_world: Points (N, 3) [m].
        part: Part (N,) of each, 0 … P − 1.
        stands_on: Number (P,) of the surface that each part is over.
        surfaces: The support surfaces.
        config: Width of the borders, and the least length of a wall.
        hidden: Whether the upper end of each part is hidden (P,).

    Returns:
        Which parts (P,).
    """
    count, margin = len(stands_on), config.segmentation.margin
    high, low = np.full((3, count), -np.inf), np.full((3, count), np.inf)
    for k, along in enumerate(points_world.T):
        np.maximum.at(high[k], part, along)
        np.minimum.at(low[k], part, along)
    highest, longest = high[2], (high - low)[:2].max(axis=0)
    some = slice(None, None, max(1, len(part) // ENOUGH))
    part, points_world = part[some], points_world[some]
    sizes = np.maximum(np.bincount(part, minlength=count), 1)
    lowest = np.array([surface.point_world[2] for surface in surfaces])[stands_on]
    furniture = np.zeros(count, dtype=np.bool_)
    for surface in surfaces:
        away = signed_distances(surface.outline_world, points_world)
        within = surface.region.grown(margin).holds(points_world)
        # Something on the surface may hide a corner of it.
        border = within & (away >= -margin)
        close, along, under = (
            np.bincount(part, which, count) / sizes for which in (np.abs(away) <= THIN, border, within)
        )
        room = surface.point_world[2] - lowest
        # What is higher than objects are is left out.
        reach = lowest + np.minimum(room, config.segmentation.max_height) - margin
        leg = (under > MOST) & (along > PARTLY) & (hidden | (highest > reach))
        wall = (close > MOST) & (longest > config.surface.min_width)
        furniture |= ((room > 0.0) & leg) | ((room == 0.0) & wall)
    return furniture


@kernel
def find_bodies(labels, inverse_depth, jump):  # type: ignore[no-untyped-def]
    """The first pixel (H, W), counted by rows, of the surface of one label (H, W) that each pixel is on.

    Neighbours of one label are on one surface where 1/z (H, W) differs by no more than a jump [1/m].
    """
    height, width = labels.shape
    first = np.arange(height * width)
    for row, column in np.ndindex(height, width):
        if labels[row, column] <= 0:
            continue
        for r, c in ((row - 1, column), (row, column - 1)):
            if r < 0 or c < 0 or labels[r, c] != labels[row, column]:
                continue
            if abs(inverse_depth[r, c] - inverse_depth[row, column]) <= jump:
                one, other = r * width + c, row * width + column
                while first[one] != one:
                    first[one] = first[first[one]]
                    one = first[one]
                while first[other] != other:
                    first[other] = first[first[other]]
                    other = first[other]
                first[max(one, other)] = min(one, other)
    for here in range(height * width):
        first[here] = first[first[here]]
    return first.reshape(height, width)
