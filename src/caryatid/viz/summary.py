"""What the whole run comes to: big figures, charts, and what each view changed."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from caryatid.viz.charts import Line, bar_chart, line_chart

if TYPE_CHECKING:
    from caryatid.viz.contents import Report
    from caryatid.viz.page import ViewPage


def changes(before: ViewPage | None, after: ViewPage) -> str:
    """Say what a view added to and took from the graph."""
    if before is None:
        return ""
    objects = ({o.id: o for o in before.objects}, {o.id: o for o in after.objects})
    edges = (
        {(s.supporter, s.supported): s for s in before.supports},
        {(s.supporter, s.supported): s for s in after.supports},
    )
    arrow = "{} → {}".format
    both = edges[0].keys() & edges[1].keys()
    parts = [
        ("new objects", [n for n in objects[1] if n not in objects[0]]),
        ("objects gone", [n for n in objects[0] if n not in objects[1]]),
        ("new supports", [arrow(*p) for p in edges[1] if p not in edges[0]]),
        ("supports gone", [arrow(*p) for p in edges[0] if p not in edges[1]]),
        (
            "now certain",
            [arrow(*p) for p in edges[1] if p in both and edges[1][p].certain and not edges[0][p].certain],
        ),
        (
            "now in doubt",
            [arrow(*p) for p in edges[1] if p in both and edges[0][p].certain and not edges[1][p].certain],
        ),
        (
            "other shape",
            [n for n in objects[1] if n in objects[0] and objects[0][n].shape != objects[1][n].shape],
        ),
    ]
    return "; ".join(f"{name}: {', '.join(items)}" for name, items in parts if items) or "nothing new"


def cards(report: Report) -> list[tuple[str, str, str]]:
    """Big figures of the summary: (name, figure, what it is made of)."""
    pages, scores = report.pages, report.scores
    last = pages[-1]
    objects = [o for o in last.objects if not o.surface]
    kinds = sorted(Counter(o.shape for o in objects).items())
    uncertain = sum(not s.certain for s in last.supports)
    seconds = [sum(page.timings.values()) for page in pages]
    figures = [
        (
            "objects",
            str(len(objects)),
            ", ".join(f"{n} {k}{'' if n == 1 else 'es' if k == 'box' else 's'}" for k, n in kinds)
            or "none found",
        ),
        (
            "supports",
            str(len(last.supports)),
            f"{len(last.supports) - uncertain} certain, {uncertain} uncertain",
        ),
        ("views", str(len(pages)), last.stop or "all there were"),
        ("per view", f"{np.mean(seconds):.2f} s", f"slowest {max(seconds):.2f} s"),
    ]
    if last.angle_travelled > 0.0 or last.path_travelled > 0.0:
        travelled = f"{np.rad2deg(last.angle_travelled):.0f}°"
        figures.append(("travelled", travelled, f"around the scene; {last.path_travelled:.1f} m of way"))
    if scores:
        final = scores[-1]
        figures.insert(
            0, ("F1", f"{final.f1:.3f}", f"precision {final.precision:.3f}, recall {final.recall:.3f}")
        )
    return figures


def charts(report: Report) -> dict[str, str]:
    """Draw the summary's charts as SVG, by their titles: scores over views and path, what was found, time."""
    pages, scores = report.pages, report.scores
    number = [float(page.index) for page in pages]
    drawn = {}

    def draw_lines(title: str, x: list[float], x_name: str, lines: list[Line], y_name: str) -> None:
        y_range = (0.0, 1.0) if title.startswith("F1") else None
        drawn[title] = line_chart(x, lines, title=title, x_name=x_name, y_name=y_name, y_range=y_range)

    if scores:
        kinds = (("F1", "f1"), ("precision", "precision"), ("recall", "recall"))
        lines = [Line(name, [float(getattr(score, key)) for score in scores]) for name, key in kinds]
        draw_lines("F1 over views", number, "view", lines, ", ".join(line.name for line in lines))
        path, unit = [page.path_travelled for page in pages], "path [m]"
        if path[-1] == 0.0:
            path = [float(np.rad2deg(page.angle_travelled)) for page in pages]
            unit = "angle around the scene [°]"
        if path[-1] > path[0]:
            draw_lines("F1 over travelled path", path, unit, lines[:1], "F1")
    if len(pages) > 1:
        found = [
            Line("objects", [sum(not o.surface for o in page.objects) for page in pages]),
            Line("supports", [len(page.supports) for page in pages]),
            Line("uncertain supports", [sum(not s.certain for s in page.supports) for page in pages]),
        ]
        draw_lines("Found so far", number, "view", found, "number")
    if any(page.timings for page in pages):
        times, title = [page.timings for page in pages], "Time of each stage"
        drawn[title] = bar_chart(times, title=title, x_name="view", y_name="time [s]")
    return drawn
