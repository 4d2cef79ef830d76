"""The settings whose figures are kept: named suites of built-in scenes, figures of them, and targets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from episodes import Episode, Extraction, Row, family, found, invented
from measures import Measure
from rich.console import Console
from rich.table import Table

from caryatid.config import SegmentationMethod

EASY = (
    *("tower", "bridge", "counterweight", "leaning_plank", "hidden_stack", "shelf", "clutter"),
    *(f"pile-{size}-{seed}" for seed, size in enumerate(range(4, 16, 2), start=1)),
)
"""Designed scenes, and piles of 4–14 primitives."""
FEW_DENSE = tuple(f"dense-{size}-{seed}" for seed, size in enumerate(range(10, 18, 2), start=1))
"""The dense scenes of the built-in suite."""
BUILT_IN = (*EASY, *FEW_DENSE)
"""The built-in suite: what is explored and segmented where no scenes are given."""
DENSE = tuple(f"dense-{10 + seed % 8}-{seed}" for seed in range(200, 216))
"""Heaps of 10–17 objects between screens and walls, of seeds nothing was developed with."""
PACKED = tuple(f"packed-20-{seed}" for seed in range(1, 6))
"""Twenty objects, each touching another."""

SHARES = ("f1", "edge_recall", "mean_iou")
"""Figures of which the mean over scenes is taken."""
POOLED = {"found": (found, "higher"), "invented": (invented, "lower")}
"""Figures of all scenes' objects together, and which way is better."""


@dataclass(frozen=True)
class Suite:
    """Scenes under one setting.

    Attributes:
        scenes: Names of built-in scenes.
        scored: After how many views figures are taken.
        segmentation: Where parts come from.
        tolerance: How much worse than the baseline a figure may be [1]: three times the largest standard
            deviation a figure of the suite has over seeds, which is twice that of a difference of two runs.
        settings: Changes of the default settings.
        figures: What is kept, of `SHARES` and `POOLED`.
        frames: Single frames of the scenes are extracted instead of exploring them.
        against: Suite of undisturbed scenes; how far F1 falls below its is kept too.
    """

    scenes: tuple[str, ...]
    scored: tuple[int, ...]
    segmentation: SegmentationMethod
    tolerance: float
    settings: tuple[str, ...] = ()
    figures: tuple[str, ...] = SHARES
    frames: bool = False
    against: str | None = None

    def tasks(self, seeds: int) -> list[Episode | Extraction]:
        """All measurements, for seeds 0…n−1."""
        tasks: list[Episode | Extraction] = []
        for scene in self.scenes:
            for seed in range(seeds):
                if self.frames:
                    tasks.append(Extraction(scene, self.segmentation, self.settings, seed))
                else:
                    episode = Episode(scene, max(self.scored), segmentation=self.segmentation, seed=seed)
                    tasks.append(replace(episode, settings=self.settings))
        return tasks


SUITES: Mapping[str, Suite] = {
    "labels": Suite((*EASY, *DENSE), (5, 10), "labels", 0.02),
    "auto": Suite((*EASY, *DENSE), (5, 10), "auto", 0.03),
    "packed": Suite(PACKED, (5,), "auto", 0.04, figures=("f1", "found", "invented")),
    "noise": Suite(
        (*EASY, *DENSE),
        (5,),
        "labels",
        0.02,
        settings=("noise.axial=[0.0048,0.0076,0.4]",),
        figures=("f1",),
        against="labels",
    ),
    "registration": Suite(
        (*EASY, *DENSE),
        (5,),
        "labels",
        0.02,
        settings=("noise.translation=0.01", "noise.rotation=1.0"),
        figures=("f1", "mean_iou"),
        against="labels",
    ),
    "frames-labels": Suite(EASY, (1,), "labels", 0.02, figures=("f1",), frames=True),
    "frames-auto": Suite(EASY, (1,), "auto", 0.04, figures=("f1", "found", "invented"), frames=True),
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
"""What is asked for; of `frames` it is asked for real frames, see `accuracy.py extract`."""


def measures(rows_of: Mapping[str, list[Row]]) -> list[Measure]:
    """Figures of suites from their rows, named `suite.scenes.figure@views`.

    Args:
        rows_of: The rows of each suite that was run.
    """
    kept = []
    for name, rows in rows_of.items():
        suite = SUITES[name]
        for group, views, part in _parts(suite, rows):
            prefix = name if len({_group(s) for s in suite.scenes}) == 1 else f"{name}.{group}"
            for figure in suite.figures:
                value, better = _figure(figure, part)
                kept.append(Measure(f"{prefix}.{figure}@{views}", value, "1", better, suite.tolerance))
            for other, other_views, undisturbed in _parts(suite, rows_of.get(suite.against or "", [])):
                if (other, other_views) == (group, views):
                    fall = _figure("f1", undisturbed)[0] - _figure("f1", part)[0]
                    kept.append(Measure(f"{prefix}.fall@{views}", fall, "1", "lower", suite.tolerance))
    return kept


def show(found_measures: list[Measure], console: Console) -> None:
    """Print the figures beside what is asked for."""
    table = Table(title="accuracy")
    for column in ("measure", "value", "± tolerated", "asked for"):
        table.add_column(column)
    for m in found_measures:
        target = TARGETS.get(m.name)
        text = "" if target is None else f"{'≥' if m.better == 'higher' else '≤'} {target:g}"
        missed = target is not None and (m.value < target if m.better == "higher" else m.value > target)
        table.add_row(m.name, f"{m.value:.3f}", f"{m.tolerance:g}", text + (" missed" if missed else ""))
    console.print(table)


def _parts(suite: Suite, rows: list[Row]) -> list[tuple[str, int, list[Row]]]:
    """(group of scenes, views, rows after so many views), for every group and number of views."""
    groups = dict.fromkeys(_group(scene) for scene in suite.scenes)
    return [
        (group, views, part)
        for group in groups
        for views in suite.scored
        if (part := [r for r in rows if r.view == views - 1 and _group(r.scene) == group])
    ]


def _figure(name: str, rows: list[Row]) -> tuple[float, str]:
    """Value of a figure, and which way is better."""
    if name in POOLED:
        pool, better = POOLED[name]
        return pool(rows), better
    return float(np.mean([getattr(r, name) for r in rows])), "higher"


def _group(scene: str) -> str:
    """Easy, dense or packed."""
    kind = family(scene)
    return kind if kind in ("dense", "packed") else "easy"
