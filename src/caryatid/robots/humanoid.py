"""Which camera poses a robot can reach, how it would stand there, and how long the path is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from caryatid.config import RobotConfig
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.planning.candidates import Candidates
from caryatid.robots.floor import FloorGrid
from caryatid.robots.protocol import Posture, SimulatedRobot, Unreachable, count_reasons
from caryatid.sensing.view_sphere import ViewSphere

REASONS = (
    "the camera would be too low",
    "the camera would be too high",
    "the head pitch is beyond its limits",
    "the camera would be rolled",
    "the platform would stand outside the floor",
    "the platform would stand in an obstacle",
    "no path leads there",
    "a wall stands in the line of sight",
)
"""Why a view is refused; the first that applies counts."""

MAX_ROLL = 0.5
"""Camera roll beyond this cannot be reached, the head has no third joint [deg]."""


class HumanoidRobot(SimulatedRobot):
    """A humanoid of ARMAR-6's kind in simulation: holonomic platform, torso lift, head with yaw and pitch.

    Args:
        floor: Where it may drive, and the furniture it knows of.
        config: Its limits.
        T_world_camera: Where its camera is (4, 4), or None while it has not been put anywhere; then any
            place is reached by a path of length 0.

    Raises:
        PlanningError: It cannot stand at that pose.
    """

    def __init__(self, floor: FloorGrid, config: RobotConfig, T_world_camera: Array | None = None) -> None:
        self._floor = floor
        self._config = config
        self._path_lengths = np.where(floor.free, 0.0, np.inf)
        self._offer: _Offer | None = None
        if T_world_camera is not None:
            self.move_to(T_world_camera)

    def solve(self, T_world_camera: Array, target_world: Array | None = None) -> Posture | Unreachable:
        """Say how the robot would stand with its camera at a pose, or why it cannot.

        Args:
            T_world_camera: Camera pose (4, 4).
            target_world: A point (3,) [m] no wall may hide from there, or None.
        """
        T = transforms.as_rigid(T_world_camera, "T_world_camera")
        reach = self._reach(T[None], target_world)
        code = int(reach.code[0])
        if code >= 0:
            return Unreachable(REASONS[code] + self._figures(code, T))
        head_yaw, head_pitch = float(reach.head_yaw[0]), float(reach.head_pitch[0])
        return Posture(reach.platform_world[0], float(T[2, 3]), head_yaw, head_pitch)

    def candidates(self, sphere: ViewSphere) -> Candidates:
        """Return the views of the sphere that can be reached and see its centre past the furniture.

        Another sphere, or other cells in reach, need new ones; otherwise only their paths change.
        """
        lengths = self._path_lengths.ravel()
        reached = np.isfinite(lengths)
        offer = self._offer
        if offer is None or offer.sphere is not sphere or not np.array_equal(offer.reached, reached):
            offer = self._offer = self._offered(sphere, reached)
        return offer.candidates.from_elsewhere(lengths[offer.cells])

    def _offered(self, sphere: ViewSphere, reached: NDArray[np.bool_]) -> _Offer:
        height = sphere.positions_world[:, 2]
        low, high = self._config.camera_height
        indices = np.flatnonzero((height >= low) & (height <= high))
        poses = sphere.poses(sphere.directions[indices])
        reach = self._reach(poses, sphere.centre_world)
        code = np.where(height < low, 0, 1)
        code[indices] = reach.code
        good = reach.code < 0
        cells = reach.cell[good]
        lengths = self._path_lengths.ravel()[cells]
        directions = sphere.directions[indices[good]]
        rejected = count_reasons(code, REASONS)
        candidates = Candidates(poses[good], directions, lengths, rejected, indices[good])
        return _Offer(sphere, reached, candidates, cells)

    def _go(self, posture: Posture, T_world_camera: Array) -> float:
        """Path length over the floor [m]; from there on path lengths begin there."""
        cell, _ = self._floor.cells(posture.platform_world[None])
        length = float(self._path_lengths.ravel()[cell[0]])
        self._path_lengths = self._floor.path_lengths(posture.platform_world)
        return length

    def _reach(self, T_world_camera: Array, target_world: Array | None) -> _Reach:
        """Find platform and gaze for poses (N, 4, 4), trying head yaws from straight ahead outwards."""
        config = self._config
        eyes = T_world_camera[:, :3, 3]
        right, forward = T_world_camera[:, :3, 0], T_world_camera[:, :3, 2]
        roll = np.arctan2(np.abs(right[:, 2]), -T_world_camera[:, 2, 1])
        level = np.hypot(forward[:, 0], forward[:, 1]) < 1e-6
        roll = np.where(level, np.arcsin(np.clip(np.abs(right[:, 2]), 0.0, 1.0)), roll)
        pitch = np.arcsin(np.clip(forward[:, 2], -1.0, 1.0))
        # Without roll the right axis is level: it gives the heading even where the view is straight down.
        heading = np.arctan2(right[:, 0], -right[:, 1])

        yaws = np.deg2rad(np.linspace(*config.yaw, config.head_yaws))
        yaws = yaws[np.argsort(np.abs(yaws), kind="stable")]
        lengths = self._path_lengths.ravel()
        quality, best = np.full(len(eyes), -1), np.zeros(len(eyes), dtype=np.intp)
        cell = np.zeros(len(eyes), dtype=np.intp)
        left = np.arange(len(eyes))
        for n, head_yaw in enumerate(yaws):
            found, here = self._standing(eyes[left], heading[left] - head_yaw, lengths)
            better = found > quality[left]
            rows = left[better]
            quality[rows], best[rows], cell[rows] = found[better], n, here[better]
            left = left[quality[left] < 3]

        tolerance = 1e-9
        low, high = np.deg2rad(config.pitch)
        hidden = np.zeros(len(eyes), dtype=np.bool_)
        tests = (
            eyes[:, 2] < config.camera_height[0] - tolerance,
            eyes[:, 2] > config.camera_height[1] + tolerance,
            (pitch < low - tolerance) | (pitch > high + tolerance),
            roll > np.deg2rad(MAX_ROLL),
            *(quality == missing for missing in range(3)),
            hidden if target_world is None else self._floor.hidden(eyes, target_world),
        )
        refused = np.stack(tests)
        code = np.where(refused.any(axis=0), refused.argmax(axis=0), -1)
        head_yaw = yaws[best]
        yaw = heading - head_yaw
        wrapped = (yaw + np.pi) % (2.0 * np.pi) - np.pi
        platform_world = np.column_stack([eyes[:, :2] - self._forward(yaw), wrapped])
        return _Reach(code, platform_world, head_yaw, pitch, cell)

    def _standing(
        self, eyes_world: Array, yaw: Array, lengths: Array
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """How well the platform stands with a yaw (N,), from 0 outside the floor to 3, and in which cell."""
        cell, inside = self._floor.cells(eyes_world[:, :2] - self._forward(yaw))
        free = self._floor.free.ravel()[cell] & inside
        return inside.astype(np.intp) + free + (free & np.isfinite(lengths[cell])), cell

    def _forward(self, yaw: Array) -> Array:
        """How far (N, 2) [m] the camera stands before the platform's centre with a yaw (N,)."""
        return self._config.camera_forward * np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)

    def _figures(self, code: int, T_world_camera: Array) -> str:
        """The numbers behind a reason."""
        low, high = self._config.camera_height
        pitch = np.rad2deg(np.arcsin(np.clip(T_world_camera[2, 2], -1.0, 1.0)))
        match code:
            case 0 | 1:
                return f": {T_world_camera[2, 3]:.2f} m, it reaches {low:.2f}…{high:.2f} m"
            case 2:
                down, up = self._config.pitch
                return f": {pitch:.0f}°, it reaches {down:.0f}…{up:.0f}°"
            case 4 | 5 | 6:
                return f" at x = {T_world_camera[0, 3]:.2f} m, y = {T_world_camera[1, 3]:.2f} m"
        return ""


@dataclass(frozen=True, eq=False, slots=True)
class _Reach:
    """Reachability of N poses: index of the reason or −1, platform, gaze, and the cell it stands in."""

    code: NDArray[np.intp]
    platform_world: Array
    head_yaw: Array
    head_pitch: Array
    cell: NDArray[np.intp]


@dataclass(frozen=True, eq=False, slots=True)
class _Offer:
    """What can be reached of a sphere while paths lead to the same cells, and the cell of each view (N,)."""

    sphere: ViewSphere
    reached: NDArray[np.bool_]
    candidates: Candidates
    cells: NDArray[np.intp]
