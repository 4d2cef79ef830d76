"""Support relations between shapes, with a probability for each (section III-A)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np

from caryatid.config import SupportConfig
from caryatid.errors import InputError
from caryatid.geometry import polygons
from caryatid.geometry.transforms import Array
from caryatid.graph import CERTAIN, LIKELY, Kind, SceneObject, Stability, Support, SupportGraph
from caryatid.support.contacts import Contact, find_gap
from caryatid.support.equilibrium import moved_without, support_forces, touching
from caryatid.support.stability import assess


@dataclass(frozen=True, eq=False, slots=True)
class Touch:
    """How one object touches another one.

    Attributes:
        other: The other object.
        contact: The contact.
        normal_world: Unit normal (3,) of the separating plane, away from the other object.
        tilt: Angle of the normal to the vertical [deg]; 0 lies on top, 180 lies below.
    """

    other: SceneObject
    contact: Contact
    normal_world: Array
    tilt: float

    def __str__(self) -> str:
        gap = self.contact.distance
        return f"{_gap(gap)}, normal {self.tilt:.0f}° from the vertical"


@dataclass(frozen=True, slots=True)
class Effect:
    """An object that moves when another one is removed.

    Attributes:
        object_id: Its id.
        certain: Whether its probability is at least `CERTAIN`.
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

    An object supports another one that it touches if the forces that hold the scene at rest need it: it
    carries a share of its weight, or the other one moves without it. The probability is the share of draws
    of what is not known, such as the gap, in which it does. With `stability` = `area`, the rules of the
    paper decide instead, and there are no probabilities: from each separating plane the lower object
    supports the upper one, and all on top of an object with a small support area hold it down.

    Args:
        objects: Shapes in the world frame; nothing supports the one with role `support_surface`.
        config: The stage's numbers.
        rng: Source of the draws; None draws the same ones every time.

    Returns:
        The graph, with the supports that are at least as likely as not.

    Raises:
        InputError: Two objects have the same id.
    """
    if len({o.id for o in objects}) < len(objects):
        raise InputError("objects", "two of them have the same id", "give each object a unique id")
    ordered = tuple(sorted(objects, key=lambda o: (o.role != "support_surface", o.label)))
    if config.stability == "area":
        return _by_area(ordered, config)
    found = support_forces(ordered, config, rng or np.random.default_rng(0))
    supports = [
        _support(t, ordered[b], float(found.shares[a, b]), found.forces[a, b], config)
        for (a, b), t in sorted(_touches(ordered, found.contacts).items())
        if found.shares[a, b] >= LIKELY
    ]
    below = {s.pair for s in supports if s.kind == "bottom-up"}
    patches: dict[str, list[Array]] = {o.id: [] for o in ordered if o.role != "support_surface"}
    for contact, area in zip(found.contacts, found.areas, strict=True):
        for a, b in permutations((ordered[contact.a].id, ordered[contact.b].id)):
            if (a, b) in below:
                patches[b].append(area[:, :2])
    stability = {o.id: assess(o.shape, patches[o.id], config) for o in ordered if o.id in patches}
    named = tuple(replace(o, probability=float(p)) for o, p in zip(ordered, found.likeness, strict=True))
    return SupportGraph(named, tuple(supports), stability)


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
    a, b = _index(graph, supporter), _index(graph, supported)
    if supporter == supported:
        raise InputError(supporter, "an object does not support itself", "ask about two different objects")
    edge = graph.support(supporter, supported)
    if edge is not None:
        known = edge.probability is not None
        return f"{edge.why} Probability {edge.probability:.2f}." if known else edge.why
    if graph.objects[b].role == "support_surface":
        return f"{supported} is the support surface: nothing supports it."
    touch = _touches(graph.objects, touching(graph.objects, config.reach)).get((a, b))
    head = f"{supporter} does not support {supported}"
    if touch is None:
        gap = find_gap(graph.objects[a].shape, graph.objects[b].shape)
        return f"{head}: they do not touch, {_gap(gap)}."
    if config.stability == "area":
        return f"{head}: it is not below it ({touch})."
    share = support_forces(graph.objects, config, np.random.default_rng(0)).shares[a, b]
    return f"{head}: {supported} rests without it ({touch}). Probability {share:.2f}."


def predict_removal(graph: SupportGraph, object_id: str, config: SupportConfig) -> tuple[Effect, ...]:
    """Say which objects move when one is removed, and how likely.

    An object moves in a draw of what is not known if it is at rest with all objects and not without the
    removed one; what rests on it moves with it.

    Args:
        graph: The support graph.
        object_id: The object to remove.
        config: The numbers the graph was inferred with.

    Returns:
        The effects, the most likely first.

    Raises:
        InputError: There is no such object, or it is the support surface.
    """
    index = _index(graph, object_id)
    if graph.objects[index].role == "support_surface":
        raise InputError(object_id, "is the support surface", "ask about one of the objects on it")
    moves = moved_without(graph.objects, index, config, np.random.default_rng(0))
    moving = {o.id: float(p) for o, p in zip(graph.objects, moves, strict=True) if p > 0.0}
    effects = [Effect(i, p >= CERTAIN, _loss(graph, i, {object_id, *moving}), p) for i, p in moving.items()]
    return tuple(sorted(effects, key=lambda e: -e.probability))


def _index(graph: SupportGraph, object_id: str) -> int:
    """The place of the object of that id; an InputError if there is none."""
    ids = [o.id for o in graph.objects]
    if object_id not in ids:
        raise InputError(object_id, "is not an object of the graph", f"known objects: {', '.join(ids)}")
    return ids.index(object_id)


def _loss(graph: SupportGraph, object_id: str, gone: set[str]) -> str:
    lost = [s.supporter for s in graph.supporters(object_id) if s.supporter in gone]
    return f"it loses the support of {', '.join(lost)}" if lost else "the forces on it change"


def _touches(objects: Sequence[SceneObject], contacts: Iterable[Contact]) -> Mapping[tuple[int, int], Touch]:
    """The nearest contact of each pair (A, B) of objects, as B, which is not the surface, touches A."""
    touches: dict[tuple[int, int], Touch] = {}
    for c in contacts:
        for a, b, sign in ((c.a, c.b, 1.0), (c.b, c.a, -1.0)):
            if objects[b].role == "support_surface":
                continue
            if (a, b) not in touches or c.distance < touches[a, b].contact.distance:
                normal_world = sign * c.normal_world
                tilt = float(np.degrees(np.arccos(np.clip(normal_world[2], -1.0, 1.0))))
                touches[a, b] = Touch(objects[a], c, normal_world, tilt)
    return touches


def _by_area(objects: tuple[SceneObject, ...], config: SupportConfig) -> SupportGraph:
    """The supports by the rules of the paper: separating planes and eq. 1."""
    touches = _touches(objects, touching(objects, config.contact_margin))
    below = {pair: t for pair, t in touches.items() if t.tilt <= config.max_tilt}
    stability: dict[str, Stability] = {}
    supports = {pair: _support(t, objects[pair[1]], None, None, config) for pair, t in below.items()}
    for k, o in enumerate(objects):
        if o.role == "support_surface":
            continue
        patches = [polygons.hull(t.contact.points_world) for (_, b), t in below.items() if b == k]
        stability[o.id] = assess(o.shape, patches, config)
        if not stability[o.id].stable:
            riders = {(b, a) for a, b in below if a == k} - supports.keys()
            supports |= {pair: _support(touches[pair], o, None, None, config) for pair in riders}
    return SupportGraph(objects, tuple(supports[pair] for pair in sorted(supports)), stability)


def _support(
    t: Touch, o: SceneObject, share: float | None, force: Array | None, config: SupportConfig
) -> Support:
    """The support of an object by what it touches, with a probability [1] and a force (3,) [its weight]."""
    a, b = t.other.id, o.id
    kind: Kind = "lean" if t.tilt < 180.0 - config.max_tilt else "top-down"
    kind = "bottom-up" if t.tilt <= config.max_tilt else kind
    weight = "" if force is None else f" with {np.linalg.norm(force):.2f} times its weight"
    why = {
        "bottom-up": f"{b} rests on {a}{weight} ({t}).",
        "lean": f"{b} leans on {a}{weight} ({t}).",
        "top-down": f"{a} holds {b} down ({t}).",
    }[kind]
    certain = kind == "bottom-up" if share is None else share >= CERTAIN
    support = Support(a, b, kind, certain, why=why, probability=share)
    return replace(support, contact_world=t.contact.point_world, normal_world=t.normal_world)


def _gap(gap: float) -> str:
    return f"gap {1000.0 * gap:.1f} mm" if gap >= 0.0 else f"overlap {-1000.0 * gap:.1f} mm"
