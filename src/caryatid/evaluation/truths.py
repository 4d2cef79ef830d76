"""Ground truth of a run: a simulated scene or a recording, each with its gt.json."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from caryatid.config import EvaluationConfig
from caryatid.errors import InputError
from caryatid.evaluation.scores import Score, TrueScene, TrueSurface, score, score_masks
from caryatid.io.bop import read_recording
from caryatid.io.datasets import find_sample
from caryatid.simulation.lifting import ASIDE
from caryatid.simulation.scenes import SCENE_FILE, TRUTH_FILE, is_builtin, load_scene
from caryatid.simulation.truth import GroundTruth, ground_truth, read_truth
from caryatid.simulation.world import SimulatedScene, posed, surface_of, true_shapes
from caryatid.steps import Run, read_run

log = logging.getLogger(__name__)


def true_scene_from_simulation(scene: SimulatedScene, truth: GroundTruth | None = None) -> TrueScene:
    """Build the truth of a simulated scene: its shapes and surfaces, and edges from gt.json.

    Args:
        scene: The scene.
        truth: Content of gt.json; None = read it from beside the scene's file, or without one derive it from
            physics.

    Raises:
        InputError: The truth names a body that the scene lacks.
    """
    if truth is None:
        file = Path(scene.source).parent / TRUTH_FILE
        known = file.is_file() and not is_builtin(scene.source)
        truth = read_truth(file) if known else ground_truth(scene)
    labels = {body: label for label, body in scene.object_bodies.items()}
    known_names = [*scene.surfaces, *labels]
    if strange := [name for name in truth.vertices if name not in known_names]:
        why = f"gt.json names '{strange[0]}', which is not a body of the scene"
        raise InputError(scene.source, why, f"known bodies: {', '.join(known_names)}")
    shapes = true_shapes(scene)
    objects = {name: shapes[labels[name]] for name in truth.vertices if name in labels}
    surfaces = {
        name: TrueSurface(*(truth.surfaces.get(name) or surface_of(scene, name)))
        for name in scene.surfaces
        if name in truth.vertices
    }
    return TrueScene(truth.vertices, frozenset(truth.pairs), objects, surfaces)


def evaluate_run(
    run_folder: str | Path | Run, truth: str | Path | None = None, config: EvaluationConfig | None = None
) -> tuple[Score, ...]:
    """Score every view of a run, in order, as `caryatid evaluate RUN [GT]` does.

    After each lift of a clear run, the truth is what physics says of the objects that are left. Warn if no
    object of the last view matches: the truth is probably of something else.

    Args:
        run_folder: The folder of a run, or the run as read.
        truth: A built-in scene; an MJCF file or scene folder, with `gt.json` beside it or else compared with
            physics; or a recording with masks and `gt.json`. None = the run's own source.
        config: Minimum IoU, tolerance of the surfaces' heights, points per pair.

    Raises:
        InputError: The run or the truth is missing or broken, or they do not fit each other.
    """
    run = run_folder if isinstance(run_folder, Run) else read_run(run_folder)
    if truth is None:  # where the run's source lies from its folder, or else as typed
        truth, path = run.record["source"], run.record.get("source_path")
        place = (run.folder.resolve() / path).resolve() if path else None
        truth = place if place is not None and place.exists() else truth
    source = str(truth)
    folder = find_sample(source)
    if is_builtin(source) or (folder / SCENE_FILE).is_file() or folder.suffix == ".xml":
        keyframe = run.record.get("options", {}).get("keyframe")
        scene = load_scene(source, keyframe=None if is_builtin(source) else keyframe)
        scores = [
            score(view.graph, true, config=config)
            for view, true in zip(run.views, _truths(run, scene), strict=True)
        ]
    elif (folder / "scene_camera.json").is_file():
        if run.record["options"].get("more"):
            raise InputError(run.folder, "shows several recordings", "give the ground truth of a scene")
        known, recording = read_truth(folder / TRUTH_FILE), read_recording(folder)
        # A recording of one frame needs no names.
        lone = recording.frames[0] if len(recording) == 1 else None
        true_labels = [(lone or recording.frame(view.name)).load_labels() for view in run.views]
        labels, edges = [view.load_labels() for view in run.views], frozenset(known.pairs)
        scores = [
            score_masks(view.graph, labels[:n], true_labels[:n], known.vertices, edges, config)
            for n, view in enumerate(run.views, 1)
        ]
    else:
        why = "neither a scene nor a recording" if folder.exists() else "no such scene or recording"
        remedy = "give a scene (scene.xml), or a recording with scene_camera.json and gt.json"
        raise InputError(source, why, remedy)
    if not scores[-1].ious and len(run.views[-1].graph.objects) > 1:
        log.warning(
            "%s: none of its objects matches one of %s; give the ground truth of this run", run.folder, source
        )
    return tuple(scores)


def _truths(run: Run, scene: SimulatedScene) -> Iterator[TrueScene]:
    """The truth at each view; a graph that lacks the object lifted after its view is that after the lift."""
    lifts = {lift["view"]: lift for lift in run.record.get("lifts", ())}
    true, names = true_scene_from_simulation(scene), list(scene.object_bodies.values())
    for number, view in enumerate(run.views):
        lift, after = lifts.get(number), true
        if lift is not None:
            state = np.array(lift["state"])
            if state.shape != (len(names), 7):
                reason = f"has {len(names)} objects, but the run removed objects from {len(state)}"
                raise InputError(scene.source, reason, "give the scene of this run")
            lifted = posed(scene, state)
            gone = {name for name, z in zip(names, state[:, 2], strict=True) if z >= ASIDE / 2.0}
            known = ground_truth(lifted)
            vertices = tuple(name for name in known.vertices if name not in gone)
            edges = tuple(edge for edge in known.edges if not {edge.supporter, edge.supported} & gone)
            after = true_scene_from_simulation(lifted, GroundTruth(vertices, edges))
        lacks = lift is not None and all(o.id != lift["object"] for o in view.graph.objects)
        yield after if lacks else true
        true = after
