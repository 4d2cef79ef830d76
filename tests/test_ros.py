"""The ROS 2 package without ROS: messages of rosbags' types. `tests/ros` has the node on real ROS 2."""

from __future__ import annotations

import array
import ast
import re
import sys
import xml.etree.ElementTree as ET
from dataclasses import astuple, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from synthetic import (
    TABLE_TOP,
    box,
    cylinder,
    shelf_graph,
    sphere,
    table_object,
    thing,
)

from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.solids import Polytope, Solid
from caryatid.graph import Change, Grasp, Support, SupportGraph, TakeStep
from caryatid.manipulation.order import Order

ROS = Path(__file__).parents[1] / "ros"
CODE = ROS / "caryatid_ros/caryatid_ros"
sys.path.insert(0, str(CODE.parent))

from caryatid_ros import messages  # noqa: E402
from caryatid_ros.inbox import Inbox, seconds_of  # noqa: E402

INTERFACES = sorted(path for kind in ("msg", "srv", "action") for path in ROS.glob(f"caryatid_msgs/{kind}/*"))
PARTS = {".msg": ("",), ".srv": ("_Request", "_Response"), ".action": ("_Goal", "_Result", "_Feedback")}
STORE = get_typestore(Stores.ROS2_JAZZY)
for path in INTERFACES:
    for part, text in zip(PARTS[path.suffix], re.split(r"^---$", path.read_text(), flags=re.M), strict=True):
        STORE.register(get_types_from_msg(text, f"caryatid_msgs/msg/{path.stem}{part}"))

BASE, NAME, ARRAY = 1, 2, 3
KINDS = {"string": str, "bool": bool, "float32": float, "float64": float}


def make(name, /, **given):
    """A message as rosidl makes it: it refuses unknown fields and wrong types, and others have defaults."""
    package, _, *names = name.split("/")
    kind = STORE.types[f"{package}/msg/{'_'.join(names)}"]
    values = {"w": 1.0} if name == "geometry_msgs/msg/Quaternion" else {}
    for field, (node, detail) in STORE.fielddefs[kind.__msgtype__][1]:
        if node == NAME:
            values[field] = given.pop(field) if field in given else make(detail)
            assert values[field].__msgtype__ == detail, (name, field)
        elif node == BASE:
            type_ = KINDS.get(detail[0], int)
            values[field] = given.pop(field, values.get(field, type_()))
            assert type(values[field]) is type_, (name, field, values[field])
            if detail[0] == "float32":
                values[field] = float(np.float32(values[field]))
        else:
            plain = np.zeros(detail[1] if node == ARRAY else 0, getattr(np, str(detail[0][1][0]), object))
            values[field] = given.pop(field, plain if detail[0][0] == BASE else [])
    assert not given, f"{name} has no {', '.join(given)}"
    return kind(**values)


def packed(message):
    """The message as another node receives it."""
    kind = message.__msgtype__
    back = STORE.deserialize_cdr(STORE.serialize_cdr(message, kind), kind)
    assert repr(back) == repr(message)
    return back


def image(pixels, encoding, time=1.0, padding=0):
    """A raw image of an array (H, W[, C]), with its rows padded as drivers may do."""
    rows = np.pad(
        np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1), ((0, 0), (0, padding))
    )
    sizes = {"height": rows.shape[0], "width": pixels.shape[1], "step": rows.shape[1]}
    stamp = make("builtin_interfaces/msg/Time", sec=int(time), nanosec=round(1e9 * (time % 1.0)))
    header = make("std_msgs/msg/Header", stamp=stamp, frame_id="lens")
    return make("sensor_msgs/msg/Image", header=header, encoding=encoding, data=rows.ravel(), **sizes)


def camera_info(view):
    height, width = view.depth.shape
    return make("sensor_msgs/msg/CameraInfo", height=height, width=width, k=view.K.ravel())


def transform_message(T):
    pose = messages.pose_message(make, T)
    shift = make("geometry_msgs/msg/Vector3", x=pose.position.x, y=pose.position.y, z=pose.position.z)
    return make("geometry_msgs/msg/Transform", translation=shift, rotation=pose.orientation)


def test_a_graph_survives_the_way_to_another_node():
    blocks = [box((x, 0.3, 0.8), (0.1, 0.1 + x, 0.1)) for x in (0.0, 0.1)]
    solid = Solid.of([Polytope.around(block.outline()) for block in blocks])
    objects = [
        table_object(),
        thing(1, box((0.1, 0.2, 0.8), (0.1, 0.2, 0.1), 30.0), probability=0.75, doubt="leans"),
        thing(2, cylinder((0.1, 0.2, 0.9), 0.03, 0.1)),
        thing(3, sphere((0.3, 0.2, 0.8), 0.05)),
        thing(4, solid),
    ]
    supports = (
        Support("o0", "o1", probability=0.9, contact_world=np.array([0.1, 0.2, TABLE_TOP]), why="it touches"),
        Support("o1", "o2", "lean", certain=False, occurrences=2, opportunities=3),
    )
    graph, header = SupportGraph(tuple(objects), supports), image(np.zeros((1, 1)), "mono8").header
    slid = Change("moved", "o2", 3, "view 3 sees through it")
    told = packed(messages.graph_message(make, graph, [slid], header))
    assert [(c.kind, c.object, c.view, c.why) for c in told.changes] == [astuple(slid)]
    assert [(o.id, o.shape, o.doubt) for o in told.objects[1:3]] == [
        ("o1", "box", "leans"),
        ("o2", "cylinder", ""),
    ]
    np.testing.assert_allclose(vars(told.objects[2].extents)["z"], 0.1)
    assert told.objects[1].probability == 0.75
    assert np.isnan(told.objects[2].probability)
    back = messages.matrix_of(told.objects[1].pose.orientation, told.objects[1].pose.position, "pose")
    np.testing.assert_allclose(back, objects[1].shape.T_world_object, atol=1e-12)
    assert [(s.supporter, s.supported, s.kind, s.probability) for s in told.supports] == [
        ("o0", "o1", "bottom-up", 0.9), ("o1", "o2", "lean", 0.5)
    ]  # fmt: skip
    assert told.supports[0].contact.z == TABLE_TOP
    assert np.isnan(told.supports[1].contact.x)
    drawn = packed(messages.markers_message(make, graph, header)).markers
    shapes = [m.type for m in drawn if m.ns == "shapes"]
    assert shapes == [messages.CUBE, messages.CUBE, messages.CYLINDER, messages.SPHERE, messages.TRIANGLES]
    assert [m.text for m in drawn if m.ns == "ids"] == ["o0", "o1", "o2", "o3", "o4"]
    sure, unsure = (m for m in drawn if m.ns == "supports")
    assert sure.scale.x > unsure.scale.x > 0.0
    assert [round(sure.points[n].z - TABLE_TOP, 3) for n in (0, 1)] == [-0.02, 0.05]
    assert drawn[0].action == messages.DELETE_ALL
    constants = {name: value for name, _, value in STORE.fielddefs["visualization_msgs/msg/Marker"][0]}
    names = ["CUBE", "SPHERE", "CYLINDER", "ARROW", "TEXT_VIEW_FACING", "TRIANGLE_LIST", "DELETEALL"]
    ours = ["CUBE", "SPHERE", "CYLINDER", "ARROW", "TEXT", "TRIANGLES", "DELETE_ALL"]
    assert [getattr(messages, name) for name in ours] == [constants[name] for name in names]


def test_every_support_surface_is_told_and_drawn():
    header = image(np.zeros((1, 1)), "mono8").header
    told = packed(messages.graph_message(make, shelf_graph(), [], header))
    surfaces = [(o.id, o.label) for o in told.objects if o.role == "support_surface"]
    assert surfaces == [("o0", 65535), ("s1", 65534), ("s2", 65533)]
    drawn = packed(messages.markers_message(make, shelf_graph(), header)).markers
    assert [m.text for m in drawn if m.ns == "ids"] == list(shelf_graph())
    (up,) = (m for m in drawn if m.ns == "supports" and m.points[1].z == 0.89)
    assert [(p.x, p.y, p.z) for p in up.points] == [(0.0, 0.3, 0.83), (0.0, 0.3, 0.89)]


def test_a_lift_says_how_the_gripper_takes_hold():
    T = transforms.rigid(np.diag([1.0, -1.0, -1.0]), (0.1, 0.2, 0.9))
    step = TakeStep("o1", ("o2",), True, 0.01, "it is free", Grasp(T, 0.06, 0.1))
    (lift,) = map(packed, messages.lift_messages(make, Order((step,))))
    (grasp,) = lift.grasp
    np.testing.assert_allclose(messages.matrix_of(grasp.pose.orientation, grasp.pose.position, ""), T)
    assert (lift.object, lift.hold, grasp.width, grasp.travel) == ("o1", ["o2"], 0.06, 0.1)
    assert np.isnan(grasp.seen_free)


def test_images_become_a_view(views):
    view = views[0]
    millimetres = np.round(1e3 * view.depth).astype("<u2")
    depth, colour = image(millimetres, "16UC1", 12.5, padding=6), image(view.rgb[..., ::-1], "bgr8")
    depth.data = array.array("B", depth.data.tobytes())  # as rclpy has it
    taken = messages.view_of(depth, camera_info(view), colour, view.pose)
    np.testing.assert_allclose(taken.depth, view.depth, atol=6e-4)
    np.testing.assert_array_equal(taken.rgb, view.rgb)
    np.testing.assert_array_equal(taken.K, view.K)
    assert taken.name == "12.500"
    assert messages.view_of(depth, camera_info(view), None, view.pose).rgb is None
    with pytest.raises(InputError, match="camera info: is for 80 × 60 pixels, the depth image has 160 × 120"):
        messages.view_of(depth, replace(camera_info(view), height=60, width=80), None, view.pose)
    with pytest.raises(InputError, match="depth image: its encoding 'bgr8' is not supported"):
        messages.view_of(colour, camera_info(view), None, view.pose)
    zero = make("geometry_msgs/msg/Quaternion", w=0.0)
    with pytest.raises(InputError, match="pose: has no rotation"):
        messages.matrix_of(zero, make("geometry_msgs/msg/Point"), "pose")


def test_the_camera_info_must_be_that_of_a_pinhole(views):
    view, info = views[0], camera_info(views[0])
    depth = image(view.depth, "32FC1")

    def taken(rectified=False, **changed):
        return messages.view_of(depth, replace(info, **changed), None, view.pose, rectified=rectified).K

    P = np.column_stack([view.K * [[1.1], [1.1], [1.0]], np.zeros(3)])
    np.testing.assert_array_equal(taken(), view.K)
    np.testing.assert_array_equal(taken(p=P.ravel()), P[:, :3])
    np.testing.assert_array_equal(taken(True, p=P.ravel(), d=np.full(5, 0.1)), P[:, :3])
    whole = make("sensor_msgs/msg/RegionOfInterest", width=info.width, height=info.height)
    np.testing.assert_array_equal(taken(roi=whole, binning_x=1, binning_y=1), view.K)
    part = make("sensor_msgs/msg/RegionOfInterest", width=80, height=60)
    for wrong, said in (({"d": np.full(5, 0.1)}, "distortion"), ({"binning_x": 2}, "binning 2 × 0"),
                        ({"roi": part}, "region of interest, 80 × 60")):  # fmt: skip
        with pytest.raises(InputError, match=f"camera info: has (a )?{said}"):
            taken(**wrong)


@pytest.mark.parametrize(
    ("encoding", "kind"), [("mono8", "u1"), ("16UC1", "<u2"), ("32SC1", "<i4"), ("mono16", ">u2")]
)
def test_label_images_are_masks(views, encoding, kind):
    message = image(views[0].labels.astype(kind), encoding, padding=4)
    message.is_bigendian = int(kind[0] == ">")
    masked = messages.with_masks(replace(views[0], labels=None), message, {})
    np.testing.assert_array_equal(masked.labels, views[0].labels)
    assert masked.labels_are == "segments"
    with pytest.raises(InputError, match="masks: have the encoding 'rgb8'"):
        messages.with_masks(views[0], image(views[0].rgb, "rgb8"), {})
    message.data = bytes(message.data)[:-64]
    with pytest.raises(InputError, match=r"masks: have \d+ pixels instead of"):
        messages.with_masks(views[0], message, {})


def test_boxes_are_masks_of_what_they_hold_in_either_frame(views):
    view, middle = replace(views[0], labels=None), np.array([0.0, 0.0, 0.7])
    to_camera = transforms.invert(view.pose)
    frames = {"map": np.eye(4), "lens": view.pose}
    masked = {}
    for frame, T in (("map", np.eye(4)), ("lens", to_camera)):
        detections = []
        for name, (x, y, z) in {"near": (0.0, 0.0, 0.0), "far": (0.3, 0.0, 0.0)}.items():
            pose = messages.pose_message(make, T @ transforms.rigid(np.eye(3), np.array([x, y, z]) + middle))
            size = make("geometry_msgs/msg/Vector3", x=0.2, y=0.2, z=0.2)
            results = [SimpleNamespace(hypothesis=SimpleNamespace(class_id=name))] if name == "near" else []
            bbox = SimpleNamespace(center=pose, size=size)
            detections.append(SimpleNamespace(results=results, bbox=bbox))
        header = SimpleNamespace(frame_id=frame)
        boxes = SimpleNamespace(header=header, detections=detections)
        masked[frame] = messages.with_masks(view, boxes, frames)
    np.testing.assert_array_equal(masked["map"].labels, masked["lens"].labels)
    assert masked["map"].names == {1: "near"}
    points = transforms.transform(view.pose, view.points_camera) - middle
    inside = view.valid & (np.abs(points) <= 0.1 + messages.BOX_MARGIN).all(axis=-1)
    np.testing.assert_array_equal(masked["map"].labels == 1, inside)
    size.x = float("nan")
    with pytest.raises(InputError, match=r"masks: have a box of nan × 0\.2 × 0\.2 m"):
        messages.with_masks(view, boxes, frames)
    header = SimpleNamespace(frame_id="odom")
    with pytest.raises(InputError, match="masks: have the frame 'odom'; publish them in map or lens"):
        messages.with_masks(view, SimpleNamespace(header=header, detections=[]), frames)


TOPICS = {"depth": "/depth", "info": "/info", "colour": "/colour"}


def arrived(depths, colours, **frames):
    """An inbox in which images of these times arrived, after a camera info."""
    inbox = Inbox(TOPICS)
    inbox.put("info", make("sensor_msgs/msg/CameraInfo"))
    for what, times in (("depth", depths), ("colour", colours)):
        for time in times:
            message = image(np.zeros((1, 1)), "mono8", time)
            message.header.frame_id = frames.get(what, "lens")
            inbox.put(what, message)
    return inbox


def test_images_are_matched_by_their_stamps():
    inbox = arrived([1.0, 2.0, 3.0, 4.0], [1.99, 0.5, 3.01])
    found = [[seconds_of(m.header.stamp) for m in (d, o["colour"])] for d, _, o in inbox.views(1.5, 0.02)]
    np.testing.assert_allclose(found, [[3.0, 3.01], [2.0, 1.99]])


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (([], [1.0]), "/depth: no message arrived, but 1 on /info, 1 on /colour"),
        (([1.0], []), "/colour: no message arrived, but 1 on /depth, 1 on /info"),
        (([0.5], [0.5]), "/depth: its newest image is 0.500 s older than the goal"),
        (([1.0, 2.0], [1.3, 1.5]), "/depth: stamps of depth and colour images differ by 0.300 s or more"),
    ],
)
def test_the_inbox_says_why_there_is_no_view(given, said):
    with pytest.raises(InputError, match=re.escape(said)):
        list(arrived(*given).views(1.0, 0.02))


def test_depth_that_is_not_registered_to_colour_is_refused():
    with pytest.raises(InputError, match="colour image: has frame 'eye', the depth image has 'lens'"):
        list(arrived([1.0], [1.0], colour="eye").views(0.0, 0.02))


# The packages


def imports(path):
    """Top-level names of the modules that a file imports."""
    nodes = list(ast.walk(ast.parse(path.read_text())))
    found = {alias.name for n in nodes if isinstance(n, ast.Import) for alias in n.names}
    found |= {str(n.module) for n in nodes if isinstance(n, ast.ImportFrom)}
    return {name.partition(".")[0] for name in found}


def test_the_packages_name_what_they_need():
    needs = {}
    for name in ("caryatid_msgs", "caryatid_ros"):
        package = ET.parse(ROS / name / "package.xml").getroot()
        assert package.findtext("name") == name
        needs[name] = {e.text for e in package if e.tag.endswith("depend")}
    ours = {path.stem: imports(path) for path in CODE.glob("*.py")}
    used = set().union(*ours.values(), *map(imports, CODE.parent.glob("launch/*.py")))
    known = {*sys.stdlib_module_names, "caryatid", "caryatid_ros", "numpy", "scipy", "launch"}
    code = "".join(path.read_text() for path in CODE.glob("*.py"))
    made = set(re.findall(r'"(\w+)/(?:msg|srv|action)/\w+', code))
    assert (used | made) - known <= needs["caryatid_ros"]
    assert not {"rclpy", "py_trees"} & (ours["messages"] | ours["inbox"]), "which other nodes use"
    listed = (ROS / "caryatid_msgs/CMakeLists.txt").read_text()
    assert all(f'"{path.parent.name}/{path.name}"' in listed for path in INTERFACES)
    params = (CODE.parent / "launch/params.yaml").read_text()
    listed_params = dict(re.findall(r"^    (\w+): (.*?) +#", params, re.M))
    tree = ast.parse((CODE / "parameters.py").read_text())
    declared = {
        n.target.id: n.value.args[0].value
        for n in ast.walk(tree)
        if isinstance(n, ast.AnnAssign) and isinstance(n.target, ast.Name) and isinstance(n.value, ast.Call)
    }
    assert {name: yaml.safe_load(text) for name, text in listed_params.items()} == declared
    fields = [line for p in INTERFACES for line in p.read_text().splitlines() if line and line[0] not in "#-"]
    assert all(" # " in line for line in fields), "every field says what it is, and its unit"
    others = {match[1] for line in fields if (match := re.match(r"(\w+)/", line))} - {"caryatid_msgs"}
    assert others <= needs["caryatid_msgs"]
    assert all(f"find_package({other} REQUIRED)" in listed for other in others)
