"""How well automatic segmentation cuts single views into objects: found, invented, split, merged, by family.

    python benchmarks/segmentation.py [SOURCES…] --views 4 [--gate]

SOURCES are folders with scene.xml, names of built-in scenes, or BOP folders with masks. Views of scenes are
simulated: the robot's first one and others it can reach, far from each other. Without SOURCES the views are
of the built-in suite, the one the committed baseline is of. What is scored is `segment` alone, at the pixels
that hold a reading; what the scene model makes of it is for `accuracy.py` to say.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import tyro
from accuracy import EASY
from measures import Gated, Measure, print_table, run_main
from numpy.typing import NDArray
from rich.console import Console

from caryatid.benchmark.episodes import family
from caryatid.config import Config, NoiseModel
from caryatid.config.settings import read_settings
from caryatid.errors import CaryatidError
from caryatid.evaluation.oracle import spread_out
from caryatid.evaluation.scores import assign, mask_ious
from caryatid.io.bop import read_recording
from caryatid.segmentation.observation import observe
from caryatid.segmentation.segments import segment
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.sensing.views import View
from caryatid.sources import is_recording, open_source

BUILT_IN = (*EASY, *(f"dense-{size}-{seed}" for seed, size in enumerate(range(10, 18, 2), start=1)))
"""What is segmented where no sources are given."""
BASELINE = Path(__file__).with_name("segmentation_baseline.json")
LEAST_PIXELS = 200
"""True objects with fewer readings are not asked for, nor are parts of them invented [px]; 2 cm at 1 m."""
MIN_IOU = 0.5
"""IoU of masks from which a part is an object [1]; method notes 5."""
COUNTED = ("found", "invented", "split", "merged")
SHARE = 0.2
"""A part that holds this share of an object's readings is a piece of it [1]."""


@dataclass(frozen=True)
class Args(Gated):
    """Segment views and compare with true masks."""

    sources: Annotated[tuple[str, ...], tyro.conf.Positional] = BUILT_IN
    """Scene folders, names of built-in scenes, or BOP folders."""
    views: int = 4
    """Views of each scene; a recording has its own."""
    noise: NoiseModel = "carmine"
    """Noise of the simulated camera."""
    seed: int = 0
    """Seed of the noise."""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Settings, e.g. `--set segmentation.concavity=12`."""


def views_of(source: str, args: Args, config: Config) -> Iterator[View]:
    """The views of a source, with true labels."""
    if is_recording(source):
        yield from read_recording(source)
        return
    opened = open_source(source, config, noise=args.noise, segmentation="labels", seed=args.seed)
    if opened.truth is None:
        raise CaryatidError(f"{source}: has no truth to score against")
    sphere = ViewSphere.around(np.array([0.0, 0.0, opened.truth.table_top]), config.active)
    found = opened.robot.candidates(sphere)
    first = opened.robot.T_world_camera
    others = spread_out(found.directions, sphere.direction_of(first)[None], args.views - 1)
    for T_world_camera in (first, *found.T_world_camera[others]):
        yield opened.camera.capture(T_world_camera)


def compare(labels: NDArray[np.int32], truth: NDArray[np.int32]) -> dict[str, int]:
    """Count true objects and parts, and of them those found, invented, split and merged.

    Args:
        labels: Parts of the pixels with a reading (N,).
        truth: Their objects (N,).
    """
    counts = pd.crosstab(labels, truth).drop(index=0, errors="ignore")
    part_sizes = counts.sum(axis=1).to_numpy()
    counts = counts.drop(columns=0, errors="ignore").reindex(columns=[k for k in np.unique(truth) if k > 0])
    both, parts, objects = counts.fillna(0).to_numpy(), counts.index.tolist(), counts.columns.tolist()
    sizes = np.array([np.sum(truth == k) for k in objects])
    asked = sizes >= LEAST_PIXELS
    pairs = assign(mask_ious([labels], [truth], parts, objects), MIN_IOU)
    crumbs = both[:, ~asked].sum(axis=1) > 0.5 * part_sizes
    invented = len(parts) - len(pairs) - sum(crumbs[i] for i in range(len(parts)) if i not in dict(pairs))
    pieces = (both >= SHARE * sizes) & asked
    inside = both >= 0.5 * part_sizes[:, None]
    return {
        "true": int(asked.sum()),
        "parts": int(len(pairs) + invented),
        "found": sum(bool(asked[j]) for _, j in pairs),
        "invented": int(invented),
        "split": int(((pieces & inside).sum(axis=0) > 1).sum()),
        "merged": int((pieces[pieces.sum(axis=1) > 1].any(axis=0)).sum()),
    }


def measure(task: tuple[str, Args]) -> list[dict[str, Any]]:
    """Segment the views of one source: a row for each."""
    source, args = task
    config = read_settings(None, args.set)
    rows = []
    for number, view in enumerate(views_of(source, args, config)):
        rng = np.random.default_rng(args.seed)
        seen = observe(view, config, segmentation="auto", known=None, rng=rng)
        if seen.view is None or view.labels is None:
            raise CaryatidError(f"{view.name}: has no masks to compare with")
        started = time.perf_counter()
        labels = segment(seen.view, seen.surface, config.segmentation, config.cloud, config.fit, rng)[0]
        known = {"source": Path(source).name, "view": number, "seconds": time.perf_counter() - started}
        rows.append(known | compare(labels[view.valid], view.labels[view.valid]))
    return rows


def shares(rows: pd.DataFrame) -> dict[str, float]:
    """Shares found, split and merged of the true objects, and invented of the parts."""
    sums = rows.sum(numeric_only=True)
    return {name: sums[name] / max(sums["parts" if name == "invented" else "true"], 1) for name in COUNTED}


def measures(rows: pd.DataFrame) -> list[Measure]:
    """The shares of each family of scenes."""
    return [
        Measure(f"{name}.{field}", value, "1", "higher" if field == "found" else "lower", 0.02)
        for name, group in rows.groupby(rows["source"].map(family))
        for field, value in shares(group).items()
    ]


def main() -> int:
    """Run the measurement."""
    args = tyro.cli(Args)
    console = Console(width=160)
    parts = args.each(measure, [(source, args) for source in args.sources])
    rows = pd.DataFrame([row for part in parts for row in part])
    sums = rows.groupby(rows["source"].map(family).rename("sources")).sum(numeric_only=True)
    print_table(sums.drop(columns="view").reset_index().round(2), console)
    worst = rows.loc[(rows["found"] - rows["true"] - rows["invented"]).nsmallest(8).index].itertuples()
    console.print("worst: " + ", ".join(f"{r.source} view {r.view}: {r.found} of {r.true}" for r in worst))
    args.write(rows.to_dict("records"))
    return args.finish(measures(rows), BASELINE, console)


if __name__ == "__main__":
    run_main(main)
