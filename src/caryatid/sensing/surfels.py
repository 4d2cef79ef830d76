"""Surfels: the readings of a view averaged to small oriented patches, which registration matches.

Patches are rows (P, 8): their readings' mean x, y, z [m] in the world as reported, unit normal, variance of
the distance from their surface [m²] by the spread of the readings, and label. Patches of different labels are
never the same surface.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from caryatid.config import RegistrationConfig
from caryatid.geometry.points import quantile
from caryatid.geometry.transforms import Array
from caryatid.runtime.parallel import SHARES, kernel, on_threads
from caryatid.sensing.views import MAX_LABEL, Cloud

MIN_COSINE = 0.9
"""Minimum cosine of the angle between normals that agree [1]."""
OFFSET = 1 << 20
"""Added to a cell's number along an axis, so that three of 21 bits make one key: 10 km of 1 cm cells."""


def surfels_of(
    cloud: Cloud, config: RegistrationConfig, *, same_labels: bool
) -> tuple[Array, NDArray[np.intp]]:
    """Average the readings of each voxel that have one label and face one way.

    The mean of a dozen readings is several times better than any of them. Patches across an edge, whose
    normals disagree, are left out.

    Args:
        cloud: Labelled points in the world; 0 = nothing that counts, above 65519 = a support surface.
        config: Sizes of the patches.
        same_labels: Whether labels mean the same in every view; otherwise only a support surface's does.

    Returns:
        Patches (P, 8), and the side (P,) each is of: one part of the view, facing roughly one way.
    """
    assert cloud.labels is not None
    voxels, kinds, sums = _gathered(cloud.points_world, cloud.normals_world, cloud.labels, config)
    far = kinds // 6 > MAX_LABEL
    count = sums[:, 0]
    # Rims, and sides at a grazing angle, have few readings; in coarse images all patches do.
    enough = np.full(len(far), 4.0)
    for alike in (far, ~far):
        if alike.any():
            enough[alike] = min(4, 0.33 * quantile(count[alike], 0.9))
    u, v, w = sums[:, 4:7].T / count
    length = np.sqrt(u * u + v * v + w * w)
    # If the mean of the normals is shorter, there is an edge. Patches of a surface that are not level are
    # noise, and would hold views in its plane.
    level = ~far | (w > MIN_COSINE * length)
    keep = np.flatnonzero((count >= enough) & (length > 0.97) & level)
    voxels, kinds, count = voxels[keep], kinds[keep], count[keep]
    x, y, z, u, v, w, xx, xy, xz, yy, yz, zz = means = np.ascontiguousarray(sums[keep, 1:].T) / count
    means[3:6] *= 1.0 / length[keep]
    spread = (xx - x * x) * u * u + (yy - y * y) * v * v + (zz - z * z) * w * w
    across = (xy - x * y) * u * v + (xz - x * z) * u * w + (yz - y * z) * v * w
    variance = np.maximum(spread + 2.0 * across, 0.0) / count
    far = kinds // 6 > MAX_LABEL
    edge = np.where(far, config.spacing_far, config.spacing)
    corner = np.stack([edge * ((voxels >> bits) % (2 * OFFSET) - OFFSET) for bits in (42, 21, 0)])
    labels = kinds // 6 if same_labels else np.where(far, kinds // 6, 1)
    patches = np.column_stack([*(corner + means[:3]), u, v, w, variance, labels])
    return _flattened(patches, np.unique(kinds, return_inverse=True)[1], config)


def _gathered(
    points: Array, normals: Array, labels: NDArray[np.int32], config: RegistrationConfig
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Sum up the readings of each voxel that have one label, not 0, and face roughly one way.

    Of each patch (P,), ascending, it gives its voxel, three cell numbers of 21 bits; its kind, 6·label + (0,
    1, 2 for +x, +y, +z, 3, 4, 5 for −x, −y, −z); and a row (P, 13): how many readings, the sums of their
    offsets from the voxel's corner, of their normals, and of the products xx, xy, xz, yy, yz, zz of the
    offsets.
    """
    points, normals = np.ascontiguousarray(points, np.float64), np.ascontiguousarray(normals, np.float64)
    labels = np.ascontiguousarray(labels, np.int32)

    def part(share: int) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
        mine = slice(share * len(points) // SHARES, (share + 1) * len(points) // SHARES)
        return _gather(points[mine], normals[mine], labels[mine], config.spacing, config.spacing_far)

    voxels, kinds, sums = (np.concatenate(parts) for parts in zip(*on_threads(part, SHARES), strict=True))
    order = np.lexsort((kinds, voxels))
    voxels, kinds = voxels[order], kinds[order]
    is_first = np.ones(len(order), dtype=np.bool_)
    is_first[1:] = (voxels[1:] != voxels[:-1]) | (kinds[1:] != kinds[:-1])
    patch, first = np.cumsum(is_first) - 1, order[is_first]
    totals = sums[first]
    np.add.at(totals, patch[~is_first], sums[order[~is_first]])
    return voxels[is_first], kinds[is_first], totals


@kernel
def _gather(points, normals, labels, spacing, spacing_far):  # type: ignore[no-untyped-def]
    """Like `_gathered` for a part of the readings, with patches in the order of their first readings."""
    counted, size = 0, 64
    for label in labels:
        counted += label != 0
    while size < 2 * counted:
        size *= 2
    slots = np.empty(size, np.int64)
    for place in range(size):
        slots[place] = -1
    voxels, kinds = np.empty(counted, np.int64), np.empty(counted, np.int64)
    sums = np.empty((counted, 13))
    found, k = 0, 0
    for i in range(len(points)):
        label = labels[i]
        if label == 0:
            continue
        edge = spacing_far if label > MAX_LABEL else spacing
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
        # Neighbours in the image often belong to one patch.
        if found == 0 or voxels[k] != voxel or kinds[k] != kind:
            mixed = (voxel ^ (kind << 50)) * np.int64(-7046029254386353131)
            slot = (mixed ^ (mixed >> 32)) & (size - 1)
            while slots[slot] >= 0 and (voxels[slots[slot]] != voxel or kinds[slots[slot]] != kind):
                slot = (slot + 1) & (size - 1)
            k = int(slots[slot])
            if k < 0:
                k = found
                found += 1
                slots[slot] = k
                voxels[k], kinds[k] = voxel, kind
                for a in range(13):
                    sums[k, a] = 0.0
        reading = (1.0, x, y, z, u, v, w, x * x, x * y, x * z, y * y, y * z, z * z)
        for a in range(13):
            sums[k, a] += reading[a]
    return voxels[:found], kinds[:found], sums[:found]


def _flattened(
    patches: Array, side: NDArray[np.intp], config: RegistrationConfig
) -> tuple[Array, NDArray[np.intp]]:
    """Give all patches of a flat side its plane's normal; leave out those that do not lie in it.

    A single patch's normal is wrong by degrees, and more near edges. Many such patches of one plane would
    seem to determine positions in the plane.
    """
    sizes = np.bincount(side)
    tolerance = 1.5 * config.noise
    planes, widths, heights = _fit_planes(patches[:, :3], side, tolerance)
    plane = planes[side]
    agreement = np.sum(plane * patches[:, 3:6], axis=1)
    lies_in = (np.abs(heights) < 2.0 * tolerance) & (np.abs(agreement) > MIN_COSINE)
    share = np.bincount(side, lies_in) / np.maximum(sizes, 1)
    # A flat side is at least 2 cm wide: its patches have a standard deviation of 6 mm.
    flat = ((share > 0.7) & (widths > 0.006**2))[side]
    patches[flat, 3:6] = (plane * np.where(agreement < 0.0, -1.0, 1.0)[:, None])[flat]
    # Sides of fewer than six patches are blurred edges.
    keep = (~flat | lies_in) & (sizes >= 6)[side]
    return patches[keep], side[keep]


def _fit_planes(
    points: Array, side: NDArray[np.intp], flat: float
) -> tuple[Array, NDArray[np.float64], NDArray[np.float64]]:
    """Fit a plane to the points (N, 3) [m] of each side, robustly: those off it lose their weight.

    At the distance `flat` [m] from the plane a point counts a quarter. It gives each plane's normal (S, 3),
    the variance along the shorter direction in the plane (S,) [m²], and each point's height (N,) [m].
    """
    weights = np.ones(len(points))
    for _ in range(4):
        total = np.bincount(side, weights)
        centres = np.stack([np.bincount(side, weights * x) for x in points.T], axis=-1) / total[:, None]
        off = points - centres[side]
        products = [np.bincount(side, weights * off[:, a] * off[:, b]) for a in range(3) for b in range(3)]
        spreads, axes = np.linalg.eigh(np.stack(products, axis=-1).reshape(-1, 3, 3))
        heights = np.einsum("ni,ni->n", off, axes[side, :, 0])
        weights = 1.0 / (1.0 + (heights / flat) ** 2) ** 2
    return axes[:, :, 0], spreads[:, 1] / total, heights


def even_sample(side: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """Pick patches evenly over labels and the directions they face: a small side counts as much as a table.

    Normal-space sampling after Rusinkiewicz and Levoy, Efficient variants of the ICP algorithm, 2001. Of the
    patches, each of one side (P,), it gives ascending indices (M,), no more than `count`.
    """
    sizes = np.bincount(side)
    # Within a side, the patches come in an order that spreads them evenly for any count.
    spread = np.mod(np.arange(len(side)) * (np.sqrt(5.0) - 1.0) / 2.0, 1.0)
    order = np.lexsort((spread, side))
    turn = np.arange(len(side)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    return np.sort(order[np.argsort(turn, kind="stable")][:count])
