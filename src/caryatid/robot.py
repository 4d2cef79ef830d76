"""Which camera poses a robot can reach, how it would stand there, and how far the way is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from caryatid import frames
from caryatid.config import RobotConfig
from caryatid.errors import PlanningError
from caryatid.floor import FloorGrid
from caryatid.frames import Array
from caryatid.view_sphere import ViewSphere, direction

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


@dataclass(frozen=True, eq=False, slots=True)
class Posture:
    """How the robot holds its camera at a pose.

    Attributes:
        platform_world: Platform [x, y, yaw] [m, m, rad].
        camera_height: Height of the camera centre over the floor [m], set by the torso lift.
        head_yaw: Against the platform, to the left [rad].
        head_pitch: Upwards [rad].
    """

    platform_world: Array
    camera_height: float
    head_yaw: float
    head_pitch: float


@dataclass(frozen=True, slots=True)
class Unreachable:
    """No posture.

    Attributes:
        reason: Why, for a person to read.
    """

    reason: str


@dataclass(frozen=True, eq=False, slots=True)
class Candidates:
    """The views a robot can reach.

    Attributes:
        T_world_camera: Camera poses (N, 4, 4).
        directions: Unit vectors (N, 3) from the view sphere's centre.
        path_length: Way (N,) [m] over the floor from where the robot stands.
        rejected: Reason → how many views of the sphere were refused for it.
        indices: Which point of the view sphere each candidate is (N,), or None where they lie elsewhere.
    """

    T_world_camera: Array
    directions: Array
    path_length: Array
    rejected: dict[str, int]
    indices: NDArray[np.intp] | None = None

    def __len__(self) -> int:
        return len(self.directions)


class Robot(Protocol):
    """What carries the camera."""

    @property
    def T_world_camera(self) -> Array:
        """Where the camera is now (4, 4)."""
        ...

    def solve(self, T_world_camera: Array) -> Posture | Unreachable:
        """Say how the robot would stand with its camera at a pose (4, 4), or why it cannot."""
        ...

    def candidates(self, sphere: ViewSphere) -> Candidates:
        """Return the views of the sphere that can be reached."""
        ...

    def move_to(self, T_world_camera: Array) -> float:
        """Go there and return the length of the way [m]."""
        ...


class HumanoidRobot:
    """A humanoid of ARMAR-6's kind in simulation: holonomic platform, torso lift, head with yaw and pitch.

    Args:
        floor: Where it may drive, and the furniture it knows of.
        config: Its limits.
        T_world_camera: Where its camera is (4, 4), or None while it has not been put anywhere; then any
            place is reached by a way of length 0.

    Raises:
        PlanningError: It cannot stand at that pose.
    """

    def __init__(self, floor: FloorGrid, config: RobotConfig, T_world_camera: Array | None = None) -> None:
        self._floor = floor
        self._config = config
        self._T_world_camera: Array | None = None
        self._path_lengths = np.where(floor.free, 0.0, np.inf)
        if T_world_camera is not None:
            self.move_to(T_world_camera)

    @property
    def T_world_camera(self) -> Array:
        """Where the camera is now (4, 4).

        Raises:
            PlanningError: The robot has not been put anywhere.
        """
        if self._T_world_camera is None:
            raise PlanningError("the robot stands nowhere yet; move it to a first view")
        return self._T_world_camera

    def solve(self, T_world_camera: Array, target_world: Array | None = None) -> Posture | Unreachable:
        """Say how the robot would stand with its camera at a pose, or why it cannot.

        Args:
            T_world_camera: Camera pose (4, 4).
            target_world: A point (3,) [m] no wall may hide from there, or None.
        """
        T = frames.as_rigid(T_world_camera, "T_world_camera")
        reach = self._reach(T[None], target_world)
        code = int(reach.code[0])
        if code >= 0:
            return Unreachable(REASONS[code] + self._figures(code, T))
        return Posture(
            reach.platform_world[0], float(T[2, 3]), float(reach.head_yaw[0]), float(reach.head_pitch[0])
        )

    def candidates(self, sphere: ViewSphere) -> Candidates:
        """Return the views of the sphere that can be reached and see its centre past the furniture."""
        height = sphere.positions_world[:, 2]
        low, high = self._config.camera_height
        indices = np.flatnonzero((height >= low) & (height <= high))
        poses = sphere.poses(sphere.directions[indices])
        reach = self._reach(poses, sphere.centre_world)
        counts = np.bincount(reach.code + 1, minlength=len(REASONS) + 1)[1:]
        counts[:2] += (height < low).sum(), (height > high).sum()
        rejected = {reason: int(n) for reason, n in zip(REASONS, counts, strict=True) if n}
        good = reach.code < 0
        return Candidates(
            poses[good], sphere.directions[indices[good]], reach.path_length[good], rejected, indices[good]
        )

    def move_to(self, T_world_camera: Array) -> float:
        """Go there and return the length of the way over the floor [m].

        Raises:
            PlanningError: The pose cannot be reached.
        """
        posture = self.solve(T_world_camera)
        if isinstance(posture, Unreachable):
            raise PlanningError(f"the robot cannot go to this view: {posture.reason}")
        cell, _ = self._floor.cells(posture.platform_world[None])
        length = float(self._path_lengths.ravel()[cell[0]])
        self._path_lengths = self._floor.path_lengths(posture.platform_world)
        self._T_world_camera = np.array(T_world_camera, dtype=np.float64)
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
        platform_yaw = heading[:, None] - yaws
        offset = config.camera_forward * np.stack([np.cos(platform_yaw), np.sin(platform_yaw)], axis=-1)
        platform = eyes[:, None, :2] - offset
        cell, inside = self._floor.cells(platform.reshape(-1, 2))
        shape = platform_yaw.shape
        inside = inside.reshape(shape)
        free = self._floor.free.ravel()[cell].reshape(shape) & inside
        path = np.where(free, self._path_lengths.ravel()[cell].reshape(shape), np.inf)
        quality = np.where(np.isfinite(path), 3, np.where(free, 2, np.where(inside, 1, 0)))
        best = np.argmax(quality, axis=1)
        rows = np.arange(len(eyes))
        quality = quality[rows, best]

        tolerance = 1e-9
        tests = (
            eyes[:, 2] < config.camera_height[0] - tolerance,
            eyes[:, 2] > config.camera_height[1] + tolerance,
            (pitch < np.deg2rad(config.pitch[0]) - tolerance)
            | (pitch > np.deg2rad(config.pitch[1]) + tolerance),
            roll > np.deg2rad(config.max_roll),
            quality == 0,
            quality == 1,
            quality == 2,
            np.zeros(len(eyes), dtype=np.bool_)
            if target_world is None
            else self._floor.hidden(eyes, target_world, config.table_margin),
        )
        refused = np.stack(tests)
        code = np.where(refused.any(axis=0), refused.argmax(axis=0), -1)
        yaw = _wrap(platform_yaw[rows, best])
        platform_world = np.column_stack([platform[rows, best], yaw])
        return _Reach(code, platform_world, yaws[best], pitch, path[rows, best])

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
    """Reachability of N poses: index of the reason or −1, platform, gaze, and the way there."""

    code: NDArray[np.intp]
    platform_world: Array
    head_yaw: Array
    head_pitch: Array
    path_length: Array


def home_view(robot: Robot, sphere: ViewSphere, config: RobotConfig) -> Array:
    """Pick the first view: the reachable candidate (4, 4) nearest to `config.home` on the view sphere.

    Raises:
        PlanningError: No view of the sphere can be reached.
    """
    candidates = robot.candidates(sphere)
    if len(candidates) == 0:
        why = ", ".join(f"{reason} ({count})" for reason, count in candidates.rejected.items())
        raise PlanningError(f"no view of the sphere can be reached: {why}")
    home = direction(*np.deg2rad(config.home))
    return candidates.T_world_camera[int(np.argmax(candidates.directions @ home))]


def _wrap(angle: Array) -> Array:
    """Bring angles into [−π, π) [rad]."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi
