from __future__ import annotations

import numpy as np
import pytest

from caryatid.config import ActiveVisionConfig, RobotConfig
from caryatid.errors import PlanningError
from caryatid.geometry import transforms
from caryatid.robots import Posture, Unreachable, home_view
from caryatid.robots.floor import FloorGrid
from caryatid.robots.humanoid import HumanoidRobot
from caryatid.robots.recording import RecordingRobot
from caryatid.sensing.view_sphere import ViewSphere, direction

CONFIG = RobotConfig()
SPHERE = ViewSphere.around((0.0, 0.0, 0.75), ActiveVisionConfig())
TABLE = ((0.0, 0.0, 0.73), (0.35, 0.5, 0.02))
WALL = ((0.62, 0.0, 1.0), (0.03, 1.6, 1.0))


def floor(*boxes: tuple[tuple[float, float, float], tuple[float, float, float]]) -> FloorGrid:
    centres, half = np.array([b[0] for b in boxes]), np.array([b[1] for b in boxes])
    return FloorGrid.from_boxes(centres, half, np.tile(np.eye(3), (len(boxes), 1, 1)), CONFIG)


def pose(azimuth: float, elevation: float) -> np.ndarray:
    return SPHERE.poses(direction(*np.deg2rad((azimuth, elevation)))[None])[0]


def azimuths(directions: np.ndarray) -> np.ndarray:
    return np.rad2deg(np.arctan2(directions[:, 1], directions[:, 0]))


class TestFloorGrid:
    def test_obstacles_are_grown_by_the_footprint(self):
        grid = floor(((0.0, 0.0, 0.5), (0.2, 0.4, 0.5)))
        rows, columns = np.nonzero(~grid.free)
        x = grid.origin_world[0] + grid.cell * (columns + 0.5)
        y = grid.origin_world[1] + grid.cell * (rows + 0.5)
        gap = np.hypot(np.maximum(np.abs(x) - 0.2, 0.0), np.maximum(np.abs(y) - 0.4, 0.0))
        assert gap.max() < CONFIG.footprint
        expected = (0.4 * 0.8 + 0.35 * 2.4 + np.pi * 0.35**2) / grid.cell**2
        assert len(rows) == pytest.approx(expected, rel=0.02)

    def test_what_lies_flat_or_hangs_high_is_no_obstacle(self):
        assert floor(((0.0, 0.0, 0.005), (1.0, 1.0, 0.005)), ((0.0, 0.0, 3.0), (1.0, 1.0, 0.5))).free.all()

    def test_path_length_in_the_open_is_the_octile_distance(self):
        grid = floor(TABLE)
        lengths = grid.path_lengths((-2.0, -2.0))
        cells, _ = grid.cells(np.array([[-1.0, -2.0], [-1.5, -1.5], [-2.0, -2.0]]))
        np.testing.assert_allclose(lengths.ravel()[cells], [1.0, np.hypot(0.5, 0.5), 0.0], atol=1e-9)

    def test_the_way_leads_around_a_wall(self):
        grid = floor(((0.0, 0.0, 1.0), (0.05, 2.0, 1.0)))
        cells, _ = grid.cells(np.array([[1.0, 0.0]]))
        length = grid.path_lengths((-1.0, 0.0)).ravel()[cells[0]]
        shortest = 2.0 * np.hypot(1.0 - 0.05, 2.0 + 0.35) + 0.1
        assert shortest - 0.15 < length < 1.15 * shortest

    def test_a_map_of_obstacles_gives_the_same_floor(self):
        occupied = np.zeros((80, 100), dtype=bool)
        occupied[30:40, 50:60] = True
        grid = FloorGrid.from_occupancy(occupied, (-2.0, -1.0), 0.05, CONFIG)
        box = FloorGrid.from_boxes([[0.75, 0.75, 1.0]], [[0.25, 0.25, 1.0]], [np.eye(3)], CONFIG)
        points = np.random.default_rng(0).uniform((-1.9, -0.9), (2.9, 2.9), (500, 2))
        distance = np.linalg.norm(np.maximum(np.abs(points - 0.75) - 0.25, 0.0), axis=1)
        clear = np.abs(distance - CONFIG.footprint) > 0.08
        for g in (grid, box):
            cells, inside = g.cells(points)
            assert inside.all()
            np.testing.assert_array_equal(g.free.ravel()[cells][clear], (distance >= 0.35)[clear])
        assert FloorGrid.from_occupancy(np.zeros((4, 4), dtype=bool), (0, 0), 0.1, CONFIG).free.all()

    def test_walls_hide_and_the_table_under_the_target_does_not(self):
        grid = floor(TABLE, WALL)
        eyes = np.array([[1.3, 0.0, 1.5], [-1.3, 0.0, 1.5], [0.9, 0.0, 8.0]])
        target = np.array([0.0, 0.0, 0.74])
        assert grid.hidden(eyes, target).tolist() == [True, False, False]


class TestHumanoidRobot:
    def test_the_camera_is_where_the_posture_puts_it(self):
        robot = HumanoidRobot(floor(TABLE, WALL), CONFIG)
        for azimuth in (180.0, -120.0, 135.0, -89.0):
            T = pose(azimuth, 35.0)
            posture = robot.solve(T)
            assert isinstance(posture, Posture)
            x, y, yaw = posture.platform_world
            forward = CONFIG.camera_forward * np.array([np.cos(yaw), np.sin(yaw)])
            gaze = yaw + posture.head_yaw
            level = np.cos(posture.head_pitch)
            axis = [level * np.cos(gaze), level * np.sin(gaze), np.sin(posture.head_pitch)]
            np.testing.assert_allclose(np.array([x, y]) + forward, T[:2, 3], atol=1e-9)
            np.testing.assert_allclose(axis, T[:3, 2], atol=1e-9)
            assert posture.camera_height == T[2, 3]

    @pytest.mark.parametrize(
        ("T_world_camera", "reason"),
        [
            (
                transforms.look_at((-1.5, 0.0, 1.0), (0.0, 0.0, 0.75)),
                "too low: 1.00 m, it reaches 1.30…1.90 m",
            ),
            (transforms.look_at((-1.5, 0.0, 2.0), (0.0, 0.0, 0.75)), "too high"),
            (transforms.look_at((-1.0, 0.0, 1.8), (-0.9, 0.0, 0.75)), "pitch is beyond its limits: -85°"),
            (transforms.look_at((-1.5, 0.0, 1.5), (0.0, 0.0, 2.9)), "pitch is beyond its limits: 43°"),
            (transforms.look_at((-1.5, 0.0, 1.5), (0.0, 0.0, 1.0), (0.0, 0.2, 1.0)), "rolled"),
            (transforms.look_at((-1.5, 0.0, 1.5), (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)), "rolled"),
            (transforms.look_at((-0.3, 0.0, 1.5), (0.0, 0.0, 1.4)), "in an obstacle"),
            (transforms.look_at((-3.5, 0.0, 1.5), (0.0, 0.0, 1.4)), "outside the floor"),
        ],
    )
    def test_it_says_why_not(self, T_world_camera: np.ndarray, reason: str):
        result = HumanoidRobot(floor(TABLE), CONFIG).solve(T_world_camera)
        assert isinstance(result, Unreachable)
        assert reason in result.reason

    def test_no_path_and_no_sight_are_reasons(self):
        shut = floor(TABLE, ((0.62, 0.0, 1.0), (0.03, 3.2, 1.0)))
        robot = HumanoidRobot(shut, CONFIG, pose(180.0, 35.0))
        beyond = pose(0.0, 30.0)
        blocked = robot.solve(beyond)
        assert isinstance(blocked, Unreachable)
        assert "no path leads there at x = 1.30 m" in blocked.reason
        open_robot = HumanoidRobot(floor(TABLE, WALL), CONFIG, pose(180.0, 35.0))
        assert isinstance(open_robot.solve(beyond), Posture)
        hidden = open_robot.solve(beyond, SPHERE.centre_world)
        assert isinstance(hidden, Unreachable)
        assert "wall" in hidden.reason

    def test_candidates_agree_with_solve(self):
        robot = HumanoidRobot(floor(TABLE, WALL), CONFIG, pose(180.0, 35.0))
        candidates = robot.candidates(SPHERE)
        offered = set(candidates.indices.tolist())
        assert len(candidates) + sum(candidates.rejected.values()) == len(SPHERE.directions)
        seen = {True: 0, False: 0}
        for i in np.random.default_rng(3).integers(0, 40_000, 300):
            T = SPHERE.poses(SPHERE.directions[i : i + 1])[0]
            reachable = isinstance(robot.solve(T, SPHERE.centre_world), Posture)
            assert reachable == (int(i) in offered)
            seen[reachable] += 1
        assert min(seen.values()) > 10
        np.testing.assert_allclose(candidates.directions, SPHERE.directions[candidates.indices])
        np.testing.assert_allclose(SPHERE.direction_of(candidates.T_world_camera), candidates.directions)

    def test_moving_changes_where_it_stands_and_returns_the_way(self):
        robot = HumanoidRobot(floor(TABLE), CONFIG, pose(180.0, 35.0))
        there = pose(90.0, 35.0)
        length = robot.move_to(there)
        assert 1.5 < length < 2.6
        np.testing.assert_array_equal(robot.T_world_camera, there)
        assert robot.move_to(there) == 0.0
        assert robot.move_to(pose(180.0, 35.0)) == pytest.approx(length, abs=1e-9)

    def test_it_stands_nowhere_before_it_is_put_somewhere(self):
        robot = HumanoidRobot(floor(TABLE), CONFIG)
        with pytest.raises(PlanningError, match="nowhere"):
            _ = robot.T_world_camera
        assert robot.move_to(home_view(robot, SPHERE, CONFIG)) == 0.0

    def test_home_is_the_reachable_view_nearest_to_the_minus_x_side(self):
        robot = HumanoidRobot(floor(TABLE), CONFIG)
        home = SPHERE.direction_of(home_view(robot, SPHERE, CONFIG))
        assert np.rad2deg(transforms.angle_between(home, pose_direction(180.0, 35.0))) < 1.5
        walled = HumanoidRobot(floor(TABLE, ((-0.62, 0.0, 1.0), (0.03, 1.6, 1.0))), CONFIG)
        home = SPHERE.direction_of(home_view(walled, SPHERE, CONFIG))
        others = walled.candidates(SPHERE).directions
        wanted = pose_direction(180.0, 35.0)
        assert transforms.angle_between(home, wanted) == transforms.angle_between(others, wanted).min()

    def test_no_home_is_an_error_with_the_reasons(self):
        robot = HumanoidRobot(floor(((0.0, 0.0, 1.0), (3.0, 3.0, 1.0))), CONFIG)
        with pytest.raises(PlanningError, match="in an obstacle"):
            home_view(robot, SPHERE, CONFIG)


def pose_direction(azimuth: float, elevation: float) -> np.ndarray:
    return direction(*np.deg2rad((azimuth, elevation)))


class TestRecordingRobot:
    POSES = np.stack([pose(azimuth, 35.0) for azimuth in (180.0, 90.0, 0.0)])

    def test_candidates_are_the_views_left(self):
        robot = RecordingRobot(self.POSES)
        candidates = robot.candidates(SPHERE)
        np.testing.assert_array_equal(candidates.T_world_camera, self.POSES[1:])
        ring = 1.5 * np.cos(np.deg2rad(35.0))
        np.testing.assert_allclose(candidates.path_length, [ring * np.sqrt(2.0), 2.0 * ring])
        assert robot.move_to(self.POSES[2]) == pytest.approx(2.0 * ring)
        np.testing.assert_array_equal(robot.T_world_camera, self.POSES[2])
        np.testing.assert_array_equal(robot.candidates(SPHERE).T_world_camera, self.POSES[1:2])
        robot.move_to(self.POSES[1])
        assert len(robot.candidates(SPHERE)) == 0

    def test_other_poses_are_unreachable_and_it_says_why(self):
        robot = RecordingRobot(self.POSES)
        elsewhere = robot.solve(pose(45.0, 35.0))
        assert isinstance(elsewhere, Unreachable)
        assert "no view from there" in elsewhere.reason
        used = robot.solve(self.POSES[0])
        assert isinstance(used, Unreachable)
        assert "already been used" in used.reason
        with pytest.raises(PlanningError, match="no view from there"):
            robot.move_to(pose(45.0, 35.0))
