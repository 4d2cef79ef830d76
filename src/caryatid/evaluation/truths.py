"""What a run is scored against: a simulated scene or a recording, each with its gt.json."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from caryatid.config import EvaluationConfig
from caryatid.errors import InputError
from caryatid.evaluation.scores import Score, TrueObject, TrueScene, score, score_masks
from caryatid.io.bop import RecordedFrame, Recording, read_recording
from caryatid.io.runs import Run, RunView, read_run
from caryatid.simulation import world
from caryatid.simulation.scenes import load_scene
from caryatid.simulation.truth import GroundTruth, read_truth
from caryatid.simulation.world import SimulatedScene

SEED = 0
"""Seed of the points volumes are measured with, the same for every evaluation so that it can be repeated."""


@dataclass(frozen=True, slots=True)
class ViewScore:
    """Score of the fused graph after one view.

    Attributes:
        view: Its number, 0 for the first.
        score: How it compares with the truth.
    """

    view: int
    score: Score

    def to_json(self) -> dict[str, int | float]:
        """One entry of `views` in what `caryatid evaluate --json` writes."""
        s = self.score
        return {
            "view": self.view,
            "precision": s.precision,
            "recall": s.recall,
            "f1": s.f1,
            "edge_precision": s.edge_precision,
            "edge_recall": s.edge_recall,
            "vertex_precision": s.vertex_precision,
            "vertex_recall": s.vertex_recall,
            "mean_iou": s.mean_iou,
        }


def true_scene_from_simulation(scene: SimulatedScene, truth: GroundTruth) -> TrueScene:
    """Build the truth of a simulated scene: solids from the model, edges from gt.json.

    Args:
        scene: The settled scene.
        truth: Its ground truth.

    Raises:
        InputError: The truth names a body the scene does not have.
    """
    labels = {body: label for label, body in scene.object_bodies.items()}
    unknown = [name for name in truth.vertices if name not in labels and name != scene.table]
    if unknown:
        raise InputError(
            scene.source,
            f"gt.json names '{unknown[0]}', which is no body of the scene",
            f"the bodies are {', '.join((scene.table, *labels))}",
        )
    return TrueScene(
        vertices=truth.vertices,
        edges=frozenset(truth.pairs),
        objects=tuple(
            TrueObject(
                name,
                partial(world.contains, scene, labels[name]),
                np.stack(world.bounds(scene, labels[name])),
            )
            for name in truth.vertices
            if name in labels
        ),
        table=scene.table if scene.table in truth.vertices else None,
        table_top=world.table_top(scene).height,
    )


def read_true_scene(folder: Path) -> TrueScene:
    """Read a scene folder, `scene.xml` with `gt.json`, as a truth.

    Raises:
        InputError: A file is missing or broken, or the two do not fit each other.
    """
    truth = read_truth(folder / "gt.json")
    return true_scene_from_simulation(load_scene(folder / "scene.xml"), truth)


def evaluate_run(
    run_folder: str | Path, truth_folder: str | Path, config: EvaluationConfig | None = None
) -> tuple[ViewScore, ...]:
    """Score every view of a run: what `caryatid evaluate RUN GT` does.

    Args:
        run_folder: A run.
        truth_folder: A scene folder (`scene.xml` and `gt.json`), or a recording with masks and `gt.json`.
        config: Least IoU, tolerance of the table's height, points a pair.

    Raises:
        InputError: The run or the truth is missing or broken, or they do not fit each other.
    """
    folder = Path(truth_folder)
    run = read_run(run_folder)
    if not folder.is_dir():
        raise InputError(folder, "is no folder", "give a scene folder or a recording with gt.json")
    if (folder / "scene.xml").is_file():
        scene = read_true_scene(folder)
        return tuple(
            ViewScore(view.index, score(view.graph, scene, np.random.default_rng(SEED), config))
            for view in run.views
        )
    if not (folder / "scene_camera.json").is_file():
        raise InputError(
            folder, "has neither scene.xml nor scene_camera.json", "give a scene folder or a recording"
        )
    return _score_recording(run, read_truth(folder / "gt.json"), read_recording(folder), config)


def _score_recording(
    run: Run, truth: GroundTruth, recording: Recording, config: EvaluationConfig | None
) -> tuple[ViewScore, ...]:
    labels = [view.load_labels() for view in run.views]
    true_labels = [_frame_of(view, recording).load_labels() for view in run.views]
    scores = []
    for view in run.views:
        seen = slice(0, view.index + 1)
        result = score_masks(
            view.graph, labels[seen], true_labels[seen], truth.vertices, frozenset(truth.pairs), config
        )
        scores.append(ViewScore(view.index, result))
    return tuple(scores)


def _frame_of(view: RunView, recording: Recording) -> RecordedFrame:
    """Frame a view was made from; a recording of one frame needs no names."""
    return recording.frames[0] if len(recording) == 1 else recording.frame(view.name)
