"""Conversion between ROS messages and caryatid's own data; rclpy is not needed.

Messages are made by a function `make(name, **fields)`, so that other message types with the same fields work.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import reduce
from importlib import import_module
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from caryatid.config import RecordingConfig
from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Shape
from caryatid.geometry.transforms import Array
from caryatid.graph import Change, Grasp, SceneObject, Support, SupportGraph
from caryatid.io.bags import decode_colour, decode_depth, pinhole
from caryatid.manipulation.order import Order
from caryatid.planning.decision import Decision
from caryatid.sensing.views import View
from caryatid.viz.colours import object_colour, rgb
from caryatid_ros.inbox import seconds_of

Make = Callable[..., Any]
"""Makes a message: `make("geometry_msgs/msg/Point", x=1.0)`; other fields keep their defaults."""

CUBE, SPHERE, CYLINDER, ARROW, TEXT, TRIANGLES, DELETE_ALL = 1, 2, 3, 0, 9, 11, 3
"""Types of visualization_msgs/Marker, and its action that deletes all markers."""
SHAPES = {"box": CUBE, "sphere": SPHERE, "cylinder": CYLINDER}
"""Kinds of shapes that RViz draws itself; others are drawn as triangles."""
LABELS = {"mono8": "u1", "8UC1": "u1", "mono16": "u2", "16UC1": "u2", "32SC1": "i4"}
"""Encodings of label images, and NumPy's type of their pixels."""
BOX_MARGIN = 0.005
"""How far outside a box its readings may lie [m]: they are on its faces, with noise."""
LIFETIME = 3
"""Time after which markers vanish that are not repeated [s]."""
TEXT_HEIGHT, ARROW_WIDTH = 0.025, 0.012
"""Height of names, and width of the arrow of a certain support [m]."""


def make_message(name: str, /, **fields: Any) -> Any:
    """Make a message of an installed ROS package, such as `caryatid_msgs/srv/Order/Request`."""
    return message_type(name)(**fields)


def message_type(name: str) -> Any:
    """Return the type of a message of an installed ROS package."""
    package, kind, *names = name.split("/")
    return reduce(getattr, names, import_module(f"{package}.{kind}"))


def message_of(make: Make, name: str, fields: Mapping[str, Any]) -> Any:
    """A message of nested mappings, as JSON has them; what they do not name has its default."""
    message = make(name)
    kinds = message.get_fields_and_field_types()
    for field, value in fields.items():
        kind = kinds[field].removeprefix("sequence<").removesuffix(">").replace("/", "/msg/")
        if isinstance(value, Mapping):
            value = message_of(make, kind, value)
        elif "/" in kind:
            value = [message_of(make, kind, item) for item in value]
        elif kind == "octet":
            value = bytes([value])
        setattr(message, field, value)
    return message


def matrix_of(rotation: Any, translation: Any, name: str) -> Array:
    """A pose or transform as a matrix (4, 4), from its quaternion and its translation [m].

    Raises:
        InputError: The quaternion is zero, or a number is not finite.
    """
    x, y, z, w = rotation.x, rotation.y, rotation.z, rotation.w
    if not np.linalg.norm((x, y, z, w)) > 1e-6:
        raise InputError(name, "has no rotation: its quaternion is zero or NaN", "give a unit quaternion")
    R = Rotation.from_quat((x, y, z, w)).as_matrix()
    return transforms.as_rigid(transforms.rigid(R, (translation.x, translation.y, translation.z)), name)


def view_of(depth: Any, info: Any, colour: Any, T_world_camera: Array, *, rectified: bool = True) -> View:
    """The view of a depth image, its camera, and a colour image of the same size.

    Args:
        depth: sensor_msgs/Image or CompressedImage.
        info: sensor_msgs/CameraInfo of the depth image.
        colour: sensor_msgs/Image or CompressedImage, or None.
        T_world_camera: Pose (4, 4) of the image's optical frame.
        rectified: Whether the images are free of the distortion that the camera info describes.

    Raises:
        InputError: An encoding is unknown, data is missing, sizes differ, or the camera is not a pinhole.
    """
    pixels = RecordingConfig().max_pixels
    metres = decode_depth(depth, "depth image", pixels)
    K, size, part = pinhole(info)
    if size != metres.shape[::-1]:
        reason = f"{part}{', so' if part else ''} is for {size[0]} × {size[1]} pixels, the depth image has "
        reason = f"{reason}{metres.shape[1]} × {metres.shape[0]}".strip()
        raise InputError("camera info", reason, "use the camera info of the aligned depth image")
    if np.any(info.d) and not rectified:
        reason = f"has distortion, d = {np.round(info.d, 4).tolist()}, and the images are not rectified"
        remedy = "use rectified topics, such as image_rect of image_proc; if they are, set rectified"
        raise InputError("camera info", reason, remedy)
    image = None if colour is None else decode_colour(colour, "colour image", pixels)
    name = f"{seconds_of(depth.header.stamp):.3f}"
    return View(metres, K, T_world_camera, image, name=name)


def with_masks(view: View, masks: Any, frames: Mapping[str, Array]) -> View:
    """Return a view with masks, as segments of that view alone.

    Args:
        view: The view.
        masks: sensor_msgs/Image of labels, 0 where there is no object; or vision_msgs/Detection3DArray, of
            which each box is the mask of what it holds, with the class of its first result as name.
        frames: Pose (4, 4) in the world of each frame that detections may have.

    Raises:
        InputError: The masks have another size or encoding than possible, or their frame is unknown.
    """
    if hasattr(masks, "encoding"):
        kind = LABELS.get(masks.encoding)
        if kind is None:
            reason = f"have the encoding '{masks.encoding}'"
            raise InputError("masks", reason, f"publish them as {', '.join(LABELS)}")
        pixels = np.frombuffer(masks.data, ">" + kind if masks.is_bigendian else kind)
        if len(pixels) < masks.height * masks.width or len(pixels) % max(masks.height, 1):
            reason = f"have {len(pixels)} pixels instead of {masks.width} × {masks.height}"
            raise InputError("masks", reason, "check the node that publishes them")
        labels = pixels.reshape(masks.height, -1)[:, : masks.width].astype(np.int32)
        return replace(view, labels=labels, labels_are="segments", names=None)
    if masks.header.frame_id not in frames:
        reason = f"have the frame '{masks.header.frame_id}'"
        raise InputError("masks", reason, f"publish them in {' or '.join(frames)}")
    labels, names = np.zeros(view.depth.shape, dtype=np.int32), {}
    inside = np.where(view.valid, 1.0, 0.0)  # 0 in the middle of a box, 1 on its faces
    for label, detection in enumerate(masks.detections, start=1):
        box, size = detection.bbox.center, detection.bbox.size
        T = frames[masks.header.frame_id] @ matrix_of(box.orientation, box.position, "masks")
        half = np.array([size.x, size.y, size.z]) / 2.0 + BOX_MARGIN
        if not (half > BOX_MARGIN).all():
            reason = f"have a box of {size.x:g} × {size.y:g} × {size.z:g} m"
            raise InputError("masks", reason, "check the node that publishes them")
        points = transforms.transform(transforms.invert(T) @ view.pose, view.points_camera)
        share = np.abs(points / half).max(axis=-1)
        labels[share < inside] = label
        inside = np.minimum(inside, share)
        names[label] = detection.results[0].hypothesis.class_id if detection.results else ""
    return replace(view, labels=labels, labels_are="segments", names=names)


def pose_message(make: Make, T: Array) -> Any:
    """A geometry_msgs/Pose of a matrix (4, 4)."""
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True).tolist()
    orientation = make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
    return make("geometry_msgs/msg/Pose", position=_point(make, T[:3, 3]), orientation=orientation)


def graph_message(make: Make, graph: SupportGraph, changes: Sequence[Change], header: Any) -> Any:
    """A SupportGraph, with the time of the newest image and the world frame in its header."""
    return make(
        "caryatid_msgs/msg/SupportGraph", header=header,
        objects=[_object(make, o) for o in graph.objects],
        supports=[_support(make, s) for s in graph.supports],
        changes=[_change(make, c) for c in changes],
    )  # fmt: skip


def _object(make: Make, o: SceneObject) -> Any:
    return make(
        "caryatid_msgs/msg/Object",
        id=o.id, name=o.name or "", label=int(o.label), role=o.role, shape=o.shape.kind,
        occurrences=int(o.occurrences),
        pose=pose_message(make, o.shape.T_world_object), extents=_vector(make, o.shape.extents),
        probability=float("nan") if o.probability is None else float(o.probability), doubt=o.doubt,
        triangles=_corners(make, o.shape) if o.shape.kind not in SHAPES else [],
    )  # fmt: skip


def _support(make: Make, s: Support) -> Any:
    return make(
        "caryatid_msgs/msg/Support",
        supporter=s.supporter, supported=s.supported, kind=s.kind, probability=float(s.belief),
        occurrences=int(s.occurrences), opportunities=int(s.opportunities), why=s.why,
        contact=_point(make, np.full(3, np.nan) if s.contact_world is None else s.contact_world),
    )  # fmt: skip


def _change(make: Make, c: Change) -> Any:
    return make("caryatid_msgs/msg/Change", kind=c.kind, object=c.object_id, view=c.view, why=c.why)


def detections_message(make: Make, graph: SupportGraph, header: Any) -> Any:
    """A vision_msgs/Detection3DArray of the objects: their class is their name, or else the kind of shape."""

    def detection(o: SceneObject) -> Any:
        kind, score = o.name or o.shape.kind, 1.0 if o.probability is None else float(o.probability)
        pose = pose_message(make, o.shape.T_world_object)
        result = make(
            "vision_msgs/msg/ObjectHypothesisWithPose",
            hypothesis=make("vision_msgs/msg/ObjectHypothesis", class_id=kind, score=score),
            pose=make("geometry_msgs/msg/PoseWithCovariance", pose=pose),
        )
        box = make("vision_msgs/msg/BoundingBox3D", center=pose, size=_vector(make, o.shape.extents))
        return make("vision_msgs/msg/Detection3D", header=header, id=o.id, results=[result], bbox=box)

    found = [detection(o) for o in graph.movable]
    return make("vision_msgs/msg/Detection3DArray", header=header, detections=found)


def decision_message(make: Make, decision: Decision, header: Any) -> Any:
    """A Decision, with the next camera pose in the frame of the header."""
    pose = pose_message(make, decision.T_world_camera)
    return make(
        "caryatid_msgs/msg/Decision",
        camera=make("geometry_msgs/msg/PoseStamped", header=header, pose=pose), why=decision.why,
        expected_gain=float(decision.saliency), cost=float(decision.cost), score=float(decision.score),
    )  # fmt: skip


def lift_messages(make: Make, order: Order) -> list[Any]:
    """A Lift for each step of a removal order."""
    return [
        make(
            "caryatid_msgs/msg/Lift",
            object=s.object_id, hold=list(s.hold), risk=float(s.risk), safe=bool(s.safe), why=s.why,
            grasp=[] if s.grasp is None else [_grasp(make, s.grasp)],
        )
        for s in order.steps
    ]  # fmt: skip


def _grasp(make: Make, grasp: Grasp) -> Any:
    return make(
        "caryatid_msgs/msg/Grasp", pose=pose_message(make, grasp.T_world_gripper), width=float(grasp.width),
        travel=float(grasp.travel),
        seen_free=float("nan") if grasp.seen_free is None else float(grasp.seen_free),
    )  # fmt: skip


def markers_message(make: Make, graph: SupportGraph, header: Any) -> Any:
    """A MarkerArray: shapes in the report's colours, their ids, and an arrow for each support.

    The more probable a support is, the wider is its arrow. They have no time, so that RViz draws them where
    their frame is now.
    """
    header = make("std_msgs/msg/Header", frame_id=header.frame_id)

    def marker(ns: str, kind: int, colour: str, alpha: float, **fields: Any) -> None:
        red, green, blue = (channel / 255.0 for channel in rgb(colour))
        rgba = make("std_msgs/msg/ColorRGBA", r=red, g=green, b=blue, a=alpha)
        fields = {"header": header, "ns": ns, "id": len(found), "type": kind, "color": rgba, **fields}
        fields["lifetime"] = make("builtin_interfaces/msg/Duration", sec=LIFETIME)
        found.append(make("visualization_msgs/msg/Marker", **fields))

    found = [make("visualization_msgs/msg/Marker", header=header, action=DELETE_ALL)]
    for o in graph.objects:
        kind, colour = SHAPES.get(o.shape.kind, TRIANGLES), object_colour(o.label)
        drawn = {"pose": pose_message(make, o.shape.T_world_object)}
        if kind == TRIANGLES:
            drawn |= {"scale": _vector(make, np.ones(3)), "points": _corners(make, o.shape)}
        else:
            drawn["scale"] = _vector(make, o.shape.extents)
        marker("shapes", kind, colour, 0.8, **drawn)
        above = transforms.rigid(np.eye(3), o.centre_world + (0.0, 0.0, _half_height(o.shape) + TEXT_HEIGHT))
        size = _vector(make, (0.0, 0.0, TEXT_HEIGHT))
        marker("ids", TEXT, "#ffffff", 1.0, pose=pose_message(make, above), scale=size, text=o.id)
    for s in graph.supports:
        end = graph[s.supported].centre_world
        start = graph[s.supporter].centre_world
        if graph[s.supporter].role == "support_surface":  # straight up, not from its middle
            start = np.array([*end[:2], start[2]])
        width = ARROW_WIDTH * max(s.belief, 0.1)
        points, scale = [_point(make, start), _point(make, end)], _vector(make, (width, 2.5 * width, 0.0))
        marker("supports", ARROW, "#202020", 1.0, points=points, scale=scale)
    return make("visualization_msgs/msg/MarkerArray", markers=found)


def _corners(make: Make, shape: Shape) -> list[Any]:
    """Three corners of each triangle of a shape, along its own axes."""
    return [_point(make, p) for p in shape.mesh().triangles.reshape(-1, 3)]


def _half_height(shape: Shape) -> float:
    return float(shape.support(np.array([[0.0, 0.0, 1.0]]))[0])


def _point(make: Make, xyz: Array | tuple[float, ...]) -> Any:
    x, y, z = map(float, xyz)
    return make("geometry_msgs/msg/Point", x=x, y=y, z=z)


def _vector(make: Make, xyz: Array | tuple[float, ...]) -> Any:
    x, y, z = map(float, xyz)
    return make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)
