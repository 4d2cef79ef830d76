"""True shapes of a simulated scene: points inside, bounds, boxes of the static geoms, the table top."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Sphere
from caryatid.geometry.transforms import Array
from caryatid.simulation.world import SimulatedScene

_GEOM = mujoco.mjtGeom
_FLAT = (int(_GEOM.mjGEOM_PLANE), int(_GEOM.mjGEOM_HFIELD))


@dataclass(frozen=True, eq=False, slots=True)
class TableTop:
    """Where things stand.

    Attributes:
        height: Of the top over the world's origin [m].
        corners_world: The rectangle (4, 3) [m], anticlockwise from above.
        shape: The geom as a box.
    """

    height: float
    corners_world: Array
    shape: Box


def contains(scene: SimulatedScene, label: int, points_world: Array) -> NDArray[np.bool_]:
    """Which points lie inside an object's true solid.

    Primitives are tested as what they are, meshes as the convex hulls they collide as; an object of several
    colliding geoms is their union.

    Args:
        scene: The scene.
        label: The object, or 0 for the table.
        points_world: (N, 3) [m].

    Returns:
        (N,) bool.
    """
    inside = np.zeros(len(points_world), dtype=bool)
    for geom in solid_geoms(scene, label):
        T_geom_world = transforms.invert(_geom_pose(scene, geom))
        inside |= _inside_geom(scene.model, geom, transforms.transform(T_geom_world, points_world))
    return inside


def bounds(scene: SimulatedScene, label: int) -> tuple[Array, Array]:
    """Lowest and highest corner, (3,) each [m], of the world-aligned box around an object (0: the table)."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for geom in solid_geoms(scene, label):
        T_world_geom = _geom_pose(scene, geom)
        if scene.model.geom_type[geom] == _GEOM.mjGEOM_MESH:
            corners = transforms.transform(T_world_geom, _mesh_vertices(scene.model, geom))
            low, high = np.minimum(low, corners.min(axis=0)), np.maximum(high, corners.max(axis=0))
        else:
            reach = _reach(scene.model, geom, T_world_geom[:3, :3])
            low = np.minimum(low, T_world_geom[:3, 3] - reach)
            high = np.maximum(high, T_world_geom[:3, 3] + reach)
    return low, high


def true_shapes(scene: SimulatedScene) -> dict[int, Box | Cylinder | Sphere]:
    """Shape of every object, by label, that is a single box, cylinder or sphere; others are left out."""
    shapes: dict[int, Box | Cylinder | Sphere] = {}
    for label in scene.object_bodies:
        geoms = solid_geoms(scene, label)
        shape = _primitive(scene, geoms[0]) if len(geoms) == 1 else None
        if shape is not None:
            shapes[label] = shape
    return shapes


def static_boxes(scene: SimulatedScene) -> tuple[Box, ...]:
    """Oriented boxes around the geoms that belong to no object, the table's first; planes are no obstacle."""
    table = scene.geoms(0)
    others = [g for g in np.flatnonzero(scene.geom_labels == 0).tolist() if g not in table]
    solid = [g for g in (*table, *others) if int(scene.model.geom_type[g]) not in _FLAT]
    return tuple(_geom_box(scene, g) for g in solid)


def table_top(scene: SimulatedScene) -> TableTop:
    """The table geom with the largest area seen from above, as a level box."""
    boxes = [_level(_geom_box(scene, g)) for g in scene.geoms(0)]
    top = max(boxes, key=lambda box: box.extents[0] * box.extents[1])
    height = top.T_world_object[2, 3] + top.extents[2] / 2.0
    signs = np.array([[-1.0, -1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, 1.0], [-1.0, 1.0, 1.0]])
    corners_world = transforms.transform(top.T_world_object, signs * top.extents / 2.0)
    return TableTop(float(height), corners_world, top)


def solid_geoms(scene: SimulatedScene, label: int) -> list[int]:
    """Geoms that make up the solid of an object (0 = table): those that collide, or all if none does."""
    geoms = scene.geoms(label)
    model = scene.model
    colliding = [g for g in geoms if model.geom_contype[g] or model.geom_conaffinity[g]]
    return colliding or geoms


def _geom_pose(scene: SimulatedScene, geom: int) -> Array:
    return transforms.rigid(scene.data.geom_xmat[geom].reshape(3, 3), scene.data.geom_xpos[geom])


def _primitive(scene: SimulatedScene, geom: int) -> Box | Cylinder | Sphere | None:
    size, T_world_geom = scene.model.geom_size[geom], _geom_pose(scene, geom)
    match scene.model.geom_type[geom]:
        case _GEOM.mjGEOM_BOX:
            return Box(T_world_geom, 2.0 * size)
        case _GEOM.mjGEOM_CYLINDER:
            return Cylinder(T_world_geom, float(size[0]), 2.0 * float(size[1]))
        case _GEOM.mjGEOM_SPHERE:
            return Sphere(T_world_geom, float(size[0]))
    return None


def _geom_box(scene: SimulatedScene, geom: int) -> Box:
    """Return the box around a geom along the geom's own axes."""
    centre, half = scene.model.geom_aabb[geom, :3], scene.model.geom_aabb[geom, 3:]
    T_world_geom = _geom_pose(scene, geom)
    return Box(T_world_geom @ transforms.rigid(np.eye(3), centre), 2.0 * half)


def _level(box: Box) -> Box:
    """Turn a box's axes so that its third is up; a box askew becomes the world-aligned one around it."""
    R = box.T_world_object[:3, :3]
    upright = int(np.argmax(np.abs(R[2])))
    if abs(R[2, upright]) < np.cos(np.deg2rad(1.0)):
        half = np.abs(R) @ (box.extents / 2.0)
        return Box(transforms.rigid(np.eye(3), box.T_world_object[:3, 3]), 2.0 * half)
    first, second = (upright + 1) % 3, (upright + 2) % 3
    x = R[:, first] * (1.0, 1.0, 0.0)
    x = x / np.linalg.norm(x)
    R_level = np.stack([x, np.cross((0.0, 0.0, 1.0), x), (0.0, 0.0, 1.0)], axis=1)
    return Box(transforms.rigid(R_level, box.T_world_object[:3, 3]), box.extents[[first, second, upright]])


def _inside_geom(model: Any, geom: int, points: Array) -> NDArray[np.bool_]:
    """Test points (N, 3) in the geom's own frame."""
    size = model.geom_size[geom]
    match model.geom_type[geom]:
        case _GEOM.mjGEOM_BOX:
            return (np.abs(points) <= size).all(axis=-1)
        case _GEOM.mjGEOM_SPHERE:
            return np.linalg.norm(points, axis=-1) <= size[0]
        case _GEOM.mjGEOM_ELLIPSOID:
            return np.linalg.norm(points / size, axis=-1) <= 1.0
        case _GEOM.mjGEOM_CYLINDER:
            return (np.hypot(points[:, 0], points[:, 1]) <= size[0]) & (np.abs(points[:, 2]) <= size[1])
        case _GEOM.mjGEOM_CAPSULE:
            along = np.clip(points[:, 2], -size[1], size[1])
            return np.linalg.norm(points - along[:, None] * (0.0, 0.0, 1.0), axis=-1) <= size[0]
        case _GEOM.mjGEOM_MESH:
            faces = ConvexHull(_mesh_vertices(model, geom)).equations
            return (points @ faces[:, :3].T + faces[:, 3] <= 1e-9).all(axis=-1)
    raise _unsupported(model, geom)


def _reach(model: Any, geom: int, R_world_geom: Array) -> Array:
    """How far (3,) [m] a primitive reaches from its centre along the world's axes."""
    size, axis = model.geom_size[geom], np.abs(R_world_geom[:, 2])
    match model.geom_type[geom]:
        case _GEOM.mjGEOM_BOX:
            return np.abs(R_world_geom) @ size
        case _GEOM.mjGEOM_SPHERE:
            return np.full(3, size[0])
        case _GEOM.mjGEOM_ELLIPSOID:
            return np.linalg.norm(R_world_geom * size, axis=1)
        case _GEOM.mjGEOM_CYLINDER:
            return size[1] * axis + size[0] * np.sqrt(np.clip(1.0 - axis**2, 0.0, None))
        case _GEOM.mjGEOM_CAPSULE:
            return size[1] * axis + size[0]
    raise _unsupported(model, geom)


def _mesh_vertices(model: Any, geom: int) -> Array:
    mesh = model.geom_dataid[geom]
    first = model.mesh_vertadr[mesh]
    return model.mesh_vert[first : first + model.mesh_vertnum[mesh]].astype(np.float64)


def _unsupported(model: Any, geom: int) -> InputError:
    body = model.body(model.geom_bodyid[geom]).name
    kind = mujoco.mjtGeom(model.geom_type[geom]).name.removeprefix("mjGEOM_").lower()
    return InputError(f"body '{body}'", f"a {kind} geom is no solid shape", "use primitives or meshes")
