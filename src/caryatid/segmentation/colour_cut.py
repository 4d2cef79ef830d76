"""Colour as weak evidence: it parts what geometry joins only between pieces of one plain colour each."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from caryatid.config import SegmentationConfig
from caryatid.geometry.transforms import Array
from caryatid.segmentation.sample_grid import colour_patches

Labels = NDArray[np.int32]
Colours = NDArray[np.uint8]


def two_colours(first: Colours, second: Colours, config: SegmentationConfig) -> bool:
    """Whether two parts are of one plain colour each, and the two differ; prints and shades say nothing.

    Args:
        first: Colours (N, 3) of one part's samples.
        second: Colours (M, 3) of the other's.
        config: What is plain.
    """
    (mean, spread), (other_mean, other_spread) = _plain(_shares(first)), _plain(_shares(second))
    differ = float(np.linalg.norm(mean - other_mean)) > config.other_colour
    return differ and max(spread, other_spread) < config.plain_colour


def cut_by_colour(labels: Labels, rgb: Colours, config: SegmentationConfig) -> Labels:
    """Cut parts that consist of plainly coloured pieces with straight borders, and of nothing else.

    A printed box has more than that, or borders all over; it stays whole.

    Args:
        labels: Parts (H, W), 1 … n, 0 = none.
        rgb: Colours (H, W, 3).
        config: What is plain, different and straight.

    Returns:
        Parts (H, W); pieces cut off have numbers above n.
    """
    result = labels.copy()
    patch = colour_patches(labels, rgb, config.other_colour / 2.0)
    sizes = np.bincount(patch.ravel() + 1)[1:]
    owner = np.zeros(len(sizes), dtype=np.intp)
    owner[patch[labels > 0]] = labels[labels > 0]
    large, whole_sizes = sizes >= config.min_size, np.bincount(labels.ravel())
    several = np.bincount(owner[large], minlength=len(whole_sizes)) >= 2
    in_pieces = np.bincount(owner[large], sizes[large], minlength=len(whole_sizes))
    for part in np.flatnonzero(several & (in_pieces >= config.plain_share * whole_sizes)):
        mask = labels == part
        pieces = np.flatnonzero(large & (owner == part))
        plain = [_plain(_shares(rgb[mask & (patch == piece)])) for piece in pieces]
        if max(spread for _, spread in plain) > config.plain_colour:
            continue
        whole = np.where(mask, np.where(np.isin(patch, pieces), patch, -1), -2)
        nearest = ndimage.distance_transform_edt(whole < 0, return_distances=False, return_indices=True)
        whole = np.where(mask, whole[tuple(nearest)], -2)
        if not _clean(whole, pieces, [mean for mean, _ in plain], config):
            continue
        for piece in pieces[1:]:
            result[whole == piece] = result.max() + 1
    return result


def _shares(rgb: Colours) -> Array:
    """Shares of red, green and blue (..., 3), which shading leaves as they are."""
    colours = rgb.astype(np.float64) + 1.0
    return colours / colours.sum(axis=-1, keepdims=True)


def _plain(shares: Array) -> tuple[Array, float]:
    """Mean colour (3,) of samples (N, 3), and the usual distance from it."""
    mean = shares.mean(axis=0)
    return mean, float(np.sqrt(np.mean(np.sum((shares - mean) ** 2, axis=-1))))


def _clean(
    whole: NDArray[np.intp], pieces: NDArray[np.intp], colours: list[Array], config: SegmentationConfig
) -> bool:
    """Whether pieces that touch differ in colour, along borders that are straight."""
    for i, first in enumerate(pieces):
        for j, second in enumerate(pieces[:i]):
            border = np.argwhere(ndimage.binary_dilation(whole == first) & (whole == second))
            if len(border) < 3:
                continue
            if np.linalg.norm(colours[i] - colours[j]) <= config.other_colour:
                return False
            bend, length = np.sqrt(np.linalg.eigvalsh(np.cov(border.T)))
            if bend > 1.0 + config.border_bend * length:
                return False
    return True
