"""The benchmark's figures, drawn of a suite's summary: the same bytes every time."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import pandas as pd

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#000000", "#e69f00", "#56b4e9")
"""Of Okabe and Ito, told apart with any kind of colour vision; without their yellow, too pale for a line."""
MARKERS, DASHES = "os^DvPX", ("-", "--", ":")
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


@dataclass(frozen=True, eq=False, slots=True)
class Figure:
    """A figure: name of its file without an ending, heading, what is to be seen in it, and the drawing."""

    name: str
    title: str
    caption: str
    drawing: Any

    def save(self, path: Path) -> None:
        """Write it as the ending says, SVG or PNG, with nothing of who drew it when."""
        from matplotlib import style

        metadata = {"Date": None, "Creator": None} if path.suffix == ".svg" else {"Software": None}
        with style.context(["default", STYLE | {"svg.hashsalt": self.name}]):
            self.drawing.savefig(path, dpi=160, metadata=metadata)


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


def draw_group(
    summary: pd.DataFrame, label: str, scenes: str, reference: str, looks: Looks
) -> Iterator[Figure]:
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
    for measure, (axis, what) in list(measures.items())[: 1 if label else None]:
        if curves := curves_of(summary, measure):
            title, caption = f"{axis} over views", f"{axis} ({what}) after each view: {mean}."
            plot = partial(_draw_lines, looks=looks, curves=curves, label=axis)
            yield _draw(f"{measure} over views {label}", title, caption, 14, plot)
    f1, path = curves_of(summary, "f1"), curves_of(summary, "path")
    if f1 and path and not removal:
        caption = f"F1 over the path travelled, a mark for each view: {mean}."
        plot = partial(_draw_lines, looks=looks, curves=f1, label="F1", path=path)
        yield _draw(f"f1 over path {label}", "F1 over path", caption, 14, plot)
    main, (name, _) = next(iter(measures.items()))
    if differences := curves_of(summary, f"{main} difference"):
        caption = (
            f"{name} minus that of {reference} over the scenes and seeds both have: mean and interval; "
            "to the right is better. Pale: the interval holds 0."
        )
        axis = f"{name} minus that of {reference}"
        plot = partial(_draw_rows, looks=looks, curves=differences, label=axis, zero=True)
        title = f"{name} compared with {reference}"
        yield _draw(f"{main} differences {label}", title, caption, len(differences), plot)
    times = curves_of(summary, "planning")
    if times and not label and not removal:
        for method, time in times.items():
            middle = time.loc[[0.5]].assign(low=time["value"].min(), high=time["value"].max())
            times[method] = middle.set_axis([1])
        caption = "Time the choice of a view takes: median and the middle 95 %."
        plot = partial(_draw_rows, looks=looks, curves=times, label="time of a choice [s]", scale="log")
        yield _draw("planning time", "Planning time", caption, len(times), plot)


def draw_conditions(summary: pd.DataFrame, looks: Looks) -> Figure:
    """Draw F1 under each condition after the later views, the methods below each other."""
    rows = summary[(summary["family"] == "") & (summary["quantity"] == "f1")]
    curves = {
        f"{condition}: {method}": own.set_index("at")
        for (condition, method), own in rows.groupby(["condition", "method"], sort=False)
    }
    looks = {name: looks[name.rpartition(": ")[2]] for name in curves}
    caption = "Mean F1 under each condition, with intervals over scenes."
    plot = partial(_draw_rows, looks=looks, curves=curves, label="F1")
    return _draw("f1 by condition", "F1 by condition", caption, len(curves), plot)


def is_removal(summary: pd.DataFrame) -> bool:
    """Whether the scenes of a group were taken apart."""
    return bool((summary["value"][summary["quantity"] == "lifts"] > 0.0).any())


def curves_of(summary: pd.DataFrame, quantity: str) -> Curves:
    """Value, low and high by view of each method that has this quantity."""
    rows = summary[summary["quantity"] == quantity]
    return {str(method): own.set_index("at") for method, own in rows.groupby("method", sort=False)}


def told_views(views: Iterable[float]) -> list[float]:
    """Views that tables and figures tell of: 1, 2, 3, 5 and 10 as far as they exist, and the last."""
    last = max(views, default=0)
    return sorted({v for v in (1, 2, 3, 5, 10, last) if 0 < v <= last})


def _draw(name: str, title: str, caption: str, rows: int, plot: Callable[[Any], None]) -> Figure:
    """Draw a figure with matplotlib, as high as its number of rows."""
    from matplotlib import style
    from matplotlib.figure import Figure as Drawing

    name = re.sub(r"[^a-z0-9.]+", "-", name.lower()).strip("-")
    with style.context(["default", STYLE]):
        drawing = Drawing(figsize=(7.2, 0.9 + 0.22 * max(rows, 2)), facecolor="white", layout="constrained")
        plot(drawing)
    return Figure(name, title, caption, drawing)


def _draw_lines(figure: Any, *, looks: Looks, curves: Curves, label: str, path: Curves | None = None) -> None:
    """A line for each curve, over the views or over the path up to each."""
    axes = figure.subplots()
    for k, (method, curve) in enumerate(curves.items()):
        at, errors = curve.index + 0.4 * ((k + 0.5) / len(curves) - 0.5), {"yerr": _interval(curve)}
        if path is not None:
            at, errors["xerr"] = path[method]["value"], _interval(path[method])
        axes.errorbar(at, curve["value"], elinewidth=0.9, label=method, **errors, **looks[method])
    axes.set(ylabel=label, xlabel="path over the floor [m]" if path else "views")
    axes.set_ylim(None, min(1.0, axes.get_ylim()[1]))
    axes.xaxis.get_major_locator().set_params(integer=path is None)
    figure.legend(loc="outside right center")


def _draw_rows(
    figure: Any, *, looks: Looks, curves: Curves, label: str, zero: bool = False, scale: str = "linear"
) -> None:
    """A panel for each of the last views a table has, a row for each curve."""
    views = told_views(view for curve in curves.values() for view in curve.index)
    views = [view for view in views if view > 1][-4:] or [1]
    panels = np.atleast_1d(figure.subplots(1, len(views), sharex=True, sharey=True))
    for panel, view in zip(panels, views, strict=True):
        for y, (name, curve) in enumerate(curves.items()):
            row = curve[curve.index == view]
            pale = zero and bool(((row["low"] <= 0.0) & (row["high"] >= 0.0)).any())
            panel.errorbar(
                row["value"], [y] * len(row), xerr=_interval(row), elinewidth=0.9, alpha=0.4 if pale else 1.0,
                **looks[name],
            )  # fmt: skip
        if zero:
            panel.axvline(0.0, color="#5d666f", linewidth=0.9, zorder=1)
        if len(views) > 1:
            panel.set_title(f"view {view:.0f}", fontsize=9.0)
    panels[0].set(xscale=scale, ylim=(len(curves) - 0.5, -0.5))
    panels[0].set_yticks(range(len(curves)), list(curves))
    figure.supxlabel(label, fontsize=9.0)


def _interval(curve: pd.DataFrame) -> Any:
    """How far the interval reaches below and above each value (2, N)."""
    return np.abs([curve["value"] - curve["low"], curve["high"] - curve["value"]])
