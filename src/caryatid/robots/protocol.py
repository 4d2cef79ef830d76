"""The `Robot` protocol, a base class of simulated robots, and a recording played back."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from caryatid.errors import InputError, PlanningError
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.io.datasets import Dataset
from caryatid.planning.candidates import Candidates, Posture
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.sensing.views import View


@dataclass(frozen=True, slots=True)
class Unreachable:
    """A pose that the robot cannot reach, and the reason in words for people."""

    reason: str


class Robot(Protocol):
    """A robot that carries the camera. If it needs its own view sphere, it also inherits `OwnViews`."""

    @property
    def T_world_camera(self) -> Array:
        """Current camera pose (4, 4)."""
        ...

    def solve(self, T_world_camera: Array) -> Posture | Unreachable:
        """Return the robot's posture with its camera at a pose (4, 4), or why there is none."""
        ...

    def candidates(self, sphere: ViewSphere) -> Candidates:
        """Return the views of the sphere that can be reached; camera poses (N, 4, 4) alone are accepted."""
        ...

    def move_to(self, T_world_camera: Array) -> float:
        """Go to a pose (4, 4) of the camera and return the path length [m].

        Raises:
            PlanningError: The pose cannot be reached.
        """
        ...


class OwnViews:
    """Optional methods of a robot, called only if it inherits this class."""

    def view_sphere(self, proposed: ViewSphere) -> ViewSphere:
        """Return the sphere of this robot's views; proposed is that of the settings around the table top.

        Equal arguments give the same sphere. Its own result as the argument gives that result again.
        """
        return proposed

    def confirm(self, T_world_camera: Array) -> Unreachable | None:
        """Return why a chosen candidate (4, 4) is rejected after a closer check, or None to accept it."""
        return None

    def waypoints(self, T_world_camera: Array) -> Sequence[Posture]:
        """Return the postures on the path to a pose (4, 4), both ends included, joined by straight lines.

        An empty sequence = only the posture at the pose is known, from `solve`.
        """
        return ()


class SimulatedRobot(Robot):
    """Base of simulated robots: the camera's pose, and moves from there."""

    _T_world_camera: Array | None = None
    _posture: Posture | None = None

    @property
    def T_world_camera(self) -> Array:
        """Current camera pose (4, 4).

        Raises:
            PlanningError: It has no pose yet.
        """
        if self._T_world_camera is None:
            raise PlanningError("the robot has no camera pose yet; move it to a first view")
        return self._T_world_camera

    def _posture_at(self, T_world_camera: Array) -> Posture:
        """The posture at a pose (4, 4); a `PlanningError` if it cannot be reached."""
        posture = self.solve(T_world_camera)
        if isinstance(posture, Unreachable):
            raise PlanningError(f"the robot cannot reach this view: {posture.reason}")
        return posture

    def _go(self, posture: Posture, T_world_camera: Array) -> float:
        """Move to a posture from `solve`; return the path length [m] from the previous one."""
        return float(straight_lengths(self._T_world_camera, T_world_camera))

    def move_to(self, T_world_camera: Array) -> float:
        """Go there and return the path length [m].

        Raises:
            PlanningError: The pose cannot be reached.
        """
        posture = self._posture_at(T_world_camera)
        length = self._go(posture, T_world_camera)
        self._T_world_camera, self._posture = T_world_camera.copy(), posture
        return length


def straight_lengths(T_world_from: Array | None, T_world_camera: Array) -> Array:
    """Straight path length (...) [m] from one camera pose (4, 4) to others (..., 4, 4); 0 from None."""
    eyes = T_world_camera[..., :3, 3]
    start = eyes if T_world_from is None else T_world_from[:3, 3]
    return np.linalg.norm(eyes - start, axis=-1)


def posture_at(T_world_camera: Array, platform_world: Array) -> Posture:
    """Posture of a level camera at a pose (4, 4) above a platform (3,): its gaze as yaw and pitch."""
    x, y, z = T_world_camera[:3, 2].tolist()
    turn = math.atan2(y, x) - float(platform_world[2])
    head_yaw = math.atan2(math.sin(turn), math.cos(turn))
    return Posture(platform_world, float(T_world_camera[2, 3]), head_yaw, math.asin(min(max(z, -1.0), 1.0)))


def count_reasons(code: NDArray[np.intp], reasons: Sequence[str]) -> dict[str, int]:
    """Number of views refused for each reason, by the index (N,) of each view's reason; −1 = not refused."""
    counts = {reason: int((code == index).sum()) for index, reason in enumerate(reasons)}
    return {reason: count for reason, count in counts.items() if count}


def view_sphere_of(robot: Robot | None, proposed: ViewSphere) -> ViewSphere:
    """Return the sphere of a robot's views: its own if it inherits `OwnViews`, else the proposed one."""
    return robot.view_sphere(proposed) if isinstance(robot, OwnViews) else proposed


def refusal_of(robot: Robot, T_world_camera: Array) -> Unreachable | None:
    """Why a robot that inherits `OwnViews` refuses a candidate (4, 4) after a closer check, or None."""
    try:
        return robot.confirm(T_world_camera) if isinstance(robot, OwnViews) else None
    except PlanningError as error:
        return Unreachable(str(error))


def way_to(robot: Robot | None, T_world_camera: Array) -> tuple[Posture, ...] | Unreachable:
    """Postures of a robot on the way to a candidate (4, 4), or why it refuses it after a closer check.

    Only the posture there if it gives no others.
    """
    if robot is None:
        return ()
    refused = refusal_of(robot, T_world_camera)
    if refused is not None:
        return refused
    try:
        if isinstance(robot, OwnViews) and (waypoints := robot.waypoints(T_world_camera)):
            return tuple(waypoints)
        posture = robot.solve(T_world_camera)
    except PlanningError as error:
        return Unreachable(str(error))
    return (posture,) if isinstance(posture, Posture) else posture


class RecordingRobot(SimulatedRobot):
    """Reaches each recorded pose (N, 4, 4), N ≥ 1, once, and begins at the first."""

    def __init__(self, T_world_cameras: Array | Sequence[Array]) -> None:
        self._recorded = np.array(T_world_cameras, dtype=np.float64)
        self._T_world_camera = self._recorded[0]
        self._used: list[int | None] = [0]

    def _index_of(self, T_world_camera: Array) -> int | None:
        """Recorded view with this pose (4, 4), to 1 mm and 1 mrad; of several, the first unused one."""
        same = np.flatnonzero(np.abs(self._recorded - T_world_camera).max(axis=(1, 2)) <= 1e-3).tolist()
        return min(same, key=lambda i: (i in self._used, i), default=None)

    def solve(self, T_world_camera: Array) -> Posture | Unreachable:
        """Return the posture at a recorded pose (4, 4), or say that the recording has no such view."""
        T = transforms.as_rigid(T_world_camera, "T_world_camera")
        index = self._index_of(T)
        if index is None:
            nearest = float(np.linalg.norm(self._recorded[:, :3, 3] - T[:3, 3], axis=-1).min())
            why = f"the nearest of its {len(self._recorded)} views is {nearest:.2f} m away"
            return Unreachable(f"the recording has no view at this pose; {why}")
        if index in self._used:
            return Unreachable(f"view {index + 1} of the recording was already used")
        forward = T[:3, 2]
        return posture_at(T, np.array([T[0, 3], T[1, 3], np.arctan2(forward[1], forward[0])]))

    def candidates(self, sphere: ViewSphere) -> Candidates:
        """Return the recorded views that have not been used; paths are straight lines between cameras."""
        left = [index for index in range(len(self._recorded)) if index not in self._used]
        poses = self._recorded[left]
        lengths, nowhere = straight_lengths(self._T_world_camera, poses), len(sphere.directions)
        rejected = {"already used": len(self._used), "the recording has no view at this pose": nowhere}
        return Candidates(poses, sphere.direction_of(poses), lengths, rejected)

    def _go(self, posture: Posture, T_world_camera: Array) -> float:
        """Mark a recorded view as used, and return the straight distance to it [m]."""
        self._used.append(self._index_of(T_world_camera))
        return super()._go(posture, T_world_camera)


class RecordingCamera:
    """Returns the recorded frame nearest to a pose.

    Raises:
        InputError: Several frames of which some have no pose.
    """

    def __init__(self, recording: Dataset) -> None:
        if len(recording) > 1 and not recording.has_poses:
            remedy = "add cam_R_w2c and cam_t_w2c to each"
            raise InputError(recording.path, "several frames have no poses", remedy)
        self._recording = recording
        self._shown: set[int] = set()

    def capture(self, T_world_camera: Array) -> View:
        """Return the frame recorded nearest to a pose (4, 4)."""
        poses = [f.T_world_camera for f in self._recording.frames]
        distances = [0.0 if T is None else np.abs(T[:3] - T_world_camera[:3]).max() for T in poses]
        nearest = np.flatnonzero(np.array(distances) <= min(distances) + 1e-3).tolist()
        index = min(nearest, key=lambda i: (i in self._shown, i))
        self._shown.add(index)
        return self._recording.frames[index].load()
