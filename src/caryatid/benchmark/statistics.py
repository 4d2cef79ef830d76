"""Statistics of a suite: means over scenes with intervals, paired differences, path to a threshold.

Scenes are the sampled units: the seeds of a scene are averaged first, and the percentile bootstrap (Efron and
Tibshirani 1993, chapter 13) draws scenes. Failed episodes are counted and enter no mean. An episode that
never reaches a threshold counts as longer than any other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from caryatid.benchmark.episodes import MEASURES
from caryatid.benchmark.store import import_pandas
from caryatid.geometry.transforms import Array
from caryatid.graph import DOUBTFUL

if TYPE_CHECKING:
    import pandas as pd

RESAMPLES = 2000
"""Bootstrap resamples of the scenes [1]; the ends of an interval then move by 3 % of its half width."""
CONFIDENCE = 0.95
"""Probability with which an interval covers the true mean [1]."""
THRESHOLDS = (0.94, 0.90)
"""F1 up to which views and path length are reported [1]; the paper's, and one that most methods reach."""
BINS = 10
"""Equal bins of probability in the reliability diagram and the expected calibration error [1]."""
COLUMNS = ("condition", "family", "method", "quantity", "at", "value", "low", "high")
"""Columns of a summary. `family` is empty for all scenes; `at` is the view, threshold or quantile."""
CURVE = ["f1", "path"]

Statistic = tuple[str, float, float, float, float]
"""Quantity, its place, its value and the ends of its interval (NaN if there is none)."""


def summarise(table: pd.DataFrame, *, reference: str, gap: tuple[str, str] | None = None) -> pd.DataFrame:
    """Summarise the episodes of a suite.

    Args:
        table: A row per view and failed episode, as `ResultStore.table` returns it.
        reference: Method the others are compared with.
        gap: Two methods, such as random choice and the oracle; `gap` is the share of the difference of their
            F1 that each other method gains.

    Returns:
        One row per figure with the columns `COLUMNS`. Quantities: every measure (`at`: view), `MEASURE
        difference` from the reference over the scenes and seeds both have, `gap`; `share`, `mean path` and
        `path ratio` (`at`: threshold of F1); `scenes`, `episodes`, `failed`, and `paired scenes`, `paired
        episodes`. Of the supports of all scenes together: `listed brier` of
        those in the graph, `brier gain` of these over doubtful = 0.5, others = 1, `calibration error`, and
        `pooled brier` with those that are missing (`at`: view); and of each bin at each VIEW `reliability
        VIEW`, the share that is true, and `supports VIEW`, how many (`at`: mean probability).

    Raises:
        ValueError: Two episodes of a method have the same scene and seed.
    """
    rows: list[tuple[str | float, ...]] = []
    for condition, part in table.groupby("condition", sort=False):
        families = list(part["family"].unique())
        for family in ("", *(families if len(families) > 1 else ())):
            group = part[part["family"] == family] if family else part
            for method, figure in _compare(group, reference, gap):
                rows.append((str(condition), family, method, *figure))
    summary: pd.DataFrame = import_pandas().DataFrame(rows, columns=list(COLUMNS))
    return summary


def _compare(
    group: pd.DataFrame, reference: str, gap: tuple[str, str] | None
) -> Iterator[tuple[str, Statistic]]:
    """Figures of each method in a group of comparable episodes."""
    done = group[group["error"].isna()]
    wide = done.pivot(index=["method", "scene", "seed"], columns="view", values=list(MEASURES)).astype(float)
    known = {str(method): own.droplevel("method") for method, own in wide.groupby("method")}
    for name, episodes in group.groupby("method", sort=False):
        method = str(name)
        own = known.get(method, wide.droplevel("method").iloc[:0])
        figures = [*_counts(own), _plain("failed", 0.0, episodes["error"].notna().sum())]
        if len(own):
            figures += _alone(own)
            figures += _calibration(episodes.dropna(subset="forecasts"))
            if method != reference and reference in known:
                figures += _against(own, known[reference])
            if gap is not None and method not in gap and set(gap) <= set(known):
                ends = (own, *(known[end] for end in gap))
                closed = bootstrap(
                    [frame["f1"] for frame in ends],
                    lambda f1, low, high: np.where(high == low, np.nan, (f1 - low) / (high - low)),
                )
                figures += _named([("gap", view) for view in own["f1"].columns], closed)
        yield from ((method, figure) for figure in figures)


def bootstrap(frames: Sequence[pd.DataFrame], figures: Callable[..., Array]) -> Array:
    """Figures of means over scenes, with percentile bootstrap intervals.

    Args:
        frames: By scene and seed, with the same number C of columns; only rows in all of them count.
        figures: Returns figures (..., F) for the frames' means (..., C); infinite if a threshold is not
            reached.

    Returns:
        Value, lower and upper end of each figure (F, 3); no ends (NaN) for a single scene, no figures for
        none.
    """
    joined = import_pandas().concat(list(frames), axis=1, join="inner", keys=range(len(frames)))
    scenes = joined.groupby("scene").mean().to_numpy().reshape(-1, len(frames), frames[0].shape[1])
    size = len(scenes)
    if size == 0:
        return np.empty((0, 3))
    with np.errstate(invalid="ignore", divide="ignore"):
        value = figures(*scenes.mean(axis=0))
        if size == 1:
            return np.stack([value, np.full_like(value, np.nan), np.full_like(value, np.nan)], axis=1)
        drawn = np.random.default_rng((0, size)).multinomial(size, np.full(size, 1.0 / size), RESAMPLES)
        means = np.tensordot(drawn / size, scenes, 1)
        # Sorted and picked, not interpolated, because a missing path is infinite.
        resampled = np.sort(figures(*np.moveaxis(means, 1, 0)), axis=0)
    tail = round((1.0 - CONFIDENCE) / 2.0 * (RESAMPLES - 1))
    return np.stack([value, resampled[tail], resampled[-1 - tail]], axis=1)


def _path_to(f1: Array, path: Array, threshold: float) -> Array:
    """Path (…) [m] at which F1 (…, V), straight over the path between two views, reaches a threshold.

    It is infinite if none does.
    """
    reached = f1 >= threshold - 1e-9  # sums of equal figures differ by less
    index = np.argmax(reached, axis=-1)[..., None]
    before = np.maximum(index - 1, 0)
    (start, end), (below, above) = (
        [np.take_along_axis(values, at, -1)[..., 0] for at in (before, index)] for values in (path, f1)
    )
    share = np.divide(threshold - below, above - below, out=np.ones_like(end), where=above > below)
    return np.where(reached.any(axis=-1), start + np.clip(share, 0.0, 1.0) * (end - start), np.inf)


def _plain(quantity: str, at: float, value: float) -> Statistic:
    return quantity, at, float(value), np.nan, np.nan


def _named(names: Iterable[tuple[str, float]], found: Array) -> list[Statistic]:
    return [(name, at, *row) for (name, at), row in zip(names, found.tolist(), strict=False)]


def _counts(own: pd.DataFrame, prefix: str = "") -> Iterator[Statistic]:
    yield _plain(f"{prefix}scenes", 0.0, own.index.unique("scene").size)
    yield _plain(f"{prefix}episodes", 0.0, len(own))


def _alone(own: pd.DataFrame) -> Iterator[Statistic]:
    """Curves of a method, how many episodes reach each threshold, and its path there."""
    means = own.copy()
    f1, path = (own[name].to_numpy() for name in CURVE)
    for threshold in THRESHOLDS:
        means["share", threshold] = np.isfinite(_path_to(f1, path, threshold)).astype(float)
    yield from _named(means.columns, bootstrap([means], lambda figures: figures))
    paths = bootstrap([own[name] for name in CURVE], _paths)
    yield from _named([("mean path", threshold) for threshold in THRESHOLDS], paths)


def _against(own: pd.DataFrame, other: pd.DataFrame) -> Iterator[Statistic]:
    """Paired differences from another method, and the ratio of paths to each threshold."""

    def ratios(f1: Array, path: Array, other_f1: Array, other_path: Array) -> Array:
        # A resample that misses the threshold counts as infinitely far, against the method.
        ours, theirs = _paths(f1, path), _paths(other_f1, other_path)
        return np.where(np.isfinite(ours) & (theirs > 0.0), ours / theirs, np.inf)

    yield from _counts(own[own.index.isin(other.index)], "paired ")
    difference = bootstrap([own, other], lambda ours, theirs: ours - theirs)
    yield from _named([(f"{name} difference", at) for name, at in own.columns], difference)
    found = bootstrap([frame[name] for frame in (own, other) for name in CURVE], ratios)
    # If the other method does not reach it either, its path is infinite, and the ratio 0.
    rows = _named([("path ratio", threshold) for threshold in THRESHOLDS], found)
    yield from (row for row in rows if 0.0 < row[2] < np.inf)


def _calibration(episodes: pd.DataFrame) -> Iterator[Statistic]:
    """Quality of the probabilities of a method's supports."""
    if episodes.empty:
        return
    rows = episodes.set_index(["scene", "seed", "view"])["forecasts"].map(_sums)
    sums = import_pandas().DataFrame(rows.tolist(), index=rows.index).unstack("view")
    views = list(sums[0].columns)

    def figures(means: Array) -> Array:
        """Of mean sums (..., C) the named figures (..., V), and the shares of the bins (..., BINS · V)."""
        sums = means.reshape(*means.shape[:-1], -1, len(views))
        missing, ours, theirs = np.moveaxis(sums[..., :3, :], -2, 0)
        count, said, true = (sums[..., k : k + BINS, :] for k in (3, 3 + BINS, 3 + 2 * BINS))
        listed, error = count.sum(axis=-2), np.abs(said - true).sum(axis=-2)
        pooled = (ours + missing) / (listed + missing)
        shares = (true / count).reshape(*means.shape[:-1], -1)
        return np.concatenate([ours / listed, 1.0 - ours / theirs, error / listed, pooled, shares], axis=-1)

    found = bootstrap([sums], figures)
    names = ("listed brier", "brier gain", "calibration error", "pooled brier")
    yield from _named([(name, view) for name in names for view in views], found)
    count, said = (sums.sum().to_numpy().reshape(-1, len(views))[k : k + BINS] for k in (3, 3 + BINS))
    shares = found[len(names) * len(views) :].reshape(BINS, len(views), 3)
    for k, j in np.argwhere(count > 0.0):
        at = float(said[k, j] / count[k, j])
        yield f"reliability {views[j]}", at, *shares[k, j].tolist()
        yield _plain(f"supports {views[j]}", at, count[k, j])


def _sums(forecasts: Sequence[Sequence[float]]) -> Array:
    """Number of missing supports; both squared errors of the others, and their sums by bin."""
    # Results of earlier versions have a number between the two.
    table = np.array([(p, true) for p, *_, true in forecasts], dtype=np.float64).reshape(-1, 2)
    said, true = table[table[:, 0] > 0.0].T
    bins = np.minimum(BINS * said, BINS - 1).astype(int)
    binned = [np.bincount(bins, of, BINS) for of in (np.ones(len(bins)), said, true)]
    simple = np.where(said <= DOUBTFUL, 0.5, 1.0)
    squares = ((said - true) ** 2).sum(), ((simple - true) ** 2).sum()
    return np.concatenate([[len(table) - len(said), *squares], *binned])


def _paths(f1: Array, path: Array) -> Array:
    """Path (..., T) [m] at which mean curves (..., V) reach each threshold."""
    return np.stack([_path_to(f1, path, threshold) for threshold in THRESHOLDS], axis=-1)
