"""What a suite's episodes say: means over scenes with intervals, paired differences, path to a threshold.

Scenes are what is sampled: the seeds of a scene are averaged first, and the percentile bootstrap (Efron and
Tibshirani 1993, chapter 13) draws scenes. A failed episode is counted, and is in no mean. An episode that
never reaches a threshold counts as longer than any other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import count
from typing import TYPE_CHECKING, Any

import numpy as np

from caryatid.benchmark.episodes import MEASURES, TIMES
from caryatid.benchmark.store import import_pandas
from caryatid.config import StatisticsConfig
from caryatid.geometry.transforms import Array

if TYPE_CHECKING:
    import pandas as pd

CONFIG = StatisticsConfig()
COLUMNS = ("condition", "family", "method", "quantity", "at", "value", "low", "high")
"""Columns of a summary. `family` is empty for all scenes; `at` is the view, threshold or quantile."""
F1, PATH = MEASURES.index("f1"), MEASURES.index("path")
UNREACHED = 1e12
"""Stands for infinity while percentiles are interpolated."""

Figures = list[tuple[str, float, float, float, float]]
"""Quantity, where it is taken, its value and the ends of its interval (NaN where there is none)."""


def summarise(
    table: pd.DataFrame,
    *,
    reference: str,
    gap: tuple[str, str] | None = None,
) -> pd.DataFrame:
    """Summarise the episodes of a suite.

    Args:
        table: A row per view and failed episode, as `ResultStore.table` returns it.
        reference: Method the others are compared with.
        gap: Two methods, such as random choice and the oracle, of whose gap in F1 it is told how much each
            other method closes.

    Returns:
        One row per figure with the columns `COLUMNS`. Quantities: every measure (`at`: view), `MEASURE
        difference` from the reference over the scenes and seeds both have, `gap`; `share`, `median views`,
        `median path`, `mean views`, `mean path` and `path ratio` (`at`: threshold of F1); `area` under F1
        over the path up to `budget` [m]; `planning` and `perception` [s] (`at`: quantile); `scenes`,
        `episodes`, `failed`, and `paired scenes`, `paired episodes`.
    """
    rows: list[tuple[str | float, ...]] = []
    for condition, part in table.groupby("condition", sort=False):
        families = list(part["family"].unique())
        for kind in ("", *(families if len(families) > 1 else ())):
            group = part[part["family"] == kind] if kind else part
            for method, figures in _compare(group, reference, gap):
                rows += [(condition, kind, method, *figure) for figure in figures]
    summary: pd.DataFrame = import_pandas().DataFrame(rows, columns=list(COLUMNS))
    return summary


def bootstrap(samples: Array, figures: Callable[[Array], Array]) -> Array:
    """Figures of the mean over scenes, with percentile bootstrap intervals.

    Args:
        samples: What is known of each scene (S, ...).
        figures: Makes figures (..., F) of means (...); infinite where a threshold is not reached.

    Returns:
        Value, lower and upper end of each figure (F, 3); no ends (NaN) for a single scene.
    """
    from scipy.stats import bootstrap as resample

    size = len(samples)
    value = figures(samples.mean(axis=0))
    if size < 2:
        return np.stack([value, np.full_like(value, np.nan), np.full_like(value, np.nan)], axis=1)

    def of_resamples(drawn: Array, axis: int) -> Array:
        weights = (drawn[..., None] == np.arange(size)).mean(axis=-2)
        return np.moveaxis(np.minimum(figures(np.tensordot(weights, samples, 1)), UNREACHED), -1, 0)

    with np.errstate(invalid="ignore"):
        found = resample(
            (np.arange(size),), of_resamples, n_resamples=CONFIG.resamples, batch=500, method="percentile",
            confidence_level=CONFIG.confidence, rng=np.random.default_rng((0, size)),
        ).confidence_interval  # fmt: skip
    ends = [np.where(end > 1e-3 * UNREACHED, np.inf, end) for end in (found.low, found.high)]
    return np.stack([value, *ends], axis=1)


def first_reach(f1: Array, path: Array, threshold: float, *, straight: bool) -> tuple[Array, Array]:
    """First view, and path there, at which curves reach a threshold; infinite where they do not.

    Args:
        f1: After each view (..., V) [1].
        path: Up to each view (..., V) [m].
        threshold: F1 [1].
        straight: F1 runs straight over the path between two views; otherwise it holds until the next view.

    Returns:
        Number of the view (...,), from 1, and path (...,) [m].
    """
    reached = f1 >= threshold - 1e-9  # sums of equal figures differ by less
    index = np.argmax(reached, axis=-1)[..., None]
    end = np.take_along_axis(path, index, -1)
    if straight:
        before = np.maximum(index - 1, 0)
        start, below = np.take_along_axis(path, before, -1), np.take_along_axis(f1, before, -1)
        rise = np.take_along_axis(f1, index, -1) - below
        share = np.divide(threshold - below, rise, out=np.ones_like(rise), where=rise > 0.0)
        end = start + np.clip(share, 0.0, 1.0) * (end - start)
    missed = ~reached.any(axis=-1)
    return np.where(missed, np.inf, index[..., 0] + 1.0), np.where(missed, np.inf, end[..., 0])


def area_over_path(f1: Array, path: Array, budget: float) -> Array:
    """Mean F1 along the path up to a budget (E,) [1]; F1 holds from one view to the next.

    Args:
        f1: After each view (E, V) [1].
        path: Up to each view (E, V), not descending [m].
        budget: Length of path [m], above 0.
    """
    begins = np.minimum(path, budget)
    begins[:, 0] = 0.0
    return np.sum(f1 * np.diff(begins, append=budget), axis=1) / budget


def _compare(
    table: pd.DataFrame, reference: str, gap: tuple[str, str] | None
) -> Iterable[tuple[str, Figures]]:
    """Figures of each method in a group of episodes that can be compared."""
    done = table[table["error"].isna()].set_index(["method", "scene", "seed", "view"])[list(MEASURES)]
    if done.index.has_duplicates:
        raise ValueError("two episodes of a method have one scene and seed")
    known = {str(method): own.droplevel("method").sort_index() for method, own in done.groupby("method")}
    lengths = [own["path"].groupby(["scene", "seed"]).last() for own in known.values()]
    budget = float(np.median([path.groupby("scene").mean().mean() for path in lengths])) if known else 0.0
    for method, all_of_it in table.groupby("method", sort=False):
        own = known.get(str(method), done.droplevel("method").iloc[:0])
        failed = int(all_of_it["error"].notna().sum())
        figures = [*_counts(own), ("failed", 0, float(failed), np.nan, np.nan)]
        if len(own):
            figures += _alone(own, budget)
            if method != reference and reference in known:
                figures += _against(_paired([own, known[reference]]))
            if gap is not None and method not in gap and all(end in known for end in gap):
                figures += _gap_closed(_paired([own, *(known[end] for end in gap)]))
        yield str(method), figures


def _counts(own: pd.DataFrame, prefix: str = "") -> Figures:
    """Numbers of scenes and of episodes."""
    scenes, episodes = own.index.unique("scene").size, own.index.droplevel("view").nunique()
    return [
        (f"{prefix}scenes", 0, float(scenes), np.nan, np.nan),
        (f"{prefix}episodes", 0, float(episodes), np.nan, np.nan),
    ]


def _alone(own: pd.DataFrame, budget: float) -> Figures:
    """Curves of a method, its path to each threshold, the area under its F1, its times."""
    curves, keys = _curves([own])[:, 0], own.index.droplevel("view").unique()
    episodes = own.to_numpy().reshape(len(keys), -1, len(MEASURES))
    reaches = [
        first_reach(episodes[..., F1], episodes[..., PATH], threshold, straight=False)
        for threshold in CONFIG.thresholds
    ]
    shares = {
        ("share", t): np.isfinite(seen) for t, (seen, _) in zip(CONFIG.thresholds, reaches, strict=True)
    }
    if budget:
        shares["area", 0.0] = area_over_path(episodes[..., F1], episodes[..., PATH], budget)
    by_scene = import_pandas().DataFrame(shares, index=keys).astype(float).groupby("scene").mean()
    figures = _named(_by_view(""), bootstrap(curves, _flat))
    figures += _named(shares, bootstrap(by_scene.to_numpy(), lambda means: means))
    paths = bootstrap(curves, _paths)
    figures += _named([("mean path", t) for t in CONFIG.thresholds], paths)
    mean = curves.mean(axis=0)
    plain: list[tuple[str, float, Any]] = [("budget", 0.0, budget)]
    for threshold, (seen, length) in zip(CONFIG.thresholds, reaches, strict=True):
        at_mean, _ = first_reach(mean[:, F1], mean[:, PATH], threshold, straight=True)
        plain += [("median views", threshold, np.median(seen)), ("median path", threshold, np.median(length))]
        plain += [("mean views", threshold, at_mean)]
    for name in TIMES:
        chosen = own.index.get_level_values("view") > (1 if name == "planning_seconds" else 0)
        for quantile in (0.025, 0.5, 0.975) if chosen.any() else ():
            seconds = np.quantile(own[name][chosen], quantile)
            plain.append((name.removesuffix("_seconds"), quantile, seconds))
    return figures + [(name, at, float(value), np.nan, np.nan) for name, at, value in plain]


def _against(frames: Sequence[pd.DataFrame]) -> Figures:
    """Paired differences from another method, and the ratio of paths to each threshold."""
    counts = _counts(frames[0], "paired ")
    if len(frames[0]) == 0:
        return counts
    both = _curves(frames)

    def ratios(means: Array) -> Array:
        ours, theirs = (
            _paths(means[..., 0, :, :]),
            _paths(means[..., 1, :, :]),
        )
        # A resample that misses the threshold counts as infinitely far, against the method.
        known = np.isfinite(ours) & (theirs > 0.0)
        return np.divide(ours, theirs, out=np.full_like(ours, np.inf), where=known)

    difference = bootstrap(both, lambda means: _flat(means[..., 0, :, :] - means[..., 1, :, :]))
    theirs = _paths(both.mean(axis=0)[1])
    shown = (theirs > 0.0) & (theirs < np.inf)
    found = _named([("path ratio", t) for t in CONFIG.thresholds], bootstrap(both, ratios))
    told = [row for row, known in zip(found, shown, strict=True) if known and np.isfinite(row[2])]
    return counts + _named(_by_view(" difference"), difference) + told


def _gap_closed(frames: Sequence[pd.DataFrame]) -> Figures:
    """(F1 − that of low) / (F1 of high − that of low) after each view, of three frames: own, low and high."""
    if len(frames[0]) == 0:
        return []

    def closed(means: Array) -> Array:
        own, low, high = np.moveaxis(means, -2, 0)
        return np.divide(own - low, high - low, out=np.full_like(own, np.nan), where=high != low)

    found = bootstrap(_curves(frames)[..., F1], closed)
    return _named([("gap", view) for view in range(1, len(found) + 1)], found)


def _flat(means: Array) -> Array:
    """Means (..., V, M) as figures (..., V·M)."""
    return means.reshape(*means.shape[:-2], -1)


def _paths(means: Array) -> Array:
    """Path (..., T) [m] at which mean curves (..., V, M) reach each threshold."""
    f1, path = means[..., F1], means[..., PATH]
    return np.stack([first_reach(f1, path, t, straight=True)[1] for t in CONFIG.thresholds], axis=-1)


def _by_view(suffix: str) -> Iterable[tuple[str, float]]:
    """Names of the measures of each view, without an end."""
    return ((measure + suffix, view) for view in count(1) for measure in MEASURES)


def _named(names: Iterable[tuple[str, float]], found: Array) -> Figures:
    return [(name, at, *row) for (name, at), row in zip(names, found.tolist(), strict=False)]


def _paired(frames: Sequence[pd.DataFrame]) -> list[pd.DataFrame]:
    """The frames with the scenes and seeds all of them have."""
    keys = [frame.index.droplevel("view") for frame in frames]
    common = keys[0].unique()
    for other in keys[1:]:
        common = common.intersection(other.unique())
    return [frame[key.isin(common)] for frame, key in zip(frames, keys, strict=True)]


def _curves(frames: Sequence[pd.DataFrame]) -> Array:
    """Means over the seeds of each scene (S, frames, V, M), with the views all frames have."""
    means = [frame.groupby(["scene", "view"]).mean() for frame in frames]
    shaped = [m.to_numpy().reshape(m.index.unique("scene").size, -1, len(MEASURES)) for m in means]
    views = min(s.shape[1] for s in shaped)
    return np.stack([s[:, :views] for s in shaped], axis=1)
