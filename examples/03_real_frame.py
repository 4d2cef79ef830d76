"""Infer the support graph of one RGB-D frame without a pose: 03_real_frame.py FOLDER (in BOP format)."""

import json
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import caryatid as ct
from caryatid.evaluation import Score, score_masks
from caryatid.io import read_recording, write_recording
from caryatid.simulation import ground_truth, load_scene, read_truth
from caryatid.simulation.setup import make_simulation


def render_a_frame(folder: Path) -> None:
    """Write what a Carmine would see of the built-in tower, and forget where the camera was."""
    scene = load_scene("tower")
    stage = make_simulation(scene, ct.Config(), noise="carmine", seed=0)
    seen = stage.camera.capture(stage.robot.T_world_camera)
    write_recording(folder, [ct.View(seen.depth, seen.K, rgb=seen.rgb, labels=seen.labels)])
    # A recording calls its objects by their obj_id.
    names = {scene.table: "table"} | {body: f"object{k}" for k, body in scene.object_bodies.items()}
    edges = [{"supporter": names[a], "supported": names[b]} for a, b in ground_truth(scene).pairs]
    (folder / "gt.json").write_text(json.dumps({"vertices": list(names.values()), "edges": edges}))


def main(folder: Path) -> Score | None:
    """Say what the first frame of a recording shows, and how that compares with its gt.json if it has one."""
    view = read_recording(folder)[0]
    print(f"{view.name}: {view.depth.shape[1]}×{view.depth.shape[0]}, {view.valid.mean():.0%} with a reading")

    # The table gives the frame its world: z up, the table's top at z = 0.
    scene = ct.Scene()
    graph = scene.update(view)
    for o in graph.movable:
        supporters = " and ".join(s.supporter for s in graph.supporters(o.id)) or "something unseen"
        size = " × ".join(f"{100 * e:.0f}" for e in o.shape.extents)
        print(f"  {o.id}: {o.shape.kind} of {size} cm, supported by {supporters}")
    assert graph.support_surface is not None

    if view.labels is None or scene.labels is None or not (folder / "gt.json").is_file():
        return None
    truth = read_truth(folder / "gt.json")
    score = score_masks(graph, [scene.labels], [view.labels], truth.vertices, frozenset(truth.pairs))
    print(f"of the true graph: precision {score.precision:.2f}, recall {score.recall:.2f}")
    return score


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        print("no folder given: rendering a frame of the built-in scene tower instead")
        with TemporaryDirectory() as temporary:
            render_a_frame(Path(temporary) / "tower")
            score = main(Path(temporary) / "tower")
        assert score is not None
        assert score.f1 > 0.8
