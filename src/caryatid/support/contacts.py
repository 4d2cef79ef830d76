"""Contacts between shapes, found by MuJoCo, with one separating plane per pair."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import mujoco
import numpy as np
from numpy.typing import NDArray

from caryatid.errors import InputError
from caryatid.geometry import BOX, CYLINDER, SPHERE, transforms
from caryatid.geometry.shapes import Primitives, Shape, fibonacci_sphere
from caryatid.geometry.solids import Solid
from caryatid.geometry.transforms import Array

_GEOM_TYPES = {
    SPHERE: mujoco.mjtGeom.mjGEOM_SPHERE,
    CYLINDER: mujoco.mjtGeom.mjGEOM_CYLINDER,
    BOX: mujoco.mjtGeom.mjGEOM_BOX,
}
"""MuJoCo's number of each kind of shape, by its code."""


@dataclass(frozen=True, eq=False, slots=True)
class Contact:
    """Two shapes that touch, nearly touch or overlap, by a convex part of each.

    Attributes:
        a: Index of the first shape.
        b: Index of the second shape.
        parts: The convex parts of both; of most shapes the shape itself.
        points_world: Contact points (K, 3) [m], midway between the two surfaces.
        point_world: Their centre (3,) [m].
        normal_world: Unit normal (3,) of the separating plane, from a to b.
        distance: Smallest gap [m]; negative where the shapes overlap.
    """

    a: int
    b: int
    parts: tuple[Shape, Shape]
    points_world: Array
    point_world: Array
    normal_world: Array
    distance: float

    @property
    def tilt(self) -> float:
        """Angle of the normal to the vertical [deg]: b lies on top of a at 0, and below it at 180."""
        return float(np.degrees(np.arccos(np.clip(self.normal_world[2], -1.0, 1.0))))

    def reversed(self) -> Contact:
        """The same contact, seen from b to a."""
        return replace(self, a=self.b, b=self.a, parts=self.parts[::-1], normal_world=-self.normal_world)


def find_contacts(shapes: Sequence[Shape], margin: float) -> list[Contact]:
    """Find every pair of shapes whose gap is at most the margin.

    Args:
        shapes: In the world frame.
        margin: Largest gap [m].

    Returns:
        One contact per pair of convex parts, a < b, sorted by (a, b) and the parts' numbers.

    Raises:
        InputError: The margin is negative.
    """
    if not margin >= 0.0:
        raise InputError("margin", "is negative or NaN", "give the largest gap of a contact in metres")
    if len(shapes) < 2:
        return []
    parts = [part for shape in shapes for part in shape.parts]
    owners = np.repeat(np.arange(len(shapes)), [len(shape.parts) for shape in shapes])
    found = _collide(parts, owners, margin).contact
    geoms = np.sort(found.geom, axis=1)
    rows = np.lexsort((geoms[:, 1], geoms[:, 0]))
    rows = rows[owners[geoms[rows, 0]] != owners[geoms[rows, 1]]]
    if not len(rows):
        return []
    geoms, points_world = geoms[rows], found.pos[rows]
    starts = np.flatnonzero(np.append(True, (geoms[1:] != geoms[:-1]).any(axis=1)))
    counts = np.diff(starts, append=len(rows))[:, None]
    signs = np.where(found.geom[rows, 0] != geoms[:, 0], -1.0, 1.0)
    normals_world = np.add.reduceat(signs[:, None] * found.frame[rows, :3], starts) / counts
    columns = (
        np.split(points_world, starts[1:]),
        np.add.reduceat(points_world, starts) / counts,
        transforms.unit(normals_world),
        np.minimum.reduceat(found.dist[rows], starts).tolist(),
    )
    return [
        Contact(int(owners[a]), int(owners[b]), (parts[a], parts[b]), *rest)
        for (a, b), *rest in zip(geoms[starts].tolist(), *columns, strict=True)
    ]


def find_gap(a: Shape, b: Shape) -> float:
    """Distance [m] between two shapes at any range; negative if they overlap."""
    parts, count = [*a.parts, *b.parts], len(a.parts)
    data = _collide(parts, np.arange(len(parts)), 0.0)
    apart = float(np.linalg.norm(a.T_world_object[:3, 3] - b.T_world_object[:3, 3]))
    return min(
        float(mujoco.mj_geomDistance(data.model, data, i, j, apart, np.empty(6)))
        for i in range(count)
        for j in range(count, len(parts))
    )


def _collide(parts: Sequence[Shape], owners: NDArray[np.intp], margin: float) -> mujoco.MjData:
    """Run MuJoCo's collision detection on convex parts up to gaps of a margin [m].

    Contacts between parts of one owner may be missing; most are. The result holds until the next call in
    the same thread.
    """
    count, (kinds, R, centres, half) = len(parts), Primitives.of(parts)
    forms = [(k, part.polytopes[0].vertices) for k, part in enumerate(parts) if isinstance(part, Solid)]
    corners = max((len(vertices) for _, vertices in forms), default=0)
    room = (_room(len(forms), 4), _room(corners, 64)) if forms else (0, 0)
    model, data = _engine(_room(count, 16), *room, threading.get_ident())
    size = half.copy()
    size[kinds == CYLINDER, 1] = half[kinds == CYLINDER, 2]
    model.geom_type[:count], model.geom_size[:count] = [_GEOM_TYPES[kind] for kind in kinds.tolist()], size
    model.geom_rbound[:count] = np.linalg.norm(half, axis=1)
    model.geom_aabb[:count, :3], model.geom_aabb[:count, 3:] = 0.0, half
    for mesh, (k, vertices) in enumerate(forms):
        first = model.mesh_vertadr[mesh]
        model.mesh_vert[first : first + len(vertices)] = vertices
        model.mesh_vertnum[mesh], model.mesh_graphadr[mesh] = len(vertices), -1
        model.geom_type[k], model.geom_dataid[k] = mujoco.mjtGeom.mjGEOM_MESH, mesh
    # A pair's margin is the sum of its two geoms'.
    model.geom_margin[:count] = model.body_margin[1 : count + 1] = margin / 2.0
    taken = np.arange(model.ngeom) < count
    collides, with_what = taken.astype(np.int32), np.where(taken, np.int32(-1), np.int32(0))
    own = np.unique(owners[[k for k, _ in forms]])
    for bit, owner in enumerate(own.tolist()[:30], start=1):
        # Parts of one solid do not collide.
        collides[:count][owners == owner] = 1 << bit
        with_what[:count][owners == owner] = ~(1 << bit)
    model.geom_contype[:], model.geom_conaffinity[:] = collides, with_what
    model.body_contype[1:], model.body_conaffinity[1:] = collides, with_what
    model.body_pos[1 : count + 1] = centres
    for quaternion, axes in zip(model.body_quat[1:], R.reshape(count, 9), strict=False):
        mujoco.mju_mat2Quat(quaternion, axes)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    return data


def _room(count: int, least: int) -> int:
    """A sufficient power of two."""
    return max(least, 1 << (count - 1).bit_length())


@lru_cache(maxsize=8)
def _engine(capacity: int, meshes: int, corners: int, thread: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Bodies with a geom each, and meshes for some of them, set before each use; one per thread."""
    spec = mujoco.MjSpec()
    for _ in range(capacity):
        body = spec.worldbody.add_body(mass=1.0, inertia=np.ones(3), explicitinertial=True)
        # Bodies without a joint would not collide; with six degrees of freedom, 1,000 take 0.2 s to compile.
        body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE)
        body.add_geom(size=np.ones(3))
    ball = fibonacci_sphere(corners).ravel().tolist() if meshes else []
    for number in range(meshes):
        spec.add_mesh(name=f"mesh{number}", uservert=ball)
    model = spec.compile()
    model.geom_pos[:], model.geom_quat[:] = 0.0, (1.0, 0.0, 0.0, 0.0)
    # Faces would be those of the ball: with none, a solid has one contact point with a convex part.
    model.mesh_polymapnum[:] = 0
    return model, mujoco.MjData(model)
