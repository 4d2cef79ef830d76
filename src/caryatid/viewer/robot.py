"""The robot in the viewer: where it stands, and how it drives there along its waypoints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from caryatid.exploration import RobotPose
from caryatid.geometry.transforms import Array
from caryatid.planning.posture import Posture

LIGHT, DARK = (122, 132, 146), (48, 55, 66)
"""Colours of its parts."""
STRIDE = 0.05
"""How far it moves from picture to picture; turning by 1 rad counts as 0.3 m [m]."""


class RobotDrawing:
    """A base, and links from it to the camera; nothing where there is no robot.

    Args:
        scene: A `viser.SceneApi`.
        robot: Its pose.
        waypoints: Way to its pose, which it drives in the viewer; empty if unknown.
    """

    def __init__(self, scene: Any, robot: RobotPose | None, waypoints: Sequence[Posture]) -> None:
        self.nodes: list[Any] = []
        self._way: list[Array] = []
        if robot is None:
            return
        (x, y, yaw), eye_world = robot.posture.platform_world, robot.T_world_camera[:3, 3]
        self._floor, self._arm = eye_world[2] - robot.posture.camera_height, robot.arm
        self._ahead = Rotation.from_euler("Z", -yaw).apply(eye_world - (x, y, self._floor))[:2]
        self._base = scene.add_frame("/robot/base", show_axes=False)
        radius, look = 0.08 if robot.arm else robot.footprint, {"cast_shadow": False, "receive_shadow": False}
        scene.add_cylinder("/robot/base/foot", radius, 0.2, DARK, position=(0.0, 0.0, 0.1), **look)
        self._links = scene.add_line_segments("/robot/base/links", np.zeros((2, 2, 3)), LIGHT, thickness=0.1)
        self.nodes, self._way = [self._base], stations(waypoints or [robot.posture])
        self.drive()

    def drive(self) -> bool:
        """Move on to the next place of the way; returns whether there is another one."""
        if self._way:
            x, y, yaw, height = self._way.pop(0)
            self._base.position = (x, y, self._floor)
            self._base.wxyz = Rotation.from_euler("Z", yaw).as_quat(scalar_first=True)
            elbow = [*self._ahead / 2.0, height / 2.0 + 0.25] if self._arm else [0.0, 0.0, height]
            joints = np.array([[0.0, 0.0, 0.2], elbow, elbow, [*self._ahead, height]], dtype=np.float32)
            self._links.points = joints.reshape(2, 2, 3)
        return bool(self._way)


def stations(waypoints: Sequence[Posture]) -> list[Array]:
    """Platform x, y and yaw, and camera height (4,), every `STRIDE` of a way, and at its end."""
    corners = np.array([[*p.platform_world, p.camera_height] for p in waypoints])
    corners[:, 2] = np.unwrap(corners[:, 2])
    legs = np.diff(corners, axis=0)
    passed = np.append(0.0, np.cumsum(np.hypot(legs[:, 0], legs[:, 1]) + 0.3 * np.abs(legs[:, 2])))
    between = [np.interp(np.arange(0.0, passed[-1], STRIDE), passed, column) for column in corners.T]
    return [*np.stack(between, axis=1), corners[-1]]
