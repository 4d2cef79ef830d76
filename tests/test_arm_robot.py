from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from arms import assert_gaze, base_at, sideways_only, within_arms_length
from synthetic import FEW_VIEWS, SENSOR, look_from
from test_docs import ROOT, blocks

from caryatid.config import ActiveVisionConfig, ArmConfig, RobotConfig
from caryatid.errors import InputError, PlanningError
from caryatid.exploration import explore
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box
from caryatid.robots.arm import RADIUS_SHARE, REASONS, UNCONFIRMED, ArmRobot
from caryatid.robots.floor import FloorGrid
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.simulation import load_scene
from caryatid.simulation.camera import SimulatedCamera

PAGE = ROOT / "docs/robot.md"

TOP = (0.0, 0.0, 0.75)
BESIDE = (0.1, 0.0, 0.8)
PROPOSED = ViewSphere.around(TOP, ActiveVisionConfig(sphere_points=1000))
BASE = base_at(-0.5, 0.0, 0.75)
CONFIG = ArmConfig(sphere_points=600, radius_views=200)


def arm(reachable=within_arms_length, T_world_base=BASE, config=CONFIG, **given) -> ArmRobot:
    return ArmRobot(reachable, T_world_base, config, **given)


def offered(robot):
    return robot.candidates(robot.view_sphere(PROPOSED))


def roll_of(T_world_camera):
    """Angle of the image's rows against the horizontal [deg]."""
    return np.rad2deg(np.arcsin(np.abs(T_world_camera[..., 2, 0])))


class TestViewSphere:
    def test_it_is_around_the_table_and_answers_for_itself(self):
        robot = arm()
        sphere = robot.view_sphere(PROPOSED)
        np.testing.assert_array_equal(sphere.centre_world, TOP)
        assert len(sphere.directions) == CONFIG.sphere_points
        assert robot.view_sphere(sphere) is sphere is robot.view_sphere(PROPOSED)
        np.testing.assert_array_equal(arm(centre_world=BESIDE).view_sphere(PROPOSED).centre_world, BESIDE)

    def test_the_largest_with_nearly_as_many_views_is_taken(self):
        def count(radius: float) -> int:
            return len(offered(arm(config=replace(CONFIG, radius=(radius, radius)))))

        chosen = arm().view_sphere(PROPOSED).radius
        most = max(count(float(r)) for r in np.linspace(*CONFIG.radius, 13))
        assert count(chosen) > (RADIUS_SHARE - 0.05) * most
        assert count(chosen + 0.1) < RADIUS_SHARE * most


class TestCandidates:
    def test_they_are_what_the_function_allows_clear_of_the_table(self):
        robot = arm()
        sphere = robot.view_sphere(PROPOSED)
        found = robot.candidates(sphere)
        assert len(found) > 50
        assert within_arms_length(transforms.invert(BASE) @ found.T_world_camera).all()
        np.testing.assert_allclose(roll_of(found.T_world_camera), 0.0, atol=1e-9)
        assert found.T_world_camera[:, 2, 3].min() >= TOP[2] + CONFIG.clearance
        np.testing.assert_array_equal(found.directions, sphere.directions[found.indices])
        others = np.setdiff1d(np.arange(len(sphere.directions)), found.indices)
        poses = sphere.poses(sphere.directions[others])
        high = poses[:, 2, 3] >= TOP[2] + CONFIG.clearance
        assert not within_arms_length((transforms.invert(BASE) @ poses)[high]).any()

    def test_every_view_is_a_candidate_or_counted_with_its_reason(self):
        wall = Box(transforms.rigid(np.eye(3), (0.0, 0.4, 1.0)), np.array([1.2, 0.04, 2.0]))
        found = offered(arm(furniture=FloorGrid.from_boxes([wall], RobotConfig())))
        assert set(found.rejected) == set(REASONS)
        assert len(found) + sum(found.rejected.values()) == CONFIG.sphere_points
        assert found.T_world_camera[:, 1, 3].max() < 0.4
        free = offered(arm())
        assert free.T_world_camera[:, 1, 3].max() > 0.4
        assert free.rejected.keys() == {REASONS[0], REASONS[2]}

    def test_a_camera_mounted_on_its_side_is_rolled(self):
        robot = arm(sideways_only)
        sphere = robot.view_sphere(PROPOSED)
        found = robot.candidates(sphere)
        assert len(found) > 50
        assert sideways_only(transforms.invert(BASE) @ found.T_world_camera).all()
        level = sphere.poses(found.directions)
        np.testing.assert_allclose(found.T_world_camera[:, :3, 2:], level[:, :3, 2:], atol=1e-12)
        assert roll_of(found.T_world_camera).min() > 30.0
        assert len(arm(sideways_only, config=replace(CONFIG, rolls=1)).candidates(sphere)) == 0

    def test_the_way_is_the_straight_line_of_the_hand(self):
        robot = arm()
        sphere = robot.view_sphere(PROPOSED)
        start = robot.candidates(sphere)
        assert not start.path_length.any()
        assert robot.move_to(start.T_world_camera[0]) == 0.0
        found = robot.candidates(sphere)
        angle = transforms.angle_between(found.directions[0], found.directions)
        np.testing.assert_allclose(found.path_length, 2.0 * sphere.radius * np.sin(angle / 2.0), atol=1e-9)
        assert robot.move_to(found.T_world_camera[7]) == pytest.approx(found.path_length[7])
        np.testing.assert_array_equal(robot.T_world_camera, found.T_world_camera[7])

    def test_waypoints_hold_the_joints_that_confirm_gives(self):
        base = base_at(-0.5, 0.1, 0.75, 30.0)
        robot = arm(T_world_base=base, confirm=lambda T: T[:3, 3])
        views = offered(robot).T_world_camera
        assert robot.waypoints(views[0])[0].joints is None
        robot.move_to(views[0])
        assert robot.confirm(views[9]) is None
        for posture, T in zip(robot.waypoints(views[9]), views[[0, 9]], strict=True):
            np.testing.assert_array_equal(posture.joints, (transforms.invert(base) @ T)[:3, 3])
            np.testing.assert_allclose(posture.platform_world, [-0.5, 0.1, np.deg2rad(30.0)])
            assert_gaze(posture, T)
        assert [p.joints for p in (arm(T_world_camera=views[0])).waypoints(views[9])] == [None, None]
        assert arm(confirm=lambda T: None).confirm(views[0]) is not None
        solution = np.array([0.1, 0.2])
        kept = arm(confirm=lambda T: solution)
        kept.confirm(views[0])
        solution[:] = 0.5  # the next answer is written into the same array
        np.testing.assert_array_equal(kept.waypoints(views[0])[0].joints, [0.1, 0.2])


@pytest.mark.parametrize(
    ("reachable", "eye", "distance"),
    [(within_arms_length, (2.0, 0.0, 1.5), 2.61), (sideways_only, (-0.3, 0.0, 1.2), 0.49)],
)
def test_it_says_why_it_cannot_reach_a_view(reachable, eye, distance):
    says = f"cannot reach this view: out of the hand's reach, {distance} m from the base"
    with pytest.raises(PlanningError, match=says):
        arm(reachable).move_to(transforms.look_at(eye, TOP))


def test_bases_and_answers_that_make_no_sense_are_refused():
    with pytest.raises(InputError, match="T_world_base"):
        arm(T_world_base=2.0 * BASE)
    for answer in (lambda T: True, lambda T: np.ones((len(T), 1), dtype=bool), lambda T: np.ones(len(T))):
        with pytest.raises(InputError, match=r"reachable: returned .* return bool of shape"):
            arm(answer).view_sphere(PROPOSED)


SETTINGS = replace(FEW_VIEWS, arm=CONFIG)


@pytest.mark.slow
def test_where_nothing_is_in_reach_or_confirmed_it_stops_with_reasons_and_counts():
    asked = []
    stops = {}
    for name, reachable, confirm in (
        ("reach", lambda T_base_camera: np.zeros(len(T_base_camera), dtype=bool), None),
        ("confirm", within_arms_length, asked.append),
    ):
        camera = SimulatedCamera(load_scene("tower"), sensor=SENSOR)
        robot = arm(reachable, confirm=confirm, T_world_camera=look_from(180.0))
        (stops[name],) = explore(camera, robot, config=SETTINGS)
    low, out = (stops["reach"].candidates.rejected[reason] for reason in (REASONS[0], REASONS[2]))
    assert low + out == CONFIG.sphere_points
    assert stops["reach"].stop == f"no candidate views left: {REASONS[0]} ({low}), {REASONS[2]} ({out})"
    assert stops["confirm"].stop == f"the robot refused 20 views in a row: {UNCONFIRMED}"
    assert len(asked) == 20


class Rig:
    """A real arm and its camera, played by the simulation: the page's driver and sensor."""

    def __init__(self, camera, T_hand_camera):
        self.camera, self.K, self.T_hand_camera = camera, camera.K, T_hand_camera
        self.T_hand = (
            transforms.invert(BASE)
            @ transforms.look_at((-0.4, 0.1, 1.3), TOP)
            @ transforms.invert(T_hand_camera)
        )
        self.planned, self.gone = 0, 0

    def T_base_hand(self):
        return self.T_hand

    def plan(self, T_base_hand):
        self.planned += 1
        return None if self.planned == 1 else [T_base_hand]

    def go_to(self, T_base_hand):
        self.gone += 1
        if self.gone > 1:  # the first motion fails
            self.T_hand = T_base_hand
        return self.gone > 1

    def read(self):
        view = self.camera.capture(BASE @ self.T_hand @ self.T_hand_camera)
        return view.depth, view.rgb


@pytest.mark.slow
def test_the_hardware_of_the_page_on_robots_goes_around_the_table():
    (code,) = (text for _, _, text in blocks(PAGE) if "class RealArm" in text)
    page = {}
    exec(code, page)
    assert len(code.splitlines()) < 40
    T_hand_camera = base_at(0.02, -0.06, 0.03, 90.0)
    rig = Rig(SimulatedCamera(load_scene("tower"), sensor=SENSOR), T_hand_camera)
    robot = page["RealArm"](rig, within_arms_length, BASE, T_hand_camera)
    camera = page["HandCamera"](rig, rig, BASE, T_hand_camera)
    steps = list(explore(camera, robot, config=SETTINGS, early_stop=False))
    assert (len(steps), rig.gone) == (3, 3)
    assert rig.planned == 1 + rig.gone, "what was accepted is not planned again"
    assert steps[-1].path_travelled > 0.3
    assert steps[0].candidates.rejected[UNCONFIRMED] == 1
    for before, after in pairwise(steps):
        taken = after.view.T_world_camera
        went = before.index > 0  # the first motion failed
        assert np.allclose(taken, before.decision.T_world_camera, atol=1e-9) == went
        distance = np.linalg.norm(taken[:3, 3] - after.sphere.centre_world)
        assert distance == pytest.approx(after.sphere.radius)
    assert len(steps[-1].graph.objects) > 3
