"""One shape from several sightings of the same object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations, product

import numpy as np

from caryatid import frames
from caryatid.config import FusionConfig
from caryatid.frames import Array
from caryatid.graph import SceneObject
from caryatid.shapes import Box, Cylinder, Shape, Sphere

_TURNS = np.array(
    [
        matrix
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
        if np.linalg.det(matrix := np.diag(signs)[:, list(order)]) > 0.0
    ]
)
"""The 24 rotations (24, 3, 3) of a cube: ways to name the axes of a box."""


def merge(sightings: Sequence[SceneObject], config: FusionConfig) -> SceneObject:
    """Merge sightings of one object into a vertex whose shape is better than each.

    The kind is the one with the most evidence. Poses and radii are averaged with the evidence as weight; each
    side is averaged over the sightings that saw it, and lies farthest out where none did. The result does not
    depend on the order of the sightings but for rounding.

    Args:
        sightings: At least one; the first lends id, label and role.
        config: What a bad residual costs.
    """
    weights = np.array([_evidence(o, config) for o in sightings])
    kinds = sorted({o.shape.kind for o in sightings})
    votes = [sum(w for w, o in zip(weights, sightings, strict=True) if o.shape.kind == k) for k in kinds]
    kind = kinds[int(np.argmax(votes))]
    same = [o for o in sightings if o.shape.kind == kind]
    w = np.array([_evidence(o, config) for o in same])
    best = same[int(np.argmax(w))]
    if len(same) == 1:
        shape, seen = best.shape, best.seen
    elif isinstance(best.shape, Sphere):
        shape, seen = _merged_sphere([o.shape for o in same], w), best.seen
    else:
        shape, seen = _merged_sides(same, w, best)
    return replace(
        sightings[0],
        shape=shape,
        seen=seen,
        residual=float(np.average([o.residual for o in same], weights=w)),
        poor_fit=best.poor_fit,
        uncertainty=best.uncertainty,
        why=best.why,
        doubt=sightings[-1].doubt,
    )


def axes_rotation(shape: Shape, reference: Shape) -> tuple[Array, float]:
    """Turn of a shape's axes, within its symmetry, that brings them nearest to a reference's.

    Returns:
        The turn (3, 3), to be applied on the right of the shape's rotation, and the angle left [rad]; of a
        sphere, to which no turn matters, the identity and 0.
    """
    R, R_reference = shape.T_world_object[:3, :3], reference.T_world_object[:3, :3]
    if isinstance(shape, Sphere):
        return np.eye(3), 0.0
    if isinstance(shape, Cylinder):
        flip = np.diag([1.0, -1.0, -1.0]) if R[:, 2] @ R_reference[:, 2] < 0.0 else np.eye(3)
        return flip, float(frames.angle_between((R @ flip)[:, 2], R_reference[:, 2]))
    turned = R @ _TURNS
    traces = np.einsum("ij,kij->k", R_reference, turned)
    best = int(np.argmax(traces))
    return _TURNS[best], float(np.arccos(np.clip((traces[best] - 1.0) / 2.0, -1.0, 1.0)))


def _evidence(o: SceneObject, config: FusionConfig) -> float:
    """Weight of a sighting: the sides seen, less for a bad residual."""
    return (config.blind + sum(o.seen)) / (1.0 + (o.residual / config.residual) ** 2)


def _merged_sphere(spheres: Sequence[Shape], weights: Array) -> Sphere:
    centre = np.average([s.T_world_object[:3, 3] for s in spheres], axis=0, weights=weights)
    radius = float(np.average([s.extents[0] / 2.0 for s in spheres], weights=weights))
    return Sphere(frames.rigid(np.eye(3), centre), radius)


def _merged_sides(
    same: Sequence[SceneObject], weights: Array, best: SceneObject
) -> tuple[Box | Cylinder, tuple[bool, bool, bool, bool, bool, bool]]:
    """Average axes, then each of the six sides along them."""
    turns = [axes_rotation(o.shape, best.shape)[0] for o in same]
    rotations = [o.shape.T_world_object[:3, :3] @ t for o, t in zip(same, turns, strict=True)]
    R = _mean_axes(rotations, weights, isinstance(best.shape, Cylinder))
    ends = np.zeros((len(same), 6))
    seen = np.zeros((len(same), 6), dtype=bool)
    for k, (o, turn) in enumerate(zip(same, turns, strict=True)):
        middle = R.T @ o.shape.T_world_object[:3, 3]
        half = np.abs(turn.T @ o.shape.extents) / 2.0
        flags = np.array(o.seen).reshape(3, 2)
        for axis in range(3):
            source = int(np.argmax(np.abs(turn[:, axis])))
            pair = flags[source] if turn[source, axis] > 0.0 else flags[source][::-1]
            seen[k, 2 * axis : 2 * axis + 2] = pair
            ends[k, 2 * axis], ends[k, 2 * axis + 1] = middle[axis] - half[axis], middle[axis] + half[axis]
    merged = np.empty(6)
    for side in range(6):
        if seen[:, side].any():
            merged[side] = np.average(ends[seen[:, side], side], weights=weights[seen[:, side]])
        else:
            merged[side] = ends[:, side].max() if side % 2 else ends[:, side].min()
    low, high = merged[0::2], merged[1::2]
    any_seen = [bool(side.any()) for side in seen.T]
    flags6 = (any_seen[0], any_seen[1], any_seen[2], any_seen[3], any_seen[4], any_seen[5])
    if isinstance(best.shape, Cylinder):
        centres = np.array([R.T @ o.shape.T_world_object[:3, 3] for o in same])
        centre = np.average(centres, axis=0, weights=weights)
        centre[2] = (low[2] + high[2]) / 2.0
        radius = float(np.average([o.shape.extents[0] / 2.0 for o in same], weights=weights))
        return Cylinder(frames.rigid(R, R @ centre), radius, float(max(high[2] - low[2], 1e-3))), flags6
    T = frames.rigid(R, R @ ((low + high) / 2.0))
    return Box(T, np.maximum(high - low, 1e-3)), flags6


def _mean_axes(rotations: Sequence[Array], weights: Array, axis_only: bool) -> Array:
    """Weighted chordal mean of rotations; of a cylinder only the axis means something."""
    mean = np.average(rotations, axis=0, weights=weights)
    if axis_only:
        z = frames.unit(mean[:, 2])
        x = frames.perpendicular(z)
        return np.stack([x, np.cross(z, x), z], axis=1)
    u, _, vt = np.linalg.svd(mean)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
