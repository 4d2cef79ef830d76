"""Compiled loops over points: many transforms at once, thinning by voxels; and numerics other kernels share.

NumPy's `solve`, `sort` and `median` do the same; called in a kernel they take ten times as long to compile.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from caryatid.geometry.transforms import Array
from caryatid.runtime.parallel import kernel


def transform(T_a_b: Array, which: NDArray[np.intp], points_b: Array) -> Array:
    """Move points (N, 3) [m], each by one (N,) of several rigid transforms (K, 4, 4)."""
    return _transformed(np.ascontiguousarray(T_a_b), which, np.ascontiguousarray(points_b), 1.0)


def rotate(T_a_b: Array, which: NDArray[np.intp], vectors_b: Array) -> Array:
    """Turn vectors (N, 3), each by one (N,) of several rigid transforms (K, 4, 4)."""
    return _transformed(np.ascontiguousarray(T_a_b), which, np.ascontiguousarray(vectors_b), 0.0)


@kernel
def _transformed(T, which, points, last):  # type: ignore[no-untyped-def]
    """Transform homogeneous points with this last coordinate."""
    moved = np.empty((len(points), 3))
    for i in range(len(points)):
        t = which[i]
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for k in range(3):
            moved[i, k] = T[t, k, 0] * x + T[t, k, 1] * y + T[t, k, 2] * z + T[t, k, 3] * last
    return moved


def most_central(points: Array, groups: NDArray[np.int32], edges: Array) -> NDArray[np.intp]:
    """For each group and voxel, the point nearest to the mean of its points; of two equally near, the first.

    Args:
        points: (N, 3) [m].
        groups: Group (N,) of each point, an index of `edges`.
        edges: Edge length (G,) [m] of the voxels of each group; points of groups without one are left out.

    Returns:
        Indices (M,), ascending.
    """
    points = np.ascontiguousarray(points)
    voxel, count = _numbered(points, groups, edges)
    means, sizes = np.zeros((count, 3)), np.zeros(count, dtype=np.int64)
    least, nearest = np.full(count, np.inf), np.zeros(count, dtype=np.int64)
    _most_central(points, voxel, means, sizes, least, nearest)
    return np.sort(nearest)


def last_in_voxels(points: Array, edge: float, depth: int) -> NDArray[np.intp]:
    """The last `depth` points (N, 3) [m] in each voxel of this edge length [m]; ascending indices."""
    points = np.ascontiguousarray(points)
    voxel, count = _numbered(points, np.zeros(len(points), dtype=np.int32), np.array([edge]))
    backwards = voxel[::-1]
    order = np.argsort(backwards, kind="stable")
    sizes = np.bincount(backwards, minlength=count)
    rank = np.arange(len(points)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    return np.sort(len(points) - 1 - order[rank < depth])


def _numbered(points: Array, groups: NDArray[np.int32], edges: Array) -> tuple[NDArray[np.int32], int]:
    """Number the occupied voxels of each group by appearance: numbers (N,), −1 = left out, and how many."""
    table = np.full(1 << (2 * len(points) + 128).bit_length(), -1, dtype=np.int32)
    cells, voxel = np.empty((len(points), 4)), np.empty(len(points), dtype=np.int32)
    return voxel, _number(points, groups, np.asarray(edges, dtype=np.float64), table, cells, voxel)


@kernel
def _most_central(points, voxel, means, sizes, least, nearest):  # type: ignore[no-untyped-def]
    for i in range(len(points)):
        k = voxel[i]
        if k >= 0:
            sizes[k] += 1
            for a in range(3):
                means[k, a] += points[i, a]
    for k in range(len(means)):
        for a in range(3):
            means[k, a] /= sizes[k]
    for i in range(len(points)):
        k = voxel[i]
        if k >= 0:
            x, y, z = points[i, 0] - means[k, 0], points[i, 1] - means[k, 1], points[i, 2] - means[k, 2]
            distance = x * x + y * y + z * z
            if distance < least[k]:
                least[k], nearest[k] = distance, i


@kernel
def _number(points, groups, edges, table, cells, voxel):  # type: ignore[no-untyped-def]
    """Number voxels by a hash table with linear probing; neighbours in the image are often in one voxel."""
    mask = len(table) - 1
    count, last = 0, -1
    for i in range(len(points)):
        group = groups[i]
        edge = edges[group]
        voxel[i] = -1
        if edge <= 0.0:
            continue
        x, y, z = np.floor(points[i, 0] / edge), np.floor(points[i, 1] / edge), np.floor(points[i, 2] / edge)
        if last < 0 or not _same(cells[last], x, y, z, group):
            slot = _mixed(np.int64(x), np.int64(y), np.int64(z), np.int64(group)) & mask
            while table[slot] >= 0 and not _same(cells[table[slot]], x, y, z, group):
                slot = (slot + 1) & mask
            if table[slot] < 0:
                table[slot] = count
                cells[count, 0], cells[count, 1], cells[count, 2], cells[count, 3] = x, y, z, group
                count += 1
            last = table[slot]
        voxel[i] = last
    return count


@kernel(inline="always")
def _same(cell, x, y, z, group):  # type: ignore[no-untyped-def]
    return cell[0] == x and cell[1] == y and cell[2] == z and cell[3] == group


@kernel(inline="always")
def _mixed(x, y, z, group):  # type: ignore[no-untyped-def]
    """A hash of four integers: a sum with odd factors, its upper bits folded into the lower (Fibonacci)."""
    h = (x * 0x9E3779B1 + y * 0x85EBCA77 + z * 0xC2B2AE3D + group * 0x27D4EB2F) * 0x9E3779B97F4A7C1
    return (h ^ (h >> 29)) & 0x7FFFFFFF


@kernel
def solve_positive(A: NDArray[np.float64], b: NDArray[np.float64]) -> Array:
    """Solution x (N,) of A x = b for a symmetric positive definite A (N, N), by Cholesky's factors.

    They overwrite A. If A is not positive definite, x has NaN.
    """
    size = len(b)
    x = np.empty(size)
    for i in range(size):
        for j in range(i + 1):
            rest = A[i, j]
            for k in range(j):
                rest -= A[i, k] * A[j, k]
            A[i, j] = np.sqrt(rest) if i == j else rest / A[j, j]
    for i in range(size):
        rest = b[i]
        for k in range(i):
            rest -= A[i, k] * x[k]
        x[i] = rest / A[i, i]
    for i in range(size - 1, -1, -1):
        rest = x[i]
        for k in range(i + 1, size):
            rest -= A[k, i] * x[k]
        x[i] = rest / A[i, i]
    return x


@kernel
def select(numbers: NDArray[np.float64], rank: int) -> float:
    """The number at this rank, from 0, among numbers (N,) in ascending order.

    The numbers are reordered: those before the rank are not greater, those after it not less. If some are
    not comparable, it is any of them.
    """
    left, right = 0, len(numbers) - 1
    while left < right:
        pivot = numbers[rank]
        i, j = left, right
        while i <= j:
            while numbers[i] < pivot:
                i += 1
            while pivot < numbers[j]:
                j -= 1
            if i <= j:
                numbers[i], numbers[j] = numbers[j], numbers[i]
                i += 1
                j -= 1
        if j < rank:
            left = i
        if rank < i:
            right = j
    return numbers[rank]


@kernel
def quantile(numbers: NDArray[np.float64], share: float) -> float:
    """Quantile of numbers (N,), interpolated between two of them; they are reordered."""
    place = share * (len(numbers) - 1)
    rank = int(place)
    below = select(numbers, rank)
    if rank + 1 >= len(numbers):
        return below
    above = np.inf
    for k in range(rank + 1, len(numbers)):
        above = min(above, numbers[k])
    return below + (place - rank) * (above - below)
