"""Bags of ROS 1 and ROS 2 (sqlite3 and MCAP): depth, its camera, colour of its time, and camera poses."""

from __future__ import annotations

import struct
import weakref
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from caryatid.config import RecordingConfig
from caryatid.errors import CaryatidError, InputError
from caryatid.geometry.transforms import Array
from caryatid.io import images
from caryatid.io.datasets import Dataset, OpenOptions
from caryatid.io.images import BrokenImageError
from caryatid.io.video import SECOND, Decoded, TimedImage, TransformTree, is_pose, make_video, nearest
from caryatid.sensing.views import check_intrinsics

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
_CONFIG_HEADER: Final = struct.Struct("<iff")
"""What comes before a compressed depth image: its format, and two parameters of inverse depth."""


@dataclass(frozen=True, slots=True)
class _Image(TimedImage):
    """Where an image is in a bag, and the frame of its camera.

    Of several received at the same time `twin` counts those before it.
    """

    topic: str
    received: int
    twin: int
    frame: str


@dataclass(frozen=True, eq=False, slots=True)
class _Camera:
    time: int
    frame: str
    K: Array
    size: tuple[int, int]
    distorts: bool


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
    depths, millimetres = bag.images(depth_topic)
    colours = None if rgb_topic is None else bag.images(rgb_topic)[0]
    pose_at, notes = None, []
    if topics.world is None:
        notes.append("no --tf FRAME: poses are not known, a single frame is taken")
    else:
        tree, world = _read_transforms(bag, config.pose_gap), topics.world
        for frame in dict.fromkeys([world, *(depth.frame for depth in depths)]):
            if frame not in tree.frames:
                known = f"there are {', '.join(tree.frames)}"
                raise InputError(path, f"there is no frame '{frame}' in its transforms", known)
        pose_at = lambda depth: tree.between(world, depth.frame, depth.time)  # noqa: E731
    if any(camera.distorts for camera in cameras):
        notes.append("the lens distorts, and a pinhole is assumed: give rectified topics, unless these are")
    decode = partial(_decode, bag, cameras, bag.source(info_topic))
    video = make_video(path, depths, colours, pose_at, decode, config)
    return replace(video, notes=tuple(notes), depth_scale=1.0 if millimetres else None)


def _decode(bag: _Bag, cameras: list[_Camera], info: str, at: _Image, colour_at: _Image | None) -> Decoded:
    """Decode a depth image and its colour; both must fit each other and the camera, `info` in errors."""
    camera = cameras[nearest([c.time for c in cameras], at.time) or 0]
    depth = _depth(bag.message(at), bag.source(at.topic))
    size, remedy = depth.shape[::-1], "give the info topic of the depth images"
    if camera.size != size:
        reason = f"is the camera of {_size(camera.size)} pixel images, the depth has {_size(size)}"
        raise InputError(info, reason, remedy)
    if camera.frame != at.frame:
        raise InputError(info, f"is the camera '{camera.frame}', the depth is of '{at.frame}'", remedy)
    if colour_at is None:
        return depth, None, camera.K
    rgb = _colour(bag.message(colour_at), bag.source(colour_at.topic))
    if rgb.shape[:2] != depth.shape or colour_at.frame != at.frame:
        raise InputError(
            bag.path,
            f"depth ({_size(size)}, frame '{at.frame}') is not registered to colour "
            f"({_size(rgb.shape[1::-1])}, frame '{colour_at.frame}')",
            "give the topic of depth aligned to colour, or leave --rgb out",
        )
    return depth, rgb, camera.K


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

    def images(self, topic: str) -> tuple[list[_Image], bool]:
        """All images of a topic, and whether they hold whole millimetres if they are of depth."""
        found: list[_Image] = []
        twins, millimetres = Counter[int](), True
        for number, (_, received, message) in enumerate(self.messages([topic])):
            name = f"{self.path.name}: depth image {number}"
            time, frame = _stamp(message.header, received), _frame(message.header.frame_id)
            found.append(_Image(name, time, topic, received, twins[received], frame))
            twins[received] += 1
            compressed = message.__msgtype__ == COMPRESSED
            millimetres = millimetres and (message.format[:5] if compressed else message.encoding) != "32FC1"
        return found, millimetres

    def message(self, image: _Image) -> Any:
        """The message of an image."""
        found = self.messages([image.topic], image.received, image.received + 1)
        for _, _, message in islice(found, image.twin, None):
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
        frame, size = _frame(message.header.frame_id), (int(message.width), int(message.height))
        time = _stamp(message.header, received)
        cameras.append(_Camera(time, frame, check_intrinsics(K, source), size, bool(np.any(D))))
    if not cameras:
        raise InputError(bag.path, f"'{topic}' holds no message", "record the camera's info too")
    return sorted(cameras, key=lambda camera: camera.time)


def _read_transforms(bag: _Bag, max_gap: float) -> TransformTree:
    tree = TransformTree(max_gap)
    for topic, received, message in bag.messages(bag.topics(TRANSFORMS)):
        for item in message.transforms:
            t, q = item.transform.translation, item.transform.rotation
            pose, time = (t.x, t.y, t.z, q.x, q.y, q.z, q.w), _stamp(item.header, received)
            if is_pose(pose):
                parent, child = _frame(item.header.frame_id), _frame(item.child_frame_id)
                tree.add(parent, child, time, pose, fixed=topic.endswith("tf_static"))
    if not tree.frames:
        raise InputError(bag.path, "holds no transforms", "record /tf and /tf_static, or leave --tf out")
    return tree


def _frame(name: str) -> str:
    """Name of a frame as ROS 2 writes it, without a slash."""
    return name.removeprefix("/")


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
    return _cleaned(pixels.astype(np.float32) if pixels.dtype.kind == "f" else pixels * 0.001)


def _colour(message: Any, source: str) -> NDArray[np.uint8]:
    """Colour (H, W, 3) of an image message, compressed or not; grey images have three equal channels."""
    if message.__msgtype__ == COMPRESSED:
        return images.read_colour(message.data.tobytes(), source)
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
        raise BrokenImageError(source, "an image has less data than its size says", "record it again")
    rows = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :row])
    return rows.view(dtype).reshape(height, width, channels).astype(dtype.newbyteorder("="))


def _compressed_depth(message: Any, source: str) -> NDArray[np.float32]:
    encoding, _, codec = (part.strip() for part in message.format.partition(";"))
    data = message.data.tobytes()
    if "rvl" in codec.lower() or "jpeg" in message.format or "jpg" in message.format:
        reason = f"its depth is compressed as '{message.format}'"
        raise InputError(source, reason, "record it raw, or compressed as PNG")
    if "compressedDepth" not in codec:
        return _cleaned(images.read_units(data, source) * 0.001)
    if len(data) < _CONFIG_HEADER.size:
        raise BrokenImageError(source, "an image is cut off", "record it again")
    units = images.read_units(data[_CONFIG_HEADER.size :], source)
    if encoding != "32FC1":
        return _cleaned(units * 0.001)
    _, scale, offset = _CONFIG_HEADER.unpack_from(data)
    with np.errstate(divide="ignore", invalid="ignore"):
        return _cleaned(np.where(units > 0, scale / (units - np.float64(offset)), 0.0))


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
