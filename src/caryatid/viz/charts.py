"""Charts of the summary, drawn by matplotlib and put into the page as SVG: lines, and stacked bars."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

import numpy as np

from caryatid.viz.colours import SERIES

WIDTH, HEIGHT = 320.0, 150.0
"""Width of a chart, and height of its axes [px]."""
LEFT, RIGHT, TOP, BOTTOM = 50.0, 14.0, 34.0, 40.0
"""Free space around the axes [px]."""
LEGEND_COLUMNS, LEGEND_ROW = 4, 17.0
"""Names side by side in the legend, and height of a row of it [px]."""
DASHES, MARKS = ("-", (0, (4, 2)), (0, (1, 1.6)), (0, (6, 2, 1, 2))), "osD^"
"""Styles of lines and of their points: what tells lines apart beside their colours."""
GAP = 0.5
"""Width of the line between a bar's parts [px]."""
MOST_TICKS, FEW_TICKS = 12, 5
"""Steps of an axis at the most: of views, and of anything else."""
SOFT, LINE = "#5d666f", "#dcdfe2"
"""Colours in place of which the page's own are put, which change with light and dark; black becomes ink."""
NOTE = "note:"
"""What the ids of elements begin with that say something when the pointer rests on them."""
STYLE = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 11.0,
    "axes.autolimit_mode": "round_numbers",
    "axes.axisbelow": True,
    "axes.labelcolor": SOFT,
    "axes.xmargin": 0.0,
    "axes.ymargin": 0.0,
    "axes.spines.left": False,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.spines.bottom": False,
    "grid.color": LINE,
    "grid.linewidth": 1.0,
    "xtick.labelcolor": SOFT,
    "ytick.labelcolor": SOFT,
    "xtick.major.size": 0.0,
    "xtick.major.pad": 8.0,
    "ytick.major.size": 0.0,
    "ytick.major.pad": 7.0,
    "legend.frameon": False,
    "legend.labelcolor": SOFT,
    "legend.handlelength": 1.6,
    "legend.handleheight": 1.0,
    "legend.handletextpad": 0.5,
    "legend.columnspacing": 1.2,
    "lines.solid_capstyle": "round",
    "svg.fonttype": "none",
}
"""matplotlib's settings that differ from its defaults; what users set for themselves has no effect."""


@dataclass(frozen=True, slots=True)
class Line:
    """One line of a chart.

    Attributes:
        name: What it is of.
        values: y of each point.
    """

    name: str
    values: Sequence[float]


def line_chart(
    x: Sequence[float],
    lines: Sequence[Line],
    *,
    title: str,
    x_name: str,
    y_name: str,
    y_range: tuple[float, float] | None = None,
) -> str:
    """Draw lines over x, the first on top and the others' points wider, so that all are seen where they meet.

    Each has a colour, a dash and a kind of points of its own.

    Args:
        x: Abscissae, ascending.
        lines: The lines, each as long as x; NaN leaves a gap.
        title: What the chart shows.
        x_name: Name and unit of the x axis.
        y_name: Name and unit of the y axis.
        y_range: Ends of the y axis; None for 0 and a round number.
    """

    def plot(axes: Any) -> None:
        for k, line in enumerate(lines):
            look = {"color": SERIES[k % len(SERIES)], "zorder": 3.0 - 0.1 * k, "clip_on": False}
            dash, mark = DASHES[k % len(DASHES)], MARKS[k % len(MARKS)]
            axes.plot(x, line.values, linewidth=2.0, linestyle=dash, label=line.name, **look)
            for px, py in zip(x, line.values, strict=True):
                if np.isfinite(py):
                    note = f"{NOTE}{line.name} {py:.3g}"
                    size = 6.2 + 2.2 * k
                    axes.plot([px], [py], mark, markersize=size, markeredgewidth=0, gid=note, **look)
        last = x[-1] if x[-1] > x[0] else x[0] + 1.0
        axes.update_datalim([(x[0], 0.0), (last, 1.0)])
        axes.autoscale_view()
        if y_range is not None:
            axes.set_ylim(*y_range)

    values = [value for line in lines for value in line.values if np.isfinite(value)]
    whole = (_whole(x), y_range is None and _whole(values))
    return _chart(plot, whole, len(lines), title=title, x_name=x_name, y_name=y_name)


def bar_chart(bars: Sequence[Mapping[str, float]], *, title: str, x_name: str, y_name: str) -> str:
    """Draw stacked bars, one for each mapping of part to height, numbered from 0.

    Args:
        bars: Part → height, bar by bar.
        title: Heading.
        x_name: What the numbers count.
        y_name: What heights are.
    """
    parts = list(dict.fromkeys(name for bar in bars for name in bar))

    def plot(axes: Any) -> None:
        base, width = np.zeros(len(bars)), 0.66 * min(1.0, len(bars) / 3.0)
        for k, name in enumerate(parts):
            heights = [bar.get(name, 0.0) for bar in bars]
            look = {"label": name, "color": SERIES[k % len(SERIES)], "clip_on": False}
            look |= {"edgecolor": "white", "linewidth": GAP}
            drawn = axes.bar(range(len(bars)), heights, width, base, **look)
            for patch, height in zip(drawn, heights, strict=True):
                patch.set_gid(f"{NOTE}{name} {height:.3g}")
            base += heights
        axes.autoscale_view()
        axes.set_xlim(-0.5, len(bars) - 0.5)

    return _chart(plot, (True, False), len(parts), title=title, x_name=x_name, y_name=y_name)


def _chart(
    plot: Callable[[Any], None], whole: tuple[bool, bool], names: int, *, title: str, x_name: str, y_name: str
) -> str:
    """Draw one chart.

    Args:
        plot: Draws into matplotlib's axes.
        whole: Whether the ticks of x and of y are whole numbers.
        names: How many names the legend has; one needs no legend.
        title: What the chart shows; no two charts of a page have the same.
        x_name: Name and unit of the x axis.
        y_name: Name and unit of the y axis.
    """
    from matplotlib import style
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    rows = -(-names // LEGEND_COLUMNS) if names > 1 else 0
    height = TOP + HEIGHT + BOTTOM + rows * LEGEND_ROW
    place = (LEFT / WIDTH, 1.0 - (TOP + HEIGHT) / height, 1.0 - (LEFT + RIGHT) / WIDTH, HEIGHT / height)
    with style.context(["default", STYLE | {"svg.hashsalt": title}]):
        figure = Figure(figsize=(WIDTH / 72.0, height / 72.0))
        axes = figure.add_axes(place)
        axes.grid(axis="y", clip_on=False)
        for axis, integer in zip((axes.xaxis, axes.yaxis), whole, strict=True):
            count = MOST_TICKS if integer and axis is axes.xaxis else FEW_TICKS
            locator = MaxNLocator(count, integer=integer, steps=(1, 2, 2.5, 5, 10), min_n_ticks=1)
            axis.set_major_locator(locator)
            axis.set_major_formatter("{x:g}")
        plot(axes)
        axes.set_xlabel(x_name)
        axes.set_ylabel(y_name)
        figure.text(6.0 / WIDTH, 1.0 - 16.0 / height, title, fontsize=12.0, fontweight="bold")
        if rows:
            corner = (0.0, (rows * LEGEND_ROW + 4.0) / height)
            figure.legend(
                loc="upper left", bbox_to_anchor=corner, ncols=min(names, LEGEND_COLUMNS), borderpad=0.2
            )
        markup = io.BytesIO()
        figure.savefig(markup, format="svg", transparent=True, metadata={"Date": None})
    return _inline(markup.getvalue(), title)


def _inline(markup: bytes, name: str) -> str:
    """Make an SVG file part of a page: no names but its own, no addresses, the page's colours and notes."""
    root = ElementTree.fromstring(markup)
    for child in list(root):
        if child.tag.endswith(("metadata", "defs")):
            root.remove(child)
    size = root.attrib["viewBox"]
    root.attrib.clear()
    root.attrib.update({"viewBox": size, "class": "chart", "role": "img", "aria-label": name})
    for node in list(root.iter()):
        node.tag = node.tag.rpartition("}")[2]
        node.attrib = {key.rpartition("}")[2]: " ".join(said.split()) for key, said in node.attrib.items()}
        node.tail = None
        if node.tag == "g":
            node.text = None
            note = node.attrib.pop("id", "")
            if note.startswith(NOTE):
                title = ElementTree.Element("title")
                title.text = note.removeprefix(NOTE)
                node.insert(0, title)
    text = ElementTree.tostring(root, encoding="unicode")
    return text.replace(SOFT, "var(--soft)").replace(LINE, "var(--line)")


def _whole(values: Sequence[float]) -> bool:
    return all(float(value).is_integer() for value in values)
