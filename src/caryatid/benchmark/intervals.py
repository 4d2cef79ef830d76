"""Figures of one row a method or condition: differences from a reference, planning time, F1 by condition."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from caryatid.benchmark.bootstrap import Estimate
from caryatid.benchmark.comparison import Difference
from caryatid.benchmark.plotting import GRID, LEGEND, LETTERS, SOFT, Mark, add_axes, label_lines, name_width
from caryatid.benchmark.statistics import Group, MethodSummary
from caryatid.benchmark.words import say_tick, say_time

Plot = Callable[[Any], None]
"""Draws into matplotlib's figure."""
LINE = 0.25
"""Height of a row [in]."""
SHORTEST = 1e-6
"""Time below which nothing is told apart [s]; a clock's step."""


def plot_differences(
    rows: Sequence[Difference],
    views: Sequence[int],
    reference: str,
    looks: Mapping[str, Mark],
    measure: str = "f1",
    name: str = "F1",
) -> tuple[Plot, float]:
    """Draw how a measure differs from a reference's: a panel a view, a row a method.

    Args:
        rows: One a method.
        views: Which views.
        reference: The method they are compared with.
        looks: Mark of each method.
        measure: Name of the measure.
        name: What the axis says.

    Returns:
        What draws it, and its height [in].
    """

    def plot(figure: Any) -> None:
        names = [difference.method for difference in rows]
        panels = _panels(figure, views, names, right=0.2, label=f"{name} minus that of {reference}")
        for panel, view in zip(panels, views, strict=True):
            panel.axvline(0.0, color=SOFT, linewidth=0.9)
            for y, difference in enumerate(rows):
                if view <= len(difference.measures[measure]):
                    estimate = difference.measures[measure][view - 1]
                    _interval(panel, y, estimate, looks[difference.method], fade=True)

    return plot, 0.95 + LINE * max(len(rows), 2)


def plot_conditions(
    groups: Sequence[Group], views: Sequence[int], methods: Sequence[str], looks: Mapping[str, Mark]
) -> tuple[Plot, float]:
    """Draw F1 under each condition: a panel a view, a row a condition, the methods one below the other.

    Args:
        groups: One a condition.
        views: After which views.
        methods: Labels, in order.
        looks: Label → how it is drawn.

    Returns:
        What draws it, and its height [in].
    """

    def plot(figure: Any) -> None:
        names = [group.condition for group in groups]
        panels = _panels(figure, views, names, right=LEGEND + name_width(methods), label="F1")
        for panel, view in zip(panels, views, strict=True):
            for y, group in enumerate(groups):
                for method in group.methods:
                    if view <= len(method.curves["f1"]):
                        place = (methods.index(method.method) + 0.5) / len(methods) - 0.5
                        _interval(panel, y + 0.7 * place, method.curves["f1"][view - 1], looks[method.method])
            for y in range(1, len(groups)):
                panel.axhline(y - 0.5, color=GRID, linewidth=0.8)
        top = [(looks[name], -0.5 + 0.001 * k) for k, name in enumerate(methods)]
        label_lines(panels[-1], top, lead=False)

    return plot, 0.95 + max(len(groups) * max(0.13 * len(methods), LINE), 0.22 * len(methods))


def plot_planning(methods: Sequence[MethodSummary], looks: Mapping[str, Mark]) -> tuple[Plot, float]:
    """Draw how long the choice of a view takes: a row a method.

    Returns:
        What draws it, and its height [in].
    """

    def plot(figure: Any) -> None:
        axes = add_axes(figure, 0.2 + name_width([m.method for m in methods]), 0.8)
        axes.grid(axis="x")
        axes.set_xscale("log")
        ends = []
        for y, method in enumerate(methods):
            if method.planning is None:
                continue
            mark, time = looks[method.method], method.planning
            low, lower, median, upper, high = (
                max(t, SHORTEST) for t in (time.low, time.lower, time.median, time.upper, time.high)
            )
            axes.hlines(y, low, high, color=mark.colour, linewidth=1.3)
            axes.hlines(y, lower, upper, color=mark.colour, linewidth=6.0, alpha=0.35)
            axes.plot([median], [y], linestyle="none", **mark.point())
            right = axes.get_yaxis_transform()
            axes.text(1.02, y, say_time(time.median), transform=right, va="center_baseline")
            ends += [low, high]
        axes.set_ylim(len(methods) - 0.5, -0.5)
        axes.set_yticks(range(len(methods)), [method.method for method in methods])
        decades = math.floor(math.log10(min(ends))), math.ceil(math.log10(max(ends)))
        axes.set_xlim(10.0 ** decades[0], 10.0 ** max(decades[1], decades[0] + 1))
        axes.xaxis.set_major_formatter(lambda value, _: say_tick(value))
        axes.minorticks_off()
        axes.set_xlabel("time of a choice")

    return plot, 0.75 + LINE * max(len(methods), 2)


def _panels(
    figure: Any, views: Sequence[int], names: Sequence[str], *, right: float, label: str
) -> list[Any]:
    """Axes side by side that share their limits, a view each, rows named on the left."""
    from matplotlib.ticker import MaxNLocator

    width, height = figure.get_size_inches()
    left, bottom, top, gap = 0.15 + name_width(names), 0.5, 0.3, 0.32
    each = (width - left - right - gap * (len(views) - 1)) / len(views)
    panels: list[Any] = []
    for k, view in enumerate(views):
        start = left + k * (each + gap)
        shared = {"sharex": panels[0], "sharey": panels[0]} if panels else {}
        place = (start / width, bottom / height, each / width, (height - bottom - top) / height)
        panel = figure.add_axes(place, **shared)
        panel.grid(axis="x")
        panel.tick_params(labelleft=k == 0)
        panel.set_title(f"view {view}", fontsize=LETTERS)
        panel.xaxis.set_major_locator(MaxNLocator(max(2, int(each / 0.4)), steps=(1, 2, 5, 10)))
        panels.append(panel)
    panels[0].set_ylim(len(names) - 0.5, -0.5)
    panels[0].set_yticks(range(len(names)), names)
    middle = (left + (width - left - right) / 2.0) / width
    figure.text(middle, 0.08 / height, label, ha="center")
    return panels


def _interval(axes: Any, y: float, estimate: Estimate, mark: Mark, *, fade: bool = False) -> None:
    """Draw a mark and its interval, pale where it is to fade when its interval holds 0."""
    alpha = 0.4 if fade and estimate.low is not None and not estimate.excludes_zero else 1.0
    if estimate.low is not None:
        axes.hlines(y, estimate.low, estimate.high, color=mark.colour, linewidth=1.6, alpha=alpha)
    small = {"markersize": 0.8 * mark.size, "markeredgewidth": 1.0 if mark.hollow else 0.0}
    axes.plot([estimate.value], [y], linestyle="none", alpha=alpha, **mark.point() | small)
