"""Contacts between shapes: MuJoCo finds them, one separating plane a pair."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import mujoco
import numpy as np
from numpy.typing import NDArray

from caryatid.errors import InputError
from caryatid.geometry import BOX, CYLINDER, SPHERE, transforms
from caryatid.geometry.shapes import Primitives, Shape
from caryatid.geometry.transforms import Array

_GEOM_TYPES = np.zeros(3, dtype=np.int32)
"""MuJoCo's number of each kind of shape, by its code."""
_GEOM_TYPES[[SPHERE, CYLINDER, BOX]] = [
    mujoco.mjtGeom.mjGEOM_SPHERE,
    mujoco.mjtGeom.mjGEOM_CYLINDER,
    mujoco.mjtGeom.mjGEOM_BOX,
]
_LEAST_CAPACITY = 16
"""Shapes that the smallest engine has room for; larger ones for twice as many each."""


@dataclass(frozen=True, eq=False, slots=True)
class Contact:
    """Two shapes that touch, nearly touch or overlap.

    Attributes:
        a: Index of the first shape.
        b: Index of the second shape; a < b.
        points_world: Contact points (K, 3) [m], midway between the two surfaces.
        point_world: Their centre (3,) [m].
        normal_world: Unit normal (3,) of the separating plane, from a to b.
        distance: Smallest gap [m]; negative where the shapes overlap.
    """

    a: int
    b: int
    points_world: Array
    point_world: Array
    normal_world: Array
    distance: float


def find_contacts(shapes: Sequence[Shape], margin: float | Sequence[float]) -> list[Contact]:
    """Find every pair of shapes whose gap is at most the margin.

    Args:
        shapes: In the world frame.
        margin: Largest gap [m]; one for each shape counts by the mean of the pair.

    Returns:
        One contact a pair, sorted by (a, b).

    Raises:
        InputError: A margin is negative, or there is not one for each shape.
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
    order = np.sort(data.contact.geom, axis=1)
    if not len(order):
        return []
    rows = np.lexsort((order[:, 1], order[:, 0]))
    order = order[rows]
    starts = np.flatnonzero(np.append(True, (order[1:] != order[:-1]).any(axis=1)))
    flipped = data.contact.geom[rows, 0] != order[:, 0]
    normals_world = np.where(flipped, -1.0, 1.0)[:, None] * data.contact.frame[rows, :3]
    counts = np.diff(starts, append=len(rows))
    means_world = transforms.unit(np.add.reduceat(normals_world, starts) / counts[:, None])
    points_world = data.contact.pos[rows]
    middles_world = np.add.reduceat(points_world, starts) / counts[:, None]
    gaps = np.minimum.reduceat(data.contact.dist[rows], starts).tolist()
    pairs, parts = order[starts].tolist(), np.split(points_world, starts[1:])
    return [
        Contact(a, b, points, middle_world, normal_world, gap)
        for (a, b), points, middle_world, normal_world, gap in zip(
            pairs, parts, middles_world, means_world, gaps, strict=True
        )
    ]


def local_frames(
    shapes: Primitives, pairs: NDArray[np.intp], points_world: Array, normals_world: Array
) -> tuple[Array, Array]:
    """Contacts in the frames of both shapes they are between.

    Args:
        shapes: N shapes.
        pairs: Indices (K, 2) of the two shapes of each contact.
        points_world: Centre of each contact (K, 3) [m].
        normals_world: Normal (K, 3) of each, from the first shape to the second.

    Returns:
        Centres (K, 2, 3) [m], and the directions (K, 2, 3) out of either shape.
    """
    R = shapes.R[pairs]
    points = np.einsum("kpij,kpi->kpj", R, points_world[:, None] - shapes.centres[pairs])
    outward_world = np.stack([normals_world, -normals_world], axis=1)
    return points, np.einsum("kpij,kpi->kpj", R, outward_world)


def find_gap(a: Shape, b: Shape) -> float:
    """Distance [m] between two shapes however far apart; negative where they overlap.

    Args:
        a: The one.
        b: The other.
    """
    data = _collide([a, b], np.zeros(2))
    apart = float(np.linalg.norm(a.T_world_object[:3, 3] - b.T_world_object[:3, 3]))
    return float(mujoco.mj_geomDistance(data.model, data, 0, 1, apart, np.empty(6)))


class _Engine:
    """A MuJoCo model of free bodies with one geom each, whose shapes and poses are set before each use.

    Args:
        capacity: How many bodies it has.

    Attributes:
        model: The compiled model.
        data: Its state; contacts are read off it.
    """

    def __init__(self, capacity: int) -> None:
        spec = mujoco.MjSpec()
        for _ in range(capacity):
            body = spec.worldbody.add_body(mass=1.0, inertia=np.ones(3), explicitinertial=True)
            body.add_freejoint()
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=np.ones(3))
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)

    def collide(self, shapes: Primitives, margins: Array) -> mujoco.MjData:
        """Find all contacts of shapes with margins (N,) [m]; N is at most the capacity."""
        model, data, count = self.model, self.data, len(shapes.kinds)
        size = shapes.half.copy()
        size[shapes.kinds == CYLINDER, 1] = shapes.half[shapes.kinds == CYLINDER, 2]
        model.geom_type[:count], model.geom_size[:count] = _GEOM_TYPES[shapes.kinds], size
        model.geom_rbound[:count] = np.linalg.norm(shapes.half, axis=1)
        model.geom_aabb[:count, 3:] = shapes.half
        # A pair's margin is the sum of its two geoms'.
        model.geom_margin[:count] = model.body_margin[1 : count + 1] = margins / 2.0
        taken = np.arange(model.ngeom) < count
        model.geom_contype[:], model.geom_conaffinity[:] = taken, taken
        model.body_contype[1:], model.body_conaffinity[1:] = taken, taken
        poses = data.qpos[: 7 * count].reshape(count, 7)
        poses[:, :3] = shapes.centres
        for pose, R in zip(poses, shapes.R.reshape(count, 9), strict=True):
            mujoco.mju_mat2Quat(pose[3:], R)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        return data


def _collide(shapes: Sequence[Shape], margins: Array) -> mujoco.MjData:
    """Run MuJoCo's collision detection on shapes with margins (N,) [m].

    The result holds until the next call in the same thread.
    """
    capacity = max(_LEAST_CAPACITY, 1 << (len(shapes) - 1).bit_length())
    return _engine(capacity, threading.get_ident()).collide(Primitives.of(shapes), margins)


@lru_cache(maxsize=8)
def _engine(capacity: int, thread: int) -> _Engine:
    """Engine of this size that belongs to one thread: two must not write into the same."""
    return _Engine(capacity)
