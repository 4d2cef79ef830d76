"""The turn, perceiving alone and each stage, against Open3D's chain on the same frames and the limit."""

from __future__ import annotations

import copy
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from caryatid import Scene, View, next_best_view
from caryatid.config import SegmentationMethod
from caryatid.geometry.transforms import Array
from caryatid.planning.expected_visibility import SURFACE_SAMPLES
from caryatid.segmentation.observation import MAX_POINTS, UP
from caryatid.segmentation.segments import segment
from caryatid.segmentation.support_plane import find_support_surface
from caryatid.sensing.clouds import oriented_points
from performance import limits
from performance.clock import PAUSE, in_turns, timed
from performance.effort import FULL, Effort
from performance.frames import Recording, fresh, heap, record
from performance.peers import Missing, open3d_chain
from performance.rows import Median, Row, Target, timed_row

SEGMENTATIONS: tuple[SegmentationMethod, ...] = ("auto", "labels")
CHAIN = "Open3D's chain"
TURN = Target(1.0 / 2.0, aim=1.0 / 3.0)
PERCEIVE = Target(1.0 / 4.0)
TARGETS = {"turn.auto": TURN, "turn.labels": TURN, "perceive.labels": PERCEIVE}
PARTS = {"auto": "automatic parts", "labels": "labels given"}
SHAPE_NUMBERS = 22
"""Numbers a fitted shape is told by [1]: pose and size, and how sure each is."""


@dataclass(frozen=True, slots=True)
class Turn:
    """What one turn took [s].

    Attributes:
        perceive: From the camera's images to the fused graph.
        plan: From the graph to the next view.
        stages: Of the update, by name.
    """

    perceive: float
    plan: float
    stages: dict[str, float]

    @property
    def whole(self) -> float:
        """From the images to the next view [s]."""
        return self.perceive + self.plan


class Episode:
    """A scene model that is shown a recording's views one by one, each as its images.

    Args:
        recording: Where the views come from.
        segmentation: Where parts come from.

    Attributes:
        scene: The model.
    """

    def __init__(self, recording: Recording, segmentation: SegmentationMethod) -> None:
        self.scene = Scene(recording.config, segmentation=segmentation)
        self._robot, self._labels = copy.copy(recording.robot), segmentation == "labels"
        self._visited: list[Array] = []

    def look(self, T_world_camera: Array, view: View) -> Turn:
        """Take in a view from a pose and choose the next one."""
        self._robot.move_to(T_world_camera)
        started = time.perf_counter()
        self.scene.update(fresh(view, labels=self._labels))
        known = time.perf_counter()
        assert self.scene.sphere is not None
        self._visited.append(self.scene.sphere.direction_of(T_world_camera))
        next_best_view(self.scene, self._robot, np.array(self._visited))
        return Turn(known - started, time.perf_counter() - known, dict(self.scene.timings))


Turns = Mapping[str, Sequence[Sequence[Turn]]]
"""Segmentation → repeat → view."""


def go_through(recording: Recording, effort: Effort = FULL) -> tuple[Turns, list[list[float]] | Missing]:
    """Show the views to Open3D's chain and to a scene model for each kind of parts, in turns.

    After a warm-up all of them are gone through, and then the first one alone, for its median.

    Returns:
        What each turn took, and what the chain took [s] by repeat and view.
    """
    chains = [open3d_chain(view, recording.config.cloud.max_depth) for view in recording.views]
    turns: dict[str, list[list[Turn]]] = {name: [] for name in SEGMENTATIONS}
    chained: list[list[float]] = []
    missing: Missing | None = None
    for repeat in range(max(effort.runs, effort.repeats) + 1):
        count = len(recording.views) if repeat <= effort.repeats else 1
        episodes = {name: Episode(recording, name) for name in SEGMENTATIONS}
        found: dict[str, list[Turn]] = defaultdict(list)
        took = []
        for k in range(count):
            T_world_camera, view, chain = recording.poses[k], recording.views[k], chains[k]
            if isinstance(chain, Missing):
                missing = chain
            else:
                took.append(timed(chain, warm=False)[0])
            for name, episode in episodes.items():
                time.sleep(PAUSE)
                found[name].append(episode.look(T_world_camera, view))
        chained.append(took)
        for name in SEGMENTATIONS:
            turns[name].append(found[name])
    warm = {name: found_by_repeat[1:] for name, found_by_repeat in turns.items()}
    return warm, chained[1:] if missing is None else missing


def measure_turns(effort: Effort = FULL) -> list[Row]:
    """Rows of the turn, of perceiving, and of the stages."""
    recording = record(heap())
    turns, chain = go_through(recording, effort)
    return compared(turns, chain, recording) + stages(turns, recording, effort)


def compared(turns: Turns, chain: Sequence[Sequence[float]] | Missing, recording: Recording) -> list[Row]:
    """Rows of the turn and of perceiving, of later views and of the first one, against the chain."""
    view = recording.views[0]
    images = view.depth.nbytes + (0 if view.rgb is None else view.rgb.nbytes)
    bound = limits.machine().limit(images)
    rows = []
    for kind, what in (("turn", "view in → next view"), ("perceive", "view in → graph")):
        for segmentation, repeats in turns.items():
            for which, part in (("", slice(1, None)), (".first", slice(0, 1))):
                name, ending = f"{kind}.{segmentation}{which}", ", first view alone" if which else ""
                there = None if isinstance(chain, Missing) else [s for took in chain for s in took[part]]
                row = timed_row(
                    name,
                    f"{what}, {PARTS[segmentation]}{ending}",
                    Median.of([_of(t, kind) for turn in repeats for t in turn[part]]),
                    peer=CHAIN,
                    theirs=None if there is None else Median.of(there),
                    limit=bound,
                    target=TARGETS.get(name),
                    note=chain.reason if isinstance(chain, Missing) else "",
                )
                rows.append(row)
    return rows


def stages(turns: Turns, recording: Recording, effort: Effort) -> list[Row]:
    """Rows of the stages: of the turns' own, and of those that can be called by themselves."""
    machine = limits.machine()
    bounds = _stage_limits(recording)
    rows = []
    for name, (what, call, bound) in _calls(recording).items():
        found = in_turns({name: call}, 3 * effort.runs)[name]
        rows.append(timed_row(f"stage.{name}", what, Median.of(found), limit=machine.limit(*bound)))
    for segmentation, repeats in turns.items():
        later = [turn for repeat in repeats for turn in repeat[1:]]
        laps = {stage: [t.stages[stage] for t in later] for stage in later[0].stages}
        laps["plan"] = [t.plan for t in later]
        for stage, took in laps.items():
            stage_bound = bounds.get(stage)
            rows.append(
                timed_row(
                    f"stage.{segmentation}.{stage}",
                    f"{stage}, in the turn with {PARTS[segmentation]}",
                    Median.of(took),
                    limit=None if stage_bound is None else machine.limit(*stage_bound),
                )
            )
    return rows


def _calls(recording: Recording) -> dict[str, tuple[str, Callable[[], object], tuple[float, float]]]:
    """Stages that can be called by themselves, on the first view: words, call, bytes and operations."""
    config, view = recording.config, recording.views[0]
    points, normals, pixels = oriented_points(view, config.cloud)
    assert view.labels is not None
    loose = np.flatnonzero(view.labels.ravel()[pixels] == 0)
    loose = loose[:: max(1, len(loose) // MAX_POINTS)]

    def surface() -> object:
        rng = np.random.default_rng(0)
        return find_support_surface(points[loose], normals[loose], UP, config.surface, rng)

    found = find_support_surface(points[loose], normals[loose], UP, config.surface, np.random.default_rng(0))

    def parts() -> object:
        rng = np.random.default_rng(0)
        bare = fresh(view, labels=False)
        return segment(bare, found, config.segmentation, config.cloud, config.fit, rng)

    pixel_count = view.depth.size
    return {
        "points": (
            "oriented points of a view",
            lambda: oriented_points(fresh(view), config.cloud),
            limits.points_limit(pixel_count, len(points)),
        ),
        "surface": ("support surface among them", surface, (48.0 * len(loose), 0.0)),
        "parts": ("automatic parts of a view", parts, (8.0 * pixel_count, 0.0)),
    }


def _stage_limits(recording: Recording) -> dict[str, tuple[float, float]]:
    """Bytes and operations of the turn's stages."""
    config, view = recording.config, recording.views[0]
    assert view.labels is not None
    voxels = float(np.prod(np.ceil(np.array(config.voxels.extent) / config.voxels.size)))
    on_objects = int(np.count_nonzero(view.labels[view.valid]))
    objects = len(np.unique(view.labels)) - 1
    active = config.active
    points = limits.points_limit(view.depth.size, int(view.valid.sum()))
    return {
        "segment": points,
        "register": (48.0 * view.valid.sum(), 0.0),
        "map": limits.map_limit(view.depth.size, int(voxels)),
        "fit": limits.fit_limit(on_objects),
        "infer": (8.0 * SHAPE_NUMBERS * objects, 12.0 * objects * (objects - 1) / 2.0),
        "fuse": (8.0 * SHAPE_NUMBERS * objects, 0.0),
        "plan": limits.plan_limit(int(voxels), active.sphere_points, SURFACE_SAMPLES, active.look_directions),
    }


def _of(turn: Turn, kind: str) -> float:
    return turn.whole if kind == "turn" else turn.perceive
