"""Bad input: one clear line that names the file and the reason, status 1, and no run folder left."""

from __future__ import annotations

import errno
import json
import os
import pathlib
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from conftest import SMALL, TWO_ON_A_TABLE, run_command, without_labels, without_poses
from PIL import Image

import caryatid as ct
from caryatid.errors import InputError
from caryatid.io import read_run, write_recording


@pytest.fixture
def refused(tmp_path, capsys):
    """Run a command that must fail on its source, and return what it says."""

    def run(command, source, *options, names=None, says):
        before = {p: os.listdir(p) for p in [tmp_path, *tmp_path.rglob("*")] if p.is_dir()}
        assert run_command(command, source, "--out", tmp_path / "runs/run", *options) == 1
        said = capsys.readouterr()
        assert said.out == ""
        assert said.err.count("\n") == 1
        assert said.err.startswith("error: ")
        assert "fault in caryatid" not in said.err
        assert str(names or source) in said.err
        assert says in said.err
        after = {p: os.listdir(p) for p in [tmp_path, *tmp_path.rglob("*")] if p.is_dir()}
        assert after == before, "something was left behind"
        return said.err

    return run


def edit(path, change):
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def change_image(path, change):
    with Image.open(path) as image:
        pixels = np.array(image)
    Image.fromarray(change(pixels)).save(path)


BOTH = pytest.mark.parametrize("command", ["extract", "explore"])

# Images of a recording


@BOTH
@pytest.mark.parametrize("name", ["depth/000001.png", "mask_visib/000001_000001.png"])
def test_a_missing_image(recording, refused, command, name):
    (recording / name).unlink()
    refused(command, recording, names=recording / name, says="the file is missing")


@BOTH
@pytest.mark.parametrize("name", ["depth/000002.png", "rgb/000002.png"])
def test_a_truncated_image(recording, refused, command, name):
    content = (recording / name).read_bytes()
    (recording / name).write_bytes(content[: len(content) // 2])
    refused(command, recording, names=recording / name, says="truncated or broken")


def test_depth_and_colour_of_different_sizes(recording, refused):
    change_image(recording / "rgb/000001.png", lambda pixels: pixels[::2, ::2])
    refused("extract", recording, names=recording / "rgb/000001.png", says="80×60 pixels")


def test_an_empty_frame(recording, refused):
    change_image(recording / "depth/000000.png", np.zeros_like)
    refused("explore", recording, names=recording / "depth/000000.png", says="the frame is empty")


def test_a_frame_beyond_the_sensors_range(recording, refused):
    change_image(recording / "depth/000000.png", lambda pixels: np.full_like(pixels, 50_000))
    refused("explore", recording, names="recording/000000", says="no depth readings within")


@BOTH
def test_no_plane(tmp_path, views, refused, command):
    depth = np.random.default_rng(0).uniform(0.5, 2.5, views[0].depth.shape).astype(np.float32)
    write_recording(tmp_path / "noise", [replace(views[0], depth=depth, labels=None)])
    refused(command, tmp_path / "noise", names="noise/000000", says="no support surface")


# What goes in through Python, where depth is not a PNG


@pytest.mark.parametrize(("value", "says"), [(np.inf, "infinite"), (-0.5, "negative")])
def test_depth_that_is_no_distance(views, value, says):
    depth = views[0].depth.copy()
    depth[10, 10] = value
    with pytest.raises(InputError, match=f"view: depth holds {says} values; mark missing readings with 0"):
        ct.View(depth=depth, K=views[0].K)


def test_nan_in_depth_is_no_reading(views):
    depth = views[0].depth.copy()
    depth[40:80, 20:60] = np.nan
    view = replace(views[0], depth=depth)
    assert not view.valid[40:80, 20:60].any()
    graph = ct.Scene().update(view)
    assert graph.support_surface is not None


@pytest.mark.parametrize("depth", [np.zeros((120, 160)), np.full((120, 160), np.nan)])
def test_a_view_without_a_reading(views, depth):
    with pytest.raises(ct.CaryatidError, match="view 7: holds no depth readings"):
        ct.Scene().update(ct.View(depth=depth, K=views[0].K, T_world_camera=np.eye(4), name="view 7"))


def test_sizes_that_differ_in_python(views):
    with pytest.raises(InputError, match="rgb is 80×60, depth is 160×120"):
        replace(views[0], rgb=views[0].rgb[::2, ::2])


def test_a_second_view_without_a_pose(views):
    scene = ct.Scene()
    scene.update(views[0])
    with pytest.raises(InputError, match="has no camera pose"):
        scene.update(without_poses(views)[1])


# Cameras and poses


@BOTH
@pytest.mark.parametrize("entry", [0, 4])
def test_a_focal_length_of_zero(recording, refused, command, entry):
    edit(recording / "scene_camera.json", lambda d: d["1"]["cam_K"].__setitem__(entry, 0.0))
    refused(command, recording, names=f"{recording / 'scene_camera.json'}: frame 1", says="focal length")


@pytest.mark.parametrize(
    "R", [np.eye(3) * 1.1, np.diag([1.0, 1.0, -1.0]), np.zeros((3, 3)), np.eye(3) + 0.2], ids=str
)
def test_a_pose_that_is_no_rigid_transform(recording, refused, R):
    edit(recording / "scene_camera.json", lambda d: d["2"].update(cam_R_w2c=R.ravel().tolist()))
    refused("extract", recording, names=f"{recording / 'scene_camera.json'}: frame 2", says="rigid")


@BOTH
def test_several_frames_without_poses(tmp_path, views, refused, command):
    write_recording(tmp_path / "loose", without_poses(views))
    says = refused(command, tmp_path / "loose", says="3 of 3 frames have no pose")
    assert "single frame" in says


# Masks


def test_masks_that_overlap(recording, refused):
    change_image(recording / "mask_visib/000001_000001.png", lambda pixels: np.full_like(pixels, 255))
    name = recording / "mask_visib/000001_000001.png"
    refused("extract", recording, names=name, says="overlaps the mask of obj_id 1")


def test_a_mask_that_names_no_object(recording, refused):
    edit(recording / "scene_gt.json", lambda d: d["1"].pop())
    name = recording / "mask_visib/000001_000001.png"
    refused("extract", recording, names=name, says="names no object")


def test_an_object_number_that_is_none(recording, refused):
    edit(recording / "scene_gt.json", lambda d: d["0"][0].update(obj_id=0))
    refused("explore", recording, names=recording / "scene_gt.json", says="'obj_id' is 0")


@BOTH
def test_labels_are_demanded_where_there_are_none(tmp_path, views, refused, command):
    write_recording(tmp_path / "bare", without_labels(views))
    says = refused(command, tmp_path / "bare", "--segmentation", "labels", says="has no masks")
    assert "--segmentation auto" in says


def three_points_of(view, label):
    labels = np.where(view.labels == label, 0, view.labels)
    labels.ravel()[np.flatnonzero(view.labels == label)[100:103]] = label
    return replace(view, labels=labels.astype(np.int32))


@BOTH
def test_a_segment_of_three_points(tmp_path, views, refused, command):
    write_recording(tmp_path / "few", [three_points_of(view, 2) for view in views[:1]])
    refused(command, tmp_path / "few", says="segment 2 has 3 points with depth, a shape needs 12")
    assert run_command("extract", tmp_path / "few", "--segmentation", "auto", "--out", tmp_path / "run") == 0


def test_a_segment_of_three_points_becomes_an_object_once_more_of_it_is_seen(tmp_path, views):
    write_recording(tmp_path / "few", [three_points_of(views[0], 2), *views[1:]])
    assert run_command("extract", tmp_path / "few", "--out", tmp_path / "run", "--quiet") == 0
    run = read_run(tmp_path / "run")
    assert [len(v.graph.objects) for v in run.views] == [2, 3, 3]


# JSON


@BOTH
@pytest.mark.parametrize("content", ["{", "[]", ""])
def test_broken_json(recording, refused, command, content):
    (recording / "scene_camera.json").write_text(content)
    refused(command, recording, names=recording / "scene_camera.json", says="scene_camera.json: ")


def test_a_camera_without_its_keys(recording, refused):
    edit(recording / "scene_camera.json", lambda d: d["1"].pop("cam_K"))
    refused("extract", recording, names=recording / "scene_camera.json", says="'cam_K' is missing")


def test_a_recording_without_frames(recording, refused):
    (recording / "scene_camera.json").write_text("{}")
    for path in recording.rglob("*.png"):
        path.unlink()
    (recording / "scene_gt.json").write_text("{}")
    refused("extract", recording, says="has no frames")


# MJCF


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('name="table"', 'name="desk"', "has no body 'table'"),
        ("<freejoint/>", "", "has no objects"),
        ("</mujoco>", "", "is no MJCF"),
        ('type="box"', 'type="brick"', "is no MJCF"),
        (TWO_ON_A_TABLE, "a table with two cups", "is no MJCF"),
        (TWO_ON_A_TABLE, "", "is no MJCF"),
        ('size="0.035 0.05"', 'size="-1 0.05"', "MuJoCo refuses it"),
        ('size="0.4 0.5 0.35"/>', 'size="0.4 0.5 0.35"/><freejoint/>', "'table' can move"),
        ('type="cylinder" size="0.035 0.05"', 'type="mesh" mesh="lost"', "lost"),
    ],
)
def test_a_scene_that_cannot_be_simulated(tmp_path, refused, old, new, says):
    path = tmp_path / "scene.xml"
    path.write_text(TWO_ON_A_TABLE.replace(old, new))
    refused("explore", path, says=says)


# Clouds


@pytest.mark.parametrize("promised", [10, 10_000_000])
def test_a_pcd_with_a_lying_header(points, write_pcd, refused, promised):
    refused("extract", write_pcd(*points, count=promised), says="the header")


@pytest.mark.parametrize("name", ["cloud.pcd", "cloud.ply"])
@pytest.mark.parametrize("content", [b"", b"not a cloud\n", b"\x89PNG\r\n\x1a\n\x00"])
def test_a_cloud_that_is_none(tmp_path, refused, name, content):
    (tmp_path / name).write_bytes(content)
    refused("extract", tmp_path / name, says=": ")


def test_a_truncated_ply(points, write_ply, refused):
    path = write_ply(points[0])
    path.write_text(path.read_text()[:5000])
    refused("extract", path, says="the header lies")


def test_a_cloud_without_finite_points(points, write_pcd, refused):
    refused("extract", write_pcd(np.full_like(points[0], np.nan)), says="no finite points")


def test_a_cloud_without_a_plane(write_pcd, refused):
    noise = np.random.default_rng(0).uniform((-0.5, -0.5, 1.0), (0.5, 0.5, 2.0), (4000, 3))
    refused("extract", write_pcd(noise), names="cloud.pcd", says="no support surface")


def test_a_cloud_without_labels_where_they_are_demanded(points, write_pcd, refused):
    says = refused("extract", write_pcd(points[0]), "--segmentation", "labels", says="no field label")
    assert "--segmentation auto" in says


def test_a_single_cloud_cannot_be_explored(points, write_pcd, refused):
    assert "caryatid extract" in refused("explore", write_pcd(*points), says="is a single cloud")


# Sources and places that are not there


@pytest.mark.parametrize("name", ["nowhere", "nowhere.xml", "no where/scene.xml"])
def test_a_source_that_does_not_exist(tmp_path, refused, name):
    assert "tower" in refused("explore", tmp_path / name, says="no such scene")


@pytest.mark.parametrize(("name", "says"), [("nowhere", "there is no such file"), ("nowhere.pcd", "missing")])
def test_nothing_to_extract(tmp_path, refused, name, says):
    refused("extract", tmp_path / name, says=says)


def test_a_name_of_two_lines_is_said_in_one(tmp_path, capsys):
    assert run_command("extract", tmp_path / "one\ntwo", "--out", tmp_path / "run") == 1
    assert capsys.readouterr().err.count("\n") == 1


def test_a_run_that_cannot_be_scored(tmp_path, recording, scene_file, capsys):
    assert run_command("extract", recording, "--out", tmp_path / "run", "--no-report", "--quiet") == 0
    for run, truth, says in (
        (tmp_path / "nowhere", scene_file.parent, "is no folder"),
        (tmp_path / "run", tmp_path / "nowhere", "is no folder"),
        (recording, scene_file.parent, "run.json: the file is missing"),
        (tmp_path / "run", recording, "gt.json: the file is missing"),
        (tmp_path / "run", tmp_path, "has neither scene.xml nor scene_camera.json"),
    ):
        capsys.readouterr()
        assert run_command("evaluate", run, truth) == 1
        said = capsys.readouterr().err
        assert says in said
        assert said.count("\n") == 1
    (tmp_path / "run/views/01/graph.json").write_text("{")
    assert run_command("evaluate", tmp_path / "run", scene_file.parent) == 1
    assert str(tmp_path / "run/views/01/graph.json") in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("[fit\n", "is not TOML"),
        ("[fit]\nhypothesis = 3\n", "there is no setting 'fit.hypothesis'"),
        ("[fit]\nhypotheses = 'many'\n", "should be a valid integer"),
        ("[fit]\nthreshold = nan\n", "should be a finite number"),
        ("[fusion]\nmethod = 'all'\n", "should be 'pc', 'sg' or 'pc+sg'"),
    ],
)
def test_settings_that_are_not_valid(tmp_path, scene_file, refused, content, says):
    file = tmp_path / "settings.toml"
    file.write_text(content)
    refused("explore", scene_file, "--config", file, names=file, says=says)


def test_settings_that_are_not_there(tmp_path, scene_file, refused):
    file = tmp_path / "settings.toml"
    refused("explore", scene_file, "--config", file, names=file, says="cannot be read")


# Where it is written to


@pytest.mark.parametrize("command", ["extract", "explore"])
@pytest.mark.parametrize("after", [0, 4])
def test_a_full_disk(recording, refused, monkeypatch, command, after):
    write, written = pathlib.Path.write_bytes, []

    def full(self, content):
        written.append(self)
        if len(written) > after:
            raise OSError(errno.ENOSPC, "No space left on device", str(self))
        return write(self, content)

    monkeypatch.setattr(pathlib.Path, "write_bytes", full)
    refused(command, recording, "--quiet", names="runs/run", says="the disk is full")
    assert len(written) == after + 1


def test_a_file_in_the_place_of_the_run(tmp_path, recording, capsys, leftovers):
    (tmp_path / "run").write_text("mine")
    assert run_command("extract", recording, "--out", tmp_path / "run") == 1
    assert f"{tmp_path / 'run'}: already exists and is not a folder" in capsys.readouterr().err
    assert run_command("extract", recording, "--out", tmp_path / "run/below") == 1
    assert capsys.readouterr().err.count("\n") == 1
    assert leftovers() <= {"run"}
    assert (tmp_path / "run").read_text() == "mine"


def test_a_read_only_place(recording, refused, monkeypatch):
    def read_only(self, *_, **__):
        raise OSError(errno.EROFS, "Read-only file system", str(self))

    monkeypatch.setattr(pathlib.Path, "mkdir", read_only)
    refused("extract", recording, names="runs/run", says="read-only file system")


@pytest.mark.skipif(not pathlib.Path("/proc/sys").is_dir(), reason="needs a folder nobody may write to")
def test_a_place_nobody_may_write_to(recording):
    done = subprocess.run(
        [sys.executable, "-m", "caryatid", "extract", str(recording), "--out", "/proc/sys/run"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.startswith("error: /proc/sys/run: cannot be written")
    assert done.stderr.count("\n") == 1


def test_a_fault_of_our_own_is_one_line_too_and_debug_shows_it(tmp_path, scene_file, capsys, monkeypatch):
    def broken(*_, **__):
        raise ZeroDivisionError("division by\nzero")

    monkeypatch.setattr("caryatid.sources.open_source", broken)
    command = ["explore", scene_file, "--out", tmp_path / "run", *SMALL]
    assert run_command(*command) == 1
    said = capsys.readouterr().err
    assert said == "error: a fault in caryatid, ZeroDivisionError: division by zero; --debug shows where\n"
    with pytest.raises(ZeroDivisionError):
        run_command(*command, "--debug")
    assert not (tmp_path / "run").exists()


def test_a_cloud_whose_table_has_the_label_of_an_object(points, write_pcd, refused):
    says = refused("extract", write_pcd(points[0], points[1] + 3), names="cloud.pcd", says="none is left")
    assert "--label-divisor" in says
