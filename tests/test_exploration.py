from __future__ import annotations

import itertools
import pickle
from dataclasses import fields, is_dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import refusal, wall_of
from synthetic import FEW_VIEWS, model_of, simulated_scene, simulated_views

from caryatid.errors import InputError, NoSurfaceError, PlanningError
from caryatid.exploration import Explorer, explore, next_best_view
from caryatid.geometry import transforms
from caryatid.graph import SupportGraph
from caryatid.io import read_recording, write_recording
from caryatid.io.graph_json import graph_text
from caryatid.robots import Unreachable
from caryatid.robots.protocol import RecordingCamera, RecordingRobot
from caryatid.scene import Scene
from caryatid.simulation.setup import make_simulation
from caryatid.steps import RunWriter, read_run, read_steps


def stage(config=FEW_VIEWS, noise="none"):
    return make_simulation(simulated_scene("tower"), config, noise=noise, seed=0)


def exploration(config=FEW_VIEWS, noise="none", robot=None, **options):
    set_up = stage(config, noise)
    return list(explore(set_up.camera, robot or set_up.robot, config=config, **options))


def test_with_a_budget_the_robot_goes_on_and_the_last_step_knows_all_views(steps):
    hurried = exploration(early_stop=False, budget=0.0)
    assert [step.index for step in hurried] == [step.index for step in steps]
    assert hurried[0].decision is not None
    taken = hurried[-1].visited
    assert len(taken) == len(np.unique(taken.round(6), axis=0)) == len(steps)


@pytest.fixture(scope="module")
def steps():
    return exploration(early_stop=False)


LONG = replace(FEW_VIEWS, active=replace(FEW_VIEWS.active, max_views=8))


def test_it_ends_where_no_view_promises_more_than_its_path_costs():
    steps = exploration(LONG)
    assert 1 < len(steps) < 8
    assert steps[-1].stop == "no further view is worth its path"
    scores = [s.decision.score for s in exploration(LONG, early_stop=False)[: len(steps)]]
    assert min(scores[1:-1], default=1.0) > 0.0 >= scores[-1]


def test_with_a_goal_it_ends_once_it_is_known_what_that_moves():
    alone, steps = len(exploration(LONG)), exploration(LONG, goal="o5")
    assert len(steps) < alone
    assert steps[-1].stop == "whether each object moves without o5 is known with probability 0.95"
    assert steps[-1].removal.object_id == "o5"
    assert steps[-1].removal.effects == steps[-1].removal.moving
    never = exploration(LONG, goal="o99")
    assert len(never) == alone
    assert never[-1].stop.endswith("; o99 was not found")
    assert never[-1].removal is None
    sure = exploration(LONG, until=0.6)[-1]
    assert (sure.index, sure.stop) == (1, "every support is known with probability 0.6")
    with pytest.raises(InputError, match=r"0.5 is not above 0.5 and at most 1"):
        exploration(until=0.5)


def test_each_view_is_taken_where_the_one_before_decided(steps):
    assert steps[0].angle_travelled == steps[0].path_travelled == 0.0
    for before, after in itertools.pairwise(steps):
        decision = before.decision
        np.testing.assert_array_equal(after.view.pose, decision.T_world_camera)
        np.testing.assert_array_equal(before.candidates.T_world_camera[decision.index], after.view.pose)
        np.testing.assert_array_equal(after.visited[:-1], before.visited)
        np.testing.assert_allclose(after.visited[-1], before.sphere.direction_of(decision.T_world_camera))
        angle = transforms.angle_between(after.visited[-2], after.visited[-1])
        assert after.angle_travelled - before.angle_travelled == pytest.approx(angle)
        for end, step in ((decision.waypoints[0], before), (decision.waypoints[-1], after)):
            np.testing.assert_array_equal(end.platform_world, step.robot.posture.platform_world)
        length = before.candidates.path_length[decision.index]
        assert after.path_travelled - before.path_travelled == pytest.approx(length)
    assert steps[-1].angle_travelled > 0.5


def test_a_step_tells_all_of_a_turn_and_the_last_why_it_stopped(steps):
    assert [s.index for s in steps] == [0, 1, 2]
    assert [s.stop for s in steps] == [None, None, "maximum of 3 views reached"]
    for step in steps:
        assert (step.decision is None) == (step.candidates is None) == (step.stop is not None)
        assert step.labels.shape == step.view.depth.shape
        assert len(step.visited) == step.index + 1
        assert {"capture", "segment", "fit"} <= set(step.timings)
        assert ("plan" in step.timings) == (step.stop is None)
        assert step.decision is None or step.decision.why
    assert 0 < len(steps[0].cloud) < len(steps[-1].cloud)


def test_the_next_view_can_be_asked_for_alone():
    views = simulated_views("tower")
    robot = RecordingRobot([v.pose for v in views])
    scene = model_of(views[:1], FEW_VIEWS)
    decision = next_best_view(scene, robot)
    assert any(np.array_equal(decision.T_world_camera, v.pose) for v in views[1:])
    candidates = robot.candidates(scene.sphere)
    visited = scene.sphere.direction_of(views[0].pose)[None]
    given = next_best_view(scene, None, visited, candidates=candidates)
    assert (given.index, given.score) == (decision.index, decision.score)
    poses = candidates.T_world_camera
    alone = next_best_view(scene, candidates=poses, path_length=candidates.path_length)
    assert (alone.index, alone.score, alone.waypoints) == (given.index, given.score, ())
    far = poses.copy()
    far[:, :3, 3] *= 1000.0
    for wrong in (far, "left", poses[:, :3], 2.0 * poses):
        with refusal("candidates"):
            next_best_view(scene, candidates=wrong)
    with pytest.raises(PlanningError):
        next_best_view(scene, candidates=np.zeros((0, 4, 4)))
    with refusal("path_length"):
        next_best_view(scene, candidates=poses, path_length=[1.0])
    for wrong in (visited[0], visited[:0], [[1.0], [1.0, 0.0]], "left", 2.0 * visited, np.nan * visited):
        with refusal("visited"):
            next_best_view(scene, None, wrong, candidates=candidates)
    with refusal("planner's choice", "NoneType"):
        planner = SimpleNamespace(plan=lambda state, rng: None)
        next_best_view(scene, candidates=poses, planner=planner)
    with refusal("scene"):
        next_best_view(scene.graph, candidates=poses)
    with pytest.raises(PlanningError, match="neither a robot nor candidates"):
        next_best_view(scene)
    with pytest.raises(PlanningError, match="has no views"):
        next_best_view(Scene(), stage().robot)


class Shy:
    """The protocol alone, around a robot whose motion planner fails three times in ten."""

    def __init__(self, robot, seed):
        self.robot, self.rng = robot, np.random.default_rng(seed)

    def fails(self):
        return self.rng.random() < 0.3

    @property
    def T_world_camera(self):
        return self.robot.T_world_camera

    def candidates(self, sphere):
        return self.robot.candidates(sphere)

    def solve(self, T_world_camera):
        return Unreachable("no path found") if self.fails() else self.robot.solve(T_world_camera)

    def move_to(self, T_world_camera):
        if self.fails():
            raise PlanningError("the motion stopped")
        return self.robot.move_to(T_world_camera)


def test_motions_that_fail_do_not_end_it(caplog):
    for seed in range(4):
        set_up = make_simulation(simulated_scene("tower"), FEW_VIEWS, noise="none", seed=seed)
        steps = list(explore(set_up.camera, Shy(set_up.robot, seed), config=FEW_VIEWS, early_stop=False))
        assert [step.index for step in steps] == [0, 1, 2]
        assert steps[-1].stop == "maximum of 3 views reached"
    assert "put aside: the motion stopped" in caplog.text


def test_where_every_motion_fails_the_last_step_says_why(tmp_path):
    set_up = stage()
    set_up.robot.move_to = lambda T_world_camera: exec("raise PlanningError('the motion stopped')")
    explorer = Explorer(set_up.camera, set_up.robot, config=FEW_VIEWS)
    explorer.look()
    planned = explorer.plan()
    ended = explorer.go()
    assert ended.decision is None
    assert ended.stop == "the robot refused 20 views in a row: the motion stopped"
    assert len(planned.candidates) - len(ended.candidates) == 20
    assert ended.candidates.rejected["the motion stopped"] == 20
    steps = list(explore(set_up.camera, set_up.robot, config=FEW_VIEWS))
    assert [(step.index, step.stop) for step in steps] == [(0, None), (0, ended.stop)]
    run = written(tmp_path / "run", steps)
    assert [step.stop for step in read_steps(run)] == [ended.stop], "it replaces the step before"


def test_a_person_may_choose_another_view_and_another_planner():
    set_up = stage()
    explorer = Explorer(set_up.camera, set_up.robot, config=FEW_VIEWS, planner="support")
    explorer.look()
    planned = explorer.plan()
    explorer.use_planner("farthest")
    other = explorer.plan()
    assert other.decision.index != planned.decision.index
    index = np.int64((other.decision.index + 7) % len(other.candidates))
    chosen = explorer.choose(index)
    assert chosen.decision.why == "chosen by hand"
    assert chosen.decision.score == chosen.decision.saliency - chosen.decision.cost
    there = set_up.robot.solve(chosen.decision.T_world_camera)
    assert repr(pickle.loads(pickle.dumps(chosen.decision.waypoints[-1]))) == repr(there)
    explorer.go()
    seen = explorer.look()
    np.testing.assert_array_equal(seen.view.pose, chosen.decision.T_world_camera)
    assert seen.path_travelled > 0.0
    with pytest.raises(PlanningError, match="no next view"):
        explorer.go()
    with pytest.raises(PlanningError, match="does not exist"):
        explorer.choose(0)


def test_views_may_be_handed_in_without_camera_or_robot():
    explorer = Explorer(config=FEW_VIEWS)
    with pytest.raises(PlanningError, match="no camera"):
        explorer.look()
    steps = [explorer.look(view) for view in simulated_views("tower")]
    straight = np.linalg.norm(steps[1].view.pose[:3, 3] - steps[0].view.pose[:3, 3])
    assert steps[1].path_travelled == pytest.approx(straight)
    assert steps[-1].angle_travelled > steps[1].angle_travelled > 0.0
    with pytest.raises(PlanningError, match="no robot"):
        explorer.plan()


def test_views_of_a_scene_that_another_program_explored_count_as_visited():
    first, other = simulated_views("tower")[:2]
    explorer = Explorer()
    explorer.scene = model_of([first])
    step = explorer.look(other)
    expected = step.sphere.direction_of(np.stack([first.pose, other.pose]))
    np.testing.assert_allclose(step.visited, expected, atol=1e-3)


def test_a_kept_view_counts_as_taken_from_where_it_was():
    first, other = simulated_views("tower")[:2]
    wall = wall_of(first)
    robot = RecordingRobot([wall.pose, other.pose])
    explorer = Explorer(robot=robot)
    with pytest.raises(NoSurfaceError):
        explorer.look(wall)
    robot.move_to(other.pose)
    kept, step = explorer.looks(other)
    expected = step.sphere.direction_of(np.stack([wall.pose, other.pose]))
    np.testing.assert_allclose(step.visited, expected, atol=1e-9)
    assert kept.robot is None
    assert step.angle_travelled == pytest.approx(np.arccos(expected[0] @ expected[1]))


def test_a_recording_from_one_place_is_shown_frame_by_frame(tmp_path):
    views = [replace(view, name="") for view in simulated_views("tower")[:2]]
    empty = replace(views[0], labels=np.where(views[0].labels == 4, 0, views[0].labels))
    write_recording(tmp_path / "rec", [*views, empty])
    camera = RecordingCamera(read_recording(tmp_path / "rec"))
    shown = [camera.capture(view.pose).name for view in (*views, empty, empty)]
    assert shown == ["rec/000000", "rec/000001", "rec/000002", "rec/000000"]


def test_masks_that_would_not_be_used_are_refused():
    with pytest.raises(InputError, match="are not used by segmentation auto"):
        Explorer(masks=lambda view: view, segmentation="auto")


def written(folder, steps):
    with RunWriter(folder, FEW_VIEWS, {"source": "tower", "seed": 0, "options": {}}) as writer:
        for step in steps:
            writer.add(step)
    return read_run(folder)


def test_steps_come_back_from_a_run_folder_as_they_were(steps, tmp_path):
    run = written(tmp_path / "run", steps)
    ends = run.views[0].record["next"]["waypoints"][-1]
    np.testing.assert_allclose(ends["platform"], steps[0].decision.waypoints[-1].platform_world, atol=1e-8)
    for step, read in zip(steps, read_steps(run), strict=True):
        check_same(step, read)


def check_same(one, other):
    """The same content, arrays to a micrometre, whatever is kept of it for speed."""
    assert type(one) is type(other)
    if isinstance(one, np.ndarray):
        assert one.dtype == other.dtype
        np.testing.assert_allclose(one, other, atol=1e-6)
    elif isinstance(one, tuple):
        for pair in zip(one, other, strict=True):
            check_same(*pair)
    elif isinstance(one, SupportGraph):
        assert graph_text(one) == graph_text(other)
    elif is_dataclass(one):
        for field in fields(one):
            if not field.name.startswith("_"):
                check_same(getattr(one, field.name), getattr(other, field.name))
    else:
        assert one == other


def test_the_log_tells_each_view_and_decision(caplog):
    with caplog.at_level("INFO", "caryatid.progress"):
        steps = exploration()
    told = [record.getMessage() for record in caplog.records if record.name == "caryatid.progress"]
    views = [f"{len(s.graph.objects)} vertices, {len(s.graph.supports)} edges" for s in steps]
    assert [any(view in line for line in told) for view in views] == [True] * len(steps)
    assert f"next view: {steps[0].decision.why}" in told


def test_a_broken_step_is_refused_by_its_name(steps, tmp_path):
    run = written(tmp_path / "run", steps[:1])
    path = run.views[0].folder / "step.npz"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(InputError, match="not a step of a run") as caught:
        list(read_steps(run))
    assert "views/00/step.npz" in str(caught.value)
    path.unlink()
    with pytest.raises(InputError, match="the file is missing"):
        list(read_steps(run))
