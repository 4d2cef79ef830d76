"""Arms for tests whose reach is known without a map."""

from __future__ import annotations

import numpy as np

from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.robots import Posture

LOW, HIGH = np.array([0.2, -0.2, 0.1]), np.array([0.6, 0.2, 0.4])
"""Where the gantry's camera can be [m]."""

PITCH, ROLL = np.deg2rad((-50.0, -10.0)), np.deg2rad((-60.0, 60.0))

LIMITS = np.column_stack([[*LOW, -np.pi, PITCH[0], ROLL[0]], [*HIGH, np.pi, PITCH[1], ROLL[1]]])

SLIDES = np.array([[-0.3, 1.2], [-0.6, 0.6], [0.3, 0.7], *LIMITS[3:]])
"""The same gantry all over a table that begins 0.2 m before its base."""


def gantry(joints: Array) -> Array:
    """Forward kinematics of three slides with yaw, pitch and roll behind them: `T_base_camera` (N, 4, 4)."""
    yaw, pitch, roll = joints[:, 3:].T
    zero = np.zeros(len(joints))
    forward = np.stack([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)], axis=-1)
    level = np.stack([np.sin(yaw), -np.cos(yaw), zero], axis=-1)
    down = np.cross(forward, level)
    right = np.cos(roll)[:, None] * level + np.sin(roll)[:, None] * down
    T = np.tile(np.eye(4), (len(joints), 1, 1))
    T[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=-1)
    T[:, :3, 3] = joints[:, :3]
    return T


def within_arms_length(T_base_camera: Array) -> np.ndarray:
    """Reach of a made-up arm: 0.2 to 0.9 m from its base, looking down, upright to a quarter of a turn."""
    distance = np.linalg.norm(T_base_camera[:, :3, 3], axis=1)
    return (distance > 0.2) & (distance < 0.9) & (T_base_camera[:, 2, 2] < -0.1)


def sideways_only(T_base_camera: Array) -> np.ndarray:
    """The same arm with its camera mounted on its side: within 30° of lying."""
    return within_arms_length(T_base_camera) & (T_base_camera[:, 2, 0] > 0.5)


def assert_gaze(posture: Posture, T_world_camera: Array) -> None:
    """A posture looks along the axis of the camera, which is as high as it says."""
    gaze, level = posture.platform_world[2] + posture.head_yaw, np.cos(posture.head_pitch)
    axis = [level * np.cos(gaze), level * np.sin(gaze), np.sin(posture.head_pitch)]
    np.testing.assert_allclose(axis, T_world_camera[:3, 2], atol=1e-9)
    assert posture.camera_height == T_world_camera[2, 3]


def base_at(x: float, y: float, z: float, yaw_deg: float = 0.0) -> Array:
    return transforms.rigid(transforms.rotation_from_vector((0.0, 0.0, np.deg2rad(yaw_deg))), (x, y, z))
