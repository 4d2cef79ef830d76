"""What page and document say of a suite: its tables, in words, and how figures are meant."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from caryatid.benchmark.bootstrap import Estimate
from caryatid.benchmark.comparison import Difference
from caryatid.benchmark.figures import Figure, draw_figures, table_views
from caryatid.benchmark.statistics import Group, MethodSummary, Spread, Summary
from caryatid.benchmark.words import NONE, say_count, say_estimate, say_number, say_time
from caryatid.config import StatisticsConfig

BY_VIEW = (
    ("f1", "F1", 3),
    ("edge_f1", "F1 of edges", 3),
    ("vertex_f1", "F1 of vertices", 3),
    ("mean_iou", "Mean IoU", 3),
    ("path", "Path over the floor [m]", 2),
)
"""Measures with a column a view: name, heading, digits."""
TAKING = (
    ("unharmed", "Scenes taken apart without harm", 3),
    ("lifts", "Lifts without harm", 3),
)
"""The same of scenes that are taken apart."""
MAIN = ("f1", TAKING[0][0])
"""Measures that are not told beside the main ones."""
AT_THE_END = (
    ("precision", "precision", 3),
    ("recall", "recall", 3),
    ("vertex_precision", "vertex precision", 3),
    ("vertex_recall", "vertex recall", 3),
    ("edge_precision", "edge precision", 3),
    ("edge_recall", "edge recall", 3),
    ("angle", "angle [rad]", 2),
    ("path", "path [m]", 2),
)
"""Measures told after the last view only."""


@dataclass(frozen=True, slots=True)
class SuiteReport:
    """A suite to be told of.

    Attributes:
        name: Its name on the command line.
        what: What it compares, in one sentence.
        summary: What its records say.
        figures: Its figures.
        planned: Episodes it is to have; more than the summary has where it is not finished.
    """

    name: str
    what: str
    summary: Summary
    figures: tuple[Figure, ...]
    planned: int


@dataclass(frozen=True, slots=True)
class Table:
    """One table.

    Attributes:
        title: Heading.
        note: What is to be known to read it.
        head: Headings of the columns; the first is of the row's name.
        rows: Cells.
        strong: Row and column of the cells whose interval excludes 0.
        aside: Whether it is told beside the main ones.
    """

    title: str
    note: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    strong: frozenset[tuple[int, int]] = frozenset()
    aside: bool = False


def report_suite(name: str, what: str, summary: Summary, planned: int | None = None) -> SuiteReport:
    """Draw the figures of a suite, for page and document.

    Args:
        name: Its name on the command line.
        what: What it compares, in one sentence.
        summary: What its records say.
        planned: Episodes it is to have; None for as many as there are.
    """
    number = summary.episodes if planned is None else planned
    return SuiteReport(name, what, summary, draw_figures(summary), number)


def describe(suite: SuiteReport) -> str:
    """Say how much was run, and how much of it failed."""
    summary = suite.summary
    failed = len(summary.failures)
    said = f"{say_count(summary.episodes, 'episode')} of {say_count(len(summary.methods), 'method')} in "
    said += f"{say_count(summary.scenes, 'scene')} with {say_count(summary.seeds, 'seed')}"
    said += f"; {'none failed' if failed == 0 else f'{failed} failed'}."
    missing = suite.planned - summary.episodes
    return (
        f"{said} Not finished: {say_count(missing, 'episode')} of {suite.planned:,} to be run."
        if missing
        else said
    )


def explain(config: StatisticsConfig) -> tuple[str, ...]:
    """Say how the figures are meant, a paragraph each."""
    return (
        "Means are over scenes; the seeds of a scene are averaged first. In brackets: the "
        f"{100.0 * config.confidence:g} % interval of the percentile bootstrap over scenes, "
        f"{config.resamples:,} resamples; a single scene has none. Failed episodes are counted and listed, "
        "and are in no mean. An episode that ends before its last view keeps what it had.",
        "Differences are paired: a method minus the one it is compared with, over the scenes and seeds both "
        "have. Bold: the interval excludes 0.",
        "Until F1 reaches a threshold: the share of the episodes that ever reach it; the median over all "
        "episodes of the first view that does, and of the path up to there. An episode that never does "
        "counts as longer than any other, so the median is “not reached” where half of them do not. “Mean "
        "curve” is where the curve of mean F1 over mean path first reaches it, straight between views; an "
        "end of its interval is “not reached” where that many resamples do not reach it.",
        "F1 along the path: the area under F1 over the path travelled, divided by its length. F1 holds until "
        "the next view. The length is the median of the methods' mean paths; where an episode ends before, "
        "its last F1 holds.",
    )


def tables(group: Group, summary: Summary, *, brief: bool = False) -> tuple[Table, ...]:
    """All tables of a group.

    Args:
        group: Methods that can be compared.
        summary: What it belongs to.
        brief: Leave out what is neither F1 nor edges, and for families what is not F1.
    """
    known = [method for method in group.methods if method.episodes]
    if not known:
        return ()
    rows = [difference for difference in group.differences if difference.scenes]
    if group.taken:
        made = [_by_view(known, group, summary, *measure) for measure in TAKING]
        if rows:
            made.append(_differences(rows, group, summary, *TAKING[0]))
        return tuple(made)
    shown = BY_VIEW[:1] if brief and group.family else BY_VIEW[:2] if brief else BY_VIEW
    made = [_by_view(known, group, summary, *measure) for measure in shown]
    if rows:
        made.append(_differences(rows, group, summary, "f1", "F1", 3))
        if not brief:
            made.append(_differences(rows, group, summary, "path", "Path", 2))
    if group.gaps:
        made.append(_gaps(group, summary))
    made.append(_thresholds(known, rows, summary))
    if not brief:
        made.append(_at_the_end(known))
    made.append(_times(known))
    return tuple(made)


def by_condition(summary: Summary) -> Table | None:
    """F1 of all scenes under each condition, or None where there is but one."""
    groups = summary.conditions
    if len(groups) < 2:
        return None
    views = table_views(summary.config.views, max(group.views for group in groups))
    rows = tuple(
        (
            group.condition,
            method.method,
            *(_at(method.curves["f1"], view, say_estimate) for view in views),
            f"{method.scenes} / {method.episodes} / {method.failed}",
        )
        for group in groups
        for method in group.methods
    )
    head = ("condition", "method", *(f"view {view}" for view in views), "scenes / episodes / failed")
    return Table("F1 by condition", "Mean and interval after so many views.", head, rows)


def failures(summary: Summary) -> Table:
    """The episodes that failed, and why."""
    rows = tuple((f.method, f.condition, f.scene, str(f.seed), f.error) for f in summary.failures)
    return Table("Failed episodes", "", ("method", "condition", "scene", "seed", "error"), rows)


def _by_view(
    methods: Sequence[MethodSummary], group: Group, summary: Summary, measure: str, name: str, digits: int
) -> Table:
    views = table_views(summary.config.views, group.views)
    counts = [f"{method.scenes} / {method.episodes} / {method.failed}" for method in methods]
    rows = tuple(
        (m.method, *(_at(m.curves[measure], v, lambda e: say_estimate(e, digits)) for v in views), count)
        for m, count in zip(methods, counts, strict=True)
    )
    head = ("method", *(f"view {v}" for v in views), "scenes / episodes / failed")
    note = "Mean and interval after so many views."
    return Table(name, note, head, rows, aside=measure not in MAIN)


def _differences(
    rows: Sequence[Difference], group: Group, summary: Summary, measure: str, name: str, digits: int
) -> Table:
    views = [v for v in table_views(summary.config.views, group.views) if v > 1] or [1]
    strong = {
        (r, c)
        for r, difference in enumerate(rows)
        for c, view in enumerate(views, start=1)
        if view <= len(difference.measures[measure]) and difference.measures[measure][view - 1].excludes_zero
    }
    cells = tuple(
        (
            d.method,
            *(_at(d.measures[measure], v, lambda e: say_estimate(e, digits, signed=True)) for v in views),
            f"{d.scenes} / {d.episodes}",
        )
        for d in rows
    )
    unit = " [m]" if measure == "path" else ""
    return Table(
        f"{name} compared with {summary.reference}{unit}",
        "Paired difference and interval; bold where the interval excludes 0.",
        ("method", *(f"view {v}" for v in views), "scenes / episodes"),
        cells,
        frozenset(strong),
        aside=measure not in MAIN,
    )


def _gaps(group: Group, summary: Summary) -> Table:
    assert summary.gap is not None
    low, high = summary.gap
    views = [v for v in table_views(summary.config.views, group.views) if v > 1] or [1]
    rows = tuple(
        (method, *(_at(shares, v, lambda e: say_estimate(e, 2)) for v in views))
        for method, shares in group.gaps.items()
    )
    note = f"(F1 − that of {low}) / (F1 of {high} − that of {low}), over the scenes and seeds all three have."
    head = ("method", *(f"view {v}" for v in views))
    return Table(f"Share of the gap from {low} to {high} that is closed", note, head, rows)


def _thresholds(methods: Sequence[MethodSummary], rows: Sequence[Difference], summary: Summary) -> Table:
    compared = {difference.method: difference for difference in rows}
    cells = []
    for threshold in summary.config.thresholds:
        for method in methods:
            (found,) = [r for r in method.reaches if r.threshold == threshold]
            ratio = compared[method.method].path_ratios[threshold] if method.method in compared else None
            cells.append(
                (
                    method.method,
                    f"{threshold:.2f}",
                    f"{100.0 * found.share.value:.0f} %",
                    say_number(found.median_views, 1).removesuffix(".0"),
                    say_number(found.median_path, 2),
                    say_number(found.mean_views, 0),
                    say_estimate(found.mean_path, 2),
                    NONE if method.method == summary.reference else say_estimate(ratio, 2),
                )
            )
    head = (
        "method", "F1", "episodes that reach it", "median views", "median path [m]", "views, mean curve",
        "path, mean curve [m]", f"… by that of {summary.reference}",
    )  # fmt: skip
    return Table("Until F1 reaches a threshold", "See below for how it is meant.", head, tuple(cells))


def _at_the_end(methods: Sequence[MethodSummary]) -> Table:
    rows = tuple(
        (m.method, *(say_estimate(m.curves[measure][-1], digits) for measure, _, digits in AT_THE_END))
        for m in methods
    )
    head = ("method", *(name for _, name, _ in AT_THE_END))
    return Table("After the last view", "", head, rows, aside=True)


def _times(methods: Sequence[MethodSummary]) -> Table:
    def said(spread: Spread | None) -> tuple[str, str]:
        if spread is None:
            return NONE, NONE
        return say_time(spread.median), f"{say_time(spread.low)} – {say_time(spread.high)}"

    rows = tuple((m.method, say_estimate(m.area), *said(m.planning), *said(m.perception)) for m in methods)
    head = (
        "method", "F1 along the path", "planning, median", "planning, middle 95 %", "perception, median",
        "perception, middle 95 %",
    )  # fmt: skip
    return Table(
        "F1 along the path, and time", "Planning: the choice of a view. Perception: of one view.", head, rows
    )


def _at(estimates: Sequence[Estimate], view: int, say: Callable[[Estimate], str]) -> str:
    return say(estimates[view - 1]) if view <= len(estimates) else NONE
