"""From the masks of a learned segmenter to a view's label image."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from caryatid.config import MaskConfig
from caryatid.errors import InputError

Masks = NDArray[np.bool_]


def labels_from_masks(
    masks: ArrayLike | Sequence[ArrayLike], scores: ArrayLike | None = None, config: MaskConfig | None = None
) -> NDArray[np.int32]:
    """Make one label image of masks that may overlap, the smallest on top.

    A pixel belongs to a mask of scores if its score is at least 0.5; of overlapping ones the largest wins.
    Left out are masks that are too small, as large as a background, of a low score, or duplicates; of two
    duplicates the one with the better score stays, without scores the first.

    Args:
        masks: N masks (N, H, W), or a sequence of (H, W): true where the object is, or its score in [0, 1].
        scores: The segmenter's confidence in each mask (N,), or None if it gives none.
        config: What is left out.

    Returns:
        Label image (H, W) int32: k where mask k − 1 is on top, 0 where none is.

    Raises:
        InputError: The masks are not a stack of images of one size, or hold values that are neither true and
            false nor scores in [0, 1]; or there is not one finite score per mask.
    """
    config = config or MaskConfig()
    stack, certainty = _stack(masks)
    if len(stack) == 0:
        return np.zeros(stack.shape[1:], dtype=np.int32)
    least = config.min_pixels * stack[0].size / (640 * 480)
    quality = np.full(len(stack), np.inf)
    if scores is not None:
        quality = np.asarray(scores, dtype=np.float64)
        if quality.shape != (len(stack),) or not np.isfinite(quality).all():
            reason = f"have shape {quality.shape} or hold NaN for {len(stack)} masks"
            raise InputError("scores", reason, "give one finite score per mask, or no scores")
    pixels = stack.sum(axis=(1, 2))
    kept = (pixels >= least) & (pixels <= config.max_share * stack[0].size)
    kept &= quality >= config.min_score
    chosen: list[int] = []
    for k in sorted(np.flatnonzero(kept).tolist(), key=lambda k: (-quality[k], k)):
        # Masks of the same object overlap by more.
        if all(_iou(stack[k], stack[other]) <= 0.8 for other in chosen):
            chosen.append(k)
    labels = np.zeros(stack.shape[1:], dtype=np.int32)
    if certainty is None:
        for k in sorted(chosen, key=lambda k: (-pixels[k], k)):
            labels[stack[k]] = k + 1
    elif chosen:
        surest = np.array(chosen)[certainty[chosen].argmax(axis=0)]
        labels = np.where(stack[chosen].any(axis=0), surest + 1, 0).astype(np.int32)
    left = np.bincount(labels.ravel(), minlength=len(stack) + 1)
    labels[left[labels] < least] = 0
    return labels


def _stack(masks: ArrayLike | Sequence[ArrayLike]) -> tuple[Masks, NDArray[np.floating] | None]:
    """The masks (N, H, W), and the scores of their pixels if given."""
    try:
        stack = np.asarray(masks)
    except ValueError:
        raise InputError("masks", "differ in size", "give masks of the size of the depth image") from None
    if stack.ndim != 3 or 0 in stack.shape[1:]:
        raise InputError("masks", f"have shape {stack.shape}", "give a stack (N, H, W); N may be 0")
    if stack.dtype == np.bool_ or np.isin(stack, (0, 1)).all() or np.isin(stack, (0, 255)).all():
        return stack.astype(bool), None
    if not np.issubdtype(stack.dtype, np.floating) or not ((stack >= 0.0) & (stack <= 1.0)).all():
        raise InputError("masks", "neither boolean nor scores in [0, 1]", "threshold them first: masks > 0")
    return stack >= 0.5, stack


def _iou(first: NDArray[np.bool_], second: NDArray[np.bool_]) -> float:
    return float((first & second).sum() / max((first | second).sum(), 1))
