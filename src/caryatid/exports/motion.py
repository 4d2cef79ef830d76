"""Worlds for motion planners: MoveIt's planning scene and cuRobo's world."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from scipy.spatial.transform import Rotation

from caryatid.geometry.shapes import Cylinder, Shape, Sphere
from caryatid.geometry.solids import Solid
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject, SupportGraph
from caryatid.io.json_files import json_text
from caryatid.viz.colours import rgba

BOX, SPHERE, CYLINDER = 1, 2, 3
"""Types of shape_msgs/SolidPrimitive."""
ADD, REMOVE = 0, 1
"""Operations of moveit_msgs/CollisionObject: add an object, or replace the one of the same id; remove it."""


def planning_scene(
    graph: SupportGraph, frame: str = "world", allowed: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Make a diff of MoveIt's planning scene: each object and surface and, if wanted, which pairs may touch.

    Objects may touch what supports them, so that one in the gripper can be lifted off. MoveIt replaces its
    whole matrix of allowed collisions by that of a diff, so that without the present one, no matrix is given:
    the links of the robot would lose theirs.

    Args:
        graph: The scene model.
        frame: Name of its frame in tf.
        allowed: The present moveit_msgs/AllowedCollisionMatrix to extend; None = leave it as it is.

    Returns:
        A moveit_msgs/PlanningScene; what is not named has its default. `operation`, a byte, is a number.
    """
    return {
        "is_diff": True,
        "robot_state": {"is_diff": True},  # else MoveIt drops what the robot holds
        "world": {"collision_objects": [collision_object(item, frame) for item in graph.objects]},
    } | ({} if allowed is None else {"allowed_collision_matrix": _extended(allowed, graph)})


def collision_object(item: SceneObject, frame: str) -> dict[str, Any]:
    """A moveit_msgs/CollisionObject that adds an object."""
    return {
        "header": {"frame_id": frame},
        "id": item.id,
        "pose": _pose_message(item.shape.T_world_object),
        **_geometry(item.shape),
        "operation": ADD,
    }


def _extended(allowed: Mapping[str, Any], graph: SupportGraph) -> dict[str, Any]:
    """The matrix of allowed collisions in which the graph's objects may touch what supports them."""
    known = {name: k for k, name in enumerate(allowed.get("entry_names", ()))}
    names = [*known, *(o.id for o in graph.objects if o.id not in known)]
    own, touching = set(graph), {frozenset(s.pair) for s in graph.supports}

    def is_allowed(a: str, b: str) -> bool:
        if a in own and b in own:
            return frozenset((a, b)) in touching
        return a in known and b in known and bool(allowed["entry_values"][known[a]]["enabled"][known[b]])

    rows = [{"enabled": [is_allowed(a, b) for b in names]} for a in names]
    return dict(allowed) | {"entry_names": names, "entry_values": rows}


def _geometry(shape: Shape) -> dict[str, Any]:
    """Primitives or meshes of a CollisionObject, in the shape's frame."""
    here = {"position": _xyz(0.0, 0.0, 0.0), "orientation": _xyz(0.0, 0.0, 0.0) | {"w": 1.0}}
    match shape:
        case Solid():
            meshes = [
                {
                    "triangles": [{"vertex_indices": corners} for corners in part.triangles.tolist()],
                    "vertices": [_xyz(*vertex) for vertex in part.vertices.tolist()],
                }
                for part in shape.polytopes
            ]
            return {"meshes": meshes, "mesh_poses": [here] * len(meshes)}
        case Cylinder():
            primitive = {"type": CYLINDER, "dimensions": [shape.height, shape.radius]}
        case Sphere():
            primitive = {"type": SPHERE, "dimensions": [shape.radius]}
        case _:
            primitive = {"type": BOX, "dimensions": shape.extents.tolist()}
    return {"primitives": [primitive], "primitive_poses": [here]}


def _pose_message(T: Array) -> dict[str, Any]:
    """A geometry_msgs/Pose."""
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True).tolist()
    return {"position": _xyz(*T[:3, 3].tolist()), "orientation": _xyz(x, y, z) | {"w": w}}


def _xyz(x: float, y: float, z: float) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


def to_curobo(graph: SupportGraph) -> str:
    """A world file of cuRobo: cuboids, cylinders, spheres, and a mesh for each convex part of a solid."""
    world: dict[str, dict[str, Any]] = {}
    for item in graph.objects:
        shape, turn = item.shape, Rotation.from_matrix(item.shape.T_world_object[:3, :3])
        known: dict[str, Any] = {"color": rgba(item.label)}
        known["pose"] = [*item.centre_world, *turn.as_quat(canonical=True, scalar_first=True)]
        match shape:
            case Solid(polytopes=parts):
                # One mesh of all parts would have faces inside, where cuRobo takes inside for outside.
                for number, part in enumerate(parts, start=1):
                    mesh = {"vertices": part.vertices, "faces": part.triangles}
                    world.setdefault("mesh", {})[f"{item.id}_part_{number}"] = known | mesh
            case Cylinder(radius=radius, height=height):
                world.setdefault("cylinder", {})[item.id] = known | {"radius": radius, "height": height}
            case Sphere(radius=radius):
                world.setdefault("sphere", {})[item.id] = known | {"radius": radius}
            case _:
                world.setdefault("cuboid", {})[item.id] = known | {"dims": shape.extents}
    # JSON is YAML, but for PyYAML, a number with an exponent and no decimal point is text.
    return re.sub(r'^(\s*(?:"\w+": )?-?\d+)e', r"\1.0e", json_text(world), flags=re.MULTILINE)
