"""Support polygons: what carries an object, and how much of it (section III-A)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from caryatid.config import SupportConfig
from caryatid.geometry import polygons
from caryatid.geometry.shapes import Box, Shape
from caryatid.geometry.solids import Solid
from caryatid.geometry.transforms import UP, Array
from caryatid.graph import Stability
from caryatid.support.contacts import Contact

_NO_AREA = 1e-12
"""Smaller contact areas are lines and points, blurred by rounding [m²]; a micrometre squared."""
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


def ground_outline(shape: Shape) -> Array:
    """P_A: the polygon (M, 2) [m] the shape's extent projects to on the ground."""
    if isinstance(shape, Solid):
        return polygons.hull(shape.outline())
    return _cap(shape, UP, np.inf)


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


def assess(shape: Shape, patches: Sequence[Array], config: SupportConfig) -> Stability:
    """The tests of an object on its support polygon: r_s of eq. 1 and, unless `area`, the centre of mass.

    Args:
        shape: The object's.
        patches: The areas (M, 2) [m] that carry it, projected to the ground; P_s is their convex hull.
        config: Limits of both tests.
    """
    polygon = polygons.hull(np.concatenate([np.empty((0, 2)), *patches]))
    overhang = float(polygons.signed_distance(polygon, *shape.centre_of_mass[:2]))
    ratio = min(1.0, polygons.area(polygon) / polygons.area(ground_outline(shape)))
    tips = config.stability == "balance" and overhang > config.overhang
    return Stability(ratio, overhang, ratio < config.min_area_ratio, tips)


def _touching_depth(shape: Shape, config: SupportConfig) -> float:
    """Depth [m] to which a shape touches, so that faces a degree apart touch all over; 0 for a ball."""
    turned = 0.0 if shape.kind == "sphere" else np.sin(np.radians(1.0)) * float(shape.extents.max()) / 2.0
    return config.patch_depth + float(turned)


def _cap(shape: Shape, direction_world: Array, depth: float) -> Array:
    """Outline on the ground (M, 2) [m] of the part within `depth` of a shape's extreme point."""
    if shape.kind == "sphere":
        return polygons.hull(_ball_cap(shape, direction_world, depth))
    if isinstance(shape, Solid):
        return polygons.cap(shape.outline(), shape.polytopes[0].edges, direction_world, depth)
    if shape.kind not in _EDGES:
        shape = Box(shape.T_world_object, shape.extents)
    return polygons.cap(shape.outline(), _EDGES[shape.kind], direction_world, depth)


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
