"""Images and stored arrays, decoded strictly."""

from __future__ import annotations

import io
import json
import warnings
import zipfile
from collections.abc import Collection, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from caryatid.config import RecordingConfig
from caryatid.errors import InputError

DEPTH_MODES: Final = ("I;16", "I;16B", "I")
MASK_MODES: Final = ("1", "L", "P", "I;16", "I;16B", "I")
"""Pillow modes of depth images, and of masks."""
MAX_PIXELS: Final = RecordingConfig().max_pixels
"""Default of the maximum number of pixels."""


class BrokenImageError(InputError):
    """An image that cannot be decoded; other images of its recording may be intact."""


def read_depth(path: Path, depth_scale: float, max_pixels: int = MAX_PIXELS) -> NDArray[np.float32]:
    """Read the depth (H, W) [m], 0 = no reading, of a PNG or TIFF in units of `depth_scale` [mm].

    Raises:
        InputError: Missing, truncated, too large, or neither 16 bit nor floating point.
    """
    units = decode_image(
        path, modes=(*DEPTH_MODES, "F"), what="a 16-bit grey PNG or TIFF", max_pixels=max_pixels
    )
    depth = (units.astype(np.float64) * (depth_scale / 1000.0)).astype(np.float32)
    return np.where(np.isfinite(depth) & (depth > 0.0), depth, np.float32(0.0))


def read_units(image: Path | bytes, name: str = "", max_pixels: int = MAX_PIXELS) -> NDArray[np.int32]:
    """Read the values (H, W) of a 16-bit grey PNG, a file or its content: depth in its own units, or labels.

    Raises:
        InputError: Missing, truncated, too large or not 16 bit.
    """
    return decode_image(image, name, DEPTH_MODES, "a 16-bit grey PNG", max_pixels).astype(np.int32)


def decode_image(
    image: Path | bytes,
    name: str = "",
    modes: tuple[str, ...] | None = None,
    what: str = "",
    max_pixels: int = MAX_PIXELS,
) -> NDArray[Any]:
    """Decode a PNG or JPEG, a file or its content, or a TIFF file: (H, W), or (H, W, 3) if colour is allowed.

    Grey images then have three equal channels. Pillow's `modes` restrict it to `what` the error says.

    Raises:
        InputError: It is missing, broken, too large, or of another mode.
    """
    source, remedy = image if isinstance(image, Path) else name, "copy or record the file again"
    try:
        content = image.read_bytes() if isinstance(image, Path) else image
        formats = ("PNG", "JPEG", "TIFF") if isinstance(image, Path) else ("PNG", "JPEG")
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(content), formats=formats) as whole:
                if whole.format == "PNG":
                    whole.verify()  # decoding ignores a wrong checksum or a missing end
            with Image.open(io.BytesIO(content), formats=formats) as opened:
                width, height = opened.size
                if modes is not None and opened.mode not in modes:
                    reason = f"has pixels of mode {opened.mode}, not {what}"
                    raise BrokenImageError(source, reason, f"save it as {what}")
                if width * height > max_pixels:
                    reason = f"{width}×{height} pixels exceed the limit of {max_pixels}"
                    raise InputError(source, reason, "give a smaller image, or raise recording.max_pixels")
                return np.array(opened.convert("RGB") if modes is None or "RGB" in modes else opened)
    except FileNotFoundError:
        raise BrokenImageError(source, "the file is missing", remedy) from None
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        reason = f"has more than {Image.MAX_IMAGE_PIXELS} pixels"
        raise BrokenImageError(source, reason, "give a smaller image") from None
    except UnidentifiedImageError as error:
        raise BrokenImageError(source, "not an image", remedy) from error
    except (InputError, MemoryError):
        raise
    except Exception as error:  # Pillow raises almost anything for a broken image
        raise BrokenImageError(source, f"the image is truncated or broken ({error})", remedy) from error


def read_mask(image: Path | bytes, name: str = "", max_pixels: int = MAX_PIXELS) -> NDArray[np.bool_]:
    """Read the pixels (H, W) of a grey PNG, a file or its content, that are not 0.

    Raises:
        InputError: As `decode_image`.
    """
    return decode_image(image, name, MASK_MODES, "a grey PNG", max_pixels) > 0


def read_npy(array: Path | bytes, name: str = "") -> NDArray[Any]:
    """Read an array (...) of a .npy, a file or its content.

    Raises:
        InputError: It is missing or broken.
    """
    source = array if isinstance(array, Path) else name
    try:
        content = array.read_bytes() if isinstance(array, Path) else array
        return np.asarray(np.load(io.BytesIO(content), allow_pickle=False))
    except OSError as error:
        raise InputError(source, f"cannot be read ({error.strerror or error})", "give a .npy file") from None
    except Exception:  # NumPy parses the header as Python, so a damaged one raises almost anything
        raise InputError(source, "is not a valid .npy of numbers", "save it with numpy.save") from None


def npy(array: NDArray[Any]) -> bytes:
    """Encode an array (...) as .npy."""
    buffer = io.BytesIO()
    np.save(buffer, np.ascontiguousarray(array), allow_pickle=False)
    return buffer.getvalue()


def png(image: NDArray[np.uint8] | NDArray[np.uint16]) -> bytes:
    """Encode an image, (H, W, 3) uint8 or (H, W) uint8 or uint16, as PNG."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="PNG")
    return buffer.getvalue()


def pack(value: Any) -> bytes:
    """Return the content of a .npz: the value as JSON in the member `document`, larger arrays as members.

    The same value gives the same bytes.
    """
    arrays: dict[str, NDArray[Any]] = {}

    def encoded(value: Any, path: str) -> Any:
        match value:
            case np.ndarray() if 0 < value.size <= 16 and value.dtype == np.float64:
                return {"$array": value.tolist()}
            case np.ndarray():
                arrays[path] = value
                return {"$array": path}
            case np.generic():
                return value.item()
            case Mapping():
                return {key: encoded(item, f"{path}.{key}".strip(".")) for key, item in value.items()}
            case tuple():
                return [encoded(item, f"{path}.{number}") for number, item in enumerate(value)]
        if is_dataclass(value):
            members = {
                f.name: item
                for f in fields(value)
                if f.init and ((item := getattr(value, f.name)) is not None or not f.metadata.get("sparse"))
            }
            return {"$kind": type(value).__name__} | encoded(members, path)
        return value

    arrays["document"] = np.frombuffer(json.dumps(encoded(value, "")).encode(), dtype=np.uint8)
    buffer = io.BytesIO()
    # Higher levels of compression take longer and save little.
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)
    return buffer.getvalue()


def unpack(content: bytes, kinds: Collection[type]) -> Any:
    """Return what `pack` packed; of dataclasses only these kinds.

    A damaged file raises almost any exception.
    """
    arrays = dict(np.load(io.BytesIO(content), allow_pickle=False))
    known = {kind.__name__: kind for kind in kinds}

    def decoded(value: Any) -> Any:
        match value:
            case {"$array": str(name)}:
                return arrays[name]
            case {"$array": numbers}:
                return np.array(numbers)
            case {"$kind": kind, **members}:
                return known[kind](**decoded(members))
            case dict():
                return {key: decoded(item) for key, item in value.items()}
            case list():
                return tuple(decoded(item) for item in value)
        return value

    return decoded(json.loads(arrays.pop("document").tobytes()))
