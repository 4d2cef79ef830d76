"""Reachability of an arm's camera or gripper: a map of positions, directions and rolls, from its joints."""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from caryatid.config import ArmConfig
from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.shapes import fibonacci_sphere
from caryatid.geometry.transforms import Array
from caryatid.io.staging import read_errors, write_file

Forward = Callable[[Array], Array]
"""Forward kinematics: joints (N, J) [rad, or m] → `T_base_camera` (N, 4, 4)."""

FORMAT, VERSION = "caryatid/reachability", 1
"""The format's name in the file."""

REMEDY = "sample it again and write it with write_reachability"
"""Remedy for a broken file."""


@dataclass(frozen=True, eq=False, slots=True)
class ReachabilityMap:
    """Cells, directions and rolls in which an arm can hold its camera, or its gripper.

    Each cell and direction has one byte, whose bits are eighths of a turn about the optical axis. A pose is
    reached if the bit of its roll is set.

    Attributes:
        reached: Rolls (X, Y, Z, D) uint8 by cell and by the nearest of D directions all over the sphere.
        origin_base: Lowest corner (3,) of the cells in the frame of the base [m].
        cell: Edge of a cell [m].
        fresh: Share of the last tenth of the samples that were the first in their cell and direction [1]:
            about the share of the arm's reach that the map lacks.
    """

    reached: NDArray[np.uint8]
    origin_base: Array
    cell: float
    fresh: float

    def __call__(self, T_base_camera: Array) -> NDArray[np.bool_]:
        """Which camera poses (N, 4, 4) lie in a cell, direction and roll that was reached (N,)."""
        cells = np.floor((T_base_camera[:, :3, 3] - self.origin_base) / self.cell).astype(np.intp)
        inside = np.all((cells >= 0) & (cells < self.reached.shape[:3]), axis=1)
        x, y, z = np.where(inside[:, None], cells, 0).T
        directions, bits = _Bins(self.reached.shape[3]).of(T_base_camera)
        return inside & ((self.reached[x, y, z, directions] & bits) != 0)


def sample_reachability(
    forward: Forward,
    limits: ArrayLike,
    count: int,
    rng: np.random.Generator,
    config: ArmConfig | None = None,
) -> ReachabilityMap:
    """Map the reach of an arm's camera from postures drawn uniformly between its joint limits.

    Args:
        forward: Forward kinematics up to the camera's optical frame (x right, y down, z forward): with the
            transform from hand to camera. It may return NaN for postures in collision; they are left out.
        limits: Lowest and highest value (J, 2) of each joint [rad, or m].
        count: Number of postures to draw [1]; `ReachabilityMap.fresh` says if they were enough.
        rng: Draws them.
        config: Size of cells and number of directions.

    Raises:
        InputError: Limits, count or the result of `forward` are not valid.
    """
    config = config or ArmConfig()
    bounds = np.asarray(limits, dtype=np.float64)
    if bounds.ndim != 2 or bounds.shape[1] != 2 or len(bounds) == 0 or not np.isfinite(bounds).all():
        reason = f"expected finite numbers (J, 2), not shape {bounds.shape}"
        raise InputError("limits", reason, "give (low, high)")
    crossed = np.flatnonzero(bounds[:, 0] > bounds[:, 1])
    if len(crossed):
        raise InputError("limits", f"joint {crossed[0]} has low > high", "give the lower limit first")
    if count < 1:
        raise InputError("count", f"{count} is too few", "sample some hundred thousand postures")
    bins = _Bins(config.view_directions)
    held = []
    for part in np.array_split(np.arange(count), min(10, count)):
        joints = rng.uniform(bounds[:, 0], bounds[:, 1], (len(part), len(bounds)))
        T_base_camera = _checked_poses(forward(joints), len(joints))
        cells = np.floor(T_base_camera[:, :3, 3] / config.cell).astype(np.intp)
        held.append(np.column_stack([cells, *bins.of(T_base_camera)]))
    places, early = np.concatenate(held), sum(map(len, held[:-1]))
    if len(places) == 0:
        raise InputError("forward", "returns NaN for every posture", "check it and the limits")
    low = np.append(places[:, :3].min(axis=0), 0)
    bits = places[:, 4].astype(np.uint8)
    shape = places[:, :3].max(axis=0) + 1 - low[:3]
    reached = np.zeros((*shape, config.view_directions), dtype=np.uint8)
    before, last = (tuple((part - low).T) for part in (places[:early, :4], places[early:, :4]))
    np.bitwise_or.at(reached, before, bits[:early])
    fresh = float((reached[last] == 0).mean()) if len(held[-1]) else 0.0
    np.bitwise_or.at(reached, last, bits[early:])
    return ReachabilityMap(reached, low[:3].astype(np.float64) * config.cell, config.cell, fresh)


def write_reachability(path: str | os.PathLike[str], reachability: ReachabilityMap) -> None:
    """Write a map as .npz; it appears whole or not at all, and the same map gives the same bytes.

    Raises:
        InputError: The file cannot be written.
    """
    buffer = io.BytesIO()
    content: dict[str, Any] = {"format": FORMAT, "version": VERSION} | asdict(reachability)
    np.savez_compressed(buffer, **content)
    write_file(Path(path), buffer.getvalue())


def read_reachability(path: str | os.PathLike[str]) -> ReachabilityMap:
    """Read a map.

    Raises:
        InputError: The file is missing, damaged, not a map, or of another version.
    """
    file = Path(path)
    with read_errors(file, REMEDY):
        content = file.read_bytes()
    try:
        held = dict(np.load(io.BytesIO(content), allow_pickle=False))
    except Exception as error:  # NumPy raises many kinds of error for a damaged archive
        raise InputError(file, f"not a readable .npz: {error}", REMEDY) from None
    if str(held.get("format")) != FORMAT:
        raise InputError(file, f"not a reachability map, expected format '{FORMAT}'", REMEDY)
    if not np.array_equal(held.get("version", 0), VERSION):
        raise InputError(file, f"version {held.get('version')} is not supported, only {VERSION}", REMEDY)
    reached = held.get("reached", np.zeros(0))
    good = reached.ndim == 4 and reached.dtype == np.uint8 and reached.size > 0
    for name, shape in (("origin_base", (3,)), ("cell", ()), ("fresh", ())):
        value = held.get(name, np.zeros(0))
        good &= value.shape == shape and value.dtype.kind == "f" and bool(np.isfinite(value).all())
    if not good or held["cell"] <= 0.0:
        raise InputError(file, "not the arrays of a reachability map", REMEDY)
    return ReachabilityMap(reached, held["origin_base"], float(held["cell"]), float(held["fresh"]))


class _Bins:
    """The bins of directions (D) and rolls.

    A roll is measured from a vector at right angles to its bin's middle, so it is defined straight down too.
    """

    def __init__(self, count: int) -> None:
        directions = fibonacci_sphere(count)
        self._tree = KDTree(directions)
        self._right = transforms.perpendicular(directions)
        self._down = np.cross(directions, self._right)

    def of(self, T_base_camera: Array) -> tuple[NDArray[np.intp], NDArray[np.uint8]]:
        """Bin (N,) of the viewing direction, and bit (N,) of the roll of poses (N, 4, 4)."""
        nearest = self._tree.query(T_base_camera[:, :3, 2])[1]
        right = T_base_camera[:, :3, 0]
        x = np.einsum("ij,ij->i", right, self._right[nearest])
        y = np.einsum("ij,ij->i", right, self._down[nearest])
        eighth = np.floor(np.arctan2(y, x) * (8 / (2.0 * np.pi))).astype(np.intp) % 8
        return nearest, np.left_shift(1, eighth).astype(np.uint8)


def _checked_poses(T_base_camera: ArrayLike, count: int) -> Array:
    """Poses (M, 4, 4) of the possible postures."""
    poses = np.asarray(T_base_camera, dtype=np.float64)
    if poses.shape != (count, 4, 4):
        reason = f"returned shape {poses.shape} for {count} postures"
        raise InputError("forward", reason, f"return ({count}, 4, 4)")
    poses = poses[np.isfinite(poses).all(axis=(1, 2))]
    R = poses[:, :3, :3]
    skewed = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2)) + 2.0 * (np.linalg.det(R) < 0.0)
    if len(poses):
        transforms.as_rigid(poses[int(np.argmax(skewed))], "forward")
    return poses
