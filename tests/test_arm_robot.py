"""Arms: what they reach by a function or a map, what they offer, and the hardware of the page on robots."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from arms import HIGH, LIMITS, LOW, PITCH, assert_gaze, base_at, gantry, sideways_only, within_arms_length
from synthetic import FEW_VIEWS, SENSOR, look_from
from test_docs import ROOT, blocks

from caryatid.cli.options import LiftingCommand
from caryatid.config import ActiveVisionConfig, ArmConfig, Config, GripperConfig, RobotConfig
from caryatid.errors import InputError, PlanningError
from caryatid.exploration import explore
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box
from caryatid.robots import find_robot
from caryatid.robots.arm import REASONS, UNCONFIRMED, ArmRobot
from caryatid.robots.floor import FloorGrid
from caryatid.robots.reachability import (
    ReachabilityMap,
    read_reachability,
    sample_reachability,
    write_reachability,
)
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


# Maps of sampled poses

COARSE = ArmConfig(cell=0.1, view_directions=60)
BIN = np.deg2rad(35.0)
"""Angle between directions that share a bin at the most."""


def sample(count: int = 400_000) -> ReachabilityMap:
    return sample_reachability(gantry, LIMITS, count, np.random.default_rng(0), COARSE)


@pytest.fixture(scope="module")
def reachability() -> ReachabilityMap:
    return sample()


def poses(low, high, count: int = 3000) -> np.ndarray:
    """Poses of the gantry with joints between two ends."""
    return gantry(np.random.default_rng(1).uniform(low, high, (count, 6)))


class TestReachabilityMap:
    def test_it_holds_what_lies_well_within_the_limits_and_nothing_well_beyond(self, reachability):
        inside = poses([*(LOW + 0.05), -np.pi, -0.6, -0.5], [*(HIGH - 0.05), np.pi, -0.4, 0.5])
        assert reachability(inside).all()
        assert reachability.fresh < 0.01
        for joint, *ends in (
            (0, HIGH[0] + 0.1, HIGH[0] + 5.0),
            (1, -5.0, LOW[1] - 0.1),
            (2, HIGH[2] + 0.1, 1e6),
            (4, PITCH[1] + BIN, np.pi / 2.0),
            (5, np.deg2rad(150.0), np.deg2rad(210.0)),
        ):
            beyond = LIMITS.copy()
            beyond[joint] = ends
            assert not reachability(poses(*beyond.T)).any()

    def test_impossible_postures_are_left_out(self):
        def forward(joints):
            return np.where((joints[:, 0] > 0.35)[:, None, None], np.nan, gantry(joints))

        found = sample_reachability(forward, LIMITS, 50_000, np.random.default_rng(0), COARSE)
        assert found(poses(LIMITS[:, 0], [0.3, *LIMITS[1:, 1]])).mean() > 0.9
        assert not found(poses([0.41, *LIMITS[1:, 0]], LIMITS[:, 1])).any()


@pytest.mark.parametrize(
    ("forward", "limits", "count", "message"),
    [
        (gantry, np.zeros((6, 3)), 10, r"\(J, 2\), not shape \(6, 3\)"),
        (gantry, [[0.0, np.nan]], 10, "finite"),
        (gantry, [[0.0, 1.0], [1.0, 0.5]], 10, "joint 1 has low > high"),
        (gantry, LIMITS, 0, "0 is too few"),
        (lambda joints: gantry(joints)[:, :3], LIMITS, 10, r"returned shape \(1, 3, 4\) for 1 postures"),
        (lambda joints: gantry(joints)[:-1], LIMITS, 10, r"returned shape \(0, 4, 4\)"),
        (lambda joints: 2.0 * gantry(joints), LIMITS, 10, "last row"),
        (lambda joints: gantry(joints) * np.array([-1.0, 1.0, 1.0, 1.0]), LIMITS, 10, "not a rotation"),
        (lambda joints: np.full((len(joints), 4, 4), np.nan), LIMITS, 10, "NaN for every posture"),
    ],
)
def test_what_cannot_be_sampled_is_refused(forward, limits, count, message):
    with pytest.raises(InputError, match=message):
        sample_reachability(forward, limits, count, np.random.default_rng(0))


class TestFiles:
    def test_a_map_comes_back_as_it_was_and_the_same_bytes_go_out(self, reachability, tmp_path):
        one, other = tmp_path / "one.npz", tmp_path / "other"
        write_reachability(one, reachability)
        back = read_reachability(one)
        np.testing.assert_array_equal(back.reached, reachability.reached)
        np.testing.assert_array_equal(back.origin_base, reachability.origin_base)
        assert (back.cell, back.fresh) == (reachability.cell, reachability.fresh)
        write_reachability(other, back)
        assert one.read_bytes() == other.read_bytes()
        assert sorted(p.name for p in tmp_path.iterdir()) == ["one.npz", "other"]

    def test_a_map_is_used_for_what_it_is(self, tmp_path):
        rng, base, world = np.random.default_rng(0), base_at(-0.5, 0.1, 0.7, 30.0), tmp_path / "world.npz"
        camera = sample_reachability(gantry, LIMITS, 2000, rng, COARSE)
        known = {"kind": "gripper", "T_world_base": base}
        gripper = sample_reachability(gantry, LIMITS, 2000, np.random.default_rng(0), COARSE, **known)
        T_base_hand = gantry(np.random.default_rng(0).uniform(*LIMITS.T, (2000, len(LIMITS))))
        np.testing.assert_array_equal(gripper(base @ T_base_hand), camera(T_base_hand))
        write_reachability(world, gripper)
        np.testing.assert_array_equal(read_reachability(world)(base @ T_base_hand), camera(T_base_hand))
        with pytest.raises(InputError, match=r"world\.npz: is a map of the gripper in the world frame, but"):
            find_robot(f"arm:{world}")
        with pytest.raises(InputError, match="reachable: is a map of the gripper in the world frame, but"):
            ArmRobot(gripper, base)
        write_reachability(tmp_path / "arm.npz", camera)
        command = LiftingCommand(gripper="parallel", reach=tmp_path / "arm.npz")
        with pytest.raises(InputError, match=r'arm\.npz: .*kind="gripper", T_world_base=…\) makes it'):
            command.reachable(replace(Config(), gripper=GripperConfig(kind="parallel")))
        with pytest.raises(InputError, match="kind: 'foot' is unknown"):
            sample_reachability(gantry, LIMITS, 10, rng, COARSE, kind="foot")

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"format": np.array("caryatid/graph")}, "not a reachability map"),
            ({"version": np.array(1)}, r"earlier caryatid, without its kind .* and frame; sample it again"),
            ({"version": np.array(3)}, "version 3 is not supported"),
            ({"kind": np.array("foot")}, "not the arrays"),
            ({"frame": np.array("world")}, "not the arrays"),
            ({"frame": np.array("world"), "T_world_base": np.ones((4, 4))}, "T_world_base: the last row"),
            ({"cell": None}, "not the arrays"),
            ({"cell": np.array(np.nan)}, "not the arrays"),
            ({"reached": np.zeros((2, 2, 2, 2))}, "not the arrays"),
            ({"reached": np.zeros((0, 2, 2, 2), dtype=np.uint8)}, "not the arrays"),
            ({"reached": np.array([None])}, "damaged"),
        ],
    )
    def test_another_content_is_refused(self, tmp_path, change, message):
        file = tmp_path / "map.npz"
        write_reachability(file, sample(1000))
        content = dict(np.load(file))
        np.savez(file, **{k: v for k, v in (content | change).items() if v is not None})
        with pytest.raises(InputError, match=rf"map\.npz: .*{message}"):
            read_reachability(file)
        with pytest.raises(InputError, match="the file is missing"):
            read_reachability(tmp_path / "other.npz")
