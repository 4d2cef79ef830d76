from __future__ import annotations

import numpy as np

from caryatid.config import SegmentationConfig
from caryatid.segmentation.colour_cut import cut_by_colour, two_colours

CONFIG = SegmentationConfig()
RED, BLUE = np.array([200, 30, 30], np.uint8), np.array([30, 30, 200], np.uint8)
PART = np.zeros((40, 60), dtype=np.int32)
PART[5:35, 5:55] = 1


def halves(slope=0.0, bulge=0.0):
    """An image red left of a line, or of a bulging one, and blue right of it."""
    v, u = np.mgrid[:40, :60].astype(float)
    border = 30.0 + slope * (v - 20.0) + bulge * ((v - 20.0) / 15.0) ** 2
    return np.where((u < border)[..., None], RED, BLUE)


def test_plain_halves_with_a_straight_border_are_two():
    for slope in (0.0, 0.5, -0.7):
        cut = cut_by_colour(PART, halves(slope), CONFIG)
        assert np.unique(cut).tolist() == [0, 1, 2]
        np.testing.assert_array_equal(cut > 0, PART > 0)
        assert len(np.unique(cut[:, 8])) == len(np.unique(cut[:, 52])) == 2


def test_noise_and_shades_do_not_matter():
    shade = np.linspace(0.6, 1.0, 40)[:, None, None]
    noise = np.random.default_rng(0).normal(scale=2.0, size=(40, 60, 3))
    image = np.clip(halves() * shade + noise, 0, 255).astype(np.uint8)
    assert cut_by_colour(PART, image, CONFIG).max() == 2
    plain = np.clip(np.broadcast_to(RED, (40, 60, 3)) * shade + noise, 0, 255).astype(np.uint8)
    np.testing.assert_array_equal(cut_by_colour(PART, plain, CONFIG), PART)


def test_bent_borders_and_prints_cut_nothing():
    np.testing.assert_array_equal(cut_by_colour(PART, halves(bulge=-22.0), CONFIG), PART)
    printed = halves()
    squares = np.random.default_rng(0).integers(0, 255, size=(8, 12, 3), dtype=np.uint8)
    printed[:, :30] = np.repeat(np.repeat(squares, 5, axis=0), 5, axis=1)[:, :30]
    np.testing.assert_array_equal(cut_by_colour(PART, printed, CONFIG), PART)
    spotted = np.broadcast_to(RED, (40, 60, 3)).copy()
    spotted[15:25, 20:30] = BLUE
    np.testing.assert_array_equal(cut_by_colour(PART, spotted, CONFIG), PART)


def test_parts_of_other_labels_are_left_alone():
    labels = PART.copy()
    labels[5:35, 30:] = np.where(PART[5:35, 30:] > 0, 2, 0)
    np.testing.assert_array_equal(cut_by_colour(labels, halves(), CONFIG), labels)


def test_two_plain_colours_differ_and_shades_of_one_do_not():
    red, blue = np.tile(RED, (50, 1)), np.tile(BLUE, (50, 1))
    assert two_colours(red, blue, CONFIG)
    assert not two_colours(red, red // 2, CONFIG)
    printed = np.random.default_rng(0).integers(0, 255, size=(50, 3), dtype=np.uint8)
    assert not two_colours(red, printed, CONFIG)
