"""How well a scene is taken apart by what is known of it after some views: in physics, by several orders."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from caryatid.benchmark.records import OrderName
from caryatid.config import Config
from caryatid.evaluation.scores import TrueScene
from caryatid.graph import SupportGraph
from caryatid.manipulation.dismantling import bodies_of, dismantle, poses_of
from caryatid.manipulation.order import TakeStep, plan_order
from caryatid.simulation.world import SimulatedScene

AFTER = (1, 3, 5, 10)
"""Views after which a scene is taken apart; what is known then."""


def take_apart(
    scene: SimulatedScene,
    graph: SupportGraph,
    truth: TrueScene,
    order: OrderName,
    config: Config,
    seed: int,
) -> tuple[float, float]:
    """Take a scene apart in physics.

    What the order leaves out, because it was not extracted, is taken last, the highest first.

    Args:
        scene: The scene.
        graph: What has been extracted.
        truth: What is really there.
        order: How objects are put in order.
        config: How lifts go, and how they are rehearsed.
        seed: Seed of rehearsals and of the random order.

    Returns:
        1 where nothing was disturbed, else 0; and the share of the lifts that disturbed nothing.
    """
    bodies = bodies_of(graph, truth)
    steps = [s for s in _steps(order, scene, graph, truth, config, seed) if s.object_id in bodies]
    height = dict(zip(scene.object_bodies.values(), poses_of(scene)[:, 2], strict=True))
    missed = sorted(set(height) - {bodies[s.object_id] for s in steps}, key=lambda b: -height[b])
    named = bodies | {b: b for b in missed}
    ok = [t.ok for t in dismantle(scene, [*steps, *map(_blind, missed)], named, config)]
    return float(all(ok)), float(np.mean(ok))


def _steps(
    order: OrderName,
    scene: SimulatedScene,
    graph: SupportGraph,
    truth: TrueScene,
    config: Config,
    seed: int,
) -> Sequence[TakeStep]:
    objects = [o for o in graph.objects if o.role == "object"]
    highest = sorted(objects, key=lambda o: (-o.centre_world[2], o.label))
    ids = [o.id for o in highest]
    match order:
        case "one hand" | "two hands" if not objects:
            return ()
        case "one hand" | "two hands":
            return plan_order(graph, config, hands=1 if order == "one hand" else 2, seed=seed).steps
        case "random":
            ids = [objects[k].id for k in np.random.default_rng(seed).permutation(len(objects))]
        case "true graph":
            ids = _by_graph(ids, truth.edges, bodies_of(graph, truth))
    return [_blind(i) for i in ids]


def _by_graph(ids: Sequence[str], edges: frozenset[tuple[str, str]], bodies: Mapping[str, str]) -> list[str]:
    """Ids (the highest first) so that what supports nothing that is left goes first."""
    left, done = list(ids), []
    while left:
        carrying = {i for i in left for k in left if (bodies.get(i), bodies.get(k)) in edges}
        done.append(next((i for i in left if i not in carrying), left[0]))
        left.remove(done[-1])
    return done


def _blind(object_id: str) -> TakeStep:
    """A step that nobody rehearsed."""
    return TakeStep(object_id, (), False, 1.0, "not rehearsed")
