"""Automatic segmentation: convex segments on the support surface, merged by a network's affinities."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from caryatid.config import CloudConfig, FitConfig, SegmentationConfig
from caryatid.fitting.primitives import Fit, candidates
from caryatid.geometry.shapes import Primitives, Shape
from caryatid.geometry.transforms import Array
from caryatid.runtime.parallel import kernel, on_threads
from caryatid.segmentation.affinities import OFFSETS, Odds, affinities
from caryatid.segmentation.insides import MEETING, merge_insides
from caryatid.segmentation.lccp import (
    Borders,
    convex_parts,
    grid_edges,
    number_by_appearance,
    summed,
    wide_parts,
)
from caryatid.segmentation.samples import Labels, Samples, take_samples
from caryatid.segmentation.seams import GAP, Pairs, cut_at_seams, divided, find_seams
from caryatid.segmentation.support_plane import Mask, SupportSurface
from caryatid.sensing.views import Cloud, View, depth_behind

SMALLEST = 160
"""Minimum number of samples across an image for the network [1]: it was trained on crops of 192."""
OVER = 0.2
"""Minimum share of a part that is over the surface that it stands on [1]."""
PLAIN = 0.02
"""How much the shares of red, green and blue differ on an object of one colour [1]."""


def segment(
    view: View,
    surface: SupportSurface,
    foreground: Mask,
    elsewhere: Mask,
    config: SegmentationConfig,
    clouds: CloudConfig,
    fit_config: FitConfig,
    rng: np.random.Generator,
) -> tuple[Labels, Pairs]:
    """Cut one view into the segments on a support surface.

    Args:
        view: The view, which has a pose.
        surface: The support surface.
        foreground: Its pixels (H, W) of what may stand on it.
        elsewhere: Its pixels (H, W) of what may stand on other surfaces.
        config: Sampling, sizes and angles.
        clouds: Working range and normals.
        fit_config: Limits of the shapes that parts of one object are merged by.
        rng: Draws the samples of their fits.

    Returns:
        Label image (H, W): parts 1 … n, 0 = nothing and the surface itself. Pairs (P, 2) of parts with a seam
        between them, which are two bodies whatever shape they make together.
    """
    labels, apart = np.zeros(view.depth.shape, dtype=np.int32), np.empty((0, 2), dtype=np.int32)
    foreground = foreground & (view.depth >= clouds.min_depth) & (view.depth <= clouds.max_depth)
    if not foreground[:: config.stride, :: config.stride].any():
        return labels, apart
    samples = take_samples(view, foreground, surface, config, clouds)
    points, normals = samples.points_camera, samples.normals_camera
    up = surface.normal_world @ view.pose[:3, :3]
    edges, steps = grid_edges(samples.places, points, normals, config.edge_jump)
    odds = borders = None
    if view.depth.shape[1] >= SMALLEST * config.stride:
        eye = view.pose[None, :3, 3]
        odds = affinities(samples.depth, samples.rgb, samples.K, up, float(surface.height(eye)[0]))
        borders = partial(affinity_borders, samples, odds, config.alike)
    part = convex_parts(points, normals, edges, config, steps, borders)
    wide = wide_parts(samples.image(part))
    # Something beside the surface or in the room behind is not an object on it; nor is a wall at its edge,
    # which begins where the readings of the surface end. Of a board that a weight holds, all may be outside.
    over = surface.pixels_over(view, 0.0, np.inf, -surface.core.size, core=True)[samples.grid][samples.places]
    proper = wide[part]
    part = np.where(proper, part, 0)
    overhang = find_overhangs(samples, part, over, -config.margin * up, 2.0 * config.edge_jump)[part]
    part = _with_share(part, over | overhang, OVER)
    uncut, width = samples.image(part), GAP // config.stride
    if view.rgb is not None and samples.rgb is not None:
        least, seam = config.min_area / samples.spacing**2, find_seams(view.rgb, samples.grid)
        facing = np.zeros((*uncut.shape, 3))
        facing[samples.places] = normals
        part = cut_at_seams(uncut, facing, seam, width, least)[samples.places]
        part = cut_by_colour(samples.image(part), samples.rgb, least)[samples.places]
    low = surface.pixels_over(view, -config.clearance, config.clearance, config.margin)
    part, inside = merge_insides(samples, part, low[samples.grid], np.count_nonzero(low) / config.stride**2)
    if odds is not None:
        part = _with_share(part, overhang | (odds[-1][samples.places] > 0.0), 0.5)
    part = merge_occluded(samples, part, config, fit_config, rng)
    labels[samples.grid] = image = samples.image(part)
    if view.rgb is not None:
        apart = divided(image, uncut, facing, seam, width)
    around = tuple(slice(side.start, side.stop) for side in samples.grid)
    jump, rounds = np.float32(2.0 * config.edge_jump), 2 * config.stride
    waiting = foreground[around] & (labels[around] == 0)
    left_out = samples.image((proper & (part == 0)).astype(np.int32)) > 0
    waiting &= ~_enlarged(left_out, config.stride, waiting.shape)
    _spread_labels(labels[around], np.flatnonzero(waiting), view.depth[around], jump, rounds)
    # The bottom of a bowl is as low as the surface's own readings, and its walls go down to it; past a
    # handle the camera sees the surface itself.
    bottom = _enlarged(np.append(part, np.int32(0))[inside], config.stride, waiting.shape)
    bottom_mask = low[around] & (labels[around] == 0) & (bottom > 0)
    hollow = np.where(np.isin(labels[around], np.unique(bottom)), labels[around], np.int32(0))
    _spread_labels(hollow, np.flatnonzero(bottom_mask), view.depth[around], jump, max(hollow.shape))
    labels[around][bottom_mask] = hollow[bottom_mask]
    # What the margin cuts off goes on: a board may hang over the edge by more.
    beyond = surface.pixels_over(view, config.clearance, config.max_height) & ~foreground & ~elsewhere
    beyond &= (view.depth >= clouds.min_depth) & (view.depth <= clouds.max_depth)
    _spread_labels(labels, np.flatnonzero(beyond), view.depth, jump, max(labels.shape))
    return labels, apart


def find_overhangs(samples: Samples, part: Labels, over: Mask, drop_camera: Array, jump: float) -> Mask:
    """Find which of the parts 0 … n hang over the edge of a surface.

    They continue one that is over the surface, and are open below. A wall, or something beside the surface,
    goes on below; the edge of the surface hides the lower end of what is behind it.

    Args:
        samples: The samples.
        part: Their parts (N,), 0 = none.
        over: Which of them (N,) are over the surface.
        drop_camera: How far below its lower end a part is open (3,) [m].
        jump: Difference of 1/z between surfaces [1/m].
    """
    image, sizes = samples.image(part), np.maximum(np.bincount(part), 1)
    beside = (np.bincount(part, over) / sizes < OVER) & (np.arange(len(sizes)) > 0)
    if not beside.any():
        return beside
    inverse_depth = np.divide(1.0, samples.depth, out=np.zeros(image.shape), where=samples.depth > 0.0)
    meeting = np.zeros(len(sizes), dtype=np.intp)
    for here, there in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        for own, other in ((here, there), (there, here)):
            near = np.abs(inverse_depth[own] - inverse_depth[other]) <= jump
            meets = near & beside[image[own]] & (image[other] > 0) & ~beside[image[other]]
            meeting += np.bincount(image[own][meets], minlength=len(sizes))
    index = np.flatnonzero(beside[part])
    below = samples.points_camera[index] + drop_camera
    column, row = np.rint((below @ samples.K.T)[:, :2] / below[:, 2:]).astype(np.intp).T
    inside = (row >= 0) & (row < image.shape[0]) & (column >= 0) & (column < image.shape[1])
    index, below, place = index[inside], below[inside], (row[inside], column[inside])
    lowest = image[place] != part[index]
    opened = lowest & (1.0 / below[:, 2] - inverse_depth[place] > jump)
    lower, free = (np.bincount(part[index], which, len(sizes)) for which in (lowest, opened))
    return beside & (meeting >= MEETING) & (2.0 * free > lower)


def _enlarged(image: NDArray[Any], stride: int, shape: tuple[int, ...]) -> NDArray[Any]:
    """An image on the grid of samples in the pixels of a view, cut to a shape."""
    return image.repeat(stride, 0).repeat(stride, 1)[: shape[0], : shape[1]]


def _with_share(part: Labels, own: Mask, least: float) -> Labels:
    """Number the parts (N,) of samples of which at least a share is among some samples (N,)."""
    share = np.bincount(part, own) / np.maximum(np.bincount(part), 1)
    return number_by_appearance(np.where((share >= least)[part], part, 0) - 1)


def segment_cloud(cloud: Cloud, surface: SupportSurface, config: SegmentationConfig) -> Labels:
    """Cut an unorganised cloud into the parts that stand on the support surface.

    Returns:
        Label of each point (N,): parts 1 … n, 0 = nothing and the surface itself.
    """
    labels = np.zeros(len(cloud), dtype=np.int32)
    index = np.flatnonzero(
        surface.over(cloud.points_world, config.clearance, config.max_height, config.margin)
    )
    if len(index) < 2:
        return labels
    points = cloud.points_world[index]
    count = min(11, len(index))  # Itself and ten neighbours.
    distance, neighbour = cKDTree(points).query(points, k=count)
    source = np.repeat(np.arange(len(index)), count - 1)
    target, near = neighbour[:, 1:].ravel(), distance[:, 1:].ravel() <= config.reach
    near &= source != target
    (edges,) = summed(np.sort(np.stack([source[near], target[near]], axis=-1), axis=1))
    labels[index] = convex_parts(points, cloud.normals_world[index], edges, config)
    return labels


@kernel
def _spread_labels(labels, waiting, depth, jump, rounds):  # type: ignore[no-untyped-def]
    """Spread labels (H, W) to waiting pixels (N,), ascending, without a depth step from a labelled neighbour.

    In each round a pixel takes the label to its right, then others to their left, below and above, until none
    is left that can. There is a step where depth differs by more than a jump at 1 m, times z² [m].
    """
    height, width = labels.shape
    left = before = len(waiting)
    for turn in range(4 * rounds):
        if turn % 4 == 0:
            if turn > 0 and left == before:
                break
            before = left
        down, right = ((0, 1), (0, -1), (1, 0), (-1, 0))[turn % 4]
        for step in range(left):
            # Against the direction that labels come from, so that none spreads twice in one turn.
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


def cut_by_colour(labels: Labels, rgb: NDArray[np.uint8], min_size: float) -> Labels:
    """Cut parts that consist almost only of pieces of one plain colour each with straight borders.

    This separates flush boxes. A printed box has more colours, or borders all over; it stays whole. Parts
    are an image (H, W), 1 … n, and so are colours (H, W, 3); pieces that are cut off, of at least `min_size`
    pixels, get numbers above n.
    """
    result = labels.copy()
    shares = colour_shares(rgb)
    patch = _colour_patches(labels, shares)
    sizes, part_of = np.bincount(patch.ravel()), np.zeros(int(patch.max()) + 1, dtype=np.int32)
    part_of[patch] = labels
    sizes[0] = 0
    for part, box in enumerate(ndimage.find_objects(labels), 1):
        pieces = np.flatnonzero((part_of == part) & (sizes >= min_size))
        if len(pieces) < 2 or sizes[pieces].sum() < 0.9 * sizes[part_of == part].sum():
            continue
        own, own_patch = labels[box] == part, patch[box]
        colours = {k: shares[box][own_patch == k] for k in pieces.tolist()}
        if max(np.sqrt(colour.var(axis=0).sum()) for colour in colours.values()) > PLAIN:
            continue
        loose = ~np.isin(own_patch, pieces)
        nearest = ndimage.distance_transform_edt(loose, return_distances=False, return_indices=True)
        piece_of = np.where(own, own_patch[tuple(nearest)], -1)
        if _borders_are_clean(piece_of, {k: c.mean(axis=0) for k, c in colours.items()}):
            for piece in pieces[1:]:
                result[box][piece_of == piece] = result.max() + 1
    return result


def colour_shares(rgb: NDArray[np.uint8]) -> Array:
    """Shares of red, green and blue (N, 3) or (H, W, 3) of such colours, which shading does not change."""
    bright = rgb.astype(np.float64) + 1.0
    shares: Array = bright / bright.sum(axis=-1, keepdims=True)
    return shares


def _colour_patches(labels: Labels, shares: Array) -> NDArray[np.intp]:
    """Connected patches (H, W), 1 … n, of one part in which neighbours' colours (H, W, 3) are alike."""
    # A place between two pixels is set if they are connected.
    height, width = labels.shape
    connected = np.zeros((2 * height - 1, 2 * width - 1), dtype=np.bool_)
    connected[::2, ::2] = labels > 0
    down, right = np.s_[1:], np.s_[:, 1:]
    up, left = np.s_[:-1], np.s_[:, :-1]
    for here, there, between in ((down, up, np.s_[1::2, ::2]), (right, left, np.s_[::2, 1::2])):
        step = shares[here] - shares[there]
        alike = np.einsum("hwc,hwc->hw", step, step) < (2.0 * PLAIN) ** 2
        connected[between] = alike & (labels[here] == labels[there]) & (labels[here] > 0)
    return np.asarray(ndimage.label(connected)[0][::2, ::2], dtype=np.intp)


def _borders_are_clean(piece_of: NDArray[np.intp], colours: dict[int, Array]) -> bool:
    """Whether pieces (H, W) that touch differ in colour, along borders that are straight."""
    for first, second in combinations(colours, 2):
        border = np.argwhere(ndimage.binary_dilation(piece_of == second) & (piece_of == first))
        if len(border) < 3:
            continue
        bend, length = np.sqrt(np.linalg.eigvalsh(np.cov(border.T)))
        alike = np.linalg.norm(colours[first] - colours[second]) <= 4.0 * PLAIN
        if alike or bend > 1.0 + length / 4.0:  # Round bodies bend their borders more.
            return False
    return True


def affinity_borders(samples: Samples, odds: Odds, alike: float, owner: NDArray[np.intp]) -> Borders:
    """How much surfels attract each other by the network's affinities.

    Each pair of samples that the network compares attracts, or repels, by its affinity beyond `alike`. The
    owners (N,) are the surfels of the samples, −1 = none.
    """
    image = samples.image((owner + 1).astype(np.int32))
    height, width = image.shape
    pairs, affinity = [np.empty((0, 2), dtype=np.intp)], [np.empty(0)]
    for (down, right), same in zip(OFFSETS, odds, strict=False):
        if down >= height or abs(right) >= width:
            continue
        here = np.s_[: height - down, max(0, -right) : width - max(0, right)]
        there = np.s_[down:, max(0, right) : width + min(0, right)]
        across = (image[here] != image[there]) & (image[here] > 0) & (image[there] > 0)
        both = np.stack([image[here][across], image[there][across]], axis=-1) - 1
        pairs.append(np.sort(both, axis=1))
        affinity.append(np.tanh(same[here][across] / 2.0) - alike)
    joint = np.concatenate(pairs)
    joint, total, number = summed(joint, np.concatenate(affinity), np.ones(len(joint)))
    return joint, total, number


def merge_occluded(
    samples: Samples,
    part: Labels,
    config: SegmentationConfig,
    fit_config: FitConfig,
    rng: np.random.Generator,
) -> Labels:
    """Merge parts of one object that something nearer separates.

    Two parts are one object when a nearer surface hides what would lie between them, neither rises above the
    other's tangent planes, a single shape explains as many samples of both as the shape of each does, and
    that shape fills no space seen empty. Merged parts (N,) of samples get the number of the larger.
    """
    # 1/z [1/m] of the whole view, 0 = no reading; at samples of the parts that of the smoothed points.
    depth, own, places = samples.depth, part > 0, samples.places.copy()
    inverse_depth = np.divide(1.0, depth, out=np.zeros(depth.shape), where=depth > 0.0)
    places[places] = own
    inverse_depth[places] = 1.0 / samples.points_camera[own, 2]
    # Samples are smoothed and hold few outliers.
    quick = replace(fit_config, hypotheses=40, polish=1, max_points=300)
    refused: set[tuple[int, int]] = set()
    while True:
        pairs = [
            pair
            for pair in _hidden_pairs(samples, part, inverse_depth, config)
            if pair not in refused and _convex_together(samples, part, pair, config)
        ]
        asked = list(dict.fromkeys(key for a, b in pairs for key in ((a,), (b,), (a, b))))
        masks = [np.isin(part, key) for key in asked]
        rngs = [np.random.default_rng(seed) for seed in rng.integers(2**63, size=len(masks))]
        found = on_threads(partial(_candidates, samples, masks, rngs, quick), len(masks))
        fits = {key: fits[0] if fits else None for key, fits in zip(asked, found, strict=True)}
        for small, large in pairs:
            alone = [(part == number, fits[number,]) for number in (small, large)]
            if _is_one(fits[small, large], alone, samples):
                break
            refused.add((small, large))
        else:
            return part
        part[part == small] = large
        refused = {pair for pair in refused if large not in pair}


def _candidates(
    samples: Samples, masks: list[Mask], rngs: list[np.random.Generator], config: FitConfig, number: int
) -> list[Fit]:
    """Shapes for the samples under one of the masks."""
    points, normals = samples.points_camera[masks[number]], samples.normals_camera[masks[number]]
    return candidates(points, normals, config=config, rng=rngs[number])


def _hidden_pairs(
    samples: Samples, part: Labels, inverse_depth: Array, config: SegmentationConfig
) -> list[tuple[int, int]]:
    """Pairs (small, large) of parts with something nearer between them, the best connected first."""
    sizes, own, image = np.bincount(part), part > 0, samples.image(part)
    usual = float(np.median(samples.points_camera[own, 2])) if own.any() else 1.0
    longest = int(config.merge_gap * samples.K[0, 0] / usual)
    votes = np.zeros((len(sizes), len(sizes)), dtype=np.intp)
    for sides in ((image, inverse_depth), (image.T, inverse_depth.T)):
        _count_gaps(*map(np.ascontiguousarray, sides), config.edge_jump, longest, votes)
    votes = np.triu(votes + votes.T)
    first, second = np.nonzero(votes >= MEETING)
    order = np.argsort(-votes[first, second], kind="stable")
    pairs = ((int(first[k]), int(second[k])) for k in order)
    return [(a, b) if (sizes[a], b) < (sizes[b], a) else (b, a) for a, b in pairs]


def _convex_together(
    samples: Samples, part: Labels, pair: tuple[int, int], config: SegmentationConfig
) -> bool:
    """Whether almost no sample of one part rises above a tangent plane of the other.

    It may by a height, and by an angle, the error of normals; creases are rounded.
    """
    own = [np.flatnonzero(part == number) for number in pair]
    first, second = (index[:: max(1, len(index) // 60)] for index in own)
    points, normals = samples.points_camera, samples.normals_camera
    between = points[second] - points[first, None]
    over = np.einsum("nmi,ni->nm", between, normals[first])
    under = -np.einsum("nmi,mi->nm", between, normals[second])
    bend = np.sin(np.radians(config.concavity)) * np.linalg.norm(between, axis=-1)
    return float((np.maximum(over, under) > config.rise + bend).mean()) <= 0.1


def _is_one(joint: Fit | None, alone: list[tuple[Mask, Fit | None]], samples: Samples) -> bool:
    """Whether a shape explains each part about as well as its own does, and fills nothing seen empty."""
    if joint is None:
        return False
    # Faces towards the camera that it looked through; edges are frayed.
    behind = depth_behind(joint.shape, samples.depth, samples.K)
    if len(behind) == 0 or float((behind > 0.02).mean()) > 0.1:
        return False
    return all(
        fit is not None and _explained(joint.shape, samples, own) >= _explained(fit.shape, samples, own) - 0.1
        for own, fit in alone
    )


def _explained(shape: Shape, samples: Samples, own: Mask) -> float:
    """Share of a part's smoothed samples that lie within 3σ of a shape and face as it does."""
    distance, outward = Primitives.of([shape]).gradient(0, samples.points_camera[own])
    cosine = np.sum(outward * samples.normals_camera[own], axis=1)
    return float(((np.abs(distance) < 0.006) & (cosine > 0.7)).mean())


@kernel
def _count_gaps(labels, inverse_depth, jump, longest, votes):  # type: ignore[no-untyped-def]
    """Add one for each row on which one part ends, another begins, and all between lies nearer.

    Between, each reading of inverse depth (H, W) [1/m] must lie nearer than the line from end to beginning by
    the jump [1/m]; a pixel without one, 0, does not count, but at least one must be nearer. Two pixels at
    either end of a gap mix both sides. Gaps are at most `longest` pixels wide.
    """
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
                    if here > 0.0 and not nearer and k - i > 2 and j - k > 2:
                        hidden = False
                        break
                if hidden and some:
                    votes[part, other] += 1
                    break
