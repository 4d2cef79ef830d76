"""Bodies to draw: shapes as meshes with their outlines, arrows for supports, the robot."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
import trimesh
from numpy.typing import NDArray

from caryatid.geometry import transforms
from caryatid.geometry.shapes import Shape
from caryatid.geometry.transforms import Array
from caryatid.graph import Support, SupportGraph
from caryatid.viewer.marks import Copies, Drawing, Label, Lines, Mesh
from caryatid.viewer.moments import Standing
from caryatid.viz.colours import Colour, object_colour, rgb

ROUND = 40
"""Corners of a drawn circle."""
OPACITY, CHOSEN_OPACITY, TABLE_OPACITY = 0.36, 0.7, 0.16
"""Of shapes: one sees the points and the arrows in them."""
CERTAIN, UNCERTAIN = (26, 32, 40), (196, 78, 12)
"""Colours of supports; uncertain ones are dashed too."""
SHAFT, HEAD, HEAD_LENGTH, KIND = 0.0035, 0.0095, 0.028, 0.011
"""Radii of an arrow's shaft and head, length of its head, radius of what stands for its kind [m]."""
DASH = 0.016
"""Length of a dash, and of the gap after it [m]."""
UNDER_TABLE = 0.07
"""How far below a contact an arrow begins whose supporter is the table [m]."""
ROBOT = (120, 130, 142)
"""Colour of the robot."""


def draw_shapes(graph: SupportGraph, chosen: str = "") -> Drawing:
    """Draw the fitted shapes in their objects' colours: seen through, with outlines and names.

    Args:
        graph: What is known.
        chosen: Id of the object that stands out.
    """
    drawing: Drawing = {}
    ends, colours = [], []
    for item in graph.objects:
        surface = item.role == "support_surface"
        colour = rgb(object_colour(item.label))
        vertices, faces = _mesh(item.shape)
        opacity = TABLE_OPACITY if surface else (CHOSEN_OPACITY if item.id == chosen else OPACITY)
        T = item.shape.T_world_object
        drawing[f"shapes/{item.id}"] = Mesh(
            T, vertices, faces, colour, opacity, item.id, flat=item.shape.kind == "box"
        )
        outline = transforms.transform(T, _outline(item.shape).reshape(-1, 3)).reshape(-1, 2, 3)
        ends.append(outline)
        ink = (17, 17, 17) if item.id == chosen else tuple(int(0.55 * c) for c in colour)
        colours.append(np.tile(np.array(ink, np.uint8), (len(outline), 1)))
        if not surface:
            top = item.centre_world + np.array([0.0, 0.0, float(item.shape.support(_UP)[0])])
            drawing[f"names/{item.id}"] = Label(top, item.id)
    if ends:
        drawing["shapes/outlines"] = Lines(np.concatenate(ends), np.concatenate(colours), 1.6)
    return drawing


def draw_supports(graph: SupportGraph) -> Drawing:
    """Draw each support as an arrow from supporter to supported.

    Uncertain ones are dashed. A ball on the shaft stands for leaning, a cube for weight from above; what
    carries from below has neither.
    """
    shafts, heads, balls, cubes = [], [], [], []
    for support in graph.supports:
        start, end = _ends(support, graph)
        colour = CERTAIN if support.certain else UNCERTAIN
        along = end - start
        length = float(np.linalg.norm(along))
        if length < 1e-6:
            continue
        along = along / length
        head = min(HEAD_LENGTH, 0.5 * length)
        neck = length - head
        pieces = [(0.0, neck)] if support.certain else _dashes(neck)
        shafts += [(start + (a + b) / 2.0 * along, along, (SHAFT, SHAFT, b - a), colour) for a, b in pieces]
        heads.append((start + neck * along, along, (HEAD, HEAD, head), colour))
        middle = (start + 0.5 * neck * along, along, (KIND, KIND, KIND), colour)
        if support.kind == "lean":
            balls.append(middle)
        elif support.kind == "top-down":
            cubes.append(middle)
    parts = {"shafts": shafts, "heads": heads, "lean": balls, "top-down": cubes}
    bodies = {"shafts": "rod", "heads": "cone", "lean": "ball", "top-down": "cube"}
    return {f"supports/{name}": _copies(bodies[name], placed) for name, placed in parts.items() if placed}


def draw_robot(robot: Standing) -> Drawing:
    """Draw a robot as simple bodies: platform, column and neck, or the base of an arm and its links."""
    posture, arm, platform = robot.posture, robot.arm, robot.platform
    eye = robot.T_world_camera[:3, 3]
    x, y, yaw = posture.platform_world
    foot = np.array([x, y, max(0.0, eye[2] - posture.camera_height)])
    height = 0.1 if arm else 0.3
    radius = 0.08 if arm else platform
    bodies = [(foot + [0.0, 0.0, height / 2.0], _UP[0], (radius, radius, height), ROBOT)]
    forward = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    nose = foot + [0.0, 0.0, height] + 0.5 * radius * forward
    shoulder = foot + [0.0, 0.0, height]
    joints = [shoulder, (shoulder + eye) / 2.0 + [0.0, 0.0, 0.25], eye] if arm else []
    if not arm:
        joints = [shoulder, np.array([x, y, eye[2]]), eye]
    for a, b in pairwise(joints):
        length = float(np.linalg.norm(b - a))
        if length > 1e-3:
            bodies.append(((a + b) / 2.0, (b - a) / length, (0.05, 0.05, length), ROBOT))
    rods = _copies("rod", bodies)
    heads = _copies("cone", [(nose, forward, (0.05, 0.05, 0.12), CERTAIN)])
    return {"robot/body": rods, "robot/front": heads}


_UP = np.array([[0.0, 0.0, 1.0]])
_Placed = tuple[Array, Array, tuple[float, float, float], Colour]
"""Position, direction of the body's z axis, scales, colour."""


def _ends(support: Support, graph: SupportGraph) -> tuple[Array, Array]:
    """Where an arrow begins and ends; from the table it rises to its supported one."""
    supporter, supported = graph[support.supporter], graph[support.supported]
    start, end = supporter.centre_world, supported.centre_world
    touch = support.contact_world
    if supporter.role == "support_surface":
        start = np.array([*(end if touch is None else touch)[:2], start[2]])
        start[2] -= UNDER_TABLE
    if supported.role == "support_surface":
        end = np.array([*(start if touch is None else touch)[:2], end[2]])
    return start, end


def _dashes(length: float) -> list[tuple[float, float]]:
    count = max(2, round(length / (2.0 * DASH)))
    pitch = length / (count - 0.5)
    return [(k * pitch, k * pitch + 0.5 * pitch) for k in range(count)]


def _copies(body: str, placed: list[_Placed]) -> Copies:
    vertices, faces = _unit(body)
    return Copies(
        vertices,
        faces,
        np.array([p[0] for p in placed]),
        np.array([_turned_up(p[1]) for p in placed]),
        np.array([p[2] for p in placed]),
        np.array([p[3] for p in placed], dtype=np.uint8),
    )


def _turned_up(direction: Array) -> Array:
    """Quaternion (4,), w first, that turns z into a direction."""
    w = 1.0 + direction[2]
    if w < 1e-9:
        return np.array([0.0, 1.0, 0.0, 0.0])
    q = np.array([w, -direction[1], direction[0], 0.0])
    return q / np.linalg.norm(q)


@cache
def _unit(body: str) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """A body of radius 1 and, rods and cones, height 1 along z; a rod's origin in its middle."""
    match body:
        case "rod":
            mesh = trimesh.creation.cylinder(1.0, 1.0, sections=16)
        case "cone":
            mesh = trimesh.creation.cone(1.0, 1.0, sections=20)
        case "ball":
            mesh = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
        case _:
            mesh = trimesh.creation.box(extents=(1.7, 1.7, 1.7))
    return np.asarray(mesh.vertices, dtype=np.float32), np.asarray(mesh.faces, dtype=np.uint32)


def _mesh(shape: Shape) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    mesh = shape.mesh(ROUND)
    return np.asarray(mesh.vertices, dtype=np.float32), np.asarray(mesh.faces, dtype=np.uint32)


@cache
def _unit_outline(kind: str) -> Array:
    """Lines (N, 2, 3) along the edges of a shape of extents 1; of a ball three circles."""
    if kind == "box":
        corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
        pairs = [(a, b) for a in range(8) for b in range(a) if np.abs(corners[a] - corners[b]).sum() == 1.0]
        return np.array([[corners[a], corners[b]] for a, b in pairs])
    angle = 2.0 * np.pi * np.arange(ROUND) / ROUND
    ring = 0.5 * np.stack([np.cos(angle), np.sin(angle), np.zeros(ROUND)], axis=-1)
    circle = np.stack([ring, np.roll(ring, -1, axis=0)], axis=1)
    if kind == "cylinder":
        return np.concatenate([circle + [0.0, 0.0, 0.5], circle - [0.0, 0.0, 0.5]])
    return np.concatenate([circle, np.roll(circle, 1, axis=-1), np.roll(circle, 2, axis=-1)])


def _outline(shape: Shape) -> Array:
    return _unit_outline(shape.kind) * shape.extents
