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
MATT: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False}


class RobotDrawing:
    """A humanoid of platform, torso, arms and head, or an arm with its base; nothing where there is no robot.

    Args:
        scene: A `viser.SceneApi`.
        robot: Its pose.
        waypoints: Way to its pose, which it drives in the viewer; empty if unknown.
    """

    def __init__(self, scene: Any, robot: RobotPose | None, waypoints: Sequence[Posture]) -> None:
        self._scene, self._way = scene, []
        self.nodes: list[Any] = []
        if robot is None:
            return
        self._eye, platform_world = robot.T_world_camera[:3, 3], robot.posture.platform_world
        self._floor = self._eye[2] - robot.posture.camera_height
        self._ahead = float(np.hypot(*(self._eye - platform_world)[:2]))
        if robot.arm:
            self._build_arm(platform_world)
            return
        self._build_humanoid(robot.footprint)
        self._way = stations(waypoints or [robot.posture])
        self.drive()

    def drive(self) -> bool:
        """Move on to the next place of the way; returns whether there is another one."""
        if self._way:
            x, y, yaw, height, head_yaw, head_pitch = self._way.pop(0)
            self._body.position, self._body.wxyz = (x, y, self._floor), _turn(yaw)
            self._torso.dimensions = (0.16, 0.2, max(height - 0.45, 0.05))
            self._torso.position = (0.0, 0.0, 0.2 + self._torso.dimensions[2] / 2.0)
            self._upper.position = (0.0, 0.0, height)
            self._head.wxyz = _turn(head_yaw, -head_pitch)
        return bool(self._way)

    def _build_humanoid(self, footprint: float) -> None:
        add, box = self._scene.add_frame, self._scene.add_box
        self._body = add("/robot/body", show_axes=False)
        self._upper = add("/robot/body/upper", show_axes=False)
        self._head = add("/robot/body/upper/head", show_axes=False, position=(self._ahead, 0.0, 0.0))
        self._scene.add_cylinder(
            "/robot/body/platform", footprint, 0.22, DARK, position=(0.0, 0.0, 0.12), **MATT
        )
        self._torso = box("/robot/body/torso", LIGHT, **MATT)
        for name, colour, size, at in (
            ("shoulders", LIGHT, (0.18, 0.52, 0.16), (0.0, 0.0, -0.26)),
            ("right", DARK, (0.1, 0.09, 0.5), (0.02, -0.3, -0.45)),
            ("left", DARK, (0.1, 0.09, 0.5), (0.02, 0.3, -0.45)),
            ("head/skull", LIGHT, (0.18, 0.2, 0.2), (-0.09, 0.0, 0.0)),
            ("head/eyes", DARK, (0.03, 0.16, 0.06), (0.0, 0.0, 0.0)),
        ):
            box(f"/robot/body/upper/{name}", colour, size, position=at, **MATT)
        self.nodes = [self._body]

    def _build_arm(self, platform_world: Array) -> None:
        base = np.array([*platform_world[:2], self._floor])
        shoulder = base + (0.0, 0.0, 0.1)
        elbow = (shoulder + self._eye) / 2.0 + (0.0, 0.0, 0.25)
        links = np.array([[shoulder, elbow], [elbow, self._eye]])
        self.nodes = [
            self._scene.add_cylinder(
                "/robot/base", 0.08, 0.1, DARK, position=base + (0.0, 0.0, 0.05), **MATT
            ),
            self._scene.add_line_segments("/robot/links", links, LIGHT, thickness=0.1),
        ]


def stations(waypoints: Sequence[Posture]) -> list[Array]:
    """Platform x, y, yaw, camera height, head yaw and pitch (6,) every `STRIDE` of a way, and at its end."""
    corners = np.array([[*p.platform_world, p.camera_height, p.head_yaw, p.head_pitch] for p in waypoints])
    corners[:, 2] = np.unwrap(corners[:, 2])
    legs = np.diff(corners, axis=0)
    passed = np.append(0.0, np.cumsum(np.hypot(legs[:, 0], legs[:, 1]) + 0.3 * np.abs(legs[:, 2])))
    between = [np.interp(np.arange(0.0, passed[-1], STRIDE), passed, column) for column in corners.T]
    return [*np.stack(between, axis=1), corners[-1]]


def _turn(yaw: float, pitch: float = 0.0) -> Array:
    wxyz: Array = Rotation.from_euler("ZY", (yaw, pitch)).as_quat(scalar_first=True)
    return wxyz
