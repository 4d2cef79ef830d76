"""Support polygons: what carries an object, how much of it, and which way it tips (section III-A)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from caryatid.config import SupportConfig
from caryatid.geometry import polygons
from caryatid.geometry.shapes import Box, Primitives, Shape
from caryatid.geometry.solids import Solid
from caryatid.geometry.transforms import Array
from caryatid.graph import Stability
from caryatid.support.contacts import Contact

_UP = np.array([0.0, 0.0, 1.0])
_NO_AREA = 1e-12
"""Smaller contact areas are lines and points, blurred by rounding [m²]; a micrometre squared."""
_HIT = 5e-4
"""A point this near to the other shape has met it [m]."""
_STEEP = 0.1
"""Cosine to the vertical of a normal below which a contact is nearly a line from above: 84°."""
_CORNERS = 8
"""Maximum number of corners of a contact area [1]; a disc keeps nine tenths of its area."""
_EDGES = {
    "box": np.array([(i, i + bit) for i in range(8) for bit in (1, 2, 4) if not i & bit]),
    "cylinder": np.concatenate(
        [[(i, i + 24), (i, (i + 1) % 24), (i + 24, (i + 1) % 24 + 24)] for i in range(24)]
    ),
}
"""Edges (E, 2) between the points of the outline of a box, and of the prism that stands for a cylinder."""


@dataclass(frozen=True, eq=False, slots=True)
class Tipping:
    """Position of the centre of mass relative to the support polygon, in the ground plane.

    Attributes:
        polygon: P_s (M, 2) [m]: the convex hull of the contact areas.
        overhang: Distance of the centre of mass outside [m], negative inside; infinite without any support.
        pivot_xy: Point (2,) [m] of the polygon's border nearest to the centre of mass: what it tips over.
        direction_xy: Unit vector (2,) the object tips towards; zero without any support.
    """

    polygon: Array
    overhang: float
    pivot_xy: Array
    direction_xy: Array


def ground_outline(shape: Shape) -> Array:
    """P_A: the polygon (M, 2) [m] the shape's extent projects to on the ground."""
    if isinstance(shape, Solid):
        return polygons.hull(_outline(shape))
    return _cap(shape, _UP, np.inf)


def contact_patch(
    shape: Shape, other: Shape, normal_world: Array, points_world: Array, config: SupportConfig
) -> Array:
    """Project to the ground the area over which two shapes touch: a polygon (M, 2) [m].

    The part of each shape within `patch_depth` of its extreme point along the normal counts as touching, and
    a little more on long shapes, so that faces turned slightly by a fit still touch all over.

    Args:
        shape: The shape the normal points to.
        other: The shape the normal comes from.
        normal_world: Unit normal (3,) of the separating plane, from `other` to `shape`.
        points_world: Contact points (K, 3) [m]; used if those parts do not overlap.
        config: `patch_depth`.
    """
    depth = _touching_depth(shape, config)
    lower = _cap(other, normal_world, min(depth, _touching_depth(other, config)))
    patch = polygons.intersection(_cap(shape, -normal_world, depth), lower)
    return patch if polygons.area(patch) > _NO_AREA else polygons.hull(points_world)


def contact_area(contact: Contact, config: SupportConfig) -> Array:
    """Corners (K, 3) [m] of the area over which the shapes of a contact touch, in its separating plane.

    Args:
        contact: The contact; a steep one, whose area has no outline from above, gives its own points.
        config: `patch_depth`.
    """
    x, y, z = contact.normal_world
    if abs(z) < _STEEP:
        return contact.points_world
    patch = contact_patch(*contact.parts[::-1], contact.normal_world, contact.points_world, config)
    patch = patch[:: -(-len(patch) // _CORNERS)]
    height = contact.point_world[2] - (patch - contact.point_world[:2]) @ (x, y) / z
    return np.column_stack([patch, height])


def drop_distance(shape: Shape, other: Shape, limit: float) -> float:
    """How far [m] a shape falls straight down until it meets another one; infinite beyond `limit` [m].

    Points all over the lower side of the one and the upper side of the other march to the opposite shape by
    its signed distance.
    """
    return min(_march(shape, other, -_UP, limit), _march(other, shape, _UP, limit))


def beneath(shapes: Primitives, index: int, limit: float) -> list[int]:
    """Indices of the shapes that one could meet, by their boxes, when it falls down by a limit [m]."""
    low, high = shapes.bounds()
    near = 2.0 * _HIT
    below = (low[index, 2] - limit <= high[:, 2] + near) & (high[index, 2] >= low[:, 2] - near)
    apart = np.maximum(low[:, :2] - high[index, :2], low[index, :2] - high[:, :2]).max(axis=1)
    return [int(k) for k in np.flatnonzero(below & (apart <= near)) if k != index]


def find_tipping(shape: Shape, patches: Sequence[Array]) -> Tipping:
    """The centre of mass relative to the contact areas, each (M, 2) [m]."""
    polygon = polygons.hull(np.concatenate([np.empty((0, 2)), *patches]))
    centre_xy = shape.centre_of_mass[:2]
    if not len(polygon):
        return Tipping(polygon, np.inf, centre_xy, np.zeros(2))
    distance, x, y, inside = polygons.nearest_on_border(polygon, centre_xy[0], centre_xy[1])
    overhang, pivot_xy = -distance if inside else distance, np.array([x, y])
    direction_xy = (centre_xy - pivot_xy) / overhang if overhang else np.zeros(2)
    return Tipping(polygon, overhang, pivot_xy, direction_xy)


def assess(shape: Shape, tipping: Tipping, config: SupportConfig) -> Stability:
    """The tests of an object on its support polygon: r_s of eq. 1 and, unless `area`, the centre of mass."""
    ratio = min(1.0, polygons.area(tipping.polygon) / polygons.area(ground_outline(shape)))
    overhang = tipping.overhang
    tips = config.stability == "balance" and overhang > config.overhang
    return Stability(ratio, overhang, ratio < config.min_area_ratio, tips)


def centroid(polygon: Array) -> Array:
    """Centre (2,) [m] of a polygon (M, 2), or of the border of one without area."""
    x, y = polygon.T - polygon[:1].T
    cross = x * np.roll(y, -1) - np.roll(x, -1) * y
    after = np.roll(polygon, -1, axis=0)
    if cross.sum() > 2.0 * _NO_AREA:
        return polygon[0] + cross @ (polygon + after - 2.0 * polygon[0]) / (3.0 * cross.sum())
    length = np.linalg.norm(after - polygon, axis=1)
    return length @ (polygon + after) / (2.0 * length.sum()) if length.sum() > 0.0 else polygon[0]


def _touching_depth(shape: Shape, config: SupportConfig) -> float:
    """Depth [m] to which a shape touches, so that faces a degree apart touch all over; 0 for a ball."""
    turned = 0.0 if shape.kind == "sphere" else np.sin(np.radians(1.0)) * float(shape.extents.max()) / 2.0
    return config.patch_depth + float(turned)


def _march(shape: Shape, target: Shape, direction_world: Array, limit: float) -> float:
    """Distance [m] until the first surface point meets the target; points touching at once lie beside."""
    spacing = float(shape.extents.max()) / 16.0
    corners_world = shape.outline() if shape.kind != "sphere" else np.empty((0, 3))
    points_world = np.concatenate([shape.surface(spacing)[0], corners_world])
    in_front = shape.signed_distance(points_world + 2.0 * _HIT * direction_world) > _HIT
    points_world = points_world[in_front & (target.signed_distance(points_world) > _HIT)]
    travelled = np.zeros(len(points_world))
    step = np.full(len(points_world), np.inf)
    for _ in range(40):  # Enough to come very close unless the path runs along a wall.
        step = target.signed_distance(points_world + travelled[:, None] * direction_world)
        on_its_way = (travelled + step <= limit) & (step > -_HIT)
        points_world, step = points_world[on_its_way], step[on_its_way]
        travelled = travelled[on_its_way] + step
        if not len(step) or step.max() < _HIT:
            break
    return float(travelled[step < _HIT].min(initial=np.inf))


def _cap(shape: Shape, direction_world: Array, depth: float) -> Array:
    """Outline on the ground (M, 2) [m] of the part within `depth` of a shape's extreme point."""
    if shape.kind == "sphere":
        return polygons.hull(_ball_cap(shape, direction_world, depth))
    if isinstance(shape, Solid):
        return polygons.cap(_outline(shape), shape.polytopes[0].edges, direction_world, depth)
    if shape.kind not in _EDGES:
        shape = Box(shape.T_world_object, shape.extents)
    return polygons.cap(_outline(shape), _EDGES[shape.kind], direction_world, depth)


@lru_cache(maxsize=128)
def _outline(shape: Shape) -> Array:
    """The shape's outline (N, 3) [m], found once for all its contacts."""
    return shape.outline()


def _ball_cap(ball: Shape, direction_world: Array, depth: float) -> Array:
    """Rim (48, 2) [m] of a ball's cap, or of its middle if the cap is deeper, projected to the ground."""
    radius = float(ball.extents[0]) / 2.0
    depth = min(depth, radius)
    x, y, z = direction_world.tolist()
    R_world_object = ball.T_world_object[:3, :3]
    turned = direction_world @ R_world_object
    least = int(np.argmin(np.abs(turned)))
    across = np.zeros(3)
    across[(least + 1) % 3], across[(least + 2) % 3] = turned[(least + 2) % 3], -turned[(least + 1) % 3]
    u = R_world_object @ across / math.sqrt(across @ across)
    v_xy = np.array([y * u[2] - z * u[1], z * u[0] - x * u[2]])
    wide = math.sqrt(depth * (2.0 * radius - depth))
    middle_xy = ball.T_world_object[:2, 3] + (radius - depth) * direction_world[:2]
    angle = 2.0 * np.pi * np.arange(48) / 48
    return middle_xy + wide * (np.stack([np.cos(angle), np.sin(angle)], axis=-1) @ np.stack([u[:2], v_xy]))
