"""Compiled costs of explanations: points as one of a shape's surface, and the space inside it.

`objects.description_length` says what they mean.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.geometry import BOX, CYLINDER
from caryatid.geometry.shapes import Primitives, Shape
from caryatid.geometry.signed_distance import gradient, local
from caryatid.geometry.transforms import Array
from caryatid.sensing.voxel_map import FREE, VoxelMap


@njit(cache=True, error_model="numpy")
def point_costs(
    kind: int,
    R: NDArray[np.float64],
    centre: NDArray[np.float64],
    half: NDArray[np.float64],
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    noise: float,
    normal_weight: float,
    outlier: float,
) -> Array:
    """Cost (N,) [nats] of each point as one of a shape's surface.

    Args:
        kind: Code of the shape.
        R: Axes (3, 3), columns = x, y, z of the object.
        centre: (3,) [m].
        half: Half extents (3,) [m] along the axes.
        points: (N, 3) [m].
        normals: Unit normals (N, 3).
        noise: Standard deviation of the points from the surface [m].
        normal_weight: Cost of a normal turned by 90° [nats].
        outlier: Most that a point costs [nats].
    """
    costs = np.empty(len(points))
    hx, hy, hz = half[0], half[1], half[2]
    for i in range(len(points)):
        x, y, z = local(R, centre, points, i)
        d, gx, gy, gz = gradient(kind, x, y, z, hx, hy, hz)
        cosine = 0.0
        for a in range(3):
            cosine += (R[a, 0] * gx + R[a, 1] * gy + R[a, 2] * gz) * normals[i, a]
        costs[i] = min(d * d / (2.0 * noise * noise) + normal_weight * (1.0 - cosine), outlier)
    return costs


def free_inside(shape: Shape, voxels: VoxelMap, inset: float) -> tuple[int, int]:
    """Of the space well inside a shape, how much there is and how much was seen free [voxels].

    Args:
        shape: In the world frame.
        voxels: What has been seen.
        inset: How far inside the surface to begin [m]; a surface voxel may be half free.

    Returns:
        Cubes of a voxel's size in all, none where the shape is too thin, and those in voxels seen free.
    """
    kind, R, centre, half = Primitives.of([shape]).row(0)
    inside, free = count_inside(
        kind, R, centre, half - inset, voxels.states, voxels.origin_world, voxels.config.size, FREE
    )
    return int(inside), int(free)


@njit(cache=True, error_model="numpy")
def count_inside(kind, R, centre, half, states, origin, size, wanted):  # type: ignore[no-untyped-def]
    """How many cubes of a voxel's size lie inside a shape, and how many of them in voxels of one state."""
    inside = matching = 0
    steps = np.empty(3, np.intp)
    for a in range(3):
        if half[a] <= 0.0:
            return 0, 0
        steps[a] = max(int(np.ceil((2.0 * half[a] - size / 2.0) / size)), 1) if half[a] > size / 2.0 else 1
    for i in range(steps[0]):
        x = -half[0] + (i + 0.5) * size if half[0] > size / 2.0 else 0.0
        for j in range(steps[1]):
            y = -half[1] + (j + 0.5) * size if half[1] > size / 2.0 else 0.0
            if kind == CYLINDER and x * x + y * y > half[0] * half[0]:
                continue
            for k in range(steps[2]):
                z = -half[2] + (k + 0.5) * size if half[2] > size / 2.0 else 0.0
                if kind != BOX and kind != CYLINDER and x * x + y * y + z * z > half[0] * half[0]:
                    continue
                inside += 1
                state = 0
                u = int(np.floor((centre[0] + R[0, 0] * x + R[0, 1] * y + R[0, 2] * z - origin[0]) / size))
                v = int(np.floor((centre[1] + R[1, 0] * x + R[1, 1] * y + R[1, 2] * z - origin[1]) / size))
                w = int(np.floor((centre[2] + R[2, 0] * x + R[2, 1] * y + R[2, 2] * z - origin[2]) / size))
                if 0 <= u < states.shape[0] and 0 <= v < states.shape[1] and 0 <= w < states.shape[2]:
                    state = states[u, v, w]
                matching += state == wanted
    return inside, matching
