"""The benchmarks: which figures are kept of rows, when the gate fails, how real recordings are scored."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from caryatid.benchmark.episodes import SCORES
from caryatid.errors import CaryatidError
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box
from caryatid.graph import SceneObject, Support, SupportGraph, object_id
from caryatid.io.bop import read_recording
from caryatid.sensing.views import SUPPORT_LABEL
from caryatid.simulation.scenes import is_builtin
from caryatid.simulation.truth import GroundTruth, TrueEdge, write_truth

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import accuracy  # noqa: E402
import clear  # noqa: E402
import measures  # noqa: E402
import others  # noqa: E402
import real  # noqa: E402

ROW = dict.fromkeys(SCORES, 1.0) | {"scene": "tower", "view": 5, "f1": 0.9, "edge_recall": 0.8}
ROW |= {"objects": 5, "returned": 5, "matched": 5}


def rows(**changes):
    return [ROW | changes | {"scene": scene} for scene in ("tower", "pile-4-1", "dense-10-200")]


def values(rows_of):
    return {m.name: m.value for m in accuracy.measures(rows_of)}


def test_figures_are_means_by_group_and_views_and_falls_from_the_undisturbed_suite():
    found = values({"labels": rows() + rows(view=10, f1=1.0), "noise": rows(f1=0.8)})
    assert found["labels.easy.f1@5"] == pytest.approx(0.9)
    assert found["labels.dense.f1@10"] == pytest.approx(1.0)
    assert found["labels.dense.edge_recall@5"] == pytest.approx(0.8)
    assert found["noise.easy.fall@5"] == pytest.approx(0.1)


def test_found_and_invented_count_objects_of_all_scenes():
    few = ROW | {"scene": "packed-20-1", "objects": 2, "returned": 2, "matched": 1}
    many = ROW | {"scene": "packed-20-2", "objects": 18, "returned": 19, "matched": 18}
    found = values({"packed": [few, many]})
    assert found["packed.found@5"] == pytest.approx(19 / 20)
    assert found["packed.invented@5"] == pytest.approx(2 / 21)


@pytest.mark.parametrize(("loss", "status"), [(0.5, 0), (1.5, 1)])
def test_the_gate_fails_beyond_the_tolerance(tmp_path, loss, status):
    baseline = tmp_path / "baseline.json"
    baseline.write_text('{"labels.easy.f1@5": 0.1, "other": 1.0, "another": 2.0}')
    kept = accuracy.measures({"labels": rows()})
    measures.update_baseline(kept, baseline, "other".__eq__)
    assert measures.read_baseline(baseline) == {m.name: m.value for m in kept} | {"other": 1.0}
    worse = accuracy.measures({"labels": rows(f1=0.9 - loss * accuracy.SUITES["labels"].tolerance)})
    assert measures.gate(worse, baseline, Console(quiet=True)) == status


def test_the_baseline_is_of_what_is_measured_and_every_scene_is_built_in():
    everything = {
        name: [ROW | {"scene": scene, "view": v} for scene in suite.scenes for v in suite.scored]
        for name, suite in accuracy.SUITES.items()
    }
    measured = set(values(everything))
    assert measures.read_baseline(accuracy.BASELINE).keys() == measured
    assert all(is_builtin(scene) for suite in accuracy.SUITES.values() for scene in suite.scenes)


def test_a_recording_is_scored_frame_by_frame(recording):
    edges = TrueEdge("table", "object1"), TrueEdge("object1", "object2")
    write_truth(GroundTruth(("table", "object1", "object2"), edges), recording / "gt.json")
    scored = accuracy.extract(accuracy.Episode(str(recording)))
    assert [r["view"] for r in scored] == [1, 2, 3]
    assert all((r["objects"], r["returned"], r["matched"]) == (2, 2, 2) for r in scored[-1:])
    assert scored[-1]["f1"] == 1.0


def squares(*corners, size=20):
    """Label image with a square at each corner (x, y), numbered from 1."""
    image = np.zeros((80, 120), dtype=np.int32)
    for label, (x, y) in enumerate(corners, 1):
        image[y : y + size, x : x + size] = label
    return image


TRUE = squares((10, 10), (50, 10), (90, 40))


def test_the_true_masks_score_100_whatever_their_numbers():
    assert set(real.compare_masks(np.array([0, 7, 3, 5], dtype=np.int32)[TRUE], TRUE, 1.0).values()) == {
        100.0
    }


def test_a_shift_beyond_the_tolerance_costs_more_of_the_boundary_than_of_the_overlap():
    shifted = np.roll(TRUE, 2, axis=1)
    within, beyond = (real.compare_masks(shifted, TRUE, tolerance) for tolerance in (2.0, 1.0))
    assert within["overlap F"] == beyond["overlap F"] == pytest.approx(90.0)
    assert within["boundary F"] == 100.0
    assert 45.0 < beyond["boundary F"] < 70.0
    assert within["%75"] == 100.0


def test_merged_masks_keep_recall_of_one_and_lose_the_others():
    merged = real.compare_masks(np.minimum(TRUE, 1), TRUE, 6.0)
    assert merged["overlap P"] == merged["overlap R"] == pytest.approx(100.0 / 3.0)
    assert merged["%75"] == 0.0


@pytest.mark.parametrize(("found", "true", "precision", "recall"), [(0, 1, 100.0, 0.0), (1, 0, 0.0, 100.0)])
def test_nothing_found_is_precise_and_nothing_to_find_is_complete(found, true, precision, recall):
    figures = real.compare_masks(TRUE * found, TRUE * true, 6.0)
    assert (figures["overlap P"], figures["overlap R"], figures["overlap F"]) == (precision, recall, 0.0)


CLICKED = real.Annotation(
    {"a": [(20, 20)], "b": [(60, 20)], "c": [(95, 50), (105, 50)]}, [("T", "a"), ("T", "b"), ("a", "c")], []
)


def graph_of(labels, *edges):
    """A graph of a table, 65535, and of objects with these labels, with supports by their labels."""
    shape = Box(transforms.rigid(np.eye(3), np.zeros(3)), np.ones(3))
    table = SceneObject("o0", SUPPORT_LABEL, shape, "support_surface")
    objects = [SceneObject(object_id(label), label, shape) for label in labels]
    supports = [Support(object_id(a), object_id(b), probability=p) for a, b, p in edges]
    return SupportGraph((table, *objects), tuple(supports))


def test_clicked_objects_and_supports_are_found():
    edges = (SUPPORT_LABEL, 1, 0.9), (SUPPORT_LABEL, 2, 0.9), (1, 3, 0.8)
    row = real.score_clicks(graph_of((1, 2, 3), *edges), TRUE, CLICKED)
    assert [row[name] for name in real.CLICKS] == [3, 3, 0, 0, 0, 0, 0, 3, 3, 0]
    assert row["AP"] == 1.0


def test_merged_split_missed_and_invented_objects_are_told_apart():
    image = squares((10, 10), (50, 10), (90, 40), (100, 40), (30, 50), size=20)
    image[image == 2] = 1
    row = real.score_clicks(graph_of((1, 3, 4, 5)), image, CLICKED)
    assert {name: row[name] for name in real.CLICKS[1:6]} == {
        "found": 0, "merged": 2, "split": 1, "missed": 0, "invented": 1
    }  # fmt: skip
    row = real.score_clicks(graph_of((2, 3)), TRUE, CLICKED)
    assert (row["found"], row["missed"]) == (2, 1)


def test_wrong_and_lacking_supports_lower_the_average_precision():
    edges = (2, 3, 0.95), (SUPPORT_LABEL, 1, 0.9), (SUPPORT_LABEL, 2, 0.9)
    row = real.score_clicks(graph_of((1, 2, 3), *edges), TRUE, CLICKED)
    assert (row["right"], row["wrong"]) == (2, 1)
    assert row["AP"] == pytest.approx(2.0 / 3.0 * 2.0 / 3.0)


def test_a_click_outside_the_image_is_an_error():
    outside = real.Annotation({"a": [(120, 20)]}, [], [])
    with pytest.raises(CaryatidError, match="outside the 120×80 pixels"):
        real.score_clicks(graph_of((1,)), TRUE, outside)


def test_a_recording_of_several_views_is_scored_with_its_masks_and_without(recording, tmp_path):
    edges = TrueEdge("table", "object1"), TrueEdge("object1", "object2")
    write_truth(GroundTruth(("table", "object1", "object2"), edges), recording / "gt.json")
    out = tmp_path / "rows.json"
    assert real.Real(jobs=1, out=out, folders=(recording.parent,), only=(recording.name,)).run(Console()) == 0
    auto, labels = json.loads(out.read_text())
    assert (auto["segments"], labels["segments"]) == ("auto", "labels")
    assert labels["views"] | {"shape IoU": 0} == {
        "views": 3, "objects": 2, "changes": 0, "pose warnings": 0, "shape IoU": 0
    }  # fmt: skip
    assert labels["views"]["shape IoU"] > 0.8
    assert labels["masks"]["F1"] == labels["masks"]["AP"] == 1.0
    assert len(auto["masks"]["frames"]) == len(auto["ms"]) == 3


def test_boundaries_agree_up_to_three_thousandths_of_the_diagonal():
    assert [others.tolerance_of(np.zeros(size)) for size in ((480, 640), (720, 1280))] == [3.0, 5.0]


def test_supports_of_unfound_and_invented_objects_lower_recall_and_precision():
    labels, image = (1, 2, 3), squares((10, 10), (50, 10), (90, 40))
    true = np.where(image == 3, 0, image)
    edges = frozenset({("table", "object1"), ("object1", "object2"), ("object1", "object4")})
    graph = graph_of(labels, (SUPPORT_LABEL, 1, 0.9), (2, 3, 0.8), (1, 2, 0.7))
    row = others.score_pixels(graph, [image], [true], ("table", "object1", "object2", "object4"), edges)
    found = others.rate(row["all"])
    assert (found["P"], found["R"]) == (pytest.approx(200 / 3), pytest.approx(200 / 3))
    assert found["AP"] == pytest.approx((1.0 + 2.0 / 3.0) / 3.0)  # right, wrong, right, and one never found
    found = others.rate(row["on objects"])
    assert (found["P"], found["R"], found["AP"]) == (50.0, 50.0, pytest.approx(0.25))


def box(x, z, size=0.1, height=0.1):
    """Corners of a box: x of its low corner, height of its bottom, side and height [m]."""
    low = np.array([x, 0.0, z])
    return low, low + (size, size, height)


TOWER = {1: box(0.0, 0.0), 2: box(0.05, 0.11), 3: box(0.5, 0.0), 4: box(0.5, 0.2)}
"""A box on the half of another, and one that floats 10 cm over a third."""


def test_boxes_rest_on_what_they_nearly_touch_from_above_and_otherwise_on_the_table():
    table = SUPPORT_LABEL
    shares = {(1, 2): 0.5, (table, 1): 1.0, (table, 3): 1.0, (table, 4): 0.5}
    assert others.rests_on(TOWER) == pytest.approx(shares)


def test_orders_of_removal():
    graph = others.graph_of_boxes(TOWER, np.eye(4))
    assert others.order_by_height(graph) == ["o4", "o2", "o1", "o3"]
    assert others.order_by_height(graph, "o1") == ["o4", "o2", "o1"]
    assert others.order_by_boxes(graph, "o1") == ["o2", "o1"]
    assert others.order_by_boxes(graph, "o3") == ["o3"]


def test_the_way_of_others_does_not_count_the_lifted_and_the_removed():
    """The first is lifted, the second goes 3 cm and 4 cm back, the third was removed before."""
    film = np.zeros((3, 3, 7))
    film[:, 0, 2], film[1:, 1, 0], film[2, 1, 1], film[:, 2, 2] = (
        (0.0, 0.5, 50.0),
        0.03,
        0.04,
        (52.0, 52.1, 53.0),
    )
    assert clear.translation(film, 0) == pytest.approx(0.07)


def test_open3d_finds_what_lies_on_what_in_one_frame(single):
    pytest.importorskip("open3d")
    views = list(read_recording(single))
    graph, labels = others.box_graph(views, "labels")
    assert (labels[0] == np.where(views[0].valid, views[0].labels, 0)).mean() > 0.99
    assert {s.pair for s in graph.supports} == {("o0", "o1"), ("o1", "o2")}
