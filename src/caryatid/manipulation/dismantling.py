"""An order tried out in a simulated scene: what was lifted, and what it did to the rest."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from caryatid.config import Config, EvaluationConfig
from caryatid.evaluation.scores import TrueScene, score
from caryatid.geometry.transforms import Array
from caryatid.graph import SupportGraph
from caryatid.manipulation.order import Order, TakeStep
from caryatid.simulation.lifting import Lifting
from caryatid.simulation.world import SimulatedScene, poses_of


@dataclass(frozen=True, eq=False, slots=True)
class Taken:
    """One step of an order, done.

    Attributes:
        step: What was asked for.
        body: Name of the body that was lifted; None where there is none at the extracted object's place.
        held: Names of the bodies that were held meanwhile.
        disturbed: Names of the bodies that were moved or turned beyond the limits.
        film: States (T, N, 7) of the scene's objects on the way; empty where nothing was lifted.
    """

    step: TakeStep
    body: str | None
    held: tuple[str, ...]
    disturbed: tuple[str, ...]
    film: Array

    @property
    def ok(self) -> bool:
        """Nothing was disturbed."""
        return not self.disturbed

    def to_json(self) -> dict[str, Any]:
        """One entry of `steps` in what `--json` writes."""
        done = {"body": self.body, "held": list(self.held), "ok": self.ok, "disturbed": list(self.disturbed)}
        return self.step.to_json() | done


def bodies_of(graph: SupportGraph, truth: TrueScene) -> dict[str, str]:
    """Body each extracted object stands for, by id: what a hand that reaches for it would take hold of.

    It is the one it overlaps most; one that overlaps by less than 0.01 (IoU) stands for none.
    """
    found = score(graph, truth, np.random.default_rng(0), replace(EvaluationConfig(), min_iou=0.01))
    table = graph.support_surface
    return {i: body for i, body in found.matches.items() if table is None or i != table.id}


def dismantle(
    scene: SimulatedScene, steps: Sequence[TakeStep], bodies: Mapping[str, str], config: Config
) -> Iterator[Taken]:
    """Do the steps of an order one after the other, whatever comes of them.

    Args:
        scene: The scene in physics; it is not changed.
        steps: What to take.
        bodies: Body each extracted object stands for, by id.
        config: How objects are lifted, and what counts as harm.

    Yields:
        What came of each step.
    """
    names = list(scene.object_bodies.values())
    lifting = Lifting(scene.spec, names)
    state = poses_of(scene)
    gone: set[str] = set()
    for step in steps:
        body = bodies.get(step.object_id)
        held = tuple(bodies[i] for i in step.hold if i in bodies and bodies[i] not in gone)
        if body is None or body in gone:
            yield Taken(step, None, held, (), np.zeros((0, len(names), 7)))
            continue
        lift = lifting.lift(state, names.index(body), config.lift, held=[names.index(h) for h in held])
        state = lift.film[-1]
        gone.add(body)
        yield Taken(step, body, held, tuple(names[k] for k in np.flatnonzero(lift.disturbed)), lift.film)


def dismantling_record(order: Order, taken: Sequence[Taken], left: Sequence[str]) -> dict[str, Any]:
    """What came of an order whose steps were done; `left` names the bodies that nobody took."""
    success = not left and all(t.ok for t in taken)
    return {"success": success, **order.to_json(), "steps": [t.to_json() for t in taken], "left": list(left)}
