"""A view as received: encoded images and their camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
from annotated_types import Gt
from numpy.typing import NDArray

from caryatid.config import SessionConfig
from caryatid.errors import InputError
from caryatid.geometry.transforms import Array
from caryatid.io.images import DEPTH_MODES, MASK_MODES, decode_image, read_npy
from caryatid.io.json_files import Numbers, parse_json, read_json
from caryatid.io.staging import read_errors
from caryatid.sensing.views import View

_FILES: Final = {
    "depth": (DEPTH_MODES, "a 16-bit grey PNG"),
    "rgb": (("RGB", "RGBA", "L", "LA", "P"), "a colour PNG or JPEG"),
    "labels": (MASK_MODES[1:], "a grey PNG"),
}


@dataclass(frozen=True, eq=False, slots=True)
class CameraRecord:
    """camera.json: the data of a view besides its images.

    Attributes:
        K: Pinhole matrix (3, 3) [px].
        T_world_camera: Camera pose (4, 4) [m]; OpenCV camera frame, world z up. The first view may omit it;
            its table then defines the world frame.
        depth_scale: Millimetres per unit of a depth PNG.
        name: Name of the view in messages.
        labels_are: Whether a label identifies an object in all views or a segment of this view.
    """

    K: Annotated[Array, Numbers(3, 3)]
    T_world_camera: Annotated[Array, Numbers(4, 4, rigid=True)] | None = None
    depth_scale: Annotated[float, Gt(0.0)] = 1.0
    name: str = "view"
    labels_are: Literal["objects", "segments"] = "objects"


@dataclass(frozen=True, eq=False, slots=True)
class Capture:
    """One view, not decoded yet.

    Attributes:
        images: Files: `depth` and, if given, `rgb` and `labels`; PNG (rgb also JPEG), or .npy: depth
            (H, W) floats [m], rgb (H, W, 3) uint8, labels (H, W) integers.
        camera: Camera matrix and pose.
    """

    images: Mapping[str, bytes]
    camera: CameraRecord

    @classmethod
    def from_files(cls, files: Mapping[str, Path | None], camera: Path, config: SessionConfig) -> Capture:
        """Read the files of one view.

        Args:
            files: Images: `depth`, and optionally `rgb` and `labels`.
            camera: JSON with K, T_world_camera and, for a depth PNG, depth_scale.
            config: Limits on the size of images.

        Raises:
            InputError: A file is missing or too large, or the camera is not valid.
        """
        images = {key: _read(path, config.max_bytes) for key, path in files.items() if path is not None}
        remedy = "give K (3×3) and, for all views after the first, T_world_camera (4×4, in metres)"
        given = parse_json(CameraRecord, read_json(camera, remedy), camera, remedy)
        return cls(images, replace(given, name=str(files["depth"])))

    def decode(self, max_pixels: int) -> View:
        """Decode the images, each with at most this number of pixels.

        Raises:
            InputError: An image is broken, too large, or of the wrong kind; sizes differ; the camera is not
                a pinhole camera, or its pose is not a rigid transform.
        """
        c, images = self.camera, {name: self._decoded(name, max_pixels) for name in self.images}
        return View(K=c.K, T_world_camera=c.T_world_camera, name=c.name, labels_are=c.labels_are, **images)

    def _decoded(self, key: str, max_pixels: int) -> NDArray[Any]:
        content, name = self.images[key], f"{self.camera.name}: {key}"
        if not content.startswith(b"\x93NUMPY"):
            image = decode_image(content, name, *_FILES[key], max_pixels)
            if key != "depth":
                return image
            return (image.astype(np.float64) * (self.camera.depth_scale / 1000.0)).astype(np.float32)
        array = read_npy(content, name)
        if array.ndim < 2 or (key == "depth" and array.dtype.kind != "f"):
            reason = f"wrong shape {array.shape} or type {array.dtype}"
            raise InputError(name, reason, "give an array (H, W), for depth of floats in metres")
        if array.shape[0] * array.shape[1] > max_pixels:
            reason = f"shape {array.shape} exceeds {max_pixels} pixels"
            raise InputError(name, reason, "give a smaller image, or raise recording.max_pixels")
        return np.ascontiguousarray(array)


def _read(path: Path, max_bytes: float) -> bytes:
    with read_errors(path, "give a readable file"):
        if path.stat().st_size > max_bytes:
            raise InputError(path, f"is larger than {max_bytes} bytes", "give a smaller file")
        return path.read_bytes()
