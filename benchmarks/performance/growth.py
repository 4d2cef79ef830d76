"""How the cost of a view grows: with points, objects, views seen and voxels; and the memory views take."""

from __future__ import annotations

import re
import resource
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from caryatid.config import SegmentationMethod
from performance.clock import PAUSE
from performance.effort import FULL, Effort
from performance.frames import Recording, capture, heap, record, sensors, table_of
from performance.rows import Median, Row, Target, exponent
from performance.turns import PARTS, SEGMENTATIONS, Episode, Turn

NOT_COUNTED = 1
"""The first view of each scene: it has no earlier ones to be laid onto."""
FIRST = 10
"""Views after which growth with them is measured."""
BINS = 12
"""Points of the curve over views, evenly spread over the logarithm."""
PATIENCE = 90.0
"""How long the views of one kind of parts may take [s]; those that were done by then count."""
MEMORY = Target(1024.0, "value")
LINEAR = Target(1.1, "value")
AXES = {
    "points": "pixels of the image",
    "objects": "objects on the table",
    "views": "views seen",
    "voxels": "voxels of the map",
}


@dataclass(frozen=True, eq=False, slots=True)
class Curve:
    """The cost of a turn over a size.

    Attributes:
        axis: Which size, of `AXES`.
        segmentation: Where parts come from.
        sizes: The sizes.
        turns: Median of the whole turn at each [s].
        stages: Medians of the stages at each [s], by name.
        shortened: Why it ends before its time; empty where it does not.
    """

    axis: str
    segmentation: SegmentationMethod
    sizes: tuple[float, ...]
    turns: tuple[float, ...]
    stages: Mapping[str, tuple[float, ...]]
    shortened: str = ""

    @property
    def exponent(self) -> float:
        """Exponent of the size the turn grows with, over the whole range."""
        return exponent(self.sizes, self.turns)

    @property
    def last_exponent(self) -> float:
        """The same over its upper half, where what does not grow weighs less."""
        half = (len(self.sizes) - 1) // 2
        return exponent(self.sizes[half:], self.turns[half:])

    def row(self) -> Row:
        """The row of the exponent; one of a shortened curve is not what is asked for, and only noted."""
        asked = LINEAR if self.axis in ("objects", "views") else None
        what = f"growth with {AXES[self.axis]}, {PARTS[self.segmentation]}"
        low, high = self.sizes[0], self.sizes[-1]
        name = f"growth.{self.axis}.{self.segmentation}"
        note = f"{low:,.0f} to {high:,.0f}; over the upper half {self.last_exponent:.2f}"
        if self.shortened:
            note = f"{self.shortened}: {self.exponent:.2f} over {note}"
        value = None if self.shortened else self.exponent
        return Row(name, what, value, "1", runs=len(self.sizes), target=asked, note=note)


def measure_growth(axis: str, effort: Effort = FULL) -> tuple[list[Row], list[Curve]]:
    """Rows and curves of one of `AXES`."""
    if axis == "views":
        return _over_views(effort)
    scenes: Mapping[str, Callable[[Effort], list[tuple[float, Recording]]]] = {
        "points": _of_points,
        "objects": _of_objects,
        "voxels": _of_voxels,
    }
    recordings = scenes[axis](effort)
    curves = [_curve(axis, name, recordings) for name in SEGMENTATIONS]
    return [curve.row() for curve in curves], curves


def _of_points(effort: Effort) -> list[tuple[float, Recording]]:
    scene, seen = heap(), effort.runs + NOT_COUNTED
    return [(float(s.width * s.height), record(scene, seen, s)) for s in sensors(effort.widths)]


def _of_objects(effort: Effort) -> list[tuple[float, Recording]]:
    return [(float(n), record(table_of(n), effort.runs + NOT_COUNTED)) for n in effort.objects]


def _of_voxels(effort: Effort) -> list[tuple[float, Recording]]:
    recording, found = record(heap(), effort.runs + NOT_COUNTED), []
    for size in effort.voxels:
        config = replace(recording.config, voxels=replace(recording.config.voxels, size=size))
        count = np.prod(np.ceil(np.array(config.voxels.extent) / size))
        found.append((float(count), replace(recording, config=config)))
    return found


def _curve(
    axis: str, segmentation: SegmentationMethod, recordings: Sequence[tuple[float, Recording]]
) -> Curve:
    """The curve over some recordings, after a warm-up with the first of them."""
    turns, stages = [], []
    go_on(recordings[0][1], segmentation)
    for _, recording in recordings:
        found = go_on(recording, segmentation)
        turns.append(Median.of([t.whole for t in found[NOT_COUNTED:]]).value)
        laps = [t.stages | {"plan": t.plan} for t in found[NOT_COUNTED:]]
        stages.append({s: Median.of([lap[s] for lap in laps]).value for s in laps[0]})
    sizes = tuple(size for size, _ in recordings)
    by_stage = {s: tuple(found[s] for found in stages) for s in stages[0]}
    return Curve(axis, segmentation, sizes, tuple(turns), by_stage)


def go_on(recording: Recording, segmentation: SegmentationMethod) -> list[Turn]:
    """Show a new scene model all views of a recording."""
    episode, found = Episode(recording, segmentation), []
    for T_world_camera, view in zip(recording.poses, recording.views, strict=True):
        time.sleep(PAUSE)
        found.append(episode.look(T_world_camera, view))
    return found


def _over_views(effort: Effort) -> tuple[list[Row], list[Curve]]:
    """Rows and curves of the views seen, and the memory they take, each in a process of its own."""
    rows, curves = [], []
    for segmentation in SEGMENTATIONS:
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            found, peak = pool.submit(many_views, segmentation, effort.views, PATIENCE).result()
        curve = binned(segmentation, found, effort.views)
        rows += [curve.row(), _memory(segmentation, len(found), effort.views, peak)]
        curves.append(curve)
    return rows, curves


def _memory(segmentation: SegmentationMethod, views: int, asked: int, peak: float) -> Row:
    name, what = f"growth.memory.{segmentation}", f"peak memory of {asked} views, {PARTS[segmentation]}"
    note = (
        "" if views == asked else f"only {views} views were done in {PATIENCE:.0f} s: {peak:.0f} MB by then"
    )
    return Row(name, what, peak if views == asked else None, "MB", target=MEMORY, note=note)


def many_views(
    segmentation: SegmentationMethod, views: int, patience: float
) -> tuple[list[tuple[float, dict[str, float]]], float]:
    """Show a scene model many views.

    Args:
        segmentation: Where parts come from.
        views: How many.
        patience: Time after which no further view is shown [s].

    Returns:
        Whole turn and stages of each view [s], and the peak memory of the process [MB].
    """
    config_of = record(heap(), 1)
    episode, found, started = Episode(config_of, segmentation), [], time.perf_counter()
    for T_world_camera, view in capture(heap(), views):
        turn = episode.look(T_world_camera, view)
        found.append((turn.whole, turn.stages | {"plan": turn.plan}))
        if time.perf_counter() - started > patience:
            break
    return found, peak_memory()


def binned(
    segmentation: SegmentationMethod, found: Sequence[tuple[float, dict[str, float]]], asked: int
) -> Curve:
    """Medians over the views between evenly spread numbers of views, from `FIRST` on."""
    edges = np.unique(np.geomspace(min(FIRST, len(found) // 2), len(found) + 1, BINS + 1).astype(int))
    bins = [range(a, b) for a, b in pairwise(edges)]
    sizes = tuple(float(np.exp(np.mean(np.log(b)))) for b in bins)
    turns = tuple(Median.of([found[v - 1][0] for v in b]).value for b in bins)
    stages = {s: tuple(Median.of([found[v - 1][1][s] for v in b]).value for b in bins) for s in found[0][1]}
    shortened = "" if len(found) == asked else f"only {len(found)} views were done in {PATIENCE:.0f} s"
    return Curve("views", segmentation, sizes, turns, stages, shortened)


def peak_memory() -> float:
    """Most memory this process had at a time [MB]; that of the process it was started by is not its own."""
    status = Path("/proc/self/status")
    if status.is_file() and (peak := re.search(r"VmHWM:\s+(\d+) kB", status.read_text(encoding="ascii"))):
        return int(peak[1]) / 1024.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
