"""Compiled kernels of shapes: signed distances, their gradients, and points spread over surfaces.

A shape is a code, its axes R (3, 3), columns = x, y, z of the object, its centre (3,) and its half
extents (3,) along the axes [m].
"""

from __future__ import annotations

import numpy as np

from caryatid.geometry import CYLINDER, SPHERE
from caryatid.runtime.parallel import inner, kernel

GOLDEN = np.pi * (3.0 - np.sqrt(5.0))
"""Angle by which one point of a ball is turned relative to the last [rad]."""


@inner
def copy(shape, target):  # type: ignore[no-untyped-def]
    """Copy axes, centre and half extents (5, 3); an assignment of slices takes seconds to compile."""
    for i in range(5):
        for j in range(3):
            target[i, j] = shape[i, j]


@inner
def local(R, centre, points, i):  # type: ignore[no-untyped-def]
    """Coordinates in the object's frame of one of the points (N, 3)."""
    u, v, w = points[i, 0] - centre[0], points[i, 1] - centre[1], points[i, 2] - centre[2]
    x = R[0, 0] * u + R[1, 0] * v + R[2, 0] * w
    y = R[0, 1] * u + R[1, 1] * v + R[2, 1] * w
    z = R[0, 2] * u + R[1, 2] * v + R[2, 2] * w
    return x, y, z


@kernel
def in_frame(R, origin, points):  # type: ignore[no-untyped-def]
    """Coordinates (N, 3) of points (N, 3) in a frame with axes R (3, 3) at an origin (3,)."""
    own = np.empty((len(points), 3))
    for i in range(len(points)):
        own[i, 0], own[i, 1], own[i, 2] = local(R, origin, points, i)
    return own


@kernel
def signed_distances(kind, R, centre, half, points):  # type: ignore[no-untyped-def]
    """Distances (N,) [m] of points (N, 3) to a shape's surface, negative inside."""
    distance = np.empty(len(points))
    hx, hy, hz = half[0], half[1], half[2]
    for i in range(len(points)):
        x, y, z = local(R, centre, points, i)
        distance[i] = gradient(kind, x, y, z, hx, hy, hz)[0]
    return distance


@kernel
def distances_and_gradients(kind, R, centre, half, points):  # type: ignore[no-untyped-def]
    """Signed distances (N,) [m] of points (N, 3), and their gradients (N, 3) in the object's frame."""
    distance = np.empty(len(points))
    gradients = np.empty((len(points), 3))
    hx, hy, hz = half[0], half[1], half[2]
    for i in range(len(points)):
        x, y, z = local(R, centre, points, i)
        distance[i], gradients[i, 0], gradients[i, 1], gradients[i, 2] = gradient(kind, x, y, z, hx, hy, hz)
    return distance, gradients


@inner
def gradient(kind, x, y, z, hx, hy, hz):  # type: ignore[no-untyped-def]
    """Signed distance [m] of one point in the object's frame, and its gradient (3) there."""
    if kind == SPHERE:
        length = np.sqrt(x * x + y * y + z * z)
        inverse = 1.0 / max(length, 1e-12)
        return length - hx, x * inverse, y * inverse, z * inverse
    if kind == CYLINDER:
        ring = np.sqrt(x * x + y * y)
        inverse = 1.0 / max(ring, 1e-12)
        q0, q2 = ring - hx, abs(z) - hz
        if q0 > 0.0 and q2 > 0.0:
            outside = np.sqrt(q0 * q0 + q2 * q2)
            s0, s2 = q0 / outside, q2 / outside
            return outside, s0 * x * inverse, s0 * y * inverse, s2 * np.sign(z)
        if q0 >= q2:
            return q0, x * inverse, y * inverse, 0.0
        return q2, 0.0, 0.0, np.sign(z)
    qx, qy, qz = abs(x) - hx, abs(y) - hy, abs(z) - hz
    ox, oy, oz = max(qx, 0.0), max(qy, 0.0), max(qz, 0.0)
    outside = np.sqrt(ox * ox + oy * oy + oz * oz)
    if outside > 1e-9:
        inverse = 1.0 / outside
        return outside, ox * inverse * np.sign(x), oy * inverse * np.sign(y), oz * inverse * np.sign(z)
    if qx >= qy and qx >= qz:
        return qx, np.sign(x), 0.0, 0.0
    if qy >= qz:
        return qy, 0.0, np.sign(y), 0.0
    return qz, 0.0, 0.0, np.sign(z)


@inner
def contains(kind, x, y, z, hx, hy, hz):  # type: ignore[no-untyped-def]
    """Whether the shape contains a point in the object's frame."""
    if kind == SPHERE:
        return x * x + y * y + z * z < hx * hx
    if kind == CYLINDER:
        return x * x + y * y < hx * hx and abs(z) < hz
    return abs(x) < hx and abs(y) < hy and abs(z) < hz


@kernel
def sample_surface(kind, R, centre, half, spacing):  # type: ignore[no-untyped-def]
    """Points (N, 3) [m] about `spacing` metres apart all over a surface, and outward normals (N, 3)."""
    # A box has the most points of all shapes with its extents.
    i, j, k = _cells(half[0], spacing), _cells(half[1], spacing), _cells(half[2], spacing)
    most, count = 2 * (i * j + j * k + k * i), np.intp(0)  # `_face` would be compiled for a literal, too.
    points, normals = np.empty((most, 3)), np.empty((most, 3))
    if kind == SPHERE:
        count = _ball(points, normals, half[0], spacing)
    elif kind == CYLINDER:
        count = _mantle(points, normals, half[0], half[2], spacing)
        for face in range(5, 3, -1):
            count = _face(kind, points, normals, count, half, face, spacing)
    else:
        for face in range(6):
            count = _face(kind, points, normals, count, half, face, spacing)
    for n in range(count):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        u, v, w = normals[n, 0], normals[n, 1], normals[n, 2]
        for axis in range(3):
            a, b, c = R[axis, 0], R[axis, 1], R[axis, 2]
            points[n, axis] = a * x + b * y + c * z + centre[axis]
            normals[n, axis] = a * u + b * v + c * w
    return points[:count], normals[:count]


@inner
def _cells(half, spacing):  # type: ignore[no-untyped-def]
    """Number of equal cells that cover [−half, half]."""
    return max(2, int(np.ceil(2.0 * half / spacing)))


@inner
def _face(kind, points, normals, start, half, face, spacing):  # type: ignore[no-untyped-def]
    """Write the points of face −x, +x, −y, …, of a cylinder a disc, and return the row after the last."""
    axis, sign = face // 2, 2.0 * (face % 2) - 1.0
    n, u, v = start, (axis + 1) % 3, (axis + 2) % 3
    along_u, along_v = _cells(half[u], spacing), _cells(half[v], spacing)
    for i in range(along_u):
        x = half[u] * (2.0 * (i + 0.5) / along_u - 1.0)
        for j in range(along_v):
            y = half[v] * (2.0 * (j + 0.5) / along_v - 1.0)
            if kind == CYLINDER and x * x + y * y > half[u] * half[u]:
                continue
            normals[n, axis], normals[n, u], normals[n, v] = sign, 0.0, 0.0
            points[n, axis], points[n, u], points[n, v] = sign * half[axis], x, y
            n += 1
    return n


@inner
def _mantle(points, normals, radius, half_height, spacing):  # type: ignore[no-untyped-def]
    """Write the points of a cylinder's mantle and return how many they are."""
    n, around = 0, max(8, int(np.rint(2.0 * np.pi * radius / spacing)))
    up = _cells(half_height, spacing)
    for k in range(up):
        z = half_height * (2.0 * (k + 0.5) / up - 1.0)
        for i in range(around):
            angle = 2.0 * np.pi * (i + 0.5) / around
            x, y = np.cos(angle), np.sin(angle)
            normals[n, 0], normals[n, 1], normals[n, 2] = x, y, 0.0
            points[n, 0], points[n, 1], points[n, 2] = radius * x, radius * y, z
            n += 1
    return n


@inner
def _ball(points, normals, radius, spacing):  # type: ignore[no-untyped-def]
    """Write the points of a ball and return how many they are."""
    count = max(20, int(np.rint(4.0 * np.pi * (radius / spacing) ** 2)))
    for n in range(count):
        z = 1.0 - (2.0 * n + 1.0) / count
        ring = np.sqrt(1.0 - z * z)
        x, y = ring * np.cos(GOLDEN * n), ring * np.sin(GOLDEN * n)
        normals[n, 0], normals[n, 1], normals[n, 2] = x, y, z
        points[n, 0], points[n, 1], points[n, 2] = radius * x, radius * y, radius * z
    return count
