"""Measure whether unreported changes are noticed: one object is removed, moved or added between two views.

    python benchmarks/changes.py [SCENES…] --segmentation auto

Each scene gets three views; then one object that supports nothing is removed, moved by 12 cm, or added. After
two more views, the changes that the model reports are compared with the actual change, and its graph with the
changed scene. A run without a change has ten views.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import pandas as pd
import tyro
from measures import OnScenes, Row, run_main

from caryatid.benchmark.episodes import open_scene
from caryatid.config.settings import read_settings
from caryatid.evaluation.scores import TrueScene, score
from caryatid.evaluation.truths import true_scene_from_simulation
from caryatid.geometry.transforms import Array
from caryatid.simulation.lifting import ASIDE, Lifting
from caryatid.simulation.truth import GroundTruth, ground_truth
from caryatid.simulation.world import SimulatedScene, bounds, posed, poses_of, strayed

PILES = tuple(f"pile-{5 + k % 8}-{400 + k}" for k in range(60))
"""Piles of 5–12 primitives; no other measurement uses these seeds."""
BEFORE, AFTER, UNCHANGED, SHIFT = 3, 2, 10, 0.12
"""Views before and after a change, views of a run without one, and the distance an object is moved [m]."""
KINDS = ("removed", "moved", "added", "nothing")


@dataclass(frozen=True)
class Changes(OnScenes):
    """Change scenes between two views, and count the changes that are noticed."""

    scenes: Annotated[tuple[str, ...], tyro.conf.Positional] = PILES
    """Names of built-in scenes, or scene folders."""
    kinds: tuple[str, ...] = KINDS
    """Kinds of change: any of `removed`, `moved`, `added` and `nothing`."""
    groups = "kind"

    def measure(self, name: str) -> list[Row]:
        """Run one scene with each kind of change that one of its objects allows."""
        return [row for kind in self.kinds if (row := self.changed(name, kind)) is not None]

    def changed(self, name: str, kind: str) -> Row | None:
        """Run one scene with one kind of change; None if no object can be changed in this way."""
        scene, _ = open_scene(name)
        rng = np.random.default_rng([self.seed, KINDS.index(kind), self.scenes.index(name)])
        states = (poses_of(scene),) * 2 if kind == "nothing" else change(scene, kind, rng)
        if states is None:
            return None
        config = read_settings(None, (f"active.max_views={UNCHANGED}", *self.set))
        camera, explorer = self.start(scene, config)
        camera.scene = posed(scene, states[0])
        told: list[str] = []
        for number in range(UNCHANGED if kind == "nothing" else BEFORE + AFTER):
            if number == BEFORE:
                camera.scene = posed(scene, states[1])
            if number > 0:
                explorer.plan()
                explorer.go()
            step = explorer.look()
            told += [f"{c.kind} {c.object_id} in view {number + 1}: {c.why}" for c in step.changes]
            if number < BEFORE or kind == "nothing":
                false = len(told)
        right = [t.startswith(kind) for t in told[false:]]
        row = {"scene": name, "kind": kind, "noticed": float(kind == "nothing" or any(right))}
        row |= {"f1": score(step.graph, truth_of(camera.scene)).f1, "false": false}
        return row | {"other": right.count(False), "told": told}

    def summary(self, rows: pd.DataFrame) -> dict[str, float]:
        """Return means of what was noticed and of F1, and sums of changes that did not happen."""
        return {"runs": len(rows), **rows[["noticed", "f1"]].mean(), **rows[["false", "other"]].sum()}

    def remark(self, row: Row) -> str:
        """Say what the model reported in a run that went wrong."""
        if row["noticed"] and row["f1"] >= 0.9 and not row["false"] and not row["other"]:
            return ""
        return f"{row['scene']} {row['kind']}: F1 {row['f1']:.3f}; {row['told']}"


def change(scene: SimulatedScene, kind: str, rng: np.random.Generator) -> tuple[Array, Array] | None:
    """Return the states (N, 7) of the objects before and after a change; None if no object can be moved."""
    state, names = poses_of(scene), list(scene.object_bodies.values())
    carrying = {edge.supporter for edge in ground_truth(scene).edges}
    free = [k for k, body in enumerate(names) if body not in carrying]
    for k in rng.permutation(free).tolist():
        if kind != "moved":
            without = state.copy()
            without[k, :3] = 0.0, 0.0, ASIDE + k
            return (state, without) if kind == "removed" else (without, state)
        moved = shifted(scene, state, k, rng)
        if moved is not None:
            return state, moved
    return None


def shifted(scene: SimulatedScene, state: Array, index: int, rng: np.random.Generator) -> Array | None:
    """Return the state after an object is set down 12 cm away; None if it falls over or hits others."""
    names = list(scene.object_bodies.values())
    lifting = Lifting(scene.spec, names)
    (low, high), table = bounds(scene, index + 1), bounds(scene, 0)
    others = [bounds(scene, k + 1) for k in range(len(names)) if k != index]
    for angle in rng.permutation(8) * np.pi / 4.0:
        step = np.array([SHIFT * np.cos(angle), SHIFT * np.sin(angle), table[1][2] + 0.001 - low[2]])
        a, b = low + step, high + step
        clear = all(((b[:2] + 0.01 < o[0][:2]) | (o[1][:2] < a[:2] - 0.01)).any() for o in others)
        if not clear or (a[:2] < table[0][:2]).any() or (b[:2] > table[1][:2]).any():
            continue
        placed = state.copy()
        placed[index, :3] += step
        rested = lifting.rest(placed, (), 2.0)
        if not strayed(placed, rested, 0.01, 8.0).any():
            return rested
    return None


def truth_of(scene: SimulatedScene) -> TrueScene:
    """Return the ground truth without the objects that were set aside."""
    names = scene.object_bodies.values()
    gone = {body for body, height in zip(names, poses_of(scene)[:, 2], strict=True) if height > ASIDE / 2.0}
    truth = ground_truth(scene)
    vertices = tuple(v for v in truth.vertices if v not in gone)
    edges = tuple(e for e in truth.edges if not gone & {e.supporter, e.supported})
    return true_scene_from_simulation(scene, GroundTruth(vertices, edges))


if __name__ == "__main__":
    run_main(Changes)
