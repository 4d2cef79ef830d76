"""A safe order of removal: each step is rehearsed in physics before it is chosen.

Extracted shapes are not exactly at rest in physics, and friction and weights are unknown. So a lift is
rehearsed in several scenes, drawn from the shapes' uncertainty, each of which first comes to rest. An object
that does not, although the real one was seen at rest, has a wrong shape or rests on something unseen. It is
held there, and the support graph alone says what it needs.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import mujoco
import networkx as nx
import numpy as np
from numpy.typing import NDArray

from caryatid.config import Config, RehearsalConfig
from caryatid.errors import InputError
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject, SupportGraph, TakeStep
from caryatid.runtime.display import Pictured
from caryatid.simulation.lifting import ASIDE, Lift, Lifting
from caryatid.simulation.world import TABLE, Body, add_body, empty_spec, quaternion, strayed
from caryatid.support.plausibility import drawn, reconcile


@dataclass(frozen=True, slots=True)
class Order(Pictured):
    """An order of removal.

    Attributes:
        steps: The objects to remove, one after the other.
        refusal: Why there is no safe order, and which objects block each other; empty if there is one.
    """

    steps: tuple[TakeStep, ...]
    refusal: str = ""

    @property
    def safe(self) -> bool:
        """Whether every step is safe."""
        return not self.refusal

    def __repr__(self) -> str:
        taken = ", ".join(s.object_id + "".join(f" (hold {i})" for i in s.hold) for s in self.steps)
        return f"Order({taken}; {self.refusal or 'safe'})"

    def to_json(self) -> dict[str, Any]:
        """Its steps, whether it is safe, and why not."""
        steps = [step.to_json() for step in self.steps]
        return {"steps": steps, "safe": self.safe, "refusal": self.refusal or None}


def plan_order(
    graph: SupportGraph,
    config: Config | None = None,
    *,
    goal: str | None = None,
    hands: int = 2,
    seed: int = 0,
    threads: int = 1,
) -> Order:
    """Find a safe order in which to remove everything, or to reach one object.

    Greedy: the next object is one whose lift disturbs another one with a probability of at most
    `rehearsal.risk`; objects that support nothing come first, and higher ones before lower ones. If there is
    none, the other hand holds the object that would be disturbed most. If that does not help either, the
    least risky lift is chosen, and the order is not safe.

    Args:
        graph: The extracted graph.
        config: How lifts go, and how they are rehearsed.
        goal: Id of the object to reach; only objects that must go first are removed.
        hands: 2 if another hand can hold one object, else 1.
        seed: Seed of the rehearsals.
        threads: Number of rehearsals at a time.

    Raises:
        InputError: There is no support surface, no object, more than `rehearsal.max_objects` of them, or no
            such goal.
    """
    config = config or Config()
    rehearsal = _rehearsal(graph, config, goal, seed, threads)
    steps: list[TakeStep] = []
    refusal = ""
    while (left := rehearsal.left()) and (goal is None or goal in left):
        trial, tried = _next(graph, goal, hands, rehearsal)
        if trial.risk > rehearsal.accepted and not refusal:
            refusal = _refusal(trial, tried)
        steps.append(_step(graph, trial, left, config.rehearsal))
        rehearsal.take(trial)
    return Order(tuple(steps), refusal)


def next_lift(
    graph: SupportGraph,
    config: Config | None = None,
    *,
    goal: str | None = None,
    hands: int = 2,
    seed: int = 0,
    threads: int = 1,
) -> TakeStep:
    """Find the first step of an order; arguments and errors are those of `plan_order`."""
    config = config or Config()
    rehearsal = _rehearsal(graph, config, goal, seed, threads)
    trial, _ = _next(graph, goal, hands, rehearsal)
    return _step(graph, trial, rehearsal.left(), config.rehearsal)


def _rehearsal(graph: SupportGraph, config: Config, goal: str | None, seed: int, threads: int) -> _Rehearsal:
    rehearsal = _Rehearsal(graph, config, np.random.default_rng(seed), threads=threads)
    if goal is not None and goal not in rehearsal.ids:
        raise InputError(goal, "is not an object of the graph", f"there are {', '.join(rehearsal.ids)}")
    return rehearsal


def _next(
    graph: SupportGraph, goal: str | None, hands: int, rehearsal: _Rehearsal
) -> tuple[_Trial, list[_Trial]]:
    """The next lift, and those tried before it."""
    left = rehearsal.left()
    wanted = _in_turn(graph, left) if goal is None else _on_the_way(graph, goal, left, rehearsal)
    return _safest(rehearsal, wanted, hands)


def _in_turn(graph: SupportGraph, left: Sequence[str]) -> list[str]:
    """The remaining objects; those that support nothing come first, the highest of them foremost."""
    carrying = {s.supporter for s in graph.supports if s.supported in left}
    height = {o.id: float(o.centre_world[2]) for o in graph.objects}
    return sorted(left, key=lambda i: (i in carrying, -height[i], i))


def _on_the_way(graph: SupportGraph, goal: str, left: Sequence[str], rehearsal: _Rehearsal) -> list[str]:
    """The goal if it can be lifted; otherwise the objects its lift disturbs, and so on, the nearest first."""
    found = [goal]
    for object_id in found:
        trial = rehearsal.try_lift(object_id)
        if trial.risk <= rehearsal.accepted:
            return [object_id]
        found += [i for i in _in_turn(graph, left) if i in trial.harmed and i not in found]
    return found


def _safest(rehearsal: _Rehearsal, wanted: Sequence[str], hands: int) -> tuple[_Trial, list[_Trial]]:
    """The first safe lift, with one hand before two, or else the least risky; and those tried before."""
    tried: list[_Trial] = []
    for object_id in wanted:
        trial = rehearsal.try_lift(object_id)
        if trial.risk <= rehearsal.accepted:
            return trial, tried
        tried.append(trial)
    tried.sort(key=lambda t: (t.risk, len(t.harmed)))
    best = tried[0]
    # The other hand holds one of those that were disturbed, the most often first.
    holds = ((t.object_id, held) for t in tried for held in sorted(t.harmed, key=lambda i: (-t.harmed[i], i)))
    for object_id, held in holds if hands > 1 else ():
        trial = rehearsal.try_lift(object_id, [held])
        if trial.risk < best.risk:
            best = trial
        if best.risk <= rehearsal.accepted:
            break
    return best, tried


def _step(graph: SupportGraph, trial: _Trial, left: Sequence[str], config: RehearsalConfig) -> TakeStep:
    carried = [s.supported for s in graph.supports if s.supporter == trial.object_id and s.supported in left]
    what = f"supports {', '.join(carried)}" if carried else "supports nothing that is left"
    with_hold = f" while {', '.join(trial.hold)} is held" if trial.hold else ""
    worst = ", ".join(f"{i} with probability {share:.2f}" for i, share in trial.harmed.items())
    why = f"it {what}; lifting it{with_hold} disturbed {worst or 'nothing'} in {config.draws} rehearsals"
    return TakeStep(trial.object_id, trial.hold, trial.risk <= config.risk, trial.risk, why)


def _refusal(trial: _Trial, tried: Sequence[_Trial]) -> str:
    """Say which objects block each other."""
    blocked = nx.DiGraph((t.object_id, i) for t in tried for i in t.harmed)
    try:
        edges = nx.find_cycle(blocked, trial.object_id)
    except nx.NetworkXNoCycle:
        return f"no safe order: lifting {trial.object_id} disturbs {', '.join(trial.harmed)}"
    cycle = ", ".join(f"lifting {a} disturbs {b}" for a, b in edges)
    return f"no safe order: {cycle}; whichever goes first"


@dataclass(frozen=True, eq=False, slots=True)
class _Trial:
    """A lift rehearsed in every drawn scene: probability that others are disturbed, in all and each."""

    object_id: str
    hold: tuple[str, ...]
    risk: float
    harmed: dict[str, float]
    lifts: tuple[Lift, ...]


class _Rehearsal:
    """Scenes in which to try lifts, with the states of their objects after each removal."""

    def __init__(
        self, graph: SupportGraph, config: Config, rng: np.random.Generator, *, threads: int = 1
    ) -> None:
        if graph.support_surface is None:
            raise InputError("graph", "has no support surface", "extract one; lifts need a table")
        self.ids = tuple(o.id for o in graph.objects if o.role == "object")
        if not self.ids:
            raise InputError("graph", "has no objects", "there is nothing to take away")
        if len(self.ids) > config.rehearsal.max_objects:
            reserved = 0.6 * (len(self.ids) / 300) ** 1.7  # two arenas [GB], measured with 300 and 1,000
            reason = (
                f"has {len(self.ids)} objects, for which MuJoCo reserves about {reserved:.1f} GB a thread"
            )
            raise InputError("graph", reason, "raise rehearsal.max_objects, or give a part of the scene")
        self._graph, self._config, self._threads = graph, config, threads
        self.accepted = config.rehearsal.risk
        self._trials: dict[tuple[str, ...], _Trial] = {}
        specs = [_drawn_scene(graph, number, config, rng) for number in range(config.rehearsal.draws)]
        settled = self._each(lambda k: _settled(specs[k], self.ids, config))
        self._liftings: list[Lifting] = [lifting for lifting, _, _ in settled]
        # For D scenes with N objects: which do not stay in place (D, N), and all states (D, N, 7).
        self._restless = np.stack([restless for _, restless, _ in settled])
        self._states = np.stack([state for _, _, state in settled])

    def left(self) -> list[str]:
        """Ids of the objects that have not been removed yet."""
        return [i for i, height in zip(self.ids, self._states[0, :, 2], strict=True) if height < ASIDE / 2.0]

    def try_lift(self, object_id: str, hold: Collection[str] = ()) -> _Trial:
        """Lift an object in every scene while others are held; cached, and nothing changes."""
        asked = (object_id, *sorted(hold))
        if asked not in self._trials:
            index, held = self.ids.index(object_id), {self.ids.index(i) for i in hold}

            def lift(k: int) -> Lift:
                also = set(np.flatnonzero(self._restless[k]).tolist()) - {index}
                state, how = self._states[k], self._config.lift
                return self._liftings[k].lift(state, index, how, held=held | also, to_the_end=False)

            lifts = self._each(lift)
            # An object held in a scene because it does not stay there moves if it loses a support.
            free = set(self.left()) - set(hold)
            supports = [self._graph.support(object_id, i) if i in free else None for i in self.ids]
            loses = np.array([0.0 if s is None else s.belief for s in supports])
            harm = np.maximum(np.stack([lift.disturbed for lift in lifts]), self._restless * loses)
            shares = zip(self.ids, harm.mean(axis=0).tolist(), strict=True)
            harmed = {i: share for i, share in shares if share > 0.0}
            risk = float(1.0 - np.prod(1.0 - harm, axis=1).mean())
            self._trials[asked] = _Trial(object_id, tuple(hold), risk, harmed, tuple(lifts))
        return self._trials[asked]

    def take(self, trial: _Trial) -> None:
        """Continue without an object whose lift was tried; others that moved are put back."""
        index = self.ids.index(trial.object_id)
        self._trials.clear()
        moved = np.array([lift.disturbed.any() for lift in trial.lifts])
        stays = self._restless | moved[:, None]
        after = np.stack([lift.film[-1] for lift in trial.lifts])
        self._states = np.where(stays[..., None], self._states, after)
        self._states[:, index, :3] = (0.0, 0.0, ASIDE + index)

    def _each(self, do: Callable[[int], Any]) -> list[Any]:
        """Do something for every scene, in order."""
        with ThreadPoolExecutor(self._threads) as pool:
            return list(pool.map(do, range(self._config.rehearsal.draws)))


def _drawn_scene(graph: SupportGraph, number: int, config: Config, rng: np.random.Generator) -> Any:
    """A `mujoco.MjSpec` of the extracted shapes or, for a number above 0, of others as likely."""
    objects = list(graph.objects)
    if number > 0:
        objects = [drawn(o, rng, config.plausibility) for o in objects]
        objects = reconcile(objects, config.plausibility)
    settings = config.support
    frictions = rng.uniform(*settings.friction, len(objects))
    densities = rng.uniform(*settings.density, len(objects))
    if number == 0:
        frictions[:], densities[:] = np.mean(settings.friction), np.mean(settings.density)
    spec = empty_spec("rehearsal")
    # Twice MuJoCo's default time step, which the implicit integrator allows, for half the time.
    spec.option.timestep = 0.004
    for o, friction, density in zip(objects, frictions, densities, strict=True):
        if o.role == "support_surface":
            _add_table(spec, o)
        else:
            add_body(spec, o.id, Body(o.shape, density, friction))
    return spec


def _add_table(spec: Any, table: SceneObject) -> None:
    """The table, 10 cm larger on each side than its seen part.

    It is slippery: contacts use the larger friction of two, and it must not hide how slippery objects are.
    """
    T, extents = table.shape.T_world_object, table.shape.extents
    up = int(np.argmax(np.abs(T[2, :3])))
    half = extents / 2.0 + np.where(np.arange(3) == up, 0.0, 0.1)
    body = spec.worldbody.add_body(name=TABLE, pos=T[:3, 3], quat=quaternion(T[:3, :3]))
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=half, friction=[0.1, 0.005, 0.001])


def _settled(spec: Any, ids: Sequence[str], config: Config) -> tuple[Lifting, NDArray[np.bool_], Array]:
    """Let a scene come to rest: objects that move too far are put back and held, until no others do.

    Returns:
        The scene, which objects (N,) had to be held, and the state (N, 7) of all.
    """
    lifting = Lifting(spec, ids)
    seen, restless = lifting.start, np.zeros(len(ids), dtype=np.bool_)
    while True:
        state = lifting.rest(seen, np.flatnonzero(restless).tolist(), config.rehearsal.settling)
        moved = strayed(seen, state, config.lift.moved, config.lift.turned) & ~restless
        if not moved.any():
            return lifting, restless, np.where(restless[:, None], seen, state)
        restless |= moved
