"""Image files, decoded strictly."""

from __future__ import annotations

import io
import struct
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from caryatid.errors import InputError

DEPTH_MODES: Final = ("I;16", "I;16B", "I")
MASK_MODES: Final = ("1", "L", "P", "I;16", "I;16B", "I")
"""Pillow modes of depth images, and of masks."""
UNREADABLE: Final = (OSError, SyntaxError, ValueError, EOFError, struct.error, zlib.error)
"""What Pillow raises on a damaged image."""


def check_image(path: Path, modes: tuple[str, ...] | None = None, what: str = "") -> tuple[int, int]:
    """Check that an image is whole and of the right kind; a PNG is not decoded for that.

    Args:
        path: A PNG or JPEG.
        modes: Pillow modes allowed, or None for any.
        what: What the image ought to be, for the error where the mode is another.

    Returns:
        Width and height [px].

    Raises:
        InputError: The file is missing, truncated, no image, or of another mode.
    """
    with _errors(path), Image.open(path) as image:
        size, mode = image.size, image.mode
        if image.format == "PNG":
            image.verify()
        else:
            image.load()
    _check_mode(mode, modes, what, path)
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
    with _errors(path), Image.open(path) as image:
        return np.array(image.convert("RGB"))


def read_mask(path: Path) -> NDArray[np.bool_]:
    """Read a mask (H, W): true where the pixel is not 0.

    Raises:
        InputError: Missing, truncated, or not of one channel.
    """
    return _read(path, MASK_MODES, "a grey PNG") > 0


def read_units(path: Path) -> NDArray[np.int32]:
    """Read a 16-bit grey PNG (H, W) as it is: depth in units of its own, or labels.

    Raises:
        InputError: Missing, truncated or not 16 bit.
    """
    return _read(path, DEPTH_MODES, "a 16-bit grey PNG").astype(np.int32)


def png(image: NDArray[np.uint8] | NDArray[np.uint16]) -> bytes:
    """Encode an image, (H, W, 3) uint8 or (H, W) uint8 or uint16, as PNG."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="PNG")
    return buffer.getvalue()


def decode_image(content: bytes, name: str, modes: tuple[str, ...], what: str, most: int) -> NDArray[Any]:
    """Decode a PNG or JPEG that came from elsewhere: (H, W), or (H, W, C) where it is in colour.

    Args:
        content: The file.
        name: What to call it in errors.
        modes: Pillow modes allowed.
        what: What the image ought to be, for the error where the mode is another.
        most: Pixels it may have; a larger one is not decoded.

    Raises:
        InputError: It is broken, larger, or no such image.
    """
    with _errors(name), Image.open(io.BytesIO(content), formats=("PNG", "JPEG")) as image:
        (width, height), mode = image.size, image.mode
        if width * height <= most and mode in modes:
            return np.array(image)
    _check_mode(mode, modes, what, name)
    raise InputError(name, f"has {width}×{height} pixels, {most} are allowed", "give a smaller image")


def _read(path: Path, modes: tuple[str, ...], what: str) -> NDArray[Any]:
    check_image(path, modes, what)
    with _errors(path), Image.open(path) as image:
        return np.asarray(image)


def _check_mode(mode: str, modes: tuple[str, ...] | None, what: str, source: str | Path) -> None:
    if modes is not None and mode not in modes:
        raise InputError(source, f"has pixels of mode {mode}, not {what}", f"save it as {what}")


@contextmanager
def _errors(path: str | Path) -> Iterator[None]:
    """Turn what Pillow raises on a bad file into one sentence."""
    remedy = "copy or record the file again"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            yield
    except FileNotFoundError:
        raise InputError(path, "the file is missing", remedy) from None
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise InputError(path, "says it is larger than any camera's image", remedy) from error
    except UnidentifiedImageError as error:
        raise InputError(path, "is no image", remedy) from error
    except (PermissionError, IsADirectoryError) as error:
        raise InputError(path, f"cannot be read ({error.strerror})", remedy) from error
    except UNREADABLE as error:
        raise InputError(path, f"the image is truncated or broken ({error})", remedy) from error
