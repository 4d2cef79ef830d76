"""Support relations from shapes: separating planes, leaning, weight from above, and why (section III-A)."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr

from caryatid.config import SupportConfig
from caryatid.errors import InputError
from caryatid.geometry import polygons, transforms
from caryatid.geometry.shapes import Primitives, Shape
from caryatid.geometry.transforms import Array, rigid
from caryatid.graph import LIKELY, Kind, SceneObject, Stability, Support, SupportGraph
from caryatid.support.contacts import Contact, find_contacts, find_gap, local_frames
from caryatid.support.equilibrium import support_shares
from caryatid.support.stability import (
    Tipping,
    assess,
    beneath,
    centroid,
    contact_patch,
    drop_distance,
    find_tipping,
)

RULES = 0.4
"""Weight of the rules against the draws [1]; with it, probabilities in heaps are calibrated."""


@dataclass(frozen=True, eq=False, slots=True)
class Touch:
    """A contact from the side of one of its two objects.

    Attributes:
        other: The object that touches it.
        parts: The convex part of the object that is touched, and that of the other.
        normal_world: Unit normal (3,) of the separating plane, pointing away from `other`.
        gap: [m], negative where they overlap.
        tilt: Angle of the normal to the vertical [deg]; below 90 where `other` is the lower one.
        points_world: Contact points (K, 3) [m].
        point_world: Centre (3,) [m] of the contact.
        margin: Gap up to which the two count as touching [m].
    """

    other: SceneObject
    parts: tuple[Shape, Shape]
    normal_world: Array
    gap: float
    tilt: float
    points_world: Array
    point_world: Array
    margin: float

    def __str__(self) -> str:
        return f"normal {self.tilt:.0f}° from the vertical, {_gap(self.gap)}"


@dataclass(frozen=True, slots=True)
class Effect:
    """An object that moves when another one is removed.

    Attributes:
        object_id: Its id.
        certain: False where it may move, or may not.
        why: What it loses, for a person to read.
        probability: Probability that it moves [1].
    """

    object_id: str
    certain: bool
    why: str
    probability: float


def infer(
    objects: Sequence[SceneObject], config: SupportConfig, rng: np.random.Generator | None = None
) -> SupportGraph:
    """Infer which objects of a scene model support which, and how likely.

    From each separating plane the lower object supports the upper one. An object whose centre of mass lies
    outside its support polygon needs something else that keeps it from tipping: first contacts below it that
    a slightly wrong fit may have opened or made steep, then neighbours it leans on and objects that weigh it
    down. An object that touches nothing below it is lowered until it does.

    Args:
        objects: Shapes in the world frame; nothing supports the one with role `support_surface`.
        config: The stage's numbers.
        rng: Source of the draws for probabilities; None draws the same ones every time.

    Returns:
        The graph, with the supports that are at least as likely as not. The rules find them; their
        probabilities are means of the rules' word, weighing `RULES`, and the share of draws in which each
        holds. With `stability` = `area` there are none, and all that the rules find is in the graph.

    Raises:
        InputError: Two objects have the same id.
    """
    graph = _by_rules(objects, config)
    if config.stability == "area":
        return graph
    shares, likeness = support_shares(graph, config, rng or np.random.default_rng(0))
    likely = [RULES + (1.0 - RULES) * share for share in shares]
    supports = [replace(s, probability=p) for s, p in zip(graph.supports, likely, strict=True) if p >= LIKELY]
    named = [replace(o, probability=p) for o, p in zip(graph.objects, likeness, strict=True)]
    return replace(graph, objects=tuple(named), supports=tuple(supports))


def _by_rules(objects: Sequence[SceneObject], config: SupportConfig) -> SupportGraph:
    """The supports by planes, support polygons and the ways objects tip."""
    if len({o.id for o in objects}) < len(objects):
        raise InputError("objects", "two of them have the same id", "give every object an id of its own")
    ordered = tuple(sorted(objects, key=lambda o: (o.role != "support_surface", o.label)))
    shapes = Primitives.of([o.shape for o in ordered])
    touches = _find_touches(ordered, config.reach, config)
    supported = [o for o in ordered if o.role != "support_surface"]
    carried: dict[str, tuple[list[Support], Tipping]] = {}
    stability: dict[str, Stability] = {}
    for o in supported:
        supports, patches = _from_below(o, touches[o.id], config)
        if not supports and config.max_drop > 0.0:
            near = [ordered[k] for k in beneath(shapes, ordered.index(o), config.max_drop)]
            supports, patches = _let_down(o, near, config)
        tipping = find_tipping(o.shape, patches)
        carried[o.id] = supports, tipping
        stability[o.id] = assess(o.shape, tipping, config)
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
    # Solids touch with several parts.
    once = {s.pair: s for s in reversed(edges)}
    return SupportGraph(ordered, tuple(reversed(once.values())), stability)


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
    a, b = _known(graph, supporter), _known(graph, supported)
    if supporter == supported:
        raise InputError(supporter, "an object does not support itself", "ask about two different objects")
    edge = graph.support(supporter, supported)
    if edge is not None:
        known = edge.probability is not None
        return f"{edge.why} Probability {edge.probability:.2f}." if known else edge.why
    if b.role == "support_surface":
        return f"{supported} is the support surface: nothing supports it."
    touches = _find_touches([a, b], config.reach, config)[b.id]
    touch = min(touches, key=lambda t: (t.tilt > config.max_tilt, t.gap), default=None)
    head = f"{supporter} does not support {supported}: "
    if touch is None:
        gap = _gap(find_gap(a.shape, b.shape))
        limits = f"margin {_mm(config.contact_margin)}, {_mm(config.reach)} where it is needed"
        return f"{head}they do not touch, {gap} ({limits})."
    stability = graph.stability.get(supported)
    verdict = _verdict(supported, stability, config) if stability else f"how {supported} stands is not known"
    if touch.tilt >= 180.0 - config.max_tilt:
        return f"{head}it lies above it ({touch}) and could only weigh it down; {verdict}."
    if touch.tilt > config.max_tilt:
        steep = f"{touch.tilt:.0f}° from the vertical, bottom-up up to {config.max_tilt:.0f}°"
        return f"{head}they touch side by side (normal {steep}); {verdict}, and it does not lean that way."
    return f"{head}the contact is doubtful ({touch}, margin {_mm(touch.margin)}) and not needed; {verdict}."


def predict_removal(graph: SupportGraph, object_id: str, config: SupportConfig) -> tuple[Effect, ...]:
    """Say which objects will or may move when one is removed.

    An object that loses a support is judged as if the supporter had never existed. It falls for certain if
    nothing touches it from below any more, or if its centre of mass is further outside the rest of its
    support polygon than the fits' uncertainty explains. It may move if that is less certain, or if only an
    uncertain support is lost. An object that falls takes its support from others in turn.

    The probability that an object moves is that of losing a support it has, times that of falling without: a
    support is lost with the probability that its supporter moves, one independently of the other, and the
    centre of mass is off by the standard deviation of the fit. If all supports and fits are certain, it is 1.

    Args:
        graph: The support graph.
        object_id: The object to remove.
        config: The numbers the graph was inferred with.

    Returns:
        The effects in the order in which supports are lost.

    Raises:
        InputError: There is no such object, or it is the support surface.
    """
    if _known(graph, object_id).role == "support_surface":
        raise InputError(object_id, "is the support surface", "ask about one of the objects on it")
    effects: dict[str, Effect] = {}
    for certain in (True, False):
        # First the objects that certainly move; then those that may, once the others are gone.
        while True:
            moving = {i: e.probability for i, e in effects.items() if e.certain or not certain}
            gone = {object_id: 1.0} | moving
            found = _next_effect(graph, gone, effects, certain, config)
            if found is None:
                break
            effects[found.object_id] = found
    return tuple(effects.values())


def _known(graph: SupportGraph, object_id: str) -> SceneObject:
    """The object of that id; an InputError if there is none."""
    for o in graph.objects:
        if o.id == object_id:
            return o
    there = ", ".join(o.id for o in graph.objects)
    raise InputError(object_id, "no such object in the graph", f"there are {there}")


def _next_effect(
    graph: SupportGraph,
    gone: Mapping[str, float],
    known: Collection[str],
    certain: bool,
    config: SupportConfig,
) -> Effect | None:
    """The next object that moves, for certain or perhaps, once some are gone, each with a probability."""
    staying = [o for o in graph.objects if o.id not in gone]
    losses = [(o, [s for s in graph.supporters(o.id) if s.supporter in gone]) for o in staying]
    losses = [(o, lost) for o, lost in losses if lost and o.id not in known]
    left = _by_rules(staying, config) if losses else graph
    for o, lost in losses:
        named = ", ".join(dict.fromkeys(s.supporter for s in lost))
        # Two standard deviations by which the fit may be off sideways.
        slack = 0.0 if o.uncertainty is None else 2.0 * float(np.max(o.uncertainty.position[:2]))
        if not any(s.certain and s.kind == "bottom-up" for s in left.supporters(o.id)):
            overhang, what = np.inf, "nothing else is below it"
        else:
            overhang = left.stability[o.id].overhang
            side = "outside" if overhang > 0.0 else "inside"
            what = f"its centre of mass is {1000.0 * abs(overhang):.0f} mm {side} what is left to carry it"
        sure = overhang > slack and any(s.certain for s in lost)
        if sure if certain else overhang > -slack or not all(s.certain for s in lost):
            loss = 1.0 - np.prod([1.0 - s.belief * gone[s.supporter] for s in lost])
            fall = ndtr(2.0 * overhang / max(slack, 1e-9))
            why = f"it loses the support of {named}, and {what}"
            return Effect(o.id, certain, why, float(loss * fall))
    return None


def _find_touches(
    objects: Sequence[SceneObject], reach: float, config: SupportConfig
) -> dict[str, list[Touch]]:
    """The contacts of each object, and those within a reach [m], by the object's id."""
    shapes = [o.shape for o in objects]
    low, high = Primitives.of(shapes).bounds()
    contacts = [c for c in find_contacts(shapes, reach) if not _parted(c, shapes, low, high)]
    normals_world = np.array([_plane_normal(objects[c.a], objects[c.b], c) for c in contacts]).reshape(-1, 3)
    tilts = np.degrees(transforms.angle_between(normals_world, (0.0, 0.0, 1.0)))
    # Shapes touch up to gaps that their fits' uncertainty across the contact explains.
    sides, rotation = np.zeros((len(objects), 3, 2)), np.zeros((len(objects), 3))
    for k, o in enumerate(objects):
        if o.uncertainty is not None:
            sides[k], rotation[k] = o.uncertainty.sides.reshape(3, 2), o.uncertainty.rotation
    pairs = np.array([(c.a, c.b) for c in contacts], dtype=np.intp).reshape(-1, 2)
    points_world = np.array([c.point_world for c in contacts]).reshape(-1, 3)
    points, outward = local_frames(Primitives.of(shapes), pairs, points_world, normals_world)
    facing = np.where(outward > 0.0, sides[pairs, :, 1], sides[pairs, :, 0])
    spread = (outward * facing) ** 2 + (np.cross(points, outward) * rotation[pairs]) ** 2
    margins = config.margin_sigma * np.sqrt(spread.sum(axis=(1, 2)))
    margins = np.clip(margins, config.contact_margin, config.max_margin)
    touches: dict[str, list[Touch]] = {o.id: [] for o in objects}
    for c, normal_world, tilt, margin in zip(
        contacts, normals_world, tilts.tolist(), margins.tolist(), strict=True
    ):
        a, b, place = objects[c.a], objects[c.b], (c.points_world, c.point_world, margin)
        touches[b.id].append(Touch(a, c.parts[::-1], normal_world, c.distance, tilt, *place))
        touches[a.id].append(Touch(b, c.parts, -normal_world, c.distance, 180.0 - tilt, *place))
    return touches


def _parted(contact: Contact, shapes: Sequence[Shape], low: Array, high: Array) -> bool:
    """Whether a third shape fills the gap: the floor of a tray separates its content from the table.

    Only one whose level box, from corners low to high (N, 3) [m], holds all the contact's points can.
    """
    if contact.distance <= 0.0:
        return False
    points = contact.points_world
    around = (low <= points.min(axis=0)) & (points.max(axis=0) <= high)
    others = set(np.flatnonzero(around.all(axis=1)).tolist()) - {contact.a, contact.b}
    return any((shapes[k].signed_distance(points) < 0.0).all() for k in others)


def _plane_normal(other: SceneObject, o: SceneObject, contact: Contact) -> Array:
    """Normal (3,) of the separating plane from `other` to `o`; everything lies above the support surface."""
    for surface, sign in ((other, 1.0), (o, -1.0)):
        if surface.role == "support_surface":
            axes_world = surface.shape.T_world_object[:3, :3]
            normal_world = axes_world[:, np.argmax(np.abs(axes_world[2]))]
            return sign * np.sign(normal_world[2]) * normal_world
    return contact.normal_world


def _patch(t: Touch, config: SupportConfig) -> Array:
    """Contact area projected to the ground, or the hull of the contact points: a polygon (M, 2) [m]."""
    if config.stability == "area":
        return polygons.hull(t.points_world)
    return contact_patch(*t.parts, t.normal_world, t.points_world, config)


def _from_below(
    o: SceneObject, touches: list[Touch], config: SupportConfig
) -> tuple[list[Support], list[Array]]:
    """Bottom-up supports, and the contact areas they carry the object by."""
    below = [t for t in touches if t.tilt <= config.max_tilt]
    sure = [t for t in below if t.gap <= (t.margin if t.tilt <= config.gentle_tilt else 0.0)]
    supports = [_support(t, o, "bottom-up", True, f"{_below_text(t, o)}.") for t in sure]
    patches = [_patch(t, config) for t in sure]
    doubtful = sorted((t for t in below if t not in sure), key=lambda t: t.gap)
    overhang = find_tipping(o.shape, patches).overhang if doubtful else 0.0
    for t in doubtful:
        if overhang <= config.overhang:
            break
        patch = _patch(t, config)
        gained = find_tipping(o.shape, [*patches, patch]).overhang
        if gained < overhang:
            why = f"{_below_text(t, o)}; without it {_overhang_text(o.id, overhang)}."
            supports.append(_support(t, o, "bottom-up", t.gap <= t.margin, why))
            patches.append(patch)
            overhang = gained
    return supports, patches


def _let_down(
    o: SceneObject, near: Sequence[SceneObject], config: SupportConfig
) -> tuple[list[Support], list[Array]]:
    """Supports of an object that touches nothing below it: what it lands on first when lowered."""
    landings: list[tuple[float, SceneObject, Touch]] = []
    for other in near:
        drop = drop_distance(o.shape, other.shape, config.max_drop)
        if np.isfinite(drop):
            lowered = replace(o, shape=o.shape.moved(rigid(np.eye(3), (0.0, 0.0, -drop))))
            touches = _find_touches([other, lowered], config.contact_margin, config)[o.id]
            landings += [(drop, lowered, t) for t in touches if t.tilt <= config.max_tilt]
    first = min((drop for drop, _, _ in landings), default=np.inf)
    landings = [landing for landing in landings if landing[0] <= first + config.contact_margin]
    head = f"{o.id} touches nothing below it; let down"
    supports = [
        _support(
            t, o, "bottom-up", drop <= config.contact_margin, f"{head} {_mm(drop)} it meets {t.other.id}."
        )
        for drop, _, t in landings
    ]
    return supports, [_patch(t, config) for _, _, t in landings]


def _leaning(o: SceneObject, touches: list[Touch], tipping: Tipping, config: SupportConfig) -> list[Support]:
    """Leaning supports of an object that tips: what pushes against it, or the nearest if none touches."""
    push = np.cos(np.radians(75.0))  # A push may come aslant, but not across the direction of tipping.
    aside = [t for t in touches if config.max_tilt < t.tilt < 180.0 - config.max_tilt]
    against = [t for t in aside if t.normal_world[:2] @ tipping.direction_xy < -push]
    against.sort(key=lambda t: t.gap)
    touching = [t for t in against if t.gap <= t.margin] or against[:1]
    head = _overhang_text(o.id, tipping.overhang)
    return [_support(t, o, "lean", False, f"{head}; {t.other.id} stands in its way ({t}).") for t in touching]


def _weighed_down(
    o: SceneObject, riders: list[Touch], stability: Stability, tipping: Tipping, config: SupportConfig
) -> list[Support]:
    """Top-down supports of an unstable object: all objects on it, or those that weigh against tipping."""
    if stability.stable:
        return []
    head, found = _verdict(o.id, stability, config), []
    for t in riders:
        why = f"{head}; {t.other.id} rests on it"
        lever = float((tipping.pivot_xy - centroid(_patch(t, config))) @ tipping.direction_xy)
        if config.stability == "area":
            found.append(_support(t, o, "top-down", False, f"{why}."))
        elif stability.tips and lever > 0.0:
            why = f"{why} {_mm(lever)} behind the edge it tips over."
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
