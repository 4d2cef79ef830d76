"""Compiled convex polygons in the ground plane: hulls, common areas, and the parts of solids that touch.

A polygon is an array (M, 2) [m] of its corners, counter-clockwise; two are a line, one is a point, none is
nothing. The tests compare with shapely.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from caryatid.geometry.transforms import Array
from caryatid.runtime.parallel import kernel


@kernel
def hull(points: NDArray[np.float64]) -> Array:
    """Convex hull of points (N, 2) or (N, 3) projected to the ground."""
    p, count = points[:, :2].copy(), len(points)
    gap = count // 2
    while gap > 0:
        for i in range(gap, count):
            x, y = p[i, 0], p[i, 1]
            j = i
            while j >= gap and (p[j - gap, 0] > x or (p[j - gap, 0] == x and p[j - gap, 1] > y)):
                p[j, 0], p[j, 1] = p[j - gap, 0], p[j - gap, 1]
                j -= gap
            p[j, 0], p[j, 1] = x, y
        gap //= 2
    corners = np.empty((2 * count + 1, 2))
    size, first = 0, 0
    for k in range(2 * count):
        # Forth along the lower side, and back along the upper one.
        i = k if k < count else 2 * count - 1 - k
        if k == count:
            first = size - 1
        x, y = p[i, 0], p[i, 1]
        if size > 0 and corners[size - 1, 0] == x and corners[size - 1, 1] == y:
            continue
        while size - first >= 2 and _turn(corners, size - 2, size - 1, x, y) <= 0.0:
            size -= 1
        corners[size, 0], corners[size, 1] = x, y
        size += 1
    # The way back ends where the way forth began.
    return corners[: size - 1 if size > 1 else size]


@kernel
def intersection(a: NDArray[np.float64], b: NDArray[np.float64]) -> Array:
    """Common area (K, 2) of two convex polygons (N, 2) and (M, 2): one cut along each edge of the other."""
    now, cut = np.empty((2 * (len(a) + len(b)), 2)), np.empty((2 * (len(a) + len(b)), 2))
    count = len(a) if len(b) > 2 else 0
    for i in range(count):
        now[i, 0], now[i, 1] = a[i, 0], a[i, 1]
    for k in range(len(b)):
        kept = 0
        before = _turn(b, k - 1, k, now[count - 1, 0], now[count - 1, 1])
        for i in range(count):
            x, y = now[i, 0], now[i, 1]
            here = _turn(b, k - 1, k, x, y)
            if (before < 0.0 < here) or (here < 0.0 < before):
                last = i - 1 if i > 0 else count - 1
                share = before / (before - here)
                cut[kept, 0] = now[last, 0] + share * (x - now[last, 0])
                cut[kept, 1] = now[last, 1] + share * (y - now[last, 1])
                kept += 1
            if here >= 0.0:
                cut[kept, 0], cut[kept, 1] = x, y
                kept += 1
            before = here
        now, cut = cut, now
        count = kept
    return now[:count]


@kernel
def area(polygon: NDArray[np.float64]) -> float:
    """Area [m²] of a polygon (N, 2) [m]."""
    total = 0.0
    for i in range(2, len(polygon)):
        total += _turn(polygon, 0, i - 1, polygon[i, 0], polygon[i, 1])
    return total / 2.0


@kernel
def signed_distance(polygon: NDArray[np.float64], x: float, y: float) -> float:
    """Distance [m] of a point to a polygon's (N, 2) border, negative inside.

    Nothing is inside a line or a point.
    """
    least, inside = np.inf, len(polygon) > 2
    for i in range(len(polygon)):
        from_x, from_y = polygon[i - 1, 0], polygon[i - 1, 1]
        along_x, along_y = polygon[i, 0] - from_x, polygon[i, 1] - from_y
        squared = along_x * along_x + along_y * along_y
        share = 0.0
        if squared > 0.0:
            share = ((x - from_x) * along_x + (y - from_y) * along_y) / squared
            share = min(max(share, 0.0), 1.0)
        away_x, away_y = x - from_x - share * along_x, y - from_y - share * along_y
        least = min(least, away_x * away_x + away_y * away_y)
        inside = inside and _turn(polygon, i - 1, i, x, y) >= 0.0
    return -np.sqrt(least) if inside else np.sqrt(least)


@kernel
def signed_distances(polygon: NDArray[np.float64], places: NDArray[np.float64]) -> Array:
    """Signed distance (N,) [m] of points (N, 2), or of the first two coordinates of (N, 3), to a polygon."""
    distances = np.empty(len(places))
    for k in range(len(places)):
        distances[k] = signed_distance(polygon, places[k, 0], places[k, 1])
    return distances


@kernel
def fill(polygon: NDArray[np.float64], squares: NDArray[np.bool_]) -> None:
    """Set the squares (X, Y) whose numbers lie within a polygon (N, 2), but not on its border."""
    for x in range(squares.shape[0]):
        low, high = np.inf, -np.inf
        for i in range(len(polygon)):
            from_x, to_x = polygon[i - 1, 0], polygon[i, 0]
            if min(from_x, to_x) <= x <= max(from_x, to_x):
                share = (x - from_x) / (to_x - from_x) if to_x != from_x else 1.0
                y = polygon[i - 1, 1] + share * (polygon[i, 1] - polygon[i - 1, 1])
                low, high = min(low, y), max(high, y)
        if polygon[:, 0].min() < x < polygon[:, 0].max():
            squares[x, int(np.floor(low + 1e-9)) + 1 : int(np.ceil(high - 1e-9))] = True


@kernel
def cap(
    corners: NDArray[np.float64], edges: NDArray[np.int64], direction: NDArray[np.float64], depth: float
) -> Array:
    """Outline (K, 2) on the ground of the part of a convex solid near its outermost point along a direction.

    Args:
        corners: (N, 3) [m].
        edges: Both ends (E, 2) of each edge.
        direction: Unit vector (3,).
        depth: How far the part reaches from the outermost point [m]; infinite for the whole solid.
    """
    farthest = -np.inf
    reach = np.empty(len(corners))
    for i in range(len(corners)):
        reach[i] = 0.0
        for k in range(3):
            reach[i] += corners[i, k] * direction[k]
        farthest = max(farthest, reach[i])
    kept = np.empty((len(corners) + len(edges), 2))
    count = 0
    for i in range(len(corners)):
        reach[i] += depth - farthest
        if reach[i] >= 0.0:
            kept[count, 0], kept[count, 1] = corners[i, 0], corners[i, 1]
            count += 1
    for k in range(len(edges)):
        i, j = edges[k, 0], edges[k, 1]
        if (reach[i] >= 0.0) != (reach[j] >= 0.0):
            share = reach[i] / (reach[i] - reach[j])
            for m in range(2):
                kept[count, m] = corners[i, m] + share * (corners[j, m] - corners[i, m])
            count += 1
    return hull(kept[:count])


@kernel
def _turn(p: NDArray[np.float64], a: int, b: int, x: float, y: float) -> float:
    """Twice the area [m²] of the triangle from p[a] over p[b] to a point; positive counter-clockwise."""
    return (p[b, 0] - p[a, 0]) * (y - p[a, 1]) - (p[b, 1] - p[a, 1]) * (x - p[a, 0])
