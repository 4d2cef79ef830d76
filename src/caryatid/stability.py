"""Support polygons: what carries an object, how much of it, and which way it tips (section III-A)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
import shapely.ops
from shapely.geometry.base import BaseGeometry

from caryatid import frames
from caryatid.config import SupportConfig
from caryatid.frames import Array
from caryatid.graph import Stability
from caryatid.shapes import Shape

_RING = 48
"""Corners of the polygon that stands for the rim of a ball's cap; 0.2 % of its radius off."""
_MARCH_POINTS = 16
"""Surface points along the longest side of a shape that is let down."""
_MARCH_STEPS = 40
"""Steps by the signed distance: enough to come within a hair wherever the way is not along a wall."""
_MARCH_HIT = 5e-4
"""A point this near to the other shape has met it [m]."""


@dataclass(frozen=True, eq=False, slots=True)
class Tipping:
    """How the centre of mass lies to the support polygon, in the ground plane.

    Attributes:
        overhang: How far the centre of mass lies outside [m], negative inside; infinite without any support.
        pivot_xy: Point (2,) [m] of the polygon's border nearest to the centre of mass: what it tips over.
        direction_xy: Unit vector (2,) the object tips towards; zero without any support.
    """

    overhang: float
    pivot_xy: Array
    direction_xy: Array


def ground_outline(shape: Shape) -> BaseGeometry:
    """P_A: the polygon [m] the shape's extent projects to on the ground."""
    return _hull(_cap(shape, np.array([0.0, 0.0, 1.0]), np.inf))


def contact_patch(
    shape: Shape, other: Shape, normal_world: Array, points_world: Array, config: SupportConfig
) -> BaseGeometry:
    """Project to the ground the area [m] over which two shapes touch.

    What of each shape lies within `patch_depth` of its extreme point along the normal counts as touching, and
    a little more on long shapes, so that faces a fit has turned against each other still touch all over.

    Args:
        shape: The shape the normal points to.
        other: The shape the normal comes from.
        normal_world: Unit normal (3,) of the separating plane, from `other` to `shape`.
        points_world: Contact points (K, 3) [m]; they stand in where those parts do not overlap.
        config: `patch_depth` and `patch_tilt`.
    """
    depth = _touching_depth(shape, config)
    cap = _hull(_cap(shape, -normal_world, depth))
    patch = cap.intersection(_hull(_cap(other, normal_world, min(depth, _touching_depth(other, config)))))
    return patch if patch.area > 0.0 else _hull(points_world)


def drop_distance(shape: Shape, other: Shape, limit: float) -> float:
    """How far [m] a shape falls straight down until it meets another one; infinite beyond `limit` [m].

    Points all over the lower side of the one and the upper side of the other march to the opposite shape by
    its signed distance.
    """
    apart = float(np.linalg.norm(shape.T_world_object[:2, 3] - other.T_world_object[:2, 3]))
    if apart > (np.linalg.norm(shape.extents) + np.linalg.norm(other.extents)) / 2.0:
        return float(np.inf)
    down, up = np.array([0.0, 0.0, -1.0]), np.array([0.0, 0.0, 1.0])
    return min(_march(shape, other, down, limit), _march(other, shape, up, limit))


def support_polygon(patches: Sequence[BaseGeometry]) -> BaseGeometry:
    """P_s: the convex hull of the contact areas."""
    return shapely.GeometryCollection(list(patches)).convex_hull


def find_tipping(shape: Shape, polygon: BaseGeometry) -> Tipping:
    """Where the centre of mass (the shape's centre) projects against the support polygon."""
    centre_xy = shape.T_world_object[:2, 3]
    if polygon.is_empty:
        return Tipping(np.inf, centre_xy, np.zeros(2))
    point = shapely.Point(centre_xy)
    border = polygon.exterior if polygon.geom_type == "Polygon" else polygon
    pivot = shapely.get_coordinates(shapely.ops.nearest_points(border, point)[0])[0]
    outward = 1.0 if polygon.distance(point) > 0.0 or polygon.geom_type != "Polygon" else -1.0
    return Tipping(outward * float(border.distance(point)), pivot, frames.unit(outward * (centre_xy - pivot)))


def assess(shape: Shape, patches: Sequence[BaseGeometry], config: SupportConfig) -> Stability:
    """Both tests of an object that rests on these contact areas: r_s of eq. 1 and the centre of mass."""
    polygon = support_polygon(patches)
    ratio = min(1.0, polygon.area / ground_outline(shape).area)
    overhang = find_tipping(shape, polygon).overhang
    return Stability(ratio, overhang, ratio < config.min_area_ratio, overhang > config.overhang)


def _hull(points_world: Array) -> BaseGeometry:
    return shapely.MultiPoint(points_world[:, :2]).convex_hull


def _touching_depth(shape: Shape, config: SupportConfig) -> float:
    if shape.kind == "sphere":
        return config.patch_depth
    turned = np.sin(np.radians(config.patch_tilt)) * float(shape.extents.max()) / 2.0
    return config.patch_depth + float(turned)


def _march(shape: Shape, target: Shape, direction_world: Array, limit: float) -> float:
    """Way [m] until the first surface point meets the target; what touches at once lies beside it."""
    spacing = float(shape.extents.max()) / _MARCH_POINTS
    corners_world = shape.outline() if shape.kind != "sphere" else np.empty((0, 3))
    points_world = np.concatenate([shape.surface(spacing)[0], corners_world])
    in_front = shape.signed_distance(points_world + 2.0 * _MARCH_HIT * direction_world) > _MARCH_HIT
    points_world = points_world[in_front & (target.signed_distance(points_world) > _MARCH_HIT)]
    travelled = np.zeros(len(points_world))
    step = np.full(len(points_world), np.inf)
    for _ in range(_MARCH_STEPS):
        step = target.signed_distance(points_world + travelled[:, None] * direction_world)
        on_its_way = (travelled + step <= limit) & (step > -_MARCH_HIT)
        points_world, step = points_world[on_its_way], step[on_its_way]
        travelled = travelled[on_its_way] + step
        if not len(step) or step.max() < _MARCH_HIT:
            break
    return float(travelled[step < _MARCH_HIT].min(initial=np.inf))


def _cap(shape: Shape, direction_world: Array, depth: float) -> Array:
    """Points (N, 3) [m] whose hull is the part of the shape within `depth` of its extreme point that way."""
    if shape.kind == "sphere":
        return _ball_cap(shape, direction_world, depth)
    corners_world = shape.outline()
    below = (corners_world @ direction_world) - (corners_world @ direction_world).max() + depth
    inside, outside = corners_world[below >= 0.0], corners_world[below < 0.0]
    if not len(outside):
        return inside
    above, under = below[below >= 0.0][:, None, None], below[below < 0.0][None, :, None]
    share = above / (above - under)
    rim = inside[:, None] + share * (outside[None] - inside[:, None])
    return np.concatenate([inside, rim.reshape(-1, 3)])


def _ball_cap(shape: Shape, direction_world: Array, depth: float) -> Array:
    radius = float(shape.extents[0]) / 2.0
    depth = min(depth, radius)
    R_world_object = shape.T_world_object[:3, :3]
    u = R_world_object @ frames.perpendicular(direction_world @ R_world_object)
    v = np.cross(direction_world, u)
    angle = 2.0 * np.pi * np.arange(_RING)[:, None] / _RING
    rim = np.sqrt(depth * (2.0 * radius - depth)) * (np.cos(angle) * u + np.sin(angle) * v)
    return shape.T_world_object[:3, 3] + (radius - depth) * direction_world + rim
