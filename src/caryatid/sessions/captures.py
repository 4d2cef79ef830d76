"""One view as it is handed in and kept: encoded images and the camera that took them."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from caryatid.config import SessionConfig
from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.io.images import DEPTH_MODES, MASK_MODES, decode_image, png
from caryatid.io.json_files import field as json_field
from caryatid.io.json_files import number, numbers, read_json
from caryatid.sensing.views import View, check_intrinsics

IMAGES: Final = ("depth", "rgb", "labels", "normals")
"""Names of the images of a view; the first one it must have."""

REMEDY: Final = "take this view and all later ones out of the session's folder"
"""What to do where a kept view is damaged."""

_NPY: Final = b"\x93NUMPY"
_MODES: Final = {
    "depth": (DEPTH_MODES, "a 16-bit grey PNG"),
    "rgb": (("RGB", "RGBA", "L", "LA", "P"), "a colour PNG or JPEG"),
    "labels": (tuple(m for m in MASK_MODES if m != "1"), "a grey PNG"),
}


@dataclass(frozen=True, eq=False, slots=True)
class Entry:
    """What is known of a kept view without decoding it.

    Attributes:
        digest: What tells its content from others'.
        T_world_camera: Camera pose (4, 4) as it was handed in.
    """

    digest: str
    T_world_camera: Array


@dataclass(frozen=True, eq=False, slots=True)
class Capture:
    """One view, not decoded yet.

    Attributes:
        images: Of `depth` and, where there are, `rgb` and `labels` the file: PNG (rgb also JPEG), or .npy:
            depth (H, W) floats [m], rgb (H, W, 3) uint8, labels (H, W) whole numbers.
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
        """The capture that decodes to a view, bit by bit.

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
            camera: JSON of the camera.
            rgb: Colour image, or None.
            labels: Label image, or None.
            config: How large images may be.

        Raises:
            InputError: One is missing or too large, or the camera's is no such JSON.
        """
        named = {"depth": depth, "rgb": rgb, "labels": labels}
        images = {key: _read(path, config.max_bytes) for key, path in named.items() if path is not None}
        text = _read(camera, config.max_bytes)
        try:
            document = json.loads(text, parse_constant=_refuse)
        except (ValueError, RecursionError) as error:
            raise InputError(camera, f"broken JSON: {error}", "write the file again") from None
        return cls.from_camera(images, document, camera, depth)

    @classmethod
    def from_camera(
        cls, images: Mapping[str, bytes], document: Any, source: str | Path, name: str | Path
    ) -> Capture:
        """Put images together with what a camera's JSON says: K, T_world_camera, depth_scale.

        Args:
            images: Files by `depth`, `rgb` and `labels`.
            document: What the camera's JSON holds.
            source: What to call it in errors.
            name: What to call the view.

        Raises:
            InputError: A key is missing or not valid.
        """
        where = str(source)
        if not isinstance(document, dict):
            raise InputError(where, "is no JSON object", "give K and T_world_camera")
        if document.get("T_world_camera") is None:
            raise InputError(where, "has no camera pose", "give T_world_camera, 4×4, in metres")
        scale = number(document, "depth_scale", where, default=1.0)
        if scale <= 0.0:
            raise InputError(where, f"'depth_scale' is {scale:g}", "give the millimetres of one depth unit")
        K = numbers(json_field(document, "K", list, where), (3, 3), f"{where}: K")
        T = numbers(document["T_world_camera"], (4, 4), f"{where}: T_world_camera")
        return cls(
            images,
            check_intrinsics(K, f"{where}: K"),
            transforms.as_rigid(T, f"{where}: T_world_camera"),
            scale,
            name=str(name),
        )

    @property
    def digest(self) -> str:
        """What tells its content from others'; names do not count."""
        digest = hashlib.sha256(json.dumps(self._camera()).encode())
        for key in sorted(self.images):
            digest.update(f"{key} {len(self.images[key])}\0".encode() + self.images[key])
        return digest.hexdigest()

    @property
    def entry(self) -> Entry:
        """What is known of it without decoding it."""
        return Entry(self.digest, self.T_world_camera)

    def files(self) -> dict[str, bytes]:
        """What is kept of it: name of a file → content."""
        document = self._camera() | {"name": self.name, "digest": self.digest}
        files = {f"{key}{_suffix(content)}": content for key, content in self.images.items()}
        return files | {"camera.json": (json.dumps(document, indent=1) + "\n").encode()}

    @classmethod
    def read(cls, folder: Path) -> Capture:
        """Read what `files` gave.

        Raises:
            InputError: Something is missing or is not what was written.
        """
        camera = read_json(folder / "camera.json", REMEDY)
        paths = {path.stem: path for path in folder.iterdir() if path.stem in IMAGES}
        images = {key: _read(path, None) for key, path in paths.items()}
        capture = cls.from_camera(images, camera, folder / "camera.json", str(camera.get("name")))
        if capture.digest != camera.get("digest"):
            raise InputError(folder, "is not what was written there", REMEDY)
        return capture

    def decode(self, config: SessionConfig) -> View:
        """Decode the images.

        Raises:
            InputError: One is broken, too large, of the wrong kind, or sizes differ.
        """
        most = config.max_pixels
        if "depth" not in self.images:
            raise InputError(self.name, "has no depth", "give a depth image")
        decoded = {key: _decoded(key, content, self.name, most) for key, content in self.images.items()}
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
    """What is known of a kept view without decoding it.

    Raises:
        InputError: Its camera.json is missing or broken.
    """
    camera, where = read_json(folder / "camera.json", REMEDY), str(folder / "camera.json")
    T = numbers(json_field(camera, "T_world_camera", list, where), (4, 4), f"{where}: T_world_camera")
    return Entry(json_field(camera, "digest", str, where), T)


def _decoded(key: str, content: bytes, view: str, most: int) -> NDArray[Any]:
    name = f"{view}: {key}"
    if content.startswith(_NPY):
        return _checked(key, _array(content, name, most), name)
    if key not in _MODES:
        raise InputError(name, "is no .npy", "save it with numpy.save")
    modes, what = _MODES[key]
    image = decode_image(content, name, modes, what, most)
    if key == "rgb":
        grey = image.reshape(*image.shape[:2], -1)[..., :3]
        image = np.repeat(grey[..., :1], 3, axis=-1) if grey.shape[-1] < 3 else grey
        return np.ascontiguousarray(image)
    return image


def _array(content: bytes, name: str, most: int) -> NDArray[Any]:
    """Read a .npy of plain numbers; its header is looked at before anything is made of it."""
    file, remedy = io.BytesIO(content), "save it with numpy.save"
    try:
        version = np.lib.format.read_magic(file)
        read = (
            np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        )
        shape, _, dtype = read(file)
    except (ValueError, EOFError, SyntaxError, OverflowError, MemoryError, RecursionError) as error:
        raise InputError(name, f"is no .npy ({str(error).splitlines()[0]})", remedy) from None
    if dtype.hasobject or dtype.kind not in "fiu":
        raise InputError(name, f"holds {dtype}, not numbers", remedy)
    if len(shape) not in (2, 3) or any(n < 1 for n in shape):
        raise InputError(name, f"has shape {shape}, not that of an image", remedy)
    if shape[0] * shape[1] > most or (len(shape) == 3 and shape[2] != 3):
        raise InputError(name, f"has shape {shape}, {most} pixels are allowed", "give a smaller image")
    if len(content) - file.tell() != int(np.prod(shape)) * dtype.itemsize:
        raise InputError(name, "the array is truncated or has more than it says", remedy)
    file.seek(0)
    array: NDArray[Any] = np.lib.format.read_array(file, allow_pickle=False)
    return np.ascontiguousarray(array)


def _checked(key: str, array: NDArray[Any], name: str) -> NDArray[Any]:
    """An array of the type that its image has."""
    kinds, dims, wanted = {
        "depth": ("f", 2, "(H, W) of floats in metres"),
        "rgb": ("u", 3, "(H, W, 3) of uint8"),
        "labels": ("iu", 2, "(H, W) of whole numbers"),
        "normals": ("f", 3, "(H, W, 3) of floats"),
    }[key]
    if array.dtype.kind not in kinds or array.ndim != dims or (key == "rgb" and array.dtype != np.uint8):
        raise InputError(name, f"is {array.shape} of {array.dtype}", f"give {wanted}")
    return array.astype(array.dtype.newbyteorder("="), copy=False)


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


def _refuse(constant: str) -> float:
    raise ValueError(f"{constant} is no JSON number")
