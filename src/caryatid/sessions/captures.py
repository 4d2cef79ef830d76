"""A view as received and stored: encoded images and their camera."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
from annotated_types import Gt
from numpy.typing import NDArray
from pydantic.json_schema import SkipJsonSchema

from caryatid.config import SessionConfig
from caryatid.errors import InputError
from caryatid.geometry.transforms import Array
from caryatid.io.images import DEPTH_MODES, MASK_MODES, decode_image, npy, read_npy
from caryatid.io.json_files import Numbers, parse_json, read_json
from caryatid.io.staging import read_errors
from caryatid.sensing.views import View

REMEDY: Final = "delete this view and all later ones from the session folder"
"""Remedy for a damaged view."""

_FILES: Final = {
    "depth": (DEPTH_MODES, "a 16-bit grey PNG"),
    "rgb": (("RGB", "RGBA", "L", "LA", "P"), "a colour PNG or JPEG"),
    "labels": (MASK_MODES[1:], "a grey PNG"),
}
_IMAGES: Final = ("depth", "rgb", "labels", "normals")


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
        digest: Digest of camera and images; empty until the view is stored.
    """

    K: Annotated[Array, Numbers(3, 3)]
    T_world_camera: Annotated[Array, Numbers(4, 4, rigid=True)] | None = None
    depth_scale: Annotated[float, Gt(0.0)] = 1.0
    name: str = "view"
    labels_are: Literal["objects", "segments"] = "objects"
    digest: SkipJsonSchema[str] = ""

    @classmethod
    def read(cls, path: Path, remedy: str = REMEDY) -> CameraRecord:
        """Read camera.json.

        Raises:
            InputError: It is missing or broken, or the pose is not a rigid transform.
        """
        return parse_json(cls, read_json(path, remedy), path, remedy)


@dataclass(frozen=True, eq=False, slots=True)
class Capture:
    """One view, not decoded yet.

    Attributes:
        images: Files: `depth` and, if given, `rgb` and `labels`; PNG (rgb also JPEG), or .npy: depth
            (H, W) floats [m], rgb (H, W, 3) uint8, labels (H, W) integers.
        camera: Camera matrix and pose; its digest is ignored.
    """

    images: Mapping[str, bytes]
    camera: CameraRecord

    @classmethod
    def of(cls, view: View) -> Capture:
        """Return the capture that decodes to exactly this view."""
        arrays = (view.depth, view.rgb, view.labels, view.normals_camera)
        images = {key: npy(array) for key, array in zip(_IMAGES, arrays, strict=True) if array is not None}
        camera = CameraRecord(view.K, view.T_world_camera, name=view.name, labels_are=view.labels_are)
        return cls(images, camera)

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
        given = CameraRecord.read(
            camera, "give K (3×3) and, for all views after the first, T_world_camera (4×4, in metres)"
        )
        return cls(images, replace(given, name=str(files["depth"])))

    @classmethod
    def read(cls, folder: Path) -> Capture:
        """Read the files of a stored view.

        Raises:
            InputError: A file is missing or has changed.
        """
        record = CameraRecord.read(folder / "camera.json")
        images = {file.stem: _read(file) for file in folder.iterdir() if file.stem in _IMAGES}
        capture = cls(images, record)
        if capture.record.digest != record.digest:
            raise InputError(folder, "has changed since it was written", REMEDY)
        return capture

    @property
    def record(self) -> CameraRecord:
        """The record with the digest of all but the name."""
        c = self.camera
        camera: dict[str, Any] = {"K": c.K, "T_world_camera": c.T_world_camera, "depth_scale": c.depth_scale}
        if c.labels_are == "segments":  # sessions begun before masks could be segments have the same digests
            camera["labels_are"] = c.labels_are
        digest = hashlib.sha256(json.dumps(camera, default=np.ndarray.tolist).encode())
        for key in sorted(self.images):
            digest.update(f"{key} {len(self.images[key])}\0".encode() + self.images[key])
        return replace(c, digest=digest.hexdigest())

    def files(self) -> dict[str, bytes]:
        """Return the files to store: name → content."""
        document = json.dumps(asdict(self.record), indent=1, default=np.ndarray.tolist)
        files = {f"{key}{_suffix(content)}": content for key, content in self.images.items()}
        return files | {"camera.json": f"{document}\n".encode()}

    def decode(self, max_pixels: int) -> View:
        """Decode the images, each with at most this number of pixels.

        Raises:
            InputError: An image is broken, too large, or of the wrong kind; sizes differ; the camera is not
                a pinhole camera, or its pose is not a rigid transform.
        """
        camera = self.camera
        decoded = {
            key: _decoded(key, content, f"{camera.name}: {key}", max_pixels)
            for key, content in self.images.items()
        }
        depth, (rgb, labels, normals_camera) = decoded["depth"], map(decoded.get, _IMAGES[1:])
        if _suffix(self.images["depth"]) == ".png":
            depth = (depth.astype(np.float64) * (camera.depth_scale / 1000.0)).astype(np.float32)
        T_world_camera, name = camera.T_world_camera, camera.name
        return View(depth, camera.K, T_world_camera, rgb, labels, normals_camera, name, camera.labels_are)


def _decoded(key: str, content: bytes, name: str, max_pixels: int) -> NDArray[Any]:
    if key in _FILES and _suffix(content) != ".npy":
        return decode_image(content, name, *_FILES[key], max_pixels)
    array = read_npy(content, name)
    if array.ndim < 2 or (key == "depth" and array.dtype.kind != "f"):
        reason = f"wrong shape {array.shape} or type {array.dtype}"
        raise InputError(name, reason, "give an array (H, W), for depth of floats in metres")
    if array.shape[0] * array.shape[1] > max_pixels:
        reason = f"shape {array.shape} exceeds {max_pixels} pixels"
        raise InputError(name, reason, "give a smaller image, or raise recording.max_pixels")
    return np.ascontiguousarray(array)


def _suffix(content: bytes) -> str:
    if content.startswith(b"\x93NUMPY"):
        return ".npy"
    return ".jpg" if content.startswith(b"\xff\xd8") else ".png"


def _read(path: Path, max_bytes: float = np.inf) -> bytes:
    with read_errors(path, "give a readable file"):
        if path.stat().st_size > max_bytes:
            raise InputError(path, f"is larger than {max_bytes} bytes", "give a smaller file")
        return path.read_bytes()
