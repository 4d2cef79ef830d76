"""A safe removal order: each step is rehearsed in physics before it is chosen.

Extracted shapes are not exactly at rest in physics, and friction and weights are unknown. So a lift is
rehearsed in several scenes, sampled from the shapes' uncertainty, each of which first comes to rest. An
object that does not come to rest, although the real one was at rest, has a wrong shape or an unseen support.
It is held in place, and its supports are taken from the support graph alone. A support surface above an
object, such as a shelf board, is not in the way of its lift: a hand takes the object out sideways.

The risk of a lift is the probability that it disturbs another object in the next scene, such as the real one.
After n scenes with total harm h, rehearsals put it at (h + ½) / (n + 1): the posterior mean with Jeffreys'
prior, Beta(½, ½). The graph is a second witness: by `predict_removal`, an object moves in a share p of m
draws. If that is more, the risk is the mean of both, weighted by n + 1 and m. If it is less, it counts for
nothing, because only rehearsals show what a lift drags along. Scenes are sampled until the risk is low
enough, or can no longer become so. Objects that stand apart are rehearsed apart.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import mujoco
import networkx as nx
import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from caryatid.config import Config
from caryatid.errors import GoalError, InputError, check_type
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Primitives, Shape
from caryatid.geometry.transforms import Array
from caryatid.graph import LIKELY, Grasp, SupportGraph, TakeStep
from caryatid.manipulation.grasps import Blocked, find_grasp
from caryatid.robots.arm import Reachable
from caryatid.runtime import Pictured
from caryatid.sensing.voxel_map import VoxelMap
from caryatid.simulation.lifting import ASIDE, Lift, Lifting
from caryatid.simulation.world import Body, add_body, empty_spec, quaternion, strayed
from caryatid.support.contacts import find_contacts
from caryatid.support.plausibility import drawn, reconcile
from caryatid.support.relations import predict_removal

BATCH = 8
"""Scenes drawn at a time [1]; how many cores there are makes no difference."""

EDGE = 0.005
"""Standard deviation of each edge of a seen support surface [m]: that of the registration of views."""

CROSSINGS = 4
"""Pairs of convex parts up to which two objects that overlap are rehearsed [1]. With 100 in a scene, a step
of the simulation takes 25 ms instead of 0.2 ms, and an order minutes."""


@dataclass(frozen=True, slots=True)
class Order(Pictured):
    """A removal order.

    Attributes:
        steps: The objects to remove, in order.
        refusal: Why no order is safe, and which objects block each other; empty for a safe order.
        risk: Probability that any of the lifts moves another object, from the share of the rehearsals of all
            lifts in which one did [1].
        unchecked: What was not checked; empty if all was.
        gripper: What lifts, as `Gripper.title`; empty if every object counts as graspable.
    """

    steps: tuple[TakeStep, ...]
    refusal: str = ""
    risk: float = 0.0
    unchecked: str = ""
    gripper: str = ""

    @property
    def safe(self) -> bool:
        """Whether every step is safe."""
        return not self.refusal

    def __repr__(self) -> str:
        taken = ", ".join(s.object_id + "".join(f" (hold {i})" for i in s.hold) for s in self.steps)
        return f"Order({taken or 'no lift'}; {self.refusal or 'safe'})"

    def to_json(self) -> dict[str, Any]:
        """The steps, whether they are safe, and why not; `probability` is that of the whole order."""
        notes = {"refusal": self.refusal or None, "unchecked": self.unchecked or None}
        steps = [step.to_json() for step in self.steps]
        return {"steps": steps, "probability": 1.0 - self.risk, "safe": self.safe, **notes}


def plan_order(
    graph: SupportGraph,
    config: Config | None = None,
    *,
    goal: str | None = None,
    hands: int = 1,
    steps: int | None = None,
    seed: int = 0,
    threads: int = 1,
    voxels: VoxelMap | None = None,
    reachable: Reachable | None = None,
) -> Order:
    """Find a safe order in which to remove all objects, or to reach one.

    Greedy: the next object is one whose lift disturbs another with a probability of at most
    `rehearsal.risk`; objects that support nothing come first, and higher ones before lower ones. If no lift
    is safe, the other hand holds the object that would be disturbed most. If that does not help either, the
    least risky lift is chosen, and the order is not safe. With a gripper (`gripper.kind`), only objects that
    it can grasp are lifted; the order ends where there are none.

    Args:
        graph: The extracted graph.
        config: Settings of lifts, rehearsals and the gripper.
        goal: Id or name of the object to reach; only objects in its way are removed.
        hands: 2 if another hand can hold one object, else 1.
        steps: Maximum number of steps; None = all.
        seed: Seed of the rehearsals.
        threads: Number of parallel rehearsals.
        voxels: What was seen empty, for the gripper's path; None = only known shapes are in its way.
        reachable: Which gripper poses (N, 4, 4), in the world frame, the arm reaches; None = all.

    Raises:
        GoalError: The goal is not an object of the graph, or the name of several.
        InputError: The graph has no support surface, no objects, or more than `rehearsal.max_objects`; or
            there are no threads, or hands.
    """
    check_type("graph", graph, SupportGraph, "give a SupportGraph, such as scene.graph")
    if hands not in (1, 2):
        raise InputError("hands", f"{hands} is neither 1 nor 2", "give the number of hands")
    if threads < 1:
        raise InputError("threads", f"{threads} is less than 1", "give the number of parallel rehearsals")
    named, goal = goal, None if goal is None else graph.find_id(goal)
    config = config or Config()
    rehearsal = _Rehearsal(graph, config, seed, threads, voxels, reachable)
    if named is not None and goal not in rehearsal.ids:
        raise GoalError(named, "is not an object of the graph", graph.suggest_objects(named))
    found: list[TakeStep] = []
    refusal = ""
    while len(found) != steps and (left := rehearsal.left()) and (goal is None or goal in left):
        wanted = _in_turn(rehearsal) if goal is None else _on_the_way(goal, rehearsal)
        trial, tried = _safest(rehearsal, wanted, hands)
        if trial is None:
            done = f"{len(found)} of {len(rehearsal.ids)} objects can be removed"
            known = [done] if goal is None else []
            refusal = refusal or "; ".join([*known, *_out_of_grasp(rehearsal, wanted)])
            break
        if trial.risk > rehearsal.accepted and not refusal:
            refusal = "; ".join([_refusal(trial, tried), *_out_of_grasp(rehearsal, wanted)])
        found.append(_step(rehearsal, trial, left))
        rehearsal.take(trial)
    gripper, unchecked = config.gripper.title, list[str]()
    if not gripper:
        unchecked.append("whether a gripper can grasp the objects, because none is given")
    elif voxels is None:
        unchecked.append("whether the gripper's path was seen to be free, because no view is kept")
    if gripper and any(step.hold for step in found):
        unchecked.append("whether the other hand can grasp what it holds")
    return Order(tuple(found), refusal, rehearsal.risk, "; ".join(unchecked), gripper)


def _in_turn(rehearsal: _Rehearsal) -> list[str]:
    """The remaining objects: those that support nothing come first.

    Among these, the ones that do not stand in rehearsals come first, because any touch may topple them, and
    then the highest.
    """
    left, graph, unstable = rehearsal.left(), rehearsal.graph, rehearsal.unstable
    carrying = {s.supporter for s in graph.supports if s.supported in left}
    height = {o.id: float(o.centre_world[2]) for o in graph.objects}
    return sorted(left, key=lambda i: (i in carrying, -unstable[i], -height[i], i))


def _on_the_way(goal: str, rehearsal: _Rehearsal) -> list[str]:
    """The goal if it can be lifted; otherwise what obstructs or loses by it, and so on, the nearest first."""
    found = [goal]
    for object_id in found:
        grasp = rehearsal.grasp(object_id)
        if isinstance(grasp, Blocked):
            found += [i for i in grasp.by if i in rehearsal.ids and i not in found]
            continue
        trial = rehearsal.try_lift(object_id)
        if trial.risk <= rehearsal.accepted:
            return [object_id]
        found += [i for i in _in_turn(rehearsal) if i in trial.harmed and i not in found]
    return found


def _safest(rehearsal: _Rehearsal, wanted: Sequence[str], hands: int) -> tuple[_Trial | None, list[_Trial]]:
    """The first safe lift, with one hand before two, or else the least risky; and those tried before.

    What the graph alone says is not safe is only rehearsed where it may be the least risky. None if no
    object can be grasped.
    """
    tried: list[_Trial] = []
    for object_id in wanted:
        if isinstance(rehearsal.grasp(object_id), Blocked):
            continue
        trial = rehearsal.try_lift(object_id, bounded=True)
        if trial.risk <= rehearsal.accepted:
            return trial, tried
        tried.append(trial)
    if not tried:
        return None, tried
    while not (best := min(tried, key=lambda t: (t.risk, len(t.harmed)))).rehearsed:
        tried[tried.index(best)] = rehearsal.try_lift(best.object_id)
    tried.sort(key=lambda t: (t.risk, len(t.harmed)))
    # The other hand holds one of those that were disturbed, the most often first.
    holds = ((t.object_id, held) for t in tried for held in sorted(t.harmed, key=lambda i: (-t.harmed[i], i)))
    for object_id, held in holds if hands > 1 else ():
        trial = rehearsal.try_lift(object_id, [held], bounded=True)
        if trial.risk < best.risk and (trial := rehearsal.try_lift(object_id, [held])).risk < best.risk:
            best = trial
        if best.risk <= rehearsal.accepted:
            break
    return best, tried


def _step(rehearsal: _Rehearsal, trial: _Trial, left: Sequence[str]) -> TakeStep:
    with_hold = f" with {', '.join(trial.hold)} held" if trial.hold else ""
    worst = ", ".join(f"{i} with probability {share:.2f}" for i, share in trial.disturbed.items())
    why = f"disturbed {worst or 'nothing'} in {len(trial.harm)} rehearsals{with_hold}"
    if trial.moved:
        moved = ", ".join(f"{i} with probability {share:.2f}" for i, share in trial.moved.items())
        why += f"; by the graph, it moves {moved}"
    for s in rehearsal.graph.supports:
        if s.supporter == trial.object_id and s.supported in left:
            stays = s.supported not in trial.hold and trial.harmed.get(s.supported, 0.0) < LIKELY
            known = f" with probability {s.belief:.2f}, but it stays in place" if stays else ""
            why += f"; supports {s.supported}{known}"
    grasp, safe = rehearsal.grasp(trial.object_id), trial.risk <= rehearsal.accepted
    assert not isinstance(grasp, Blocked)
    if grasp is not None:
        lean = np.degrees(np.arccos(np.clip(-grasp.T_world_gripper[2, 2], -1.0, 1.0)))
        across = f" across {1e3 * grasp.width:.0f} mm" if grasp.width else ""
        why += f"; the gripper grasps it{across}, {lean:.0f}° from straight down"
    return TakeStep(trial.object_id, trial.hold, safe, trial.risk, why, grasp)


def _out_of_grasp(rehearsal: _Rehearsal, wanted: Sequence[str]) -> list[str]:
    """Say which objects the gripper cannot grasp, and why, one sentence for each reason."""
    reasons: dict[str, list[str]] = {}
    for object_id in wanted:
        if isinstance(grasp := rehearsal.grasp(object_id), Blocked):
            reasons.setdefault(grasp.why, []).append(object_id)
    return [f"{', '.join(ids)} cannot be grasped: {why}" for why, ids in reasons.items()]


def _refusal(trial: _Trial, tried: Sequence[_Trial]) -> str:
    """Say which objects block each other."""
    blocked = nx.DiGraph((t.object_id, i) for t in tried for i in t.harmed)
    try:
        edges = nx.find_cycle(blocked, trial.object_id)
    except nx.NetworkXNoCycle:
        harm = ", ".join(trial.harmed) or "nothing, but rehearsal.draws is too small to show this risk"
        return f"no safe order: lifting {trial.object_id} disturbs {harm}"
    cycle = ", ".join(f"lifting {a} disturbs {b}" for a, b in edges)
    return f"no safe order: {cycle}"


@dataclass(frozen=True, eq=False, slots=True)
class _Trial:
    """A rehearsed lift.

    Attributes:
        object_id: What is lifted.
        hold: What is held.
        harm: Probability (n,) that each rehearsal disturbed another object.
        doubt: Probability that an object moves by the graph.
        risk: Probability that the next lift disturbs another object; at least that, before rehearsals.
        disturbed: Share of the rehearsals that disturbed each object, by id.
        moved: Probability that each object moves by the graph, by id.
    """

    object_id: str
    hold: tuple[str, ...]
    harm: Array
    doubt: float
    risk: float
    disturbed: dict[str, float]
    moved: dict[str, float]

    @property
    def rehearsed(self) -> bool:
        """Whether it was rehearsed: without, the risk is what the graph says at least."""
        return len(self.harm) > 0

    @property
    def harmed(self) -> dict[str, float]:
        """Probability that each object moves, by id, by the witness that says more."""
        ids = dict.fromkeys([*self.disturbed, *self.moved])
        return {i: max(self.disturbed.get(i, 0.0), self.moved.get(i, 0.0)) for i in ids}


class _Rehearsal:
    """Scenes in which to try lifts, drawn when they are needed."""

    def __init__(
        self,
        graph: SupportGraph,
        config: Config,
        seed: int,
        threads: int,
        voxels: VoxelMap | None,
        reachable: Reachable | None,
    ) -> None:
        if graph.support_surface is None:
            raise InputError("graph", "has no support surface", "give a graph with a table")
        self.ids = tuple(o.id for o in graph.movable)
        if not self.ids:
            raise InputError("graph", "has no objects to remove", "give a graph with objects")
        # Objects whose bounds, seen from above, are nearer than this gap form a group: a lift that moves no
        # object by more than half the gap has no effect on another group.
        gap = 2.0 * config.lift.moved
        shapes = [graph[i].shape for i in self.ids]
        low, high = (side[:, :2] for side in Primitives.of(shapes).bounds())
        near = ((low[:, None] <= high + gap) & (low <= high[:, None] + gap)).all(axis=-1)
        near &= ~_levels(shapes, [o.shape for o in graph.support_surfaces])[1]
        self._groups: NDArray[np.int32] = np.asarray(connected_components(near, directed=False)[1])
        largest = int(np.bincount(self._groups).max())
        if largest > config.rehearsal.max_objects:
            reserved = 0.6 * (largest / 300) ** 1.7  # two arenas [GB], measured with 300 and 1,000
            reason = (
                f"has {largest} objects close together, for which MuJoCo reserves "
                f"about {reserved:.1f} GB per thread"
            )
            raise InputError("graph", reason, "raise rehearsal.max_objects, or give a part of the scene")
        self.graph, self._config, self._seed, self._threads = graph, config, seed, threads
        self.accepted = config.rehearsal.risk
        self._bodies: list[tuple[list[Box], dict[str, Body]]] = []
        self._scenes: dict[int, list[_DrawnScene]] = {group: [] for group in self._groups.tolist()}
        self._trials: dict[tuple[str, ...], _Trial] = {}
        self._taken: list[_Trial] = []
        self._voxels, self._reachable = voxels, reachable
        self._grasps: dict[str, Grasp | Blocked] = {}

    def left(self) -> list[str]:
        """Ids of the objects that have not been removed yet."""
        taken = {trial.object_id for trial in self._taken}
        return [i for i in self.ids if i not in taken]

    @property
    def risk(self) -> float:
        """Probability that any lift so far does harm, from the scenes in which all were rehearsed."""
        if not self._taken:
            return 0.0
        fewest = min(len(trial.harm) for trial in self._taken)
        harm = 1.0 - np.prod([1.0 - trial.harm[:fewest] for trial in self._taken], axis=0)
        return self._risk(harm, 1.0 - float(np.prod([1.0 - trial.doubt for trial in self._taken])))

    def _risk(self, harm: Array, moves: float) -> float:
        """Probability of harm, from that in each of some rehearsals (n,) and that by the graph."""
        rehearsed, draws = float(harm.sum() + 0.5) / (len(harm) + 1.0), self._config.support.draws
        return rehearsed + draws * max(moves - rehearsed, 0.0) / (len(harm) + draws + 1.0)

    @cached_property
    def unstable(self) -> dict[str, float]:
        """Shares of the first scenes in which each object does not stay in place, by id."""
        unstable: dict[str, float] = {}
        for group in self._scenes:
            found = self._each(group, lambda scene: scene.unstable, slice(0, BATCH))
            unstable |= zip(self._near(group), np.mean(found, axis=0).tolist(), strict=True)
        return unstable

    def try_lift(self, object_id: str, hold: Collection[str] = (), *, bounded: bool = False) -> _Trial:
        """Lift an object while others are held, in as many scenes as needed; cached, and nothing changes.

        If bounded, a lift that is not safe by the graph alone is not rehearsed.
        """
        asked = (object_id, *sorted(hold))
        known = self._trials.get(asked)
        if known is None or not (known.rehearsed or bounded):
            self._trials[asked] = self._tried(object_id, tuple(hold), bounded)
        return self._trials[asked]

    def grasp(self, object_id: str) -> Grasp | Blocked | None:
        """How the gripper takes hold of a remaining object, or why it cannot; None without a gripper."""
        if self._config.gripper.kind == "none":
            return None
        if object_id not in self._grasps:
            gone = {trial.object_id for trial in self._taken} | {object_id}
            others = {o.id: o.shape for o in self.graph.objects if o.id not in gone}
            gripper, friction = self._config.gripper, self._config.support.friction[0]
            removed = [self.graph[trial.object_id].shape for trial in self._taken]
            known: Any = {"voxels": self._voxels, "removed": removed, "reachable": self._reachable}
            shape = self.graph[object_id].shape
            self._grasps[object_id] = find_grasp(shape, others, gripper, friction, **known)
        return self._grasps[object_id]

    def _tried(self, object_id: str, hold: tuple[str, ...], bounded: bool) -> _Trial:
        # An object held in a scene because it does not stay there moves if it loses a support.
        free = set(self.left()) - set(hold)
        group = self._group_of(object_id)
        ids = self._near(group)
        supports = [self.graph.support(object_id, i) if i in free else None for i in ids]
        loses = np.array([0.0 if s is None else s.belief for s in supports])
        left = set(self.left()) & set(ids)
        objects = tuple(o for o in self.graph.objects if o.id in left or o.role == "support_surface")
        kept = {o.id for o in objects}
        part = SupportGraph(objects, tuple(s for s in self.graph.supports if {*s.pair} <= kept))
        effects = predict_removal(part, object_id, self._config.support)
        moved = {e.object_id: e.probability for e in effects if e.object_id in free}
        doubt = max(moved.values(), default=0.0)  # What falls, falls together.
        accepted, most = self.accepted, self._config.rehearsal.draws
        found, harm = list[Array](), np.zeros(0)
        risk = least = self._risk(np.zeros(most), doubt)
        cannot_be_safe = bounded and least > accepted
        while not (found or cannot_be_safe) or (len(found) < most and risk > accepted >= least):
            scenes = slice(len(found), len(found) + BATCH)
            found += self._each(
                group, lambda s: np.maximum(s.lift(object_id, hold).disturbed, s.unstable * loses), scenes
            )
            harm = 1.0 - np.prod(1.0 - np.array(found), axis=1)
            risk = self._risk(harm, doubt)
            least = self._risk(np.concatenate([harm, np.zeros(most - len(harm))]), doubt)
        shares = zip(ids, np.mean(found, axis=0).tolist() if found else [0.0] * len(ids), strict=True)
        disturbed = {i: share for i, share in shares if share > 0.0}
        return _Trial(object_id, hold, harm, doubt, risk, disturbed, moved)

    def take(self, trial: _Trial) -> None:
        """Continue without an object whose lift was tried; others that moved are put back."""
        group = self._group_of(trial.object_id)
        scenes = slice(0, len(self._scenes[group]))
        self._each(group, lambda scene: scene.take(trial.object_id, trial.hold), scenes)
        self._taken.append(trial)
        self._trials = {k: known for k, known in self._trials.items() if self._group_of(k[0]) != group}
        self._grasps.clear()

    def _group_of(self, object_id: str) -> int:
        return int(self._groups[self.ids.index(object_id)])

    def _near(self, group: int) -> list[str]:
        """Ids of a group, removed objects too."""
        return [self.ids[k] for k in np.flatnonzero(self._groups == group)]

    def _draw(self, group: int, number: int) -> _DrawnScene:
        near = self._near(group)
        surfaces, bodies = self._bodies[number]
        scene = _DrawnScene(surfaces, {i: bodies[i] for i in near}, self._config)
        for trial in self._taken:
            if trial.object_id in near:
                scene.take(trial.object_id, trial.hold)
        return scene

    def _each(self, group: int, do: Callable[[_DrawnScene], Any], numbers: slice) -> list[Any]:
        """Do something in these scenes of a group, in order; those that are missing are drawn."""
        drawn = self._scenes[group]
        for number in range(len(self._bodies), min(numbers.stop, self._config.rehearsal.draws)):
            rng = np.random.default_rng([self._seed, number])
            self._bodies.append(_drawn_bodies(self.graph, number, self._config, rng))
        missing = range(len(drawn), min(numbers.stop, self._config.rehearsal.draws))
        pool = ThreadPoolExecutor(self._threads)
        try:
            drawn += pool.map(partial(self._draw, group), missing)
            return list(pool.map(do, drawn[numbers]))
        finally:  # `with` would make Ctrl-C wait for the rehearsals
            pool.shutdown(wait=False, cancel_futures=True)


class _DrawnScene:
    """The support surfaces and a group of bodies at rest, and what is left of them.

    Bodies that move too far before they rest are put back and held, until no others do. They are watched for
    as long as the highest lift takes, so that no lift is blamed for what moves by itself. Two that are
    entangled are held from the start and do not touch. Lifting one is taken to disturb the other if they
    still are when it is so much higher that it counts as moved.
    """

    def __init__(self, surfaces: Sequence[Box], bodies: Mapping[str, Body], config: Config) -> None:
        self._ids, self._config = list(bodies), config.lift
        spec = empty_spec("rehearsal")
        # Twice MuJoCo's default time step, which the implicit integrator allows, for half the time.
        spec.option.timestep = 0.004
        names = [str(number) for number in range(len(bodies))]  # MuJoCo does not allow every id as a name
        tops = [f"surface {number}" for number in range(len(surfaces))]
        # A surface is as large as it was seen: what is beyond its edge falls. It is slippery: contacts use
        # the larger friction of two, and it must not hide how slippery objects are.
        for name, surface in zip(tops, surfaces, strict=True):
            T, half, slippery = surface.T_world_object, surface.extents / 2.0, [0.1, 0.005, 0.001]
            top = spec.worldbody.add_body(name=name, pos=T[:3, 3], quat=quaternion(T[:3, :3]))
            top.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=half, friction=slippery)
        for name, body in zip(names, bodies.values(), strict=True):
            add_body(spec, name, body)
        shapes, touch = [body.shape for body in bodies.values()], config.plausibility.touch
        under, apart = _levels(shapes, surfaces)
        self.unstable = np.zeros(len(bodies), dtype=np.bool_)
        self._caught = np.zeros((len(bodies), len(bodies)), dtype=np.bool_)
        up = transforms.rigid(np.eye(3), (0.0, 0.0, self._config.moved))
        for a, b in _entangled(shapes, touch):
            apart[a, b] = self.unstable[a] = self.unstable[b] = True
            for lifted, other in ((a, b), (b, a)):
                pair = [shapes[lifted].moved(up), shapes[other]]
                self._caught[lifted, other] = bool(_entangled(pair, touch))
        under |= self.unstable[:, None]  # Held, they need no surface.
        for first, others, pairs in ((names, tops, under), (names, names, np.triu(apart))):
            for a, b in np.argwhere(pairs):
                spec.add_exclude(bodyname1=first[a], bodyname2=others[b])
        more = sum(len(shape.parts) for shape in shapes) - len(shapes)
        if more > 16:
            # MuJoCo reserves too little for solids of many parts, and then drops contacts or fails. A part
            # has up to 8 contacts of 6 numbers, and the no-slip solver stores a square matrix of all [B].
            spec.memory = spec.compile().narena + 8 * (48 * more) ** 2
        self._lifting, limits = Lifting(spec, names), self._config
        seen, seconds = self._lifting.start, self._lifting.longest(self._lifting.start, limits)
        # One alone can disturb nothing.
        state, moved = seen, np.full(len(bodies), len(bodies) > 1)
        while moved.any():
            state = self._lifting.rest(seen, np.flatnonzero(self.unstable).tolist(), seconds, limits)
            moved = strayed(seen, state, limits.moved, limits.turned) & ~self.unstable
            self.unstable |= moved
        self._state = np.where(self.unstable[:, None], seen, state)
        self._lifts: dict[tuple[str, ...], Lift] = {}

    def lift(self, object_id: str, hold: Sequence[str]) -> Lift:
        """Lift an object while others are held, and those that do not stay in place; cached.

        The film has the final state only.
        """
        if (object_id, *hold) not in self._lifts:
            index = self._ids.index(object_id)
            caught = self._caught[index] & (self._state[:, 2] < ASIDE / 2.0)
            held = {self._ids.index(i) for i in hold} | ({*np.flatnonzero(self.unstable).tolist()} - {index})
            lift = Lift(caught, self._state[None])
            if not caught.any():
                lift = self._lifting.lift(self._state, index, self._config, held=held, to_the_end=False)
            self._lifts[object_id, *hold] = Lift(lift.disturbed, lift.film[-1:].copy())
        return self._lifts[object_id, *hold]

    def take(self, object_id: str, hold: Sequence[str]) -> None:
        """Continue without an object; others that moved are put back."""
        lift, index = self.lift(object_id, hold), self._ids.index(object_id)
        stays = self.unstable | lift.disturbed.any()
        self._state = np.where(stays[:, None], self._state, lift.film[-1])
        self._state[index, :3] = 0.0, 0.0, ASIDE + index
        self._lifts.clear()


def _drawn_bodies(
    graph: SupportGraph, number: int, config: Config, rng: np.random.Generator
) -> tuple[list[Box], dict[str, Body]]:
    """Support surfaces, and bodies of the extracted shapes or, for a number above 0, of others as likely."""
    objects = list(graph.objects)
    if number > 0:
        objects = [drawn(o, rng, config.plausibility) for o in objects]
        objects = reconcile(objects, config.plausibility)
    settings = config.support
    frictions = rng.uniform(*settings.friction, len(objects))
    densities = rng.uniform(*settings.density, len(objects))
    if number == 0:
        frictions[:], densities[:] = np.mean(settings.friction), np.mean(settings.density)
    surfaces = [
        _with_edges(o.shape, rng.normal(0.0, EDGE, (2, 3)) * (number > 0)) for o in graph.support_surfaces
    ]
    made = zip(objects, densities, frictions, strict=True)
    return surfaces, {o.id: Body(o.shape, density, friction) for o, density, friction in made}


def _with_edges(surface: Shape, edges: Array) -> Box:
    """A support surface whose two sides along each axis move out (2, 3) [m]; its top stays."""
    T = surface.T_world_object
    edges[:, np.argmax(np.abs(T[2, :3]))] = 0.0
    shift = transforms.rigid(np.eye(3), (edges[1] - edges[0]) / 2.0)
    return Box(T @ shift, np.maximum(surface.extents + edges.sum(axis=0), EDGE))


def _entangled(shapes: Sequence[Shape], touch: float) -> list[tuple[int, int]]:
    """Find the pairs of shapes that overlap by more than a distance [m] in more than `CROSSINGS` parts."""
    overlaps = Counter((c.a, c.b) for c in find_contacts(shapes, 0.0) if c.distance < -touch)
    return [pair for pair, count in overlaps.items() if count > CROSSINGS]


def _levels(
    shapes: Sequence[Shape], surfaces: Sequence[Shape]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which shapes are under which surfaces (N, M), and which two have a surface between them (N, N).

    How thick a surface is was not seen. What is higher than the middle of its box is not under it.
    """
    low, high = Primitives.of(shapes).bounds()
    start, end = Primitives.of(surfaces).bounds()
    across = ((low[:, None, :2] < end[:, :2]) & (start[:, :2] < high[:, None, :2])).all(axis=-1)
    middle = (start + end)[:, 2] / 2.0
    under, over = across & (high[:, None, 2] < middle), low[:, None, 2] > middle
    apart = np.any(under[:, None] & over, axis=2)
    return under, np.asarray(apart | apart.T)
