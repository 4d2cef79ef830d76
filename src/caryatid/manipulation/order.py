"""A safe order to take objects away: each step rehearsed in physics before it is chosen."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import networkx as nx
import numpy as np

from caryatid.config import Config
from caryatid.errors import InputError
from caryatid.graph import SupportGraph
from caryatid.manipulation.rehearsal import Rehearsal, Trial
from caryatid.runtime.display import Pictured


@dataclass(frozen=True, slots=True)
class TakeStep:
    """One object to take.

    Attributes:
        object_id: Which.
        hold: Ids of what the other hand holds meanwhile.
        safe: No other object was disturbed in any rehearsal.
        risk: Share of the rehearsals in which one was [1].
        why: What the step goes by, for a person to read.
    """

    object_id: str
    hold: tuple[str, ...]
    safe: bool
    risk: float
    why: str

    def to_json(self) -> dict[str, Any]:
        """One entry of `steps` in what `--json` writes."""
        hold = list(self.hold)
        return {"object": self.object_id, "hold": hold, "safe": self.safe, "risk": self.risk, "why": self.why}


@dataclass(frozen=True, slots=True)
class Order(Pictured):
    """An order to take objects away.

    Attributes:
        steps: What to take, one after the other.
        refusal: Why there is no safe order, naming what stands in whose way; empty where there is one.
    """

    steps: tuple[TakeStep, ...]
    refusal: str = ""

    @property
    def safe(self) -> bool:
        """Every step is."""
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
    """Find a safe order to take everything away, or to get at one object.

    Greedy: of what is left that object is taken whose lift disturbs no other in any rehearsal, one that
    supports nothing before one that does, higher ones first. Where there is none, the other hand holds what
    would be disturbed most. Where that does not help either, the least risky lift is taken, and the order is
    not safe.

    Args:
        graph: What has been extracted.
        config: How lifts go, and how they are rehearsed.
        goal: Id of the object to get at; only what has to be taken before it is.
        hands: 2 where another hand can hold one object, else 1.
        seed: Seed of the rehearsals.
        threads: How many of them run at a time.

    Raises:
        InputError: There is no support surface, or no object to take, or no such goal.
    """
    config = config or Config()
    rehearsal = Rehearsal(graph, config, np.random.default_rng(seed), threads=threads)
    if goal is not None and goal not in rehearsal.ids:
        raise InputError(goal, "is not an object of the graph", f"there are {', '.join(rehearsal.ids)}")
    steps: list[TakeStep] = []
    refusal = ""
    while (left := rehearsal.left()) and (goal is None or goal in left):
        wanted = _in_turn(graph, left) if goal is None else _on_the_way(graph, goal, left, rehearsal)
        trial, tried = _safest(rehearsal, wanted, hands)
        if trial.risk > 0.0 and not refusal:
            refusal = _refusal(trial, tried)
        steps.append(_step(graph, trial, left, config.rehearsal.draws))
        rehearsal.take(trial)
    return Order(tuple(steps), refusal)


def _in_turn(graph: SupportGraph, left: Sequence[str]) -> list[str]:
    """What is left, what supports nothing of it first, and of these the highest."""
    carrying = {s.supporter for s in graph.supports if s.supported in left}
    height = {o.id: float(o.centre_world[2]) for o in graph.objects}
    return sorted(left, key=lambda i: (i in carrying, -height[i], i))


def _on_the_way(graph: SupportGraph, goal: str, left: Sequence[str], rehearsal: Rehearsal) -> list[str]:
    """The goal if it can be lifted; else what its lift disturbs, and what theirs do, the nearest first."""
    found = [goal]
    for object_id in found:
        harmed = rehearsal.try_lift(object_id).harmed
        if not harmed:
            return [object_id]
        found += [i for i in _in_turn(graph, left) if i in harmed and i not in found]
    return found


def _safest(rehearsal: Rehearsal, wanted: Sequence[str], hands: int) -> tuple[Trial, list[Trial]]:
    """The first lift that is safe, with one hand before two; else the least risky; and those tried before."""
    tried: list[Trial] = []
    for object_id in wanted:
        trial = rehearsal.try_lift(object_id)
        if trial.risk == 0.0:
            return trial, tried
        tried.append(trial)
    tried.sort(key=lambda t: (t.risk, len(t.harmed)))
    best = tried[0]
    for trial in _with_hold(rehearsal, tried) if hands > 1 else ():
        if trial.risk < best.risk:
            best = trial
        if best.risk == 0.0:
            break
    return best, tried


def _with_hold(rehearsal: Rehearsal, tried: Sequence[Trial]) -> Iterator[Trial]:
    """The same lifts while the other hand holds one of those that were disturbed, the most often first."""
    for trial in tried:
        for held in sorted(trial.harmed, key=lambda i: (-trial.harmed[i], i)):
            yield rehearsal.try_lift(trial.object_id, [held])


def _step(graph: SupportGraph, trial: Trial, left: Sequence[str], draws: int) -> TakeStep:
    carried = [s.supported for s in graph.supports if s.supporter == trial.object_id and s.supported in left]
    what = f"supports {', '.join(carried)}" if carried else "supports nothing that is left"
    with_hold = f" while {', '.join(trial.hold)} is held" if trial.hold else ""
    worst = ", ".join(f"{i} in {share * draws:.0f}" for i, share in trial.harmed.items())
    harm = f"nothing in {draws} rehearsals" if trial.risk == 0.0 else f"{worst} of {draws} rehearsals"
    why = f"it {what}; lifting it{with_hold} disturbed {harm}"
    return TakeStep(trial.object_id, trial.hold, trial.risk == 0.0, trial.risk, why)


def _refusal(trial: Trial, tried: Sequence[Trial]) -> str:
    """Say which objects stand in one another's way."""
    blocked = nx.DiGraph((t.object_id, i) for t in tried for i in t.harmed)
    try:
        edges = nx.find_cycle(blocked, trial.object_id)
    except nx.NetworkXNoCycle:
        return f"no safe order: lifting {trial.object_id} disturbs {', '.join(trial.harmed)}"
    cycle = ", ".join(f"lifting {a} disturbs {b}" for a, b in edges)
    return f"no safe order: {cycle}; whichever goes first"
