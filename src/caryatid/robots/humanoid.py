"""A humanoid: the camera poses it reaches, its postures there, and path lengths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from caryatid.config import RobotConfig
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.planning.candidates import Candidates, Posture
from caryatid.robots.floor import FloorGrid, FloorPaths
from caryatid.robots.protocol import OwnViews, SimulatedRobot, Unreachable, count_reasons
from caryatid.sensing.view_sphere import ViewSphere

REASONS = (
    "the camera would be too low",
    "the camera would be too high",
    "the head pitch is beyond its limits",
    "the camera would be rolled",
    "the platform would be off the floor",
    "the platform would hit an obstacle",
    "no free path",
    "a wall blocks the line of sight",
)
"""Reasons to reject a view; the first that applies counts."""

FARTHEST = 2.0
"""Radius of the view sphere up to which the robot steps back from a low surface [m]: depth gets noisy."""

Indices = NDArray[np.intp]
"""Whole numbers (N,)."""


class HumanoidRobot(SimulatedRobot, OwnViews):
    """A humanoid of ARMAR-6's kind in simulation: holonomic platform, torso lift, head with yaw and pitch.

    It has no pose at first; its first move has path length 0.
    """

    def __init__(self, floor: FloorGrid, config: RobotConfig) -> None:
        self._floor = floor
        self._config = config
        self._paths: FloorPaths | None = None
        self._reached = floor.free.ravel()
        self._offer: tuple[ViewSphere, NDArray[np.bool_], Candidates, Array] | None = None
        self._spheres: tuple[ViewSphere, ViewSphere] | None = None

    def view_sphere(self, proposed: ViewSphere) -> ViewSphere:
        """Look at a low surface, such as the floor, from farther off, where the head need not pitch too far.

        At its steepest pitch the camera then has the middle of its heights.
        """
        if self._spheres is None or self._spheres[0] is not proposed:
            rise = float(np.mean(self._config.camera_height)) - proposed.centre_world[2]
            steepest = np.sin(np.deg2rad(-self._config.pitch[0]))
            radius = min(rise / max(float(steepest), 1e-9), FARTHEST)
            own = proposed if radius <= proposed.radius else replace(proposed, radius=radius)
            self._spheres = proposed, own
        return self._spheres[1]

    def solve(self, T_world_camera: Array) -> Posture | Unreachable:
        """Return the robot's posture with its camera at a pose (4, 4), or why there is none."""
        T = transforms.as_rigid(T_world_camera, "T_world_camera")
        (code,), (platform,), (head_yaw,), (pitch,) = self._reach(T[None])
        if code >= 0:
            x, y, z = T[:3, 3]
            where = f"camera at ({x:.2f}, {y:.2f}, {z:.2f}) m, pitch {np.rad2deg(pitch):.0f}°"
            return Unreachable(f"{REASONS[code]}; {where}")
        return Posture(platform, float(T[2, 3]), float(head_yaw), float(pitch))

    def candidates(self, sphere: ViewSphere) -> Candidates:
        """Return the views of the sphere that can be reached and see its centre past the furniture.

        They are computed again for another sphere or other cells in reach; otherwise only their paths change.
        """
        offer = self._offer
        if offer is None or offer[0] is not sphere or not np.array_equal(offer[1], self._reached):
            offer = self._offer = (sphere, self._reached, *self._offered(sphere))
        return offer[2] if self._paths is None else offer[2].from_elsewhere(self._paths.lengths(offer[3]))

    def waypoints(self, T_world_camera: Array) -> tuple[Posture, ...]:
        """Return its way to a pose (4, 4): corners of the shortest path, turning and lifting evenly.

        The straight lines between the platform's places are as long as the path.

        Raises:
            PlanningError: The pose cannot be reached.
        """
        there, here = self._posture_at(T_world_camera), self._posture
        if here is None or self._paths is None:
            return (there,)
        corners = self._paths.corners(there.platform_world)
        legs = np.linalg.norm(np.diff(corners, axis=0), axis=-1)
        start, end = (
            np.array([p.platform_world[2], p.camera_height, p.head_yaw, p.head_pitch]) for p in (here, there)
        )
        change = end - start
        change[0] = _wrapped(change[0])
        between = (start + change * share for share in np.cumsum(legs)[:-1] / max(float(legs.sum()), 1e-9))
        passed = (
            Posture(np.array([*corner, _wrapped(yaw)]), float(height), float(head_yaw), float(pitch))
            for corner, (yaw, height, head_yaw, pitch) in zip(corners[1:-1], between, strict=True)
        )
        return (here, *passed, there)

    def _offered(self, sphere: ViewSphere) -> tuple[Candidates, Array]:
        """The views of a sphere that can be reached, and where the platform stands for each (N, 3)."""
        height = sphere.positions_world[:, 2]
        low, high = self._config.camera_height
        indices = np.flatnonzero((height >= low) & (height <= high))
        poses = sphere.poses(sphere.directions[indices])
        code = np.where(height < low, 0, 1)
        reach, platform_world, _, _ = self._reach(poses)
        hidden = self._floor.hidden(poses[:, :3, 3], sphere.centre_world)
        code[indices] = np.where((reach < 0) & hidden, len(REASONS) - 1, reach)
        good = code[indices] < 0
        indices, rejected = indices[good], count_reasons(code, REASONS)
        directions, lengths = sphere.directions[indices], np.zeros(len(indices))
        return Candidates(poses[good], directions, lengths, rejected, indices), platform_world[good]

    def _go(self, posture: Posture, T_world_camera: Array) -> float:
        """Drive along the waypoints and return the path length [m]. Later paths begin there."""
        driven = np.array([p.platform_world[:2] for p in self.waypoints(T_world_camera)])
        self._paths = self._floor.paths_from(driven[-1])
        self._reached = np.isfinite(self._paths.to_centres)
        return float(np.linalg.norm(np.diff(driven, axis=0), axis=-1).sum())

    def _reach(self, T_world_camera: Array) -> tuple[Indices, Array, Array, Array]:
        """Index of the reason or −1 (N,), platform (N, 3), head yaw and pitch (N,) for poses (N, 4, 4)."""
        config = self._config
        eyes = T_world_camera[:, :3, 3]
        right, forward = T_world_camera[:, :3, 0], T_world_camera[:, :3, 2]
        pitch = np.arcsin(np.clip(forward[:, 2], -1.0, 1.0))
        # Without roll the right axis is level: it gives the heading even if the view is straight down.
        heading = np.arctan2(right[:, 0], -right[:, 1])

        # Head yaws are tried from straight ahead outwards.
        yaws = np.deg2rad(np.linspace(*config.yaw, config.head_yaws))
        yaws = yaws[np.argsort(np.abs(yaws), kind="stable")]
        quality, best = np.full(len(eyes), -1), np.zeros(len(eyes), dtype=np.intp)
        left = np.arange(len(eyes))
        for n, head_yaw in enumerate(yaws):
            found = self._standing(eyes[left], heading[left] - head_yaw)
            better = found > quality[left]
            rows = left[better]
            quality[rows], best[rows] = found[better], n
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
        platform_world = np.column_stack([eyes[:, :2] - self._forward(yaw), _wrapped(yaw)])
        return code, platform_world, yaws[best], pitch

    def _standing(self, eyes_world: Array, yaw: Array) -> Indices:
        """How well (N,) the platform stands with a yaw (N,): 0 off the floor, 1 in an obstacle, 2 cut off."""
        cell, inside = self._floor.cells(eyes_world[:, :2] - self._forward(yaw))
        free = self._floor.free.ravel()[cell] & inside
        return inside.astype(np.intp) + free + (free & self._reached[cell])

    def _forward(self, yaw: Array) -> Array:
        """Offset (N, 2) [m] of the camera from the platform's centre with a yaw (N,)."""
        return self._config.camera_forward * np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)


def _wrapped(angle: Array) -> Array:
    """Angles (...) [rad] wrapped to [−π, π)."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi
