"""Compiled choice of one point a voxel; the tests hold a NumPy reference."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.frames import Array

MIX = np.uint64(0x9E3779B97F4A7C15)
"""Odd number near 2⁶⁴ over the golden ratio: multiplied by it, neighbouring cells fall far apart."""


def nearest_to_means(points: Array, voxel: float) -> NDArray[np.bool_]:
    """Which points (N, 3) [m] are nearest of all in their voxel to its mean; the first one, where two are.

    Args:
        points: (N, 3) [m].
        voxel: Edge length of a voxel [m]; the grid starts at the origin.
    """
    points = np.ascontiguousarray(points, dtype=np.float64)
    cells = np.floor(points / voxel).astype(np.int64)
    slots = np.full(1 << max(len(points), 1).bit_length() + 1, -1)
    chosen = np.zeros(len(points), dtype=np.bool_)
    room = np.zeros((len(points), 5))
    _choose(points, cells, slots, np.empty(len(points), dtype=np.intp), room, chosen)
    return chosen


@njit(cache=True, error_model="numpy")
def _choose(points, cells, slots, owner, room, chosen):  # type: ignore[no-untyped-def]
    """Mark the points (N,) chosen.

    `slots` is a hash table of the voxels' first points, which stand for them: in `room` (N, 5) for the sum of
    the voxel's points, how many they are, and the least distance from the mean, and in `owner` (N,) at last
    for the point that has it.
    """
    last = len(slots) - 1
    for i in range(len(points)):
        mixed = np.uint64(0)
        for axis in range(3):
            mixed = (mixed + np.uint64(cells[i, axis])) * MIX
        slot = np.int64(mixed >> np.uint64(32)) & last
        while True:
            k = slots[slot]
            if k < 0:
                slots[slot] = k = i
            if cells[k, 0] == cells[i, 0] and cells[k, 1] == cells[i, 1] and cells[k, 2] == cells[i, 2]:
                break
            slot = (slot + 1) & last
        owner[i] = k
        for axis in range(3):
            room[k, axis] += points[i, axis]
        room[k, 3] += 1.0
    for i in range(len(points)):
        k = owner[i]
        square = 0.0
        for axis in range(3):
            square += (points[i, axis] - room[k, axis] / room[k, 3]) ** 2
        if k == i or square < room[k, 4]:
            room[k, 4] = square
            slots[k] = i
    for i in range(len(points)):
        if owner[i] == i:
            chosen[slots[i]] = True
