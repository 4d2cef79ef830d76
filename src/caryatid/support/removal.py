"""What happens when an object is taken away, by the support graph: who loses what carries it."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from caryatid.config import SupportConfig
from caryatid.errors import InputError
from caryatid.graph import SceneObject, Support, SupportGraph
from caryatid.support.relations import infer


@dataclass(frozen=True, slots=True)
class Effect:
    """An object that moves when another one is taken away.

    Attributes:
        object_id: Which.
        certain: False where it may move, or may not.
        why: What it loses, for a person to read.
    """

    object_id: str
    certain: bool
    why: str


def predict_removal(graph: SupportGraph, object_id: str, config: SupportConfig) -> tuple[Effect, ...]:
    """Say which objects will or may move when one is taken away.

    What loses a support is looked at again as if the supporter had never been there: it falls for certain
    where nothing touches it from below any more, or its centre of mass is further outside what is left of its
    support polygon than the fits' uncertainty explains. It may move where that is not so sure, or where only
    a support that is uncertain itself is lost. What falls takes its support from others in turn.

    Args:
        graph: What is known.
        object_id: The object that is taken away.
        config: The numbers the graph was inferred with.

    Returns:
        The effects in the order in which supports are lost.

    Raises:
        InputError: There is no such object, or it is the support surface.
    """
    ids = {o.id: o for o in graph.objects}
    if object_id not in ids:
        raise InputError(object_id, "no such object in the graph", f"there are {', '.join(ids)}")
    if ids[object_id].role == "support_surface":
        raise InputError(object_id, "is the support surface", "ask about one of the objects on it")
    effects: dict[str, Effect] = {}
    for certain in (True, False):
        # First what moves for certain; then what may, once all that certainly moves is gone.
        while True:
            gone = {object_id} | {i for i, e in effects.items() if e.certain or not certain}
            found = _next(graph, gone, effects, certain, config)
            if found is None:
                break
            effects[found.object_id] = found
    return tuple(effects.values())


def _next(
    graph: SupportGraph,
    gone: Collection[str],
    known: Collection[str],
    certain: bool,
    config: SupportConfig,
) -> Effect | None:
    """One more object that moves once some are gone: for certain, or perhaps."""
    losing = [o for o in graph.objects if o.id not in gone and o.id not in known and _lost(graph, o, gone)]
    if not losing:
        return None
    left = infer([o for o in graph.objects if o.id not in gone], config)
    for o in losing:
        lost = _lost(graph, o, gone)
        named = ", ".join(dict.fromkeys(s.supporter for s in lost))
        slack = _slack(o)
        if not any(s.certain and s.kind == "bottom-up" for s in left.supporters(o.id)):
            overhang, what = np.inf, "nothing else is below it"
        else:
            overhang = left.stability[o.id].overhang
            side = "outside" if overhang > 0.0 else "inside"
            what = f"its centre of mass is {1000.0 * abs(overhang):.0f} mm {side} what is left to carry it"
        sure = overhang > slack and any(s.certain for s in lost)
        if sure if certain else overhang > -slack or not all(s.certain for s in lost):
            return Effect(o.id, certain, f"it loses the support of {named}, and {what}")
    return None


def _lost(graph: SupportGraph, o: SceneObject, gone: Collection[str]) -> list[Support]:
    return [s for s in graph.supporters(o.id) if s.supporter in gone]


def _slack(o: SceneObject) -> float:
    """How far [m] the fits' uncertainty may shift an object over what carries it: two standard deviations."""
    return 0.0 if o.uncertainty is None else 2.0 * float(np.max(o.uncertainty.position[:2]))
