"""Visibility: what cameras see of points in a scene, and what a view says about a shape it should show."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.geometry import transforms
from caryatid.geometry.rays import Grid, room, traverse
from caryatid.geometry.shapes import Shape
from caryatid.geometry.transforms import Array
from caryatid.runtime.parallel import SHARES, for_each
from caryatid.sensing.views import View


def shown(
    solid: Grid,
    origin: Array,
    size: float,
    points: Array,
    normals: Array,
    before: Array,
    weights: Array,
    eyes: Array,
    axes: Array,
    clearance: float,
    good: float,
    cone: float,
) -> Array:
    """Worth of what each camera shows of each point anew.

    A camera shows a point as well as the cosine of the angle to its normal over `good`, fully beyond that;
    not at all where the point lies outside its image or the line of sight is blocked.

    Args:
        solid: What blocks lines of sight (X, Y, Z), not 0 = solid.
        origin: Corner (3,) [m] of voxel [0, 0, 0].
        size: Edge of a voxel [m].
        points: (P, 3) [m].
        normals: Outward unit normals (P, 3); zero where a point looks the same from all sides.
        before: How well each has been shown (P,), from 0 to 1.
        weights: Worth (P,) of showing each fully.
        eyes: Camera centres (3, C) [m].
        axes: Optical axes (3, C), unit.
        clearance: Length of a line of sight's beginning at the point that does not count [m].
        good: Cosine of the angle to the normal up to which a point is shown fully.
        cone: Least cosine of the angle to the optical axis within the image.

    Returns:
        (P, C): weight · (how well it is shown − how well before), 0 where that is less.
    """
    worth = np.empty((len(points), eyes.shape[1]))
    samples, cameras = (points, normals, before, weights), (eyes, axes, clearance, good, cone)
    for_each(_show, SHARES, (solid, origin, 1.0 / size, *samples, *cameras, worth))
    return worth


@njit(cache=True, error_model="numpy")
def _show(share, data):  # type: ignore[no-untyped-def]
    """Write the worth of a share of the work: each piece is one point and 128 of the cameras."""
    solid, worth = data[0], data[-1]
    found, count = room(solid.shape), worth.shape[1]
    across = (count + 127) // 128
    for piece in range(share, len(worth) * across, SHARES):
        p, first = piece // across, piece % across * 128
        end = min(first + 128, count)
        _face(data, p, first, end)
        _hide(data, found, p, first, end)


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _face(data, p, first, end):  # type: ignore[no-untyped-def]
    """Write what each camera shows of one point anew where nothing is in between."""
    _, _, _, points, normals, befores, weights, eyes, axes, _, good, cone, worths = data
    x, y, z = points[p, 0], points[p, 1], points[p, 2]
    a, b, c = normals[p, 0], normals[p, 1], normals[p, 2]
    before, weight, worth = befores[p], weights[p], worths[p]
    around = a == 0.0 and b == 0.0 and c == 0.0
    for n in range(first, end):
        dx, dy, dz = eyes[0, n] - x, eyes[1, n] - y, eyes[2, n] - z
        distance = max(np.sqrt(dx * dx + dy * dy + dz * dz), 1e-6)
        facing = 1.0 if around else min((a * dx + b * dy + c * dz) / (distance * good), 1.0)
        along = -(axes[0, n] * dx + axes[1, n] * dy + axes[2, n] * dz)
        new = facing - before
        worth[n] = weight * new if new > 0.0 and along >= cone * distance else 0.0


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _hide(data, found, p, first, end):  # type: ignore[no-untyped-def]
    """Set to nought what cameras would show of one point but for what is in between."""
    solid, origin, per_metre, points, _, _, _, eyes, _, clearance, _, _, worths = data
    shape, flat, worth = solid.shape, solid.reshape(-1), worths[p]
    x, y, z = points[p, 0], points[p, 1], points[p, 2]
    start = ((x - origin[0]) * per_metre, (y - origin[1]) * per_metre, (z - origin[2]) * per_metre)
    for n in range(first, end):
        if worth[n] == 0.0:
            continue
        dx, dy, dz = eyes[0, n] - x, eyes[1, n] - y, eyes[2, n] - z
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        if length <= clearance:
            continue
        ray = (dx * per_metre, dy * per_metre, dz * per_metre)
        slabs = traverse(found, shape, start, ray, clearance / length, 1.0)
        blocked = np.uint8(0)
        for m in range(slabs):
            blocked |= flat[np.uint32(found[0, m])]
            blocked |= flat[np.uint32(found[1, m])]
            blocked |= flat[np.uint32(found[2, m])]
        if blocked:
            worth[n] = 0.0


def seen_through(shape: Shape, view: View) -> bool:
    """Whether a view with a pose looks through most of where a shape in the world frame should be."""
    behind = depth_behind(shape.moved(transforms.invert(view.pose)), view.depth, view.K)
    read = np.isfinite(behind)
    # A reading 2 cm behind a point contradicts it: 2σ of registration and depth together.
    return bool(read.any()) and bool((behind[read] > 0.02).mean() > 0.5)


def depth_behind(shape: Shape, depth: NDArray[np.float32], K: Array) -> Array:
    """How far readings lie behind the surface of a shape where it faces the camera.

    Args:
        shape: In the camera frame.
        depth: Readings (H, W) [m], 0 = none.
        K: Pinhole matrix (3, 3) [px].

    Returns:
        Of points about 1 cm apart that are in the image (N,) [m]; −inf where there is no reading.
    """
    points, outward = shape.surface(0.01)
    facing = np.einsum("ij,ij->i", points, outward) < 0.0
    points = points[facing & (points[:, 2] > 1e-3)]
    u, v = np.rint((points @ K.T)[:, :2] / points[:, 2:]).astype(np.intp).T
    height, width = depth.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    reading = depth[v[inside], u[inside]]
    return np.where(reading > 0.0, reading - points[inside, 2], -np.inf)
