"""Compiled questions about the shape of patches: which looks inwards, and which two rise over each other.

A patch is an array (N, 6): points [m] and their unit normals. The tests hold NumPy references.
"""

from __future__ import annotations

import math

from numba import njit

from caryatid.geometry.transforms import Array


@njit(cache=True, error_model="numpy")
def hollowness(patch: Array) -> float:
    """How much a patch (N, 6) looks inwards: mean cosine between its normals and the way to its middle.

    0 on a plane, positive on the inside of a bowl, negative on the outside.
    """
    count = len(patch)
    x = y = z = total = 0.0
    for i in range(count):
        x += patch[i, 0]
        y += patch[i, 1]
        z += patch[i, 2]
    for i in range(count):
        u, v, w = x / count - patch[i, 0], y / count - patch[i, 1], z / count - patch[i, 2]
        length = math.sqrt(u * u + v * v + w * w)
        if length > 1e-9:
            total += (patch[i, 3] * u + patch[i, 4] * v + patch[i, 5] * w) / length
    return total / count


@njit(cache=True, error_model="numpy")
def convex(first: Array, second: Array, rise: float, bend: float, share: float) -> bool:
    """Whether of the pairs of points of two patches hardly any rises above the other's tangent plane.

    Args:
        first: One patch (N, 6).
        second: The other (M, 6).
        rise: Height that counts [m].
        bend: Added to it a metre between the two points, as normals err [1].
        share: Greatest share of pairs that may rise [1].
    """
    allowed = share * (len(first) * len(second))
    rising = 0
    for i in range(len(first)):
        for j in range(len(second)):
            u, v, w = second[j, 0] - first[i, 0], second[j, 1] - first[i, 1], second[j, 2] - first[i, 2]
            over = first[i, 3] * u + first[i, 4] * v + first[i, 5] * w
            under = -(second[j, 3] * u + second[j, 4] * v + second[j, 5] * w)
            most = over if over > under else under
            if most > rise and most > rise + bend * math.sqrt(u * u + v * v + w * w):
                rising += 1
        if rising > allowed:
            return False
    return True
