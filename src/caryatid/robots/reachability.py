"""Reachability of an arm's camera or gripper: a map of positions, directions and rolls, from its joints."""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, cast, get_args

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

FORMAT, VERSION = "caryatid/reachability", 2
"""The format's name in the file, and its version."""

Held = Literal["camera", "gripper"]
"""What an arm holds at the end of its forward kinematics."""
Frame = Literal["base", "world"]
"""Frame of the poses that a map is asked for."""

REMEDY = "give a reachability map, a file that write_reachability wrote"
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
        kind: Whether it is the reach of the arm's camera, or of its gripper.
        T_world_base: Pose (4, 4) of the base, for a map that is asked for poses in the world; None for one
            that is asked for poses in the frame of the base.
    """

    reached: NDArray[np.uint8]
    origin_base: Array
    cell: float
    fresh: float
    kind: Held = "camera"
    T_world_base: Array | None = None

    @property
    def frame(self) -> Frame:
        """Frame of the poses that it is asked for."""
        return "base" if self.T_world_base is None else "world"

    def check_use(self, name: str | os.PathLike[str], kind: Held, frame: Frame) -> None:
        """Reject a map of something else, or in another frame; the error uses the name.

        Raises:
            InputError: The kind or the frame is another one.
        """
        if (self.kind, self.frame) != (kind, frame):
            where = {"base": "the frame of the arm's base", "world": "the world frame"}
            pose = "" if frame == "base" else ", T_world_base=…"
            reason = f"is a map of the {self.kind} in {where[self.frame]}"
            wanted = f"needed is one of the {kind} in {where[frame]}"
            remedy = f'sample_reachability(…, kind="{kind}"{pose}) makes it'
            raise InputError(name, f"{reason}, but {wanted}", remedy)

    def __call__(self, T_frame_camera: Array) -> NDArray[np.bool_]:
        """Which poses (N, 4, 4) in `frame` lie in a cell, direction and roll that was reached (N,)."""
        T_base_camera = T_frame_camera
        if self.T_world_base is not None:
            T_base_camera = transforms.invert(self.T_world_base) @ T_frame_camera
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
    *,
    kind: Held = "camera",
    T_world_base: ArrayLike | None = None,
) -> ReachabilityMap:
    """Map the reach of an arm's camera or gripper from postures drawn uniformly between its joint limits.

    Args:
        forward: Forward kinematics up to the camera's optical frame (x right, y down, z forward): with the
            transform from hand to camera. It may return NaN for postures in collision; they are left out.
            For a gripper, up to the frame of its grasps.
        limits: Lowest and highest value (J, 2) of each joint [rad, or m].
        count: Number of postures to draw [1]; `ReachabilityMap.fresh` says if they were enough.
        rng: Draws them.
        config: Size of cells and number of directions.
        kind: Whether `forward` gives the pose of the camera or of the gripper.
        T_world_base: Pose (4, 4) of the base, for a map that is asked for poses in the world frame, as
            `order --reach` asks; None for the frame of the base, as an `ArmRobot` asks.

    Raises:
        InputError: Kind, pose, limits, count or the result of `forward` are not valid.
    """
    config = config or ArmConfig()
    if kind not in get_args(Held):
        raise InputError("kind", f"'{kind}' is unknown", f"choose {' or '.join(get_args(Held))}")
    T_base = None if T_world_base is None else transforms.as_rigid(T_world_base, "T_world_base")
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
    origin = low[:3].astype(np.float64) * config.cell
    return ReachabilityMap(reached, origin, config.cell, fresh, kind, T_base)


def write_reachability(path: str | os.PathLike[str], reachability: ReachabilityMap) -> None:
    """Write a map as .npz; it appears whole or not at all, and the same map gives the same bytes.

    Raises:
        InputError: The file cannot be written.
    """
    buffer = io.BytesIO()
    content: dict[str, Any] = {"format": FORMAT, "version": VERSION} | asdict(reachability)
    content |= {"frame": reachability.frame}
    if reachability.T_world_base is None:
        del content["T_world_base"]
    np.savez_compressed(buffer, **content)
    write_file(Path(path), buffer.getvalue())


def read_reachability(path: str | os.PathLike[str]) -> ReachabilityMap:
    """Read a map.

    Raises:
        InputError: The file is missing, damaged, not a map, or of another version, such as an older one that
            has neither kind nor frame.
    """
    file = Path(path)
    with read_errors(file, REMEDY):
        content = file.read_bytes()
    try:
        held = dict(np.load(io.BytesIO(content), allow_pickle=False))
    except Exception:  # NumPy raises many kinds of error for a damaged archive, and gives advice for pickles
        raise InputError(file, "damaged, or not an .npz", REMEDY) from None
    if str(held.get("format")) != FORMAT:
        raise InputError(file, f"not a reachability map, expected format '{FORMAT}'", REMEDY)
    if np.array_equal(held.get("version", 0), 1):
        reason = "was written by an earlier caryatid, without its kind (camera or gripper) and frame"
        raise InputError(file, reason, "sample it again and write it with write_reachability")
    if not np.array_equal(held.get("version", 0), VERSION):
        raise InputError(file, f"version {held.get('version')} is not supported, only {VERSION}", REMEDY)
    reached = held.get("reached", np.zeros(0))
    good = reached.ndim == 4 and reached.dtype == np.uint8 and reached.size > 0
    for name, shape in (("origin_base", (3,)), ("cell", ()), ("fresh", ())):
        value = held.get(name, np.zeros(0))
        good &= value.shape == shape and value.dtype.kind == "f" and bool(np.isfinite(value).all())
    kind, frame, T_world_base = (held.get(name) for name in ("kind", "frame", "T_world_base"))
    good &= str(kind) in get_args(Held) and str(frame) == ("base" if T_world_base is None else "world")
    if not good or held["cell"] <= 0.0:
        raise InputError(file, "not the arrays of a reachability map", REMEDY)
    if T_world_base is not None:
        T_world_base = transforms.as_rigid(T_world_base, f"{file}: T_world_base")
    cell, fresh, held_kind = float(held["cell"]), float(held["fresh"]), cast(Held, str(kind))
    return ReachabilityMap(reached, held["origin_base"], cell, fresh, held_kind, T_world_base)


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
