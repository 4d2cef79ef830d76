"""The node's parameters: names, defaults, descriptions and ranges."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from difflib import get_close_matches
from typing import Any

from caryatid.errors import InputError

OTHERS = ("use_sim_time", "start_type_description_service", "qos_overrides")
"""Parameters, or their prefixes, that every node has."""

MASKS = {"labels": "sensor_msgs/msg/Image", "boxes": "vision_msgs/msg/Detection3DArray"}
"""Kinds of masks that are topics, and their messages."""


def _given(default: Any, about: str, low: float = 0.0, high: float = 1e6) -> Any:
    return field(default=default, metadata={"about": about, "range": (low, high)})


@dataclass(frozen=True, slots=True)
class Settings:
    """The node's parameters; those that are floats may change, which counts from the next goal on."""

    world_frame: str = _given("map", "level, fixed frame of the graph and the views")
    depth_topic: str = _given(
        "/camera/aligned_depth_to_color/image_raw",
        "registered to colour; compressed if it ends with /compressedDepth",
    )
    colour_topic: str = _given(
        "/camera/color/image_raw", "of the same size; compressed if it ends with /compressed; empty = none"
    )
    info_topic: str = _given("/camera/color/camera_info", "of these images")
    rectified: bool = _given(False, "whether the images are rectified; those of a topic …rect… are")
    config: str = _given("", "TOML file of caryatid's settings; empty = defaults")
    masks: str = _given(
        "", "source of masks: onnx:FILE, labels:TOPIC or boxes:TOPIC; empty = automatic segmentation"
    )
    ignore: str = _given("", "grey PNG, not 0 where the images show the robot itself; empty = nowhere")
    planner: str = _given("support", "planner of the next view")
    robot: str = _given("humanoid", "which views are reachable: humanoid, arm:FILE.npz or module:callable")
    planning_scene: str = _given("", "topic of MoveIt's planning scene, /planning_scene; empty = none")
    unseen_space: bool = _given(False, "whether that scene holds what no view showed, as boxes that block it")
    gripper_links: str = _given("", "links that touch what is `removed`, the first holds it; empty = none")
    session: str = _given("", "folder that keeps the scene over a restart; empty = none")
    seed: int = _given(0, "of every random choice", high=2**63 - 1)
    budget: float = _given(
        0.0, "time for each view after the first, before the next one is planned [s]; 0 = what it takes", 0.0
    )
    slop: float = _given(0.02, "maximum time between the images of a view [s]", 0.0, 1.0)
    image_timeout: float = _given(5.0, "maximum wait for images and their transform [s]", 0.1)
    move_timeout: float = _given(120.0, "maximum wait until the camera is at the next view [s]", 0.1)
    position_tolerance: float = _given(
        0.03, "maximum distance from the next view on arrival [m]", 0.0005, 1.0
    )
    angle_tolerance: float = _given(0.05, "maximum rotation from the next view on arrival [rad]", 0.0005, 3.2)
    max_speed: float = _given(0.02, "maximum speed of the camera while it takes a view [m/s]", 0.001)
    max_turn: float = _given(0.05, "maximum rotation of the camera meanwhile [rad/s]", 0.001)

    @property
    def topics(self) -> dict[str, tuple[str, str]]:
        """What the node listens to: name and message type of each topic of images, camera info and masks."""
        named = {"depth": self.depth_topic, "info": self.info_topic, "colour": self.colour_topic}
        found = {what: (topic, _image_type(topic)) for what, topic in named.items() if topic}
        found["info"] = self.info_topic, "sensor_msgs/msg/CameraInfo"
        kind, _, topic = self.masks.partition(":")
        return found | ({"masks": (topic, MASKS[kind])} if kind in MASKS else {})


def check_parameters(settings: Settings) -> None:
    """Reject topics that are missing or the same, and masks of another kind.

    Raises:
        InputError: The first parameter that cannot be used.
    """
    kind, colon, _ = settings.masks.partition(":")
    if colon and kind not in (*MASKS, "onnx"):
        remedy = "give onnx:FILE, labels:TOPIC or boxes:TOPIC"
        raise InputError("parameter masks", f"has the kind '{kind}'", remedy)
    if settings.budget and settings.session:
        reason = "is given with session, which keeps each view before the next one"
        raise InputError("parameter budget", reason, "omit one of them")
    if not settings.depth_topic:
        raise InputError("parameter depth_topic", "is empty", "give the topic of depth images")
    names = [topic for topic, _ in settings.topics.values()]
    if twice := {name for name in names if names.count(name) > 1}:
        raise InputError("parameters", f"two of them name the topic {min(twice)}", "give each its own topic")


def _image_type(topic: str) -> str:
    packed = topic.endswith(("/compressed", "/compressedDepth"))
    return "sensor_msgs/msg/CompressedImage" if packed else "sensor_msgs/msg/Image"


def declare_parameters(node: Any) -> None:
    """Declare the parameters of an rclpy node; a warning names given ones that are unknown.

    Raises:
        InputError: A given value has the wrong type, or is out of range.
    """
    from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
    from rclpy.exceptions import InvalidParameterTypeException, ParameterException
    from rclpy.parameter import Parameter

    names = [f.name for f in fields(Settings)]
    for f in fields(Settings):
        low, high = f.metadata["range"]
        given = node._parameter_overrides.get(f.name)  # rclpy has no public list of what was given
        if isinstance(f.default, float) and given is not None and given.type_ is Parameter.Type.INTEGER:
            node._parameter_overrides[f.name] = Parameter(f.name, value=float(given.value))
        described = ParameterDescriptor(description=f.metadata["about"])
        if isinstance(f.default, float):
            described.floating_point_range = [FloatingPointRange(from_value=low, to_value=float(high))]
        else:
            described.read_only = True
            if type(f.default) is int:
                described.integer_range = [IntegerRange(from_value=int(low), to_value=high)]
        try:
            node.declare_parameter(f.name, f.default, described)
        except InvalidParameterTypeException:
            remedy = f"give a {type(f.default).__name__}, such as {f.default!r}"
            raise InputError(f"parameter {f.name}", "has the wrong type", remedy) from None
        except ParameterException as error:
            raise InputError(f"parameter {f.name}", " ".join(str(error).split())) from None
    for name in node._parameter_overrides:
        if name not in names and name.partition(".")[0] not in OTHERS:
            near = get_close_matches(name, names, 1)
            meant = f"did you mean {near[0]}?" if near else f"known ones: {', '.join(names)}"
            node.get_logger().warning(f"unknown parameter '{name}' is ignored; {meant}")


def read_parameters(node: Any) -> Settings:
    """Return the present values of the parameters of an rclpy node."""
    return Settings(**{f.name: node.get_parameter(f.name).value for f in fields(Settings)})
