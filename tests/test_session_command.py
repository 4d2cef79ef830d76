"""`caryatid session`: what a robot's software says and hears on the command line."""

from __future__ import annotations

import json

import numpy as np
import pytest
from conftest import run_command, write_view_files

from caryatid.geometry import transforms
from caryatid.io.graph_json import graph_text
from caryatid.sessions import Session
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


def test_what_a_step_did_is_said_in_a_line(folder, files, capsys, views):
    def said(step, *words, status=0):
        assert run_command("session", step, folder, *words) == status
        return "".join(capsys.readouterr())

    away = files(0, T_world_camera=transforms.look_at((-1.2, 0.0, 1.2), (-2.0, 0.0, 1.2)).tolist())
    assert said("add", *away).startswith("view 1 (number 0): 0 objects, 0 supports, graph unchanged\n")
    assert said("undo") == "0 views left: 0 objects, 0 supports\n"
    assert said("add", *files(0)) == "view 1 (number 0): 2 objects, 2 supports\n"
    assert "the next view is 1" in said("add", *files(1), "--number", 0, status=1)

    told = json.loads(said("next"))
    assert (told["view"], set(told["gaze"])) == (1, {"yaw", "pitch"})
    path = folder.parent / "candidates.json"
    path.write_text("{}")
    assert "'T_world_camera' is missing" in said("next", "--candidates", path, status=1)

    moved = folder.parent / "moved.json"
    moved.write_text(json.dumps({"T": transforms.rigid(np.eye(3), (0.0, 0.1, 0.0)).tolist()}))
    assert said("take", "o1", "--moved", moved).startswith("o1 moved: 2 objects")
    assert said("take", "o2") == "o2 removed: 1 object, 1 support\n"
    assert said("undo").startswith("1 view left: 2 objects")


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
