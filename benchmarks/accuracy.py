"""Measure how well the loop finds support graphs: F1 per view, on simulated scenes.

    python benchmarks/accuracy.py suite [NAMES…] [--gate | --update]
    python benchmarks/accuracy.py exact SCENES…

`suite` runs the suites of the committed baseline: all of them, or only NAMES. `exact` infers supports from
the true shapes. `caryatid benchmark` compares planners and settings with confidence intervals, and `real.py`
scores recordings.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from operator import call
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import pandas as pd
import tyro
from measures import Gated, Measure, Spread, print_table, run_main
from rich.console import Console

from caryatid.benchmark.episodes import Episode, family, figures_of, run_episode
from caryatid.benchmark.suites import SUITES as BENCHMARK
from caryatid.config import Config, SegmentationMethod
from caryatid.config.settings import read_settings
from caryatid.errors import CaryatidError
from caryatid.evaluation.scores import score, score_masks
from caryatid.evaluation.truths import true_scene_from_simulation
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box
from caryatid.graph import SceneObject
from caryatid.io import write_recording
from caryatid.io.bop import read_recording
from caryatid.scene import Scene
from caryatid.sensing.views import SUPPORT_LABEL
from caryatid.simulation.scenes import is_builtin, load_scene
from caryatid.simulation.setup import make_simulation
from caryatid.simulation.truth import GroundTruth, TrueEdge, ground_truth, read_truth, write_truth
from caryatid.support.relations import infer

BASELINE = Path(__file__).with_name("accuracy_baseline.json")
LEAST_READINGS = 200
"""Minimum readings of an object in a simulated frame for its ground truth to include it [px]: 2 cm at 1 m."""
EASY = (
    *("tower", "bridge", "counterweight", "leaning_plank", "hidden_stack", "shelf", "clutter"),
    *(f"pile-{size}-{seed}" for seed, size in enumerate(range(4, 16, 2), start=1)),
)
"""Hand-designed scenes, and piles of 4–14 primitives."""
DENSE = tuple(f"dense-{10 + seed % 8}-{seed}" for seed in range(200, 216))
"""Heaps of 10–17 objects between screens and walls; development used none of these seeds."""
PACKED = tuple(f"packed-20-{seed}" for seed in range(1, 6))
"""Twenty objects, each touching another."""
BOARDS = tuple(f"boards-{4 + seed % 9}-{seed}" for seed in range(201, 221))
"""Boards on pillars, over lower objects that they hide; development used none of these seeds."""
STOREYS = tuple(f"storeys-{4 + seed % 5}-{seed}" for seed in range(920, 936))
"""Objects on two levels of furniture; development used none of these seeds."""
MEANS, POOLED = ("f1", "edge_recall", "mean_iou"), ("f1", "found", "invented")
"""Figures of a suite: means over scenes; `found` and `invented` are shares of the objects of all scenes."""
SURE = 0.95
"""Probability from which on a false support between matched objects counts as `overconfident` [1]."""
Row = dict[str, Any]
"""`scene`, `seed`, `view` (from 1), and figures."""


@dataclass(frozen=True)
class Suite:
    """Scenes measured with the same settings.

    Attributes:
        scenes: Names of built-in scenes.
        scored: Numbers of views after which figures are computed.
        segmentation: Where segments come from.
        tolerance: By how much a figure may be worse than the baseline [1]: three times the largest standard
            deviation over seeds of any figure of the suite, about twice that of the difference of two runs.
        settings: Changes to the default settings.
        figures: Figures to compute.
        frames: Extract single frames of the scenes instead of exploring them.
        against: Suite of the undisturbed scenes; the drop in F1 from it is another figure.
    """

    scenes: tuple[str, ...]
    scored: tuple[int, ...]
    segmentation: SegmentationMethod
    tolerance: float
    settings: tuple[str, ...] = ()
    figures: tuple[str, ...] = MEANS
    frames: bool = False
    against: str = ""

    def tasks(self, seeds: int) -> list[Callable[[], list[Row]]]:
        """Return the measurements, one per scene and seed."""
        measure = extract if self.frames else explore
        base = Episode("", segmentation=self.segmentation, settings=self.settings, views=max(self.scored))
        return [
            partial(measure, replace(base, scene=scene, seed=seed))
            for scene, seed in product(self.scenes, range(seeds))
        ]


BOTH = (*EASY, *DENSE)
DEPTH_NOISE = ("noise.axial=[0.0048,0.0076,0.4]",)
REGISTRATION = ("noise.translation=0.01", "noise.rotation=1.0")
SUITES: Mapping[str, Suite] = {
    "labels": Suite(BOTH, (5, 10), "labels", 0.02),
    "auto": Suite(BOTH, (5, 10), "auto", 0.03),
    "packed": Suite(PACKED, (5,), "auto", 0.04, figures=POOLED),
    "noise": Suite(BOTH, (5,), "labels", 0.02, DEPTH_NOISE, ("f1",), against="labels"),
    "registration": Suite(BOTH, (5,), "labels", 0.02, REGISTRATION, ("f1", "mean_iou"), against="labels"),
    "boards": Suite(BOARDS, (5,), "labels", 0.02, figures=("f1", "edge_recall", "overconfident")),
    "storeys": Suite(STOREYS, (5,), "auto", 0.03, figures=("f1", "edge_recall")),
    "frames-labels": Suite(EASY, (1,), "labels", 0.02, figures=("f1",), frames=True),
    "frames-auto": Suite(EASY, (1,), "auto", 0.04, figures=POOLED, frames=True),
}
"""`noise` has four times the depth noise; in `registration`, poses are off by σ = 1 cm and 1°."""


def explore(episode: Episode) -> list[Row]:
    """Run an episode and return its rows."""
    outcome = run_episode(episode)
    if outcome.error is not None:
        raise CaryatidError(f"{episode.scene}: {outcome.error}")
    return [{"scene": episode.scene, "seed": episode.seed} | row for row in outcome.rows]


def extract(episode: Episode) -> list[Row]:
    """Extract a recording, and score the graph after each frame by the masks of all frames so far.

    The scene is a BOP folder or a built-in scene. Of a built-in scene, one simulated frame without a pose is
    recorded first.
    """
    config = read_settings(None, episode.settings)
    if is_builtin(episode.scene):
        with TemporaryDirectory() as temporary:
            recording = Path(temporary) / episode.scene
            record_frame(episode.scene, recording, config, episode.seed)
            return extract(replace(episode, scene=str(recording)))
    folder = Path(episode.scene)
    truth = read_truth(folder / "gt.json")
    scene = Scene(config, segmentation=episode.segmentation, seed=episode.seed)
    labels, true_labels, rows = [], [], []
    for index, frame in enumerate(read_recording(folder).frames):
        started = time.perf_counter()
        graph = scene.update(frame.load())
        seconds = time.perf_counter() - started
        assert scene.labels is not None
        labels.append(scene.labels)
        true_labels.append(frame.load_labels())
        found = score_masks(graph, labels, true_labels, truth.vertices, frozenset(truth.pairs))
        known = {"scene": folder.name, "seed": episode.seed, "view": index + 1, "perception_seconds": seconds}
        rows.append(known | figures_of(found, graph, len(truth.vertices) - 1))
    return rows


def infer_exactly(name: str) -> list[Row]:
    """Infer supports from the true shapes of a built-in scene, on a table wider than the scene."""
    started, truth = time.perf_counter(), true_scene_from_simulation(load_scene(name))
    (surface, top), *_ = truth.surfaces.items()
    table = Box(transforms.rigid(np.eye(3), (0.0, 0.0, top.height - 0.02)), np.array([3.0, 3.0, 0.04]))
    objects = [SceneObject(surface, SUPPORT_LABEL, table, "support_surface")]
    objects += [SceneObject(o, k, shape) for k, (o, shape) in enumerate(truth.objects.items(), 1)]
    graph = infer(objects, Config().support)
    found = figures_of(score(graph, truth), graph, len(truth.objects))
    return [
        {"scene": name, "seed": 0, "view": 1, "perception_seconds": time.perf_counter() - started} | found
    ]


def record_frame(scene: str, folder: Path, config: Config, seed: int) -> None:
    """Record the robot's first view of a built-in scene: one noisy frame without a pose, and gt.json."""
    simulated = load_scene(scene)
    simulation = make_simulation(simulated, config, noise="carmine", seed=seed)
    view = simulation.camera.capture(simulation.robot.T_world_camera)
    assert view.labels is not None
    shown, readings = np.unique(view.labels[view.valid], return_counts=True)
    kept = [int(k) for k in shown[readings >= LEAST_READINGS] if k > 0]
    labels = np.where(np.isin(view.labels, kept), view.labels, np.int32(0))
    write_recording(folder, [replace(view, labels=labels, T_world_camera=None)])
    names = {simulated.object_bodies[k]: f"object{k}" for k in kept} | {simulated.table: "table"}
    edges = tuple(
        TrueEdge(names[e.supporter], names[e.supported], e.kind)
        for e in ground_truth(simulated).edges
        if e.supporter in names and e.supported in names
    )
    write_truth(GroundTruth(("table", *(f"object{k}" for k in kept)), edges), folder / "gt.json")


def figures(rows: pd.DataFrame) -> dict[str, float]:
    """Return the means of rows, and shares of all their objects, and of their sure supports, together."""
    true, returned, matched = rows[["objects", "returned", "matched"]].sum()
    shares = {"found": matched / max(true, 1), "invented": (returned - matched) / max(returned, 1)}
    sure = [right for row in rows.get("forecasts", ()) for p, right in row if p >= SURE]
    shares["overconfident"] = 1.0 - float(np.mean(sure)) if sure else 0.0
    return rows.mean(numeric_only=True).to_dict() | shares


def measures(rows_of: Mapping[str, Sequence[Row]]) -> list[Measure]:
    """Compute the figures of suites from their rows, named `suite.scenes.figure@views`."""
    means = {}
    for name, rows in rows_of.items():
        frame = pd.DataFrame(rows)
        for (group, view), part in frame.groupby([frame["scene"].map(_group), "view"]):
            means[name, group, view] = figures(part)
    kept = []
    for (name, group, view), found in means.items():
        suite = SUITES[name]
        if view not in suite.scored:
            continue
        prefix = name if len({_group(scene) for scene in suite.scenes}) == 1 else f"{name}.{group}"
        wanted = {f: found[f] for f in suite.figures}
        if undisturbed := means.get((suite.against, group, view)):
            wanted["fall"] = undisturbed["f1"] - found["f1"]
        for f, value in wanted.items():
            better = "lower" if f in ("invented", "overconfident", "fall") else "higher"
            kept.append(Measure(f"{prefix}.{f}@{view}", value, "1", better, suite.tolerance))
    return kept


def _group(scene: str) -> str:
    return kind if (kind := family(scene)) in ("dense", "packed", "boards", "storeys") else "easy"


def show_rows(rows: Sequence[Row], console: Console, title: str) -> None:
    """Print F1 per view and other means after the last view, one line per family, and the worst scenes."""
    frame = pd.DataFrame(rows)
    kinds = frame["scene"].map(family).rename("scenes")
    last = frame[frame["view"] == frame["view"].max()]
    f1 = frame.pivot_table("f1", kinds, "view")
    rest = last[["edge_precision", "edge_recall", "mean_iou", "perception_seconds"]].groupby(kinds).mean()
    console.print(f"{title}: F1 per view, and other means after the last view")
    print_table(f1.join(rest).round(3).reset_index(), console)
    worst = last.nsmallest(6, "f1")[["scene", "seed", "f1"]].itertuples(index=False)
    console.print("lowest F1: " + ", ".join(f"{scene} (seed {seed}) {f1:.3f}" for scene, seed, f1 in worst))


@dataclass(frozen=True)
class SuiteRun(Gated):
    """Run the suites of the committed baseline."""

    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Suites to run. [default: all]"""
    seeds: int = 1
    """Number of seeds, from 0."""

    def run(self, console: Console) -> int:
        """Measure, print, and compare."""
        if unknown := [name for name in self.names if name not in SUITES]:
            raise CaryatidError(f"unknown suite '{unknown[0]}': choose from {', '.join(SUITES)}")
        names = self.names or tuple(SUITES)
        tasks = [(name, task) for name in names for task in SUITES[name].tasks(self.seeds)]
        rows: dict[str, list[Row]] = {name: [] for name in names}
        for (name, _), part in zip(tasks, self.each(call, [task for _, task in tasks]), strict=True):
            rows[name] += part
        for name in names:
            show_rows(rows[name], console, name)
        self.write(rows)
        others = {*SUITES} - {*names}
        return self.finish(measures(rows), BASELINE, console, lambda name: name.split(".")[0] in others)


@dataclass(frozen=True)
class Exact(Spread):
    """Infer supports from the true shapes; the remaining errors are what shapes cannot tell about forces."""

    scenes: Annotated[tuple[str, ...], tyro.conf.Positional] = BENCHMARK["heaps"].scenes
    """Built-in scenes. [default: the suite `heaps` of `caryatid benchmark`]"""

    def run(self, console: Console) -> int:
        """Infer and print."""
        rows = [row for part in self.each(infer_exactly, self.scenes) for row in part]
        show_rows(rows, console, "exact")
        self.write(rows)
        return 0


if __name__ == "__main__":
    run_main({"suite": SuiteRun, "exact": Exact})
