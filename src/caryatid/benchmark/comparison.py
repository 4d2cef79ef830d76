"""Two methods side by side: paired differences over the scenes and seeds both have."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from caryatid.benchmark.bootstrap import Bootstrap, Estimate
from caryatid.benchmark.records import MEASURES
from caryatid.benchmark.samples import Sample, scene_means
from caryatid.benchmark.thresholds import F1, reach_of_means
from caryatid.geometry.transforms import Array


@dataclass(frozen=True, slots=True)
class Difference:
    """A method minus the method it is compared with, over the scenes and seeds both have.

    Attributes:
        method: Name of the one.
        reference: Name of the other.
        scenes: Scenes both have.
        episodes: Scenes × seeds both have.
        measures: For each measure its mean difference after each view.
        path_ratios: For each threshold, the method's path to it by the reference's, both as
            `Reach.mean_path`; None where one of them does not reach it, or the reference need not move.
    """

    method: str
    reference: str
    scenes: int
    episodes: int
    measures: dict[str, tuple[Estimate, ...]]
    path_ratios: dict[float, Estimate | None]


def compare(
    method: str,
    one: Sample,
    reference: str,
    other: Sample,
    thresholds: tuple[float, ...],
    bootstrap: Bootstrap,
) -> Difference:
    """Compare two methods over the scenes and seeds both have.

    Args:
        method: Label of the one.
        one: Its figures.
        reference: Label of the other.
        other: Its figures.
        thresholds: F1 whose paths are compared.
        bootstrap: Draws scenes anew.
    """
    keys = sorted(set(one.keys) & set(other.keys))
    views = min(one.values.shape[1], other.values.shape[1])
    ours, theirs = (scene_means(s.restrict(keys)[:, :views], keys) for s in (one, other))
    scenes = len(ours)
    drawn = bootstrap.means(ours - theirs)
    measures = {
        name: tuple(bootstrap.estimate(drawn[:, v, m], scenes) for v in range(views) if scenes)
        for m, name in enumerate(MEASURES)
    }
    means = bootstrap.means(ours), bootstrap.means(theirs)
    ratios = {threshold: _path_ratio(*means, threshold, scenes, bootstrap) for threshold in thresholds}
    return Difference(method, reference, scenes, len(keys), measures, ratios)


def closed_gap(one: Sample, low: Sample, high: Sample, bootstrap: Bootstrap) -> tuple[Estimate, ...]:
    """Share of the gap in mean F1 between two methods that a third closes, after each view [1].

    Args:
        one: The method asked about.
        low: What it is to be better than, such as random choice.
        high: What it would have to equal to close the gap, such as the oracle.
        bootstrap: Resamples of the scenes.

    Returns:
        (one − low) / (high − low) after each view all three have, over the scenes and seeds all three have;
        NaN where the gap is 0.
    """
    keys = sorted(set(one.keys) & set(low.keys) & set(high.keys))
    views = min(s.values.shape[1] for s in (one, low, high))
    f1 = [scene_means(s.restrict(keys)[:, :views, F1], keys) for s in (one, low, high)]
    scenes = len(f1[0])
    gain, gap = bootstrap.means(f1[0] - f1[1]), bootstrap.means(f1[2] - f1[1])
    shares = np.divide(gain, gap, out=np.full_like(gain, np.nan), where=gap != 0.0)
    return tuple(bootstrap.estimate(shares[:, v], scenes) for v in range(views) if scenes)


def _path_ratio(
    ours: Array, theirs: Array, threshold: float, scenes: int, bootstrap: Bootstrap
) -> Estimate | None:
    """Ratio of paths; a resample that misses the threshold counts as infinitely far, against the method."""
    _, path = reach_of_means(ours, threshold)
    _, reference = reach_of_means(theirs, threshold)
    if scenes == 0 or not math.isfinite(path[0]) or not 0.0 < reference[0] < math.inf:
        return None
    ratios = np.full_like(path, np.inf)
    np.divide(path, reference, out=ratios, where=np.isfinite(path) & (reference > 0.0))
    return bootstrap.estimate(ratios, scenes)
