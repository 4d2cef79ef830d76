"""Bags of ROS 1 and ROS 2 (sqlite3 and MCAP): depth, its camera, colour of its time, and camera poses."""

from __future__ import annotations

import io
import struct
import weakref
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from caryatid.config import RecordingConfig
from caryatid.errors import CaryatidError, InputError
from caryatid.geometry.transforms import Array
from caryatid.io.datasets import NO_COLOUR, NO_POSE, BrokenFrameError, Dataset, OpenOptions, Topics, within
from caryatid.io.images import UNREADABLE
from caryatid.io.transform_tree import SECOND, MissingTransform, TransformTree, is_pose, nearest
from caryatid.sensing.views import View, check_intrinsics

SUFFIXES: Final = (".bag", ".mcap", ".db3")
"""Endings of files that are bags; a folder with a metadata.yaml is one too."""
IMAGE: Final = "sensor_msgs/msg/Image"
COMPRESSED: Final = "sensor_msgs/msg/CompressedImage"
CAMERA: Final = "sensor_msgs/msg/CameraInfo"
TRANSFORMS: Final = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
"""Types of messages that are read."""
DEPTH_ENCODINGS: Final[Mapping[str, str]] = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
"""Encodings of depth → type of a pixel: whole millimetres, or metres."""
COLOUR_ENCODINGS: Final[Mapping[str, tuple[int, tuple[int, ...]]]] = {
    "rgb8": (3, (0, 1, 2)),
    "bgr8": (3, (2, 1, 0)),
    "rgba8": (4, (0, 1, 2)),
    "bgra8": (4, (2, 1, 0)),
    "mono8": (1, (0, 0, 0)),
    "8UC1": (1, (0, 0, 0)),
}
"""Encodings of colour → number of channels, and those that are red, green and blue."""
_WANTED: Final = {"--depth": (IMAGE, COMPRESSED), "--rgb": (IMAGE, COMPRESSED), "--info": (CAMERA,)}
_CALLED: Final = {"--depth": "images", "--rgb": "images", "--info": "cameras"}
_MILLIMETRES: Final = 0.001
_CONFIG_HEADER: Final = struct.Struct("<iff")
"""What comes before a compressed depth image: its format, and two parameters of inverse depth."""


@dataclass(frozen=True, slots=True)
class _Place:
    """Where an image is in a bag, when it was taken [ns], and the frame of its camera."""

    topic: str
    number: int
    received: int
    twin: int
    time: int
    frame: str


@dataclass(frozen=True, eq=False, slots=True)
class _Camera:
    time: int
    frame: str
    K: Array
    size: tuple[int, int]
    distorts: bool


@dataclass(frozen=True, eq=False, slots=True)
class _Frame:
    bag: _Bag
    depth: _Place
    colour: _Place | None
    camera: _Camera
    T_world_camera: Array | None
    far: float
    info_topic: str
    has_labels: bool = False

    @property
    def name(self) -> str:
        return f"{self.bag.path.name}: depth image {self.number}"

    @property
    def number(self) -> int:
        return self.depth.number

    @property
    def time(self) -> int:
        return self.depth.time

    def load(self) -> View:
        bag, camera = self.bag, self.camera
        depth = within(_depth(bag.message(self.depth), bag.source(self.depth.topic)), self.far)
        size, frame = depth.shape[::-1], self.depth.frame
        source = bag.source(self.info_topic)
        remedy = "give the info topic of the depth images"
        if camera.size != size:
            reason = f"is the camera of {_size(camera.size)} pixel images, the depth has {_size(size)}"
            raise InputError(source, reason, remedy)
        if camera.frame != frame:
            raise InputError(source, f"is the camera '{camera.frame}', the depth is of '{frame}'", remedy)
        rgb = None
        if self.colour is not None:
            rgb = _colour(bag.message(self.colour), bag.source(self.colour.topic))
            if rgb.shape[:2] != depth.shape or self.colour.frame != frame:
                raise InputError(
                    bag.path,
                    f"depth ({_size(size)}, frame '{frame}') is not registered to colour "
                    f"({_size(rgb.shape[1::-1])}, frame '{self.colour.frame}')",
                    "give the topic of depth aligned to colour, or leave --rgb out",
                )
        return View(depth=depth, K=camera.K, T_world_camera=self.T_world_camera, rgb=rgb, name=self.name)


def recognises(path: Path) -> bool:
    """Whether a path looks like a bag."""
    return path.suffix in SUFFIXES if path.is_file() else (path / "metadata.yaml").is_file()


def open_dataset(path: Path, config: RecordingConfig, options: OpenOptions) -> Dataset:
    """Open a bag.

    Args:
        path: `.bag`, `.mcap`, `.db3`, or a folder with a metadata.yaml.
        config: Limits of time and range.
        options: The topics.

    Raises:
        InputError: `rosbags` is not installed; the bag is damaged, empty, lacks a topic or a frame, or its
            images do not fit each other.
    """
    if options.camera_file is not None:
        raise InputError("--camera", "is for TUM RGB-D folders", "a bag has its camera in --info TOPIC")
    bag, topics = _Bag(path), options.topics
    depth_topic = bag.require("--depth", topics.depth)
    info_topic = bag.require("--info", topics.info)
    rgb_topic = None if topics.rgb is None else bag.require("--rgb", topics.rgb)
    cameras = _read_cameras(bag, info_topic)
    tree = _read_transforms(bag, topics, config)
    depths, millimetres = bag.places(depth_topic)
    colours = None if rgb_topic is None else sorted(bag.places(rgb_topic)[0], key=lambda place: place.time)
    if tree is not None:
        for frame in dict.fromkeys([topics.world, *(depth.frame for depth in depths)]):
            if frame not in tree.frames:
                known = f"there are {', '.join(tree.frames)}"
                raise InputError(path, f"there is no frame '{frame}' in its transforms", known)
    camera_times, colour_times = [c.time for c in cameras], [c.time for c in colours or ()]
    frames, skipped = [], Counter[str]()
    for depth in depths:
        colour, T_world_camera = None, None
        if colours is not None:
            index = nearest(colour_times, depth.time)
            if index is None or abs(colour_times[index] - depth.time) > config.colour_gap * SECOND:
                skipped[NO_COLOUR] += 1
                continue
            colour = colours[index]
        if tree is not None and topics.world is not None:
            try:
                T_world_camera = tree.between(topics.world, depth.frame, depth.time)
            except MissingTransform:
                skipped[NO_POSE] += 1
                continue
        camera = cameras[nearest(camera_times, depth.time) or 0]
        frames.append(_Frame(bag, depth, colour, camera, T_world_camera, config.far, info_topic))
    notes = []
    if topics.world is None:
        notes.append("no --tf FRAME: poses are not known, a single frame is taken")
    if any(camera.distorts for camera in cameras):
        notes.append("the lens distorts, and a pinhole is assumed: give rectified topics, unless these are")
    frames.sort(key=lambda frame: (frame.time, frame.number))
    scale = 1.0 if millimetres else None
    return Dataset(path, frames, skipped, tuple(notes), is_video=True, depth_scale=scale)


class _Bag:
    """An open bag; closed once no frame of it is left."""

    def __init__(self, path: Path) -> None:
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ImportError:
            raise InputError(path, "reading bags needs rosbags", 'pip install "caryatid[ros]"') from None
        self.path = path
        empty = "the bag is empty"
        if path.is_file() and path.stat().st_size == 0:
            raise InputError(path, empty, "record it again")
        with _damage(path):
            # Before ROS 2 Iron sqlite3 bags did not say how messages are laid out; those read here are alike.
            self._reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            self._reader.open()
        weakref.finalize(self, self._reader.close)
        self._types = {c.topic: c.msgtype for c in self._reader.connections}
        if not self._reader.message_count:
            raise InputError(path, f"{empty}: it holds no message", "record it again")

    def source(self, topic: str) -> str:
        """What to call a topic in errors."""
        return f"{self.path}: {topic}"

    def topics(self, types: Collection[str]) -> list[str]:
        """Topics with messages of one of these types, by name."""
        return sorted(topic for topic, kind in self._types.items() if kind in types)

    def require(self, option: str, topic: str | None) -> str:
        """Return a topic that exists and is of the type an option wants; otherwise list those that are."""
        fitting = self.topics(_WANTED[option])
        if topic in fitting:
            return topic
        if topic is None:
            reason = f"{option} TOPIC is needed"
        elif topic in self._types:
            reason = f"{option}: '{topic}' holds {self._types[topic]}, not {_CALLED[option]}"
        else:
            reason = f"{option}: there is no topic '{topic}'"
        others = sorted(set(self._types) - set(fitting))
        listed = f"topics with {_CALLED[option]}: {', '.join(fitting) or 'none'}"
        raise InputError(self.path, reason, f"{listed}; other topics: {', '.join(others) or 'none'}")

    def messages(self, topics: Collection[str], *times: int) -> Iterator[tuple[str, int, Any]]:
        """Topic, time of receipt [ns] and message, in the order of receipt, within times [ns] if given."""
        connections = [c for c in self._reader.connections if c.topic in topics]
        if not connections:
            return
        with _damage(self.path):
            messages = self._reader.messages(connections, *times)
        while True:
            with _damage(self.path):
                item = next(messages, None)
                if item is None:
                    return
                connection, received, data = item
                message = self._reader.deserialize(data, connection.msgtype)
            yield connection.topic, int(received), message

    def places(self, topic: str) -> tuple[list[_Place], bool]:
        """All images of a topic, and whether they hold whole millimetres if they are of depth."""
        places: list[_Place] = []
        twins, millimetres = Counter[int](), True
        for number, (_, received, message) in enumerate(self.messages([topic])):
            time, frame = _stamp(message.header, received), message.header.frame_id.removeprefix("/")
            places.append(_Place(topic, number, received, twins[received], time, frame))
            twins[received] += 1
            compressed = message.__msgtype__ == COMPRESSED
            encoding = message.format[:5] if compressed else message.encoding
            millimetres = millimetres and encoding != "32FC1"
        return places, millimetres

    def message(self, place: _Place) -> Any:
        """The message of an image."""
        found = self.messages([place.topic], place.received, place.received + 1)
        for _, _, message in islice(found, place.twin, None):
            return message
        raise InputError(self.path, "has been changed while it was read", "import it again")


def _read_cameras(bag: _Bag, topic: str) -> list[_Camera]:
    cameras = []
    for _, received, message in bag.messages([topic]):
        source, region = bag.source(topic), message.roi
        whole = ((0, 0), (message.width, message.height))
        cropped = region.x_offset or region.y_offset or (region.width, region.height) not in whole
        if cropped or max(message.binning_x, message.binning_y) > 1:
            raise InputError(source, "its images are cropped or binned", "record the camera's whole images")
        # ROS 1 names the matrices in capitals.
        K, D = (message.K, message.D) if hasattr(message, "K") else (message.k, message.d)
        K = np.array(K, dtype=np.float64).reshape(3, 3)
        if not K.any():
            reason = "says the camera is not calibrated: K is 0"
            raise InputError(source, reason, "calibrate it, and record again")
        frame, size = message.header.frame_id.removeprefix("/"), (int(message.width), int(message.height))
        time = _stamp(message.header, received)
        cameras.append(_Camera(time, frame, check_intrinsics(K, source), size, bool(np.any(D))))
    if not cameras:
        raise InputError(bag.path, f"'{topic}' holds no message", "record the camera's info too")
    return sorted(cameras, key=lambda camera: camera.time)


def _read_transforms(bag: _Bag, topics: Topics, config: RecordingConfig) -> TransformTree | None:
    if topics.world is None:
        return None
    tree = TransformTree(config.pose_gap)
    for topic, received, message in bag.messages(bag.topics(TRANSFORMS)):
        for item in message.transforms:
            t, q = item.transform.translation, item.transform.rotation
            pose = (t.x, t.y, t.z, q.x, q.y, q.z, q.w)
            if is_pose(pose):
                parent, child = (
                    name.removeprefix("/") for name in (item.header.frame_id, item.child_frame_id)
                )
                time = _stamp(item.header, received)
                tree.add(parent, child, time, pose, fixed=topic.endswith("tf_static"))
    if not tree.frames:
        raise InputError(bag.path, "holds no transforms", "record /tf and /tf_static, or leave --tf out")
    return tree


def _stamp(header: Any, received: int) -> int:
    """The header's time [ns], or when it was received where that is 0."""
    return int(header.stamp.sec * SECOND + header.stamp.nanosec) or received


def _depth(message: Any, source: str) -> NDArray[np.float32]:
    """Depth (H, W) [m] of an image message, compressed or not; 0 = no reading."""
    if message.__msgtype__ == COMPRESSED:
        return _compressed_depth(message, source)
    if message.encoding not in DEPTH_ENCODINGS:
        raise _unknown(source, message.encoding, DEPTH_ENCODINGS, "depth")
    pixels = _pixels(message, DEPTH_ENCODINGS[message.encoding], 1, source)[:, :, 0]
    return _cleaned(pixels.astype(np.float32) if pixels.dtype.kind == "f" else pixels * _MILLIMETRES)


def _colour(message: Any, source: str) -> NDArray[np.uint8]:
    """Colour (H, W, 3) of an image message, compressed or not; grey images have three equal channels."""
    if message.__msgtype__ == COMPRESSED:
        return _decoded(message.data.tobytes(), "RGB", source)
    if message.encoding not in COLOUR_ENCODINGS:
        raise _unknown(source, message.encoding, COLOUR_ENCODINGS, "colour")
    count, channels = COLOUR_ENCODINGS[message.encoding]
    return np.ascontiguousarray(_pixels(message, "u1", count, source)[:, :, channels])


def _pixels(message: Any, kind: str, channels: int, source: str) -> NDArray[Any]:
    """Pixels (H, W, channels) of a raw image: rows may be padded, and numbers big-endian."""
    dtype = np.dtype((">" if message.is_bigendian else "<") + kind)
    height, width, step = int(message.height), int(message.width), int(message.step)
    row = width * channels * dtype.itemsize
    data = np.asarray(message.data, dtype=np.uint8)
    if not height or not width or step < row or data.size < height * step:
        raise BrokenFrameError(source, "an image has less data than its size says", "record it again")
    rows = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :row])
    return rows.view(dtype).reshape(height, width, channels).astype(dtype.newbyteorder("="))


def _compressed_depth(message: Any, source: str) -> NDArray[np.float32]:
    encoding, _, codec = (part.strip() for part in message.format.partition(";"))
    data = message.data.tobytes()
    if "rvl" in codec.lower() or "jpeg" in message.format or "jpg" in message.format:
        reason = f"its depth is compressed as '{message.format}'"
        raise InputError(source, reason, "record it raw, or compressed as PNG")
    if "compressedDepth" not in codec:
        return _cleaned(_decoded(data, "I;16", source) * _MILLIMETRES)
    if len(data) < _CONFIG_HEADER.size:
        raise BrokenFrameError(source, "an image is cut off", "record it again")
    units = _decoded(data[_CONFIG_HEADER.size :], "I;16", source)
    if encoding != "32FC1":
        return _cleaned(units * _MILLIMETRES)
    _, scale, offset = _CONFIG_HEADER.unpack_from(data)
    with np.errstate(divide="ignore", invalid="ignore"):
        return _cleaned(np.where(units > 0, scale / (units - np.float64(offset)), 0.0))


def _decoded(data: bytes, mode: str, source: str) -> NDArray[Any]:
    """Pixels of a PNG or JPEG as colour (`RGB`), or as 16-bit numbers (`I;16`)."""
    try:
        with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as image:
            if mode == "RGB":
                return np.array(image.convert("RGB"))
            if image.mode.startswith("I"):
                return np.array(image).astype(np.uint16)
            reason = f"has pixels of mode {image.mode}"
    except (*UNREADABLE, Image.DecompressionBombError) as error:
        reason = f"is broken ({error})"
    raise BrokenFrameError(source, f"an image {reason}", "record it again")


def _cleaned(depth: NDArray[Any]) -> NDArray[np.float32]:
    """Depth without what is no reading: NaN, infinity and numbers below 0 become 0."""
    return np.where(np.isfinite(depth) & (depth > 0.0), depth, 0.0).astype(np.float32)


def _unknown(source: str, encoding: str, known: Mapping[str, Any], what: str) -> InputError:
    reason = f"its encoding '{encoding}' is none of {what}"
    return InputError(source, reason, f"record a topic with {', '.join(known)}")


def _size(size: tuple[int, ...]) -> str:
    return f"{size[0]}×{size[1]}"


@contextmanager
def _damage(path: Path) -> Iterator[None]:
    """Turn whatever the library raises on bytes no program wrote into one sentence."""
    remedies = {
        ".bag": "try `rosbag reindex`, or record it again",
        ".mcap": "try `mcap recover`, or record it again",
    }
    remedy = remedies.get(path.suffix, "try `ros2 bag reindex`, or record it again")
    try:
        yield
    except CaryatidError:
        raise
    except MemoryError as error:
        raise InputError(path, "is damaged, or more than this machine's memory holds", remedy) from error
    except Exception as error:
        words = " ".join(str(error).split()) or type(error).__name__
        short = words if len(words) <= 120 else words[:119] + "…"
        if "not supported" in words or "Profile" in words:
            remedy = "try a newer version, pip install --upgrade rosbags, or convert the bag"
            raise InputError(path, f"is of a kind rosbags does not read ({short})", remedy) from error
        raise InputError(path, f"is damaged or was cut off ({short})", remedy) from error
