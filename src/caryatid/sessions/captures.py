"""One view as it is handed in and kept: encoded images and the camera that took them."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from annotated_types import Gt
from numpy.typing import NDArray

from caryatid.config import SessionConfig
from caryatid.errors import InputError
from caryatid.geometry.transforms import Array
from caryatid.io.images import DEPTH_MODES, MASK_MODES, decode_image, png
from caryatid.io.json_files import Numbers, parse_json, read_json
from caryatid.sensing.views import View

REMEDY: Final = "take this view and all later ones out of the session's folder"
"""What to do where a kept view is damaged."""

_MODES: Final = {
    "depth": (DEPTH_MODES, "a 16-bit grey PNG"),
    "rgb": (("RGB", "RGBA", "L", "LA", "P"), "a colour PNG or JPEG"),
    "labels": (tuple(m for m in MASK_MODES if m != "1"), "a grey PNG"),
}
_ARRAYS: Final[dict[str, tuple[type[np.generic], tuple[int, ...], str]]] = {
    "depth": (np.floating, (), "(H, W) of floats in metres"),
    "rgb": (np.uint8, (3,), "(H, W, 3) of uint8"),
    "labels": (np.integer, (), "(H, W) of whole numbers"),
    "normals": (np.floating, (3,), "(H, W, 3) of floats"),
}


@dataclass(frozen=True, eq=False, slots=True)
class CameraRecord:
    """camera.json: what is known of a view without decoding its images.

    Attributes:
        K: Pinhole matrix (3, 3) [px].
        T_world_camera: Camera pose (4, 4).
        depth_scale: Millimetres of one unit of a depth PNG.
        name: What to call the view in messages.
        digest: Digest of camera and images; empty where the view is not kept yet.
    """

    K: Annotated[Array, Numbers(3, 3)]
    T_world_camera: Annotated[Array, Numbers(4, 4, rigid=True)]
    depth_scale: Annotated[float, Gt(0.0)] = 1.0
    name: str = "view"
    digest: str = ""

    @classmethod
    def read(cls, path: Path, remedy: str = REMEDY) -> CameraRecord:
        """Read camera.json.

        Raises:
            InputError: It is missing or broken, or the pose is no rigid transform.
        """
        return parse_json(cls, read_json(path, remedy), path, remedy)


@dataclass(frozen=True, eq=False, slots=True)
class Capture:
    """One view, not decoded yet.

    Attributes:
        images: Files: `depth` and, where given, `rgb` and `labels`; PNG (rgb also JPEG), or .npy: depth
            (H, W) floats [m], rgb (H, W, 3) uint8, labels (H, W) whole numbers.
        camera: The camera that took them; its digest does not count.
    """

    images: Mapping[str, bytes]
    camera: CameraRecord

    @classmethod
    def of(cls, view: View) -> Capture:
        """Return the capture that decodes to exactly this view.

        Raises:
            InputError: It has no pose.
        """
        images = {"depth": _npy(view.depth)}
        if view.rgb is not None:
            images["rgb"] = png(view.rgb)
        if view.labels is not None:
            images["labels"] = png(view.labels.astype(np.uint16))
        if view.normals_camera is not None:
            images["normals"] = _npy(view.normals_camera)
        return cls(images, CameraRecord(view.K, view.pose, name=view.name))

    @classmethod
    def from_files(
        cls, depth: Path, camera: Path, rgb: Path | None, labels: Path | None, config: SessionConfig
    ) -> Capture:
        """Read the files of one view.

        Args:
            depth: Depth image.
            camera: JSON with K, T_world_camera and, for a depth PNG, depth_scale.
            rgb: Colour image, or None.
            labels: Label image, or None.
            config: How large images may be.

        Raises:
            InputError: One is missing or too large, or the camera is not valid.
        """
        named = {"depth": depth, "rgb": rgb, "labels": labels}
        images = {key: _read(path, config.max_bytes) for key, path in named.items() if path is not None}
        given = CameraRecord.read(camera, "give K (3×3) and T_world_camera (4×4, in metres)")
        return cls(images, replace(given, name=str(depth)))

    @classmethod
    def read(cls, folder: Path) -> Capture:
        """Read the files of a kept view.

        Raises:
            InputError: Something is missing, or is not what was written.
        """
        camera = CameraRecord.read(folder / "camera.json")
        images = {file.stem: _read(file) for file in folder.iterdir() if file.stem in _ARRAYS}
        capture = cls(images, camera)
        if capture.record.digest != camera.digest:
            raise InputError(folder, "is not what was written there", REMEDY)
        return capture

    @property
    def record(self) -> CameraRecord:
        """The camera with the digest of all but the name."""
        names = ("K", "T_world_camera", "depth_scale")
        seen = {name: getattr(self.camera, name) for name in names}
        digest = hashlib.sha256(json.dumps(seen, default=np.ndarray.tolist).encode())
        for key in sorted(self.images):
            digest.update(f"{key} {len(self.images[key])}\0".encode() + self.images[key])
        return replace(self.camera, digest=digest.hexdigest())

    def files(self) -> dict[str, bytes]:
        """Return the files that are kept: name → content."""
        document = json.dumps(asdict(self.record), indent=1, default=np.ndarray.tolist)
        files = {f"{key}{_suffix(content)}": content for key, content in self.images.items()}
        return files | {"camera.json": f"{document}\n".encode()}

    def decode(self, config: SessionConfig) -> View:
        """Decode the images.

        Raises:
            InputError: One is broken, too large, of the wrong kind, or sizes differ; the camera is no pinhole
                camera, or its pose no rigid transform.
        """
        camera = self.camera
        if "depth" not in self.images:
            raise InputError(camera.name, "has no depth", "give a depth image")
        decoded = {
            key: _decoded(key, content, f"{camera.name}: {key}", config.max_pixels)
            for key, content in self.images.items()
        }
        depth = decoded["depth"]
        if depth.dtype.kind in "iu":
            depth = (depth.astype(np.float64) * (camera.depth_scale / 1000.0)).astype(np.float32)
        return View(
            depth=depth,
            K=camera.K,
            T_world_camera=camera.T_world_camera,
            rgb=decoded.get("rgb"),
            labels=decoded.get("labels"),
            normals_camera=decoded.get("normals"),
            name=camera.name,
        )


def _decoded(key: str, content: bytes, name: str, most: int) -> NDArray[Any]:
    if _suffix(content) == ".npy":
        return _array(key, content, name, most)
    if key not in _MODES:
        raise InputError(name, "is no .npy", "save it with numpy.save")
    image = decode_image(content, name, *_MODES[key], most)
    if key == "rgb":
        channels = image.reshape(*image.shape[:2], -1)[..., :3]
        image = channels if channels.shape[-1] == 3 else np.repeat(channels[..., :1], 3, axis=-1)
    return np.ascontiguousarray(image)


def _array(key: str, content: bytes, name: str, most: int) -> NDArray[Any]:
    """Read a .npy of plain numbers; its header is checked before anything is allocated."""
    file, header, remedy = io.BytesIO(content), np.lib.format, "save it with numpy.save"
    try:
        first = header.read_magic(file) == (1, 0)
        shape, _, dtype = (header.read_array_header_1_0 if first else header.read_array_header_2_0)(file)
    except (ValueError, EOFError, SyntaxError, OverflowError, MemoryError, RecursionError) as error:
        raise InputError(name, f"is no .npy ({str(error).splitlines()[0]})", remedy) from None
    kind, channels, wanted = _ARRAYS[key]
    if not np.issubdtype(dtype, kind) or len(shape) < 2 or shape[2:] != channels or 0 in shape:
        raise InputError(name, f"is {shape} of {dtype}", f"give {wanted}")
    if shape[0] * shape[1] > most:
        raise InputError(name, f"has shape {shape}, {most} pixels are allowed", "give a smaller image")
    if len(content) - file.tell() != int(np.prod(shape)) * dtype.itemsize:
        raise InputError(name, "the array is truncated or has more than it says", remedy)
    array = np.load(io.BytesIO(content), allow_pickle=False)
    return np.ascontiguousarray(array, dtype.newbyteorder("="))


def _npy(array: NDArray[Any]) -> bytes:
    file = io.BytesIO()
    np.save(file, np.ascontiguousarray(array), allow_pickle=False)
    return file.getvalue()


def _suffix(content: bytes) -> str:
    if content.startswith(b"\x93NUMPY"):
        return ".npy"
    return ".jpg" if content.startswith(b"\xff\xd8") else ".png"


def _read(path: Path, most: float = np.inf) -> bytes:
    try:
        if path.stat().st_size > most:
            raise InputError(path, f"is larger than {most} bytes", "give a smaller file")
        return path.read_bytes()
    except FileNotFoundError:
        raise InputError(path, "the file is missing", "give one that is there") from None
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})", "give a file you may read") from None
