"""Bags of ROS 1 and ROS 2 (sqlite3 and MCAP): depth, its camera, simultaneous colour, and camera poses."""

from __future__ import annotations

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
    cameras, distorts = _read_cameras(bag, info_topic)
    depths = bag.images(depth_topic, partial(decode_depth, max_pixels=config.max_pixels))
    colour = partial(decode_colour, max_pixels=config.max_pixels)
    colours = None if rgb_topic is None else bag.images(rgb_topic, colour)
    pose_at, notes = None, []
    if options.world is None:
        notes.append("no --tf FRAME: poses are unknown, so only one frame is imported")
    else:
        tree = TransformTree(config.pose_gap)
        for topic, received, message in bag.messages(bag.topics("transforms")):
            for item in message.transforms:
                t, q = item.transform.translation, item.transform.rotation
                pose, time = (t.x, t.y, t.z, q.x, q.y, q.z, q.w), _stamp(item.header, received)
                if is_pose(pose):
                    parent, child = _frame(item.header.frame_id), _frame(item.child_frame_id)
                    tree.add(parent, child, time, pose, fixed=topic.endswith("tf_static"))
        if not tree.frames:
            raise InputError(bag.path, "has no transforms", "record /tf and /tf_static, or omit --tf")
        for frame in dict.fromkeys([options.world, *(depth.frame for depth in depths)]):
            if frame not in tree.frames:
                raise InputError(path, f"unknown frame '{frame}'", f"known frames: {', '.join(tree.frames)}")
        pose_at = partial(tree.between, options.world)
    if distorts:
        notes.append("the lens has distortion, but a pinhole camera is assumed: use rectified topics")
    return make_video(path, depths, colours, cameras, pose_at, config, notes)


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
        weakref.finalize(self, self._reader.close)
        self._types = {c.topic: c.msgtype for c in self._reader.connections}
        if not self._reader.message_count:
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

    def _image(
        self, topic: str, received: int, time: int, decode: Callable[[Any, str], NDArray[Any]]
    ) -> NDArray[Any]:
        for _, _, message in self.messages([topic], received, received + 1):
            if _stamp(message.header, received) == time:
                return decode(message, f"{self.path}: {topic}")
        raise InputError(self.path, "changed while it was read", "import it again")


def _read_cameras(bag: _Bag, topic: str) -> tuple[list[TimedCamera], bool]:
    """The cameras of a topic, and whether a lens distorts."""
    cameras, distorts, source = [], False, f"{bag.path}: {topic}"
    for _, received, message in bag.messages([topic]):
        # ROS 1 names the matrices in capitals.
        K, D = (message.K, message.D) if hasattr(message, "K") else (message.k, message.d)
        time, frame = _stamp(message.header, received), _frame(message.header.frame_id)
        size = int(message.width), int(message.height)
        K = check_intrinsics(np.reshape(K, (3, 3)), source)
        cameras.append(TimedCamera(source, time, frame, K, size))
        distorts = distorts or bool(np.any(D))
    if not cameras:
        raise InputError(bag.path, f"'{topic}' has no messages", "record the camera info too")
    return cameras, distorts


def _frame(name: str) -> str:
    """Name of a frame as ROS 2 writes it, without a slash."""
    return name.removeprefix("/")


def _stamp(header: Any, received: int) -> int:
    """The header's time [ns], or the time of receipt if that is 0."""
    return int(header.stamp.sec * SECOND + header.stamp.nanosec) or received


def decode_depth(message: Any, source: str, max_pixels: int) -> NDArray[np.float32]:
    """Depth (H, W) [m] of an image message, compressed or not; 0 for NaN, infinite or negative values."""
    if hasattr(message, "format"):
        depth = _compressed_depth(message, source, max_pixels)
    else:
        mode = _known(message, DEPTH_ENCODINGS, source)
        order = "B" if message.is_bigendian else ""
        raw = f"F;32{order}F" if mode == "F" else f"I;16{order}"
        depth = _pixels(message, mode, raw, source) * (1.0 if mode == "F" else 0.001)
    return np.where(np.isfinite(depth) & (depth > 0.0), depth, 0.0).astype(np.float32)


def _compressed_depth(message: Any, source: str, max_pixels: int) -> NDArray[np.floating[Any]]:
    encoding, _, codec = (part.strip() for part in message.format.partition(";"))
    data = message.data.tobytes()
    if "rvl" in codec.lower() or "jpeg" in message.format or "jpg" in message.format:
        reason = f"its depth is compressed as '{message.format}'"
        raise InputError(source, reason, "record it raw, or compressed as PNG")
    if "compressedDepth" not in codec:
        return images.read_units(data, source, max_pixels) * 0.001
    units = images.read_units(data[_CONFIG_HEADER.size :], source, max_pixels)
    if encoding != "32FC1":
        return units * 0.001
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
