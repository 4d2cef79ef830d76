"""Shapes drawn as solids on a table, by walking along the rays; no OpenGL, no scene needed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array

STEPS, REACHED = 80, 2e-4
"""Steps along a ray at the most, and the distance from a surface that counts as on it [m]."""
LIGHT = transforms.unit(np.array([0.3, -0.5, 1.0]))
AMBIENT = 0.45
"""Share of the light that comes from everywhere [1]."""
TABLE_COLOUR, SKY_COLOUR = (0.91, 0.89, 0.86), (1.0, 1.0, 1.0)


class Solid(Protocol):
    """What can be drawn: boxes, cylinders and spheres are."""

    @property
    def T_world_object(self) -> Array:
        """Pose (4, 4) of the middle."""

    @property
    def extents(self) -> Array:
        """Sides (3,) [m] of a box around it, along its axes."""

    def signed_distance(self, points_world: Array) -> Array:
        """Distance (N,) [m] of points (N, 3), negative inside; outside it may be too short, not too long."""


@dataclass(frozen=True, eq=False, slots=True)
class Eye:
    """Where a picture is drawn from.

    Attributes:
        T_world_camera: Pose (4, 4), OpenCV camera frame.
        K: Pinhole matrix (3, 3) [px].
        width: Of the picture [px].
        height: Of the picture [px].
    """

    T_world_camera: Array
    K: Array
    width: int
    height: int

    @classmethod
    def towards(cls, centre_world: Array, direction: Array, radius: float, width: int, height: int) -> Eye:
        """An eye in a direction (3,) from a centre (3,) [m] that sees a ball of some radius [m] around it."""
        distance = 7.0 * radius
        focal = 0.5 * min(width, height) * distance / radius
        K = np.array([[focal, 0.0, (width - 1) / 2.0], [0.0, focal, (height - 1) / 2.0], [0.0, 0.0, 1.0]])
        return cls(transforms.look_at(centre_world + distance * direction, centre_world), K, width, height)

    def project(self, points_world: Array) -> Array:
        """Pixels (N, 2) of points (N, 3) [m]."""
        points_camera = transforms.transform(transforms.invert(self.T_world_camera), points_world)
        return points_camera[:, :2] / points_camera[:, 2:] @ self.K[:2, :2].T + self.K[:2, 2]

    def rays_world(self) -> Array:
        """Unit directions (H·W, 3) of the pixels' rays, row by row."""
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        pixels = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=1)
        return transforms.unit(pixels @ np.linalg.inv(self.K).T @ self.T_world_camera[:3, :3].T)


def draw_solids(
    shapes: Sequence[Solid], colours: Sequence[tuple[float, float, float]], table_top: float, eye: Eye
) -> tuple[Array, NDArray[np.intp]]:
    """Draw shapes and the table they stand on.

    Args:
        shapes: S shapes.
        colours: Of each, red, green, blue 0…1.
        table_top: Height [m].
        eye: Where from.

    Returns:
        The picture (H, W, 3) 0…1, and which shape is seen (H, W): its position, S the table, S + 1 nothing.
    """
    rays = eye.rays_world()
    origin = eye.T_world_camera[:3, 3]
    down = np.minimum(rays[:, 2], -1e-9)
    nearest = np.where(rays[:, 2] < -1e-3, (table_top - origin[2]) / down, np.inf)
    seen = np.where(np.isfinite(nearest), len(shapes), len(shapes) + 1)
    normals = np.tile(np.array([0.0, 0.0, 1.0]), (len(rays), 1))
    for position, shape in enumerate(shapes):
        along = _walk(shape, origin, rays)
        hit = along < nearest
        points_world = origin + along[hit, None] * rays[hit]
        nearest[hit], seen[hit], normals[hit] = along[hit], position, _gradient(shape, points_world)
    shadow = np.zeros(len(rays), dtype=bool)
    lit = seen < len(shapes) + 1
    foot = origin + nearest[lit, None] * rays[lit] + 1e-3 * normals[lit]
    dark = np.zeros(len(foot), dtype=bool)
    for shape in shapes:
        dark |= np.isfinite(_walk(shape, foot, np.broadcast_to(LIGHT, foot.shape)))
    shadow[lit] = dark
    brightness = AMBIENT + (1.0 - AMBIENT) * np.maximum(normals @ LIGHT, 0.0) * np.where(shadow, 0.3, 1.0)
    brightness[~lit] = 1.0
    palette = np.array([*colours, TABLE_COLOUR, SKY_COLOUR])
    size = (eye.height, eye.width)
    return np.clip(palette[seen] * brightness[:, None], 0.0, 1.0).reshape(*size, 3), seen.reshape(size)


def _walk(shape: Solid, origin: Array, rays: Array) -> Array:
    """How far (N,) [m] along unit rays (N, 3) from an origin (3,) or (N, 3) a shape is met; inf = never."""
    centre, radius = shape.T_world_object[:3, 3], 0.5 * float(np.linalg.norm(shape.extents)) + 1e-3
    origins = np.broadcast_to(origin, rays.shape)
    closest = np.einsum("ij,ij->i", centre - origins, rays)
    off = np.linalg.norm(origins + closest[:, None] * rays - centre, axis=1)
    near = np.flatnonzero((off < radius) & (closest > -radius))
    start = np.maximum(closest[near] - np.sqrt(radius**2 - off[near] ** 2), 0.0)
    along = np.full(len(rays), np.inf)
    going, at = near, start
    for _ in range(STEPS):
        distance = shape.signed_distance(origins[going] + at[:, None] * rays[going])
        arrived = distance < REACHED
        along[going[arrived]] = at[arrived]
        on = ~arrived & (at < closest[going] + radius)
        going, at = going[on], (at + distance)[on]
        if len(going) == 0:
            break
    return along


def _gradient(shape: Solid, points_world: Array) -> Array:
    """Outward normals (N, 3) at points (N, 3) on a shape."""
    step = 5e-5
    slopes = [
        shape.signed_distance(points_world + step * axis) - shape.signed_distance(points_world - step * axis)
        for axis in np.eye(3)
    ]
    return transforms.unit(np.stack(slopes, axis=1))
