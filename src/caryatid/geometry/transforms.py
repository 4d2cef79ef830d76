"""Rigid transforms as 4×4 arrays, named `T_target_source`: `p_target = T_target_source @ p_source`."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from caryatid.errors import InputError

Array = NDArray[np.float64]
"""An array of float64; its shape is given where it is used."""


UP: Array = np.array([0.0, 0.0, 1.0])
"""The world's vertical (3,)."""
FARTHEST = 1e6
"""Largest coordinate of a translation [m]; beyond it, units are wrong, and float64 resolves no nanometre."""
RIGID_TOLERANCE = 1e-4
"""How far RᵀR may be from the identity (per entry, no unit) before a matrix is refused as a rotation."""


def as_rigid(T: ArrayLike, name: str = "transform") -> Array:
    """Check that `T` is a rigid transform and return it as float64 (4, 4).

    Args:
        T: Homogeneous matrix (4, 4), translation in metres.
        name: What to call it in the error.

    Raises:
        InputError: The matrix has another shape, holds NaN, is not a rotation or has a wrong last row, or
            the translation is beyond `FARTHEST`.
    """
    try:
        matrix = np.asarray(T, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(name, "not a matrix", "give a homogeneous rigid transform (4, 4)") from None
    if matrix.shape != (4, 4):
        raise InputError(name, f"shape {matrix.shape} is not (4, 4)", "give a homogeneous rigid transform")
    if not np.isfinite(matrix).all():
        raise InputError(name, "contains NaN or infinity", "give a finite rigid transform")
    if not np.allclose(matrix[3], (0.0, 0.0, 0.0, 1.0), atol=RIGID_TOLERANCE):
        raise InputError(name, "the last row is not 0 0 0 1", "give a homogeneous rigid transform")
    if np.abs(matrix[:3, 3]).max() > FARTHEST:
        raise InputError(name, f"more than {FARTHEST:g} m from the world's origin", "give it in metres")
    R = matrix[:3, :3]
    if not np.allclose(R.T @ R, np.eye(3), atol=RIGID_TOLERANCE) or np.linalg.det(R) < 0.0:
        reason = "the 3×3 part is not a rotation (not orthonormal, or mirrored)"
        raise InputError(name, reason, "check units and row order; p_world = T_world_camera @ p_camera")
    return matrix


def rigid(R: ArrayLike, t: ArrayLike) -> Array:
    """Put a rotation (3, 3) and a translation (3,) [m] together into a transform (4, 4)."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    return T


def invert(T_a_b: Array) -> Array:
    """Return `T_b_a` of a rigid `T_a_b`; leading axes (..., 4, 4) are kept."""
    R_b_a = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    T_b_a = np.zeros_like(T_a_b)
    T_b_a[..., :3, :3] = R_b_a
    T_b_a[..., :3, 3] = -np.einsum("...ij,...j->...i", R_b_a, T_a_b[..., :3, 3])
    T_b_a[..., 3, 3] = 1.0
    return T_b_a


def transform(T_a_b: Array, points_b: Array) -> Array:
    """Move points (..., 3) [m] from frame b to frame a by a rigid transform (4, 4)."""
    return points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def rotate(T_a_b: Array, vectors_b: Array) -> Array:
    """Turn vectors (..., 3) from frame b into frame a by the rotation of a rigid transform (4, 4)."""
    return vectors_b @ T_a_b[:3, :3].T


def unit(vectors: ArrayLike) -> Array:
    """Scale vectors (..., 3) to length 1; zero vectors stay zero."""
    array = np.asarray(vectors, dtype=np.float64)
    length = np.linalg.norm(array, axis=-1, keepdims=True)
    return array / np.where(length > 0.0, length, 1.0)


def angle_between(a: ArrayLike, b: ArrayLike) -> Array:
    """Angle (...) [rad] between vectors (..., 3) that are not zero, exact for small and opposite ones too."""
    u, v = unit(a), unit(b)
    return 2.0 * np.arctan2(np.linalg.norm(u - v, axis=-1), np.linalg.norm(u + v, axis=-1))


def perpendicular(axis: ArrayLike) -> Array:
    """Return unit vectors (..., 3) perpendicular to `axis` (..., 3)."""
    a = unit(axis)
    helper = np.eye(3)[np.argmin(np.abs(a), axis=-1)]
    return unit(np.cross(a, helper))


def rotation_from_vector(rotation_vector: ArrayLike) -> Array:
    """Rodrigues' formula: rotation vector (3,) [rad] to a 3×3 rotation."""
    w = np.asarray(rotation_vector, dtype=np.float64)
    angle = float(np.linalg.norm(w))
    if angle < 1e-12:
        return np.eye(3) + skew(w)
    k = skew(w / angle)
    return np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * (k @ k)


def skew(w: Array) -> Array:
    """Cross-product matrix of `w` (3,)."""
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])


def random_rotation(rng: np.random.Generator) -> Array:
    """Draw a 3×3 rotation uniformly over SO(3)."""
    q = unit(rng.normal(size=4))
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def look_at(eye_world: ArrayLike, target_world: ArrayLike, up_world: ArrayLike = (0.0, 0.0, 1.0)) -> Array:
    """`T_world_camera` (..., 4, 4) of OpenCV cameras (x right, y down, z forward) that look at a target.

    Straight up or down, where `up` gives no roll, the image's top points along world +x (or +y).

    Args:
        eye_world: Camera centres (..., 3) [m].
        target_world: Points on the optical axes (..., 3) [m].
        up_world: Direction (3,) that is up in the image.

    Raises:
        InputError: Eye and target are the same point.
    """
    eye = np.asarray(eye_world, dtype=np.float64)
    forward = np.asarray(target_world, dtype=np.float64) - eye
    if (np.linalg.norm(forward, axis=-1) < 1e-9).any():
        raise InputError("look_at", "eye and target are the same point", "give two different points")
    z = unit(forward)
    x = z @ skew(np.asarray(up_world, dtype=np.float64))  # z × up
    upright = np.linalg.norm(x, axis=-1) < 1e-6
    if upright.any():
        aside = np.where(np.abs(z[upright, :1]) > 0.9, (0.0, 1.0, 0.0), (1.0, 0.0, 0.0))
        x[upright] = np.cross(z[upright], aside)
    x = unit(x)
    T = np.zeros((*z.shape[:-1], 4, 4))
    T[..., :3, :] = np.stack([x, np.cross(z, x), z, np.broadcast_to(eye, z.shape)], axis=-1)
    T[..., 3, 3] = 1.0
    return T


def level_world(normal: ArrayLike, point: ArrayLike) -> Array:
    """`T_world_camera` (4, 4) for a frame without a pose, from the support plane seen by the camera.

    World z is the plane's upward unit normal (3,), world x the camera's viewing direction projected to the
    plane, and the world's origin the plane's point below the camera. The normal and a point (3,) [m] of the
    plane, any one, are in the camera frame.
    """
    up = unit(normal)
    forward = np.array([0.0, 0.0, 1.0]) - up[2] * up
    x = unit(forward) if np.linalg.norm(forward) > 1e-6 else perpendicular(up)
    R_world_camera = np.stack([x, np.cross(up, x), up])
    height = -float(np.dot(up, np.asarray(point, dtype=np.float64)))
    return rigid(R_world_camera, (0.0, 0.0, height))
