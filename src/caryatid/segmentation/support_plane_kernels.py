"""Compiled loops of the search for the support surface, each beside the plain reference it is held to."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.geometry.transforms import Array
from caryatid.runtime.parallel import for_each

Mask = NDArray[np.bool_]

BLOCK = 32
"""Hypotheses that one thread scores at a time [1]; changes no result."""


def plane_gains(
    points: Array,
    normals: Array,
    directions: Array,
    offsets: Array,
    tolerance: float,
    least_cosine: float,
    penalty: float,
) -> Array:
    """Score (B,) planes n·p = offset by points: 1 − (distance/tolerance)² each where their normals agree.

    Args:
        points: (N, 3) [m].
        normals: Unit normals (N, 3).
        directions: Unit normals (B, 3) of the planes.
        offsets: (B,) [m].
        tolerance: Distance within which a point counts [m].
        least_cosine: Of the angle between a point's normal and the plane's.
        penalty: What a point further than three tolerances behind a plane costs it.
    """
    planes = np.concatenate([directions, offsets[:, None]], axis=1).T.copy()
    points, normals = np.ascontiguousarray(points), np.ascontiguousarray(normals)
    gains = np.zeros(len(offsets))
    blocks = (len(offsets) + BLOCK - 1) // BLOCK
    for_each(
        _add_gains,
        blocks,
        _Hypotheses(points, normals, planes, float(tolerance), float(least_cosine), float(penalty), gains),
    )
    return gains


def plane_gains_reference(
    points: Array,
    normals: Array,
    directions: Array,
    offsets: Array,
    tolerance: float,
    least_cosine: float,
    penalty: float,
) -> Array:
    """Do as `plane_gains` does."""
    signed = points @ directions.T - offsets
    agree = normals @ directions.T > least_cosine
    gain = np.where(agree, np.maximum(1.0 - (signed / tolerance) ** 2, 0.0), 0.0).sum(axis=0)
    return np.asarray(gain - penalty * (signed < -3.0 * tolerance).sum(axis=0))


def plane_inliers(
    points: Array,
    normals: Array,
    among: Mask,
    plane: tuple[Array, float],
    tolerance: float,
    least_cosine: float,
) -> tuple[Mask, int, Array, Array]:
    """Points on a plane n·p = offset whose normals agree with it.

    Args:
        points: (N, 3) [m].
        normals: Unit normals (N, 3).
        among: Which points (N,) may be inliers.
        plane: Its unit normal (3,) and its offset [m].
        tolerance: Distance within which a point is on the plane [m].
        least_cosine: Of the angle between a point's normal and the plane's.

    Returns:
        The inliers (N,), how many they are, their mean (3,) [m] and their scatter about it (3, 3) [m²].
    """
    points, normals = np.ascontiguousarray(points), np.ascontiguousarray(normals)
    normal, offset = np.ascontiguousarray(plane[0]), plane[1]
    inliers, mean, scatter = np.zeros(len(points), dtype=np.bool_), np.zeros(3), np.zeros((3, 3))
    count = _inliers(points, normals, among, normal, offset, tolerance, least_cosine, inliers, mean, scatter)
    return inliers, count, mean, scatter


def plane_inliers_reference(
    points: Array,
    normals: Array,
    among: Mask,
    plane: tuple[Array, float],
    tolerance: float,
    least_cosine: float,
) -> tuple[Mask, int, Array, Array]:
    """Do as `plane_inliers` does."""
    normal, offset = plane
    inliers = among & (np.abs(points @ normal - offset) <= tolerance) & (normals @ normal > least_cosine)
    if not inliers.any():
        return inliers, 0, np.zeros(3), np.zeros((3, 3))
    spread = points[inliers] - points[inliers].mean(axis=0)
    return inliers, int(inliers.sum()), points[inliers].mean(axis=0), spread.T @ spread


class _Hypotheses(NamedTuple):
    """What `plane_gains` is given, its planes as directions and offsets (4, B), and the gains (B,)."""

    points: Array
    normals: Array
    planes: Array
    tolerance: float
    least_cosine: float
    penalty: float
    gains: Array


@njit(cache=True, error_model="numpy")
def _add_gains(block, data):  # type: ignore[no-untyped-def]
    """Score one block of planes."""
    here = slice(block * BLOCK, block * BLOCK + BLOCK)
    nx, ny, nz = data.planes[0, here], data.planes[1, here], data.planes[2, here]
    offset, gains, penalty = data.planes[3, here], data.gains[here], data.penalty
    points, normals = data.points, data.normals
    scale, least_cosine, behind = 1.0 / data.tolerance, data.least_cosine, -3.0 * data.tolerance
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        u, v, w = normals[i, 0], normals[i, 1], normals[i, 2]
        for k in range(len(gains)):
            signed = nx[k] * x + ny[k] * y + nz[k] * z - offset[k]
            gain = 1.0 - (signed * scale) ** 2
            agrees = nx[k] * u + ny[k] * v + nz[k] * w > least_cosine and gain > 0.0
            gains[k] += gain if agrees else 0.0
            gains[k] -= penalty if signed < behind else 0.0


@njit(cache=True)
def _inliers(points, normals, among, normal, offset, tolerance, least_cosine, inliers, mean, scatter):  # type: ignore[no-untyped-def]
    count = 0
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        on_plane = abs(x * normal[0] + y * normal[1] + z * normal[2] - offset) <= tolerance
        cosine = normals[i, 0] * normal[0] + normals[i, 1] * normal[1] + normals[i, 2] * normal[2]
        if among[i] and on_plane and cosine > least_cosine:
            inliers[i] = True
            count += 1
            mean[0] += x
            mean[1] += y
            mean[2] += z
    for a in range(3):
        mean[a] /= max(count, 1)
    for i in range(len(points)):
        if inliers[i]:
            for a in range(3):
                for b in range(3):
                    scatter[a, b] += (points[i, a] - mean[a]) * (points[i, b] - mean[b])
    return count
