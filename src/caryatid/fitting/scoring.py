"""Compiled judgement of a fitted shape: which sides points bear out, and what it costs to believe in it."""

from __future__ import annotations

import numpy as np
from numba import njit

from caryatid.fitting.search import TRIM
from caryatid.geometry import BOX, CYLINDER, SPHERE
from caryatid.geometry.points import quantile
from caryatid.geometry.signed_distance import gradient, in_frame

BARE_SPACING = 0.008
"""Spacing of the samples that look for points near a side [m]; a point within twice that is near one."""


@njit(cache=True, error_model="numpy", inline="always")
def judge(kind, shape, points, normals, threshold, least, min_extent, seen):  # type: ignore[no-untyped-def]
    """Find the sides that points bear out, draw the others in to where the points end, and score the shape.

    Points and unit normals are (N, 3); those nearer than the threshold [m] are the shape's, and a side needs
    at least `least` of them. The shape (5, 3) changes, down to a least extent [m]; `seen` (6,) is written to:
    whether the sides -x, +x, -y, +y, -z, +z are.

    Returns:
        Mean distance, truncated at the threshold [m]; mean of 1 − the cosine between normals, 1 at the most;
        share of the points within the threshold.
    """
    own, facing = in_frame(shape[:3], shape[3], points), in_frame(shape[:3], np.zeros(3), normals)
    counts, near, count = np.zeros(6), np.empty((len(points), 3)), 0
    hx, hy, hz = shape[4]
    for i in range(len(points)):
        d, gx, gy, gz = gradient(kind, own[i, 0], own[i, 1], own[i, 2], hx, hy, hz)
        if not abs(d) < threshold:
            continue
        near[count, 0], near[count, 1], near[count, 2] = own[i, 0], own[i, 1], own[i, 2]
        count += 1
        if gx * facing[i, 0] + gy * facing[i, 1] + gz * facing[i, 2] > 0.5:
            for axis, g in enumerate((gx, gy, gz)):
                # A point bears out the side that its own gradient follows within 45°.
                counts[2 * axis + (g > 0.0)] += abs(g) > 0.7
    for side in range(6):
        seen[side] = counts[side] >= least
    if kind != SPHERE:
        _draw_in(kind, shape, own, near[:count] if count > 0 else own, min_extent, seen)
    away = turned = 0.0
    inliers = 0
    count = len(points)
    hx, hy, hz = shape[4]
    for i in range(count):
        d, gx, gy, gz = gradient(kind, own[i, 0], own[i, 1], own[i, 2], hx, hy, hz)
        away += min(abs(d), threshold)
        cosine = gx * facing[i, 0] + gy * facing[i, 1] + gz * facing[i, 2]
        turned += min(max(1.0 - cosine, 0.0), 1.0)
        inliers += abs(d) < threshold
    return away / count, turned / count, inliers / count


@njit(cache=True, error_model="numpy", no_cpython_wrapper=True)
def _draw_in(kind, shape, own, near, min_extent, seen):  # type: ignore[no-untyped-def]
    """Move sides that are not seen inwards to where the near points end; all points move with the centre."""
    R, centre, half = shape[:3], shape[3], shape[4]
    shift, reach = np.zeros(3), np.empty(len(near))
    for axis in range(2 if kind == CYLINDER else 0, 3):
        low, high = -half[axis], half[axis]
        for i in range(len(near)):
            reach[i] = near[i, axis]
        if not seen[2 * axis]:
            low = min(max(low, quantile(reach, TRIM)), high - min_extent)
        if not seen[2 * axis + 1]:
            high = max(min(high, quantile(reach, 1.0 - TRIM)), low + min_extent)
        half[axis], shift[axis] = (high - low) / 2.0, (high + low) / 2.0
    for a in range(3):
        centre[a] += R[a, 0] * shift[0] + R[a, 1] * shift[1] + R[a, 2] * shift[2]
        for i in range(len(own)):
            own[i, a] -= shift[a]


@njit(cache=True, error_model="numpy", nogil=True)
def bare_share(kind, R, centre, half, seen, points):  # type: ignore[no-untyped-def]
    """Share of the seen sides' area that has no point near it: a side that was seen should be seen whole.

    The shape has axes R (3, 3), a centre (3,) and half extents (3,) [m]; points are (N, 3).
    """
    own = in_frame(R, centre, points)
    samples = bare = last = 0
    for side in range(6):
        if not seen[side]:
            continue
        places = _samples(kind, half, side // 2, 2 * (side % 2) - 1)
        samples += len(places)
        for k in range(len(places)):
            u, v, w = places[k, 0], places[k, 1], places[k, 2]
            found = False
            for n in range(-1, len(own)):
                i = last if n < 0 else n
                x, y, z = own[i, 0] - u, own[i, 1] - v, own[i, 2] - w
                if x * x + y * y + z * z <= 4.0 * BARE_SPACING * BARE_SPACING:
                    found, last = True, i
                    break
            bare += not found
    return bare / samples if samples > 0 else 1.0


@njit(cache=True, error_model="numpy", no_cpython_wrapper=True)
def _samples(kind, half, axis, sign):  # type: ignore[no-untyped-def]
    """Points (M, 3) [m] about `BARE_SPACING` apart on one side, in the object's frame.

    A round side is the part of the surface whose outward normal is nearest to the side's direction.
    """
    u, v = (axis + 1) % 3, (axis + 2) % 3
    flat = kind == BOX or (kind == CYLINDER and axis == 2)
    if kind == CYLINDER and not flat:
        u, v = 1 - axis, 2
    quarter = half[0] * np.pi / 4.0
    rows = max(2, int(np.ceil(2.0 * (half[u] if flat else quarter) / BARE_SPACING)))
    columns = max(2, int(np.ceil(2.0 * (quarter if kind == SPHERE else half[v]) / BARE_SPACING)))
    found = np.empty((rows * columns, 3))
    count = 0
    for i in range(rows):
        for j in range(columns):
            a, b = 2.0 * (i + 0.5) / rows - 1.0, 2.0 * (j + 0.5) / columns - 1.0
            if flat:
                x, y, z = half[axis], half[u] * a, half[v] * b
                if kind == CYLINDER and y * y + z * z > half[0] * half[0]:
                    continue
            elif kind == CYLINDER:
                angle = np.pi / 4.0 * a
                x, y, z = half[0] * np.cos(angle), half[0] * np.sin(angle), half[2] * b
            else:
                # Equal angles both ways: the cube's side blown up to the sphere.
                a, b = np.tan(np.pi / 4.0 * a), np.tan(np.pi / 4.0 * b)
                x = half[0] / np.sqrt(1.0 + a * a + b * b)
                y, z = a * x, b * x
            found[count, axis], found[count, u], found[count, v] = sign * x, y, z
            count += 1
    return found[:count]
