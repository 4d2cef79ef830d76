"""The client of MoveIt, `examples/franka_moveit.py`, on real ROS 2 with a stand-in for MoveIt."""

from __future__ import annotations

import time

import numpy as np
import pytest
from conftest import EXAMPLES, Process, wait_for
from control_msgs.action import GripperCommand, ParallelGripperCommand
from planner import Arm
from rclpy.qos import qos_profile_sensor_data
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo

from caryatid.benchmark.episodes import open_scene
from caryatid.config import GRIPPERS, Config
from caryatid.geometry.shapes import KINDS
from caryatid.geometry.transforms import invert, rigid, transform
from caryatid.simulation.setup import make_simulation
from caryatid_ros.messages import matrix_of

EXAMPLE = EXAMPLES / "franka_moveit.py"
T_MAP_BASE = rigid(Rotation.from_euler("z", 0.5).as_matrix(), (-0.6, 0.1, 0.0))
T_HAND_CAMERA = rigid(Rotation.from_euler("zyx", (0.8, 0.1, -0.2)).as_matrix(), (0.05, -0.03, 0.02))
T_HAND_TCP = rigid(np.eye(3), (0.0, 0.0, 0.1034))
TABLE_HEIGHT = 0.75
DROP = transform(invert(T_MAP_BASE), np.array([0.05, -0.3, TABLE_HEIGHT + 0.003]))


@pytest.fixture(params=[GripperCommand], ids=lambda kind: kind.__name__)
def arm(client, request):
    """An arm that holds the camera of the table where it is first."""
    scene, _ = open_scene("tower")
    first = make_simulation(scene, Config(), noise="none", seed=0).robot.T_world_camera
    T_base_hand = invert(T_MAP_BASE) @ first @ invert(T_HAND_CAMERA)
    found = Arm(client, T_MAP_BASE, T_base_hand, T_HAND_CAMERA, request.param)
    client.set_table(carried=True, frame="camera_color_optical_frame", follow=False)
    yield found
    client.run(found.destroy)


def shape_of(graph, name):
    """The shape of an object in a message."""
    o = next(o for o in graph.objects if o.id == name)
    T, size = matrix_of(o.pose.orientation, o.pose.position, name), o.extents
    return KINDS[o.shape].from_extents(T, np.array([size.x, size.y, size.z]))


def bottom_of(shape):
    return shape.T_world_object[2, 3] - shape.support(np.array([[0.0, 0.0, -1.0]]))[0]


@pytest.mark.parametrize("arm", [GripperCommand, ParallelGripperCommand], indirect=True)
def test_the_client_looks_through_moveit_and_puts_an_object_down(start_ready, client, arm):
    start_ready(world_frame="panda_link0", planning_scene="/planning_scene")
    arm.refused = 0, 2  # the first view, and the first grasp, which is then turned by 180°
    lifting = Process(EXAMPLE, max_views=2, lift=True, confirm=False, drop=DROP.tolist())
    wait_for(lambda: lifting.process.poll() is not None, 120.0, "the end of the client")
    assert lifting.process.returncode == 0, lifting.text

    assert "asks for another view: MoveIt answers NO_IK_SOLUTION" in lifting.text
    assert "2 views: maximum of 2 views reached" in lifting.text
    steps = [
        "move",
        "grip",
        "move",
        "line",
        "grip",
        "attach",
        "line",
        "move",
        "line",
        "grip",
        "detach",
        "line",
    ]
    assert [what for what, _ in arm.done] == steps
    _, opened, before, at, closed, name, above, over, placed, _, _, away = (where for _, where in arm.done)
    before, at, above, over, placed, away = (T @ T_HAND_TCP for T in (before, at, above, over, placed, away))
    travel = GRIPPERS["franka"].travel
    up, back = (rigid(np.eye(3), (0.0, 0.0, way)) for way in (travel, -travel))
    assert np.allclose(before, at @ back, atol=1e-6)
    assert np.allclose(above, up @ at, atol=1e-6)
    assert np.allclose(over, up @ placed, atol=1e-6)
    assert np.allclose(away, placed @ back, atol=1e-6)
    assert np.allclose(placed[:2, 3], DROP[:2], atol=1e-6)
    assert np.allclose(placed[2, :3], at[2, :3], atol=1e-6), "it is tilted"
    lifted = next(shape_of(g, name) for g in reversed(client.graphs) if g.changes == [])
    assert abs(bottom_of(lifted.moved(placed @ invert(at))) - DROP[2]) < 1e-6, (
        "it does not stand on the table"
    )
    p = lifted.T_world_object[:3, 3]
    assert np.linalg.norm(transform(invert(at), p)[:2]) < 0.01, "it is not between the fingers"
    assert opened == 0.039
    assert abs(2.0 * closed - (0.06 - 0.003)) < 0.005  # its diameter, squeezed

    assert not arm.held
    assert {frozenset(("o0", "panda_link0")), frozenset(("o0", name))} <= arm.touching
    q = transform(placed @ invert(at), p)
    wait_for(
        lambda: np.linalg.norm(shape_of(client.graphs[-1], name).T_world_object[:3, 3] - q) < 0.005,
        what="that caryatid knows where it is",
    )


@pytest.mark.parametrize(
    ("given", "status", "said"),
    [
        ({}, 0, "nothing is lifted: the parameter lift is false"),
        ({"lift": True}, 1, "error: there is no terminal to ask on; set the parameter confirm to false"),
    ],
)
def test_nothing_is_gripped_before_that_is_wanted(start_ready, client, arm, given, status, said):
    start_ready(world_frame="panda_link0", planning_scene="/planning_scene")
    looking = Process(EXAMPLE, max_views=2, **given)
    assert looking.process.wait(120.0) == status, looking.text
    wait_for(lambda: said in looking.text)
    assert "plan: lift o" in looking.text
    assert {what for what, _ in arm.done} == {"move"}


def test_a_carried_camera_that_tf_does_not_know_sees_nothing(client, arm):
    infos = []
    topic = client.create_subscription(CameraInfo, "/camera/info", infos.append, qos_profile_sensor_data)
    frames = lambda: {info.header.frame_id for info in infos}  # noqa: E731
    wait_for(lambda: "camera_color_optical_frame" in frames())
    client.set_table(carried=True, frame="nowhere")
    time.sleep(1.0)
    client.destroy_subscription(topic)
    assert frames() == {"camera_color_optical_frame"}


def test_what_is_missing_is_one_sentence(client, arm):
    lifting = Process(EXAMPLE, camera_frame="nowhere")
    assert lifting.process.wait(60.0) == 1
    wait_for(lambda: "error: tf has no panda_hand ← nowhere; publish the hand-eye" in lifting.text)
    assert "Traceback" not in lifting.text


def test_the_gripper_is_awaited_before_the_first_view(client, arm):
    lifting = Process(EXAMPLE, gripper_action="nowhere")
    assert lifting.process.wait(60.0) == 1
    wait_for(lambda: "error: there is no action /nowhere, GripperCommand or" in lifting.text)
    assert not arm.done
