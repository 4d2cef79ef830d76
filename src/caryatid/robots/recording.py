"""A recording played back: the robot can only be where a recorded view is, the camera gives that view."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.io.datasets import Dataset
from caryatid.planning.candidates import Candidates
from caryatid.robots.protocol import Posture, SimulatedRobot, Unreachable, posture_at
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.sensing.views import View


class RecordingRobot(SimulatedRobot):
    """Reaches each view of a recording once.

    Args:
        T_world_cameras: The recorded poses (N, 4, 4).
        start: Index of the view it begins at.

    Raises:
        InputError: There is no recorded pose, or `start` is not one of them.
    """

    def __init__(self, T_world_cameras: Array | Sequence[Array], start: int = 0) -> None:
        self._recorded = np.array(T_world_cameras, dtype=np.float64).reshape(-1, 4, 4)
        if not 0 <= start < len(self._recorded):
            why = f"has no view {start} of {len(self._recorded)}"
            raise InputError("recording", why, "give poses to be at")
        self._used = [start]

    @property
    def T_world_camera(self) -> Array:
        """Where the camera is now (4, 4)."""
        return self._recorded[self._used[-1]]

    def index_of(self, T_world_camera: Array) -> int | None:
        """Which recorded view has this pose (4, 4) to 1 mm and 2 mrad; of several the first not used yet."""
        distance = np.linalg.norm(self._recorded[:, :3, 3] - T_world_camera[:3, 3], axis=-1)
        cosine = (np.einsum("nij,ij->n", self._recorded[:, :3, :3], T_world_camera[:3, :3]) - 1.0) / 2.0
        angle = np.arccos(np.clip(cosine, -1.0, 1.0))
        same = np.flatnonzero((distance <= 1e-3) & (angle <= 2e-3))
        unused = [int(i) for i in same if i not in self._used]
        return unused[0] if unused else (int(same[0]) if len(same) else None)

    def solve(self, T_world_camera: Array) -> Posture | Unreachable:
        """Say where the recording's camera was, or that it has not been at a pose (4, 4)."""
        T = transforms.as_rigid(T_world_camera, "T_world_camera")
        index = self.index_of(T)
        if index is None:
            nearest = float(np.linalg.norm(self._recorded[:, :3, 3] - T[:3, 3], axis=-1).min())
            return Unreachable(
                f"the recording has no view from there; the nearest of its {len(self._recorded)} views is "
                f"{nearest:.2f} m away"
            )
        if index in self._used:
            return Unreachable(f"view {index} of the recording has already been used")
        forward = T[:3, 2]
        return posture_at(T, np.array([T[0, 3], T[1, 3], np.arctan2(forward[1], forward[0])]))

    def candidates(self, sphere: ViewSphere) -> Candidates:
        """Return the recorded views that have not been used; paths are straight lines between cameras."""
        left = np.setdiff1d(np.arange(len(self._recorded)), self._used)
        poses = self._recorded[left]
        path_length = np.linalg.norm(poses[:, :3, 3] - self.T_world_camera[:3, 3], axis=-1)
        nowhere = len(sphere.directions)
        rejected = {"already used": len(self._used), "the recording has no view from there": nowhere}
        return Candidates(poses, sphere.direction_of(poses), path_length, rejected)

    def _go(self, posture: Posture, T_world_camera: Array) -> float:
        """The straight distance to a recorded view [m], which is then used."""
        before, index = self.T_world_camera, self.index_of(T_world_camera)
        assert index is not None
        self._used.append(index)
        return float(np.linalg.norm(self.T_world_camera[:3, 3] - before[:3, 3]))


class RecordingCamera:
    """Gives the recorded frame nearest to a pose.

    Args:
        recording: Frames with poses, or a single frame.

    Raises:
        InputError: Several frames of which some have no pose.
    """

    def __init__(self, recording: Dataset) -> None:
        if len(recording) > 1 and not recording.has_poses:
            raise InputError(
                recording.path, "has several frames without poses", "add cam_R_w2c and cam_t_w2c to each"
            )
        self._recording = recording

    def capture(self, T_world_camera: Array) -> View:
        """Return the frame recorded nearest to a pose (4, 4)."""
        poses = [f.T_world_camera for f in self._recording.frames]
        distances = [0.0 if T is None else np.abs(T[:3] - T_world_camera[:3]).max() for T in poses]
        return self._recording.frames[int(np.argmin(distances))].load()
