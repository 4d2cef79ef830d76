"""Compiled search for parts of one image that go on behind something nearer, beside its plain reference."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from caryatid.geometry.transforms import Array

EDGE = 2
"""Pixels at either end of a gap whose readings mix both sides and say nothing [px]."""


def hidden_gaps(
    labels: NDArray[np.int32], inverse_depth: Array, jump: float, longest: int
) -> NDArray[np.intp]:
    """Count the rows and columns on which one part ends, another begins, and all between lies nearer.

    Between, each reading must lie nearer than the line from end to beginning by the jump; a pixel without
    one says nothing, but one at least must be nearer.

    Args:
        labels: Parts (H, W), 1 … N, 0 = none.
        inverse_depth: 1/z (H, W) [1/m], 0 = no reading.
        jump: How much nearer [1/m].
        longest: Gaps longer than this are not looked over [px].

    Returns:
        Counts (N + 1, N + 1), symmetric; row and column 0 are empty.
    """
    labels, inverse_depth = np.asarray(labels, np.int32), np.asarray(inverse_depth, np.float64)
    votes = np.zeros((int(labels.max(initial=0)) + 1,) * 2, dtype=np.intp)
    for image, depth in ((labels, inverse_depth), (labels.T, inverse_depth.T)):
        _count(np.ascontiguousarray(image), np.ascontiguousarray(depth), jump, longest, votes)
    return votes + votes.T


def hidden_gaps_reference(
    labels: NDArray[np.int32], inverse_depth: Array, jump: float, longest: int
) -> NDArray[np.intp]:
    """Do as `hidden_gaps` does, gap by gap."""
    votes = np.zeros((int(labels.max(initial=0)) + 1,) * 2, dtype=np.intp)
    for image, depth in ((labels, inverse_depth), (labels.T, inverse_depth.T)):
        for row, w in zip(image, depth, strict=True):
            ends = [i for i in range(len(row) - 1) if row[i] > 0 and row[i + 1] != row[i]]
            starts = [j for j in range(1, len(row)) if row[j] > 0 and row[j - 1] != row[j]]
            for i in ends:
                later = [j for j in starts if j > i + 1 and j - i - 1 <= longest and row[j] != row[i]]
                for j in later:
                    between = np.arange(i + 1, j)
                    line = w[i] + (w[j] - w[i]) * (between - i) / (j - i)
                    nearer = w[i + 1 : j] > line + jump
                    inner = (between - i > EDGE) & (j - between > EDGE)
                    seen = (w[i + 1 : j] > 0.0) & inner
                    if nearer.any() and (nearer | ~seen).all():
                        votes[row[i], row[j]] += 1
                        break
    return votes + votes.T


@njit(cache=True)
def _count(labels, inverse_depth, jump, longest, votes):  # type: ignore[no-untyped-def]
    height, width = labels.shape
    for row in range(height):
        for i in range(width - 1):
            part = labels[row, i]
            if part == 0 or labels[row, i + 1] == part:
                continue
            for j in range(i + 2, min(i + longest + 2, width)):
                other = labels[row, j]
                if other == 0 or other == part or labels[row, j - 1] == other:
                    continue
                slope = (inverse_depth[row, j] - inverse_depth[row, i]) / (j - i)
                hidden, some = True, False
                for k in range(i + 1, j):
                    here = inverse_depth[row, k]
                    nearer = here > inverse_depth[row, i] + slope * (k - i) + jump
                    some = some or nearer
                    if here > 0.0 and not nearer and k - i > EDGE and j - k > EDGE:
                        hidden = False
                        break
                if hidden and some:
                    votes[part, other] += 1
                    break
