"""A camera that plays a recording back: what it captures at a pose is the frame recorded there."""

from __future__ import annotations

import numpy as np

from caryatid.errors import InputError
from caryatid.geometry.transforms import Array
from caryatid.io.bop import Recording
from caryatid.sensing.views import View


class RecordingCamera:
    """Gives the recorded frame nearest to a pose.

    Args:
        recording: Frames with poses, or a single frame.

    Raises:
        InputError: Several frames of which some have no pose.
    """

    def __init__(self, recording: Recording) -> None:
        if len(recording) > 1 and not recording.has_poses:
            raise InputError(
                recording.folder, "has several frames without poses", "add cam_R_w2c and cam_t_w2c to each"
            )
        self._recording = recording

    def capture(self, T_world_camera: Array) -> View:
        """Return the frame recorded nearest to a pose (4, 4)."""
        poses = [f.T_world_camera for f in self._recording.frames]
        distances = [0.0 if T is None else np.abs(T[:3] - T_world_camera[:3]).max() for T in poses]
        return self._recording.frames[int(np.argmin(distances))].load()
