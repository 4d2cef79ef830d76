"""The accuracy benchmark: which figures are kept of rows, when the gate fails."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from rich.console import Console

from caryatid.benchmark.episodes import SCORES
from caryatid.simulation.scenes import is_builtin
from caryatid.simulation.truth import GroundTruth, TrueEdge, write_truth

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import accuracy  # noqa: E402
import measures  # noqa: E402

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
