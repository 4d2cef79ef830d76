"""Parts of one object that a view shows apart: cut by something nearer, or by a flaw of the depth image."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from caryatid.config import FitConfig, SegmentationConfig
from caryatid.convexity import concave_share, hollowness
from caryatid.frames import Array
from caryatid.kernels.gaps import hidden_gaps
from caryatid.plain_colours import two_colours
from caryatid.primitives import Fit, Oriented, candidates
from caryatid.refine import linearise
from caryatid.shapes import Box, Cylinder, Sphere

Labels = NDArray[np.int32]


@dataclass(frozen=True, eq=False, slots=True)
class Samples:
    """A depth image as segmentation samples it.

    Attributes:
        labels: Part of each sample (H, W), 0 = none.
        points_camera: (H, W, 3) [m].
        normals_camera: Unit normals (H, W, 3).
        height: Over the support surface (H, W) [m].
        depth: Readings (H, W) [m], 0 = none; of all that is seen, not of parts only.
        K: Pinhole matrix (3, 3) of this grid [px].
        rgb: Colours (H, W, 3), or None.
    """

    labels: Labels
    points_camera: Array
    normals_camera: Array
    height: Array
    depth: NDArray[np.float32]
    K: Array
    rgb: NDArray[np.uint8] | None


def rejoin(
    samples: Samples, config: SegmentationConfig, fit_config: FitConfig, rng: np.random.Generator
) -> Labels:
    """Join parts that one shape explains as well as each alone.

    The inside of a bowl belongs to the outside whose rim it ends at. Other parts are looked at in pairs: when
    a nearer surface hides what would lie between them, or when one is small and touches the other. They are
    one object when neither rises above the other's tangent planes, a single shape explains as many samples
    of both as the shape of each does, and that shape fills no space seen empty. Two parts that are plainly of
    two colours are two objects.

    Args:
        samples: The view's parts.
        config: Tolerances.
        fit_config: Limits of the shapes.
        rng: Draws the samples of the fits.

    Returns:
        The parts (H, W) with the label of the larger where two were joined.
    """
    labels = _insides_joined(samples, config)
    quick = replace(
        fit_config, hypotheses=config.rejoin_hypotheses, polish=1, max_points=config.rejoin_points
    )
    fits: dict[int, Fit | None] = {}
    refused: set[tuple[int, int]] = set()

    def fitted(part: int) -> Fit | None:
        if part not in fits:
            fits[part] = _fit(samples, labels == part, quick, rng)
        return fits[part]

    while True:
        for small, large in _pairs(replace(samples, labels=labels), config):
            if (small, large) in refused:
                continue
            refused.add((small, large))
            mine, theirs = labels == small, labels == large
            if not _convex(samples, mine, theirs, config) or (
                samples.rgb is not None and two_colours(samples.rgb[mine], samples.rgb[theirs], config)
            ):
                continue
            alone = fitted(small), fitted(large)
            joint = _fit(samples, mine | theirs, quick, rng)
            if joint is None or alone[0] is None or alone[1] is None:
                continue
            if not _explains(joint, samples, (mine, theirs), (alone[0], alone[1]), config):
                continue
            if _seen_empty(joint.shape, samples) > config.rejoin_empty:
                continue
            labels[mine] = large
            fits[large] = joint
            refused = {pair for pair in refused if large not in pair}
            break
        else:
            return labels


def _insides_joined(samples: Samples, config: SegmentationConfig) -> Labels:
    """Give each hollow part to the neighbour with the longest common border whose top is as high."""
    labels = samples.labels.copy()
    count = int(labels.max(initial=0)) + 1
    masks = [labels == part for part in range(count)]
    hollow = [hollowness(samples.points_camera[m], samples.normals_camera[m]) for m in masks]
    top = np.array([np.quantile(samples.height[m], 0.95) if m.any() else 0.0 for m in masks])
    for part in range(1, count):
        if not hollow[part] > config.hollow:
            continue
        around = ndimage.binary_dilation(masks[part], np.ones((3, 3)), iterations=2) & (labels > 0)
        border = np.bincount(labels[around], minlength=count)
        level = (np.abs(top - top[part]) < config.rim) & ~(np.array(hollow) > config.hollow)
        border[~level] = 0
        border[0] = 0
        if border.max() >= config.rejoin_votes:
            labels[masks[part]] = int(np.argmax(border))
    return labels


def _pairs(samples: Samples, config: SegmentationConfig) -> list[tuple[int, int]]:
    """Pairs (small, large) of parts that may be one, the best connected first."""
    labels = samples.labels
    sizes = np.bincount(labels.ravel())
    inverse_depth = np.zeros(labels.shape)
    np.divide(1.0, samples.depth, out=inverse_depth, where=samples.depth > 0.0)
    own = labels > 0
    inverse_depth[own] = 1.0 / samples.points_camera[own][:, 2]
    usual = float(np.median(samples.points_camera[own][:, 2])) if own.any() else 1.0
    longest = int(config.rejoin_gap * samples.K[0, 0] / usual)
    votes = hidden_gaps(labels, inverse_depth, config.edge_jump, longest)
    votes[votes < config.rejoin_votes] = 0
    touching = _touching(labels, len(sizes))
    small = np.minimum(sizes[:, None], sizes) < config.rejoin_share * (sizes[:, None] + sizes)
    votes += np.where(small & (touching >= config.rejoin_votes), touching, 0)
    first, second = np.nonzero(np.triu(votes[1:, 1:], k=1))
    order = np.argsort(-votes[first + 1, second + 1], kind="stable")
    pairs = ((int(first[k]) + 1, int(second[k]) + 1) for k in order)
    return [(a, b) if (sizes[a], b) < (sizes[b], a) else (b, a) for a, b in pairs]


def _touching(labels: Labels, count: int) -> NDArray[np.intp]:
    """Samples (n+1, n+1) along which two parts touch in the image."""
    votes = np.zeros((count, count), dtype=np.intp)
    for here, there in ((labels[:, :-1], labels[:, 1:]), (labels[:-1], labels[1:])):
        across = (here > 0) & (there > 0) & (here != there)
        np.add.at(votes, (here[across], there[across]), 1)
    return votes + votes.T


def _fit(
    samples: Samples, mask: NDArray[np.bool_], config: FitConfig, rng: np.random.Generator
) -> Fit | None:
    part = Oriented(samples.points_camera[mask], samples.normals_camera[mask])
    (fits,) = candidates([part], config=config, rngs=[rng])
    return fits[0] if fits else None


def _convex(
    samples: Samples, first: NDArray[np.bool_], second: NDArray[np.bool_], config: SegmentationConfig
) -> bool:
    """Whether hardly a sample of one part rises above the tangent planes of the other."""
    patches = _thinned(samples, first), _thinned(samples, second)
    return concave_share(*patches, config) <= config.rejoin_concave


def _thinned(samples: Samples, mask: NDArray[np.bool_]) -> tuple[Array, Array]:
    chosen = np.flatnonzero(mask)
    chosen = chosen[:: max(1, len(chosen) // 60)]
    return samples.points_camera.reshape(-1, 3)[chosen], samples.normals_camera.reshape(-1, 3)[chosen]


def _explains(
    joint: Fit,
    samples: Samples,
    masks: tuple[NDArray[np.bool_], NDArray[np.bool_]],
    alone: tuple[Fit, Fit],
    config: SegmentationConfig,
) -> bool:
    """Whether a shape explains nearly as many samples of each part as the part's own shape does."""
    return all(
        _explained(joint.shape, samples, mask, config)
        >= _explained(own.shape, samples, mask, config) - config.rejoin_loss
        for mask, own in zip(masks, alone, strict=True)
    )


def _explained(
    shape: Box | Cylinder | Sphere, samples: Samples, mask: NDArray[np.bool_], config: SegmentationConfig
) -> float:
    """Share of a part's samples that lie at a shape and face as it does."""
    distance, J = linearise(shape, samples.points_camera[mask])
    outward = -J[:, :3] @ shape.T_world_object[:3, :3].T
    cosine = np.sum(outward * samples.normals_camera[mask], axis=1)
    return float(((np.abs(distance) < config.rejoin_distance) & (cosine > config.rejoin_cosine)).mean())


def _seen_empty(shape: Box | Cylinder | Sphere, samples: Samples) -> float:
    """Share of the shape's faces towards the camera behind which the camera saw something."""
    points, outward = shape.surface(0.01)
    facing = np.einsum("ij,ij->i", points, outward) < 0.0
    points = points[facing & (points[:, 2] > 0.0)]
    u, v = np.rint((points @ samples.K.T)[:, :2] / points[:, 2:]).astype(np.intp).T
    height, width = samples.labels.shape
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    if not inside.any():
        return 1.0
    depth = samples.depth[v[inside], u[inside]]
    return float((depth > points[inside, 2] + 0.02).mean())
