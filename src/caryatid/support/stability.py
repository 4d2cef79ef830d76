"""Support polygons: what carries an object, and how much of it (section III-A)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from caryatid.config import SupportConfig
from caryatid.geometry import polygons
from caryatid.geometry.shapes import Shape
from caryatid.geometry.transforms import Array
from caryatid.graph import Stability
from caryatid.support.contacts import Contact

_NO_AREA = 1e-12
"""Smaller contact areas are lines and points, blurred by rounding [m²]; a micrometre squared."""
_STEEP = 0.1
"""Cosine to the vertical of a normal below which a contact is nearly a line from above: 84°."""
_CORNERS = 8
"""Maximum number of corners of a contact area [1]; a disc keeps nine tenths of its area."""


def contact_patch(contact: Contact, config: SupportConfig) -> Array:
    """Outline (M, 2) [m], on the ground, of the area over which the shapes of a contact touch.

    The part of each shape within `patch_depth` of its extreme point along the normal counts as touching, and
    a little more on long shapes, so that faces turned slightly by a fit still touch all over. If those parts
    do not overlap, the contact points span the area.
    """
    lower, upper = contact.parts
    depth = _touching_depth(upper, config)
    bottom = lower.cap(contact.normal_world, min(depth, _touching_depth(lower, config)))
    patch = polygons.intersection(upper.cap(-contact.normal_world, depth), bottom)
    return patch if polygons.area(patch) > _NO_AREA else polygons.hull(contact.points_world)


def contact_area(contact: Contact, config: SupportConfig) -> Array:
    """Corners (K, 3) [m] of that area in the separating plane; a steep contact gives its own points."""
    x, y, z = contact.normal_world
    if abs(z) < _STEEP:
        return contact.points_world
    patch = contact_patch(contact, config)
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
    ratio = min(1.0, polygons.area(polygon) / polygons.area(shape.footprint()))
    tips = config.stability == "balance" and overhang > config.overhang
    return Stability(ratio, overhang, ratio < config.min_area_ratio, tips)


def _touching_depth(shape: Shape, config: SupportConfig) -> float:
    """Depth [m] to which a shape touches, so that faces a degree apart touch all over; 0 for a ball."""
    turned = 0.0 if shape.kind == "sphere" else np.sin(np.radians(1.0)) * float(shape.extents.max()) / 2.0
    return config.patch_depth + float(turned)
