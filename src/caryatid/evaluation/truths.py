"""What a run is scored against: a simulated scene or a recording, each with its gt.json."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from caryatid.config import EvaluationConfig
from caryatid.errors import InputError
from caryatid.evaluation.scores import Score, TrueObject, TrueScene, score, score_masks
from caryatid.io.bop import read_recording
from caryatid.simulation import world
from caryatid.simulation.scenes import load_scene
from caryatid.simulation.truth import GroundTruth, read_truth
from caryatid.simulation.world import SimulatedScene
from caryatid.steps import read_run


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
        figures = ["precision", "recall", "f1", "edge_precision", "edge_recall"]
        figures += ["vertex_precision", "vertex_recall", "mean_iou"]
        return {"view": self.view} | {name: getattr(self.score, name) for name in figures}


def true_scene_from_simulation(scene: SimulatedScene, truth: GroundTruth) -> TrueScene:
    """Build the truth of a simulated scene: solids from the model, edges from gt.json.

    Raises:
        InputError: The truth names a body the scene does not have.
    """
    labels = {body: label for label, body in scene.object_bodies.items()}
    objects = []
    for name in truth.vertices:
        if name in labels:
            contains = partial(world.contains, scene, labels[name])
            objects.append(TrueObject(name, contains, np.stack(world.bounds(scene, labels[name]))))
        elif name != scene.table:
            raise InputError(
                scene.source,
                f"gt.json names '{name}', which is no body of the scene",
                f"the bodies are {', '.join((scene.table, *labels))}",
            )
    table = scene.table if scene.table in truth.vertices else None
    height = float(world.table_centre(scene)[2])
    return TrueScene(truth.vertices, frozenset(truth.pairs), tuple(objects), table, height)


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
        raise InputError(folder, "is not a folder", "give a scene folder or a recording with gt.json")
    if (folder / "scene.xml").is_file():
        scene = read_true_scene(folder)
        scores = [score(view.graph, scene, config=config) for view in run.views]
    elif (folder / "scene_camera.json").is_file():
        truth, recording = read_truth(folder / "gt.json"), read_recording(folder)
        # A recording of one frame needs no names.
        lone = recording.frames[0] if len(recording) == 1 else None
        true_labels = [(lone or recording.frame(view.name)).load_labels() for view in run.views]
        labels, edges = [view.load_labels() for view in run.views], frozenset(truth.pairs)
        scores = [
            score_masks(view.graph, labels[:n], true_labels[:n], truth.vertices, edges, config)
            for n, view in enumerate(run.views, 1)
        ]
    else:
        why = "has neither scene.xml nor scene_camera.json"
        raise InputError(folder, why, "give a scene folder or a recording")
    return tuple(ViewScore(number, result) for number, result in enumerate(scores))
