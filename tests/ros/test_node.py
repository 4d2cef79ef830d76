"""What the node does on real ROS 2: scenarios of each fault that only real ROS shows."""

from __future__ import annotations

import time

import pytest
from action_msgs.msg import GoalStatus
from conftest import wait_for

pytestmark = pytest.mark.usefixtures("table", "node")
SUCCEEDED, CANCELED, ABORTED = (
    getattr(GoalStatus, f"STATUS_{name}") for name in ("SUCCEEDED", "CANCELED", "ABORTED")
)
ALL = ["depth", "colour", "info", "tf"]


@pytest.fixture(autouse=True)
def defaults(client):
    client.set_table()


def within(seconds, call):
    """Result of a call that must return within a time [s]."""
    since = time.monotonic()
    found = call()
    assert (took := time.monotonic() - since) <= seconds, f"took {took:.2f} s"
    return found


def at_stage(client, text):
    """Wait until the node tells a stage that it has not told before."""
    known = len(client.stages)
    wait_for(lambda: any(text in stage for stage in client.stages[known:]), 30.0, text)


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
    answers = [client.start_call("order", hands=2) for _ in range(5)]
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
        ({"offset": 0.03}, "stamps of depth and colour images differ by 0.03"),
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
    client.set_table(topics=ALL[:2])
    status, result = goal.result(10.0)
    assert status == ABORTED
    assert "mm and " in result.message
