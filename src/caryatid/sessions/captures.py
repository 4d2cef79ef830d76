"""One view as it is handed in and kept: encoded images and the camera that took them."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import NDArray

from caryatid.config import SessionConfig
from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.io.images import DEPTH_MODES, MASK_MODES, decode_image, png
from caryatid.io.json_files import Numbers, parse_json, read_json
from caryatid.sensing.views import View, check_intrinsics

REMEDY: Final = "take this view and all later ones out of the session's folder"
"""What to do where a kept view is damaged."""

_NPY: Final = b"\x93NUMPY"
_MODES: Final = {
    "depth": (DEPTH_MODES, "a 16-bit grey PNG"),
    "rgb": (("RGB", "RGBA", "L", "LA", "P"), "a colour PNG or JPEG"),
    "labels": (tuple(m for m in MASK_MODES if m != "1"), "a grey PNG"),
}
_ARRAYS: Final = {
    "depth": ("f", 2, "(H, W) of floats in metres"),
    "rgb": ("u", 3, "(H, W, 3) of uint8"),
    "labels": ("iu", 2, "(H, W) of whole numbers"),
    "normals": ("f", 3, "(H, W, 3) of floats"),
}


@dataclass(frozen=True, eq=False, slots=True)
class Entry:
    """What is known of a kept view without decoding it.

    Attributes:
        digest: Digest of its content.
        T_world_camera: Camera pose (4, 4) as it was handed in.
    """

    digest: str
    T_world_camera: Annotated[Array, Numbers(4, 4)]


@dataclass(frozen=True, eq=False, slots=True)
class _Camera:
    """camera.json."""

    K: Annotated[Array, Numbers(3, 3)]
    T_world_camera: Annotated[Array, Numbers(4, 4)]
    depth_scale: float = 1.0
    name: str = ""
    digest: str = ""


@dataclass(frozen=True, eq=False, slots=True)
class Capture:
    """One view, not decoded yet.

    Attributes:
        images: Files: `depth` and, where given, `rgb` and `labels`; PNG (rgb also JPEG), or .npy: depth
            (H, W) floats [m], rgb (H, W, 3) uint8, labels (H, W) whole numbers.
        K: Pinhole matrix (3, 3) [px].
        T_world_camera: Camera pose (4, 4).
        depth_scale: Millimetres of one unit of a depth PNG.
        name: What to call the view in messages.
    """

    images: Mapping[str, bytes]
    K: Array
    T_world_camera: Array
    depth_scale: float = 1.0
    name: str = field(default="view", kw_only=True)

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
        return cls(images, view.K, view.pose, name=view.name)

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
        given = parse_json(
            _Camera, read_json(camera), camera, "give K (3×3) and T_world_camera (4×4, in metres)"
        )
        return cls.checked(images, given.K, given.T_world_camera, given.depth_scale, str(camera), str(depth))

    @classmethod
    def checked(
        cls,
        images: Mapping[str, bytes],
        K: Array,
        T_world_camera: Array,
        depth_scale: float,
        source: str,
        name: str,
    ) -> Capture:
        """Return a capture after checking its camera.

        Args:
            images: Files by `depth`, `rgb` and `labels`.
            K: Pinhole matrix (3, 3) [px].
            T_world_camera: Camera pose (4, 4).
            depth_scale: Millimetres of one unit of a depth PNG.
            source: What to call the camera in errors.
            name: What to call the view.

        Raises:
            InputError: No pinhole matrix, no rigid transform, or no scale.
        """
        if not 0.0 < depth_scale < np.inf:
            raise InputError(
                source, f"'depth_scale' is {depth_scale:g}", "give the millimetres of one depth unit"
            )
        K = check_intrinsics(K, f"{source}: K")
        return cls(
            images,
            K,
            transforms.as_rigid(T_world_camera, f"{source}: T_world_camera"),
            depth_scale,
            name=name,
        )

    @property
    def digest(self) -> str:
        """Digest of its content; the name does not count."""
        digest = hashlib.sha256(json.dumps(self._camera()).encode())
        for key in sorted(self.images):
            digest.update(f"{key} {len(self.images[key])}\0".encode() + self.images[key])
        return digest.hexdigest()

    @property
    def entry(self) -> Entry:
        """What is known of it without decoding it."""
        return Entry(self.digest, self.T_world_camera)

    def files(self) -> dict[str, bytes]:
        """Return the files that are kept: name → content."""
        document = self._camera() | {"name": self.name, "digest": self.digest}
        files = {f"{key}{_suffix(content)}": content for key, content in self.images.items()}
        return files | {"camera.json": (json.dumps(document, indent=1) + "\n").encode()}

    @classmethod
    def read(cls, folder: Path) -> Capture:
        """Read the files of a kept view.

        Raises:
            InputError: Something is missing, or is not what was written.
        """
        path = folder / "camera.json"
        camera = parse_json(_Camera, read_json(path, REMEDY), path, REMEDY)
        images = {file.stem: _read(file, None) for file in folder.iterdir() if file.stem in _ARRAYS}
        capture = cls.checked(
            images, camera.K, camera.T_world_camera, camera.depth_scale, str(path), camera.name
        )
        if capture.digest != camera.digest:
            raise InputError(folder, "is not what was written there", REMEDY)
        return capture

    def decode(self, config: SessionConfig) -> View:
        """Decode the images.

        Raises:
            InputError: One is broken, too large, of the wrong kind, or sizes differ.
        """
        if "depth" not in self.images:
            raise InputError(self.name, "has no depth", "give a depth image")
        decoded = {
            key: _decoded(key, content, f"{self.name}: {key}", config.max_pixels)
            for key, content in self.images.items()
        }
        depth = decoded["depth"]
        if depth.dtype.kind in "iu":
            depth = (depth.astype(np.float64) * (self.depth_scale / 1000.0)).astype(np.float32)
        return View(
            depth=depth,
            K=self.K,
            T_world_camera=self.T_world_camera,
            rgb=decoded.get("rgb"),
            labels=decoded.get("labels"),
            normals_camera=decoded.get("normals"),
            name=self.name,
        )

    def _camera(self) -> dict[str, Any]:
        return {
            "K": self.K.tolist(),
            "T_world_camera": self.T_world_camera.tolist(),
            "depth_scale": self.depth_scale,
        }


def read_entry(folder: Path) -> Entry:
    """Read what is known of a kept view without decoding it.

    Raises:
        InputError: Its camera.json is missing or broken.
    """
    path = folder / "camera.json"
    return parse_json(Entry, read_json(path, REMEDY), path, REMEDY)


def _decoded(key: str, content: bytes, name: str, most: int) -> NDArray[Any]:
    if content.startswith(_NPY):
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
    file, remedy = io.BytesIO(content), "save it with numpy.save"
    header = np.lib.format
    try:
        first = header.read_magic(file) == (1, 0)
        read = header.read_array_header_1_0 if first else header.read_array_header_2_0
        shape, _, dtype = read(file)
    except (ValueError, EOFError, SyntaxError, OverflowError, MemoryError, RecursionError) as error:
        raise InputError(name, f"is no .npy ({str(error).splitlines()[0]})", remedy) from None
    kinds, dimensions, wanted = _ARRAYS[key]
    if (
        dtype.hasobject
        or dtype.kind not in kinds
        or len(shape) != dimensions
        or 0 in shape
        or shape[2:] not in ((), (3,))
    ):
        raise InputError(name, f"is {shape} of {dtype}", f"give {wanted}")
    if key == "rgb" and dtype != np.uint8:
        raise InputError(name, f"is {shape} of {dtype}", f"give {wanted}")
    if shape[0] * shape[1] > most:
        raise InputError(name, f"has shape {shape}, {most} pixels are allowed", "give a smaller image")
    if len(content) - file.tell() != int(np.prod(shape)) * dtype.itemsize:
        raise InputError(name, "the array is truncated or has more than it says", remedy)
    file.seek(0)
    array: NDArray[Any] = header.read_array(file, allow_pickle=False)
    return np.ascontiguousarray(array).astype(dtype.newbyteorder("="), copy=False)


def _npy(array: NDArray[Any]) -> bytes:
    file = io.BytesIO()
    np.save(file, np.ascontiguousarray(array), allow_pickle=False)
    return file.getvalue()


def _suffix(content: bytes) -> str:
    if content.startswith(_NPY):
        return ".npy"
    return ".jpg" if content.startswith(b"\xff\xd8") else ".png"


def _read(path: Path, most: int | None) -> bytes:
    try:
        if most is not None and path.stat().st_size > most:
            raise InputError(path, f"is larger than {most} bytes", "give a smaller file")
        return path.read_bytes()
    except FileNotFoundError:
        raise InputError(path, "the file is missing", "give one that is there") from None
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})", "give a file you may read") from None
