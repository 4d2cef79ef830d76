"""How well the loop finds support graphs: F1 per view over scenes, planners, seeds, and on real frames.

    python benchmarks/accuracy.py explore [SCENES…] --noise carmine --views 5 [--gate]
    python benchmarks/accuracy.py extract FRAMES… --segmentation labels

SCENES are folders with scene.xml and gt.json or names of built-in scenes, FRAMES BOP folders with gt.json.
Without SCENES the built-in suite is explored, the one the committed baseline is of.
"""

from __future__ import annotations

import json
import os
import re
import sys
import time
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from measures import Measure, gate, write_baseline
from rich.console import Console
from rich.table import Table

from caryatid.config import FusionMethod, NoiseModel, SegmentationMethod
from caryatid.errors import CaryatidError
from caryatid.evaluation.scores import Score, score, score_masks
from caryatid.settings import read_settings

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
"""Set to 1 in the processes, unless set already: the jobs share the cores."""


SUITE = (
    *("tower", "bridge", "counterweight", "leaning_plank", "hidden_stack", "shelf", "clutter"),
    *(f"pile-{size}-{seed}" for seed, size in enumerate(range(4, 16, 2), start=1)),
    *(f"dense-{size}-{seed}" for seed, size in enumerate(range(10, 18, 2), start=1)),
)
"""Built-in scenes the committed baseline is of."""
BASELINE = Path(__file__).with_name("accuracy_baseline.json")


@dataclass(frozen=True)
class Row:
    """One view of one episode."""

    scene: str
    planner: str
    seed: int
    view: int
    f1: float
    edge_precision: float
    edge_recall: float
    vertex_recall: float
    mean_iou: float
    angle: float
    path: float
    seconds: float

    @classmethod
    def of(
        cls,
        scene: str,
        planner: str,
        seed: int,
        view: int,
        s: Score,
        angle: float,
        path: float,
        seconds: float,
    ) -> Row:
        """Put a score and what it cost together."""
        figures = (s.f1, s.edge_precision, s.edge_recall, s.vertex_recall, s.mean_iou)
        return cls(scene, planner, seed, view, *figures, angle, path, seconds)


@dataclass(frozen=True)
class Explore:
    """Explore scenes and score every view."""

    scenes: Annotated[tuple[str, ...], tyro.conf.Positional] = SUITE
    """Scene folders or names of built-in scenes."""
    noise: NoiseModel = "carmine"
    """Noise of the camera."""
    segmentation: SegmentationMethod = "labels"
    """Where parts come from."""
    fusion: FusionMethod = "pc+sg"
    """What is fused."""
    planner: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Planners compared; may be given more than once. [default: support]"""
    seeds: int = 1
    """Seeds 0…n−1."""
    views: int = 5
    """Views an episode."""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Settings, e.g. `--set registration.enabled=false`."""
    early_stop: bool = False
    """Stop when a view changed nothing; its scores then stand for the later views."""
    jobs: int = 4
    """Processes."""
    out: Path | None = None
    """JSON file for all rows."""
    gate: bool = False
    """Fail where a figure is worse than the committed baseline."""
    update: bool = False
    """Make the figures the committed baseline."""


@dataclass(frozen=True)
class Extract:
    """Extract graphs from single real frames and score them."""

    frames: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """BOP folders with gt.json."""
    segmentation: SegmentationMethod = "labels"
    """Where parts come from."""
    jobs: int = 4
    """Processes."""
    out: Path | None = None
    """JSON file for all rows."""


def explore_one(task: tuple[str, str, int, Explore]) -> list[Row]:
    """Run one episode."""
    from caryatid.commands.sources import open_source
    from caryatid.exploration import explore

    scene, planner, seed, args = task
    config = read_settings(None, args.set)
    config = replace(
        config,
        fusion=replace(config.fusion, method=args.fusion),
        active=replace(config.active, max_views=args.views),
    )
    source = open_source(scene, config, noise=args.noise, segmentation=args.segmentation, seed=seed)
    if source.truth is None:
        raise CaryatidError(f"{scene}: has no truth to score against")
    rows: list[Row] = []
    for step in explore(
        source.camera,
        source.robot,
        planner=planner,
        config=config,
        segmentation=args.segmentation,
        seed=seed,
        early_stop=args.early_stop,
    ):
        s = score(step.graph, source.truth, np.random.default_rng(0))
        seconds = sum(v for k, v in step.timings.items() if k != "capture")
        rows.append(
            Row.of(
                source.name, planner, seed, step.index, s, step.angle_travelled, step.path_travelled, seconds
            )
        )
    rows += [replace(rows[-1], view=v) for v in range(len(rows), args.views)]
    return rows


def extract_one(task: tuple[Path, Extract]) -> list[Row]:
    """Extract one frame's graph."""
    from caryatid.formats.bop import read_recording
    from caryatid.scene import Scene
    from caryatid.simulation.truth import read_truth

    folder, args = task
    recording = read_recording(folder)
    truth = read_truth(folder / "gt.json")
    frame = recording.frames[0]
    scene = Scene(segmentation=args.segmentation)
    started = time.perf_counter()
    graph = scene.update(frame.load())
    seconds = time.perf_counter() - started
    assert scene.labels is not None
    s = score_masks(graph, [scene.labels], [frame.load_labels()], truth.vertices, frozenset(truth.pairs))
    return [
        Row(
            folder.name,
            args.segmentation,
            0,
            0,
            s.f1,
            s.edge_precision,
            s.edge_recall,
            s.vertex_recall,
            s.mean_iou,
            0.0,
            0.0,
            seconds,
        )
    ]


def family(scene: str) -> str:
    """Kind of a scene, from its name: letters before the number; designed ones have no number."""
    matched = re.match(r"(pile|ycb|dense|test|learn)", scene)
    return matched[1] if matched else "designed"


def show(rows: list[Row], console: Console) -> None:
    """Print F1 per view, one line a family and planner, and the worst scenes."""
    last = max(r.view for r in rows)
    table = Table(title=f"mean over scenes and seeds, views 1…{last + 1}")
    for column in (
        "scenes",
        "planner",
        "F1 by view",
        "edge P / R",
        "vertex R",
        "IoU",
        "angle [rad]",
        "path [m]",
        "s/view",
    ):
        table.add_column(column)
    groups: dict[tuple[str, str], list[Row]] = defaultdict(list)
    for row in rows:
        groups[family(row.scene), row.planner].append(row)
        groups["easy" if family(row.scene) != "dense" else "all dense", row.planner].append(row)
    for (name, planner), part in sorted(groups.items()):
        by_view = [[r for r in part if r.view == v] for v in range(last + 1)]
        end = by_view[-1]
        table.add_row(
            f"{name} ({len({r.scene for r in part})})",
            planner,
            " ".join(f"{np.mean([r.f1 for r in view]):.3f}" for view in by_view),
            f"{np.mean([r.edge_precision for r in end]):.3f} / {np.mean([r.edge_recall for r in end]):.3f}",
            f"{np.mean([r.vertex_recall for r in end]):.3f}",
            f"{np.mean([r.mean_iou for r in end]):.3f}",
            f"{np.mean([r.angle for r in end]):.2f}",
            f"{np.mean([r.path for r in end]):.2f}",
            f"{np.mean([r.seconds for r in part]):.2f}",
        )
    console.print(table)
    worst = sorted((r for r in rows if r.view == last), key=lambda r: r.f1)[:6]
    console.print("lowest: " + ", ".join(f"{r.scene} ({r.planner}, seed {r.seed}) {r.f1:.3f}" for r in worst))


def measures(rows: list[Row]) -> list[Measure]:
    """Mean F1, edge recall and IoU of each family at the last view."""
    last = max(r.view for r in rows)
    found = []
    for name in sorted({family(r.scene) for r in rows}):
        end = [r for r in rows if family(r.scene) == name and r.view == last]
        for field in ("f1", "edge_recall", "mean_iou"):
            value = float(np.mean([getattr(r, field) for r in end]))
            found.append(Measure(f"{name}.{field}", value, "1", "higher", 0.02))
    return found


def main() -> int:
    """Run the measurement."""
    args = tyro.extras.subcommand_cli_from_dict({"explore": Explore, "extract": Extract})
    console = Console(width=160)
    for name in THREADS:
        os.environ.setdefault(name, "1")
    with ProcessPoolExecutor(args.jobs, get_context("spawn")) as pool:
        if isinstance(args, Explore):
            episodes = product(args.scenes, args.planner or ("support",), range(args.seeds))
            tasks = [(scene, planner, seed, args) for scene, planner, seed in episodes]
            rows = [row for episode in pool.map(explore_one, tasks) for row in episode]
        else:
            rows = [row for frame in pool.map(extract_one, [(f, args) for f in args.frames]) for row in frame]
    show(rows, console)
    if args.out is not None:
        args.out.write_text(json.dumps([asdict(r) for r in rows], indent=1) + "\n", encoding="utf-8")
    if isinstance(args, Explore) and args.update:
        write_baseline(measures(rows), BASELINE)
    if isinstance(args, Explore) and args.gate:
        return gate(measures(rows), BASELINE, console)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except CaryatidError as error:
        sys.exit(f"error: {error}")
