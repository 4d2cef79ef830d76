"""Least squares on the geometric residual: the signed distance of points to a shape's surface."""

from __future__ import annotations

import numpy as np

from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Sphere
from caryatid.geometry.signed_distance import (
    BOX,
    CYLINDER,
    SPHERE,
    distances_and_gradients,
)
from caryatid.geometry.transforms import Array

ROBUST_WIDTH = 2.5
"""Residuals beyond this many robust standard deviations lose most of their weight (Geman–McClure)."""
RIDGE = 1e-3 * np.array([1.0, 1.0, 1.0, 0.01, 0.01, 0.01, 0.01, 0.01, 0.01])
"""Added to the diagonal, times the damping, so that what no point determines stays where it is."""
NOISE_FLOOR = 0.001
"""Least standard deviation the weights assume [m]: what smoothed points of several views err by. With less,
faces that hold few of the points would be outliers of the others."""
CONVERGED = 1e-4
"""Least squares end with a step that lowers the cost by less than this share; the rest is far below noise."""
ROUGHLY = 1e-3
"""The same where another refinement follows."""

CODES = {"sphere": SPHERE, "cylinder": CYLINDER, "box": BOX}
"""Codes of the shapes, as the kernels take them."""


def linearise(shape: Box | Cylinder | Sphere, points_world: Array) -> tuple[Array, Array]:
    """Signed distances (N,) [m] of points (N, 3) and their derivatives (N, 6 + sizes).

    The columns are a translation [m] and a rotation [rad] of the shape in its own frame, then its sizes [m]:
    three half extents of a box, radius and half height of a cylinder, the radius of a sphere.
    """
    T = shape.T_world_object
    p = (points_world - T[:3, 3]) @ T[:3, :3]
    if isinstance(shape, Sphere):
        length = np.linalg.norm(p, axis=1)
        gradient = p / np.maximum(length, 1e-12)[:, None]
        return length - shape.radius, _jacobian(p, gradient, -np.ones((len(p), 1)))
    if isinstance(shape, Cylinder):
        ring = np.hypot(p[:, 0], p[:, 1])
        q = np.stack([ring - shape.radius, np.abs(p[:, 2]) - shape.height / 2.0], axis=1)
        distance, share = _corner_distance(q)
        outward = p[:, :2] / np.maximum(ring, 1e-12)[:, None]
        gradient = np.concatenate([share[:, :1] * outward, share[:, 1:] * np.sign(p[:, 2:])], axis=1)
        return distance, _jacobian(p, gradient, -share)
    distance, share = _corner_distance(np.abs(p) - shape.extents / 2.0)
    return distance, _jacobian(p, share * np.sign(p), -share)


def stepped(shape: Box | Cylinder | Sphere, step: Array, min_extent: float) -> Box | Cylinder | Sphere:
    """Change a shape by a step (6 + sizes,), ordered as by `linearise`, no size below `min_extent`."""
    T = shape.T_world_object @ transforms.rigid(transforms.rotation_from_vector(step[3:6]), step[:3])
    if isinstance(shape, Sphere):
        return Sphere(T, max(shape.radius + float(step[6]), min_extent / 2.0))
    if isinstance(shape, Cylinder):
        radius = max(shape.radius + float(step[6]), min_extent / 2.0)
        return Cylinder(T, radius, max(shape.height + 2.0 * float(step[7]), min_extent))
    return Box(T, np.maximum(shape.extents + 2.0 * step[6:9], min_extent))


def refine_reference(
    shape: Box | Cylinder | Sphere,
    points_world: Array,
    *,
    steps: int,
    min_extent: float,
    shrink: float,
) -> Box | Cylinder | Sphere:
    """Minimise robust squared signed distances by Levenberg–Marquardt with Geman–McClure weights.

    Does in NumPy, step by step, what `kernels.fitting.levenberg_marquardt` does.

    Args:
        shape: Where to start.
        points_world: (N, 3) [m].
        steps: Steps at the most.
        min_extent: Least extent [m].
        shrink: Gradient [m] that pulls every half extent inwards, so that sides nobody saw stay small. A face
            that holds a share s of the points is moved by shrink / (2·s) only.
    """
    damping = 1e-3
    best = shape
    distance, J = linearise(best, points_world)
    for _ in range(steps):
        scale = ROBUST_WIDTH * max(1.4826 * float(np.median(np.abs(distance))), NOISE_FLOOR)
        weight = 1.0 / (1.0 + (distance / scale) ** 2) ** 2 / len(distance)
        H, gradient = J.T @ (weight[:, None] * J), J.T @ (weight * distance)
        gradient[6:] += shrink / 2.0
        cost = _cost(distance, scale) + shrink * _sizes(best)
        ridge = np.diag(H) + RIDGE[: len(H)]
        for _ in range(6):
            step = np.linalg.solve(H + np.diag(damping * ridge), gradient)
            trial = stepped(best, _limited(-np.asarray(step, dtype=np.float64)), min_extent)
            trial_distance, trial_J = linearise(trial, points_world)
            trial_cost = _cost(trial_distance, scale) + shrink * _sizes(trial)
            if trial_cost < cost:
                break
            damping *= 6.0
        else:
            return best
        best, distance, J = trial, trial_distance, trial_J
        damping = max(damping / 10.0, 1e-7)
        if cost - trial_cost < CONVERGED * cost:
            break
    return best


def distances(shape: Box | Cylinder | Sphere, points_world: Array) -> tuple[Array, Array]:
    """Signed distances (N,) [m] of points (N, 3) and the outward directions (N, 3) there, object frame."""
    return distances_and_gradients(*arrays(shape), np.ascontiguousarray(points_world))


def arrays(shape: Box | Cylinder | Sphere) -> tuple[int, Array, Array, Array]:
    """Code, axes (3, 3), centre (3,) [m] and half extents (3,) [m], as the kernels take them."""
    T = shape.T_world_object
    return CODES[shape.kind], np.ascontiguousarray(T[:3, :3]), T[:3, 3].copy(), shape.extents / 2.0


def from_arrays(kind: str, R: Array, centre: Array, half: Array) -> Box | Cylinder | Sphere:
    """The shape with these axes (3, 3), centre (3,) [m] and half extents (3,) [m].

    Args:
        kind: Name of the shape.
        R: Its axes (3, 3).
        centre: Its centre (3,) [m].
        half: Its half extents (3,) [m].
    """
    T = transforms.rigid(R, centre)
    if kind == "sphere":
        return Sphere(T, float(half[0]))
    if kind == "cylinder":
        return Cylinder(T, float(half[0]), 2.0 * float(half[2]))
    return Box(T, 2.0 * half)


def _jacobian(p: Array, gradient: Array, sizes: Array) -> Array:
    return np.concatenate([-gradient, -np.cross(p, gradient), sizes], axis=1)


def _corner_distance(q: Array) -> tuple[Array, Array]:
    """Distance (N,) for the signed gaps q (N, k) to each pair of faces, and each gap's share (N, k) in it."""
    outside = np.maximum(q, 0.0)
    length = np.linalg.norm(outside, axis=1)
    nearest = np.argmax(q, axis=1)
    rows = np.arange(len(q))
    share = np.zeros_like(q)
    share[rows, nearest] = 1.0
    far = length > 1e-9
    share[far] = outside[far] / length[far, None]
    return np.where(far, length, q[rows, nearest]), share


def _cost(distance: Array, scale: float) -> float:
    squared = (distance / scale) ** 2
    return float(np.mean(squared / (1.0 + squared))) * scale**2


def _sizes(shape: Box | Cylinder | Sphere) -> float:
    if isinstance(shape, Sphere):
        return shape.radius
    if isinstance(shape, Cylinder):
        return shape.radius + shape.height / 2.0
    return float(np.sum(shape.extents)) / 2.0


def _limited(step: Array) -> Array:
    """Shorten a step to 3 cm and 0.3 rad, over which the linearisation means something."""
    longest = max(
        float(np.abs(np.delete(step, [3, 4, 5])).max()) / 0.03, float(np.abs(step[3:6]).max()) / 0.3, 1.0
    )
    return step / longest
