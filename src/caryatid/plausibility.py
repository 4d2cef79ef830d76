"""Physical plausibility of the whole scene: shapes do not fill one another, and nothing floats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from caryatid import frames
from caryatid.config import PlausibilityConfig
from caryatid.contacts import Contact, find_contacts
from caryatid.frames import Array
from caryatid.graph import SceneObject
from caryatid.shapes import Box, Cylinder, Sphere


@dataclass(frozen=True, eq=False, slots=True)
class _Freedom:
    """How an object may change: V independent variables, what they do to its pose and size, and by how much.

    Attributes:
        effect: Translation [m], rotation [rad] and change of the half extents [m], in the object's frame,
            of each variable (9, V).
        sigma: Standard deviation of each (V,).
    """

    effect: Array
    sigma: Array


def reconcile(objects: Sequence[SceneObject], config: PlausibilityConfig) -> list[SceneObject]:
    """Move shapes, and their unsure sides, until they neither overlap nor float: within their uncertainty.

    Each overlap is a measurement that the gap there is zero, and so is the smallest gap below an object that
    touches nothing below it. All of them together correct poses, sizes and hidden extents at once, each in
    proportion to its variance (the update of a Kalman filter). A gap beyond what the fits' uncertainty can
    explain is left as it is and said of the objects: their shapes are doubtful.

    Args:
        objects: The support surface and the objects on it; without `uncertainty` they stay as they are.
        config: How exactly shapes touch, and what uncertainty can explain.

    Returns:
        The objects in the same order, `doubt` telling what could not be explained.
    """
    done = list(objects)
    freedoms = [_freedom(o) for o in objects]
    doubts: dict[int, str] = {}
    for number in range(config.rounds):
        contacts = find_contacts([o.shape for o in done], config.reach)
        wrong = [c for c in contacts if c.distance < -config.touch] + _floating(done, contacts, config)
        if not wrong:
            break
        rows = np.stack([_row(done, freedoms, c) for c in wrong])
        variance = np.concatenate([f.sigma for f in freedoms]) ** 2
        gaps = np.array([c.distance for c in wrong])
        explained = np.abs(gaps) <= config.sigmas * np.sqrt((rows**2) @ variance + config.touch**2)
        if number == 0:
            doubts = _doubts(done, [c for c, fine in zip(wrong, explained, strict=True) if not fine])
        if not explained.any():
            break
        rows, gaps = rows[explained], gaps[explained]
        scatter = (rows * variance) @ rows.T + config.touch**2 * np.eye(len(rows))
        change = variance * (rows.T @ np.linalg.solve(scatter, gaps))
        ends = np.cumsum([len(f.sigma) for f in freedoms])
        for k, part in enumerate(np.split(change, ends[:-1])):
            if len(part):
                done[k] = replace(done[k], shape=_changed(done[k].shape, freedoms[k].effect @ part, config))
    return [replace(o, doubt=doubts.get(k, "")) for k, o in enumerate(done)]


def _freedom(o: SceneObject) -> _Freedom:
    known = o.uncertainty
    if known is None or o.role == "support_surface":
        return _Freedom(np.zeros((9, 0)), np.zeros(0))
    effect, sigma = np.zeros((9, 9)), np.empty(9)
    effect[3:6, 3:6], sigma[3:6] = np.eye(3), known.rotation
    for axis, round_ in enumerate(_ROUND[o.shape.kind]):
        if round_:
            # What is round moves as a whole, and its radius is one number.
            effect[axis, axis], sigma[axis] = 1.0, known.position[axis]
            sigma[6 + axis] = 0.0 if axis else known.sizes[0] / 2.0
        else:
            effect[[axis, 6 + axis], axis] = -0.5, 0.5
            effect[[axis, 6 + axis], 6 + axis] = 0.5, 0.5
            sigma[axis], sigma[6 + axis] = known.sides[2 * axis], known.sides[2 * axis + 1]
    if _ROUND[o.shape.kind][0]:
        effect[6:9, 6] = _ROUND[o.shape.kind]
    return _Freedom(effect, sigma)


_ROUND = {"box": (False, False, False), "cylinder": (True, True, False), "sphere": (True, True, True)}
"""Along which axes a shape's two sides are one round surface."""


def _floating(
    objects: Sequence[SceneObject], contacts: Sequence[Contact], config: PlausibilityConfig
) -> list[Contact]:
    """The nearest contact below each object that touches nothing below it, among those with a small gap."""
    nearest: dict[int, Contact] = {}
    steep = np.cos(np.radians(config.max_tilt))
    for contact in contacts:
        upper = contact.b if contact.normal_world[2] > 0.0 else contact.a
        level = abs(contact.normal_world[2]) > steep and objects[upper].role != "support_surface"
        if level and (upper not in nearest or contact.distance < nearest[upper].distance):
            nearest[upper] = contact
    return [c for c in nearest.values() if c.distance > config.touch]


def _row(objects: Sequence[SceneObject], freedoms: Sequence[_Freedom], contact: Contact) -> Array:
    """How much (all V,) each variable of each object closes the gap of a contact."""
    parts = [np.zeros(len(f.sigma)) for f in freedoms]
    point_world = contact.points_world.mean(axis=0)
    for k, outward_world in ((contact.a, contact.normal_world), (contact.b, -contact.normal_world)):
        shape = objects[k].shape
        T_object_world = frames.invert(shape.T_world_object)
        p, u = frames.transform(T_object_world, point_world), frames.rotate(T_object_world, outward_world)
        sizes = np.abs(u)
        if any(_ROUND[shape.kind]):
            round_ = np.array(_ROUND[shape.kind])
            sizes[round_] = (np.linalg.norm(u[round_]), 0.0, 0.0)[: round_.sum()]
        parts[k] = np.concatenate([u, np.cross(p, u), sizes]) @ freedoms[k].effect
    return np.concatenate(parts)


def _changed(
    shape: Box | Cylinder | Sphere, change: Array, config: PlausibilityConfig
) -> Box | Cylinder | Sphere:
    """Apply a translation, a rotation and a change of the half extents (9,) in the shape's own frame."""
    T = shape.T_world_object @ frames.rigid(frames.rotation_from_vector(change[3:6]), change[:3])
    extents = np.maximum(shape.extents + 2.0 * change[6:9], config.min_extent)
    if isinstance(shape, Sphere):
        return Sphere(T, float(extents[0]) / 2.0)
    if isinstance(shape, Cylinder):
        return Cylinder(T, float(extents[0]) / 2.0, float(extents[2]))
    return Box(T, extents)


def _doubts(objects: Sequence[SceneObject], contacts: Sequence[Contact]) -> dict[int, str]:
    """What to say of the objects of contacts that uncertainty does not explain."""
    doubts: dict[int, str] = {}
    for c in contacts:
        for k, other in ((c.a, c.b), (c.b, c.a)):
            if objects[k].role == "support_surface":
                continue
            what = "overlaps" if c.distance < 0.0 else "floats over"
            by = f"{1000.0 * abs(c.distance):.0f} mm, more than both fits explain"
            more = f"{what} {objects[other].id} by {by}"
            if c.distance < 0.0 or objects[k].centre_world[2] > objects[other].centre_world[2]:
                doubts[k] = f"{doubts[k]}; {more}" if k in doubts else more
    return doubts
