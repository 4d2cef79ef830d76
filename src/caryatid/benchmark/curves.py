"""Figures of one line a method: a measure over views, and F1 over the path."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from caryatid.benchmark.bootstrap import Estimate
from caryatid.benchmark.plotting import LEGEND, SOFT, Mark, add_axes, label_lines, name_width
from caryatid.benchmark.statistics import MethodSummary
from caryatid.geometry.transforms import Array

Plot = Callable[[Any], None]
"""Draws into matplotlib's figure."""
MOST_BANDS = 6
"""Methods whose intervals are drawn as bands; of more they are bars, side by side."""
BESIDE = 0.5
"""Part of a view's room that methods side by side take [1]."""


def plot_over_views(
    methods: Sequence[MethodSummary],
    measure: str,
    name: str,
    thresholds: Sequence[float],
    looks: Mapping[str, Mark],
) -> tuple[Plot, float]:
    """Draw a measure over views, each method's intervals with it.

    Args:
        methods: Each with one view at least.
        measure: Name of the measure.
        name: What the axis says.
        thresholds: Drawn as lines to be reached.
        looks: Mark of each method.

    Returns:
        What draws it, and its height [in].
    """

    def plot(figure: Any) -> None:
        axes = add_axes(figure, 0.6, LEGEND + name_width([m.method for m in methods]))
        axes.grid(axis="y")
        ends = []
        for k, method in enumerate(methods):
            mark = looks[method.method]
            value, low, high = arrays(method.curves[measure])
            views = np.arange(1.0, len(value) + 1.0)
            if len(methods) <= MOST_BANDS:
                axes.fill_between(views, low, high, color=mark.colour, alpha=0.14, linewidth=0)
            else:
                views += BESIDE * ((k + 0.5) / len(methods) - 0.5)
                axes.vlines(views, low, high, color=mark.colour, linewidth=1.1, alpha=0.6)
            axes.plot(views, value, zorder=4.0 - 0.01 * k, **mark.line())
            ends.append((mark, float(value[-1])))
        last = max(len(method.curves[measure]) for method in methods)
        axes.set_xlim(0.7, last + 0.3)
        axes.set_xticks(range(1, last + 1))
        axes.set_xlabel("views")
        _scale(axes, name, methods, measure, thresholds)
        label_lines(axes, ends, lead=True)

    return plot, _height(methods)


def plot_over_path(
    methods: Sequence[MethodSummary], thresholds: Sequence[float], looks: Mapping[str, Mark]
) -> tuple[Plot, float]:
    """Draw mean F1 over the mean path, a mark a view.

    Args:
        methods: Each with one view at least.
        thresholds: Drawn as lines to be reached.
        looks: Mark of each method.

    Returns:
        What draws it, and its height [in].
    """

    def plot(figure: Any) -> None:
        axes = add_axes(figure, 0.6, LEGEND + name_width([m.method for m in methods]))
        axes.grid()
        ends = []
        for k, method in enumerate(methods):
            mark = looks[method.method]
            value, low, high = arrays(method.curves["f1"])
            path, left, right = arrays(method.curves["path"])
            if len(methods) <= MOST_BANDS:
                axes.vlines(path, low, high, color=mark.colour, linewidth=1.1, alpha=0.5)
                axes.hlines(value, left, right, color=mark.colour, linewidth=1.1, alpha=0.5)
            axes.plot(path, value, zorder=4.0 - 0.01 * k, **mark.line())
            ends.append((mark, float(value[-1])))
        axes.margins(x=0.03)
        axes.set_xlabel("path over the floor [m]")
        _scale(axes, "F1", methods, "f1", thresholds)
        label_lines(axes, ends, lead=False)

    return plot, _height(methods)


def arrays(estimates: Sequence[Estimate]) -> tuple[Array, Array, Array]:
    """Values, and lower and upper ends of their intervals (V,); both ends the value where there is none."""
    values = np.array([e.value for e in estimates])
    low = np.array([e.value if e.low is None else e.low for e in estimates])
    high = np.array([e.value if e.high is None else e.high for e in estimates])
    return values, low, high


def _scale(
    axes: Any, name: str, methods: Sequence[MethodSummary], measure: str, thresholds: Sequence[float]
) -> None:
    """Set the ends of y to tenths around all intervals, never beyond 0 and 1, and draw the thresholds."""
    ends = [arrays(method.curves[measure])[1:] for method in methods]
    low = min(float(np.nanmin(low)) for low, _ in ends)
    high = max(float(np.nanmax(high)) for _, high in ends)
    bottom = max(0.0, math.floor(10.0 * low - 0.2) / 10.0)
    top = min(1.0, max(math.ceil(10.0 * high + 0.2) / 10.0, bottom + 0.2))
    step = 0.1 if top - bottom > 0.25 else 0.05
    axes.set_ylim(bottom, top + 1e-6)
    axes.set_yticks(np.arange(round(bottom / step), round(top / step) + 1) * step)
    axes.yaxis.set_major_formatter("{x:.1f}" if step == 0.1 else "{x:.2f}")
    axes.set_ylabel(name)
    for threshold in thresholds:
        if bottom < threshold < top:
            axes.axhline(threshold, color=SOFT, linewidth=0.8, linestyle=(0, (1.0, 2.0)), zorder=1.0)
            said = axes.annotate(
                f"{threshold:.2f}", (0.0, threshold), (3.0, 2.0), xycoords=axes.get_yaxis_transform(),
                textcoords="offset points", color=SOFT, fontsize=7.5,
            )  # fmt: skip
            said.set_bbox({"facecolor": "white", "edgecolor": "none", "pad": 0.6})


def _height(methods: Sequence[MethodSummary]) -> float:
    return max(3.6, 0.95 + 0.22 * len(methods))
