"""Compounds: objects beyond primitives: a body of revolution or an open box.

Convexity cuts such objects to pieces, and a primitive explains each. A compound explains them as one at a
lower cost: the pieces of a bottle share an axis, the walls and the floor of a tray share its corners.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import ClassVar

import numpy as np

from caryatid.config import ExplanationConfig
from caryatid.fitting.primitives import is_free
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Shape
from caryatid.geometry.signed_distance import gradient, local
from caryatid.geometry.transforms import UP, Array
from caryatid.runtime.parallel import kernel
from caryatid.sensing.voxel_map import VoxelMap

FEW = 5
"""Minimum number of points of a face [1]; 3 cm² of them."""
HYPOTHESES = 64
"""Points whose planes are tried as faces of a profile [1]."""
ENOUGH = 300
"""Points from which a profile is found [1]."""
FACES = 8
"""Maximum number of faces of a profile [1]: a bottle has five, a bowl six."""
ROUND = 4
"""Twelfths of a turn from which a body of revolution must be seen [1]; one view shows five or six."""
ROUND_SHARE = 0.7
"""Share of the normals of a body of revolution that point at its axis or along it [1]."""
ALIKE = 0.8
"""Cosine of the angle to a face's normal up to which points belong to it [1]; normals err by up to 30°."""


def box_axes(normals: Array, up: Array) -> list[Array]:
    """Up, and the two directions across it that most faces are normal to, by their normals (N, 3)."""
    level = normals - np.outer(normals @ up, up)
    length = np.linalg.norm(level, axis=1)
    upright = level[length > 0.5] / length[length > 0.5, None]
    if len(upright) == 0:
        return [up]
    x, y = transforms.perpendicular(up), np.cross(up, transforms.perpendicular(up))
    angle = np.angle(np.mean(((upright @ x) + 1j * (upright @ y)) ** 4)) / 4.0
    main = np.cos(angle) * x + np.sin(angle) * y
    return [up, main, np.cross(up, main)]


@dataclass(frozen=True, eq=False, slots=True)
class Revolution:
    """A body of revolution: conical faces around an axis.

    Attributes:
        middle: A point (3,) [m] on the axis.
        axis: Its direction (3,).
        ends: Where each face begins and ends (K, 2, 2) [m]: distance from the axis, and height along it.
        outward: Unit normal (K, 2) of each face, away from and along the axis.
    """

    middle: Array
    axis: Array
    ends: Array
    outward: Array
    kind: ClassVar = "body of revolution"

    @property
    def parameters(self) -> int:
        """Four for the axis, two for each face, and two for the ends of the profile."""
        return 6 + 2 * len(self.ends)

    def costs(self, points: Array, normals: Array, noise: float, config: ExplanationConfig) -> Array:
        """Cost (N,) [nats] of oriented points (N, 3), each on the face that explains it best."""
        seen = _profile(points, normals, self.middle, self.axis)
        costs = np.full(len(points), config.outlier)
        for face in zip(self.ends, self.outward, strict=True):
            _lower(*seen, *face, noise, config.normal_weight, costs)
        return costs

    def surface(self, spacing: float) -> tuple[Array, Array]:
        """Points (N, 3) of its faces, this far from each other all around [m], outward normals (N, 3)."""
        rings, outward = [], []
        for (begin, end), facing in zip(self.ends, self.outward, strict=True):
            steps = _middles(float(np.linalg.norm(end - begin)) / spacing)[:, None]
            rings.append(begin + steps * (end - begin))
            outward.append(np.tile(facing, (len(steps), 1)))
        ring, facing = np.concatenate(rings), np.concatenate(outward)
        number = np.maximum(np.round(2.0 * np.pi * ring[:, 0] / spacing).astype(np.intp), 1)
        index = np.repeat(np.arange(len(ring)), number)
        first = np.cumsum(number) - number
        angle = 2.0 * np.pi * (np.arange(len(index)) - first[index]) / number[index]
        x, y = _across(self.axis)
        away = np.cos(angle)[:, None] * x + np.sin(angle)[:, None] * y
        places, normals = (at[index, :1] * away + at[index, 1:] * self.axis for at in (ring, facing))
        return self.middle + places, normals

    def free(self, voxels: VoxelMap) -> int:
        """Number of voxels of its surface seen free, all around; it may be hollow."""
        places, normals = self.surface(voxels.config.size)
        # The seen part of a surface may lie in the voxel behind.
        behind = places - 0.5 * voxels.config.size * normals
        return int(np.count_nonzero(voxels.empty_at(places) & voxels.empty_at(behind)))


def revolutions(
    points: Array, normals: Array, noise: float, weight: float, config: ExplanationConfig
) -> Iterator[Revolution]:
    """Fit bodies of revolution around each axis worth trying.

    Args:
        points: (N, 3) [m].
        normals: Unit normals (N, 3).
        noise: Standard deviation of the points [m].
        weight: Independent readings each point stands for [1].
        config: The costs of explanations.
    """
    for middle, axis in _axes(points, normals, noise):
        places, facing = _profile(points, normals, middle, axis)
        if np.count_nonzero(np.linalg.norm(facing, axis=1) > ALIKE) < ROUND_SHARE * len(points):
            continue
        x, y = _across(axis)
        azimuth = np.arctan2((points - middle) @ y, (points - middle) @ x)
        seen = np.bincount(((azimuth / np.pi + 1.0) * 6.0).astype(np.intp).clip(0, 11), minlength=12)
        if np.count_nonzero(seen > 0.02 * len(points)) < ROUND:
            continue
        step = max(1, len(places) // ENOUGH)
        ends, outward = np.empty((FACES, 2, 2)), np.empty((FACES, 2))
        count = _find_faces(
            places[::step].copy(), facing[::step].copy(), noise, config.normal_weight, config.outlier,
            config.irregular, config.reach, 2.0 * config.parameter_cost / (step * weight), ends, outward,
        )  # fmt: skip
        if count:
            yield Revolution(middle, axis, ends[:count], outward[:count])


@kernel
def _find_faces(  # type: ignore[no-untyped-def]
    places, facing, noise, normal_weight, outlier, irregular, gap, least, ends, outward
):
    """Write ends (K, 2, 2) and normals (K, 2) of the faces of a profile, and return how many they are.

    They are found one by one among planes through points, while each lowers the sum of costs by the least.
    """
    tried = np.flatnonzero(facing[:, 0] ** 2 + facing[:, 1] ** 2 > ALIKE**2)
    tried = tried[:: max(1, len(tried) // HYPOTHESES)]
    costs, left = np.empty((len(tried), len(places))), np.full(len(places), outlier)
    for h, i in enumerate(tried):
        x, y = facing[i] / np.sqrt(facing[i, 0] ** 2 + facing[i, 1] ** 2)
        for j in range(len(places)):
            distance = (places[j, 0] - places[i, 0]) * x + (places[j, 1] - places[i, 1]) * y
            turned = 1.0 - facing[j, 0] * x - facing[j, 1] * y
            costs[h, j] = min(distance**2 / (2.0 * noise**2) + normal_weight * turned, outlier)
    for count in range(len(ends) if len(tried) else 0):
        best, most = costs[0], 0.0
        for own in costs:
            saved = 0.0
            for j in range(len(places)):
                saved += max(left[j] - own[j], 0.0)
            if saved > most:
                best, most = own, saved
        near = np.flatnonzero((best < irregular) & (best < left))
        if len(near) < 3:
            return count
        x, y = facing[near, 0].sum(), facing[near, 1].sum()
        x, y = x / np.sqrt(x * x + y * y), y / np.sqrt(x * x + y * y)
        # Of the points on the face, those that no gap separates from most others.
        along = places[near, 1] * x - places[near, 0] * y
        ordered, first, begin, end = np.sort(along), 0, 0, 0
        for j in range(1, len(ordered) + 1):
            if j == len(ordered) or ordered[j] - ordered[j - 1] > gap:
                if j - first > end - begin:
                    begin, end = first, j
                first = j
        near = near[(along >= ordered[begin]) & (along <= ordered[end - 1])]
        level = (places[near, 0].mean() * x) + (places[near, 1].mean() * y)
        for side, place in enumerate((ordered[begin], ordered[end - 1])):
            ends[count, side, 0], ends[count, side, 1] = level * x - place * y, level * y + place * x
        outward[count, 0], outward[count, 1] = x, y
        before = left.sum()
        _lower(places, facing, ends[count], outward[count], noise, normal_weight, left)
        if before - left.sum() <= least:
            return count
    return len(ends) if len(tried) else 0


@kernel
def _lower(places, facing, ends, outward, noise, normal_weight, costs):  # type: ignore[no-untyped-def]
    """Lower the costs (N,) of places (N, 2) with normals (N, 2) to those on a face, where these are less."""
    x, y = outward[0], outward[1]
    low, high = ends[0, 1] * x - ends[0, 0] * y, ends[1, 1] * x - ends[1, 0] * y
    for i in range(len(places)):
        off = (places[i, 0] - ends[0, 0]) * x + (places[i, 1] - ends[0, 1]) * y
        along = places[i, 1] * x - places[i, 0] * y
        beyond = max(low - along, along - high, 0.0)
        turned = 1.0 - facing[i, 0] * x - facing[i, 1] * y
        costs[i] = min(costs[i], (off**2 + beyond**2) / (2.0 * noise**2) + normal_weight * turned)


def _axes(points: Array, normals: Array, noise: float) -> Iterator[tuple[Array, Array]]:
    """Middle (3,) [m] and direction (3,) of lines that the normals of points nearly meet.

    Lines that meet a line are a linear complex (Pottmann and Wallner, Computational Line Geometry, 2001);
    normals that pass it at a distance lose their weight. On a bowl, which is nearly a ball, all lines through
    the middle fit about as well: then the vertical is tried too.
    """
    centre, weights = points.mean(axis=0), np.ones(len(points))
    lines = np.concatenate([np.cross(points - centre, normals), normals], axis=1)
    for _ in range(4):
        mm, mn, nn = _products(lines, weights)
        solved = np.linalg.solve(nn, mn.T)
        axes = np.linalg.eigh(mm - mn @ solved)[1].T
        weights = _weights(lines @ np.concatenate([axes[0], -solved @ axes[0]]), noise)
    for axis in (axes[0], UP):
        level, weights, moment = np.stack(_across(axis), axis=1), np.ones(len(points)), np.zeros(3)
        for _ in range(4):
            _, mn, nn = _products(lines, weights)
            moment = -level @ np.linalg.solve(level.T @ nn @ level, level.T @ mn.T @ axis)
            weights = _weights(lines @ np.concatenate([axis, moment]), noise)
        yield centre + np.cross(axis, moment), axis


def _products(lines: Array, weights: Array) -> tuple[Array, Array, Array]:
    """Weighted sums (3, 3) of the products of the moments and the directions of lines (N, 6)."""
    sums = lines.T @ (weights[:, None] * lines)
    return sums[:3, :3], sums[:3, 3:], sums[3:, 3:] + 1e-6 * len(lines) * np.eye(3)


def _weights(miss: Array, noise: float) -> Array:
    """Weights (N,) of normals that miss the axis by these distances [m]."""
    return 1.0 / (1.0 + (miss / (2.0 * noise)) ** 2) ** 2


def _across(axis: Array) -> tuple[Array, Array]:
    """Two directions (3,) across an axis (3,) and across each other."""
    x = transforms.perpendicular(axis)
    return x, np.cross(axis, x)


def _profile(points: Array, normals: Array, middle: Array, axis: Array) -> tuple[Array, Array]:
    """Points (N, 2) [m] and normals (N, 2) away from and along an axis; normals that pass it are shorter."""
    height = (points - middle) @ axis
    away = points - middle - np.outer(height, axis)
    radius = np.linalg.norm(away, axis=1)
    away /= np.maximum(radius, 1e-9)[:, None]
    facing = np.stack([np.einsum("ni,ni->n", normals, away), normals @ axis], axis=1)
    return np.stack([radius, height], axis=1), facing


@dataclass(frozen=True, eq=False, slots=True)
class OpenBox:
    """A floor and four walls.

    Attributes:
        slabs: The floor and the walls.
    """

    slabs: tuple[Box, ...]
    kind: ClassVar = "open box"

    @property
    def parameters(self) -> int:
        """Those of a box, and the thickness of walls and floor."""
        return Box.parameters + 2

    def costs(self, points: Array, normals: Array, noise: float, config: ExplanationConfig) -> Array:
        """Cost (N,) [nats] of oriented points (N, 3), each on the slab that explains it best."""
        slabs = [shape_costs(slab, points, normals, noise, config) for slab in self.slabs]
        return np.min(slabs, axis=0)

    def surface(self, spacing: float) -> tuple[Array, Array]:
        """Points (N, 3) of its slabs, this far from each other [m], and outward normals (N, 3)."""
        points, normals = zip(*(slab.surface(spacing) for slab in self.slabs), strict=True)
        return np.concatenate(points), np.concatenate(normals)

    def free(self, voxels: VoxelMap) -> int:
        """Number of voxels seen free that it fills, with free ones on either side."""
        return sum(count_free_in_slab(*slab.row[1:], *voxels.space) for slab in self.slabs)


Compound = Revolution | OpenBox
"""A surface that could be several primitives."""


@kernel
def count_free_in_slab(R, centre, half, states, origin, size):  # type: ignore[no-untyped-def]
    """Number of voxels seen free that a thin box fills, with free ones on either side."""
    thin, free, count = 0, 0, np.empty(3, np.intp)
    for a in range(3):
        count[a] = max(np.rint(2.0 * half[a] / size), 1.0)
        thin = a if half[a] < half[thin] else thin
    # The seen part of a surface may lie in the voxel beside it.
    du, dv, dw = 0.5 * size * (thin == 0), 0.5 * size * (thin == 1), 0.5 * size * (thin == 2)
    for i in range(count[0]):
        u = (2.0 * (i + 0.5) / count[0] - 1.0) * half[0]
        for j in range(count[1]):
            v = (2.0 * (j + 0.5) / count[1] - 1.0) * half[1]
            for k in range(count[2]):
                w = (2.0 * (k + 0.5) / count[2] - 1.0) * half[2]
                seen = is_free(R, centre, u, v, w, states, origin, size)
                seen = seen and is_free(R, centre, u - du, v - dv, w - dw, states, origin, size)
                free += seen and is_free(R, centre, u + du, v + dv, w + dw, states, origin, size)
    return free


def open_boxes(points: Array, normals: Array, thickness: float) -> Iterator[OpenBox]:
    """Fit boxes along the axes of the faces of oriented points (N, 3) [m], open where an inside was seen.

    Walls seen from one side only have a thickness [m].
    """
    first = normals[np.argmax((normals @ normals[:: max(1, len(normals) // 100)].T > 0.95).sum(axis=1))]
    axes = np.stack(box_axes(normals, first))
    if len(axes) < 3:
        return
    turned = normals @ axes.T
    sums = [normals[np.abs(t) > 0.9].T @ np.sign(t[np.abs(t) > 0.9]) for t in turned.T]
    u, _, vt = np.linalg.svd(np.stack([s + 1e-3 * a for s, a in zip(sums, axes, strict=True)]))
    R = (u @ vt).T
    if np.linalg.det(R) < 0.0:
        R[:, 2] *= -1.0
    local, facing = points @ R, normals @ R
    # At the low and the high end of each axis: where faces that face outwards and inwards lie.
    outer = np.quantile(local, (0.01, 0.99), axis=0).T
    middle = outer.mean(axis=1)
    inner, gap = np.full((3, 2), np.nan), np.full((3, 2), np.nan)
    for axis, end in product(range(3), range(2)):
        sign = (-1.0, 1.0)[end]
        here = sign * (local[:, axis] - middle[axis]) > 0.0
        out, into = (
            _level(local[here & (way * sign * facing[:, axis] > ALIKE), axis], thickness)
            for way in (1.0, -1.0)
        )
        outer[axis, end] = outer[axis, end] if out is None else out
        if into is not None:
            inner[axis, end] = into
            if out is not None and sign * (out - into) > 0.0:
                gap[axis, end] = abs(out - into)
    for axis, end in product(range(3), range(2)):
        if np.isfinite(inner).any():
            yield from _open_box(R, outer, inner, gap, axis, end, thickness)


def _level(heights: Array, width: float) -> float | None:
    """Median [m] of the heights in the band of this width that holds most; None if they are few."""
    heights = np.sort(heights)
    ends = np.searchsorted(heights, heights + width, side="right")
    counts = ends - np.arange(len(heights))
    if counts.max(initial=0) < FEW:
        return None
    first = int(counts.argmax())
    return float(np.median(heights[first : ends[first]]))


def _open_box(
    R: Array, outer: Array, inner: Array, gap: Array, axis: int, end: int, thickness: float
) -> Iterator[OpenBox]:
    """The box with its floor at one end (0 low, 1 high) of an axis; all walls have one thickness."""
    others = [k for k in range(3) if k != axis]
    walls = gap[others][np.isfinite(gap[others])]
    thick = np.full((3, 2), np.median(walls) if len(walls) else thickness)
    thick[axis] = 0.0
    thick[axis, end] = gap[axis, end] if np.isfinite(gap[axis, end]) else thickness
    outwards = np.array([-1.0, 1.0])
    # Some were seen from the inside only.
    outer = np.where(np.isfinite(inner) & ~np.isfinite(gap), inner + outwards * thick, outer)
    within = outer - outwards * thick
    if (np.diff(within) < thickness).any():
        return
    ends = [(axis, end), *product(others, range(2))]
    yield OpenBox(tuple(_slab(R, outer, within, k, side) for k, side in ends))


def _slab(R: Array, outer: Array, within: Array, axis: int, end: int) -> Box:
    """The part of a box in a rotated frame (3, 3) between its outer and its inner plane at an end."""
    low, high = outer.T.copy()
    low[axis], high[axis] = np.sort([outer[axis, end], within[axis, end]])
    return Box(transforms.rigid(R, R @ ((low + high) / 2.0)), np.maximum(high - low, 1e-3))


def _middles(count: float) -> Array:
    """Middles (N,) of equal parts of the range from 0 to 1, at least one."""
    number = max(round(count), 1)
    return (np.arange(number) + 0.5) / number


def shape_costs(
    shape: Shape, points: Array, normals: Array, noise: float, config: ExplanationConfig
) -> Array:
    """Cost (N,) [nats] of oriented points (N, 3) on the surface of a shape."""
    costs: Array = point_costs_on(*shape.row, points, normals, noise, config.normal_weight, config.outlier)
    return costs


@kernel
def point_costs_on(  # type: ignore[no-untyped-def]
    kind, R, centre, half, points, normals, noise, normal_weight, outlier
):
    """Cost (N,) [nats] of oriented points (N, 3) on the surface of a shape."""
    costs, hx, hy, hz = np.empty(len(points)), half[0], half[1], half[2]
    origin = np.zeros(3)
    for i in range(len(points)):
        x, y, z = local(R, centre, points, i)
        distance, gx, gy, gz = gradient(kind, x, y, z, hx, hy, hz)
        u, v, w = local(R, origin, normals, i)
        turned = 1.0 - (gx * u + gy * v + gz * w)
        costs[i] = min(distance**2 / (2.0 * noise**2) + normal_weight * turned, outlier)
    return costs
