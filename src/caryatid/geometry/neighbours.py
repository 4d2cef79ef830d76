"""Compiled search for the nearest neighbours of points among themselves, beside SciPy's tree in the tests."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.geometry.transforms import Array
from caryatid.runtime.parallel import for_each

SHARE = 64
"""Points of one piece of work [1]."""


class Search(NamedTuple):
    """Points whose neighbours are looked for.

    Attributes:
        points: (N, 3) [m], ascending along their first axis.
        found: Indices (N, K) of the nearest ones of each, the nearest first; written to.
    """

    points: Array
    found: NDArray[np.intp]


def nearest_neighbours(points: Array, count: int) -> NDArray[np.intp]:
    """Find the nearest neighbours of points among themselves.

    Args:
        points: (N, 3) [m].
        count: How many, the point itself among them; no more than there are.

    Returns:
        Indices (N, C), C = `count`, the nearest first: the point itself, or one at the same place.
    """
    axis = int(np.argmax(np.ptp(points, axis=0))) if len(points) else 0
    order = np.argsort(points[:, axis], kind="stable")
    search = Search(
        np.ascontiguousarray(np.roll(points[order], -axis, axis=1)),
        np.empty((len(points), count), dtype=np.intp),
    )
    for_each(find_nearest, -(-len(points) // SHARE), search)
    found = np.empty_like(search.found)
    found[order] = order[search.found]
    return found


@njit(cache=True, error_model="numpy")
def find_nearest(share: int, search: Search) -> None:
    """Find those of one share of the points: outwards along the first axis until none can be nearer."""
    points, count, size = search.points, search.found.shape[1], len(search.points)
    distances = np.empty(count)
    for i in range(share * SHARE, min(share * SHARE + SHARE, size)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        found, held = search.found[i], 0
        below, above = i, i + 1
        while below >= 0 or above < size:
            down = x - points[below, 0] if below >= 0 else np.inf
            up = points[above, 0] - x if above < size else np.inf
            if down <= up:
                k, along, below = below, down, below - 1
            else:
                k, along, above = above, up, above + 1
            if held == count and along * along >= distances[count - 1]:
                break
            dy, dz = points[k, 1] - y, points[k, 2] - z
            squared = along * along + dy * dy + dz * dz
            if held == count and squared >= distances[count - 1]:
                continue
            held = min(held + 1, count)
            place = held - 1
            while place > 0 and distances[place - 1] > squared:
                distances[place], found[place] = distances[place - 1], found[place - 1]
                place -= 1
            distances[place], found[place] = squared, k
