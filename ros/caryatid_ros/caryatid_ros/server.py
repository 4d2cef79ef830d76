"""The node `caryatid`: its topics, its action and services, and the threads that work for them."""

from __future__ import annotations

import logging
import re
import traceback
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from threading import Thread
from typing import Any

import rclpy
from caryatid_msgs.action import Explore
from caryatid_msgs.msg import Decision, SupportGraph
from caryatid_msgs.srv import Order, Refused, Removed
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import String
from tf2_ros import Buffer, TransformListener
from visualization_msgs.msg import MarkerArray

from caryatid.errors import CaryatidError, InputError, in_one_line
from caryatid_ros.goal import CANCELLED, Goal
from caryatid_ros.inbox import Inbox
from caryatid_ros.messages import make_message, message_type
from caryatid_ros.parameters import check_parameters, declare_parameters, read_parameters

PUBLISHED = {
    "support_graph": SupportGraph, "markers": MarkerArray, "stage": String, "decision": Decision,
    "/diagnostics": DiagnosticArray,
}  # fmt: skip
"""Topics, relative to the node's namespace, and their types."""
COMMANDS = re.compile(
    r" \(on the command line: [^)]*\)|,? or for a recording (add )?--set \S+| or use --level"
)
"""Remedies for the command line."""
BEAT = 1.0
"""Time between two diagnostics; markers are repeated with them, and vanish with the node [s]."""
with suppress(ImportError):
    from vision_msgs.msg import Detection3DArray

    PUBLISHED["detections"] = Detection3DArray
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""How topics are published whose newest message those receive, too, who come late."""


class ExplorationNode(Node):
    """Takes views, and offers the action `explore` and the services `order`, `removed` and `refused`.

    The thread that spins only receives, answers and publishes. A goal waits in a thread of its own; one more
    changes the scene, and one plans removal orders, so that a cancellation is answered at once.

    Attributes:
        prepared: Future of the Exploration, which is made in the scene's thread.
        failure: Why that failed, in one sentence; the node then stops.
        goal: The goal that runs, or None.

    Raises:
        InputError: A parameter cannot be used.
    """

    def __init__(self) -> None:
        super().__init__("caryatid")
        declare_parameters(self)
        self.settings = read_parameters(self)
        check_parameters(self.settings)
        try:
            topics = self.settings.topics.items()
            self._listened = {
                what: (self.resolve_topic_name(topic), message_type(kind)) for what, (topic, kind) in topics
            }
        except ImportError as error:
            raise InputError("parameter masks", f"needs messages ({error})", "install vision_msgs") from None
        except RuntimeError as error:  # of the middleware
            raise InputError("parameters", " ".join(str(error).split()), "correct the topic") from None
        self.failure = ""
        self.goal: Goal | None = None
        # A client that comes late must not drive to the view of an old goal.
        qos = dict.fromkeys(PUBLISHED, LATCHED) | dict.fromkeys(
            ("decision", "/diagnostics"), QoSProfile(depth=1)
        )
        self._topics = {n: self.create_publisher(kind, n, qos[n]) for n, kind in PUBLISHED.items()}
        handler, log = logging.Handler(logging.INFO), self.get_logger()
        handler.emit = lambda record: (  # type: ignore[method-assign]
            log.info(record.getMessage())
            if record.levelno < logging.WARNING
            else log.warning(record.getMessage())  # rclpy wants one level for each line
        )
        for name in ("caryatid", "caryatid_ros"):
            logging.getLogger(name).setLevel(logging.INFO)
            logging.getLogger(name).addHandler(handler)
        self._planning_scene = self._made_planning_scene() if self.settings.planning_scene else None
        self.scene_thread = ThreadPoolExecutor(1)
        self._markers: list[Any] = []
        self.tell_stage("starting")
        self.create_timer(BEAT, self._publish_diagnostics)
        self.prepared = self.scene_thread.submit(self._prepare)
        self._info: Any = None
        info = self._listened["info"][0]
        self.create_subscription(CameraInfo, info, self._take_info, qos_profile_sensor_data)
        group = ReentrantCallbackGroup()
        order = partial(self._answer, ThreadPoolExecutor(1), "order")
        self.create_service(Order, "order", order, callback_group=group)
        removed = partial(self._answer, self.scene_thread, "remove")
        self.create_service(Removed, "removed", removed, callback_group=group)
        self.create_service(Refused, "refused", self._refused, callback_group=group)
        self._server: ActionServer | None = ActionServer(
            self, Explore, "explore", self._execute, callback_group=group,
            goal_callback=self._admit, handle_accepted_callback=self._begin, cancel_callback=self._cancel,
        )  # fmt: skip

    def destroy_node(self) -> None:
        """Destroy the node and all that it offers, so that others know at once that it is gone."""
        server, self._server = self._server, None
        if server is not None:  # ROS 2 Kilted has destroyed it where the context ended.
            server.destroy()
            super().destroy_node()

    def _made_planning_scene(self) -> Any:
        """The topic of MoveIt's planning scene.

        Raises:
            InputError: Messages of MoveIt are not installed.
        """
        try:
            from caryatid_ros.planning_scene import PlanningSceneTopic
        except ImportError as error:
            remedy = "install moveit_msgs"
            raise InputError(
                "parameter planning_scene", f"needs MoveIt's messages ({error})", remedy
            ) from None
        return PlanningSceneTopic(self, self.settings, LATCHED, make_message)

    def publish(self, name: str, message: Any) -> None:
        """Publish a message under a name of PUBLISHED."""
        self._topics[name].publish(message)
        self._markers = message.markers[1:] if name == "markers" else self._markers

    def tell_stage(self, text: str, level: bytes = DiagnosticStatus.OK) -> None:
        """Publish what the node does now, with a level of its diagnostics."""
        self.publish("stage", String(data=text))
        self._status = DiagnosticStatus(level=level, name=f"{self.get_name()}: exploration", message=text)

    def _publish_diagnostics(self) -> None:
        now = DiagnosticArray(status=[self._status])
        now.header.stamp = self.get_clock().now().to_msg()
        self.publish("/diagnostics", now)
        if self._markers:
            self._topics["markers"].publish(MarkerArray(markers=self._markers))

    def sentence(self, error: Exception) -> str:
        """Describe an error in a sentence; the log has the traceback of one that nobody expected."""
        if isinstance(error, (CaryatidError, OSError, MemoryError)):
            said = in_one_line(error)
            told = COMMANDS.sub("", said)
            return told if told == said else f"{told}; check world_frame and the images' frame"
        if not rclpy.ok():
            return "the node was stopped"
        self.get_logger().error("".join(traceback.format_exception(error)))
        return f"internal error: {type(error).__name__}: {error}; the node's log has the traceback"

    def _prepare(self) -> Any:
        """Import what takes long, read the settings, open the session, and compile the kernels."""
        try:
            from caryatid.simulation.warm_up import is_warm, warm_up
            from caryatid_ros.exploration import Exploration

            exploration = Exploration(self.settings, self.publish, planning_scene=self._planning_scene)
            if not is_warm():
                self.get_logger().info("compiling kernels, once after installation, for about a minute")
                self.tell_stage("compiling kernels")
                warm_up()
        except Exception as error:
            self.failure = self.sentence(error)
            rclpy.try_shutdown()
            raise
        if exploration.scene.views:
            exploration.header.stamp = self.get_clock().now().to_msg()
            exploration.publish()
        self.get_logger().info(f"ready: {self.settings}")
        self.tell_stage("idle")
        return exploration

    def _refused(self, request: Any, response: Any) -> Any:
        response.success = self.goal is not None and self.goal.refuse(request.reason)
        response.message = "" if response.success else "no next view is awaited"
        return response

    async def _answer(self, thread: ThreadPoolExecutor, what: str, request: Any, response: Any) -> Any:
        """Have a thread fill in a response; any error becomes a sentence in it."""

        def fill_in() -> None:
            try:
                getattr(self.prepared.result(), what)(request, response)
                response.success = True
            except Exception as error:
                response.success, response.message = False, self.sentence(error)
            done.set_result(response)

        done = self._future()
        thread.submit(fill_in)
        return await done

    def _future(self) -> Future:
        """A future that wakes the thread that spins when it is done."""
        done = Future()
        done.add_done_callback(lambda _: self.executor.wake())
        return done

    def _take_info(self, message: Any) -> None:
        self._info = message
        if self.goal is not None:
            self.goal.inbox.put("info", message)

    def _admit(self, request: Any) -> GoalResponse:
        if self.goal is None:
            return GoalResponse.ACCEPT
        self.get_logger().warning("a goal is rejected, because another one is running; cancel that first")
        return GoalResponse.REJECT

    def _begin(self, handle: Any) -> None:
        before = set(self.subscriptions)
        try:
            self._listen(handle)
        finally:  # a goal that cannot begin is aborted, and the error is logged
            self._heard = set(self.subscriptions) - before
            handle.execute()

    def _listen(self, handle: Any) -> None:
        """Listen to the camera for the new goal only, because images and transforms cost time."""
        buffer = Buffer()
        inbox = Inbox({what: topic for what, (topic, _) in self._listened.items()}, self._info)
        self._listener = TransformListener(buffer, self)
        for what, (topic, kind) in self._listened.items():
            if what != "info":
                put = partial(inbox.put, what)
                self.create_subscription(kind, topic, put, qos_profile_sensor_data)
        info = self._listened["info"][0]
        for publisher in self.get_publishers_info_by_topic(info):
            if publisher.qos_profile.durability == LATCHED.durability:  # it may have published before we came
                self.create_subscription(CameraInfo, info, self._take_info, LATCHED)
        self.goal = Goal(self, handle, inbox, buffer)

    async def _execute(self, handle: Any) -> Any:
        done, goal, heard = self._future(), self.goal, self._heard
        if goal is None:
            handle.abort()
            done.set_result(Explore.Result(message="internal error; the node's log has the traceback"))
        else:
            Thread(target=lambda: done.set_result(goal.run()), daemon=True).start()
        await done
        for subscription in heard:
            self.destroy_subscription(subscription)
        return done.result()

    def _cancel(self, handle: Any) -> CancelResponse:
        if self.goal is not None:
            self.goal.end(CANCELLED)
        return CancelResponse.ACCEPT
