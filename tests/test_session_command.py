"""`caryatid session`: what a robot's software says and hears on the command line."""

from __future__ import annotations

import json

import numpy as np
import pytest
from conftest import run_command, write_view_files

from caryatid.config import Config
from caryatid.geometry import transforms
from caryatid.io.graph_json import graph_text
from caryatid.scene import Scene
from caryatid.sessions import Capture, Session
from caryatid.sources import open_run
from caryatid.steps import read_steps


@pytest.fixture
def files(tmp_path, views):
    """Files of each view: depth, camera, labels, as options of `session add`."""

    def write(number, **camera):
        write_view_files(tmp_path, views[number], **camera)
        return [f"--{name.split('.')[0]}={tmp_path / name}" for name in FILES]

    return write


FILES = ("depth.png", "labels.png", "camera.json")


@pytest.fixture
def folder(tmp_path, capsys):
    options = ("--segmentation", "labels", "--seed", 3, "--quiet")
    assert run_command("session", "new", tmp_path / "s", *options) == 0
    return tmp_path / "s"


def test_a_session_from_the_first_view_to_the_last(folder, files, capsys, views):
    scene = Scene(segmentation="labels", seed=3)
    for number in range(2):
        options = files(number)
        assert run_command("session", "add", folder, *options, "--json") == 0
        told = json.loads(capsys.readouterr().out)
        images = {name: folder.parent / f"{name}.png" for name in ("depth", "labels")}
        capture = Capture.from_files(images, folder.parent / "camera.json", Config().session)
        scene.update(capture.decode(Config().recording.max_pixels))
        assert told["view"] == number
        assert json.dumps(told["graph"], indent=1, ensure_ascii=False) + "\n" == graph_text(scene.graph)

    assert run_command("session", "graph", folder) == 0
    assert capsys.readouterr().out == graph_text(scene.graph)

    assert run_command("session", "next", folder) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["view"] == 2
    assert set(told["gaze"]) == {"yaw", "pitch"}
    assert told["expected_gain"] > 0.0
    assert told["why"]

    aside = transforms.rigid(np.eye(3), (0.0, 0.1, 0.0))
    (folder.parent / "moved.json").write_text(json.dumps({"T": aside.tolist()}))
    assert run_command("session", "take", folder, "o1", "--moved", folder.parent / "moved.json") == 0
    assert capsys.readouterr().out.startswith("o1 moved: 2 objects")
    assert run_command("session", "take", folder, "o2") == 0
    assert capsys.readouterr().out == "o2 removed: 1 object, 1 support\n"
    assert run_command("session", "take", folder, "o2") == 1
    assert "not an object of the graph; known objects: o1" in capsys.readouterr().err

    for left in (2, 2, 1):
        assert run_command("session", "undo", folder) == 0
        assert capsys.readouterr().out.startswith(f"{left} view")
    with Session.open(folder) as session:
        assert np.allclose(session.scene.T_world_camera, views[0].pose, atol=0.02)


def test_warnings_of_a_view_are_shown(folder, files, capsys, views):
    away = transforms.look_at((-1.2, 0.0, 1.2), (-2.0, 0.0, 1.2)).tolist()
    assert run_command("session", "add", folder, *files(0, T_world_camera=away)) == 0
    captured = capsys.readouterr()
    assert captured.out == "view 1 (number 0): 0 objects, 0 supports, graph unchanged\n"
    assert "no support surface" in captured.err


def test_a_robot_gives_the_poses_it_reaches(folder, files, capsys, views):
    assert run_command("session", "add", folder, *files(0)) == 0
    assert capsys.readouterr().out == "view 1 (number 0): 2 objects, 2 supports\n"
    assert run_command("session", "add", folder, *files(1), "--number", 0) == 1
    assert "the next view is 1" in capsys.readouterr().err

    path = folder.parent / "candidates.json"
    poses = [view.pose.tolist() for view in views[1:]]
    path.write_text(json.dumps({"T_world_camera": poses, "path_length": [9, 0]}))
    assert run_command("session", "next", folder, "--candidates", path) == 0
    told = json.loads(capsys.readouterr().out)
    assert np.allclose(told["T_world_camera"], poses[told["candidate"]])
    far = np.array(poses)
    far[:, :3, 3] *= 1000.0
    path.write_text(json.dumps({"T_world_camera": far.tolist()}))
    assert run_command("session", "next", folder, "--candidates", path) == 1
    assert "give camera poses in metres" in capsys.readouterr().err
    path.write_text("{}")
    assert run_command("session", "next", folder, "--candidates", path) == 1
    assert "'T_world_camera' is missing" in capsys.readouterr().err


def test_other_commands_take_a_session_like_a_run(folder, files, capsys, tmp_path):
    assert run_command("report", folder) == 1
    assert "no view shows a table top yet" in capsys.readouterr().err
    for number in range(2):
        assert run_command("session", "add", folder, *files(number)) == 0
    with open_run(folder) as run:
        seen = list(read_steps(run))
    assert [step.index for step in seen] == [0, 1]
    with Session.open(folder) as session:
        assert graph_text(seen[-1].graph) == graph_text(session.graph)
        session.take("o2")
        (tmp_path / "graph.json").write_text(graph_text(session.graph))

    assert run_command("report", folder) == 0
    page = (folder / "report.html").read_text()
    assert "After the last view, o2 was removed: reported by the robot." in page
    assert "1 object, 1 support after 2 views" in page
    orders = []
    for source in (folder, tmp_path / "graph.json"):
        capsys.readouterr()
        assert run_command("order", source, "--json", "--set", "rehearsal.draws=30") == 0
        orders.append(json.loads(capsys.readouterr().out))
    assert [step["object"] for step in orders[0]["steps"]] == ["o1"]
    assert orders[0] == orders[1]
    assert run_command("export", folder, "--out", tmp_path / "scene.xml") == 0
    assert run_command("evaluate", folder, tmp_path / "scene.xml") == 0

    for source, command in ((folder, "order"), (tmp_path / "graph.json", "export")):
        capsys.readouterr()
        assert run_command("explore", source, "--out", tmp_path / "run") == 1
        assert f"`caryatid {command} {source}" in capsys.readouterr().err


BAD = (
    ({"T_world_camera": [1]}, "'T_world_camera' is [1]: must be 4×4 finite numbers; give K"),
    ({"T_world_camera": np.diag((2, 2, 2, 2)).tolist()}, "camera.json"),
    ({"depth_scale": 0}, "'depth_scale' is 0"),
)


def test_views_that_cannot_be_used_are_one_line_each(folder, files, capsys):
    def refused(options, said):
        assert run_command("session", "add", folder, *options) == 1
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err.startswith("error: ")
        assert captured.err.count("\n") == 1
        assert said in captured.err
        assert (folder / "session.jsonl").read_text().count("\n") == 1

    for camera, said in BAD:
        refused(files(0, **camera), said)
    for name in FILES:
        options = files(0)
        (folder.parent / name).write_bytes(b"{")
        refused(options, name.split(".")[0])
        (folder.parent / name).unlink()
        refused(options, name)
