"""Compiled model search: shapes through two oriented points, the best of many by MSAC; and of one face."""

from __future__ import annotations

import numpy as np

from caryatid.geometry import BOX, CYLINDER, SPHERE
from caryatid.geometry.points import quantile, select
from caryatid.geometry.signed_distance import gradient, local
from caryatid.runtime.parallel import inner

TRIM = 0.005
"""Share of the points beyond each end of an extent that counts as noise [1]."""
LEAST_EXTENT, LEAST_RADIUS = 1e-4, 1e-3
"""Minimum extent and radius of hypotheses [m]; points on one plane have none across it."""


@inner
def search(  # type: ignore[no-untyped-def]
    kind, points, normals, samples, keep, threshold, max_radius, max_extent, min_extent, shapes
):
    """Score hypotheses until a better one has become unlikely, and keep the best (MSAC).

    Each is made from a pair of oriented points (N, 3), in the order of the samples (B, 2), and is to keep
    within the limits [m]. Shapes (K, 5, 3) are written to: the best `keep` hypotheses, the best first, and a
    shape for points of one face behind them.

    Returns:
        Number of hypotheses; 0 if none is within the limits.
    """
    count, cost = len(points), np.full(keep + 1, np.inf)
    most_inliers = found = 0
    for b in range(len(samples)):
        i, j = samples[b, 0], samples[b, 1]
        if _hypothesis(kind, points, normals, i, j, max_radius, max_extent, shapes[keep]):
            limit = cost[keep - 1] * count
            total, inliers = _msac(kind, shapes[keep], points, threshold, limit)
            if inliers > 0 and total < limit:
                place = keep
                cost[keep] = total / count
                while place > 0 and cost[place] < cost[place - 1]:
                    place -= 1
                    cost[place], cost[place + 1] = cost[place + 1], cost[place]
                    for i in range(5):
                        for j in range(3):
                            better = shapes[place + 1, i, j]
                            shapes[place + 1, i, j], shapes[place, i, j] = shapes[place, i, j], better
                found = min(found + 1, keep)
                if place == 0:
                    most_inliers = inliers
        # Every 25 hypotheses: stop when a better one is less likely than a hundredth.
        if b % 25 == 24 and found > 0:
            hit = min(max((most_inliers / count) ** 2, 1e-9), 1.0 - 1e-9)
            if b + 1 >= keep * np.log(0.01) / np.log(1.0 - hit):
                break
    if kind == SPHERE:
        return found
    return found + _of_one_face(kind, points, normals, min_extent, max_radius, max_extent, shapes[found])


@inner
def _of_one_face(kind, points, normals, min_extent, max_radius, max_extent, shape):  # type: ignore[no-untyped-def]
    """Make a box or a cylinder for points of one face, along their main normal.

    A box has the smallest rectangle around them, a cylinder the circle that reaches as far. Returns whether
    it is within the limits.
    """
    R, centre, half = shape[:3], shape[3], shape[4]
    (x, y, z), on_face = _main_normal(normals)
    if not x * x + y * y + z * z > 0.0:
        return False
    ux, uy, uz = _across(points, x, y, z)
    _set_axes(R, ux, uy, uz, x, y, z, 0)
    if kind == BOX:
        best, least = 0.0, np.inf
        for step in range(30):
            angle = np.radians(3.0 * step)  # Least squares do the rest.
            area = 1.0
            for quarter in range(2):
                c, s = np.cos(angle + quarter * np.pi / 2.0), np.sin(angle + quarter * np.pi / 2.0)
                low, high = _range(points, *_turned(R, c, s))
                area *= high - low
            if area < least:
                best, least = angle, area
        ux, uy, uz = _turned(R, np.cos(best), np.sin(best))
        _set_axes(R, ux, uy, uz, x, y, z, 0)
    low, high = np.empty(3), np.empty(3)
    for a in range(3):
        low[a], high[a] = _range(points, R[0, a], R[1, a], R[2, a])
    heights = np.empty(len(points))
    count = 0
    for i in range(len(points)):
        if on_face[i]:
            heights[count] = points[i, 0] * x + points[i, 1] * y + points[i, 2] * z
            count += 1
    high[2] = quantile(heights[:count], 0.5)
    low[2] = min(low[2], high[2] - min_extent)
    centre[0] = centre[1] = centre[2] = 0.0
    for a in range(3):
        half[a] = (high[a] - low[a]) / 2.0
        for b in range(3):
            centre[a] += R[a, b] * (low[b] + high[b]) / 2.0
    if kind == BOX:
        return 2.0 * max(half[0], half[1], half[2]) <= max_extent
    half[0] = half[1] = (half[0] + half[1]) / 2.0
    return LEAST_RADIUS < half[0] <= max_radius and 2.0 * half[2] <= max_extent


@inner
def _msac(kind, shape, points, threshold, limit):  # type: ignore[no-untyped-def]
    """Sum of truncated squared distances in units of the threshold, and how many points lie within it.

    Ends early, with what it has, once the sum exceeds the limit.
    """
    R, centre, half = shape[:3], shape[3], shape[4]
    total, inliers = 0.0, 0
    for i in range(len(points)):
        x, y, z = local(R, centre, points, i)
        off = gradient(kind, x, y, z, half[0], half[1], half[2])[0] / threshold
        if abs(off) < 1.0:
            total += off * off
            inliers += 1
        else:
            total += 1.0
            if total > limit:
                break
    return total, inliers


@inner
def _hypothesis(kind, points, normals, i, j, max_radius, max_extent, shape):  # type: ignore[no-untyped-def]
    """Make a shape from two oriented points; extents they leave open are as long as all points reach.

    A box has adjacent faces through them; a cylinder has them on its mantle, its axis where the lines along
    their normals come closest; so does the centre of a sphere. Returns whether it is within the limits.
    """
    R, centre, half = shape[:3], shape[3], shape[4]
    ax, ay, az = normals[i, 0], normals[i, 1], normals[i, 2]
    bx, by, bz = normals[j, 0], normals[j, 1], normals[j, 2]
    if kind == BOX:
        along = ax * bx + ay * by + az * bz
        ux, uy, uz = bx - along * ax, by - along * ay, bz - along * az
        sine = np.sqrt(ux * ux + uy * uy + uz * uz)
        if sine <= 0.5:
            return False
        _set_axes(R, ux / sine, uy / sine, uz / sine, ax, ay, az, 1)
        centre[0] = centre[1] = centre[2] = 0.0
        for a in range(3):
            low, high = _range(points, R[0, a], R[1, a], R[2, a])
            half[a] = max(high - low, LEAST_EXTENT) / 2.0
            for b in range(3):
                centre[b] += R[b, a] * (low + high) / 2.0
        return 2.0 * max(half[0], half[1], half[2]) <= max_extent
    x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    sine = np.sqrt(x * x + y * y + z * z)
    if sine <= (0.3 if kind == CYLINDER else 0.1):
        return False
    x, y, z = x / sine, y / sine, z / sine
    gx, gy, gz = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
    tx, ty, tz = bx - ax, by - ay, bz - az
    # Normals turn across the axis, so the gap along it adds nothing.
    radius = (gx * tx + gy * ty + gz * tz) / max(tx * tx + ty * ty + tz * tz, 1e-12)
    if not LEAST_RADIUS < radius <= max_radius:
        return False
    _set_axes(R, ax, ay, az, x, y, z, 0)
    cx = (points[i, 0] + points[j, 0] - radius * (ax + bx)) / 2.0
    cy = (points[i, 1] + points[j, 1] - radius * (ay + by)) / 2.0
    cz = (points[i, 2] + points[j, 2] - radius * (az + bz)) / 2.0
    half[0] = half[1] = half[2] = radius
    level = 0.0
    if kind == CYLINDER:
        low, high = _range(points, x, y, z)
        half[2] = max(high - low, LEAST_EXTENT) / 2.0
        level = (low + high) / 2.0 - (cx * x + cy * y + cz * z)
    centre[0], centre[1], centre[2] = cx + level * x, cy + level * y, cz + level * z
    return kind != CYLINDER or 2.0 * half[2] <= max_extent


@inner
def _set_axes(R, ux, uy, uz, x, y, z, column):  # type: ignore[no-untyped-def]
    """Set right-handed axes (3, 3): z, a unit vector across it as x or y (column 0 or 1), and the third."""
    R[0, column], R[1, column], R[2, column] = ux, uy, uz
    R[0, 2], R[1, 2], R[2, 2] = x, y, z
    sign = 1.0 - 2.0 * column
    R[0, 1 - column] = sign * (y * uz - z * uy)
    R[1, 1 - column] = sign * (z * ux - x * uz)
    R[2, 1 - column] = sign * (x * uy - y * ux)


@inner
def _turned(R, c, s):  # type: ignore[no-untyped-def]
    """The direction between the first two axes by cosine and sine."""
    return c * R[0, 0] + s * R[0, 1], c * R[1, 0] + s * R[1, 1], c * R[2, 0] + s * R[2, 1]


@inner
def _range(points, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Lowest and highest coordinate [m] of points (N, 3) along a direction, without a share at each end."""
    along, low, high = np.empty(len(points)), np.inf, -np.inf
    for i in range(len(points)):
        along[i] = points[i, 0] * dx + points[i, 1] * dy + points[i, 2] * dz
        low, high = min(low, along[i]), max(high, along[i])
    beyond = min(int(TRIM * len(points)), (len(points) - 1) // 2)
    if beyond == 0:
        return low, high
    return select(along, beyond), select(along, len(points) - 1 - beyond)


@inner
def _main_normal(normals):  # type: ignore[no-untyped-def]
    """The direction most normals (N, 3) agree on, their mean, and which do (N,)."""
    count, agreed = len(normals), np.cos(np.radians(25.0))
    best, most = 0, 0
    for i in range(count):
        agreeing = 0
        for j in range(count):
            agreeing += _cosine(normals, i, j) > agreed
        if agreeing > most:
            best, most = i, agreeing
    u = v = w = 0.0
    agree = np.empty(count, np.bool_)
    for j in range(count):
        agree[j] = _cosine(normals, best, j) > agreed
        if agree[j]:
            u, v, w = u + normals[j, 0], v + normals[j, 1], w + normals[j, 2]
    length = np.sqrt(u * u + v * v + w * w)
    return (u / length, v / length, w / length), agree


@inner
def _cosine(normals, i, j):  # type: ignore[no-untyped-def]
    return normals[i, 0] * normals[j, 0] + normals[i, 1] * normals[j, 1] + normals[i, 2] * normals[j, 2]


@inner
def _across(points, x, y, z):  # type: ignore[no-untyped-def]
    """A direction across an axis that turns with the points: to the first one well off their middle."""
    count = len(points)
    mx = my = mz = 0.0
    for i in range(count):
        mx, my, mz = mx + points[i, 0] / count, my + points[i, 1] / count, mz + points[i, 2] / count
    farthest = 0.0
    for turn in range(2):
        for i in range(count):
            u, v, w = points[i, 0] - mx, points[i, 1] - my, points[i, 2] - mz
            along = u * x + v * y + w * z
            u, v, w = u - along * x, v - along * y, w - along * z
            reach = np.sqrt(u * u + v * v + w * w)
            if turn == 0:
                farthest = max(farthest, reach)
            elif reach > 0.5 * farthest:
                return u / reach, v / reach, w / reach
        if farthest < 1e-6:
            break
    # Points on the axis leave it open: then across the world axis least aligned with it.
    u, v, w = 0.0, 0.0, 1.0
    if abs(x) <= abs(y) and abs(x) <= abs(z):
        u, v, w = 1.0, 0.0, 0.0
    elif abs(y) <= abs(z):
        u, v, w = 0.0, 1.0, 0.0
    along = u * x + v * y + w * z
    u, v, w = u - along * x, v - along * y, w - along * z
    length = np.sqrt(u * u + v * v + w * w)
    return u / length, v / length, w / length
