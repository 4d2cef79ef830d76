"""The benchmark's figures, drawn of a suite's summary: the same bytes every time."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import pandas as pd

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#000000", "#e69f00", "#56b4e9")
"""Of Okabe and Ito, told apart with any kind of colour vision; without their yellow, too pale for a line."""
MARKERS, DASHES = "os^DvPX", ("-", "--", ":")
WIDTH = 7.2
"""Width of a figure [in]."""
ROW = 0.22
"""Height of a row, and of a name in the legend [in]."""
STYLE = {
    "font.size": 9.0, "axes.spines.right": False, "axes.spines.top": False, "axes.axisbelow": True,
    "axes.grid": True, "grid.color": "#e3e6e8", "svg.fonttype": "none", "text.parse_math": False,
    "lines.markersize": 5.0, "legend.frameon": False,
}  # fmt: skip
"""matplotlib's settings that differ from its defaults; what users set for themselves has no effect."""
OVER_VIEWS = {
    "f1": ("F1", "vertices and edges together"),
    "edge_f1": ("F1 of edges", "edges alone"),
    "vertex_f1": ("F1 of vertices", "vertices alone, the table included"),
    "mean_iou": ("Mean IoU", "of the matched objects"),
}
"""Measures drawn over views: what the axis says, what it is of."""
REMOVAL = {
    "unharmed": ("Scenes without harm", "share of those taken apart without any object being disturbed"),
    "lifts": ("Lifts without harm", "share of all lifts"),
}
"""The same of scenes that are taken apart."""

Looks = Mapping[str, dict[str, Any]]
"""Label of a method → arguments of matplotlib's `plot`."""
Curves = dict[str, "pd.DataFrame"]
"""Label of a method → value, low and high by view or quantile."""


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure: name of its file without an ending, heading, what is to be seen in it, SVG and PNG."""

    name: str
    title: str
    caption: str
    svg: str
    png: bytes


def looks_of(methods: Sequence[str]) -> Looks:
    """Give each method a colour, a marker and a line style of its own."""
    looks = {}
    for k, name in enumerate(methods):
        turn, place = divmod(k, len(COLOURS))
        shift, dash = divmod(turn, len(DASHES))
        looks[name] = {
            "color": COLOURS[place],
            "marker": MARKERS[(place + shift) % len(MARKERS)],
            "linestyle": DASHES[dash],
            "markerfacecolor": "white" if dash else COLOURS[place],
        }
    return looks


def draw_group(summary: pd.DataFrame, label: str, scenes: str, reference: str, looks: Looks) -> list[Figure]:
    """Draw the figures of the methods under one condition, over all scenes or one family.

    Args:
        summary: Its rows of a suite's summary.
        label: Told apart from other groups by this in names of files; may be empty.
        scenes: How many of what kind, in words.
        reference: Method differences are from.
        looks: How each method is drawn.
    """
    removal = is_removal(summary)
    measures = REMOVAL if removal else OVER_VIEWS
    mean = f"mean over {scenes}, with intervals"
    figures = []

    def add(name: str, title: str, caption: str, rows: int, plot: Callable[..., None], *data: Any) -> None:
        figures.append(render(partial(plot, looks, *data), rows, f"{name} {label}", title, caption))

    for measure, (axis, what) in list(measures.items())[: 1 if label else None]:
        if curves := curves_of(summary, measure):
            caption = f"{axis} ({what}) after each view: {mean}."
            add(f"{measure} over views", f"{axis} over views", caption, 14, _over_views, curves, axis)
    f1, path = curves_of(summary, "f1"), curves_of(summary, "path")
    if f1 and path and not removal:
        caption = f"F1 over the path travelled, a mark for each view: {mean}."
        add("f1 over path", "F1 over path", caption, 14, _over_path, f1, path)
    first, (name, _) = next(iter(measures.items()))
    if differences := curves_of(summary, f"{first} difference"):
        caption = (
            f"{name} minus that of {reference} over the scenes and seeds both have: mean and interval; "
            "to the right is better. Pale: the interval holds 0."
        )
        title, rows = f"{name} compared with {reference}", len(differences)
        axis = f"{name} minus that of {reference}"
        add(f"{first} differences", title, caption, rows, _panels, differences, axis, True)
    times = curves_of(summary, "planning")
    if times and not label and not removal:
        caption = (
            "Time the choice of a view takes: median, the middle half of them all and, as a thin line, "
            "the middle 95 %."
        )
        add("planning time", "Planning time", caption, len(times), _planning, times)
    return figures


def draw_conditions(summary: pd.DataFrame, looks: Looks) -> Figure:
    """Draw F1 under each condition after the later views, the methods below each other."""
    rows = summary[(summary["family"] == "") & (summary["quantity"] == "f1")]
    curves = {
        f"{condition}: {method}": own.set_index("at")
        for (condition, method), own in rows.groupby(["condition", "method"], sort=False)
    }
    plot = partial(_panels, {name: looks[name.rpartition(": ")[2]] for name in curves}, curves, "F1", False)
    caption = "Mean F1 under each condition, with intervals over scenes."
    return render(plot, len(curves), "f1 by condition", "F1 by condition", caption)


def is_removal(summary: pd.DataFrame) -> bool:
    """Whether the scenes of a group were taken apart."""
    return bool((_quantity(summary, "lifts")["value"] > 0.0).any())


def curves_of(summary: pd.DataFrame, quantity: str) -> Curves:
    """Value, low and high by view of each method that has this quantity."""
    rows = _quantity(summary, quantity)
    return {str(method): own.set_index("at") for method, own in rows.groupby("method", sort=False)}


def render(plot: Callable[[Any], None], rows: int, name: str, title: str, caption: str) -> Figure:
    """Draw a figure with matplotlib, so many rows high, as SVG and PNG."""
    from matplotlib import style
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas

    name = re.sub(r"[^a-z0-9.]+", "-", name.lower()).strip("-")
    with style.context(["default", STYLE | {"svg.hashsalt": name}]):
        figure = Canvas(figsize=(WIDTH, 0.9 + ROW * max(rows, 2)), facecolor="white", layout="constrained")
        FigureCanvasAgg(figure)
        plot(figure)
        svg, png = io.BytesIO(), io.BytesIO()
        figure.savefig(svg, format="svg", metadata={"Date": None, "Creator": None})
        figure.savefig(png, format="png", dpi=160, metadata={"Software": None})
    return Figure(name, title, caption, svg.getvalue().decode(), png.getvalue())


def _quantity(summary: pd.DataFrame, quantity: str) -> pd.DataFrame:
    return summary[summary["quantity"] == quantity]


def _over_views(looks: Looks, curves: Curves, axis: str, figure: Any) -> None:
    axes = figure.subplots()
    for k, (method, curve) in enumerate(curves.items()):
        shift = 0.4 * ((k + 0.5) / len(curves) - 0.5)
        _errors(axes, curve.index + shift, curve["value"], looks[method], y=curve, label=method)
    axes.set(xlabel="views", ylabel=axis, ylim=(None, min(1.0, axes.get_ylim()[1])))
    axes.xaxis.get_major_locator().set_params(integer=True)
    figure.legend(loc="outside right center")


def _over_path(looks: Looks, f1: Curves, path: Curves, figure: Any) -> None:
    axes = figure.subplots()
    for method, curve in f1.items():
        along = path[method].loc[curve.index]
        _errors(axes, along["value"], curve["value"], looks[method], x=along, y=curve, label=method)
    axes.set(xlabel="path over the floor [m]", ylabel="F1", ylim=(None, min(1.0, axes.get_ylim()[1])))
    figure.legend(loc="outside right center")


def _panels(looks: Looks, curves: Curves, label: str, zero: bool, figure: Any) -> None:
    """A panel for each of the last views a table has, a row for each curve."""
    views = [v for v in table_views(curves) if v > 1][-4:] or [1]
    panels = np.atleast_1d(figure.subplots(1, len(views), sharex=True, sharey=True))
    for panel, view in zip(panels, views, strict=True):
        if zero:
            panel.axvline(0.0, color="#5d666f", linewidth=0.9)
        for y, (name, curve) in enumerate(curves.items()):
            if view in curve.index:
                row = curve.loc[[view]]
                pale = zero and bool((row["low"] <= 0.0).all() and (row["high"] >= 0.0).all())
                _errors(panel, row["value"], [y], looks[name], x=row, alpha=0.4 if pale else 1.0)
        panel.set_title(f"view {view:.0f}", fontsize=9.0)
    panels[0].set_yticks(range(len(curves)), list(curves))
    panels[0].set_ylim(len(curves) - 0.5, -0.5)
    figure.supxlabel(label, fontsize=9.0)


def _planning(looks: Looks, times: Curves, figure: Any) -> None:
    axes = figure.subplots()
    for y, (method, time) in enumerate(times.items()):
        known = list(time["value"])
        colour = looks[method]["color"]
        axes.hlines(y, known[0], known[-1], color=colour, linewidth=1.3)
        axes.hlines(y, known[1], known[-2], color=colour, linewidth=6.0, alpha=0.35)
        axes.plot(known[len(known) // 2], y, **looks[method] | {"linestyle": "none"})
    axes.set_xscale("log")
    axes.set_yticks(range(len(times)), list(times))
    axes.set_ylim(len(times) - 0.5, -0.5)
    axes.set_xlabel("time of a choice [s]")


def _errors(
    axes: Any, at: Any, value: Any, look: dict[str, Any], *, x: Any = None, y: Any = None, **options: Any
) -> None:
    def reach(curve: Any) -> Any:
        return (
            None if curve is None else np.abs([curve["value"] - curve["low"], curve["high"] - curve["value"]])
        )

    axes.errorbar(at, value, xerr=reach(x), yerr=reach(y), elinewidth=0.9, **look, **options)


def table_views(curves: Curves) -> list[float]:
    """Views a table has columns of: 1, 2, 3, 5 and 10 as far as they exist, and the last."""
    last = max((max(curve.index) for curve in curves.values()), default=0)
    return sorted({v for v in (1, 2, 3, 5, 10, last) if 0 < v <= last})
