"""What it takes until a scene is known: views and path to a threshold of F1, and F1 over the path.

An episode need not reach a threshold. It then counts as having taken longer than any other, so a median over
episodes is honest as long as more than half reach it, and is "not reached" otherwise; means of what only some
episodes have are never taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caryatid.benchmark.bootstrap import Bootstrap, Estimate
from caryatid.benchmark.records import MEASURES
from caryatid.benchmark.samples import Sample, scene_means
from caryatid.geometry.transforms import Array

ROUNDING = 1e-9
"""A mean this far below a threshold reaches it [1]: what sums of equal figures differ by."""
F1, PATH = MEASURES.index("f1"), MEASURES.index("path")
"""Columns of a sample."""


@dataclass(frozen=True, slots=True)
class Reach:
    """What it takes to reach F1 of a threshold; infinite where it is not reached.

    Attributes:
        threshold: F1 [1].
        share: Share of the episodes that reach it, mean over scenes [1].
        median_views: Median over episodes of the first view that reaches it [1].
        median_path: Median over episodes of the path travelled up to that view [m].
        mean_views: First view after which the mean F1 reaches it [1].
        mean_path: Path at which the curve of mean F1 over mean path first reaches it, straight between
            views [m].
    """

    threshold: float
    share: Estimate
    median_views: float
    median_path: float
    mean_views: float
    mean_path: Estimate


def reach(sample: Sample, threshold: float, bootstrap: Bootstrap) -> Reach:
    """Say what a method takes to reach F1 of a threshold."""
    views, path = first_reach(sample.of("f1"), sample.of("path"), threshold, straight=False)
    shares = bootstrap.means(scene_means(np.isfinite(views).astype(np.float64), sample.keys))
    scenes = len(sample.scenes)
    curve_views, curve_path = reach_of_means(
        bootstrap.means(scene_means(sample.values, sample.keys)), threshold
    )
    return Reach(
        threshold,
        bootstrap.estimate(shares, scenes),
        _median(views),
        _median(path),
        float(curve_views[0]),
        bootstrap.estimate(curve_path, scenes),
    )


def reach_of_means(means: Array, threshold: float) -> tuple[Array, Array]:
    """Views and path [m] (R,) at which curves of mean F1 over mean path reach a threshold.

    Args:
        means: Of every measure (R, V, M), M as in `MEASURES`.
        threshold: F1 [1].
    """
    return first_reach(means[:, :, F1], means[:, :, PATH], threshold, straight=True)


def first_reach(f1: Array, path: Array, threshold: float, *, straight: bool) -> tuple[Array, Array]:
    """First view, and path there, at which curves reach a threshold; infinite where they do not.

    Args:
        f1: After each view (R, V) [1]; NaN where there was none.
        path: Up to each view (R, V) [m].
        threshold: F1 [1].
        straight: F1 runs straight over the path between two views, so that the path may end between them;
            otherwise it holds until the next view.

    Returns:
        Number of the view (R,), from 1, and path (R,) [m].
    """
    if f1.shape[1] == 0:
        return np.full(len(f1), np.inf), np.full(len(f1), np.inf)
    reached = f1 >= threshold - ROUNDING
    index = np.argmax(reached, axis=1)
    rows = np.arange(len(f1))
    end = path[rows, index]
    if straight:
        before = np.maximum(index - 1, 0)
        rise = f1[rows, index] - f1[rows, before]
        share = np.divide(threshold - f1[rows, before], rise, out=np.ones_like(rise), where=rise > 0.0)
        start = path[rows, before]
        end = start + np.clip(share, 0.0, 1.0) * (end - start)
    missed = ~reached.any(axis=1)
    return np.where(missed, np.inf, index + 1.0), np.where(missed, np.inf, end)


def area_over_path(f1: Array, path: Array, budget: float) -> Array:
    """Mean F1 along the path up to a budget (E,) [1]: the area below it, divided by the budget.

    F1 holds from one view to the next, the first from the start and the last to the budget.

    Args:
        f1: After each view (E, V) [1]; NaN after the last view of an episode.
        path: Up to each view (E, V), not descending [m].
        budget: Length of path [m], above 0.
    """
    begins = np.minimum(np.where(np.isfinite(path), path, budget), budget)
    begins[:, :1] = 0.0
    ends = np.concatenate([begins[:, 1:], np.full((len(begins), 1), budget)], axis=1)
    return np.sum(np.where(ends > begins, np.nan_to_num(f1) * (ends - begins), 0.0), axis=1) / budget


def path_budget(samples: list[Sample]) -> float:
    """Median of the methods' mean final paths [m]; 0 where there is no episode or nobody moves.

    Not the smallest: where one method hardly moves, none would be told from the others.
    """
    finals = [
        float(scene_means(np.nanmax(sample.of("path"), axis=1), sample.keys).mean())
        for sample in samples
        if sample.keys
    ]
    return float(np.median(finals)) if finals else 0.0


def _median(values: Array) -> float:
    """Median of values of which some may be infinite; infinite where the middle one, or one of two, is."""
    return float(np.median(values)) if len(values) else np.inf
