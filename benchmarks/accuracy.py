"""How well the loop finds support graphs: F1 per view over scenes, planners, seeds, and on real frames.

    python benchmarks/accuracy.py suite [NAMES…] [--gate | --update]
    python benchmarks/accuracy.py extract RECORDINGS… --segmentation labels

`suite` measures the settings the committed baseline is of, all where no NAMES are given. RECORDINGS are BOP
folders with masks and gt.json. `caryatid benchmark` compares planners and settings with confidence intervals.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import pandas as pd
import tyro
from measures import Gated, Measure, Spread, print_table, run_main
from rich.console import Console

from caryatid.benchmark.episodes import Episode, family, figures_of, run_episode
from caryatid.config import Config, SegmentationMethod
from caryatid.config.settings import read_settings
from caryatid.errors import CaryatidError
from caryatid.evaluation.scores import score_masks
from caryatid.io import write_recording
from caryatid.io.bop import read_recording
from caryatid.scene import Scene
from caryatid.simulation.scenes import is_builtin, load_scene
from caryatid.simulation.setup import make_simulation
from caryatid.simulation.truth import GroundTruth, TrueEdge, ground_truth, read_truth, write_truth

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
SHOWN = (
    *("edge_precision", "edge_recall", "vertex_precision", "vertex_recall", "mean_iou", "found", "invented"),
    *("planning_seconds", "perception_seconds"),
)
"""Columns of the table beside F1."""
MEANS, POOLED = ("f1", "edge_recall", "mean_iou"), ("f1", "found", "invented")
"""Figures of a suite: means over scenes; `found` and `invented` of all scenes' objects."""
Row = dict[str, Any]
"""`scene`, `seed`, `view` (from 1), and figures."""


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
    return [{"scene": task.scene, "seed": task.seed} | row for row in outcome.rows]


def extract(task: Extraction) -> list[Row]:
    """Extract a recording, and score the graph after each frame by the pixels of all frames so far."""
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
    known = {"scene": folder.name, "seed": task.seed}
    for index, frame in enumerate(read_recording(folder).frames):
        started = time.perf_counter()
        graph = scene.update(frame.load())
        seconds = time.perf_counter() - started
        assert scene.labels is not None
        labels.append(scene.labels)
        true_labels.append(frame.load_labels())
        found = score_masks(graph, labels, true_labels, truth.vertices, frozenset(truth.pairs))
        times = {"planning_seconds": 0.0, "perception_seconds": seconds}
        rows.append(known | {"view": index + 1} | figures_of(found, graph, len(truth.vertices) - 1) | times)
    return rows


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
        TrueEdge(supporter=names[e["supporter"]], supported=names[e["supported"]], kind=e["kind"])
        for e in ground_truth(simulated).edges
        if e["supporter"] in names and e["supported"] in names
    )
    write_truth(GroundTruth(("table", *(f"object{k}" for k in kept)), edges), folder / "gt.json")


def figures(rows: pd.DataFrame) -> dict[str, float]:
    """Means of rows, and the shares of their objects together that are `found` and `invented`."""
    true, returned, matched = rows[["objects", "returned", "matched"]].sum()
    shares = {"found": matched / max(true, 1), "invented": (returned - matched) / max(returned, 1)}
    return rows.mean(numeric_only=True).to_dict() | shares


def measures(rows_of: Mapping[str, Sequence[Row]]) -> list[Measure]:
    """Figures of suites from the rows of each, named `suite.scenes.figure@views`."""
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
            better = "lower" if f in ("invented", "fall") else "higher"
            kept.append(Measure(f"{prefix}.{f}@{view}", value, "1", better, suite.tolerance))
    return kept


def _group(scene: str) -> str:
    return kind if (kind := family(scene)) in ("dense", "packed") else "easy"


def show_rows(rows: Sequence[Row], console: Console, title: str) -> None:
    """Print F1 per view and the rest of the last view, a line a family, and the worst scenes."""
    frame = pd.DataFrame(rows)
    frame["scenes"] = frame["scene"].map(family)
    last = frame[frame["view"] == frame["view"].max()]
    lines = []
    for kind, part in last.groupby("scenes"):
        by_view = frame[frame["scenes"] == kind].groupby("view")["f1"].mean()
        known = figures(part)
        f1 = " ".join(f"{value:.3f}" for value in by_view)
        scenes = f"{kind} ({part['scene'].nunique()})"
        lines.append({"scenes": scenes, "F1 by view": f1} | {name: known[name] for name in SHOWN})
    console.print(f"{title}: means over scenes and seeds")
    print_table(pd.DataFrame(lines).round(3), console)
    worst = last.nsmallest(6, "f1")[["scene", "seed", "f1"]].itertuples(index=False)
    console.print("lowest: " + ", ".join(f"{scene} (seed {seed}) {f1:.3f}" for scene, seed, f1 in worst))


@dataclass(frozen=True)
class SuiteRun(Gated):
    """Measure the settings the committed baseline is of."""

    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Suites. [default: all]"""
    seeds: int = 1
    """Seeds 0…n−1."""

    def run(self, console: Console) -> int:
        """Measure, print, and compare."""
        if unknown := [name for name in self.names if name not in SUITES]:
            raise CaryatidError(f"no suite '{unknown[0]}': choose from {', '.join(SUITES)}")
        names = self.names or tuple(SUITES)
        seeds = range(self.seeds)
        tasks = [(n, SUITES[n].task(s, k)) for n in names for s in SUITES[n].scenes for k in seeds]
        rows: dict[str, list[Row]] = {name: [] for name in names}
        for (name, _), part in zip(tasks, self.each(run, [task for _, task in tasks]), strict=True):
            rows[name] += part
        for name in names:
            show_rows(rows[name], console, name)

        def kept(name: str) -> bool:
            return (suite := name.split(".")[0]) in SUITES and suite not in names

        self.write(rows)
        return self.finish(measures(rows), BASELINE, console, TARGETS, kept)


@dataclass(frozen=True)
class Extract(Spread):
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
        rows = [row for part in self.each(run, tasks) for row in part]
        show_rows(rows, console, "extract")
        self.write(rows)
        return 0


def main() -> int:
    """Run the measurement."""
    commands: dict[str, Any] = {"suite": SuiteRun, "extract": Extract}
    return tyro.extras.subcommand_cli_from_dict(commands).run(Console(width=200))


if __name__ == "__main__":
    run_main(main)
