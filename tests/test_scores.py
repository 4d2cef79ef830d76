"""Scores: eqs. 4 and 5, matching by volume and by mask, runs against scenes and recordings."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import step_of
from hypothesis import given, settings
from hypothesis import strategies as st

from caryatid.config import Config
from caryatid.errors import InputError
from caryatid.evaluation import as_scene, evaluate_run, score, score_masks, true_scene_from_simulation
from caryatid.evaluation.scores import mask_ious
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Sphere
from caryatid.graph import SceneObject, Support, SupportGraph
from caryatid.io import write_recording
from caryatid.sensing.views import SUPPORT_LABEL, View
from caryatid.simulation import load_scene
from caryatid.steps import RunWriter

SHARED = Path(__file__).parents[2] / "shared"


def at(x=0.0, y=0.0, z=0.0):
    return transforms.rigid(np.eye(3), (x, y, z))


def turned(x=0.0, y=0.0):
    return transforms.rotation_from_vector(np.deg2rad((x, y, 0.0)))


def table(height=0.75):
    shape = Box(at(z=height - 0.02), np.array([1.0, 1.0, 0.04]))
    return SceneObject("o0", SUPPORT_LABEL, shape, role="support_surface")


def tower(levels=3, table_height=0.75, edge=0.1):
    """Cubes on each other on a table."""
    objects, supports = [table(table_height)], []
    for level in range(levels):
        shape = Box(at(z=0.75 + edge * (level + 0.5)), np.full(3, edge))
        objects.append(SceneObject(f"o{level + 1}", level + 1, shape))
        supports.append(Support(f"o{level}", f"o{level + 1}"))
    return SupportGraph(tuple(objects), tuple(supports))


def test_equations_4_and_5_by_hand():
    truth = as_scene(tower(3))
    graph = tower(2)
    wrong = SceneObject("o9", 9, Sphere(at(x=0.4, z=0.8), 0.05))
    graph = SupportGraph((*graph.objects, wrong), (*graph.supports, Support("o2", "o9", certain=False)))
    result = score(graph, truth)
    assert result.precision == result.recall == pytest.approx((3 + 2) / (4 + 3))
    assert result.vertex_precision == result.vertex_recall == pytest.approx(3 / 4)
    assert result.edge_precision == result.edge_recall == pytest.approx(2 / 3)
    assert result.mean_iou == pytest.approx(1.0)
    assert result.matches == {"o0": "o0", "o1": "o1", "o2": "o2"}


def test_an_edge_the_wrong_way_round_is_false_and_its_kind_does_not_matter():
    truth, (right, above) = as_scene(tower(2)), tower(2).supports
    lean = Support(above.supporter, above.supported, kind="lean")
    turned = Support(above.supported, above.supporter)
    assert score(SupportGraph(tower(2).objects, (right, lean)), truth).f1 == 1.0
    result = score(SupportGraph(tower(2).objects, (right, turned)), truth)
    assert result.edge_precision == result.edge_recall == 0.5


@pytest.mark.parametrize(("offset", "found"), [(0.019, True), (-0.019, True), (0.021, False)])
def test_the_table_is_found_within_two_centimetres(offset, found):
    result = score(tower(2, table_height=0.75 + offset), as_scene(tower(2)))
    assert ("o0" in result.matches) == found
    assert result.edge_recall == (1.0 if found else 0.5)


@pytest.mark.parametrize(("shift", "found"), [(0.030, True), (0.037, False)])
def test_an_object_is_found_at_half_overlap(shift, found):
    """A cube of 10 cm shifted by s overlaps its old place by (0.1 - s) / (0.1 + s): 0.5 at 3.33 cm."""
    moved = SupportGraph((SceneObject("o1", 1, Box(at(x=shift), np.full(3, 0.1))),))
    truth = as_scene(SupportGraph((SceneObject("o1", 1, Box(at(), np.full(3, 0.1))),)))
    result = score(moved, truth)
    assert (result.vertex_recall == 1.0) == found
    if found:
        assert result.mean_iou == pytest.approx((0.1 - shift) / (0.1 + shift), abs=0.02)


def test_one_true_object_is_matched_once():
    cube = Box(at(), np.full(3, 0.1))
    twice = SupportGraph((SceneObject("o1", 1, cube), SceneObject("o2", 2, Box(at(x=0.01), np.full(3, 0.1)))))
    result = score(twice, as_scene(SupportGraph((SceneObject("o7", 7, cube),))))
    assert result.matches == {"o1": "o7"}
    assert result.vertex_precision == 0.5


def test_empty_graphs():
    empty, some = SupportGraph(), tower(1)
    assert score(empty, as_scene(empty)).f1 == 1.0
    against = score(empty, as_scene(some))
    assert (against.precision, against.recall, against.f1, against.mean_iou) == (0.0, 0.0, 0.0, 0.0)
    assert score(some, as_scene(empty)).f1 == 0.0


@pytest.mark.parametrize(
    ("shape", "height"),
    [
        (Box(transforms.rigid(turned(x=2.0), (0, 0, 0.7)), np.array([1.0, 1.0, 0.04])), 0.72),
        (Box(transforms.rigid(turned(y=90.0), (0, 0, 0.7)), np.array([0.04, 1.0, 1.0])), 0.72),
        (Sphere(at(z=1.0), 0.1), 1.1),
    ],
)
def test_the_top_of_a_tilted_table_is_measured_in_its_middle(shape, height):
    graph = SupportGraph((SceneObject("o0", SUPPORT_LABEL, shape, role="support_surface"),))
    assert as_scene(graph).table_top == pytest.approx(height, abs=1e-4)


def mask_graph(labels=(1, 2)):
    objects = [table(), *(SceneObject(f"o{k}", k, Sphere(at(), 0.1)) for k in labels)]
    return SupportGraph(tuple(objects), (Support("o0", "o1"), Support("o1", "o2")))


TRUE_LABELS = np.zeros((20, 20), np.int32)
TRUE_LABELS[2:8, 2:12] = 5
TRUE_LABELS[10:18, 3:9] = 7
VERTICES = ("table", "object5", "object7")
EDGES = frozenset({("table", "object5"), ("object5", "object7")})


SEEN = np.where(TRUE_LABELS == 5, 1, 0) + np.where(TRUE_LABELS == 7, 2, 0)


def test_masks_match_objects_in_real_frames():
    labels = SEEN.copy()
    labels[0] = SUPPORT_LABEL
    result = score_masks(mask_graph(), [labels], [TRUE_LABELS], VERTICES, EDGES)
    assert (result.f1, result.mean_iou) == (1.0, 1.0)
    assert result.matches == {"o0": "table", "o1": "object5", "o2": "object7"}
    labels[2:5] = 0
    at_half = score_masks(mask_graph(), [labels], [TRUE_LABELS], VERTICES, EDGES)
    assert at_half.ious["o1"] == 0.5
    labels[5, 2] = 0
    below = score_masks(mask_graph(), [labels], [TRUE_LABELS], VERTICES, EDGES)
    assert set(below.matches) == {"o0", "o2"}
    assert below.edge_recall == 0.0


def test_without_a_true_table_the_extracted_one_is_wrong():
    upper = frozenset({("object5", "object7")})
    result = score_masks(mask_graph(), [SEEN], [TRUE_LABELS], VERTICES[1:], upper)
    assert result.vertex_precision == pytest.approx(2 / 3)
    assert result.edge_precision == 0.5


@given(st.integers(0, 10_000))
@settings(max_examples=15, deadline=None)
def test_mask_iou_is_what_sets_say(seed):
    rng = np.random.default_rng(seed)
    mine, theirs = ([rng.integers(0, 5, shape) for shape in ((6, 7), (4, 3))] for _ in range(2))
    iou = mask_ious(mine, theirs, [1, 2, 3], [4, 1])
    a, b = (np.concatenate([image.ravel() for image in images]) for images in (mine, theirs))
    for i, k in enumerate((1, 2, 3)):
        for j, m in enumerate((4, 1)):
            union = ((a == k) | (b == m)).sum()
            assert iou[i, j] == pytest.approx(((a == k) & (b == m)).sum() / max(union, 1))


def test_masks_of_other_sizes_are_refused():
    with pytest.raises(InputError, match="label images of"):
        score_masks(mask_graph(), [np.zeros((3, 3), np.int32)], [TRUE_LABELS], VERTICES, EDGES)


SCENE = """<mujoco><worldbody>
  <body name="table"><geom type="box" size="0.4 0.4 0.02" pos="0 0 0.73"/></body>
  <body name="lower" pos="0 0 0.8"><joint type="free"/><geom type="box" size="0.06 0.06 0.05"/></body>
  <body name="upper" pos="0 0 0.88"><joint type="free"/><geom type="cylinder" size="0.04 0.03"/></body>
</worldbody></mujoco>"""
GT = {
    "vertices": ["table", "lower", "upper"],
    "edges": [
        {"supporter": "table", "supported": "lower", "kind": "bottom-up"},
        {"supporter": "lower", "supported": "upper"},
    ],
}


@pytest.fixture
def scene_folder(tmp_path):
    folder = tmp_path / "scene"
    folder.mkdir()
    (folder / "scene.xml").write_text(SCENE)
    (folder / "gt.json").write_text(json.dumps(GT))
    return folder


def scene_graph(objects):
    table_ = SceneObject("o0", SUPPORT_LABEL, Box(at(z=0.73), np.array([0.8, 0.8, 0.04])), "support_surface")
    lower = SceneObject("o1", 1, Box(at(z=0.8), np.array([0.12, 0.12, 0.1])))
    upper = SceneObject("o2", 2, Cylinder(at(z=0.88), 0.04, 0.06))
    supports = (Support("o0", "o1"), Support("o1", "o2"))
    return SupportGraph((table_, lower, upper)[: objects + 1], supports[:objects])


def write_run(folder, graphs, labels=None, names=None):
    with RunWriter(folder, Config(), {}) as run:
        for index, graph in enumerate(graphs):
            image = np.zeros((4, 4), np.int32) if labels is None else labels[index]
            run.add(step_of(graph, image, f"view {index}" if names is None else names[index]))


def test_a_run_is_scored_view_by_view_against_its_scene(tmp_path, scene_folder):
    write_run(tmp_path / "RUN", [scene_graph(1), scene_graph(2)])
    first, second = evaluate_run(tmp_path / "RUN", scene_folder)
    assert first.f1 == first.to_json()["f1"] == pytest.approx(2 * 1.0 * (3 / 5) / (1.0 + 3 / 5))
    assert second.f1 == 1.0
    assert second.mean_iou > 0.98
    assert second.matches == {"o0": "table", "o1": "lower", "o2": "upper"}
    assert evaluate_run(tmp_path / "RUN", scene_folder) == (first, second)


def record(folder, count):
    poses = [transforms.look_at((1.0, 0.2 * k, 1.0), (0, 0, 0)) for k in range(count)]
    K = np.array([[20.0, 0, 9.5], [0, 20.0, 9.5], [0, 0, 1]])
    depth = np.ones((20, 20), np.float32)
    write_recording(
        folder, [View(depth, K, T, labels=np.roll(TRUE_LABELS, k, axis=1)) for k, T in enumerate(poses)]
    )
    edges = [{"supporter": a, "supported": b} for a, b in sorted(EDGES)]
    (folder / "gt.json").write_text(json.dumps({"vertices": VERTICES, "edges": edges}))


def test_a_view_is_scored_by_the_pixels_of_its_frames_up_to_it(tmp_path):
    record(tmp_path / "rec", 2)
    mine = [np.roll(SEEN, 1, axis=1), SEEN]
    write_run(tmp_path / "RUN", [mask_graph()] * 2, mine, ["rec/000001", "rec/000000"])
    views = evaluate_run(tmp_path / "RUN", tmp_path / "rec")
    assert [(score.f1, score.mean_iou) for score in views] == [(1.0, 1.0)] * 2
    names = ["rec/000000", "rec/000001"]
    write_run(tmp_path / "RUN", [mask_graph()] * 2, [SEEN, np.zeros_like(SEEN)], names)
    assert [score.mean_iou for score in evaluate_run(tmp_path / "RUN", tmp_path / "rec")] == [1.0, 0.5]
    write_run(tmp_path / "RUN", [mask_graph()] * 2, mine, ["rec/000001", "rec/000007"])
    with pytest.raises(InputError, match="000007"):
        evaluate_run(tmp_path / "RUN", tmp_path / "rec")


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("gt.json", '{"vertices": ["table", "ghost"], "edges": []}', "ghost"),
        ("scene.xml", "<mujoco", "scene.xml"),
    ],
)
def test_a_bad_truth_is_refused(tmp_path, scene_folder, name, content, said):
    write_run(tmp_path / "RUN", [scene_graph(2)])
    path = scene_folder / name
    path.write_text(content)
    with pytest.raises(InputError, match=said) as caught:
        evaluate_run(tmp_path / "RUN", scene_folder)
    assert str(scene_folder) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
@pytest.mark.skipif(not SHARED.is_dir(), reason="needs ../shared")
@pytest.mark.parametrize("name", ["arch", "ycb05_9"])
def test_a_true_scene_against_itself_is_one(name):
    truth = true_scene_from_simulation(load_scene(SHARED / "scenes" / name))
    gt = json.loads((SHARED / "scenes" / name / "gt.json").read_text())
    result = score(truth, truth)
    assert (result.precision, result.recall, result.f1, result.mean_iou) == (1.0,) * 4
    assert len(result.matches) == len(gt["vertices"])
    assert len(truth.edges) == len(gt["edges"])
    assert truth.table_top == pytest.approx(0.75)
