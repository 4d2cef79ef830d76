"""One measurement of accuracy: a run of the loop, or the extraction of a recording, scored view by view."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from caryatid.config import Config, FusionMethod, NoiseModel, SegmentationMethod
from caryatid.config.settings import read_settings
from caryatid.errors import CaryatidError
from caryatid.evaluation.scores import Score, score, score_masks

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
"""Set to 1 in the processes, unless set already: the jobs share the cores."""
LEAST_READINGS = 200
"""Objects of which a simulated frame shows less are not in its truth [px]; 2 cm at 1 m."""


@dataclass(frozen=True)
class Row:
    """One view of one episode.

    Attributes:
        scene: Name of the scene or recording.
        planner: Planner of an episode, segmentation of a recording.
        seed: Seed of noise and choices.
        view: Number of the view, 0 the first.
        f1: Vertices and edges together [1].
        edge_precision: Edges alone [1].
        edge_recall: Edges alone [1].
        vertex_precision: Vertices alone, the table included [1].
        vertex_recall: Vertices alone, the table included [1].
        mean_iou: Of the matched objects [1].
        objects: True objects, the table left out.
        returned: Extracted objects, the table left out.
        matched: Extracted objects that are true ones.
        angle: Travelled so far [rad].
        path: Travelled so far [m].
        seconds: What this view took.
    """

    scene: str
    planner: str
    seed: int
    view: int
    f1: float
    edge_precision: float
    edge_recall: float
    vertex_precision: float
    vertex_recall: float
    mean_iou: float
    objects: int
    returned: int
    matched: int
    angle: float = 0.0
    path: float = 0.0
    seconds: float = 0.0


@dataclass(frozen=True)
class Episode:
    """One run of the loop.

    Attributes:
        scene: Scene folder, or name of a built-in scene.
        views: Views it has.
        noise: Of the camera.
        segmentation: Where parts come from.
        settings: Changes of the default settings, `section.name=value`.
        fusion: What is fused.
        planner: Chooses the views.
        seed: Seed of noise and choices.
        early_stop: Stop when a view changed nothing; its scores then stand for the later views.
    """

    scene: str
    views: int
    noise: NoiseModel = "carmine"
    segmentation: SegmentationMethod = "labels"
    settings: tuple[str, ...] = ()
    fusion: FusionMethod = "pc+sg"
    planner: str = "support"
    seed: int = 0
    early_stop: bool = False

    def run(self) -> list[Row]:
        """Explore and score every view."""
        from caryatid.exploration import explore
        from caryatid.sources import open_source

        config = read_settings(None, self.settings)
        config = replace(
            config,
            fusion=replace(config.fusion, method=self.fusion),
            active=replace(config.active, max_views=self.views),
        )
        source = open_source(
            self.scene, config, noise=self.noise, segmentation=self.segmentation, seed=self.seed
        )
        if source.truth is None:
            raise CaryatidError(f"{self.scene}: has no truth to score against")
        rows: list[Row] = []
        for step in explore(
            source.camera,
            source.robot,
            planner=self.planner,
            config=config,
            segmentation=self.segmentation,
            seed=self.seed,
            early_stop=self.early_stop,
        ):
            s = score(step.graph, source.truth, np.random.default_rng(0))
            row = _row(
                source.name, self.planner, step.index, s, len(source.truth.objects), len(step.graph.objects)
            )
            seconds = sum(v for k, v in step.timings.items() if k != "capture")
            angle, path = step.angle_travelled, step.path_travelled
            rows.append(replace(row, seed=self.seed, angle=angle, path=path, seconds=seconds))
        return rows + [replace(rows[-1], view=v) for v in range(len(rows), self.views)]


@dataclass(frozen=True)
class Extraction:
    """The extraction of one recording, all its frames one after the other.

    Attributes:
        source: BOP folder with masks and gt.json, or name of a built-in scene: then a single simulated frame
            from where the robot starts, without a pose, is recorded first.
        segmentation: Where parts come from.
        settings: Changes of the default settings, `section.name=value`.
        seed: Seed of noise and choices.
    """

    source: str
    segmentation: SegmentationMethod = "labels"
    settings: tuple[str, ...] = ()
    seed: int = 0

    def run(self) -> list[Row]:
        """Extract, and score the graph after each frame by the pixels of all frames so far."""
        from caryatid.simulation.scenes import is_builtin

        config = read_settings(None, self.settings)
        if not is_builtin(self.source):
            return self._extract(Path(self.source), config)
        with TemporaryDirectory() as folder:
            recording = Path(folder) / self.source
            record_frame(self.source, recording, config, self.seed)
            return self._extract(recording, config)

    def _extract(self, folder: Path, config: Config) -> list[Row]:
        from caryatid.io.bop import read_recording
        from caryatid.scene import Scene
        from caryatid.simulation.truth import read_truth

        truth = read_truth(folder / "gt.json")
        scene = Scene(config, segmentation=self.segmentation, seed=self.seed)
        labels: list[NDArray[np.int32]] = []
        true_labels: list[NDArray[np.int32]] = []
        rows = []
        for index, frame in enumerate(read_recording(folder).frames):
            started = time.perf_counter()
            graph = scene.update(frame.load())
            seconds = time.perf_counter() - started
            assert scene.labels is not None
            labels.append(scene.labels)
            true_labels.append(frame.load_labels())
            s = score_masks(graph, labels, true_labels, truth.vertices, frozenset(truth.pairs))
            row = _row(folder.name, self.segmentation, index, s, len(truth.vertices) - 1, len(graph.objects))
            rows.append(replace(row, seed=self.seed, seconds=seconds))
        return rows


def record_frame(scene: str, folder: Path, config: Config, seed: int) -> None:
    """Record the robot's first view of a built-in scene: one noisy frame without a pose, and gt.json.

    Args:
        scene: Its name.
        folder: BOP folder to write; must not exist.
        config: Sensor, noise and robot.
        seed: Seed of the noise.
    """
    from caryatid.io import write_recording
    from caryatid.simulation.scenes import load_scene
    from caryatid.simulation.setup import make_simulation
    from caryatid.simulation.truth import GroundTruth, TrueEdge, ground_truth, write_truth

    simulated = load_scene(scene)
    stage = make_simulation(simulated, config, noise="carmine", seed=seed)
    view = stage.camera.capture(stage.robot.T_world_camera)
    assert view.labels is not None
    shown, counts = np.unique(view.labels[view.valid], return_counts=True)
    kept = [int(k) for k in shown[counts >= LEAST_READINGS] if k > 0]
    labels = np.where(np.isin(view.labels, kept), view.labels, np.int32(0))
    write_recording(folder, [replace(view, labels=labels, T_world_camera=None)])
    names = {simulated.object_bodies[k]: f"object{k}" for k in kept} | {simulated.table: "table"}
    edges = tuple(
        TrueEdge(supporter=names[e["supporter"]], supported=names[e["supported"]], kind=e["kind"])
        for e in ground_truth(simulated).edges
        if e["supporter"] in names and e["supported"] in names
    )
    write_truth(GroundTruth(("table", *(f"object{k}" for k in kept)), edges), folder / "gt.json")


def run(task: Episode | Extraction) -> list[Row]:
    """Run a measurement: what a process of the pool is given."""
    return task.run()


def family(scene: str) -> str:
    """Kind of a scene, from its name: letters before the number; designed ones have no number."""
    matched = re.match(r"(pile|ycb|dense|packed|test|learn)", scene)
    return matched[1] if matched else "designed"


def found(rows: Sequence[Row]) -> float:
    """Share of the true objects that were found, over all rows together."""
    return sum(r.matched for r in rows) / max(sum(r.objects for r in rows), 1)


def invented(rows: Sequence[Row]) -> float:
    """Share of the extracted objects that are no true ones, over all rows together."""
    returned = sum(r.returned for r in rows)
    return (returned - sum(r.matched for r in rows)) / max(returned, 1)


def _row(name: str, planner: str, view: int, s: Score, objects: int, vertices: int) -> Row:
    return Row(
        scene=name,
        planner=planner,
        seed=0,
        view=view,
        f1=s.f1,
        edge_precision=s.edge_precision,
        edge_recall=s.edge_recall,
        vertex_precision=s.vertex_precision,
        vertex_recall=s.vertex_recall,
        mean_iou=s.mean_iou,
        objects=objects,
        returned=vertices - 1,
        matched=len(s.ious),
    )
