"""Support relations from shapes: separating planes, leaning, weight from above, and why (section III-A)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from shapely.geometry.base import BaseGeometry

from caryatid import frames
from caryatid.config import SupportConfig
from caryatid.contacts import Contact, find_contacts, find_gap
from caryatid.errors import InputError
from caryatid.frames import Array, rigid
from caryatid.graph import Kind, SceneObject, Stability, Support, SupportGraph
from caryatid.stability import (
    Tipping,
    assess,
    contact_patch,
    drop_distance,
    find_tipping,
    support_polygon,
)


@dataclass(frozen=True, eq=False, slots=True)
class Touch:
    """A contact as one of its two objects feels it.

    Attributes:
        other: The object that touches it.
        normal_world: Unit normal (3,) of the separating plane, pointing away from `other`.
        gap: [m], negative where they overlap.
        tilt: Angle of the normal to the vertical [deg]; below 90 where `other` is the lower one.
        point_world: Centre (3,) [m] of the contact.
        patch: Contact area projected to the ground [m].
        margin: Gap up to which the two are taken to touch [m].
    """

    other: SceneObject
    normal_world: Array
    gap: float
    tilt: float
    point_world: Array
    patch: BaseGeometry
    margin: float

    def __str__(self) -> str:
        return f"normal {self.tilt:.0f}° from the vertical, {_gap(self.gap)}"


def infer(objects: Sequence[SceneObject], config: SupportConfig) -> SupportGraph:
    """Infer who supports whom among the objects of one scene model.

    From each separating plane the lower object supports the upper one. An object whose centre of mass lies
    outside what then carries it looks for what keeps it from tipping: first contacts below it that a slightly
    wrong fit may have opened or made steep, then neighbours it leans on and objects that weigh it down. What
    touches nothing below it is let down until it does.

    Args:
        objects: Shapes in the world frame; the one with role `support_surface` is supported by nothing.
        config: The stage's numbers.

    Raises:
        InputError: Two objects have the same id.
    """
    if len({o.id for o in objects}) < len(objects):
        raise InputError("objects", "two of them have the same id", "give every object an id of its own")
    ordered = tuple(sorted(objects, key=lambda o: (o.role != "support_surface", o.label)))
    touches = _find_touches(ordered, config)
    supported = [o for o in ordered if o.role != "support_surface"]
    carried: dict[str, tuple[list[Support], Tipping]] = {}
    stability: dict[str, Stability] = {}
    for o in supported:
        supports, patches = _from_below(o, touches[o.id], config)
        if not supports:
            supports, patches = _let_down(o, ordered, config)
        carried[o.id] = supports, find_tipping(o.shape, support_polygon(patches))
        stability[o.id] = assess(o.shape, patches, config)
    edges: list[Support] = []
    for o in supported:
        supports, tipping = carried[o.id]
        edges += supports
        known = {s.supporter for s in supports}
        beside = [t for t in touches[o.id] if t.other.id not in known]
        riders = [t for t in beside if any(s.supporter == o.id for s in carried.get(t.other.id, ([],))[0])]
        if supports and stability[o.id].tips:
            edges += _leaning(o, [t for t in beside if t not in riders], tipping, config)
        edges += _weighed_down(o, riders, stability[o.id], tipping, config)
    rank = {o.id: i for i, o in enumerate(ordered)}
    edges.sort(key=lambda s: (rank[s.supporter], rank[s.supported]))
    return SupportGraph(ordered, tuple(edges), stability)


def explain(graph: SupportGraph, supporter: str, supported: str, config: SupportConfig) -> str:
    """Say in a sentence why `supporter` supports `supported`, or why it does not.

    Args:
        graph: As `infer` returns it.
        supporter: Id of the one below, beside or on top.
        supported: Id of the one held.
        config: The numbers the graph was inferred with.

    Raises:
        InputError: There is no object with one of the ids, or both are the same.
    """
    for name in (supporter, supported):
        if name not in {o.id for o in graph.objects}:
            raise InputError(
                name, "no such object in the graph", f"there are {', '.join(o.id for o in graph.objects)}"
            )
    if supporter == supported:
        raise InputError(supporter, "an object does not support itself", "ask about two different objects")
    edge = graph.support(supporter, supported)
    if edge is not None:
        return edge.why
    a, b = graph[supporter], graph[supported]
    if b.role == "support_surface":
        return f"{supported} is the support surface: nothing supports it."
    contact = next(iter(find_contacts([a.shape, b.shape], config.reach)), None)
    head = f"{supporter} does not support {supported}: "
    if contact is None:
        gap = _gap(find_gap(a.shape, b.shape))
        limits = f"margin {_mm(config.contact_margin)}, {_mm(config.reach)} where it is needed"
        return f"{head}they do not touch, {gap} ({limits})."
    touch = _touch(a, b, contact, config)
    stability = graph.stability.get(supported)
    verdict = _verdict(supported, stability, config) if stability else f"how {supported} stands is not known"
    if touch.tilt >= 180.0 - config.max_tilt:
        return f"{head}it lies above it ({touch}) and could only weigh it down; {verdict}."
    if touch.tilt > config.max_tilt:
        steep = f"{touch.tilt:.0f}° from the vertical, bottom-up up to {config.max_tilt:.0f}°"
        return f"{head}they touch side by side (normal {steep}); {verdict}, and it does not lean that way."
    return f"{head}the contact is doubtful ({touch}, margin {_mm(touch.margin)}) and not needed; {verdict}."


def _find_touches(objects: Sequence[SceneObject], config: SupportConfig) -> dict[str, list[Touch]]:
    touches: dict[str, list[Touch]] = {o.id: [] for o in objects}
    for contact in find_contacts([o.shape for o in objects], config.reach):
        a, b = objects[contact.a], objects[contact.b]
        touches[b.id].append(_touch(a, b, contact, config))
        touches[a.id].append(_touch(b, a, _swapped(contact), config))
    return touches


def _swapped(contact: Contact) -> Contact:
    return Contact(contact.b, contact.a, contact.points_world, -contact.normal_world, contact.distance)


def _touch(other: SceneObject, o: SceneObject, contact: Contact, config: SupportConfig) -> Touch:
    normal_world = _plane_normal(other, o, contact)
    tilt = float(np.degrees(frames.angle_between(normal_world, (0.0, 0.0, 1.0))))
    patch = contact_patch(o.shape, other.shape, normal_world, contact.points_world, config)
    point_world = contact.points_world.mean(axis=0)
    margin = _margin(other, o, point_world, normal_world, config)
    return Touch(other, normal_world, contact.distance, tilt, point_world, patch, margin)


def _margin(
    other: SceneObject, o: SceneObject, point_world: Array, normal_world: Array, config: SupportConfig
) -> float:
    """Gap [m] up to which two shapes touch: what their fits' uncertainty across the contact explains."""
    variance = 0.0
    for each, outward_world in ((other, normal_world), (o, -normal_world)):
        if each.uncertainty is not None:
            T_object_world = frames.invert(each.shape.T_world_object)
            point = frames.transform(T_object_world, point_world)
            variance += each.uncertainty.along(point, frames.rotate(T_object_world, outward_world)) ** 2
    return float(np.clip(config.margin_sigma * np.sqrt(variance), config.contact_margin, config.max_margin))


def _plane_normal(other: SceneObject, o: SceneObject, contact: Contact) -> Array:
    """Normal (3,) of the separating plane from `other` to `o`; everything lies above the support surface."""
    for surface, sign in ((other, 1.0), (o, -1.0)):
        if surface.role == "support_surface":
            axes_world = surface.shape.T_world_object[:3, :3]
            normal_world = axes_world[:, np.argmax(np.abs(axes_world[2]))]
            return sign * np.sign(normal_world[2]) * normal_world
    return contact.normal_world


def _from_below(
    o: SceneObject, touches: list[Touch], config: SupportConfig
) -> tuple[list[Support], list[BaseGeometry]]:
    """Bottom-up supports, and the contact areas they carry the object by."""
    below = [t for t in touches if t.tilt <= config.max_tilt]
    sure = [t for t in below if t.gap <= (t.margin if t.tilt <= config.gentle_tilt else 0.0)]
    supports = [_support(t, o, "bottom-up", True, f"{_below_text(t, o)}.") for t in sure]
    patches = [t.patch for t in sure]
    overhang = find_tipping(o.shape, support_polygon(patches)).overhang
    for t in sorted((t for t in below if t not in sure), key=lambda t: t.gap):
        if overhang <= config.overhang:
            break
        gained = find_tipping(o.shape, support_polygon([*patches, t.patch])).overhang
        if gained < overhang:
            why = f"{_below_text(t, o)}; without it {_overhang_text(o.id, overhang)}."
            supports.append(_support(t, o, "bottom-up", t.gap <= t.margin, why))
            patches.append(t.patch)
            overhang = gained
    return supports, patches


def _let_down(
    o: SceneObject, objects: Sequence[SceneObject], config: SupportConfig
) -> tuple[list[Support], list[BaseGeometry]]:
    """Supports of an object that touches nothing below it: what it lands on first when let straight down."""
    landings: list[tuple[float, Touch]] = []
    for other in objects:
        drop = drop_distance(o.shape, other.shape, config.max_drop) if other is not o else np.inf
        if np.isfinite(drop):
            lowered = replace(o, shape=o.shape.moved(rigid(np.eye(3), (0.0, 0.0, -drop))))
            contacts = find_contacts([other.shape, lowered.shape], config.contact_margin)
            landings += [(drop, _touch(other, lowered, contact, config)) for contact in contacts]
    landings = [(drop, t) for drop, t in landings if t.tilt <= config.max_tilt]
    first = min((drop for drop, _ in landings), default=np.inf)
    landings = [(drop, t) for drop, t in landings if drop <= first + config.contact_margin]
    head = f"{o.id} touches nothing below it; let down"
    supports = [
        _support(
            t, o, "bottom-up", drop <= config.contact_margin, f"{head} {_mm(drop)} it meets {t.other.id}."
        )
        for drop, t in landings
    ]
    return supports, [t.patch for _, t in landings]


def _leaning(o: SceneObject, touches: list[Touch], tipping: Tipping, config: SupportConfig) -> list[Support]:
    """Leaning supports of an object that tips: who pushes against it, the nearest one if none touches."""
    push = np.cos(np.radians(config.lean_angle))
    aside = [t for t in touches if config.max_tilt < t.tilt < 180.0 - config.max_tilt]
    against = [t for t in aside if t.normal_world[:2] @ tipping.direction_xy < -push]
    against.sort(key=lambda t: t.gap)
    touching = [t for t in against if t.gap <= t.margin] or against[:1]
    head = _overhang_text(o.id, tipping.overhang)
    return [_support(t, o, "lean", False, f"{head}; {t.other.id} stands in its way ({t}).") for t in touching]


def _weighed_down(
    o: SceneObject, riders: list[Touch], stability: Stability, tipping: Tipping, config: SupportConfig
) -> list[Support]:
    """Top-down supports: what rests on an unstable object, all or only what weighs against its tipping."""
    if stability.stable:
        return []
    head = _verdict(o.id, stability, config)
    found = []
    for t in riders:
        load_xy = np.asarray(t.patch.centroid.coords[0])
        lever = float((tipping.pivot_xy - load_xy) @ tipping.direction_xy)
        if config.top_down == "paper":
            found.append(_support(t, o, "top-down", False, f"{head}; {t.other.id} rests on it."))
        elif stability.tips and lever > 0.0:
            why = f"{head}; {t.other.id} rests on it {_mm(lever)} behind the edge it tips over."
            found.append(_support(t, o, "top-down", False, why))
    return found


def _support(t: Touch, o: SceneObject, kind: Kind, certain: bool, why: str) -> Support:
    return Support(
        t.other.id, o.id, kind, certain, contact_world=t.point_world, normal_world=t.normal_world, why=why
    )


def _below_text(t: Touch, o: SceneObject) -> str:
    return f"{t.other.id} lies below the plane that parts it from {o.id} ({t})"


def _verdict(object_id: str, stability: Stability, config: SupportConfig) -> str:
    """Both tests in words."""
    if not np.isfinite(stability.overhang):
        return _overhang_text(object_id, stability.overhang)
    sign = "<" if stability.small_area else "≥"
    ratio = f"{object_id} has a support area ratio {stability.ratio:.2f} {sign} {config.min_area_ratio:g}"
    return f"{ratio}, {_overhang_text('it', stability.overhang)}"


def _overhang_text(name: str, overhang: float) -> str:
    if not np.isfinite(overhang):
        return f"{name} rests on nothing"
    side = "outside" if overhang > 0.0 else "inside"
    return f"{name} has its centre of mass {_mm(abs(overhang))} {side} its support polygon"


def _gap(gap: float) -> str:
    return f"gap {_mm(gap)}" if gap >= 0.0 else f"overlap {_mm(-gap)}"


def _mm(metres: float) -> str:
    return f"{metres * 1000.0:.1f} mm"
