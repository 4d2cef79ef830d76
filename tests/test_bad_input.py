"""Bad input: one clear line that names the file and the reason, status 1, and no run folder left."""

from __future__ import annotations

import re
import shutil
import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest
from conftest import SMALL, TWO_ON_A_TABLE, refusal, run_command, without_labels, without_poses
from raycast import TABLE, from_the_side, table_scene
from synthetic import TABLE_TOP, model_of, simulated_scene, simulated_views

from caryatid.config import SensorConfig
from caryatid.geometry import transforms
from caryatid.io import read_recording, write_recording
from caryatid.sensing.views import View
from caryatid.simulation.camera import SimulatedCamera
from caryatid.steps import read_run

BOTH = pytest.mark.parametrize("command", ["extract", "explore"])

# Recordings


@BOTH
def test_a_recording_that_does_not_say_enough(tmp_path, views, refused, command):
    write_recording(tmp_path / "loose", without_poses(views))
    assert "single frame" in refused(command, tmp_path / "loose", says="3 of 3 frames have no pose")
    write_recording(tmp_path / "bare", without_labels(views))
    said = refused(command, tmp_path / "bare", "--segmentation", "labels", says="has no masks")
    assert "--segmentation auto" in said


def test_a_segment_of_three_points(tmp_path, views, refused):
    """It is refused, unless more of the object is seen from elsewhere."""
    labels = np.where(views[0].labels == 2, 0, views[0].labels)
    labels.ravel()[np.flatnonzero(views[0].labels == 2)[100:103]] = 2
    view = replace(views[0], labels=labels)
    write_recording(tmp_path / "few", [view])
    refused("extract", tmp_path / "few", says="segment 2 has 3 points with depth, but a shape needs 12")
    options = ("--quiet", "--no-report", "--out", tmp_path / "run")
    assert run_command("extract", tmp_path / "few", "--segmentation", "auto", *options) == 0
    write_recording(tmp_path / "more", [view, *views[1:]])
    assert run_command("extract", tmp_path / "more", *options) == 0
    assert [len(v.graph.objects) for v in read_run(tmp_path / "run").views] == [2, 3, 3]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            lambda v: v.with_pose(v.pose + np.outer([0.0, 0.0, 0.4, 0.0], [0, 0, 0, 1])),
            "lie on surfaces of earlier views",
        ),
        (lambda v: replace(v, K=v.K * [[1.0], [1e12], [1.0]]), "K is implausible .* 160×120 pixels"),
        (lambda v: replace(v, depth=np.full_like(v.depth, 5.0)), "readings are at 5 m, none within"),
    ],
    ids=["pose", "camera", "depth"],
)
def test_a_view_that_cannot_be_right_is_left_out(tmp_path, views, refused, capsys, change, says):
    write_recording(tmp_path / "wrong", [*views[:2], change(views[2])])
    assert run_command("extract", tmp_path / "wrong", "--out", tmp_path / "run", "--no-report") == 0
    assert re.search(f"{says}.*; the view is ignored", capsys.readouterr().err)
    run = read_run(tmp_path / "run")
    assert len(run.views) == 2
    assert [w.endswith("; the view is ignored") for w in run.record["warnings"]] == [True]


def test_a_view_that_contradicts_earlier_ones_is_warned_of(tmp_path, views, capsys):
    aside = views[2].with_pose(views[2].pose + np.outer([0.0, 0.3, 0.0, 0.0], [0, 0, 0, 1]))
    for name, last in (("right", views[2]), ("wrong", aside)):
        write_recording(tmp_path / name, [*views[:2], last])
        assert run_command("extract", tmp_path / name, "--out", tmp_path / "run", "--no-report") == 0
        assert ("that earlier views saw as free" in capsys.readouterr().err) == (name == "wrong")


def test_a_right_view_that_shares_little_with_earlier_ones_is_not_warned_of(caplog):
    camera = SimulatedCamera(simulated_scene("hidden_stack"), sensor=SensorConfig())
    eyes = ((-1.22372, -0.01029, 1.61741), (0.7632, 1.10154, 1.30901))
    model_of([camera.capture(transforms.look_at(eye, (0.0, 0.0, TABLE_TOP))) for eye in eyes])
    assert caplog.text == ""


Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
GL = np.diag([1.0, -1.0, -1.0, 1.0])
BODY = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


@pytest.mark.parametrize(
    ("misread", "says"),
    [
        (lambda T: T @ GL, "axes are OpenGL's"),
        (lambda T: T @ BODY, "give the pose of the optical frame"),
        (transforms.invert, "is the inverse, world to camera"),
        (lambda T: Y_UP @ T, "table, the world's y axis points up"),
        (lambda T: Y_UP @ T @ GL, "axes are OpenGL's.* and the world's y axis points up"),
    ],
    ids=["OpenGL", "body", "inverse", "y up", "y up, OpenGL"],
)
@pytest.mark.parametrize("azimuth", [180.0, 60.0])
def test_a_pose_of_another_convention_is_named(caplog, misread, says, azimuth):
    (view,) = simulated_views("clutter", (azimuth,))
    model_of([view.with_pose(misread(view.pose))])
    (message,) = caplog.messages
    assert re.search(f"if that plane is the .*{says}", message)


def test_a_first_pose_in_millimetres_is_refused(views):
    T = transforms.rigid(views[0].pose[:3, :3], 1000.0 * views[0].pose[:3, 3])
    with refusal("as if in millimetres or centimetres; give T_world_camera"):
        model_of([views[0].with_pose(T)])


def a_plane(width, height, T_world_camera, top=0.7):
    """Depth of nothing but a level plane."""
    v, u = np.mgrid[0:height, 0:width]
    x, y = (u - (width - 1) / 2) / (0.8 * width), (v - (height - 1) / 2) / (0.8 * width)
    down = np.stack([x, y, np.ones_like(x)], axis=-1) @ T_world_camera[2, :3]
    return (top - T_world_camera[2, 3]) / down


DOWN = transforms.look_at((-0.9, 0.0, 1.6), (0.0, 0.0, 0.7))
AHEAD = transforms.look_at((0.0, 0.0, 1.0), (1.0, 0.0, 1.0))
NOISE = np.random.default_rng(0).uniform(0.5, 2.0, (120, 160))
FEW = np.where((np.indices((120, 160)) // 4 == 10).all(axis=0), 1.0, 0.0)


@pytest.mark.parametrize(
    ("depth", "T_world_camera", "posed", "loose"),
    [
        (np.zeros((120, 160)), DOWN, "no pixel has a depth reading; remove", "no pixel has a depth reading"),
        (np.ones((120, 160)), AHEAD, "100% of them, is tilted by 90°; show the table top or", 1),
        (np.full((120, 160), 5.0), AHEAD, "readings are at 5 m, none within 0.1–3 m; check", "at 5 m, none"),
        (NOISE, DOWN, "points lie on one level plane; show", "points lie on one plane; show the table top"),
        (FEW, DOWN, "only 16 points are on a surface, fewer than 200", "or give a larger image"),
        (np.ones((200, 1)), DOWN, "pixels are too few", "give a larger or less noisy image"),
        (a_plane(12, 12, DOWN), DOWN, "fewer than 200; show more", "or give a larger image"),
        (a_plane(80, 60, DOWN), DOWN, 1, 1),
        (a_plane(160, 120, DOWN), DOWN, 1, 1),
    ],
    ids=["no depth", "wall", "far wall", "noise", "few", "line", "12×12", "80×60", "one plane"],
)
@pytest.mark.parametrize("masks", [False, True])
def test_an_image_that_shows_no_objects(tmp_path, refused, depth, T_world_camera, posed, loose, masks):
    """One clear line, or a graph of the support surface and what a mask says; a wall may be a table's top."""
    (height, width), labels = depth.shape, np.zeros(depth.shape, dtype=np.int32)
    labels[3 * height // 8 : 5 * height // 8 + 1, 3 * width // 8 : 5 * width // 8 + 1] = masks
    K = np.array([[0.8 * width, 0, (width - 1) / 2], [0, 0.8 * width, (height - 1) / 2], [0, 0, 1]])
    for T, expected in ((T_world_camera, posed), (None, loose)):
        folder = tmp_path / f"{T is None}"
        write_recording(folder, [View(depth, K, T, labels=labels if masks else None)])
        if isinstance(expected, str):
            refused("extract", folder, names=folder.name, says=expected)
        else:
            assert run_command("extract", folder, "--out", tmp_path / "run") == 0
            assert len(read_run(tmp_path / "run").graph.objects) == expected + masks


def test_an_image_too_small_to_tell_objects_in(tmp_path, capsys):
    depth, higher = a_plane(80, 60, DOWN), a_plane(80, 60, DOWN, top=0.8)
    patches = np.add.outer(np.arange(60) // 5 % 2, np.arange(80) // 5 % 2) == 2
    patches[:15] = patches[45:] = patches[:, :20] = patches[:, 60:] = False
    depth[patches] = higher[patches]
    write_recording(tmp_path / "small", [View(depth, [[64, 0, 39.5], [0, 64, 29.5], [0, 0, 1]], DOWN)])
    assert run_command("extract", tmp_path / "small", "--out", tmp_path / "run") == 0
    assert "belong to no object" in capsys.readouterr().err


def test_an_object_without_readings_on_the_grid_of_samples(tmp_path, capsys):
    depth, higher = a_plane(160, 120, DOWN), a_plane(160, 120, DOWN, top=0.85)
    box = slice(40, 80), slice(60, 100)
    depth[box] = np.where(np.arange(60, 100) % 2 == 1, higher[box], 0.0)
    K = [[128, 0, 79.5], [0, 128, 59.5], [0, 0, 1]]
    write_recording(tmp_path / "stripes", [View(depth, K, DOWN)])
    assert run_command("extract", tmp_path / "stripes", "--out", tmp_path / "run") == 0
    assert "no depth in 1 region" in capsys.readouterr().err


@pytest.mark.parametrize(("width", "says"), [(12000, "has more than 89478485"), (9000, "9000×9000")])
def test_an_image_larger_than_any_cameras(recording, refused, width, says):
    """Its header says so; nothing is decoded."""
    path = recording / "depth/000001.png"
    header = b"IHDR" + struct.pack(">II", width, 9000) + path.read_bytes()[24:29]
    path.write_bytes(
        path.read_bytes()[:12] + header + struct.pack(">I", zlib.crc32(header)) + path.read_bytes()[33:]
    )
    refused("extract", recording, names=path, says=says)


def test_one_setting_limits_the_size_of_images(recording, refused, tmp_path, capsys):
    depth = recording / "depth/000000.png"
    height, width = read_recording(recording)[0].depth.shape
    few, enough = (f"--set=recording.max_pixels={n}" for n in (height * width - 1, height * width))
    refused("extract", recording, few, names=depth, says="raise recording.max_pixels")
    png = recording / "mask_visib" / "000000_000000.png"
    for limit, status in ((few, 1), (enough, 0)):
        words = ("session", "new", tmp_path / limit[-3:], "--ignore", png, limit, "--quiet")
        assert run_command(*words) == status
    assert "raise recording.max_pixels" in capsys.readouterr().err


# MJCF


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('name="table" pos="0', 'name="desk" pos="9', "nothing static carries an object"),
        ("<freejoint/>", "", "has no objects"),
        ("</mujoco>", "", "not an MJCF file"),
        (TWO_ON_A_TABLE, "a table with two cups", "not an MJCF file"),
        (TWO_ON_A_TABLE, "<mujocoinclude/>", "give a file that begins with <mujoco>"),
        ('size="0.035 0.05"', 'size="-1 0.05"', "MuJoCo rejects it"),
        ('size="0.4 0.5 0.35"/>', 'size="0.4 0.5 0.35"/><freejoint/>', "'table' can move"),
        ('type="cylinder" size="0.035 0.05"', 'type="mesh" mesh="lost"', "lost"),
        ('<geom type="box" size="0.4 0.5 0.35"/>', "", "body 'table' has no geom"),
        ("<worldbody>", '<include file="arm.xml"/><worldbody>', "it needs the file"),
        ("<worldbody>", '<asset><mesh name="cup" file="cup.stl"/></asset><worldbody>', "asset 'cup' needs"),
        ("<worldbody>", '<option gravity="0 -9.81 0"/><worldbody>', "not along -z"),
        ("<freejoint/>", '<joint type="slide" axis="nan 0 0"/>', "NaN"),
        ('pos="0 0 0.75"', 'pos="0 nan 0.75"', "NaN"),
        ("<worldbody>", '<option timestep="0"/><worldbody>', "its time step is 0 s"),
        ("<worldbody>", '<option timestep="nan"/><worldbody>', "its time step is nan s"),
        ("<worldbody>", '<option gravity="0 0 -1e15"/><worldbody>', "unstable"),
        ("<worldbody>", '<worldbody><geom name="\xfd" size="0.01"/>', "a name that is not UTF-8"),
    ],
)
def test_a_scene_that_cannot_be_simulated(tmp_path, refused, old, new, says):
    path = tmp_path / "scene.xml"
    path.write_text(TWO_ON_A_TABLE.replace(old, new), encoding="latin-1")
    refused("explore", path, says=says)


# Clouds


def test_clouds_that_do_not_do(points, write_pcd, refused):
    assert "caryatid extract" in refused("explore", write_pcd(*points), says="a single cloud cannot be")
    noise = np.random.default_rng(0).uniform((-0.5, -0.5, 1.0), (0.5, 0.5, 2.0), (4000, 3))
    refused("extract", write_pcd(noise), names="cloud.pcd", says="no support surface")
    without = write_pcd(points[0])
    said = refused("extract", without, "--segmentation", "labels", says="no field label")
    assert "--segmentation auto" in said
    parts = write_pcd(points[0], points[1] + 3)
    assert "--label-divisor" in refused("extract", parts, names="cloud.pcd", says="none is left")


# Sources and places that are not there, or something else


@pytest.mark.parametrize(
    ("command", "name", "says"),
    [
        ("explore", "nowhere", "`caryatid scenes` lists"),
        ("explore", "", "a folder without scene.xml"),
        ("explore", "table.md", "not an MJCF file"),
        ("explore", "no where/scene.xml", "no such file, folder or built-in scene"),
        ("extract", "nowhere", "no such file"),
        ("extract", "nowhere.pcd", "missing"),
        ("extract", "of two\nlines", "no such file"),
    ],
)
def test_a_source_that_is_none(tmp_path, refused, command, name, says):
    (tmp_path / "table.md").touch()
    refused(command, tmp_path / name, names=name.replace("\n", " "), says=says)


@pytest.mark.parametrize("command", ["explore", "extract", "clear"])
def test_a_run_is_not_a_source(kept_run, refused, command):
    said = refused(command, kept_run, says="is a run, not a scene or recording")
    assert f"`caryatid view {kept_run}`" in said


def test_a_run_that_cannot_be_scored(tmp_path, recording, scene_file, capsys):
    run, broken = tmp_path / "run", tmp_path / "broken"
    assert run_command("extract", recording, "--out", run, "--no-report", "--quiet") == 0
    shutil.copytree(run, broken)
    (broken / "views/01/graph.json").write_text("{")
    strange = shutil.copytree(scene_file.parent, tmp_path / "strange")
    (strange / "gt.json").write_text('{"vertices": ["table", "ghost"], "edges": []}')
    for scored, truth, says in (
        (tmp_path / "nowhere", scene_file.parent, "no such folder"),
        (run, tmp_path / "nowhere", "no such scene or recording"),
        (recording, scene_file.parent, "not a run or session"),
        (run, recording, "has no gt.json, the ground truth to compare with"),
        (run, strange, "gt.json names 'ghost', which is not a body of the scene"),
        (run, tmp_path, "neither a scene nor a recording"),
        (broken, scene_file.parent, str(broken / "views/01/graph.json")),
    ):
        capsys.readouterr()
        assert run_command("evaluate", scored, truth) == 1
        said = capsys.readouterr().err
        assert says in said
        assert said.count("\n") == 1


def test_a_fault_of_our_own_is_one_line_too_and_debug_shows_it(tmp_path, scene_file, capsys, monkeypatch):
    def broken(*_, **__):
        raise ZeroDivisionError("division by\nzero")

    monkeypatch.setattr("caryatid.cli.run.open_source", broken)
    command = ["explore", scene_file, "--out", tmp_path / "run", *SMALL]
    assert run_command(*command) == 1
    said = capsys.readouterr().err
    assert (
        said
        == "error: internal error: ZeroDivisionError: division by zero; run with --debug for the traceback\n"
    )
    with pytest.raises(ZeroDivisionError):
        run_command(*command, "--debug")
    assert not (tmp_path / "run").exists()


def test_what_is_too_long_for_an_object_is_said_and_reported(tmp_path, capsys):
    bar = (np.array([0.0, 0.0, TABLE + 0.03]), np.array([0.06, 0.7, 0.06]))
    write_recording(tmp_path / "long", [replace(table_scene(from_the_side(), [bar]), labels=None)])
    assert run_command("extract", tmp_path / "long", "--out", tmp_path / "run") == 0
    assert "something longer than 0.5 m is left out" in "".join(capsys.readouterr())
    assert (tmp_path / "run" / "report.html").exists()
