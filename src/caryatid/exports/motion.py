"""A scene model for motion planners: MoveIt's planning scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from caryatid.geometry import transforms
from caryatid.geometry.shapes import Cylinder, Primitives, Shape, Sphere
from caryatid.geometry.solids import Solid
from caryatid.graph import SceneObject, SupportGraph
from caryatid.sensing.voxel_map import UNKNOWN, VoxelMap

BOX, SPHERE, CYLINDER = 1, 2, 3
"""Types of shape_msgs/SolidPrimitive."""
ADD, REMOVE = 0, 1
"""Operations of moveit_msgs/CollisionObject: add an object, or replace the one of the same id; remove it."""
CELL = 3
"""Edge of a cell of unseen space [voxels]: rays leave out single voxels, and no finger is thinner."""
UNSEEN = "unseen"
"""Id of the CollisionObject of unseen space."""
HERE = {
    "position": dict.fromkeys("xyz", 0.0),
    "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
}
"""A geometry_msgs/Pose that changes nothing."""


def planning_scene(
    graph: SupportGraph,
    frame: str = "world",
    allowed: Mapping[str, Any] | None = None,
    voxels: VoxelMap | None = None,
) -> dict[str, Any]:
    """Make a diff of MoveIt's planning scene: each object and surface and, if wanted, which pairs may touch.

    Objects may touch what supports them, and unseen space, so that one in the gripper can be lifted off.
    MoveIt replaces its whole matrix of allowed collisions by that of a diff, so that without the present one,
    no matrix is given: the links of the robot would lose theirs.

    Args:
        graph: The scene model.
        frame: Name of its frame in tf.
        allowed: The present moveit_msgs/AllowedCollisionMatrix to extend; None = leave it as it is.
        voxels: The map, to add the unseen space among the objects as one more object; None = leave it out.

    Returns:
        A moveit_msgs/PlanningScene; what is not named has its default. `operation`, a byte, is a number.
    """
    items = [collision_object(item, frame) for item in graph.objects]
    items += [] if voxels is None else _unseen_space(graph, voxels, frame)
    return {
        "is_diff": True,
        "robot_state": {"is_diff": True},  # else MoveIt drops what the robot holds
        "world": {"collision_objects": items},
    } | ({} if allowed is None else {"allowed_collision_matrix": _extended(allowed, graph, items)})


def collision_object(item: SceneObject, frame: str) -> dict[str, Any]:
    """A moveit_msgs/CollisionObject that adds an object."""
    T = item.shape.T_world_object
    *xyz, w = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True).tolist()
    return {
        "header": {"frame_id": frame},
        "id": item.id,
        "pose": {"position": _xyz(*T[:3, 3].tolist()), "orientation": _xyz(*xyz) | {"w": w}},
        **_geometry(item.shape),
        "operation": ADD,
    }


def _unseen_space(graph: SupportGraph, voxels: VoxelMap, frame: str) -> list[dict[str, Any]]:
    """A CollisionObject of what no view showed above surfaces, outside of objects and up to the highest."""
    bodies = [o.shape for o in graph.movable]
    if not bodies:
        return []
    surfaces = [o.shape for o in graph.support_surfaces]
    low, high = Primitives.of(surfaces).bounds()
    top = Primitives.of(bodies).bounds()[1][:, 2].max()
    space = voxels.cut(low.min(axis=0), np.array([*high[:, :2].max(axis=0), top]))
    index = np.argwhere(space.states == UNKNOWN)
    points, kept = space.centres_world(index), np.zeros(len(index), dtype=np.bool_)
    for shape in surfaces:
        local = transforms.transform(transforms.invert(shape.T_world_object), points)
        half = shape.extents / 2.0
        over = (np.abs(local[:, :2]) < half[:2]).all(axis=1)
        kept |= over & (local[:, 2] > half[2] + voxels.config.size)
    for shape in bodies:
        kept[kept] = shape.signed_distance(points[kept]) > voxels.config.size
    cells = -(-np.array(space.states.shape) // CELL)
    number = np.ravel_multi_index(tuple(index[kept].T // CELL), tuple(cells))
    full = 2 * np.bincount(number, minlength=cells.prod()) >= CELL**3
    corners = _merge_cells(full.reshape(cells))
    lows, highs = (space.origin_world + CELL * voxels.config.size * corner for corner in corners)
    return [
        {
            "header": {"frame_id": frame},
            "id": UNSEEN,
            "pose": HERE,
            "primitives": [{"type": BOX, "dimensions": size.tolist()} for size in highs - lows],
            "primitive_poses": [HERE | {"position": _xyz(*c)} for c in ((lows + highs) / 2.0).tolist()],
            "operation": ADD,
        }
    ]


def _merge_cells(which: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Lowest and highest corners (B, 3) [cells] of boxes that fill some of the cells (X, Y, Z) of a grid."""
    ends = np.diff(np.pad(which.astype(np.int8), ((0, 0), (0, 0), (1, 1))), axis=2)
    low, high = np.argwhere(ends > 0), np.argwhere(ends < 0) + (1, 1, 0)
    for axis in (1, 0):  # Boxes become one if they share a face.
        others = np.hstack([np.delete(low, axis, axis=1), np.delete(high, axis, axis=1)])
        order = np.lexsort((low[:, axis], *others.T))
        low, high, others = low[order], high[order], others[order]
        meets = (others[1:] == others[:-1]).all(axis=1) & (low[1:, axis] == high[:-1, axis])
        low, high = low[np.append(True, ~meets)[: len(low)]], high[np.append(~meets, True)[: len(high)]]
    return low, high


def _extended(
    allowed: Mapping[str, Any], graph: SupportGraph, items: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """The matrix of allowed collisions in which objects may touch what supports them, and unseen space."""
    known = {name: k for k, name in enumerate(allowed.get("entry_names", ()))}
    own = dict.fromkeys(item["id"] for item in items)
    names = [*known, *(name for name in own if name not in known)]
    touching = {frozenset(s.pair) for s in graph.supports} | {frozenset((name, UNSEEN)) for name in graph}

    def is_allowed(a: str, b: str) -> bool:
        if a in own and b in own:
            return frozenset((a, b)) in touching
        return a in known and b in known and bool(allowed["entry_values"][known[a]]["enabled"][known[b]])

    rows = [{"enabled": [is_allowed(a, b) for b in names]} for a in names]
    return dict(allowed) | {"entry_names": names, "entry_values": rows}


def _geometry(shape: Shape) -> dict[str, Any]:
    """Primitives or meshes of a CollisionObject, in the shape's frame."""
    match shape:
        case Solid():
            meshes = [
                {
                    "triangles": [{"vertex_indices": corners} for corners in part.triangles.tolist()],
                    "vertices": [_xyz(*vertex) for vertex in part.vertices.tolist()],
                }
                for part in shape.polytopes
            ]
            return {"meshes": meshes, "mesh_poses": [HERE] * len(meshes)}
        case Cylinder():
            primitive = {"type": CYLINDER, "dimensions": [shape.height, shape.radius]}
        case Sphere():
            primitive = {"type": SPHERE, "dimensions": [shape.radius]}
        case _:
            primitive = {"type": BOX, "dimensions": shape.extents.tolist()}
    return {"primitives": [primitive], "primitive_poses": [HERE]}


def _xyz(x: float, y: float, z: float) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}
