"""What a suite's episodes say: means over scenes with intervals, paired differences, path to a threshold.

Scenes are what is sampled: the seeds of a scene are averaged first, and the percentile bootstrap (Efron and
Tibshirani 1993, chapter 13) draws scenes. A failed episode is counted, and is in no mean. An episode that
never reaches a threshold counts as longer than any other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from caryatid.benchmark.episodes import MEASURES, TIMES
from caryatid.benchmark.store import import_pandas
from caryatid.config import StatisticsConfig
from caryatid.geometry.transforms import Array

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = ("condition", "family", "method", "quantity", "at", "value", "low", "high")
"""Columns of a summary. `family` is empty for all scenes; `at` is the view, threshold or quantile."""
QUANTILES = (0.025, 0.25, 0.5, 0.75, 0.975)
F1, PATH = MEASURES.index("f1"), MEASURES.index("path")
SEED = 0
"""Seed of the resamples, so that a result always gives the same figures."""
ROUNDING = 1e-9
"""A mean this far below a threshold reaches it [1]: what sums of equal figures differ by."""
UNREACHED = 1e12
"""Stands for infinity while percentiles are interpolated."""


def summarise(
    table: pd.DataFrame,
    *,
    reference: str,
    gap: tuple[str, str] | None = None,
    config: StatisticsConfig | None = None,
) -> pd.DataFrame:
    """Summarise the episodes of a suite.

    Args:
        table: A row per view and failed episode, as `ResultStore.table` returns it.
        reference: Method the others are compared with.
        gap: Two methods, such as random choice and the oracle, of whose gap in F1 it is told how much each
            other method closes.
        config: Resamples, confidence, thresholds.

    Returns:
        One row per figure with the columns `COLUMNS`. Quantities: every measure (`at`: view), `MEASURE
        difference` from the reference over the scenes and seeds both have, `gap`; `share`, `median views`,
        `median path`, `mean views`, `mean path` and `path ratio` (`at`: threshold of F1); `area` under F1
        over the path up to `budget` [m]; `planning` and `perception` [s] (`at`: quantile); `scenes`,
        `episodes`, `failed`, and `paired scenes`, `paired episodes`.
    """
    config = config or StatisticsConfig()
    rows: list[tuple[Any, ...]] = []
    for condition, part in table.groupby("condition", sort=False):
        families = list(part["family"].unique())
        for kind in ("", *(families if len(families) > 1 else ())):
            chosen = part[part["family"] == kind] if kind else part
            rows += [(condition, kind, *row) for row in _group(chosen, reference, gap, config)]
    summary: pd.DataFrame = import_pandas().DataFrame(rows, columns=list(COLUMNS))
    return summary


def bootstrap(table: Array, figures: Callable[[Array], Array], config: StatisticsConfig) -> Array:
    """Figures of the mean over scenes, with percentile bootstrap intervals.

    Args:
        table: What is known of each scene (S, K).
        figures: Makes figures (..., F) of means (..., K); infinite where a threshold is not reached.
        config: Resamples and confidence.

    Returns:
        Value, lower and upper end of each figure (F, 3); no ends (NaN) for a single scene.
    """
    from scipy.stats import bootstrap as resample

    count = len(table)
    value = figures(table.mean(axis=0))
    if count < 2:
        return np.stack([value, np.full_like(value, np.nan), np.full_like(value, np.nan)], axis=1)

    def of_resamples(drawn: Array, axis: int) -> Array:
        weights = (drawn[..., None] == np.arange(count)).mean(axis=-2)
        return np.moveaxis(np.minimum(figures(weights @ table), UNREACHED), -1, 0)

    with np.errstate(invalid="ignore"):
        found = resample(
            (np.arange(count),), of_resamples, n_resamples=config.resamples, batch=500, method="percentile",
            confidence_level=config.confidence, rng=np.random.default_rng((SEED, count)),
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
    reached = f1 >= threshold - ROUNDING
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
    ends = np.concatenate([begins[:, 1:], np.full((len(begins), 1), budget)], axis=1)
    return np.sum(f1 * (ends - begins), axis=1) / budget


def _group(
    table: pd.DataFrame, reference: str, gap: tuple[str, str] | None, config: StatisticsConfig
) -> list[tuple[Any, ...]]:
    """Figures of the methods that can be compared: (method, quantity, at, value, low, high)."""
    done = table[table["error"].isna()]
    methods: dict[str, pd.DataFrame] = {}
    for method in table["method"].unique():
        own = done[done["method"] == method].set_index(["scene", "seed", "view"])[list(MEASURES)]
        if own.index.has_duplicates:
            raise ValueError(f"two episodes of {method} have one scene and seed")
        methods[method] = own.sort_index()
    finals = [
        own["path"].groupby(["scene", "seed"]).last().groupby("scene").mean().mean()
        for own in methods.values()
        if len(own)
    ]
    budget = float(np.median(finals)) if finals else 0.0
    failed = table[table["error"].notna()]["method"].value_counts()
    rows: list[tuple[Any, ...]] = []
    for method, own in methods.items():
        counted = {
            "scenes": own.index.unique("scene").size,
            "episodes": own.index.droplevel("view").nunique(),
            "failed": failed.get(method, 0),
        }
        found = [(name, 0, float(count), np.nan, np.nan) for name, count in counted.items()]
        if len(own):
            found += _alone(own, budget, config)
            if method != reference and len(methods.get(reference, ())):
                found += _against(own, methods[reference], config)
            if gap is not None and method not in gap and all(len(methods.get(name, ())) for name in gap):
                found += _gap_closed(own, methods[gap[0]], methods[gap[1]], config)
        rows += [(method, *row) for row in found]
    return rows


def _alone(own: pd.DataFrame, budget: float, config: StatisticsConfig) -> list[tuple[Any, ...]]:
    """Curves of a method, its way to each threshold, the area under its F1, its times."""
    curves, keys = _curves([own])[0], own.index.droplevel("view").unique()
    views, thresholds = curves.shape[1], config.thresholds
    episodes = own.to_numpy().reshape(len(keys), -1, len(MEASURES))
    f1, path = episodes[:, :, F1], episodes[:, :, PATH]
    reaches = [first_reach(f1, path, threshold, straight=False) for threshold in thresholds]
    extra = [np.isfinite(seen) for seen, _ in reaches] + (
        [area_over_path(f1, path, budget)] if budget else []
    )
    by_scene = (
        import_pandas().DataFrame(np.stack(extra, axis=1).astype(float), index=keys).groupby("scene").mean()
    )
    size = views * len(MEASURES)

    def figures(means: Array) -> Array:
        curve = means[..., :size].reshape(*means.shape[:-1], views, len(MEASURES))
        reached = [first_reach(curve[..., F1], curve[..., PATH], t, straight=True)[1] for t in thresholds]
        return np.concatenate([means, np.stack(reached, axis=-1)], axis=-1)

    names: list[tuple[str, float]] = [(measure, view) for view in range(1, views + 1) for measure in MEASURES]
    names += [("share", t) for t in thresholds] + ([("area", 0)] if budget else [])
    names += [("mean path", t) for t in thresholds]
    found = bootstrap(np.hstack([curves.reshape(len(curves), -1), by_scene.to_numpy()]), figures, config)
    rows: list[tuple[Any, ...]] = [(*name, *row) for name, row in zip(names, found.tolist(), strict=True)]
    mean = curves.mean(axis=0)
    for threshold, (seen, length) in zip(thresholds, reaches, strict=True):
        at_mean, _ = first_reach(mean[:, F1], mean[:, PATH], threshold, straight=True)
        told = {"median views": np.median(seen), "median path": np.median(length), "mean views": at_mean}
        rows += [(name, threshold, float(value), np.nan, np.nan) for name, value in told.items()]
    rows.append(("budget", 0, budget, np.nan, np.nan))
    for name in TIMES:
        times = own[name] if name == TIMES[1] else own[name][own.index.get_level_values("view") > 1]
        for quantile in QUANTILES if len(times) else ():
            value = float(np.quantile(times, quantile))
            rows.append((name.removesuffix("_seconds"), quantile, value, np.nan, np.nan))
    return rows


def _against(own: pd.DataFrame, other: pd.DataFrame, config: StatisticsConfig) -> list[tuple[Any, ...]]:
    """Paired differences from another method, and the ratio of paths to each threshold."""
    own, other = _paired([own, other])
    counts = own.index.unique("scene").size, own.index.droplevel("view").nunique()
    names = ("paired scenes", "paired episodes")
    rows: list[tuple[Any, ...]] = [
        (n, 0, float(c), np.nan, np.nan) for n, c in zip(names, counts, strict=True)
    ]
    if len(own) == 0:
        return rows
    ours, theirs = _curves([own, other])
    shape = ours.shape[1:]

    def paths(means: Array, threshold: float) -> Array:
        return first_reach(means[..., F1], means[..., PATH], threshold, straight=True)[1]

    def figures(means: Array) -> Array:
        both = means.reshape(*means.shape[:-1], 2, *shape)
        one, two = both[..., 0, :, :], both[..., 1, :, :]
        ratios = []
        for threshold in config.thresholds:
            path, of = paths(one, threshold), paths(two, threshold)
            # A resample that misses the threshold counts as infinitely far, against the method.
            known = np.isfinite(path) & (of > 0.0)
            ratios.append(np.divide(path, of, out=np.full_like(path, np.inf), where=known))
        difference = (one - two).reshape(*means.shape[:-1], -1)
        return np.concatenate([difference, np.stack(ratios, axis=-1)], axis=-1)

    found = bootstrap(np.stack([ours, theirs], axis=1).reshape(len(ours), -1), figures, config).tolist()
    labels = [(f"{measure} difference", view) for view in range(1, shape[0] + 1) for measure in MEASURES]
    rows += [(*label, *row) for label, row in zip(labels, found, strict=False)]
    for threshold, row in zip(config.thresholds, found[len(labels) :], strict=True):
        if np.isfinite(row[0]) and 0.0 < paths(theirs.mean(axis=0), threshold) < np.inf:
            rows.append(("path ratio", threshold, *row))
    return rows


def _gap_closed(
    own: pd.DataFrame, low: pd.DataFrame, high: pd.DataFrame, config: StatisticsConfig
) -> list[tuple[Any, ...]]:
    """(F1 − that of low) / (F1 of high − that of low) after each view, over what all three have."""
    paired = _paired([own, low, high])
    if len(paired[0]) == 0:
        return []
    curves = [c[:, :, F1] for c in _curves(paired)]

    def figures(means: Array) -> Array:
        one, two, three = np.moveaxis(means.reshape(*means.shape[:-1], 3, -1), -2, 0)
        return np.divide(one - two, three - two, out=np.full_like(one, np.nan), where=three != two)

    found = bootstrap(np.hstack(curves), figures, config)
    return [("gap", view, *row) for view, row in enumerate(found.tolist(), start=1)]


def _paired(frames: Sequence[pd.DataFrame]) -> list[pd.DataFrame]:
    """The frames with the scenes and seeds all of them have."""
    keys = [frame.index.droplevel("view") for frame in frames]
    common = keys[0].unique()
    for other in keys[1:]:
        common = common.intersection(other.unique())
    return [frame[key.isin(common)] for frame, key in zip(frames, keys, strict=True)]


def _curves(frames: Sequence[pd.DataFrame]) -> list[Array]:
    """Mean over the seeds of each scene (S, V, M), with the views all frames have."""
    means = [frame.groupby(["scene", "view"]).mean() for frame in frames]
    shaped = [m.to_numpy().reshape(m.index.unique("scene").size, -1, len(MEASURES)) for m in means]
    views = min(s.shape[1] for s in shaped)
    return [s[:, :views] for s in shaped]
