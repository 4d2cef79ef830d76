"""Removal in a simulated scene: what was lifted, and what it disturbed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from caryatid.config import Config, EvaluationConfig
from caryatid.evaluation.scores import TrueScene, score
from caryatid.evaluation.truths import true_scene_from_simulation
from caryatid.geometry.transforms import Array
from caryatid.graph import SupportGraph, TakeStep
from caryatid.simulation.lifting import ASIDE, Lifting
from caryatid.simulation.truth import GroundTruth
from caryatid.simulation.world import SimulatedScene, posed, poses_of


@dataclass(frozen=True, eq=False, slots=True)
class Taken:
    """Outcome of one step of an order.

    Attributes:
        step: The step of the order.
        body: Name of the lifted body; None if no body matches the extracted object.
        held: Names of the bodies held during the lift.
        disturbed: Names of the bodies that moved or turned beyond the limits.
        film: States (T, N, 7) of the scene's objects during the lift; empty if nothing was lifted.
        bodies: Body that each extracted object represented, by id.
    """

    step: TakeStep
    body: str | None
    held: tuple[str, ...]
    disturbed: tuple[str, ...]
    film: Array
    bodies: Mapping[str, str]

    @property
    def ok(self) -> bool:
        """Whether no object was disturbed."""
        return not self.disturbed

    def to_json(self) -> dict[str, Any]:
        """One entry of `steps` in the output of `--json`."""
        done = {"body": self.body, "held": list(self.held), "ok": self.ok, "disturbed": list(self.disturbed)}
        return self.step.to_json() | done


def bodies_of(graph: SupportGraph, truth: TrueScene) -> dict[str, str]:
    """Body that each extracted object represents, by id: the one that a hand would grasp.

    It is the one it overlaps most; an object with an overlap below 0.01 (IoU) represents none.
    """
    found = score(graph, truth, np.random.default_rng(0), replace(EvaluationConfig(), min_iou=0.01))
    table = graph.support_surface
    return {i: body for i, body in found.matches.items() if table is None or i != table.id}


class SimulatedHands:
    """Hands that remove objects in physics, one after the other.

    Args:
        scene: The scene in physics; it is not changed.
        config: Settings of lifts, and limits beyond which an object was disturbed.

    Attributes:
        names: Names (N) of the scene's objects.
        state: Current state (N, 7) of the scene's objects; removed ones are far above.
    """

    def __init__(self, scene: SimulatedScene, config: Config) -> None:
        self._scene, self._config = scene, config
        self.names = list(scene.object_bodies.values())
        self._lifting = Lifting(scene.spec, self.names)
        self.state = poses_of(scene)

    @property
    def scene(self) -> SimulatedScene:
        """The scene in its current state."""
        return posed(self._scene, self.state)

    @property
    def left(self) -> list[str]:
        """Names of the bodies that are still on the table."""
        return [n for n, z in zip(self.names, self.state[:, 2], strict=True) if z < ASIDE / 2.0]

    def bodies(self, graph: SupportGraph) -> dict[str, str]:
        """Body that each extracted object represents now, as `bodies_of`."""
        return bodies_of(graph, true_scene_from_simulation(self.scene, GroundTruth(tuple(self.left), ())))

    def take(self, step: TakeStep, bodies: Mapping[str, str]) -> Taken:
        """Carry out a step, even if it disturbs others; extracted objects represent these bodies, by id."""
        body, left = bodies.get(step.object_id), self.left
        held = tuple(bodies[i] for i in step.hold if bodies.get(i) in left)
        if body not in left:
            return Taken(step, None, held, (), np.zeros((0, len(self.names), 7)), bodies)
        index, also = self.names.index(body), [self.names.index(h) for h in held]
        lift = self._lifting.lift(self.state, index, self._config.lift, held=also)
        self.state = lift.film[-1]
        disturbed = tuple(np.array(self.names)[lift.disturbed].tolist())
        return Taken(step, body, held, disturbed, lift.film, bodies)
