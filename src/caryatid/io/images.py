"""Image files: checked without decoding them where possible, decoded strictly."""

from __future__ import annotations

import io
import struct
import warnings
import zlib
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from caryatid.errors import InputError

DEPTH_MODES: Final = ("I;16", "I;16B", "I")
MASK_MODES: Final = ("1", "L", "P", "I;16", "I;16B", "I")
"""Pillow modes of depth images, and of masks."""


def check_image(path: Path, modes: tuple[str, ...] | None = None, what: str = "") -> tuple[int, int]:
    """Check that an image is whole and of the right kind, decoding it only where nothing less will do.

    Args:
        path: A PNG or JPEG.
        modes: Pillow modes allowed, or None for any.
        what: What the image ought to be, for the error where the mode is another.

    Returns:
        Width and height [px].

    Raises:
        InputError: The file is missing, truncated, no image, or of another mode.
    """
    with _clearly(path), Image.open(path) as image:
        size, mode = image.size, image.mode
        if image.format == "PNG":
            image.verify()
        elif image.format != "JPEG" or not _ends_as_jpeg(path):
            image.load()
    if modes is not None and mode not in modes:
        raise InputError(path, f"has pixels of mode {mode}, not {what}", f"save it as {what}")
    return size


def read_depth(path: Path, depth_scale: float) -> NDArray[np.float32]:
    """Read a 16-bit depth PNG.

    Args:
        path: The file.
        depth_scale: One unit [mm].

    Returns:
        Depth (H, W) [m], 0 = no reading.

    Raises:
        InputError: Missing, truncated, not 16 bit, or without a single reading.
    """
    raw = read_units(path)
    if not raw.any():
        raise InputError(path, "the frame is empty: no pixel has a depth reading", "leave this frame out")
    return (raw.astype(np.float64) * (depth_scale / 1000.0)).astype(np.float32)


def read_colour(path: Path) -> NDArray[np.uint8]:
    """Read a colour image (H, W, 3); grey ones become three equal channels.

    Raises:
        InputError: Missing, truncated or no image.
    """
    with _clearly(path), Image.open(path) as image:
        return np.array(image.convert("RGB"))


def read_mask(path: Path) -> NDArray[np.bool_]:
    """Read a mask (H, W): true where the pixel is not 0.

    Raises:
        InputError: Missing, truncated, or not of one channel.
    """
    check_image(path, MASK_MODES, "a grey PNG")
    with _clearly(path), Image.open(path) as image:
        return np.asarray(image) > 0


def png(image: NDArray[np.uint8] | NDArray[np.uint16]) -> bytes:
    """Encode an image, (H, W, 3) uint8 or (H, W) uint8 or uint16, as PNG."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="PNG")
    return buffer.getvalue()


def read_units(path: Path) -> NDArray[np.int32]:
    """Read a 16-bit grey PNG (H, W) as it is: depth in units of its own, or labels.

    Raises:
        InputError: Missing, truncated or not 16 bit.
    """
    check_image(path, DEPTH_MODES, "a 16-bit grey PNG")
    with _clearly(path), Image.open(path) as image:
        return np.asarray(image).astype(np.int32)


def decode_image(content: bytes, name: str, modes: tuple[str, ...], what: str, most: int) -> NDArray[Any]:
    """Decode a PNG or JPEG that came from elsewhere: (H, W), or (H, W, 3) where it is in colour.

    Args:
        content: The file.
        name: What to call it in errors.
        modes: Pillow modes allowed.
        what: What the image ought to be, for the error where the mode is another.
        most: Pixels it may have; of one that has more nothing is decoded.

    Raises:
        InputError: It is broken, larger, or no such image.
    """
    with _clearly(Path(name)), Image.open(io.BytesIO(content), formats=("PNG", "JPEG")) as image:
        width, height = image.size
        if width * height <= most and image.mode in modes:
            return np.array(image)
        mode = image.mode
    if mode not in modes:
        raise InputError(name, f"has pixels of mode {mode}, not {what}", f"save it as {what}")
    raise InputError(name, f"has {width}×{height} pixels, {most} are allowed", "give a smaller image")


class _clearly:  # noqa: N801
    """Turn what Pillow raises on a bad file into one sentence."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._warnings = warnings.catch_warnings()

    def __enter__(self) -> None:
        self._warnings.__enter__()
        warnings.simplefilter("error", Image.DecompressionBombWarning)

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self._warnings.__exit__(None, None, None)
        remedy = "copy or record the file again"
        if isinstance(error, FileNotFoundError):
            raise InputError(self.path, "the file is missing", remedy) from None
        if isinstance(error, Image.DecompressionBombError | Image.DecompressionBombWarning):
            raise InputError(self.path, "says it is larger than any camera's image", remedy) from error
        if isinstance(error, UnidentifiedImageError):
            raise InputError(self.path, "is no image", remedy) from error
        if isinstance(error, PermissionError | IsADirectoryError):
            raise InputError(self.path, f"cannot be read ({error.strerror})", remedy) from error
        if isinstance(error, OSError | SyntaxError | ValueError | EOFError | struct.error | zlib.error):
            raise InputError(self.path, f"the image is truncated or broken ({error})", remedy) from error


def _ends_as_jpeg(path: Path) -> bool:
    with path.open("rb") as file:
        file.seek(-2, io.SEEK_END)
        return file.read() == b"\xff\xd9"
