"""Hidden extents: how far a shape reaches into unseen space, limited by free space and other shapes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from caryatid.config import CompletionConfig
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Cylinder, Primitives, Shape, Sphere
from caryatid.geometry.solids import Solid
from caryatid.geometry.transforms import UP, Array
from caryatid.graph import SceneObject
from caryatid.segmentation.support_plane import Mask, SupportSurface, find_surface_below
from caryatid.sensing.voxel_map import FREE, VoxelMap

SPACING = 0.015
"""Spacing of the points tested on the moving side [m]."""
LEAST = 0.0005
"""Smaller gaps do not count [m]."""
THIN = 0.01
"""A side this close to the opposite one may lie inside what is below [m]; fits are at least 8 mm deep."""


Face = tuple[Array, Array]
"""Points (N, 3) [m] all over a side, and its rim (M, 3)."""


def complete(
    objects: Sequence[SceneObject],
    surfaces: Sequence[SupportSurface],
    voxels: VoxelMap,
    config: CompletionConfig,
) -> list[SceneObject]:
    """Extend the unseen lower side of each object until it meets free space, another shape or the table.

    Before, unseen upper sides, whose points end only in the shadow of what lies above, are extended to it
    where that is likelier than not. Objects are extended from the lowest up, so that those below are
    complete.

    Args:
        objects: Objects without the support surface; `seen` says which sides points confirm.
        surfaces: The support surfaces, the main one first.
        voxels: The voxel map.
        config: Tolerances.
    """
    every, others = _Balls.of([o.shape for o in objects]), ~np.eye(len(objects), dtype=np.bool_)
    done = [_raise_upper_side(o, every, others[k], voxels, config) for k, o in enumerate(objects)]
    lowest = [o.shape.surface(SPACING)[0][:, 2].min() for o in objects]
    tops = np.array([o.centre_world[2] + o.shape.support(UP[None])[0] for o in done])
    below = find_surface_below(surfaces, np.array([o.centre_world for o in done]).reshape(-1, 3))
    every = _Balls.of([o.shape for o in done])
    for k in sorted(range(len(done)), key=lambda k: (lowest[k], done[k].label)):
        lower = tops < tops[k]
        done[k] = _extend_downwards(done[k], every, others[k], lower, surfaces[below[k]], voxels, config)
        every.put(k, done[k].shape)
    return done


class _Balls(NamedTuple):
    """N shapes, and a ball around each: centres (N, 3) and radii (N,) [m]."""

    shapes: list[Shape]
    centres: Array
    radii: Array

    @classmethod
    def of(cls, shapes: list[Shape]) -> _Balls:
        arrays = Primitives.of(shapes)
        return cls(shapes, arrays.centres, np.linalg.norm(arrays.half, axis=1))

    def put(self, k: int, shape: Shape) -> None:
        """Put another shape in the place of one."""
        self.shapes[k], self.centres[k] = shape, shape.T_world_object[:3, 3]
        self.radii[k] = np.linalg.norm(shape.extents) / 2.0


def _raise_upper_side(
    candidate: SceneObject, every: _Balls, others: Mask, voxels: VoxelMap, config: CompletionConfig
) -> SceneObject:
    """Extend an object's unseen upper side to the shape above if that is likely; widen its uncertainty."""
    shape, known = candidate.shape, candidate.uncertainty
    if isinstance(shape, Sphere) or known is None:
        return candidate
    axis, sign = _downward_side(shape)
    side = 2 * axis + (sign < 0.0)
    up_world = -sign * shape.T_world_object[:3, axis]
    if candidate.seen[side] or up_world[2] < np.cos(np.radians(config.max_tilt)):
        return candidate
    points, rim = _face(shape, axis, -sign)
    across = np.delete(shape.T_world_object[:3, :3], axis, axis=1)
    shown, most = float(shape.extents[axis]), float(voxels.config.extent[2])
    room = _way_to_others(_inwards(points, across, config.overlap), up_world, most, every, others, config)
    if room < LEAST or room >= most:
        return candidate
    if _free_before(_inwards(rim, across, voxels.config.size), up_world, room, voxels, config) < room:
        return candidate
    if shown >= room:
        why = f"an unseen upper side is assumed to reach the next object, {1000 * room:.0f} mm further"
        why = f"{candidate.why}; {why}" if candidate.why else why
        shape = _lengthened(shape, axis, -sign, room)
        candidate = replace(candidate, shape=shape, why=why)
    variance = _variance(shown, room, room if shown >= room else 0.0)
    return replace(candidate, uncertainty=known.widened(side, variance))


def _variance(shown: float, room: float, put: float) -> float:
    """Mean squared error [m²] of a side put that far beyond the part of an object that shows [m].

    Of a length l, the share v/l that shows is anything between 0 and 1, and without a scale, p(l) ∝ 1/l. So
    l has the density v/l², and it exceeds w = v + room with probability v/w; then the side ends there.
    """
    v, w, at = shown, shown + room, shown + put
    # ∫ v/l² (l − at)² dl from v to w, and the rest at w.
    return float(v * (w - v) - 2.0 * v * at * np.log(w / v) + at**2 * (w - v) / w + (w - at) ** 2 * v / w)


def _extend_downwards(
    candidate: SceneObject,
    every: _Balls,
    others: Mask,
    lower: Mask,
    surface: SupportSurface,
    voxels: VoxelMap,
    config: CompletionConfig,
) -> SceneObject:
    """Extend an object's unseen lower side down to the table, another shape or free space.

    If that lies below the table, or a thin object reaches into a lower shape, it is raised instead.
    """
    shape = candidate.shape
    if isinstance(shape, Sphere):
        return candidate
    axis, sign = _downward_side(shape)
    down_world = sign * shape.T_world_object[:3, axis]
    upright = -down_world[2] >= np.cos(np.radians(config.max_tilt))
    if not upright or candidate.seen[2 * axis + (sign > 0)]:
        return candidate
    points, rim = _face(shape, axis, sign)
    length = float(surface.height(points).min()) / -float(down_world @ surface.normal_world)
    across = np.delete(shape.T_world_object[:3, :3], axis, axis=1)
    shown = float(shape.extents[axis])
    if lower.any() and shown < THIN:
        # As deep as a fit must be at least, it may reach into what it lies on.
        top = _inwards(_face(shape, axis, -sign)[0], across, config.overlap)
        room = _way_to_others(top, down_world, shown, every, lower, replace(config, overlap=0.0))
        length = min(length, room - shown) if room < shown else length
    if length <= 0.0:
        return replace(candidate, shape=_lengthened(shape, axis, sign, length))
    reason = "is assumed to reach down to the table"
    # What lies beside the shape may overlap its walls by as much as what lies ahead may overlap the side.
    points = _inwards(points, across, config.overlap)
    to_object = _way_to_others(points, down_world, length, every, others, config)
    if to_object < length:
        length, reason = to_object, "ends at the next object"
    # A voxel inside the walls, so that their noise does not count.
    to_free = _free_before(_inwards(rim, across, voxels.config.size), down_world, length, voxels, config)
    if to_free < length:
        length, reason = to_free, "ends at free space"
    if length < LEAST:
        return candidate
    why = f"an unseen side {reason}, {1000 * length:.0f} mm further"
    why = f"{candidate.why}; {why}" if candidate.why else why
    return replace(candidate, shape=_lengthened(shape, axis, sign, length), why=why)


def _way_to_others(
    points: Array, outward: Array, limit: float, every: _Balls, others: Mask, config: CompletionConfig
) -> float:
    """How far [m] points (N, 3) can move before they meet one of some shapes (M,), by sphere tracing."""
    middle = points.mean(axis=0)
    # A ball around a shape that is further than the limit from the one around the face limits no step.
    to_centres = every.centres - middle
    ahead = np.clip(to_centres @ outward, 0.0, limit)
    aside = np.linalg.norm(to_centres - ahead[:, None] * outward, axis=1)
    radius = np.linalg.norm(points - middle, axis=1).max() + limit
    near = np.flatnonzero(others & (aside < radius + every.radii)).tolist()
    length = 0.0
    while near and length < limit:
        moved = points + length * outward
        gap = min(every.shapes[k].signed_distance(moved).min() for k in near) + config.overlap
        if gap < LEAST:
            return max(length - config.overlap, 0.0)
        length += gap
    return limit


def _free_before(
    rim: Array, outward: Array, limit: float, voxels: VoxelMap, config: CompletionConfig
) -> float:
    """How far [m] a rim (M, 3) can move before it lies in space seen free."""
    step = voxels.config.size
    lengths = np.append(0.0, np.cumsum(np.full(int(limit / step) + 1, step)))
    lengths = lengths[limit - lengths > step]
    if not len(lengths):
        return limit
    middles = rim + (lengths[:, None] + step / 2.0)[:, None] * outward
    free = voxels.state_at(middles.reshape(-1, 3)).reshape(len(lengths), -1) == FREE
    stops = np.flatnonzero(free.mean(axis=1) > config.max_free)
    return float(lengths[stops[0]]) if len(stops) else limit


def _downward_side(shape: Shape) -> tuple[int, float]:
    down = -shape.T_world_object[2, :3]
    axis = 2 if isinstance(shape, Cylinder) else int(np.argmax(np.abs(down)))
    return axis, 1.0 if down[axis] >= 0.0 else -1.0


def _face(shape: Shape, axis: int, sign: float) -> Face:
    if isinstance(shape, Solid):
        lowest = shape.outline()[shape.lowest(sign * np.eye(3)[axis], SPACING / 2.0)]
        middle = lowest.mean(axis=0)
        rings = [middle + share * (lowest - middle) for share in (0.0, 0.3, 0.6, 0.8, 1.0)]
        return np.concatenate(rings), lowest
    across = [(axis + 1) % 3, (axis + 2) % 3]
    half = shape.extents / 2.0
    u, v = (_ticks(half[k], SPACING) for k in across)
    grid = np.empty((len(u), len(v), 3))
    grid[..., axis], grid[..., across[0]], grid[..., across[1]] = sign * half[axis], u[:, None], v
    points = grid.reshape(-1, 3)
    if isinstance(shape, Cylinder):
        outward = np.hypot(points[:, 0], points[:, 1]) / shape.radius
        points[:, :2] /= np.maximum(outward, 1.0)[:, None]
    else:
        outward = np.abs(points[:, across] / half[across]).max(axis=1)
    points_world = transforms.transform(shape.T_world_object, points)
    return points_world, points_world[outward > 0.99]


def _inwards(points: Array, across: Array, length: float) -> Array:
    """Move the outermost of points (N, 3) by a length [m] to their middle along directions (3, 2)."""
    places = (points - points.mean(axis=0)) @ across
    half = np.abs(places).max(axis=0)
    moved: Array = points - (places * np.minimum(length / np.maximum(half, LEAST), 1.0)) @ across.T
    return moved


def _ticks(half: float, spacing: float) -> Array:
    """Evenly spaced numbers from −half to half, both included, at most `spacing` apart."""
    count = max(2, int(np.ceil(2.0 * half / spacing)))
    return half * (2.0 * np.arange(count + 1) / count - 1.0)


def _lengthened(shape: Shape, axis: int, sign: float, length: float) -> Shape:
    if isinstance(shape, Solid):
        return shape.lengthened(sign * np.eye(3)[axis], SPACING / 2.0, length)
    extents = shape.extents
    length = max(length, -0.8 * float(extents[axis]))
    shift = np.zeros(3)
    shift[axis] = sign * length / 2.0
    T = transforms.rigid(shape.T_world_object[:3, :3], transforms.transform(shape.T_world_object, shift))
    grown = extents.copy()
    grown[axis] += length
    return shape.from_extents(T, grown)
