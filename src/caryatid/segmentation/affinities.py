"""Learned affinities: a small network says which samples of a depth image lie on the same object."""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray
from scipy import ndimage

from caryatid.geometry.transforms import Array
from caryatid.runtime.parallel import cores

Image = NDArray[np.float32]
Odds = NDArray[np.float32]
"""Log odds on a grid: one image for each of `OFFSETS`, and one for `on an object` (13, H, W)."""

OFFSETS = (
    (0, 1), (1, 0), (0, 4), (4, 0), (4, 4), (4, -4),
    (0, 12), (12, 0), (12, 12), (12, -12), (0, 32), (32, 0),
)  # fmt: skip
"""Rows and columns from a sample to the one that each output of the network compares it with."""
MODEL = "affinities.onnx"
"""File of the network, in this package; `tools/train_affinities.py` makes it."""
MULTIPLE = 32
"""The network halves images five times."""


def affinities(
    depth: Image, rgb: NDArray[np.uint8] | None, K: Array, up_camera: Array, offset: float
) -> Odds:
    """Log odds that samples lie on the same object, and on any object.

    The network is a U-Net of a million weights, trained on simulated tables alone. Affinities at several
    distances follow Wolf et al., "The Mutex Watershed" (2018).

    Args:
        depth: (H, W) [m], 0 = no reading.
        rgb: Colours (H, W, 3), or None.
        K: Pinhole matrix (3, 3) [px].
        up_camera: Unit normal (3,) of the support surface, upwards, in the camera frame.
        offset: Height of the camera over the support surface [m].

    Returns:
        (13, H, W): for each of `OFFSETS`, whether a sample is on the same object as the one that far from it;
        and whether it is on an object.
    """
    height, width = depth.shape
    border = (0, -height % MULTIPLE), (0, -width % MULTIPLE)
    padded = np.pad(depth, border)
    colours = None if rgb is None else np.pad(rgb, (*border, (0, 0)))
    logits = _session().run(None, {"features": features(padded, colours, K, up_camera, offset)[None]})[0]
    cropped: Image = logits[0, :, :height, :width]
    return cropped


def features(depth: Image, rgb: NDArray[np.uint8] | None, K: Array, up_camera: Array, offset: float) -> Image:
    """What the network sees (11, H, W) of an image; arguments as of `affinities`.

    Validity; height over the surface; height over the mean around it, in 15 and of 3 in 7 pixels, in metres
    of depth; slopes of 1/z; depth; the slope of each ray against the surface; and colours from -1 to 1, all 0
    without any.
    """
    depth = depth.astype(np.float32)
    valid = (depth > 0.0).astype(np.float32)
    inverse = np.divide(np.float32(1.0), depth, out=np.zeros_like(depth), where=depth > 0.0)
    v, u = (np.arange(n, dtype=np.float32) for n in depth.shape)
    x, y = (u - np.float32(K[0, 2])) / np.float32(K[0, 0]), (v - np.float32(K[1, 2])) / np.float32(K[1, 1])
    rising = np.float32(up_camera[0]) * x + (np.float32(up_camera[1]) * y + np.float32(up_camera[2]))[:, None]
    height = (np.float32(offset) + rising * depth) * valid

    def around(radius: int) -> tuple[Image, Image]:
        """Mean of 1/z, and share of readings, in the square around each pixel."""
        share = ndimage.uniform_filter(valid, 2 * radius + 1, mode="constant")
        total = ndimage.uniform_filter(inverse, 2 * radius + 1, mode="constant")
        return total / np.maximum(share, np.float32(1e-6)), share

    wide, fine, coarse = (around(radius)[0] for radius in (7, 1, 3))
    smooth, share = around(2)
    dense = (share > 0.2).astype(np.float32)
    smooth = smooth * dense
    slopes = np.zeros((2, *depth.shape), dtype=np.float32)
    slopes[0, :, 2:-2] = (
        (smooth[:, 4:] - smooth[:, :-4]) / 4.0 * dense[:, 4:] * dense[:, :-4] * np.float32(K[0, 0])
    )
    slopes[1, 2:-2] = (smooth[4:] - smooth[:-4]) / 4.0 * dense[4:] * dense[:-4] * np.float32(K[1, 1])
    slopes /= np.maximum(smooth, np.float32(0.1))
    square = depth * depth * valid
    channels = (
        valid,
        np.clip(height / 0.1, -1.0, 4.0),
        np.clip((inverse - wide) * square / 0.02, -3.0, 3.0),
        np.clip((fine - coarse) * square / 0.004, -3.0, 3.0),
        *np.clip(slopes / 2.0, -3.0, 3.0),
        (depth - 0.8) * valid,
        rising,
    )
    colours = np.zeros((*depth.shape, 3)) if rgb is None else rgb / np.float32(127.5) - np.float32(1.0)
    return np.concatenate([np.stack(channels), colours.transpose(2, 0, 1)]).astype(np.float32)


@cache
def _session() -> Any:
    """The network, loaded once."""
    return open_network(files("caryatid.segmentation").joinpath(MODEL).read_bytes())


def open_network(model: bytes | Path) -> Any:
    """Open an ONNX model that runs on as many threads as caryatid may use, which wait without spinning."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = cores()
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
