"""What phones record becomes a recording: nerfstudio, Record3D and Stray Scanner, good ones and bad ones."""

from __future__ import annotations

import json

import numpy as np
import pytest
from conftest import run_command
from phone_files import opengl, write_nerfstudio, write_record3d, write_stray

from caryatid.io import read_recording
from caryatid.io.graph_json import read_graph

WRITERS = {
    "nerfstudio": (write_nerfstudio, ()),
    "record3d": (write_record3d, ("lzfse",)),
    "stray": (write_stray, ("av",)),
}
EACH = pytest.mark.parametrize("kind", WRITERS)


def written(kind, folder, views, **changes):
    """A recording of some views, if its library is here."""
    write, libraries = WRITERS[kind]
    for library in libraries:
        pytest.importorskip(library)
    write(folder, views, **changes)
    return folder


@EACH
def test_views_come_back_with_z_up(kind, tmp_path, views):
    source = written(kind, tmp_path / "scan", views)
    assert run_command("import", source, "--out", tmp_path / "out") == 0
    recording = read_recording(tmp_path / "out")
    assert len(recording) == len(views)
    for view, original in zip(recording, views, strict=True):
        depth = original.depth.copy()
        depth[: 2 if kind == "stray" else 0] = 0.0  # no confidence
        np.testing.assert_allclose(view.depth, depth, atol=0.00056)
        np.testing.assert_allclose(view.pose, original.pose, atol=1e-6)
        np.testing.assert_allclose(view.K, original.K, atol=1e-9)
        assert np.abs(view.rgb.astype(float) - original.rgb).mean() < 6.0


def test_a_graph_without_import(tmp_path, views):
    source = written("nerfstudio", tmp_path / "scan", views)
    assert run_command("extract", source, "--out", tmp_path / "run", "--quiet", "--no-report") == 0
    assert len(read_graph(tmp_path / "run/graph.json").objects) > 1


def test_frames_of_nerfstudio_without_depth_are_left_out(tmp_path, views):
    source = written("nerfstudio", tmp_path / "scan", views)
    table = json.loads((source / "transforms.json").read_text())
    del table["frames"][1]["depth_file_path"]
    (source / "transforms.json").write_text(json.dumps(table | {"depth_unit_scale_factor": 0.0005}))
    assert run_command("import", source, "--out", tmp_path / "out") == 0
    recording = read_recording(tmp_path / "out")
    np.testing.assert_allclose(recording[0].depth, views[0].depth / 2.0, atol=0.0006)
    np.testing.assert_allclose(recording[1].pose, views[2].pose, atol=1e-6)


STRETCHED = (2.0 * np.eye(4)).tolist()
HEADER = "timestamp, frame, x, y, z, qx, qy, qz, qw\n"


@pytest.mark.parametrize(
    ("kind", "changes", "says"),
    [
        ("nerfstudio", {"frames": []}, "has no frames with depth"),
        ("nerfstudio", {"frames": 1}, "'frames' is not a list"),
        (
            "nerfstudio",
            {"frames": [{"file_path": "0.jpg", "transform_matrix": STRETCHED}]},
            "transform_matrix",
        ),
        ("nerfstudio", {"k1": 0.1}, "its images are distorted"),
        ("nerfstudio", {"camera_model": "EQUIRECTANGULAR"}, "its camera is EQUIRECTANGULAR, not a pinhole"),
        ("nerfstudio", {"fl_x": None}, "'fl_x'"),
        ("nerfstudio", {"w": 100}, "colour has 320×240 pixels, but its camera 100×240"),
        ("record3d", {"poses": [[0.0] * 7]}, "is not a pose"),
        ("record3d", {"poses": [[0.0] * 6]}, "'poses'"),
        ("record3d", {"K": [0.0] * 9}, "K"),
        ("record3d", {"dw": 100}, "none of its 3 depth images is usable: 3 broken, such as "),
        ("stray", {"odometry.csv": HEADER.replace("qw", "w")}, "the column 'qw' is missing"),
        ("stray", {"odometry.csv": HEADER + "1, 0, 0, 0, 0, 0, 0, 0, 0"}, "is not a pose"),
        ("stray", {"odometry.csv": HEADER + "1, 0, 0, 0, 0, 0, 0, 0, 1, 2"}, "is not 9 numbers"),
        ("stray", {"odometry.csv": HEADER + "1, -1, 0, 0, 0, 0, 0, 0, 1"}, "frame -1 at 1 s"),
        ("stray", {"odometry.csv": " \n"}, "odometry.csv: is empty"),
        ("stray", {"odometry.csv": HEADER + 200_000 * "1"}, "field limit"),
        ("stray", {"camera_matrix.csv": "1, 2"}, "is not 3 numbers"),
        ("stray", {"rgb.mp4": "not a video"}, "rgb.mp4: cannot be read"),
    ],
)
def test_what_is_broken_is_refused(kind, changes, says, tmp_path, views, refused):
    refused("import", written(kind, tmp_path / "scan", views, **changes), says=says, names="scan")


def test_depth_in_another_format_is_named(tmp_path, views, refused):
    source = written("nerfstudio", tmp_path / "scan", views)
    for path in source.glob("*.png"):
        path.write_bytes(b"\x76\x2f\x31\x01")  # OpenEXR
    refused("import", source, says="3 broken, such as " + str(source / "0.png: not an image"))


def test_a_table_from_a_spreadsheet_has_a_byte_order_mark(tmp_path, views):
    source = written("stray", tmp_path / "scan", views)
    table = source / "odometry.csv"
    table.write_bytes(b"\xef\xbb\xbf" + table.read_bytes())
    assert run_command("import", source, "--out", tmp_path / "out") == 0


def test_options_of_bags_and_archives_are_refused(tmp_path, views, refused):
    source = written("nerfstudio", tmp_path / "scan", views)
    refused("import", source, "--depth", "/depth", says="apply only to bags and TUM folders")
    (tmp_path / "scan.r3d").write_bytes(b"PK")
    refused("import", tmp_path / "scan.r3d", says="unzip it")


def test_the_camera_of_opengl_looks_the_other_way():
    assert (opengl(np.eye(4))[:3, 2] == (0.0, 0.0, -1.0)).all()
