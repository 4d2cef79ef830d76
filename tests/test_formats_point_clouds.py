"""Clouds: PCD and PLY in all encodings, and headers that lie."""

from __future__ import annotations

import struct

import lzf
import numpy as np
import pytest
from conftest import refusal
from hypothesis import given, settings
from hypothesis import strategies as st

from caryatid.config import CloudConfig
from caryatid.io import read_stored_cloud

DTYPE = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgba", "<u4"), ("label", "<u4")])


def plane(count=60, seed=0):
    """Points of the plane z = 1 before a camera in the origin."""
    rng = np.random.default_rng(seed)
    data = np.zeros(count, DTYPE)
    data["x"], data["y"] = rng.uniform(-0.3, 0.3, (2, count))
    data["z"] = 1.0
    data["rgba"] = (10 << 16) | (20 << 8) | 30
    data["label"] = np.arange(count) % 4
    return data


def header(data, encoding, **changed):
    names, kinds = data.dtype.names, [data.dtype[name] for name in data.dtype.names]
    lines = {
        "VERSION": "0.7",
        "FIELDS": " ".join(names),
        "SIZE": " ".join(str(kind.itemsize) for kind in kinds),
        "TYPE": " ".join(kind.kind.upper() for kind in kinds),
        "COUNT": " ".join("1" for _ in names),
        "WIDTH": len(data),
        "HEIGHT": 1,
        "VIEWPOINT": "0 0 0 1 0 0 0",
        "POINTS": len(data),
        "DATA": encoding,
    } | changed
    return "# .PCD v0.7\n" + "".join(f"{k} {v}\n" for k, v in lines.items() if v is not None)


def body(data, encoding):
    match encoding:
        case "ascii":
            return "\n".join(" ".join(repr(v.item()) for v in row) for row in data).encode() + b"\n"
        case "binary":
            return data.tobytes()
    columns = b"".join(np.ascontiguousarray(data[name]).tobytes() for name in data.dtype.names)
    packed = lzf.compress(columns)
    return struct.pack("<II", len(packed), len(columns)) + packed


def write(path, data, encoding="binary", **changed):
    path.write_bytes(header(data, encoding, **changed).encode() + body(data, encoding))
    return path


def read_cloud(path):
    return read_stored_cloud(path).to_cloud(CloudConfig())


def refused(path, said):
    with refusal(path, said):
        read_stored_cloud(path)


ENCODINGS = ["ascii", "binary", "binary_compressed"]


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_all_encodings_give_the_same_cloud(tmp_path, encoding):
    data = plane()
    cloud = read_cloud(write(tmp_path / "a.pcd", data, encoding))
    assert np.allclose(cloud.points_world, np.stack([data["x"], data["y"], data["z"]], axis=-1), atol=1e-7)
    assert (cloud.labels == data["label"]).all()
    assert (cloud.rgb == (10, 20, 30)).all()
    assert np.allclose(cloud.normals_world, (0, 0, -1), atol=1e-6)
    assert cloud.name == "a.pcd"


def test_stored_normals_are_used_where_every_reading_has_one(tmp_path):
    full = np.zeros(60, [(name, "<f4") for name in ("x", "y", "z", "normal_x", "normal_y", "normal_z")])
    for name in "xyz":
        full[name] = plane()[name]
    full["normal_x"] = 2.0
    assert np.allclose(read_cloud(write(tmp_path / "a.pcd", full)).normals_world, (1, 0, 0))
    full["normal_x"][3] = np.nan
    estimated = read_cloud(write(tmp_path / "a.pcd", full)).normals_world
    assert np.allclose(estimated, (0, 0, -1), atol=1e-6)


@given(st.integers(1, 40), st.integers(0, 1000))
@settings(max_examples=25, deadline=None)
def test_missing_readings_are_dropped_and_labels_spread_back(tmp_path_factory, missing, seed):
    rng = np.random.default_rng(seed)
    data, gone = plane(60, seed), rng.choice(60, missing, replace=False)
    data["x"][gone] = rng.choice([np.nan, np.inf, -np.inf], missing)
    stored = read_stored_cloud(write(tmp_path_factory.mktemp("c") / "a.pcd", data, WIDTH=10, HEIGHT=6))
    cloud = stored.to_cloud(CloudConfig())
    assert len(cloud) == 60 - missing == stored.kept.sum()
    assert np.isfinite(cloud.points_world).all()
    assert np.isfinite(cloud.normals_world).all()
    back = stored.spread(cloud.labels + 5)
    assert (back == np.where(stored.kept, data["label"] + 5, 0)).all()
    assert not back[gone].any()


@pytest.mark.parametrize(("value", "kind"), [(-1, "<i4"), (0.5, "<f4"), (np.nan, "<f4"), (65535, "<u4")])
def test_labels_that_are_no_object_numbers_are_refused(tmp_path, value, kind):
    data = np.zeros(6, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("label", kind)])
    data["z"], data["label"] = 1.0, value
    refused(write(tmp_path / "a.pcd", data), "label")


def test_odd_but_honest_ascii_is_read(tmp_path):
    lines = ["# c\nVERSION .7", "FIELDS x y z", "SIZE 4 4 4", "TYPE F F F", "WIDTH 2", "HEIGHT 1", "POINTS 2"]
    lines += ["DATA ascii", "1  2\t3 ", "", "nan nan nan", ""]
    (tmp_path / "a.pcd").write_bytes("\r\n".join(lines).encode())
    stored = read_stored_cloud(tmp_path / "a.pcd")
    assert stored.points[0].tolist() == [1, 2, 3]
    assert stored.kept.tolist() == [True, False]


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_number_of_points_that_is_not_there_is_refused(tmp_path, encoding):
    for points in (59, 61, 4_000_000_000):
        path = write(tmp_path / "a.pcd", plane(), encoding, POINTS=points, WIDTH=points)
        refused(path, "broken file or header")
    path.write_bytes(write(path, plane(), encoding).read_bytes()[:-50])
    refused(path, "broken file or header")


GIGABYTES = struct.pack("<II", 100, 10**8 * DTYPE.itemsize) + bytes(100)


@pytest.mark.parametrize(
    ("content", "changed", "said"),
    [
        (None, {"WIDTH": 30}, "WIDTH 30 × HEIGHT 1, POINTS 60"),
        (None, {"FIELDS": "x y z rgba"}, "do not agree"),
        (None, {"FIELDS": "a b c d e"}, "fields x y z"),
        (None, {"TYPE": "U F F U U"}, "floating-point"),
        (None, {"POINTS": 0, "WIDTH": 0}, "POINTS 0"),
        (None, {"VIEWPOINT": "0 0 0"}, "VIEWPOINT"),
        (None, {"COUNT": "1 1 1 1 997"}, "the sum of COUNT, 1001, exceeds 1000"),
        (None, {"DATA": None}, "no DATA line"),
        (GIGABYTES, {"DATA": "binary_compressed", "POINTS": 10**8, "WIDTH": 10**8}, "broken file or header"),
        (b"1 2 3 4 5\n1 2\n", {"DATA": "ascii", "POINTS": 2, "WIDTH": 2}, "2 were found"),
        (b"1 2 3 4 5\na b c 1 2\n", {"DATA": "ascii", "POINTS": 2, "WIDTH": 2}, "'a'"),
    ],
)
def test_headers_that_make_no_sense_or_do_not_fit_are_refused(tmp_path, content, changed, said):
    path = tmp_path / "a.pcd"
    data = body(plane(), "binary") if content is None else content
    path.write_bytes(header(plane(), "binary", **changed).encode() + data)
    refused(path, said)


def test_files_of_no_use_are_refused(tmp_path):
    refused(tmp_path / "nowhere.pcd", "missing")
    refused(tmp_path / "nowhere.ply", "missing")
    (tmp_path / "a.xyz").write_text("1 2 3")
    refused(tmp_path / "a.xyz", "not a .pcd or .ply")
    (tmp_path / "folder.pcd").mkdir()
    refused(tmp_path / "folder.pcd", "cannot be read")
    data = plane()
    data["x"] = np.nan
    refused(write(tmp_path / "nan.pcd", data), "no finite points")


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_ply_is_read_with_labels_and_colour(tmp_path, encoding):
    kinds = {"x": "float", "y": "float", "z": "float", "red": "uchar", "green": "uchar", "blue": "uchar"}
    types = {"float": "<f4", "uchar": "u1", "int": "<i4"}
    data = np.zeros(60, [(name, types[kind]) for name, kind in (kinds | {"label": "int"}).items()])
    for name in ("x", "y", "z", "label"):
        data[name] = plane()[name]
    data["red"], data["green"], data["blue"] = 10, 20, 30
    data["x"][5] = np.nan
    fields = "".join(f"property {kind} {name}\n" for name, kind in (kinds | {"label": "int"}).items())
    head = f"ply\nformat {encoding} 1.0\ncomment made by hand\nelement vertex 60\n{fields}end_header\n"
    path = tmp_path / "a.ply"
    path.write_bytes(head.encode() + body(data, "ascii" if encoding == "ascii" else "binary"))
    cloud, keep = read_cloud(path), np.arange(60) != 5
    assert np.allclose(cloud.points_world[:, 0], data["x"][keep], atol=1e-7)
    assert (cloud.labels == data["label"][keep]).all()
    assert (cloud.rgb == (10, 20, 30)).all()
    assert np.allclose(cloud.normals_world, (0, 0, -1), atol=1e-6)


def test_the_vertices_of_a_mesh_are_a_cloud(tmp_path):
    import trimesh

    mesh = trimesh.creation.box((0.1, 0.2, 0.3))
    mesh.export(tmp_path / "a.ply", vertex_normal=True)
    stored = read_stored_cloud(tmp_path / "a.ply")
    assert len(stored.points) == 8
    assert np.allclose(np.abs(stored.points), (0.05, 0.1, 0.15))
    assert stored.normals is not None
    assert stored.labels is None


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"ply\nformat ascii 1.0\nend_header\n",
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float a\nend_header\n1\n",
    ],
)
def test_files_other_than_ply_are_refused(tmp_path, content):
    path = tmp_path / "a.ply"
    path.write_bytes(content)
    refused(path, "a.ply")
