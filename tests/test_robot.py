from __future__ import annotations

import numpy as np
import pytest

from caryatid.config import ActiveVisionConfig, RobotConfig
from caryatid.errors import PlanningError
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box
from caryatid.robots import Posture, Unreachable, home_view
from caryatid.robots.floor import FloorGrid
from caryatid.robots.humanoid import HumanoidRobot
from caryatid.robots.recording import RecordingRobot
from caryatid.sensing.view_sphere import ViewSphere, direction

CONFIG = RobotConfig()
UP = (0.0, 0.0, 1.0)
SPHERE = ViewSphere.around((0.0, 0.0, 0.75), ActiveVisionConfig())


def box(centre, half) -> Box:
    return Box(transforms.rigid(np.eye(3), centre), 2.0 * np.array(half))


TABLE = box((0.0, 0.0, 0.73), (0.35, 0.5, 0.02))
WALL = box((0.62, 0.0, 1.0), (0.03, 1.6, 1.0))


def floor(*boxes: Box) -> FloorGrid:
    return FloorGrid.from_boxes(boxes, CONFIG)


def standing(grid: FloorGrid, T_world_camera: np.ndarray) -> HumanoidRobot:
    robot = HumanoidRobot(grid, CONFIG)
    assert robot.move_to(T_world_camera) == 0.0
    return robot


def pose(azimuth: float, elevation: float) -> np.ndarray:
    return SPHERE.poses(direction(*np.deg2rad((azimuth, elevation)))[None])[0]


class TestFloorGrid:
    def test_obstacles_are_grown_by_the_footprint(self):
        grid = floor(box((0.0, 0.0, 0.5), (0.2, 0.4, 0.5)))
        rows, columns = np.nonzero(~grid.free)
        x = grid.origin_world[0] + grid.cell * (columns + 0.5)
        y = grid.origin_world[1] + grid.cell * (rows + 0.5)
        gap = np.hypot(np.maximum(np.abs(x) - 0.2, 0.0), np.maximum(np.abs(y) - 0.4, 0.0))
        assert gap.max() < CONFIG.footprint
        expected = (0.4 * 0.8 + 0.35 * 2.4 + np.pi * 0.35**2) / grid.cell**2
        assert len(rows) == pytest.approx(expected, rel=0.02)

    def test_what_lies_flat_or_hangs_high_is_no_obstacle(self):
        flat, high = box((0.0, 0.0, 0.005), (1.0, 1.0, 0.005)), box((0.0, 0.0, 3.0), (1.0, 1.0, 0.5))
        assert floor(flat, high).free.all()

    def test_path_length_in_the_open_is_the_octile_distance(self):
        grid = floor(TABLE)
        lengths = grid.path_lengths((-2.0, -2.0))
        cells, _ = grid.cells(np.array([[-1.0, -2.0], [-1.5, -1.5], [-2.0, -2.0]]))
        np.testing.assert_allclose(lengths.ravel()[cells], [1.0, np.hypot(0.5, 0.5), 0.0], atol=1e-9)

    def test_the_way_leads_around_a_wall(self):
        grid = floor(box((0.0, 0.0, 1.0), (0.05, 2.0, 1.0)))
        cells, _ = grid.cells(np.array([[1.0, 0.0]]))
        length = grid.path_lengths((-1.0, 0.0)).ravel()[cells[0]]
        shortest = 2.0 * np.hypot(1.0 - 0.05, 2.0 + 0.35) + 0.1
        assert shortest - 0.15 < length < 1.15 * shortest

    def test_a_map_of_obstacles_gives_the_same_floor(self):
        occupied = np.zeros((80, 100), dtype=bool)
        occupied[30:40, 50:60] = True
        grid = FloorGrid.from_occupancy(occupied, (-2.0, -1.0), 0.05, CONFIG)
        same = floor(box((0.75, 0.75, 1.0), (0.25, 0.25, 1.0)))
        points = np.random.default_rng(0).uniform((-1.9, -0.9), (2.9, 2.9), (500, 2))
        distance = np.linalg.norm(np.maximum(np.abs(points - 0.75) - 0.25, 0.0), axis=1)
        clear = np.abs(distance - CONFIG.footprint) > 0.08
        for g in (grid, same):
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
        ("eye", "target", "up", "reason"),
        [
            ((-1.5, 0.0, 1.0), (0.0, 0.0, 0.75), UP, "too low; camera at (-1.50, 0.00, 1.00) m, pitch -9°"),
            ((-1.5, 0.0, 2.0), (0.0, 0.0, 0.75), UP, "too high"),
            ((-1.0, 0.0, 1.8), (-0.9, 0.0, 0.75), UP, "the head pitch is beyond its limits"),
            ((-1.5, 0.0, 1.5), (0.0, 0.0, 2.9), UP, "the head pitch is beyond its limits"),
            ((-1.5, 0.0, 1.5), (0.0, 0.0, 1.0), (0.0, 0.2, 1.0), "rolled"),
            ((-1.5, 0.0, 1.5), (0.0, 0.0, 1.0), (0.0, 0.0, -1.0), "rolled"),
            ((-0.3, 0.0, 1.5), (0.0, 0.0, 1.4), UP, "in an obstacle"),
            ((-3.5, 0.0, 1.5), (0.0, 0.0, 1.4), UP, "outside the floor"),
        ],
    )
    def test_it_says_why_not(self, eye, target, up, reason):
        result = HumanoidRobot(floor(TABLE), CONFIG).solve(transforms.look_at(eye, target, up))
        assert isinstance(result, Unreachable)
        assert reason in result.reason

    def test_no_path_is_a_reason(self):
        shut = floor(TABLE, box((0.62, 0.0, 1.0), (0.03, 3.2, 1.0)))
        robot = standing(shut, pose(180.0, 35.0))
        beyond = pose(0.0, 30.0)
        blocked = robot.solve(beyond)
        assert isinstance(blocked, Unreachable)
        assert "no path leads there; camera at (1.30" in blocked.reason
        assert isinstance(standing(floor(TABLE, WALL), pose(180.0, 35.0)).solve(beyond), Posture)

    def test_candidates_agree_with_solve(self):
        grid = floor(TABLE, WALL)
        robot = standing(grid, pose(180.0, 35.0))
        candidates = robot.candidates(SPHERE)
        offered = set(candidates.indices.tolist())
        assert len(candidates) + sum(candidates.rejected.values()) == len(SPHERE.directions)
        assert candidates.rejected["a wall stands in the line of sight"] > 100
        seen = {True: 0, False: 0}
        for i in np.random.default_rng(3).integers(0, 40_000, 300).tolist():
            T = SPHERE.poses(SPHERE.directions[i : i + 1])[0]
            hidden = grid.hidden(T[None, :3, 3], SPHERE.centre_world)[0]
            reachable = isinstance(robot.solve(T), Posture) and not hidden
            assert reachable == (i in offered)
            seen[reachable] += 1
        assert min(seen.values()) > 10
        np.testing.assert_allclose(candidates.directions, SPHERE.directions[candidates.indices])
        np.testing.assert_allclose(SPHERE.direction_of(candidates.T_world_camera), candidates.directions)

    def test_a_robot_that_moved_is_offered_the_same_views_by_other_paths(self):
        grid = floor(TABLE, box((0.0, 2.2, 1.0), (3.0, 0.05, 1.0)))
        moved = standing(grid, pose(180.0, 35.0))
        before = moved.candidates(SPHERE)
        there = int(np.argmax(before.directions @ direction(0.0, 0.6)))
        length = moved.move_to(before.T_world_camera[there])
        assert length == before.path_length[there] > 2.0
        np.testing.assert_array_equal(moved.T_world_camera, before.T_world_camera[there])
        after, fresh = moved.candidates(SPHERE), standing(grid, moved.T_world_camera).candidates(SPHERE)
        for field in ("T_world_camera", "directions", "path_length", "indices"):
            np.testing.assert_array_equal(getattr(after, field), getattr(fresh, field))
        assert after.rejected == fresh.rejected
        assert after.looks(1000) is moved.candidates(SPHERE).looks(1000)
        other = ViewSphere.around((0.1, 0.0, 0.85), ActiveVisionConfig())
        offered = moved.candidates(other)
        np.testing.assert_allclose(other.poses(offered.directions), offered.T_world_camera)
        assert moved.move_to(moved.T_world_camera) == 0.0
        assert moved.move_to(pose(180.0, 35.0)) == pytest.approx(length, abs=0.1)

    def test_home_is_the_reachable_view_nearest_to_the_minus_x_side(self):
        robot = HumanoidRobot(floor(TABLE), CONFIG)
        with pytest.raises(PlanningError, match="nowhere"):
            _ = robot.T_world_camera
        wanted = direction(*np.deg2rad((180.0, 35.0)))
        home = home_view(robot, SPHERE, CONFIG)
        assert np.rad2deg(transforms.angle_between(SPHERE.direction_of(home), wanted)) < 1.5
        assert robot.move_to(home) == 0.0
        walled = HumanoidRobot(floor(TABLE, box((-0.62, 0.0, 1.0), (0.03, 1.6, 1.0))), CONFIG)
        home = SPHERE.direction_of(home_view(walled, SPHERE, CONFIG))
        others = walled.candidates(SPHERE).directions
        assert transforms.angle_between(home, wanted) == transforms.angle_between(others, wanted).min()
        shut = HumanoidRobot(floor(box((0.0, 0.0, 1.0), (3.0, 3.0, 1.0))), CONFIG)
        with pytest.raises(PlanningError, match=r"in an obstacle \(\d"):
            home_view(shut, SPHERE, CONFIG)


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
