"""A client of the node, in the process of the tests."""

from __future__ import annotations

import runpy
import threading
from collections.abc import Callable
from functools import partial
from typing import Any

from caryatid_msgs.action import Explore
from caryatid_msgs.msg import Decision, SupportGraph
from caryatid_msgs.srv import Order, Refused, Removed
from conftest import TABLE, wait_for
from rcl_interfaces.msg import Log
from rcl_interfaces.srv import SetParameters
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String
from std_srvs.srv import Trigger
from vision_msgs.msg import Detection3DArray

DEFAULTS = runpy.run_path(str(TABLE))["DEFAULTS"]
SERVICES = {"order": Order, "refused": Refused, "removed": Removed, "go_home": Trigger}


class Goal:
    """A goal that was sent.

    Attributes:
        handle: The goal handle, once it is answered.
        feedback: What came so far.
    """

    def __init__(self, client: Client, request: Any) -> None:
        self.feedback: list[Any] = []
        self._client = client
        sent = client.run(partial(client.action.send_goal_async, request, self._take))
        self.handle = wait_for(lambda: sent.done() and sent.result(), what="an answer to the goal")
        self._result = client.run(self.handle.get_result_async) if self.handle.accepted else None

    def _take(self, message: Any) -> None:
        self.feedback.append(message.feedback)

    @property
    def done(self) -> bool:
        """Whether there is a result."""
        return bool(self._result and self._result.done())

    def result(self, seconds: float = 60.0) -> tuple[int, Any]:
        """Wait for status and result."""
        wait_for(lambda: self.done, seconds, "the end of the goal")
        return self._result.result().status, self._result.result().result

    def cancel(self, seconds: float = 5.0) -> bool:
        """Cancel it; return whether that was accepted."""
        answer = self._client.run(self.handle.cancel_goal_async)
        wait_for(answer.done, seconds, "an answer to the cancel")
        return len(answer.result().goals_canceling) == 1


class Client(Node):
    """Clients of all that the node offers; a context manager that spins meanwhile.

    Attributes:
        graphs, decisions, logs, stages, detections: What was published so far.
        stages_seen: Number of stages up to the one that a test has waited for.
        action, service_clients: The clients of rclpy.
    """

    def __init__(self, context: Any = None) -> None:
        super().__init__("client", context=context)
        latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.graphs: list[SupportGraph] = []
        self.decisions: list[Decision] = []
        self.logs: list[Log] = []
        self.stages: list[str] = []
        self.stages_seen = 0
        self.create_subscription(SupportGraph, "/support_graph", self.graphs.append, latched)
        self.create_subscription(Decision, "/decision", self.decisions.append, 10)
        self.create_subscription(Log, "/rosout", self.logs.append, 100)
        self.create_subscription(String, "/stage", lambda m: self.stages.append(m.data), latched)
        self.detections: list[Detection3DArray] = []
        self.create_subscription(Detection3DArray, "/detections", self.detections.append, latched)
        self.action = ActionClient(self, Explore, "/explore")
        self.service_clients = {name: self.create_client(kind, f"/{name}") for name, kind in SERVICES.items()}
        self._setters: dict[str, Any] = {}

    def __enter__(self) -> Client:
        self._spinner = SingleThreadedExecutor(context=self.context)
        self._spinner.add_node(self)
        self._thread = threading.Thread(target=self._spinner.spin, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._spinner.shutdown()
        self._thread.join(5.0)
        self.destroy_node()

    def run(self, call: Callable[[], Any]) -> Any:
        """Return the result of a call in the thread that spins: rclpy may lose answers to others."""
        task = self._spinner.create_task(call)
        wait_for(task.done)
        return task.result()

    def explore(self, **fields: Any) -> Goal:
        """Send a goal."""
        assert self.action.wait_for_server(20.0), "there is no action server"
        self.stages_seen = len(self.stages)
        return Goal(self, Explore.Goal(**fields))

    def call(self, name: str, seconds: float = 30.0, **fields: Any) -> Any:
        """Call a service, and return its response."""
        return wait_for((answer := self.start_call(name, **fields)).done, seconds, name) and answer.result()

    def start_call(self, name: str, **fields: Any) -> Any:
        """Call a service, and return the future."""
        assert self.service_clients[name].wait_for_service(20.0), f"there is no service {name}"
        return self.service_clients[name].call_async(SERVICES[name].Request(**fields))

    def set_table(self, **parameters: Any) -> None:
        """Change parameters of the table; those that are not given get their defaults."""
        values = DEFAULTS | parameters
        fixed = ("scene", "width", "focal", "rate")
        self.set_parameters("table", {name: v for name, v in values.items() if name not in fixed})

    def set_parameters(self, node: str, values: dict[str, Any]) -> None:
        """Change parameters of a node."""
        if node not in self._setters:
            self._setters[node] = self.create_client(SetParameters, f"/{node}/set_parameters")
        setter = self._setters[node]
        assert setter.wait_for_service(20.0), f"there is no {node}"
        request = SetParameters.Request()
        request.parameters = [Parameter(n, value=value).to_parameter_msg() for n, value in values.items()]
        wait_for((answer := setter.call_async(request)).done, what="the answer")
        assert all(result.successful for result in answer.result().results)
