"""Robots: floor, humanoid, recordings; and robots by name, in Python and on the command line."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest
from arms import SLIDES, assert_gaze, gantry, within_arms_length
from conftest import SMALL, run_command
from synthetic import shelf_graph, surface_at, surface_object

from caryatid.config import ActiveVisionConfig, ArmConfig, Config, RobotConfig
from caryatid.errors import InputError, PlanningError
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box
from caryatid.graph import SupportGraph
from caryatid.robots import Posture, Surroundings, find_robot, go_home
from caryatid.robots.arm import ArmRobot
from caryatid.robots.floor import FloorGrid
from caryatid.robots.humanoid import HumanoidRobot
from caryatid.robots.protocol import RecordingRobot
from caryatid.robots.reachability import sample_reachability, write_reachability
from caryatid.sensing.view_sphere import ViewSphere, direction
from caryatid.sessions import Session
from caryatid.sessions.session import table_floor

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
    def test_obstacles_are_grown_by_the_footprint_from_boxes_and_from_a_map(self):
        occupied = np.zeros((80, 100), dtype=bool)
        occupied[30:40, 50:60] = True
        grid = FloorGrid.from_occupancy(occupied, (-2.0, -1.0), 0.05, CONFIG)
        flat, high = box((0.0, 0.0, 0.005), (1.0, 1.0, 0.005)), box((0.0, 0.0, 3.0), (1.0, 1.0, 0.5))
        same = floor(box((0.75, 0.75, 1.0), (0.25, 0.25, 1.0)), flat, high)
        points = np.random.default_rng(0).uniform((-1.9, -0.9), (2.9, 2.9), (500, 2))
        distance = np.linalg.norm(np.maximum(np.abs(points - 0.75) - 0.25, 0.0), axis=1)
        clear = np.abs(distance - CONFIG.footprint) > 0.08
        for g in (grid, same):
            cells, inside = g.cells(points)
            assert inside.all()
            np.testing.assert_array_equal(g.free.ravel()[cells][clear], (distance >= 0.35)[clear])

    def test_walls_hide_and_the_table_under_the_target_does_not(self):
        eyes = np.array([[1.3, 0.0, 1.5], [-1.3, 0.0, 1.5], [0.9, 0.0, 8.0]])
        assert floor(TABLE, WALL).hidden(eyes, np.array([0.0, 0.0, 0.74])).tolist() == [True, False, False]

    def test_a_robot_stands_on_the_floor_but_not_under_a_table_or_a_board(self):
        """The floor of the model is also a support surface; a second table is not in reach of the first."""
        surfaces = [*shelf_graph().support_surfaces, surface_object(3, (-1.5, 1.0, 0.7), (0.4, 0.4))]
        table = surface_at(0.45)
        scene = SimpleNamespace(
            surface=table, sphere=SimpleNamespace(centre_world=table.point_world), config=Config(),
            graph=SupportGraph(tuple(surfaces)),
        )  # fmt: skip
        places = np.array([(0.0, 0.0), (-1.0, 0.0), (1.0, -0.8), (-1.5, 1.0), (-1.5, -1.0)])
        floor = table_floor(scene)
        free = floor.free.ravel()[floor.cells(places)[0]]
        assert free.tolist() == [False, True, True, False, True]


class TestHumanoidRobot:
    def test_the_camera_is_where_the_posture_puts_it(self):
        robot = HumanoidRobot(floor(TABLE, WALL), CONFIG)
        for azimuth in (180.0, -120.0, 135.0, -89.0):
            T = pose(azimuth, 35.0)
            posture = robot.solve(T)
            x, y, yaw = posture.platform_world
            forward = CONFIG.camera_forward * np.array([np.cos(yaw), np.sin(yaw)])
            np.testing.assert_allclose(np.array([x, y]) + forward, T[:2, 3], atol=1e-9)
            assert_gaze(posture, T)

    @pytest.mark.parametrize(
        ("eye", "target", "up", "reason"),
        [
            ((-1.5, 0.0, 1.0), (0.0, 0.0, 0.75), UP, "too low; camera at (-1.50, 0.00, 1.00) m, pitch -9°"),
            ((-1.5, 0.0, 2.0), (0.0, 0.0, 0.75), UP, "too high"),
            ((-1.0, 0.0, 1.8), (-0.9, 0.0, 0.75), UP, "the head pitch is beyond its limits"),
            ((-1.5, 0.0, 1.5), (0.0, 0.0, 2.9), UP, "the head pitch is beyond its limits"),
            ((-1.5, 0.0, 1.5), (0.0, 0.0, 1.0), (0.0, 0.2, 1.0), "rolled"),
            ((-1.5, 0.0, 1.5), (0.0, 0.0, 1.0), (0.0, 0.0, -1.0), "rolled"),
            ((-0.3, 0.0, 1.5), (0.0, 0.0, 1.4), UP, "hit an obstacle"),
            ((-3.5, 0.0, 1.5), (0.0, 0.0, 1.4), UP, "off the floor"),
        ],
    )
    def test_it_says_why_not(self, eye, target, up, reason):
        assert reason in HumanoidRobot(floor(TABLE), CONFIG).solve(transforms.look_at(eye, target, up)).reason

    def test_no_path_is_a_reason(self):
        shut = floor(TABLE, box((0.62, 0.0, 1.0), (0.03, 3.2, 1.0)))
        blocked, free = (standing(f, pose(180.0, 35.0)).solve(pose(0.0, 30.0)) for f in (shut, floor(WALL)))
        assert "no free path; camera at (1.30" in blocked.reason
        assert isinstance(free, Posture)

    def test_candidates_agree_with_solve(self):
        grid = floor(TABLE, WALL)
        robot = standing(grid, pose(180.0, 35.0))
        candidates = robot.candidates(SPHERE)
        offered = set(candidates.indices.tolist())
        assert len(candidates) + sum(candidates.rejected.values()) == len(SPHERE.directions)
        assert candidates.rejected["a wall blocks the line of sight"] > 100
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

    def test_home_is_the_reachable_view_nearest_to_the_minus_x_side(self):
        robot = HumanoidRobot(floor(TABLE), CONFIG)
        with pytest.raises(PlanningError, match="no camera pose yet"):
            _ = robot.T_world_camera
        wanted = direction(*np.deg2rad((180.0, 35.0)))
        go_home(robot, SPHERE, CONFIG)
        home = SPHERE.direction_of(robot.T_world_camera)
        assert np.rad2deg(transforms.angle_between(home, wanted)) < 1.5
        walled = HumanoidRobot(floor(TABLE, box((-0.62, 0.0, 1.0), (0.03, 1.6, 1.0))), CONFIG)
        others = walled.candidates(SPHERE).directions
        go_home(walled, SPHERE, CONFIG)
        home = SPHERE.direction_of(walled.T_world_camera)
        assert transforms.angle_between(home, wanted) == transforms.angle_between(others, wanted).min()
        shut = HumanoidRobot(floor(box((0.0, 0.0, 1.0), (3.0, 3.0, 1.0))), CONFIG)
        with pytest.raises(PlanningError, match=r"hit an obstacle \(\d"):
            go_home(shut, SPHERE, CONFIG)
        high = ViewSphere.around((0.0, 0.0, 4.0), ActiveVisionConfig())
        with pytest.raises(PlanningError, match=r"top is 4\.00 m above the floor.* robot\.camera_height"):
            go_home(robot, high, CONFIG)

    def test_it_steps_back_from_the_floor_but_not_from_a_table(self):
        robot = HumanoidRobot(floor(), CONFIG)
        assert robot.view_sphere(SPHERE) is SPHERE
        low = ViewSphere.around((0.0, 0.0, 0.0), ActiveVisionConfig())
        own = robot.view_sphere(low)
        assert len(robot.candidates(low)) == 0 < len(robot.candidates(own))
        assert low.radius < own.radius <= 2.0
        assert robot.view_sphere(own) is own


class TestRecordingRobot:
    POSES = np.stack([pose(azimuth, 35.0) for azimuth in (180.0, 90.0, 0.0)])

    def test_other_poses_are_unreachable_and_it_says_why(self):
        robot = RecordingRobot(self.POSES)
        for T, why in ((pose(45.0, 35.0), "no view at this pose"), (self.POSES[0], "was already used")):
            with pytest.raises(PlanningError, match=why):
                robot.move_to(T)


QUICK = [*SMALL, "--views=2", "--no-report", "--quiet"]


def make_arm(around: Surroundings) -> ArmRobot:
    """What a package of one's own would hold."""
    return ArmRobot(within_arms_length, around.T_world_base, around.config.arm, furniture=around.floor)


@pytest.fixture
def surroundings():
    floor = FloorGrid.from_boxes((), RobotConfig())
    config = Config(arm=ArmConfig(base=(-0.4, 0.1, 0.05), base_yaw=90.0))
    return Surroundings(np.array([0.0, 0.0, 0.75]), floor, config)


@pytest.fixture(scope="module")
def map_file(tmp_path_factory):
    """A gantry over the table."""
    file = tmp_path_factory.mktemp("maps") / "gantry.npz"
    write_reachability(file, sample_reachability(gantry, SLIDES, 200_000, np.random.default_rng(0)))
    return file


def test_the_humanoid_and_an_arm_are_found_by_name(surroundings, map_file):
    assert isinstance(find_robot("humanoid")(surroundings), HumanoidRobot)
    arm = find_robot(f"arm:{map_file}")(surroundings)
    assert isinstance(arm, ArmRobot)
    np.testing.assert_allclose(arm.T_world_base[:3, 3], [-0.4, 0.1, 0.8])
    np.testing.assert_allclose(arm.T_world_base[:3, 0], [0.0, 1.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("no.such.module:arm", "'no.such.module:arm' cannot be imported"),
        ("test_robots:nothing", "cannot be imported .*nothing"),
        ("yours", r"choose one of humanoid, arm:FILE\.npz, module:callable"),
        ("arm:no-such.npz", r"no-such\.npz: the file is missing"),
    ],
)
def test_missing_robots_are_reported(name, message):
    with pytest.raises(InputError, match=message):
        find_robot(name)


@pytest.mark.slow
class TestCommandLine:
    def test_an_arm_explores_with_its_map(self, map_file, tmp_path):
        options = [*SMALL, "--views=2", "--quiet", "--robot", f"arm:{map_file}", "--no-early-stop"]
        assert run_command("explore", "tower", "--out", tmp_path / "run", *options) == 0
        run = json.loads((tmp_path / "run/run.json").read_text())
        assert run["options"]["robot"] == f"arm:{map_file}"
        assert 0.0 < run["path_travelled"] < 2.0
        view = json.loads((tmp_path / "run/views/01/view.json").read_text())
        eye = np.array(view["T_world_camera"])[:3, 3]
        assert np.linalg.norm(eye - [0.0, 0.0, 0.75]) < 1.1
        assert (tmp_path / "run/report.html").is_file()

    def test_where_no_robot_can_be_it_says_why_and_writes_nothing(
        self, map_file, kept_recording, tmp_path, capsys
    ):
        far = ["--robot", f"arm:{map_file}", "--set=arm.base=[-5.0, 0.0, 0.0]"]
        recorded = ["--robot", "test_robots:make_arm"]
        for source, options, why in (
            ("tower", far, "no view of the view sphere is reachable: "),
            (kept_recording, recorded, "a recording has no robot"),
        ):
            assert run_command("explore", source, "--out", tmp_path / "run", *options, *QUICK) == 1
            assert why in capsys.readouterr().err
            assert not (tmp_path / "run").exists()

    def test_a_session_keeps_its_arm(self, map_file, views, tmp_path, monkeypatch, capsys):
        monkeypatch.chdir(map_file.parent)
        table = tmp_path / "table"
        (tmp_path / "loop").symlink_to("loop")
        assert run_command("session", "new", table, "--robot", f"arm:{tmp_path / 'loop'}") == 1
        assert "loop: cannot be read" in capsys.readouterr().err
        assert run_command("session", "new", table, "--robot", f"arm:{map_file.name}", "--quiet") == 0
        monkeypatch.chdir(tmp_path)
        with Session.open(table) as session:
            session.add(views[0])
        capsys.readouterr()
        assert run_command("session", "next", table) == 0
        told = json.loads(capsys.readouterr().out)
        T, config = np.array(told["T_world_camera"]), Config()
        with Session.open(table, read_only=True) as session:
            centre, floor = session.scene.sphere.centre_world, table_floor(session.scene)
        arm = find_robot(f"arm:{map_file}")(Surroundings(centre, floor, config))
        assert isinstance(arm.solve(T), Posture)
        sphere = arm.view_sphere(ViewSphere.around(centre, config.active))
        assert np.isclose(np.linalg.norm(T[:3, 3] - centre), sphere.radius)
