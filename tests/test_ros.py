"""The ROS 2 package without ROS: messages of rosbags' types, a simulated robot, stand-ins for rclpy."""

from __future__ import annotations

import array
import ast
import importlib
import re
import sys
import xml.etree.ElementTree as ET
from dataclasses import astuple, replace
from dataclasses import fields as dataclass_fields
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from synthetic import (
    FEW_VIEWS,
    TABLE_TOP,
    box,
    cylinder,
    shelf_graph,
    simulated_scene,
    sphere,
    table_object,
    thing,
)

from caryatid.config.settings import write_settings
from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.solids import Polytope, Solid
from caryatid.graph import Change, Grasp, Support, SupportGraph, TakeStep
from caryatid.manipulation.order import Order, plan_order
from caryatid.simulation.setup import make_simulation

ROS = Path(__file__).parents[1] / "ros"
CODE = ROS / "caryatid_ros/caryatid_ros"
sys.path.insert(0, str(CODE.parent))

from caryatid_ros import messages  # noqa: E402
from caryatid_ros.exploration import Connection, Exploration, Settings  # noqa: E402

INTERFACES = sorted(path for kind in ("msg", "srv", "action") for path in ROS.glob(f"caryatid_msgs/{kind}/*"))
PARTS = {".msg": ("",), ".srv": ("_Request", "_Response"), ".action": ("_Goal", "_Result", "_Feedback")}
STORE = get_typestore(Stores.ROS2_JAZZY)
for path in INTERFACES:
    for part, text in zip(PARTS[path.suffix], re.split(r"^---$", path.read_text(), flags=re.M), strict=True):
        STORE.register(get_types_from_msg(text, f"caryatid_msgs/msg/{path.stem}{part}"))

BASE, NAME, ARRAY = 1, 2, 3
KINDS = {"string": str, "bool": bool, "float32": float, "float64": float}


def make(name, **given):
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


class Bench:
    """A robot whose camera takes views, seen through the calls that the logic makes of a node."""

    def __init__(self, folder, capture, T_world_camera=None, config=FEW_VIEWS):
        self.capture, self.T_world_camera, self.time = capture, T_world_camera, 100.0
        self.seen, self.poses, self.published, self.frame = [], [], [], "map"
        (folder / "settings.toml").write_text(write_settings(config))
        self.masks = folder / "masks"
        self.masks.mkdir()
        files = {"config": str(folder / "settings.toml"), "masks": str(self.masks)}
        settings = Settings(**files, seed=3, move_timeout=2.0)
        names = ("images", "lookup", "publish", "now", "sleep")
        self.logic = Exploration(settings, Connection(**{n: getattr(self, n) for n in names}, make=make))

    def images(self):
        view = self.capture(self.T_world_camera)
        self.time += 1.0
        np.save(self.masks / f"{self.time:.3f}.npy", view.labels)
        self.seen.append((image(view.depth, "32FC1", self.time), camera_info(view), image(view.rgb, "rgb8")))
        return self.seen[-1]

    def lookup(self, target, source, stamp):
        if (target, source) != (self.frame, "lens"):
            raise LookupError("no such frame")
        found = transform_message(self.T_world_camera)
        if stamp is not None:
            self.poses.append(messages.matrix_of(found.rotation, found.translation, "view"))
        return make("geometry_msgs/msg/TransformStamped", transform=found)

    def publish(self, name, message):
        self.published.append((name, packed(message)))

    def now(self):
        return self.time

    def sleep(self, seconds):
        self.time += seconds


class Handle:
    """A goal handle; its client moves the camera to each next view, but refuses the first few."""

    def __init__(self, bench, moves=True, refuses=0, cancel_at=None, **goal):
        self.request = make("caryatid_msgs/action/Explore/Goal", **goal)
        self.bench, self.moves, self.refuses = bench, moves, refuses
        self.cancel_at, self.feedback, self.ended = cancel_at, [], []
        self.succeed, self.abort, self.canceled = (
            lambda end=end: self.ended.append(end) for end in ("succeeded", "aborted", "canceled")
        )

    @property
    def is_cancel_requested(self):
        return self.cancel_at == len(self.feedback)

    def publish_feedback(self, message):
        self.feedback.append(packed(message))
        pose = message.decision.camera.pose
        if len(self.feedback) <= self.refuses:
            told = self.bench.logic.refused(make("caryatid_msgs/srv/Refused/Request", reason="no path"))
            assert packed(told).success
        elif self.moves:
            T = messages.matrix_of(pose.orientation, pose.position, "camera")
            self.bench.T_world_camera = T

    def run(self):
        result = packed(self.bench.logic.explore(self))
        return *self.ended, result


def simulated(folder):
    """A bench of a simulated robot."""
    simulation = make_simulation(simulated_scene("tower"), FEW_VIEWS, noise="none", seed=0)
    return Bench(folder, simulation.camera.capture, simulation.robot.T_world_camera)


@pytest.fixture(scope="module")
def explored(tmp_path_factory):
    """A bench after a goal of three views, with handle and result."""
    bench = simulated(tmp_path_factory.mktemp("ros"))
    handle = Handle(bench, max_views=3)
    end, result = handle.run()
    assert (end, result.message, result.views) == ("succeeded", "maximum of 3 views reached", 3)
    return bench, handle, result


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
        messages.view_of(depth, SimpleNamespace(height=60, width=80), None, view.pose)
    with pytest.raises(InputError, match="depth image: its encoding 'bgr8' is not supported"):
        messages.view_of(colour, camera_info(view), None, view.pose)
    zero = make("geometry_msgs/msg/Quaternion", w=0.0)
    with pytest.raises(InputError, match="pose: has no rotation"):
        messages.matrix_of(zero, make("geometry_msgs/msg/Point"), "pose")


def test_explore_tells_each_next_view_and_publishes_each_graph(explored):
    bench, handle, result = explored
    assert len(handle.feedback) == 2
    for message, T_world_camera in zip(handle.feedback, bench.poses[1:], strict=True):
        pose = message.decision.camera.pose
        np.testing.assert_allclose(
            messages.matrix_of(pose.orientation, pose.position, ""), T_world_camera, atol=1e-12
        )
    assert np.linalg.norm(np.diff(bench.poses, axis=0)[:, :3, 3], axis=1).min() > 0.3
    assert len(result.graph.objects) == 6
    assert len(result.graph.supports) == 5
    names = [name for name, _ in bench.published]
    assert names == ["support_graph", "markers", "decision"] * 2 + ["support_graph", "markers"]
    assert repr(bench.published[-2][1]) == repr(result.graph)
    assert result.graph.header.frame_id == handle.feedback[0].decision.camera.header.frame_id == "map"


def test_order_and_removed_do_what_the_library_does(explored):
    bench, _, _ = explored
    scene = bench.logic._explorer.scene.copy()
    wanted = plan_order(scene.graph, FEW_VIEWS, steps=1, hands=1, seed=3)
    told = packed(bench.logic.order(make("caryatid_msgs/srv/Order/Request", steps=1, hands=1)))
    assert (told.success, told.safe) == (True, wanted.safe)
    assert [(s.object, s.risk, s.why) for s in told.lifts] == [
        (s.object_id, s.risk, s.why) for s in wanted.steps
    ]
    assert told.lifts[0].grasp == []
    first = wanted.steps[0].object_id
    told = packed(bench.logic.removed(make("caryatid_msgs/srv/Removed/Request", object=first)))
    assert [o.id for o in told.graph.objects] == [o.id for o in scene.removed(first).objects]
    assert [(c.kind, c.object) for c in told.graph.changes] == [("removed", first)]
    end, result = Handle(bench, max_views=1, goal="o99").run()
    assert (end, result.message) == ("succeeded", "maximum of 1 views reached; o99 was not found")
    assert bench.logic._explorer.scene.views == 4, "goals continue the scene"
    Handle(bench, max_views=1, restart=True).run()
    assert bench.logic._explorer.scene.views == 1


@pytest.fixture
def bench(tmp_path):
    return simulated(tmp_path)


def test_a_cancelled_goal_stops_before_the_next_view(bench):
    end, result = Handle(bench, moves=False, cancel_at=1).run()
    assert (end, result.message, result.views, len(bench.seen)) == ("canceled", "cancelled", 1, 1)
    assert len(result.graph.objects) > 1


def test_a_view_that_the_motion_planner_refuses_is_replaced_by_another(bench):
    handle = Handle(bench, refuses=2, max_views=2)
    end, result = handle.run()
    assert (end, result.message, len(handle.feedback)) == ("succeeded", "maximum of 2 views reached", 3)
    assert len({repr(message.decision.camera.pose) for message in handle.feedback}) == 3
    end, result = Handle(bench, refuses=99, max_views=2).run()
    assert (end, result.message) == ("succeeded", "the robot refused 20 views in a row: no path")
    told = packed(bench.logic.refused(make("caryatid_msgs/srv/Refused/Request")))
    assert (told.success, told.message) == (False, "no next view is awaited")


def test_what_goes_wrong_ends_in_one_sentence(bench):
    reply = packed(bench.logic.order(make("caryatid_msgs/srv/Order/Request")))
    assert (reply.success, reply.message) == (False, "scene: has no views; send a goal to explore first")
    bench.frame = "odom"
    said = ended_in(bench)
    assert said.startswith("transform map ← lens: is unknown at 101.000 s (no such frame); publish it in tf")
    bench.frame, images = "map", bench.images
    bench.logic._ros = replace(bench.logic._ros, images=lambda: (images()[2], *images()[1:]))
    bench.time = 0.0
    assert ended_in(bench).startswith("depth image: its encoding 'rgb8' is not supported; ")
    bench.logic._ros = replace(bench.logic._ros, images=lambda: None)
    assert "no image in 5 s: none arrived; check the topics" in ended_in(bench)
    bench.logic._ros = replace(bench.logic._ros, images=lambda: images())
    said = ended_in(bench, moves=False)
    assert re.fullmatch(r"camera: is \d\.\d\d m and .* after 2 s; move it there, .*", said)
    assert ended_in(bench, until=0.4).startswith("until: 0.4 is not above 0.5")
    bench.logic._goal_lock.acquire()
    assert ended_in(bench) == "explore: another goal is running; cancel it, or wait for its result"


def ended_in(bench, **goal):
    end, result = Handle(bench, **goal).run()
    assert end == "aborted"
    assert "\n" not in result.message
    return result.message


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
    for library, home in (("rclpy", "node"), ("tf2_ros", "node"), ("py_trees", "leaves")):
        assert [name for name, found in ours.items() if library in found] == [home]
    listed = (ROS / "caryatid_msgs/CMakeLists.txt").read_text()
    assert all(f'"{path.parent.name}/{path.name}"' in listed for path in INTERFACES)
    params = (CODE.parent / "launch/params.yaml").read_text()
    listed_params = dict(re.findall(r"^    (\w+): \"?(.*?)\"? +#", params, re.M))
    assert listed_params == {f.name: str(f.default) for f in dataclass_fields(Settings)}
    fields = [line for p in INTERFACES for line in p.read_text().splitlines() if line and line[0] not in "#-"]
    assert all(" # " in line for line in fields), "every field says what it is, and its unit"
    others = {match[1] for line in fields if (match := re.match(r"(\w+)/", line))} - {"caryatid_msgs"}
    assert others <= needs["caryatid_msgs"]
    assert all(f"find_package({other} REQUIRED)" in listed for other in others)


class Answer:
    """A future of rclpy."""

    def __init__(self, value=None):
        self.value = value

    def done(self):
        return self.value is not None

    def result(self):
        return self.value

    def add_done_callback(self, call):
        call(self)


@pytest.fixture
def leaves(monkeypatch):
    """The leaves, with py_trees or a stand-in for what they use of it."""
    if importlib.util.find_spec("py_trees") is None:
        status = SimpleNamespace(RUNNING="RUNNING", SUCCESS="SUCCESS", FAILURE="FAILURE", INVALID="INVALID")

        class Behaviour:
            def __init__(self, name):
                self.name, self.status, self.feedback_message = name, status.INVALID, ""

            def tick_once(self):
                if self.status != status.RUNNING:
                    self.initialise()
                self.status = self.update()

            def stop(self, new_status):
                self.terminate(new_status)
                self.status = new_status

        Behaviour.terminate = lambda self, new_status: None
        parts = {"": {}, ".behaviour": {"Behaviour": Behaviour}, ".common": {"Status": status}}
        for name, holds in parts.items():
            monkeypatch.setitem(sys.modules, f"py_trees{name}", SimpleNamespace(**holds))
    yield importlib.import_module("caryatid_ros.leaves")
    del sys.modules["caryatid_ros.leaves"]


def test_a_leaf_for_each_verb(leaves):
    status, went, client = leaves.Status, [], MagicMock()
    leaf = leaves.Explore(client, went.append, make=make, max_views=4)
    sent, answer = Answer(), Answer()
    client.send_goal_async.return_value = sent
    leaf.tick_once()
    assert leaf.status == status.RUNNING
    assert client.send_goal_async.call_args.args[0].max_views == 4
    sent.value = MagicMock(accepted=True, get_result_async=lambda: answer)
    leaf.tick_once()
    feedback = make("caryatid_msgs/action/Explore/Feedback")
    client.send_goal_async.call_args.kwargs["feedback_callback"](SimpleNamespace(feedback=feedback))
    assert went == [feedback.decision]
    result = make("caryatid_msgs/action/Explore/Result", message="no further view is worth its path")
    for code, wanted in ((4, status.SUCCESS), (6, status.FAILURE)):
        answer.value = SimpleNamespace(status=code, result=result)
        leaf.tick_once()
        assert (leaf.status, leaf.feedback_message, leaf.result) == (wanted, result.message, result)
    answer.value = None
    leaf.tick_once()
    leaf.stop(status.INVALID)
    sent.value.cancel_goal_async.assert_called_once()

    lift = make("caryatid_msgs/msg/Lift", object="o4")
    order = leaves.order(client, make=make, hands=1)
    client.call_async.return_value = sent = Answer()
    order.tick_once()
    assert (order.status, client.call_async.call_args.args[0].hands) == (status.RUNNING, 1)
    for safe, wanted in ((False, status.FAILURE), (True, status.SUCCESS)):
        sent.value = make("caryatid_msgs/srv/Order/Response", success=True, safe=safe, lifts=[lift])
        order.tick_once()
        assert order.status == wanted
    removed = leaves.removed(client, lambda: order.response.lifts[0].object, make=make)
    sent.value = make("caryatid_msgs/srv/Removed/Response", success=True)
    removed.tick_once()
    assert (removed.status, client.call_async.call_args.args[0].object) == (status.SUCCESS, "o4")


def test_the_node_connects_its_topics(monkeypatch):
    class Node:
        declared, create_publisher, create_service = {}, MagicMock(), MagicMock()
        get_clock = MagicMock()

        def __init__(self, name):
            assert name == "caryatid"

        def declare_parameter(self, name, value):
            return SimpleNamespace(value=self.declared.setdefault(name, value))

    class LostError(Exception):
        pass

    needed = [name for name in imports(CODE / "node.py") if name not in sys.stdlib_module_names]
    for name in {*needed} - {"caryatid", "caryatid_ros"}:
        for module in (name, *(f"{name}.{part}" for part in ("msg", "srv", "action", "node", "qos", "time",
                               "callback_groups", "duration", "executors"))):  # fmt: skip
            monkeypatch.setitem(sys.modules, module, MagicMock())
    sys.modules["rclpy.node"].Node, sys.modules["tf2_ros"].TransformException = Node, LostError
    monkeypatch.delitem(sys.modules, "caryatid_ros.node", raising=False)
    node = importlib.import_module("caryatid_ros.node").ExplorationNode()
    monkeypatch.delitem(sys.modules, "caryatid_ros.node")
    assert Node.declared == {name: getattr(Settings(), name) for name in Settings.__dataclass_fields__}
    filters = sys.modules["message_filters"]
    topics = [call.args[2] for call in filters.Subscriber.call_args_list]
    assert topics == [node.settings.depth_topic, node.settings.info_topic, node.settings.colour_topic]
    (take,) = filters.ApproximateTimeSynchronizer.return_value.registerCallback.call_args.args
    take("depth", "info", "colour")
    assert node.logic._ros.images() == ("depth", "info", "colour")
    assert [call.args[1] for call in Node.create_publisher.call_args_list] == [
        "support_graph",
        "markers",
        "decision",
    ]
    assert [call.args[1] for call in Node.create_service.call_args_list] == ["order", "removed", "refused"]
    assert sys.modules["rclpy.action"].ActionServer.call_args.args[2:] == ("explore", node.logic.explore)
    sys.modules["tf2_ros"].Buffer.return_value.lookup_transform.side_effect = LostError("two trees")
    with pytest.raises(LookupError, match="two trees"):
        node.logic._ros.lookup("map", "lens", None)
