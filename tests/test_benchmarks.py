"""The accuracy benchmark: which figures are kept of rows, when the gate fails, and what a picture shows."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Sphere
from caryatid.simulation.truth import GroundTruth, TrueEdge, write_truth

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
sys.path[:0] = [str(BENCHMARKS), str(BENCHMARKS / "pictures")]

import episodes  # noqa: E402
import measures  # noqa: E402
import solids  # noqa: E402
import suites  # noqa: E402

ROW = episodes.Row("tower", "support", 0, 4, 0.9, 1.0, 0.8, 1.0, 1.0, 0.95, objects=5, returned=5, matched=5)


def rows(**changes):
    return [replace(ROW, scene=scene, **changes) for scene in ("tower", "pile-4-1", "dense-10-200")]


def test_figures_are_means_by_group_and_views():
    found = {m.name: m.value for m in suites.measures({"labels": rows() + rows(view=9, f1=1.0)})}
    assert found["labels.easy.f1@5"] == pytest.approx(0.9)
    assert found["labels.dense.f1@10"] == pytest.approx(1.0)
    assert found["labels.dense.edge_recall@5"] == pytest.approx(0.8)


def test_found_and_invented_count_objects_of_all_scenes():
    few = replace(ROW, scene="packed-20-1", objects=2, returned=2, matched=1)
    many = replace(ROW, scene="packed-20-2", objects=18, returned=19, matched=18)
    found = {m.name: m.value for m in suites.measures({"packed": [few, many]})}
    assert found["packed.found@5"] == pytest.approx(19 / 20)
    assert found["packed.invented@5"] == pytest.approx(2 / 21)


def test_a_disturbed_suite_says_how_far_it_falls():
    found = {m.name: m for m in suites.measures({"labels": rows(), "noise": rows(f1=0.8)})}
    assert found["noise.easy.fall@5"].value == pytest.approx(0.1)
    assert found["noise.easy.fall@5"].better == "lower"


@pytest.mark.parametrize(("loss", "status"), [(0.5, 0), (1.5, 1)])
def test_the_gate_fails_beyond_the_tolerance(tmp_path, loss, status):
    kept = suites.measures({"labels": rows()})
    measures.write_baseline(kept, tmp_path / "baseline.json")
    assert measures.read_baseline(tmp_path / "baseline.json") == sorted(kept, key=lambda m: m.name)
    worse = suites.measures({"labels": rows(f1=0.9 - loss * suites.SUITES["labels"].tolerance)})
    assert measures.gate(worse, tmp_path / "baseline.json", Console(quiet=True)) == status


def test_every_target_is_measured_and_every_scene_is_built_in():
    everything = {
        name: [replace(ROW, scene=scene, view=v - 1) for scene in suite.scenes for v in suite.scored]
        for name, suite in suites.SUITES.items()
    }
    assert set(suites.TARGETS) <= {m.name for m in suites.measures(everything)}
    from caryatid.simulation.scenes import is_builtin

    assert all(is_builtin(scene) for suite in suites.SUITES.values() for scene in suite.scenes)


def test_a_recording_is_scored_frame_by_frame(recording):
    edges = (
        TrueEdge(supporter="table", supported="object1", kind="bottom-up"),
        TrueEdge(supporter="object1", supported="object2", kind="bottom-up"),
    )
    write_truth(GroundTruth(("table", "object1", "object2"), edges), recording / "gt.json")
    scored = episodes.Extraction(str(recording)).run()
    assert [r.view for r in scored] == [0, 1, 2]
    assert episodes.found(scored) == 1.0
    assert episodes.invented(scored) == 0.0
    assert scored[-1].f1 == 1.0


def test_solids_are_drawn_where_they_are_and_hide_what_is_behind():
    ball = Sphere(transforms.rigid(np.eye(3), (0.0, 0.0, 0.1)), 0.05)
    behind = Box(transforms.rigid(np.eye(3), (-0.3, 0.0, 0.1)), np.full(3, 0.04))
    eye = solids.Eye.towards(np.array([0.0, 0.0, 0.1]), np.array([1.0, 0.0, 0.0]), 0.1, 60, 60)
    image, seen = solids.draw_solids([ball, behind], [(1.0, 0.0, 0.0), (0.0, 0.0, 1.0)], 0.0, eye)
    assert image.shape == (60, 60, 3)
    assert not (seen == 1).any()
    v, u = np.nonzero(seen == 0)
    np.testing.assert_allclose(
        [u.mean(), v.mean()], eye.project(ball.T_world_object[None, :3, 3])[0], atol=0.5
    )
    assert len(u) == pytest.approx(np.pi * 15.0**2, rel=0.05)
