"""How well the loop finds support graphs: F1 per view over scenes, planners, seeds, and on real frames.

    python benchmarks/accuracy.py suite [NAMES…] [--gate | --update]
    python benchmarks/accuracy.py explore tower dense-10-1 --planner support random --seeds 3 --out rows.json
    python benchmarks/accuracy.py extract RECORDINGS… --segmentation labels

`suite` measures the settings the committed baseline is of, all where no NAMES are given. RECORDINGS are BOP
folders with masks and gt.json. `caryatid benchmark` compares planners and settings with confidence intervals.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import tyro
from measures import Measure, gate, read_baseline, show, write_baseline
from rich.console import Console
from rich.table import Table

from caryatid.benchmark.episodes import Episode, counts, family, find_scenes, run_episode, short_name
from caryatid.benchmark.running import THREADS
from caryatid.config import Config, NoiseModel, SegmentationMethod
from caryatid.config.settings import read_settings
from caryatid.errors import CaryatidError

BASELINE = Path(__file__).with_name("accuracy_baseline.json")
LEAST_READINGS = 200
"""Objects of which a simulated frame shows less are not in its ground truth [px]; 2 cm at 1 m."""
EASY = (
    *("tower", "bridge", "counterweight", "leaning_plank", "hidden_stack", "shelf", "clutter"),
    *(f"pile-{size}-{seed}" for seed, size in enumerate(range(4, 16, 2), start=1)),
)
"""Designed scenes, and piles of 4–14 primitives."""
DENSE = tuple(f"dense-{10 + seed % 8}-{seed}" for seed in range(200, 216))
"""Heaps of 10–17 objects between screens and walls, of seeds nothing was developed with."""
PACKED = tuple(f"packed-20-{seed}" for seed in range(1, 6))
"""Twenty objects, each touching another."""
MEANS, POOLED = ("f1", "edge_recall", "mean_iou"), ("f1", "found", "invented")
"""Figures of a suite: means over scenes; `found` and `invented` of all scenes' objects."""
Row = dict[str, Any]
"""`scene`, `planner` (of a recording its segmentation), `seed`, `view` (from 1), and figures."""


@dataclass(frozen=True)
class Extraction:
    """The extraction of a BOP folder, or of a single simulated frame of a built-in scene without a pose."""

    source: str
    segmentation: SegmentationMethod = "labels"
    settings: tuple[str, ...] = ()
    seed: int = 0


@dataclass(frozen=True)
class Suite:
    """Scenes under one setting.

    Attributes:
        scenes: Names of built-in scenes.
        scored: After how many views figures are taken.
        segmentation: Where segments come from.
        tolerance: How much worse than the baseline a figure may be [1]: three times the largest standard
            deviation a figure of the suite has over seeds, which is twice that of a difference of two runs.
        settings: Changes of the default settings.
        figures: What is kept.
        frames: Single frames of the scenes are extracted instead of exploring them.
        against: Suite of undisturbed scenes; how far F1 falls below its is kept too.
    """

    scenes: tuple[str, ...]
    scored: tuple[int, ...]
    segmentation: SegmentationMethod
    tolerance: float
    settings: tuple[str, ...] = ()
    figures: tuple[str, ...] = MEANS
    frames: bool = False
    against: str = ""

    def task(self, scene: str, seed: int) -> Episode | Extraction:
        """What is measured on a scene."""
        if self.frames:
            return Extraction(scene, self.segmentation, self.settings, seed)
        known = {"segmentation": self.segmentation, "settings": self.settings}
        return Episode(scene, views=max(self.scored), seed=seed, **known)  # type: ignore[arg-type]


BOTH = (*EASY, *DENSE)
DEPTH_NOISE = ("noise.axial=[0.0048,0.0076,0.4]",)
REGISTRATION = ("noise.translation=0.01", "noise.rotation=1.0")
SUITES: Mapping[str, Suite] = {
    "labels": Suite(BOTH, (5, 10), "labels", 0.02),
    "auto": Suite(BOTH, (5, 10), "auto", 0.03),
    "packed": Suite(PACKED, (5,), "auto", 0.04, figures=POOLED),
    "noise": Suite(BOTH, (5,), "labels", 0.02, DEPTH_NOISE, ("f1",), against="labels"),
    "registration": Suite(BOTH, (5,), "labels", 0.02, REGISTRATION, ("f1", "mean_iou"), against="labels"),
    "frames-labels": Suite(EASY, (1,), "labels", 0.02, figures=("f1",), frames=True),
    "frames-auto": Suite(EASY, (1,), "auto", 0.04, figures=POOLED, frames=True),
}
"""`noise` has four times the depth noise, `registration` views that are off by σ = 1 cm and 1°."""
TARGETS: Mapping[str, float] = {
    "labels.easy.f1@5": 0.985,
    "labels.easy.edge_recall@5": 0.96,
    "labels.easy.mean_iou@5": 0.92,
    "labels.dense.f1@5": 0.93,
    "labels.dense.f1@10": 0.97,
    "auto.easy.f1@5": 0.96,
    "auto.easy.f1@10": 0.975,
    "auto.dense.f1@5": 0.85,
    "auto.dense.f1@10": 0.92,
    "packed.found@5": 0.92,
    "packed.invented@5": 0.05,
    "noise.easy.fall@5": 0.05,
    "noise.dense.fall@5": 0.05,
    "registration.easy.fall@5": 0.05,
    "registration.dense.fall@5": 0.05,
    "frames-labels.f1@1": 0.985,
    "frames-auto.f1@1": 0.95,
    "frames-auto.found@1": 0.97,
    "frames-auto.invented@1": 0.04,
}
"""What is asked for; of `frames` it is asked for real frames, see `extract`."""


def run(task: Episode | Extraction) -> list[Row]:
    """Rows of one measurement: what a process of the pool is given."""
    if isinstance(task, Extraction):
        return extract(task)
    outcome = run_episode(task)
    if outcome.error is not None:
        raise CaryatidError(f"{task.scene}: {outcome.error}")
    about = {"scene": short_name(task.scene), "planner": task.planner, "seed": task.seed}
    return [
        about | row | {"seconds": row["planning_seconds"] + row["perception_seconds"]} for row in outcome.rows
    ]


def extract(task: Extraction) -> list[Row]:
    """Extract a recording, and score the graph after each frame by the pixels of all frames so far."""
    from caryatid.evaluation.scores import score_masks
    from caryatid.io.bop import read_recording
    from caryatid.scene import Scene
    from caryatid.simulation.scenes import is_builtin
    from caryatid.simulation.truth import read_truth

    config = read_settings(None, task.settings)
    if is_builtin(task.source):
        with TemporaryDirectory() as temporary:
            recording = Path(temporary) / task.source
            record_frame(task.source, recording, config, task.seed)
            return extract(replace(task, source=str(recording)))
    folder = Path(task.source)
    truth = read_truth(folder / "gt.json")
    scene = Scene(config, segmentation=task.segmentation, seed=task.seed)
    labels, true_labels, rows = [], [], []
    for index, frame in enumerate(read_recording(folder).frames):
        started = time.perf_counter()
        graph = scene.update(frame.load())
        seconds = time.perf_counter() - started
        assert scene.labels is not None
        labels.append(scene.labels)
        true_labels.append(frame.load_labels())
        found = score_masks(graph, labels, true_labels, truth.vertices, frozenset(truth.pairs))
        known = {"scene": folder.name, "planner": task.segmentation, "seed": task.seed, "view": index + 1}
        scores = {name: getattr(found, name) for name in SCORES}
        sizes = counts(len(truth.vertices) - 1, graph, found)
        rows.append(known | scores | sizes | {"seconds": seconds, "angle": 0.0, "path": 0.0})
    return rows


SCORES = ("f1", "edge_precision", "edge_recall", "vertex_precision", "vertex_recall", "mean_iou")


def record_frame(scene: str, folder: Path, config: Config, seed: int) -> None:
    """Record the robot's first view of a built-in scene: one noisy frame without a pose, and gt.json."""
    from caryatid.io import write_recording
    from caryatid.simulation.scenes import load_scene
    from caryatid.simulation.setup import make_simulation
    from caryatid.simulation.truth import GroundTruth, TrueEdge, ground_truth, write_truth

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
        TrueEdge(supporter=names[e["supporter"]], supported=names[e["supported"]], kind=e["kind"])
        for e in ground_truth(simulated).edges
        if e["supporter"] in names and e["supported"] in names
    )
    write_truth(GroundTruth(("table", *(f"object{k}" for k in kept)), edges), folder / "gt.json")


def figure(name: str, rows: Sequence[Row]) -> float:
    """A figure of rows: a mean, or `found` and `invented` of all their objects together."""
    true, returned, matched = (sum(r[n] for r in rows) for n in ("objects", "returned", "matched"))
    if name == "found":
        return float(matched / max(true, 1))
    if name == "invented":
        return float((returned - matched) / max(returned, 1))
    return float(np.mean([r[name] for r in rows]))


def measures(rows_of: Mapping[str, Sequence[Row]]) -> list[Measure]:
    """Figures of suites from the rows of each, named `suite.scenes.figure@views`."""
    kept = []
    for name, rows in rows_of.items():
        suite = SUITES[name]
        groups = list(dict.fromkeys(_group(scene) for scene in suite.scenes))
        for group, views in product(groups, suite.scored):
            prefix = name if len(groups) == 1 else f"{name}.{group}"
            part, undisturbed = (
                [r for r in some if r["view"] == views and _group(r["scene"]) == group]
                for some in (rows, rows_of.get(suite.against, ()))
            )
            for f in suite.figures if part else ():
                better = "lower" if f == "invented" else "higher"
                kept.append(Measure(f"{prefix}.{f}@{views}", figure(f, part), "1", better, suite.tolerance))
            if part and undisturbed:
                fall = figure("f1", undisturbed) - figure("f1", part)
                kept.append(Measure(f"{prefix}.fall@{views}", fall, "1", "lower", suite.tolerance))
    return kept


def _group(scene: str) -> str:
    return kind if (kind := family(scene)) in ("dense", "packed") else "easy"


def show_rows(rows: Sequence[Row], console: Console, title: str = "") -> None:
    """Print F1 per view and the rest of the last view, a line a family and planner, and the worst scenes."""
    last = max(r["view"] for r in rows)
    table = Table(title=f"{title} mean over scenes and seeds, views 1…{last:.0f}".strip())
    columns = (*SCORES[1:], "found", "invented", "angle", "path", "seconds")
    for column in ("scenes", "planner", "F1 by view", *(c.replace("_", " ") for c in columns)):
        table.add_column(column)
    groups: dict[tuple[str, str], list[Row]] = defaultdict(list)
    for row in rows:
        groups[family(row["scene"]), row["planner"]].append(row)
    for (name, planner), part in sorted(groups.items()):
        views = sorted({r["view"] for r in part})
        by_view = [[r for r in part if r["view"] == v] for v in views]
        f1 = " ".join(f"{figure('f1', view):.3f}" for view in by_view)
        scenes = f"{name} ({len({r['scene'] for r in part})})"
        table.add_row(scenes, planner, f1, *(f"{figure(c, by_view[-1]):.3f}" for c in columns))
    console.print(table)
    worst = sorted((r for r in rows if r["view"] == last), key=lambda r: r["f1"])[:6]
    told = (f"{r['scene']} ({r['planner']}, seed {r['seed']}) {r['f1']:.3f}" for r in worst)
    console.print("lowest: " + ", ".join(told))


@dataclass(frozen=True)
class Common:
    """What all measurements share."""

    jobs: int = 4
    """Processes."""
    out: Path | None = None
    """JSON file for all rows."""

    def measure(self, tasks: Sequence[Episode | Extraction]) -> list[list[Row]]:
        """Rows of each task, run in processes."""
        for name in THREADS:
            os.environ.setdefault(name, "1")
        with ProcessPoolExecutor(self.jobs, get_context("spawn")) as pool:
            return list(pool.map(run, tasks))

    def tell(self, rows_of: Mapping[str, list[Row]], console: Console) -> None:
        """Print rows, and write them where asked to."""
        for title, rows in rows_of.items():
            show_rows(rows, console, title)
        if self.out is not None:
            self.out.write_text(json.dumps(rows_of, indent=1) + "\n", encoding="utf-8")


@dataclass(frozen=True)
class SuiteRun(Common):
    """Measure the settings the committed baseline is of."""

    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Suites. [default: all]"""
    seeds: int = 1
    """Seeds 0…n−1."""
    gate: bool = False
    """Fail where a figure is worse than the committed baseline."""
    update: bool = False
    """Make the figures the committed baseline; those of other suites stay."""

    def run(self, console: Console) -> int:
        """Measure, print, and compare."""
        if unknown := [name for name in self.names if name not in SUITES]:
            raise CaryatidError(f"no suite '{unknown[0]}': choose from {', '.join(SUITES)}")
        names = self.names or tuple(SUITES)
        seeds = range(self.seeds)
        tasks = [(n, SUITES[n].task(s, k)) for n in names for s in SUITES[n].scenes for k in seeds]
        rows: dict[str, list[Row]] = {name: [] for name in names}
        for (name, _), part in zip(tasks, self.measure([task for _, task in tasks]), strict=True):
            rows[name] += part
        self.tell(rows, console)
        found = measures(rows)
        show("accuracy", found, TARGETS, console)
        if self.update:
            others = [m for m in read_baseline(BASELINE) if m.name.split(".")[0] not in names]
            write_baseline([m for m in others if m.name.split(".")[0] in SUITES] + found, BASELINE)
        return gate(found, BASELINE, console) if self.gate else 0


@dataclass(frozen=True)
class Explore(Common):
    """Explore scenes, and score every view."""

    scenes: Annotated[tuple[str, ...], tyro.conf.Positional] = BOTH
    """Names of built-in scenes, scene folders, or folders of them."""
    planner: tuple[str, ...] = ("support",)
    """Who chooses the views."""
    segmentation: SegmentationMethod = "labels"
    """Where segments come from."""
    noise: NoiseModel = "carmine"
    """Noise of the camera."""
    views: int = 5
    """Views of an episode, including the first."""
    seeds: int = 1
    """Seeds 0…n−1."""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Settings, e.g. `--set registration.enabled=false`."""

    def run(self, console: Console) -> int:
        """Explore and print."""
        read_settings(None, self.set)
        known = {"segmentation": self.segmentation, "noise": self.noise, "settings": self.set}
        same = Episode("", views=self.views, **known)  # type: ignore[arg-type]
        cross = product(find_scenes(self.scenes), self.planner, range(self.seeds))
        tasks = [replace(same, scene=scene, planner=planner, seed=seed) for scene, planner, seed in cross]
        self.tell({"explore": [row for part in self.measure(tasks) for row in part]}, console)
        return 0


@dataclass(frozen=True)
class Extract(Common):
    """Extract graphs from recordings, frame after frame, and score them."""

    recordings: Annotated[tuple[str, ...], tyro.conf.Positional] = EASY
    """BOP folders with masks and gt.json, or built-in scenes: one simulated frame of each."""
    segmentation: SegmentationMethod = "labels"
    """Where segments come from."""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Settings, e.g. `--set registration.enabled=false`."""

    def run(self, console: Console) -> int:
        """Extract and print."""
        tasks = [Extraction(folder, self.segmentation, self.set) for folder in self.recordings]
        self.tell({"extract": [row for part in self.measure(tasks) for row in part]}, console)
        return 0


def main() -> int:
    """Run the measurement."""
    commands: dict[str, Any] = {"suite": SuiteRun, "explore": Explore, "extract": Extract}
    return tyro.extras.subcommand_cli_from_dict(commands).run(Console(width=200))


if __name__ == "__main__":
    try:
        sys.exit(main())
    except CaryatidError as error:
        sys.exit(f"error: {error}")
