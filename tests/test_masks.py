from __future__ import annotations

import numpy as np
import pytest

from caryatid.config import MaskConfig
from caryatid.errors import InputError
from caryatid.sensing.masks import labels_from_masks
from caryatid.sensing.views import View

LEAST = 200 * 640 * 480 // 60**2
"""Minimum of a mask that is 200 pixels in an image of 60 × 60."""


def square(first, last, size=60):
    mask = np.zeros((size, size), dtype=bool)
    mask[first:last, first:last] = True
    return mask


def test_the_smallest_mask_is_on_top_in_whatever_order():
    large, small = square(5, 40), square(10, 30)
    for masks, on_top, below in (([large, small], 2, 1), ([small, large], 1, 2)):
        labels = labels_from_masks(masks)
        assert labels.dtype == np.int32
        assert labels[20, 20] == on_top
        assert labels[6, 6] == below
        assert labels[50, 50] == 0


def test_background_crumbs_and_doubtful_masks_are_left_out():
    masks = [square(0, 60), square(0, 5), square(5, 30), square(32, 55)]
    labels = labels_from_masks(masks, [0.9, 0.9, 0.9, 0.3], MaskConfig(LEAST, min_score=0.5))
    assert np.unique(labels).tolist() == [0, 3]


def test_what_is_nearly_the_same_nearly_covered_too_small_or_nothing_is_left_out():
    masks = [square(5, 30), square(5, 31)]
    assert np.unique(labels_from_masks(masks, [0.7, 0.9])).tolist() == [0, 2]
    assert np.unique(labels_from_masks(masks)).tolist() == [0, 1]
    cover = square(5, 30)
    low, high = cover.copy(), cover.copy()
    low[:18], high[17:] = False, False
    labels = labels_from_masks([cover, low, high], config=MaskConfig(LEAST))
    assert np.unique(labels).tolist() == [0, 2, 3]
    for size, kept in ((60, True), (600, False)):
        mask = np.zeros((1, size, size), dtype=bool)
        mask[:, :10, :10] = True
        assert labels_from_masks(mask).any() == kept
    assert not labels_from_masks(np.zeros((0, 60, 60), dtype=bool)).any()


def test_of_overlapping_scores_the_largest_is_on_top():
    """Columns 22 to 27 are in both, where the second is surer; a pixel below one half is in neither."""
    scores = np.zeros((2, 60, 60))
    scores[0, :, 5:28], scores[1, :, 22:45], scores[1, :, 45:] = 0.7, 0.8, 0.4
    labels = labels_from_masks(scores)
    assert labels[30, [4, 5, 21, 22, 44, 45]].tolist() == [0, 1, 1, 2, 2, 0]
    view = View(np.ones((60, 60)), np.array([[60.0, 0, 30], [0, 60, 30], [0, 0, 1]]), labels=scores)
    np.testing.assert_array_equal(view.labels, labels)
    assert view.labels_are == "segments"


@pytest.mark.parametrize(
    ("masks", "scores", "what"),
    [
        ([], None, "shape"),
        (square(5, 30), None, "shape"),
        ([square(5, 30), square(5, 30, size=50)], None, "size"),
        ([square(5, 30) * 7], None, "threshold"),
        ([square(5, 30)], [0.5, 0.6], "scores"),
        ([square(5, 30)], [np.nan], "scores"),
    ],
)
def test_bad_masks_are_errors_that_say_so(masks, scores, what):
    with pytest.raises(InputError, match=what):
        labels_from_masks(masks, scores)
