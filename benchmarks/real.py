"""Score what the scene model makes of real recordings, by masks, by clicked annotations and by supports.

    python benchmarks/real.py FOLDERS… [--only NAMES…] [--annotations FILE] [--jobs 2] [--out FILE]

FOLDERS are BOP folders, or folders of them. Those whose names end in `-masks` run with their masks, others
with automatic segments, and recordings of several views that have masks with both. Figures are:

* of automatic segments, where every frame has masks: overlap and boundary as Xie et al. compute them for
  UOIS-Net (IEEE T-RO 2021), in each frame, then their means; and the counts of `segmentation.py`;
* where objects were clicked (`annotations.json` beside the recordings, or FILE): what is found, and which of
  the annotated supports;
* where there is a gt.json: F1 and average precision of the graph by masks;
* of several views: objects after the last one, changes, and pose warnings; with masks, how well the fitted
  shapes, projected into each view, agree with them. True shapes are not needed, but a mask that another
  object partly hides lowers this IoU.

Segments are label images, 0 where there is no reading. A frame that the scene model refuses counts as one in
which nothing is found. Times are of whole updates on one thread, without reading images.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import tyro
from measures import Row, Spread, print_table, run_main
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from rich.console import Console
from scipy.ndimage import distance_transform_edt
from scipy.optimize import linear_sum_assignment
from segmentation import compare

from caryatid.config import Config, SegmentationMethod
from caryatid.config.settings import read_settings
from caryatid.errors import CaryatidError, InputError, PerceptionError, WrongViewError
from caryatid.evaluation.scores import Forecast, average_precision, score_masks
from caryatid.geometry import polygons, transforms
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject, SupportGraph
from caryatid.io.bop import read_recording, recognises
from caryatid.io.json_files import parse_json, read_json
from caryatid.scene import Scene
from caryatid.sensing.views import MAX_LABEL, View
from caryatid.simulation.truth import read_truth

Labels = NDArray[np.int32]
ANNOTATIONS, TRUTH = "annotations.json", "gt.json"
HIT = 0.75
"""An object counts for `%75` above this F of its mask [1], as in UOIS-Net."""
CLICK = 4
"""A click means the most common label up to this far from it [px]; a hand shakes as much."""
NEAR = 60
"""Objects farther than this from all clicks are background [px], which nobody annotated."""
MASKS = ("overlap P", "overlap R", "overlap F", "boundary P", "boundary R", "boundary F", "%75")
"""Figures of UOIS-Net [%]."""
CLICKS = (
    "objects", "found", "merged", "split", "missed", "invented", "background", "edges", "right", "wrong"
)  # fmt: skip
"""Numbers that `score_clicks` counts."""
TIMES = ("median ms", "slowest ms")


@dataclass(frozen=True)
class Annotation:
    """What a person clicked in a frame: pixels (x, y) in each object, and supports; `T` is the table."""

    objects: dict[str, list[tuple[int, int]]]
    edges: list[tuple[str, str]]
    maybe: list[tuple[str, str]]
    """Supports that are a matter of opinion, and do not count."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """A recording as the scene model sees it.

    Attributes:
        graph: The graph after the last view.
        views: The views as recorded.
        labels: Label image (H, W) of each view when it was new; zeros if it was refused.
        cameras: Registered pose (4, 4) of each view, or None.
        seconds: Time of each update [s].
        refused: Number of views that are not in the model.
        changes: Number of changes reported.
        pose_warnings: Number of views reported to have a wrong pose.
    """

    graph: SupportGraph
    views: tuple[View, ...]
    labels: tuple[Labels, ...]
    cameras: tuple[Array | None, ...]
    seconds: tuple[float, ...]
    refused: int
    changes: int
    pose_warnings: int


class PoseWarnings(logging.Handler):
    """Counts warnings about poses; shows none."""

    count = 0

    def emit(self, record: logging.LogRecord) -> None:
        """Count a message."""
        self.count += record.levelno >= logging.WARNING and "pose" in record.getMessage()


@dataclass(frozen=True)
class Real(Spread):
    """Score recordings of real scenes."""

    folders: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """BOP folders, or folders of them."""
    only: tuple[str, ...] = ()
    """Names of the recordings to score. [default: all]"""
    annotations: Path | None = None
    """Clicked annotations. [default: annotations.json beside each recording]"""
    segmentation: SegmentationMethod | None = None
    """Where segments come from. [default: masks for names in -masks; both for several views with masks;
    automatic for others]"""
    tolerance: float = 6.0
    """Distance at which boundaries agree [px]; UOIS-Net has 3 px in 640 × 480 pixels."""
    seed: tuple[int, ...] = (0,)
    """Seeds; figures are means over them."""
    set: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Settings, e.g. `--set segmentation.stride=1`."""

    def run(self, console: Console) -> int:
        """Score all recordings, and print a table for each kind of truth."""
        found = [f for f in find_recordings(self.folders) if not self.only or f.name in self.only]
        if missing := {*self.only} - {f.name for f in found}:
            raise CaryatidError(f"{min(missing)}: no such recording; give the folder that contains it")
        if not found:
            raise CaryatidError("no recordings to score; give BOP folders, or folders of them")
        runs = [(folder, method) for folder in found for method in self.methods(folder)]
        rows = self.each(self.measure, [(*run, seed) for run, seed in product(runs, self.seed)])
        self.write(rows)
        show(rows, console)
        return 0

    def methods(self, folder: Path) -> tuple[SegmentationMethod, ...]:
        """Where the segments of a recording come from, once for each run."""
        if self.segmentation is not None:
            return (self.segmentation,)
        if folder.name.endswith("-masks"):
            return ("labels",)
        frames = read_recording(folder).frames
        both = len(frames) > 1 and all(frame.has_labels for frame in frames)
        return ("auto", "labels") if both else ("auto",)

    def measure(self, task: tuple[Path, SegmentationMethod, int]) -> Row:
        """Run one recording, and score it by every truth that it has."""
        folder, method, seed = task
        warm_up()
        outcome = follow(folder, method, seed, read_settings(None, self.set))
        row: Row = {"recording": folder.name, "segments": method, "seed": seed, "refused": outcome.refused}
        row |= {"ms": [1e3 * seconds for seconds in outcome.seconds]}
        truths = [view.labels for view in outcome.views if view.labels is not None]
        masked = len(truths) == len(outcome.views)
        if masked and (scored := self.score_by_masks(folder, outcome, truths, method)):
            row["masks"] = scored
        if (annotation := self.annotation(folder)) is not None:
            row["clicks"] = score_clicks(outcome.graph, outcome.labels[0], annotation)
        if len(outcome.views) > 1:
            objects = sum(o.role == "object" for o in outcome.graph.objects)
            row["views"] = {"views": len(outcome.views), "objects": objects, "changes": outcome.changes}
            row["views"] |= {"pose warnings": outcome.pose_warnings}
            row["views"] |= {"shape IoU": project_shapes(outcome)} if masked and method == "labels" else {}
        return row

    def score_by_masks(
        self, folder: Path, outcome: Outcome, truths: Sequence[Labels], method: SegmentationMethod
    ) -> Row:
        """Compare automatic segments with true masks (H, W), and the graph with gt.json, where it exists."""
        row: Row = {}
        if method == "auto":
            segments = [np.where(labels > MAX_LABEL, np.int32(0), labels) for labels in outcome.labels]
            row["frames"] = [
                compare_masks(found, true, self.tolerance) | compare(found[view.valid], true[view.valid])
                for found, true, view in zip(segments, truths, outcome.views, strict=True)
            ]
            row |= pd.DataFrame(row["frames"]).mean().to_dict()
        if (folder / TRUTH).exists():
            truth = read_truth(folder / TRUTH)
            pairs = frozenset(truth.pairs)
            found = score_masks(outcome.graph, outcome.labels, truths, truth.vertices, pairs)
            row |= {"F1": found.f1, "AP": found.average_precision, "forecasts": list(found.forecasts)}
        return row

    def annotation(self, folder: Path) -> Annotation | None:
        """What was clicked in a recording; variants with masks share it with the recording itself."""
        path = self.annotations or folder.parent / ANNOTATIONS
        if self.annotations is None and not path.exists():
            return None
        return read_annotations(path).get(folder.name.removesuffix("-masks"))


@cache
def read_annotations(path: Path) -> dict[str, Annotation]:
    """Read clicked annotations by the name of the recording.

    Raises:
        InputError: The file is missing or broken.
    """
    remedy = "give the objects, edges and maybe of each recording"
    return parse_json(dict[str, Annotation], read_json(path, remedy), path, remedy)


def find_recordings(folders: Iterable[Path]) -> list[Path]:
    """List BOP folders, and those in other folders, each once.

    Raises:
        InputError: A folder is not there, or has none.
    """
    found: list[Path] = []
    for folder in map(Path.resolve, folders):
        inside = [folder] if recognises(folder) else sorted(filter(recognises, folder.glob("*")))
        if not inside:
            raise InputError(folder, "has no recordings", "give BOP folders, or folders of them")
        found += inside
    return list(dict.fromkeys(found))


@cache
def warm_up() -> None:
    """Load the compiled kernels of this process, which would count as time of the first frame."""
    for method in ("labels", "auto"):
        Scene(segmentation=method).update(read_recording("sample-recording")[0])


def follow(folder: Path, segmentation: SegmentationMethod, seed: int, config: Config) -> Outcome:
    """Update a scene with every view of a recording."""
    scene, views = Scene(config, segmentation=segmentation, seed=seed), tuple(read_recording(folder))
    labels, cameras, seconds = list[Labels](), list[Array | None](), list[float]()
    log, warnings = logging.getLogger("caryatid"), PoseWarnings()
    log.addHandler(warnings)
    for view in views:
        before, started = scene.views, time.perf_counter()
        try:
            scene.update(view)
        except WrongViewError:
            warnings.count += 1
        except PerceptionError:
            pass  # It shows no support surface, and has no pose with which to wait for one.
        seconds.append(time.perf_counter() - started)
        taken = scene.labels if scene.views > before else None
        labels.append(np.zeros(view.depth.shape, dtype=np.int32) if taken is None else taken)
        cameras.append(None if taken is None else scene.T_world_camera)
    log.removeHandler(warnings)
    counts = len(views) - scene.views, len(scene.changes), warnings.count
    return Outcome(scene.graph, views, tuple(labels), tuple(cameras), tuple(seconds), *counts)


def compare_masks(labels: Labels, truth: Labels, tolerance: float) -> dict[str, float]:
    """Compute the figures of UOIS-Net [%]: segments are paired with true masks (Hungarian) for the largest F.

    Pixels, and those of boundaries, are pooled over all pairs of a frame. A pixel of a boundary is right if
    the other boundary of the pair passes within the tolerance.

    Args:
        labels: Segment of each pixel (H, W), 0 = none.
        truth: True object of each pixel (H, W).
        tolerance: Distance [px].
    """
    masks = [[image == k for k in np.unique(image[image > 0])] for image in (labels, truth)]
    found, true = masks
    if not found or not true:
        either, both_empty = (100.0 * (not found), 100.0 * (not true)), 100.0 * (not found and not true)
        return dict(zip(MASKS, (*either, both_empty, *either, both_empty, both_empty), strict=True))
    both = np.array([[np.count_nonzero(a & b) for b in true] for a in found])
    sizes, true_sizes = (np.array([np.count_nonzero(mask) for mask in group]) for group in masks)
    f = 2.0 * both / (sizes[:, None] + true_sizes)
    pairs = linear_sum_assignment(f, maximize=True)
    edges, true_edges = ([boundary(mask) for mask in group] for group in masks)
    right = met = 0
    for i, j in zip(*pairs, strict=True):
        right += int(np.count_nonzero(edges[i] & near(true_edges[j], tolerance)))
        met += int(np.count_nonzero(true_edges[j] & near(edges[i], tolerance)))
    overlap = shares(both[pairs].sum(), sizes.sum(), both[pairs].sum(), true_sizes.sum())
    borders = shares(right, float(np.sum(edges)), met, float(np.sum(true_edges)))
    hits = np.count_nonzero(f[pairs] > HIT) / len(true)
    return {name: 100.0 * float(v) for name, v in zip(MASKS, (*overlap, *borders, hits), strict=True)}


def shares(right: float, claimed: float, met: float, true: float) -> tuple[float, float, float]:
    """Precision, recall and their harmonic mean, 0 if both are."""
    precision, recall = right / claimed, met / true
    return precision, recall, 2.0 * precision * recall / max(precision + recall, 1e-12)


def boundary(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels (H, W) that differ from the one to the right, below, or both, as in the DAVIS benchmark."""
    wide = np.pad(mask, ((0, 1), (0, 1)), mode="edge")
    return (mask ^ wide[:-1, 1:]) | (mask ^ wide[1:, :-1]) | (mask ^ wide[1:, 1:])


def near(edge: NDArray[np.bool_], tolerance: float) -> NDArray[np.bool_]:
    """Pixels (H, W) within a distance [px] of an edge: its dilation by a disc."""
    if not edge.any():
        return edge
    distances: Array = distance_transform_edt(~edge)
    return distances <= tolerance


def score_clicks(graph: SupportGraph, labels: Labels, annotation: Annotation) -> Row:
    """Count clicked objects and annotated supports, with the supports' forecasts as those of `Score`.

    An object is found if all its clicks on objects lie in one of the graph that no other annotated object
    shares, merged if it shares one, split if they lie in several, and missed if none is on an object of the
    graph. An object without a click is invented, or background if it is far from all clicks. A support
    between annotated objects, or any support surface, is right or wrong; of a merged object, it is right only
    if it is right for all of the objects in it.

    Args:
        graph: The extracted graph.
        labels: Label image (H, W) of the clicked frame.
        annotation: What was clicked.
    """
    ids = {o.label: o.id for o in graph.movable}
    clicks = {
        name: [label for click in points if 0 < (label := label_at(labels, *click)) <= MAX_LABEL]
        for name, points in annotation.objects.items()
    }
    owners: dict[int, list[str]] = {}
    for name, hit in clicks.items():
        if hit:
            owners.setdefault(Counter(hit).most_common(1)[0][0], []).append(name)
    merged = {name for names in owners.values() if len(names) > 1 for name in names}
    missed = {*clicks} - {name for label, names in owners.items() if label in ids for name in names}
    split = {name for name, hit in clicks.items() if len(set(hit)) > 1} - merged - missed
    others = ids.keys() - {label for hit in clicks.values() for label in hit}
    invented = sum(is_near(labels == label, annotation) for label in others)
    names = {o.id: ["T"] for o in graph.support_surfaces}
    names |= {ids[label]: owned for label, owned in owners.items() if label in ids}
    for name, hit in clicks.items():
        for label in ids.keys() & {*hit}:
            names.setdefault(ids[label], [name])
    right, wrong, judged = judge_supports(graph, names, annotation)
    counts = len(clicks), len({*clicks} - merged - missed - split), len(merged), len(split), len(missed)
    rest = invented, len(others) - invented, len({*annotation.edges}), right, wrong
    row: Row = dict(zip(CLICKS, (*counts, *rest), strict=True))
    return row | ({"AP": average_precision(judged)} if judged else {}) | {"forecasts": judged}


def judge_supports(
    graph: SupportGraph, names: dict[str, list[str]], annotation: Annotation
) -> tuple[int, int, list[Forecast]]:
    """Count the right annotated supports and the wrong ones of a graph, and return the forecasts.

    Args:
        graph: The extracted graph.
        names: Names of the annotated objects in each of its objects, by id.
        annotation: What was clicked.
    """
    true, accepted = {*annotation.edges}, {*annotation.edges, *annotation.maybe}
    right, wrong = dict[tuple[str, str], float](), list[float]()
    for support in graph.supports:
        ends = names.get(support.supporter, ()), names.get(support.supported, ())
        pairs = {pair for pair in product(*ends) if pair[0] != pair[1]}
        if pairs and pairs <= true:
            right |= dict.fromkeys(pairs, support.belief)
        elif pairs and not pairs & accepted:
            wrong.append(support.belief)
    there = {name for owned in names.values() for name in owned}
    lacking = sum({*pair} <= there for pair in true - right.keys())
    judged = [*(Forecast(p, True) for p in right.values()), *(Forecast(p, False) for p in wrong)]
    return len(right), len(wrong), judged + [Forecast(0.0, True)] * lacking


def label_at(labels: Labels, x: int, y: int) -> int:
    """Return the most common label around a pixel.

    Raises:
        CaryatidError: The pixel is outside the image.
    """
    if not (0 <= x < labels.shape[1] and 0 <= y < labels.shape[0]):
        size = "×".join(map(str, labels.shape[::-1]))
        raise CaryatidError(
            f"({x}, {y}) was clicked, which is outside the {size} pixels; correct the annotation"
        )
    around = labels[max(0, y - CLICK) : y + CLICK + 1, max(0, x - CLICK) : x + CLICK + 1]
    return int(np.bincount(around.ravel()).argmax())


def is_near(mask: NDArray[np.bool_], annotation: Annotation) -> bool:
    """Whether the middle of a mask (H, W) is among the clicks; also if no pixel shows the object."""
    points = np.array([point for clicked in annotation.objects.values() for point in clicked])
    middle = np.median(np.argwhere(mask)[:, ::-1], axis=0) if mask.any() else points[0]
    return bool((middle >= points.min(axis=0) - NEAR).all() and (middle <= points.max(axis=0) + NEAR).all())


def project_shapes(outcome: Outcome) -> float:
    """Mean IoU [1] of masks with the projected shapes of their labels; 0 for those without a shape."""
    shapes = {o.label: o for o in outcome.graph.movable}
    ious = []
    for view, T_world_camera in zip(outcome.views, outcome.cameras, strict=True):
        assert view.labels is not None
        for label in np.unique(view.labels[view.labels > 0]).tolist():
            if label not in shapes or T_world_camera is None:
                ious.append(0.0)
                continue
            mask, drawn = view.labels == label, silhouette(shapes[label], view, T_world_camera)
            ious.append(np.count_nonzero(mask & drawn) / np.count_nonzero(mask | drawn))
    return float(np.mean(ious))


def silhouette(o: SceneObject, view: View, T_world_camera: Array) -> NDArray[np.bool_]:
    """Pixels (H, W) of the convex hull of an object's shape in a view, as if nothing else were there."""
    points = transforms.transform(transforms.invert(T_world_camera), o.shape.outline()) @ view.K.T
    image = Image.new("1", view.depth.shape[::-1])
    if (points[:, 2] > 0.0).all():
        corners = polygons.hull(np.ascontiguousarray(points[:, :2] / points[:, 2:]))
        ImageDraw.Draw(image).polygon([(float(x), float(y)) for x, y in corners], fill=1)
    return np.array(image, dtype=np.bool_)


def show(rows: Sequence[Row], console: Console) -> None:
    """Print a table for each kind of truth: means over seeds, and over or of all recordings."""
    for group, sum_up in (("masks", mean_figures), ("clicks", share_clicks), ("views", None)):
        table = pd.DataFrame([row | row[group] | times(row["ms"]) for row in rows if group in row])
        if table.empty:
            continue
        known = dict.fromkeys(name for row in rows for name in row.get(group, ()))
        columns = [*(name for name in known if name not in ("frames", "forecasts")), "refused", *TIMES]
        means = table.groupby(["recording", "segments"], sort=False)[columns].mean()
        console.print(f"{group}:")
        print_table(means.reset_index().round(2), console)
        if sum_up is not None:
            sums = {method: sum_up(part, columns) for method, part in table.groupby("segments")}
            print_table(pd.DataFrame(sums).T.rename_axis("segments").reset_index().round(2), console)
    every = times([ms for row in rows for ms in row["ms"]])
    console.print("time per frame: " + ", ".join(f"{name} {ms:.0f}" for name, ms in every.items()))


def times(ms: Sequence[float]) -> dict[str, float]:
    """Median and longest of durations [ms]."""
    return {"median ms": float(np.median(ms)), "slowest ms": max(ms)}


def pooled(table: pd.DataFrame) -> dict[str, float]:
    """Average precision [1] of all forecasts of a table, if it has any."""
    lists = [] if "forecasts" not in table else table["forecasts"].dropna().tolist()
    return {"pooled AP": average_precision([f for part in lists for f in part])} if lists else {}


def mean_figures(table: pd.DataFrame, columns: Sequence[str]) -> dict[str, float]:
    """Means over recordings, and the average precision of all their forecasts."""
    return {"mean of": len(table)} | table[columns].mean().dropna().to_dict() | pooled(table)


def share_clicks(table: pd.DataFrame, columns: Sequence[str]) -> dict[str, float]:
    """Shares of the objects and supports of all recordings [%]; invented ones per 100 that are found."""
    total = table[list(CLICKS)].sum()
    of_objects = {f"{name} %": 100.0 * total[name] / total["objects"] for name in CLICKS[1:5]}
    of_edges = {
        "right %": 100.0 * total["right"] / max(total["edges"], 1),
        "wrong %": 100.0 * total["wrong"] / max(total["right"] + total["wrong"], 1),
    }
    invented = {"invented per 100": 100.0 * total["invented"] / max(total["found"], 1)}
    return {"recordings": len(table)} | of_objects | invented | of_edges | pooled(table)


if __name__ == "__main__":
    run_main(Real)
