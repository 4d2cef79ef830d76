"""From steps to pages to one HTML file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import resources
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from caryatid.config import ReportConfig
from caryatid.graph import SupportGraph
from caryatid.report.charts import Line, bar_chart, line_chart
from caryatid.report.cloud import draw_cloud
from caryatid.report.graphs import draw_graph
from caryatid.report.images import draw_image
from caryatid.report.rows import (
    ObjectRow,
    PointRow,
    SupportRow,
    object_rows,
    point_rows,
    settings_rows,
    support_rows,
)
from caryatid.report.sphere import draw_sphere
from caryatid.views import Cloud, View

if TYPE_CHECKING:
    from caryatid.evaluation.scores import Score
    from caryatid.exploration import Step


@dataclass(frozen=True, slots=True)
class Figure:
    """One picture of the report: what it is of, its SVG markup, a heading and what is to be seen in it."""

    kind: Literal["camera", "graph", "cloud", "sphere"]
    svg: str
    heading: str
    caption: str


@dataclass(frozen=True, slots=True)
class ViewPage:
    """One view, drawn: all the report says of it and none of its data.

    Attributes:
        index: Number of the view, from 0.
        name: The view's name, or the cloud's.
        figures: The pictures.
        objects: The table of objects.
        supports: The table of supports.
        points: The table of points of interest.
        choice: Why the next view was chosen, with its figures; empty where none was.
        timings: Time of each stage [s].
        angle_travelled: Around the view sphere so far [rad].
        path_travelled: Over the floor so far [m].
        stop: Why the exploration ended here, or None.
    """

    index: int
    name: str
    figures: tuple[Figure, ...]
    objects: tuple[ObjectRow, ...]
    supports: tuple[SupportRow, ...]
    points: tuple[PointRow, ...] = ()
    choice: str = ""
    timings: Mapping[str, float] = field(default_factory=dict)
    angle_travelled: float = 0.0
    path_travelled: float = 0.0
    stop: str | None = None


def draw_view(step: Step, config: ReportConfig | None = None) -> ViewPage:
    """Draw one step of an exploration, so that its images and clouds need not be kept.

    Args:
        step: What `explore` yields.
        config: Sizes of the pictures.
    """
    config = config or ReportConfig()
    first = step.visited[0] if len(step.visited) else np.array([1.0, 0.0, 0.0])
    page = draw_model(
        step.graph,
        step.cloud,
        view=step.view,
        labels=step.labels,
        azimuth=float(np.arctan2(first[1], first[0])),
        config=config,
    )
    figures = page.figures
    if step.candidates is not None or step.decision is not None:
        sphere = Figure("sphere", draw_sphere(step, config), "Where to look next", _sphere_caption(step))
        figures = (*figures, sphere)
    return replace(
        page,
        index=step.index,
        figures=figures,
        points=point_rows(step.decision),
        choice=_choice(step),
        timings=dict(step.timings),
        angle_travelled=step.angle_travelled,
        path_travelled=step.path_travelled,
        stop=step.stop,
    )


def draw_model(
    graph: SupportGraph,
    cloud: Cloud,
    *,
    view: View | None = None,
    labels: NDArray[np.int32] | None = None,
    azimuth: float = 0.0,
    config: ReportConfig | None = None,
) -> ViewPage:
    """Draw a scene model without any planning: what `extract` finds in a view, or in a cloud.

    Args:
        graph: Objects and supports.
        cloud: The points they were fitted to, labelled.
        view: The newest view, or None for a cloud.
        labels: Label image (H, W) of the view, or None to leave its parts out.
        azimuth: Direction about the vertical from which the cloud is drawn [rad]; also from the opposite one.
        config: Sizes of the pictures.
    """
    config = config or ReportConfig()
    figures = []
    if view is not None:
        parts = np.zeros(view.depth.shape, dtype=np.int32) if labels is None else labels
        kind = "colour image" if view.rgb is not None else "depth image, near bright and far dark"
        caption = (
            f"The {kind} around the objects, tinted by the parts found in it, with the outlines of the shapes "
            "fitted so far. Outlines are thin where something nearer hides them; a pale name has no pixel here."
        )
        drawn = draw_image(view, parts, graph, config)
        figures.append(Figure("camera", drawn, "What the camera saw", caption))
    caption = (
        "Arrows run from supporter to supported; on them, in how many of the views that could have shown it the "
        "relation was found. Dashed arrows are uncertain; objects with a dashed rim have no known supporter."
    )
    figures.append(Figure("graph", draw_graph(graph), "What supports what", caption))
    for turn, side in ((0.0, "from the side of the first view"), (np.pi, "from the opposite side")):
        drawn = draw_cloud(cloud, graph, azimuth + turn, config)
        caption = (
            f"{len(cloud):,} points fused so far in their objects' colours, pale where a surface is seen from "
            "its inside, which no camera can have done."
        )
        figures.append(Figure("cloud", drawn, f"Cloud and shapes {side}", caption))
    name = cloud.name if view is None else view.name
    return ViewPage(0, name, tuple(figures), object_rows(graph), support_rows(graph))


def render_report(
    pages: Sequence[ViewPage],
    *,
    title: str,
    settings: Mapping[str, object],
    scores: Sequence[Score] | None = None,
) -> str:
    """Write the report: one HTML file that loads nothing from anywhere.

    Args:
        pages: The views, in order.
        title: Heading of the report.
        settings: Names and values of the run's settings; mappings and dataclasses in it are flattened.
        scores: Score after each view, where the truth is known; as many as pages.

    Raises:
        ValueError: There are scores, but not one for each page, or there is no page.
    """
    import jinja2

    if not pages:
        raise ValueError("a report needs one view at least")
    if scores is not None and len(scores) != len(pages):
        raise ValueError(f"{len(scores)} scores for {len(pages)} views")
    source = resources.files("caryatid.report").joinpath("page.html.jinja").read_text(encoding="utf-8")
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    return environment.from_string(source).render(
        title=title,
        pages=pages,
        last=pages[-1],
        changes=[_changes(a, b) for a, b in zip([None, *pages[:-1]], pages, strict=True)],
        cards=_cards(pages, scores),
        charts=_charts(pages, scores),
        scores=scores,
        settings=settings_rows(settings),
    )


def _sphere_caption(step: Step) -> str:
    said = "The view sphere, coloured by saliency; washed out where the robot cannot bring its camera. "
    said += "Rays lead from each point of interest to where it is best seen. Numbers: views made; next: the choice."
    if step.candidates is not None:
        refused = ", ".join(f"{count:,} {reason}" for reason, count in step.candidates.rejected.items())
        said += f" {len(step.candidates.directions):,} views can be reached" + (
            f"; refused: {refused}." if refused else "."
        )
    return said


def _choice(step: Step) -> str:
    if step.decision is None:
        return ""
    d = step.decision
    return f"{d.why.rstrip('.')}. Saliency {d.saliency:.2f}, cost of the way {d.cost:.2f}, score {d.score:.2f}."


def _changes(before: ViewPage | None, after: ViewPage) -> str:
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


def _cards(pages: Sequence[ViewPage], scores: Sequence[Score] | None) -> list[tuple[str, str, str]]:
    """Big figures of the summary: (name, figure, what it is made of)."""
    last = pages[-1]
    objects = [o for o in last.objects if not o.surface]
    kinds = [(kind, sum(o.shape == kind for o in objects)) for kind in ("box", "cylinder", "sphere")]
    plural = {"box": "boxes", "cylinder": "cylinders", "sphere": "spheres"}
    uncertain = sum(not s.certain for s in last.supports)
    seconds = [sum(page.timings.values()) for page in pages]
    cards = [
        (
            "objects",
            str(len(objects)),
            ", ".join(f"{n} {k if n == 1 else plural[k]}" for k, n in kinds if n) or "none found",
        ),
        (
            "supports",
            str(len(last.supports)),
            f"{len(last.supports) - uncertain} certain, {uncertain} uncertain",
        ),
        ("views", str(len(pages)), last.stop or "no stop reason given"),
        (
            "travelled",
            f"{np.rad2deg(last.angle_travelled):.0f}°",
            f"around the scene; {last.path_travelled:.1f} m over the floor",
        ),
        ("per view", f"{np.mean(seconds):.2f} s", f"slowest {max(seconds):.2f} s"),
    ]
    if scores is not None:
        final = scores[-1]
        cards.insert(
            0, ("F1", f"{final.f1:.3f}", f"precision {final.precision:.3f}, recall {final.recall:.3f}")
        )
    return cards


def _charts(pages: Sequence[ViewPage], scores: Sequence[Score] | None) -> list[str]:
    number = [float(page.index) for page in pages]
    charts = []
    if scores is not None:
        kinds = (("F1", "f1"), ("precision", "precision"), ("recall", "recall"))
        lines = [Line(name, [float(getattr(score, key)) for score in scores]) for name, key in kinds]
        charts.append(line_chart(number, lines, title="Score over views", x_name="view", y_range=(0.0, 1.0)))
        path = [page.path_travelled for page in pages]
        unit = "path over the floor [m]"
        if path[-1] == 0.0 and pages[-1].angle_travelled > 0.0:
            path, unit = (
                [float(np.rad2deg(page.angle_travelled)) for page in pages],
                "angle around the scene [°]",
            )
        if path[-1] > path[0]:
            charts.append(
                line_chart(path, lines[:1], title="F1 over travelled path", x_name=unit, y_range=(0.0, 1.0))
            )
    if len(pages) > 1:
        found = [
            Line("objects", [sum(not o.surface for o in page.objects) for page in pages]),
            Line("supports", [len(page.supports) for page in pages]),
            Line("uncertain supports", [sum(not s.certain for s in page.supports) for page in pages]),
        ]
        charts.append(line_chart(number, found, title="Found so far", x_name="view"))
    if any(page.timings for page in pages):
        charts.append(
            bar_chart([page.timings for page in pages], title="Time of each view [s]", x_name="view")
        )
    return charts
