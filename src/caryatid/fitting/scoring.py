"""Compiled judgement of a fitted shape: which sides points bear out, and what it costs to believe in it."""

from __future__ import annotations

import numpy as np
from numba import njit

from caryatid.fitting.search import TRIM
from caryatid.geometry import BOX, CYLINDER, SPHERE
from caryatid.geometry.points import quantile
from caryatid.geometry.signed_distance import gradient, local

BARE_SPACING = 0.008
"""Spacing of the samples that look for points near a side [m]; a point within twice that is near one."""
FACING = 0.7
"""A point bears out the side whose outward normal its own gradient follows with this cosine [1]; 45°."""
AGREE = 0.5
"""Least cosine between a point's normal and the shape's there [1]."""


@njit(cache=True, error_model="numpy", no_cpython_wrapper=True)
def draw_in(  # type: ignore[no-untyped-def]
    kind, R, centre, half, points, normals, threshold, least, min_extent, seen
):
    """Find the sides that points bear out, and move the others inwards to where the points end.

    Args:
        kind: Code of the shape.
        R: Axes (3, 3).
        centre: (3,) [m]; moved.
        half: Half extents (3,) [m]; shortened.
        points: (N, 3) [m].
        normals: Unit normals (N, 3).
        threshold: Points nearer to the surface are the shape's [m].
        least: Points that bear out a side at the least.
        min_extent: Least extent [m].
        seen: Whether the sides -x, +x, -y, +y, -z, +z are (6,); written to.
    """
    hx, hy, hz = half[0], half[1], half[2]
    counts = np.zeros(6, np.intp)
    near_points = np.empty((3, len(points)))
    near = 0
    for i in range(len(points)):
        x, y, z = local(R, centre, points, i)
        d, gx, gy, gz = gradient(kind, x, y, z, hx, hy, hz)
        if not abs(d) < threshold:
            continue
        near_points[0, near], near_points[1, near], near_points[2, near] = x, y, z
        near += 1
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        wx = R[0, 0] * gx + R[0, 1] * gy + R[0, 2] * gz
        wy = R[1, 0] * gx + R[1, 1] * gy + R[1, 2] * gz
        wz = R[2, 0] * gx + R[2, 1] * gy + R[2, 2] * gz
        if nx * wx + ny * wy + nz * wz > AGREE:
            counts[0] += gx < -FACING
            counts[1] += gx > FACING
            counts[2] += gy < -FACING
            counts[3] += gy > FACING
            counts[4] += gz < -FACING
            counts[5] += gz > FACING
    for side in range(6):
        seen[side] = counts[side] >= least
    if kind == SPHERE:
        return
    if near == 0:
        near = len(points)
        for i in range(near):
            for a in range(3):
                near_points[a, i] = 0.0
                for b in range(3):
                    near_points[a, i] += R[b, a] * (points[i, b] - centre[b])
    shift = np.zeros(3)
    for axis in range(3):
        if (kind == CYLINDER and axis < 2) or (seen[2 * axis] and seen[2 * axis + 1]):
            continue
        reach = near_points[axis, :near]
        low, high = -half[axis], half[axis]
        if not seen[2 * axis]:
            low = min(max(low, quantile(reach, TRIM)), high - min_extent)
        if not seen[2 * axis + 1]:
            high = max(min(high, quantile(reach, 1.0 - TRIM)), low + min_extent)
        half[axis], shift[axis] = (high - low) / 2.0, (high + low) / 2.0
    for a in range(3):
        centre[a] += R[a, 0] * shift[0] + R[a, 1] * shift[1] + R[a, 2] * shift[2]


@njit(cache=True, error_model="numpy", no_cpython_wrapper=True)
def misfit(kind, R, centre, half, points, normals, threshold):  # type: ignore[no-untyped-def]
    """How badly a shape explains oriented points.

    Args:
        kind: Code of the shape.
        R: Its axes (3, 3).
        centre: Its centre (3,) [m].
        half: Its half extents (3,) [m].
        points: (N, 3) [m].
        normals: Unit normals (N, 3).
        threshold: Distance beyond which points are none of its [m].

    Returns:
        Mean distance, truncated at the threshold [m]; mean of 1 − the cosine between normals, 1 at the most;
        share of the points within the threshold.
    """
    hx, hy, hz = half[0], half[1], half[2]
    away = turned = 0.0
    inliers = 0
    for i in range(len(points)):
        x, y, z = local(R, centre, points, i)
        d, gx, gy, gz = gradient(kind, x, y, z, hx, hy, hz)
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        mx = R[0, 0] * nx + R[1, 0] * ny + R[2, 0] * nz
        my = R[0, 1] * nx + R[1, 1] * ny + R[2, 1] * nz
        mz = R[0, 2] * nx + R[1, 2] * ny + R[2, 2] * nz
        away += min(abs(d), threshold)
        turned += min(max(1.0 - (gx * mx + gy * my + gz * mz), 0.0), 1.0)
        inliers += abs(d) < threshold
    count = len(points)
    return away / count, turned / count, inliers / count


@njit(cache=True, error_model="numpy", no_cpython_wrapper=True)
def bare_share(kind, R, centre, half, seen, points):  # type: ignore[no-untyped-def]
    """Share of the seen sides' area that has no point near it: a side that was seen should be seen whole.

    Args:
        kind: Code of the shape.
        R: Axes (3, 3).
        centre: (3,) [m].
        half: Half extents (3,) [m].
        seen: Which sides (6,) are seen.
        points: (N, 3) [m].
    """
    own = np.empty((len(points), 3))
    for i in range(len(points)):
        for a in range(3):
            own[i, a] = 0.0
            for b in range(3):
                own[i, a] += R[b, a] * (points[i, b] - centre[b])
    squared = 4.0 * BARE_SPACING * BARE_SPACING
    samples = bare = last = 0
    for side in range(6):
        if not seen[side]:
            continue
        axis, sign = side // 2, 2 * (side % 2) - 1
        places = _samples(kind, half, axis, sign, BARE_SPACING)
        samples += len(places)
        for k in range(len(places)):
            u, v, w = places[k, 0], places[k, 1], places[k, 2]
            found = False
            for n in range(-1, len(own)):
                i = last if n < 0 else n
                x, y, z = own[i, 0] - u, own[i, 1] - v, own[i, 2] - w
                if x * x + y * y + z * z <= squared:
                    found = True
                    last = i
                    break
            bare += not found
    return bare / samples if samples > 0 else 1.0


@njit(cache=True, error_model="numpy", no_cpython_wrapper=True)
def _samples(kind, half, axis, sign, spacing):  # type: ignore[no-untyped-def]
    """Points (M, 3) [m] about `spacing` apart on one side, in the object's frame.

    A round side is the part of the surface whose outward normal is nearest to the side's direction.
    """
    if kind == BOX or (kind == CYLINDER and axis == 2):
        return _flat_side(kind, half, axis, sign, spacing)
    quarter = half[0] * np.pi / 2.0
    around = max(2, int(np.ceil(quarter / spacing)))
    along = around if kind == SPHERE else max(2, int(np.ceil(2.0 * half[2] / spacing)))
    found = np.empty((around * along, 3))
    u, v = (axis + 1) % 3, (axis + 2) % 3
    if kind == CYLINDER:
        u, v = 1 - axis, 2
    for i in range(around):
        angle = (np.pi / 2.0) * ((i + 0.5) / around - 0.5)
        for j in range(along):
            k = i * along + j
            if kind == CYLINDER:
                found[k, axis] = sign * half[0] * np.cos(angle)
                found[k, u] = half[0] * np.sin(angle)
                found[k, v] = half[2] * (2.0 * (j + 0.5) / along - 1.0)
            else:
                # Equal angles both ways: the cube's side blown up to the sphere.
                b = np.tan((np.pi / 2.0) * ((j + 0.5) / along - 0.5))
                a = np.tan(angle)
                length = half[0] / np.sqrt(1.0 + a * a + b * b)
                found[k, axis], found[k, u], found[k, v] = sign * length, a * length, b * length
    return found


@njit(cache=True, error_model="numpy", no_cpython_wrapper=True)
def _flat_side(kind, half, axis, sign, spacing):  # type: ignore[no-untyped-def]
    u, v = (axis + 1) % 3, (axis + 2) % 3
    columns = max(2, int(np.ceil(2.0 * half[u] / spacing)))
    rows = max(2, int(np.ceil(2.0 * half[v] / spacing)))
    found = np.empty((columns * rows, 3))
    count = 0
    for i in range(columns):
        for j in range(rows):
            a = half[u] * (2.0 * (i + 0.5) / columns - 1.0)
            b = half[v] * (2.0 * (j + 0.5) / rows - 1.0)
            if kind == CYLINDER and a * a + b * b > half[0] * half[0]:
                continue
            found[count, axis], found[count, u], found[count, v] = sign * half[axis], a, b
            count += 1
    return found[:count]
