"""Messages of robots turned into what caryatid knows: images, cameras, poses; ROS 1 and ROS 2 alike."""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from caryatid.errors import InputError
from caryatid.geometry.transforms import Array
from caryatid.io.recordings.transform_tree import SECOND, is_pose
from caryatid.sensing.views import check_intrinsics

IMAGE: Final = "sensor_msgs/msg/Image"
COMPRESSED: Final = "sensor_msgs/msg/CompressedImage"
CAMERA: Final = "sensor_msgs/msg/CameraInfo"
TRANSFORMS: Final = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
"""Types of messages that are read."""

DEPTH_ENCODINGS: Final[Mapping[str, str]] = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
"""Encodings of depth → type of a pixel: whole millimetres, or metres."""
COLOUR_ENCODINGS: Final[Mapping[str, tuple[int, ...]]] = {
    "rgb8": (0, 1, 2),
    "bgr8": (2, 1, 0),
    "rgba8": (0, 1, 2),
    "bgra8": (2, 1, 0),
    "mono8": (0, 0, 0),
    "8UC1": (0, 0, 0),
}
"""Encodings of colour → the channels that are red, green and blue."""
_CHANNELS: Final[Mapping[str, int]] = {"rgba8": 4, "bgra8": 4, "mono8": 1, "8UC1": 1}
_MILLIMETRES: Final = 0.001
_CONFIG_HEADER: Final = struct.Struct("<iff")
"""What comes before a compressed depth image: its format, and two parameters of inverse depth."""


class BrokenMessageError(Exception):
    """A message that cannot be decoded; others of its topic may be whole."""


def stamp(header: Any, received: int) -> int:
    """When what a message tells was so [ns]: its header's time, or when it was received where that is 0."""
    time = header.stamp.sec * SECOND + header.stamp.nanosec
    return int(time) or received


def frame_name(name: str) -> str:
    """A frame's name as all messages have it: older ones put a slash before it."""
    return name.removeprefix("/")


def depth_of(message: Any, topic: str) -> NDArray[np.float32]:
    """Depth (H, W) [m] of an image message, compressed or not; 0 = no reading.

    Args:
        message: As `rosbags` gives it.
        topic: Where it was sent, for messages.

    Raises:
        InputError: The encoding is none of depth.
        BrokenMessageError: The message cannot be decoded.
    """
    if message.__msgtype__ == COMPRESSED:
        return _compressed_depth(message, topic)
    if message.encoding not in DEPTH_ENCODINGS:
        raise _unknown(topic, message.encoding, DEPTH_ENCODINGS, "depth")
    pixels = _pixels(message, DEPTH_ENCODINGS[message.encoding], 1)[:, :, 0]
    return _cleaned(pixels.astype(np.float32) if pixels.dtype.kind == "f" else pixels * _MILLIMETRES)


def colour_of(message: Any, topic: str) -> NDArray[np.uint8]:
    """Colour (H, W, 3) of an image message, compressed or not; grey images have three equal channels.

    Args:
        message: As `rosbags` gives it.
        topic: Where it was sent, for messages.

    Raises:
        InputError: The encoding is none of colour.
        BrokenMessageError: The message cannot be decoded.
    """
    if message.__msgtype__ == COMPRESSED:
        return _decoded(message.data.tobytes(), "RGB")
    if message.encoding not in COLOUR_ENCODINGS:
        raise _unknown(topic, message.encoding, COLOUR_ENCODINGS, "colour")
    pixels = _pixels(message, "u1", _CHANNELS.get(message.encoding, 3))
    return np.ascontiguousarray(pixels[:, :, COLOUR_ENCODINGS[message.encoding]])


def counts_millimetres(message: Any) -> bool:
    """Whether an image message holds depth in whole millimetres."""
    if message.__msgtype__ == COMPRESSED:
        return not message.format.startswith("32FC1")
    return DEPTH_ENCODINGS.get(message.encoding) == "u2"


def camera_of(message: Any, topic: str) -> tuple[Array, tuple[int, int], bool]:
    """Pinhole matrix (3, 3) [px], width and height [px], and whether the lens is said to distort.

    Raises:
        InputError: The camera is not calibrated, or its images are cropped or binned.
    """
    region = message.roi
    cropped = (
        region.x_offset
        or region.y_offset
        or (region.width, region.height)
        not in (
            (0, 0),
            (message.width, message.height),
        )
    )
    if cropped or max(message.binning_x, message.binning_y) > 1:
        raise InputError(topic, "its images are cropped or binned", "record the camera's whole images")
    K = np.array(message.K if hasattr(message, "K") else message.k, dtype=np.float64).reshape(3, 3)
    if not K.any():
        raise InputError(topic, "says the camera is not calibrated: K is 0", "calibrate it, and record again")
    distortion = message.D if hasattr(message, "D") else message.d
    return check_intrinsics(K, topic), (int(message.width), int(message.height)), bool(np.any(distortion))


def poses_of(message: Any, received: int) -> Iterator[tuple[str, str, int, tuple[float, ...]]]:
    """Parent, child, time [ns], and translation [m] with quaternion, w last, of each pose of a message."""
    for item in message.transforms:
        t, q = item.transform.translation, item.transform.rotation
        pose = (t.x, t.y, t.z, q.x, q.y, q.z, q.w)
        if is_pose(pose):
            parent, child = frame_name(item.header.frame_id), frame_name(item.child_frame_id)
            yield parent, child, stamp(item.header, received), pose


def _pixels(message: Any, kind: str, channels: int) -> NDArray[Any]:
    """Pixels (H, W, channels) of a raw image: rows may be padded, and numbers big-endian."""
    order = ">" if message.is_bigendian else "<"
    dtype = np.dtype(order + kind)
    height, width, step = int(message.height), int(message.width), int(message.step)
    row = width * channels * dtype.itemsize
    data = np.asarray(message.data, dtype=np.uint8)
    if not height or not width or step < row or data.size < height * step:
        raise BrokenMessageError
    rows = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :row])
    return rows.view(dtype).reshape(height, width, channels).astype(dtype.newbyteorder("="))


def _compressed_depth(message: Any, topic: str) -> NDArray[np.float32]:
    encoding, _, codec = (part.strip() for part in message.format.partition(";"))
    data = message.data.tobytes()
    if "rvl" in codec.lower() or "jpeg" in message.format or "jpg" in message.format:
        raise InputError(
            topic, f"its depth is compressed as '{message.format}'", "record it raw, or compressed as PNG"
        )
    if "compressedDepth" not in codec:
        return _cleaned(_decoded(data, "I;16") * _MILLIMETRES)
    if len(data) < _CONFIG_HEADER.size:
        raise BrokenMessageError
    units = _decoded(data[_CONFIG_HEADER.size :], "I;16")
    if encoding != "32FC1":
        return _cleaned(units * _MILLIMETRES)
    _, scale, offset = _CONFIG_HEADER.unpack_from(data)
    with np.errstate(divide="ignore", invalid="ignore"):
        return _cleaned(np.where(units > 0, scale / (units - np.float64(offset)), 0.0))


def _decoded(data: bytes, mode: str) -> NDArray[Any]:
    """Pixels of a PNG or JPEG as colour (`RGB`), or as 16-bit numbers (`I;16`)."""
    try:
        with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as image:
            if mode == "RGB":
                return np.array(image.convert("RGB"))
            if not image.mode.startswith("I"):
                raise BrokenMessageError
            return np.array(image).astype(np.uint16)
    except (OSError, SyntaxError, ValueError, EOFError, struct.error, Image.DecompressionBombError) as error:
        raise BrokenMessageError from error


def _cleaned(depth: NDArray[Any]) -> NDArray[np.float32]:
    """Depth without what is no reading: NaN, infinity and numbers below 0 become 0."""
    return np.where(np.isfinite(depth) & (depth > 0.0), depth, 0.0).astype(np.float32)


def _unknown(topic: str, encoding: str, known: Mapping[str, Any], what: str) -> InputError:
    return InputError(
        topic, f"its encoding '{encoding}' is none of {what}", f"record a topic with {', '.join(known)}"
    )
