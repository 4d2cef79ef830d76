"""Which frames of a recording are worth keeping: sharp ones, each from another viewpoint."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import laplace

from caryatid.config import RecordingConfig
from caryatid.geometry.transforms import Array


@dataclass(frozen=True, eq=False, slots=True)
class Choice:
    """The frames to keep, and why the others are not kept.

    Attributes:
        kept: Indices, in the order of time.
        blurred: How many are less sharp than others around them.
        alike: How many show what a kept frame shows.
        spare: How many were more than are wanted.
    """

    kept: tuple[int, ...]
    blurred: int
    alike: int
    spare: int


def sharpness_of_colour(rgb: NDArray[np.uint8]) -> float:
    """Variance of the Laplacian of the brightness of an image (H, W, 3): the higher, the sharper."""
    return float(laplace(rgb.mean(axis=2, dtype=np.float32)).var())


def sharpness_of_depth(depth: NDArray[np.float32]) -> float:
    """Share of pixels (H, W) with a reading: a depth camera in motion loses them at edges."""
    return float((depth > 0.0).mean())


def choose_views(
    times: Array, sharpness: Array, T_world_camera: Array | None, config: RecordingConfig
) -> Choice:
    """Choose frames that are sharp for their time and seen from viewpoints apart from each other.

    Through time, the sharpest frame of the next moments that is seen from elsewhere than all chosen ones is
    chosen. Of more than are wanted those stay that are farthest from each other.

    Args:
        times: When frames were taken (N,) [s], rising.
        sharpness: How sharp they are (N,); only ratios count.
        T_world_camera: Their poses (N, 4, 4), or None where poses are not known: a single frame is chosen.
        config: What is sharp, and how far apart viewpoints are.
    """
    if len(times) == 0:
        return Choice((), 0, 0, 0)
    if T_world_camera is None:
        return Choice((int(np.argmax(sharpness)),), 0, 0, len(times) - 1)
    sharp = sharpness >= config.sharp_share * _most_around(times, sharpness, config.sharp_window)
    candidates = np.flatnonzero(sharp)
    chosen: list[int] = []
    free = np.ones(len(candidates), dtype=np.bool_)
    while free.any():
        first = int(np.argmax(free))
        soon = free & (times[candidates] <= times[candidates[first]] + config.sharp_window)
        best = candidates[soon][np.argmax(sharpness[candidates[soon]])]
        chosen.append(int(best))
        free &= apart(T_world_camera[candidates], T_world_camera[best], config) > 1.0
    kept = _farthest(T_world_camera[chosen], config)
    return Choice(
        tuple(sorted(chosen[i] for i in kept)),
        blurred=int((~sharp).sum()),
        alike=len(candidates) - len(chosen),
        spare=len(chosen) - len(kept),
    )


def apart(T_world_camera: Array, T_world_other: Array, config: RecordingConfig) -> Array:
    """How far poses (N, 4, 4) are from another one (4, 4), in units of what makes a view another one (N,).

    Args:
        T_world_camera: Poses (N, 4, 4).
        T_world_other: The other one (4, 4).
        config: What way and what angle make a view another one.
    """
    distance = np.linalg.norm(T_world_camera[:, :3, 3] - T_world_other[:3, 3], axis=1)
    cosine = (np.einsum("nij,ij->n", T_world_camera[:, :3, :3], T_world_other[:3, :3]) - 1.0) / 2.0
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return np.maximum(distance / config.min_distance, angle / config.min_angle)


def _most_around(times: Array, values: Array, window: float) -> Array:
    """Largest value (N,) within `window` seconds of each time, either way."""
    first = np.searchsorted(times, times - window, side="left")
    stop = np.searchsorted(times, times + window, side="right")
    return np.array([values[a:b].max() for a, b in zip(first, stop, strict=True)])


def _farthest(T_world_camera: Array, config: RecordingConfig) -> list[int]:
    """Indices of as many poses as are wanted: the first, then always the one farthest from those before."""
    kept = [0]
    nearest = apart(T_world_camera, T_world_camera[0], config)
    while len(kept) < min(config.max_views, len(T_world_camera)):
        kept.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, apart(T_world_camera, T_world_camera[kept[-1]], config))
    return kept
