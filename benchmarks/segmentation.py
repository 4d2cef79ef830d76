"""Measure how well automatic segmentation cuts single views into objects: found, invented, split, merged.

    python benchmarks/segmentation.py [SOURCES…] --views 4 [--gate]

SOURCES are folders with scene.xml, or names of built-in scenes. Views are simulated: the robot's first view,
and others that it can reach, far apart. Without SOURCES, the views are those of the built-in suite, which the
committed baseline covers. Only `segment` is scored, at the pixels with a reading; `accuracy.py` scores what
the scene model makes of the segments, `real.py` does so for recordings. Figures are per family of scenes.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import tyro
from accuracy import EASY
from measures import Gated, Measure, Row, Simulated, print_table, run_main
from numpy.typing import NDArray
from rich.console import Console

from caryatid.benchmark.episodes import family
from caryatid.config import Config
from caryatid.config.settings import read_settings
from caryatid.errors import CaryatidError
from caryatid.evaluation.oracle import spread_out
from caryatid.evaluation.scores import assign, mask_ious
from caryatid.segmentation.observation import observe, segment_view
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.sensing.views import View
from caryatid.sources import open_source

BUILT_IN = (*EASY, *(f"dense-{size}-{seed}" for seed, size in enumerate(range(10, 18, 2), start=1)))
"""Sources to segment if none are given."""
BASELINE = Path(__file__).with_name("segmentation_baseline.json")
LEAST_PIXELS = 200
"""Minimum readings of a true object that counts [px]: 2 cm at 1 m. Segments of smaller ones are ignored."""
MIN_IOU = 0.5
"""Minimum IoU of masks at which a segment is an object [1], as in docs/method.md, section V."""
SHARE = 0.2
"""A segment that holds this share of an object's readings is a piece of it [1]."""


@dataclass(frozen=True)
class Segmentation(Gated, Simulated):
    """Segment views, and compare the segments with true masks."""

    sources: Annotated[tuple[str, ...], tyro.conf.Positional] = BUILT_IN
    """Scene folders, or names of built-in scenes."""
    views: int = 4
    """Number of views of each scene."""

    def views_of(self, source: str, config: Config) -> Iterator[View]:
        """Yield the views of a source, with true labels."""
        opened = open_source(source, config, noise=self.noise, segmentation="labels", seed=self.seed)
        if opened.truth is None:
            raise CaryatidError(f"{source}: has no ground truth to score against")
        top = next(iter(opened.truth.surfaces.values()))
        sphere = ViewSphere.around(np.array([0.0, 0.0, top.height]), config.active)
        found = opened.robot.candidates(sphere)
        first = opened.robot.T_world_camera
        others = spread_out(found.directions, sphere.direction_of(first)[None], self.views - 1)
        for T_world_camera in (first, *found.T_world_camera[others]):
            yield opened.camera.capture(T_world_camera)

    def measure(self, source: str) -> list[Row]:
        """Segment the views of one source; return one row per view."""
        config, rows = read_settings(None, self.set), []
        for number, view in enumerate(self.views_of(source, config)):
            rng = np.random.default_rng(self.seed)
            seen = observe(view, config, segmentation="auto", known=(), rng=rng)
            if seen.view is None or view.labels is None:
                raise CaryatidError(f"{view.name}: has no masks to compare with")
            started = time.perf_counter()
            labels = segment_view(seen.view, seen.surfaces, config, rng)[0]
            known = {"source": Path(source).name, "view": number, "seconds": time.perf_counter() - started}
            rows.append(known | compare(labels[view.valid], view.labels[view.valid]))
        return rows

    def run(self, console: Console) -> int:
        """Segment all views, print sums by family and the worst views, and compare."""
        rows = pd.DataFrame([row for part in self.each(self.measure, self.sources) for row in part])
        sums = rows.groupby(rows["source"].map(family).rename("sources")).sum(numeric_only=True)
        print_table(sums.drop(columns="view").reset_index().round(2), console)
        worst = rows.loc[(rows["found"] - rows["true"] - rows["invented"]).nsmallest(8).index].itertuples()
        console.print(
            "worst: " + ", ".join(f"{r.source} view {r.view}: {r.found} of {r.true}" for r in worst)
        )
        self.write(rows.to_dict("records"))
        shares = sums[["found", "split", "merged"]].div(sums["true"].clip(lower=1), axis=0)
        shares["invented"] = sums["invented"] / sums["parts"].clip(lower=1)
        found = [
            Measure(f"{name}.{field}", value, "1", "higher" if field == "found" else "lower", 0.02)
            for (name, field), value in shares.stack().items()
        ]
        return self.finish(found, BASELINE, console)


def compare(labels: NDArray[np.int32], truth: NDArray[np.int32]) -> dict[str, int]:
    """Count true objects and segments, and how many are found, invented, split and merged.

    Args:
        labels: Segment of each pixel with a reading (N,).
        truth: True object of each of these pixels (N,).
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


if __name__ == "__main__":
    run_main(Segmentation)
