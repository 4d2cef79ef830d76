"""The node `caryatid`: connects ROS to `Exploration`; the only module that needs rclpy."""

from __future__ import annotations

import sys
import time
from dataclasses import fields
from typing import Any

import rclpy
from caryatid_msgs.action import Explore
from caryatid_msgs.msg import Decision, SupportGraph
from caryatid_msgs.srv import Order, Refused, Removed
from message_filters import ApproximateTimeSynchronizer, Subscriber
from rclpy.action import ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, Image
from tf2_ros import Buffer, TransformException, TransformListener
from visualization_msgs.msg import MarkerArray

from caryatid.errors import CaryatidError, in_one_line
from caryatid_ros.exploration import Connection, Exploration, Settings

PUBLISHED = {"support_graph": SupportGraph, "markers": MarkerArray, "decision": Decision}
"""Topics, relative to the node's namespace, and their types."""


class ExplorationNode(Node):
    """Takes views, and offers the action `explore` and the services `order`, `removed` and `refused`.

    Raises:
        CaryatidError: A parameter cannot be used.
    """

    def __init__(self) -> None:
        super().__init__("caryatid")
        declared = {f.name: self.declare_parameter(f.name, f.default).value for f in fields(Settings)}
        self.settings = Settings(**declared)
        self.images: tuple[Any, Any, Any] | None = None
        self._buffer = Buffer()
        self._listener = TransformListener(self._buffer, self)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._topics = {n: self.create_publisher(kind, n, latched) for n, kind in PUBLISHED.items()}
        self.logic = Exploration(
            self.settings,
            Connection(
                images=lambda: self.images,
                lookup=self._lookup,
                publish=lambda name, message: self._topics[name].publish(message),
                now=lambda: self.get_clock().now().nanoseconds * 1e-9,
                sleep=self._sleep,
            ),
        )
        topics = [(Image, self.settings.depth_topic), (CameraInfo, self.settings.info_topic)]
        if self.settings.colour_topic:
            topics.append((Image, self.settings.colour_topic))
        subscribers = [Subscriber(self, kind, t, qos_profile=qos_profile_sensor_data) for kind, t in topics]
        self._together = ApproximateTimeSynchronizer(subscribers, 10, self.settings.slop)
        self._together.registerCallback(self._take_images)
        # Goals and services last; images and transforms arrive meanwhile in other threads.
        group = ReentrantCallbackGroup()
        self.create_service(Order, "order", lambda r, _: self.logic.order(r), callback_group=group)
        self.create_service(Removed, "removed", lambda r, _: self.logic.removed(r), callback_group=group)
        self.create_service(Refused, "refused", lambda r, _: self.logic.refused(r), callback_group=group)
        self._server = ActionServer(
            self, Explore, "explore", self.logic.explore,
            cancel_callback=lambda _: CancelResponse.ACCEPT, callback_group=group,
        )  # fmt: skip

    def _take_images(self, depth: Any, info: Any, colour: Any = None) -> None:
        self.images = depth, info, colour

    def _sleep(self, seconds: float) -> None:
        time.sleep(seconds)
        if not rclpy.ok():  # else a goal would keep the process alive
            raise ExternalShutdownException

    def _lookup(self, target: str, source: str, stamp: Any) -> Any:
        time_ = Time() if stamp is None else Time.from_msg(stamp)
        try:
            timeout = Duration(seconds=self.settings.image_timeout)
            return self._buffer.lookup_transform(target, source, time_, timeout)
        except TransformException as error:
            raise LookupError(str(error)) from None


def main() -> None:
    """Run the node until it is stopped."""
    rclpy.init()
    try:
        executor = MultiThreadedExecutor(num_threads=4)
        executor.add_node(ExplorationNode())
        executor.spin()
    except CaryatidError as error:
        sys.exit(f"error: {in_one_line(error)}")
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()
