"""Posture of a robot at a camera pose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from caryatid.geometry.transforms import Array


@dataclass(frozen=True, eq=False, slots=True)
class Posture:
    """Posture of a robot at a camera pose.

    Attributes:
        platform_world: Platform (3,): x, y, yaw [m, m, rad].
        camera_height: Height of the camera centre over the floor [m], set by the torso lift.
        head_yaw: Relative to the platform, to the left [rad].
        head_pitch: Upwards [rad].
        joints: Joint positions (J,) of an arm [rad, or m], or None if unknown.
    """

    platform_world: Array
    camera_height: float
    head_yaw: float
    head_pitch: float
    joints: Array | None = None

    def to_json(self) -> dict[str, Any]:
        """Return it as in `session next`, the service and view.json."""
        return {
            "platform": self.platform_world.tolist(),
            "camera_height": self.camera_height,
            "gaze": {"yaw": self.head_yaw, "pitch": self.head_pitch},
            "joints": None if self.joints is None else self.joints.tolist(),
        }
