"""A recording played back: the robot moves between recorded views, and the camera returns them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.io.datasets import Dataset
from caryatid.planning.candidates import Candidates, Posture
from caryatid.robots.protocol import SimulatedRobot, Unreachable, posture_at, straight_lengths
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.sensing.views import View


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
