"""The benchmark's figures: F1 over views (Fig. 5 of the paper) and over path, differences, planning time."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from caryatid.benchmark.curves import MOST_BANDS, plot_over_path, plot_over_views
from caryatid.benchmark.intervals import Plot, plot_conditions, plot_differences, plot_planning
from caryatid.benchmark.plotting import Mark, marks, render
from caryatid.benchmark.statistics import Group, Summary
from caryatid.benchmark.words import say_count

MOST_PANELS = 4
"""Views side by side in one figure; the later ones."""
OVER_VIEWS = (
    ("f1", "F1", "vertices and edges together"),
    ("edge_f1", "F1 of edges", "edges alone"),
    ("vertex_f1", "F1 of vertices", "vertices alone, the table included"),
    ("mean_iou", "Mean IoU", "of the matched objects"),
)
"""Measures drawn over views: name, what the axis says, what it is of."""
TAKING = (
    ("unharmed", "Scenes without harm", "share of those taken apart without any object being disturbed"),
    ("lifts", "Lifts without harm", "share of all lifts"),
)
"""The same of scenes that are taken apart."""


@dataclass(frozen=True, slots=True)
class Figure:
    """One figure.

    Attributes:
        name: Of its file, without an ending.
        title: Heading.
        caption: What is to be seen in it.
        condition: Condition it is of; empty for all of them.
        family: Family of scenes it is of; empty for all of them.
        svg: The figure as SVG.
        png: The figure as PNG.
    """

    name: str
    title: str
    caption: str
    condition: str
    family: str
    svg: str
    png: bytes


def write_figures(figures: Sequence[Figure], folder: Path) -> None:
    """Write each figure as SVG and PNG.

    Args:
        figures: What to write.
        folder: Where to; made where it is missing.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for figure in figures:
        (folder / f"{figure.name}.svg").write_text(figure.svg, encoding="utf-8")
        (folder / f"{figure.name}.png").write_bytes(figure.png)


def draw_figures(summary: Summary) -> tuple[Figure, ...]:
    """Draw all figures of a suite.

    For each condition: F1, edge F1, vertex F1 and mean IoU over views, F1 over path, differences from the
    reference and planning time. Where there is but one, F1 over views and over path and the differences for
    each family too; where there are several, F1 by condition. Of scenes that are taken apart: what came to no
    harm over views, and the differences. A figure with nothing to show is left out.
    """
    looks = marks(summary.methods)
    groups = summary.conditions
    drawn = summary.groups if len(groups) < 2 else groups
    figures = [figure for group in drawn for figure in _draw_group(group, looks, summary)]
    if len(groups) > 1:
        views = later_views(summary, groups)
        plot, height = plot_conditions(groups, views, summary.methods, looks)
        caption = f"Mean F1 under each condition, with {_percent(summary)} % intervals over scenes."
        figures.append(
            Figure(
                "f1-by-condition",
                "F1 by condition",
                caption,
                "",
                "",
                *render(plot, height, "f1-by-condition"),
            )
        )
    return tuple(figures)


def table_views(wanted: Sequence[int], views: int) -> tuple[int, ...]:
    """The wanted views of those there are, and the last."""
    return tuple(sorted({v for v in wanted if v <= views} | ({views} if views else set())))


def later_views(summary: Summary, groups: Sequence[Group]) -> tuple[int, ...]:
    """The last few views the tables have, after the first where there are any."""
    views = table_views(summary.config.views, max(group.views for group in groups))
    return tuple(v for v in views if v > 1)[-MOST_PANELS:] or (1,)


def _draw_group(group: Group, looks: Mapping[str, Mark], summary: Summary) -> list[Figure]:
    known = [method for method in group.methods if method.scenes]
    if not known:
        return []
    mean = f"mean over {_scenes(group)}"
    intervals = f"{_percent(summary)} % intervals"
    beside = "" if len(known) <= MOST_BANDS else " as bars, the methods side by side"
    thresholds = summary.config.thresholds
    figures = []

    def add(name: str, title: str, caption: str, drawn: tuple[Plot, float]) -> None:
        plot, height = drawn
        several = len({g.condition for g in summary.groups}) > 1
        file = _file_name(name, group.family, group.condition if several else "")
        svg, png = render(plot, height, file)
        figures.append(Figure(file, title, caption, group.condition, group.family, svg, png))

    for measure, axis, what in TAKING if group.taken else OVER_VIEWS[:1] if group.family else OVER_VIEWS:
        caption = f"{axis} ({what}) after each view: {mean}, with {intervals}{beside}."
        goals = thresholds if measure == "f1" else ()
        name = f"{measure}-over-views"
        add(name, f"{axis} over views", caption, plot_over_views(known, measure, axis, goals, looks))
    if group.budget > 0.0 and not group.taken:
        caption = f"F1 over the path travelled, a mark a view: {mean}"
        caption += f"; bars are {intervals} of both. " if len(known) <= MOST_BANDS else ". "
        caption += "Names stand in the order of the last F1."
        add("f1-over-path", "F1 over path", caption, plot_over_path(known, thresholds, looks))
    rows = [difference for difference in group.differences if difference.scenes]
    if rows:
        reference = summary.reference
        of, name, _ = (TAKING if group.taken else OVER_VIEWS)[0]
        caption = (
            f"{name} minus that of {reference} over the scenes and seeds both have: mean and "
            f"{_percent(summary)} % interval; to the right is better. Pale: the interval holds 0."
        )
        views = later_views(summary, [group])
        add(
            f"{of}-differences", f"{name} compared with {reference}", caption,
            plot_differences(rows, views, reference, looks, of, name),
        )  # fmt: skip
    timed = [method for method in known if method.planning]
    if timed and not group.family and not group.taken:
        caption = (
            "Time the choice of a view takes: median (written on the right), the middle half of them all "
            "and, as a thin line, the middle 95 %."
        )
        add("planning-time", "Planning time", caption, plot_planning(timed, looks))
    return figures


def _file_name(*words: str) -> str:
    return re.sub(r"[^a-z0-9.]+", "-", " ".join(words).lower()).strip("-")


def _percent(summary: Summary) -> str:
    return f"{100.0 * summary.config.confidence:g}"


def _scenes(group: Group) -> str:
    return say_count(group.scenes, f"{group.family} scene" if group.family else "scene")
