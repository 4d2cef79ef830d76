"""A simulated table as a ROS 2 node: publishes the images of a depth camera, its camera info and tf.

    python examples/ros_table.py --ros-args -p scene:=tower

Its parameters may be changed while it runs. The camera moves to the newest `decision` (or stays), or with
`carried` is where tf says; until tf knows that, there are no images. Its service `go_home` moves the camera
to its first pose, and says whether another node is listening.
"""

from __future__ import annotations

import io
import time
from array import array
from contextlib import suppress
from typing import Any

import numpy as np
import PIL.Image
import rclpy
from caryatid_msgs.msg import Decision
from geometry_msgs.msg import PoseStamped, TransformStamped
from numpy.typing import NDArray
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.time import Time
from rosgraph_msgs.msg import Clock
from scipy.spatial.transform import Rotation, Slerp
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage
from tf2_ros import Buffer, TransformException, TransformListener

from caryatid.benchmark.episodes import open_scene
from caryatid.config import Config, SensorConfig
from caryatid.geometry.transforms import Array
from caryatid.simulation.setup import make_simulation
from caryatid_ros.messages import matrix_of

DEFAULTS: dict[str, Any] = {
    "scene": "tower",
    "width": 320,
    "focal": 262.5,
    "rate": 15.0,  # images per second
    "follow": True,  # whether the camera moves to decisions
    "carried": False,  # whether something else carries the camera: then tf says where it is
    "motion_time": 0.3,  # of a motion [s]
    "encoding": "32FC1",  # of depth
    "topics": ["depth", "colour", "info", "tf"],  # what is published; also labels
    "frame": "camera_optical",
    "world": "map",
    "offset": 0.0,  # stamp of colour minus stamp of depth [s]
    "distortion": [0.0],  # d of the camera info
    "projection": 1.0,  # p of the camera info is k with focal lengths multiplied by this; 0 = no p
    "binning": 0,
    "roi": [0, 0, 0, 0],  # x, y, width, height
    "clock": False,  # whether it publishes /clock
}


class Table(Node):
    """A table, and a camera that floats."""

    def __init__(self) -> None:
        super().__init__("table")
        for name, value in DEFAULTS.items():
            self.declare_parameter(name, value)
        width, focal = self._value("width"), self._value("focal")
        config = Config(sensor=SensorConfig(width=width, height=3 * width // 4, focal=focal))
        scene, _ = open_scene(self._value("scene"))
        simulation = make_simulation(scene, config, noise="none", seed=0)
        self.camera, self.pose = simulation.camera, simulation.robot.T_world_camera
        self._home = self.pose
        self._way: tuple[float, Array, Array] | None = None
        self._buffer = Buffer()
        self._listener = TransformListener(self._buffer, self)
        self._drawn: tuple[bytes, tuple[Any, ...]] | None = None
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._depth_topic = self.create_publisher(Image, "/camera/depth", qos_profile_sensor_data)
        self._colour_topic = self.create_publisher(Image, "/camera/colour", qos_profile_sensor_data)
        packed = CompressedImage, "/camera/depth/compressedDepth", qos_profile_sensor_data
        self._packed_topic = self.create_publisher(*packed)
        self._labels_topic = self.create_publisher(Image, "/camera/labels", qos_profile_sensor_data)
        self._info_topic = self.create_publisher(CameraInfo, "/camera/info", qos_profile_sensor_data)
        self._tf_topic = self.create_publisher(TFMessage, "/tf", 100)
        self._static_topic = self.create_publisher(TFMessage, "/tf_static", latched)
        self._clock_topic = self.create_publisher(Clock, "/clock", 10)
        self.create_subscription(Decision, "/decision", self._decide, 10)
        self.create_subscription(PoseStamped, "/table/go", lambda message: self._go(message.pose), 10)
        self.create_service(Trigger, "/go_home", self._go_home)
        self.create_timer(1.0 / self._value("rate"), self._publish)
        self.create_timer(0.01, self._move)

    def _value(self, name: str) -> Any:
        return self.get_parameter(name).value

    def _decide(self, message: Decision) -> None:
        self.get_logger().info("decision")
        if self._value("follow"):
            self._go(message.camera.pose)

    def _go(self, pose: Any) -> None:
        q, p, end = pose.orientation, pose.position, np.eye(4)
        end[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
        end[:3, 3] = p.x, p.y, p.z
        self._way = time.monotonic(), self.pose, end

    def _go_home(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.pose, self._way = self._home, None
        response.success = self._info_topic.get_subscription_count() > 0
        return response

    def _move(self) -> None:
        carried = self._value("carried")
        if self._way is not None and not carried:
            since, start, end = self._way
            share = min(1.0, (time.monotonic() - since) / max(self._value("motion_time"), 1e-3))
            turn = Slerp([0.0, 1.0], Rotation.from_matrix([start[:3, :3], end[:3, :3]]))
            self.pose = (1.0 - share) * start + share * end
            self.pose[:3, :3] = turn(share).as_matrix()
            self._way = None if share == 1.0 else self._way
        now, topics = self.get_clock().now().to_msg(), self._value("topics")
        if self._value("clock"):
            stamp = Clock()
            stamp.clock.sec, stamp.clock.nanosec = divmod(time.time_ns(), 1_000_000_000)
            self._clock_topic.publish(stamp)
        if "tf" in topics and not carried:
            message = TransformStamped()
            message.header.stamp, message.header.frame_id = now, self._value("world")
            message.child_frame_id = self._value("frame")
            t, q = message.transform.translation, message.transform.rotation
            t.x, t.y, t.z = map(float, self.pose[:3, 3])
            q.x, q.y, q.z, q.w = map(float, Rotation.from_matrix(self.pose[:3, :3]).as_quat())
            self._tf_topic.publish(TFMessage(transforms=[message]))

    def _publish(self) -> None:
        if self._value("carried"):
            try:
                names = self._value("world"), self._value("frame")
                found = self._buffer.lookup_transform(*names, Time()).transform
            except TransformException:
                return
            self.pose = matrix_of(found.rotation, found.translation, "camera")
        if self._drawn is None or self._drawn[0] != self.pose.tobytes():
            view = self.camera.capture(self.pose)
            depth = view.depth
            if self._value("encoding") == "16UC1":
                depth = np.round(depth * 1000.0).astype(np.uint16)
            self._drawn = self.pose.tobytes(), (depth, view.rgb, view.K, view.labels)
        depth, rgb, K, labels = self._drawn[1]
        topics, now = self._value("topics"), self.get_clock().now()
        if "depth" in topics:
            self._depth_topic.publish(self._image(depth, self._value("encoding"), now.nanoseconds))
            if self._packed_topic.get_subscription_count():
                message = CompressedImage(format="16UC1; compressedDepth png")
                message.header = self._image(depth, "", now.nanoseconds).header
                file = io.BytesIO()
                PIL.Image.fromarray(np.round(depth * 1000.0).astype(np.uint16)).save(file, "png")
                message.data = array("B", bytes(12) + file.getvalue())  # after the header of its transport
                self._packed_topic.publish(message)
        if "colour" in topics:
            late = int(self._value("offset") * 1e9)
            self._colour_topic.publish(self._image(rgb, "rgb8", now.nanoseconds + late))
        if "labels" in topics:
            self._labels_topic.publish(self._image(labels.astype(np.int32), "32SC1", now.nanoseconds))
        if "info" in topics:
            info = CameraInfo(height=depth.shape[0], width=depth.shape[1], distortion_model="plumb_bob")
            info.header.stamp, info.header.frame_id = now.to_msg(), self._value("frame")
            info.k, info.d = K.ravel().tolist(), list(self._value("distortion"))
            if scale := self._value("projection"):
                P = np.column_stack([K, np.zeros(3)])
                P[[0, 1], [0, 1]] *= scale
                info.p, info.r = P.ravel().tolist(), np.eye(3).ravel().tolist()
            info.binning_x = info.binning_y = self._value("binning")
            roi = info.roi
            roi.x_offset, roi.y_offset, roi.width, roi.height = self._value("roi")
            self._info_topic.publish(info)

    def _image(self, pixels: NDArray[Any], encoding: str, stamp: int) -> Image:
        message = Image(height=pixels.shape[0], width=pixels.shape[1], encoding=encoding)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 1_000_000_000)
        message.header.frame_id = self._value("frame")
        message.step = pixels.strides[0]
        message.data = array("B", pixels.tobytes())  # of bytes, each is checked
        return message


if __name__ == "__main__":
    rclpy.init()
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(Table())
