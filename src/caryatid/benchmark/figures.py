"""The benchmark's figures, drawn from a suite's summary; the same summary gives the same bytes."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import pandas as pd

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#000000", "#e69f00", "#56b4e9")
"""Colours of Okabe and Ito, distinct for any colour vision; without their yellow, too pale for a line."""
MARKERS, DASHES = "os^DvPX", ("-", "--", ":")
STYLE = {
    "font.size": 9.0, "axes.spines.right": False, "axes.spines.top": False, "axes.axisbelow": True,
    "axes.grid": True, "grid.color": "#e3e6e8", "svg.fonttype": "none", "text.parse_math": False,
    "lines.markersize": 5.0, "legend.frameon": False,
}  # fmt: skip
"""matplotlib settings that differ from its defaults; a user's own settings have no effect."""

Curves = dict[str, "pd.DataFrame"]
"""Label of a method → value, low and high by view."""


@dataclass(frozen=True, eq=False, slots=True)
class Figure:
    """A figure: name of its file without suffix, caption, height [in], and the function that draws it."""

    name: str
    caption: str
    height: float
    plot: Callable[[Any], None]

    def save(self, path: Path) -> None:
        """Write it as SVG or PNG, by the suffix, without author and date."""
        from matplotlib import style
        from matplotlib.figure import Figure as Drawing

        metadata = {"Date": None, "Creator": None} if path.suffix == ".svg" else {"Software": None}
        with style.context(["default", STYLE | {"svg.hashsalt": self.name}]):
            drawing = Drawing(figsize=(7.2, self.height), facecolor="white", layout="constrained")
            self.plot(drawing)
            drawing.savefig(path, dpi=160, metadata=metadata)


def draw_group(group: pd.DataFrame, measure: str, heading: str, reference: str) -> Iterator[Figure]:
    """Draw a measure, such as `f1`, of the methods under one condition, in all scenes or one family's."""
    family = group["family"].iloc[0]
    scenes = f"{family or 'all'} scenes"
    curves, path = curves_of(group, measure), curves_of(group, "path")
    if curves:
        caption = f"{heading} after each view: mean over {scenes}, with intervals."
        yield _figure(f"{measure} over views {family}", caption, 14, partial(_lines, curves, None, heading))
    if curves and path and measure == "f1":
        caption = f"{heading} over path length, with a mark for each view: mean over {scenes}."
        yield _figure(f"f1 over path {family}", caption, 14, partial(_lines, curves, path, heading))
    if differences := curves_of(group, f"{measure} difference"):
        label = f"{heading} minus that of {reference}"
        caption = f"{label} in {scenes}, paired: mean and interval. Pale: the interval includes 0."
        plot = partial(_rows, differences, label, zero=True)
        yield _figure(f"{measure} differences {family}", caption, len(differences), plot)
    panels = {view: curves_of(group, f"reliability {view}").get(reference) for view in (1, 2, 3, 5)}
    shown = {view: curve for view, curve in panels.items() if curve is not None}
    if shown and not family:
        numbers = {view: curves_of(group, f"supports {view}")[reference] for view in shown}
        caption = f"Reliability of {reference}: share of supports of a probability that are true, with "
        caption += "intervals. A larger mark stands for more supports. On the line, probabilities are right."
        yield _figure("reliability", caption, 6, partial(_reliability, shown, numbers))


def draw_conditions(summary: pd.DataFrame, measure: str, heading: str) -> Figure:
    """Draw a measure under each condition, one method below the other."""
    curves = {
        f"{condition}: {method}": curve
        for condition, group in conditions_of(summary)
        for method, curve in curves_of(group, measure).items()
    }
    caption = f"{heading} under each condition: mean over scenes, with intervals."
    return _figure(f"{measure} by condition", caption, len(curves), partial(_rows, curves, heading))


def conditions_of(summary: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Each condition, and the rows of all its scenes together."""
    yield from summary[summary["family"] == ""].groupby("condition", sort=False)


def curves_of(group: pd.DataFrame, quantity: str) -> Curves:
    """Value, low and high by view of each method that has this quantity."""
    rows = group[group["quantity"] == quantity]
    return {str(method): own.set_index("at") for method, own in rows.groupby("method", sort=False)}


def _figure(name: str, caption: str, rows: int, plot: Callable[[Any], None]) -> Figure:
    name = re.sub(r"[^a-z0-9.]+", "-", name.lower()).strip("-")
    return Figure(name, caption, 0.9 + 0.22 * max(rows, 2), plot)


def _lines(curves: Curves, path: Curves | None, label: str, figure: Any) -> None:
    """Plot a line for each curve, over views or path length."""
    axes = figure.subplots()
    for index, (method, curve) in enumerate(curves.items()):
        turn, place = divmod(index, len(COLOURS))
        look = {"color": COLOURS[place], "marker": MARKERS[place], "linestyle": DASHES[turn % len(DASHES)]}
        # Side by side, so that intervals of one view do not hide each other.
        at = curve.index + 0.4 * ((index + 0.5) / len(curves) - 0.5)
        errors = {"yerr": _interval(curve)}
        if path is not None:
            at, errors["xerr"] = path[method]["value"], _interval(path[method])
        axes.errorbar(at, curve["value"], elinewidth=0.9, label=method, **errors, **look)
    axes.set(ylabel=label, xlabel="path over the floor [m]" if path else "views")
    axes.set_ylim(None, min(1.0, axes.get_ylim()[1]))
    axes.xaxis.get_major_locator().set_params(integer=path is None)
    figure.legend(loc="outside right center")


def _rows(curves: Curves, label: str, figure: Any, *, zero: bool = False) -> None:
    """Plot a panel for up to four views, with a row for each curve."""
    last = max(curve.index.max() for curve in curves.values())
    views = sorted({view for view in (2, 3, 5, 10, last) if view <= last})[-4:]
    panels = figure.subplots(1, len(views), sharex=True, sharey=True, squeeze=False)[0]
    for panel, view in zip(panels, views, strict=True):
        for y, curve in enumerate(curves.values()):
            row = curve[curve.index == view]
            pale = zero and bool(((row["low"] <= 0.0) & (row["high"] >= 0.0)).any())
            look = {"marker": "o", "elinewidth": 0.9, "alpha": 0.4 if pale else 1.0}
            panel.errorbar(row["value"], [y] * len(row), xerr=_interval(row), color=COLOURS[0], **look)
        if zero:
            panel.axvline(0.0, color="#5d666f", linewidth=0.9, zorder=1)
        panel.set_title(f"view {view:.0f}", fontsize=9.0)
    panels[0].set(ylim=(len(curves) - 0.5, -0.5))
    panels[0].set_yticks(range(len(curves)), list(curves))
    figure.supxlabel(label, fontsize=9.0)


def _reliability(curves: dict[int, pd.DataFrame], numbers: dict[int, pd.DataFrame], figure: Any) -> None:
    """Plot a panel for each view: share of true supports over probability."""
    panels = figure.subplots(1, len(curves), sharex=True, sharey=True, squeeze=False)[0]
    for panel, (view, curve) in zip(panels, curves.items(), strict=True):
        number = numbers[view]["value"]
        panel.plot((0.0, 1.0), (0.0, 1.0), color="#5d666f", linewidth=0.9, zorder=1)
        look = {"color": COLOURS[0], "clip_on": False}
        panel.errorbar(curve.index, curve["value"], _interval(curve), fmt="none", elinewidth=0.9, **look)
        panel.scatter(curve.index, curve["value"], 12.0 + 100.0 * number / number.sum(), zorder=3, **look)
        panel.set_title(f"view {view}, {number.sum():,.0f} supports", fontsize=9.0)
        panel.set_aspect("equal")
    panels[0].set(xlim=(0.0, 1.0), ylim=(0.0, 1.0), ylabel="share of true supports")
    figure.supxlabel("probability", fontsize=9.0)


def _interval(curve: pd.DataFrame) -> Any:
    """Extent of the interval below and above each value (2, N)."""
    return np.abs([curve["value"] - curve["low"], curve["high"] - curve["value"]])
