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


class BrokenImageError(InputError):
    """An image that cannot be decoded; others of its recording may be whole."""


def read_depth(path: Path, depth_scale: float) -> NDArray[np.float32]:
    """Read a 16-bit depth PNG.

    Args:
        path: The file.
        depth_scale: One unit [mm].

    Returns:
        Depth (H, W) [m], 0 = no reading.

    Raises:
        InputError: Missing, truncated, or not 16 bit.
    """
    return (read_units(path).astype(np.float64) * (depth_scale / 1000.0)).astype(np.float32)


def read_colour(image: Path | bytes, name: str = "") -> NDArray[np.uint8]:
    """Read a colour image (H, W, 3), a file or its content; grey ones become three equal channels.

    Raises:
        InputError: Missing, truncated or no image.
    """
    with _opened(image, name) as opened:
        return np.array(opened.convert("RGB"))


def read_mask(path: Path) -> NDArray[np.bool_]:
    """Read a mask (H, W): true where the pixel is not 0.

    Raises:
        InputError: Missing, truncated, or not of one channel.
    """
    with _opened(path, "", MASK_MODES, "a grey PNG") as opened:
        return np.asarray(opened) > 0


def read_units(image: Path | bytes, name: str = "") -> NDArray[np.int32]:
    """Read a 16-bit grey PNG (H, W), a file or its content, as it is: depth in units of its own, or labels.

    Raises:
        InputError: Missing, truncated or not 16 bit.
    """
    with _opened(image, name, DEPTH_MODES, "a 16-bit grey PNG") as opened:
        return np.asarray(opened).astype(np.int32)


def decode_image(content: bytes, name: str, modes: tuple[str, ...], what: str, most: int) -> NDArray[Any]:
    """Decode a PNG or JPEG that came from elsewhere: (H, W), or (H, W, 3) where colour is allowed.

    Args:
        content: The file.
        name: What to call it in errors.
        modes: Pillow modes allowed.
        what: What the image ought to be, for the error where the mode is another.
        most: Pixels it may have; a larger one is not decoded.

    Raises:
        InputError: It is broken, larger, or no such image.
    """
    with _opened(content, name, modes, what) as image:
        width, height = image.size
        if width * height > most:
            reason = f"has {width}×{height} pixels, {most} are allowed"
            raise InputError(name, reason, "give a smaller image")
        return np.array(image.convert("RGB") if "RGB" in modes else image)


def png(image: NDArray[np.uint8] | NDArray[np.uint16]) -> bytes:
    """Encode an image, (H, W, 3) uint8 or (H, W) uint8 or uint16, as PNG."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="PNG")
    return buffer.getvalue()


@contextmanager
def _opened(
    image: Path | bytes, name: str = "", modes: tuple[str, ...] | None = None, what: str = ""
) -> Iterator[Image.Image]:
    """Open a PNG or JPEG; whatever Pillow raises on a bad one becomes one sentence."""
    source = image if isinstance(image, Path) else name
    remedy = "copy or record the file again"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with _open(image) as whole:
                if whole.format == "PNG":
                    whole.verify()  # decoding passes over a wrong checksum or a missing end
            with _open(image) as opened:
                if modes is not None and opened.mode not in modes:
                    reason = f"has pixels of mode {opened.mode}, not {what}"
                    raise BrokenImageError(source, reason, f"save it as {what}")
                yield opened
    except FileNotFoundError:
        raise BrokenImageError(source, "the file is missing", remedy) from None
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise BrokenImageError(source, "says it is larger than any camera's image", remedy) from error
    except UnidentifiedImageError as error:
        raise BrokenImageError(source, "is no image", remedy) from error
    except (PermissionError, IsADirectoryError) as error:
        raise BrokenImageError(source, f"cannot be read ({error.strerror})", remedy) from error
    except (OSError, SyntaxError, ValueError, EOFError, struct.error, zlib.error) as error:
        raise BrokenImageError(source, f"the image is truncated or broken ({error})", remedy) from error


def _open(image: Path | bytes) -> Image.Image:
    file = image if isinstance(image, Path) else io.BytesIO(image)
    return Image.open(file, formats=("PNG", "JPEG"))
