"""Surfels: the readings of a view averaged to small oriented patches, which registration matches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.config import RegistrationConfig
from caryatid.geometry.transforms import Array
from caryatid.runtime.parallel import for_each
from caryatid.sensing.views import SUPPORT_LABEL, Cloud

PARTS = 16
"""Parts of the readings that are gathered each by itself [1]; who gathers which changes no result."""
SWEEPS = 6
"""Sweeps of Jacobi rotations that make a 3×3 matrix diagonal to rounding [1]; they converge quadratically."""
OFFSET = 1 << 20
"""Added to a cell's number along an axis, so that three of 21 bits make one key: 10 km of 1 cm cells."""
MASK = 2 * OFFSET - 1
"""Its bits."""
MIN_COSINE = 0.9
"""Cosine of the angle between normals that agree at least [1]."""


class Readings(NamedTuple):
    """Readings to be averaged patch by patch, and place for that.

    Attributes:
        points: (N, 3) [m].
        normals: Unit normals (N, 3).
        labels: Label (N,) of each point; 0 counts nowhere.
        spacing: Edge of a voxel [m].
        spacing_far: Edge of a voxel of the label `far` [m].
        far: That label.
        voxels: Of each patch (N,) the number of its voxel, ascending along x, then y, then z; written to.
        kinds: Its label and the way it faces (N,), as 6·label + (0, 1, 2 for +x, +y, +z, 3, 4, 5 for −x, −y,
            −z); written to.
        sums: Of its readings (N, 13): how many; sums of their offsets from the voxel's corner, of their
            normals, and of the products xx, xy, xz, yy, yz, zz of the offsets; written to.
        found: How many patches each part has (PARTS,), from where its readings begin; written to.
        slots: Places (S,) to find patches by their keys, twice as many as readings or more; written to.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    labels: NDArray[np.int32]
    spacing: float
    spacing_far: float
    far: int
    voxels: NDArray[np.int64]
    kinds: NDArray[np.int64]
    sums: NDArray[np.float64]
    found: NDArray[np.int64]
    slots: NDArray[np.int64]


def gather_patches(
    points: Array, normals: Array, labels: NDArray[np.int32], spacing: float, spacing_far: float, far: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Average the readings of each voxel that are of one label and face roughly one way.

    Args:
        points: (N, 3) [m].
        normals: Unit normals (N, 3).
        labels: Label (N,) of each point; 0 counts nowhere.
        spacing: Edge of a voxel [m].
        spacing_far: Edge of a voxel of the label `far` [m].
        far: That label.

    Returns:
        Of each patch (P,), in the order its first reading comes: the number of its voxel and its kind, see
        `Readings`; and a row (P, 9): readings, their mean [m], the direction of their mean normal, its
        length, and the variance of the mean's distance from the surface by the readings' spread along that
        direction [m²].
    """
    size = len(points)
    readings = Readings(
        np.ascontiguousarray(points, dtype=np.float64),
        np.ascontiguousarray(normals, dtype=np.float64),
        np.ascontiguousarray(labels, dtype=np.int32),
        *(spacing, spacing_far, far),
        *(np.empty(size, np.int64), np.empty(size, np.int64), np.empty((size, 13))),
        *(np.zeros(PARTS, np.int64), np.empty(PARTS * _slots(size // PARTS + 1), np.int64)),
    )
    for_each(gather_part, PARTS, readings)
    found = join_parts(readings.found, readings.voxels, readings.kinds, readings.sums, readings.slots)
    voxels, kinds = readings.voxels[:found].copy(), readings.kinds[:found].copy()
    return voxels, kinds, averages(kinds, voxels, readings.sums, spacing, spacing_far, far)


def _slots(count: int) -> int:
    """Slots for that many keys, of which they fill half at the most; a power of two from 64 on."""
    return max(64, 1 << (2 * count - 1).bit_length())


@njit(cache=True, error_model="numpy")
def gather_part(index: int, readings: Readings) -> None:
    """Sum up one part of the readings patch by patch."""
    points, normals, labels = readings.points, readings.normals, readings.labels
    voxels, kinds, sums = readings.voxels, readings.kinds, readings.sums
    # Neighbouring parts are as full as each other; a thread that takes several gets them from all over.
    part = 5 * index % PARTS
    first, last = part * len(points) // PARTS, (part + 1) * len(points) // PARTS
    counted, size = 0, 64
    for i in range(first, last):
        counted += labels[i] != 0
    while size < 2 * counted:
        size *= 2
    begin = part * (len(readings.slots) // PARTS)
    slots = readings.slots[begin : begin + size]
    for slot in range(size):
        slots[slot] = -1
    found, k = first, first
    for i in range(first, last):
        label = labels[i]
        if label == 0:
            continue
        edge = readings.spacing_far if label == readings.far else readings.spacing
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        cx, cy, cz = np.floor(x / edge), np.floor(y / edge), np.floor(z / edge)
        x, y, z = x - edge * cx, y - edge * cy, z - edge * cz
        voxel = (((np.int64(cx) + OFFSET) << 42) | ((np.int64(cy) + OFFSET) << 21)) | (np.int64(cz) + OFFSET)
        u, v, w = normals[i, 0], normals[i, 1], normals[i, 2]
        way, most = 0, abs(u)
        if abs(v) > most:
            way, most = 1, abs(v)
        if abs(w) > most:
            way = 2
        if normals[i, way] < 0.0:
            way += 3
        kind = 6 * np.int64(label) + way
        if k == found or voxels[k] != voxel or kinds[k] != kind:
            slot = _slot(slots, voxel, kind, voxels, kinds)
            k = slots[slot]
            if k < 0:
                k = found
                found += 1
                slots[slot] = k
                voxels[k], kinds[k] = voxel, kind
                for a in range(13):
                    sums[k, a] = 0.0
        s = sums[k]
        s[0] += 1.0
        s[1] += x
        s[2] += y
        s[3] += z
        s[4] += u
        s[5] += v
        s[6] += w
        s[7] += x * x
        s[8] += x * y
        s[9] += x * z
        s[10] += y * y
        s[11] += y * z
        s[12] += z * z
    readings.found[part] = found - first


@njit(cache=True)
def _slot(slots, voxel, kind, voxels, kinds):  # type: ignore[no-untyped-def]
    """The slot that holds the number of a patch, or where it belongs."""
    mixed = (voxel ^ (kind << 50)) * np.int64(-7046029254386353131)
    slot = (mixed ^ (mixed >> 32)) & (len(slots) - 1)
    while slots[slot] >= 0 and (voxels[slots[slot]] != voxel or kinds[slots[slot]] != kind):
        slot = (slot + 1) & (len(slots) - 1)
    return slot


@njit(cache=True, error_model="numpy")
def join_parts(
    counts: NDArray[np.int64],
    voxels: NDArray[np.int64],
    kinds: NDArray[np.int64],
    sums: NDArray[np.float64],
    slots: NDArray[np.int64],
) -> int:
    """Put the parts' patches together at the front.

    Args:
        counts: How many patches each part has (PARTS,), from where its readings begin.
        voxels: As in `Readings` (N,); written to, like all that follow.
        kinds: As in `Readings` (N,).
        sums: As in `Readings` (N, 13).
        slots: As in `Readings` (S,).

    Returns:
        How many there are.
    """
    total, size = 0, 64
    for part in range(PARTS):
        total += counts[part]
    while size < 2 * total:
        size *= 2
    slots = slots[:size]
    for slot in range(size):
        slots[slot] = -1
    found = 0
    for part in range(PARTS):
        first = part * len(voxels) // PARTS
        for i in range(first, first + counts[part]):
            slot = _slot(slots, voxels[i], kinds[i], voxels, kinds)
            k = slots[slot]
            if k >= 0:
                for a in range(13):
                    sums[k, a] += sums[i, a]
                continue
            slots[slot] = found
            voxels[found], kinds[found] = voxels[i], kinds[i]
            for a in range(13):
                sums[found, a] = sums[i, a]
            found += 1
    return found


@njit(cache=True, error_model="numpy")
def averages(
    kinds: NDArray[np.int64],
    voxels: NDArray[np.int64],
    sums: NDArray[np.float64],
    spacing: float,
    spacing_far: float,
    far: int,
) -> Array:
    """Rows (P, 9) of `gather_patches` from the sums (≥ P, 13) of `Readings`; arguments as there."""
    patches = np.empty((len(kinds), 9))
    for k in range(len(kinds)):
        edge = spacing_far if kinds[k] // 6 == far else spacing
        s, patch = sums[k], patches[k]
        n = s[0]
        x, y, z = s[1] / n, s[2] / n, s[3] / n
        u, v, w = s[4] / n, s[5] / n, s[6] / n
        length = np.sqrt(u * u + v * v + w * w)
        scale = 1.0 / length if length > 0.0 else 1.0
        u, v, w = u * scale, v * scale, w * scale
        spread = (s[7] / n - x * x) * u * u + (s[10] / n - y * y) * v * v + (s[12] / n - z * z) * w * w
        across = (s[8] / n - x * y) * u * v + (s[9] / n - x * z) * u * w + (s[11] / n - y * z) * v * w
        patch[0] = n
        patch[1] = edge * (((voxels[k] >> 42) & MASK) - OFFSET) + x
        patch[2] = edge * (((voxels[k] >> 21) & MASK) - OFFSET) + y
        patch[3] = edge * ((voxels[k] & MASK) - OFFSET) + z
        patch[4], patch[5], patch[6], patch[7] = u, v, w, length
        patch[8] = max(spread + 2.0 * across, 0.0) / n
    return patches


@njit(cache=True, error_model="numpy")
def fit_planes(
    points: NDArray[np.float64], side: NDArray[np.intp], sides: int, flat: float, rounds: int
) -> tuple[Array, Array, Array]:
    """Fit a plane to the points of each side, robustly: those that lie off it lose their weight.

    Args:
        points: (N, 3) [m].
        side: Side (N,) each point is of, from 0.
        sides: How many sides there are.
        flat: Distance from the plane at which a point counts a quarter [m].
        rounds: How many times.

    Returns:
        Of each side the plane's normal (sides, 3) and the variance along the shorter direction in the plane
        (sides,) [m²]; of each point its height over its side's plane (N,) [m].
    """
    weights, heights = np.ones(len(points)), np.zeros(len(points))
    normals, widths = np.zeros((sides, 3)), np.zeros(sides)
    axes, sums = np.zeros((3, 3)), np.zeros((sides, 10))
    for _ in range(rounds):
        for s in range(sides):
            for a in range(10):
                sums[s, a] = 0.0
        for i in range(len(points)):
            total = sums[side[i]]
            total[0] += weights[i]
            for a in range(3):
                total[1 + a] += weights[i] * points[i, a]
        for s in range(sides):
            for a in range(3):
                sums[s, 1 + a] /= max(sums[s, 0], 1e-9)
        for i in range(len(points)):
            total = sums[side[i]]
            x, y, z = points[i, 0] - total[1], points[i, 1] - total[2], points[i, 2] - total[3]
            total[4] += weights[i] * x * x
            total[5] += weights[i] * y * y
            total[6] += weights[i] * z * z
            total[7] += weights[i] * x * y
            total[8] += weights[i] * x * z
            total[9] += weights[i] * y * z
        for s in range(sides):
            least, widths[s] = _least_spread(sums[s, 4:], axes)
            widths[s] /= max(sums[s, 0], 1e-9)
            for a in range(3):
                normals[s, a] = axes[a, least]
        for i in range(len(points)):
            s = side[i]
            heights[i] = 0.0
            for a in range(3):
                heights[i] += (points[i, a] - sums[s, 1 + a]) * normals[s, a]
            weights[i] = 1.0 / (1.0 + (heights[i] / flat) ** 2) ** 2
    return normals, widths, heights


@njit(cache=True, error_model="numpy")
def _least_spread(spread, axes):  # type: ignore[no-untyped-def]
    """Principal axes of a spread (xx, yy, zz, xy, xz, yz), by Jacobi rotations.

    Fills `axes` (3, 3), one a column; returns the column of least spread, and the middle one of the spreads.
    """
    for a in range(3):
        for b in range(3):
            axes[a, b] = 1.0 if a == b else 0.0
    for turn in range(3 * SWEEPS):
        # Of the axes p and q the rotation takes the product away; r is the third one.
        r = 2 - turn % 3
        p, q = (1 if r == 0 else 0), (1 if r == 2 else 2)
        product = spread[2 + p + q]
        if product == 0.0:
            continue
        cotangent = (spread[q] - spread[p]) / (2.0 * product)
        tangent = 1.0 / (abs(cotangent) + np.sqrt(cotangent * cotangent + 1.0))
        if cotangent < 0.0:
            tangent = -tangent
        cosine = 1.0 / np.sqrt(tangent * tangent + 1.0)
        sine = tangent * cosine
        spread[p] -= tangent * product
        spread[q] += tangent * product
        spread[2 + p + q] = 0.0
        u, v = spread[2 + r + p], spread[2 + r + q]
        spread[2 + r + p], spread[2 + r + q] = cosine * u - sine * v, sine * u + cosine * v
        for a in range(3):
            u, v = axes[a, p], axes[a, q]
            axes[a, p], axes[a, q] = cosine * u - sine * v, sine * u + cosine * v
    x, y, z = spread[0], spread[1], spread[2]
    least = 0 if x <= y and x <= z else (1 if y <= z else 2)
    return least, max(min(x, y), min(max(x, y), z))


@dataclass(frozen=True, eq=False, slots=True)
class Surfels:
    """Small flat patches of the surfaces one view shows.

    Attributes:
        points_world: Mean of each patch's readings (N, 3) [m], in the world as reported.
        normals_world: Unit normals (N, 3).
        labels: Label of each patch (N,); patches of different labels are never the same surface.
        sides: Number of the side (N,) each patch is of: one part of the view, facing roughly one way.
        variance: Of each patch's distance from its surface (N,) [m²], by the spread of its readings.
    """

    points_world: Array
    normals_world: Array
    labels: NDArray[np.int32]
    sides: NDArray[np.intp]
    variance: Array

    def __len__(self) -> int:
        return len(self.points_world)


def surfels_of(cloud: Cloud, config: RegistrationConfig, *, same_labels: bool) -> Surfels:
    """Average the readings of each voxel that are of one label and face one way.

    The mean of a dozen readings is several times better than any of them. Patches across an edge, whose
    normals disagree, are left out.

    Args:
        cloud: Labelled points in the world; 0 = nothing that counts, 65535 = the support surface.
        config: Sizes of the patches.
        same_labels: Whether labels mean the same in every view; otherwise only the support surface's does.
    """
    if cloud.labels is None:
        raise ValueError("surfels are made of labelled points")
    voxels, kinds, rows = gather_patches(
        cloud.points_world,
        cloud.normals_world,
        cloud.labels,
        config.spacing,
        config.spacing_far,
        SUPPORT_LABEL,
    )
    far = kinds // 6 == SUPPORT_LABEL
    # Rims, and sides at a grazing angle, have few readings; in coarse images all patches have.
    enough = np.full(len(far), 4.0)
    for alike in (far, ~far):
        if alike.any():
            fullest = np.percentile(rows[alike, 0], 90.0)
            enough[alike] = min(4, 0.33 * fullest)
    # Where the mean of the normals is shorter, there is an edge.
    keep = np.flatnonzero((rows[:, 7] > 0.97) & (rows[:, 0] >= enough))
    keep = keep[np.lexsort((kinds[keep], voxels[keep]))]
    labels = kinds[keep] // 6 if same_labels else np.where(far[keep], SUPPORT_LABEL, 1)
    _, sides = np.unique(kinds[keep], return_inverse=True)
    rows = rows[keep]
    found = Surfels(
        rows[:, 1:4].copy(), rows[:, 4:7].copy(), labels.astype(np.int32), sides, rows[:, 8].copy()
    )
    return _flattened(found, config)


def _flattened(surfels: Surfels, config: RegistrationConfig) -> Surfels:
    """Give all patches of a flat side its plane's normal; those that do not lie in it are left out.

    A single patch's normal errs by degrees, and more near edges, which many patches of one plane would sum
    up to the belief that they say something of positions in the plane.
    """
    side, normals = surfels.sides, surfels.normals_world.copy()
    patches = np.bincount(side)
    tolerance = 1.5 * config.noise
    planes, widths, heights = fit_planes(surfels.points_world, side, len(patches), tolerance, rounds=4)
    plane = planes[side]
    agreement = np.sum(plane * normals, axis=1)
    lies_in = (np.abs(heights) < 2.0 * tolerance) & (np.abs(agreement) > MIN_COSINE)
    share = np.bincount(side, lies_in) / np.maximum(patches, 1)
    # A flat side is 2 cm wide at least: its patches have a standard deviation of 6 mm.
    flat = ((share > 0.7) & (widths > 0.006**2))[side]
    normals[flat] = (plane * np.where(agreement < 0.0, -1.0, 1.0)[:, None])[flat]
    # Sides of fewer than six patches are blurred edges.
    keep = (~flat | lies_in) & (patches >= 6)[side]
    return Surfels(
        surfels.points_world[keep], normals[keep], surfels.labels[keep], side[keep], surfels.variance[keep]
    )


def even_sample(surfels: Surfels, count: int) -> NDArray[np.intp]:
    """Pick surfels evenly over labels and the directions they face: a small side counts as much as a table.

    Normal-space sampling after Rusinkiewicz and Levoy, Efficient variants of the ICP algorithm, 2001.

    Args:
        surfels: What to pick from.
        count: How many at the most.

    Returns:
        Indices (M,), ascending.
    """
    if len(surfels) <= count:
        return np.arange(len(surfels))
    sizes = np.bincount(surfels.sides)
    # Within a side the surfels take turns in an order that spreads them evenly whatever the count.
    spread = np.mod(np.arange(len(surfels)) * (np.sqrt(5.0) - 1.0) / 2.0, 1.0)
    order = np.lexsort((spread, surfels.sides))
    turn = np.arange(len(surfels)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    taken = np.cumsum(np.bincount(turn))
    last = np.searchsorted(taken, count)
    rest = count - (taken[last - 1] if last > 0 else 0)
    return np.sort(np.concatenate([order[turn < last], order[turn == last][:rest]]))
