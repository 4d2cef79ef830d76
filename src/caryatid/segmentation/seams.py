"""Seams: dark straight lines between bodies that lie flush, where depth shows no border."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from caryatid.geometry.transforms import Array, unit
from caryatid.segmentation.lccp import summed

Labels = NDArray[np.int32]
Mask = NDArray[np.bool_]
Pairs = NDArray[np.int32]

GAP = 9
"""Width of the widest gap that depth hides [px]: the window that stereo cameras match."""
DARK = 0.08
"""How much darker than its surroundings a seam is at least [1]: more than noise and the grain of surfaces."""
CLOSED = 0.9
"""Minimum share of a border that is dark [1]: a seam runs from edge to edge, a print ends before."""
TURN = np.cos(np.radians(45.0))
"""Cosine of the maximum angle between faces that lie flush [1]: halfway to those of one box at its edge."""
BEND = 1.0
"""Maximum standard deviation of a seam from a straight line [samples]: the spacing of the grid."""


def find_seams(rgb: NDArray[np.uint8], grid: tuple[slice, slice]) -> Mask:
    """Find the places (M, N) of a grid that are darker than what surrounds them within the width of a gap.

    Little light comes out of the gap between two bodies, however narrow it is. At a border between two
    colours, neither is darker than both sides.

    Args:
        rgb: Colours (H, W, 3) of the whole image.
        grid: Its M rows and N columns that form the grid.
    """
    stride = grid[0].step or 1
    red, green, blue = rgb[grid[0].start : grid[0].stop, grid[1].start : grid[1].stop].transpose(2, 0, 1)
    bright = np.maximum(np.maximum(red, green), blue)
    # A gap may lie between two places of the grid.
    bright = ndimage.minimum_filter(bright, stride)[::stride, ::stride].astype(np.float32) + 1.0
    around = ndimage.grey_closing(bright, (GAP // stride | 1,) * 2)
    return np.asarray(bright < (1.0 - DARK) * around)


def cut_at_seams(labels: Labels, normals: Array, seam: Mask, width: int, least: float) -> Labels:
    """Cut parts along straight seams that run from edge to edge.

    Args:
        labels: Image (H, W) of parts 1 … n, 0 = none.
        normals: Their unit normals (H, W, 3).
        seam: Where the image has seams (H, W).
        width: Width of a gap [samples].
        least: Minimum size of what lies between seams and edges [samples].

    Returns:
        The image with numbers above n for the pieces that are cut off.
    """
    result = labels.copy()
    inside = ndimage.minimum_filter(labels, 3) == ndimage.maximum_filter(labels, 3)
    inside &= (labels > 0) & ~seam
    # Where a seam fades at its end, its sides are still connected, over less than the width of a gap.
    core, count = ndimage.label(ndimage.binary_erosion(inside, iterations=width // 2))
    sizes = np.bincount(core.ravel(), minlength=count + 1)
    core[(sizes < least)[core]] = 0
    part_of = np.zeros(count + 1, dtype=np.int32)
    part_of[core] = labels
    part_of[0] = 0
    for part in np.flatnonzero(np.bincount(part_of)[1:] > 1) + 1:
        own = labels == part
        apart = part_of[core] != part
        nearest = ndimage.distance_transform_edt(apart, return_distances=False, return_indices=True)
        piece = np.where(own, core[tuple(nearest)], 0)
        pairs, by_seam = _borders(piece, normals, seam, width)
        joined = pairs[~by_seam]
        graph = coo_array((np.ones(len(joined)), tuple(joined.T)), shape=(count + 1, count + 1))
        group = connected_components(graph, directed=False)[1]
        beside = group[pairs[by_seam]]
        for other in np.unique(beside[beside[:, 0] != beside[:, 1]])[1:]:
            result[own & (group[piece] == other)] = result.max() + 1
    return result


def divided(labels: Labels, uncut: Labels, normals: Array, seam: Mask, width: int) -> Pairs:
    """Pairs (P, 2) of parts with a straight seam between them.

    Args:
        labels: Image (H, W) of parts 1 … n, 0 = none.
        uncut: The parts before they were cut; only pieces of one of them are compared.
        normals: Unit normals (H, W, 3).
        seam: Where the image has seams (H, W).
        width: Width of a gap [samples].
    """
    whole = np.zeros(int(labels.max(initial=0)) + 1, dtype=np.int32)
    whole[labels] = uncut
    pairs, by_seam = _borders(labels, normals, seam, width)
    return pairs[by_seam & (whole[pairs[:, 0]] == whole[pairs[:, 1]])]


def _borders(part: Labels, normals: Array, seam: Mask, width: int) -> tuple[Pairs, Mask]:
    """Pairs (B, 2) of parts 1 … n that meet in an image (H, W), and which (B,) have a seam between them."""
    totals = [np.bincount(part.ravel(), along.ravel()) for along in np.moveaxis(normals, -1, 0)]
    facing = unit(np.stack(totals, axis=-1))
    pairs, places = [], []
    for down, right in ((1, 0), (0, 1)):
        here, there = part[down:, right:], part[: len(part) - down, : part.shape[1] - right]
        meet = (here != there) & (here > 0) & (there > 0)
        pairs.append(np.sort(np.stack([here[meet], there[meet]], axis=-1), axis=1))
        places.append(np.argwhere(meet))
    place = np.concatenate(places)
    row, column = place.T.astype(np.float64)
    # A border runs within its seam or beside it.
    dark = ndimage.maximum_filter(seam, 3)[tuple(place.T)]
    known = np.ones(len(place)), dark, row, column, row * row, row * column, column * column
    joint, number, dark, *sums = summed(np.concatenate(pairs), *known)
    r, c, rr, rc, cc = (total / number for total in sums)
    spread = np.array([[rr - r * r, rc - r * c], [rc - r * c, cc - c * c]]).transpose(2, 0, 1)
    bend = np.sqrt(np.maximum(np.linalg.eigvalsh(spread)[:, 0], 0.0))
    flush = np.einsum("ij,ij->i", facing[joint[:, 0]], facing[joint[:, 1]]) >= TURN
    # A border no longer than two gaps are wide (a diagonal one counts twice) may be where a neck was cut.
    return joint, flush & (number > 4 * width) & (dark >= CLOSED * number) & (bend <= BEND)
