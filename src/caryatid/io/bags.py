"""Bags of ROS 1 and ROS 2 (sqlite3 and MCAP): depth, its camera, simultaneous colour, and camera poses."""

from __future__ import annotations

import re
import struct
import weakref
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from caryatid.config import RecordingConfig
from caryatid.errors import InputError, needs_extra
from caryatid.geometry.transforms import Array
from caryatid.io import images
from caryatid.io.datasets import Dataset, OpenOptions
from caryatid.io.images import BrokenImageError
from caryatid.io.video import SECOND, TimedCamera, TimedImage, TransformTree, is_pose, make_video
from caryatid.sensing.views import check_intrinsics

SUFFIXES: Final = (".bag", ".mcap", ".db3")
"""Suffixes of bags; a folder with a metadata.yaml is one too."""
TYPES: Final[Mapping[str, tuple[str, ...]]] = {
    "images": ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"),
    "cameras": ("sensor_msgs/msg/CameraInfo",),
    "transforms": ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"),
}
"""Kind of data → types of its messages."""
DEPTH_ENCODINGS: Final = {"16UC1": "I;16", "mono16": "I;16", "32FC1": "F"}
"""Encodings of depth → Pillow's mode: whole millimetres, or metres."""
COLOUR_ENCODINGS: Final = {
    "rgb8": "RGB", "bgr8": "BGR", "rgba8": "RGBX", "bgra8": "BGRX", "mono8": "L", "8UC1": "L",
}  # fmt: skip
"""Encodings of colour → Pillow's raw mode."""
_REALSENSE: Final = re.compile(r"/device_\d+/sensor_\d+(?=/)")
"""Start of the topics of a sensor in bags of the RealSense SDK, which also store its options."""
_CONFIG_HEADER: Final = struct.Struct("<iff")
"""Header of a compressed depth image: its format, and two parameters of inverse depth."""


def recognises(path: Path) -> bool:
    """Whether a path is a bag, by its name."""
    return path.suffix in SUFFIXES if path.is_file() else (path / "metadata.yaml").is_file()


def open_dataset(path: Path, config: RecordingConfig, options: OpenOptions) -> Dataset:
    """Open a bag: a file `.bag`, `.mcap` or `.db3`, or a folder with a metadata.yaml.

    Raises:
        InputError: `rosbags` is not installed; the bag is damaged, empty, or lacks a topic or frame; or its
            images do not fit each other.
    """
    if options.camera_file is not None:
        raise InputError("--camera", "applies only to TUM RGB-D folders", "for a bag, use --info TOPIC")
    bag = _Bag(path)
    depth_topic = bag.require("--depth", options.depth, "images")
    info_topic = bag.require("--info", options.info, "cameras")
    rgb_topic = None if options.rgb is None else bag.require("--rgb", options.rgb, "images")
    sensor, other = _REALSENSE.match(depth_topic), _REALSENSE.match(rgb_topic or "")
    if sensor and other and sensor[0] != other[0]:
        reason = f"depth of {sensor[0]} is not registered to the colour of another sensor, {other[0]}"
        raise InputError(path, reason, "omit --rgb, or align depth to colour and record that")
    cameras, notes = _read_cameras(bag, info_topic, depth_topic)
    unit = bag.depth_unit(sensor[0]) if sensor else 0.001
    if sensor and unit != 0.001:
        notes.append(f"{sensor[0]} counts depth in units of {unit:g} m (Depth_Units)")
    depths = bag.images(depth_topic, partial(decode_depth, max_pixels=config.max_pixels, unit=unit))
    colour = partial(decode_colour, max_pixels=config.max_pixels)
    colours = None if rgb_topic is None else bag.images(rgb_topic, colour)
    poses = None
    if options.world is None:
        notes.insert(0, "no --tf FRAME: poses are unknown, so only one frame is imported")
    else:
        poses = bag.transforms(config.pose_gap), options.world
        for frame in dict.fromkeys(depth.frame or cameras[0].frame for depth in depths):
            _check_way(path, frame, *poses)
    return make_video(path, depths, colours, cameras, poses, config, notes)


def _check_way(path: Path, frame: str, tree: TransformTree, world: str) -> None:
    """Check that transforms connect a camera's frame with the world."""
    if not tree.frames:
        raise InputError(path, "has no transforms", "record /tf and /tf_static, or omit --tf")
    if not frame:
        reason = "neither depth images nor their camera info say their frame (frame_id is empty)"
        raise InputError(path, reason, "set the frame_id of the driver and record again, or omit --tf")
    for name in (world, frame):
        if name not in tree.frames:
            raise InputError(path, f"unknown frame '{name}'", f"known frames: {', '.join(tree.frames)}")
    above, reached = tree.ancestors(frame), {*tree.ancestors(world)}
    if reached.isdisjoint(above):
        # A root is the one without parents.
        top, root = (min(names, key=tree.parents) for names in (above, tree.ancestors(world)))
        reason = f"no transform connects '{world}' with '{frame}': the roots are '{root}' and '{top}'"
        remedy = f"record the transform from '{root}' to '{top}', or give --tf {top} (with --level if tilted)"
        raise InputError(path, reason, remedy)


class _Bag:
    """An open bag; closed once no frame of it is left."""

    def __init__(self, path: Path) -> None:
        with needs_extra("ros", path):
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        self.path = path
        if path.is_file() and path.stat().st_size == 0:
            raise InputError(path, "the bag is empty", "record it again")
        with _damage(path):
            # Before ROS 2 Iron, sqlite3 bags did not store message definitions; those read here are alike.
            self._reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            self._reader.open()
            messages = self._reader.message_count
        weakref.finalize(self, self._reader.close)
        self._types = {c.topic: c.msgtype for c in self._reader.connections}
        if not messages:
            raise InputError(path, "the bag has no messages", "record it again")

    def topics(self, kind: str) -> list[str]:
        """Topics with messages of a kind of `TYPES`, by name."""
        return sorted(topic for topic, type_ in self._types.items() if type_ in TYPES[kind])

    def require(self, option: str, topic: str | None, kind: str) -> str:
        """Return a topic that exists and has messages of a kind; otherwise list those that do."""
        fitting = self.topics(kind)
        if topic in fitting:
            return topic
        reason = f"{option}: '{topic}' holds {self._types.get(topic or '', 'nothing')}, not {kind}"
        if topic is None:
            reason = f"{option} TOPIC is required"
        others = sorted(set(self._types) - set(fitting))
        listed = f"topics with {kind}: {', '.join(fitting) or 'none'}"
        raise InputError(self.path, reason, f"{listed}; other topics: {', '.join(others) or 'none'}")

    def messages(self, topics: Collection[str], *times: int) -> Iterator[tuple[str, int, Any]]:
        """Topic, time of receipt [ns] and message, in the order of receipt, within times [ns] if given."""
        connections = [c for c in self._reader.connections if c.topic in topics]
        if not connections:
            return
        with _damage(self.path):
            for connection, received, data in self._reader.messages(connections, *times):
                message = self._reader.deserialize(data, connection.msgtype)
                yield connection.topic, int(received), message

    def images(self, topic: str, decode: Callable[[Any, str], NDArray[Any]]) -> list[TimedImage]:
        """All images of a topic, to be decoded from the message and the topic's name in errors."""
        found = []
        for number, (_, received, message) in enumerate(self.messages([topic])):
            time, frame = _stamp(message.header, received), _frame(message.header.frame_id)
            name = f"{self.path.name}: {topic}, image {number}"
            found.append(TimedImage(name, time, frame, partial(self._image, topic, received, time, decode)))
        return found

    def transforms(self, max_gap: float) -> TransformTree:
        """All transforms, interpolated across gaps of at most `max_gap` [s]."""
        tree = TransformTree(max_gap, str(self.path))
        for topic, received, message in self.messages(self.topics("transforms")):
            for item in message.transforms:
                t, q = item.transform.translation, item.transform.rotation
                pose, time = (t.x, t.y, t.z, q.x, q.y, q.z, q.w), _stamp(item.header, received)
                if is_pose(pose):
                    parent, child = (
                        name.removeprefix("/") for name in (item.header.frame_id, item.child_frame_id)
                    )
                    tree.add(parent, child, time, pose, fixed=topic.endswith("tf_static"))
        return tree

    def depth_unit(self, sensor: str) -> float:
        """Unit of depth [m] that the RealSense SDK recorded as an option of a sensor; 1 mm without it."""
        unit = 0.001
        for _, _, message in self.messages([f"{sensor}/option/Depth_Units/value"]):
            unit = round(float(message.data), 9)  # a float of 32 bits
        if not 0.0 < unit < 1.0:
            raise InputError(self.path, f"Depth_Units of {sensor} is {unit:g} m", "record it again")
        return unit

    def _image(
        self, topic: str, received: int, time: int, decode: Callable[[Any, str], NDArray[Any]]
    ) -> NDArray[Any]:
        for _, _, message in self.messages([topic], received, received + 1):
            if _stamp(message.header, received) == time:
                return decode(message, f"{self.path}: {topic}")
        raise InputError(self.path, "changed while it was read", "import it again")


def _read_cameras(bag: _Bag, topic: str, depth_topic: str) -> tuple[list[TimedCamera], list[str]]:
    """The cameras of a topic, and what to say about distortion."""
    cameras, notes, source = [], [], f"{bag.path}: {topic}"
    rectified = is_rectified(depth_topic)
    is_raw = "raw" in depth_topic and not rectified
    for _, received, message in bag.messages([topic]):
        time, frame = _stamp(message.header, received), _frame(message.header.frame_id)
        K, size, part = pinhole(message, is_raw=is_raw)
        cameras.append(TimedCamera(f"{source}{part}", time, frame, check_intrinsics(K, source), size))
        if np.any(message.D if hasattr(message, "D") else message.d) and not rectified:
            notes = ["the lens has distortion, but a pinhole camera is assumed: use rectified topics"]
    if not cameras:
        raise InputError(bag.path, f"'{topic}' has no messages", "record the camera info too")
    return cameras, notes


def is_rectified(topic: str) -> bool:
    """Whether the name of a topic says that its images are free of distortion, such as image_rect."""
    return re.search(r"(?<![a-z])rect", topic.lower()) is not None


def pinhole(info: Any, *, is_raw: bool = False) -> tuple[Array, tuple[int, int], str]:
    """Camera matrix (3, 3) and size (width, height) [px] of the images of a CameraInfo, of ROS 1 or 2.

    P is the camera of rectified images, which every node that projects depth uses, and K that of raw ones
    and of drivers that leave P empty. Both are of whole images: a region shifts them and binning divides
    them, as in image_geometry. The last result says so in words, or is empty.
    """
    K, P = (info.K, info.P) if hasattr(info, "K") else (info.k, info.p)
    K, P = np.reshape(K, (3, 3)), np.reshape(P, (3, 4))[:, :3]
    if P[0, 0] > 0.0 and P[1, 1] > 0.0 and not (is_raw and K[0, 0] > 0.0):
        K = P
    part, region = "", info.roi
    width, height = int(region.width or info.width), int(region.height or info.height)
    if (region.x_offset, region.y_offset, width, height) != (0, 0, info.width, info.height):
        K = K - np.array([[0.0, 0.0, region.x_offset], [0.0, 0.0, region.y_offset], [0.0, 0.0, 0.0]])
        part = (
            f" has a region of interest, {width} × {height} pixels at ({region.x_offset}, {region.y_offset})"
        )
    columns, rows = max(int(info.binning_x), 1), max(int(info.binning_y), 1)
    if max(columns, rows) > 1:
        K = K / np.array([[columns], [rows], [1]])
        part += f"{' and' if part else ' has'} binning {info.binning_x} × {info.binning_y}"
    return K, (width // columns, height // rows), part


def _frame(name: str) -> str:
    """Name of a frame as ROS 2 writes it, without a slash; the RealSense SDK writes 0 for none."""
    name = name.removeprefix("/")
    return "" if name == "0" else name


def _stamp(header: Any, received: int) -> int:
    """The header's time [ns], or the time of receipt if that is 0."""
    return int(header.stamp.sec * SECOND + header.stamp.nanosec) or received


def decode_depth(message: Any, source: str, max_pixels: int, unit: float = 0.001) -> NDArray[np.float32]:
    """Depth (H, W) [m] of an image message, compressed or not; 0 for NaN, infinite or negative values.

    Whole numbers count a unit [m].
    """
    if hasattr(message, "format"):
        depth = _compressed_depth(message, source, max_pixels, unit)
    else:
        mode = _known(message, DEPTH_ENCODINGS, source)
        order = "B" if message.is_bigendian else ""
        raw = f"F;32{order}F" if mode == "F" else f"I;16{order}"
        depth = _pixels(message, mode, raw, source) * (1.0 if mode == "F" else unit)
    return np.where(np.isfinite(depth) & (depth > 0.0), depth, 0.0).astype(np.float32)


def _compressed_depth(message: Any, source: str, max_pixels: int, unit: float) -> NDArray[np.floating[Any]]:
    encoding, _, codec = (part.strip() for part in message.format.partition(";"))
    data = message.data.tobytes()
    if "rvl" in codec.lower() or "jpeg" in message.format or "jpg" in message.format:
        reason = f"its depth is compressed as '{message.format}'"
        raise InputError(source, reason, "record it raw, or compressed as PNG")
    if "compressedDepth" not in codec:
        return images.read_units(data, source, max_pixels) * unit
    units = images.read_units(data[_CONFIG_HEADER.size :], source, max_pixels)
    if encoding != "32FC1":
        return units * unit
    _, scale, offset = _CONFIG_HEADER.unpack_from(data)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(units > 0, scale / (units - np.float64(offset)), 0.0)


def decode_colour(message: Any, source: str, max_pixels: int) -> NDArray[np.uint8]:
    """Colour (H, W, 3) of an image message, compressed or not; grey images have three equal channels."""
    if hasattr(message, "format"):
        return images.decode_image(message.data.tobytes(), source, max_pixels=max_pixels)
    raw = _known(message, COLOUR_ENCODINGS, source)
    grey = _pixels(message, "L" if raw == "L" else "RGB", raw, source)
    return np.stack([grey] * 3, axis=-1) if raw == "L" else grey


def _known(message: Any, encodings: Mapping[str, Any], source: str) -> Any:
    if message.encoding not in encodings:
        reason = f"its encoding '{message.encoding}' is not supported"
        raise InputError(source, reason, f"record a topic with {', '.join(encodings)}")
    return encodings[message.encoding]


def _pixels(message: Any, mode: str, raw: str, source: str) -> NDArray[Any]:
    """Pixels of a raw image (H, W), or (H, W, 3), by Pillow's modes; rows may be padded."""
    width, height, step = int(message.width), int(message.height), int(message.step)
    data = np.asarray(message.data, dtype=np.uint8)
    try:
        if not 0 < width <= step or not 0 < height * step <= data.size:
            raise ValueError
        return np.array(Image.frombytes(mode, (width, height), data.tobytes(), "raw", raw, step))
    except ValueError:
        reason = "an image has less data than its size requires"
        raise BrokenImageError(source, reason, "record it again") from None


@contextmanager
def _damage(path: Path) -> Iterator[None]:
    """Turn any exception of the library about damaged data into one sentence."""
    try:
        yield
    except Exception as error:
        words = " ".join(str(error).split()) or type(error).__name__
        reason = f"rosbags cannot read it ({words if len(words) <= 120 else words[:119] + '…'})"
        remedy = "repair it with `rosbag reindex`, `ros2 bag reindex` or `mcap recover`, or record it again"
        raise InputError(path, reason, remedy) from error
