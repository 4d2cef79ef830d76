"""Which camera poses a humanoid can reach, how it would stand there, and how long the path is."""

from __future__ import annotations

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

Indices = NDArray[np.intp]
"""Whole numbers (N,)."""


class HumanoidRobot(SimulatedRobot):
    """A humanoid of ARMAR-6's kind in simulation: holonomic platform, torso lift, head with yaw and pitch.

    It is nowhere at first, and goes to its first place by a path of length 0.

    Args:
        floor: Where it may drive, and the furniture it knows of.
        config: Its limits.
    """

    def __init__(self, floor: FloorGrid, config: RobotConfig) -> None:
        self._floor = floor
        self._config = config
        self._path_lengths = np.where(floor.free, 0.0, np.inf).ravel()
        self._offer: tuple[ViewSphere, NDArray[np.bool_], Candidates, Indices] | None = None

    def solve(self, T_world_camera: Array) -> Posture | Unreachable:
        """Say how the robot would stand with its camera at a pose (4, 4), or why it cannot."""
        T = transforms.as_rigid(T_world_camera, "T_world_camera")
        (code,), (platform,), (head_yaw,), (pitch,), _ = self._reach(T[None])
        if code >= 0:
            x, y, z = T[:3, 3]
            where = f"camera at ({x:.2f}, {y:.2f}, {z:.2f}) m, pitch {np.rad2deg(pitch):.0f}°"
            return Unreachable(f"{REASONS[code]}; {where}")
        return Posture(platform, float(T[2, 3]), float(head_yaw), float(pitch))

    def candidates(self, sphere: ViewSphere) -> Candidates:
        """Return the views of the sphere that can be reached and see its centre past the furniture.

        Another sphere, or other cells in reach, need new ones; otherwise only their paths change.
        """
        reached = np.isfinite(self._path_lengths)
        offer = self._offer
        if offer is None or offer[0] is not sphere or not np.array_equal(offer[1], reached):
            offer = self._offer = (sphere, reached, *self._offered(sphere))
        return offer[2].from_elsewhere(self._path_lengths[offer[3]])

    def _offered(self, sphere: ViewSphere) -> tuple[Candidates, Indices]:
        """The views of a sphere that can be reached, and the cell of each."""
        height = sphere.positions_world[:, 2]
        low, high = self._config.camera_height
        indices = np.flatnonzero((height >= low) & (height <= high))
        poses = sphere.poses(sphere.directions[indices])
        code = np.where(height < low, 0, 1)
        reach, _, _, _, cell = self._reach(poses)
        hidden = self._floor.hidden(poses[:, :3, 3], sphere.centre_world)
        code[indices] = np.where((reach < 0) & hidden, len(REASONS) - 1, reach)
        good = code[indices] < 0
        indices, cell = indices[good], cell[good]
        lengths, rejected = self._path_lengths[cell], count_reasons(code, REASONS)
        return Candidates(poses[good], sphere.directions[indices], lengths, rejected, indices), cell

    def _go(self, posture: Posture, T_world_camera: Array) -> float:
        """Path length over the floor [m]; from there on path lengths begin there."""
        (cell,), _ = self._floor.cells(posture.platform_world[None])
        length = float(self._path_lengths[cell])
        self._path_lengths = self._floor.path_lengths(posture.platform_world).ravel()
        return length

    def _reach(self, T_world_camera: Array) -> tuple[Indices, Array, Array, Array, Indices]:
        """Find how to stand for poses (N, 4, 4), trying head yaws from straight ahead outwards.

        Returns:
            Index of the reason or −1 (N,), platform (N, 3), head yaw (N,), head pitch (N,), and the cell
            the platform stands in (N,).
        """
        config = self._config
        eyes = T_world_camera[:, :3, 3]
        right, forward = T_world_camera[:, :3, 0], T_world_camera[:, :3, 2]
        pitch = np.arcsin(np.clip(forward[:, 2], -1.0, 1.0))
        # Without roll the right axis is level: it gives the heading even where the view is straight down.
        heading = np.arctan2(right[:, 0], -right[:, 1])

        yaws = np.deg2rad(np.linspace(*config.yaw, config.head_yaws))
        yaws = yaws[np.argsort(np.abs(yaws), kind="stable")]
        quality, best = np.full(len(eyes), -1), np.zeros(len(eyes), dtype=np.intp)
        cell = np.zeros(len(eyes), dtype=np.intp)
        left = np.arange(len(eyes))
        for n, head_yaw in enumerate(yaws):
            found, here = self._standing(eyes[left], heading[left] - head_yaw)
            better = found > quality[left]
            rows = left[better]
            quality[rows], best[rows], cell[rows] = found[better], n, here[better]
            left = left[quality[left] < 3]

        tolerance = 1e-9
        low, high = np.deg2rad(config.pitch)
        tests = (
            eyes[:, 2] < config.camera_height[0] - tolerance,
            eyes[:, 2] > config.camera_height[1] + tolerance,
            (pitch < low - tolerance) | (pitch > high + tolerance),
            # The head has no third joint: the image's rows are level, and it is not upside down.
            (np.abs(right[:, 2]) > np.sin(np.deg2rad(0.5))) | (T_world_camera[:, 2, 1] > tolerance),
            *(quality == missing for missing in range(3)),
        )
        refused = np.stack(tests)
        code = np.where(refused.any(axis=0), refused.argmax(axis=0), -1)
        yaw = heading - yaws[best]
        wrapped = (yaw + np.pi) % (2.0 * np.pi) - np.pi
        platform_world = np.column_stack([eyes[:, :2] - self._forward(yaw), wrapped])
        return code, platform_world, yaws[best], pitch, cell

    def _standing(self, eyes_world: Array, yaw: Array) -> tuple[Indices, Indices]:
        """How well the platform stands with a yaw (N,), from 0 outside the floor to 3, and in which cell."""
        cell, inside = self._floor.cells(eyes_world[:, :2] - self._forward(yaw))
        free = self._floor.free.ravel()[cell] & inside
        return inside.astype(np.intp) + free + (free & np.isfinite(self._path_lengths[cell])), cell

    def _forward(self, yaw: Array) -> Array:
        """How far (N, 2) [m] the camera stands before the platform's centre with a yaw (N,)."""
        return self._config.camera_forward * np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
