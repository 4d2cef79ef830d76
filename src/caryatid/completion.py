"""Hidden extents: how far a shape reaches where nobody looked, bounded by free space and by what is there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from caryatid import frames
from caryatid.config import CompletionConfig
from caryatid.frames import Array
from caryatid.graph import SceneObject
from caryatid.shapes import Box, Cylinder, Shape, Sphere
from caryatid.surface import SupportSurface
from caryatid.voxels import FREE, VoxelMap


def complete(
    objects: Sequence[SceneObject], surface: SupportSurface, voxels: VoxelMap, config: CompletionConfig
) -> list[SceneObject]:
    """Extend the unseen lower side of each object until it meets free space, another shape or the table.

    An object of which one side alone was seen is taken to be as deep as it is wide, in the same bounds.

    Objects are taken from the lowest up, so that each finds what lies below it already completed.

    Args:
        objects: Objects without the support surface; `seen` says which sides points bear out.
        surface: The table top.
        voxels: What has been seen free.
        config: Steps and tolerances.
    """
    done: dict[str, SceneObject] = {}
    for candidate in sorted(objects, key=lambda o: (_lowest(o.shape), o.label)):
        others = [done.get(o.id, o).shape for o in objects if o.id != candidate.id]
        done[candidate.id] = _extended(candidate, others, surface, voxels, config)
    return [done[o.id] for o in objects]


def _extended(
    candidate: SceneObject,
    others: Sequence[Shape],
    surface: SupportSurface,
    voxels: VoxelMap,
    config: CompletionConfig,
) -> SceneObject:
    shape = candidate.shape
    if isinstance(shape, Sphere):
        return candidate
    axis, sign = _downward_side(shape)
    down_world = sign * shape.T_world_object[:3, axis]
    upright = -down_world[2] >= np.cos(np.radians(config.max_tilt))
    if upright and not candidate.seen[2 * axis + (sign > 0)]:
        bottom = _face_grid(shape, axis, sign, config.spacing)
        to_table = float(np.min(surface.height(bottom) / -(down_world @ surface.normal_world)))
        if to_table <= 0.0:
            candidate = replace(candidate, shape=_lengthened(shape, axis, sign, to_table))
        else:
            candidate = _moved_out(
                candidate, axis, sign, to_table, "down to the table", others, voxels, config
            )
    hidden = _depth_side(candidate, config)
    if hidden is None or (upright and hidden[0] == axis):
        return candidate
    guess = float(np.delete(candidate.shape.extents, hidden[0]).min()) - float(
        candidate.shape.extents[hidden[0]]
    )
    return _moved_out(candidate, *hidden, guess, "as deep as it is wide", others, voxels, config)


def _moved_out(
    candidate: SceneObject,
    axis: int,
    sign: float,
    limit: float,
    aim: str,
    others: Sequence[Shape],
    voxels: VoxelMap,
    config: CompletionConfig,
) -> SceneObject:
    """Move one side outwards up to a limit [m], another shape or free space, whichever comes first."""
    shape = candidate.shape
    if isinstance(shape, Sphere):
        return candidate
    outward_world = sign * shape.T_world_object[:3, axis]
    face = _face_grid(shape, axis, sign, config.spacing)
    length, reason = limit, f"is taken to reach {aim}"
    to_object = _gap_before(face, outward_world, others, limit, config)
    if to_object < length:
        length, reason = to_object, "ends at the next object"
    to_free = _free_before(shape, face, axis, outward_world, length, voxels, config)
    if to_free < length:
        length, reason = to_free, "ends where free space was seen"
    if length < config.least:
        return candidate
    why = f"a side that was not seen {reason}, {1000 * length:.0f} mm further"
    why = f"{candidate.why}; {why}" if candidate.why else why
    return replace(candidate, shape=_lengthened(shape, axis, sign, length), why=why)


def _depth_side(candidate: SceneObject, config: CompletionConfig) -> tuple[int, float] | None:
    """The hidden side (axis, sign) opposite the only one seen, where the points say nothing of the depth."""
    seen = np.flatnonzero(candidate.seen)
    if len(seen) != 1:
        return None
    axis, side = divmod(int(seen[0]), 2)
    if isinstance(candidate.shape, Cylinder) and axis != 2:
        return None
    if candidate.shape.extents[axis] > config.flat:
        return None
    return axis, -1.0 if side else 1.0


def _gap_before(
    face: Array, outward_world: Array, others: Sequence[Shape], limit: float, config: CompletionConfig
) -> float:
    """How far [m] a face can move before it meets another shape, by sphere tracing."""
    length = 0.0
    while others and length < limit:
        moved = face + length * outward_world
        nearest = min(float(o.signed_distance(moved).min()) for o in others) + config.overlap
        if nearest < config.least:
            return max(length - config.overlap, 0.0)
        length += nearest
    return limit


def _free_before(
    shape: Box | Cylinder,
    face: Array,
    axis: int,
    outward_world: Array,
    limit: float,
    voxels: VoxelMap,
    config: CompletionConfig,
) -> float:
    """How far [m] a face can move before its rim lies in space seen free."""
    ring = _rim(shape, face, axis, config.inset)
    length = 0.0
    while limit - length > config.step:
        free = voxels.state_at(ring + (length + config.step / 2.0) * outward_world) == FREE
        if float(free.mean()) > config.max_free:
            return length
        length += config.step
    return limit


def _downward_side(shape: Box | Cylinder) -> tuple[int, float]:
    down = -shape.T_world_object[2, :3]
    axis = 2 if isinstance(shape, Cylinder) else int(np.argmax(np.abs(down)))
    return axis, 1.0 if down[axis] >= 0.0 else -1.0


def _face_grid(shape: Box | Cylinder, axis: int, sign: float, spacing: float) -> Array:
    """Points (N, 3) [m] all over one face, its rim included."""
    u, v = (axis + 1) % 3, (axis + 2) % 3
    half = shape.extents / 2.0
    ticks = [
        np.linspace(-half[k], half[k], max(3, 1 + int(np.ceil(2.0 * half[k] / spacing)))) for k in (u, v)
    ]
    grid_u, grid_v = (g.ravel() for g in np.meshgrid(*ticks, indexing="ij"))
    local = np.zeros((len(grid_u), 3))
    local[:, axis], local[:, u], local[:, v] = sign * half[axis], grid_u, grid_v
    if isinstance(shape, Cylinder):
        reach = np.hypot(grid_u, grid_v)
        outside = reach > shape.radius
        local[outside, :2] *= (shape.radius / reach[outside])[:, None]
    return frames.transform(shape.T_world_object, local)


def _rim(shape: Box | Cylinder, face: Array, axis: int, inset: float) -> Array:
    """The outermost points of a face grid, drawn in by `inset` [m] to lie inside the shape's walls."""
    local = frames.transform(frames.invert(shape.T_world_object), face)
    across = [k for k in range(3) if k != axis]
    half = shape.extents / 2.0
    if isinstance(shape, Cylinder):
        on_rim = np.hypot(local[:, 0], local[:, 1]) > 0.99 * shape.radius
    else:
        on_rim = np.max(np.abs(local[:, across]) / half[across], axis=1) > 0.99
    drawn = local[on_rim]
    drawn[:, across] *= np.maximum(1.0 - inset / half[across], 0.0)
    return frames.transform(shape.T_world_object, drawn)


def _lengthened(shape: Box | Cylinder, axis: int, sign: float, length: float) -> Box | Cylinder:
    extents = shape.extents
    length = max(length, -0.8 * float(extents[axis]))
    shift = np.zeros(3)
    shift[axis] = sign * length / 2.0
    T = frames.rigid(shape.T_world_object[:3, :3], frames.transform(shape.T_world_object, shift))
    if isinstance(shape, Cylinder):
        return Cylinder(T, shape.radius, shape.height + length)
    grown = extents.copy()
    grown[axis] += length
    return Box(T, grown)


def _lowest(shape: Shape) -> float:
    return float(shape.T_world_object[2, 3] - shape.support(np.array([[0.0, 0.0, -1.0]]))[0])
