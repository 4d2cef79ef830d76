"""Recordings: what is written is read back, bad ones are refused in one line."""

from __future__ import annotations

import json

import numpy as np
import pytest
from conftest import refusal
from PIL import Image

from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.io import read_recording, write_recording
from caryatid.sensing.views import View

K = np.array([[60.0, 0.0, 31.5], [0.0, 60.0, 23.5], [0.0, 0.0, 1.0]])
MASK = "mask_visib/000001_000001.png"


def make_views():
    rng = np.random.default_rng(3)
    labels = np.zeros((48, 64), dtype=np.int32)
    labels[10:20, 10:30], labels[20:30, 12:20] = 7, 300
    views = []
    for _ in range(3):
        depth = rng.uniform(0.4, 3.0, (48, 64)).astype(np.float32)
        depth[:5] = 0.0
        rgb = rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)
        T_world_camera = transforms.look_at(rng.normal(5.0, 1.0, 3), rng.normal(size=3))
        views.append(View(depth, K, T_world_camera, rgb, labels))
    return views


@pytest.fixture
def folder(tmp_path):
    write_recording(tmp_path / "scene", make_views())
    return tmp_path / "scene"


def edit(folder, name, change):
    path = folder / name
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def refused(folder, *said):
    with refusal(folder, *said):
        list(read_recording(folder))


def test_what_is_written_is_read_back(folder):
    views = make_views()
    recording = read_recording(folder)
    assert len(recording) == 3
    assert recording.has_poses
    assert recording.has_labels
    for view, again in zip(views, recording, strict=True):
        assert np.abs(view.depth - again.depth).max() < 0.51e-4
        assert ((view.depth == 0) == (again.depth == 0)).all()
        assert (view.rgb == again.rgb).all()
        assert (view.labels == again.labels).all()
        assert np.allclose(view.K, again.K)
        assert np.allclose(view.T_world_camera, again.T_world_camera, atol=1e-8)
    assert [v.name for v in recording] == ["scene/000000", "scene/000001", "scene/000002"]
    assert recording.frame("elsewhere/000001") is recording.frames[1]
    assert len(recording[1:]) == 2
    with pytest.raises(InputError, match="no frame"):
        recording.frame("000009")


def test_millimetres_and_world_to_camera_become_metres_and_camera_to_world(tmp_path):
    (tmp_path / "depth").mkdir()
    Image.fromarray(np.full((4, 5), 2000, np.uint16)).save(tmp_path / "depth/000004.png")
    camera = {"cam_K": K.ravel().tolist(), "depth_scale": 0.5}
    camera |= {"cam_R_w2c": np.eye(3).ravel().tolist(), "cam_t_w2c": [0, 0, 500]}
    (tmp_path / "scene_camera.json").write_text(json.dumps({"4": camera}))
    view = read_recording(tmp_path)[0]
    assert np.allclose(view.depth, 1.0)
    assert np.allclose(view.T_world_camera[:3, 3], (0, 0, -0.5))
    assert view.rgb is None
    assert view.labels is None


def test_views_are_read_one_by_one_and_not_kept(folder):
    recording = read_recording(folder)
    assert recording[0] is not recording[0]
    for path in (folder / "depth").glob("*.png"):
        path.unlink()
    with pytest.raises(InputError, match="missing"):
        recording[0]


@pytest.mark.parametrize("name", ["depth/000001.png", "rgb/000001.png", MASK])
def test_an_image_that_is_missing_or_truncated_is_refused(folder, name):
    path = folder / name
    content = path.read_bytes()
    for keep in (0.0, 0.3, 0.9):
        path.write_bytes(content[: int(len(content) * keep)])
        refused(folder, name, "000001")
    path.unlink()
    refused(folder, name, "missing")


@pytest.mark.parametrize(
    ("name", "image", "said"),
    [
        (MASK, Image.new("L", (63, 48)), "63×48 pixels, but the depth image has 64"),
        (MASK, Image.new("L", (64, 48), 255), "overlaps the mask of obj_id 7 in"),
        ("depth/000002.png", Image.new("L", (64, 48), 1), "mode L, not a 16-bit grey PNG"),
        ("depth/000002.png", Image.new("I;16", (64, 48)), "the frame is empty"),
    ],
)
def test_images_of_another_size_or_kind_are_refused(folder, name, image, said):
    image.save(folder / name)
    refused(folder, name, said)


def test_an_empty_mask_is_an_object_out_of_sight(folder):
    Image.new("L", (64, 48)).save(folder / "mask_visib/000000_000001.png")
    assert set(np.unique(read_recording(folder)[0].labels)) == {0, 7}


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("scene_camera.json", lambda d: d["1"].update(cam_K=[1, 2]), "9 finite numbers"),
        ("scene_camera.json", lambda d: d["1"]["cam_K"].__setitem__(0, 0.0), "focal lengths 0"),
        ("scene_camera.json", lambda d: d["1"].pop("depth_scale"), "'depth_scale' is missing"),
        ("scene_camera.json", lambda d: d["1"].pop("cam_t_w2c"), "'cam_t_w2c' is missing"),
        ("scene_camera.json", lambda d: d["1"].update(cam_R_w2c=[0.0] * 9), "not a rotation"),
        ("scene_camera.json", lambda d: d.pop("1"), "no entry in scene_camera.json"),
        ("scene_camera.json", dict.clear, "has no frames"),
        ("scene_camera.json", lambda d: d.update({"first": d["1"]}), "must be a valid integer"),
        ("scene_gt.json", lambda d: d["1"][0].update(obj_id=300), "two masks have obj_id 300"),
        ("scene_gt.json", lambda d: d.update({"1": {"obj_id": 1}}), "must be a valid array"),
        ("scene_gt.json", lambda d: d.update({"8": []}), "not in scene_camera.json"),
        ("scene_gt.json", lambda d: d["1"].pop(), "names no object"),
        ("scene_gt.json", lambda d: d["1"][0].update(obj_id=0), "'obj_id' is 0"),
    ],
)
def test_bad_cameras_and_object_tables_are_refused(folder, name, change, said):
    edit(folder, name, change)
    refused(folder, said)


def test_a_rotation_that_drifted_is_made_a_rotation(folder):
    drifted = [1.0005, 2e-4, 0, 0, 1, 0, 0, 0, 1.0002]
    edit(folder, "scene_camera.json", lambda d: d["1"].update(cam_R_w2c=drifted))
    R = read_recording(folder).frames[1].T_world_camera[:3, :3]
    assert np.allclose(R.T @ R, np.eye(3), atol=1e-12)
    assert np.allclose(R, np.eye(3), atol=1e-3)


@pytest.mark.parametrize(("reach", "scale"), [(6.5, 0.1), (7.0, 0.2), (20.0, 0.4)])
def test_depth_is_counted_as_finely_as_16_bits_reach(tmp_path, reach, scale):
    write_recording(tmp_path / "far", [View(np.array([[0.0, 1.2345, reach]], np.float32), K)])
    camera = json.loads((tmp_path / "far/scene_camera.json").read_text())["0"]
    assert camera["depth_scale"] == scale
    assert np.allclose(
        read_recording(tmp_path / "far")[0].depth, [[0.0, 1.2345, reach]], atol=0.00051 * scale
    )


def test_what_cannot_be_written_leaves_nothing(tmp_path, folder):
    with pytest.raises(InputError, match="no views"):
        write_recording(tmp_path / "none", [])
    with pytest.raises(InputError, match="already exists"):
        write_recording(folder, make_views())
    assert [p.name for p in tmp_path.iterdir()] == ["scene"]
