"""Measure what exploring with a goal saves: the views needed to know what moves when the goal is removed.

    python benchmarks/goals.py [SCENES…] --goals 2

Goals are drawn at random from a scene's objects. Each goal gets its own exploration; one exploration without
a goal predicts for all goals. All explorations stop by themselves. An object is predicted to move if its
probability is at least 0.5; the prediction is right if it agrees with a physics simulation. The simulation
removes the goal in two ways: it deletes it at once, as for the ground truth of supports, or it lifts it.
"""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import pandas as pd
import tyro
from measures import OnScenes, Row, run_main

from caryatid.benchmark.episodes import open_scene
from caryatid.benchmark.suites import DENSE
from caryatid.config import PhysicsConfig
from caryatid.config.settings import read_settings
from caryatid.evaluation.scores import TrueScene
from caryatid.exploration import explore
from caryatid.graph import SupportGraph
from caryatid.manipulation.clearing import bodies_of
from caryatid.simulation.lifting import Lifting
from caryatid.simulation.setup import make_simulation
from caryatid.simulation.truth import displaced_without
from caryatid.simulation.world import poses_of
from caryatid.support.relations import predict_removal

PILES = tuple(f"pile-{6 + k}-{901 + k}" for k in range(16))


@dataclass(frozen=True)
class Goals(OnScenes):
    """Explore with and without a goal."""

    scenes: Annotated[tuple[str, ...], tyro.conf.Positional] = (*DENSE, *PILES)
    """Names of built-in scenes, or scene folders."""
    goals: int = 2
    """Number of goals in each scene."""
    until: float | None = None
    """Probability at which a prediction counts as known."""
    planner: str = "support"
    """Planner that chooses the views."""

    def measure(self, name: str) -> list[Row]:
        """Explore one scene without a goal and with each goal; return one row per goal."""
        config, (scene, truth) = read_settings(None, self.set), open_scene(name)
        bodies = scene.object_bodies
        names = list(bodies.values())

        def explored(goal: str | None) -> tuple[int, SupportGraph]:
            simulation = make_simulation(scene, config, noise=self.noise, seed=self.seed)
            known: dict[str, Any] = {"config": config, "seed": self.seed, "segmentation": self.segmentation}
            known |= {"planner": self.planner, "goal": goal, "until": self.until if goal else None}
            *_, last = explore(simulation.camera, simulation.robot, **known)
            return last.index + 1, last.graph

        views, graph = explored(None)
        lifting, rows = Lifting(scene.spec, names), []
        for label in self.drawn(name, list(bodies), self.goals):
            taken = {bodies[k] for k in displaced_without(scene, label, PhysicsConfig())}
            lift = lifting.lift(poses_of(scene), names.index(bodies[label]), config.lift)
            lifted = {names[k] for k in np.flatnonzero(lift.disturbed)}
            fewer, with_goal = explored(f"o{label}")
            row = {"scene": name, "goal": f"o{label}", "others": len(names) - 1}
            row |= {"views": fewer, "all views": views}
            for which, found in (("", with_goal), ("all ", graph)):
                moves = predicted(found, f"o{label}", truth, config)
                for how, true in (("taken", taken), ("lifted", lifted)):
                    right = len(names) - 1 - len(moves ^ true)
                    row |= {f"{how} moving": len(true), f"{which}{how} right": right}
            rows.append(row)
        return rows

    def summary(self, rows: pd.DataFrame) -> dict[str, float]:
        """Return views with and without a goal, and the shares of right objects and of wholly right goals."""
        sums = rows.sum(numeric_only=True)
        found = {"goals": len(rows), "views": rows["views"].mean(), "all views": rows["all views"].mean()}
        found |= {"share of views": sums["views"] / sums["all views"]}
        for how in ("taken", "lifted"):
            found[f"{how}: moving"] = sums[f"{how} moving"] / sums["others"]
            for which in ("", "all "):
                right = f"{which}{how} right"
                found[f"{how}: {which}right"] = sums[right] / sums["others"]
                found[f"{how}: {which}wholly"] = (rows[right] == rows["others"]).mean()
        return found


def predicted(graph: SupportGraph, goal: str, truth: TrueScene, config: Any) -> Set[str]:
    """Return the bodies predicted to move with the goal; an object that matches no body appears by its id."""
    if all(o.id != goal for o in graph.objects):
        return set()
    bodies = bodies_of(graph, truth)
    effects = predict_removal(graph, goal, config.support)
    return {bodies.get(e.object_id, e.object_id) for e in effects if e.probability >= 0.5}


if __name__ == "__main__":
    run_main(Goals)
