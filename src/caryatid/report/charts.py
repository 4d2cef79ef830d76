"""Small charts as SVG: lines over views or path, and bars of time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from caryatid.report import svg

WIDTH, HEIGHT = 320.0, 222.0
"""Size of a chart [px]."""
LEFT, RIGHT, TOP, BOTTOM = 40.0, 14.0, 34.0, 44.0
"""Free space around the axes [px]."""
TEXT = 12.0
"""Height of letters [px]."""
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#999933", "#882255")
"""Colours of lines and of bars' parts, none of which means an object."""

Place = Callable[[float, float], tuple[float, float]]
"""From a value on both axes to pixels."""


@dataclass(frozen=True, slots=True)
class Line:
    """One line of a chart: its name and y of each point."""

    name: str
    values: Sequence[float]


def line_chart(
    x: Sequence[float],
    lines: Sequence[Line],
    *,
    title: str,
    x_name: str,
    y_range: tuple[float, float] | None = None,
) -> str:
    """Draw lines over x; without a range the y axis begins at 0 and ends at a round number.

    Args:
        x: Abscissae, ascending.
        lines: The lines, each as long as x; NaN leaves a gap.
        title: What the chart shows, with the unit.
        x_name: Name and unit of the x axis.
        y_range: Ends of the y axis.
    """
    values = np.array([line.values for line in lines], dtype=np.float64)
    if y_range is None:
        finite = values[np.isfinite(values)]
        top = max(float(finite.max(initial=0.0)), 1.0)
        ticks_y = _ticks(0.0, top, whole=bool((finite == finite.round()).all()))
    else:
        ticks_y = _ticks(*y_range)
    last = max(x) if max(x) > min(x) else min(x) + 1.0
    ticks_x = _ticks(min(x), last, whole=all(float(v).is_integer() for v in x))
    low_x, high_x = min(ticks_x[0], min(x)), max(ticks_x[-1], max(x))
    low_y, high_y = ticks_y[0], ticks_y[-1]

    def at(px: float, py: float) -> tuple[float, float]:
        return (
            LEFT + (px - low_x) / (high_x - low_x) * (WIDTH - LEFT - RIGHT),
            HEIGHT - BOTTOM - (py - low_y) / (high_y - low_y) * (HEIGHT - TOP - BOTTOM),
        )

    drawn = [svg.text(6, 16, title, class_="heading"), _axis_y(ticks_y, at, low_x, high_x)]
    drawn += [
        svg.text(at(v, low_y)[0], HEIGHT - BOTTOM + 17, f"{v:g}", class_="small middle") for v in ticks_x
    ]
    drawn.append(svg.text((LEFT + WIDTH - RIGHT) / 2, HEIGHT - 8, x_name, class_="small middle"))
    names = []
    for line, row, colour in zip(lines, values, COLOURS, strict=False):
        points = np.array([at(px, py) for px, py in zip(x, row, strict=True) if np.isfinite(py)]).reshape(
            -1, 2
        )
        if len(points) == 0:
            continue
        drawn.append(svg.element("path", d=svg.path(points), class_="line", stroke=colour))
        for (cx, cy), value in zip(points, row[np.isfinite(row)], strict=True):
            note = svg.tooltip(f"{line.name} {value:.3g}")
            drawn.append(svg.element("circle", note, cx=cx, cy=cy, r=3.4, fill=colour))
        names.append((line.name, colour))
    return _framed(drawn, names, title)


def bar_chart(bars: Sequence[Mapping[str, float]], *, title: str, x_name: str) -> str:
    """Draw stacked bars, one for each mapping of part to height, numbered from 0."""
    parts = list(dict.fromkeys(name for bar in bars for name in bar))
    top = max((sum(bar.values()) for bar in bars), default=0.0)
    ticks_y = _ticks(0.0, max(top, 1e-3))
    pitch = (WIDTH - LEFT - RIGHT) / max(len(bars), 1)
    thickness = min(0.66 * pitch, 44.0)

    def at(px: float, py: float) -> tuple[float, float]:
        return LEFT + px * pitch, HEIGHT - BOTTOM - py / ticks_y[-1] * (HEIGHT - TOP - BOTTOM)

    drawn = [svg.text(6, 16, title, class_="heading"), _axis_y(ticks_y, at, 0.0, float(len(bars)))]
    for number, bar in enumerate(bars):
        base, middle = 0.0, at(number + 0.5, 0.0)[0]
        for k, name in enumerate(parts):
            height = bar.get(name, 0.0)
            y = at(0.0, base + height)[1]
            note = svg.tooltip(f"{name}: {height:.3g}")
            drawn.append(
                svg.element(
                    "rect", note, x=middle - thickness / 2, y=y, width=thickness, height=at(0.0, base)[1] - y,
                    fill=COLOURS[k % len(COLOURS)],
                )
            )  # fmt: skip
            base += height
        drawn.append(svg.text(middle, HEIGHT - BOTTOM + 17, str(number), class_="small middle"))
    drawn.append(svg.text((LEFT + WIDTH - RIGHT) / 2, HEIGHT - 8, x_name, class_="small middle"))
    return _framed(drawn, [(name, COLOURS[k % len(COLOURS)]) for k, name in enumerate(parts)], title)


def _axis_y(ticks: Sequence[float], at: Place, low_x: float, high_x: float) -> str:
    drawn = []
    for value in ticks:
        (x0, y), (x1, _) = at(low_x, value), at(high_x, value)
        drawn.append(svg.element("path", d=f"M{x0:.1f} {y:.1f}H{x1:.1f}", class_="grid"))
        drawn.append(svg.text(x0 - 7, y + 4, f"{value:g}", class_="small end"))
    return "".join(drawn)


def _framed(drawn: Sequence[str], names: Sequence[tuple[str, str]], title: str) -> str:
    """Put a chart together, the names of its colours in rows below the axes."""
    legend, x, y = [], 8.0, HEIGHT + 10.0
    for name, colour in names:
        width = 22.0 + len(name) * svg.GLYPH_WIDTH * TEXT + 8.0
        if x > 8.0 and x + width > WIDTH:
            x, y = 8.0, y + 18.0
        legend.append(svg.element("rect", x=x, y=y - 9, width=11, height=11, rx=2, fill=colour))
        legend.append(svg.text(x + 17, y, name, class_="small"))
        x += width
    return svg.picture(WIDTH, y + 8.0, *drawn, *legend, name=title, text_size=TEXT)


def _ticks(low: float, high: float, whole: bool = False) -> list[float]:
    """Round numbers from `low` or below to `high` or above, about five; whole ones if asked."""
    raw = (high - low) / 5.0
    power = 10.0 ** np.floor(np.log10(raw))
    step = float(next(m for m in (1.0, 2.0, 2.5, 5.0, 10.0) if m * power >= raw - 1e-12) * power)
    if whole:
        step = float(max(1, np.ceil(step)))
    first = np.floor(low / step + 1e-9)
    last = np.ceil(high / step - 1e-9)
    return [float(np.round(k * step, 10)) for k in np.arange(first, last + 1)]
