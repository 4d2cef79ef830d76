"""How far extracted and true objects overlap, as volumes or as masks, and which is which."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from caryatid.errors import InputError
from caryatid.geometry.transforms import Array
from caryatid.sensing.views import SUPPORT_LABEL


@dataclass(frozen=True, eq=False, slots=True)
class TrueObject:
    """A solid whose inside can be asked for.

    Attributes:
        name: Body name, or `object<obj_id>`.
        contains: Which of the points (N, 3) [m], world frame, lie inside: (N,) bool.
        aabb_world: Lowest and highest corner (2, 3) [m] of a world-aligned box around it.
    """

    name: str
    contains: Callable[[Array], NDArray[np.bool_]]
    aabb_world: Array


def volume_ious(
    found: Sequence[TrueObject], true: Sequence[TrueObject], samples: int, rng: np.random.Generator
) -> Array:
    """Intersection over union (F, T) of solids by Monte Carlo.

    Only pairs whose boxes overlap are measured, each with points drawn evenly from the box around both.

    Args:
        found: F solids.
        true: T solids.
        samples: Points a pair; 10,000 give 0.01 in the worst case (σ).
        rng: Draws them.
    """
    iou = np.zeros((len(found), len(true)))
    for i, a in enumerate(found):
        for j, b in enumerate(true):
            low = np.maximum(a.aabb_world[0], b.aabb_world[0])
            high = np.minimum(a.aabb_world[1], b.aabb_world[1])
            if (low >= high).any():
                continue
            start = np.minimum(a.aabb_world[0], b.aabb_world[0])
            end = np.maximum(a.aabb_world[1], b.aabb_world[1])
            points_world = rng.uniform(start, end, size=(samples, 3))
            in_a, in_b = a.contains(points_world), b.contains(points_world)
            union = int(np.count_nonzero(in_a | in_b))
            iou[i, j] = np.count_nonzero(in_a & in_b) / union if union else 0.0
    return iou


def mask_ious(
    labels: Sequence[NDArray[np.int32]],
    true_labels: Sequence[NDArray[np.int32]],
    found: Sequence[int],
    true: Sequence[int],
) -> Array:
    """Intersection over union (F, T) of masks, the pixels of all frames pooled.

    Args:
        labels: Label images (H, W), or labels of points (N,).
        true_labels: The true ones, (H, W) or (N,) as those.
        found: F label numbers in `labels`.
        true: T label numbers in `true_labels`; numbers that are no object's match nothing.

    Raises:
        InputError: Images differ in number or size.
    """
    if [a.size for a in labels] != [b.size for b in true_labels]:
        raise InputError(
            "labels",
            f"the run has label images of {[a.shape for a in labels]}, the truth of "
            f"{[b.shape for b in true_labels]}",
            "give the truth of the frames the run was made from",
        )
    intersection = np.zeros((len(found) + 1, len(true) + 1))
    for image, true_image in zip(labels, true_labels, strict=True):
        row, column = _order(image, found), _order(true_image, true)
        counts = np.bincount(row * intersection.shape[1] + column, minlength=intersection.size)
        intersection += counts.reshape(intersection.shape)
    union = intersection.sum(axis=1, keepdims=True) + intersection.sum(axis=0) - intersection
    return (intersection / np.maximum(union, 1.0))[1:, 1:]


def assign(iou: Array, min_iou: float) -> list[tuple[int, int]]:
    """Pair rows with columns one-to-one for the largest sum (Hungarian), then drop pairs below `min_iou`.

    Args:
        iou: (F, T) [1].
        min_iou: Pairs below this are no pairs [1].

    Returns:
        Pairs (row, column), by row.
    """
    rows, columns = linear_sum_assignment(iou, maximize=True)
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if iou[i, j] >= min_iou]


def _order(image: NDArray[np.int32], labels: Sequence[int]) -> NDArray[np.intp]:
    """Position of each pixel's label in `labels`, from 1; 0 where it is none of them."""
    table = np.zeros(SUPPORT_LABEL + 1, dtype=np.intp)
    for position, label in enumerate(labels, start=1):
        if 0 < label < SUPPORT_LABEL:
            table[label] = position
    return table[image.ravel()]
