"""Contacts between shapes: MuJoCo finds them, one separating plane a pair."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from caryatid import frames
from caryatid.errors import InputError
from caryatid.frames import Array
from caryatid.shapes import Shape

_GEOM_TYPES = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
}


@dataclass(frozen=True, eq=False, slots=True)
class Contact:
    """Two shapes that touch, nearly touch or overlap.

    Attributes:
        a: Index of the first shape.
        b: Index of the second shape; a < b.
        points_world: Contact points (K, 3) [m], midway between the two surfaces.
        normal_world: Unit normal (3,) of the separating plane, from a to b.
        distance: Smallest gap [m]; negative where the shapes overlap.
    """

    a: int
    b: int
    points_world: Array
    normal_world: Array
    distance: float


def find_contacts(shapes: Sequence[Shape], margin: float | Sequence[float]) -> list[Contact]:
    """Find every pair of shapes whose gap is at most the margin.

    Args:
        shapes: Boxes, cylinders and spheres in the world frame.
        margin: Largest gap [m]; one for each shape counts by the mean of the pair.

    Returns:
        One contact a pair, sorted by (a, b).

    Raises:
        InputError: A margin is negative, there is not one for each shape, or a shape is of no known kind.
    """
    margins = np.asarray(margin, dtype=np.float64)
    if margins.ndim and margins.shape != (len(shapes),):
        raise InputError(
            "margin", f"{margins.size} margins for {len(shapes)} shapes", "give one for each or one for all"
        )
    if not (margins >= 0.0).all():
        raise InputError("margin", "is negative or NaN", "give the largest gap of a contact in metres")
    if len(shapes) < 2:
        return []
    data = _collide(shapes, np.broadcast_to(margins, len(shapes)))
    geom = np.sort(data.contact.geom, axis=1)
    sign = np.where(data.contact.geom[:, 0] == geom[:, 0], 1.0, -1.0)
    normals_world = sign[:, None] * data.contact.frame[:, :3]
    pairs, owner = np.unique(geom, axis=0, return_inverse=True)
    contacts = []
    for k, (a, b) in enumerate(pairs):
        mine = owner.ravel() == k
        points_world, dist = data.contact.pos[mine].copy(), data.contact.dist[mine]
        normal_world = frames.unit(normals_world[mine].mean(axis=0))
        contacts.append(Contact(int(a), int(b), points_world, normal_world, float(dist.min())))
    return contacts


def find_gap(a: Shape, b: Shape) -> float:
    """Distance [m] between two shapes however far apart; negative where they overlap."""
    data = _collide([a, b], np.zeros(2))
    apart = float(np.linalg.norm(a.T_world_object[:3, 3] - b.T_world_object[:3, 3]))
    return float(mujoco.mj_geomDistance(data.model, data, 0, 1, apart, np.empty(6)))


def _collide(shapes: Sequence[Shape], margins: Array) -> mujoco.MjData:
    """Run MuJoCo's collision detection once on shapes with margins (N,) [m], one free body each."""
    spec = mujoco.MjSpec()
    for shape, extra in zip(shapes, margins, strict=True):
        if shape.kind not in _GEOM_TYPES:
            raise InputError("shapes", f"no shape '{shape.kind}'", f"there are {', '.join(_GEOM_TYPES)}")
        T = shape.T_world_object
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, T[:3, :3].ravel())
        body = spec.worldbody.add_body(
            pos=T[:3, 3], quat=quaternion, mass=1.0, inertia=np.ones(3), explicitinertial=True
        )
        body.add_freejoint()
        half = shape.extents / 2.0
        size = np.array([half[0], half[2], 0.0]) if shape.kind == "cylinder" else half
        # A pair's margin is the sum of its two geoms'.
        body.add_geom(type=_GEOM_TYPES[shape.kind], size=size, margin=extra / 2.0)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    return data
