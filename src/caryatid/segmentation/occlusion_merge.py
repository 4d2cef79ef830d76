"""Parts of one object that a view shows apart: cut by something nearer, or by a flaw of the depth image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from caryatid.config import FitConfig, SegmentationConfig
from caryatid.fitting.primitives import Fit, Oriented, candidates
from caryatid.geometry.shapes import Primitives, Shape
from caryatid.geometry.transforms import Array
from caryatid.segmentation.colour_cut import two_colours
from caryatid.segmentation.concavity import hollowness
from caryatid.segmentation.lccp import convex_together
from caryatid.segmentation.occlusion_gaps import hidden_gaps
from caryatid.segmentation.samples import Samples

Labels = NDArray[np.int32]
Mask = NDArray[np.bool_]

COMPARED = 60
"""Samples of a part, about, that are compared with another's [1]; bounds time."""


def rejoin(
    samples: Samples,
    part: Labels,
    config: SegmentationConfig,
    fit_config: FitConfig,
    rng: np.random.Generator,
) -> Labels:
    """Join parts that one shape explains as well as each alone.

    The inside of a bowl belongs to the outside whose rim it ends at. Other parts are looked at in pairs: when
    a nearer surface hides what would lie between them, or when one is small and touches the other. They are
    one object when neither rises above the other's tangent planes, a single shape explains as many samples
    of both as the shape of each does, and that shape fills no space seen empty. Two parts that are plainly of
    two colours are two objects.

    Args:
        samples: Samples N of a view.
        part: Part of each (N,), 0 = none.
        config: Tolerances.
        fit_config: Limits of the shapes.
        rng: Draws the samples of the fits.

    Returns:
        The parts (N,) with the number of the larger where two were joined.
    """
    part = _insides_joined(samples, part, config)
    inverse_depth = _inverse_depth(samples, part > 0)
    quick = replace(
        fit_config, hypotheses=config.rejoin_hypotheses, polish=1, max_points=config.rejoin_points
    )
    fits: dict[tuple[int, ...], Fit | None] = {}
    refused: set[tuple[int, int]] = set()
    while True:
        pairs = [pair for pair in _pairs(samples, part, inverse_depth, config) if pair not in refused]
        pairs = [pair for pair in pairs if _may_be_one(samples, part, pair, config)]
        asked = [key for pair in pairs for key in ((pair[0],), (pair[1],), pair)]
        needed = [key for key in dict.fromkeys(asked) if key not in fits]
        found = _fits(samples, [np.isin(part, key) for key in needed], quick, rng)
        fits.update(zip(needed, found, strict=True))
        for small, large in pairs:
            alone = [(part == number, fits[number,]) for number in (small, large)]
            if _is_one(fits[small, large], alone, samples, config):
                break
            refused.add((small, large))
        else:
            return part
        part[part == small] = large
        refused = {pair for pair in refused if large not in pair}
        joint = {(large,): fits[small, large]}
        fits = {key: fit for key, fit in fits.items() if large not in key} | joint


def _insides_joined(samples: Samples, part: Labels, config: SegmentationConfig) -> Labels:
    """Give each hollow part to the neighbour with the longest common border whose top is as high."""
    joined, count = part.copy(), int(part.max(initial=0)) + 1
    hollow = np.zeros(count, dtype=bool)
    for number in range(1, count):
        hollow[number] = hollowness(samples.patch(part == number)) > config.hollow
    if not hollow.any():
        return joined
    top = np.array([np.quantile(samples.height[part == k], 0.95) if k else 0.0 for k in range(count)])
    for number in np.flatnonzero(hollow).tolist():
        image = samples.image(joined)
        around = ndimage.binary_dilation(samples.image(part) == number, np.ones((3, 3)), iterations=2)
        border = np.bincount(image[around], minlength=count)
        border[hollow | (np.abs(top - top[number]) >= config.rim)] = 0
        border[0] = 0
        if border.max() >= config.rejoin_votes:
            joined[part == number] = np.argmax(border)
    return joined


def _inverse_depth(samples: Samples, own: Mask) -> Array:
    """1/z (H, W) [1/m] of all that is seen, 0 = no reading; of the parts' samples as they are evened out."""
    inverse_depth = np.zeros(samples.depth.shape)
    np.divide(1.0, samples.depth, out=inverse_depth, where=samples.depth > 0.0)
    places = samples.places.copy()
    places[places] = own
    inverse_depth[places] = 1.0 / samples.points_camera[own, 2]
    return inverse_depth


def _pairs(
    samples: Samples, part: Labels, inverse_depth: Array, config: SegmentationConfig
) -> list[tuple[int, int]]:
    """Pairs (small, large) of parts that may be one, the best connected first."""
    image, sizes = samples.image(part), np.bincount(part)
    own = part > 0
    usual = float(np.median(samples.points_camera[own, 2])) if own.any() else 1.0
    longest = int(config.rejoin_gap * samples.K[0, 0] / usual)
    votes = hidden_gaps(image, inverse_depth, config.edge_jump, longest)
    votes[votes < config.rejoin_votes] = 0
    touching = _touching(image, len(sizes))
    small = np.minimum(sizes[:, None], sizes) < config.rejoin_share * (sizes[:, None] + sizes)
    votes += np.where(small & (touching >= config.rejoin_votes), touching, 0)
    first, second = np.nonzero(np.triu(votes[1:, 1:], k=1))
    order = np.argsort(-votes[first + 1, second + 1], kind="stable")
    pairs = ((int(first[k]) + 1, int(second[k]) + 1) for k in order)
    return [(a, b) if (sizes[a], b) < (sizes[b], a) else (b, a) for a, b in pairs]


def _touching(image: Labels, count: int) -> NDArray[np.intp]:
    """Samples (n+1, n+1) along which two parts touch in the image."""
    votes = np.zeros(count * count, dtype=np.intp)
    for here, there in ((image[:, :-1], image[:, 1:]), (image[:-1], image[1:])):
        across = (here > 0) & (there > 0) & (here != there)
        votes += np.bincount(here[across] * count + there[across], minlength=count * count)
    table = votes.reshape(count, count)
    return table + table.T


def _may_be_one(samples: Samples, part: Labels, pair: tuple[int, int], config: SegmentationConfig) -> bool:
    """Whether hardly a sample of one part rises above the planes of the other, nor their colours differ."""
    own = [np.flatnonzero(part == number) for number in pair]
    first, second = (samples.patch(index[:: max(1, len(index) // COMPARED)]) for index in own)
    if not convex_together(first, second, config.rejoin_concave, config):
        return False
    if samples.rgb is None:
        return True
    colours = samples.rgb[samples.places]
    return not two_colours(colours[own[0]], colours[own[1]], config)


def _fits(
    samples: Samples, masks: list[Mask], config: FitConfig, rng: np.random.Generator
) -> list[Fit | None]:
    """The best shape for each choice (N,) of samples, each from a generator of its own."""
    parts = [Oriented(samples.points_camera[own], samples.normals_camera[own]) for own in masks]
    rngs = [np.random.default_rng(seed) for seed in rng.integers(2**63, size=len(masks))]
    return [found[0] if found else None for found in candidates(parts, config=config, rngs=rngs)]


def _is_one(
    joint: Fit | None, alone: list[tuple[Mask, Fit | None]], samples: Samples, config: SegmentationConfig
) -> bool:
    """Whether a shape explains about as many samples of each part as its own and fills nothing seen empty."""
    if joint is None or _seen_empty(joint.shape, samples) > config.rejoin_empty:
        return False
    return all(
        fit is not None
        and _explained(joint.shape, samples, own, config)
        >= _explained(fit.shape, samples, own, config) - config.rejoin_loss
        for own, fit in alone
    )


def _explained(shape: Shape, samples: Samples, own: Mask, config: SegmentationConfig) -> float:
    """Share of a part's samples that lie at a shape and face as it does."""
    distance, outward = Primitives.of([shape]).gradient(0, samples.points_camera[own])
    cosine = np.sum(outward * samples.normals_camera[own], axis=1)
    return float(((np.abs(distance) < config.rejoin_distance) & (cosine > config.rejoin_cosine)).mean())


def _seen_empty(shape: Shape, samples: Samples) -> float:
    """Share of the shape's faces towards the camera behind which the camera saw something."""
    points, outward = shape.surface(0.01)
    facing = np.einsum("ij,ij->i", points, outward) < 0.0
    points = points[facing & (points[:, 2] > 0.0)]
    u, v = np.rint((points @ samples.K.T)[:, :2] / points[:, 2:]).astype(np.intp).T
    height, width = samples.depth.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    if not inside.any():
        return 1.0
    depth = samples.depth[v[inside], u[inside]]
    return float((depth > points[inside, 2] + 0.02).mean())
