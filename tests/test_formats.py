"""Files: what is written is read back, the same content is the same bytes, and bad files are refused."""

from __future__ import annotations

import copy
import json
import shutil
import struct
from dataclasses import asdict

import lzf
import numpy as np
import pytest
import trimesh
from conftest import refusal
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from synthetic import shelf_graph

from caryatid.config import CloudConfig
from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Sphere, Uncertainty
from caryatid.geometry.solids import Polytope, Solid
from caryatid.graph import SceneObject, Stability, Support, SupportGraph
from caryatid.io import (
    graph_from_json,
    graph_text,
    graph_to_json,
    open_dataset,
    read_graph,
    read_recording,
    read_stored_cloud,
    write_recording,
)
from caryatid.io.json_files import json_text
from caryatid.sensing.views import View
from caryatid.simulation import GroundTruth, TrueEdge, read_truth, write_truth


def change(document, *path_and_value):
    """Replace what lies at a path, or remove it for `...`."""
    *path, last, value = path_and_value
    for key in path:
        document = document[key]
    if value is ...:
        del document[last]
    else:
        document[last] = value


# Graphs


def make_graph(rng):
    """Every kind of shape and support, with all that is known of each, or as little as possible."""
    T = [transforms.rigid(transforms.random_rotation(rng), rng.normal(size=3)) for _ in range(3)]
    table = Box(transforms.rigid(np.eye(3), (0.0, 0.0, 0.7)), np.array([1.0, 0.8, 0.04]))
    known = {"occurrences": 3, "opportunities": 9, "residual": 0.004, "poor_fit": True, "why": "σ ≤ 5 mm"}
    known |= {"seen": (True, False) * 3, "doubt": "hovers"}
    known["uncertainty"] = Uncertainty(*rng.uniform(size=(3, 3)), rng.uniform(size=6))
    objects = (
        SceneObject("o0", 65535, table, role="support_surface"),
        SceneObject("o1", 1, Box(T[0], rng.uniform(0.02, 0.3, 3)), **known),
        SceneObject("o2", 2, Cylinder(T[1], 0.04, 0.1)),
        SceneObject("o3", 3, Sphere(T[2], 0.05)),
        SceneObject("o4", 4, Solid.of([Polytope.around(Box(t, np.ones(3)).outline()) for t in T[:2]])),
    )
    supports = (
        Support("o0", "o1"),
        Support("o1", "o2", "lean", False, 2, 4, rng.normal(size=3), np.array([0.0, 0.6, 0.8]), "contact"),
        Support("o3", "o2", "top-down", contact_world=rng.normal(size=3)),
    )
    stability = {"o2": Stability(0.3, -0.01, True, False), "o3": Stability(0.0, float("inf"), True, True)}
    return SupportGraph(objects, supports, stability)


def everything(graph):
    return json_text({"all": [asdict(item) for item in (*graph.objects[:4], *graph.supports)]})


def test_a_graph_is_read_back():
    graph = make_graph(np.random.default_rng(0))
    document = json.loads(graph_text(graph))
    assert document["stability"]["o3"]["overhang"] is None
    again = graph_from_json(document, "graph.json")
    assert graph_text(again) == graph_text(graph)
    assert again.stability == graph.stability
    assert everything(again) == everything(graph)


def test_a_graph_with_several_support_surfaces_is_read_back():
    again = graph_from_json(json.loads(graph_text(shelf_graph())), "graph.json")
    assert graph_text(again) == graph_text(shelf_graph())
    assert [o.id for o in again.support_surfaces] == ["o0", "s1", "s2"]
    assert again.support_surface.id == "o0"


def test_a_graph_is_as_documented_and_noise_below_a_nanometre_changes_no_byte():
    def graph(offset):
        T = transforms.rigid(np.eye(3), (offset, 0.0, 0.8))
        can = SceneObject("o3", 3, Cylinder(T, 0.04, 0.12), occurrences=4)
        return SupportGraph((SceneObject("o1", 1, Sphere(T, 0.05)), can), (Support("o1", "o3"),))

    document = graph_to_json(graph(0.0))
    about = {"format": "caryatid/graph", "version": 1, "frame": "world, z up, metres"}
    assert {key: document[key] for key in about} == about
    cylinder = document["objects"][1]
    assert cylinder["size"] == {"radius": 0.04, "height": 0.12}
    assert cylinder["T_world_object"] == [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.8], [0, 0, 0, 1]]
    edge = {"supporter": "o1", "supported": "o3", "kind": "bottom-up", "certain": True}
    assert document["supports"] == [edge | {"occurrences": 1, "opportunities": 1, "why": ""}]
    texts = [graph_text(graph(offset)) for offset in (0.0, -1e-12, 1e-6)]
    assert texts[0] == texts[1] != texts[2]


def test_a_minimal_file_of_another_program_is_read(tmp_path):
    thing = {"role": "object", "T_world_object": np.eye(4).tolist(), "mood": "good"}
    box = thing | {"id": "a", "label": 1, "shape": "box", "size": [0.1, 0.1, 0.1]}
    ball = thing | {"id": "b", "label": 2, "shape": "sphere", "size": {"radius": 1}}
    edges = [{"supporter": "a", "supported": "b", "kind": "lean"}]
    about = {"format": "caryatid/graph", "version": 1, "colour": "red"}
    (tmp_path / "graph.json").write_text(json.dumps(about | {"objects": [box, ball], "supports": edges}))
    graph = read_graph(tmp_path / "graph.json")
    assert graph.supports[0].certain
    assert graph["a"].shape.volume == pytest.approx(1e-3)


SUPPORT = {"supporter": "o0", "supported": "o1", "kind": "bottom-up"}


@pytest.mark.parametrize(
    ("where", "said"),
    [
        (("format", "other"), "caryatid/graph"),
        (("version", 2), "'version' is 2: must be 1"),
        (("objects", ...), "'objects' is missing"),
        (("objects", 1, "id", "o0"), "two objects have the id 'o0'"),
        (("objects", 1, "role", "hero"), "hero"),
        (("objects", 1, "label", 70000), "70000"),
        (("objects", 1, "T_world_object", np.diag([2.0, 2, 2, 1]).tolist()), "not a rotation"),
        (("objects", 1, "shape", "banana"), "banana"),
        (("objects", 1, "size", [0.1, -0.1, 0.1]), "not positive"),
        (("objects", 1, "occurrences", -3), "occurrences"),
        (("objects", 1, "size", [0.1, 0.2]), "no shape 'box'"),
        (("objects", 1, "size", {"radius": 0.1}), "no shape 'box'"),
        (("objects", 1, "seen", [True]), "seen"),
        (("objects", 1, "uncertainty", {"position": [0.1, 0.1, 0.1]}), "'rotation' is missing"),
        (("objects", 1, 7), "must be an object"),
        (("supports", 0, "supporter", "o99"), "o99"),
        (("supports", 0, "kind", "glue"), "glue"),
        (("supports", 0, "contact", [1, 2]), "3 finite numbers"),
        (("stability", {"o99": {}}), "o99"),
        (("supports", [SUPPORT, SUPPORT]), "duplicate edge o0 → o1"),
        (("supports", 0, "supporter", "o1"), "'o1' supports itself"),
    ],
)
def test_a_bad_graph_is_refused_with_its_name_and_the_reason(where, said):
    table = SceneObject("o0", 65535, Box(np.eye(4), np.ones(3)), role="support_surface")
    box = SceneObject("o1", 1, Box(np.eye(4), np.ones(3)))
    document = graph_to_json(SupportGraph((table, box), (Support("o0", "o1", contact_world=np.ones(3)),)))
    graph_from_json(copy.deepcopy(document), "right.json")
    change(document, *where)
    with refusal("wrong.json", said):
        graph_from_json(document, "wrong.json")


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b'{"format": ', "broken JSON"),
        (b"[1, 2]", "list"),
        (b'{"a": NaN}', "broken JSON"),
        (b"[" * 200_000, "graph.json"),
        (b'{"format": "caryatid/graph", "version": ' + b"9" * 5000 + b"}", "graph.json"),
        (b'{"objects": [{"residual": 1e300}]}', "a number is larger than 9.2e+18"),
        (b'{"objects": [{"residual": 1e999}]}', "is larger than 9.2e+18"),
        (None, "700 MB is too large, at most 100 MB are read"),
    ],
)
def test_broken_json_is_refused(tmp_path, content, said):
    path = tmp_path / "graph.json"
    with path.open("wb") as file:
        file.truncate(700_000_000) if content is None else file.write(content)
    with refusal(path, said):
        read_graph(path)
    with pytest.raises(ValueError, match="JSON"):
        json_text({"a": float("nan")})


# Ground truth

EASY = {"vertices": ["table", "a"], "edges": [{"supporter": "table", "supported": "a"}]}


def test_ground_truth_is_read_back_and_the_kind_may_be_missing(tmp_path):
    path, truth = tmp_path / "gt.json", GroundTruth(("table", "a"), (TrueEdge("table", "a", "lean"),))
    write_truth(truth, path)
    assert read_truth(path) == truth
    assert json.loads(path.read_text())["edges"] == [EASY["edges"][0] | {"kind": "lean"}]
    path.write_text(json.dumps(EASY))
    assert read_truth(path) == GroundTruth(("table", "a"), (TrueEdge("table", "a"),))
    assert read_truth(path).pairs == {("table", "a")}


@pytest.mark.parametrize(
    ("where", "said"),
    [
        (("vertices", "table"), "'vertices'"),
        (("vertices", ["table", "a", "a"]), "twice"),
        (("edges", ...), "'edges'"),
        (("edges", 0, 3), "edges: '0' is 3"),
        (("vertices", ["table", "b"]), "'a', which is not a vertex"),
        (("edges", 0, "supporter", ...), "edges.0: the key 'supporter' is missing"),
        (("edges", 0, "kind", "glue"), "glue"),
    ],
)
def test_bad_ground_truth_is_refused(tmp_path, where, said):
    document = copy.deepcopy(EASY)
    change(document, *where)
    (tmp_path / "gt.json").write_text(json.dumps(document))
    with refusal(tmp_path / "gt.json", said):
        read_truth(tmp_path / "gt.json")


# Clouds

TYPES = {"x": "<f4", "y": "<f4", "z": "<f4"}
ENCODINGS = ["ascii", "binary", "binary_compressed"]


def plane(count=60, seed=0, **others):
    """Points of the plane z = 1 before a camera in the origin, with labels and, by default, PCD's colours."""
    rng = np.random.default_rng(seed)
    data = np.zeros(count, list((TYPES | (others or {"rgba": "<u4"}) | {"label": "<u4"}).items()))
    data["x"], data["y"] = rng.uniform(-0.3, 0.3, (2, count))
    data["z"], data["label"] = 1.0, np.arange(count) % 4
    if not others:
        data["rgba"] = (10 << 16) | (20 << 8) | 30
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


def write_ply(path, data, encoding):
    kinds = {"<f4": "float", "|u1": "uchar", "<u4": "uint"}
    fields = "".join(f"property {kinds[data.dtype[name].str]} {name}\n" for name in data.dtype.names)
    form = encoding if encoding == "ascii" else "binary_little_endian"
    head = f"ply\nformat {form} 1.0\ncomment made by hand\nelement vertex {len(data)}\n{fields}end_header\n"
    path.write_bytes(head.encode() + body(data, encoding))
    return path


def read_cloud(path):
    return read_stored_cloud(path).to_cloud(CloudConfig())


def refused(path, said):
    with refusal(path, said):
        read_stored_cloud(path)


@pytest.mark.parametrize(
    ("name", "encoding"), [*(("a.pcd", e) for e in ENCODINGS), *(("a.ply", e) for e in ENCODINGS[:2])]
)
def test_all_encodings_give_the_same_cloud(tmp_path, name, encoding):
    if name == "a.pcd":
        data, make = plane(), write
    else:
        data, make = plane(red="u1", green="u1", blue="u1"), write_ply
        data["red"], data["green"], data["blue"] = 10, 20, 30
    data["x"][5], keep = np.nan, np.arange(60) != 5
    cloud = read_cloud(make(tmp_path / name, data, encoding))
    points = np.stack([data["x"], data["y"], data["z"]], axis=-1)
    assert np.allclose(cloud.points_world, points[keep], atol=1e-7)
    assert (cloud.labels == data["label"][keep]).all()
    assert (cloud.rgb == (10, 20, 30)).all()
    assert np.allclose(cloud.normals_world, (0, 0, -1), atol=1e-6)
    assert cloud.name == name


def test_stored_normals_are_used_where_every_reading_has_one(tmp_path):
    full = plane(normal_x="<f4", normal_y="<f4", normal_z="<f4")
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


@pytest.mark.parametrize(("value", "kind"), [(-2, "<i4"), (0.5, "<f4"), (np.nan, "<f4"), (65534, "<u4")])
def test_labels_that_are_no_object_numbers_are_refused(tmp_path, value, kind):
    data = np.zeros(6, list((TYPES | {"label": kind}).items()))
    data["z"], data["label"] = 1.0, value
    refused(write(tmp_path / "a.pcd", data), "label")


@pytest.mark.parametrize(("value", "kind"), [(-1, "<i4"), (2**32 - 1, "<u4"), (65535, "<u2")])
def test_numbers_that_others_give_to_nothing_are_read(tmp_path, value, kind):
    data = np.zeros(6, list((TYPES | {"label": kind}).items()))
    data["z"], data["label"] = 1.0, value
    assert not read_stored_cloud(write(tmp_path / "a.pcd", data)).labels.any()


def test_odd_but_honest_files_are_read(tmp_path):
    lines = ["# c\nVERSION .7", "FIELDS x y z", "SIZE 4 4 4", "TYPE F F F", "WIDTH 2", "HEIGHT 1", "POINTS 2"]
    lines += ["DATA ascii", "1  2\t3 ", "", "nan nan nan", ""]
    (tmp_path / "a.pcd").write_bytes("\r\n".join(lines).encode())
    stored = read_stored_cloud(tmp_path / "a.pcd")
    assert stored.points[0].tolist() == [1, 2, 3]
    assert stored.kept.tolist() == [True, False]
    trimesh.creation.box((0.1, 0.2, 0.3)).export(tmp_path / "a.ply", vertex_normal=True)
    mesh = read_stored_cloud(tmp_path / "a.ply")
    assert len(mesh.points) == 8
    assert np.allclose(np.abs(mesh.points), (0.05, 0.1, 0.15))
    assert mesh.normals is not None
    assert mesh.labels is None


PADDED = {"FIELDS": "x y z _ rgba _ label _", "SIZE": "4 4 4 1 4 1 4 2", "TYPE": "F F F U U U U U"}
PADDED |= {"COUNT": "1 1 1 4 1 0 1 2"}


@pytest.mark.parametrize("encoding", ["binary", "binary_compressed", "stored"])
@pytest.mark.parametrize("version", [".5", "0.6", None])
def test_clouds_of_pcl_with_padding_of_any_version_and_not_shrunk_are_read(tmp_path, encoding, version):
    data = plane(a="V4", rgba="<u4", b="V4")
    data["rgba"] = 0xFF0A141E
    order = ["x", "y", "z", "a", "rgba", "label", "b"]
    padded = np.zeros(60, [(name, data.dtype[name]) for name in order])
    for name in order:
        padded[name] = data[name]
    content = body(padded, encoding)
    if encoding == "stored":
        columns = b"".join(np.ascontiguousarray(padded[name]).tobytes() for name in order)
        encoding, content = "binary_compressed", struct.pack("<II", len(columns), len(columns)) + columns
    path = tmp_path / "a.pcd"
    path.write_bytes(header(padded, encoding, VERSION=version, VIEWPOINT=None, **PADDED).encode() + content)
    stored = read_stored_cloud(path)
    assert np.array_equal(stored.points, np.stack([data[axis] for axis in "xyz"], axis=-1))
    assert np.array_equal(stored.labels, data["label"])
    assert (stored.rgb == (10, 20, 30)).all()


@pytest.mark.parametrize("order", ["<", ">"])
def test_doubles_of_either_byte_order_are_read_whatever_follows_the_points(tmp_path, order):
    points, names = np.random.default_rng(0).normal(size=(4, 3)), ("little", "big")
    lines = [f"format binary_{names[order == '>']}_endian 1.0", "element vertex 4"]
    lines += [f"property double {axis}" for axis in "xyz"]
    lines += ["element face 2", "property list uchar int vertex_indices", "element camera 1"]
    lines += ["property float view_px", "end_header", ""]
    faces = struct.pack(f"{order}B3iB4i", 3, 0, 1, 2, 4, 0, 1, 2, 3)
    content = points.astype(f"{order}f8").tobytes() + faces + struct.pack(f"{order}f", 0.5)
    (tmp_path / "a.ply").write_bytes("\n".join(["ply", *lines]).encode() + content)
    assert np.array_equal(read_stored_cloud(tmp_path / "a.ply").points, points)


GIGABYTES = struct.pack("<II", 100, 10**8 * plane().itemsize) + bytes(100)


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
        *((body(plane(), e)[:-50], {"DATA": e}, "broken file or header") for e in ENCODINGS),
        *(
            (body(plane(), e), {"DATA": e, "POINTS": n, "WIDTH": n}, "broken file or header")
            for e in ENCODINGS
            for n in (59, 61, 4_000_000_000)
        ),
    ],
)
def test_headers_that_make_no_sense_or_do_not_fit_are_refused(tmp_path, content, changed, said):
    data = body(plane(), "binary") if content is None else content
    (tmp_path / "a.pcd").write_bytes(header(plane(), "binary", **changed).encode() + data)
    refused(tmp_path / "a.pcd", said)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("nowhere.pcd", None, "missing"),
        ("nowhere.ply", None, "missing"),
        ("a.xyz", b"1 2 3", "not a .pcd or .ply"),
        ("folder.pcd", ..., "cannot be read"),
        ("a.ply", b"", "a.ply"),
        ("a.ply", b"ply\nformat ascii 1.0\nend_header\n", "a.ply"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float a\nend_header\n1\n", "a.ply"),
        ("nan.pcd", header(plane(1), "ascii").encode() + b"nan 0 1 2 3\n", "no finite points"),
    ],
)
def test_files_of_no_use_are_refused(tmp_path, name, content, said):
    if content is ...:
        (tmp_path / name).mkdir()
    elif content is not None:
        (tmp_path / name).write_bytes(content)
    refused(tmp_path / name, said)


# Recordings

K = np.array([[60.0, 0.0, 31.5], [0.0, 60.0, 23.5], [0.0, 0.0, 1.0]])
MASK = "mask_visib/000001_000001.png"
CAMERA = "scene_camera.json"


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


def spoil(folder, name, *where):
    """Change a file of a recording: an image, the bytes left of it, or a place in a document."""
    path, (what, *_) = folder / name, where
    if isinstance(what, Image.Image):
        what.save(path)
    elif isinstance(what, float):
        path.write_bytes(path.read_bytes()[: int(what * path.stat().st_size)])
    else:
        document = json.loads(path.read_text())
        change(document, *where)
        path.write_text(json.dumps(document))


def test_a_recording_is_read_back_view_by_view(folder):
    views, recording = make_views(), read_recording(folder)
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
    assert recording[0] is not recording[0], "views are not kept"
    with pytest.raises(InputError, match="no frame"):
        recording.frame("000009")


def test_millimetres_and_world_to_camera_become_metres_and_camera_to_world(tmp_path):
    (tmp_path / "depth").mkdir()
    Image.fromarray(np.full((4, 5), 2000, np.uint16)).save(tmp_path / "depth/000004.png")
    camera = {"cam_K": K.ravel().tolist(), "depth_scale": 0.5}
    drifted = [1.0005, 2e-4, 0, 0, 1, 0, 0, 0, 1.0002]
    camera |= {"cam_R_w2c": drifted, "cam_t_w2c": [0, 0, 500]}
    (tmp_path / CAMERA).write_text(json.dumps({"4": camera}))
    view = read_recording(tmp_path)[0]
    assert np.allclose(view.depth, 1.0)
    R, t = view.T_world_camera[:3, :3], view.T_world_camera[:3, 3]
    assert np.allclose(t, (0, 0, -0.5), atol=1e-3)
    assert np.allclose(R.T @ R, np.eye(3), atol=1e-12)
    assert np.allclose(R, np.eye(3), atol=1e-3)
    assert (view.rgb, view.labels) == (None, None)


def test_an_empty_mask_is_an_object_out_of_sight(folder):
    Image.new("L", (64, 48)).save(folder / "mask_visib/000000_000001.png")
    assert set(np.unique(read_recording(folder)[0].labels)) == {0, 7}


def test_masks_of_one_model_or_without_a_table_are_segments_of_their_view(tmp_path, folder):
    first = read_recording(folder)[0].labels
    (folder / "names.json").write_text('{"300": "cup"}')
    spoil(folder, "scene_gt.json", "1", 0, "obj_id", 300)
    repeated = read_recording(folder)
    assert "two masks of frame 1 have obj_id 300, so masks are segments" in repeated.notes[0]
    for view, names in zip(repeated, ({2: "cup"}, {1: "cup", 2: "cup"}, {2: "cup"}), strict=True):
        assert view.labels_are == "segments"
        assert view.names == names
        assert (view.labels == np.select([first == 7, first == 300], [1, 2])).all()
    write_recording(tmp_path / "again", repeated)
    for path in (tmp_path / "again", folder):
        (path / "scene_gt.json").unlink(missing_ok=True)
        (unknown, *_), (seen, *_) = read_recording(path), repeated
        assert (unknown.labels_are, unknown.names) == ("segments", {} if path == folder else None)
        assert (unknown.labels == seen.labels).all()


def test_of_masks_that_overlap_the_smallest_is_on_top_and_one_line_says_so(folder, caplog):
    Image.new("L", (64, 48), 255).save(folder / "mask_visib/000001_000000.png")
    with caplog.at_level("INFO"):
        labels = [view.labels for view in (*read_recording(folder), *read_recording(folder, masks=False))]
    assert ((labels[1] == 300) == (labels[0] == 300)).all()
    assert (labels[1] != 0).all()
    assert labels[3:] == [None] * 3
    (line,) = caplog.messages
    assert "overlap, in frame 1 in 80 pixels" in line


def test_a_lost_mask_is_left_out_with_a_line(folder):
    (folder / MASK).unlink()
    read = read_recording(folder)
    assert [set(np.unique(view.labels)) for view in read] == [{0, 7, 300}, {0, 7}, {0, 7, 300}]
    assert "1 of 6 masks are left out:" in read.notes[0]
    assert MASK in read.notes[0]


@pytest.mark.parametrize("kind", [np.uint16, np.float32])
def test_of_several_sensors_one_is_chosen_and_its_depth_may_be_a_tiff(folder, kind):
    views = list(read_recording(folder))
    for end in ("left", "right"):
        for name in ("depth", "mask_visib"):
            shutil.copytree(folder / name, folder / f"{name}_{end}")
        for name in ("scene_camera", "scene_gt"):
            shutil.copy(folder / f"{name}.json", folder / f"{name}_{end}.json")
    for path in (folder / CAMERA, folder / "scene_gt.json"):
        path.unlink()
    for path in (folder / "depth_right").iterdir():
        Image.fromarray(np.array(Image.open(path)).astype(kind)).save(path.with_suffix(".tif"))
        path.unlink()
    with refusal(folder, "2 of its sensors have depth: left, right", "depth_left"):
        open_dataset(folder)
    for read in (read_recording(folder / "depth_left"), open_dataset(folder / "depth_right")):
        for view, before in zip(read, views, strict=True):
            assert (view.name, view.rgb) == (before.name, None)
            assert np.array_equal(view.depth, before.depth)
            assert np.array_equal(view.labels, before.labels)
    shutil.rmtree(folder / "depth_left")
    assert len(read_recording(folder)) == 3


@pytest.mark.parametrize(
    ("name", "where", "said"),
    [
        *(
            (name, (share,), name)
            for name in ("depth/000001.png", "rgb/000001.png", MASK)
            for share in (0.0, 0.3, 0.9)
        ),
        (MASK, (Image.new("L", (63, 48)),), "63×48 pixels, but the depth image has 64"),
        ("depth/000002.png", (Image.new("L", (64, 48), 1),), "mode L, not a 16-bit grey PNG"),
        ("depth/000002.png", (Image.new("I;16", (64, 48)),), "the frame is empty"),
        (CAMERA, ("1", "cam_K", [1, 2]), "9 finite numbers"),
        (CAMERA, ("1", "cam_K", 0, 0.0), "focal lengths 0"),
        (CAMERA, ("1", "depth_scale", ...), "'depth_scale' is missing"),
        (CAMERA, ("1", "cam_t_w2c", ...), "'cam_t_w2c' is missing"),
        (CAMERA, ("1", "cam_R_w2c", [0.0] * 9), "not a rotation"),
        (CAMERA, ("1", ...), "no entry in scene_camera.json"),
        (CAMERA, ("first", {}), "must be a valid integer"),
        ("scene_gt.json", ("1", {"obj_id": 1}), "must be a valid array"),
        ("scene_gt.json", ("8", []), "not in scene_camera.json"),
        ("scene_gt.json", ("1", -1, ...), "names no object"),
        ("scene_gt.json", ("1", 0, "obj_id", 0), "'obj_id' is 0"),
    ],
)
def test_a_bad_recording_is_refused(folder, name, where, said):
    spoil(folder, name, *where)
    with refusal(folder, said):
        list(read_recording(folder))


@pytest.mark.parametrize(("reach", "scale"), [(6.5, 0.1), (7.0, 0.2), (20.0, 0.4)])
def test_depth_is_counted_as_finely_as_16_bits_reach(tmp_path, reach, scale):
    depth = np.array([[0.0, 1.2345, reach]], np.float32)
    write_recording(tmp_path / "far", [View(depth, K)])
    assert json.loads((tmp_path / "far" / CAMERA).read_text())["0"]["depth_scale"] == scale
    assert np.allclose(read_recording(tmp_path / "far")[0].depth, depth, atol=0.00051 * scale)


def test_what_is_missing_or_cannot_be_written_is_said_and_leaves_nothing(tmp_path, folder):
    with pytest.raises(InputError, match="no views"):
        write_recording(tmp_path / "none", [])
    with pytest.raises(InputError, match="already exists"):
        write_recording(folder, make_views())
    assert [p.name for p in tmp_path.iterdir()] == ["scene"]
    for name in ("rgb/000001.png", "depth/000001.png"):
        (folder / name).unlink()
        with refusal(folder, name, "missing"):
            list(read_recording(folder))
    (folder / CAMERA).write_text("{}")
    with refusal(folder, "has no frames"):
        list(read_recording(folder))
