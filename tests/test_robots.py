"""Robots by name, in Python and on the command line."""

from __future__ import annotations

import json
from importlib.metadata import EntryPoint

import numpy as np
import pytest
from arms import SLIDES, gantry, within_arms_length
from conftest import SMALL, run_command

from caryatid import robots
from caryatid.config import ArmConfig, Config, RobotConfig
from caryatid.errors import InputError
from caryatid.robots import Posture, Surroundings, find_robot
from caryatid.robots.arm import ArmRobot
from caryatid.robots.floor import FloorGrid
from caryatid.robots.humanoid import HumanoidRobot
from caryatid.robots.reachability import sample_reachability, write_reachability
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.sessions import Session
from caryatid.sessions.next_view import table_floor

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


def test_a_robot_of_another_package_is_found_by_its_entry_point(surroundings, monkeypatch):
    point = EntryPoint("mine", "test_robots:make_arm", robots.ENTRY_POINTS)
    monkeypatch.setattr(robots, "entry_points", lambda group: [point] if group == point.group else [])
    assert isinstance(find_robot("mine")(surroundings), ArmRobot)
    with pytest.raises(InputError, match=r"choose one of humanoid, mine, arm:FILE\.npz, module:callable"):
        find_robot("yours")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("no.such.module:arm", "'no.such.module:arm' cannot be imported"),
        ("test_robots:nothing", "cannot be imported .*nothing"),
        ("test_robots:", "cannot be imported"),
        ("arm:no-such.npz", r"no-such\.npz: the file is missing"),
    ],
)
def test_what_cannot_be_found_is_said(name, message):
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

    def test_settings_say_where_it_stands(self, map_file, tmp_path, capsys):
        far = ["--robot", f"arm:{map_file}", "--set=arm.base=[-5.0, 0.0, 0.0]"]
        assert run_command("explore", "tower", "--out", tmp_path / "run", *far, *QUICK) == 1
        said = capsys.readouterr().err
        assert "no view of the sphere can be reached: " in said
        assert "the hand does not reach there (" in said
        assert not (tmp_path / "run").exists()

    def test_a_recording_has_no_robot(self, kept_recording, tmp_path, capsys):
        arm = ["--robot", "test_robots:make_arm", "--views=2", "--no-report", "--quiet"]
        assert run_command("explore", kept_recording, "--out", tmp_path / "run", *arm) == 1
        assert "is a recording" in capsys.readouterr().err

    def test_a_session_keeps_its_arm(self, map_file, views, tmp_path, monkeypatch, capsys):
        monkeypatch.chdir(map_file.parent)
        table = tmp_path / "table"
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
