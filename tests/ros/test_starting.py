"""What the node does while it starts and stops, on real ROS 2; each test starts its own."""

from __future__ import annotations

import re
import signal
import time

import pytest
from action_msgs.msg import GoalStatus
from conftest import HERE, NODE, Process, at_stage, wait_for, within

ABORTED, CANCELED, SUCCEEDED = (
    getattr(GoalStatus, f"STATUS_{name}") for name in ("ABORTED", "CANCELED", "SUCCEEDED")
)
PARAMS = HERE.parents[1] / "ros/caryatid_ros/launch/params.yaml"


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (
            {"image_timeout": "soon"},
            "error: parameter image_timeout: has the wrong type; give a float, such as 5.0",
        ),
        ({"seed": -1}, "error: parameter seed: .*out of range"),
        ({"depth_topic": "bad//name"}, "error: .*topic"),
        ({"planner": "best"}, "error: .*best"),
        ({"depth_topic": "''"}, "error: parameter depth_topic: is empty"),
        ({"info_topic": "/camera/depth"}, "error: parameters: two of them name the topic /camera/depth"),
        ({"masks": "label:/t"}, "error: parameter masks: has the kind 'label'; give onnx:FILE, labels:TOPIC"),
    ],
)
def test_a_wrong_parameter_is_one_sentence(start_node, given, said):
    node = start_node(**given)
    assert node.process.wait(20.0) == 1
    wait_for(lambda: "error: " in node.text)
    assert re.search(said, node.text)
    assert "Traceback" not in node.text


def test_a_parameter_file_holds_for_any_name_and_misspelt_names_are_told(tmp_path):
    file = tmp_path / "params.yaml"
    file.write_text(
        PARAMS.read_text().replace("move_timeout: 120.0", "move_timeout: 61\n    move_timout: 60.0")
    )
    node = Process(*NODE, "--ros-args", "-r", "__ns:=/lab", "-r", "__node:=eyes", "--params-file", file)
    wait_for(lambda: "move_timeout=61.0" in node.text, 30.0)
    assert "unknown parameter 'move_timout' is ignored; did you mean move_timeout?" in node.text
    node.stop()


def test_without_a_clock_a_goal_says_that_time_stands_still(start_ready, client):
    start_ready(use_sim_time=True, image_timeout=1.0)
    status, result = client.explore(max_views=1).result(20.0)
    assert (status, result.message.partition(";")[0]) == (ABORTED, "ROS time: stands still at 0.000 s")


def test_while_kernels_compile_cancel_and_ctrl_c_are_obeyed(start_node, client, tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    node = start_node()
    goal = client.explore(max_views=1)
    wait_for(lambda: "compiling kernels" in node.text, 30.0)
    time.sleep(2.0)
    assert within(0.3, goal.cancel)
    assert goal.result(1.0)[0] == CANCELED
    assert not client.explore(max_views=1).done
    time.sleep(0.5)
    status, took = node.stop()
    assert took <= 1.0
    assert status == 0
    assert "Traceback" not in node.text


@pytest.mark.parametrize("wait", [0.1, 0.4, 0.8, 1.6])
def test_ctrl_c_while_starting_is_quiet(start_node, wait):
    node = start_node()
    time.sleep(wait)
    assert node.stop()[1] <= 1.0
    assert "caryatid" not in node.text.partition("Traceback")[2]


def test_a_view_is_taken_only_after_the_camera_has_come_to_rest(start_ready, client):
    client.set_table(motion_time=1.0)
    start_ready(position_tolerance=1.0, angle_tolerance=3.0)
    goal = client.explore(max_views=2, restart=True)
    wait_for(lambda: goal.feedback, 30.0)
    since = time.time()
    status, result = goal.result()
    stamp = result.graph.header.stamp
    assert status == SUCCEEDED
    assert stamp.sec + 1e-9 * stamp.nanosec > since + 0.9


def test_depth_may_be_compressed_and_colour_missing(start_ready, client):
    start_ready(depth_topic="/camera/depth/compressedDepth", colour_topic="''")
    status, result = client.explore(max_views=1).result()
    assert status == SUCCEEDED
    assert len(result.graph.supports) >= 3


def test_a_leaf_fails_when_the_server_goes(start_ready, client):
    pytest.importorskip("py_trees")
    from caryatid_ros import leaves

    client.set_table(follow=False)
    node = start_ready()
    leaf = leaves.Explore(client.action, lambda decision: None)
    assert client.action.wait_for_server(20.0)
    client.run(leaf.tick_once)
    at_stage(client, "waiting for the camera")
    node.stop()
    wait_for(
        lambda: client.run(leaf.tick_once) or leaf.status == leaves.Status.FAILURE, 5.0, "failure of the leaf"
    )
    order = leaves.order(client.service_clients["order"])
    client.run(order.tick_once)
    assert (order.status, order.feedback_message) == (leaves.Status.FAILURE, "there is no service order")


def test_a_session_outlives_a_kill(start_ready, new_client, tmp_path):
    session = str(tmp_path / "scene")
    node = start_ready(session=session)
    with new_client() as client:
        client.explore(max_views=2).result()
        told = client.call("removed", object="o5")
    assert told.success
    node.stop(signal.SIGKILL)
    start_ready(session=session)
    with new_client() as client:
        graph = wait_for(lambda: client.graphs, 30.0)[-1]
        assert {o.id for o in graph.objects} == {o.id for o in told.graph.objects}
        assert client.call("order", steps=1).success
        status, result = client.explore(max_views=1).result()
    assert (status, result.views) == (SUCCEEDED, 1)
