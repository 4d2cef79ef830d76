"""Physical plausibility of the whole scene: shapes do not overlap, and nothing floats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from caryatid.config import PlausibilityConfig
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Primitives, Shape
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject
from caryatid.support.contacts import Contact, find_contacts


def reconcile(objects: Sequence[SceneObject], config: PlausibilityConfig) -> list[SceneObject]:
    """Move shapes, and their unsure sides, until they neither overlap nor float: within their uncertainty.

    Each overlap is a measurement that the gap there is zero, and so is the smallest gap, up to 1 cm, below
    an object that touches nothing below it. All of them together correct poses, sizes and hidden extents at
    once, each in proportion to its variance (the update of a Kalman filter). A gap that the fits'
    uncertainty cannot explain stays as it is, and becomes a doubt of the objects.

    Args:
        objects: The support surface and the objects on it; without `uncertainty` they do not change.
        config: How exactly shapes touch, and limits of the uncertainty.

    Returns:
        The objects in the same order; `doubt` says what could not be explained.
    """
    done = list(objects)
    sigma = np.array([deviations(o) for o in objects]).reshape(-1, 9)
    variance = sigma**2
    doubts: dict[int, str] = {}
    for number in range(config.rounds):
        contacts = find_contacts([o.shape for o in done], 0.01)
        wrong = [c for c in contacts if c.distance < -config.touch] + _floating(done, contacts, config)
        if not wrong:
            break
        pairs = np.array([(c.a, c.b) for c in wrong], dtype=np.intp)
        gaps = np.array([c.distance for c in wrong])
        rows = gap_rows(done, wrong, pairs)
        scatter = np.einsum("kpv,kpv->k", rows**2, variance[pairs]) + config.touch**2
        explained = np.abs(gaps) <= config.sigmas * np.sqrt(scatter)
        if number == 0:
            doubts = _doubts(done, [c for c, fine in zip(wrong, explained, strict=True) if not fine])
        if not explained.any():
            break
        change = closing(pairs[explained], rows[explained], variance, gaps[explained], config.touch**2)
        for k in np.flatnonzero(change.any(axis=1)):
            shape = done[k].shape
            done[k] = replace(done[k], shape=_changed(shape, change[k]))
    said = [(o, doubts.get(k, "")) for k, o in enumerate(done)]
    return [o if o.doubt == doubt else replace(o, doubt=doubt) for o, doubt in said]


def drawn(o: SceneObject, rng: np.random.Generator, config: PlausibilityConfig) -> SceneObject:
    """Return an object with a shape drawn from its uncertainty: moved, turned and resized.

    Args:
        o: An object; without `uncertainty` it does not change.
        rng: Source of the draw.
        config: Maximum number of standard deviations.
    """
    draw = np.clip(rng.standard_normal(9), -config.sigmas, config.sigmas)
    return replace(o, shape=_changed(o.shape, draw * deviations(o)))


@cache
def effect(ties: tuple[int, int, int]) -> Array:
    """Effect of a shape's independent variables (9,) on translation, rotation and half extents (9, 9)."""
    matrix = np.zeros((9, 9))
    matrix[3:6, 3:6] = np.eye(3)
    for axis, round_ in enumerate(_round(ties)):
        if round_:
            # A round shape moves as a whole, and its radius is one number.
            matrix[axis, axis] = 1.0
        else:
            matrix[[axis, 6 + axis], axis] = -0.5, 0.5
            matrix[[axis, 6 + axis], 6 + axis] = 0.5, 0.5
    if _round(ties)[0]:
        matrix[6:9, 6] = _round(ties)
    return matrix


def _round(ties: tuple[int, int, int]) -> list[bool]:
    """Along which axes (3,) a shape's two sides are one round surface."""
    return [ties.count(tie) > 1 for tie in ties]


def deviations(o: SceneObject) -> Array:
    """Standard deviation of each of an object's independent variables (9,); zero where it cannot change.

    The support surface, and objects without `uncertainty`, cannot change.
    """
    sigma = np.zeros(9)
    if (known := o.uncertainty) is None or o.role == "support_surface":
        return sigma
    sigma[0:3], sigma[3:6], sigma[6:9] = known.sides[0::2], known.rotation, known.sides[1::2]
    round_ = sum(_round(o.shape.ties))
    if round_:
        sigma[:round_] = known.position[:round_]
        sigma[6] = known.sizes[0] / 2.0
    return sigma


def _floating(
    objects: Sequence[SceneObject], contacts: Sequence[Contact], config: PlausibilityConfig
) -> list[Contact]:
    """The nearest contact below each object that touches nothing below it; steep ones carry nothing."""
    nearest: dict[int, Contact] = {}
    steep = np.cos(np.radians(25.0))
    for contact in contacts:
        upper = contact.b if contact.normal_world[2] > 0.0 else contact.a
        level = abs(contact.normal_world[2]) > steep and objects[upper].role != "support_surface"
        if level and (upper not in nearest or contact.distance < nearest[upper].distance):
            nearest[upper] = contact
    return [c for c in nearest.values() if c.distance > config.touch]


def gap_rows(objects: Sequence[SceneObject], contacts: Sequence[Contact], pairs: NDArray[np.intp]) -> Array:
    """How far (K, 2, 9) each variable of the two objects (K, 2) of each contact closes its gap."""
    points_world = np.array([c.point_world for c in contacts]).reshape(-1, 3)
    normals_world = np.array([c.normal_world for c in contacts]).reshape(-1, 3)
    shapes = [o.shape for o in objects]
    _, R, centres, _ = Primitives.of(shapes)
    # Contacts in the frames of their two shapes: centres, and directions out of either shape.
    p = np.einsum("kpij,kpi->kpj", R[pairs], points_world[:, None] - centres[pairs])
    u = np.einsum("kpij,kpi->kpj", R[pairs], np.stack([normals_world, -normals_world], axis=1))
    round_ = np.array([_round(s.ties) for s in shapes]).reshape(-1, 3)[pairs]
    sizes = np.where(round_, 0.0, np.abs(u))
    sizes[..., 0] += np.linalg.norm(np.where(round_, u, 0.0), axis=-1)
    effects = np.array([effect(s.ties) for s in shapes]).reshape(-1, 9, 9)[pairs]
    rows: Array = np.einsum("kpi,kpij->kpj", np.concatenate([u, np.cross(p, u), sizes], axis=-1), effects)
    return rows


def closing(pairs: NDArray[np.intp], rows: Array, variance: Array, gaps: Array, noise: float) -> Array:
    """Most likely change (N, V) of N objects' variables that closes gaps: the update of a Kalman filter.

    Args:
        pairs: The two objects of each gap (K, 2).
        rows: How much (K, 2, V) each variable of the two closes it.
        variance: Variance of each variable (N, V); zero if it cannot change.
        gaps: (K,).
        noise: Variance of a gap that is closed [m²].
    """
    weighted = rows * variance[pairs]
    ends, each = pairs.ravel(), (2 * len(pairs), rows.shape[-1])
    shared = np.where(ends[:, None] == ends, weighted.reshape(each) @ rows.reshape(each).T, 0.0)
    of_either = shared[::2] + shared[1::2]
    scatter = of_either[:, ::2] + of_either[:, 1::2] + noise * np.eye(len(pairs))
    solved = np.linalg.solve(scatter, gaps)
    change = np.zeros(variance.shape)
    np.add.at(change, pairs, weighted * solved[:, None, None])
    return change


def _changed(shape: Shape, change: Array) -> Shape:
    """Change a shape's independent variables (9,)."""
    change = effect(shape.ties) @ change
    T = shape.T_world_object @ transforms.rigid(transforms.rotation_from_vector(change[3:6]), change[:3])
    # As of the fits; thinner ones were cut off at the table, and do not get thicker.
    extents = np.maximum(shape.extents + 2.0 * change[6:9], np.minimum(shape.extents, 0.008))
    return shape.resized(T, extents)


def _doubts(objects: Sequence[SceneObject], contacts: Sequence[Contact]) -> dict[int, str]:
    """The doubts about objects of contacts that uncertainty does not explain; of two, the largest."""
    doubts: dict[int, str] = {}
    largest: dict[tuple[int, int], Contact] = {}
    for c in sorted(contacts, key=lambda c: -abs(c.distance)):  # each of their convex parts has its own
        largest.setdefault((c.a, c.b), c)
    for c in sorted(largest.values(), key=lambda c: (c.a, c.b)):
        for k, other in ((c.a, c.b), (c.b, c.a)):
            if objects[k].role == "support_surface":
                continue
            what = "overlaps" if c.distance < 0.0 else "floats over"
            by = f"{1000.0 * abs(c.distance):.0f} mm, more than both fits explain"
            more = f"{what} {objects[other].id} by {by}"
            if c.distance < 0.0 or objects[k].centre_world[2] > objects[other].centre_world[2]:
                doubts[k] = f"{doubts[k]}; {more}" if k in doubts else more
    return doubts
