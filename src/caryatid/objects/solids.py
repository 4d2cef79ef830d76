"""Solids: the shape of an object that no primitive explains, its hull less the cavities seen in it.

A solid is the convex hull of its points, and of what explains them in unseen space, less convex cavities. A
point of the object looks into a cavity if its normal leads through space seen free before it leaves the hull;
the cavity lies in front of all the faces that look at that space. The other side of a wall seen from outside
only, and of an unseen floor, is taken to be as near as that of the thinnest object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from caryatid.config import FitConfig
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Shape, Uncertainty, fibonacci_sphere
from caryatid.geometry.solids import Polytope, Solid, hollowed
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject
from caryatid.objects.compounds import Compound
from caryatid.objects.description_length import Evidence
from caryatid.sensing.views import Cloud
from caryatid.sensing.voxel_map import FREE, UNKNOWN, VoxelMap

DIRECTIONS = fibonacci_sphere(200)
"""Directions (N, 3) in which an object's hull is as wide as its points; 16° apart."""
CAVITIES = 4
"""Maximum number of cavities [1]."""
FEW = 5
"""Minimum number of points of a cavity's face [1]; 3 cm² of them."""
ALIKE = float(np.cos(np.radians(18.0)))
"""Cosine of the angle to the normal of a cavity's face up to which points are on it [1]."""


def as_solid(
    fitted: SceneObject,
    cloud: Cloud,
    evidence: Evidence,
    backs: Sequence[Shape | Compound],
    others: Sequence[Shape],
    config: FitConfig,
) -> SceneObject:
    """Return an object with the solid of its points instead of its fitted primitive.

    Args:
        fitted: The object; it does not change if its points span no volume.
        cloud: Its points.
        evidence: Some of them, evenly spread, their noise, and the space seen free.
        backs: Shapes whose surfaces in unseen space may be the object's.
        others: Shapes of the other objects near it.
        config: `min_extent` is the thickness of a wall seen from one side.
    """
    places, outward = _smoothed(cloud, evidence)
    if not len(places) or evidence.voxels is None:
        return fitted
    solid = _solid(places, outward, _unseen(backs, places, others, evidence.voxels), evidence, config)
    if solid is None:
        return fitted
    sides = np.stack([sign * outward[:, axis] for axis in range(3) for sign in (-1.0, 1.0)])
    seen = np.count_nonzero(sides > np.sqrt(0.5), axis=1) >= config.min_points
    sigma = np.full(3, config.registration)
    return replace(
        fitted,
        shape=solid,
        residual=float(np.abs(solid.signed_distance(evidence.points)).mean()),
        poor_fit=False,
        seen=tuple(seen.tolist()),
        why="no primitive explains its points",
        uncertainty=Uncertainty(sigma, np.zeros(3), np.zeros(3), np.repeat(sigma, 2)),
    )


def _unseen(
    backs: Sequence[Shape | Compound], places: Array, others: Sequence[Shape], voxels: VoxelMap
) -> Array:
    """Points (M, 3) of shapes in unseen space, as high as the object's (N, 3)."""
    points = np.concatenate([back.surface(voxels.config.size)[0] for back in backs])
    low, high = places[:, 2].min(), places[:, 2].max()
    points = points[(points[:, 2] >= low) & (points[:, 2] <= high)]
    points = points[voxels.state_at(points) == UNKNOWN]
    for other in others:
        points = points[other.signed_distance(points) > voxels.config.size]
    return points


def _solid(
    places: Array, outward: Array, unseen: Array, evidence: Evidence, config: FitConfig
) -> Solid | None:
    """The hull of points (N, 3) with normals (N, 3), less the cavities they show; None without volume."""
    spanned = np.concatenate([places, unseen])
    hull = Polytope.around(spanned[np.unique((DIRECTIONS @ spanned.T).argmax(axis=1))])
    if hull is None or evidence.voxels is None:
        return None
    parts, tolerance, voxels = [hull], evidence.noise, evidence.voxels
    tried = np.zeros(len(places), dtype=np.bool_)
    under, down = Solid(np.eye(4), (hull,)).surface(config.min_extent)
    below = (down[:, 2] < -0.7) & (voxels.state_at(under) != FREE)
    faces, facing = _with_backs(
        np.concatenate([places, under[below]]), np.concatenate([outward, down[below]]), config.min_extent
    )
    for _ in range(CAVITIES):
        empty = np.where(tried, 0.0, _way_inside(parts, places, outward, voxels.config.size))
        seed = int(empty.argmax())
        if empty[seed] < 2.0 * voxels.config.size:
            break
        tried[seed] = True
        eye = _free_point(places[seed], outward[seed], float(empty[seed]), voxels)
        planes = [] if eye is None else _cavity(eye, hull, faces, facing, tolerance)
        left = [piece for part in parts for piece in hollowed(part, planes)] if planes else []
        if left:  # What leaves nothing is no cavity.
            parts = left
            tried |= np.all([places @ n - d > -2.0 * tolerance for n, d in planes], axis=0)
    return Solid.of(parts)


def _smoothed(cloud: Cloud, evidence: Evidence) -> tuple[Array, Array]:
    """Evenly spread points in the mean plane of neighbours that face alike; lone ones are left out."""
    points, normals = evidence.points, evidence.normals
    count = min(16, len(cloud))
    near = cKDTree(cloud.points_world).query(points, k=count, distance_upper_bound=0.01)[1].reshape(-1, count)
    there = near < len(cloud)
    near = np.where(there, near, 0)
    facing = cloud.normals_world[near]
    alike = there & (np.einsum("ski,si->sk", facing, normals) > 0.8)
    apart = np.einsum("ski,si->sk", cloud.points_world[near] - points[:, None], normals)
    kept = alike.sum(axis=1) > 3
    shift = np.mean(apart, axis=1, where=alike | ~kept[:, None])
    mean = np.where(alike[..., None], facing, 0.0).sum(axis=1)
    return (points + shift[:, None] * normals)[kept], transforms.unit(mean[kept])


def _with_backs(places: Array, outward: Array, thickness: float) -> tuple[Array, Array]:
    """Points (N, 3) with outward normals (N, 3), and the other side of walls seen from one side."""
    backs = places - thickness * outward
    gap, near = cKDTree(places).query(backs, k=min(8, len(places)), distance_upper_bound=2.0 * thickness)
    opposite = np.einsum("ni,nki->nk", outward, outward[np.where(np.isfinite(gap), near, 0)]) < -0.5
    alone = ~(opposite & np.isfinite(gap)).any(axis=1)
    return np.concatenate([places, backs[alone]]), np.concatenate([outward, -outward[alone]])


def _way_inside(parts: Sequence[Polytope], places: Array, outward: Array, step: float) -> Array:
    """Distance (N,) [m] from each point along its normal to the end of all parts."""
    solid = Solid(np.eye(4), tuple(parts))
    length, moving = np.zeros(len(places)), np.arange(len(places))
    for k in range(1, 64):
        inside = solid.signed_distance(places[moving] + k * step * outward[moving]) < 0.0
        moving = moving[inside]
        if not len(moving):
            break
        length[moving] = k * step
    return length


def _free_point(place: Array, normal: Array, length: float, voxels: VoxelMap) -> Array | None:
    """The free point (3,) nearest to the middle of a line of this length [m] from a place, or None."""
    size = voxels.config.size
    ways = np.arange(1, max(round(length / size), 1) + 1) * size
    free = voxels.state_at(place + ways[:, None] * normal) == FREE
    if not free.any():
        return None
    best = ways[free][np.abs(ways[free] - length / 2.0).argmin()]
    point: Array = place + best * normal
    return point


def _cavity(
    eye: Array, hull: Polytope, places: Array, outward: Array, tolerance: float
) -> list[tuple[Array, float]]:
    """Planes (normal (3,), offset [m]) of the cavity around an empty point (3,): faces that look at it."""
    depth = -(places @ hull.faces[:, :3].T + hull.faces[:, 3]).max(axis=1)
    looking = np.einsum("ni,ni->n", outward, eye - places) > 0.0
    alike = outward @ DIRECTIONS.T > ALIKE
    planes: list[tuple[Array, float]] = []
    left = np.flatnonzero(looking & (depth > tolerance))
    while len(left):
        face = left[alike[left, alike[left].sum(axis=0).argmax()]]
        if len(face) < FEW:
            break
        normal = transforms.unit(outward[face].mean(axis=0))
        offset = float(np.median(places[face] @ normal))
        left = np.setdiff1d(left, face)
        if eye @ normal > offset:
            planes.append((normal, offset))
            left = left[places[left] @ normal > offset + tolerance]
    return planes
