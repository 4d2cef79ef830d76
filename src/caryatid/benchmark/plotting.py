"""How the benchmark's figures look: one mark a method, drawn off screen, the same bytes every time."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from caryatid.geometry.transforms import Array

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#000000", "#e69f00", "#56b4e9")
"""Of Okabe and Ito, told apart with any kind of colour vision; without their yellow, too pale for a line."""
MARKERS = (("o", 5.6), ("s", 5.2), ("^", 6.4), ("D", 4.8), ("v", 6.4), ("P", 7.0), ("X", 6.8))
"""And their sizes [pt], at which they look equally large."""
DASHES: tuple[Any, ...] = ("-", (0, (4.0, 1.6)), (0, (1.2, 1.4)))
"""A second and a third method of a colour have dashes and dots, and hollow marks."""
INK, SOFT, GRID = "#1d2126", "#5d666f", "#e3e6e8"
"""Colours of what is said, of what is said beside it, and of the lines behind."""
WIDTH = 7.2
"""Width of a figure [in]; a page's column."""
DOTS_PER_INCH = 160
"""Of the PNG."""
ROW = 0.21
"""Height of a line of the legend [in]."""
LEGEND = 0.72
"""Room beside the axes for all of a legend but the names [in]."""
LETTERS = 9.0
"""Size of letters [pt]."""
STYLE = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": LETTERS,
    "text.color": INK,
    "axes.edgecolor": SOFT,
    "axes.labelcolor": INK,
    "axes.axisbelow": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.linewidth": 0.8,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "xtick.color": SOFT,
    "ytick.color": SOFT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.major.size": 3.0,
    "ytick.major.size": 0.0,
    "ytick.major.pad": 5.0,
    "lines.solid_capstyle": "round",
    "lines.dash_capstyle": "butt",
    "svg.fonttype": "none",
    "text.parse_math": False,
}
"""matplotlib's settings that differ from its defaults; what users set for themselves has no effect."""


@dataclass(frozen=True, slots=True)
class Mark:
    """How a method is drawn in all figures.

    Attributes:
        name: Of the method.
        colour: `#rrggbb`.
        dash: matplotlib's line style.
        marker: matplotlib's marker.
        size: Of the marker [pt].
        hollow: Whether the marker is white inside.
    """

    name: str
    colour: str
    dash: Any
    marker: str
    size: float
    hollow: bool

    def line(self) -> dict[str, Any]:
        """Arguments of matplotlib's `plot` for the line and its marks."""
        return {"color": self.colour, "linestyle": self.dash, "linewidth": 1.8, **self.point()}

    def point(self) -> dict[str, Any]:
        """Arguments of matplotlib's `plot` for a mark, set off from what lies below it."""
        return {
            "color": self.colour,
            "marker": self.marker,
            "markersize": self.size,
            "markeredgewidth": 1.2 if self.hollow else 0.6,
            "markeredgecolor": self.colour if self.hollow else "white",
            "markerfacecolor": "white" if self.hollow else self.colour,
        }


def marks(methods: Sequence[str]) -> dict[str, Mark]:
    """Give each method a mark; up to 147 differ."""
    found = {}
    for k, name in enumerate(methods):
        turn, place = divmod(k, len(COLOURS))
        shift, dash = divmod(turn, len(DASHES))
        marker = MARKERS[(place + shift) % len(MARKERS)]
        found[name] = Mark(name, COLOURS[place], DASHES[dash], *marker, hollow=dash > 0)
    return found


def render(plot: Callable[[Any], None], height: float, salt: str) -> tuple[str, bytes]:
    """Draw a figure.

    Args:
        plot: Draws into matplotlib's figure, `WIDTH` wide.
        height: Of the figure [in].
        salt: Sets the ids of the SVG apart from those of other figures on a page.

    Returns:
        SVG and PNG; the same bytes for the same figure.
    """
    from matplotlib import style
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with style.context(["default", STYLE | {"svg.hashsalt": salt}]):
        figure = Figure(figsize=(WIDTH, height), facecolor="white")
        FigureCanvasAgg(figure)
        plot(figure)
        svg, png = io.BytesIO(), io.BytesIO()
        figure.savefig(svg, format="svg", metadata={"Date": None, "Creator": None})
        figure.savefig(png, format="png", dpi=DOTS_PER_INCH, metadata={"Software": None})
    return svg.getvalue().decode(), png.getvalue()


def add_axes(figure: Any, left: float, right: float, bottom: float = 0.52, top: float = 0.2) -> Any:
    """Add axes with these margins [in].

    Args:
        figure: Of matplotlib.
        left: To the left edge.
        right: To the right edge.
        bottom: To the lower edge.
        top: To the upper edge.
    """
    width, height = figure.get_size_inches()
    place = (
        left / width, bottom / height, (width - left - right) / width, (height - bottom - top) / height,
    )  # fmt: skip
    return figure.add_axes(place)


def name_width(names: Sequence[str]) -> float:
    """Room the longest of these names needs [in]."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextPath

    font = FontProperties(family="DejaVu Sans")
    sizes = [TextPath((0.0, 0.0), name, LETTERS, prop=font).get_extents().width for name in names]
    return float(max(sizes, default=0.0)) / 72.0 + 0.05


def spread(positions: Array, gap: float, low: float, high: float) -> Array:
    """Move positions (N,), ascending, as little as it takes to be a gap apart and between two ends.

    Args:
        positions: Where they would best be (N,).
        gap: Least distance of two.
        low: Lower end.
        high: Upper end.
    """
    from scipy.optimize import isotonic_regression

    if len(positions) == 0:
        return positions
    steps = gap * np.arange(len(positions))
    moved = isotonic_regression(positions - steps).x
    return np.clip(moved, low, max(high - steps[-1], low)) + steps


def label_lines(axes: Any, lines: Sequence[tuple[Mark, float]], *, lead: bool) -> None:
    """Name lines to the right of the axes, with a piece of each, at the height at which it ends.

    Args:
        axes: matplotlib's axes, their limits set.
        lines: Mark of each line, and y of its end.
        lead: Lead from the edge of the axes, where a line ends, to its name.
    """
    from matplotlib.lines import Line2D

    figure = axes.figure
    box = axes.get_position()
    width, height = figure.get_size_inches()
    transform = axes.transData + figure.transFigure.inverted()
    ordered = sorted(
        ((float(transform.transform((0.0, y))[1]), mark) for mark, y in reversed(lines)),
        key=lambda line: line[0],
    )
    heights = spread(np.array([end for end, _ in ordered]), ROW / height, box.y0, box.y1)
    start = box.x1 + 0.22 / width
    for (end, mark), y in zip(ordered, heights, strict=True):
        if lead:
            line = ([box.x1, start - 0.03 / width], [end, y])
            figure.add_artist(Line2D(*line, color=mark.colour, linewidth=0.7, alpha=0.7))
        piece = [start, start + 0.16 / width, start + 0.32 / width]
        figure.add_artist(Line2D(piece, [y] * 3, markevery=[1], **mark.line()))
        figure.text(start + 0.4 / width, y, mark.name, va="center_baseline")
