"""Clearing: look, remove one object, look again; and the hands that remove it in a simulated scene."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from caryatid.config import Config, EvaluationConfig
from caryatid.evaluation.scores import TrueScene, score
from caryatid.evaluation.truths import true_scene_from_simulation
from caryatid.exploration import Explorer, Step, used_up
from caryatid.geometry.transforms import Array
from caryatid.graph import SupportGraph, TakeStep
from caryatid.manipulation.order import plan_order
from caryatid.robots.arm import Reachable
from caryatid.simulation.lifting import ASIDE, Lifting
from caryatid.simulation.truth import GroundTruth
from caryatid.simulation.world import SimulatedScene, posed, poses_of

MISSES = 2
"""Number of lifts in a row that remove nothing after which clearing stops [1]: the model is then wrong."""


def clear(
    explorer: Explorer,
    take: Callable[[TakeStep], bool],
    *,
    goal: str | None = None,
    hands: int = 1,
    threads: int = 1,
    reachable: Reachable | None = None,
) -> Iterator[Step]:
    """Look until the next lift is safe, lift, and repeat until no object or no safe lift is left.

    A lift is safe if no other object moves with a probability above `config.rehearsal.risk`, as in
    `plan_order`; with a gripper, it also needs a grasp. It is carried out when no view of what it depends on
    is worth its path. With a goal, this is a view of what removing the goal depends on, because it may show
    that nothing else has to go. A goal that no view shows is uncovered if given labels identify objects: the
    robot then removes what it would remove without a goal. While no lift is safe, it keeps looking. Both end
    after `config.active.max_views` views since the previous lift. After each lift the robot looks again, and
    so detects objects that slid or fell.

    Args:
        explorer: Explorer with a camera and a robot, without a goal.
        take: Removes an object; returns whether it was in place.
        goal: Id or name of the object to reach; None = remove all.
        hands: 2 if another hand can hold one object, else 1.
        threads: Number of parallel rehearsals.
        reachable: Which gripper poses (N, 4, 4), in the world frame, the arm reaches; None = all.

    Yields:
        A step after each view and its lift; `lift` names the removed object, which the graph holds until the
        next view, or not if there is none. The last one again, with `stop`, if the robot can go to no further
        view.

    Raises:
        CaryatidError: A view cannot be used.
    """
    views = missed = 0
    while explorer.step is None or explorer.step.decision is not None:
        if explorer.step is not None and (step := explorer.go()).stop is not None:
            yield step
            return
        explorer.look()
        explorer.finish()
        views += 1
        found = None if goal is None else explorer.scene.graph.find_id(goal) or goal
        lift, reason = _lift(explorer, found, hands, threads, views, reachable)
        if lift is not None:
            views, missed = 0, 0 if take(lift) else missed + 1
            explorer.scene.removed(lift.object_id)
            explorer.goal = goal
            explorer.plan()
            if lift.object_id == found and not missed:
                reason = f"{goal} is removed"
            elif missed == MISSES:
                reason = f"{MISSES} lifts in a row found no object in place"
        assert explorer.step is not None
        step = replace(explorer.step, lift=lift, removal=None)
        if reason is not None:
            # No further view shows what is left.
            last = replace(step, graph=explorer.scene.graph, candidates=None, decision=None, stop=reason)
            step = explorer.conclude_step(last)
        explorer.step = step
        yield step


def _lift(
    explorer: Explorer, goal: str | None, hands: int, threads: int, views: int, reachable: Reachable | None
) -> tuple[TakeStep | None, str | None]:
    """The object to remove now, or None to look again; and why this is the last view, or None."""
    scene = explorer.scene
    ids = [o.id for o in scene.graph.movable]
    if not ids and goal is None:
        return None, "no objects are left"
    lift, missing, found = None, f"{goal} was not found", goal is None or goal in ids
    if found or (ids and scene.identified):
        wanted = goal if found else None  # What hides the goal has to go.
        known: Any = {"goal": wanted, "hands": hands, "seed": scene.seed, "threads": threads}
        order = plan_order(
            scene.graph, scene.config, steps=1, voxels=scene.voxels, reachable=reachable, **known
        )
        lift = next(iter(order.steps), None)
        missing = order.refusal if found else missing
    safe = lift if lift is not None and lift.safe else None
    explorer.goal = None if safe is None or not found else goal or safe.object_id
    step = explorer.plan()
    # While no lift is safe, a view that shows little is worth its path too.
    unsafe = safe is None and (found or lift is not None)
    enough = step.stop if unsafe else explorer.reason_to_stop()
    reason = used_up(views, scene.config.active) or enough
    if reason is None:
        return None, None
    if safe is not None:
        return safe, None
    if lift is not None:
        return None, f"no lift is safe: lifting {lift.object_id} {lift.why}"
    return None, f"{reason}; {missing}"


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
    return {i: body for i, body in found.matches.items() if graph[i].role == "object"}


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
        """Names of the bodies that are still in place."""
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
