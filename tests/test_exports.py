"""Scene models for other programs: each file is read by a program that knows it, and compared."""

from __future__ import annotations

import json
from dataclasses import replace

import mujoco
import networkx as nx
import numpy as np
import pydot
import pytest
import trimesh
import yourdfpy
from conftest import run_command
from scipy.spatial.transform import Rotation
from synthetic import shelf_graph

from caryatid.config import ExportConfig
from caryatid.errors import InputError
from caryatid.exports import export_graph
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Sphere
from caryatid.graph import SceneObject, Support, SupportGraph
from caryatid.io import graph_text
from caryatid.simulation.scenes import load_scene
from caryatid.viz.colours import object_colour


def at(x, y, z, turn=(0.0, 0.0, 0.0)):
    return transforms.rigid(transforms.rotation_from_vector(turn), (x, y, z))


@pytest.fixture
def graph():
    """A table, one shape of each kind, and a box whose axis points straight down."""
    down = (0.0, np.pi / 2.0, 0.0)
    return SupportGraph(
        objects=(
            SceneObject("o0", 0, Box(at(0.0, 0.0, 0.73), np.array([0.6, 0.9, 0.04])), "support_surface"),
            SceneObject("o1", 1, Box(at(0.1, 0.0, 0.80, (0.1, 0.2, 2.0)), np.array([0.08, 0.1, 0.09]))),
            SceneObject("o2", 2, Cylinder(at(-0.1, 0.2, 0.81, (1.0, -0.4, 0.3)), 0.04, 0.12)),
            SceneObject("o3", 3, Sphere(at(0.0, -0.2, 0.78), 0.03), occurrences=2, opportunities=3),
            SceneObject("o15", 15, Box(at(0.2, 0.3, 0.85, down), np.array([0.2, 0.06, 0.05]))),
        ),
        supports=(
            Support("o0", "o1"),
            Support("o1", "o2", "lean", certain=False, occurrences=1, opportunities=3),
            Support("o3", "o1", "top-down"),
        ),
    )


# Simulators


def test_mjcf_has_the_poses_and_sizes_of_the_model(tmp_path, graph):
    export_graph(graph, tmp_path / "scene.xml")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert model.nbody == 1 + len(graph.objects)
    for item in graph.objects:
        body = data.body("table" if item.role == "support_surface" else item.id)
        assert np.allclose(body.xpos, item.centre_world, atol=1e-6)
        assert np.allclose(body.xmat.reshape(3, 3), item.shape.T_world_object[:3, :3], atol=1e-5)
        geom = model.body(body.name).geomadr[0]
        assert model.body(body.name).jntnum == (item.role == "object")
        assert mujoco.mjtGeom(model.geom_type[geom]).name == f"mjGEOM_{item.shape.kind.upper()}"
        assert np.allclose(model.geom_aabb[geom, 3:], item.shape.extents / 2.0, atol=1e-6)
        if item.role == "object":
            assert model.body(body.name).mass[0] == pytest.approx(600.0 * item.shape.volume, rel=1e-4)


def test_a_model_is_a_scene_and_stays_where_it_is_in_mujoco(tmp_path, kept_run):
    assert run_command("export", kept_run, "--format", "mjcf", "--out", tmp_path / "scene.xml") == 0
    assert sorted(load_scene(tmp_path / "scene.xml").object_bodies.values()) == ["o1", "o2"]
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    before, turned = data.xpos.copy(), Rotation.from_matrix(data.xmat.reshape(-1, 3, 3))
    mujoco.mj_step(model, data, nstep=round(1.0 / model.opt.timestep))
    assert np.linalg.norm(data.xpos - before, axis=1).max() < 0.005
    turns = Rotation.from_matrix(data.xmat.reshape(-1, 3, 3)) * turned.inv()
    assert np.degrees(turns.magnitude()).max() < 3.0


@pytest.mark.parametrize("name", ["scene.xml", "scene.urdf", "scene.gltf", "scene.graphml", "scene.dot"])
def test_every_support_surface_is_exported(tmp_path, name):
    export_graph(shelf_graph(), tmp_path / name)
    text = (tmp_path / name).read_text()
    assert all(f'"{o.id}"' in text for o in shelf_graph().objects if (o.id, name) != ("o0", "scene.xml"))
    if name == "scene.xml":
        scene = load_scene(tmp_path / name)
        for o in shelf_graph().support_surfaces:
            body = scene.data.body("table" if o.id == "o0" else o.id)
            np.testing.assert_allclose(body.xpos, o.centre_world, atol=1e-9)
        bodies = {i: scene.data.body(i).xpos for i in scene.object_bodies.values()}
        assert all(np.linalg.norm(at - shelf_graph()[i].centre_world) < 0.005 for i, at in bodies.items())


def test_urdf_has_the_poses_sizes_and_masses_of_the_model(tmp_path, graph):
    export_graph(graph, tmp_path / "scene.urdf")
    robot = yourdfpy.URDF.load(str(tmp_path / "scene.urdf"))
    assert robot.validate()
    assert robot.base_link == "world"
    assert {j.parent for j in robot.joint_map.values()} == {"world"}
    assert {j.child for j in robot.joint_map.values()} == {o.id for o in graph.objects}
    assert robot.num_actuated_joints == 0
    for item in graph.objects:
        T = robot.get_transform(item.id, "world")
        if item.shape.kind != "sphere":
            assert np.allclose(T, item.shape.T_world_object, atol=1e-6)
        assert np.allclose(T[:3, 3], item.centre_world, atol=1e-6)
        link = robot.link_map[item.id]
        solid = getattr(link.collisions[0].geometry, item.shape.kind)
        sizes = {"size": item.shape.extents} if item.shape.kind == "box" else item.shape.size
        for name, size in sizes.items():
            assert np.allclose(getattr(solid, name.replace("height", "length")), size)
        assert link.inertial.mass == pytest.approx(600.0 * item.shape.volume)
        moments = 600.0 * item.shape.mesh(720).moment_inertia
        assert np.allclose(link.inertial.inertia, moments, rtol=0.02, atol=1e-9)


# Viewers


@pytest.mark.parametrize("name", ["scene.glb", "scene.gltf"])
def test_gltf_has_a_coloured_node_for_each_object(tmp_path, graph, name):
    export_graph(graph, tmp_path / name)
    scene = trimesh.load(tmp_path / name)
    assert set(scene.geometry) == {o.id for o in graph.objects}
    for item in graph.objects:
        T_z_up_object, geometry = scene.graph.get(item.id, frame_from="z_up")
        mesh = scene.geometry[geometry]
        assert np.allclose(T_z_up_object, item.shape.T_world_object, atol=1e-6)
        assert np.allclose(mesh.extents, item.shape.extents, rtol=0.011)
        red, green, blue = mesh.visual.material.baseColorFactor[:3]
        assert f"#{red:02x}{green:02x}{blue:02x}" == object_colour(item.label)
        assert mesh.metadata["shape"] == item.shape.kind
        assert mesh.is_watertight
    x, y, z = graph["o15"].centre_world
    in_file = scene.graph.get("o15")[0][:3, 3]
    assert np.allclose(in_file, (x, z, -y), atol=1e-6), "viewers of glTF expect y up"


# Graphs


def test_graphml_is_the_graph(tmp_path, graph):
    export_graph(graph, tmp_path / "graph.graphml")
    read = nx.read_graphml(tmp_path / "graph.graphml")
    assert read.is_directed()
    assert set(read.nodes) == {o.id for o in graph.objects}
    assert set(read.edges) == {s.pair for s in graph.supports}
    for item in graph.objects:
        node = read.nodes[item.id]
        assert (node["role"], node["shape"], node["label"]) == (item.role, item.shape.kind, item.label)
        assert np.allclose([node["x"], node["y"], node["z"]], item.centre_world)
    assert read.nodes["o2"]["size"] == "0.04 0.12"
    assert read.edges["o1", "o2"] == {"kind": "lean", "certain": False, "occurrences": 1, "opportunities": 3}


def test_dot_is_the_graph(tmp_path, graph):
    export_graph(graph, tmp_path / "graph.dot")
    (read,) = pydot.graph_from_dot_file(str(tmp_path / "graph.dot"))
    edges = {(e.get_source().strip('"'), e.get_destination().strip('"')): e for e in read.get_edges()}
    assert set(edges) == {s.pair for s in graph.supports}
    assert edges["o1", "o2"].get("style") == '"dashed"'
    assert edges["o1", "o2"].get("label") == '"lean 0.50"'
    assert edges["o0", "o1"].get("style") == '"solid"'
    assert read.get_node('"o3"')[0].get("shape") == '"circle"'
    assert read.get_node('"o3"')[0].get("fillcolor") == f'"{object_colour(3)}"'


@pytest.mark.parametrize("name", ['say "hi" -> b; c', "back\\slash", "<b>&amp;</b>", "two\nlines Öl"])
def test_any_name_of_an_object_stays_one_name(tmp_path, graph, name):
    objects = tuple(replace(o, id=name) if o.id == "o15" else o for o in graph.objects)
    files = {ending: tmp_path / f"scene.{ending}" for ending in ("dot", "graphml", "urdf", "glb", "xml")}
    for path in files.values():
        export_graph(replace(graph, objects=objects), path)
    (read,) = pydot.graph_from_dot_file(str(files["dot"]))
    assert len([n for n in read.get_nodes() if n.get_name() != "node"]) == 5
    assert len(read.get_edges()) == 3
    assert name in nx.read_graphml(files["graphml"]).nodes
    assert len(yourdfpy.URDF.load(str(files["urdf"])).link_map) == 6
    assert len(trimesh.load(files["glb"]).geometry) == 5
    model = mujoco.MjModel.from_xml_path(str(files["xml"]))
    assert name in [model.body(k).name for k in range(model.nbody)]


# The command


@pytest.mark.parametrize("name", ["s.xml", "s.urdf", "s.glb", "s.gltf", "s.graphml", "s.gv"])
def test_the_name_says_the_format_and_the_same_model_gives_the_same_bytes(tmp_path, kept_run, name, capsys):
    contents = set()
    for _ in range(2):
        assert run_command("export", kept_run, "--out", tmp_path / name, "--json") == 0
        assert json.loads(capsys.readouterr().out)["file"] == str(tmp_path / name)
        contents.add((tmp_path / name).read_bytes())
    assert len(contents) == 1
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_a_graph_file_alone_can_be_exported_and_settings_count(tmp_path, graph):
    (tmp_path / "graph.json").write_text(graph_text(graph))
    heavy = ("--set", "export.density=1200")
    assert run_command("export", tmp_path / "graph.json", "--out", tmp_path / "s.urdf", *heavy) == 0
    robot = yourdfpy.URDF.load(str(tmp_path / "s.urdf"))
    assert robot.link_map["o3"].inertial.mass == pytest.approx(1200.0 * graph["o3"].shape.volume)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--out", "model.step"], "the suffix is not that of any format"),
        (["--format", "mjcf", "--out", "graph.json"], "the suffix is not that of mjcf"),
        (["--out", "folder.urdf"], "is a directory"),
    ],
)
def test_a_file_of_another_kind_is_never_overwritten(
    tmp_path, kept_run, monkeypatch, capsys, arguments, said
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "graph.json").write_text("mine")
    (tmp_path / "folder.urdf").mkdir()
    assert run_command("export", kept_run, *arguments) == 1
    told = capsys.readouterr().err
    assert said in told
    assert told.count("\n") == 1
    assert (tmp_path / "graph.json").read_text() == "mine"
    assert {p.name for p in tmp_path.iterdir()} == {"graph.json", "folder.urdf"}


def test_an_impossible_export_ends_in_one_line(tmp_path, graph, capsys):
    assert run_command("export", tmp_path / "no-run", "--out", tmp_path / "s.xml") == 1
    assert "no such folder" in capsys.readouterr().err
    assert run_command("export", tmp_path, "--format", "step", "--out", tmp_path / "s.step") == 2
    with pytest.raises(InputError, match="objects, more than export"):
        export_graph(graph, tmp_path / "a.dot", ExportConfig(max_objects=1))
    with pytest.raises(InputError, match="has no objects"):
        export_graph(SupportGraph(), tmp_path / "s.glb")
    named = replace(graph, objects=(replace(graph.objects[1], id="world"),), supports=())
    with pytest.raises(InputError, match="named 'world'"):
        export_graph(named, tmp_path / "s.urdf")
    twice = replace(graph, objects=(graph.objects[0], replace(graph.objects[1], id="table")), supports=())
    with pytest.raises(InputError, match="MuJoCo rejects it"):
        export_graph(twice, tmp_path / "s.xml")
    assert list(tmp_path.iterdir()) == []
