"""Compiled loops over the grid of samples that segmentation works on; the tests hold NumPy references."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.geometry.transforms import Array

Index = NDArray[np.intp]
Labels = NDArray[np.int32]

TOUCHING = [(0, 1), (1, 0), (1, 1), (1, -1)]
"""Rows down and columns right of a sample's later neighbours, diagonals too."""
TURNS = np.array([(0, 1), (0, -1), (1, 0), (-1, 0)])
"""Rows down and columns right of the neighbours labels are taken from, one after the other."""


def grid_edges(
    places: NDArray[np.bool_],
    points: Array,
    normals: Array,
    edge_jump: float,
    max_jump: float,
    min_rise: float,
    gap: int,
) -> tuple[Index, Index]:
    """Pairs of samples that are neighbours in the image: on one surface, and at a step.

    There is a step where neither sample's inverse depth lies near the other's tangent plane: unlike the bare
    difference this does not grow on steep surfaces. Steps are also looked for across short gaps without
    readings, which sensors leave there.

    Args:
        places: Which places of the grid hold a sample (H, W).
        points: Samples (N, 3) [m] in the camera frame.
        normals: Unit normals (N, 3).
        edge_jump: Distance from the neighbour's plane beyond which a sample is another surface's [1/m].
        max_jump: Difference in inverse depth beyond which it is so in any case [1/m].
        min_rise: Height over the neighbour's plane from which a step counts [m].
        gap: How far apart samples at a step may be, with none between [samples].

    Returns:
        Pairs (E, 2) on one surface, and pairs (F, 2) at a step.
    """
    number = np.where(places, np.cumsum(places).reshape(places.shape) - 1, -1)
    offset = np.einsum("ij,ij->i", normals, points)
    planes = normals / np.where(offset == 0.0, np.inf, offset)[:, None]
    ways = np.array(TOUCHING + [way for k in range(2, gap + 1) for way in ((0, k), (k, 0))])
    edges = np.empty((len(TOUCHING) * len(points), 2), dtype=np.intp)
    steps = np.empty((len(ways) * len(points), 2), dtype=np.intp)
    counts = np.zeros(2, dtype=np.intp)
    limits = np.array([edge_jump, max_jump, min_rise])
    _grid_edges(number, points, normals, planes, ways, len(TOUCHING), limits, edges, steps, counts)
    return edges[: counts[0]], steps[: counts[1]]


@njit(cache=True, error_model="numpy")
def _grid_edges(  # type: ignore[no-untyped-def]
    number, points, normals, planes, ways, touching, limits, edges, steps, counts
):
    """Write the pairs and how many there are (2,); limits (3,) are edge_jump, max_jump and min_rise."""
    height, width = number.shape
    for place in range(height * width):
        row, col = place // width, place % width
        i = number[row, col]
        if i < 0:
            continue
        for k in range(len(ways)):
            down, right = ways[k, 0], ways[k, 1]
            if row + down >= height or col + right < 0 or col + right >= width:
                continue
            j = number[row + down, col + right]
            for between in range(1, down if k >= touching and down > 0 else right):
                v, u = (row + between, col) if down > 0 else (row, col + between)
                if number[v, u] >= 0:
                    j = -1
            if j < 0:
                continue
            rise_i = rise_j = from_i = from_j = 0.0
            for axis in range(3):
                way = points[j, axis] - points[i, axis]
                rise_j += normals[i, axis] * way
                rise_i -= normals[j, axis] * way
                from_i += planes[i, axis] * points[j, axis]
                from_j += planes[j, axis] * points[i, axis]
            first, second = 1.0 / points[i, 2], 1.0 / points[j, 2]
            off_i, off_j = abs(from_i - 1.0) * second, abs(from_j - 1.0) * first
            if abs(first - second) <= limits[1] and (off_i <= limits[0] or off_j <= limits[0]):
                if k < touching:
                    edges[counts[0], 0], edges[counts[0], 1] = i, j
                    counts[0] += 1
            elif rise_i > limits[2] or rise_j > limits[2]:
                steps[counts[1], 0], steps[counts[1], 1] = i, j
                counts[1] += 1


def wide_parts(labels: Labels) -> NDArray[np.bool_]:
    """Which parts 0 … n of a label image (H, W) have a sample amid eight of their own.

    At the image's border what lies beyond it speaks for neither.
    """
    wide = np.zeros(int(labels.max(initial=0)) + 1, dtype=np.bool_)
    _find_wide(np.pad(labels, 1, mode="edge"), wide)
    return wide


@njit(cache=True)
def _find_wide(labels, wide):  # type: ignore[no-untyped-def]
    """Mark the parts (n + 1,) that are wide in a label image with one place more on each side."""
    for row in range(1, labels.shape[0] - 1):
        for col in range(1, labels.shape[1] - 1):
            part = labels[row, col]
            amid = not wide[part]
            for k in range(9):
                amid = amid and labels[row + k // 3 - 1, col + k % 3 - 1] == part
            if amid:
                wide[part] = True


def colour_patches(labels: Labels, rgb: NDArray[np.uint8], step: float) -> Index:
    """Patches of one part within which neighbours differ in colour by less than a step.

    Args:
        labels: Parts (H, W), 0 = none.
        rgb: Colours (H, W, 3).
        step: Distance between the shares of red, green and blue [1].

    Returns:
        Patch of each sample (H, W), 0, 1, … in the order of their first samples, −1 = none.
    """
    patch = np.empty(labels.shape, dtype=np.intp)
    _join_colours(labels, np.array(rgb, dtype=np.uint8), step, np.arange(labels.size), patch)
    return patch


@njit(cache=True, error_model="numpy")
def _join_colours(labels, rgb, step, parent, patch):  # type: ignore[no-untyped-def]
    """Write the patches (H, W); `parent` (H · W,) is each place's own at first, and then its set's first."""
    width, patches = labels.shape[1], 0
    for place in range(len(parent)):
        row, col = place // width, place % width
        patch[row, col] = -1
        if labels[row, col] == 0:
            continue
        for k in range(2):
            v, u = (row - 1, col) if k == 0 else (row, col - 1)
            if v < 0 or u < 0 or labels[v, u] != labels[row, col]:
                continue
            bright = bright_other = 3.0
            for c in range(3):
                bright += rgb[row, col, c]
                bright_other += rgb[v, u, c]
            square = 0.0
            for c in range(3):
                share, other = (rgb[row, col, c] + 1.0) / bright, (rgb[v, u, c] + 1.0) / bright_other
                square += (share - other) ** 2
            if math.sqrt(square) < step:
                a, b = v * width + u, place
                while parent[a] != a:
                    parent[a] = parent[parent[a]]
                    a = parent[a]
                while parent[b] != b:
                    parent[b] = parent[parent[b]]
                    b = parent[b]
                if a < b:
                    parent[b] = a
                else:
                    parent[a] = b
    for place in range(len(parent)):
        row, col = place // width, place % width
        if labels[row, col] == 0:
            continue
        parent[place] = parent[parent[place]]
        first = parent[place]
        if first == place:
            patch[row, col] = patches
            patches += 1
        else:
            patch[row, col] = patch[first // width, first % width]


def spread_labels(
    labels: Labels, foreground: NDArray[np.bool_], depth: NDArray[np.float32], jump: float, rounds: int
) -> Labels:
    """Bring labels to the foreground pixels without one that lie no depth step from a labelled neighbour.

    In each round a pixel takes the label to its right, then others to their left, below and above.

    Args:
        labels: Label image (H, W), 0 = none.
        foreground: Pixels to label (H, W).
        depth: Readings (H, W) [m].
        jump: Difference in depth beyond which neighbours lie on two surfaces, at 1 m and times z² [m].
        rounds: How often, each a pixel further.

    Returns:
        Label image (H, W).
    """
    labels = labels.copy()
    waiting = np.flatnonzero(foreground & (labels == 0))
    _spread(labels, waiting, np.ascontiguousarray(depth), np.float32(jump), TURNS, rounds)
    return labels


@njit(cache=True)
def _spread(labels, waiting, depth, jump, turns, rounds):  # type: ignore[no-untyped-def]
    """Label the waiting places (N,), which are in ascending order."""
    height, width = labels.shape
    left = len(waiting)
    for turn in range(4 * rounds):
        down, right = turns[turn % 4, 0], turns[turn % 4, 1]
        for step in range(left):
            # Against the direction labels are taken from, so that none moves on in the same turn.
            place = waiting[step] if down + right > 0 else waiting[left - 1 - step]
            row, col = place // width, place % width
            v, u = row + down, col + right
            if v < 0 or v >= height or u < 0 or u >= width or labels[v, u] == 0:
                continue
            z, other = depth[row, col], depth[v, u]
            if abs(z - other) <= jump * z * other:
                labels[row, col] = labels[v, u]
        kept = 0
        for step in range(left):
            place = waiting[step]
            if labels[place // width, place % width] == 0:
                waiting[kept] = place
                kept += 1
        left = kept
