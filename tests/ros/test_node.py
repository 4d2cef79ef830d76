"""What the node does on real ROS 2: one scenario for each fault that only real ROS shows."""

from __future__ import annotations

import pytest
from action_msgs.msg import GoalStatus

pytestmark = pytest.mark.usefixtures("table", "node")


@pytest.fixture(autouse=True)
def defaults(client):
    client.set_table()


def test_a_goal_takes_views_and_ends_with_a_graph(client):
    goal = client.explore(max_views=3, restart=True)
    status, result = goal.result()
    assert (status, result.message, result.views) == (
        GoalStatus.STATUS_SUCCEEDED,
        "maximum of 3 views reached",
        3,
    )
    assert len(goal.feedback) == 2
    assert [(s.supporter, s.supported) for s in client.graphs[-1].supports]


def test_a_cancelled_goal_publishes_no_further_decision(client):
    goal = client.explore(max_views=5, restart=True)
    assert goal.cancel(0.3)
    before = len(client.decisions)
    assert goal.result(5.0)[0] == GoalStatus.STATUS_CANCELED
    assert len(client.decisions) == before
