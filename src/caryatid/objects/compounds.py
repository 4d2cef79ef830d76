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
from numpy.typing import NDArray

from caryatid.config import ExplanationConfig
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Shape
from caryatid.geometry.signed_distance import gradient, local
from caryatid.geometry.transforms import UP, Array
from caryatid.runtime.parallel import kernel
from caryatid.sensing.voxel_map import VoxelMap

Index = NDArray[np.intp]
"""Indices (M,) of points."""

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
        places, facing = _profile(points, normals, self.middle, self.axis)
        least = np.full(len(points), config.outlier)
        for (begin, end), outward in zip(self.ends, self.outward, strict=True):
            own = _costs(*_from_face(places, facing, begin, end, outward), noise, config)
            least = np.minimum(least, own)
        return least

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
        ends, outward = _faces(places[::step], facing[::step], noise, step * weight, config)
        if len(ends):
            yield Revolution(middle, axis, ends, outward)


def _faces(
    places: Array, facing: Array, noise: float, weight: float, config: ExplanationConfig
) -> tuple[Array, Array]:
    """Ends (K, 2, 2) and normals (K, 2) of the faces of a profile, one by one while each saves cost."""
    tried = np.flatnonzero(np.linalg.norm(facing, axis=1) > ALIKE)
    tried = tried[:: max(1, len(tried) // HYPOTHESES)]
    planes = transforms.unit(facing[tried])
    offset = np.einsum("hi,hi->h", places[tried], planes)
    costs = _costs(places @ planes.T - offset, facing @ planes.T, noise, config)
    left = np.full(len(places), config.outlier)
    ends: list[tuple[Array, Array]] = []
    outward: list[Array] = []
    while len(tried) and len(ends) < FACES:
        best = int(np.maximum(left[:, None] - costs, 0.0).sum(axis=0).argmax())
        own = np.flatnonzero((costs[:, best] < config.irregular) & (costs[:, best] < left))
        if len(own) < 3:
            break
        face = transforms.unit(facing[own].mean(axis=0))
        across = np.array([-face[1], face[0]])
        own = _longest_run(own, places @ across, config.reach)
        centre, along = places[own].mean(axis=0), places[own] @ across
        span = np.array([along.min(), along.max()]) - centre @ across
        begin, end = centre + span[:, None] * across
        cost = np.minimum(left, _costs(*_from_face(places, facing, begin, end, face), noise, config))
        if (left - cost).sum() * weight <= 2.0 * config.parameter_cost:
            break
        left = cost
        ends.append((begin, end))
        outward.append(face)
    return np.array(ends), np.array(outward)


def _longest_run(own: Index, along: Array, gap: float) -> Index:
    """Those of some points (M,) along a line (N,) [m] that no gap separates from most of the others."""
    own = own[np.argsort(along[own])]
    run = np.cumsum(np.append(False, np.diff(along[own]) > gap))
    return own[run == np.bincount(run).argmax()]


def _from_face(places: Array, facing: Array, begin: Array, end: Array, outward: Array) -> tuple[Array, Array]:
    """Distance (N,) [m] of places (N, 2) from a face of a profile, and cosine (N,) of their normals."""
    length = float(np.linalg.norm(end - begin))
    along = (end - begin) / max(length, 1e-9)
    beyond = np.abs((places - (begin + end) / 2.0) @ along) - length / 2.0
    return np.hypot((places - begin) @ outward, np.maximum(beyond, 0.0)), facing @ outward


def _axes(points: Array, normals: Array, noise: float) -> Iterator[tuple[Array, Array]]:
    """Middle (3,) [m] and direction (3,) of lines that the normals of points nearly meet.

    Lines that meet a line are a linear complex (Pottmann and Wallner, Computational Line Geometry, 2001);
    normals that pass it at a distance lose their weight. On a bowl, which is nearly a ball, all lines through
    the middle fit about as well: then the vertical is tried too.
    """
    centre = points.mean(axis=0)
    moments = np.cross(points - centre, normals)
    weights = np.ones(len(points))
    for _ in range(4):
        mm, mn, nn = _products(moments, normals, weights)
        solved = np.linalg.solve(nn, mn.T)
        axes = np.linalg.eigh(mm - mn @ solved)[1].T
        moment = -solved @ axes[0]
        weights = _weights(moments @ axes[0] + normals @ moment, noise)
    for axis in (axes[0], UP):
        level, weights, moment = np.stack(_across(axis), axis=1), np.ones(len(points)), np.zeros(3)
        for _ in range(4):
            _, mn, nn = _products(moments, normals, weights)
            moment = -level @ np.linalg.solve(level.T @ nn @ level, level.T @ mn.T @ axis)
            weights = _weights(moments @ axis + normals @ moment, noise)
        yield centre + np.cross(axis, moment), axis


def _products(moments: Array, normals: Array, weights: Array) -> tuple[Array, Array, Array]:
    """Weighted sums (3, 3) of the products of moments (N, 3) and normals (N, 3)."""
    weighted = weights[:, None] * normals
    few = 1e-6 * len(normals) * np.eye(3)
    return moments.T @ (weights[:, None] * moments), moments.T @ weighted, normals.T @ weighted + few


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
        return sum(free_in_slab(slab, voxels) for slab in self.slabs)


Compound = Revolution | OpenBox
"""A surface that could be several primitives."""


def free_in_slab(slab: Box, voxels: VoxelMap) -> int:
    """Number of voxels seen free that a thin box fills, with free ones on either side."""
    axes = [_middles(n) - 0.5 for n in slab.extents / voxels.config.size]
    local = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) * slab.extents
    # The seen part of a surface may lie in the voxel beside it.
    beside = 0.5 * voxels.config.size * np.eye(3)[slab.extents.argmin()]
    around = np.concatenate([local - beside, local, local + beside])
    free = voxels.empty_at(transforms.transform(slab.T_world_object, around))
    return int(np.count_nonzero(free.reshape(3, -1).all(axis=0)))


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


def _costs(distance: Array, cosine: Array, noise: float, config: ExplanationConfig) -> Array:
    """Cost [nats] of points at a distance [m] from a surface whose normals make an angle with theirs."""
    costs = distance**2 / (2.0 * noise**2) + config.normal_weight * (1.0 - cosine)
    return np.minimum(costs, config.outlier)


def shape_costs(
    shape: Shape, points: Array, normals: Array, noise: float, config: ExplanationConfig
) -> Array:
    """Cost (N,) [nats] of oriented points (N, 3) on the surface of a shape."""
    sizes = shape.code, shape.T_world_object, shape.extents / 2.0
    costs: Array = _point_costs(*sizes, points, normals, noise, config.normal_weight, config.outlier)
    return costs


@kernel
def _point_costs(kind, T, half, points, normals, noise, normal_weight, outlier):  # type: ignore[no-untyped-def]
    costs, hx, hy, hz = np.empty(len(points)), half[0], half[1], half[2]
    centre, origin = T[:3, 3], np.zeros(3)
    for i in range(len(points)):
        x, y, z = local(T, centre, points, i)
        distance, gx, gy, gz = gradient(kind, x, y, z, hx, hy, hz)
        u, v, w = local(T, origin, normals, i)
        turned = 1.0 - (gx * u + gy * v + gz * w)
        costs[i] = min(distance**2 / (2.0 * noise**2) + normal_weight * turned, outlier)
    return costs
