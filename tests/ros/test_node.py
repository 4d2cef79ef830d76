"""What the node does on real ROS 2: scenarios of each fault that only real ROS shows."""

from __future__ import annotations

import re
import signal
import time

import pytest
from action_msgs.msg import GoalStatus
from conftest import HERE, Process, at_stage, wait_for, within
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.srv import DescribeParameters, SetParameters
from rclpy.parameter import Parameter
from visualization_msgs.msg import MarkerArray

pytestmark = pytest.mark.usefixtures("table", "node")
SUCCEEDED, CANCELED, ABORTED = (
    getattr(GoalStatus, f"STATUS_{name}") for name in ("SUCCEEDED", "CANCELED", "ABORTED")
)
ALL = ["depth", "colour", "info", "tf"]
CLIENT = f"""
import sys, time; sys.path.insert(0, "{HERE}")
import rclpy; from client import Client, Decision, DurabilityPolicy, QoSProfile; rclpy.init()
with Client() as client:
"""
LATE = """
    latched, old = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL), []
    client.create_subscription(Decision, "/decision", old.append, latched)
    for _ in range(150):
        time.sleep(0.0 if client.graphs else 0.1)
    time.sleep(1.0)
    print(len(client.decisions + old), len(client.graphs))
"""
DYING = """
    client.explore(max_views=9, restart=True)
    print("sent")
    time.sleep(60)
"""


def test_a_goal_takes_views_and_ends_with_a_graph(client):
    logged = len(client.logs)
    goal = client.explore(max_views=3, restart=True)
    status, result = goal.result()
    assert (status, result.message, result.views) == (SUCCEEDED, "maximum of 3 views reached", 3)
    assert len(goal.feedback) == 2
    assert [(s.supporter, s.supported) for s in client.graphs[-1].supports]
    assert result.graph == client.graphs[-1]
    text = "\n".join(log.msg for log in client.logs[logged:])
    for line in ("goal: max_views 3", "view ", "decision: next view at", "goal ended after 3 views: maximum"):
        assert line in text


def test_diagnostics_tell_how_the_last_goal_ended_and_markers_are_repeated(client):
    told, drawn = [], []
    topics = [
        client.create_subscription(DiagnosticArray, "/diagnostics", told.append, 10),
        client.create_subscription(MarkerArray, "/markers", drawn.append, 10),
    ]
    assert client.explore(max_views=1, restart=True).result()[0] == SUCCEEDED
    ended = "idle; the last goal ended: maximum of 1 views reached"
    wait_for(lambda: any(a.status[0].message == ended for a in told), 3.0, "diagnostics")
    assert told[-1].status[0].level == DiagnosticStatus.OK
    client.set_table(topics=ALL[1:])
    assert client.explore(max_views=1, restart=True).result()[0] == ABORTED
    wait_for(lambda: told[-1].status[0].level == DiagnosticStatus.ERROR, 3.0, "an error")
    assert "/camera/depth: no message arrived" in told[-1].status[0].message
    assert len(drawn) >= 3
    assert all(marker.lifetime.sec == 3 for marker in drawn[-1].markers)
    for topic in topics:
        client.destroy_subscription(topic)


@pytest.mark.parametrize("stage", ["adding view 1", "adding view 2", "planning", "waiting for the camera"])
def test_a_cancelled_goal_publishes_no_further_decision(client, stage):
    goal = client.explore(max_views=5, restart=True)
    at_stage(client, stage)
    assert within(0.3, goal.cancel)
    before = len(client.decisions)
    assert goal.result(1.0)[0] == CANCELED
    time.sleep(1.0)
    assert len(client.decisions) == before


def test_cancel_is_answered_while_orders_are_planned(client):
    client.set_table(follow=False)
    goal = client.explore(max_views=9, restart=True)
    at_stage(client, "planning")
    answers = [client.start_call("order", steps=1) for _ in range(3)]
    at_stage(client, "waiting for the camera")
    for _ in range(3):
        assert within(0.3, lambda: client.call("refused", reason="").success)
        at_stage(client, "waiting for the camera")
    assert within(0.3, goal.cancel)
    assert goal.result(1.0)[0] == CANCELED
    wait_for(lambda: all(answer.done() for answer in answers), 60.0, "orders")
    assert all(answer.result().success for answer in answers)


def test_a_refused_view_is_replaced(client):
    client.set_table(follow=False)
    assert client.call("refused").message == "no next view is awaited"
    goal = client.explore(max_views=2, restart=True)
    wait_for(lambda: goal.feedback, 30.0)
    assert client.call("refused", reason="no path").success
    wait_for(lambda: len(goal.feedback) == 2, 30.0)
    first, second = (f.decision.camera.pose.position for f in goal.feedback)
    assert first != second
    goal.cancel()
    goal.result()


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"topics": ALL[1:]}, "/camera/depth: no message arrived, but "),
        ({"topics": ["depth", "info", "tf"]}, "/camera/colour: no message arrived, but "),
        ({"offset": 0.03}, "stamps of depth and colour images differ by 0.0"),
        ({"topics": ALL[:3]}, "transform map ← camera_optical: is unknown"),
        ({"world": "odom"}, "transform map ← camera_optical: is unknown"),
        ({"distortion": [0.1, 0.0, 0.0, 0.0, 0.0]}, "camera info: has distortion, d = [0.1, 0.0, 0.0"),
        ({"binning": 2}, "camera info: has binning 2 × 2"),
        ({"roi": [0, 0, 100, 100]}, "camera info: has a region of interest"),
    ],
)
def test_a_goal_without_views_says_the_true_cause(client, changed, said):
    client.set_table(**changed)
    time.sleep(0.2)
    status, result = client.explore(max_views=1, restart=True).result(10.0)
    assert status == ABORTED
    assert said in result.message


def test_a_second_goal_is_rejected_and_hands_are_checked(client):
    client.set_table(follow=False)
    goal = client.explore(restart=True)
    at_stage(client, "waiting for the camera")
    assert not within(0.5, client.explore).handle.accepted
    assert "hands: 7 is neither 1 nor 2" in client.call("order", hands=7).message
    client.set_table(topics=["tf"])
    status, result = goal.result(10.0)
    assert status == ABORTED
    assert "mm and " in result.message


def test_an_order_for_a_named_gripper_has_its_grasps(client):
    assert client.explore(max_views=3, restart=True).result()[0] == SUCCEEDED
    (lift,) = client.call("order", steps=1, gripper="franka").lifts
    assert 0.0 < lift.grasp[0].width < 0.08
    (lift,) = client.call("order", steps=1).lifts
    assert not lift.grasp
    assert client.call("order", gripper="claw").message.startswith(
        "gripper: 'claw' is unknown; choose one of"
    )


def test_transforms_that_stop_are_told_while_the_camera_is_awaited(client):
    goal = client.explore(restart=True)
    wait_for(lambda: goal.feedback, 30.0)
    client.set_table(topics=ALL[:3], follow=False)
    status, result = goal.result(10.0)
    assert status == ABORTED
    assert re.match(r"transform map ← camera_optical: is \d\.\d s old", result.message)


def test_a_late_client_gets_no_old_decision_but_the_graph(client):
    goal = client.explore(max_views=2, restart=True)
    goal.result()
    late = Process("-c", CLIENT + LATE)
    assert late.process.wait(40.0) == 0
    wait_for(lambda: late.lines)
    assert late.lines[-1] == "0 1\n"


def test_camera_info_holds_until_the_next_one(client):
    client.set_table(topics=["depth", "colour", "tf"])
    assert client.explore(max_views=1, restart=True).result()[0] == SUCCEEDED


def test_parameters_are_described_and_read_only_where_they_do_not_change(client):
    def ask(kind, name, request):
        service = client.create_client(kind, f"/caryatid/{name}")
        assert service.wait_for_service(10.0)
        return wait_for((answer := service.call_async(request)).done) and answer.result()

    names = ["move_timeout", "seed", "depth_topic"]
    told = ask(DescribeParameters, "describe_parameters", DescribeParameters.Request(names=names)).descriptors
    assert all(d.description for d in told)
    assert [d.read_only for d in told] == [False, True, True]
    assert told[0].floating_point_range[0].from_value == 0.1
    values = {"move_timeout": [7.0, -1.0, "long", float("nan")], "depth_topic": ["/other"], "seed": [1]}
    request = SetParameters.Request()
    for name, given in values.items():
        request.parameters += [Parameter(name, value=value).to_parameter_msg() for value in given]
    results = ask(SetParameters, "set_parameters", request).results
    assert [r.successful for r in results] == [True] + [False] * 5
    assert "out of range" in results[1].reason
    client.set_parameters("caryatid", {"move_timeout": 2.0})


def test_a_goal_ends_when_its_client_dies_and_the_next_one_does_not(client):
    client.set_table(follow=False)
    client.set_parameters("caryatid", {"move_timeout": 60.0})
    dying = Process("-c", CLIENT + DYING)
    wait_for(lambda: "sent" in dying.text, 20.0)
    wait_for(lambda: "waiting for the camera" in client.stages[-1], 20.0)
    dying.stop(signal.SIGKILL)
    within(5.0, lambda: wait_for(lambda: "the client of the goal is gone" in client.stages[-1]))
    goal = client.explore(max_views=9, restart=True)
    at_stage(client, "waiting for the camera")
    time.sleep(5.0)  # DDS still waits for the one that was killed
    assert not goal.done
    goal.cancel()
    goal.result()
    client.set_parameters("caryatid", {"move_timeout": 2.0})


@pytest.mark.parametrize("verb", ["order", "removed"])
def test_an_unforeseen_error_is_answered_and_the_node_lives_on(client, verb):
    assert client.explore(max_views=1).result()[0] == SUCCEEDED
    # The stand-in of a robot, which the node was started with, breaks what is behind this id.
    fields = {"goal": "broken"} if verb == "order" else {"object": "broken"}
    response = client.call(verb, **fields)
    assert (response.success, response.message[:24]) == (False, "internal error: KeyError")
    wait_for(lambda: any("Traceback" in log.msg for log in client.logs), 5.0, "a traceback in /rosout")
    assert client.call("order", steps=1).success


def test_leaves_fail_when_there_is_no_server_and_succeed_with_one(client):
    pytest.importorskip("py_trees")
    from caryatid_ros import leaves

    went = []
    leaf = leaves.Explore(client.action, went.append, max_views=2, restart=True)

    def ended(leaf):
        client.run(leaf.tick_once)
        return leaf.status not in (leaves.Status.RUNNING, leaves.Status.INVALID)

    wait_for(lambda: ended(leaf), 30.0)
    assert (leaf.status, leaf.feedback_message) == (leaves.Status.SUCCESS, "maximum of 2 views reached")
    assert len(went) == 1
    order = leaves.order(client.service_clients["order"], steps=1)
    wait_for(lambda: ended(order), 30.0)
    assert order.response.lifts
    leaf = leaves.Explore(client.action, went.append, restart=True)
    client.set_table(follow=False)
    client.run(leaf.tick_once)
    at_stage(client, "waiting for the camera")
    client.run(lambda: leaf.stop(leaves.Status.INVALID))
    wait_for(lambda: client.stages[-1].endswith("ended: cancelled"), 5.0)
