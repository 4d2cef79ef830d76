"""What a voxel map's update is compared with: a pass that unprojects a depth image and hashes its voxels."""

from __future__ import annotations

import numpy as np
from numba import get_num_threads, njit, prange
from numpy.typing import NDArray

from caryatid.geometry.transforms import Array
from caryatid.sensing.views import View

EMPTY = -1
"""What stands in a free place of a table; no key is negative."""
REACH = 1 << 20
"""Voxels along an axis, the origin in the middle [1]."""
MIXER = np.uint64(0x9E3779B97F4A7C15)
"""Odd, near 2⁶⁴ over the golden ratio: spreads keys over a table."""


def hash_voxels(view: View, size: float) -> NDArray[np.int64]:
    """Keys of the voxels of an edge [m] that hold a view's points, each once, in no order.

    Each thread takes a band of the image; then each takes a share of the hashes, and enters the keys that
    have one of them into an open-addressing table of its own.
    """
    threads = get_num_threads()
    keys, counts = _keys(view.depth, view.K, view.pose, 1.0 / size, threads)
    places = 1 << int(np.ceil(np.log2(max(2 * counts.sum() // threads, 2))))
    tables, taken = _tables(keys, counts, places)
    return np.concatenate([table[: taken[t]] for t, table in enumerate(tables)])


@njit(cache=True, parallel=True)
def _keys(
    depth: NDArray[np.float32], K: Array, T: Array, scale: float, threads: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Keys of the points' voxels, a row a band of the image, no two neighbours the same; and how many."""
    height, width = depth.shape
    keys = np.empty((threads, (height // threads + 1) * width), dtype=np.int64)
    counts = np.zeros(threads, dtype=np.int64)
    x = (np.arange(width) - K[0, 2]) / K[0, 0]
    for t in prange(threads):
        count, last = 0, EMPTY
        for v in range(height * t // threads, height * (t + 1) // threads):
            y = (v - K[1, 2]) / K[1, 1]
            a, b, c = T[0, 1] * y + T[0, 2], T[1, 1] * y + T[1, 2], T[2, 1] * y + T[2, 2]
            for u in range(width):
                z = depth[v, u]
                if z > 0.0:
                    i = int(np.floor(((T[0, 0] * x[u] + a) * z + T[0, 3]) * scale)) + REACH // 2
                    j = int(np.floor(((T[1, 0] * x[u] + b) * z + T[1, 3]) * scale)) + REACH // 2
                    k = int(np.floor(((T[2, 0] * x[u] + c) * z + T[2, 3]) * scale)) + REACH // 2
                    key = (i * REACH + j) * REACH + k
                    if key != last:
                        keys[t, count] = key
                        count += 1
                        last = key
        counts[t] = count
    return keys, counts


@njit(cache=True, parallel=True)
def _tables(
    keys: NDArray[np.int64], counts: NDArray[np.int64], places: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Each thread's keys, once, at the beginning of its row, and how many."""
    threads = len(keys)
    found = np.empty((threads, counts.sum()), dtype=np.int64)
    taken = np.zeros(threads, dtype=np.int64)
    mask = np.uint64(places - 1)
    for t in prange(threads):
        table = np.full(places, EMPTY, dtype=np.int64)
        for band in range(threads):
            for n in range(counts[band]):
                key = keys[band, n]
                mixed = (np.uint64(key) * MIXER) >> np.uint64(32)
                if ((mixed * np.uint64(threads)) >> np.uint64(32)) != np.uint64(t):
                    continue
                place = mixed & mask
                while table[place] != key and table[place] != EMPTY:
                    place = (place + np.uint64(1)) & mask
                if table[place] == EMPTY:
                    table[place] = key
                    found[t, taken[t]] = key
                    taken[t] += 1
    return found, taken
