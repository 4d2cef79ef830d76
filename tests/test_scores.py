"""Scores: eqs. 4 and 5, matching by volume and by mask, runs against scenes and recordings."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from conftest import step_of
from synthetic import box, sphere, table_object, thing

from caryatid.config import Config
from caryatid.errors import InputError
from caryatid.evaluation import as_scene, evaluate_run, score, score_masks
from caryatid.evaluation.truths import true_scene_from_simulation
from caryatid.geometry import transforms
from caryatid.graph import SceneObject, Support, SupportGraph, object_id
from caryatid.io import write_recording
from caryatid.sensing.views import SUPPORT_LABEL, View
from caryatid.simulation import ground_truth, load_scene, read_truth, true_shapes, write_truth
from caryatid.steps import RunWriter


def stack(*shapes, table=0.75):
    """Shapes that carry each other in their order, the first on a table."""
    objects = [table_object(table), *(thing(k, shape) for k, shape in enumerate(shapes, start=1))]
    return SupportGraph(tuple(objects), tuple(Support(f"o{k}", f"o{k + 1}") for k in range(len(shapes))))


def tower(levels, table=0.75):
    return stack(*(cube(z=0.8 + 0.1 * level) for level in range(levels)), table=table)


def cube(x=0.0, z=0.8):
    return box((x, 0.0, z), (0.1, 0.1, 0.1))


def lone(*shapes):
    return SupportGraph(tuple(thing(k, shape) for k, shape in enumerate(shapes, start=1)))


def test_equations_4_and_5_by_hand():
    """Of 4 vertices 3 are true and of 3 edges 2; the truth has as many: both are (3 + 2)/(4 + 3) = 5/7."""
    truth, graph = as_scene(tower(3)), tower(2)
    wrong = Support("o2", "o9", certain=False)
    graph = SupportGraph((*graph.objects, thing(9, sphere((0.4, 0.0, 0.8), 0.05))), (*graph.supports, wrong))
    result = score(graph, truth)
    assert result.precision == result.recall == pytest.approx((3 + 2) / (4 + 3))
    assert result.vertex_precision == result.vertex_recall == pytest.approx(3 / 4)
    assert result.edge_precision == result.edge_recall == pytest.approx(2 / 3)
    assert result.mean_iou == pytest.approx(1.0)
    assert result.matches == {"o0": "o0", "o1": "o1", "o2": "o2"}


def test_an_edge_the_wrong_way_round_is_false_and_its_kind_does_not_matter():
    graph = tower(2)
    for above, share in ((Support("o1", "o2", kind="lean"), 1.0), (Support("o2", "o1"), 0.5)):
        result = score(SupportGraph(graph.objects, (graph.supports[0], above)), as_scene(graph))
        assert result.edge_precision == result.edge_recall == share


@pytest.mark.parametrize(("offset", "found"), [(0.019, True), (-0.019, True), (0.021, False)])
def test_the_table_is_found_within_two_centimetres(offset, found):
    result = score(tower(2, table=0.75 + offset), as_scene(tower(2)))
    assert ("o0" in result.matches) == found
    assert result.edge_recall == (1.0 if found else 0.5)


def surface(label, centre, extents):
    """A level surface, by the middle of its top."""
    x, y, top = centre
    return SceneObject(object_id(label), label, box((x, y, top - 0.005), (*extents, 0.01)), "support_surface")


def test_support_surfaces_match_one_to_one_where_height_and_place_agree():
    """A bin's floor 1.5 cm above its table is within the tolerance of both; the better overlap decides."""
    table = surface(SUPPORT_LABEL, (0.0, 0.0, 0.75), (0.6, 0.9))
    bin_floor = surface(SUPPORT_LABEL - 1, (0.0, 0.2, 0.765), (0.3, 0.4))
    truth = as_scene(SupportGraph((table, bin_floor, thing(1, cube())), (Support("s1", "o1"),)))
    swapped = (
        surface(SUPPORT_LABEL, (0.01, 0.2, 0.76), (0.3, 0.4)),
        surface(SUPPORT_LABEL - 1, (0.0, 0.0, 0.752), (0.5, 0.8)),
    )
    result = score(SupportGraph((*swapped, thing(1, cube())), (Support("o0", "o1"),)), truth)
    assert result.matches == {"o0": "s1", "s1": "o0", "o1": "o1"}
    assert result.f1 == 1.0
    alone = score(SupportGraph((swapped[0],)), truth)
    assert alone.matches == {"o0": "s1"}
    assert alone.unfound == ("o0", "o1")
    elsewhere = score(SupportGraph((table, surface(SUPPORT_LABEL - 1, (2.0, 0.0, 0.765), (0.3, 0.4)))), truth)
    assert elsewhere.matches == {"o0": "o0"}
    assert (elsewhere.vertex_precision, elsewhere.unfound) == (1 / 2, ("s1", "o1"))


@pytest.mark.parametrize(("shift", "found"), [(0.030, True), (0.037, False)])
def test_an_object_is_found_at_half_overlap_and_once(shift, found):
    """A cube of 10 cm shifted by s overlaps its old place by (0.1 - s) / (0.1 + s): 0.5 at 3.33 cm."""
    result = score(lone(cube(x=shift)), as_scene(lone(cube())))
    assert (result.vertex_recall == 1.0) == found
    assert result.mean_iou == pytest.approx(found * (0.1 - shift) / (0.1 + shift), abs=0.02)
    twice = score(lone(cube(x=shift), cube(x=-0.01)), as_scene(lone(cube())))
    assert twice.matches == {"o2": "o1"}
    assert twice.vertex_precision == 0.5


def test_empty_graphs():
    empty, some = SupportGraph(), tower(1)
    assert score(empty, as_scene(empty)).f1 == 1.0
    against = score(empty, as_scene(some))
    assert (against.precision, against.recall, against.f1, against.mean_iou) == (0.0, 0.0, 0.0, 0.0)
    assert score(some, as_scene(empty)).f1 == 0.0


def test_probabilities_by_hand():
    """Of cubes on each other three supports are said, one is wrong, and one true one is missing."""
    truth = as_scene(tower(4))
    objects, supports = tower(4).objects, tower(4).supports
    said = [0.9, 0.6, None]
    sure = [replace(s, probability=p, certain=False) for s, p in zip(supports, said, strict=False)]
    wrong = Support("o0", "o4", probability=0.7)
    found = score(SupportGraph(objects, (*sure, wrong)), truth)
    # By falling probability: true, wrong, true, true; the fourth true one is missing.
    squares = [0.1**2, 0.7**2, 0.4**2, 0.5**2, 1.0]
    assert found.brier == pytest.approx(sum(squares) / 5)
    assert found.average_precision == pytest.approx((1 / 1 + 2 / 3 + 3 / 4) / 4)
    assert sorted(found.forecasts) == [
        (0.0, True), (0.5, True), (0.6, True), (0.7, False), (0.9, True)
    ]  # fmt: skip
    # What says nothing of a probability: supports of objects that are not there.
    strange = Support("o0", "o9", probability=0.9)
    aside = SupportGraph((*objects, thing(9, sphere((0.4, 0.0, 0.8), 0.05))), (*supports, strange))
    assert (score(aside, truth).brier, score(aside, truth).average_precision) == (0.0, 1.0)


TRUE_LABELS = np.zeros((20, 20), np.int32)
TRUE_LABELS[2:8, 2:12] = 5
TRUE_LABELS[10:18, 3:9] = 7
VERTICES = ("table", "object5", "object7")
EDGES = frozenset({("table", "object5"), ("object5", "object7")})
SEEN = np.where(TRUE_LABELS == 5, 1, 0) + np.where(TRUE_LABELS == 7, 2, 0)


def masked(labels, vertices=VERTICES, edges=EDGES):
    return score_masks(tower(2), [labels], [TRUE_LABELS], vertices, edges)


def test_masks_match_objects_in_real_frames():
    labels = SEEN.copy()
    labels[0] = SUPPORT_LABEL
    result = masked(labels)
    assert (result.f1, result.mean_iou) == (1.0, 1.0)
    assert result.matches == {"o0": "table", "o1": "object5", "o2": "object7"}
    labels[2:5] = 0
    assert masked(labels).ious["o1"] == 0.5
    labels[5, 2] = 0
    below = masked(labels)
    assert set(below.matches) == {"o0", "o2"}
    assert below.edge_recall == 0.0
    with pytest.raises(InputError, match="label images of"):
        masked(np.zeros((3, 3), np.int32))


def write_run(folder, *views):
    """A run of graphs with label images and names."""
    with RunWriter(folder, Config(), {"source": "two", "seed": 0, "options": {}}) as run:
        for graph, labels, name in views:
            run.add(step_of(graph, labels, name))
    return folder


def test_a_run_is_scored_view_by_view_against_its_scene(tmp_path, scene_file):
    scene = load_scene(scene_file)
    whole = stack(*true_shapes(scene).values(), table=0.7)
    part = SupportGraph(whole.objects[:2], whole.supports[:1])
    run = write_run(tmp_path / "RUN", *((graph, SEEN, "view") for graph in (part, whole)))
    first, second = evaluate_run(run, scene_file.parent)
    assert first.f1 == first.to_json()["f1"] == pytest.approx(2 * 1.0 * (3 / 5) / (1.0 + 3 / 5))
    assert second.f1 == 1.0
    assert second.mean_iou > 0.98
    assert second.matches == {"o0": "table", "o1": "crate", "o2": "can"}
    assert evaluate_run(run, scene_file.parent) == (first, second)


def test_the_surfaces_in_gt_json_count(tmp_path, scene_file):
    scene = load_scene(scene_file)
    assert true_scene_from_simulation(scene).surfaces["table"] == pytest.approx((0.7, 0.0, 0.0, 0.4, 0.5))
    given, path = (
        replace(ground_truth(scene), surfaces={"table": (0.72, 0.0, 0.1, 0.4, 0.5)}),
        tmp_path / "gt.json",
    )
    write_truth(given, path)
    assert read_truth(path) == given
    assert true_scene_from_simulation(scene, read_truth(path)).surfaces["table"].height == 0.72
    write_truth(replace(given, surfaces={"shelf": given.surfaces["table"]}), path)
    with pytest.raises(InputError, match="'shelf', which is not a vertex"):
        read_truth(path)


def test_a_view_is_scored_by_the_pixels_of_its_frames_up_to_it(tmp_path):
    poses = [transforms.look_at((1.0, 0.2 * k, 1.0), (0, 0, 0)) for k in range(2)]
    K = np.array([[20.0, 0, 9.5], [0, 20.0, 9.5], [0, 0, 1]])
    depth, graph = np.ones((20, 20), np.float32), tower(2)
    recording = tmp_path / "rec"
    write_recording(
        recording, [View(depth, K, T, labels=np.roll(TRUE_LABELS, k, axis=1)) for k, T in enumerate(poses)]
    )
    edges = [{"supporter": a, "supported": b} for a, b in sorted(EDGES)]
    (recording / "gt.json").write_text(json.dumps({"vertices": VERTICES, "edges": edges}))
    one, other = (graph, SEEN, "rec/000000"), (graph, np.roll(SEEN, 1, axis=1), "rec/000001")
    unseen = (graph, np.zeros_like(SEEN), "rec/000001")
    for views, ious in (((other, one), [1.0, 1.0]), ((one, unseen), [1.0, 0.5])):
        found = evaluate_run(write_run(tmp_path / "RUN", *views), recording)
        assert [score.mean_iou for score in found] == ious
    with pytest.raises(InputError, match="000007"):
        evaluate_run(write_run(tmp_path / "RUN", (graph, SEEN, "rec/000007"), one), recording)
