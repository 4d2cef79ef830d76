"""The planner that knows the truth: what it predicts comes true, and nothing else comes of its trying."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from conftest import SMALL, run_command
from synthetic import FEW_VIEWS, simulated_scene

from caryatid.config import OracleConfig
from caryatid.errors import InputError
from caryatid.evaluation.oracle import OraclePlanner, planner_for, spread_out
from caryatid.evaluation.scores import score
from caryatid.evaluation.truths import true_scene_from_simulation
from caryatid.exploration import explore
from caryatid.io.graph_json import graph_text
from caryatid.planning.planners import make_planner
from caryatid.simulation.setup import make_simulation
from caryatid.simulation.truth import ground_truth

CONFIG = replace(FEW_VIEWS, oracle=OracleConfig(candidates=4, stride=1))


class Chosen:
    """Goes to the same candidates again."""

    def __init__(self, indices):
        self.indices = list(indices)

    def plan(self, state, rng):
        decision = make_planner("random").plan(state, rng)
        index = self.indices.pop(0)
        return replace(decision, index=index, T_world_camera=state.candidates.T_world_camera[index])


def truth_of(name):
    return true_scene_from_simulation(simulated_scene(name), ground_truth(simulated_scene(name)))


def exploration(planner, name="hidden_stack", config=CONFIG):
    """Steps and their F1."""
    stage = make_simulation(simulated_scene(name), config, noise="carmine", seed=3)
    truth, camera = truth_of(name), stage.camera
    options = {"segmentation": "labels", "seed": 3}
    if planner == "oracle":
        planner, camera = planner_for(planner, camera, truth, config, **options)
    steps = list(explore(camera, stage.robot, planner=planner, config=config, early_stop=False, **options))
    return steps, [score(s.graph, truth).f1 for s in steps]


@pytest.fixture(scope="module")
def explored():
    return exploration("oracle")


@pytest.mark.slow
def test_what_it_predicts_is_what_comes_and_what_it_says(explored):
    steps, f1 = explored
    assert len(steps) == 3
    assert [s.decision.saliency for s in steps[:-1]] == f1[1:]
    assert f1[1] > f1[0]
    told = rf"F1 goes from {f1[0]:.2f} to {f1[1]:.2f}, the best of [45] views"
    assert re.match(told, steps[0].decision.why)


@pytest.mark.slow
def test_trying_views_changes_nothing_of_the_exploration(explored):
    steps, _ = explored
    again, _ = exploration(Chosen(s.decision.index for s in steps[:-1]))
    assert [graph_text(s.graph) for s in again] == [graph_text(s.graph) for s in steps]
    for one, other in zip(steps, again, strict=True):
        np.testing.assert_array_equal(one.view.depth, other.view.depth)


@pytest.mark.slow
def test_none_of_the_views_it_tries_would_have_been_better(explored):
    steps, f1 = explored
    config = replace(CONFIG, active=replace(CONFIG.active, max_views=2))
    spread = spread_out(steps[0].candidates.directions, steps[0].visited, 4)
    tried = {*spread.tolist(), exploration(make_planner("support"), config=config)[0][0].decision.index}
    assert steps[0].decision.index in tried
    others = [exploration(Chosen([index]), config=config)[1][1] for index in tried]
    assert f1[1] == max(others)
    assert min(others) < max(others)


@pytest.mark.parametrize("wrong", ["camera", "seed"])
def test_another_exploration_than_its_own_is_refused(wrong):
    stage = make_simulation(simulated_scene("tower"), CONFIG, noise="carmine", seed=0)
    oracle = OraclePlanner(stage.camera, truth_of("tower"), CONFIG, segmentation="labels")
    camera, seed = (stage.camera, 0) if wrong == "camera" else (oracle.camera, 1)
    steps = explore(camera, stage.robot, planner=oracle, config=CONFIG, segmentation="labels", seed=seed)
    with pytest.raises(InputError, match="differ from those of this exploration; pass its camera"):
        list(steps)


@pytest.mark.slow
def test_the_command_line_has_it_for_scenes_and_not_for_recordings(tmp_path, scene_file, recording, capsys):
    options = ["--planner", "oracle", "--views", 2, "--no-report", "--quiet", "--no-early-stop"]
    few = [*SMALL, "--set=oracle.candidates=2"]
    assert run_command("explore", scene_file, "--out", tmp_path / "a", *options, *few) == 0
    assert "F1 goes from" in (tmp_path / "a/views/00/view.json").read_text()
    capsys.readouterr()
    assert run_command("explore", recording, "--out", tmp_path / "b", *options) == 1
    assert "'oracle' requires the ground truth of a simulated scene" in capsys.readouterr().err
    assert not (tmp_path / "b").exists()
