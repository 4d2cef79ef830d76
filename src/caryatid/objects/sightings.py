"""One shape from several sightings of the same object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations, product

import numpy as np

from caryatid.config import FusionConfig
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Shape, Sphere
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject

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
    if isinstance(shape, Sphere):
        return np.eye(3), 0.0
    R, R_reference = shape.T_world_object[:3, :3], reference.T_world_object[:3, :3]
    round_ = isinstance(shape, Cylinder)
    turn = _turns(R[None], R_reference, round_)[0]
    if round_:
        return turn, float(transforms.angle_between((R @ turn)[:, 2], R_reference[:, 2]))
    trace = float(np.sum((R @ turn) * R_reference))
    return turn, float(np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0)))


def _evidence(o: SceneObject, config: FusionConfig) -> float:
    """Weight of a sighting: the sides seen, less for a bad residual."""
    return (config.blind + sum(o.seen)) / (1.0 + (o.residual / config.residual) ** 2)


def _merged_sphere(spheres: Sequence[Shape], weights: Array) -> Sphere:
    centre = np.average([s.T_world_object[:3, 3] for s in spheres], axis=0, weights=weights)
    radius = float(np.average([s.extents[0] / 2.0 for s in spheres], weights=weights))
    return Sphere(transforms.rigid(np.eye(3), centre), radius)


def _merged_sides(
    same: Sequence[SceneObject], weights: Array, best: SceneObject
) -> tuple[Box | Cylinder, tuple[bool, bool, bool, bool, bool, bool]]:
    """Average axes, then each of the six sides along them."""
    T = np.array([o.shape.T_world_object for o in same])
    extents = np.array([o.shape.extents for o in same])
    round_ = isinstance(best.shape, Cylinder)
    turns = _turns(T[:, :3, :3], best.shape.T_world_object[:3, :3], round_)
    R = _mean_axes(np.average(T[:, :3, :3] @ turns, axis=0, weights=weights), round_)
    middles = T[:, :3, 3] @ R
    half = np.abs(np.einsum("kij,ki->kj", turns, extents))[:, :, None] / 2.0
    ends = middles[:, :, None] + half * (-1.0, 1.0)
    # The sides along a new axis are those along one of the old axes, in the other order where it points back.
    sources = np.abs(turns).argmax(axis=1)
    seen = np.take_along_axis(np.array([o.seen for o in same]).reshape(-1, 3, 2), sources[:, :, None], axis=1)
    ahead = turns.sum(axis=1)[:, :, None] > 0.0
    seen = np.where(ahead, seen, seen[:, :, ::-1])
    share = weights[:, None, None] * seen
    known = seen.any(axis=0)
    mean = (share * ends).sum(axis=0) / np.where(known, share.sum(axis=0), 1.0)
    widest = np.stack([ends[:, :, 0].min(axis=0), ends[:, :, 1].max(axis=0)], axis=1)
    low, high = np.where(known, mean, widest).T
    sides = known.ravel().tolist()
    flags = (sides[0], sides[1], sides[2], sides[3], sides[4], sides[5])
    if round_:
        centre = np.average(middles, axis=0, weights=weights)
        centre[2] = (low[2] + high[2]) / 2.0
        radius = float(np.average(extents[:, 0] / 2.0, weights=weights))
        return Cylinder(transforms.rigid(R, R @ centre), radius, float(max(high[2] - low[2], 1e-3))), flags
    return Box(transforms.rigid(R, R @ ((low + high) / 2.0)), np.maximum(high - low, 1e-3)), flags


def _turns(R: Array, R_reference: Array, axis_only: bool) -> Array:
    """Turns (K, 3, 3) within a shape's symmetry that bring axes (K, 3, 3) nearest to a reference's (3, 3)."""
    if axis_only:
        flipped = R[:, :, 2] @ R_reference[:, 2] < 0.0
        return np.where(flipped[:, None, None], np.diag([1.0, -1.0, -1.0]), np.eye(3))
    traces = (np.swapaxes(R, 1, 2) @ R_reference).reshape(-1, 9) @ _TURNS.reshape(-1, 9).T
    return _TURNS[traces.argmax(axis=1)]


def _mean_axes(mean: Array, axis_only: bool) -> Array:
    """Chordal mean of rotations from their average; of a cylinder only the axis means something."""
    if axis_only:
        z = transforms.unit(mean[:, 2])
        x = transforms.perpendicular(z)
        return np.stack([x, np.cross(z, x), z], axis=1)
    u, _, vt = np.linalg.svd(mean)
    return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
