"""Scene models for other programs: each file is read by a program that knows it, and compared."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import mujoco
import numpy as np
import pydot
import pytest
import trimesh
import yourdfpy
from conftest import run_command
from scipy import ndimage
from scipy.spatial.transform import Rotation
from synthetic import model_of, shelf_graph, simulated_views

from caryatid.errors import InputError
from caryatid.exports import export_graph, planning_scene
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Sphere
from caryatid.geometry.solids import Polytope, Solid
from caryatid.graph import SceneObject, Support, SupportGraph
from caryatid.io import graph_text
from caryatid.sensing.voxel_map import UNKNOWN
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


@pytest.fixture
def with_solid(graph):
    """The same with a turned solid of two parts, o16, which rests on o1."""
    low, high = (Box(at(0.0, 0.0, z), np.array([0.2, side, 0.02])) for z, side in ((0.9, 0.1), (0.92, 0.04)))
    parts = [Polytope.around(box.outline()) for box in (low, high)]
    o16 = SceneObject("o16", 16, Solid.of(parts).moved(at(0.0, 0.0, 0.0, (0.0, 0.1, 0.5))))
    supports = (*graph.supports, Support("o1", "o16", probability=0.8))
    return replace(graph, objects=(*graph.objects, o16), supports=supports)


def same_shape(shape, corners):
    """Whether points (N, 3) [m] span a shape to a millimetre, of each of its parts."""
    outline = shape.outline()
    there = np.linalg.norm(outline[:, None] - np.asarray(corners), axis=2).min(axis=1).max()
    return there < 1e-3 and np.abs(shape.signed_distance(np.asarray(corners))).max() < 1e-3


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


@pytest.mark.parametrize("name", ["scene.xml", "scene.urdf", "scene.gltf", "scene.dot"])
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


def test_usd_has_the_shapes_bodies_and_colours_of_the_model(tmp_path, with_solid):
    pxr = pytest.importorskip("pxr", reason="usd-core is not installed")
    from pxr import Usd, UsdGeom, UsdPhysics, UsdShade

    export_graph(with_solid, tmp_path / "scene.usda")
    stage = pxr.Usd.Stage.Open(str(tmp_path / "scene.usda"))
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    boxes = UsdGeom.BBoxCache(Usd.TimeCode.Default(), [UsdGeom.Tokens.default_])
    for item in with_solid.objects:
        body = stage.GetPrimAtPath(f"/World/{item.id}")
        drawn = body.GetChildren()
        T = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(body)).T
        assert np.allclose(T, item.shape.T_world_object, atol=1e-6)
        assert [p.GetTypeName() for p in drawn] == {
            "box": ["Cube"], "cylinder": ["Cylinder"], "sphere": ["Sphere"], "solid": ["Mesh", "Mesh"],
        }[item.shape.kind]  # fmt: skip
        for prim, part in zip(drawn, item.shape.parts, strict=True):
            bound = boxes.ComputeRelativeBound(prim, body).ComputeAlignedRange()
            local = part.moved(transforms.invert(item.shape.T_world_object)).outline()
            assert np.allclose([*bound.GetMin()], local.min(axis=0), atol=1e-3)
            assert np.allclose([*bound.GetMax()], local.max(axis=0), atol=1e-3)
            assert prim.HasAPI(UsdPhysics.CollisionAPI)
            colour = 255.0 * np.array(UsdGeom.Gprim(prim).GetDisplayColorAttr().Get()[0])
            assert "#{:02x}{:02x}{:02x}".format(*np.rint(colour).astype(int)) == object_colour(item.label)
        assert body.HasAPI(UsdPhysics.RigidBodyAPI) == (item.role == "object")
        density = UsdPhysics.MassAPI(body).GetDensityAttr().Get() if item.role == "object" else None
        assert density == (600.0 if item.role == "object" else None)
        material, _ = UsdShade.MaterialBindingAPI(body).ComputeBoundMaterial("physics")
        friction = UsdPhysics.MaterialAPI(material.GetPrim()).GetDynamicFrictionAttr().Get()
        assert friction == pytest.approx(0.8)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/World/o16/part_1"))
    faces = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    assert trimesh.Trimesh(mesh.GetPointsAttr().Get(), faces).volume == pytest.approx(0.2 * 0.1 * 0.02)


# Motion and task planners

HEADER = {"frame_id": str}
POINT = dict.fromkeys("xyz", float)
POSE = {"position": POINT, "orientation": POINT | {"w": float}}
PLANNING_SCENE = {
    "is_diff": bool,
    "robot_state": {"is_diff": bool},
    "world": {
        "collision_objects": [
            {
                "header": HEADER,
                "id": str,
                "pose": POSE,
                "primitives": [{"type": int, "dimensions": [float]}],
                "primitive_poses": [POSE],
                "meshes": [{"triangles": [{"vertex_indices": [int]}], "vertices": [POINT]}],
                "mesh_poses": [POSE],
                "operation": int,
            }
        ]
    },
    "allowed_collision_matrix": {
        "entry_names": [str],
        "entry_values": [{"enabled": [bool]}],
        "default_entry_names": [str],
        "default_entry_values": [bool],
    },
}
"""Fields that the definitions of moveit_msgs/PlanningScene and the messages in it have."""


def check_message(value, definition):
    if isinstance(definition, dict):
        assert value.keys() <= definition.keys()
        for key, item in value.items():
            check_message(item, definition[key])
    elif isinstance(definition, list):
        for item in value:
            check_message(item, definition[0])
    else:
        assert type(value) is definition


def pose_of(message):
    turn = Rotation.from_quat([message["orientation"][axis] for axis in "xyzw"])
    return transforms.rigid(turn.as_matrix(), [message["position"][axis] for axis in "xyz"])


def test_a_planning_scene_has_the_shapes_of_the_model(tmp_path, with_solid):
    (tmp_path / "graph.json").write_text(graph_text(with_solid))
    words = ("--format", "moveit", "--out", tmp_path / "scene.json", "--set", "export.frame=base_link")
    assert run_command("export", tmp_path / "graph.json", *words) == 0
    scene = json.loads((tmp_path / "scene.json").read_text())
    check_message(scene, PLANNING_SCENE)
    assert scene["is_diff"]
    assert scene["robot_state"]["is_diff"], "or MoveIt detaches what the robot holds"
    objects = {o["id"]: o for o in scene["world"]["collision_objects"]}
    assert set(objects) == set(with_solid)
    for item in with_solid.objects:
        known = objects[item.id]
        assert known["header"]["frame_id"] == "base_link"
        assert known["operation"] == 0
        T = pose_of(known["pose"])
        if item.shape.kind == "solid":
            assert len(known["meshes"]) == len(known["mesh_poses"]) == 2
            for mesh, pose, part in zip(known["meshes"], known["mesh_poses"], item.shape.parts, strict=True):
                vertices = transforms.transform(
                    T @ pose_of(pose), [[v[a] for a in "xyz"] for v in mesh["vertices"]]
                )
                assert same_shape(part, vertices)
                faces = [t["vertex_indices"] for t in mesh["triangles"]]
                assert trimesh.Trimesh(vertices, faces).volume == pytest.approx(part.volume)
            continue
        (primitive,), (pose,) = known["primitives"], known["primitive_poses"]
        sizes = primitive["dimensions"]
        T = T @ pose_of(pose)
        match primitive["type"]:
            case 1:
                made = Box(T, np.array(sizes))
            case 2:
                made = Sphere(T, *sizes)
            case 3:
                made = Cylinder(T, radius=sizes[1], height=sizes[0])
        assert made.kind == item.shape.kind
        assert same_shape(item.shape, made.outline())


def test_unseen_space_is_one_object_of_boxes_beside_all_that_was_seen():
    scene = model_of(simulated_views("shelf")[:2])
    message = planning_scene(scene.graph, allowed={}, voxels=scene.voxels)
    check_message(message, PLANNING_SCENE)
    unseen = message["world"]["collision_objects"][-1]
    assert unseen["id"] == "unseen"
    voxels, places = scene.voxels, scene.voxels.centres_world(np.argwhere(scene.voxels.hits >= 0))
    covered = np.zeros(voxels.hits.shape, dtype=int)
    for primitive, pose in zip(unseen["primitives"], unseen["primitive_poses"], strict=True):
        away = np.abs(places - pose_of(pose)[:3, 3]) - np.array(primitive["dimensions"]) / 2.0
        covered += (away < 0.0).all(axis=1).reshape(covered.shape)
    assert covered.max() == 1, "boxes overlap"
    bodies = [o.shape for o in scene.graph.objects if o.role == "object"]
    beside = np.min([shape.signed_distance(places) for shape in bodies], axis=0) > voxels.config.size
    table, top = scene.graph["o0"].shape, max(shape.outline()[:, 2].max() for shape in bodies)
    over, height = np.split(
        transforms.transform(transforms.invert(table.T_world_object), places), [2], axis=1
    )
    among = (
        (np.abs(over) < table.extents[:2] / 2.0).all(axis=1) & (height[:, 0] > 0.03) & (places[:, 2] < top)
    )
    unknown = (voxels.states.ravel() == UNKNOWN) & beside & among
    assert unknown[covered.ravel() > 0].mean() > 0.7
    assert covered[ndimage.binary_erosion(unknown.reshape(covered.shape), np.ones((5, 5, 5)))].all()
    names, rows = (message["allowed_collision_matrix"][f"entry_{key}"] for key in ("names", "values"))
    assert all(rows[names.index("unseen")]["enabled"][names.index(o)] for o in scene.graph)


def test_what_supports_an_object_may_touch_it_and_the_robot_keeps_its_own_entries(graph):
    old = {
        "entry_names": ["link1", "link2", "o1", "o15"],
        "entry_values": [
            {"enabled": [False, True, False, False]},
            {"enabled": [True, False, True, False]},
            {"enabled": [False, True, False, True]},
            {"enabled": [False, False, True, False]},
        ],
        "default_entry_names": ["octomap"],
        "default_entry_values": [True],
    }
    assert "allowed_collision_matrix" not in planning_scene(graph)
    for given, kept in (({}, set()), (old, {("link1", "link2"), ("link2", "o1")})):
        matrix = planning_scene(graph, allowed=given)["allowed_collision_matrix"]
        check_message(matrix, PLANNING_SCENE["allowed_collision_matrix"])
        names = matrix["entry_names"]
        enabled = np.array([row["enabled"] for row in matrix["entry_values"]])
        assert enabled.shape == (len(names), len(names))
        assert np.array_equal(enabled, enabled.T)
        pairs = {(names[a], names[b]) for a, b in zip(*np.nonzero(enabled), strict=True)}
        allowed = {frozenset(pair) for pair in pairs}
        assert allowed == {frozenset(s.pair) for s in graph.supports} | set(map(frozenset, kept))
    assert matrix["default_entry_names"] == ["octomap"]


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
    files = {ending: tmp_path / f"scene.{ending}" for ending in ("dot", "urdf", "glb", "xml")}
    for path in files.values():
        export_graph(replace(graph, objects=objects), path)
    (read,) = pydot.graph_from_dot_file(str(files["dot"]))
    assert len([n for n in read.get_nodes() if n.get_name() != "node"]) == 5
    assert len(read.get_edges()) == 3
    assert len(yourdfpy.URDF.load(str(files["urdf"])).link_map) == 6
    assert len(trimesh.load(files["glb"]).geometry) == 5
    model = mujoco.MjModel.from_xml_path(str(files["xml"]))
    assert name in [model.body(k).name for k in range(model.nbody)]


# The command


@pytest.mark.parametrize(
    "name",
    [
        "s.xml",
        "s.urdf",
        "s.glb",
        "s.gltf",
        "s.gv",
        "s.usda",
        "s.json",
    ],
)
def test_the_name_says_the_format_and_the_same_model_gives_the_same_bytes(tmp_path, kept_run, name, capsys):
    pytest.importorskip({"s.usda": "pxr"}.get(name, "caryatid"))
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
        (["--format", "mjcf", "--out", "graph.json"], "the suffix is not that of mjcf; use .xml"),
        (["--format", "usd", "--out", "graph.json"], "use .usda, .usd"),
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


@pytest.mark.parametrize("name", ["graph.json", "run.json"])
def test_a_planning_scene_never_replaces_a_part_of_a_run(tmp_path, kept_run, capsys, name):
    run = shutil.copytree(kept_run, tmp_path / "run")
    before = (run / name).read_bytes()
    assert run_command("export", run, "--out", run / name) == 1
    assert "holds a scene model or run, which would be lost; give another file" in capsys.readouterr().err
    assert (run / name).read_bytes() == before
    for _ in range(2):
        assert run_command("export", run, "--out", run / "scene.json") == 0


def test_an_impossible_export_ends_in_one_line(tmp_path, graph, capsys):
    assert run_command("export", tmp_path / "no-run", "--out", tmp_path / "s.xml") == 1
    assert "no such folder" in capsys.readouterr().err
    assert run_command("export", tmp_path, "--format", "step", "--out", tmp_path / "s.step") == 2
    with pytest.raises(InputError, match="has no objects"):
        export_graph(SupportGraph(), tmp_path / "s.glb")
    named = replace(graph, objects=(replace(graph.objects[1], id="world"),), supports=())
    with pytest.raises(InputError, match="named 'world'"):
        export_graph(named, tmp_path / "s.urdf")
    twice = replace(graph, objects=(graph.objects[0], replace(graph.objects[1], id="table")), supports=())
    with pytest.raises(InputError, match="MuJoCo rejects it"):
        export_graph(twice, tmp_path / "s.xml")
    assert list(tmp_path.iterdir()) == []
