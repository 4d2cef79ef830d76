"""Compiled model search: shapes through two oriented points, the best of many by MSAC.

The tests hold a NumPy reference.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.geometry import BOX, CYLINDER
from caryatid.geometry.signed_distance import local, signed_distance
from caryatid.geometry.transforms import Array

BATCH = 25
"""Hypotheses drawn between two looks at the stopping rule."""
LEAST_EXTENT = 1e-4
"""Extents of hypotheses are no shorter [m]; points on one plane have none across it."""
LEAST_RADIUS = 1e-3
"""Smaller round hypotheses are none [m]."""
LEAST_SINE = (0.1, 0.3, 0.5)
"""Least sine of the angle between two normals that determine a sphere, a cylinder and a box [1]."""

Settings = tuple[float, float, float, float, float]
"""Truncation of distances [m], trimmed share at each end, greatest radius [m] and extent [m], confidence."""


@njit(cache=True, error_model="numpy")
def search(
    kind: int,
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    samples: NDArray[np.intp],
    settings: Settings,
    R: NDArray[np.float64],
    centre: NDArray[np.float64],
    half: NDArray[np.float64],
    cost: NDArray[np.float64],
) -> int:
    """Score hypotheses until a better one has become unlikely; keep the best, the best first (MSAC).

    Args:
        kind: Code of the shape.
        points: (N, 3) [m].
        normals: Unit normals (N, 3).
        samples: Indices (B, 2) of the two points each hypothesis is made from, in the order they are tried.
        settings: See `Settings`.
        R: Axes (K + 1, 3, 3) of the K best, columns = x, y, z; written to, the last one is for trials.
        centre: (K + 1, 3) [m]; written to.
        half: Half extents (K + 1, 3) [m]; written to.
        cost: Mean truncated squared distances (K + 1,) in units of the threshold; written to.

    Returns:
        How many there are, at most K.
    """
    threshold, trim, max_radius, max_extent, confidence = settings
    count, keep = len(points), len(R) - 1
    for k in range(keep + 1):
        cost[k] = np.inf
    most_inliers = found = 0
    for b in range(len(samples)):
        valid = hypothesis(
            kind, points, normals, samples[b], trim, max_radius, max_extent, R[keep], centre[keep], half[keep]
        )
        if valid:
            limit = cost[keep - 1] * count
            total, inliers = msac(kind, R[keep], centre[keep], half[keep], points, threshold, limit)
            if inliers > 0 and total < limit:
                place = keep
                cost[keep] = total / count
                while place > 0 and cost[place] < cost[place - 1]:
                    _swap(place, R, centre, half, cost)
                    place -= 1
                found = min(found + 1, keep)
                if place == 0:
                    most_inliers = inliers
        if (b + 1) % BATCH == 0 and found > 0:
            hit = min(max((most_inliers / count) ** 2, 1e-9), 1.0 - 1e-9)
            if b + 1 >= keep * np.log(1.0 - confidence) / np.log(1.0 - hit):
                break
    return found


@njit(cache=True, error_model="numpy", no_cpython_wrapper=True)
def _swap(k: int, R: Array, centre: Array, half: Array, cost: Array) -> None:
    """Exchange a hypothesis and the one before it."""
    cost[k], cost[k - 1] = cost[k - 1], cost[k]
    for a in range(3):
        centre[k, a], centre[k - 1, a] = centre[k - 1, a], centre[k, a]
        half[k, a], half[k - 1, a] = half[k - 1, a], half[k, a]
        for b in range(3):
            R[k, a, b], R[k - 1, a, b] = R[k - 1, a, b], R[k, a, b]


@njit(cache=True, error_model="numpy")
def msac(
    kind: int,
    R: NDArray[np.float64],
    centre: NDArray[np.float64],
    half: NDArray[np.float64],
    points: NDArray[np.float64],
    threshold: float,
    limit: float,
) -> tuple[float, int]:
    """Sum of truncated squared distances in units of the threshold, and how many points lie within it.

    Ends early, with what it has, once the sum exceeds the limit.

    Args:
        kind: Code of the shape.
        R: Its axes (3, 3).
        centre: Its centre (3,) [m].
        half: Its half extents (3,) [m].
        points: (N, 3) [m].
        threshold: Where distances are truncated [m].
        limit: A sum that is of no use any more.
    """
    total = 0.0
    inliers = 0
    hx, hy, hz = half[0], half[1], half[2]
    for i in range(len(points)):
        x, y, z = local(R, centre, points, i)
        off = signed_distance(kind, x, y, z, hx, hy, hz) / threshold
        if abs(off) < 1.0:
            total += off * off
            inliers += 1
        else:
            total += 1.0
            if total > limit:
                break
    return total, inliers


@njit(cache=True, error_model="numpy")
def hypothesis(
    kind: int,
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    sample: NDArray[np.intp],
    trim: float,
    max_radius: float,
    max_extent: float,
    R: NDArray[np.float64],
    centre: NDArray[np.float64],
    half: NDArray[np.float64],
) -> bool:
    """Make a shape of two oriented points; what they leave open is as long as all points reach.

    A box has adjacent faces through them; a cylinder has them on its mantle, its axis where the lines along
    their normals come closest; so does the centre of a sphere.

    Args:
        kind: Code of the shape.
        points: (N, 3) [m].
        normals: Unit normals (N, 3).
        sample: Indices (2,) of the two points.
        trim: Share of the points beyond each end that count as noise.
        max_radius: [m].
        max_extent: [m].
        R: Axes (3, 3), columns = x, y, z; written to.
        centre: (3,) [m]; written to.
        half: Half extents (3,) [m]; written to.

    Returns:
        Whether there is such a shape within the limits.
    """
    i, j = sample[0], sample[1]
    ax, ay, az = normals[i, 0], normals[i, 1], normals[i, 2]
    bx, by, bz = normals[j, 0], normals[j, 1], normals[j, 2]
    if kind == BOX:
        along = ax * bx + ay * by + az * bz
        ux, uy, uz = bx - along * ax, by - along * ay, bz - along * az
        sine = np.sqrt(ux * ux + uy * uy + uz * uz)
        if sine <= LEAST_SINE[kind]:
            return False
        set_axes(R, ux / sine, uy / sine, uz / sine, ax, ay, az, 1)
        for a in range(3):
            centre[a] = 0.0
        for a in range(3):
            low, high = trimmed_range(points, R[0, a], R[1, a], R[2, a], trim)
            half[a] = max(high - low, LEAST_EXTENT) / 2.0
            for b in range(3):
                centre[b] += R[b, a] * (low + high) / 2.0
        return 2.0 * max(half[0], half[1], half[2]) <= max_extent
    x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    sine = np.sqrt(x * x + y * y + z * z)
    if sine <= LEAST_SINE[kind]:
        return False
    x, y, z = x / sine, y / sine, z / sine
    gx, gy, gz = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
    tx, ty, tz = bx - ax, by - ay, bz - az
    # The turn of the normals is across the axis, so the gap along it adds nothing.
    radius = (gx * tx + gy * ty + gz * tz) / max(tx * tx + ty * ty + tz * tz, 1e-12)
    if not LEAST_RADIUS < radius <= max_radius:
        return False
    set_axes(R, ax, ay, az, x, y, z, 0)
    cx = (points[i, 0] + points[j, 0] - radius * (ax + bx)) / 2.0
    cy = (points[i, 1] + points[j, 1] - radius * (ay + by)) / 2.0
    cz = (points[i, 2] + points[j, 2] - radius * (az + bz)) / 2.0
    half[0] = half[1] = half[2] = radius
    level = 0.0
    if kind == CYLINDER:
        low, high = trimmed_range(points, x, y, z, trim)
        half[2] = max(high - low, LEAST_EXTENT) / 2.0
        level = (low + high) / 2.0 - (cx * x + cy * y + cz * z)
    centre[0], centre[1], centre[2] = cx + level * x, cy + level * y, cz + level * z
    return kind != CYLINDER or 2.0 * half[2] <= max_extent


@njit(cache=True, error_model="numpy", no_cpython_wrapper=True)
def set_axes(
    R: NDArray[np.float64], ux: float, uy: float, uz: float, x: float, y: float, z: float, column: int
) -> None:
    """Set right-handed axes (3, 3): z, a unit vector across it as x or y (column 0 or 1), and the third.

    Args:
        R: Written to (3, 3).
        ux: x of the vector across.
        uy: Its y.
        uz: Its z.
        x: x of the unit vector that becomes the third axis.
        y: Its y.
        z: Its z.
        column: 0 or 1: which axis the one across becomes.
    """
    R[0, column], R[1, column], R[2, column] = ux, uy, uz
    R[0, 2], R[1, 2], R[2, 2] = x, y, z
    sign = 1.0 - 2.0 * column
    R[0, 1 - column] = sign * (y * uz - z * uy)
    R[1, 1 - column] = sign * (z * ux - x * uz)
    R[2, 1 - column] = sign * (x * uy - y * ux)


@njit(cache=True, error_model="numpy")
def trimmed_range(
    points: NDArray[np.float64], dx: float, dy: float, dz: float, trim: float
) -> tuple[float, float]:
    """Least and greatest coordinate [m] of points (N, 3) along a direction, a share at each end left out.

    Args:
        points: (N, 3) [m].
        dx: x of the direction, a unit vector.
        dy: Its y.
        dz: Its z.
        trim: The share left out at each end.
    """
    beyond = min(int(trim * len(points)), (len(points) - 1) // 2)
    least, greatest = np.empty(beyond + 1), np.empty(beyond + 1)
    for k in range(beyond + 1):
        least[k], greatest[k] = np.inf, -np.inf
    for i in range(len(points)):
        c = points[i, 0] * dx + points[i, 1] * dy + points[i, 2] * dz
        if c < least[beyond]:
            k = beyond
            while k > 0 and least[k - 1] > c:
                least[k] = least[k - 1]
                k -= 1
            least[k] = c
        if c > greatest[beyond]:
            k = beyond
            while k > 0 and greatest[k - 1] < c:
                greatest[k] = greatest[k - 1]
                k -= 1
            greatest[k] = c
    return least[beyond], greatest[beyond]
