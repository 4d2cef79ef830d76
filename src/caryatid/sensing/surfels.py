"""Patches of surface to lay views onto each other by: readings averaged, picked evenly over directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from caryatid.config import RegistrationConfig
from caryatid.geometry.transforms import Array
from caryatid.sensing.surfel_kernels import fit_planes, gather_patches
from caryatid.sensing.views import SUPPORT_LABEL, Cloud


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
    enough = np.full(len(far), float(config.min_readings))
    for alike in (far, ~far):
        if alike.any():
            fullest = np.percentile(rows[alike, 0], 90.0)
            enough[alike] = min(config.min_readings, config.min_share * fullest)
    keep = np.flatnonzero((rows[:, 7] > config.min_flatness) & (rows[:, 0] >= enough))
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
    planes, widths, heights = fit_planes(
        surfels.points_world, side, len(patches), config.flat, config.plane_rounds
    )
    plane = planes[side]
    agreement = np.sum(plane * normals, axis=1)
    lies_in = (np.abs(heights) < 2.0 * config.flat) & (np.abs(agreement) > config.min_cosine)
    share = np.bincount(side, lies_in) / np.maximum(patches, 1)
    flat = ((share > config.flat_share) & (widths > config.min_side**2))[side]
    normals[flat] = (plane * np.where(agreement < 0.0, -1.0, 1.0)[:, None])[flat]
    keep = (~flat | lies_in) & (patches >= config.min_patches)[side]
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
