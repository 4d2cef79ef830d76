"""Compiled search for the patches of one view in another; the tests hold it to plain NumPy."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.geometry.transforms import Array

COLUMNS = 8
"""Of a patch: x, y, z [m], its unit normal, the variance of its distance from the surface [m²], its label."""
BUCKETS = 4096
"""Lists a view's patches are kept in, by a hash of label and cell [1]; more patches make longer lists."""
CHUNK = 50
"""Patches one task looks for partners of [1]; who does which task changes no result."""


@njit(cache=True)
def index_patches(patches: NDArray[np.float64], edge: float) -> tuple[Array, NDArray[np.int64]]:
    """Sort patches such that those of one label and cell lie together.

    Args:
        patches: (P, 8), see `COLUMNS`.
        edge: Edge of a cell [m].

    Returns:
        The patches in another order, and where the list of each bucket begins (BUCKETS + 1,).
    """
    bucket = np.empty(len(patches), np.int64)
    starts = np.zeros(BUCKETS + 2, np.int64)
    for i in range(len(patches)):
        x, y, z = patches[i, 0], patches[i, 1], patches[i, 2]
        bucket[i] = _bucket(patches[i, 7], np.floor(x / edge), np.floor(y / edge), np.floor(z / edge))
        starts[bucket[i] + 2] += 1
    for b in range(1, len(starts)):
        starts[b] += starts[b - 1]
    ordered = np.empty_like(patches)
    for i in range(len(patches)):
        for c in range(COLUMNS):
            ordered[starts[bucket[i] + 1], c] = patches[i, c]
        starts[bucket[i] + 1] += 1
    return ordered, starts[:-1]


@njit(cache=True, inline="always")
def _bucket(label, x, y, z):  # type: ignore[no-untyped-def]
    """Number of the bucket of a label and a cell, all given as floats."""
    mixed = (np.int64(x) * 73856093) ^ (np.int64(y) * 19349663) ^ (np.int64(z) * 83492791)
    mixed ^= np.int64(label) * 50331653
    return (mixed ^ (mixed >> 15)) & (BUCKETS - 1)


class Search(NamedTuple):
    """Patches that look for partners in other views.

    Attributes:
        patches: Of all views (P, 8), view by view, each as `index_patches` sorts them, in the world as
            reported; see `COLUMNS`.
        starts: Where the list of each bucket of each view begins (V, BUCKETS + 1).
        samples: Patches that may look for a partner (S, 8).
        tasks: (R, 5): first and last sample, step from one to the next, view in which they look for a
            partner, view they are of; at most `CHUNK` of them.
        shares: Into how many shares the tasks go; every so many of them are one.
        twists: Move (V, 6) of each view from where it was reported: 3 × m, 3 × rad, about the pivot.
        pivot_world: (3,) [m].
        edge: Edge of a cell [m], as the patches were sorted.
        reach: How far away a partner may be [m].
        min_cosine: Cosine of the angle between the normals of partners at least.
        normal_reach: How far apart [m] directions at right angles count, by 1/√2.
        noise: Standard deviation of the distance beside what the patches bring [m].
        rows: (R, CHUNK, 8): derivative (6,) of the distance by the twist of the moving view, the other's
            being the opposite; the distance [m]; its inverse variance [1/m²], 0 where there is no partner.
            Written to where a sample looks for one, and zero elsewhere.
    """

    patches: NDArray[np.float64]
    starts: NDArray[np.int64]
    samples: NDArray[np.float64]
    tasks: NDArray[np.int64]
    shares: int
    twists: NDArray[np.float64]
    pivot_world: NDArray[np.float64]
    edge: float
    reach: float
    min_cosine: float
    normal_reach: float
    noise: float
    rows: NDArray[np.float64]


@njit(cache=True, error_model="numpy")
def find_partners(share: int, search: Search) -> None:
    """Look for the patch of another view that is nearest in place and direction, and linearise the distance.

    Distance is along the mean of both normals, and its derivative by a move of either view that about the
    middle between the two patches: a move of both views together changes nothing. Coordinates are about the
    pivot.
    """
    twists, pivot, noise = search.twists, search.pivot_world, search.noise * search.noise
    for task in range(share, len(search.tasks), search.shares):
        stride, still, moving = search.tasks[task, 2], search.tasks[task, 3], search.tasks[task, 4]
        R = _rotation(twists[moving, 3], twists[moving, 4], twists[moving, 5])
        S = _rotation(twists[still, 3], twists[still, 4], twists[still, 5])
        i = 0
        for k in range(search.tasks[task, 0], search.tasks[task, 1], stride):
            row, sample = search.rows[task, i], search.samples[k]
            i += 1
            px, py, pz = _turned(R, sample[0] - pivot[0], sample[1] - pivot[1], sample[2] - pivot[2])
            px, py, pz = px + twists[moving, 0], py + twists[moving, 1], pz + twists[moving, 2]
            nx, ny, nz = _turned(R, sample[3], sample[4], sample[5])
            found = _partner(
                search, still,
                _turned_back(S, px - twists[still, 0], py - twists[still, 1], pz - twists[still, 2]),
                _turned_back(S, nx, ny, nz), sample[7],
            )  # fmt: skip
            if found < 0:
                for a in range(8):
                    row[a] = 0.0
                continue
            other = search.patches[found]
            qx, qy, qz = _turned(S, other[0] - pivot[0], other[1] - pivot[1], other[2] - pivot[2])
            qx, qy, qz = qx + twists[still, 0], qy + twists[still, 1], qz + twists[still, 2]
            mx, my, mz = _turned(S, other[3], other[4], other[5])
            mx, my, mz = mx + nx, my + ny, mz + nz
            length = np.sqrt(mx * mx + my * my + mz * mz)
            mx, my, mz = mx / length, my / length, mz / length
            row[0], row[1], row[2] = mx, my, mz
            row[6] = (px - qx) * mx + (py - qy) * my + (pz - qz) * mz
            qx, qy, qz = 0.5 * (px + qx), 0.5 * (py + qy), 0.5 * (pz + qz)
            row[3], row[4], row[5] = qy * mz - qz * my, qz * mx - qx * mz, qx * my - qy * mx
            row[7] = 1.0 / (sample[6] + other[6] + noise)


@njit(cache=True, error_model="numpy")
def _partner(search, view, point, normal, label):  # type: ignore[no-untyped-def]
    """Number of the patch of a view nearest in place and direction, or −1; point [m] from the pivot."""
    patches, starts, edge, reach = search.patches, search.starts[view], search.edge, search.reach
    min_cosine, normal_reach, pivot = search.min_cosine, search.normal_reach, search.pivot_world
    x, y, z = point[0] + pivot[0], point[1] + pivot[1], point[2] + pivot[2]
    cx, cy, cz = np.floor(x / edge), np.floor(y / edge), np.floor(z / edge)
    fx, fy, fz = x - cx * edge, y - cy * edge, z - cz * edge
    inside = min(min(fx, edge - fx), min(fy, edge - fy), min(fz, edge - fz))
    turned = 2.0 * normal_reach * normal_reach
    widest = reach * reach
    best = widest + turned * (1.0 - min_cosine)
    found = -1
    # Cell by cell in rings around its own; `gap` is how far away along an axis a cell begins.
    for ring in range(int(np.ceil(reach / edge)) + 1):
        border = inside + (ring - 1) * edge
        if ring > 0 and border * border >= min(best, widest):
            break
        for i in range(-ring, ring + 1):
            gap = i * edge - fx if i > 0 else (fx - (i + 1) * edge if i < 0 else 0.0)
            gap_x = gap * gap
            for j in range(-ring, ring + 1):
                gap = j * edge - fy if j > 0 else (fy - (j + 1) * edge if j < 0 else 0.0)
                gap_xy = gap_x + gap * gap
                inner = abs(i) < ring and abs(j) < ring
                for k in range(-ring, ring + 1, 2 * ring if inner else 1):
                    gap = k * edge - fz if k > 0 else (fz - (k + 1) * edge if k < 0 else 0.0)
                    if gap_xy + gap * gap >= min(best, widest):
                        continue
                    bucket = _bucket(label, cx + i, cy + j, cz + k)
                    for n in range(starts[bucket], starts[bucket + 1]):
                        u, v, w = patches[n, 0] - x, patches[n, 1] - y, patches[n, 2] - z
                        apart = u * u + v * v + w * w
                        if apart >= min(best, widest) or patches[n, 7] != label:
                            continue
                        cosine = patches[n, 3] * normal[0] + patches[n, 4] * normal[1]
                        cosine += patches[n, 5] * normal[2]
                        apart += turned * (1.0 - cosine)
                        if cosine > min_cosine and apart < best:
                            best = apart
                            found = n
    return found


@njit(cache=True, error_model="numpy")
def _rotation(x, y, z):  # type: ignore[no-untyped-def]
    """Rotation of a rotation vector [rad], row by row (9)."""
    angle = np.sqrt(x * x + y * y + z * z)
    a, b = 1.0, 0.5
    if angle > 1e-6:
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / (angle * angle)
    return (
        1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y,
        b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x,
        b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y),
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def _turned(R, x, y, z):  # type: ignore[no-untyped-def]
    """A vector (3) turned by a rotation (9)."""
    return R[0] * x + R[1] * y + R[2] * z, R[3] * x + R[4] * y + R[5] * z, R[6] * x + R[7] * y + R[8] * z


@njit(cache=True, error_model="numpy")
def _turned_back(R, x, y, z):  # type: ignore[no-untyped-def]
    """A vector (3) turned by the inverse of a rotation (9)."""
    return R[0] * x + R[3] * y + R[6] * z, R[1] * x + R[4] * y + R[7] * z, R[2] * x + R[5] * y + R[8] * z
