"""Support relations between shapes, with a probability for each (section III-A)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, permutations
from typing import Any

import numpy as np

from caryatid.config import SupportConfig
from caryatid.errors import InputError
from caryatid.geometry.transforms import Array
from caryatid.graph import DOUBTFUL, LIKELY, Kind, SceneObject, Support, SupportGraph, vertex_order
from caryatid.support.contacts import Contact, find_gap
from caryatid.support.equilibrium import moved_without, support_forces, touching
from caryatid.support.stability import assess


@dataclass(frozen=True, slots=True)
class Effect:
    """An object that moves when another one is removed.

    Attributes:
        object_id: Its id.
        why: What it loses, for a person to read.
        probability: Probability that it moves [1].
    """

    object_id: str
    why: str
    probability: float


@dataclass(frozen=True, slots=True)
class Removal:
    """What happens to the other objects when one is removed.

    Attributes:
        object_id: Id of the removed object.
        effects: The objects that move with a probability above 0, the most likely first.
        rest: Probability that no object moves but those in `moving` [1].
        unseen: Share of its free upper side next to unseen space, where something may rest on it [1]; 0
            without a voxel map.
    """

    object_id: str
    effects: tuple[Effect, ...]
    rest: float
    unseen: float = 0.0

    @property
    def moving(self) -> tuple[Effect, ...]:
        """The effects that are not as good as excluded."""
        return tuple(e for e in self.effects if e.probability >= 1.0 - DOUBTFUL)

    def to_json(self) -> dict[str, Any]:
        """Entry `removal` in the output of `--json`."""
        moving = [{"object": e.object_id, "probability": e.probability, "why": e.why} for e in self.moving]
        return {"object": self.object_id, "moving": moving, "rest": self.rest, "unseen": self.unseen}

    def __str__(self) -> str:
        clauses = []
        for likely, alike in groupby(self.moving, lambda e: f"{e.probability:.2f}"):
            *others, last = (e.object_id for e in alike)
            verb = "move" if others else "moves"
            clauses.append(f"{', '.join(others)}{' and ' * bool(others)}{last} {verb} ({likely})")
        clauses.append(f"nothing else moves ({self.rest:.2f})")
        if self.unseen > 1.0 - DOUBTFUL:
            clauses.append(f"{100.0 * self.unseen:.0f}% of the space on {self.object_id} is unseen")
        return ", ".join(clauses)


def infer(
    objects: Sequence[SceneObject], config: SupportConfig, rng: np.random.Generator | None = None
) -> SupportGraph:
    """Infer which objects of a scene model support which, and how likely.

    An object supports another one that it touches if the forces that hold the scene at rest need it: it
    carries a share of its weight, or the other one moves without it. The probability is the share of scenes,
    sampled from the uncertainty of shapes, friction and weights, in which it does.

    Args:
        objects: Shapes in the world frame; nothing supports those with role `support_surface`.
        config: The stage's numbers.
        rng: Source of the draws; None draws the same ones every time.

    Returns:
        The graph, with the supports that are at least as likely as not.

    Raises:
        InputError: Two objects have the same id, or `stability` is `area`.
    """
    if config.stability == "area":
        raise InputError("support.stability", "is 'area'", "use caryatid.paper.infer_by_area")
    ordered = sort_objects(objects)
    found = support_forces(ordered, config, rng or np.random.default_rng(0))
    supports = [
        make_support(ordered, c, config, float(found.shares[a, b]), found.forces[a, b])
        for (a, b), c in sorted(nearest_contacts(ordered, found.contacts).items())
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


def sort_objects(objects: Sequence[SceneObject]) -> tuple[SceneObject, ...]:
    """Put the support surface first, then the objects by label.

    Raises:
        InputError: Two objects have the same id.
    """
    if len({o.id for o in objects}) < len(objects):
        raise InputError("objects", "two of them have the same id", "give each object a unique id")
    return tuple(sorted(objects, key=vertex_order))


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
        return f"{supported} is a support surface: nothing supports it."
    contact = nearest_contacts(graph.objects, touching(graph.objects, config.reach)).get((a, b))
    head = f"{supporter} does not support {supported}"
    if contact is None:
        gap = find_gap(graph.objects[a].shape, graph.objects[b].shape)
        return f"{head}: they do not touch, {_gap(gap)}."
    if config.stability == "area":
        return f"{head}: {supporter} is not below {supported} ({_described(contact)})."
    share = support_forces(graph.objects, config, np.random.default_rng(0)).shares[a, b]
    return f"{head}: {supported} rests without it ({_described(contact)}). Probability {share:.2f}."


def predict_removal(graph: SupportGraph, object_id: str, config: SupportConfig) -> tuple[Effect, ...]:
    """Say which objects move when one is removed, and how likely: the effects of `removal_of`."""
    return removal_of(graph, object_id, config).effects


def removal_of(graph: SupportGraph, object_id: str, config: SupportConfig) -> Removal:
    """Say what moves, and whether nothing else does, when an object is removed.

    In a sampled scene, an object moves if it is at rest with all objects, but not without the removed one;
    what rests on it moves with it.

    Args:
        graph: The support graph.
        object_id: The object to remove.
        config: The numbers the graph was inferred with.

    Returns:
        The removal.

    Raises:
        InputError: There is no such object, or it is a support surface.
    """
    index = _index(graph, object_id)
    if graph.objects[index].role == "support_surface":
        raise InputError(object_id, "is a support surface", "ask about one of the objects on it")
    beliefs = np.full(len(graph.objects), np.nan)
    for s in graph.supports:
        if s.supporter == object_id:
            beliefs[_index(graph, s.supported)] = s.belief
    moves, trust = moved_without(graph.objects, index, beliefs, config, np.random.default_rng(0))
    shares = ((moves * trust).sum(axis=0) / trust.sum(axis=0)).clip(0.0, 1.0)
    moving = {o.id: float(p) for o, p in zip(graph.objects, shares, strict=True) if p > 0.0}
    effects = [Effect(i, _loss(graph, i, {object_id, *moving}), p) for i, p in moving.items()]
    removal = Removal(object_id, tuple(sorted(effects, key=lambda e: -e.probability)), 1.0)
    listed = {e.object_id for e in removal.moving}
    rest = [k for k, o in enumerate(graph.objects) if o.id in moving.keys() - listed]
    weights = trust[:, rest].min(axis=1, initial=1.0)
    disturbed = float(weights @ (1.0 - np.prod(1.0 - moves[:, rest], axis=1)))
    # As for rehearsals: that a few draws move nothing does not make it certain.
    return replace(removal, rest=1.0 - (disturbed + 0.5) / (float(weights.sum()) + 1.0))


def _index(graph: SupportGraph, object_id: str) -> int:
    """The place of the object of that id; an InputError if there is none."""
    ids = [o.id for o in graph.objects]
    if object_id not in ids:
        raise InputError(object_id, "is not an object of the graph", f"known objects: {', '.join(ids)}")
    return ids.index(object_id)


def _loss(graph: SupportGraph, object_id: str, gone: set[str]) -> str:
    lost = [s.supporter for s in graph.supporters(object_id) if s.supporter in gone]
    return f"it loses the support of {', '.join(lost)}" if lost else "the forces on it change"


def nearest_contacts(
    objects: Sequence[SceneObject], contacts: Iterable[Contact]
) -> dict[tuple[int, int], Contact]:
    """Find the nearest contact of each pair (a, b) of objects, seen from a to b, which is not the surface."""
    nearest: dict[tuple[int, int], Contact] = {}
    for contact in contacts:
        for c in (contact, contact.reversed()):
            on_object = objects[c.b].role != "support_surface"
            if on_object and ((c.a, c.b) not in nearest or c.distance < nearest[c.a, c.b].distance):
                nearest[c.a, c.b] = c
    return nearest


def make_support(
    objects: Sequence[SceneObject],
    contact: Contact,
    config: SupportConfig,
    share: float | None = None,
    force: Array | None = None,
) -> Support:
    """Make the support of b by a across a contact, with a probability [1] and a force (3,) [weight of b]."""
    a, b, tilt = objects[contact.a].id, objects[contact.b].id, contact.tilt
    kind: Kind = "lean" if tilt < 180.0 - config.max_tilt else "top-down"
    kind = "bottom-up" if tilt <= config.max_tilt else kind
    verb = {"bottom-up": f"{b} rests on {a}", "lean": f"{b} leans on {a}", "top-down": f"{a} holds {b} down"}
    weight = (
        "" if force is None or kind == "top-down" else f" with {np.linalg.norm(force):.2f} times its weight"
    )
    why = f"{verb[kind]}{weight} ({_described(contact)})."
    certain = share is not None or kind == "bottom-up"
    support = Support(a, b, kind, certain, why=why, probability=share)
    return replace(support, contact_world=contact.point_world, normal_world=contact.normal_world)


def _described(contact: Contact) -> str:
    return f"{_gap(contact.distance)}, normal {contact.tilt:.0f}° from the vertical"


def _gap(gap: float) -> str:
    return f"gap {1000.0 * gap:.1f} mm" if gap >= 0.0 else f"overlap {-1000.0 * gap:.1f} mm"
