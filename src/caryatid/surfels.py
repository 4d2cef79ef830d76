"""Patches of surface to lay views onto each other by: readings averaged, picked evenly over directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from caryatid import frames
from caryatid.config import RegistrationConfig
from caryatid.frames import Array
from caryatid.views import SUPPORT_LABEL, Cloud


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
    parts = cloud.labels[cloud.labels != 0]
    cloud = cloud.select(cloud.labels != 0)
    far = parts == SUPPORT_LABEL
    labels = parts if same_labels else np.where(far, SUPPORT_LABEL, 1)
    spacing = np.where(far, config.spacing_far, config.spacing)
    cells = np.floor(cloud.points_world / spacing[:, None]).astype(np.int64)
    cells -= cells.min(axis=0, initial=np.iinfo(np.int64).max)
    facing = np.argmax(np.abs(cloud.normals_world), axis=1)
    facing += 3 * (cloud.normals_world[np.arange(len(cloud)), facing] < 0.0)
    _, part = np.unique(parts, return_inverse=True)
    size = cells.max(axis=0, initial=0) + 1
    keys = np.ravel_multi_index((*cells.T, facing, part), (*size, 6, part.max(initial=0) + 1))
    _, first, owner, count = np.unique(keys, return_index=True, return_inverse=True, return_counts=True)
    mean = [np.bincount(owner, x) / count for x in (*cloud.points_world.T, *cloud.normals_world.T)]
    points, normals = np.stack(mean[:3], axis=1), np.stack(mean[3:], axis=1)
    length = np.linalg.norm(normals, axis=1)
    normals = frames.unit(normals)
    height = np.sum((cloud.points_world - points[owner]) * normals[owner], axis=1)
    enough = np.full(len(count), float(config.min_readings))
    for kind in (False, True):
        alike = far[first] == kind
        if alike.any():
            enough[alike] = min(config.min_readings, config.min_share * np.percentile(count[alike], 90.0))
    keep = (length > config.min_flatness) & (count >= enough)
    variance = np.bincount(owner, height**2) / count**2
    found = Surfels(
        points[keep],
        normals[keep],
        labels[first[keep]].astype(np.int32),
        (6 * part + facing)[first[keep]],
        variance[keep],
    )
    return _flattened(found, config)


def _flattened(surfels: Surfels, config: RegistrationConfig) -> Surfels:
    """Give all patches of a flat side its plane's normal; those that do not lie in it are left out.

    A single patch's normal errs by degrees, and more near edges, which many patches of one plane would sum
    up to the belief that they say something of positions in the plane.
    """
    _, side = np.unique(surfels.sides, return_inverse=True)
    points, normals = surfels.points_world, surfels.normals_world.copy()
    weight = np.ones(len(points))
    for _ in range(config.plane_rounds):
        total = np.maximum(np.bincount(side, weight), 1e-9)
        centre = np.stack([np.bincount(side, weight * x) / total for x in points.T], axis=1)
        offset = points - centre[side]
        spread = np.array(
            [[np.bincount(side, weight * a * b) / total for a in offset.T] for b in offset.T]
        ).transpose(2, 0, 1)
        values, vectors = np.linalg.eigh(spread)
        plane = vectors[side, :, 0]
        height = np.sum(offset * plane, axis=1)
        weight = 1.0 / (1.0 + (height / config.flat) ** 2) ** 2
    lies_in = np.abs(height) < 2.0 * config.flat
    agrees = np.abs(np.sum(plane * normals, axis=1)) > config.min_cosine
    share = np.bincount(side, lies_in & agrees) / np.bincount(side)
    wide = values[:, 1] > config.min_side**2
    flat = ((share > config.flat_share) & wide)[side]
    towards = np.where(np.sum(plane * normals, axis=1) < 0.0, -1.0, 1.0)
    normals[flat] = (plane * towards[:, None])[flat]
    keep = (~flat | (lies_in & agrees)) & (np.bincount(side) >= config.min_patches)[side]
    return Surfels(
        points[keep], normals[keep], surfels.labels[keep], surfels.sides[keep], surfels.variance[keep]
    )


def even_sample(surfels: Surfels, count: int) -> NDArray[np.intp]:
    """Pick surfels evenly over labels and the directions they face: a small side counts as much as a table.

    Normal-space sampling after Rusinkiewicz and Levoy, Efficient variants of the ICP algorithm, 2001.

    Args:
        surfels: What to pick from.
        count: How many at the most.

    Returns:
        Indices, ascending.
    """
    if len(surfels) <= count:
        return np.arange(len(surfels))
    _, side = np.unique(surfels.sides, return_inverse=True)
    # Within a side the surfels take turns in an order that spreads them evenly whatever the count.
    spread = np.mod(np.arange(len(surfels)) * (np.sqrt(5.0) - 1.0) / 2.0, 1.0)
    order = np.lexsort((spread, side))
    sizes = np.bincount(side)
    turn = np.arange(len(surfels)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    return np.sort(order[np.argsort(turn, kind="stable")[:count]])
