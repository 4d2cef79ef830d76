"""Leaves of a py_trees behaviour tree, one for each verb: `Explore`, `order` and `removed`.

They take the clients of an rclpy node, and call them asynchronously. Tick the tree in the thread that spins
the node, such as in a timer: from another one, rclpy may lose the answer to a goal. They fail if there is no
server, or if it goes away.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from action_msgs.msg import GoalStatus
from caryatid_msgs.action import Explore as Action
from caryatid_msgs.srv import Order, Removed
from py_trees.behaviour import Behaviour
from py_trees.common import Status


class Explore(Behaviour):
    """Explore; succeeds when no further view is worth its path. An interruption cancels the goal.

    Args:
        client: `rclpy.action.ActionClient` of `explore`.
        go_to: Called with each Decision; starts the camera's motion to `decision.camera`, and returns.
        goal: Fields of the goal, such as `max_views=5`.

    Attributes:
        result: The newest result, or None.
    """

    def __init__(self, client: Any, go_to: Callable[[Any], object], **goal: Any) -> None:
        super().__init__("explore")
        self._client, self._go_to, self._goal = client, go_to, goal
        self.result = self._sent = self._answer = None

    def initialise(self) -> None:
        """Send the goal."""
        self.result = self._sent = self._answer = None
        if self._client.server_is_ready():
            goal = Action.Goal(**self._goal)
            self._sent = self._client.send_goal_async(goal, feedback_callback=self._decided)

    def _decided(self, message: Any) -> None:
        self.feedback_message = message.feedback.decision.why
        self._go_to(message.feedback.decision)

    def update(self) -> Status:
        """Return whether the goal is running, succeeded or failed."""
        sent, answer = self._sent, self._answer
        if sent is not None and answer is None and sent.done() and sent.result().accepted:
            self._answer = answer = sent.result().get_result_async()
        if answer is not None and answer.done():
            self.result, self.feedback_message = answer.result().result, answer.result().result.message
            succeeded = answer.result().status == GoalStatus.STATUS_SUCCEEDED
            return Status.SUCCESS if succeeded else Status.FAILURE
        if sent is None or not self._client.server_is_ready():
            self.feedback_message = "there is no action server explore"
            return Status.FAILURE
        if answer is None and sent.done():
            self.feedback_message = "the goal was rejected"
            return Status.FAILURE
        return Status.RUNNING

    def terminate(self, new_status: Status) -> None:
        """Cancel a goal that is interrupted, as soon as it is accepted."""
        if self.status == Status.RUNNING and new_status == Status.INVALID and self._sent is not None:
            self._sent.add_done_callback(lambda sent: sent.result().cancel_goal_async())


class Call(Behaviour):
    """Call a service once.

    Args:
        name: Name of the leaf.
        client: Client of the service, from `Node.create_client`.
        request: Makes the request when the leaf starts.
        good: Tells by the response whether the leaf succeeds.

    Attributes:
        response: The newest response, or None.
    """

    feedback_message: str

    def __init__(
        self, name: str, client: Any, request: Callable[[], Any], good: Callable[[Any], bool]
    ) -> None:
        super().__init__(name)
        self._client, self._request, self._good = client, request, good
        self.response = self._sent = None

    def initialise(self) -> None:
        """Send the request."""
        self.response = None
        self._sent = self._client.call_async(self._request()) if self._client.service_is_ready() else None

    def update(self) -> Status:
        """Return whether the response is outstanding, good or bad."""
        if self._sent is not None and self._sent.done():
            self.response = self._sent.result()
            self.feedback_message = self.response.message
            return Status.SUCCESS if self._good(self.response) else Status.FAILURE
        if self._sent is not None and self._client.service_is_ready():
            return Status.RUNNING
        self.feedback_message = f"there is no service {self.name}"
        return Status.FAILURE


def order(client: Any, **request: Any) -> Call:
    """Plan a removal order, such as with `hands=2`; the leaf succeeds if every lift of it is safe."""
    return Call("order", client, lambda: Order.Request(**request), lambda r: r.success and r.safe)


def removed(client: Any, which: Callable[[], str]) -> Call:
    """Report that an object was removed; `which` returns its id when the leaf starts."""
    return Call("removed", client, lambda: Removed.Request(object=which()), lambda r: r.success)
